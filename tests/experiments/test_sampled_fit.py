"""Plans of the fits of networks and hash grids: presets, settings, and their words in ``explain``."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mivol.display import format_duration
from mivol.errors import MivolError
from mivol.experiments import sampled_fit
from mivol.experiments.field_fit import FieldFit
from mivol.experiments.octree_fit import OctreeFit
from mivol.optim.photographs.sampled_problem import PRESETS
from mivol.photos import Camera, intrinsics


def settings_of(**field: object) -> SimpleNamespace:
    return SimpleNamespace(field=SimpleNamespace(**{"effort": 1.0, **field}))


def test_settings_change_a_preset() -> None:
    """Sizes, samples and cells by name; the effort is a factor on the steps, of which one remains."""
    plan = sampled_fit.make_sampled_plan(settings_of(kind="hash", preset="tiny", levels=4, samples=512, cells=8, effort=1.25))
    preset = PRESETS["hash"]["tiny"]
    assert (plan.sizes.levels, plan.sizes.width, plan.samples, plan.cells, plan.steps) == (4, preset.sizes.width, 512, 8, 250)
    assert sampled_fit.make_sampled_plan(settings_of(kind="hash", preset="tiny", effort=1e-6, samples=None)).steps == 1
    with pytest.raises(MivolError, match=r'field.preset = "tini" is unknown: did you mean "tiny"\?'):
        sampled_fit.make_sampled_plan(settings_of(kind="nerf", preset="tini"))


def photographs(alpha: object) -> SimpleNamespace:
    """What a plan reads of two photographs."""
    camera = Camera(intrinsics(4, 4, 4, 4), (4, 4), np.eye(4))
    views = [SimpleNamespace(alpha=alpha, camera=camera)] * 2
    return SimpleNamespace(box=np.array([[0, 0, 0], [1, 2, 3.5]]), views=views, survey=SimpleNamespace(box_from="cameras"))


@pytest.mark.parametrize(
    ("kind", "changes", "expected"),
    [
        (
            "hash",
            {"levels": 4, "cells": 10},
            {
                "4 levels of 16 to 64 cells, 2 features each": "numbers in at most 8192 rows a level, and",
                "8192 samples a step, about 20 a ray at first": "cell of the map of occupied cells, with 10 cells an edge",
                "single precision: rays read a table of 0.2 MiB": 'field.precision = "half" takes half of it',
            },
        ),
        (
            "hash",
            {"levels": 4, "cells": 10, "precision": "half"},
            {"half precision: rays read a table of 0.1 MiB": "the fit steps float32 values, and rounds them for rays"},
        ),
        (
            "nerf",
            {"coarse": 16, "fine": 24},
            {
                "two networks of 3 layers x 32, the position again after layer 2, 32 neurons for the colours; "
                "16 samples of a ray by a coarse network, 24 more": "5 frequencies of the position, 4 of the direction",
                "8192 samples a step, about 56 a ray at first": "the coarse network takes 16, the fine one these and 24 more",
            },
        ),
        (
            "nerf",
            {"harmonics": 2, "skip": 0},
            {"a network of 3 layers x 32, harmonics of degree 2 for the colours": "frequencies of the position, no direction"},
        ),
    ],
)
def test_a_plan_in_words(kind: str, changes: dict, expected: dict) -> None:
    plan = sampled_fit.make_sampled_plan(settings_of(kind=kind, preset="tiny", **changes))
    lines = sampled_fit.explain_sampled_plan(plan, photographs(None), SimpleNamespace(bytes=3 << 20))
    said = {line.choice: line.reason for line in lines}
    assert said["2 photographs, a box of 1 x 2 x 3.5 [length]"] == "cameras"
    assert said["200 steps"] == "the preset's, times field.effort" and said["no field behind the box"] == "photos.background"
    for choice, reason in expected.items():
        assert reason in said[choice]
    # 200 steps of 8192 samples: a few levels or a few thousand weights take 0.3 to 5 microseconds a sample.
    assert f"about {format_duration(60 * plan.minutes)}" in said
    assert 0.3e-6 < plan.minutes * 60 / (200 * 8192) < 5e-6
    own = lines[-1].choice
    assert own.startswith("about ") and "photographs 3, the fit " in own
    marked = sampled_fit.explain_sampled_plan(plan, photographs(np.ones((4, 4))), SimpleNamespace(bytes=0))
    assert {line.choice: line.reason for line in marked}["no field behind the box"] == "alpha marks the object"


@pytest.mark.parametrize("kind", [sampled_fit.SampledFit, OctreeFit])
def test_exposures_and_cameras_stay(kind: type[FieldFit]) -> None:
    """Problems of these kinds have neither gains nor poses, for which the outputs of a run ask every kind."""
    fit = object.__new__(kind)
    fit.problem = SimpleNamespace()
    assert fit.gains() is None and fit.motions() is None
