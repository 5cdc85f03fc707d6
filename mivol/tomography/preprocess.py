"""From a detector's readings to line integrals: flat and dark fields, noise, logarithm, and the drift of the light.

Conventions. Readings, flats (light, no object) and darks (no light) are in one unit (counts or volts); transmission
``T = (reading - dark) / (flat - dark)`` has no unit, line integrals are ``y = -log T``. Arrays are (views, rows, cols).

References: delta method for the variance of a ratio (any textbook).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mivol.errors import MivolError


@dataclass(frozen=True, eq=False)
class Transmission:
    """Transmission and its variance, both (views, rows, cols) float64; not finite where a reading was not."""

    value: np.ndarray
    variance: np.ndarray


# -- Readings to line integrals -----------------------------------------------------------------------------------------

UNKNOWN_NOISE = 1e-4
"""Variance of a transmission of 1 where the noise was not measured: that of 1e4 quanta."""


def of_unknown_noise(transmission: np.ndarray) -> Transmission:
    """A transmission of whose noise only the form is known: that of quanta, ``var T ~ T``.

    Its size, ``UNKNOWN_NOISE``, matters to a solver with a prior only.
    """
    t = np.asarray(transmission, np.float64)
    return Transmission(t, np.maximum(t, 0.0) * UNKNOWN_NOISE)


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


def bridge_gaps(y: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Line integrals with unused pixels (weight 0: dead, saturated, no light) on the line between their neighbours.

    For methods without weights, as filtered back-projection, in which a pixel of 0 would leave a streak through the object.

    Args:
        y, weights: (views, rows, cols).

    Returns:
        (views, rows, cols); a row without any used pixel is 0.
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
