"""mivol beside Mitsuba's path tracer: the verdict, its exit code, its files, and that a fault is found."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import pytest
from fit_scene import KEY
from tiny_experiment import run

from mivol.errors import MivolError
from mivol.experiments import validation
from mivol.experiments.validation import DIFFERS, UNTRUSTED, Validation, validate_scene
from mivol.scene.load import load_scene
from mivol.validate.trust import Doubt

FEW = Validation(spp=64, reference_spp=64, parameters=(KEY,))


@pytest.fixture
def scene(folder: Path) -> Path:
    """The absorbing cube."""
    return folder / "scene.xml"


def test_mivol_agrees_with_volpath(variant_rgb, scene: Path, capsys: pytest.CaptureFixture) -> None:
    """An absorbing cube, where both are right: the seeds are fixed, and with them there is no false alarm."""
    target = scene.parent / "validation"
    flags = ["--spp", 64, "--reference-spp", 256, "--parameter", KEY]
    assert run("validate", scene, "-o", target, *flags) == 0
    said = capsys.readouterr().out
    assert "mivol agrees with Mitsuba's volpath on this scene." in said
    assert "relMSE" in said
    found = json.loads((target / "validation.json").read_text())
    assert (target / "validation.png").read_bytes()[:4] == b"\x89PNG"
    assert found["code"] == 0
    assert found["bias"]["low"] <= 0 <= found["bias"]["high"]
    (slope,) = found["gradients"]
    # The image darkens where there is more extinction.
    assert slope["agrees"]
    assert slope["ours"] < 0


@pytest.mark.slow
def test_a_wrong_renderer_is_found(variant_rgb, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ours is given half the extinction for a while, and its gradient half the slope."""
    loaded = load_scene(scene)
    real_image, real_slope = validation.render_batches, validation.slope_of

    def halved(scene: mi.Scene, *rest: object) -> object:
        params = mi.traverse(scene)
        params[KEY] = params[KEY] * 0.5
        params.update()
        try:
            return real_image(scene, *rest)
        finally:
            params[KEY] = params[KEY] * 2.0
            params.update()

    with monkeypatch.context() as patch:
        patch.setattr(validation, "render_batches", halved)
        verdict = validate_scene(loaded, scene.parent / "a", FEW)
    assert verdict.code == DIFFERS
    assert not verdict.comparison.agrees
    with monkeypatch.context() as patch:
        patch.setattr(validation, "slope_of", lambda *given: 0.5 * real_slope(*given))
        verdict = validate_scene(loaded, scene.parent / "a", FEW)
    assert verdict.code == DIFFERS
    assert verdict.comparison.agrees
    assert not verdict.slopes[0].agrees


def test_a_reference_that_cannot_be_trusted_decides_nothing(
    variant_rgb, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validation, "trust", lambda scene, sensors: [Doubt("rotated", "the grid is turned.")])
    verdict = validate_scene(load_scene(scene), scene.parent / "a", Validation(spp=16, reference_spp=32))
    assert verdict.code == UNTRUSTED
    assert "is no reference here, so nothing is decided" in verdict.text
    assert "Doubt: the grid is turned." in verdict.text


def test_what_cannot_be_validated_is_refused(variant_rgb, scene: Path) -> None:
    with pytest.raises(MivolError, match="too few"):
        Validation(spp=3)
    with pytest.raises(MivolError, match="no parameter"):
        validate_scene(load_scene(scene), scene.parent / "a", Validation(parameters=("cube.none",)))
