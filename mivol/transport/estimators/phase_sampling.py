"""Directions drawn from phase functions, and their density."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.phase.turn import INV_FOUR_PI
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["phase_context", "phase_pdf", "sample_phase"]


def sample_phase(
    media: SceneMedia,
    mei: mi.MediumInteraction3f,
    component: mi.Float,
    direction: mi.Point2f,
    active: mi.Bool,
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
    """Sample a direction from a phase function.

    Microflake phase functions are sampled uniformly over the sphere, since Mitsuba 3.9.1 samples them with another density than
    its ``eval_pdf`` returns (an error of 6 % in an image under a constant sky).

    Args:
        media: of the scene.
        mei: the point, its medium, and the direction towards the camera.
        component, direction: three numbers in [0, 1), of which the first chooses a component of the phase function.
        active: lanes to sample.

    Returns:
        The direction, value over density [1], and density [1/sr].
    """
    phase = mei.medium.phase_function()
    wo, weight, pdf = phase.sample(phase_context(), mei, component, direction, active)
    if media.has_microflakes:
        even = _has_microflakes(phase)
        wo = dr.select(even, mi.warp.square_to_uniform_sphere(direction), wo)
        f, _ = phase.eval_pdf(phase_context(), mei, wo, active & even)
        weight, pdf = dr.select(even, f / INV_FOUR_PI, weight), dr.select(even, INV_FOUR_PI, pdf)
    return wo, weight, pdf


def phase_pdf(
    media: SceneMedia, phase: mi.PhaseFunctionPtr, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool
) -> mi.Float:
    """Density [1/sr] of the direction ``d`` in :func:`sample_phase`."""
    _, pdf = phase.eval_pdf(phase_context(), mei, d, active)
    return dr.select(_has_microflakes(phase), INV_FOUR_PI, pdf) if media.has_microflakes else pdf


def _has_microflakes(phase: mi.PhaseFunctionPtr) -> mi.Bool:
    return (phase.flags() & mi.UInt32(int(mi.PhaseFunctionFlags.Microflake))) != 0


def phase_context() -> mi.PhaseFunctionContext:
    """The context that asks a phase function for all of its components."""
    return mi.PhaseFunctionContext(None)
