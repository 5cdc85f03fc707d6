"""From a detector's readings to line integrals: flat and dark fields, noise, logarithm, and the drift of the light.

Conventions. Readings, flats (light, no object) and darks (no light) share a unit (counts or volts). Transmission ``T =
(reading - dark) / (flat - dark)`` has no unit; line integrals are ``y = -log T``. Arrays are (views, rows, cols).

References: delta method for the variance of a ratio (textbooks).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from mivol.errors import MivolError


@dataclass(frozen=True, eq=False)
class Transmission:
    """Transmission and its variance, both (views, rows, cols) float64; not finite for readings that are not finite.

    Without ``is_noise_known``, only ratios of variances are known. ``notes`` say what the flats and darks do not tell.
    """

    value: np.ndarray
    variance: np.ndarray
    is_noise_known: bool = True
    notes: tuple[str, ...] = ()


# -- Readings to line integrals -----------------------------------------------------------------------------------------

UNKNOWN_NOISE = 1e-4
"""Variance of a transmission of 1 for unmeasured noise: the variance of 1e4 quanta."""


def assume_quantum_noise(transmission: np.ndarray) -> Transmission:
    """Give a transmission of unknown noise the variance of quanta, ``var T ~ T``.

    The size of the noise, ``UNKNOWN_NOISE``, matters only to a solver with a prior.
    """
    t = np.asarray(transmission, np.float64)
    return Transmission(t, np.maximum(t, 0.0) * UNKNOWN_NOISE, is_noise_known=False)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of a detector by flats and darks: ``var(reading) = dark_variance + gain (reading - dark)``.

    Attributes:
        dark, light: (rows, cols) mean reading without light, and the reading added by light; ``light`` is NaN at a dead pixel.
        dark_variance: variance of a reading without light, pooled over all pixels; 0 for a single dark.
        gain: reading per quantum, from the additional scatter of the flats, pooled over all pixels; NaN without scatter.
        n_flats, n_darks: numbers of flats and darks.
        saturation: smallest saturated reading.
        notes: what the flats and darks do not tell.
    """

    dark: np.ndarray
    light: np.ndarray
    dark_variance: float
    gain: float
    n_flats: int
    n_darks: int
    saturation: float
    notes: tuple[str, ...]

    def signal(self, readings: np.ndarray) -> np.ndarray:
        """Readings minus the dark reading; NaN at dead or saturated pixels."""
        lost = (readings >= self.saturation) | np.isnan(self.light)
        return np.where(lost, np.nan, readings - self.dark)


FULL_SCALES, FULL_SHARE = tuple(float(2**bits - 1) for bits in (8, 10, 12, 14, 16)), 0.01
"""Largest numbers of a detector's bits, and the share of flats at that number above which they seem saturated."""


