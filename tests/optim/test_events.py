"""Events: due iterations, and conservation of mass on refining a grid."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mivol.optim.events import (
    Checkpoint,
    CoarseToFine,
    ControlDensity,
    DropUnseen,
    Evaluate,
    UpdateOccupancy,
    Upsample,
    checkpoints_first,
    upsample,
)

EPS = float(np.finfo(np.float32).eps)

SIZES = st.tuples(*[st.integers(1, 6)] * 3)
NEW_SIZES = st.tuples(*[st.integers(1, 11)] * 3)


@settings(max_examples=60, deadline=None)
@given(SIZES, NEW_SIZES, st.integers(1, 3), st.integers(0, 1000))
def test_upsampling_conserves_mass(old: tuple[int, ...], new: tuple[int, ...], channels: int, seed: int) -> None:
    """Rationale: a refined start must absorb as much as the coarse one, or the loss jumps. Whole factors conserve the
    mass by themselves, others do not.
    Expected: the mean of each channel is kept to the rounding of float32 values (eps / 2 each, of one sign at worst);
    nothing is negative (linear, not cubic).

    Hard case 47.
    """
    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(seed)
    field = rng.uniform(0, 1, (*old, channels)) ** 8 * (rng.uniform(size=(*old, 1)) > 0.5)
    fine = np.asarray(upsample(mi.TensorXf(field.astype("f")), new))
    assert fine.shape == (*new, channels)
    before = field.astype("f").astype(np.float64).mean(axis=(0, 1, 2))
    after = fine.astype(np.float64).mean(axis=(0, 1, 2))
    assert np.all(np.abs(after - before) <= EPS * before)
    assert fine.min(initial=0.0) >= 0.0


def test_upsampling_conserves_the_mass_of_a_much_smaller_channel(variant_rgb) -> None:
    """Three voxels become one, in which linear interpolation alone leaves more than a third of the last."""
    field = np.zeros((1, 1, 3, 2), np.float32)
    field[0, 0, 2] = 1e-16, 1.0
    fine = np.asarray(upsample(mi.TensorXf(field), (1, 1, 1)), np.float64)
    np.testing.assert_allclose(fine[0, 0, 0], field[0, 0, 2] / 3, rtol=EPS)


def test_no_overshoot(variant_rgb) -> None:
    """A step stays between its levels, but for the factor that restores the mass, which is 1 for a step by symmetry.

    Hard case 47.
    """
    step = np.zeros((4, 4, 4, 1), "f")
    step[2:] = 1.0
    fine = np.asarray(upsample(mi.TensorXf(step), (8, 8, 8)))
    assert fine.min() == 0.0
    assert fine.max() <= 1.0 + EPS
    ramp = fine[:, 0, 0, 0]
    assert np.all(np.diff(ramp) >= 0)
    assert np.allclose(ramp[3:5], [0.25, 0.75], rtol=2 * EPS)


def test_upsampling_of_a_field_of_both_signs_without_mass(variant_rgb) -> None:
    values = np.array([1.0, -1.0], "f").reshape(2, 1, 1, 1)
    fine = np.asarray(upsample(mi.TensorXf(values), (4, 1, 1)))
    assert np.allclose(fine.ravel(), [1, 0.5, -0.5, -1], atol=EPS)


def test_events_are_due_at_their_iterations(variant_rgb) -> None:
    assert [i for i in range(9) if Upsample(at=(3, 5)).due(i)] == [3, 5]
    assert [i for i in range(9) if Checkpoint(every=4).due(i)] == [4, 8]
    assert [i for i in range(9) if Evaluate(every=4).due(i)] == [0, 4, 8]
    assert [i for i in range(9) if CoarseToFine(at=(3, 5)).due(i)] == [3, 5]
    assert [i for i in range(9) if DropUnseen(at=(3, 5)).due(i)] == [3, 5]
    assert [i for i in range(9) if UpdateOccupancy(every=4).due(i)] == [4, 8]
    assert [i for i in range(9) if ControlDensity(every=2, begin=3, end=8).due(i)] == [4, 6]
    assert isinstance(checkpoints_first((Upsample(at=(1,)), Evaluate(), Checkpoint()))[0], Checkpoint)
