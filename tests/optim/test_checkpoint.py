"""Checkpoints: a resumed run equals an uninterrupted run."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from fit_scene import KEY, small_problem
from refusals import assert_refused
from scattering_scenes import cases

from mivol.errors import MivolError, WorkersLost
from mivol.files import atomic
from mivol.optim import checkpoint
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.events import Checkpoint, Evaluate, Upsample
from mivol.optim.first_order import Adam, RMSprop
from mivol.optim.interrupt import Interrupted
from mivol.optim.loop import Course, Fit, reconstruct
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.second_order import GaussNewton, Lbfgs

ITERATIONS = 6
EVENTS = (Upsample(at=(2,)), Evaluate(every=3))
CASES = {
    "adam": Adam(views=2),
    "rmsprop": RMSprop(views=1),
    "halves": RMSprop(half=True),
    "lbfgs": Lbfgs(),
    "gauss_newton": GaussNewton(inner=2),
}


def fit(optimizer, path: Path | None = None, *, stop_after: int = -1, how: int = signal.SIGINT, resume: bool = False) -> Fit:
    """The same run, stopped by a signal after an iteration where asked for."""

    def observe(at_work: Fit) -> None:
        if at_work.next_iteration == stop_after:
            os.kill(os.getpid(), how)

    def measure(problem: SceneProblem) -> dict[str, float]:
        return {"mean": float(np.asarray(problem.values()[KEY]).mean())}

    store = None if path is None else CheckpointFile(path, {"a": 1}, resume)
    course = Course(ITERATIONS, events=EVENTS)
    return reconstruct(small_problem(), optimizer, course, measure=measure, observer=observe, checkpoint=store)


@pytest.mark.slow
@pytest.mark.parametrize("name", cases(CASES, ["rmsprop", "lbfgs"]))
def test_a_resumed_run_is_bitwise_the_same(one_thread, ctrl_c, tmp_path: Path, name: str) -> None:
    """Rationale: a state that forgets anything (a moment, a pair, a damping, an event) shows in the next step.
    Expected: with one thread every loss, measure and voxel is equal to the last bit."""
    path = tmp_path / "checkpoint.npz"
    whole = fit(CASES[name])
    for stop_after, how in ((1, signal.SIGINT), (4, signal.SIGTERM)):
        with pytest.raises(Interrupted):
            fit(CASES[name], path, stop_after=stop_after, how=how, resume=stop_after > 1)
    resumed = fit(CASES[name], path, resume=True)
    assert [r["loss"] for r in resumed.history] == [r["loss"] for r in whole.history]
    assert [m["mean"] for m in resumed.evaluations] == [m["mean"] for m in whole.evaluations]
    assert resumed.log == whole.log
    assert np.array_equal(np.asarray(resumed.run.reals[KEY]), np.asarray(whole.run.reals[KEY]))


@pytest.mark.slow
def test_a_resumed_run_is_the_same_with_several_threads(two_threads, ctrl_c, tmp_path: Path) -> None:
    """Float sums have no fixed order: 1e-7 per gradient, which Adam's division can turn into 1e-5 of its steps."""
    path = tmp_path / "checkpoint.npz"
    whole = fit(Adam())
    with pytest.raises(Interrupted):
        fit(Adam(), path, stop_after=3)
    resumed = fit(Adam(), path, resume=True)
    assert np.allclose(np.asarray(resumed.run.reals[KEY]), np.asarray(whole.run.reals[KEY]), rtol=1e-5, atol=1e-5)


