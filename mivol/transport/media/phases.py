r"""Phase functions of media, evaluated without a call through a pointer.

.. math:: p_{SGGX}(\omega_i, \omega_o) = \frac{D(\omega_h)}{4 A(\omega_i)}, \qquad
          D(\omega) = \frac{1}{\pi \sqrt{|S|}\,(\omega^T S^{-1} \omega)^2}, \qquad A(\omega) = \sqrt{\omega^T S\, \omega}

Conventions. As in :mod:`mivol.phase`; the value of ``eval_pdf`` carries derivatives, densities carry none. Mitsuba 3.9.1 hides
the arrays of its phase functions from Dr.Jit, so a recording reads them here, and evaluates Mitsuba's phase functions in closed
form. All others are called as objects. A kernel that calls a phase function through its pointer would contain a call for every
phase function of the process, and could not be recorded while one of them is an ``hg`` whose ``g`` was set.

References: Heitz et al. 2015, The SGGX Microflake Distribution, Eqs. 6, 10 and 16.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import is_recording
from mivol.phase.closed_forms import (
    INV_FOUR_PI,
    ScatteringAngle,
    angle_between,
    eval_hg,
    eval_rayleigh,
    sample_hg,
    sample_rayleigh,
    scattered_direction,
)
from mivol.phase.table import Lookup
from mivol.scene_graph import find_children, list_values, traverse

__all__ = [
    "Blend",
    "HenyeyGreenstein",
    "Isotropic",
    "Microflakes",
    "Phase",
    "PluginPhase",
    "Rayleigh",
    "Tabulated",
    "find_plugins",
    "read_phase",
]


class AngleFunction:
    """A phase function of the scattering angle alone, whose samples have its own density."""

    def prepare(self) -> Phase:
        """The phase function with all that its methods need."""
        return self

    def merge_key(self) -> tuple | None:
        """Media with the same key differ by numbers only; None for a phase function with arrays of any length."""
        return (type(self),)

    def eval_angle(self, angle: ScatteringAngle, active: mi.Bool) -> mi.Float:
        """Density [1/sr], with derivatives."""
        raise NotImplementedError

    def sample_angle(self, u: mi.Float, active: mi.Bool) -> ScatteringAngle:
        """Draw a scattering angle."""
        raise NotImplementedError

    def eval_pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Value for light from the direction ``d``, and density of ``d`` in :meth:`sample` [1/sr]."""
        value = self.eval_angle(angle_between(mei.wi, d), active)
        return mi.Spectrum(value), dr.detach(value)

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Draw a direction.

        Args:
            mei: the point, and the direction towards the camera.
            component, direction: uniform random numbers in [0, 1) for the lobe and for the direction.
            active: lanes to sample.

        Returns:
            The direction, value over density [1], and density [1/sr].
        """
        with dr.suspend_grad():
            angle = self.sample_angle(direction.x, active)
            wo = scattered_direction(mei.wi, angle, direction.y)
            return wo, mi.Spectrum(1), self.eval_angle(angle, active)


@dataclass
class Isotropic(AngleFunction):
    """Mitsuba's ``isotropic``."""

    def eval_angle(self, angle: ScatteringAngle, active: mi.Bool) -> mi.Float:
        return mi.Float(INV_FOUR_PI)

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        return mi.warp.square_to_uniform_sphere(direction), mi.Spectrum(1), mi.Float(INV_FOUR_PI)


@dataclass
class HenyeyGreenstein(AngleFunction):
    """Mitsuba's ``hg``, with the mean cosine ``g`` [1]."""

    g: mi.Float

    def eval_angle(self, angle: ScatteringAngle, active: mi.Bool) -> mi.Float:
        return eval_hg(angle, self.g)

    def sample_angle(self, u: mi.Float, active: mi.Bool) -> ScatteringAngle:
        return sample_hg(u, self.g)


@dataclass
class Rayleigh(AngleFunction):
    """Mitsuba's ``rayleigh``."""

    def eval_angle(self, angle: ScatteringAngle, active: mi.Bool) -> mi.Float:
        return eval_rayleigh(angle)

    def sample_angle(self, u: mi.Float, active: mi.Bool) -> ScatteringAngle:
        return sample_rayleigh(u)


