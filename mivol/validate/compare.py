"""Compare an image with its reference, in units of the expected noise.

Conventions. Batches give the variance of the reference; the variance of the image is given (0: exact). Half of ``alpha``, the
chance of a false alarm, goes to the largest difference of all pixels, half to the mean difference, as in
:mod:`mivol.validate.statistics`. PSNR cannot tell noise from error; PSNR is reported but never decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.validate.metrics import nrmse, psnr
from mivol.validate.reference_file import ReferenceResult
from mivol.validate.statistics import Bias, Estimate, Significance, estimate_bias, smallest_detectable_bias, z_bound, z_image


@with_short_repr
@dataclass(frozen=True)
class Comparison:
    """The comparison of an image with its reference.

    Attributes:
        z: (H, W, C) difference in standard errors.
        bound: bound on |z|; if the means agree, the largest |z| of all values exceeds the bound with chance ``alpha``/2.
        beyond: share of values with |z| above the bound; 0 expected.
        above_three: share of values with |z| > 3; 0.0027 expected of normal noise.
        worst: (row, column, channel) of the largest |z|.
        bias: mean difference with its confidence interval.
        detectable: median over pixels of the smallest bias found 9 times in 10 [radiance].
        psnr: [dB], peak of the reference; -inf for a black reference.
        nrmse: norm of the difference over the norm of the reference; inf for a black reference.
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
        """Whether no pixel exceeds the bound, and the interval of the bias contains 0."""
        return self.beyond == 0 and self.bias.low <= 0 <= self.bias.high

    @property
    def text(self) -> str:
        """A paragraph."""
        verdict = "agrees with the reference" if self.agrees else "differs from the reference"
        return (
            f"The image {verdict}: {100 * self.beyond:.2g} % of its values lie beyond {self.bound:.1f} standard errors (alpha "
            f"{self.alpha:g} for the whole image), {100 * self.above_three:.2g} % beyond 3 (0.27 % expected), the worst "
            f"{self.z[self.worst]:+.1f} at row {self.worst[0]}, column {self.worst[1]}, channel {self.worst[2]}. The mean "
            f"difference is {self.bias.value:+.2g}, between {self.bias.low:+.2g} and {self.bias.high:+.2g}; in one pixel "
            f"{self.detectable:.2g} would be found 9 times in 10. PSNR {self.psnr:.1f} dB, nRMSE {self.nrmse:.2g}."
        )


def compare(
    image: Estimate,
    reference: ReferenceResult,
    *,
    alpha: float = 1e-3,
    samples_seen: float = 0.0,
    rounding: float = 0.0,
    correlated: int = 3,
) -> Comparison:
    """Compare an image with a reference.

    Args:
        image: (H, W, C), with the variance of its own mean; 0 for an exact image.
        reference: result of ``render_reference`` or ``read_reference`` (which refuses the reference of another scene).
        alpha: chance that images of equal mean are reported as different.
        samples_seen: largest value of a single sample [radiance], for instance the background's. The variance then allows for
            light missed by the samples, see :meth:`ReferenceResult.variance_with_unseen`. 0: the variance as estimated.
        rounding: as in :func:`mivol.validate.statistics.z_image`.
        correlated: as in :func:`mivol.validate.statistics.estimate_bias`; 3: the channels share their paths, with a box
            filter.

    Raises:
        MivolError: an image of another size, or values that are not finite.
    """
    mean = np.asarray(image.mean, dtype=np.float64)
    if mean.shape != reference.mean.shape:
        raise MivolError(f"an image of shape {mean.shape} cannot be compared with a reference of {reference.mean.shape}.")
    var = reference.variance_with_unseen(samples_seen) if samples_seen else reference.variance
    truth, dof = Estimate(reference.mean, var, reference.batches - 1), reference.batches - 1
    difference = estimate_bias(image, truth, alpha=alpha / 2, correlated=correlated)
    dark = not reference.mean.any()
    z, level = z_image(image, truth, rounding), Significance(alpha / 2, mean.size)
    bound = float(z_bound(level, dof))
    return Comparison(
        z=z,
        bound=bound,
        beyond=float(np.mean(np.abs(z) > bound)),
        above_three=float(np.mean(np.abs(z) > 3)),
        worst=tuple(int(i) for i in np.unravel_index(np.argmax(np.abs(z)), z.shape)),
        bias=difference,
        detectable=float(np.median(smallest_detectable_bias(image.var + var, level=level, dof=dof))),
        psnr=-np.inf if dark else psnr(mean, reference.mean),
        nrmse=np.inf if dark else nrmse(mean, reference.mean),
        alpha=alpha,
    )
