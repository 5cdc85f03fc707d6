r"""An extinction of a hash grid and a small network, with a majorant that holds for any weights.

.. math:: f(x) = m\, S(h(x) - 3), \qquad S(y) = \frac{1}{1 + e^{-y}}, \qquad 0 < f < m

h is the output of the network for the features of x (:mod:`mivol.fields.hash_grid`), and m the bound. The logistic function is
bounded, so m is a majorant of every table and every network: a fit never has to search for one. Untrained, h is about 0 and f
about 0.05 m.

:class:`TabulatedDensity` evaluates f at the nodes of a grid, trilinear between them. Rays then cross cells as in voxels, and
a step of a fit evaluates the network once a node, not at every point of every path.

Conventions. The parameters are tensors: ``table`` (rows, features), and ``weights_k`` (outputs, inputs) of layer k. The field
is grey, and 0 outside the box.

References: Müller et al. 2022 (encoding). Their activation, an exponential, has no bound.
"""

from __future__ import annotations

from copy import copy
from typing import Any, ClassVar

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.hash_encoding import HashEncoding, HashSizes
from mivol.fields.networks import Network
from mivol.fields.protocol import BOUNDED, accumulate_tracked
from mivol.fields.sampled_field import SampledField
from mivol.fields.voxels import Voxels

__all__ = ["FittedDensity", "HashDensity", "TabulatedDensity"]

SHIFT = 3.0
"""An untrained field has S(-3) = 0.047 of the bound: most of a box is thin."""

SETTINGS = {name: name for name in ("levels", "features", "log2_table", "coarsest", "finest", "width")} | {
    "layers": "density_layers"
}
"""Sizes by the name of a plugin's parameter."""


class HashDensity:
    """A bounded extinction (:class:`mivol.fields.protocol.Field`).

    Attributes:
        sizes: of grid and network.
        to_world: (4, 4) float64, unit cube to world.
        largest: the bound m [1/length].
        tensors: parameters by name.
    """

    line: ClassVar[str] = BOUNDED
    channels: ClassVar[int] = 1
    may_jump: ClassVar[bool] = False

    def __init__(self, sizes: HashSizes, to_world: np.ndarray, largest: float, tensors: dict[str, mi.TensorXf]) -> None:
        if not 0 < largest < np.inf:
            raise MivolError(f"found the bound {largest:g} of a mivol_hash, expected a finite number above 0: give majorant.")
        self.sizes, self.to_world, self.largest = sizes, np.asarray(to_world, np.float64), largest
        self.encoding = HashEncoding(sizes, self.to_world)
        for name, shape in self.shapes().items():
            if tuple(tensors[name].shape) != shape:
                found = f"{name} of the shape {tuple(tensors[name].shape)}"
                raise MivolError(f"mivol_hash was given {found}; {shape} is expected by its sizes.")
            if not np.isfinite(np.array(dr.detach(tensors[name].array))).all():
                raise MivolError(f"mivol_hash was given {name} with values that are not finite: start from others.")
        self.tensors = tensors

    @classmethod
    def from_props(cls, props: mi.Properties) -> HashDensity:
        """Make a field from plugin parameters: ``majorant``, ``to_world``, sizes, ``seed``, or tensors.

        Raises:
            MivolError: sizes or tensors that contradict each other, some tensors only, or no majorant.
        """
        if "majorant" not in props:
            raise MivolError("mivol_hash was given no majorant: give the largest extinction that it may take [1/length].")
        given = {name: int(props[key]) for key, name in SETTINGS.items() if key in props}
        sizes = HashSizes(**{"coarsest": 4, "finest": 32, "geometry": 1, "width": 16} | given)
        place = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
        untrained = cls.untrained(sizes, place, float(props["majorant"]), int(props.get("seed", 0)))
        names = list(untrained.tensors)
        given = {name: props[name] for name in names if name in props}
        if given and len(given) < len(names):
            raise MivolError(f"mivol_hash was given {' and '.join(given)}; all of {', '.join(names)} or none are expected.")
        return cls(sizes, place, untrained.largest, given) if given else untrained

    @classmethod
    def untrained(cls, sizes: HashSizes, to_world: np.ndarray, largest: float, seed: int = 0) -> HashDensity:
        """A field of small random features and random weights."""
        rng, network = np.random.default_rng(seed), sizes.density_network
        layers = network.layers(network.first_weights(rng))
        first = {"table": HashEncoding(sizes, to_world).first_table(rng)}
        first |= {f"weights_{k}": np.ascontiguousarray(layer) for k, layer in enumerate(layers)}
        return cls(sizes, to_world, largest, {name: mi.TensorXf(values) for name, values in first.items()})

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter, by name."""
        layers = self.sizes.density_network.shapes
        return {"table": self.encoding.shape} | {f"weights_{k}": shape for k, shape in enumerate(layers)}

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        unit = self.encoding.to_unit(p)
        return [self.eval_unit(unit, mi.Bool(active) & dr.all((unit >= 0) & (unit <= 1)))]

    def eval_unit(self, unit: mi.Point3f, inside: mi.Bool) -> mi.Float:
        """Values at points of the unit cube; 0 for the lanes outside."""
        layers = [nn.view(self.tensors[f"weights_{k}"]) for k in range(len(self.sizes.density_network.shapes))]
        raw = Network.eval_lanes(layers, self.encoding.encode(self.tensors["table"].array, unit, inside))[0]
        return dr.select(inside, self.largest * dr.rcp(1 + dr.exp(SHIFT - raw)), 0)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Cells (Z, Y, X) of the finest level."""
        return self.encoding.levels[-1].cells[::-1]

    def slopes(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Vector3f]:
        fixed = copy(self)
        fixed.tensors = dr.detach(self.tensors)
        with dr.resume_grad():
            place = mi.Point3f(p)
            dr.enable_grad(place)
            dr.backward_from(fixed.eval(place, w, active)[0])
            return [mi.Vector3f(dr.grad(place))]

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
        accumulate_tracked(self, p, w, d, active)

    def bound(self) -> list[float]:
        return [self.largest]

    def parameters(self) -> dict[str, Any]:
        return self.tensors


