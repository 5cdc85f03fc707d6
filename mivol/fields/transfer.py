r"""A scan seen through a transfer function: a table that maps scalar values to opacities or colours.

.. math:: y(x) = (1 - f) y_i + f y_{i+1}, \qquad i + f = (n - 1)\, \frac{s(x) - s_0}{s_1 - s_0}

A table y has n entries at equal steps of the value s from s_0 to s_1 (its domain); values outside the domain use the entry at
the end. Two such fields as ``sigma_t`` and ``emission`` of a ``mivol_medium`` are the emission-absorption model of scans (Max
1995). The gradient of the scan can shade colours, and a second table of its magnitude can scale
opacities, which keeps the boundaries between materials and removes their insides (Levoy 1988; Kindlmann and Durkin 1998).

Conventions. The scalar grid is (Z, Y, X, 1) with values at voxel centres and clamped borders, and holds any finite numbers
(Hounsfield units are negative in air). The grid is refined ``refine`` times in each direction, then classified. The result is
an ordinary grid, linear between its nodes, so classification precedes the last interpolation and resolves a table within a
voxel to 1 / refine. Derivatives with respect to table and scalar grid pass through the look-up.

Bias: second order in 1 / refine, if the cell of a node contains at most one kink of the table. Measured in
tests/conformance/test_transfer.py: 5e-2, 1.2e-2, 5e-3 and 3e-3 at refine 1, 3, 5 and 7 for voxels with one or two kinks. An odd
number keeps the nodes of the scan, where the scan has its peaks. Cost: memory grows with the cube of refine.

Shading. Colours are reflected as by surfaces, with normals from the gradient of the scan:

.. math:: c' = c\,(k_a + k_d\,|n \cdot l|) + k_s\,|n \cdot h|^m, \qquad n = \nabla s / |\nabla s|, \qquad
          h = (l + v) / |l + v|

c is the colour from a table, l the direction to the light, v the direction to the eye (Levoy 1988, equation 3, without the
fading with distance). Both sides of a surface are lit. The light is white and stands at the eye by default; matter casts no
shadow on matter. In constant regions of a scan the normal is undefined and the result is k_a c. Gradients are central
differences at the voxels (one-sided in the outermost layers), linear between voxels, per length of the world; they are exact
for a quadratic field. The default coefficients are VTK's (``vtkVolumeProperty``).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.voxels import Voxels
from mivol.files import read_volume
from mivol.kernel_recording import is_recording


def look_up(table: mi.TensorXf, domain: tuple[float, float], s: mi.Float) -> list[mi.Float]:
    """Entries of a table at values s, a list of channels; attached to both.

    Args:
        table: (n, C) entries.
        domain: values of the first and the last entry.
        s: values.
    """
    n, channels = table.shape
    low, high = domain
    u = dr.clip((s - low) * ((n - 1) / (high - low)), 0, n - 1)
    i = dr.minimum(mi.UInt32(u), n - 2)
    f, at = u - mi.Float(i), dr.ravel(table)
    ends = [[dr.gather(mi.Float, at, (i + k) * channels + c) for k in (0, 1)] for c in range(channels)]
    return [dr.lerp(*pair, f) for pair in ends]


def parse_table(text: object, what: str) -> np.ndarray:
    """Entries (n, C) of a text: commas between rows, spaces between numbers.

    Args:
        text: plugin parameter.
        what: name of the parameter in messages.

    Raises:
        MivolError: text other than numbers.
    """
    try:
        return np.array([[float(v) for v in row.split()] for row in str(text).split(",")])
    except ValueError as error:
        raise MivolError(f"{what} is {str(text)!r}; rows of numbers are expected, as in '0 0 0, 1 0.5 0.2'.") from error


def parse_domain(text: object, what: str) -> tuple[float, float]:
    """The two ends of a domain from a text.

    Raises:
        MivolError: text other than two numbers.
    """
    ends = parse_table(text, what).ravel().tolist()
    if len(ends) != 2:
        raise MivolError(f"{what} is {text}; two numbers in rising order are expected.")
    return ends[0], ends[1]


def check_table(rows: np.ndarray, what: str, channels: tuple[int, ...] = (1, 3)) -> None:
    """Check the entries of a table.

    Args:
        rows: (n, C).
        what: name of the table in messages.
        channels: allowed numbers of channels.

    Raises:
        MivolError: fewer than two entries, another number of channels, or entries that are negative or not finite.
    """
    if rows.ndim != 2 or rows.shape[0] < 2 or rows.shape[1] not in channels or not (np.isfinite(rows) & (rows >= 0)).all():
        raise MivolError(
            f"{what} has the shape {rows.shape} and entries from {rows.min(initial=0):.4g}; at least two entries of "
            f"{' or '.join(map(str, channels))} finite numbers that are not negative are expected: clip them after each step."
        )


def check_domain(domain: tuple[float, float], what: str) -> None:
    """Check the ends of a domain.

    Raises:
        MivolError: ends that are not finite or not in rising order.
    """
    low, high = domain
    if not (np.isfinite([low, high]).all() and low < high):
        raise MivolError(f"{what} is {low:g}, {high:g}; two numbers in rising order are expected.")


@dataclass(frozen=True)
class GradientOpacity:
    """Factors on the entries of a table by the magnitude of the scan's gradient.

    Attributes:
        table: (n, 1), factors of at least 0.
        domain: magnitudes [value of the scan / length] of the first and the last factor.
    """

    table: mi.TensorXf
    domain: tuple[float, float]

    @classmethod
    def from_props(cls, props: mi.Properties, name: str, max_gradient: float) -> GradientOpacity | None:
        """Make factors from plugin parameters: ``gradient_opacity`` and ``gradient_domain``; None without a table.

        Args:
            props: parameters of the plugin.
            name: name of the plugin in messages.
            max_gradient: largest magnitude of the scan's gradient, the default end of the domain.

        Raises:
            MivolError: an invalid table or domain.
        """
        domain = (0.0, max_gradient or 1.0)
        if "gradient_domain" in props:
            domain = parse_domain(props["gradient_domain"], f"the gradient_domain of {name}")
        if "gradient_opacity" not in props:
            return None
        rows = parse_table(props["gradient_opacity"], f"the gradient_opacity of {name}")
        check_table(rows, f"the gradient_opacity of {name}", (1,))
        check_domain(domain, f"the gradient_domain of {name}")
        return cls(mi.TensorXf(np.ascontiguousarray(rows, dtype=np.float32)), domain)

    def factor(self, gradient: mi.Vector3f) -> mi.Float:
        """Factors at points with the given gradients."""
        return look_up(self.table, self.domain, dr.norm(gradient))[0]


@dataclass(frozen=True)
class GradientEffects:
    """Effects of a scan's gradient: opacity factors, shading, both or none."""

    opacity: GradientOpacity | None = None
    shading: Shading | None = None

    @classmethod
    def from_props(cls, props: mi.Properties, field: mi.TensorXf, to_world: np.ndarray, name: str) -> GradientEffects:
        """Make effects from the parameters of a plugin.

        Args:
            props: parameters of the plugin.
            field: scan (Z, Y, X, 1).
            to_world: (4, 4), unit cube to world.
            name: name of the plugin in messages.

        Raises:
            MivolError: as :class:`GradientOpacity` and :class:`mivol.fields.transfer.Shading`.
        """
        needs_most = "gradient_opacity" in props and "gradient_domain" not in props
        with dr.suspend_grad():
            most = np.linalg.norm(np.array(gradient_grid(field, to_world)), axis=-1).max() if needs_most else 0.0
        return cls(GradientOpacity.from_props(props, name, float(most)), Shading.from_props(props, name))

    @property
    def is_empty(self) -> bool:
        """Whether the gradient has no effect."""
        return self.opacity is None and self.shading is None

    def apply(self, entries: list[mi.Float], gradient: mi.Vector3f, p: mi.Point3f) -> list[mi.Float]:
        """Entries of a table at points of the world after factors and shading."""
        if self.opacity is not None:
            factor = self.opacity.factor(gradient)
            entries = [entry * factor for entry in entries]
        return entries if self.shading is None else self.shading.shade(entries, gradient, p)


