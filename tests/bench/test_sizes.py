"""How much each bench measures, and what it promises: published figures are of these sizes, and can be compared with no others.

Who changes a size measures the tables of the benches anew.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from mivol.bench.extinctions import TUTORIAL_SCALE
from mivol.bench.harness import agreement
from mivol.bench.harness.timing import Budget
from mivol.bench.studies import single_scattering, still_life, tomography
from mivol.bench.studies.depth import BESIDE_ALBEDOS, CUBE_DEPTH, SEED, TAUS, UNIT
from mivol.bench.studies.gradients.size import ALBEDO, CONTESTS, TUTORIALS
from mivol.bench.studies.gradients.subject import SEEDS
from mivol.bench.studies.radiance_field import STEP_BARS
from mivol.bench.studies.radiance_field.fits import EVERY
from mivol.bench.studies.radiance_field.peer import LEARNING_RATE
from mivol.bench.studies.radiance_field.size import FULL as PHOTOGRAPHS
from mivol.bench.studies.radiance_field.size import QUICK as QUICK_PHOTOGRAPHS
from mivol.bench.studies.radiance_field.size import STOP
from mivol.bench.studies.storage import DEGREES, MODEL, SIZES

FULL = {
    "radiance_field": {
        "resolution": 128, "side": 256, "rounds": 3, "steps": 105, "chair_steps": 800, "fit_resolution": 128, "fit_side": 256,
        "fields": ("shell", "fog", "fitted"), "photo_views": 75, "photo_side": 200, "photo_spp": 32,
        "photo_fits": (
            ("chair", 128, 1.0, "cpu"), ("chair", 256, 1.9, "cpu"), ("chair", None, 1.0, "fine"),
            *((name, 128, 1.0, "cpu") for name in ("still_life", "wires", "glossy")),
            *((name, None, 1.0, "fine") for name in ("still_life", "wires", "glossy")),
        ),
        "photo_folder": Path("runs/photographs"), "walk_side": 1024,
        "prior_side": 80, "prior_resolution": 32, "prior_steps": 180, "prior_folds": 5,
    },
    "gradients": {
        "rounds": 8, "side": 64, "budget": Budget(seconds=2.0), "table_rounds": 16, "table_side": 24,
        "table_budget": Budget(seconds=0.4), "table_res": 16, "derivative_spp": 256, "difference_spp": 1024,
        "certain_percent": 0.06, "most_estimates": 750, "reference_spp": 4096, "check_spp": 4, "loss_spp": 32,
        "resolutions": (16, 64), "steps": (20, 20), "step_spp": (8, 64), "seed": 0,
    },
    "optical_depth": {
        "rounds": 7, "walk_side": 1024, "image_side": 256, "image_spp": 16, "exact_pixels": 192, "exact_rays": 4096,
        "accuracy_res": (64, 256), "memory_res": (16, 64), "memory_sides": (256, 512, 1024), "grid_side": 512, "ct_res": 256,
        "sparse_res": 512, "peer_rounds": 3, "peer_side": 512, "peer_spp": (1, 4, 16, 64), "volpath_spp": (1, 4, 16),
        "march_steps": (16, 32, 64, 128, 256, 512, 1024),
    },
    "single_scattering": {
        "rounds": 8, "most_pixels": 64, "budget": Budget(seconds=0.8), "levels": (1, 4, 16), "fine_res": 256,
        "sparse_res": 512, "seed": 0,
    },
    "representations": {
        "photographs": asdict(PHOTOGRAPHS), "edge": 200, "grids": (64, 128), "gaussians": ("minute", "minutes"), "effort": 1.0,
    },
    "depth": {"lines": 1 << 18, "taus": (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)},
    "still_life": {
        "folder": Path("runs/still_life/photographs"), "views": 75, "side": 128, "longest": 64, "steps": 600, "shrink": 2,
        "tiles": 256, "few": 5, "spp": 64,
    },
}  # fmt: skip

QUICK = {
    "radiance_field": {
        "resolution": 32, "side": 64, "rounds": 1, "steps": 7, "chair_steps": 30, "fit_resolution": 32, "fit_side": 32,
        "photo_fits": (("chair", 32, 0.03, "cpu"), ("wires", 32, 0.03, "cpu")),
        "photo_views": 15, "photo_side": 48, "photo_spp": 2,
        "photo_folder": Path("runs/quick_photographs"), "walk_side": 64,
        "prior_side": 16, "prior_resolution": 16, "prior_steps": 6, "prior_folds": 1,
    },
    "gradients": {
        "rounds": 5, "side": 12, "budget": Budget(seconds=0.05), "table_rounds": 8, "table_side": 8,
        "table_budget": Budget(seconds=0.05), "table_res": 6, "derivative_spp": 64, "difference_spp": 256,
        "certain_percent": math.inf,
        "reference_spp": 256, "check_spp": 4, "loss_spp": 16, "resolutions": (4, 8), "steps": (2, 2), "step_spp": (2, 4),
    },
    "optical_depth": {
        "rounds": 3, "walk_side": 256, "image_side": 64, "image_spp": 4, "exact_pixels": 32, "exact_rays": 1024,
        "accuracy_res": (64,), "memory_sides": (64, 128, 256), "grid_side": 128, "ct_res": 64, "sparse_res": 128,
        "peer_side": 64, "peer_spp": (1, 4), "volpath_spp": (1, 4), "march_steps": (16, 64, 256),
    },
    "single_scattering": {
        "most_pixels": 16, "budget": Budget(seconds=0.02), "levels": (1, 4), "fine_res": 48, "sparse_res": 64,
    },
    "representations": {
        "photographs": asdict(QUICK_PHOTOGRAPHS), "edge": 48, "grids": (16,), "gaussians": ("minute",), "effort": 0.02,
    },
    "depth": {"lines": 1 << 14, "taus": (0.1, 1.0, 10.0)},
    "still_life": {
        "folder": Path("runs/still_life/quick_photographs"), "views": 15, "side": 48, "longest": 16, "steps": 40, "shrink": 1,
        "tiles": 32, "few": 2,
    },
}  # fmt: skip
"""What is smaller than in FULL."""


@pytest.mark.parametrize("name", FULL)
def test_sizes_are_those_of_the_published_figures(name: str) -> None:
    bench = importlib.import_module(f"mivol.bench.studies.{name}").BENCH
    assert asdict(bench.full) == {"name": "full", **FULL[name]}
    assert asdict(bench.quick) == {"name": "quick", **FULL[name], **QUICK[name]}


def test_what_is_promised():
    """Bars, and the media that they are measured in."""
    assert STEP_BARS == {"camera": 8, "pixels": 4, "any": 4} and STOP == 1e-4
    bars = {question: [light.bar for light in lights.values()] for question, (_, lights) in CONTESTS.items()}
    deep = {"deep smoke": [100, 100, 35], "deep fine smoke": [40, 20], "deep cloud": [80]}
    assert bars == {"smoke": [60, 30]} | deep and ALBEDO == 0.75
    assert TUTORIALS["tutorial"][:2] == (2, 20) and TUTORIALS["deep tutorial"] == (6, 60, 30)
    assert (SIZES, DEGREES, MODEL) == ((128, 256, 512, 1024), (0, 1, 2, 3), 64)
    assert FULL["depth"]["taus"] == TAUS and SEED == 0 and BESIDE_ALBEDOS == (0.5, 0.9) and CUBE_DEPTH == 0.8966336
    assert UNIT.to_world.tolist() == np.eye(4).tolist()
    assert (tomography.REPORTED, tomography.BAR) == ((5, 10, 20), 0.2)
    assert (single_scattering.ALBEDO, single_scattering.SEEN, agreement.FALSE_ALARM) == (0.75, 0.01, 1e-3)
    assert (EVERY, LEARNING_RATE, SEEDS, TUTORIAL_SCALE) == (7, 0.05, 100_000, 40.0)
    assert still_life.NO_TV == {"tv_sh": 0.0, "tv_density": 0.0}
