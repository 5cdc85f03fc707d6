"""Parameters of a scene: their domains, priors, and the real numbers that an optimizer moves.

Conventions. ``name`` is a key of ``mi.traverse(scene)``. A map takes the domain [low, high] to the reals and back. Optimizers
step and project in the reals, and the fit loop is the same for all parameters. MAPS lists the maps.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.priors import Prior
from mivol.optim.strategy import check_strategy, suggest_name

ADDRESS = r"^object_\d+"
"""The name that Mitsuba gives an object without an id: its address in memory, another one in each run."""

GRID = 4
"""Axes of a grid (Z, Y, X, C); spherical harmonics have one more axis."""


@dataclass(frozen=True)
class Map:
    """A monotone bijection between a domain and a part of the reals.

    Attributes:
        to_reals: value, low, high -> reals; Dr.Jit or float, element by element.
        from_reals: reals, low, high -> value; differentiable through Dr.Jit.
        domains: supported (low, high), in words.
        supports: whether the map supports (low, high).
        description: effect and source of the map.
    """

    to_reals: Callable
    from_reals: Callable
    domains: str
    supports: Callable[[float, float], bool]
    description: str


def log1p_unit(x: mi.Float) -> mi.Float:
    """log(1 + x) for x in [0, 1] as 2 atanh(x / (2 + x)), differentiable without cancellation.

    The ratio s is at most 1/3. The first omitted term, s^17 / 17, is below 2e-9 of s, so the error is float32 rounding.
    """
    s = x / (2.0 + x)
    square = s * s
    total = 1.0 / 15.0
    for odd in (13.0, 11.0, 9.0, 7.0, 5.0, 3.0, 1.0):
        total = total * square + 1.0 / odd
    return 2.0 * s * total


def softplus(u: mi.Float) -> mi.Float:
    """log(1 + e^u) = max(u, 0) + log1p(e^-|u|): no overflow above, full relative precision below.

    Written with selections, since max(u, 0) and |u| have no slope at 0; here the slope is 1/2.
    """
    rises = u >= 0.0
    return dr.select(rises, u, 0.0) + log1p_unit(dr.exp(dr.select(rises, -u, u)))


def inverse_softplus(x: mi.Float) -> mi.Float:
    """log(e^x - 1) = x + log(1 - e^-x), x > 0.

    1 - e^-x loses 6e-8 / x in float32. Below 1/2 its series is used, cut after x^8 / 8! (the next term is below 1e-8).
    """
    series = 1.0 / 40320.0
    for factorial in (-5040.0, 720.0, -120.0, 24.0, -6.0, 2.0, -1.0):
        series = series * x - 1.0 / factorial
    return x + dr.log(dr.select(x < 0.5, series * x, 1.0 - dr.exp(-x)))


MAPS: dict[str, Map] = {
    "identity": Map(
        lambda value, low, high: value,
        lambda u, low, high: u,
        "any domain",
        lambda low, high: True,
        "the value itself, projected onto its bounds after each step",
    ),
    "softplus": Map(
        lambda value, low, high: inverse_softplus(value - low),
        lambda u, low, high: low + softplus(u),
        "a finite lower and no upper bound",
        lambda low, high: math.isfinite(low) and high == math.inf,
        "low + log(1 + e^u): linear far from the bound, exponential near it (Dugas et al. 2001)",
    ),
    "log": Map(
        lambda value, low, high: dr.log(value),
        lambda u, low, high: dr.exp(u),
        "a lower bound of at least 0",
        lambda low, high: low >= 0.0,
        "e^u: steps are relative changes",
    ),
    "logistic": Map(
        lambda value, low, high: dr.log((value - low) / (high - value)),
        lambda u, low, high: low + (high - low) / (1.0 + dr.exp(-u)),
        "two finite bounds",
        lambda low, high: math.isfinite(low) and math.isfinite(high),
        "low + (high - low) / (1 + e^-u)",
    ),
}


class ParameterKind(NamedTuple):
    """What a parameter is: the unit of its values, and the closed domain (low, high) that makes sense of them."""

    unit: str
    domain: tuple[float, float]


NOT_NEGATIVE, SHARE, ANY = (0.0, math.inf), (0.0, 1.0), (-math.inf, math.inf)

PARAMETER_KINDS = {
    "sigma_t": ParameterKind("1/length", NOT_NEGATIVE),
    "sigma_a": ParameterKind("1/length", NOT_NEGATIVE),
    "sigma_s": ParameterKind("1/length", NOT_NEGATIVE),
    "g": ParameterKind("1", (-0.999, 0.999)),  # at -1 and 1 a phase function is a delta function
    "position": ParameterKind("length", ANY),
    "radiance": ParameterKind("radiance", NOT_NEGATIVE),
    "irradiance": ParameterKind("radiance sr", NOT_NEGATIVE),
    "intensity": ParameterKind("radiance length²", NOT_NEGATIVE),
    "scale": ParameterKind("1", NOT_NEGATIVE),
    "data": ParameterKind("", NOT_NEGATIVE),
    **dict.fromkeys(("albedo", "reflectance", "alpha", "base_color", "roughness", "metallic"), ParameterKind("1", SHARE)),
    **dict.fromkeys(("diffuse_reflectance", "specular_reflectance", "specular_transmittance"), ParameterKind("1", SHARE)),
}
"""Kinds by the last word of a key. Mitsuba's extinction is ``scale`` times ``sigma_t``, its sky ``scale`` times ``data``:
only one factor has the unit."""


def find_parameter_kind(key: str) -> ParameterKind:
    """The kind of a key: of its last word, or of the word before ``data`` and ``value``; else any number without a unit."""
    words = key.split(".")
    while len(words) > 1 and words[-1] in ("data", "value") and words[-2] in {*PARAMETER_KINDS, "value"}:
        words.pop()
    return PARAMETER_KINDS.get(words[-1], ParameterKind("", ANY))


@dataclass(frozen=True)
class Parameter:
    """A scene parameter to fit.

    Attributes:
        name: key of ``mi.traverse(scene)``.
        unit: unit of the value, for labels; by default the usual unit of the key.
        domain: (low, high), closed; ends may be infinite. By default the domain that makes sense for the key: an extinction is
            not negative, an albedo is at most 1.
        map: "identity", "softplus", "log" or "logistic": how a free real number becomes the value.
        lr: step of Adam in this real number; with "identity" it has the parameter's unit.
        extent: edges (z, y, x) of a grid's box [length], for the voxel size in priors.
        priors: prior knowledge about the field.
    """

    name: str
    unit: str = ""
    domain: tuple[float, float] | None = None
    map: str = "identity"
    lr: float = 0.01
    extent: tuple[float, float, float] = (1.0, 1.0, 1.0)
    priors: tuple[Prior, ...] = ()

    def __post_init__(self) -> None:
        usual = find_parameter_kind(self.name)
        object.__setattr__(self, "unit", self.unit or usual.unit)
        object.__setattr__(self, "domain", usual.domain if self.domain is None else self.domain)
        low, high = self.domain
        if not low < high:
            raise MivolError(f"{self.name}: domain [{low}, {high}] is empty: give the smaller bound first.")
        if self.map not in MAPS:
            raise MivolError(f'{self.name}: unknown map "{self.map}": {suggest_name(self.map, list(MAPS))}')
        if not MAPS[self.map].supports(low, high):
            raise MivolError(
                f'{self.name}: map "{self.map}" supports {MAPS[self.map].domains}, found [{low}, {high}]: '
                "change the domain or the map."
            )
        if not self.lr > 0.0:
            raise MivolError(f"{self.name}: learning rate {self.lr} is not positive: give a step size above 0.")
        if not isinstance(self.priors, Sequence) or not all(isinstance(prior, Prior) for prior in self.priors):
            raise MivolError(f"{self.name}: found the priors {self.priors!r:.80}, expected a list of priors.")
        for prior in self.priors:
            check_strategy(prior)

    def to_reals(self, value: mi.TensorXf) -> mi.TensorXf:
        """Reals of a value.

        Raises:
            MivolError: a value is not finite, lies outside the domain, or lies on a bound that the map sends to infinity; or a
                prior that compares neighbours acts on a parameter that is no grid.
        """
        self.check(np.asarray(value))
        self.check_priors(value.shape)
        reals = MAPS[self.map].to_reals(value, *self.domain)
        if not np.all(np.isfinite(np.asarray(reals))):
            raise MivolError(
                f"{self.name}: the start lies on the bound of [{self.domain[0]}, {self.domain[1]}], which map "
                f'"{self.map}" sends to infinity: start inside it.'
            )
        return reals

    def spacing(self, shape: tuple[int, ...]) -> tuple[float, float, float]:
        """Voxel size (z, y, x) [length] of a grid of this shape; 1 for numbers and images."""
        if len(shape) < GRID:
            return 1.0, 1.0, 1.0
        return tuple(edge / n for edge, n in zip(self.extent, shape[:3], strict=True))

    def energy(self, value: mi.TensorXf) -> mi.Float:
        """Sum of the weighted energies of the priors."""
        total = mi.Float(0.0)
        for prior in self.priors:
            total += prior.weight * prior.energy(value, self.spacing(value.shape))
        return total

    def from_reals(self, u: mi.TensorXf) -> mi.TensorXf:
        """Value of reals, differentiable."""
        return MAPS[self.map].from_reals(u, *self.domain)

    def map_derivative(self, u: mi.TensorXf) -> mi.TensorXf:
        """dx/du of the map, entry by entry."""
        u = mi.TensorXf(dr.detach(u))
        dr.enable_grad(u)
        dr.backward(dr.sum(self.from_reals(u).array))
        return dr.grad(u)

    def bounds(self) -> tuple[float, float]:
        """The domain as an interval of the reals: infinite if the map never reaches the bound."""
        low, high = self.domain
        if self.map == "identity":
            return low, high
        if self.map == "log":
            return (math.log(low) if low > 0.0 else -math.inf), math.log(high)
        return -math.inf, math.inf

    def project(self, u: mi.TensorXf) -> mi.TensorXf:
        """The nearest point of the domain, in the reals."""
        low, high = self.bounds()
        if low > -math.inf:
            u = dr.maximum(u, low)
        return dr.minimum(u, high) if high < math.inf else u

    def check_priors(self, shape: tuple[int, ...]) -> None:
        """Check the shape for spatial priors: they need a grid, since an image's third axis holds colours.

        Raises:
            MivolError: with the prior.
        """
        prior = next((prior.label() for prior in self.priors if prior.is_spatial), None)
        if prior is not None and len(shape) < GRID:
            raise MivolError(
                f'{self.name} has the shape {tuple(shape)}, and the prior "{prior}" compares neighbours in a grid: '
                'leave it out, or take "l1" or "bounds".'
            )

    def check(self, value: np.ndarray) -> None:
        """Check that all values are finite and inside the domain.

        Raises:
            MivolError: with index and value of the first invalid number.
        """
        low, high = self.domain
        bad = ~(np.isfinite(value) & (value >= low) & (value <= high))
        if bad.any():
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            raise MivolError(
                f"{self.name}{list(index)} = {value[index]:g} {self.unit}, expected a number in [{low:g}, {high:g}]: "
                "correct the start or widen the domain."
            )


def as_tensor(value: object) -> mi.TensorXf:
    """A scene value (tensor, float or colour) as a tensor; gradients stay attached."""
    if isinstance(value, mi.TensorXf):
        return value
    flat = dr.ravel(value)
    return mi.TensorXf(flat, (dr.width(flat),))


def to_type_of(tensor: mi.TensorXf, value: object) -> object:
    """The inverse of :func:`as_tensor`, in the type of ``value``."""
    return tensor if isinstance(value, mi.TensorXf) else dr.unravel(type(value), tensor.array)


def check_names(names: Sequence[str]) -> None:
    """Check that no parameter appears twice in a fit.

    Raises:
        MivolError: with the name.
    """
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise MivolError(f"the parameter {twice} appears twice: keep one entry with one domain, start and map.")


def find_key(name: str, params: mi.SceneParameters) -> str:
    """The key of ``params`` with this name.

    Raises:
        MivolError: no such key (the message offers the nearest), an id that is a memory address and changes from run to run, or
            a value without derivatives.
    """
    keys = list(params.keys())
    if re.match(ADDRESS, name):
        raise MivolError(f'"{name}" begins with a memory address, which changes from run to run: give the object an id.')
    if name not in keys:
        hint = suggest_name(name, [re.sub(ADDRESS, "<id>", key) for key in keys])
        if "<id>" in hint:
            hint = f"{hint[:-1]}: give the objects without a name an id in the scene, and write it in the place of <id>."
        raise MivolError(f'the scene has no parameter "{name}": {hint}')
    if not (dr.is_array_v(params[name]) and dr.is_float_v(params[name])):
        raise MivolError(
            f'"{name}" is a {type(params[name]).__name__}, expected a number, colour, point or tensor of floating point that '
            "Dr.Jit can differentiate: choose another parameter."
        )
    return name
