"""Coefficients of a medium at a point, as Mitsuba's volumes give them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body

__all__ = ["eval_albedo", "medium_interaction"]


def medium_interaction(ray: mi.Ray3f, t: mi.Float | mi.Float64, medium: mi.Medium | None = None) -> mi.MediumInteraction3f:
    """A point of a ray as Mitsuba evaluates volumes and phase functions at it, found in float64 and rounded once."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
    p = [mi.Float(dr.fma(mi.Float64(t), mi.Float64(ray.d[a]), mi.Float64(ray.o[a]))) for a in range(3)]
    mei.t, mei.p, mei.wi = mi.Float(t), mi.Point3f(*p), -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    if medium is not None:
        mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(ray)), mi.MediumPtr(medium), None)
    return mei


def eval_albedo(body: Body, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The single-scattering albedo of a body at a point [1], with its derivative."""
    albedo = body.view.albedo
    return albedo.eval(mei, on) if isinstance(albedo, mi.Volume) else mi.Spectrum(albedo)
