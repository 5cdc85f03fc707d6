"""What is being looked for: a scene parameter, its domain, and the real numbers an optimiser moves instead.

Conventions. ``name`` is the key of ``mi.traverse(scene)``. A map takes the domain [low, high] to the reals and back;
optimisers step in the reals and project there, so that no loop asks what kind of parameter it holds. MAPS lists them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.priors import Prior
from mivol.optim.strategy import suggest_name

GRID = 4
"""Axes of a grid (Z, Y, X, C); harmonics of directions have one more."""


@dataclass(frozen=True)
class Map:
    """A monotone bijection between a domain and (part of) the reals.

    Attributes:
        to_reals: value, low, high -> reals; Dr.Jit or float, element by element.
        from_reals: reals, low, high -> value; differentiable through Dr.Jit.
        domains: which (low, high) it can serve, in words.
        serves: whether it can serve (low, high).
        says: what it does, with its source.
    """

    to_reals: Callable
    from_reals: Callable
    domains: str
    serves: Callable[[float, float], bool]
    says: str


def log1p_unit(x: mi.Float) -> mi.Float:
    """log(1 + x) for x in [0, 1] by 2 atanh(x / (2 + x)), in a form that AD differentiates without cancellation.

    The ratio s is at most 1/3: the first omitted term, s^17 / 17, is below 2e-9 of s, so the error is float32 rounding.
    """
    s = x / (2.0 + x)
    square = s * s
    total = 1.0 / 15.0
    for odd in (13.0, 11.0, 9.0, 7.0, 5.0, 3.0, 1.0):
        total = total * square + 1.0 / odd
    return 2.0 * s * total


def softplus(u: mi.Float) -> mi.Float:
    """log(1 + e^u) = max(u, 0) + log1p(e^-|u|): no overflow above, full relative precision below.

    Written with selections, since max(u, 0) and |u| have no slope at 0, where this has 1/2.
    """
    rises = u >= 0.0
    return dr.select(rises, u, 0.0) + log1p_unit(dr.exp(dr.select(rises, -u, u)))


def inverse_softplus(x: mi.Float) -> mi.Float:
    """log(e^x - 1) = x + log(1 - e^-x), x > 0.

    1 - e^-x loses 6e-8 / x in float32: below 1/2 its series serves, cut after x^8 / 8! (the next term is below 1e-8).
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


@dataclass(frozen=True)
class Parameter:
    """One scene parameter that is being looked for.

    Attributes:
        name: key of ``mi.traverse(scene)``.
        unit: of the value, for labels.
        domain: (low, high), closed; infinite ends are fine.
        map: key of MAPS.
        lr: step of Adam, in the map's reals (identity: the parameter's own unit).
        extent: edges (z, y, x) of a grid's box [length], for the voxel size that priors see.
        priors: what is known of the field before anything is measured.
    """

    name: str
    unit: str = "1"
    domain: tuple[float, float] = (-math.inf, math.inf)
    map: str = "identity"
    lr: float = 0.01
    extent: tuple[float, float, float] = (1.0, 1.0, 1.0)
    priors: tuple[Prior, ...] = ()

    def __post_init__(self) -> None:
        low, high = self.domain
        if not low < high:
            raise MivolError(f"{self.name}: domain [{low}, {high}] is empty: give the smaller bound first.")
        if self.map not in MAPS:
            raise MivolError(f'{self.name}: unknown map "{self.map}": {suggest_name(self.map, list(MAPS))}')
        if not MAPS[self.map].serves(low, high):
            raise MivolError(
                f'{self.name}: map "{self.map}" serves {MAPS[self.map].domains}, found [{low}, {high}]: '
                "change the domain or the map."
            )
        if not self.lr > 0.0:
            raise MivolError(f"{self.name}: learning rate {self.lr} is not positive: give a step size above 0.")

    def to_reals(self, value: mi.TensorXf) -> mi.TensorXf:
        """Value -> reals.

        Raises:
            MivolError: a value is not finite, lies outside the domain, or on a bound that the map sends to infinity; or a
                prior that compares neighbours has no grid to look at.
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
        """Voxel size (z, y, x) [length] of a grid of that shape; numbers and images have none, and count as 1 apart."""
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
        """Reals -> value, differentiable."""
        return MAPS[self.map].from_reals(u, *self.domain)

    def map_derivative(self, u: mi.TensorXf) -> mi.TensorXf:
        """dx/du of the map, entry by entry."""
        u = mi.TensorXf(dr.detach(u))
        dr.enable_grad(u)
        dr.backward(dr.sum(self.from_reals(u).array))
        return dr.grad(u)

    def bounds(self) -> tuple[float, float]:
        """The domain as an interval of the reals: infinite where the map never reaches the bound."""
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
        """Refuse a prior that compares neighbours where the parameter is no grid: an image's third axis is its colours.

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
        """Refuse values that are not finite or lie outside the domain, naming the first one.

        Raises:
            MivolError: with index and value.
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
    """A scene value (tensor, float or colour) as a tensor; attached as it was."""
    if isinstance(value, mi.TensorXf):
        return value
    flat = dr.ravel(value)
    return mi.TensorXf(flat, (dr.width(flat),))


def like(tensor: mi.TensorXf, value: object) -> object:
    """The inverse of :func:`as_tensor`, in the type of ``value``."""
    return tensor if isinstance(value, mi.TensorXf) else dr.unravel(type(value), tensor.array)


def check_names(names: Sequence[str]) -> None:
    """Refuse a fit that looks for one parameter twice.

    Raises:
        MivolError: with its name.
    """
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise MivolError(f"the fit looks for {twice} twice: give it one domain, start and map.")


def find(name: str, params: mi.SceneParameters) -> str:
    """The key of ``params`` of that name.

    Raises:
        MivolError: there is none (the nearest is offered), its id is a memory address that changes from run to run, or no
            derivative leads to what it is.
    """
    keys = list(params.keys())
    if name not in keys:
        raise MivolError(f'the scene has no parameter "{name}": {suggest_name(name, keys)}')
    if re.match(r"object_\d+", name):
        raise MivolError(f'"{name}" begins with a memory address, which changes from run to run: give the object an id.')
    if not (dr.is_array_v(params[name]) and dr.is_float_v(params[name])):
        raise MivolError(
            f'"{name}" is a {type(params[name]).__name__}, and a fit looks for numbers, colours, points and tensors of '
            "floating point that Dr.Jit holds: choose another parameter."
        )
    return name
