"""Light of emitting media: the scenes, the pixels that count, and the bars."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mivol.bench.studies.media_light import BARS, STUDY, find_dark_pixels, make_scene
from mivol.bench.studies.single_scattering import ContestSize

TINY = replace(ContestSize.quick(), max_pixels=6, rounds=2, spp=2)


def test_pixels_that_count_do_not_see_the_medium(variant_rgb: str) -> None:
    """A fire is in the centre of its image; a room fills its image, and all pixels count."""
    dark = find_dark_pixels(make_scene("fire", 12))
    assert not dark[6, 6] and dark[0].all() and dark[:, 0].all()
    assert find_dark_pixels(make_scene("room", 12)).all()


@pytest.mark.slow
def test_every_question_is_answered(variant_rgb: str) -> None:
    for name in BARS:
        answer = STUDY.questions[name](TINY)
        assert answer["pixels_that_count"] > 0 and answer["time"] > 0


@pytest.mark.parametrize("name", BARS)
def test_the_median_is_judged(name: str) -> None:
    answer = {"variance_x_time_median_over_pixels": 5.0, "z": -2.0, "z_bound": 3.5}
    bars = [(bar["value"], bar["bar"], bar["met"]) for bar in STUDY.bars(name, answer)]
    assert bars == [(5.0, BARS[name], name == "room"), (2.0, 3.5, True)]
