"""The notebooks of docs/notebooks run from the first cell to the last, and are kept without outputs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def code_of(path: Path) -> list[str]:
    """The text of each code cell."""
    return ["".join(cell["source"]) for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


@pytest.fixture
def no_window(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Figures are drawn into memory, and closed."""
    import matplotlib.pyplot as plt

    before = plt.get_backend()
    plt.switch_backend("agg")
    yield
    plt.close("all")
    plt.switch_backend(before)


def executed(name: str, shorter: dict[str, str] | None = None) -> dict[str, object]:
    """Run the cells of a notebook one after another in one namespace, and return the namespace.

    Each cell is compiled under the notebook's name, so that a traceback says where it stopped.

    Args:
        shorter: texts that each stand in the notebook once, and the texts of a shorter run that replace them.
    """
    space: dict[str, object] = {"__name__": "__main__"}
    cells = code_of(FOLDER / f"{name}.ipynb")
    for old, new in (shorter or {}).items():
        assert sum(code.count(old) for code in cells) == 1, old
        cells = [code.replace(old, new) for code in cells]
    for number, code in enumerate(cells, 1):
        exec(compile(code, f"{name}.ipynb, code cell {number}", "exec"), space)
    return space


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_kept_without_outputs(path: Path) -> None:
    """A notebook is text that can be compared: no outputs, no counts, cells with names, less than 20 kB."""
    book = json.loads(path.read_text())
    assert [cell for cell in book["cells"] if cell.get("outputs") or cell.get("execution_count")] == []
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
    assert path.stat().st_size < 20_000


def test_each_is_run() -> None:
    """A new notebook needs a test below."""
    assert [path.stem for path in NOTEBOOKS] == ["light_in_a_smoke", "mivol_in_ten_minutes", "seven_representations"]


@pytest.mark.slow
def test_light_in_a_smoke(two_threads: None, no_window: None, capsys: pytest.CaptureFixture[str]) -> None:
    """No ray through the cube is longer than its diagonal; a white sky is given back by what scatters; all is finite."""
    left = executed("light_in_a_smoke")
    assert left["image"].min() >= np.exp(-2 * np.sqrt(3)) * (1 - 1e-5)  # float32, a hundred roundings
    assert left["white"].mean() > left["black"].mean() > 0
    assert left["slope"].shape == (24, 24, 24) and np.isfinite(left["slope"]).all() and left["slope"].sum() < 0
    assert "exp(-2 * sqrt(3)) = 0.0313" in capsys.readouterr().out


@pytest.mark.slow
def test_mivol_in_ten_minutes(
    two_threads: None, no_window: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the notebook's steps: mivol halves the error of the start and ends below ``prbvolpath``.

    The plan is printed; the curves hold finite times.
    """
    monkeypatch.chdir(tmp_path)
    variables = executed("mivol_in_ten_minutes", {"steps=80": "steps=40", "spp=1024": "spp=256"})
    nrmse, truth = variables["nrmse"], variables["truth"]
    ours, theirs = (variables["results"][name] for name in ("mivol", "prbvolpath"))
    start = nrmse(np.full_like(truth, 1.0))
    assert nrmse(ours[0]) < min(0.5 * start, nrmse(theirs[0]))
    assert all(np.isfinite(curve).all() and (np.diff(curve[:, 0]) > 0).all() for _, curve in (ours, theirs))
    assert "max_depth is 6" in capsys.readouterr().out


@pytest.mark.slow
def test_seven_representations(
    two_threads: None, no_window: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every representation shows the views that it was not fitted to: white paper has 11 dB.

    Half of the squared error of white paper is 14 dB. The two networks take a quarter of the notebook's steps (15 and 21 dB),
    and the others a third.
    """
    monkeypatch.chdir(tmp_path)
    shorter = {'"field.effort": 2.0': '"field.effort": 0.5', '"field.effort": 4.0': '"field.effort": 1.0'}
    for last in ('"field.degree": 0', '"field.degree": 2', '"plenoxels", {"field.preset": "tiny"'):
        shorter[last] = f'{last}, "field.effort": 0.3'
    shorter['"field.depth": 6, "field.effort": 0.5'] = '"field.depth": 5, "field.effort": 0.2'
    shorter['"gaussians.preset": "tiny"'] = '"gaussians.preset": "tiny", "gaussians.effort": 0.3'
    results = executed("seven_representations", shorter)["results"]
    assert list(results) == [
        "dense grid", "network", "octree", "grid with harmonics", "plenoxels", "hash grid", "gaussians"
    ]  # fmt: skip
    assert all(row["psnr"] > 14 and row["view"].shape[:2] == (64, 64) for row in results.values()), results
    assert "its leaves fitted" in capsys.readouterr().out
