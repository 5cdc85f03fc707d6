"""Study of conversions: a conversion of a made-up model, judged by its own views."""

from __future__ import annotations

from pathlib import Path

import pytest
from ball_photos import ball, photo

from mivol.bench.studies.conversions import ConversionSize, convert_and_judge, judge
from mivol.experiments.field_conversion import Representation
from mivol.fields.field_files import write_field
from mivol.photos import Photos


def judged_ball() -> Photos:
    """Two photographs of the ball over white."""
    return Photos(tuple(photo(ball(), k) for k in (0.5, 2.5)), "srgb", None)


@pytest.mark.slow
def test_a_file_is_judged_over_the_background_of_the_photographs(variant_rgb: str, tmp_path: Path) -> None:
    """What made the photographs has none but the rounding of codes; its octree loses some of it."""
    write_field(tmp_path / "grid.npz", ball())
    own = judge(Representation.open(tmp_path / "grid.npz"), judged_ball())
    row = convert_and_judge(tmp_path / "grid.npz", "octree", judged_ball(), ConversionSize.quick())
    assert own > 50 > row["psnr"] > 25 and row["loss"] > 25 and row["mib"] > 0
