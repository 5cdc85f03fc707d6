"""The phase functions of the media of a scene: Mitsuba's ``isotropic`` and ``hg`` in closed form, all others by Mitsuba.

A kernel that calls a phase function through its pointer contains a call for every phase function of the process. Dr.Jit cannot
record such a kernel while one of them is an ``hg`` whose ``g`` was set, since Mitsuba 3.9.1 hides this array. The closed forms
need no call, and follow ``g`` as any other argument.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.phase.closed_forms import eval_hg, sample_hg
from mivol.phase.scattering_angle import INV_FOUR_PI, angle_between, scattered_direction
from mivol.transport.media.body import Body

__all__ = ["ScenePhases"]


class ScenePhases:
    """The phase functions of some media.

    Args:
        bodies: the media.

    Attributes:
        has_microflakes: some phase function is, or contains, a microflake phase function.
    """

    def __init__(self, bodies: list[Body]) -> None:
        self._even = [b for b in bodies if b.view.is_isotropic]
        self._peaked = [b for b in bodies if b.view.asymmetry is not None]
        self._others = [b for b in bodies if not b.view.is_isotropic and b.view.asymmetry is None]
        phases = [b.view.medium.phase_function() for b in self._others]
        self.has_microflakes = any(p is not None and int(p.flags()) & int(mi.PhaseFunctionFlags.Microflake) for p in phases)

    def eval(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """Phase function at points of ``mei.medium`` for light from the direction ``d`` [1/sr], with derivatives."""
        value = mi.Spectrum(INV_FOUR_PI)
        if self._peaked:
            own = mi.Spectrum(eval_hg(angle_between(mei.wi, d), self._asymmetry(mei)))
            value = self._select(self._peaked, mei, own, value)
        if self._others:
            on = active & self._is_in(self._others, mei)
            own, _ = mei.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, d, on)
            value = self._select(self._others, mei, own, value)
        return dr.select(active, value, 0)

    def pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of the direction ``d`` in :meth:`sample` [1/sr]."""
        pdf = mi.Float(INV_FOUR_PI)
        if self._peaked:
            own = dr.detach(eval_hg(angle_between(mei.wi, d), self._asymmetry(mei)))
            pdf = self._select(self._peaked, mei, own, pdf)
        if self._others:
            phase = mei.medium.phase_function()
            _, own = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, d, active & self._is_in(self._others, mei))
            if self.has_microflakes:
                own = dr.select(_has_microflakes(phase), INV_FOUR_PI, own)
            pdf = self._select(self._others, mei, own, pdf)
        return dr.select(active, pdf, 0)

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Sample a direction.

        Microflake phase functions are sampled uniformly over the sphere: in Mitsuba 3.9.1 their sampling density differs from
        the density of their ``eval_pdf`` (an error of 6 % in an image under a constant sky).

        Args:
            mei: the point, its medium, and the direction towards the camera.
            component: uniform random number in [0, 1) for the component of the phase function.
            direction: two uniform random numbers in [0, 1) for the direction.
            active: lanes to sample.

        Returns:
            The direction, value over density [1], and density [1/sr].
        """
        found = mi.warp.square_to_uniform_sphere(direction), mi.Spectrum(1), mi.Float(INV_FOUR_PI)
        if self._peaked:
            g = dr.detach(self._asymmetry(mei))
            angle = sample_hg(direction.x, g)
            own = scattered_direction(mei.wi, angle, direction.y), mi.Spectrum(1), eval_hg(angle, g)
            found = self._select(self._peaked, mei, own, found)
        if self._others:
            on = active & self._is_in(self._others, mei)
            found = self._select(self._others, mei, self._sample_others(mei, component, direction, on), found)
        wo, weight, pdf = found
        return wo, dr.select(active, weight, 0), dr.select(active, pdf, 0)

    def _sample_others(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        phase = mei.medium.phase_function()
        wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(None), mei, component, direction, active)
        if self.has_microflakes:
            even = _has_microflakes(phase)
            wo = dr.select(even, mi.warp.square_to_uniform_sphere(direction), wo)
            f, _ = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, wo, active & even)
            weight, pdf = dr.select(even, f / INV_FOUR_PI, weight), dr.select(even, INV_FOUR_PI, pdf)
        return wo, weight, pdf

    def _asymmetry(self, mei: mi.MediumInteraction3f) -> mi.Float:
        """The ``g`` of the medium of each lane [1]."""
        first, *rest = self._peaked
        g = mi.Float(first.view.asymmetry)
        for body in rest:
            g = dr.select(mei.medium == mi.MediumPtr(body.view.medium), body.view.asymmetry, g)
        return g

    def _select(self, bodies: list[Body], mei: mi.MediumInteraction3f, own: tuple, rest: tuple) -> tuple:
        """``own`` in the lanes of some media, ``rest`` in the others."""
        if len(bodies) == len(self._even) + len(self._peaked) + len(self._others):
            return own
        return dr.select(self._is_in(bodies, mei), own, rest)

    @staticmethod
    def _is_in(bodies: list[Body], mei: mi.MediumInteraction3f) -> mi.Bool:
        """Lanes in some media."""
        inside = mi.Bool(False)
        for body in bodies:
            inside |= mei.medium == mi.MediumPtr(body.view.medium)
        return inside


def _has_microflakes(phase: mi.PhaseFunctionPtr) -> mi.Bool:
    return (phase.flags() & mi.UInt32(int(mi.PhaseFunctionFlags.Microflake))) != 0