@pytest.mark.slow_for("after an event")
@pytest.mark.parametrize(
    ("iteration", "end"),
    [(2, Interrupted), (3, Interrupted), (3, WorkersLost)],
    ids=["after an event", "plain", "workers lost"],
)
def test_an_end_within_an_iteration_loses_nothing(
    one_thread, ctrl_c, tmp_path: Path, iteration: int, end: type[BaseException]
) -> None:
    """The signal, or the loss of all workers, comes in the render of an iteration: that iteration is done again from where it
    began, its events not."""
    path, whole = tmp_path / "checkpoint.npz", fit(Adam())
    problem = small_problem()
    renders = 0
    kept = problem.render

    def render(*args: object) -> object:
        nonlocal renders
        renders += 1
        if renders == iteration + 1:
            if end is WorkersLost:
                raise WorkersLost("no scheduler.")
            os.kill(os.getpid(), signal.SIGINT)
        return kept(*args)

    problem.render = render
    with pytest.raises(end):
        reconstruct(problem, Adam(), Course(ITERATIONS, events=EVENTS), checkpoint=CheckpointFile(path, {"a": 1}))
    assert renders == iteration + 1
    resumed = fit(Adam(), path, resume=True)
    assert [r["loss"] for r in resumed.history] == [r["loss"] for r in whole.history]
    assert np.array_equal(np.asarray(resumed.run.reals[KEY]), np.asarray(whole.run.reals[KEY]))


def test_checkpoints_are_written_when_due(variant_rgb, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.npz"
    found = []

    def observe(at_work: Fit) -> None:
        found.append(checkpoint.read(path, {})[1]["next_iteration"] if path.exists() else 0)

    reconstruct(
        small_problem(), Adam(), Course(6, events=(Checkpoint(every=2),)), observer=observe, checkpoint=CheckpointFile(path, {})
    )
    assert found == [0, 0, 2, 2, 4, 4]


def written(path: Path, fingerprint: dict) -> Path:
    checkpoint.write(path, {"reals/x": np.arange(3.0)}, {"fingerprint": fingerprint})
    return path


def test_refused_checkpoints(tmp_path: Path) -> None:
    """Another scene, another setting, none at all, half a file, a file of something else."""
    here = {"scene": "abc", "optimizer.lr": 0.1, "domain": [0.0, float("inf")]}
    path = written(tmp_path / "a.npz", here)
    assert checkpoint.read(path, here)[0]["reals/x"].tolist() == [0, 1, 2]
    for change, sentence in (
        ({"scene": "abd"}, "scene is 'abc' there and 'abd' here"),
        ({"optimizer.lr": 0.2}, "optimizer.lr is 0.1 there and 0.2 here"),
        ({"new": 1}, "new is None there and 1 here"),
    ):
        assert_refused(sentence, checkpoint.read, path, here | change)
    hashed = {"field.kind": "hash", "field.effort": 0.5}
    for settings, kind in ((hashed | {"field.kind": "octree"}, "octree"), ({"gaussians.preset": "tiny"}, "gaussians")):
        with pytest.raises(MivolError, match=f"of the kind hash, and the kind {kind} is expected here"):
            checkpoint.read(written(tmp_path / "hash.npz", hashed), settings)
    assert_refused("without --resume first", checkpoint.read, tmp_path / "none.npz", here)
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"no checkpoint at all"):
        (tmp_path / "b.npz").write_bytes(broken)
        assert_refused("not a whole checkpoint", checkpoint.read, tmp_path / "b.npz", here)
    np.savez(tmp_path / "c.npz", x=1)
    assert_refused("not a whole checkpoint", checkpoint.read, tmp_path / "c.npz", here)


def test_a_full_disk_leaves_the_last_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.npz", {"a": 1})
    before = path.read_bytes()

    def full(path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(atomic, "_sync", full)
    assert_refused("no space left", written, path, {"a": 2})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_iterations_that_the_kind_of_fit_chooses_resume(tmp_path: Path) -> None:
    """Without a number of iterations in either run, and with one in the second; a number that is gone is another run."""
    checkpoint.check_same(tmp_path, {"solve.iterations": None}, {"solve.iterations": None})
    checkpoint.check_same(tmp_path, {"solve.iterations": None}, {"solve.iterations": 30})
    with pytest.raises(MivolError, match="solve.iterations is 30 there and None here"):
        checkpoint.check_same(tmp_path, {"solve.iterations": 30}, {"solve.iterations": None})