def calibrate(readings: np.ndarray, flats: np.ndarray, darks: np.ndarray, saturation: float = np.inf) -> Calibration:
    """Calibrate a detector by flats and darks. A pixel is dead if its flats are saturated or not above its darks.

    Args:
        readings: (views, rows, cols); only the shape is used.
        flats: (n_flats, rows, cols), at least 1. The scatter of 2 or more gives the noise; copies of one flat count as one.
        darks: (n_darks, rows, cols), at least 1. Without the scatter of 2 or more, the flats' scatter is all of quanta.
        saturation: smallest saturated reading.

    Raises:
        MivolError: shapes that do not fit, no flat or dark, or at least half of the pixels dead.
    """
    if readings.ndim != 3 or not readings.shape[1:] == flats.shape[1:] == darks.shape[1:]:
        raise MivolError(
            f"Found readings {readings.shape}, flats {flats.shape} and darks {darks.shape}, "
            "expected three stacks (n, rows, cols) of one detector."
        )
    if not len(flats) or not len(darks):
        raise MivolError(f"Found {len(flats)} flats and {len(darks)} darks, expected at least 1 of each.")
    dark, light = darks.mean(0), flats.mean(0) - darks.mean(0)
    alive = (light > 0) & (flats < saturation).all(0)
    if 2 * alive.sum() <= alive.size:
        pixel = tuple(map(int, np.argwhere(~alive)[0]))
        raise MivolError(
            f"Found no light, or too much, at detector pixel {pixel} and at half of all pixels or more, "
            "expected flats above darks."
        )
    dark_variance = float(darks.var(0, ddof=1)[alive].mean()) if len(darks) > 1 else 0.0
    gain, notes = np.nan, ()
    if (np.ptp(flats, axis=0)[alive] == 0).all():
        found = "one flat tells" if len(flats) == 1 else f"the {len(flats)} flats are copies of one image, which tell"
        notes = (f"the noise is unknown, because {found} no scatter; photon noise is assumed, and the fit finds its size",)
    else:
        gain = max(float(flats.var(0, ddof=1)[alive].mean()) - dark_variance, 0.0) / float(light[alive].mean())
        if len(darks) == 1 and darks.any():
            notes = ("one dark: its noise is unknown, and the scatter of the flats counts as noise of quanta",)
    full = float(flats.max())
    share = float(np.mean(flats == full))
    if full in FULL_SCALES and share > FULL_SHARE:
        notes += (
            f"{share:.0%} of the flats' pixels are {full:g}, the largest number of their bits: the flats seem saturated, "
            f"data.saturation = {full:g} leaves such pixels out",
        )
    return Calibration(dark, np.where(alive, light, np.nan), dark_variance, gain, len(flats), len(darks), saturation, notes)


def correct_transmission(
    readings: np.ndarray, flats: np.ndarray, darks: np.ndarray, saturation: float = np.inf
) -> Transmission:
    """Compute transmission from readings, with a variance from the spread of flats and darks.

    The noise model is :class:`Calibration`. To first order

    ``var T = (var(reading) + T^2 var(flat) / n_flats + (1 - T)^2 var(dark) / n_darks) / (flat - dark)^2``.

    Dead and saturated pixels are NaN. If the flats have no scatter, the noise is that of :func:`assume_quantum_noise`.

    Args, raises: as :func:`calibrate`.
    """
    readings, flats, darks = (np.asarray(a, np.float64) for a in (readings, flats, darks))
    known = calibrate(readings, flats, darks, saturation)
    signal = known.signal(readings)
    t = signal / known.light
    if np.isnan(known.gain):
        return replace(assume_quantum_noise(t), notes=known.notes)
    reading_variance = known.dark_variance + known.gain * np.maximum(signal, 0.0)
    flat_variance = known.dark_variance + known.gain * known.light
    variance = reading_variance + t**2 * flat_variance / known.n_flats + (1 - t) ** 2 * known.dark_variance / known.n_darks
    return Transmission(t, variance / known.light**2, notes=known.notes)


@dataclass(frozen=True, eq=False)
class Quanta:
    """Numbers of quanta, ``counts ~ Poisson(blank exp(-y) + background)``, for solvers without a logarithm.

    Attributes:
        counts: (views, rows, cols); 0 at unused pixels.
        blank: quanta without an object, a number or shaped as ``counts``.
        background: expected additional quanta.
        used: (views, rows, cols); False at dead or saturated pixels.
    """

    counts: np.ndarray
    blank: np.ndarray | float
    background: float
    used: np.ndarray

    def select_views(self, views: np.ndarray) -> Quanta:
        """Select views."""
        blank = self.blank[views] if isinstance(self.blank, np.ndarray) else self.blank
        return Quanta(self.counts[views], blank, self.background, self.used[views])


