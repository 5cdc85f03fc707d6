r"""Direct light in the parts of the blocks of a baseline, estimated by a few emitter samples in each part.

.. math:: D = \frac{\alpha}{4\pi} \int L_e(\omega)\, e^{-\tau(x, \omega)}\,d\omega

D is the light that a medium of albedo alpha with an isotropic phase function scatters once, averaged over points x of a part.
D shows shadows inside of a block. The few collisions in a block do not.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.flights.baseline import DirectLightTable, MediumBlocks
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.shadow_rays import trace_shadow_ray
from mivol.transport.media.body import eval_albedo
from mivol.transport.media.extinction import to_components
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.random_numbers import SpreadSampler

__all__ = ["tabulate_direct_light"]


SAMPLES = 2
"""Number of emitter samples in each part."""

FIRST_PIXEL = -2
"""Row of pixels for the random numbers, outside of every film."""


def tabulate_direct_light(
    media: SceneMedia, lighting: DirectLighting, emitters: SceneEmitters | None, seed: int
) -> DirectLightTable | None:
    """Tabulate the direct light in the parts of all blocks that have a grid.

    Args:
        media: media of the scene, without bounded parts.
        lighting: estimator of direct lighting.
        emitters: emitters that light collisions; None: all emitters.
        seed: seed of the emitter samples. With the seed of the render, the table would bias derivatives.

    Returns:
        The table; None if no block has a grid.

    Bias: none. Cost: ``SAMPLES`` emitter samples and shadow rays for each part.
    """
    blocks = MediumBlocks.of(media, has_parts=True)
    total, colours = blocks[-1].first + blocks[-1].count, dr.size_v(mi.Spectrum)
    if all(own.parts == 1 for own in blocks):
        return None
    values = dr.zeros(mi.Float, colours * total)
    for own in blocks:
        if own.parts == 1:
            continue
        lane = dr.arange(mi.UInt32, own.count * SAMPLES)
        part = lane // SAMPLES
        sampler = SpreadSampler.of_pixels(
            mi.Vector2i(part + own.first, FIRST_PIXEL), mi.UInt32(seed), lane % SAMPLES, mi.UInt32(SAMPLES)
        )
        it = dr.zeros(mi.MediumInteraction3f, dr.width(lane))
        it.p = own.place(part, mi.Point3f(sampler.next_lead(), *sampler.next_2d()))
        it.medium = mi.MediumPtr(own.body.view.medium)
        sample = lighting.sample_emitter(it, sampler.next_2d(), mi.Bool(True), emitters)
        on = sample.direct.pdf > 0
        _, clear, _, T = trace_shadow_ray(media, mi.Point3d(it.p), media.medium_around(it.p), sample.direct, on)
        light = dr.detach(eval_albedo(own.body, it, on)) * sample.weight * T * (1 / (4 * dr.pi * SAMPLES))
        for c, row in enumerate(to_components(light)):
            dr.scatter_add(values, row, part + (own.first + c * total), on & clear & dr.isfinite(row))
    dr.eval(values)
    return DirectLightTable(blocks, values)
