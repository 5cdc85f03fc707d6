"""What was seen of a scene: rendered once, read from files, and held out."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from tiny_experiment import SCENE, refused, run

from mivol.config import Truth
from mivol.errors import MivolError
from mivol.experiments import references
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.references import check_truth, hold_values, make_truth
from mivol.files import write_exr, write_volume
from mivol.validate.reference_file import ReferenceResult
from scenes import box_of, grid_volume, medium


@pytest.mark.slow
def test_references_are_cached(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second fit of the same views renders none again, another truth does; and each row of the metrics is there once."""
    target = folder / "run"
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    flags = ["optimize", folder / "fit.toml", "-o", target, *fewer]
    assert run(*flags, "--set", "fit.iterations=1") == 0
    before = {path: path.stat().st_mtime_ns for path in (target / "references").iterdir()}
    assert run(*flags, "--set", "fit.iterations=2") == 0
    assert {path: path.stat().st_mtime_ns for path in (target / "references").iterdir()} == before
    assert len((target / "metrics.jsonl").read_text().splitlines()) == 3
    assert run(*flags, "--set", "fit.iterations=1", "--set", "truth.seed=4") == 0
    assert len(list((target / "references").glob("*.exr"))) == 2


@pytest.mark.slow
def test_references_from_files(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Photographs (no header) are taken as they are; mivol's own must be of this scene."""
    write_exr(folder / "a.exr", {"": np.full((6, 8, 3), 0.7, "f")})
    (folder / "other.xml").write_text(SCENE.replace('value="35"', 'value="36"'))
    changes = ["--set", 'views={rig="scene", indices=[0]}', "--set", "event=[]", "--set", "fit.iterations=2"]
    files = ["--set", 'reference={source="files", paths=["a.exr"]}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *changes, *files) == 0
    assert run("reference", folder / "other.xml", "-o", folder / "d.exr", "--max-depth", 6, "--spp", 32) == 0
    capsys.readouterr()
    wrong = ["--set", 'reference={source="files", paths=["d.exr"]}']
    said = refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *changes, *wrong)
    assert "reference of another scene" in said
    right = ["--set", 'reference={source="files", paths=["d.exr"], scene="other.xml"}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *changes, *right) == 0


@pytest.mark.parametrize(("variant", "taken", "channels"), [("llvm_ad_rgb", "", 3), ("llvm_ad_mono", "Y", 1)])
def test_a_photograph_has_what_the_variant_renders(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variant: str, taken: str, channels: int
) -> None:
    """Colours without their alpha, or a luminance; a scene's fit met a KeyError on the other."""
    monkeypatch.setattr(references.mi, "variant", lambda: variant)
    held = {"": np.zeros((4, 5, 4)), "Y": np.zeros((4, 5))}
    assert references.select_colours(tmp_path / "a.exr", held).shape == (4, 5, channels)
    del held[taken]
    with pytest.raises(MivolError, match=r"a\.exr: found the channels (R, G, B|Y), expected (R, G and B|Y \(luminance\));"):
        references.select_colours(tmp_path / "a.exr", held)


def test_views_that_are_held_out_come_after_the_others(variant_rgb, folder: Path) -> None:
    """A rig of their own: none of its views is fitted, all of them are compared, and their files follow the others'."""
    (folder / "d.exr").write_bytes((folder / "c.exr").read_bytes())
    files = 'reference={source="files", paths=["a.exr", "b.exr", "c.exr", "d.exr"], held_out=[0]}'
    more = 'held_out={rig="ring", count=1, width=8, height=8, elevation=40}'
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", "--set", files, "--set", more) == 0
    record = json.loads((folder / "run" / "run.json").read_text())
    shown = [image for image in record["images"] if image.get("view")]
    assert {image["view"] for image in shown if image.get("held_out")} == {"view 0", "view 3"}
    assert {image["view"] for image in shown if not image.get("held_out")} == {"view 1", "view 2"}
    assert record["results"]["views"] == 2


def test_views_of_different_sizes(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    sensor = SCENE[SCENE.index("<sensor") : SCENE.index("</sensor>") + 9]
    (folder / "scene.xml").write_text(SCENE.replace(sensor, sensor + sensor.replace('value="6"', 'value="5"')))
    flags = ["--set", 'views={rig="scene"}', "--set", 'reference={source="render", spp=64}']
    said = refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *flags)
    assert "8 x 5 pixels" in said
    assert "8 x 6" in said


@pytest.mark.parametrize(("wanted", "target"), [(0.0, None), (0.25, 0.25)])
@pytest.mark.parametrize(("own", "depth"), [(None, 7), (-1, -1), (0, 0)])
def test_a_reference_is_rendered_as_the_file_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, wanted: float, target: float | None, own: int | None, depth: int
) -> None:
    """Each view with its own depth or the fit's, emitters hidden as its own, up to the samples or the error; 0 is no aim."""
    asked, kept = [], []
    monkeypatch.setattr(references, "prepare_reference", lambda *how, **settings: asked.append((how, settings)) or made)
    monkeypatch.setattr(references, "standard_error", lambda found: "its error")
    made = SimpleNamespace(complete=lambda: SimpleNamespace(mean="its mean"))
    chosen = SimpleNamespace(
        fit=SimpleNamespace(max_depth=7), reference=SimpleNamespace(standard_error=wanted, spp=33, seed=5, max_depth=own)
    )
    context = RunContext(chosen, Path(), tmp_path)
    loaded = SimpleNamespace(scene=SimpleNamespace(integrator=lambda: SimpleNamespace(hide_emitters=True)))
    references.render_views(SimpleNamespace(add=lambda *view: kept.append(view)), context, chosen, loaded, ["a", "b"])
    settings = {"max_depth": depth, "hide_emitters": True, "target_se": target, "max_spp": 33, "seed": 5}
    assert asked == [((loaded, tmp_path / "references"), {"sensor": view, **settings}) for view in "ab"]
    assert kept == [(view, "its mean", "its error") for view in "ab"]
    assert (tmp_path / "references").is_dir()


def test_a_faint_light_that_a_reference_has_missed_is_no_difference() -> None:
    """The edge of a smoke under a lamp, as it was seen: 256 samples of 0.8, one in 50 of which meets the smoke, mean 0.016.
    A pixel whose samples all missed it (chance 0.6 %) stood 0.016 n / (brightest mean) = 9.5 standard errors off. Its 8
    neighbours hold 41 events in the mean: z is beyond 5 where they hold 9 or fewer, of a chance of 1e-8.
    """
    n, light, chance = 256, 0.8, 1 / 50
    events = np.random.default_rng(4).binomial(n, chance, (40, 40, 1)).astype(float)
    assert (events == 0).any()
    mean, share = light * events / n, events / n
    mean[0, 0] = 0.43
    made = ReferenceResult(mean, light**2 * share * (1 - share) / n, 32, n, {}, Path("a.exr"))
    z = (light * chance - mean) / references.standard_error(made)
    assert np.abs(z[events == 0]).max() < 5


KEY = "smoke.interior_medium.sigma_t.data"


def scene() -> mi.Scene:
    box = box_of(medium("mivol_medium", grid_volume("mivol_voxels", np.ones((2, 3, 4)))), np.eye(4))
    return mi.load_dict({"type": "scene", "smoke": box})


def experiment(truth: Truth | None, *sought: str) -> SimpleNamespace:
    return SimpleNamespace(truth=truth, parameter=[SimpleNamespace(key=key) for key in sought])


def test_a_truth_is_a_file_beside_the_experiment_or_made(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4, 1)
    write_volume(tmp_path / "truth.npz", values, np.eye(4))
    assert make_truth(experiment(None), tmp_path, scene()) is None
    np.testing.assert_array_equal(make_truth(experiment(Truth(key=KEY, file="truth.npz")), tmp_path, scene()), values)
    made = make_truth(experiment(Truth(key=KEY, procedural="tangle", shape=(4, 5, 6), peak=2.0)), tmp_path, scene())
    assert made.shape[:3] == (4, 5, 6) and 0 < made.max() <= 2
    assert_refused("nothing", make_truth, experiment(Truth(key="nothing", file="truth.npz")), tmp_path, scene())


def test_a_truth_is_of_what_is_looked_for() -> None:
    check_truth(experiment(None))
    check_truth(experiment(Truth(key=KEY, file="truth.npz"), "other", KEY))
    assert_refused("no parameter of the fit", check_truth, experiment(Truth(key=KEY, file="truth.npz"), "other"))


def test_a_scene_holds_other_values_for_a_while() -> None:
    found = scene()
    params = mi.traverse(found)
    with hold_values(found, KEY, np.full((2, 3, 4, 1), 7.0)):
        assert set(np.array(params[KEY]).ravel()) == {7}
        assert set(np.array(mi.traverse(found)[KEY]).ravel()) == {7}
    assert set(np.array(mi.traverse(found)[KEY]).ravel()) == {1}
