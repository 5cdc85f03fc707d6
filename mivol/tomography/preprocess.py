"""From a detector's readings to line integrals: flat and dark fields, noise, logarithm, and where the rotation axis is.

Conventions. Readings, flats (light, no object) and darks (no light) are in one unit (counts or volts); transmission
``T = (reading - dark) / (flat - dark)`` has no unit, line integrals are ``y = -log T``. Arrays are (views, rows, cols);
columns are counted from 0 at pixel centres, so the middle of a detector of C columns is (C - 1) / 2.

References: delta method for the variance of a ratio (any textbook); Helgason 1965 and Ludwig 1966 (moments of a
sinogram); Vo et al. 2014 (why the mirrored views hold the axis); Donath, Beckmann & Schreyer 2006 (axis from trial
reconstructions).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, optimize

from mivol.errors import MivolError
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector


@dataclass(frozen=True, eq=False)
class Transmission:
    """Transmission and its variance, both (views, rows, cols) float64; not finite where a reading was not."""

    value: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class Axis:
    """Where the rotation axis falls on the detector.

    Args:
        column: in pixels, counted from 0 at the first column's centre.
        uncertainty: one standard deviation [pixels].
        method: how it was found.
    """

    column: float
    uncertainty: float
    method: str

    def offset(self, n_columns: int, pitch: float = 1.0) -> float:
        """The ``axis_offset`` of a :class:`~mivol.tomography.geometry.ParallelBeam` with that many columns [length]."""
        return (self.column - (n_columns - 1) / 2) * pitch


# -- Readings to line integrals -----------------------------------------------------------------------------------------


def correct_transmission(readings: np.ndarray, flats: np.ndarray, darks: np.ndarray) -> Transmission:
    """Transmission from readings, and its variance from the spread of the flats and darks.

    The detector's noise is taken as ``var(reading) = var_dark + gain (reading - dark)``: read noise, and shot noise whose
    ``gain`` (variance per unit of signal) follows from the flats, pooled over all pixels. To first order

    ``var T = (var(reading) + T^2 var(flat) / n_flats + (1 - T)^2 var(dark) / n_darks) / (flat - dark)^2``.

    Args:
        readings: (views, rows, cols).
        flats: (n_flats, rows, cols), at least 2.
        darks: (n_darks, rows, cols), at least 2.

    Raises: MivolError: shapes that do not fit, too few fields, or a pixel whose mean flat is not above its mean dark.
    """
    readings, flats, darks = (np.asarray(a, np.float64) for a in (readings, flats, darks))
    if readings.ndim != 3 or not readings.shape[1:] == flats.shape[1:] == darks.shape[1:]:
        raise MivolError(
            f"Found readings {readings.shape}, flats {flats.shape} and darks {darks.shape}, "
            "expected three stacks (n, rows, cols) of one detector."
        )
    if len(flats) < 2 or len(darks) < 2:
        raise MivolError(
            f"Found {len(flats)} flats and {len(darks)} darks, expected at least 2 of each: their spread is the noise."
        )
    dark, light = darks.mean(0), flats.mean(0) - darks.mean(0)
    if not (light > 0).all():
        pixel = np.unravel_index(int(np.argmin(np.where(np.isfinite(light), light, -np.inf))), light.shape)
        raise MivolError(f"Found no light at detector pixel {tuple(map(int, pixel))}, expected flats above darks everywhere.")
    dark_variance = darks.var(0, ddof=1).mean()
    gain = max(flats.var(0, ddof=1).mean() - dark_variance, 0.0) / light.mean()
    signal = readings - dark
    t = signal / light
    reading_variance = dark_variance + gain * np.maximum(signal, 0.0)
    flat_variance = dark_variance + gain * light
    variance = reading_variance + t**2 * flat_variance / len(flats) + (1 - t) ** 2 * dark_variance / len(darks)
    return Transmission(t, variance / light**2)


def normalise_air(transmission: Transmission, n_columns: int) -> Transmission:
    """Divide each row of each view by the straight line through its air at both edges of the detector.

    Undoes a beam that drifts between the flats and the views. Where the object reaches into these columns it would be
    divided away: that is the caller's to know.

    Args:
        transmission: of a scan whose first and last ``n_columns`` columns see no object.
        n_columns: at least 2, at most half of the columns.
    """
    value, columns = transmission.value, transmission.value.shape[2]
    if not 2 <= n_columns <= columns // 2:
        raise MivolError(f"Found {n_columns} air columns, expected 2 to {columns // 2} of {columns}.")
    left, right = value[..., :n_columns].mean(-1), value[..., -n_columns:].mean(-1)
    middle = (n_columns - 1) / 2
    f = (np.arange(columns) - middle) / (columns - 1 - 2 * middle)
    air = left[..., None] * (1 - f) + right[..., None] * f
    return replace(transmission, value=value / air, variance=transmission.variance / air**2)


def line_integrals(transmission: Transmission, n_sigma: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """``y = -log T`` and the weights ``1 / var y = T^2 / var T`` (delta method).

    A pixel whose transmission is below ``n_sigma`` standard deviations (no light came through), or is not finite, gets
    y = 0 and weight 0. A pixel brighter than the light keeps its negative y: clipping it would bias the air.

    Args:
        transmission: with its variance.
        n_sigma: below how many standard deviations light is noise. The log's bias, ``var T / (2 T^2)``, is then at most
            ``1 / (2 n_sigma^2)``.

    Returns:
        (y, weights), each (views, rows, cols) float64.
    """
    t, variance = transmission.value, transmission.variance
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(t) & np.isfinite(variance) & (variance > 0) & (t > n_sigma * np.sqrt(variance))
    safe = np.where(seen, t, 1.0)
    return np.where(seen, -np.log(safe), 0.0), np.where(seen, safe**2 / np.where(seen, variance, 1.0), 0.0)


# -- Drift of the light ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LightDrift:
    """How the pattern of the light moved away from the flats: line integrals ``offset + slope time`` of each pixel.

    Flats taken before a scan are out of date at its end: the beam's stripes have moved, and each pixel of every view
    is too dark or too bright by a factor that changes slowly (stripes in the sinogram, rings in the slice).
    """

    offset: np.ndarray
    slope: np.ndarray

    def eval(self, times: np.ndarray) -> np.ndarray:
        """(views, rows, cols) to add to the line integrals of the object."""
        return self.offset + np.asarray(times)[:, None, None] * self.slope


def fit_light_drift(residual: np.ndarray, weights: np.ndarray, times: np.ndarray) -> LightDrift:
    """Fit each pixel's offset and slope to what the object does not explain, by weighted least squares.

    In turns with a few iterations of a solver on ``y - drift`` this is block descent on the joint weighted least
    squares of object and drift.

    Args:
        residual: (views, rows, cols), ``y - A x``.
        weights: inverse variances; a pixel with fewer than two weighted views gets no drift.
        times: (views,) when each was taken, in any unit, best about 0.
    """
    t = np.asarray(times, float)[:, None, None]
    w0, w1, w2 = weights.sum(0), (weights * t).sum(0), (weights * t * t).sum(0)
    r0, r1 = (weights * residual).sum(0), (weights * residual * t).sum(0)
    det = w0 * w2 - w1 * w1
    # Equal times leave det at the rounding of its terms: no slope can be told then.
    known = det > 1e-9 * w0 * w2
    det = np.where(known, det, 1.0)
    offset, slope = (w2 * r0 - w1 * r1) / det, (w0 * r1 - w1 * r0) / det
    return LightDrift(np.where(known, offset, 0.0), np.where(known, slope, 0.0))


# -- Rotation axis --------------------------------------------------------------------------------------------------------


def axis_from_mirrors(y: np.ndarray, angles: np.ndarray, n_pairs: int = 12) -> Axis:
    """Find the axis from views half a turn apart, which are mirror images of one another about it.

    Each of the ``n_pairs`` pairs nearest to half a turn gives the column about which one is the best mirror of the other
    (least squares, cubic interpolation). A pair that misses half a turn by ``e`` is off by about ``slope e``; a straight
    line through the columns of all pairs is read at ``e = 0``.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
        n_pairs: how many pairs to use at most.

    Raises: MivolError: no two views are within 5 degrees of half a turn, or one of them shows nothing.
    """
    first, second, miss = _opposite_pairs(np.asarray(angles, float), n_pairs)
    used = np.union1d(first, second)
    flat = used[np.ptp(y[used], axis=-1).max(axis=-1) <= 0]
    if len(flat):
        raise MivolError(f"Found view {flat[0]} without contrast, expected an object in every view.")
    columns = np.array([_mirror_column(y[i], y[j]) for i, j in zip(first, second, strict=True)])
    uneven = np.ptp(miss) > 1e-9
    design = np.stack([np.ones_like(miss), miss], 1) if uneven else np.ones((len(miss), 1))
    column, sigma = _fit_constant(design, columns)
    return Axis(column, sigma, f"mirror images, {len(miss)} pairs of views")


def axis_from_moments(y: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the axis from the shadow's centre of mass, which follows ``c + a cos(theta) + b sin(theta)`` (Ludwig).

    Needs the whole object in every view and air at 0: a constant error of the air pulls the centre of mass towards the
    middle of the detector.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam.
        angles: (views,) [rad].
    """
    mass = y.sum(-1)
    if not (mass > 0).all():
        raise MivolError("Found a row of a view with no absorption in it, expected an object in every row and view.")
    centres = (y @ np.arange(y.shape[-1])) / mass
    design = np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], 1)
    rows = [_fit_constant(design, centres[:, row]) for row in range(y.shape[1])]
    column = float(np.mean([c for c, _ in rows]))
    return Axis(column, float(np.sqrt(np.mean([s**2 for _, s in rows]) / len(rows))), "moments of the shadows")


