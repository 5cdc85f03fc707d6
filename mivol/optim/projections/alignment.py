"""Where the detector stood in each view: shifts, turns, the axis and its tilt, as unknowns of the fit.

Rounds alternate between volume and geometry. A few iterations of pcg explain the projections with the geometry of the last
round. Then the unknowns move by a Gauss-Newton step on the residual, whose derivatives are differences of the predicted views
along rows and columns, or of predictions with another tilt. The volume continues from round to round. Its adaption to wrong
views slows the rounds: an error of the geometry shrinks by a factor ``1 - c`` a round, where c is the share of the curvature
that remains after the volume has adapted.

Smoothing. Projections are smoothed by ``SMOOTHING`` pixels first, so an error of a pixel is a small fraction of a detail, and
large detectors are averaged over blocks. Neighbouring residuals are then correlated. Counted as independent, they give
standard deviations five times too small. With smoothing G, slopes J and normal equations N = J^T J, the moves of a view have
the covariance ``N^-1 J^T G G^T J N^-1`` times the variance of the noise before smoothing. The residual of held-out views tells
this variance, because the volume adapts to the noise of the others.

Gauge. A displaced object cannot be told from views displaced by ``a cos(theta) + b sin(theta)`` along the columns and by a
constant along the rows: both are removed from the moves.

References: Penczek, Grassucci & Frank 1994, Ultramicroscopy 53, 251 (projection matching); Gursoy et al. 2017, Sci. Rep. 7,
11818 (rounds of reconstruction and alignment); White 1980, Econometrica 48, 817 (variance from the scatter of parts).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from mivol.errors import MivolError
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import LeastSquares, last_state
from mivol.tomography.filtered import check_directions, feldkamp, filtered_backprojection
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

UNKNOWNS = ("shift", "axis", "tilt")
"""Names of unknowns: shift and turn of each view; the axis along the columns; its tilts along the light and across it."""

SMOOTHING = 2.0
"""Standard deviation [pixel] of the smoothing: twice a usual shift."""

ROUNDS, ITERATIONS = 12, 6
"""Rounds, and iterations of pcg in each: shifts of one pixel are then known to .03 (measured for heads and blocks)."""

MOST_COLUMNS = 192
"""Columns above which pixels are averaged over blocks."""

LARGEST_STEP, TILT_STEP = 2.0, 2e-3
"""Largest move of a round [pixel], and half the difference of tilts [rad] of a derivative."""

CLEAR, LEAST_GAIN, TINY = 4.0, 0.1, 1e-30
"""Standard errors, and logarithm of the ratio, by which the squared residual of held-out views must fall: their own three moves
alone lower it by some percent. Residuals below the last number count as it."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """A geometry fitted to its projections.

    Attributes:
        beam: the fitted beam; the given one if ``is_needed`` is False.
        moves: (views, 3) fitted moves: (rows, columns) [pixel], turn [rad].
        axis: displacement of the axis along the columns [pixel], and its standard deviation.
        tilt: tilts along the light and across it [rad] and their standard deviations, (2, 2).
        sigma: standard deviation of the moves (rows, columns, turn) of a typical view (median).
        before, after: (held-out views,) mean squared residual without and with the fitted geometry.
        is_needed: whether ``after`` is below ``before`` by more than chance.
    """

    beam: ParallelBeam | ConeBeam
    moves: np.ndarray
    axis: tuple[float, float]
    tilt: np.ndarray
    sigma: np.ndarray
    before: np.ndarray
    after: np.ndarray
    is_needed: bool


@dataclass(frozen=True, eq=False)
class _State:
    """Unknowns: moves (views, 3), and (axis [pixel], tilt along the light [rad], tilt across it [rad])."""

    moves: np.ndarray
    common: np.ndarray

    def beam(self, beam: ParallelBeam | ConeBeam) -> ParallelBeam | ConeBeam:
        moves = self.moves + np.array([0.0, self.common[0], self.common[2]])
        return replace(beam, tilt=beam.tilt + self.common[1], moves=moves if beam.moves is None else beam.moves + moves)


def align_views(
    beam: ParallelBeam | ConeBeam,
    grid: VoxelGrid,
    y: np.ndarray,
    weights: np.ndarray,
    refine: Sequence[str],
    held_out: np.ndarray,
    rounds: int = ROUNDS,
) -> Alignment:
    """Fit where the detector stood.

    Held-out views take no part in the volume. Their own moves are fitted to its prediction, and the mean squared residual of
    this prediction judges the result: a geometry that lowers it by less than ``CLEAR`` standard errors and a tenth is not used.

    Args:
        beam: the nominal geometry.
        grid: voxels of the reconstruction.
        y: line integrals (views, rows, cols).
        weights: inverse variances.
        refine: some of ``UNKNOWNS``. Detectors of fewer than 8 rows have moves along the columns only, and no tilt.
        held_out: indices of views that judge; empty: every tenth, or more often for at least eight.
        rounds: number of rounds.

    Raises:
        MivolError: unknown names, too few rows for a tilt, or fewer than 8 views.
    """
    wrong = [name for name in refine if name not in UNKNOWNS]
    if wrong or not refine:
        raise MivolError(f"found scan.refine = {list(refine)}, expected some of {', '.join(UNKNOWNS)}.")
    if len(y) < 8:
        raise MivolError(f"found {len(y)} views, expected at least 8 to fit their geometry: leave scan.refine out.")
    few = y.shape[1] < 8
    if few and "tilt" in refine:
        raise MivolError(f'found {y.shape[1]} rows, expected at least 8 to find a tilt by: leave "tilt" out of scan.refine.')
    small, coarse, smooth, mask, factor = _reduce(beam, grid, y, weights)
    own = ([1] if few else [0, 1, 2]) if "shift" in refine else []
    # The moves of all views together hold the axis, and its tilt across the light.
    common = [0] if "axis" in refine and not own else []
    common += ([1] if own else [1, 2]) if "tilt" in refine else []
    step = min(10, max(2, len(y) // 8))
    judges = held_out if len(held_out) else np.arange(step // 2, len(y), step)
    state = _State(np.zeros((len(y), 3)), np.zeros(3))
    x = None
    steps: list[np.ndarray] = []
    for _ in range(rounds):
        x, predicted = _predict(state.beam(small), coarse, smooth, mask, judges, x)
        state, step, fit = _improve(state, small, coarse, x, smooth - predicted, mask, predicted, own, common)
        steps.append(step)
    before, after = (
        _misfit(at.beam(small), coarse, smooth, mask, judges) for at in (_State(0 * state.moves, 0 * state.common), state)
    )
    better = np.log(np.maximum(before, TINY) / np.maximum(after, TINY))
    is_needed = better.mean() > max(CLEAR * better.std(ddof=1) / math.sqrt(len(better)), LEAST_GAIN)
    spread = _moves_spread(_slopes(predicted)[..., own], mask, fit.own) if own else np.empty(0)
    sigma, common_sigma = _deviations(fit, float(after.mean()) * spread, steps, own, common)
    moves, found = state.moves * [factor, factor, 1.0], state.common * [factor, 1.0, 1.0]
    shifted = _State(moves, found)
    axis = found[0] + moves[:, 1].mean(), (common_sigma[0] if common[:1] == [0] else sigma[1] / math.sqrt(len(y))) * factor
    across = found[2] + moves[:, 2].mean(), common_sigma[2] or sigma[2] / math.sqrt(len(y))
    tilt = np.array([(found[1], common_sigma[1]), across]).T
    return Alignment(
        shifted.beam(beam) if is_needed else beam,
        moves + np.array([0.0, found[0], found[2]]),
        axis,
        tilt,
        sigma * [factor, factor, 1.0],
        before,
        after,
        bool(is_needed),
    )


def _reduce(
    beam: ParallelBeam | ConeBeam, grid: VoxelGrid, y: np.ndarray, weights: np.ndarray
) -> tuple[ParallelBeam | ConeBeam, VoxelGrid, np.ndarray, np.ndarray, int]:
    """Beam, voxels, smooth projections and their mask, averaged over blocks of some pixels; and pixels along a block."""
    factor = max(1, -(-y.shape[2] // MOST_COLUMNS))
    rows, columns = (max(1, n // factor) for n in y.shape[1:])
    block = min(factor, y.shape[1]), factor
    first = [(n - m * b) // 2 for n, m, b in zip(y.shape[1:], (rows, columns), block, strict=True)]
    inner = np.s_[:, first[0] : first[0] + rows * block[0], first[1] : first[1] + columns * block[1]]

    def mean(a: np.ndarray) -> np.ndarray:
        return a[inner].reshape(len(a), rows, block[0], columns, block[1]).mean((2, 4))

    seen = weights > 0
    share = mean(seen.astype(float))
    values = mean(np.where(seen, y, 0.0)) / np.where(share > 0, share, 1.0)
    margin = 2 * int(SMOOTHING) if rows >= 8 * SMOOTHING else int(rows >= 8)
    mask = (share > 0).astype(float)
    if margin:
        mask[:, :margin] = mask[:, -margin:] = 0.0
    cut = [
        (2 * f + m * b - n) / 2 * p
        for f, m, b, n, p in zip(first, (rows, columns), block, y.shape[1:], beam.pitch, strict=True)
    ]
    small = replace(
        beam,
        detector=(rows, columns),
        pitch=tuple(b * p for b, p in zip(block, beam.pitch, strict=True)),
        detector_offset=tuple(o + c for o, c in zip(beam.detector_offset, cut, strict=True)),
    )
    shape = tuple(max(1, -(-n // (block[0] if axis == 0 else factor))) for axis, n in enumerate(grid.shape))
    coarse = VoxelGrid(shape, tuple(grid.extent / np.array(shape[::-1])), grid.centre)
    return small, coarse, _smooth(values), mask, factor


def _smooth(images: np.ndarray) -> np.ndarray:
    """Images (views, rows, cols) smoothed along the columns, and along 8 rows or more."""
    return gaussian_filter(images, (0, SMOOTHING if images.shape[1] >= 8 else 0, SMOOTHING), mode="nearest")


def _predict(
    beam: ParallelBeam | ConeBeam,
    grid: VoxelGrid,
    y: np.ndarray,
    mask: np.ndarray,
    judges: np.ndarray,
    start: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """A volume of the views that do not judge, and its projections (views, rows, cols)."""
    a = Projector(beam, grid)
    kept = np.setdiff1d(np.arange(len(y)), judges)
    part = a.subset(kept)
    if start is None:
        start = _filtered(part, y[kept])
    problem = LeastSquares(part, y[kept], mask[kept], start, nonnegative=True)
    state = last_state(projected_cg(problem), ITERATIONS)
    x = start if state is None else state.x
    return x, (a @ np.reshape(x, grid.shape)).astype(float)


def _filtered(a: Projector, y: np.ndarray) -> np.ndarray | None:
    """Filtered back-projection above 0, or None if the views do not allow it."""
    try:
        check_directions(a)
    except MivolError:
        return None
    method = filtered_backprojection if isinstance(a.geometry, ParallelBeam) else feldkamp
    return np.maximum(method(a, y, "hann"), 0)


def _misfit(beam: ParallelBeam | ConeBeam, grid: VoxelGrid, y: np.ndarray, mask: np.ndarray, judges: np.ndarray) -> np.ndarray:
    """(judging views,) mean squared residual, by a volume that begins anew."""
    x = None
    for _ in range(3):
        x, predicted = _predict(beam, grid, y, mask, judges, x)
    squares = mask[judges] * (y - predicted)[judges] ** 2
    return squares.sum((1, 2)) / np.maximum(mask[judges].sum((1, 2)), 1.0)


def _slopes(predicted: np.ndarray) -> np.ndarray:
    """Derivatives (views, rows, cols, 3) of the readings by the moves (rows, columns, turn)."""
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in predicted.shape[1:])
    along_v = np.gradient(predicted, axis=1) if len(rows) > 1 else np.zeros_like(predicted)
    along_u = np.gradient(predicted, axis=2)
    return np.stack([along_v, along_u, along_v * columns - along_u * rows[:, None]], -1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A Gauss-Newton step: normal equations of the views, of the common unknowns, and the gradients of each view."""

    own: np.ndarray
    common: np.ndarray
    gradients: np.ndarray


