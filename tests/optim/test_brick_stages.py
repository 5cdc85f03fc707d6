"""Bricks of a sparse grid vanish where they are empty, and appear where the gradient asks for them."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY, absorbing_scene, camera, views_of_truth
from refusals import assert_refused

from mivol.files import SparseVolumeData
from mivol.optim.events import AdaptBricks
from mivol.optim.first_order import Adam
from mivol.optim.loop import Course, begin_fit
from mivol.optim.parameters import Parameter
from mivol.optim.priors import PRIORS
from mivol.optim.scenes.brick_stages import _carry, _find_asked, _find_kept, find_neighbours
from mivol.optim.scenes.scene_problem import SceneProblem

SHAPE = (32, 24, 24)


def truth() -> np.ndarray:
    """A box that fills two bricks along z of 4 x 3 x 3, one of which the start lacks."""
    values = np.zeros((*SHAPE, 1), np.float32)
    values[8:24, 8:16, 8:16] = 1.5
    return values


def start() -> np.ndarray:
    """One of the truth's bricks, and one that the truth does not have."""
    values = np.zeros((*SHAPE, 1), np.float32)
    values[8:16, 8:16, 8:16] = values[24:, 16:, 16:] = 0.3
    return values


def problem_of(values: np.ndarray, **given: object) -> SceneProblem:
    volume = SparseVolumeData.from_dense(values)
    scene = absorbing_scene(np.zeros((2, 2, 2, 1)))
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = {"type": "mivol_voxels", "data": mi.TensorXf(volume.values), "bricks": mi.UInt32(volume.numbers)}
    grid |= {"resolution": list(SHAPE[::-1]), "to_world": place}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "mivol_medium", "sigma_t": grid, "albedo": 0.0}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "mivol"}, "sky": {"type": "constant"}, "cube": cube})
    views = views_of_truth(truth(), [camera(angle) for angle in (0.3, 1.4, 2.6)], spp=16)
    given = {"domain": (0.0, 20.0), "lr": 0.1} | given
    return SceneProblem(scene, views, [Parameter(KEY, **given)], spp=4)


def test_bricks_follow_the_gradient(variant_rgb: None) -> None:
    problem = problem_of(start())
    fit = begin_fit(problem, Adam(), Course(12, events=(AdaptBricks(every=4, threshold=0.02),)))
    fit.complete()
    fixed = problem_of(start())
    without = begin_fit(fixed, Adam(), Course(12)).complete()
    held = set(problem.brick_numbers(KEY).tolist())
    z, y, x = 1, 1, 1
    inside = {(k * 3 + y) * 3 + x for k in (z, z + 1)}
    assert inside <= held
    assert problem.loss_value(fit.run.reals, 0) < 0.5 * fixed.loss_value(without.run.reals, 0)
    assert any("appeared" in line for line in fit.log)
    assert fit.run.reals[KEY].shape[0] == len(held) == problem.params[KEY].shape[0]


def test_a_checkpoint_holds_the_bricks(variant_rgb: None) -> None:
    problem, other = problem_of(start()), problem_of(start())
    reals = problem.initial_reals()
    refinement = problem.adapt_bricks(reals, 0, 0.0)
    other.unpack(problem.pack(refinement.reals), refinement.reals)
    other.set_reals(refinement.reals)
    assert np.array_equal(other.brick_numbers(KEY), problem.brick_numbers(KEY))
    assert problem.loss_value(refinement.reals, 3) == other.loss_value(refinement.reals, 3)


def test_neighbours_and_rows() -> None:
    counts = (3, 4, 5)
    middle = np.ravel_multi_index((1, 2, 2), counts)
    around = [np.ravel_multi_index((1 + a, 2 + b, 2 + c), counts) for a, b, c in itertools.product((-1, 0, 1), repeat=3)]
    assert find_neighbours(np.array([middle]), counts).tolist() == sorted(around)
    assert len(find_neighbours(np.array([0]), counts)) == 8
    values = np.array([0.0, 0.5, 0.2])[:, None] * np.ones((1, 4))
    assert _find_kept(values, np.array([3, 5, 9]), 0.2).tolist() == [5]
    assert _find_kept(values, np.array([3, 5, 9]), 0.7).tolist() == [5]
    # Pulls 3, 1, -3, 5, 2; those of the stored bricks are 1 and -3, with a median size of 2.
    gradient = np.array([[-2.0, -1.0], [-2.0, 1.0], [4.0, -1.0], [-5.0, 0.0], [-1.0, -1.0]])
    stored = np.array([False, True, True, False, False])
    assert _find_asked(gradient, stored).tolist() == [True, False, False, True, False]


def test_rows_are_carried(variant_rgb: None) -> None:
    tensor = mi.TensorXf(np.array([[1.0], [2.0], [3.0]], np.float32))
    assert np.array(_carry(tensor, np.array([2, 4, 7]), np.array([1, 4, 7, 8]))).ravel().tolist() == [0, 2, 3, 0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"map": "softplus", "domain": (0.0, np.inf)}, 'map "softplus" does not take 0'),
        ({"priors": "tv"}, "compares neighbours"),
    ],
)
def test_what_bricks_cannot_have_is_refused(variant_rgb: None, given: dict, words: str) -> None:
    ready = {k: (PRIORS["tv"](weight=1e-3),) if k == "priors" else v for k, v in given.items()}
    assert_refused(words, problem_of, start(), **ready)


def test_a_dense_grid_has_no_bricks(variant_rgb: None) -> None:
    values = np.ones((4, 4, 4, 1), np.float32)
    problem = SceneProblem(absorbing_scene(values), views_of_truth(values, [camera(0.3)], spp=4), [Parameter(KEY)], spp=4)
    assert_refused("no sparse grid among the parameters", problem.adapt_bricks, problem.initial_reals(), 0, 0.0)
