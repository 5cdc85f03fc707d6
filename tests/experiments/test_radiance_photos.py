"""``mivol optimize`` on photographs of radiance (OpenEXR): what is fitted, judged, shown and stored is in the right unit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_photos import camera
from photo_sets import png_of_16_bits
from PIL import Image
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments.field_fit import adapt_plan, make_batches, make_radiance_plan, write_result
from mivol.experiments.photo_data import MIDDLE_GREY, describe_photos, divide_by_white, read_photos
from mivol.experiments.photo_fit import judge_colour_fitted, write_view
from mivol.fields.field_files import read_field
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import encode_srgb, read_exr, write_exr, write_png
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos.transforms import write_transforms
from mivol.validate.metrics import score_image

UNIT = 3000.0
"""Radiance of the files: nothing is near 1."""


def scene(n: int = 12) -> SphericalGrid:
    """A ball of 100 on one side and 400,000 on the other."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    level = 2 * UNIT * np.exp(7.0 * x)[..., None, None] * np.array([1.0, 0.8, 0.6])
    cube = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]])
    return SphericalGrid.from_dense(60 * (0.6 - np.sqrt(x * x + y * y + z * z)), level / 0.2820948, cube, offset=0.0)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve OpenEXR views of the ball, over black, two of them to be judged by."""
    import mitsuba as mi

    import mivol.plugins  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    folder, cameras = tmp_path_factory.mktemp("radiance"), {}
    for k in range(12):
        name = f"view_{k}.exr"
        cameras[name] = camera(k)
        write_exr(folder / name, {"": render_view(scene(), camera(k), np.zeros(3)).image})
    write_transforms(folder / "transforms.json", cameras, ["view_3.exr", "view_8.exr"])
    return folder


def toml(folder: Path, photographs: Path, photos: str = "", field: str = "effort = 0.02") -> Path:
    path = folder / "fit.toml"
    path.write_text(
        f"""
        title = "A lamp"
        [photos]
        path = "{photographs}"
        box = [[-1, -1, -1], [1, 1, 1]]
        held_out = 0
        judged = "test"
        {photos}
        [field]
        preset = "tiny"
        longest = 26
        degree = 0
        {field}
        [show]
        frames = 2
        views = 1
        """
    )
    return path


def read(path: Path) -> tuple:
    return read_photos(config.load(path), path.parent)


def test_photographs_of_radiance_are_shown_at_one_exposure(photographs: Path, tmp_path: Path) -> None:
    """Both sets are divided by one power of 2, which brings the median of what is lit to middle grey."""
    photos, judged = read(toml(tmp_path, photographs))
    assert (photos.space, judged.space, judged.white) == ("linear", "linear", photos.white)
    assert np.log2(photos.white) == int(np.log2(photos.white)) and photos.white > 1000
    lit = np.concatenate([view.image[view.image.max(axis=2) > 0].mean(axis=1) for view in photos.views])
    # Every other row and column is looked at, and the power is rounded.
    assert abs(np.log2(np.median(lit) / MIDDLE_GREY)) < 0.6
    channels, _ = read_exr(photographs / "view_3.exr")
    np.testing.assert_array_equal(judged.views[0].image[..., 1] * np.float32(photos.white), channels["G"])
    assert f"y = 1 is the radiance {photos.white:g}" in describe_photos(photos, judged)[0]
    assert divide_by_white(photos, 1.0) is photos


def test_what_is_found_is_kept_in_the_unit_of_the_files(photographs: Path, tmp_path: Path) -> None:
    """The field and its sky are brightened; a view beside its photograph is tone-mapped."""
    path = toml(tmp_path, photographs, field="sky = 8")
    photos, judged = read(path)
    plan = adapt_plan(make_radiance_plan(config.load(path)), photos)
    problem = RadianceProblem(make_batches(plan, photos), photos.box, plan)
    problem.sky = Sky.uniform(8, 0.75)
    write_result(tmp_path, problem, "_best", photos.white)
    found = read_field(tmp_path / "field_best.npz")
    assert (found.space, found.offset) == ("linear", 0.5 * photos.white)
    assert np.all(read_exr(tmp_path / "sky_best.exr")[0]["G"] == 0.75 * photos.white)
    twice = SphericalGrid.scale_colours(scene(4), 2.0)
    np.testing.assert_array_equal(np.array(twice.harmonics), 2 * np.array(scene(4).harmonics))
    (tmp_path / "views").mkdir()
    write_view(tmp_path, judged.views[0], 0, judged.views[0].image / 2, "linear")
    for name, image in (("reference", judged.views[0].image), ("render", judged.views[0].image / 2)):
        shown = np.array(Image.open(tmp_path / f"views/000_{name}.png"))
        np.testing.assert_allclose(shown / 255, encode_srgb(image), atol=0.51 / 255)
    # Half as bright, and otherwise the same: what is not shown white is fitted away.
    view = replace(judged.views[0], image=np.minimum(judged.views[0].image, 1))
    assert (
        judge_colour_fitted(view.image / 2, view, "linear")
        > score_image(view.image / 2, view.image, space="linear").values["psnr"] + 6
    )


@pytest.mark.slow
def test_a_fit_of_radiance_is_as_bright_as_its_photographs(photographs: Path, tmp_path: Path) -> None:
    """Where codes would end at white, the median ratio of field and photograph is 1 to a few per cent; the page says it all."""
    path = toml(tmp_path, photographs, field="effort = 1.5")
    _, judged = read(path)
    assert main(["optimize", str(path), "-o", str(tmp_path / "run")]) == 0
    found, ratios = read_field(tmp_path / "run/field.npz"), []
    for view in judged.views:
        seen, truth = render_view(found, view.camera, np.zeros(3)).image, view.image * judged.white
        bright = view.image.max(axis=2) > 1
        assert bright.sum() > 20
        ratios.append(np.median(seen[bright] / truth[bright]))
    # Of what is brighter than white, up to 3 and 6 times, codes would leave 0.6 and 0.4. 0.93 and 0.98 were seen.
    np.testing.assert_allclose(ratios, 1, atol=0.15)
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["results"]["held_out_psnr"] > 30
    assert "mildenhall_2022" in record["citations"] and any("tone-mapped" in note for note in record["notes"])
    assert "NeRF in the Dark" in (tmp_path / "run/report.html").read_text()


@pytest.mark.parametrize("said_by", ["the file", "the setting"])
def test_png_of_16_bits_may_hold_radiance(tmp_path: Path, said_by: str) -> None:
    """Radiance as a raw converter writes it: the numbers over the largest, exposed as those of OpenEXR are."""
    cameras, codes = {f"{k}.png": camera(k) for k in range(3)}, np.full((48, 48, 3), [3000, 600, 120], np.uint16)
    for name in cameras:
        (tmp_path / name).write_bytes(png_of_16_bits(codes, gamma=100_000 if said_by == "the file" else None))
    write_transforms(tmp_path / "transforms.json", cameras, ["2.png"])
    photos, judged = read(toml(tmp_path, tmp_path, "" if said_by == "the file" else 'stored = "linear"'))
    assert photos.space == judged.space == "linear" and photos.stored == {"linear"}
    for view in (*photos.views, *judged.views):
        np.testing.assert_allclose(view.image[7, 7] * photos.white, codes[0, 0] / 65535, rtol=1e-6)
    photos, _ = read(toml(tmp_path, tmp_path, 'stored = "linear"\nspace = "srgb"'))
    np.testing.assert_allclose(photos.views[0].image[7, 7], encode_srgb(codes[0, 0] / 65535), rtol=1e-5)
    photos, _ = read(toml(tmp_path, tmp_path, 'stored = "srgb"'))
    np.testing.assert_allclose(photos.views[0].image[7, 7], codes[0, 0] / 65535, rtol=1e-6)
    assert photos.space == "srgb" and photos.white == 1


def test_codes_and_radiance_in_one_set_are_refused(photographs: Path, tmp_path: Path) -> None:
    """One sentence with the key that settles it; with it, either kind is made of the other."""
    cameras = {"a.exr": camera(0), "b.png": camera(1), "c.exr": camera(2)}
    for name in cameras:
        image = np.full((48, 48, 3), [0.5, 0.25, 2.0], np.float32)
        write_exr(tmp_path / name, {"": image}) if name.endswith("exr") else write_png(tmp_path / name, image)
    write_transforms(tmp_path / "transforms.json", cameras, ["c.exr"])
    with pytest.raises(MivolError, match='b.png: found sRGB codes and radiance in one data set, .*; set space = "srgb" or'):
        read(toml(tmp_path, tmp_path))
    photos, _ = read(toml(tmp_path, tmp_path, 'space = "srgb"'))
    for view in photos.views:
        np.testing.assert_allclose(view.image[7, 7], encode_srgb(np.array([0.5, 0.25, 1])), atol=0.6 / 255)
    assert any("radiance above 1 counts as 1" in note for note in describe_photos(photos))
    photos, judged = read(toml(tmp_path, tmp_path, 'space = "linear"'))
    np.testing.assert_allclose(photos.views[1].image[7, 7] * photos.white, [0.5, 0.25, 1], atol=0.005)
    np.testing.assert_allclose(judged.views[0].image[7, 7] * judged.white, [0.5, 0.25, 2], rtol=1e-6)
    assert any("converted to radiance" in note for note in describe_photos(photos))


def test_gaussians_are_fitted_to_codes(photographs: Path, tmp_path: Path) -> None:
    text = toml(tmp_path, photographs).read_text()
    path = tmp_path / "gaussians.toml"
    path.write_text(text[: text.index("[field]")] + "[gaussians]\n preset = 'tiny'")
    photos, _ = read(path)
    assert (photos.space, photos.white) == ("srgb", 1.0) and max(view.image.max() for view in photos.views) < 1.01
    path.write_text(path.read_text().replace("held_out = 0", 'space = "linear"'))
    assert_refused('Gaussians, which are fitted to code values: choose "srgb"', read, path)