def _improve(
    state: _State,
    beam: ParallelBeam | ConeBeam,
    grid: VoxelGrid,
    x: np.ndarray,
    residual: np.ndarray,
    mask: np.ndarray,
    predicted: np.ndarray,
    own: list[int],
    common: list[int],
) -> tuple[_State, np.ndarray, _Fit]:
    """The unknowns after a step, the step (views x moves, then the common unknowns), and its equations."""
    slopes = _slopes(predicted)
    moves, shared = np.zeros((len(residual), 3)), np.zeros(3)
    fit = _Fit(np.empty(0), np.empty(0), np.empty(0))
    if own:
        j = slopes[..., own]
        normal = np.einsum("vrci,vrc,vrcj->vij", j, mask, j)
        # A view without slopes stays where it is.
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2).mean() * np.eye(len(own)) / len(own) + 1e-30 * np.eye(len(own))
        pull = np.einsum("vrci,vrc,vrc->vi", j, mask, residual)
        moves[:, own] = np.clip(np.linalg.solve(normal, pull[..., None])[..., 0], -LARGEST_STEP, LARGEST_STEP)
        moves = _fix_gauge(moves, beam.angles)
        fit = replace(fit, own=normal)
    if common:
        parts = {0: slopes[..., 1], 2: slopes[..., 2]}
        if 1 in common:
            ends = [
                Projector(replace(state.beam(beam), tilt=state.beam(beam).tilt + h), grid) @ np.reshape(x, grid.shape)
                for h in (-TILT_STEP, TILT_STEP)
            ]
            parts[1] = (ends[1].astype(float) - ends[0]) / (2 * TILT_STEP)
        j = np.stack([parts[k] for k in common], -1)
        normal = np.einsum("vrci,vrc,vrcj->ij", j, mask, j)
        gradients = np.einsum("vrci,vrc,vrc->vi", j, mask, residual)
        limit = np.array([LARGEST_STEP, 0.05, 0.05])[common]
        shared[common] = np.clip(np.linalg.lstsq(normal, gradients.sum(0), rcond=1e-9)[0], -limit, limit)
        fit = replace(fit, common=normal, gradients=gradients)
    step = np.concatenate([moves.ravel(), shared])
    return _State(state.moves + moves, state.common + shared), step, fit


