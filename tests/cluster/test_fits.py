"""Fits whose steps are parts on workers: the same result with one, two and three of them, and with one killed in the middle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from local_workers import kill_worker, some_workers

from mivol import config
from mivol.bench.studies.cluster_kills import write_experiments
from mivol.cluster.distribution import ClusterDistribution
from mivol.cluster.steps import Steps
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.kinds import run_experiment
from mivol.files import read_volume
from mivol.report.record import read_record

CHANGES = {
    "grid": [],
    "octree": [],
    "hash": [],
    "gaussians": [],
    "scan": ["solve.iterations=5", "solve.tv=0.1"],
    "stored": [
        'scan={beam="parallel", views=20, detector=[24, 24], pitch=0.09}',
        'solve={name="os-sart", subsets=4, iterations=3, storage="matrix"}',
    ],
}
"""Changes of an experiment of each kind; "stored" is a scan in parallel light with stored rows."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The experiments of the study of kills, and photographs of its ball."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    found = tmp_path_factory.mktemp("fits")
    write_experiments(found)
    return found


def read_result(run: Path) -> np.ndarray:
    """The fitted numbers of a run."""
    archive = run / "field.npz"
    if archive.is_file():
        with np.load(archive) as arrays:
            return np.concatenate(
                [np.ravel(arrays[name]).astype(float) for name in sorted(arrays) if arrays[name].dtype.kind == "f"]
            )
    if (run / "gaussians.ply").is_file():
        from mivol.points import read_gaussians

        cloud = read_gaussians(run / "gaussians.ply")
        return np.concatenate([np.ravel(cloud.means), np.ravel(cloud.log_scales), np.ravel(cloud.harmonics)])
    return read_volume(next((run / "volumes").glob("reconstruction*.npz"))).values


@pytest.mark.slow
@pytest.mark.parametrize("kind", CHANGES)
def test_a_fit_does_not_depend_on_workers(client: object, folder: Path, tmp_path: Path, kind: str) -> None:
    """Rationale: a part depends on the step only, and sums of float32 numbers in float64 do not depend on their order.

    Expected: equal to 1e-6 with one worker, two of which one is killed, and three; the record counts the loss.
    """

    def fit(name: str, workers: int, killed: int = -1) -> np.ndarray:
        with some_workers(client, workers) as pool, pytest.MonkeyPatch.context() as patch:
            compute, calls = Steps.compute, iter(range(1_000_000))

            def strike(steps: Steps, *args: object, **more: object) -> object:
                if next(calls) == killed:
                    kill_worker(pool)
                return compute(steps, *args, **more)

            patch.setattr(Steps, "compute", strike)
            settings = config.load(folder / f"{'scan' if kind == 'stored' else kind}.toml", CHANGES[kind])
            run_experiment(RunContext(settings, folder, tmp_path / name, distribution=ClusterDistribution(pool)))
            assert pool.lost == (killed >= 0)
        said = " ".join(read_record(tmp_path / name).notes)
        assert ("1 worker(s) of the cluster were lost" in said) == (killed >= 0)
        return read_result(tmp_path / name)

    one, two, three = fit("one", 1), fit("two", 2, killed=4), fit("three", 3)
    assert one.std() > 0
    for other in (two, three):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-6 * np.abs(one).max())
