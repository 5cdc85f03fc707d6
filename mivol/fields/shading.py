r"""Shading of scans: light reflected as by surfaces, with normals from the gradient of the scan.

.. math:: c' = c\,(k_a + k_d\,|n \cdot l|) + k_s\,|n \cdot h|^m, \qquad n = \nabla s / |\nabla s|, \qquad
          h = (l + v) / |l + v|

c is the colour from a table, l the direction to the light, v the direction to the eye (Levoy 1988, equation 3, without the
fading with distance). Both sides of a surface are lit. The light is white and stands at the eye by default; matter casts no
shadow on matter. In constant regions of a scan the normal is undefined and the result is k_a c.

Conventions. Gradients are central differences at the voxels (one-sided in the outermost layers), linear between voxels, per
length of the world; they are exact for a quadratic field. The default coefficients are VTK's (``vtkVolumeProperty``).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError

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
