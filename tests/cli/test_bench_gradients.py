"""`scripts/bench_gradients.py --quick`: our derivatives agree with finite differences, prbvolpath's do not where they should
not, and the arithmetic of the table is right. Times of a quick run mean nothing and decide nothing."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace

import bench_script
import numpy as np
import pytest

from mivol.files import read_volume


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    return bench_script.load("bench_gradients")


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the script prints; it ends with status 1 where means differ."""
    asked = "smoke,estimators,tutorial"
    return bench_script.quick("bench_gradients", tmp_path_factory.mktemp("bench"), "--only", asked)


@pytest.mark.slow
def test_every_question_is_answered(quick: dict, bench: ModuleType) -> None:
    assert set(bench.QUESTIONS) <= set(quick)
    for light in bench.LIGHTS:
        for functional in ("mean", "L2"):
            figures = quick["smoke"][light][functional]
            assert figures["sigma_t >= 1"]["variance_x_time"] > 0
            assert abs(figures["sigma_t >= 1"]["z"]) <= figures["sigma_t >= 1"]["z_bound"]
    for run in quick["tutorial"]["runs"].values():
        assert np.all(np.diff(run["seconds"]) > 0)
        assert run["loss"][-1] < run["loss"][0]
    assert (quick["folder"] / "bench_gradients.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_table_tells_a_biased_estimator_from_ours(quick: dict, bench: ModuleType) -> None:
    """Where the density is 0 free flights never stop, and their derivative is exactly 0; where half of it is empty they
    give that half the sign of their other term alone."""
    for light, table in quick["estimators"].items():
        assert set(table) == set(bench.cases(4))
        assert table["density 0"][bench.STOCK]["bias_percent"] == pytest.approx(-100)
        assert abs(table["half empty"][bench.STOCK]["bias_standard_errors"]) > 6
        for name, row in table.items():
            # Student's t of 7 to 14 degrees of freedom: 7.1 is exceeded by chance in one of 8 cases once in 600 runs
            assert abs(row[bench.OURS]["bias_standard_errors"]) < 7.1, (light, name)
    assert quick["estimators"]["constant light"]["density 0"][bench.OURS]["known_to_percent"] < 5


@pytest.mark.slow
def test_references_agree_with_volpath(quick: dict) -> None:
    found = quick["tutorial"]["references"]
    assert abs(found["z_against_volpath"]) <= found["z_bound"]


def test_differences_are_exact_for_a_parabola(bench: ModuleType) -> None:
    """Central ones, and one-sided ones where a negative density would be needed; float64, step 0.01."""
    subject = SimpleNamespace(mean=lambda values, seed, spp: float(np.sum(3 * values + values**2)))
    for values, slope in ((np.zeros((2, 2, 2)), 3.0), (np.ones((2, 2, 2)), 5.0)):
        case = bench.Case(values, np.ones((2, 2, 2)), 0.01)
        assert bench.difference(subject, case, 0, 1) == pytest.approx(8 * slope, rel=1e-11)  # 18 / (6 h) roundings of 40


def test_refined_until_the_mean_is_known_well_enough(bench: ModuleType) -> None:
    """Of unit variance about 10: 1 % of the mean needs 100 values; the estimate of the variance is known to 15 % then."""
    rng = np.random.default_rng(7)
    numbers, size = [], bench.Size(certain_percent=1.0, certain_seconds=5.0)
    found = bench.refine(rng.normal(10, 1, 16), lambda k: numbers.append(k) or rng.normal(10, 1), size)
    assert 60 < len(found) < 160
    assert numbers == list(range(16, len(found)))
    assert len(bench.refine(found, None, bench.QUICK)) == len(found)
    assert len(bench.refine(found, None, bench.Size(certain_percent=0.0, certain_seconds=0.0))) == len(found)


def test_the_smoke_stands_as_in_the_tutorial(bench: ModuleType, variant_rgb: str, data_dir) -> None:
    """The file under the tutorial's rotation, and the turned array without one: the same values at the same places."""
    import mitsuba as mi

    path = data_dir / "volumes_vol" / "tutorials_volume.vol"
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2).translate(-0.5)
    theirs = mi.load_dict({"type": "gridvolume", "filename": str(path), "to_world": turn})
    grid = mi.VolumeGrid(bench.upright(read_volume(path, frame="unit").values[..., 0])[..., None])
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    ours = mi.load_dict({"type": "gridvolume", "grid": grid, "raw": True, "to_world": place})
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.random.default_rng(0).uniform(-0.99, 0.99, (3, 500)).astype(np.float32))
    a, b = (np.array(v.eval_1(it)) for v in (theirs, ours))
    assert a.max() > 0.5
    # the rotation by cos(90 degrees) = 6e-17 moves a point by an ulp: 53 voxels * 6e-8 * a difference of at most 1.85
    np.testing.assert_allclose(a, b, atol=2e-5)


def test_when_ours_is_there_is_read_off_its_own_clock(bench: ModuleType) -> None:
    """Its lowest loss may lie before the last one."""
    ours = bench.Run([1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [5.0, 0.9, 0.5], [0.9, 0.8, 0.7])
    theirs = bench.Run([20.0, 30.0, 60.0], [20.0, 20.0, 40.0], [4.0, 0.6, 1.0], [0.9, 0.85, 0.84])
    got = bench.finish({bench.OURS: ours, bench.STOCK: theirs})
    last, lowest = got["to_the_last_loss_of_prbvolpath"], got["to_its_lowest_loss"]
    assert (last["mivol_after_iterations"], last["sooner"], last["sooner_by_processor_time"]) == (2, 30.0, 40.0)
    assert last["density_errors"] == {bench.OURS: 0.8, bench.STOCK: 0.84}
    assert (lowest["mivol_after_iterations"], lowest["sooner"]) == (3, 10.0)
    ours.loss = [5.0, 4.0, 3.0]
    assert bench.finish({bench.OURS: ours, bench.STOCK: theirs})["to_its_lowest_loss"]["sooner"] == 0


def test_voxels_are_read_at_their_centres(bench: ModuleType, variant_rgb: str) -> None:
    """A ramp is reproduced by trilinear reading, but for the last half voxels; weights are rounded to 2^-24."""
    ramp = np.broadcast_to((np.arange(8, dtype=np.float32) + 0.5) / 8, (8, 8, 8))
    fine = bench.at_voxels(ramp, 16)
    np.testing.assert_allclose(fine[3, 5, 1:-1], (np.arange(1, 15) + 0.5) / 16, atol=1e-6)
