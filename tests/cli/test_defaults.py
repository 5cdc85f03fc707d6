"""Defaults that no page of docs/reference lists; tests/test_docs.py holds the others."""

from __future__ import annotations

import msgspec
import pytest

from mivol.config import ScanExperiment, SceneExperiment, Sought
from mivol.optim.events import Checkpoint, Evaluate, UpdateOccupancy
from mivol.optim.first_order import Adam
from mivol.optim.losses import L2
from mivol.optim.optimizer import Constant
from mivol.optim.priors import DecoupledPrior, Smoothness, Sparsity, ViewDependence
from mivol.optim.projections.inversion import LinearSolve

DEFAULTS = {
    SceneExperiment: {
        **{"held_out": None, "truth": None, "optimizer": Adam(), "schedule": Constant(), "loss": L2()},
        "event": (Checkpoint(every=10), Evaluate(every=10)),
    },
    ScanExperiment: {"grid": None},
    Sought: {"prior": ()},
    DecoupledPrior: {"weight": 1.0},
    Smoothness: {"weight": 1.0, "share": 0.125, "every": 1},
    Sparsity: {"weight": 1.0},
    ViewDependence: {"weight": 1.0},
    UpdateOccupancy: {"every": 64},
    LinearSolve: {
        **{"solver": "pcg", "subsets": 10, "drift": 0, "relaxation": 1.0, "decay": 0.99, "window": "ram-lak", "cutoff": 1.0},
        "stop_norm": 0.0,
    },
}


@pytest.mark.parametrize("kind", DEFAULTS, ids=lambda kind: kind.__name__)
def test_defaults(kind: type) -> None:
    defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
    assert {name: defaults[name] for name in DEFAULTS[kind]} == DEFAULTS[kind]