def axis_from_reconstructions(y: np.ndarray, weights: np.ndarray, angles: np.ndarray, start: float, width: float = 2.0) -> Axis:
    """Refine the axis: the column with which one half of the views predicts the other half best.

    Filtered back-projection from every other view, forward projection to the views between, weighted mean squared
    residual; a parabola fitted to five trial columns, then once more on a fourth of the width. Done twice, the halves
    changing roles: the estimate is their mean. Its standard deviation is that of the parabola's curvature (the residual
    taken as noise), or half of the two estimates' difference where that is larger.

    Args:
        y: (views, rows, cols) line integrals of a parallel beam; the middle row or two are used.
        weights: inverse variances of ``y``.
        angles: (views,) [rad], evenly over half a turn or a whole one.
        start: column to search around.
        width: half width of the search [pixels].

    Raises: MivolError: the misfit has no minimum within the search.
    Cost: for each of the 20 trials one A and two A^T over half of the views, at the detector's resolution.
    """
    middle = slice((y.shape[1] - 1) // 2, y.shape[1] // 2 + 1)
    y, weights = y[:, middle], weights[:, middle]
    halves = (slice(0, None, 2), slice(1, None, 2))
    found = []
    for known, asked in (halves, halves[::-1]):

        def misfit(column: float, known: slice = known, asked: slice = asked) -> float:
            return _held_out_misfit(y, weights, angles, column, known, asked)

        n = int((weights[asked] > 0).sum())
        coarse, _ = _parabola_minimum(misfit, start, width, n)
        found.append(_parabola_minimum(misfit, coarse, width / 4, n))
    (a, sigma_a), (b, sigma_b) = found
    sigma = max(abs(a - b) / 2, float(np.hypot(sigma_a, sigma_b)) / 2)
    return Axis((a + b) / 2, sigma, "one half of the views predicted from the other")


def find_axis(y: np.ndarray, weights: np.ndarray, angles: np.ndarray) -> Axis:
    """Find the rotation axis of a parallel-beam scan: by mirror images (else by moments), refined by reconstructions.

    The refined column counts; its uncertainty is at least half of its distance from the rough one, since pixels of
    finite width and light that drifts move both by more than noise does.

    Args:
        y: (views, rows, cols) line integrals.
        weights: inverse variances of ``y``.
        angles: (views,) [rad].
    """
    try:
        rough = axis_from_mirrors(y, angles)
    except MivolError:
        rough = axis_from_moments(y, angles)
    fine = axis_from_reconstructions(y, weights, angles, rough.column)
    return replace(fine, uncertainty=max(fine.uncertainty, abs(fine.column - rough.column) / 2))


def _opposite_pairs(angles: np.ndarray, n_pairs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(first, second, angle beyond half a turn), the best pairs first."""
    i, j = np.triu_indices(len(angles), 1)
    miss = np.mod(angles[j] - angles[i], 2 * np.pi) - np.pi
    best = np.argsort(np.abs(miss), kind="stable")[:n_pairs]
    best = best[np.abs(miss[best]) < np.radians(5)]
    if len(best) == 0:
        raise MivolError("Found no two views half a turn apart (to 5 degrees), expected some: use axis_from_moments.")
    return i[best], j[best], miss[best]


def _mirror_column(a: np.ndarray, b: np.ndarray) -> float:
    """Column c for which ``a(s) = b(2 c - s)`` at best; ``a`` and ``b`` are (rows, cols)."""
    n = a.shape[-1]
    # sum_s a(s) b(k - s), k = 2 c, is a convolution: its peak is the best whole k.
    size = 2 * n
    k0 = int(np.fft.irfft((np.fft.rfft(a, size) * np.fft.rfft(b, size)).sum(0), size).argmax())
    s = np.arange(n, dtype=float)
    spline = ndimage.spline_filter1d(b, axis=-1, mode="nearest")

    def misfit(c: float) -> float:
        mirrored = [ndimage.map_coordinates(row, [2 * c - s], mode="nearest", prefilter=False) for row in spline]
        return float(np.sum((a - np.array(mirrored)) ** 2))

    return float(optimize.minimize_scalar(misfit, bounds=(k0 / 2 - 1, k0 / 2 + 1), method="bounded").x)


def _fit_constant(design: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """(first coefficient, its standard deviation) of a least-squares fit."""
    coefficients, *_ = np.linalg.lstsq(design, values, rcond=None)
    freedom = max(len(values) - design.shape[1], 1)
    scatter = np.sum((values - design @ coefficients) ** 2) / freedom
    return float(coefficients[0]), float(np.sqrt(scatter * np.linalg.pinv(design.T @ design)[0, 0]))


def _held_out_misfit(
    y: np.ndarray, weights: np.ndarray, angles: np.ndarray, column: float, known: slice, asked: slice
) -> float:
    rows, cols = y.shape[1:]
    n = 2 * _reach(y, column) + 1
    grid, offset = VoxelGrid((rows, n, n)), Axis(column, 0.0, "trial").offset(cols)
    seen, hidden = (Projector(ParallelBeam(angles[part], (rows, cols), axis_offset=offset), grid) for part in (known, asked))
    predicted = hidden @ filtered_backprojection(seen, y[known])
    w, target = weights[asked], y[asked]
    # Filtered back-projection of few views loses a little of its scale: one factor is fitted.
    scale = np.sum(w * predicted * target) / np.sum(w * predicted**2)
    return float(np.sum(w * (target - scale * predicted) ** 2) / np.sum(w > 0))


def _reach(y: np.ndarray, column: float) -> int:
    """Pixels from the axis to the outermost one that ever sees a tenth of the densest ray, and a tenth more."""
    seen = np.flatnonzero((y > 0.1 * y.max()).any(axis=(0, 1)))
    return int(np.ceil(1.1 * np.abs(seen - column).max()))


def _parabola_minimum(f: Callable[[float], float], centre: float, width: float, n: int) -> tuple[float, float]:
    """(abscissa, standard deviation) of the least of a parabola fitted to a mean of ``n`` weighted squares."""
    offsets = np.linspace(-1.0, 1.0, 5)
    a, b, c = map(float, np.polyfit(offsets, [f(centre + width * o) for o in offsets], 2))
    if a <= 0 or abs(b) > 2 * a:
        raise MivolError(
            f"Found no least misfit between columns {centre - width:.1f} and {centre + width:.1f}, expected one: start "
            "nearer, or search wider."
        )
    # n a (offset / sigma)^2 rises by the residual's own mean square at one standard deviation.
    return centre - width * b / (2 * a), width * float(np.sqrt((c - b * b / (4 * a)) / (n * a)))