def _fix_gauge(moves: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Moves, without the part equivalent to a displaced object."""
    object_moves = np.stack([np.cos(angles), np.sin(angles)], 1)
    fixed = moves.copy()
    fixed[:, 1] -= object_moves @ np.linalg.lstsq(object_moves, moves[:, 1], rcond=None)[0]
    fixed[:, 0] -= moves[:, 0].mean()
    return fixed


def _moves_spread(slopes: np.ndarray, mask: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Variances (own moves,) of a typical view (median) over the variance of its smooth readings.

    Args:
        slopes: J, derivatives of the readings by the moves (views, rows, cols, own moves).
        mask: (views, rows, cols), 1 where readings count.
        normal: N (views, own moves, own moves).
    """
    middle = (mask.shape[1] // 2, mask.shape[2] // 2)
    point = np.zeros((1, *mask.shape[1:]))
    point[0, *middle] = 1.0
    reduction = float((_smooth(point) ** 2).sum())
    smooth = np.stack([_smooth(mask * part) for part in np.moveaxis(slopes, -1, 0)], -1)
    inverse = np.linalg.inv(normal)
    covariance = inverse @ np.einsum("vrci,vrcj->vij", smooth, smooth) @ inverse / reduction
    return np.median(np.diagonal(covariance, axis1=1, axis2=2), axis=0)


def _deviations(
    fit: _Fit, variances: np.ndarray, steps: list[np.ndarray], own: list[int], common: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of the moves (3,) and of the common unknowns (3,); 0 for those that are known.

    Of the curvature of a fixed volume, the share ``c`` = 1 - (last step over the step before) remains. The rounds that were
    not taken would add ``step (1 - c) / c``. ``variances`` are those of the moves due to noise.
    """
    views = (len(steps[-1]) - 3) // 3

    def remaining(parts: list[np.ndarray]) -> tuple[float, float]:
        last, before = (float(np.sqrt(np.mean(part**2))) for part in (parts[-1], parts[-2]))
        ratio = min(last / before, 0.95) if before > 0 else 0.0
        return 1 - ratio, last * ratio / (1 - ratio)

    sigma, shared = np.zeros(3), np.zeros(3)
    for k, axis in enumerate(own):
        _, rest = remaining([step[: 3 * views].reshape(views, 3)[:, axis] for step in steps])
        sigma[axis] = math.hypot(math.sqrt(variances[k]), rest)
    if common:
        inverse = np.linalg.pinv(fit.common)
        scatter = (fit.gradients - fit.gradients.mean(0)).T @ (fit.gradients - fit.gradients.mean(0))
        covariance = inverse @ scatter @ inverse
        for k, axis in enumerate(common):
            share, rest = remaining([step[3 * views + axis : 3 * views + axis + 1] for step in steps])
            shared[axis] = math.hypot(math.sqrt(covariance[k, k]) / share, rest)
    return sigma, shared