class Transfer:
    """A grid classified by a table.

    Args:
        field: scalar values (Z, Y, X, 1), finite.
        table: (n, C) entries, n at least 2, C 1 or 3, finite and at least 0; and the values [of the field] of the first and the
            last entry.
        refine: nodes per voxel in each direction.
        to_world: (4, 4) affine map of the unit cube to the world.
        name: name of the grid in messages.
        effects: effects of the field's gradient.

    Raises:
        MivolError: an invalid field, table, domain or placement.
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
        """Make a grid from plugin parameters.

        The parameters are ``filename`` or ``data``, ``table``, ``domain``, ``refine``, ``to_world``, and those read by
        :class:`GradientEffects`.

        Raises:
            MivolError: as the class, or a text with other contents than numbers.
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
        """Entries of the table at the nodes of the refined grid, (Z, Y, X, C); derivatives by table and field pass through."""
        (s,), res = self._refine(self.field)
        rows = self._entries(s)
        if not self.effects.is_empty:
            gradient, _ = self._refine(gradient_grid(self.field, self.to_world))
            rows = self.effects.apply(rows, mi.Vector3f(*gradient), self._world_positions(res))
        flat = rows[0] if len(rows) == 1 else dr.ravel(mi.Vector3f(*rows))
        return mi.TensorXf(flat, (*res, len(rows)))

    def interpolation_error(self) -> float:
        """Difference between the classified grid and the table half-way between nodes: rms over edges / largest entry.

        Cost: 9 look-ups a node of the refined grid.
        """
        with dr.suspend_grad():
            (s,), res = self._refine(self.field)
            values, squares = np.array(s).reshape(res), []
            for axis in range(3):
                ends = [mi.Float(values.take(range(k, res[axis] - 1 + k), axis).ravel()) for k in (0, 1)]
                if dr.width(ends[0]):
                    middle, *sides = (self._entries(v) for v in (0.5 * (ends[0] + ends[1]), *ends))
                    squares += [np.square(m - 0.5 * (a + b)) for m, a, b in zip(middle, *sides, strict=True)]
            largest = float(np.max(np.array(self.table)))
        return float(np.sqrt(np.concatenate(squares).mean())) / largest if squares and largest > 0 else 0.0

    def _entries(self, s: mi.Float) -> list[mi.Float]:
        """Entries of the table at scalar values, a list of channels."""
        return look_up(self.table, self.domain, s)

    def refresh(self) -> None:
        """Classify again after the table or the field was replaced.

        Raises:
            MivolError: as the class; values are not checked while ``dr.freeze`` records.
        """
        if not is_recording():
            self._check()
        self.voxels.replace(self.classify())

    def _refine(self, grid: mi.TensorXf) -> tuple[list[mi.Float], tuple[int, int, int]]:
        """A grid (Z, Y, X, C) at the nodes of the refined grid: a list of channels, and the resolution (Z, Y, X)."""
        k, (z, y, x, channels) = self.refine, grid.shape
        if k == 1:
            return [dr.ravel(grid)] if channels == 1 else list(dr.unravel(mi.Vector3f, grid.array)), (z, y, x)
        texture = mi.Texture3f(grid, use_accel=False, migrate=False)
        return texture.eval(_node_positions((k * z, k * y, k * x))), (k * z, k * y, k * x)

    def _world_positions(self, res: tuple[int, int, int]) -> mi.Point3f:
        """World positions of the nodes of the refined grid."""
        return mi.AffineTransform4f(mi.ScalarMatrix4f(self.to_world)) @ _node_positions(res)

    def _check(self) -> None:
        _check_field(self.field, self.name)
        check_table(np.array(dr.detach(self.table)), f"the table of {self.name}")
        check_domain(self.domain, f"the domain of {self.name}")
        if self.refine < 1:
            raise MivolError(f"refine of {self.name} is {self.refine}; a whole number of at least 1 is expected.")


