"""An image in passes, and of a volume alone."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mivol.experiments import render
from mivol.experiments.render import Framing
from mivol.files import write_volume
from scenes import refused


def test_render_in_passes_is_the_mean(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three passes of 3 samples: interior pixels differ from one pass of 9 only by where samples fall, 4 % of tau."""
    scene = mi.load_file(str(folder / "scene.xml"), spp=9)
    once, names = render.render_image(scene, 0)
    monkeypatch.setattr(render, "SAMPLES_PER_PASS", 3 * 48)
    split, _ = render.render_image(scene, 0)
    assert names == ["R", "G", "B", "tau"]
    assert np.isclose(split[3, 4, 0], once[3, 4, 0], rtol=0.02)
    assert not np.array_equal(split, once)


@pytest.mark.parametrize("count", [2, 3])
def test_each_pass_has_a_seed_of_its_own(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Passes with one seed would be one image, as noisy as a single pass."""
    parts = []

    def render_black(given):
        parts.extend(given)
        return ((np.zeros((6, 8, 4)), 0.0) for _ in given)

    monkeypatch.setattr(render, "SAMPLES_PER_PASS", 3 * 48)
    render.render_image(mi.load_file(str(folder / "scene.xml")), 0, spp=3 * count, passes=render_black)
    assert [spp for _, spp in parts] == [3] * count
    assert len({seed for seed, _ in parts}) == count


@pytest.mark.parametrize("colours", ["luminance", "rgb", "rgba"])
@pytest.mark.parametrize("inside", [0, 1, 2])
def test_channels_of_integrators_inside_aov_have_names(variant_rgb, colours: str, inside: int) -> None:
    """Values and names of each channel are those of the same integrator alone; the first has the plain names."""
    film = {"type": "hdrfilm", "width": 8, "height": 6, "pixel_format": colours, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    camera = {"type": "perspective", "to_world": place, "film": film}
    scene = mi.load_dict({"type": "scene", "camera": camera, "ball": {"type": "sphere"}, "sky": {"type": "constant"}})
    kinds = {"first": "direct", "second": "depth"}
    parts = {name: {"type": kinds[name]} for name in list(kinds)[:inside]}
    image, names = render.render_image(scene, 0, mi.load_dict({"type": "aov", "aovs": "far:depth", **parts}))
    own = {"luminance": "Y", "rgb": "RGB", "rgba": "RGBA"}[colours]
    expected = [*own[: len(own) * bool(inside)], *(f"second.{letter}" for letter in own if inside == 2), "far.T"]
    assert names == expected and image.shape == (6, 8, len(names))
    for prefix, part in zip(("", "second.")[:inside], parts.values(), strict=True):
        alone, _ = render.render_image(scene, 0, mi.load_dict(part))
        found = image[..., [names.index(prefix + letter) for letter in own]]
        np.testing.assert_allclose(found, alone, rtol=1e-4, atol=1e-5)


def test_an_image_without_colours_is_no_png(tmp_path: Path) -> None:
    with refused("no colours, only far.T: write it as .exr"):
        render.write_image(tmp_path / "a.png", np.zeros((2, 2, 1)), ["far.T"])


# -- A volume alone ----------------------------------------------------------------------------------------------------


def write_ball(path: Path, factor: float = 1.0, length: float = 1.0) -> Path:
    """A ball in a box of 2 x 2 x 4 times a length, far from the origin."""
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, 16),) * 3, indexing="ij")
    values = factor * (x * x + y * y + z * z < 0.5).astype(np.float32)
    place = np.diag([2.0, 2.0, 4.0, 1.0])
    place[:3, 3] = 10, -5, 3
    place[:3] *= length
    write_volume(path, values, place)
    return path


def test_a_volume_is_seen_whole_and_scaled(variant_rgb, tmp_path: Path) -> None:
    """Before the sky, in the middle of the image; its values in another unit give the same image."""
    size = Framing(size=(16, 12))
    image, names = render.render_volume(write_ball(tmp_path / "a.vol"), size, spp=16)
    other, _ = render.render_volume(write_ball(tmp_path / "b.vol", 256.0), size, spp=16)
    assert image.shape == (12, 16, 3) and names == ["R", "G", "B"]
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    np.testing.assert_allclose(edge, np.broadcast_to([0.03, 0.05, 0.09], edge.shape), rtol=1e-5)
    assert image[6, 8, 0] > 0.1
    # The same products, since 256 is a power of two; threads add the 16 samples of a pixel in any order.
    np.testing.assert_allclose(image, other, rtol=16 * 2.0**-23)
    side = Framing([11, -20, 5, 11, 0, 5], (0.0, 0.0, 1.0), 30.0, (16, 12))
    moved, _ = render.render_volume(tmp_path / "a.vol", side, spp=16)
    assert moved[6, 8, 0] > 0.04 and not np.array_equal(moved, image)


@pytest.mark.parametrize("length", [1e-4, 1e4])
def test_a_volume_of_any_size_is_seen(variant_rgb, tmp_path: Path, length: float) -> None:
    """Smaller than the near plane of Mitsuba's cameras (0.01), and behind their far plane (10,000)."""
    image, _ = render.render_volume(write_ball(tmp_path / "a.vol", length=length), Framing(size=(16, 12)), spp=16)
    np.testing.assert_allclose(image[0], np.broadcast_to([0.03, 0.05, 0.09], image[0].shape), rtol=1e-5)
    assert image[6, 8, 0] > 0.1


def test_a_volume_without_matter_is_refused(variant_rgb, tmp_path: Path) -> None:
    write_volume(tmp_path / "empty.vol", np.full((2, 2, 2), -1.0, np.float32))
    with refused("empty.vol: found no value above 0, which a smoke needs"):
        render.render_volume(tmp_path / "empty.vol", Framing())
    write_ball(tmp_path / "a.vol")
    with refused("^--look-at .* is no camera"):
        render.render_volume(tmp_path / "a.vol", Framing([0, 0, 0, 1, 1, 1], (0.0, 0.0, 1.0), 200.0))
    (tmp_path / "broken.vol").write_bytes(b"VOL\3")
    with refused("^[^ ]*broken.vol"):
        render.render_volume(tmp_path / "broken.vol", Framing())


@pytest.mark.parametrize("name", ["volpath", "direct"])
def test_a_named_integrator_hides_what_the_scene_hides(variant_rgb, name: str) -> None:
    """``direct`` has no longest path, and hides emitters all the same."""
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "volpath", "max_depth": 5, "hide_emitters": True}})
    assert render.choose_integrator(scene, name).hide_emitters