MOST_NODES = 1 << 27
"""Largest number of nodes of a table."""


class FittedDensity:
    """The extinction of a hash grid or a NeRF fitted to photographs, with its tensors.

    Attributes:
        field: with a region, in an upright box.
        tensors: parameters by name, without parameters of the colours alone.
    """

    def __init__(self, field: SampledField) -> None:
        self.field, self.to_world = field, field.to_world
        self.tensors = {name: value for name, value in field.parameters().items() if not name.startswith("colour")}

    def eval_unit(self, unit: mi.Point3f, inside: mi.Bool) -> mi.Float:
        """Values at points of the unit cube; 0 in cells that are not occupied, and for the lanes outside."""
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in self.to_world[:3]]
        p = mi.Point3f(*(dr.fma(r[0], unit.x, dr.fma(r[1], unit.y, dr.fma(r[2], unit.z, r[3]))) for r in rows))
        changed = self.field.with_parameters(self.field.parameters() | self.tensors)
        return dr.select(inside & self.field.region.holds(p), changed.eval_density(p), 0)

    def parameters(self) -> dict[str, Any]:
        return self.tensors


class TabulatedDensity:
    """A hash grid or a NeRF at the nodes of a grid over its box: voxels that follow the tensors, with their derivatives.

    Args:
        density: the hash grid, or the density of a fitted field.
        nodes: nodes along the longest edge of the box, at least 1; voxels are nearly cubes.

    Raises:
        MivolError: another number of nodes, or more than ``MOST_NODES`` in the box.
    """

    def __init__(self, density: HashDensity | FittedDensity, nodes: int) -> None:
        edges = np.linalg.norm(density.to_world[:3, :3], axis=0)
        res = [max(1, round(nodes * float(edge / edges.max()))) for edge in edges[::-1]]
        if nodes < 1 or np.prod(res, dtype=np.float64) > MOST_NODES:
            raise MivolError(
                f"mivol_hash was given {nodes} nodes along its longest edge; 1 to {MOST_NODES} nodes in its box are expected."
            )
        self.density, self.res = density, tuple(res)
        self.voxels = Voxels(self.tabulate(), density.to_world, "mivol_hash")

    def tabulate(self) -> mi.TensorXf:
        """Values at the nodes (Z, Y, X, 1); derivatives by the tensors pass through."""
        z, y, x = dr.meshgrid(*[(dr.arange(mi.Float, n) + 0.5) / n for n in self.res], indexing="ij")
        values = self.density.eval_unit(mi.Point3f(x, y, z), mi.Bool(True))
        return mi.TensorXf(values, (*self.res, 1))

    def refresh(self) -> None:
        """Evaluate the nodes again, after the tensors were replaced."""
        self.voxels.replace(self.tabulate())