def _add_channel_axis(field: mi.TensorXf) -> mi.TensorXf:
    """Scalar values with an axis of one channel."""
    return field if len(field.shape) != 3 else mi.TensorXf(field.array, (*field.shape, 1))


def _value_range(field: mi.TensorXf) -> tuple[float, float]:
    """The smallest and the largest value."""
    values = np.array(dr.detach(field))
    return (float(np.min(values)), float(np.max(values))) if values.size else (0.0, 0.0)


def _node_positions(res: tuple[int, int, int]) -> mi.Point3f:
    """Nodes of a grid in the unit cube."""
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


# -- Shading ---------------------------------------------------------------------------------------------------------------


COEFFICIENTS = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.2, "specular_power": 10.0}


@dataclass(frozen=True)
class Shading:
    """The light on the surfaces of a scan.

    Attributes:
        eye: position of the viewer, world.
        light: position of the light, world; None: at the eye.
        ambient, diffuse, specular: k_a, k_d and k_s.
        specular_power: m.
    """

    eye: mi.Point3f
    light: mi.Point3f | None
    ambient: float
    diffuse: float
    specular: float
    specular_power: float

    @classmethod
    def from_props(cls, props: mi.Properties, name: str) -> Shading | None:
        """Make shading from plugin parameters: ``shade``, ``eye``, ``light`` and the coefficients; None if ``shade`` is false.

        Raises:
            MivolError: no eye, or a coefficient that is negative or not finite.
        """
        numbers = {key: float(props.get(key, value)) for key, value in COEFFICIENTS.items()}
        eye, light = (_parse_point(props, key) for key in ("eye", "light"))
        if not props.get("shade", False):
            return None
        if eye is None:
            raise MivolError(f"{name} is to be shaded and was given no eye; give the place of the camera, or shade = false.")
        wrong = [f"{key} {value:g}" for key, value in numbers.items() if not 0 <= value < float("inf")]
        if wrong:
            raise MivolError(f"{name} was given {', '.join(wrong)}; finite numbers that are not negative are expected.")
        return cls(eye, light, **numbers)

    def shade(self, colours: list[mi.Float], gradient: mi.Vector3f, p: mi.Point3f) -> list[mi.Float]:
        """Reflected light at points; attached to colours, gradient and eye.

        Args:
            colours: list of channels at the points.
            gradient: gradient of the scan at the points, per length.
            p: positions of the points, world.
        """
        n = _normalize(gradient)
        to_eye = _normalize(self.eye - p)
        to_light = to_eye if self.light is None else _normalize(self.light - p)
        half = _normalize(to_light + to_eye)
        matte = self.ambient + self.diffuse * dr.abs(dr.dot(n, to_light))
        highlight = self.specular * _positive_power(dr.abs(dr.dot(n, half)), self.specular_power)
        return [c * matte + highlight for c in colours]