@dataclass
class Tabulated(AngleFunction):
    """Mitsuba's ``tabphase``.

    Attributes:
        values: (n,) at equally spaced cosines from -1 to 1, at least 0, not normalised.
        table: the nodes, and ``values``, their integral and their cumulative distribution; None before :meth:`prepare`.
    """

    values: mi.Float
    table: tuple[Lookup, mi.Float, mi.Float, mi.Float] | None = None

    def prepare(self) -> Tabulated:
        nodes = Lookup.of_regular_cosines(dr.width(self.values))
        return replace(self, table=(nodes, *nodes.normalise(self.values)))

    def merge_key(self) -> None:
        return None

    def eval_angle(self, angle: ScatteringAngle, active: mi.Bool) -> mi.Float:
        nodes, values, integral, _ = self.table
        return nodes.eval(angle, values, integral, active)

    def sample_angle(self, u: mi.Float, active: mi.Bool) -> ScatteringAngle:
        nodes, *numbers = self.table
        return nodes.sample(u, *numbers, active)


@dataclass
class Microflakes:
    """Mitsuba's ``sggx``, with the same matrix everywhere.

    Attributes:
        matrix: entries xx, yy, zz, xy, xz, yz of the matrix S, once for each voxel, with derivatives.
    """

    matrix: mi.Float

    def prepare(self) -> Phase:
        """The phase function itself."""
        return self

    def merge_key(self) -> tuple | None:
        """Media with the same key differ by numbers only."""
        return (type(self),)

    @property
    def entries(self) -> list[mi.Float]:
        """The entries xx, yy, zz, xy, xz, yz of S."""
        return [dr.gather(mi.Float, self.matrix, mi.UInt32(k)) for k in range(6)]

    def eval_pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Value for light from the direction ``d``, and density of ``d`` in :meth:`sample` [1/sr]."""
        xx, yy, zz, xy, xz, yz = self.entries
        # The adjugate of S is |S| times its inverse.
        adjugate = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
        adjugate += xz * yz - zz * xy, xy * yz - yy * xz, xy * xz - xx * yz
        determinant = dr.abs(xx * adjugate[0] + xy * adjugate[3] + xz * adjugate[4])
        half = dr.normalize(mei.wi + d)
        distribution = determinant * dr.safe_sqrt(determinant) / (dr.pi * dr.square(_quadratic_form(adjugate, half)))
        area = dr.safe_sqrt(_quadratic_form((xx, yy, zz, xy, xz, yz), mei.wi))
        return mi.Spectrum(0.25 * distribution / area), mi.Float(INV_FOUR_PI)

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Draw a direction, uniform over the sphere."""
        return _sample_sphere(self, mei, direction, active)