def count_quanta(readings: np.ndarray, flats: np.ndarray, darks: np.ndarray, saturation: float = np.inf) -> Quanta:
    """Convert readings to quanta, ``(reading - dark) / gain``, with the read noise as a background of equal variance.

    Shifted by ``dark_variance / gain^2``, a Poisson number has the mean and the variance of the reading; a negative sum counts
    as 0. A pixel without light keeps its count, because no logarithm is taken.

    Args: as :func:`calibrate`.

    Raises:
        MivolError: as :func:`calibrate`, or flats that scatter no more than darks.

    Reference: Yavuz & Fessler 1998, Med. Image Anal. 2, 369 (shifted Poisson model of precorrected transmission scans).
    """
    readings, flats, darks = (np.asarray(a, np.float64) for a in (readings, flats, darks))
    known = calibrate(readings, flats, darks, saturation)
    if not known.gain > 0:
        raise MivolError("found flats that scatter no more than darks, expected quanta's noise: choose pcg.")
    shift = known.dark_variance / known.gain**2
    signal = known.signal(readings)
    used = np.isfinite(signal)
    counts = np.where(used, np.maximum(signal / known.gain + shift, 0.0), 0.0)
    blank = np.where(np.isnan(known.light), 1.0, known.light / known.gain)
    return Quanta(counts, np.broadcast_to(blank, counts.shape), shift, used)


def normalise_air(transmission: Transmission, n_columns: int) -> Transmission:
    """Divide each row of each view by the straight line through its air at both edges of the detector.

    This corrects a beam that drifts between flats and views. Precondition: the object does not reach into these columns, else
    its absorption is divided away.

    Args:
        transmission: transmission of a scan with air in its first and last ``n_columns`` columns.
        n_columns: at least 2, at most half of the columns.
    """
    value, columns = transmission.value, transmission.value.shape[2]
    if not 2 <= n_columns <= columns // 2:
        raise MivolError(f"Found {n_columns} air columns, expected 2 to {columns // 2} of {columns}.")
    air = fit_air(value, n_columns)
    if not transmission.is_noise_known:
        # Values of any scale, such as counts without flats, become transmissions here.
        return replace(assume_quantum_noise(value / air), notes=transmission.notes)
    return replace(transmission, value=value / air, variance=transmission.variance / air**2)


def fit_air(transmission: np.ndarray, n_columns: int) -> np.ndarray:
    """(views, rows, cols): the straight line of each row through the mean of the finite pixels in ``n_columns`` at both edges.

    Raises:
        MivolError: a row of a view without a finite pixel at an edge.
    """

    def mean(edge: np.ndarray) -> np.ndarray:
        seen = np.isfinite(edge)
        if not seen.any(-1).all():
            view, row = map(int, np.argwhere(~seen.any(-1))[0])
            raise MivolError(f"found no usable air pixel at an edge of row {row} of view {view}, expected one: widen data.air.")
        return np.where(seen, edge, 0.0).sum(-1) / seen.sum(-1)

    columns = transmission.shape[2]
    left, right = mean(transmission[..., :n_columns]), mean(transmission[..., -n_columns:])
    middle = (n_columns - 1) / 2
    f = (np.arange(columns) - middle) / (columns - 1 - 2 * middle)
    return left[..., None] * (1 - f) + right[..., None] * f


@dataclass(frozen=True, eq=False)
class Air:
    """Light of the air at both edges of the detector, over the light of the flats.

    Attributes:
        factor: (views,) mean over rows and columns; one number for all views if they differ by no more than noise.
        columns: columns at each edge.
        uncertainty: standard deviation of the mean factor.
        is_needed: whether the factor is believed, and differs from 1, or between views, by more than noise and a hundredth.
        is_believed: whether the mean factor is in ``AIR_RANGE``.
    """

    factor: np.ndarray
    columns: int
    uncertainty: float
    is_needed: bool
    is_believed: bool = True

    def normalise(self, transmission: Transmission) -> Transmission:
        """Divide each view by its factor."""
        factor = self.factor[:, None, None]
        return replace(transmission, value=transmission.value / factor, variance=transmission.variance / factor**2)


AIR_RANGE = 0.4, 1.25
"""Smallest and largest air that is believed: less is absorption, more is another scan's flat."""

AIR_TOLERANCE = 0.01
"""Errors of flats as a share of the light, which no view averages out: of the air between edges, columns and views."""


LIT_SHARE = 0.01
"""Smallest share of pixels with light in a view: of noise alone, .13 % exceed three standard deviations."""


