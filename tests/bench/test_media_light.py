"""The bench of light of media: its scenes, what counts of them, and what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mivol.bench.harness.timing import Budget
from mivol.bench.studies.media_light import BARS, BENCH, QUICK, media_scene, unseen

TINY = replace(QUICK, most_pixels=6, rounds=2, budget=Budget(spp=2))


@pytest.mark.slow
def test_what_counts_does_not_see_the_medium(variant_rgb: str) -> None:
    """A fire is in the middle of its picture; a room is seen everywhere, and all of it counts."""
    dark = unseen(media_scene("fire", 12))
    assert not dark[6, 6] and dark[0].all() and dark[:, 0].all()
    assert unseen(media_scene("room", 12)).all()


@pytest.mark.slow
def test_every_question_is_answered(variant_rgb: str) -> None:
    for name in BARS:
        answer = BENCH.questions[name](TINY)
        assert answer["pixels_that_count"] > 0 and answer["time"] > 0


@pytest.mark.parametrize("name", BARS)
def test_the_median_is_judged(name: str) -> None:
    answer = {"variance_x_time_median_over_pixels": 5.0, "z": -2.0, "z_bound": 3.5}
    bars = [(bar["value"], bar["bar"], bar["met"]) for bar in BENCH.compare(name, answer)]
    assert bars == [(5.0, BARS[name], name == "room"), (2.0, 3.5, True)]
    assert np.isfinite(list(BARS.values())).all()
