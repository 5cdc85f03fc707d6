r"""A scalar field seen through a transfer function: what value is how opaque, and of which colour.

.. math:: y(x) = (1 - f) y_i + f y_{i+1}, \qquad i + f = (n - 1)\, \frac{s(x) - s_0}{s_1 - s_0}

for a table y of n entries at equal steps of the value s from s_0 to s_1; values beyond them have the entry at the end. Given as
``sigma_t`` and as ``emission`` of a ``mivol_medium`` two such fields are the emission-absorption model of scans (Max 1995).
The scan's gradient may take part: :mod:`mivol.fields.shading`.

Conventions. The scalar grid is (Z, Y, X, 1), voxel centres, clamped borders, and may hold any finite number (Hounsfield
units are negative in air). It is refined ``refine`` times in each direction, then looked up, and what comes out is a grid like
any other: linear between its nodes. Classification therefore comes before that last interpolation, and what a table
does within a voxel is resolved to 1 / refine of it. Derivatives by the table and by the scalar grid are those of the look-up.

Bias: second order in 1 / refine, once a node's cell has one kink of the table at most (measured in
tests/conformance/test_transfer.py: 5e-2, 1.2e-2, 5e-3 and 3e-3 at refine 1, 3, 5 and 7 for a voxel that passes one or two).
An odd number keeps the scan's own nodes, where it has its peaks. Cost: memory grows with the cube of refine.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.shading import Shading, gradient_grid
from mivol.fields.voxels import Voxels
from mivol.files import read_volume

__all__ = [
    "Transfer",
    "check_domain",
    "check_table",
    "parse_domain",
    "look_up",
    "parse_table",
    "GradientOpacity",
    "GradientEffects",
]


def look_up(table: mi.TensorXf, domain: tuple[float, float], s: mi.Float) -> list[mi.Float]:
    """The table at values s, a list of channels; attached to both."""
    n, channels = table.shape
    low, high = domain
    u = dr.clip((s - low) * ((n - 1) / (high - low)), 0, n - 1)
    i = dr.minimum(mi.UInt32(u), n - 2)
    f, at = u - mi.Float(i), dr.ravel(table)
    ends = [[dr.gather(mi.Float, at, (i + k) * channels + c) for k in (0, 1)] for c in range(channels)]
    return [dr.lerp(*pair, f) for pair in ends]


def parse_table(text: object, what: str) -> np.ndarray:
    """Rows between commas, numbers between spaces: (n, C).

    Raises:
        MivolError: other things than numbers.
    """
    try:
        return np.array([[float(v) for v in row.split()] for row in str(text).split(",")])
    except ValueError as error:
        raise MivolError(f"{what} is {str(text)!r}; rows of numbers are expected, as in '0 0 0, 1 0.5 0.2'.") from error


def parse_domain(text: object, what: str) -> tuple[float, float]:
    """The two ends of a domain.

    Raises:
        MivolError: other things than two numbers.
    """
    ends = parse_table(text, what).ravel().tolist()
    if len(ends) != 2:
        raise MivolError(f"{what} is {text}; two numbers in rising order are expected.")
    return ends[0], ends[1]


def check_table(rows: np.ndarray, what: str, channels: tuple[int, ...] = (1, 3)) -> None:
    """Refuse what is no table.

    Args:
        rows: (n, C).
        what: the table's name in a sentence.
        channels: how many numbers an entry may have.

    Raises:
        MivolError: fewer than two entries, another number of channels, entries that are negative or not finite.
    """
    if rows.ndim != 2 or rows.shape[0] < 2 or rows.shape[1] not in channels or not (np.isfinite(rows) & (rows >= 0)).all():
        raise MivolError(
            f"{what} has the shape {rows.shape} and entries from {rows.min(initial=0):.4g}; at least two entries of "
            f"{' or '.join(map(str, channels))} finite numbers that are not negative are expected: clip them after each step."
        )


def check_domain(domain: tuple[float, float], what: str) -> None:
    """Refuse ends that are not finite or not in rising order.

    Raises:
        MivolError: such ends.
    """
    low, high = domain
    if not (np.isfinite([low, high]).all() and low < high):
        raise MivolError(f"{what} is {low:g}, {high:g}; two numbers in rising order are expected.")


@dataclass(frozen=True)
class GradientOpacity:
    """Factors on a table's entries by the magnitude of the gradient.

    Attributes:
        table: (n, 1), factors of at least 0.
        domain: magnitudes [value of the scan per length] of the first and the last factor.
    """

    table: mi.TensorXf
    domain: tuple[float, float]

    @classmethod
    def from_props(cls, props: mi.Properties, name: str, most: float) -> GradientOpacity | None:
        """Build from plugin parameters: ``gradient_opacity`` and ``gradient_domain``; None where there is no table.

        Args:
            props: of the plugin.
            name: of the plugin in a sentence.
            most: the largest magnitude of the scan's gradient: where the last factor is, unless a domain is given.

        Raises:
            MivolError: a table or a domain of another kind.
        """
        domain = (0.0, most or 1.0)
        if "gradient_domain" in props:
            domain = parse_domain(props["gradient_domain"], f"the gradient_domain of {name}")
        if "gradient_opacity" not in props:
            return None
        rows = parse_table(props["gradient_opacity"], f"the gradient_opacity of {name}")
        check_table(rows, f"the gradient_opacity of {name}", (1,))
        check_domain(domain, f"the gradient_domain of {name}")
        return cls(mi.TensorXf(np.ascontiguousarray(rows, dtype=np.float32)), domain)

    def factor(self, gradient: mi.Vector3f) -> mi.Float:
        """The factor at points of such gradients."""
        return look_up(self.table, self.domain, dr.norm(gradient))[0]


@dataclass(frozen=True)
class GradientEffects:
    """What is made of a scan's gradient: factors, light, both or nothing."""

    opacity: GradientOpacity | None = None
    shading: Shading | None = None

    @classmethod
    def from_props(cls, props: mi.Properties, field: mi.TensorXf, to_world: np.ndarray, name: str) -> GradientEffects:
        """Build from the parameters of a plugin that shows a scan (Z, Y, X, 1) in a box of the world.

        Raises:
            MivolError: as :class:`Shading` and :class:`GradientOpacity`.
        """
        needs_most = "gradient_opacity" in props and "gradient_domain" not in props
        with dr.suspend_grad():
            most = np.linalg.norm(np.array(gradient_grid(field, to_world)), axis=-1).max() if needs_most else 0.0
        return cls(GradientOpacity.from_props(props, name, float(most)), Shading.from_props(props, name))

    @property
    def is_flat(self) -> bool:
        """Whether the gradient changes nothing."""
        return self.opacity is None and self.shading is None

    def apply(self, entries: list[mi.Float], gradient: mi.Vector3f, p: mi.Point3f) -> list[mi.Float]:
        """A table's entries at points of the world, times their factor, and lit."""
        if self.opacity is not None:
            factor = self.opacity.factor(gradient)
            entries = [entry * factor for entry in entries]
        return entries if self.shading is None else self.shading.shade(entries, gradient, p)


