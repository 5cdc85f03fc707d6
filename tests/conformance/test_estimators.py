"""The table of segment estimators: at most one entry applies to any needs, and the plan takes it."""

from __future__ import annotations

import itertools
import math

import mitsuba as mi
import numpy as np
import pytest

from mivol.cite import list_citations
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS, SegmentNeeds, Settings, choose_segment_estimator
from scenes import box_of, camera, centred, medium

TURNS = ((1, False), (1, True), (2, False), (math.inf, False), (math.inf, True))
QUESTIONS = [SegmentNeeds(*flags, *turns) for flags in itertools.product((False, True), repeat=4) for turns in TURNS]


@pytest.mark.parametrize("asked", QUESTIONS, ids=str)
def test_a_question_has_one_answer_at_most(asked: SegmentNeeds) -> None:
    """Quadrature serves single scattering only, and flights find the emission of bounded media; one entry applies to all other
    needs.
    """
    found = [name for name, entry in SEGMENT_ESTIMATORS.items() if entry.applies(asked)]
    if asked.scatters:
        several = asked.scatterings > 1 or asked.emits or asked.is_bounded or asked.refracts
        assert len(found) == (0 if asked.deterministic and several else 1)
        assert ("free_flight" in found) == (several and not asked.deterministic)
    else:
        flies = asked.emits and asked.is_bounded
        assert len(found) == (0 if flies and asked.deterministic else 1)
        assert ("free_flight" in found) == (flies and not asked.deterministic)
    assert choose_segment_estimator(asked) == (found[0] if found else None)


@pytest.mark.parametrize("name", SEGMENT_ESTIMATORS)
def test_an_entry_says_what_it_needs_and_promises(name: str) -> None:
    entry = SEGMENT_ESTIMATORS[name]
    assert entry.needs and entry.promises
    assert len(list_citations(entry.cites)) == len(entry.cites) >= 1
    answered = [asked for asked in QUESTIONS if entry.applies(asked)]
    assert answered and all(
        (asked.scatters or (asked.emits and asked.is_bounded)) == (entry.scatterings > 0) for asked in answered
    )


@pytest.mark.parametrize(
    ("emitter", "settings", "name"),
    [
        ("constant", Settings(max_depth=2), "single_scattering"),
        ("constant", Settings(max_depth=1), "absorption"),
        (None, Settings(max_depth=2), "absorption"),
        ("constant", Settings(max_depth=3), "free_flight"),
        ("constant", Settings(max_depth=-1), "free_flight"),
        (None, Settings(max_depth=-1), "absorption"),
        ("point", Settings(max_depth=2, deterministic=True), "scattering_quadrature"),
        ("point", Settings(max_depth=1, deterministic=True), "absorption"),
    ],
)
def test_a_plan_takes_the_answer(variant_rgb: str, emitter: str | None, settings: Settings, name: str) -> None:
    parts = {"emitter": {"type": emitter, **({"position": [0, 0, 3]} if emitter == "point" else {})}} if emitter else {}
    fog = box_of(medium("homogeneous", 1.0, 0.5), centred(2 * np.eye(3)))
    scene = mi.load_dict({"type": "scene", "fog": fog, "sensor": camera([0, -4, 0], [0, 0, 0], res=4), **parts})
    needs = find_needs(scene, scene.sensors()[0], survey_scene(scene))
    assert make_plan(needs, settings).segment == name
