r"""A scalar field seen through a transfer function: what value is how opaque, and of which colour.

.. math:: y(x) = (1 - f) y_i + f y_{i+1}, \qquad i + f = (n - 1)\, \frac{s(x) - s_0}{s_1 - s_0}

for a table y of n entries at equal steps of the value s from s_0 to s_1; values beyond them have the entry at the end. Given as
``sigma_t`` and as ``emission`` of a ``mivol_medium`` two such fields are the emission-absorption model of scans (Max 1995).

Conventions. The scalar grid is (Z, Y, X, 1), voxel centres, clamped borders, and may hold any finite number (Hounsfield
units are negative in air). It is refined ``refine`` times in each direction, then looked up, and what comes out is a grid like
any other: linear between its nodes. Classification therefore comes before that last interpolation, and what a table
does within a voxel is resolved to 1 / refine of it. Derivatives by the table and by the scalar grid are those of the look-up.

Bias: second order in 1 / refine, once a node's cell has one kink of the table at most (measured in
tests/conformance/test_transfer.py: 5e-2, 1.2e-2, 5e-3 and 3e-3 at refine 1, 3, 5 and 7 for a voxel that passes one or two).
An odd number keeps the scan's own nodes, where it has its peaks. Cost: memory grows with the cube of refine.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.voxels import Voxels
from mivol.files import read_volume

__all__ = ["Transfer"]


class Transfer:
    """A grid that is a table of another one.

    Args:
        field: scalar values (Z, Y, X, 1), finite.
        table: (n, C) entries, n at least 2, C 1 or 3, finite and at least 0.
        domain: values [of the field] of the first and the last entry.
        refine: how many nodes stand for a voxel in each direction.
        to_world: (4, 4) affine map of the unit cube to the world.
        name: what the grid is called in a sentence that refuses it.

    Raises:
        MivolError: a field, a table, a domain or a placement of another kind.
    """

    def __init__(
        self, field: mi.TensorXf, table: mi.TensorXf, domain: tuple[float, float], refine: int, to_world: np.ndarray, name: str
    ) -> None:
        self.name, self.domain, self.refine = name, domain, refine
        self.field = field if len(field.shape) != 3 else mi.TensorXf(field.array, (*field.shape, 1))
        self.table = table if len(table.shape) != 1 else mi.TensorXf(table.array, (*table.shape, 1))
        self._check()
        self.voxels = Voxels(self.classified(), to_world, name)

    @classmethod
    def from_props(cls, props: mi.Properties) -> Transfer:
        """Build from plugin parameters: ``filename`` or ``data``; ``table``; ``domain``; ``refine``; ``to_world``.

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
        table = table if isinstance(table, mi.TensorXf) else _tensor(_numbers(table, f"the table of {name}"))
        values = np.array(dr.detach(field))
        low, high = (float(np.min(values)), float(np.max(values))) if values.size else (0.0, 0.0)
        if "domain" in props:
            ends = _numbers(props["domain"], f"the domain of {name}").ravel().tolist()
            if len(ends) != 2:
                raise MivolError(f"the domain of {name} is {props['domain']}; two numbers in rising order are expected.")
            low, high = ends
        place = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
        refine = props.get("refine", 1)
        if type(refine) is not int:
            raise MivolError(f"refine of {name} is {refine!r}; a whole number of nodes per voxel is expected, at least 1.")
        return cls(field, table, (low, high), refine, place, name)

    def classified(self) -> mi.TensorXf:
        """The table's entries at the nodes of the refined grid, (Z, Y, X, C), with derivatives by table and field."""
        s, res = self._refined()
        rows = self._entries(s)
        flat = rows[0] if len(rows) == 1 else dr.ravel(mi.Vector3f(*rows))
        return mi.TensorXf(flat, (*res, len(rows)))

    def departure(self) -> float:
        """How far the classified grid is from the table half-way between its nodes: rms over its edges, in its largest entry.

        Cost: 9 look-ups a node of the refined grid.
        """
        with dr.suspend_grad():
            s, res = self._refined()
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
        n, channels = self.table.shape
        low, high = self.domain
        u = dr.clip((s - low) * ((n - 1) / (high - low)), 0, n - 1)
        i = dr.minimum(mi.UInt32(u), n - 2)
        f, at = u - mi.Float(i), dr.ravel(self.table)
        ends = [[dr.gather(mi.Float, at, (i + k) * channels + c) for k in (0, 1)] for c in range(channels)]
        return [dr.lerp(*pair, f) for pair in ends]

    def refresh(self) -> None:
        """Take over a table or a field that was replaced from outside.

        Raises:
            MivolError: as the class (values are looked at, unless ``dr.freeze`` is recording).
        """
        if not dr.flag(dr.JitFlag.FreezingScope):
            self._check()
        self.voxels.texture.set_tensor(self.classified())

    def _refined(self) -> tuple[mi.Float, tuple[int, int, int]]:
        """Scalar values at the nodes of the refined grid, and its resolution (Z, Y, X)."""
        k, (z, y, x) = self.refine, self.field.shape[:3]
        if k == 1:
            return dr.ravel(self.field), (z, y, x)
        texture = mi.Texture3f(self.field, use_accel=False, migrate=False)
        axes = [dr.arange(mi.Float, k * n) for n in (z, y, x)]
        pz, py, px = dr.meshgrid(*[(a + 0.5) / (k * n) for a, n in zip(axes, (z, y, x), strict=True)], indexing="ij")
        return texture.eval(mi.Point3f(px, py, pz))[0], (k * z, k * y, k * x)

    def _check(self) -> None:
        if len(self.field.shape) != 4 or self.field.shape[3] != 1 or not np.isfinite(np.array(dr.detach(self.field))).all():
            raise MivolError(
                f"{self.name} was given a field of shape {tuple(self.field.shape)} (or with NaN in it); (Z, Y, X, 1) finite "
                "numbers are expected."
            )
        rows = np.array(dr.detach(self.table))
        if rows.ndim != 2 or rows.shape[0] < 2 or rows.shape[1] not in (1, 3) or not (np.isfinite(rows) & (rows >= 0)).all():
            raise MivolError(
                f"the table of {self.name} has the shape {rows.shape} and entries from {rows.min(initial=0):.4g}; at least two "
                "entries of 1 or 3 finite numbers that are not negative are expected: clip them after each step."
            )
        low, high = self.domain
        if not (np.isfinite([low, high]).all() and low < high):
            raise MivolError(f"the domain of {self.name} is {low:g}, {high:g}; two numbers in rising order are expected.")
        if self.refine < 1:
            raise MivolError(f"refine of {self.name} is {self.refine}; a whole number of at least 1 is expected.")


def _numbers(text: object, what: str) -> np.ndarray:
    """Rows between commas, numbers between spaces: (n, C)."""
    try:
        return np.array([[float(v) for v in row.split()] for row in str(text).split(",")])
    except ValueError as error:
        raise MivolError(f"{what} is {str(text)!r}; rows of numbers are expected, as in '0 0 0, 1 0.5 0.2'.") from error


def _tensor(values: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32))


def _path(name: str) -> str:
    return str(mi.file_resolver().resolve(name))