class Transfer:
    """A grid that is a table of another one.

    Args:
        field: scalar values (Z, Y, X, 1), finite.
        table: (n, C) entries, n at least 2, C 1 or 3, finite and at least 0, and the values [of the field] of the first and
            the last entry.
        refine: how many nodes stand for a voxel in each direction.
        to_world: (4, 4) affine map of the unit cube to the world.
        name: what the grid is called in a sentence that refuses it.
        effects: what is made of the field's gradient.

    Raises:
        MivolError: a field, a table, a domain or a placement of another kind.
    """

    def __init__(
        self,
        field: mi.TensorXf,
        table: tuple[mi.TensorXf, tuple[float, float]],
        refine: int,
        to_world: np.ndarray,
        name: str,
        effects: GradientEffects = GradientEffects(),
    ) -> None:
        entries, self.domain = table
        self.name, self.refine, self.to_world, self.effects = name, refine, to_world, effects
        self.field = _add_channel_axis(field)
        self.table = entries if len(entries.shape) != 1 else mi.TensorXf(entries.array, (*entries.shape, 1))
        self._check()
        self.voxels = Voxels(self.classify(), to_world, name)

    @classmethod
    def from_props(cls, props: mi.Properties) -> Transfer:
        """Build from plugin parameters: ``filename`` or ``data``; ``table``; ``domain``; ``refine``; ``to_world``; a effects's.

        Raises:
            MivolError: as the class, or a text that holds other things than numbers.
        """
        name = f"mivol_transfer {props.id()}".strip()
        sources = [k for k in ("filename", "data") if k in props]
        if len(sources) != 1 or "table" not in props:
            raise MivolError(f"{name} was given {', '.join(sources) or 'no field'}; give filename or data, and a table.")
        field = props["data"] if sources == ["data"] else read_volume(_path(props["filename"]), frame="unit").values
        field = _tensor(np.array(field, dtype=np.float32)) if not isinstance(field, mi.TensorXf) else field
        table = props["table"]
        table = table if isinstance(table, mi.TensorXf) else _tensor(parse_table(table, f"the table of {name}"))
        domain = parse_domain(props["domain"], f"the domain of {name}") if "domain" in props else _value_range(field)
        place = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
        refine = props.get("refine", 1)
        if type(refine) is not int:
            raise MivolError(f"refine of {name} is {refine!r}; a whole number of nodes per voxel is expected, at least 1.")
        field = _add_channel_axis(field)
        _check_field(field, name)
        return cls(field, (table, domain), refine, place, name, GradientEffects.from_props(props, field, place, name))

    def classify(self) -> mi.TensorXf:
        """The table's entries at the nodes of the refined grid, (Z, Y, X, C), with derivatives by table and field."""
        (s,), res = self._refined(self.field)
        rows = self._entries(s)
        if not self.effects.is_flat:
            gradient, _ = self._refined(gradient_grid(self.field, self.to_world))
            rows = self.effects.apply(rows, mi.Vector3f(*gradient), self._places(res))
        flat = rows[0] if len(rows) == 1 else dr.ravel(mi.Vector3f(*rows))
        return mi.TensorXf(flat, (*res, len(rows)))

    def interpolation_error(self) -> float:
        """How far the classified grid is from the table half-way between its nodes: rms over its edges, in its largest entry.

        Cost: 9 look-ups a node of the refined grid.
        """
        with dr.suspend_grad():
            (s,), res = self._refined(self.field)
            values, squares = np.array(s).reshape(res), []
            for axis in range(3):
                ends = [mi.Float(values.take(range(k, res[axis] - 1 + k), axis).ravel()) for k in (0, 1)]
                if dr.width(ends[0]):
                    middle, *sides = (self._entries(v) for v in (0.5 * (ends[0] + ends[1]), *ends))
                    squares += [np.square(m - 0.5 * (a + b)) for m, a, b in zip(middle, *sides, strict=True)]
            largest = float(np.max(np.array(self.table)))
        return float(np.sqrt(np.concatenate(squares).mean())) / largest if squares and largest > 0 else 0.0

    def _entries(self, s: mi.Float) -> list[mi.Float]:
        """The table at scalar values, a list of channels."""
        return look_up(self.table, self.domain, s)

    def refresh(self) -> None:
        """Take over a table or a field that was replaced from outside.

        Raises:
            MivolError: as the class (values are looked at, unless ``dr.freeze`` is recording).
        """
        if not dr.flag(dr.JitFlag.FreezingScope):
            self._check()
        self.voxels.texture.set_tensor(self.classify())

    def _refined(self, grid: mi.TensorXf) -> tuple[list[mi.Float], tuple[int, int, int]]:
        """A grid (Z, Y, X, C) at the nodes of the refined grid, a list of channels, and its resolution (Z, Y, X)."""
        k, (z, y, x, channels) = self.refine, grid.shape
        if k == 1:
            return [dr.ravel(grid)] if channels == 1 else list(dr.unravel(mi.Vector3f, grid.array)), (z, y, x)
        texture = mi.Texture3f(grid, use_accel=False, migrate=False)
        return texture.eval(_node_positions((k * z, k * y, k * x))), (k * z, k * y, k * x)

    def _places(self, res: tuple[int, int, int]) -> mi.Point3f:
        """The nodes of the refined grid in the world."""
        return mi.AffineTransform4f(mi.ScalarMatrix4f(self.to_world)) @ _node_positions(res)

    def _check(self) -> None:
        _check_field(self.field, self.name)
        check_table(np.array(dr.detach(self.table)), f"the table of {self.name}")
        check_domain(self.domain, f"the domain of {self.name}")
        if self.refine < 1:
            raise MivolError(f"refine of {self.name} is {self.refine}; a whole number of at least 1 is expected.")


def _add_channel_axis(field: mi.TensorXf) -> mi.TensorXf:
    """Scalar values with their axis of one channel."""
    return field if len(field.shape) != 3 else mi.TensorXf(field.array, (*field.shape, 1))


def _value_range(field: mi.TensorXf) -> tuple[float, float]:
    """The least and the largest value."""
    values = np.array(dr.detach(field))
    return (float(np.min(values)), float(np.max(values))) if values.size else (0.0, 0.0)


def _node_positions(res: tuple[int, int, int]) -> mi.Point3f:
    """The nodes of a grid in the unit cube."""
    z, y, x = dr.meshgrid(*[(dr.arange(mi.Float, n) + 0.5) / n for n in res], indexing="ij")
    return mi.Point3f(x, y, z)


def _check_field(field: mi.TensorXf, name: str) -> None:
    if len(field.shape) != 4 or field.shape[3] != 1 or not np.isfinite(np.array(dr.detach(field))).all():
        raise MivolError(
            f"{name} was given a field of shape {tuple(field.shape)} (or with NaN in it); (Z, Y, X, 1) finite numbers are "
            "expected."
        )


def _tensor(values: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32))


def _path(name: str) -> str:
    return str(mi.file_resolver().resolve(name))
