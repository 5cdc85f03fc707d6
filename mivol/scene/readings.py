"""Values of a scene's arrays, each read once: are they finite, which blocks are empty, is an albedo zero.

Conventions. What was read is kept by the array itself; a new array is read again, and nothing is read while
``dr.freeze`` records.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.activation import Activation
from mivol.files import check_volume
from mivol.kernel_recording import is_recording
from mivol.scene.coefficients import check_constant
from mivol.scene.survey import SceneSurvey
from mivol.transport.media.extinction import ExactExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.grid_blocks import (
    BlockRanges,
    CoarseGrid,
    bound_blocks,
    coarsen_grid,
    find_block_ranges,
    find_distances_of_bounds,
)
from mivol.transport.traversal.grid_walk import corner_nodes
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice, locate_cell

__all__ = ["GridReading", "check_emission", "check_constants", "is_scattering", "read_extinction"]


@dataclass
class GridReading:
    """What was read of an array; ``floored``: its values with 0 for those below it, None where there are none."""

    bounds: mi.Float | None
    occupied: float
    maximum: float
    floored: mi.Float | None = None


def _read_once(survey: SceneSurvey, kind: tuple, array: mi.Float, make: Callable[[], Any]) -> Any:
    """Make something once for each state of an array, which is kept so that its number cannot be given to another one.

    While a function is being recorded it is made anew: a recording can use no array that was made before it.
    """
    if is_recording():
        return make()
    key = (*kind, array.index)
    if key not in survey.values:
        made = make()
        survey.values = dict(list(survey.values.items())[-15:])
        survey.values[key] = (array, made)
    return survey.values[key][1]


def read_extinction(part: ExactExtinction, survey: SceneSurvey, name: str) -> GridReading:
    """Read the bounds of a part of an extinction once for each state of its array.

    Voxels below 0, where a step of an optimiser or a filter overshot, count as 0 from here on, and have the derivative that
    they would have at 0, so that a step may bring them back. The first ones of each grid of a scene are told in a warning.

    Raises:
        MivolError: NaN or infinite values (those of a radiance field may be negative only where its activation takes them);
            the first bad voxel of a grid is named. A stock grid that is looked up otherwise than between voxel centres
            with clamped borders.
    """
    array = dr.detach(part.lattice.values.array)

    def make() -> GridReading:
        values, activation, floored = part.lattice.values, part.activation, None
        if activation is not None:
            _check_stored_density(array, activation, name)
            # Nothing is below an empty value; an extinction rises with what is stored.
            empty = activation.empty_below
            values = mi.TensorXf(dr.maximum(array, empty) if empty is not None else dr.abs(array) + 1, values.shape)
        elif not dr.all((array >= 0) & dr.isfinite(array)):
            floored = _clip_negative(part, survey, name)
            values = mi.TensorXf(floored, values.shape)
        blocks = bound_blocks(values)
        host = np.array(blocks)
        _check_look_up(part, survey, name)
        return GridReading(blocks, float((host > 0).mean()), float(host.max(initial=0.0)), floored)

    read = _read_once(survey, ("part",), array, make)
    if read.floored is not None:
        values = part.lattice.values
        # The stock grid is not looked up again: it interpolates the values below 0, these do not.
        part.lattice.values, part.volume = mi.TensorXf(dr.replace_grad(read.floored, values.array), values.shape), None
    return read


def _clip_negative(part: ExactExtinction, survey: SceneSurvey, name: str) -> mi.Float:
    """The values of a grid with 0 for those below it; says so once for each grid of a scene.

    Raises:
        MivolError: NaN or infinite values.
    """
    values = np.array(dr.detach(part.lattice.values))
    check_volume(values, name=name, minimum=None)
    if (name, part.name) not in survey.warned:
        survey.warned.add((name, part.name))
        warnings.warn(
            f"{int((values < 0).sum())} of {values.size} values of {part.name} of the medium in {name} are below 0, the least "
            f"{values.min():.3g}: they count as 0, with the derivative at 0; add params[key] = dr.maximum(params[key], 0) "
            "after each step or filter, or give mivol.Parameter(key, domain=(0, ...)) (this is said once).",
            RuntimeWarning,
            stacklevel=2,
        )
    floored = dr.maximum(dr.detach(part.lattice.values.array), 0)
    dr.eval(floored)
    return floored


def _check_stored_density(array: mi.Float, activation: Activation, name: str) -> None:
    """Refuse densities of a radiance field that are none: an activation would make vacuum of them in silence."""
    if not bool(dr.all(dr.isfinite(array) & (activation.signed | (array >= 0)))):
        low, high = float(dr.min(array)[0]), float(dr.max(array)[0])
        expected = "finite numbers" if activation.signed else "finite numbers of at least 0 (without an activation)"
        raise MivolError(
            f"the density of the field in {name} lies in [{low:.4g}, {high:.4g}] (or is NaN); {expected} are expected: clip it "
            "after each step."
        )


LOOK_UP_POINTS = 2048
"""Points at which a stock grid is looked up, half of them in its outermost half voxels, half around voxels that are not 0."""

LOOK_UP_TOLERANCE = 0.02
"""How far a look-up may be from the trilinear one, in differences between the 8 voxels around (it is 5e-6 of a grid's size off
where a turned stock grid does not fill its boundary; the nearest voxel is about 0.4 off)."""


def _check_look_up(part: ExactExtinction, survey: SceneSurvey, name: str) -> None:
    """Refuse a stock grid with another filter or with borders that are not clamped: it tells neither, but its values do."""
    volume, lattice = part.volume, part.lattice
    mixes = mi.is_monochromatic and lattice.channels > 1
    if volume is None or volume.ptr in survey.looked_up or mixes:
        return
    rng, sizes = np.random.default_rng(0), np.array(lattice.res[::-1])
    u, axis, border = (
        rng.uniform(1e-3, 1 - 1e-3, (LOOK_UP_POINTS, 3)),
        rng.integers(3, size=LOOK_UP_POINTS),
        np.arange(LOOK_UP_POINTS // 2),
    )
    u[border, axis[border]] = rng.uniform(0.05, 0.45, len(border)) / sizes[axis[border]]
    held = np.argwhere(np.array(lattice.values).any(axis=3))[:, ::-1]
    if len(held):
        chosen = held[rng.integers(len(held), size=LOOK_UP_POINTS - len(border))]
        u[len(border) :] = np.clip((chosen + rng.uniform(0, 1, chosen.shape)) / sizes, 1e-3, 1 - 1e-3)
    it = dr.zeros(mi.Interaction3f, LOOK_UP_POINTS)
    it.p = lattice.place(mi.Vector3f(u.T.astype(np.float32)))
    cell, frac, _ = locate_cell(lattice, it.p, mi.Vector3f(0, 0, 1), mi.Float(0))
    nodes, c = corner_nodes(cell, dr.full(dr.mask_t(mi.Vector3f), True), lattice.res), lattice.channels
    corners = [[dr.gather(mi.Float, dr.detach(lattice.values.array), k * c + i) for k in nodes] for i in range(c)]
    ours = np.array([np.array(interpolate(row, frac)) for row in corners])
    theirs = np.array(volume.eval_1(it))[None] if c == 1 else np.array(volume.eval(it))
    spread = np.ptp(np.array([[np.array(v) for v in row] for row in corners]), axis=1)
    off, most = np.abs(ours - theirs), float(np.abs(ours).max())
    groups = [*(border[axis[border] == a] for a in range(3)), slice(len(border), None)]
    if any(off[:, s].sum() > LOOK_UP_TOLERANCE * spread[:, s].sum() + 1e-5 * most * LOOK_UP_POINTS for s in groups):
        raise MivolError(
            f"{part.name} of the medium in {name} is a gridvolume with another filter_type than trilinear or another wrap_mode "
            "than clamp: its values between voxels are not those that rays are integrated over; leave both at these, or "
            "resample the grid."
        )
    if spread.any():
        survey.looked_up.add(volume.ptr)


def read_empty_distances(part: ExactExtinction, survey: SceneSurvey, name: str) -> mi.UInt8:
    """Measure how far each block of a part is from the nearest one that is not empty, once for each state of its array."""
    array, res = dr.detach(part.lattice.values.array), part.lattice.res
    return _read_once(
        survey, ("empty distances",), array, lambda: find_distances_of_bounds(read_extinction(part, survey, name).bounds, res)
    )


def read_block_ranges(part: ExactExtinction, survey: SceneSurvey) -> BlockRanges:
    """Read what the blocks of a grid hold, once for each state of its array."""
    values = part.lattice.values
    return _read_once(survey, ("blocks",), dr.detach(values.array), lambda: find_block_ranges(values))


def read_coarse_grid(survey: SceneSurvey, lattice: Lattice, shift: int, lists: bool) -> CoarseGrid:
    """Make a grid coarser once for each state of its array and place."""
    kind = ("coarse", shift, lists, lattice.empty_distances is None, lattice.to_world.tobytes())
    return _read_once(survey, kind, dr.detach(lattice.values.array), lambda: coarsen_grid(lattice, shift, lists))


def is_scattering(view: MediumView, survey: SceneSurvey, name: str) -> bool:
    """Whether any albedo (or sigma_s) of a medium is above 0, or its derivative is asked for. Each array is read once.

    Raises:
        MivolError: an albedo outside [0, 1].
    """
    positive = [_is_positive(a, survey, name, view.albedo is not None) for a in view.albedo_arrays]
    return any(positive)


def _is_positive(values: mi.TensorXf, survey: SceneSurvey, name: str, is_albedo: bool) -> bool:
    flat = dr.detach(dr.ravel(values))

    def make() -> bool:
        low, high = float(dr.min(flat)[0]), float(dr.max(flat)[0])
        # NaN fails every comparison.
        if is_albedo and not (low >= 0 and high <= 1 and bool(dr.all(dr.isfinite(flat)))):
            raise MivolError(
                f"the albedo of the medium in {name} lies in [{low:.9g}, {high:.9g}] (or is NaN); the share of light that is "
                "scattered lies in [0, 1]: clip it after each step."
            )
        return high > 0

    return _read_once(survey, ("albedo",), flat, make) or dr.grad_enabled(values)


def check_constants(view: MediumView, survey: SceneSurvey, name: str) -> None:
    """Look at the constants of an extinction and its scale. Each state of them is read once.

    Raises:
        MivolError: a number that is NaN, infinite or negative.
    """
    for key, given in view.numbers.items():
        # A copy is kept: what traverse hands out changes in place, and the index of an array that is gone is given to others.
        value = dr.detach(given)
        state = _constant_state(value)
        if survey.numbers.get((view.medium.ptr, key), (None, None))[1] != state:
            check_constant(value, key, f" of the medium in {name}")
            survey.numbers[view.medium.ptr, key] = (value, state)


def _constant_state(value: float | mi.Float | mi.Color3f) -> float | tuple[int, ...]:
    """What changes with a number: itself, or the indices of its arrays."""
    if not dr.is_array_v(value):
        return value
    return (value.index,) if dr.depth_v(value) == 1 else tuple(v.index for v in value)


def check_emission(view: MediumView, survey: SceneSurvey, name: str) -> None:
    """Look at what a medium emits. Each array is read once.

    Raises:
        MivolError: light that is negative, infinite or NaN.
    """
    for values in view.emission_arrays:
        flat = dr.detach(dr.ravel(values))
        _read_once(survey, ("light",), flat, lambda flat=flat: _check_emission_values(flat, name))


def _check_emission_values(flat: mi.Float, name: str) -> None:
    if not bool(dr.all(dr.isfinite(flat) & (flat >= 0))):
        low, high = float(dr.min(flat)[0]), float(dr.max(flat)[0])
        raise MivolError(
            f"the emission of the medium in {name} lies in [{low:.4g}, {high:.4g}] (or is NaN); light is finite and at "
            "least 0: clip it after each step."
        )
