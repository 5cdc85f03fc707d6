"""Where the detector stood in each view: shifts, turns, the axis and its tilt, as unknowns of the fit.

Moves of views. Rounds alternate between volume and moves. A few iterations of pcg explain the projections with the geometry of
the last round. Then the moves change by a Gauss-Newton step on the residual, whose derivatives are differences of the predicted
views along rows and columns. The volume continues from round to round. Its adaption to wrong views slows the rounds: an error
of the geometry shrinks by a factor ``1 - c`` a round, where c is the share of the curvature that remains after the volume has
adapted.

Axis and tilt. A volume adapts to a wrong tilt almost wholly where the detector cuts the object off, so the residual of its own
views says little. Every fourth view is therefore predicted by a volume of the others, begun anew. The derivatives are
differences of such predictions, so they include the adaption of the volume. Each predicted view pulls at the axis and the tilt.
For the axis alone, the last round predicts each view once: a quarter of the views is off by what its volume has wrong.
The variance has two parts: the scatter of these pulls (White 1980), and the noise of the volume, which pulls at all predicted
views at once and is found by ``REPEATS`` volumes of views with more noise.

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
from mivol.tomography.rotation_axis import SAMPLING_ERROR

UNKNOWNS = ("shift", "axis", "tilt")
"""Names of unknowns: shift and turn of each view; the axis along the columns; its tilts along the light and across it."""

SMOOTHING = 2.0
"""Standard deviation [pixel] of the smoothing: twice a usual shift."""

ROUNDS, ITERATIONS = 12, 6
"""Rounds, and iterations of pcg in each: shifts of one pixel are then known to .03 (measured for heads and blocks)."""

MOST_COLUMNS = 192
"""Columns above which pixels are averaged over blocks."""

LARGEST_STEP = 2.0
"""Largest move of a view in a round [pixel]."""

JUDGES = 8
"""Fewest views that judge."""

COMMON_ROUNDS, FOLD = 3, 4
"""Last rounds, in which axis and tilt move; every ``FOLD``-th view is predicted by the others."""

SETTLED = 3 * ITERATIONS
"""Iterations of a prediction: after a third of them, volumes of ellipsoids pull the tilt by several standard deviations."""

REPEATS = 2
"""Volumes of views with more noise."""

COMMON_STEPS, LARGEST_COMMON = np.array([0.25, 4e-3, 4e-3]), np.array([2.0, 0.05, 0.05])
"""Half the difference for a derivative, and the largest step: axis [pixel], tilts along the light and across it [rad]."""

CLEAR, LEAST_GAIN, TINY = 4.0, 0.1, 1e-30
"""Standard errors, and logarithm of the ratio, by which the squared residual of held-out views must fall beyond what their own
moves explain of noise. Residuals below the last number count as it."""

MOST_BY_CHANCE = 0.9
"""Largest share of noise that the moves of a view are said to explain."""


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
    this prediction judges the result. A geometry is used if it lowers this residual by a tenth, and by ``CLEAR`` standard
    errors more than own moves lower the residual by chance, by explaining a part of the noise.

    Args:
        beam: the nominal geometry.
        grid: voxels of the reconstruction.
        y: line integrals (views, rows, cols).
        weights: inverse variances.
        refine: some of ``UNKNOWNS``. Detectors of fewer than 8 rows have moves along the columns only, and no tilt.
        held_out: indices of views that judge; if fewer than ``JUDGES``, every tenth view judges too, or more to reach eight.
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
    judges = held_out if len(held_out) >= JUDGES else np.union1d(held_out, np.arange(step // 2, len(y), step)).astype(int)
    state, normal = _State(np.zeros((len(y), 3)), np.zeros(3)), np.empty(0)
    x, predicted, slopes = None, smooth, None
    steps: list[np.ndarray] = []
    common_sigma = np.zeros(3)
    for k in range(rounds):
        if own:
            x, predicted = _predict(state.beam(small), coarse, smooth, mask, judges, x)
            moves, normal = _move_views(predicted, smooth - predicted, mask, small.angles, own)
            state = replace(state, moves=state.moves + moves)
            steps.append(moves)
        if common and k >= rounds - COMMON_ROUNDS:
            is_last = k == rounds - 1
            state, slopes, common_sigma = _move_axis(
                state, small, coarse, smooth, mask, common, slopes if is_last else None, is_last
            )
    before, after = (
        _misfit(at.beam(small), coarse, smooth, mask, judges) for at in (_State(0 * state.moves, 0 * state.common), state)
    )
    better = np.log(np.maximum(before, TINY) / np.maximum(after, TINY))
    sigma, by_chance = np.zeros(3), np.zeros(len(y))
    if own:
        spread, by_chance = _moves_spread(_slopes(predicted)[..., own], mask, normal)
    clear = CLEAR * better.std(ddof=1) / math.sqrt(len(better)) - np.log1p(-by_chance[judges]).mean()
    is_needed = better.mean() > max(clear, LEAST_GAIN)
    if own:
        sigma[own] = _deviations(float(after.mean()) * spread, np.array(steps)[..., own])
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


def _smooth_variance(shape: tuple[int, int, int]) -> float:
    """Variance of smoothed noise (views, rows, cols) over that before."""
    point = np.zeros((1, *shape[1:]))
    point[0, shape[1] // 2, shape[2] // 2] = 1.0
    return float((_smooth(point) ** 2).sum())


def _predict(
    beam: ParallelBeam | ConeBeam,
    grid: VoxelGrid,
    y: np.ndarray,
    mask: np.ndarray,
    judges: np.ndarray,
    start: np.ndarray | None,
    iterations: int = ITERATIONS,
) -> tuple[np.ndarray, np.ndarray]:
    """A volume of the views that do not judge, and its projections (views, rows, cols)."""
    a = Projector(beam, grid)
    kept = np.setdiff1d(np.arange(len(y)), judges)
    part = a.subset(kept)
    if start is None:
        start = _filtered(part, y[kept])
    problem = LeastSquares(part, y[kept], mask[kept], start, nonnegative=True)
    state = last_state(projected_cg(problem), iterations)
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
    _, predicted = _predict(beam, grid, y, mask, judges, None, SETTLED)
    squares = mask[judges] * (y - predicted)[judges] ** 2
    return squares.sum((1, 2)) / np.maximum(mask[judges].sum((1, 2)), 1.0)


def _slopes(predicted: np.ndarray) -> np.ndarray:
    """Derivatives (views, rows, cols, 3) of the readings by the moves (rows, columns, turn)."""
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in predicted.shape[1:])
    along_v = np.gradient(predicted, axis=1) if len(rows) > 1 else np.zeros_like(predicted)
    along_u = np.gradient(predicted, axis=2)
    return np.stack([along_v, along_u, along_v * columns - along_u * rows[:, None]], -1)


def _move_views(
    predicted: np.ndarray, residual: np.ndarray, mask: np.ndarray, angles: np.ndarray, own: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """A Gauss-Newton step (views, 3) of the moves ``own``, and its normal equations (views, own moves, own moves)."""
    j, moves = _slopes(predicted)[..., own], np.zeros((len(residual), 3))
    normal = np.einsum("vrci,vrc,vrcj->vij", j, mask, j)
    # A view without slopes stays where it is.
    normal += 1e-6 * np.trace(normal, axis1=1, axis2=2).mean() * np.eye(len(own)) / len(own) + 1e-30 * np.eye(len(own))
    pull = np.einsum("vrci,vrc,vrc->vi", j, mask, residual)
    moves[:, own] = np.clip(np.linalg.solve(normal, pull[..., None])[..., 0], -LARGEST_STEP, LARGEST_STEP)
    return _fix_gauge(moves, angles), normal


def _move_axis(
    state: _State,
    beam: ParallelBeam | ConeBeam,
    grid: VoxelGrid,
    y: np.ndarray,
    mask: np.ndarray,
    common: list[int],
    slopes: np.ndarray | None,
    is_last: bool,
) -> tuple[_State, np.ndarray, np.ndarray]:
    """The state after a step of axis and tilt on every fourth view, predicted by the others.

    The last step of the axis alone is of all views. With a tilt, all views gave deviations too small: -0.037 +- 0.009 degrees.

    ``slopes`` of the first set of predicted views are those of an earlier round, or None: find them. Returned after the state:
    these slopes (views, rows, cols, common), and the standard deviations (3,), 0 for what is known.
    """

    def predict(judges: np.ndarray, common: np.ndarray, iterations: int, noise: np.ndarray | float = 0.0) -> np.ndarray:
        at = replace(state, common=common)
        return _predict(at.beam(beam), grid, y + noise, mask, judges, None, iterations)[1][judges]

    def find_slopes(judges: np.ndarray) -> np.ndarray:
        moved = [COMMON_STEPS * (np.arange(3) == k) for k in common]
        ends = [[predict(judges, state.common + sign * h, ITERATIONS) for sign in (1, -1)] for h in moved]
        return np.stack([(up - down) / (2 * h.sum()) for (up, down), h in zip(ends, moved, strict=True)], -1)

    judges = np.arange(FOLD // 2, len(y), FOLD)
    slopes = find_slopes(judges) if slopes is None else slopes
    predicted, seen = predict(judges, state.common, SETTLED), mask[judges]
    normal, pull = _pull_views(slopes, seen, y[judges] - predicted)
    inverse = _invert(normal)
    step, by_volume = inverse @ pull.sum(0), np.zeros((REPEATS, len(common)))
    first_step = step
    if is_last:
        rng, variance = np.random.default_rng(0), _noise_variance(y[judges] - predicted, seen)
        for k in range(REPEATS):
            noise = math.sqrt(variance) * _smooth(rng.standard_normal(y.shape))
            change = predict(judges, state.common, SETTLED, noise) - predicted
            by_volume[k] = inverse @ _pull_views(slopes, seen, change)[1].sum(0)
        for first in set(range(FOLD)) - {FOLD // 2} if common == [0] else ():
            judges = np.arange(first, len(y), FOLD)
            residual = y[judges] - predict(judges, state.common, SETTLED)
            more = _pull_views(find_slopes(judges), mask[judges], residual)
            normal, pull = (np.concatenate(both) for both in zip((normal, pull), more, strict=True))
        inverse = _invert(normal)
        step = inverse @ pull.sum(0)
    rest = pull - normal @ step
    covariance = inverse @ (rest.T @ rest) @ inverse + by_volume.T @ by_volume / REPEATS
    moved_by, sigma = np.zeros(3), np.zeros(3)
    moved_by[common] = np.clip(step, -LARGEST_COMMON[common], LARGEST_COMMON[common])
    # The views of all rounds have found their least residual if they ask for no further step.
    sigma[common] = np.hypot(np.sqrt(np.diag(covariance)), first_step)
    if common[0] == 0:
        sigma[0] = math.hypot(sigma[0], SAMPLING_ERROR)
    return replace(state, common=state.common + moved_by), slopes, sigma


def _pull_views(slopes: np.ndarray, mask: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations (views, unknowns, unknowns) and pulls (views, unknowns) of each view."""
    return np.einsum("vrci,vrc,vrcj->vij", slopes, mask, slopes), np.einsum("vrci,vrc,vrc->vi", slopes, mask, residual)