def find_lost_views(transmission: Transmission) -> tuple[np.ndarray, np.ndarray]:
    """Find views that a camera or a shutter spoiled: without light, and brighter in every pixel than any view can be.

    Returns:
        (views,) whether a view has light in less than ``LIT_SHARE`` of its pixels, and whether its darkest pixels exceed the
        brightest of the other views by the factor of ``AIR_RANGE``. Up to 16 rows count.
    """
    rows = np.unique(np.linspace(0, transmission.value.shape[1] - 1, 16).astype(int))
    value, variance = transmission.value[:, rows], transmission.variance[:, rows]
    with np.errstate(invalid="ignore"):
        lit = value > 3 * np.sqrt(variance)
        is_dark = lit.mean((1, 2)) < LIT_SHARE
        low, high = np.percentile(np.where(np.isfinite(value), value, 0.0), (1, 99), axis=(1, 2))
    return is_dark, low > AIR_RANGE[1] * np.median(high)


def find_air(transmission: Transmission) -> Air | None:
    """Measure the air at both edges of the detector, such as of flats taken at another current.

    The outer columns count as air if they are as bright at both edges in each view, do not rise or fall towards the middle, and
    if the sum of the line integrals over the detector, which is the mass of the object, is the same in all views. An object
    that reaches beyond the detector fails at least one of the three, unless it is round and much wider than the detector, when
    ``AIR_RANGE`` keeps it from being believed.

    Returns:
        The air, or None if the edges are not air.
    """
    value = np.where(np.isfinite(transmission.value), transmission.value, np.nan)
    views, _, columns = value.shape
    width = max(4, columns // 20)
    if columns < 4 * width:
        return None
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        light = np.nanmean(value, axis=1)
        log = np.log(np.maximum(light, 1e-6))
        edges = log[:, :width], log[:, -width:]
        means = np.stack([np.nanmean(edge, axis=1) for edge in edges])
        # The scatter of a column over the views, less what the whole edge does, is noise.
        noise = np.sqrt(np.nanmean([np.nanvar(e - m[:, None], axis=0) for e, m in zip(edges, means, strict=True)]))
        profile = np.nanmean(log - means.mean(0)[:, None], axis=0)
        mass = -np.nansum(log - means.mean(0)[:, None], axis=1)
    air = means.mean()
    if not np.isfinite([air, noise, mass.sum()]).all():
        return None
    is_believed = bool(AIR_RANGE[0] < np.exp(air) < AIR_RANGE[1])
    at_edges = noise / np.sqrt(width)
    falls = [abs(np.nanmean(side[: width // 2]) - np.nanmean(side[width // 2 : width])) for side in (profile, profile[::-1])]
    between = np.std(means[0] - means[1])
    limit = 4 * noise / np.sqrt(views * width / 2) + AIR_TOLERANCE
    is_even = max(falls) < limit and abs(means[0].mean() - means[1].mean()) < 2 * limit
    is_alike = between < 2 * at_edges + AIR_TOLERANCE
    is_whole = np.std(mass) < 0.1 * np.mean(mass) + 4 * noise * np.sqrt(columns)
    if not (is_even and is_alike and is_whole):
        return None
    sides = [int(np.argmax(np.append(side < -limit, True))) for side in (profile, profile[::-1])]
    over_views = np.std(means.mean(0))
    drifts = over_views > 3 * at_edges / np.sqrt(2) + AIR_TOLERANCE / 2
    factor = np.exp(means.mean(0)) if drifts else np.full(views, np.exp(air))
    sigma = float(np.exp(air) * noise / np.sqrt(2 * views * width))
    is_needed = is_believed and (drifts or abs(air) > AIR_TOLERANCE + 5 * sigma)
    return Air(factor, min(*sides, columns // 8), sigma, bool(is_needed), is_believed)


def to_line_integrals(transmission: Transmission, n_sigma: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Compute ``y = -log T`` and the weights ``1 / var y = T^2 / var T`` (delta method).

    A pixel with a transmission below ``n_sigma`` standard deviations (no light), or not finite, gets y = 0 and weight 0. A
    pixel brighter than the light keeps its negative y: clipping would bias the air.

    Args:
        transmission: transmission with its variance.
        n_sigma: number of standard deviations below which light is noise. The bias of the log, ``var T / (2 T^2)``, is then at
            most ``1 / (2 n_sigma^2)``.

    Returns:
        (y, weights), each (views, rows, cols) float64.
    """
    t, variance = transmission.value, transmission.variance
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(t) & np.isfinite(variance) & (variance > 0) & (t > n_sigma * np.sqrt(variance))
    safe = np.where(seen, t, 1.0)
    return np.where(seen, -np.log(safe), 0.0), np.where(seen, safe**2 / np.where(seen, variance, 1.0), 0.0)


def subtract_scatter(y: np.ndarray, weights: np.ndarray, scatter: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals of the light that was not scattered, and their weights; both are 0 at pixels darker than the scatter.

    Args:
        y: line integrals (views, rows, cols).
        weights: inverse variances.
        scatter: scattered light over the light without object.
    """
    left = np.exp(-y) - scatter
    seen = (weights > 0) & (left > 0)
    safe = np.where(seen, left, 1.0)
    # Delta method: dy'/dy = exp(-y) / (exp(-y) - scatter).
    gain = np.exp(-y) / safe
    return np.where(seen, -np.log(safe), 0.0), np.where(seen, weights / gain**2, 0.0)


def interpolate_gaps(y: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate unused pixels (weight 0: dead, saturated, no light) linearly between their neighbours in the row.

    For methods without weights, such as filtered back-projection: a pixel of 0 would leave a streak through the object.

    Args:
        y, weights: (views, rows, cols).

    Returns:
        (views, rows, cols); a row without used pixels is 0.
    """
    used = weights > 0
    if used.all():
        return y
    bridged, columns = np.where(used, y, 0.0), np.arange(y.shape[-1])
    for view, row in np.argwhere(used.any(-1) & ~used.all(-1)):
        seen = used[view, row]
        bridged[view, row, ~seen] = np.interp(columns[~seen], columns[seen], y[view, row, seen])
    return bridged


# -- Drift of the light ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LightDrift:
    """Drift of the light's pattern away from the flats: line integrals ``offset + slope time`` of each pixel.

    Flats taken before a scan are outdated at the end: the beam's stripes have moved, and each pixel is too dark or too bright
    by a factor that changes slowly between views (stripes in the sinogram, rings in the slice).
    """

    offset: np.ndarray
    slope: np.ndarray

    def eval(self, times: np.ndarray) -> np.ndarray:
        """(views, rows, cols) to add to the line integrals of the object."""
        return self.offset + np.asarray(times)[:, None, None] * self.slope


def fit_light_drift(residual: np.ndarray, weights: np.ndarray, times: np.ndarray) -> LightDrift:
    """Fit each pixel's offset and slope to the residual of the object, by weighted least squares.

    Alternating with a few iterations of a solver on ``y - drift``, the fit is block descent on the joint weighted least
    squares of object and drift.

    Args:
        residual: (views, rows, cols), ``y - A x``.
        weights: inverse variances; a pixel with fewer than two weighted views gets no drift.
        times: (views,) time of each view, in an arbitrary unit, best centred about 0.
    """
    t = np.asarray(times, float)[:, None, None]
    w0, w1, w2 = weights.sum(0), (weights * t).sum(0), (weights * t * t).sum(0)
    r0, r1 = (weights * residual).sum(0), (weights * residual * t).sum(0)
    det = w0 * w2 - w1 * w1
    # For equal times det is rounding of its terms: the slope is undetermined.
    known = det > 1e-9 * w0 * w2
    det = np.where(known, det, 1.0)
    offset, slope = (w2 * r0 - w1 * r1) / det, (w0 * r1 - w1 * r0) / det
    return LightDrift(np.where(known, offset, 0.0), np.where(known, slope, 0.0))
