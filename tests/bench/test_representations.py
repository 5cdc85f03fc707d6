"""Study of representations: all fits get the same photographs, and files are measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from bench_figures import drawn
from gaussian_sets import random_gaussians

from mivol.bench import photo_fits
from mivol.bench.studies import representations
from mivol.bench.studies.representations import STUDY, RepresentationSize
from mivol.fields.octree import Octree
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.gaussians.gaussian_problem import GaussianProblem


def test_the_chair_is_left_out_where_it_is_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(photo_fits, "DATA", tmp_path)
    for question in ("chair", "octree"):
        assert STUDY.questions[question](RepresentationSize.quick()) == {}
        assert "chair: left out, its data is missing (MIVOL_DATA" in capsys.readouterr().err


def test_an_octree_stands_beside_its_grid() -> None:
    grid = {"psnr": 36.349, "file_bytes": 2**20, "pixels_per_second": 12.82e6}
    octree = {"psnr": 36.2, "file_bytes": 2**19, "pixels_per_second": 25.4e6}
    lines = STUDY.table("octree", {"grid": grid, "octree": octree, "over_grid": {"db": -0.149, "bytes": 0.5, "pixels": 1.98}})
    assert lines[2:] == ["| grid | 36.35 dB | 1 MiB | 12.8 M pixels/s |", "| octree | 36.20 dB | 0.5 MiB | 25.4 M pixels/s |"]


@pytest.mark.slow
def test_the_grid_is_that_of_which_the_octree_was_made(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    small = {"photo_folder": str(tmp_path / "photographs"), "photo_side": 32, "photo_views": 9, "edge": 16}
    monkeypatch.setattr(representations, "find_photographs", lambda name, size: photo_fits.find_photographs("still_life", size))
    timed = []
    monkeypatch.setattr(
        representations, "compare_speed", lambda *fields: (timed.extend(map(type, fields)), ((4e6, 2e6), 2.0))[1]
    )
    answer = STUDY.answer(("octree",), replace(RepresentationSize.quick(), **small))["octree"]
    assert timed == [Octree, SphericalGrid]
    grid, octree, gain = (answer[name] for name in ("grid", "octree", "over_grid"))
    assert gain["db"] == octree["psnr"] - grid["psnr"] and gain["bytes"] == octree["file_bytes"] / grid["file_bytes"]
    assert min(grid["psnr"], octree["psnr"]) > 8
    assert (octree["pixels_per_second"], grid["pixels_per_second"], gain["pixels"]) == (4e6, 2e6, 2.0)


@pytest.mark.slow
def test_all_fits_see_the_same_photographs(variant_rgb: str, tmp_path: Path) -> None:
    small = {"photo_folder": str(tmp_path / "photographs"), "photo_side": 32, "photo_views": 9, "edge": 16}
    answer = STUDY.answer(("still_life",), replace(RepresentationSize.quick(), **small))["still_life"]
    assert set(answer) == {"grid", "nested grid", "octree", "hash grid", "NeRF", "Gaussians"}
    assert len({result["photograph"].tobytes() for result in answer.values()}) == 1
    for result in answer.values():
        # Half the edge of the files, which have 32 pixels.
        assert result["view"].shape == result["photograph"].shape == (16, 16, 3)
        assert result["psnr"] > 8
        assert result["file_mib"] > 0
        seconds = result["processor_seconds"] / dr.thread_count() * result["walk_rays_per_second"] / 25e6
        assert result["minutes"] == pytest.approx(seconds / 60)
    # As published: places, normals, opacity, scales, rotation (14 numbers of 4 bytes), harmonics; a header of less than 4 kB.
    gaussians = answer["Gaussians"]
    headers = [gaussians["file_mib"] * 2**20 - 4 * gaussians["count"] * (14 + 3 * (d + 1) ** 2) for d in range(4)]
    assert any(0 < header < 4096 for header in headers)
    lines = STUDY.table("still_life", answer)
    assert len(lines) == 2 + len(answer) and f"| octree | {answer['octree']['psnr']:.2f} dB" in "\n".join(lines)
    STUDY.draw({"still_life": answer}, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_gaussians_are_counted_and_stored() -> None:
    """A .ply holds 14 float32 of each Gaussian of degree 0, behind its header."""
    problem = object.__new__(GaussianProblem)
    problem.cloud = vars(random_gaussians(7, 0))
    count, size = representations.store(problem)
    assert count == 7 and 7 * 14 * 4 < size < 7 * 17 * 4 + 1000


def test_nothing_is_drawn_of_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    STUDY.draw({"chair": {}}, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def test_a_figure_shows_each_view_beside_its_photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    one = {"minutes": 1.0, "psnr": 30.0, "view": np.zeros((4, 4, 3)), "photograph": np.ones((4, 4, 3))}
    answers = {"still_life": {"grid": one, "Gaussians": one | {"minutes": 2.0, "view": np.full((4, 4, 3), 0.5)}}}
    axes = drawn(representations, monkeypatch, answers, Path()).axes
    pictures = {axis.get_title(loc="left"): float(axis.images[0].get_array().mean()) for axis in axes if axis.images}
    assert pictures == {"photograph": 1.0, "grid: 30.0 dB": 0.0, "Gaussians: 30.0 dB": 0.5}
    assert [line.get_xdata()[0] for line in axes[0].lines] == [1.0, 2.0]
    # Labels of four digits have room beside each other.
    assert len(axes[0].get_xticks()) <= 4