def gradient_grid(field: mi.TensorXf, to_world: np.ndarray) -> mi.TensorXf:
    """The gradient of a scan at its voxels, (Z, Y, X, 3), along x, y and z of the world; attached to the scan.

    Args:
        field: (Z, Y, X, 1).
        to_world: (4, 4) affine map of the unit cube to the world.
    """
    res, values = field.shape[:3], dr.ravel(field)
    z, y, x = dr.meshgrid(*(dr.arange(mi.Int32, n) for n in res), indexing="ij")
    index = {"x": x, "y": y, "z": z}
    slopes = []
    for axis, n in zip("xyz", reversed(res), strict=True):
        ends = [dr.clip(index[axis] + step, 0, n - 1) for step in (-1, 1)]
        before, after = (dr.gather(mi.Float, values, _flat_index({**index, axis: end}, res)) for end in ends)
        # In the unit cube a voxel is 1 / n wide. Along an axis of one voxel the difference is 0.
        slopes.append(n * (after - before) / dr.maximum(mi.Float(ends[1] - ends[0]), 1))
    world = np.linalg.inv(np.asarray(to_world)[:3, :3]).T
    along = [sum(float(share) * slope for share, slope in zip(row, slopes, strict=True)) for row in world]
    return mi.TensorXf(dr.ravel(mi.Vector3f(*along)), (*res, 3))


def _flat_index(index: dict[str, mi.Int32], res: tuple[int, ...]) -> mi.UInt32:
    return mi.UInt32((index["z"] * res[1] + index["y"]) * res[2] + index["x"])


def _normalize(v: mi.Vector3f) -> mi.Vector3f:
    """Vectors of length 1; zero vectors stay zero."""
    length = dr.norm(v)
    return v / dr.select(length > 0, length, 1)


def _positive_power(x: mi.Float, exponent: float) -> mi.Float:
    """x^m for x of at least 0, with slope 0 at 0; 0^0 is 0, since a zero normal means no surface."""
    return dr.select(x > 0, dr.power(dr.select(x > 0, x, 1), exponent), 0)


def _parse_point(props: mi.Properties, key: str) -> mi.Point3f | None:
    """A point from plugin parameters, opaque to kernels: a moving camera compiles no new kernel."""
    if key not in props:
        return None
    point = mi.Point3f(*(float(v) for v in np.array(props[key]).ravel()))
    dr.make_opaque(point)
    return point