def _invert(normal: np.ndarray) -> np.ndarray:
    """Inverse of the sum of the views' normal equations."""
    return np.linalg.pinv(normal.sum(0), rcond=1e-9)


def _noise_variance(residual: np.ndarray, mask: np.ndarray) -> float:
    """Variance of readings before smoothing, by the residual of smooth predicted views (views, rows, cols)."""
    return float((mask * residual**2).sum() / mask.sum() / _smooth_variance(residual.shape))


def _fix_gauge(moves: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Moves, without the part equivalent to a displaced object."""
    object_moves = np.stack([np.cos(angles), np.sin(angles)], 1)
    fixed = moves.copy()
    fixed[:, 1] -= object_moves @ np.linalg.lstsq(object_moves, moves[:, 1], rcond=None)[0]
    fixed[:, 0] -= moves[:, 0].mean()
    return fixed


def _moves_spread(slopes: np.ndarray, mask: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variances (own moves,) of a typical view (median) over the variance of its smooth readings; and the share (views,) of the
    squares of smooth noise that moves explain, ``tr(N^-1 J^T G G^T J)`` over the trace of ``G G^T``.

    Args:
        slopes: J, derivatives of the readings by the moves (views, rows, cols, own moves).
        mask: (views, rows, cols), 1 where readings count.
        normal: N (views, own moves, own moves).
    """
    smooth = np.stack([_smooth(mask * part) for part in np.moveaxis(slopes, -1, 0)], -1)
    inverse = np.linalg.inv(normal)
    pulls = inverse @ np.einsum("vrci,vrcj->vij", smooth, smooth) / _smooth_variance(mask.shape)
    shares = np.trace(pulls, axis1=1, axis2=2) / np.maximum(mask.sum((1, 2)), 1.0)
    return np.median(np.diagonal(pulls @ inverse, axis1=1, axis2=2), axis=0), np.minimum(shares, MOST_BY_CHANCE)


def _deviations(variances: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Standard deviations of the moves (own moves,), from their variances by noise and the steps (rounds, views, own moves).

    Of the curvature of a fixed volume, the share ``c`` = 1 - (last step over the step before) remains. The rounds that were
    not taken would add ``step (1 - c) / c``.
    """
    before, last = np.sqrt(np.mean(steps[-2:] ** 2, axis=1))
    ratio = np.minimum(np.divide(last, before, out=np.zeros_like(last), where=before > 0), 0.95)
    return np.hypot(np.sqrt(variances), last * ratio / (1 - ratio))
