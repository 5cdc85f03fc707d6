"""A new kind of problem needs one class only: here a network that learns a curve."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import CoarseToFine
from mivol.optim.first_order import Adam, RMSprop
from mivol.optim.interrupt import Interrupted
from mivol.optim.loop import Course, Fit, reconstruct
from mivol.optim.optimizer import Cosine, Optimizer
from mivol.optim.problem import Reals, Refinement

X = np.linspace(-1, 1, 64, dtype=np.float32)
SPLIT = 40


@dataclass
class Network:
    """sum_k w_k relu(s_k x + b_k) for a curve; a stage more has twice the units, each shared between two."""

    width: int = 4
    safe_point: Callable[[], None] = lambda: None
    reals: Reals = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Units that face either way, all awake somewhere: |x| = relu(x) + relu(-x) is within reach.
        start = {"w": [0.3, 0.3, 0.2, 0.2], "s": [1, -1, 0.5, -0.5], "b": [0.1, 0.1, 0.2, 0.2]}
        self.reals = {name: mi.TensorXf(np.float32(values)) for name, values in start.items()}

    def initial_reals(self) -> Reals:
        return self.reals

    def set_reals(self, reals: Reals) -> None:
        self.reals = reals

    def values(self) -> Reals:
        return self.reals

    def warning(self) -> str:
        return ""

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        return {"width": np.array(self.width)}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        self.width, self.reals = int(arrays["width"]), reals

    def learning_rates(self, iteration: int) -> dict[str, float]:
        return dict.fromkeys("wsb", 0.02)

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        return reals

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        leaves = {name: mi.TensorXf(value) for name, value in reals.items()}
        dr.enable_grad(leaves)
        x, y = mi.Float(X), mi.Float(0)
        for k in range(self.width):
            w, s, b = (dr.gather(mi.Float, leaves[name].array, mi.UInt32(k)) for name in "wsb")
            y += w * dr.maximum(dr.fma(s, x, b), 0)
        loss = dr.mean(dr.square(y - dr.abs(x)))
        dr.backward(loss)
        return dr.detach(loss), {name: dr.grad(leaf) for name, leaf in leaves.items()}

    def refine(self, stage: int) -> Refinement:
        self.width *= 2

        def twice(tensors: Reals) -> Reals:
            return {name: mi.TensorXf(np.repeat(np.array(value), 2)) for name, value in tensors.items()}

        reals = twice(self.reals)
        reals["w"] = reals["w"] * 0.5
        return Refinement(reals, twice, {"s": 0.5, "b": 0.5}, f"{self.width} units")


def fit(optimizer: Optimizer, store: CheckpointFile | None = None, stop_after: int = -1) -> Fit:
    def observe(at_work: Fit) -> None:
        if at_work.next_iteration == stop_after:
            os.kill(os.getpid(), signal.SIGINT)

    course = Course(80, Cosine(), (CoarseToFine(at=(SPLIT,)),))
    return reconstruct(Network(), optimizer, course, observer=observe, checkpoint=store)


@pytest.mark.parametrize("optimizer", [Adam(), RMSprop(), RMSprop(half=True)], ids=["adam", "rmsprop", "halves"])
def test_another_problem_is_fitted_refined_and_resumed(one_thread, ctrl_c, tmp_path: Path, optimizer: Optimizer) -> None:
    """Expected: the loss falls to a tenth and does not jump where units are split (the function is the same there, and a step
    changes the loss by less than half); a run stopped in the second stage goes on to the last bit."""
    whole = fit(optimizer)
    losses = [row["loss"] for row in whole.history]
    assert losses[-1] < 0.1 * losses[0]
    assert losses[SPLIT] < 1.5 * losses[SPLIT - 1]
    assert whole.log == [f"iteration {SPLIT}: 8 units"] and whole.run.reals["w"].shape == (8,)
    path = tmp_path / "checkpoint.npz"
    with pytest.raises(Interrupted):
        fit(optimizer, CheckpointFile(path, {"a": 1}), stop_after=SPLIT + 10)
    resumed = fit(optimizer, CheckpointFile(path, {"a": 1}, resume=True))
    assert [row["loss"] for row in resumed.history] == losses
    assert all(np.array_equal(resumed.run.reals[name], whole.run.reals[name]) for name in "wsb")
