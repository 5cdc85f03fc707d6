"""Values of a scene's arrays, each read once: finite or not, empty blocks, albedo of zero.

Conventions. The cache key of a reading is the array itself: a new array is read again. Nothing is read while ``dr.freeze``
records.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError, MivolWarning
from mivol.fields.activation import Activation
from mivol.files import check_volume
from mivol.kernel_recording import is_recording
from mivol.scene.coefficients import check_constant
from mivol.scene.survey import SceneSurvey
from mivol.transport.media.extinction import ExactExtinction, Extinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.grid_blocks import (
    SHIFT,
    BlockExtremes,
    BlockRanges,
    CoarseGrid,
    block_shift,
    coarsen_grid,
    find_block_ranges,
    find_distances_of_bounds,
    find_extremes,
    find_occupied_blocks,
    place_blocks,
    tabulate_ranges,
)
from mivol.transport.traversal.lattice import Lattice


@dataclass
class GridReading:
    """The result of reading a grid.

    Attributes:
        bounds: largest value of each block; of a sparse grid, whether the block is occupied.
        extremes: smallest and largest values of each block; None of a sparse grid.
        pattern: whether each block has a positive value, eight blocks a byte; None of a sparse grid.
        occupied: share of blocks with a positive value [1].
        maximum: largest value of the grid.
        floored: values with 0 in place of negative values; None without negative values.
    """

    bounds: mi.Float | mi.Bool | None
    occupied: float
    maximum: float
    floored: mi.Float | None
    extremes: BlockExtremes | None = None
    pattern: bytes | None = None


def _read_once(survey: SceneSurvey, kind: tuple, array: mi.Float, make: Callable[[], Any]) -> Any:
    """Compute something once for each state of an array. The array is kept, so Dr.Jit cannot give its index to another array,
    until :func:`release_unread`.

    While ``dr.freeze`` records, the result is computed anew: a recording cannot use arrays made before the recording.
    """
    if is_recording():
        return make()
    key = (*kind, array.index)
    if key not in survey.values:
        made = make()
        survey.values = dict(list(survey.values.items())[-15:])
        survey.values[key] = (array, made)
    survey.reads[-1].add(key)
    return survey.values[key][1]


def _call_recorded(survey: SceneSurvey, function: Callable, *arguments: Any) -> Any:
    """The result of a function of arrays, without tracing it in each step. A recording cannot hold another one."""
    return function(*arguments) if is_recording() else survey.recorded.call(function, *arguments)


def _find_ends(values: mi.TensorXf) -> tuple[list[mi.Float], list[mi.Float]]:
    """The smallest and the largest values of :func:`find_extremes`."""
    found = find_extremes(values)
    return found.low, found.high


def _find_distances(low: list[mi.Float], high: list[mi.Float], res: tuple[int, int, int]) -> mi.UInt32:
    """The distances of :func:`find_distances_of_bounds` between the smallest and largest values of blocks."""
    return find_distances_of_bounds(BlockExtremes(low, high, res, SHIFT).bounds, res)


def release_unread(survey: SceneSurvey) -> None:
    """Release the arrays that neither the present nor the previous render has read: those of earlier steps of a fit."""
    survey.values = {key: kept for key, kept in survey.values.items() if any(key in reads for reads in survey.reads)}
    survey.reads = [survey.reads[-1], set()]


def read_extinction(part: ExactExtinction, survey: SceneSurvey, name: str) -> GridReading:
    """Read the bounds of one part of an extinction, once for each state of its array.

    Negative voxels, left by a step of an optimizer or by a filter, count as 0. Their derivative is the derivative at 0, so
    that a later step can raise them again. The first negative voxels of each grid cause a warning.

    Raises:
        MivolError: NaN or infinite values, or negative values of a radiance field whose activation takes none (the sentence
            names the first bad voxel of a grid).
    """
    array = dr.detach(part.lattice.values.array)

    def make() -> GridReading:
        values, activation, bricks, floored = part.lattice.values, part.activation, part.lattice.bricks, None
        if activation is not None:
            _check_stored_density(array, activation, name)
            # Values up to the empty value give no extinction; above, the extinction rises with the stored value.
            empty = activation.empty_below
            values = mi.TensorXf(dr.maximum(array, empty) if empty is not None else dr.abs(array) + 1, values.shape)
        elif bricks is not None and not dr.all((array >= 0) & dr.isfinite(array)):
            floored = _clip_negative(part, survey, name)
            values = mi.TensorXf(floored, values.shape)
        if bricks is not None:
            blocks = find_occupied_blocks(values, bricks)
            share = float(dr.count(blocks)[0]) / dr.width(blocks)
            return GridReading(blocks, share, float(dr.max(values.array)[0]), floored)
        # All facts of a dense grid follow from the extremes of its blocks, which the host reads once.
        # A recording would hold zeros for the derivatives of its inputs.
        ends = _call_recorded(survey, _find_ends, dr.detach(values))
        extremes = BlockExtremes(*ends, tuple(values.shape[:3]), SHIFT)
        low, high = (np.array([np.array(end) for end in ends]) for ends in (extremes.low, extremes.high))
        if activation is None and low.min() < 0:
            floored = _clip_negative(part, survey, name)
            extremes, low, high = extremes.floor(), np.maximum(low, 0), np.maximum(high, 0)
        bounds = np.maximum(-low, high).max(axis=0)
        filled = bounds > 0
        pattern = np.packbits(filled).tobytes()
        return GridReading(extremes.bounds, float(filled.mean()), float(bounds.max()), floored, extremes, pattern)

    reading = _read_once(survey, ("part",), array, make)
    if reading.floored is not None:
        part.floor(reading.floored)
    return reading


def _clip_negative(part: ExactExtinction, survey: SceneSurvey, name: str) -> mi.Float:
    """Clip the negative values of a grid to 0, with one warning for each grid of a scene.

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
            MivolWarning,
            stacklevel=2,
        )
    floored = dr.maximum(dr.detach(part.lattice.values.array), 0)
    dr.eval(floored)
    return floored


