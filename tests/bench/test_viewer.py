"""The study of the live view, in small."""

from __future__ import annotations

import pytest

from mivol.bench.studies import viewer


@pytest.mark.parametrize("name", ["balls.ply", "field.npz", "volume.nrrd"])
def test_pictures_are_drawn_and_timed(variant_rgb: str, name: str) -> None:
    answer = viewer.measure_pictures(name, viewer.ViewerSize.quick())
    assert answer["clock"] > 0 and 48 <= answer["width"] <= 64 and name in viewer.table("", answer)[0]
