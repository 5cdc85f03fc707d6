"""Study of captures: constants chosen with each capture left out, wrong poses, folders that are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_photos import write_capture

from mivol.bench.studies import captures
from mivol.bench.studies.captures import RULE, STUDY, CaptureSize, Variation, disturb_poses, leave_each_out
from mivol.errors import MivolError
from mivol.photos import load_photos
from mivol.photos.region import viewing_distance


def test_a_value_is_chosen_without_the_capture_left_out() -> None:
    """One capture gains 3 dB from a value that costs the others half a dB each: without it the rule is better."""
    gains = {"low": {"a": 3.0, "b": -0.5, "c": -0.5}, "the rule": {"a": 0.0, "b": 0.0, "c": 0.0}}
    found = leave_each_out(gains)
    assert found == {"chosen": {"a": "the rule", "b": "low", "c": "low"}, "left_out": pytest.approx(-1 / 3), "is_stable": False}
    gains["low"]["a"] = 0.4
    assert leave_each_out(gains) == {"chosen": dict.fromkeys("abc", "the rule"), "left_out": 0.0, "is_stable": True}


def test_each_constant_has_the_rule_among_its_values() -> None:
    for constants in captures.CONSTANTS.values():
        for choices in constants.values():
            assert [choice is RULE for choice in choices].count(True) == 1
            assert len({choice.label for choice in choices}) == len(choices) > 1


def test_poses_are_disturbed_by_the_wanted_deviations(tmp_path: Path) -> None:
    """12 cameras: 36 numbers of each kind, whose root mean square scatters by 12 %: within four deviations."""
    photos, size = load_photos(write_capture(tmp_path / "capture", 12)), CaptureSize(turn=2.0, shift=0.05)
    wrong = disturb_poses(photos, size)
    before, after = ([view.camera for view in one.views] for one in (photos, wrong))
    turns = [a.to_world[:3, :3].T @ b.to_world[:3, :3] for a, b in zip(before, after, strict=True)]
    angles = np.degrees(np.arccos([(np.trace(turn) - 1) / 2 for turn in turns]))
    shifts = np.array([b.origin - a.origin for a, b in zip(before, after, strict=True)])
    assert np.sqrt(np.mean(angles**2) / 3) == pytest.approx(2.0, rel=0.5)
    assert np.sqrt(np.mean(shifts**2)) == pytest.approx(0.05 * viewing_distance(before, photos.box), rel=0.5)


@pytest.mark.parametrize(
    ("named", "said"),
    [(("",), "found no captures: --captures expects"), (("nowhere",), "nowhere is missing: --captures expects")],
)
def test_folders_that_are_refused(named: tuple[str, ...], said: str, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    assert STUDY.run(["--quick", "--captures", *named, "--out", str(tmp_path)]) == 1
    assert said in capsys.readouterr().err


class Fitted:
    """Stands for a fit that has a known PSNR."""

    def __init__(self, psnr: float) -> None:
        self.psnr = psnr

    def score(self, views: list, metrics: tuple[str, ...] = ("psnr",)) -> dict[str, float]:
        return {"psnr": self.psnr, "ssim": 0.5}


def test_each_capture_is_fitted_with_each_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    folders = [tmp_path / name for name in ("one", "two")]
    for folder in folders:
        folder.mkdir()
    more = Variation("more")
    monkeypatch.setattr(captures, "CONSTANTS", {"grid": {"steps": (RULE, more)}})
    monkeypatch.setattr(captures, "choose_judged", lambda fitted, size: [])
    psnr = {("one", RULE): 20.0, ("two", RULE): 24.0, ("one", more): 21.5, ("two", more): 24.25}
    monkeypatch.setattr(captures, "fit_capture", lambda folder, kind, size, choice=RULE: Fitted(psnr[folder.name, choice]))
    size = CaptureSize(captures=(str(folders[0]), f"second={folders[1]}"))
    answer = STUDY.answer(("grid",), size)["grid"]
    assert answer["constants"]["steps"]["gains"] == {"the rule": {"one": 0, "second": 0}, "more": {"one": 1.5, "second": 0.25}}
    printed = capsys.readouterr().err
    assert "| the rules | 20.00 / 0.500 | 24.00 / 0.500 | 22.00 | |" in printed
    assert "| steps: more | +1.50 | +0.25 | +0.88 | 2 of 2 |" in printed
    with pytest.raises(MivolError, match="two captures of one name"):
        captures.list_captures(replace(size, captures=(str(folders[0]), f"one={folders[1]}")))


@pytest.mark.slow
def test_a_capture_is_fitted_with_moving_cameras(variant_rgb: str, tmp_path: Path) -> None:
    """A fit of few steps is foggy, but judged photographs are found and aligned."""
    size = replace(CaptureSize.quick(), judged=1)
    fitted = captures.fit_capture(write_capture(tmp_path / "capture", 9), "grid", size, poses=True)
    (view,) = captures.choose_judged(fitted, size)
    before, after = (fitted.score([one])["psnr"] for one in (view, captures.align_view(fitted, view)))
    assert 8 < before <= after