@dataclass
class Blend:
    """Mitsuba's ``blendphase``: two phase functions side by side.

    Attributes:
        weight: share of the second one [1], to be clipped to [0, 1]: a number with derivatives, or a volume.
        first, second: the phase functions.
    """

    weight: mi.Float | mi.Volume
    first: Phase
    second: Phase

    def prepare(self) -> Blend:
        """The blend of prepared phase functions."""
        return replace(self, first=self.first.prepare(), second=self.second.prepare())

    def merge_key(self) -> tuple | None:
        """Media with the same key differ by numbers only; None for a blend with arrays of any length."""
        keys = self.first.merge_key(), self.second.merge_key()
        return None if isinstance(self.weight, mi.Volume) or None in keys else (type(self), *keys)

    def eval_pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Value for light from the direction ``d``, and density of ``d`` in :meth:`sample` [1/sr]."""
        weight = self._eval_weight(mei, active)
        (first, first_pdf), (second, second_pdf) = (p.eval_pdf(mei, d, active) for p in (self.first, self.second))
        return dr.lerp(first, second, mi.Spectrum(weight)), dr.lerp(first_pdf, second_pdf, dr.detach(weight))

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Draw a direction of one of the phase functions."""
        with dr.suspend_grad():
            weight = self._eval_weight(mei, active)
            is_second = component < weight
            inside = dr.select(is_second, component / weight, (component - weight) / (1 - weight))
            first = self.first.sample(mei, inside, direction, active & ~is_second)[0]
            second = self.second.sample(mei, inside, direction, active & is_second)[0]
            wo = dr.select(is_second, second, first)
            value, pdf = self.eval_pdf(mei, wo, active)
            return wo, dr.select(pdf > 0, value / pdf, 0), pdf

    def _eval_weight(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
        weight = self.weight.eval_1(mei, active) if isinstance(self.weight, mi.Volume) else self.weight
        return dr.clip(weight, 0, 1)


@dataclass
class PluginPhase:
    """A phase function that is called as an object.

    Attributes:
        plugin: the phase function.
    """

    plugin: mi.PhaseFunction

    def prepare(self) -> Phase:
        """The phase function itself."""
        return self

    def merge_key(self) -> None:
        """None: two objects are called one by one."""

    @property
    def has_microflakes(self) -> bool:
        """Whether the phase function is, or contains, a microflake phase function."""
        return bool(int(self.plugin.flags()) & int(mi.PhaseFunctionFlags.Microflake))

    def eval_pdf(self, mei: mi.MediumInteraction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Value for light from the direction ``d``, and density of ``d`` in :meth:`sample` [1/sr]."""
        value, pdf = self.plugin.eval_pdf(mi.PhaseFunctionContext(None), mei, d, active)
        return value, mi.Float(INV_FOUR_PI) if self.has_microflakes else pdf

    def sample(
        self, mei: mi.MediumInteraction3f, component: mi.Float, direction: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Draw a direction: with microflakes uniform over the sphere.

        In Mitsuba 3.9.1 the sampling density of microflakes differs from the density of their ``eval_pdf`` (an error of 6 % in
        an image under a constant sky).
        """
        if self.has_microflakes:
            return _sample_sphere(self, mei, direction, active)
        return self.plugin.sample(mi.PhaseFunctionContext(None), mei, component, direction, active)


Phase = AngleFunction | Microflakes | Blend | PluginPhase


def _sample_sphere(
    phase: Microflakes | PluginPhase, mei: mi.MediumInteraction3f, direction: mi.Point2f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
    """Draw a direction, uniform over the sphere."""
    with dr.suspend_grad():
        wo = mi.warp.square_to_uniform_sphere(direction)
        return wo, phase.eval_pdf(mei, wo, active)[0] / INV_FOUR_PI, mi.Float(INV_FOUR_PI)


def _quadratic_form(entries: tuple[mi.Float, ...], d: mi.Vector3f) -> mi.Float:
    """d^T M d for the symmetric matrix with the entries xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = entries
    return xx * d.x * d.x + yy * d.y * d.y + zz * d.z * d.z + 2 * (xy * d.x * d.y + xz * d.x * d.z + yz * d.y * d.z)


def read_phase(phase: mi.PhaseFunction | None) -> Phase:
    """The arrays of a phase function, with its derivatives; ``isotropic`` for None."""
    kind = "IsotropicPhaseFunction" if phase is None else phase.class_name()
    if kind == "IsotropicPhaseFunction":
        return Isotropic()
    if kind == "RayleighPhaseFunction":
        return Rayleigh()
    if kind == "HGPhaseFunction":
        return HenyeyGreenstein(_keep_number(traverse(phase)["g"]))
    if kind == "TabulatedPhaseFunction":
        return Tabulated(traverse(phase)["values"])
    if kind == "SGGXPhaseFunction":
        matrix = dr.ravel(next(value for key, value in list_values(traverse(phase)) if key.startswith("S.")))
        return Microflakes(matrix) if _is_uniform(matrix) else PluginPhase(phase)
    if kind == "BlendPhaseFunction":
        children, params = find_children(phase), traverse(phase)
        is_number = "weight.value.value" in params and len(params["weight.value.value"]) == 1
        weight = _keep_number(params["weight.value.value"]) if is_number else children["weight"]
        return Blend(weight, read_phase(children["phase_0"]), read_phase(children["phase_1"]))
    return PluginPhase(phase)


def find_plugins(phase: mi.PhaseFunction | None) -> list[mi.PhaseFunction]:
    """The phase functions in a phase function that :func:`read_phase` calls as objects."""
    return _list_plugins(read_phase(phase))


def _list_plugins(phase: Phase) -> list[mi.PhaseFunction]:
    if isinstance(phase, Blend):
        return _list_plugins(phase.first) + _list_plugins(phase.second)
    return [phase.plugin] if isinstance(phase, PluginPhase) else []


def _is_uniform(matrices: mi.Float) -> bool:
    """Whether matrices of six entries are the same in every voxel. A recording cannot ask, and takes the first."""
    if dr.width(matrices) == 6 or is_recording():
        return True
    rows = np.array(dr.detach(matrices)).reshape(-1, 6)
    return bool((rows == rows[0]).all())


def _keep_number(number: mi.Float) -> mi.Float:
    """Keep the derivatives of a number; without derivatives, make it an array: each literal would make a new kernel."""
    if not dr.grad_enabled(number):
        number = mi.Float(dr.detach(number))
        dr.make_opaque(number)
    return number