def _check_stored_density(array: mi.Float, activation: Activation, name: str) -> None:
    """Refuse invalid densities of a radiance field: an activation would turn them into vacuum silently."""
    if not bool(dr.all(dr.isfinite(array) & (activation.signed | (array >= 0)))):
        low, high = float(dr.min(array)[0]), float(dr.max(array)[0])
        expected = "finite numbers" if activation.signed else "finite numbers of at least 0 (without an activation)"
        raise MivolError(
            f"the density of the field in {name} lies in [{low:.4g}, {high:.4g}] (or is NaN); {expected} are expected: clip it "
            "after each step."
        )


@dataclass
class PartReading:
    """What transport reads of the values of a part before a render. Each is None if the plan does not need it.

    Attributes:
        floored: the values with 0 in place of negative values; None without negative values.
        empty_distances, trims, block_ranges: as in :class:`mivol.transport.traversal.lattice.Lattice`.
        rough, rough_distances: means of blocks of voxels, and their own ``empty_distances``.
        largest: largest value of a grey grid.
    """

    floored: mi.Float | None = None
    empty_distances: mi.UInt32 | None = None
    trims: bool = False
    block_ranges: BlockRanges | None = None
    rough: mi.TensorXf | None = None
    rough_distances: mi.UInt32 | None = None
    largest: mi.Float | None = None

    def apply(self, part: ExactExtinction) -> None:
        """Give the reading to a part."""
        if self.floored is not None:
            part.floor(self.floored)
        if self.empty_distances is not None:
            part.lattice.empty_distances, part.lattice.trims = self.empty_distances, self.trims
        if self.block_ranges is not None:
            part.lattice.block_ranges = self.block_ranges
        if self.largest is not None:
            part.largest = self.largest
        if self.rough is not None:
            shift = block_shift(part.lattice.res)
            part.rough = GridExtinction(part.name, place_blocks(part.lattice, self.rough, shift, self.rough_distances))


def read_part(
    part: Extinction,
    survey: SceneSurvey,
    name: str,
    skips_empty: bool,
    trims: bool,
    tracks: bool,
    looks_up: bool,
    coarsens: bool,
) -> PartReading:
    """Read what transport needs of a part, once for each state of its array.

    Args:
        part: a part of the extinction of the medium in ``name``.
        survey: keeps what was read.
        skips_empty, trims: whether walks skip empty blocks, and only before and behind the occupied ones.
        tracks: whether tracking needs the range of values of each block.
        looks_up: whether look-ups need the largest value of the grid.
        coarsens: whether distances of near light are drawn in coarse cells.
    """
    lattice, reading = part.lattice, PartReading()
    if lattice is None:
        return reading
    if skips_empty:
        reading.empty_distances = lattice.empty_distances = read_empty_distances(part, survey, name)
        reading.trims = lattice.trims = trims
    if part.activation is not None:
        return reading
    reading.floored = part.floored
    # A grey variant averages an rgb extinction over the channels; the transmittance of the mean is not the mean transmittance.
    has_estimates = not (mi.is_monochromatic and part.channels > 1)
    if tracks and has_estimates:
        reading.block_ranges = read_block_ranges(part, survey, name)
    if looks_up and has_estimates:
        reading.largest = read_largest(part, survey, name)
    if coarsens:
        coarse = read_coarse_grid(survey, lattice, block_shift(lattice.res), False).lattice
        reading.rough, reading.rough_distances = coarse.values, coarse.empty_distances
    return reading


def read_empty_distances(part: ExactExtinction, survey: SceneSurvey, name: str) -> mi.UInt32:
    """Measure the distance of each block to the nearest occupied block, once for each pattern of occupied blocks: steps of a
    fit seldom change it."""
    array, res, place = dr.detach(part.lattice.values.array), part.lattice.res, (name, part.name)

    def make() -> mi.UInt32:
        reading = read_extinction(part, survey, name)
        if reading.pattern is None or is_recording():
            return find_distances_of_bounds(reading.bounds, res)
        key = res, reading.pattern
        if place not in survey.distances or survey.distances[place][0] != key:
            ends = reading.extremes.low, reading.extremes.high
            survey.distances[place] = key, _call_recorded(survey, _find_distances, *ends, res)
        return survey.distances[place][1]

    return _read_once(survey, ("empty distances",), array, make)


