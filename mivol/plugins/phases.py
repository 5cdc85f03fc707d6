"""The phase function plugins "mivol_hg", "mivol_rayleigh", "mivol_draine", "mivol_tabulated" and "mivol_mixture".

Conventions. A phase function of the angle alone has a single component; a mixture has the components of its lobes. A stock
``blendphase`` reads this count from a C++ member that Mitsuba 3.9 hides from Python, so ``blendphase`` numbers no phase
function written in Python. Its renders are still right, because no integrator of Mitsuba asks for a component. To use
components, nest the phase functions in a ``mivol_mixture``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import is_recording
from mivol.phase.closed_forms import (
    ASYMMETRY,
    COSINE_SQUARED,
    WEIGHT,
    Domain,
    ScatteringAngle,
    angle_between,
    choose_lobe,
    eval_draine,
    eval_hg,
    eval_rayleigh,
    normalise_weights,
    sample_draine,
    sample_hg,
    sample_rayleigh,
    scattered_direction,
)
from mivol.phase.table import Lookup, Table, check_values
from mivol.scene_graph import traverse

VOLUME_KEYS = ("data", "value.value")
"""Keys of the values of grids and constants, of Mitsuba and of mivol."""

ALL_COMPONENTS = 2**32 - 1


class AnglePhase(mi.PhaseFunction):
    """A phase function of the scattering angle alone.

    Samples and densities carry no derivatives. The value of ``eval_pdf`` carries the derivatives with respect to the parameters
    and the directions.
    """

    domains: ClassVar[dict[str, Domain]] = {}

    def __init__(self, props: mi.Properties, parameters: Mapping[str, mi.Float | mi.Volume]) -> None:
        super().__init__(props)
        self.m_flags = int(mi.PhaseFunctionFlags.Anisotropic)
        self.kind = props.plugin_name()
        self.parameters = dict(parameters)  # dr.freeze finds arrays only among a plugin's own attributes
        self.refresh()

    def refresh(self) -> None:
        _check_parameters(self.parameters, self.domains, self.kind)

    def component_count(self, active: mi.Bool = True) -> int:
        return 1

    def flags(self, index: int | mi.Bool | None = None, active: mi.Bool = True) -> int:
        return self.m_flags

    def eval_angle(self, angle: ScatteringAngle, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
        raise NotImplementedError

    def sample_angle(self, u: mi.Float, mei: mi.MediumInteraction3f, active: mi.Bool) -> ScatteringAngle:
        raise NotImplementedError

    def sample(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        with dr.suspend_grad():
            active = mi.Bool(active)
            angle = self.sample_angle(sample2.x, mei, active)
            return scattered_direction(mei.wi, angle, sample2.y), mi.Spectrum(1), self.eval_angle(angle, mei, active)

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        value = self.eval_angle(angle_between(mei.wi, wo), mei, mi.Bool(active))
        return mi.Spectrum(value), dr.detach(value)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, value in self.parameters.items():
            callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.refresh()

    def to_string(self) -> str:
        return f"{self.kind}[" + ", ".join(f"{n}={_format_value(v)}" for n, v in self.parameters.items()) + "]"


class ClosedFormPhase(AnglePhase):
    """A phase function whose density and inversion are closed forms.

    A subclass names both functions, and the default and the domain of each parameter in the order of the functions' arguments.
    """

    density: ClassVar[Callable[..., mi.Float]]
    inversion: ClassVar[Callable[..., ScatteringAngle]]
    defaults: ClassVar[dict[str, float]] = {}

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props, {name: _read_parameter(props, name, default) for name, default in self.defaults.items()})

    def eval_angle(self, angle: ScatteringAngle, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
        return self.density(angle, *self._eval_parameters(mei, active))

    def sample_angle(self, u: mi.Float, mei: mi.MediumInteraction3f, active: mi.Bool) -> ScatteringAngle:
        return self.inversion(u, *self._eval_parameters(mei, active))

    def _eval_parameters(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> list[mi.Float]:
        return [_eval_parameter(value, self.domains[name], mei, active) for name, value in self.parameters.items()]


class HenyeyGreenstein(ClosedFormPhase):
    """``<phase type="mivol_hg">``: the Henyey-Greenstein phase function.

    Parameters:
        g: mean cosine, -1 < g < 1, a float or a volume. Default 0.8, as stock ``hg`` has it.
    """

    density, inversion = staticmethod(eval_hg), staticmethod(sample_hg)
    defaults: ClassVar = {"g": 0.8}
    domains: ClassVar = {"g": ASYMMETRY}


class Rayleigh(ClosedFormPhase):
    """``<phase type="mivol_rayleigh">``: particles much smaller than the wavelength; no parameters."""

    density, inversion = staticmethod(eval_rayleigh), staticmethod(sample_rayleigh)


class Draine(ClosedFormPhase):
    """``<phase type="mivol_draine">``: Draine's phase function, between Henyey-Greenstein's, Cornette-Shanks' and Rayleigh's.

    Parameters:
        g: asymmetry, -1 < g < 1, a float or a volume. Default 0.8.
        alpha: weight of cos^2, at least 0, a float or a volume: 0 is Henyey-Greenstein, 1 (the default) Cornette-Shanks.
    """

    density, inversion = staticmethod(eval_draine), staticmethod(sample_draine)
    defaults: ClassVar = {"g": 0.8, "alpha": 1.0}
    domains: ClassVar = {"g": ASYMMETRY, "alpha": COSINE_SQUARED}


class Tabulated(AnglePhase):
    """``<phase type="mivol_tabulated">``: values at cosines, linear in between, normalised.

    Parameters:
        values: numbers at the cosines, text with commas or a tensor; differentiable. Or
        moments: Legendre moments chi_0 = 1, chi_1, ...; or
        filename: a CSV table of two columns, ``cos`` (or ``angle`` in degrees) and value.
        cosines: cosines of the values, rising from -1 (backwards) to 1 (forwards). Default: equally spaced.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.table = _read_table(props)
        self.nodes = Lookup.from_table(self.table)
        super().__init__(props, {"values": mi.Float(self.table.values.astype(np.float32))})

    def refresh(self) -> None:
        values = self.parameters["values"]
        if dr.width(values) != len(self.table.values):
            raise MivolError(
                f"found {dr.width(values)} values of {self._name()}, expected {len(self.table.values)}, one for each cosine."
            )
        if not is_recording():
            check_values(np.array(dr.detach(values), dtype=np.float64), f"values of {self._name()}")
        self.values, self.integral, self.cumulative = self.nodes.normalise(values)
        dr.make_opaque(self.values, self.integral, self.cumulative)

    def eval_angle(self, angle: ScatteringAngle, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
        return self.nodes.eval(angle, self.values, self.integral, active)

    def sample_angle(self, u: mi.Float, mei: mi.MediumInteraction3f, active: mi.Bool) -> ScatteringAngle:
        return self.nodes.sample(u, self.values, self.integral, self.cumulative, active)

    def _name(self) -> str:
        return f"mivol_tabulated {self.id()}".strip()

    def to_string(self) -> str:
        return f"{self.kind}[{len(self.table.values)} nodes]"


class Mixture(mi.PhaseFunction):
    """``<phase type="mivol_mixture">``: a weighted sum of phase functions.

    Parameters:
        nested phase functions, each with a name, for instance ``haze``.
        weight_<name>: weight of each, at least 0, a float or a volume; divided by the sum of weights. Give all weights or
            none; default: equal weights.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        # Mitsuba raises for properties that are never read. So only phase functions are read, and other objects cause the
        # error.
        nested = dict(props.objects(False))
        self.lobes = {name: props[name] for name, part in nested.items() if isinstance(part, mi.PhaseFunction)}
        self.weights = _read_weights(props, list(self.lobes))
        flags = 0
        for lobe in self.lobes.values():
            flags |= int(lobe.flags())
        self.m_flags = flags
        self.refresh()

    def refresh(self) -> None:
        _check_parameters(self.weights, dict.fromkeys(self.weights, WEIGHT), "mivol_mixture")
        numbers = [w for w in self.weights.values() if not isinstance(w, mi.Volume)]
        if len(numbers) == len(self.weights) and not is_recording() and not any(w[0] > 0 for w in numbers):
            raise MivolError("the weights of mivol_mixture are all 0; at least one above 0 is expected.")

    def component_count(self, active: mi.Bool = True) -> int:
        return sum(_count_components(lobe) for lobe in self.lobes.values())

    def flags(self, index: int | mi.Bool | None = None, active: mi.Bool = True) -> int:
        if index is None or isinstance(index, (bool, mi.Bool)):
            return self.m_flags
        name, inner = self._find_component(index)
        lobe = self.lobes[name]
        return int(lobe.flags() if inner == ALL_COMPONENTS else lobe.flags(inner))

    def shares(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> list[mi.Float]:
        return normalise_weights([_eval_parameter(w, WEIGHT, mei, active) for w in self.weights.values()])

    def sample(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        with dr.suspend_grad():
            active = mi.Bool(active)
            shares = self.shares(mei, active)
            if ctx.component != ALL_COMPONENTS:
                share, lobe, inner = self._component(ctx, shares)
                wo, weight, pdf = lobe.sample(inner, mei, sample1, sample2, active)
                return wo, weight * share, pdf * share
            chosen, inside = choose_lobe(shares, sample1)
            wo = dr.zeros(mi.Vector3f)
            for k, lobe in enumerate(self.lobes.values()):
                selected = active & (chosen == k)
                wo = dr.select(selected, lobe.sample(ctx, mei, inside, sample2, selected)[0], wo)
            value, pdf = self._sum(ctx, mei, wo, shares, active)
            return wo, value * dr.select(pdf > 0, dr.rcp(pdf), 0), pdf

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        active = mi.Bool(active)
        shares = self.shares(mei, active)
        if ctx.component != ALL_COMPONENTS:
            share, lobe, inner = self._component(ctx, shares)
            value, pdf = lobe.eval_pdf(inner, mei, wo, active)
            return value * share, dr.detach(pdf * share)
        return self._sum(ctx, mei, wo, shares, active)

    def _sum(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        wo: mi.Vector3f,
        shares: list[mi.Float],
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Float]:
        value, pdf = mi.Spectrum(0), mi.Float(0)
        for share, lobe in zip(shares, self.lobes.values(), strict=True):
            value_k, pdf_k = lobe.eval_pdf(ctx, mei, wo, active)
            value, pdf = value + share * value_k, pdf + dr.detach(share * pdf_k)
        return value, pdf

    def _component(
        self, ctx: mi.PhaseFunctionContext, shares: list[mi.Float]
    ) -> tuple[mi.Float, mi.PhaseFunction, mi.PhaseFunctionContext]:
        """The lobe of a component, its share, and the context that selects the component."""
        name, index = self._find_component(ctx.component)
        inner = mi.PhaseFunctionContext(ctx.sampler, ctx.mode)
        inner.type_mask, inner.component = ctx.type_mask, index
        return shares[list(self.lobes).index(name)], self.lobes[name], inner

    def _find_component(self, index: int) -> tuple[str, int]:
        """The name of the lobe of a component, and the component's number inside the lobe."""
        left = index
        for name, lobe in self.lobes.items():
            if left < _count_components(lobe):
                return name, left if lobe.component_count() else ALL_COMPONENTS
            left -= _count_components(lobe)
        raise MivolError(f"component {index} of mivol_mixture was requested; the mixture has {self.component_count()}.")

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, weight in self.weights.items():
            callback.put(name, weight, mi.ParamFlags.Differentiable)
        for name, lobe in self.lobes.items():
            callback.put(name, lobe, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.refresh()

    def to_string(self) -> str:
        return "mivol_mixture[" + ", ".join(f"{n}={lobe}" for n, lobe in self.lobes.items()) + "]"


def _count_components(lobe: mi.PhaseFunction) -> int:
    """Number of components of a phase function; stock ``rayleigh`` reports 0 and counts as 1."""
    return max(lobe.component_count(), 1)


# -- Parameters: each a number or a volume ----------------------------------------------------------------------------


def _read_parameter(props: mi.Properties, name: str, default: float) -> mi.Float | mi.Volume:
    value = props.get(name, default)
    if isinstance(value, mi.Volume):
        return value
    if isinstance(value, (int, float)):
        return mi.Float(value)
    raise MivolError(f"{name} of {props.plugin_name()} is a {type(value).__name__}; a number or a volume is expected.")


def _format_value(value: mi.Float | mi.Volume) -> str:
    """Print a value. While ``dr.freeze`` records, numbers cannot be read."""
    if isinstance(value, mi.Volume):
        return value.class_name()
    return "recorded" if is_recording() else str(dr.detach(value))


def _check_parameters(parameters: dict[str, mi.Float | mi.Volume], domains: dict[str, Domain], owner: str) -> None:
    """Refuse values outside their domains, and make numbers opaque: recordings and compiled kernels do not bake them in."""
    for name, value in parameters.items():
        if not is_recording():
            for known in _known_values(value):
                _check_channels(known, f"{name} of {owner}")
                domains[name].check(np.array(dr.detach(known)), f"{name} of {owner}")
        if not isinstance(value, mi.Volume):
            dr.make_opaque(value)


def _known_values(value: mi.Float | mi.Volume) -> list[object]:
    if not isinstance(value, mi.Volume):
        return [value]
    params = traverse(value)
    return [params[key] for key in VOLUME_KEYS if key in params]


def _check_channels(known: mi.Float | mi.Color3f | mi.TensorXf, name: str) -> None:
    channels = known.shape[3] if dr.is_tensor_v(known) else dr.size_v(known) if dr.depth_v(known) > 1 else 1
    if channels != 1:
        raise MivolError(f"{name} has {channels} channels; a phase function has one value for all colours: give a grey volume.")


def _eval_parameter(value: mi.Float | mi.Volume, domain: Domain, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Float:
    return domain.project(value.eval_1(mei, active) if isinstance(value, mi.Volume) else value)


def _read_weights(props: mi.Properties, names: list[str]) -> dict[str, mi.Float | mi.Volume]:
    if not names:
        raise MivolError("mivol_mixture was given no phase function; nest at least one.")
    keys = [f"weight_{n}" for n in names]
    missing = [k for k in keys if k not in props]
    if 0 < len(missing) < len(keys):
        raise MivolError(f"mivol_mixture lacks {', '.join(missing)}; give a weight for each phase function, or for none.")
    return {k: _read_parameter(props, k, 1.0) for k in keys}


def _read_table(props: mi.Properties) -> Table:
    sources = [k for k in ("values", "moments", "filename") if k in props]
    if len(sources) != 1:
        found = " and ".join(sources) or "none of them"
        raise MivolError(f"mivol_tabulated was given {found}; give exactly one of values, moments or filename.")
    name = f"mivol_tabulated {props.id()}".strip()
    if sources == ["filename"]:
        return Table.from_csv(str(mi.file_resolver().resolve(props["filename"])))
    numbers = _numbers(props, sources[0], name)
    if sources == ["moments"]:
        return Table.from_moments(numbers, name=name)
    return Table(_numbers(props, "cosines", name), numbers, name) if "cosines" in props else Table.regular(numbers, name)


def _numbers(props: mi.Properties, key: str, name: str) -> np.ndarray:
    given = props[key]
    if not isinstance(given, str):
        return np.array(given, dtype=np.float64).ravel()
    try:
        return np.array([float(x) for x in given.replace(",", " ").split()])
    except ValueError as error:
        raise MivolError(f"{key} of {name} is not a list of numbers: {error}.") from error


mi.register_phase("mivol_hg", HenyeyGreenstein)
mi.register_phase("mivol_rayleigh", Rayleigh)
mi.register_phase("mivol_draine", Draine)
mi.register_phase("mivol_tabulated", Tabulated)
mi.register_phase("mivol_mixture", Mixture)
