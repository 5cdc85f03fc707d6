"""Scenes in which gradients of prbvolpath are wrong: scripts/biased_gradients.py and its page."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh

from mivol.validate.statistics import Moments

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SCRIPT = runpy.run_path(str(ROOT / "scripts" / "biased_gradients.py"))
SCENES = tuple(SCRIPT["SCENES"])


def test_page_has_a_row_for_each_scene() -> None:
    """In the order of the script, each with the command that prints it."""
    rows = re.findall(r"^\| `(\w+)` .*\| `python scripts/biased_gradients.py --scene (\w+)` \|$",
                      (DOCS / "biased_gradients.md").read_text(), re.MULTILINE)  # fmt: skip
    assert rows == [(name, name) for name in SCENES]


def test_page_shows_the_lines_of_the_patch() -> None:
    page = (DOCS / "biased_gradients.md").read_text()
    added = [line.strip() for line in "\n".join(SCRIPT["PATCH"].values()).splitlines()]
    assert len(added) == 3
    assert added[0] in page and added[2] in page


def test_script_prints_one_scene(variant_rgb: str, capsys: pytest.CaptureFixture[str]) -> None:
    SCRIPT["main"](["--scene", "god_rays", "--spp", "8", "--rounds", "2", "--variant", variant_rgb])
    title, *lines = capsys.readouterr().out.splitlines()
    assert title.startswith("god_rays: ")
    names = ["finite differences, volpath", "finite differences, prbvolpath", "gradient, prbvolpath"]
    assert [re.split(r"  +", line.strip())[0] for line in lines] == [*names, "gradient, prbvolpath_patched", "gradient, mivol"]
    assert all(re.search(r" [+-]\d\.\d+ \+- \d\.\d+(   z = [+-][\d.]+)?$", line) for line in lines)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("scene", SCENES)
def test_two_lines_explain_the_bias(variant_rgb: str, scene: str) -> None:
    """With its two lines prbvolpath has the gradient of mivol; without them it is off by 25 % and more."""
    SCRIPT["register_patched"]()
    names = ("prbvolpath", "prbvolpath_patched", "mivol")
    gradients = [SCRIPT["Derivative"](scene, name).gradient for name in names]
    stock, patched, ours = (np.array([gradient(64, fresh(seed)) for seed in range(12)]) for gradient in gradients)
    a, b = (Estimate.from_result(Moments.from_values(values)) for values in (patched, ours))
    assert_same_mean(a, b, what=scene)
    bias = abs(np.mean(stock - patched))
    assert_precise(difference(a, b), 0.2 * bias, what=scene)
    assert bias > 0.25 * abs(b.mean)
