r"""The transmittance of a field of which no more than a majorant is known, by ratio tracking.

.. math:: \hat T = \prod_j \left(1 - \frac{\sigma(x_j)}{\kappa M}\right)

at the points x_j of a Poisson process of the rate kappa M, for a majorant M of the extinction sigma; kappa = ``LOOKUP_RATE``.

References: Cramer 1978; Novak et al. 2014 (ratio tracking).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.numerics import largest_of
from mivol.transport.estimators.ratio_tracking import FAINT, LOOKUP_RATE
from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["ratio_tracking"]


def ratio_tracking(
    part: BoundedExtinction, scale: mi.Float, interval: RayInterval, rng: mi.UInt32
) -> tuple[list[mi.Float], mi.UInt32]:
    """Estimate the transmittance of an interval of a ray for each channel.

    Args:
        part: the extinction; that its values are no larger than its majorant is the field's promise.
        scale: factor on the values.
        interval: of the ray; the field has a box, so it may be infinite. Lanes that are not active return 1.
        rng: state of the generator.

    Returns:
        The estimates, and the state of the generator.

    Bias: none. Variance: T^2 (exp(int sigma^2 / (kappa M) dt) - 1), and what the roulette adds, which ends rays below FAINT.
    Cost: kappa M l look-ups for a length l in the box.
    """
    ray = interval.ray
    begin, end = part.clip(interval)
    rate = LOOKUP_RATE * scale * part.majorant

    def look(t: mi.Float, T: list[mi.Float], rng: mi.UInt32, on: mi.Bool) -> tuple:
        rng, (u, chance) = draw_pcg32(rng, 2)
        # Where the majorant is 0 the next point is infinitely far.
        t = t - dr.log(u) / rate
        on &= t < end
        values = part.eval_at(scale, ray, t, on)
        T = [dr.select(on, a * (1 - value / rate), a) for a, value in zip(T, values, strict=True)]
        # -- Roulette ---------------------------------------------------------------------------------------------------
        seen = largest_of(T)
        lift = dr.select(chance * FAINT < seen, dr.maximum(1, FAINT / seen), 0)
        T = [dr.select(on, a * lift, a) for a in T]
        return t, T, rng, on & (lift > 0)

    width = dr.width(ray)
    T = [dr.full(mi.Float, 1, width) for _ in range(part.channels)]
    start = (begin, T, mi.UInt32(rng), interval.active & (end > begin))
    _, T, rng, _ = dr.while_loop(start, lambda t, T, rng, on: on, look, label="points of a bounded medium")
    return T, rng
