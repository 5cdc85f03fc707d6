"""Distances between images and between volumes, and scores of views: each choice of a protocol is worth 0.2 to 6 dB.

All distances ignore noise.

Protocol of scores. Render and photograph are compared as displayed: sRGB values, clipped to 0..1 and rounded to 8 bits, over
the same background, at the size of reading. PSNR has the peak 1 and covers all pixels (inside a mask, if given) and channels of
an image. **The PSNR of a set is the mean of its images' PSNR**, not the PSNR of the mean error. SSIM has the 11 x 11 Gaussian
window of Wang et al., FLIP the viewing distance of its authors (67 pixels per degree); smaller FLIP is better. Outside a mask,
SSIM and FLIP compare the photograph with itself.

Source: Wang et al. 2004 (IEEE TIP 13); Andersson et al. 2020 (PACM CGIT 3, FLIP). The choices follow the protocol of the
NerfBaselines project for NeRF's synthetic scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.photos.photo_file import CONVERSIONS


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


# -- Scores of views -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImageScore:
    """The metrics of an image, by their names in ``METRICS``."""

    name: str
    values: dict[str, float]


@dataclass(frozen=True)
class MeanScore:
    """The metrics of a set of images: means over images, and each image."""

    images: tuple[ImageScore, ...]

    @property
    def values(self) -> dict[str, float]:
        """Mean over the images, by metric."""
        return {name: float(np.mean([image.values[name] for image in self.images])) for name in self.images[0].values}

    @property
    def text(self) -> str:
        """A line."""
        means = ", ".join(f"{METRICS[name].label} {value:.{METRICS[name].digits}f}" for name, value in self.values.items())
        worst = min(self.images, key=lambda image: image.values.get("psnr", np.inf))
        return f"{len(self.images)} images: {means} (worst PSNR: {worst.name})"


@dataclass(frozen=True)
class Metric:
    """A distance of two quantised images (H, W, 3): its function, its label and its printed digits."""

    measure: Callable[[np.ndarray, np.ndarray], float]
    label: str
    digits: int


def flip(image: np.ndarray, truth: np.ndarray) -> float:
    """Mean FLIP of two sRGB images in 0..1 (H, W, 3), at 67 pixels per degree; 0 for equal images.

    Raises:
        MivolError: as :func:`load_flip`.
    """
    evaluate = load_flip()
    pair = [np.ascontiguousarray(values, np.float32) for values in (truth, image)]
    return float(evaluate(*pair, "LDR", applyMagma=False, parameters={})[1])


def load_flip() -> Callable:
    """Import FLIP's own implementation.

    Raises:
        MivolError: flip-evaluator is not installed.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        raise MivolError('FLIP needs flip-evaluator, which is not installed; pip install "mivol[metrics]".') from None
    return evaluate


#: name -> metric. PSNR costs nothing, SSIM 0.2 s and FLIP 1 s for an image of 800 x 800 pixels.
METRICS: dict[str, Metric] = {
    "psnr": Metric(lambda image, truth: psnr(image, truth, 1.0), "PSNR [dB]", 2),
    "ssim": Metric(lambda image, truth: ssim(image, truth, 1.0), "SSIM", 4),
    "flip": Metric(flip, "FLIP", 4),
}


def check_metrics(names: Sequence[str], width: int, height: int) -> None:
    """Refuse metrics that cannot score images of a size, before a fit.

    Args:
        names: keys of ``METRICS``.
        width, height: size of the smallest image [pixel].

    Raises:
        MivolError: images smaller than SSIM's window, or FLIP without its package.
    """
    if "ssim" in names:
        check_window(width, height)
    if "flip" in names:
        load_flip()


def quantise(image: np.ndarray, space: str = "srgb") -> np.ndarray:
    """Quantise an image like an 8-bit screen, in sRGB values: multiples of 1/255, float64.

    Args:
        image: (H, W, 3).
        space: space of the values, "srgb" or "linear".

    Raises:
        MivolError: another shape or space, or NaN.
    """
    values = np.asarray(image, np.float64)
    if values.ndim != 3 or values.shape[2] != 3 or values.size == 0:
        raise MivolError(f"found an image of shape {values.shape}, expected (height, width, 3).")
    if (space, "srgb") not in CONVERSIONS:
        raise MivolError(f'the values of an image are "srgb" or "linear", found "{space}": choose one of both.')
    if np.isnan(values).any():
        row, column = (int(i) for i in np.argwhere(np.isnan(values))[0][:2])
        raise MivolError(f"an image holds NaN at row {row}, column {column}; find its cause.")
    return np.round(np.clip(CONVERSIONS[space, "srgb"](values), 0, 1) * 255) / 255


def score_image(
    image: np.ndarray,
    truth: np.ndarray,
    *,
    space: str = "srgb",
    mask: np.ndarray | None = None,
    metrics: Sequence[str] = ("psnr",),
    name: str = "image",
) -> ImageScore:
    """Compare a render with its photograph by the protocol of this module.

    Args:
        image: (H, W, 3).
        truth: (H, W, 3).
        space: space of the values of both.
        mask: (H, W) bool, False for pixels that do not count; None: all pixels count.
        metrics: keys of ``METRICS``.
        name: name of the image.

    Raises:
        MivolError: different shapes, an unknown metric, a metric without its package, NaN, or an empty mask.
    """
    unknown = next((metric for metric in metrics if metric not in METRICS), None)
    if unknown is not None:
        raise MivolError(f'there is no metric "{unknown}"; choose among {", ".join(METRICS)}.')
    if np.shape(image) != np.shape(truth):
        raise MivolError(f"{name} has shape {np.shape(image)} and its photograph {np.shape(truth)}; render it at that size.")
    render, photograph = quantise(image, space), quantise(truth, space)
    if mask is None:
        return ImageScore(name, {metric: METRICS[metric].measure(render, photograph) for metric in metrics})
    if np.shape(mask) != render.shape[:2] or not np.any(mask):
        raise MivolError(f"the mask of {name} has shape {np.shape(mask)} or leaves no pixel; give one of {render.shape[:2]}.")
    filled = np.where(np.asarray(mask, bool)[..., None], render, photograph)
    # Pixels outside the mask have an error of 0; the offset removes them from the PSNR.
    offset = -10 * np.log10(np.size(mask) / np.count_nonzero(mask))
    return ImageScore(name, {m: METRICS[m].measure(filled, photograph) + offset * (m == "psnr") for m in metrics})


def fit_colours(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Fit each channel of an image to its photograph by a x + b, with least squares over counting pixels.

    A camera may choose another exposure or white balance for a held-out view. The fitted image shows the quality of the field
    without this choice. Its PSNR is reported beside the PSNR of the image itself, never in its place.

    Args:
        image, truth: (H, W, 3).
        mask: (H, W) bool, False for pixels that do not count.
    """
    used = np.ones(np.shape(truth)[:2], bool) if mask is None else np.asarray(mask, bool)
    fitted = np.empty(np.shape(image))
    for channel in range(3):
        values = np.clip(image[..., channel], 0, 1).astype(np.float64)
        terms = np.stack([values[used], np.ones(np.count_nonzero(used))], axis=1)
        a, b = np.linalg.lstsq(terms, np.asarray(truth, np.float64)[..., channel][used], rcond=None)[0]
        fitted[..., channel] = a * values + b
    return fitted


def average_scores(images: Iterable[ImageScore]) -> MeanScore:
    """Average the scores of a set of images.

    Raises:
        MivolError: an empty set.
    """
    scores = tuple(images)
    if not scores:
        raise MivolError("found no image to score, expected at least one: hold views out.")
    return MeanScore(scores)