def read_block_ranges(part: ExactExtinction, survey: SceneSurvey, name: str) -> BlockRanges:
    """Read the range of values of each block of a grid, once for each state of the array."""
    values, bricks = part.lattice.values, part.lattice.bricks

    def make() -> BlockRanges:
        if bricks is not None or is_recording():
            return find_block_ranges(values, None, bricks)
        extremes = read_extinction(part, survey, name).extremes
        return tabulate_ranges(extremes if extremes.shift == block_shift(part.lattice.res) else extremes.join())

    return _read_once(survey, ("blocks",), dr.detach(values.array), make)


def read_largest(part: ExactExtinction, survey: SceneSurvey, name: str) -> mi.Float:
    """Read the largest value of a grid, once for each state of the array."""
    array = dr.detach(part.lattice.values.array)

    def make() -> mi.Float:
        return dr.max(array) if is_recording() else dr.opaque(mi.Float, read_extinction(part, survey, name).maximum)

    return _read_once(survey, ("largest",), array, make)


def read_coarse_grid(survey: SceneSurvey, lattice: Lattice, shift: int, finds_occupied: bool) -> CoarseGrid:
    """Coarsen a grid, once for each state of the array and each placement."""
    kind = ("coarse", shift, finds_occupied, lattice.empty_distances is None, lattice.to_world.tobytes())
    return _read_once(survey, kind, dr.detach(lattice.values.array), lambda: coarsen_grid(lattice, shift, finds_occupied))


def is_scattering(view: MediumView, survey: SceneSurvey, name: str) -> bool:
    """Whether an albedo (or ``sigma_s``) of a medium is above 0 or has gradients enabled. Each array is read once.

    Raises:
        MivolError: an albedo outside [0, 1].
    """
    highest = [_read_range(a, survey, name, view.albedo is not None)[1] for a in view.albedo_arrays]
    return any(high > 0 or dr.grad_enabled(a) for high, a in zip(highest, view.albedo_arrays, strict=True))


def read_number(value: float | mi.Float, survey: SceneSurvey) -> float:
    """A number, read once from an array of length 1: the host waits for all kernels before it reads."""
    if isinstance(value, float):
        return value
    if value.state == dr.VarState.Literal:
        return float(value[0])
    return _read_once(survey, ("number",), value, lambda: float(value[0]))


def read_lowest_albedo(view: MediumView, survey: SceneSurvey, name: str) -> float:
    """The lowest albedo of a medium [1]; 0 for a medium without an albedo. Each array is read once."""
    if view.albedo is None:
        return 0.0
    return min((_read_range(a, survey, name, True)[0] for a in view.albedo_arrays), default=0.0)


def _read_range(values: mi.TensorXf, survey: SceneSurvey, name: str, is_albedo: bool) -> tuple[float, float]:
    """The lowest and the highest value of an array."""
    flat = dr.detach(dr.ravel(values))

    def make() -> tuple[float, float]:
        low, high = float(dr.min(flat)[0]), float(dr.max(flat)[0])
        # NaN fails every comparison.
        if is_albedo and not (low >= 0 and high <= 1 and bool(dr.all(dr.isfinite(flat)))):
            raise MivolError(
                f"the albedo of the medium in {name} lies in [{low:.9g}, {high:.9g}] (or is NaN); the share of light that is "
                "scattered lies in [0, 1]: clip it after each step."
            )
        return low, high

    return _read_once(survey, ("albedo",), flat, make)


def check_constants(view: MediumView, survey: SceneSurvey, name: str) -> None:
    """Check the constants and the scale of an extinction. Each state is read once.

    Raises:
        MivolError: a number that is NaN, infinite or negative.
    """
    for key, given in view.numbers.items():
        # Keep a copy: values of mi.traverse change in place, and Dr.Jit reuses the index of a deleted array.
        value = dr.detach(given)
        state = _constant_state(value)
        if survey.numbers.get((view.medium.ptr, key), (None, None))[1] != state:
            check_constant(value, key, f" of the medium in {name}")
            survey.numbers[view.medium.ptr, key] = (value, state)


def _constant_state(value: float | mi.Float | mi.Color3f) -> float | tuple[int, ...]:
    """The state of a constant: the number itself, or the indices of its arrays."""
    if not dr.is_array_v(value):
        return value
    return (value.index,) if dr.depth_v(value) == 1 else tuple(v.index for v in value)


def check_emission(view: MediumView, survey: SceneSurvey, name: str) -> None:
    """Check the light that a medium emits. Each array is read once.

    Raises:
        MivolError: negative, infinite or NaN values.
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
