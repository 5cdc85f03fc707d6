"""Studies of conversions and of a GPU: tables, and a conversion of a made-up model, judged by its own views."""

from __future__ import annotations

from pathlib import Path

import pytest
from ball_photos import ball, photo

from mivol.bench.studies import conversions, gpu
from mivol.bench.studies.conversions import ConversionSize, convert_and_judge, judge
from mivol.experiments.field_conversion import Source
from mivol.fields.field_files import write_field
from mivol.photos import Photos


def test_the_matrix_has_a_row_for_each_source() -> None:
    rows = {
        "grid": {"psnr": 34.1, "targets": {"octree": {"loss": 38.26, "psnr": 33.04}}},
        "Gaussians": {"psnr": 30, "targets": {"grid": {"loss": 25, "psnr": 24}}},
    }
    lines = conversions.STUDY.table("matrix", {"sources": rows})
    assert lines[0] == "| from, to | grid | octree | hash grid | NeRF | Gaussians |" and lines[1].count("|") == lines[0].count(
        "|"
    )
    assert lines[2] == "| grid (34.1) | - | 38.3 (33.0) | - | - | - |"
    assert lines[3] == "| Gaussians (30.0) | 25.0 (24.0) | - | - | - | - |"


def test_figures_of_a_card_name_it() -> None:
    assert gpu.STUDY.table("samples", {"samples_per_second": 2.5e7, "card": "a card"})[0].endswith(
        "| 25.0 M samples/s | a card |"
    )
    assert gpu.STUDY.table("hash", {}) == []
    gpu.STUDY.draw({"hash": {}}, Path("nothing"))


def judged_ball() -> Photos:
    """Two photographs of the ball over white."""
    return Photos(tuple(photo(ball(), k) for k in (0.5, 2.5)), "srgb", None)


@pytest.mark.slow
def test_a_file_is_judged_over_the_background_of_the_photographs(variant_rgb: str, tmp_path: Path) -> None:
    """What made the photographs has none but the rounding of codes; its octree loses some of it."""
    write_field(tmp_path / "grid.npz", ball())
    own = judge(Source.open(tmp_path / "grid.npz"), judged_ball())
    row = convert_and_judge(tmp_path / "grid.npz", "octree", judged_ball(), ConversionSize.quick())
    assert own > 50 > row["psnr"] > 25 and row["loss"] > 25 and row["mib"] > 0
