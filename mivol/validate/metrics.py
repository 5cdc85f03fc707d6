"""Distances between images and between volumes: PSNR, relative error, structural similarity. All ignore noise."""

from __future__ import annotations

import numpy as np

from mivol.errors import MivolError


def _rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(a, dtype=np.float64) - b) ** 2)))


def psnr(image: np.ndarray, truth: np.ndarray, peak: float | None = None) -> float:
    """Peak signal to noise ratio, 20 log10(peak / RMSE) [dB]; infinite for equal images.

    Args:
        peak: largest value of a signal; by default the largest value of the truth.

    Raises:
        MivolError: a peak of at most 0.
    """
    peak = float(np.max(truth)) if peak is None else peak
    if not peak > 0:
        raise MivolError(f"a peak of {peak} leaves no signal; give the largest expected value, above 0.")
    error = _rmse(image, truth)
    return float("inf") if error == 0 else float(20 * np.log10(peak / error))


def nrmse(x: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error divided by the root mean square of the truth: |x - truth| / |truth|.

    Other authors divide by the range of the truth. For a mostly empty volume the range gives a several times smaller number.

    Raises:
        MivolError: a truth of 0 everywhere.
    """
    norm = float(np.linalg.norm(np.asarray(truth, dtype=np.float64)))
    if norm == 0:
        raise MivolError("the truth is 0 everywhere; a relative error has no meaning there.")
    return float(np.linalg.norm(np.asarray(x, dtype=np.float64) - truth)) / norm


WINDOW = 11
"""Edge of the window of SSIM [pixel]."""


def check_window(width: int, height: int) -> None:
    """Refuse images too small for SSIM.

    Raises:
        MivolError: images smaller than the window.
    """
    if min(width, height) < WINDOW:
        raise MivolError(
            f"an image of {width} x {height} pixels is smaller than the {WINDOW} pixel window of SSIM: leave ssim out of the "
            "metrics, or take larger images."
        )


def ssim(image: np.ndarray, truth: np.ndarray, peak: float | None = None) -> float:
    """Structural similarity (Wang et al. 2004, IEEE TIP 13), by scikit-image, mean over channels; 1 for equal images.

    The window has the paper's 11 x 11 pixels with Gaussian weights of standard deviation 1.5, and lies wholly inside the
    image.

    Raises:
        MivolError: as :func:`check_window`.
    """
    from skimage.metrics import structural_similarity  # slow to import

    truth = np.asarray(truth, dtype=np.float64)
    check_window(truth.shape[1], truth.shape[0])
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    peak = float(truth.max()) if peak is None else peak
    axis = 2 if truth.ndim == 3 else None
    return float(structural_similarity(np.asarray(image, np.float64), truth, data_range=peak, channel_axis=axis, **window))
