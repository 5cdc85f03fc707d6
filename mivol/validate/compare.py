"""An image beside its reference: how far apart, in units of what chance explains.

Conventions. The reference's variance is estimated from its batches, the image's is given (0: exact). Of ``alpha``, the
chance of a false alarm, one half goes to the largest of all pixels and one half to the mean difference, as in
:mod:`mivol.validate.statistics`; PSNR cannot tell noise from error, so it is reported and never judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.validate.reference import ReferenceResult, read_reference
from mivol.validate.statistics import Bias, bias, nrmse, psnr, smallest_detectable_bias, z_bound, z_image

__all__ = ["Comparison", "compare"]


@dataclass(frozen=True)
class Comparison:
    """What can be said of an image and its reference.

    Attributes:
        z: (H, W, C) difference in standard errors.
        bound: on |z|, which one of all values exceeds with chance ``alpha``/2 if the means agree.
        beyond: share of values whose |z| exceeds it; 0 expected.
        above_three: share of values with |z| > 3; 0.0027 expected of normal noise.
        worst: (row, column, channel) of the largest |z|.
        bias: mean difference with its confidence interval.
        detectable: median over pixels of the smallest bias that would be found 9 times in 10 [radiance].
        psnr: [dB], peak of the reference; -inf where the reference is black.
        nrmse: norm of the difference over the norm of the reference; inf where that is black.
        alpha: chance of a false alarm.
    """

    z: np.ndarray
    bound: float
    beyond: float
    above_three: float
    worst: tuple[int, int, int]
    bias: Bias
    detectable: float
    psnr: float
    nrmse: float
    alpha: float

    @property
    def agrees(self) -> bool:
        """No pixel beyond the bound, and the interval of the bias holds 0."""
        return self.beyond == 0 and self.bias.low <= 0 <= self.bias.high

    @property
    def text(self) -> str:
        """One paragraph."""
        verdict = "agrees with the reference" if self.agrees else "differs from the reference"
        return (
            f"The image {verdict}: {100 * self.beyond:.2g} % of its values lie beyond {self.bound:.1f} standard errors (alpha "
            f"{self.alpha:g} for the whole image), {100 * self.above_three:.2g} % beyond 3 (0.27 % expected), the worst "
            f"{self.z[self.worst]:+.1f} at row {self.worst[0]}, column {self.worst[1]}, channel {self.worst[2]}. The mean "
            f"difference is {self.bias.value:+.2g}, between {self.bias.low:+.2g} and {self.bias.high:+.2g}; in one pixel "
            f"{self.detectable:.2g} would be found 9 times in 10. PSNR {self.psnr:.1f} dB, nRMSE {self.nrmse:.2g}."
        )


def compare(
    image: np.ndarray,
    reference: ReferenceResult | str | Path,
    *,
    variance: np.ndarray | float = 0.0,
    content_hash: str | None = None,
    alpha: float = 1e-3,
    samples_seen: float = 0.0,
    rounding: float = 0.0,
    correlated: int = 3,
) -> Comparison:
    """Compare an image with a reference.

    Args:
        image: (H, W, C).
        reference: what ``render_reference`` gave, or its file.
        variance: of the image's own mean; 0 where it is exact.
        content_hash: of the scene that the image shows; a reference of another is refused.
        alpha: chance that images of equal mean are said to differ.
        samples_seen: largest value of one sample [radiance], for instance the background's. A pixel whose few bright
            samples were never seen has an estimated variance of 0; with this it has at least that of one sample in all,
            (samples_seen / spp)^2. 0: as estimated.
        rounding: see :func:`mivol.validate.statistics.z_image`.
        correlated: see :func:`mivol.validate.statistics.bias`; 3: the channels share their paths, the filter is a box.

    Raises:
        MivolError: another size, another scene, or values that are not finite.
    """
    if not isinstance(reference, ReferenceResult):
        reference = read_reference(reference, content_hash)
    elif content_hash not in (None, reference.identity["scene"]):
        raise MivolError(f"{reference.path} is the reference of another scene; render this one's.")
    image = np.asarray(image, dtype=np.float64)
    if image.shape != reference.mean.shape:
        raise MivolError(f"an image of shape {image.shape} cannot be compared with a reference of {reference.mean.shape}.")
    var = np.maximum(reference.variance, (samples_seen / reference.spp) ** 2)
    dof = reference.batches - 1
    difference = bias(image, variance, reference.mean, var, alpha=alpha / 2, correlated=correlated, dof_b=dof)
    dark = not reference.mean.any()
    z = z_image(image, variance, reference.mean, var, rounding)
    bound = float(z_bound(alpha / 2, z.size, dof=dof))
    return Comparison(
        z=z,
        bound=bound,
        beyond=float(np.mean(np.abs(z) > bound)),
        above_three=float(np.mean(np.abs(z) > 3)),
        worst=tuple(int(i) for i in np.unravel_index(np.argmax(np.abs(z)), z.shape)),
        bias=difference,
        detectable=float(
            np.median(smallest_detectable_bias(variance, var, alpha=alpha / 2, comparisons=z.size, dof=dof))
        ),
        psnr=-np.inf if dark else psnr(image, reference.mean),
        nrmse=np.inf if dark else nrmse(image, reference.mean),
        alpha=alpha,
    )
