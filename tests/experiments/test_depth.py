"""A fit whose depth is measured: in the truth, once, and written down."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_experiment import PHOTOS, refused, run

from mivol import config
from mivol.experiments import depth

ONE = ["--set", 'fit.max_depth="auto"', "--set", "fit.iterations=1", "--set", "reference.spp=32"]


def record_of(folder: Path) -> dict:
    return json.loads((folder / "run" / "run.json").read_text())


def whiten(folder: Path, albedo: float) -> None:
    """Give the medium an albedo, where it had none."""
    scene = folder / "scene.xml"
    scene.write_text(scene.read_text().replace('name="albedo" value="0"', f'name="albedo" value="{albedo}"'))


@pytest.mark.slow
@pytest.mark.parametrize(("albedo", "noise", "limit"), [(0.0, 0.02, 2), (0.99, 1e-6, -1)])
def test_the_depth_is_measured_in_the_truth(variant_rgb, folder: Path, albedo: float, noise: float, limit: int) -> None:
    """What only absorbs needs no more than 2, whatever noise is asked for; the start is empty, the truth is not."""
    whiten(folder, albedo)
    more = ["--set", f"fit.noise={noise}", "--set", "parameter.0.start=0.0"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *ONE, *more) == 0
    first = record_of(folder)["plan"][0]
    assert first["choice"] == f"max_depth: {limit}"
    assert "depth 2 leaves out" in first["reason"]


def test_of_photographs_nothing_is_known(variant_rgb, folder: Path) -> None:
    """Paths have no limit where the references are files and no truth is given."""
    text = (folder / "fit.toml").read_text()
    (folder / "fit.toml").write_text("\n".join(line for line in text.splitlines() if not line.startswith("truth")))
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *ONE[:4], *PHOTOS) == 0
    first = record_of(folder)["plan"][0]
    assert (first["choice"], first["reason"]) == ("max_depth: -1", "the references are files, and what they show is not known")


def test_other_words_are_refused(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    said = refused(capsys, "optimize", folder / "fit.toml", "--set", 'fit.max_depth="atuo"')
    assert 'max_depth is "atuo": expected a whole number from -1 on, or "auto"' in said


@pytest.mark.parametrize("truth", [None, "values"])
def test_the_first_view_is_measured_with_the_truth_in_the_scene(monkeypatch: pytest.MonkeyPatch, truth: str | None) -> None:
    """Where there is one; the noise is that of the fit, and the task has a number then."""
    held, asked = [], []
    chosen = SimpleNamespace()
    chosen.fit = SimpleNamespace(max_depth=depth.AUTO, noise=0.125)
    chosen.reference, chosen.truth = config.Rendered(), SimpleNamespace(key="k")
    chosen.views = SimpleNamespace(sensors=lambda scene: iter([f"first of {scene}", "second"]))

    @contextmanager
    def holding(scene: str, key: str, values: str) -> Iterator[None]:
        held.append((scene, key, values))
        yield
        held.append("given back")

    def measured(scene: str, sensor: str, settings: object, noise: float) -> SimpleNamespace:
        asked.append((scene, sensor, noise, len(held)))
        return SimpleNamespace(depth=5, reason="so")

    monkeypatch.setattr(depth, "holding", holding)
    monkeypatch.setattr(depth, "camera_of", lambda sensor: f"camera {sensor}")
    monkeypatch.setattr(depth, "measure_depths", measured)
    monkeypatch.setattr(depth.msgspec.structs, "replace", lambda given, **change: SimpleNamespace(**change))
    monkeypatch.setattr(depth, "replace", lambda task, chosen: chosen)
    settled, (line,) = depth.settle_depth(SimpleNamespace(chosen=chosen), SimpleNamespace(scene="scene"), truth)
    assert settled.fit.max_depth == 5 and (line.choice, line.reason) == ("max_depth: 5", "so")
    assert asked == [("scene", "camera first of scene", 0.125, 0 if truth is None else 1)]
    assert held == ([] if truth is None else [("scene", "k", "values"), "given back"])


def test_a_depth_that_is_given_is_not_measured() -> None:
    task = SimpleNamespace(chosen=SimpleNamespace(fit=SimpleNamespace(max_depth=3)))
    assert depth.settle_depth(task, None, None) == (task, [])
