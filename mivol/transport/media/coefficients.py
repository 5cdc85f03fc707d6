"""Coefficients of a medium at a point, as Mitsuba's volumes give them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body
from mivol.transport.media.channels import spectrum
from mivol.transport.traversal.fine_ray import Ray, point_along

__all__ = ["emission_slope", "eval_albedo", "eval_emission", "medium_interaction"]


def medium_interaction(ray: Ray, t: mi.Float | mi.Float64, medium: mi.Medium | None = None) -> mi.MediumInteraction3f:
    """A point of a ray as Mitsuba evaluates volumes and phase functions at it, found in float64 and rounded once."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
    mei.t, mei.p, mei.wi = mi.Float(t), mi.Point3f(point_along(ray, t)), -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    if medium is not None:
        mei.medium = dr.select(dr.full(mi.Bool, True, dr.width(ray)), mi.MediumPtr(medium), None)
    return mei


def eval_albedo(body: Body, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The single-scattering albedo of a body at a point [1], with its derivative."""
    albedo = body.view.albedo
    return albedo.eval(mei, on) if isinstance(albedo, mi.Volume) else mi.Spectrum(albedo)


def eval_emission(body: Body, ray: Ray, t: mi.Float64, channels: int, on: mi.Bool) -> mi.Spectrum:
    """The light that a body emits at a point of a ray towards its origin [radiance/length].

    It carries the derivatives of the emission and of the albedo; those of the extinction are :func:`emission_slope`.
    """
    total = mi.Spectrum(0)
    if body.view.emission is not None:
        name, slope = emission_slope(body, ray, t, on)
        total += spectrum(body.extinction_at(ray, dr.select(on, t, 0), channels, on, name)) * slope
    if body.view.emission_density is not None:
        total += _at(body, body.view.emission_density, ray, t, on)
    return total


def emission_slope(body: Body, ray: Ray, t: mi.Float64, on: mi.Bool) -> tuple[str, mi.Spectrum]:
    """The coefficient that the ``emission`` of a body goes with, and the derivative of the emitted light by it [radiance]."""
    Le = _at(body, body.view.emission, ray, t, on)
    if body.view.albedo is None:
        return "sigma_a", Le
    return "sigma_", Le * (1 - eval_albedo(body, medium_interaction(ray, t, body.view.medium), on))


def _at(body: Body, value: mi.Volume | mi.Float | mi.Color3f, ray: Ray, t: mi.Float64, on: mi.Bool) -> mi.Spectrum:
    if not isinstance(value, mi.Volume):
        return mi.Spectrum(value)
    mei = medium_interaction(ray, dr.select(on, t, 0), body.view.medium)
    return dr.select(body.view.holds(value, mei.p), value.eval(mei, on), 0)
