"""A control variate for derivatives with one source function for all of space, for media under a constant sky."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import UNIFORM
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["find_constant_control"]


def find_constant_control(media: SceneMedia) -> mi.Spectrum | None:
    r"""Find the constant source function S [radiance]: the mean albedo times the radiance of a constant sky.

    The light of S along a ray is :math:`S (1 - T(D))`, and its derivative by the optical depth of any part of the ray is
    :math:`T(D)\,S`. So it needs no lattice, and serves any number of media in any boundaries.

    Returns:
        S; None where there is no constant sky, or a medium has no albedo (but a ``sigma_s``).
    """
    skies = [e for e in media.scene.emitters() if e.class_name() == UNIFORM]
    albedos = [a for body in media.bodies for a in body.view.albedo_arrays]
    if not skies or any(body.view.albedo is None for body in media.bodies):
        return None
    mean = sum(_mean_of(a) for a in albedos) / len(albedos)
    return mean * dr.detach(skies[0].eval(dr.zeros(mi.SurfaceInteraction3f)))


def _mean_of(albedo: mi.TensorXf | mi.Float | mi.Color3f) -> mi.Spectrum:
    """Mean over space of an albedo, or of its volume."""
    flat = dr.ravel(dr.detach(albedo))
    n = albedo.shape[-1] if dr.is_tensor_v(albedo) else dr.width(flat)
    of_each = dr.arange(mi.UInt32, dr.width(flat) // n) * n
    rows = [dr.mean(dr.gather(mi.Float, flat, of_each + c)) for c in range(n)]
    return mi.Spectrum(*rows) if len(rows) == 3 and not mi.is_monochromatic else mi.Spectrum(sum(rows) / n)
