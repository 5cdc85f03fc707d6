"""Doubts about Mitsuba 3.9.1: the known cases in which ``volpath`` is wrong.

Conventions. A doubt is fatal if the image is wrong, and a remark if the image is right but surprising, or slightly off. All
cases were reproduced with the 3.9.1 wheel. tests/conformance/test_reference.py checks that each case is still wrong, so a
release with a correction is noticed. An extinction that differs between channels raises no doubt:
:func:`mivol.validate.reference.render_reference` renders each channel alone, inside :func:`use_channel`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import mitsuba as mi
import numpy as np

from mivol.scene.nesting import find_nesting_fault, shape_bounds
from mivol.scene_graph import find_children, traverse, traverse_children
from mivol.transport.media.medium_view import medium_kind

# exp(-x) is 0 in float32 (denormals flushed) from x = 87.3. Mitsuba divides by this probability of passing without a collision.
MAX_OPTICAL_DEPTH = 87.0

# Mean cosine of `hg` samples, measured: -0.41 at g = 1e-7, -0.029 at 1e-6; the error falls as 1/g.
MIN_G = 1e-3

# Mitsuba's shadow rays end math::ShadowEpsilon, 10 RayEpsilon, of their length before an emitter: nearer to it than this, times
# (1 + max|p|), one that starts anew at a boundary reaches behind its surface, and is dark.
NEAR_EMITTER = 0.1

# Farther off, shadow rays that graze the limb of a curved emitter are dark. The limb seen at cosines below c has the share c^2,
# and c falls as 1 / gap. Measured with balls at gaps of 1.0 to 2.2 times that reach: 0.013, 0.013, 0.0074, 0.0055 and 0.0047 of
# the light, 0.014 to 0.03 times the square of reach / gap; a square at 2.4 times the reach loses nothing (0.002).
LIMB_LOSS = 0.02

ROUND = ("Sphere", "Cylinder")
"""Classes of emitters with a limb. Boxes showed no loss in tests. Round meshes are not recognised."""

TOUCH_POINTS = 512
"""Surface points tested for another boundary."""

# Smallest reported loss, as a share of the light: below the noise of most references.
MIN_LOSS = 2e-3


@dataclass(frozen=True)
class Doubt:
    """A reason not to trust an image of Mitsuba.

    Attributes:
        kind: key of ``DOUBT_CHECKS``.
        sentence: the finding, Mitsuba's fault, and the way out.
        fatal: whether the image would be wrong.
    """

    kind: str
    sentence: str
    fatal: bool = True


def find_doubts(scene: mi.Scene, sensors: Sequence[mi.Sensor] | None = None) -> list[Doubt]:
    """Find all reasons not to trust a render of Mitsuba 3.9.1.

    Args:
        scene: the scene.
        sensors: the sensors to render; by default the scene's own sensors.
    """
    boundaries = [read_medium_shape(s) for s in scene.shapes() if s.interior_medium() is not None]
    doubts = [Doubt(kind, *found) for kind, check in DOUBT_CHECKS.items() for b in boundaries for found in check(b)]
    doubts += [Doubt("touching", _touching(a, b)) for a, b in combinations(boundaries, 2) if _touch(a, b)]
    fault = find_nesting_fault(scene)
    doubts += [Doubt("overlap", fault)] if fault is not None else []
    emitting = [s for s in scene.shapes() if s.is_emitter()]
    doubts += [Doubt("near emitter", *found) for shape in emitting for b in boundaries for found in _near_emitter(shape, b)]
    for sensor in scene.sensors() if sensors is None else sensors:
        doubts += [Doubt("camera inside", sentence) for sentence in _camera_inside(sensor, boundaries)]
        doubts += [Doubt("sampler", SAMPLER)] if boundaries and sensor.sampler().class_name() == "LowDiscrepancySampler" else []
    return doubts


# -- The checks -----------------------------------------------------------------------------------

Found = Iterator[tuple[str, bool]]


def _not_finite(b: MediumShape) -> Found:
    if not np.isfinite(b.majorant) or b.majorant < 0:
        yield (
            f"the extinction inside {b.name} has {b.majorant} as its largest value; its voxels must be finite and not negative."
        ), True


def _rotated(b: MediumShape) -> Found:
    linear = [np.abs(to_local[:3, :3]) for to_local in b.grids if b.overhang(to_local)]
    if any(np.any(np.sort(m, axis=1)[:, :2] > 1e-5 * m.max(axis=1, keepdims=True)) for m in linear):
        yield (
            f"the grid inside {b.name} is rotated or sheared and {b.name} is larger than the grid's own box: Mitsuba fills the "
            "grid's upright bounding box with clamped values; make the boundary the grid's own box."
        ), True


def _too_deep(b: MediumShape) -> Found:
    depth = b.majorant * b.diagonal
    if b.overhangs and depth > MAX_OPTICAL_DEPTH:
        yield (
            f"{b.name} is larger than the box of its grid, and the largest extinction times its diagonal is {depth:.3g}, above "
            f"{MAX_OPTICAL_DEPTH:g}: Mitsuba shows 0 where a ray misses the grid (issue 336); make the boundary the grid's own "
            "box."
        ), True


def _constant_box(b: MediumShape) -> Found:
    if b.volume == "ConstVolume" and b.overhangs:
        yield (
            f"the heterogeneous medium inside {b.name} has a constant extinction, which Mitsuba puts into the unit cube of the "
            f"constvolume only, not into all of {b.name}; use the medium homogeneous if all of it was meant."
        ), False


def _mirrored(b: MediumShape) -> Found:
    turned = b.to_world is not None and np.linalg.det(b.to_world[:3, :3]) < 0
    if b.faces is not None:
        p, q, r = (b.points[b.faces[:, i]] - b.points.mean(axis=0) for i in range(3))
        turned = np.einsum("ij,ij->", p, np.cross(q, r)) < 0
    if turned:
        yield (
            f"the normals of {b.name} point inwards (a mirroring to_world?), so that Mitsuba has the medium outside; "
            "mirror the grid, not the shape."
        ), True


def _wrong_inverse(b: MediumShape) -> Found:
    if b.to_local is None or b.to_local_inverse is None:
        return
    # 1e-4: both are printed with 6 digits.
    product = b.to_local @ b.to_local_inverse.T
    if np.abs(product - np.eye(4)).max() > 1e-4 * max(1.0, np.abs(b.to_local).max() * np.abs(b.to_local_inverse).max()):
        yield (
            f"the transform of the volume inside {b.name} and Mitsuba's inverse of it do not match (a rotation axis of length "
            "other than 1?); normalise the axis."
        ), True


def _small_g(b: MediumShape) -> Found:
    g = first_number(b.params.get("phase_function.g", 0.0))
    if 0 < abs(g) < MIN_G and not _is_black(b):
        yield (
            f"the phase function inside {b.name} is hg with g = {g:.2g}: the mean cosine of Mitsuba's samples is off by about "
            "3e-8/g; use the isotropic phase function."
        ), False


def _microflakes(b: MediumShape) -> Found:
    if any(re.search(r"^phase_function.*\bS\.", key) for key in b.params) and not _is_black(b):
        yield (
            f"the phase function inside {b.name} has microflakes (sggx), and Mitsuba draws their directions from another "
            "density than it divides by; light them by emitters of one position or direction, or use another phase function."
        ), True


def _is_black(b: MediumShape) -> bool:
    albedo = [np.asarray(v) for k, v in b.params.items() if k.startswith(("albedo", "sigma_s"))]
    return bool(albedo) and all(np.all(v == 0) for v in albedo)


def _emission(b: MediumShape) -> Found:
    key = next((k for k in b.params if k.startswith("emission")), None)
    if key is not None and np.any(np.asarray(b.params[key]) != 0):
        yield f"the medium inside {b.name} emits light, which Mitsuba's integrators do not render; set its emission to 0.", True


def _thick_skin(b: MediumShape) -> Found:
    if b.skin > MIN_LOSS and not _is_black(b):
        yield (
            f"the medium inside {b.name} is dense where it touches it: Mitsuba starts rays a little behind the surface where "
            f"they enter, and loses about {b.skin:.1%} of the light that comes back head-on, more aslant; leave the outermost "
            "voxels empty, or allow for that much."
        ), False


DOUBT_CHECKS: dict[str, Callable[[MediumShape], Found]] = {
    "not finite": _not_finite,
    "rotated grid": _rotated,
    "too deep": _too_deep,
    "constant box": _constant_box,
    "mirrored": _mirrored,
    "wrong inverse": _wrong_inverse,
    "small g": _small_g,
    "microflakes": _microflakes,
    "emission": _emission,
    "thick skin": _thick_skin,
}


def _touch(a: MediumShape, b: MediumShape) -> bool:
    """Whether the surfaces of two shapes coincide in part: a point passing a common face changes sides of both shapes."""
    return _lies_on(a, b) or _lies_on(b, a)


def _lies_on(a: MediumShape, b: MediumShape) -> bool:
    p = a.surface[:TOUCH_POINTS]
    out = p - a.points.mean(axis=0)
    step = RESTART_DISTANCE * (1 + np.abs(p).max(axis=1, keepdims=True)) * out / np.linalg.norm(out, axis=1, keepdims=True)
    near = np.all((p >= b.points.min(axis=0) - np.abs(step)) & (p <= b.points.max(axis=0) + np.abs(step)), axis=1)
    changes = sum(b.holds(q + s) != b.holds(q - s) for q, s in zip(p[near], step[near], strict=True))
    return changes >= 0.01 * len(p)


def _touching(a: MediumShape, b: MediumShape) -> str:
    return (
        f"{a.name} and {b.name} touch: Mitsuba starts rays a little behind the surface they leave, and so inside the other "
        "without having entered its medium, which is then vacuum; leave a gap of a thousandth of the scene, or make one grid "
        "of both."
    )


SAMPLER = (
    "the camera's sampler is ldsampler, some of whose dimensions depend on each other (correlations of 0.24): Mitsuba's free "
    "flights, which draw many numbers a path, are off by percents; use the independent or the multijitter sampler."
)


def _near_emitter(shape: mi.Shape, b: MediumShape) -> Found:
    near, far = (np.array(v, np.float64) for v in shape_bounds(shape))
    low, high = b.points.min(axis=0), b.points.max(axis=0)
    reach = float(NEAR_EMITTER * (1 + np.abs([near, far, low, high]).max()))
    gap = float(np.linalg.norm(np.maximum(0, np.maximum(near - high, low - far))))
    name = shape.id() or shape.class_name()
    if 0 < gap < reach:
        whole = float(np.linalg.norm(np.maximum(far, high) - np.minimum(near, low)))
        yield (
            f"the emitter {name} is {gap:.2g} from {b.name}: Mitsuba's shadow rays that leave a boundary within about "
            f"{reach:.2g} of an emitter end behind its surface, and are dark; move it away, or make the scene "
            f"{reach / gap:.0f} times as large.",
            whole < 2 * reach,
        )
    elif gap > 0 and (loss := LIMB_LOSS * (reach / gap) ** 2) > MIN_LOSS and shape.class_name() in ROUND:
        yield (
            f"the emitter {name} is {gap:.2g} from {b.name}: Mitsuba's shadow rays that leave a boundary and graze a curved "
            f"emitter end behind its surface, and are dark, about {loss:.1%} of its light; move it away, or allow for that "
            "much.",
            False,
        )


def _camera_inside(sensor: mi.Sensor, boundaries: list[MediumShape]) -> Iterator[str]:
    if sensor.get_medium() is not None:
        return
    origin = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)[:3, 3]
    for b in boundaries:
        if b.holds(origin):
            yield (
                f"the camera at {np.round(origin, 4).tolist()} is inside {b.name}, and Mitsuba starts its paths in vacuum; "
                'give the sensor the medium that it is in (<ref name="medium" .../>).'
            )


FACE_TOLERANCE = 1e-4
"""Distance outside the unit cube that still counts as on its face: Mitsuba prints transforms with 6 digits, and float32
vertices carry 1e-7 of their size."""

RESTART_DISTANCE = 1500 * 2.0**-24
"""math::RayEpsilon of float32: Mitsuba restarts a ray at a surface point p by (1 + max|p|) times this distance behind the
surface, along the normal."""

POINTS = 4096
"""Points of a boundary for reading the extinction."""


@dataclass(frozen=True)
class MediumShape:
    """A shape that holds a medium, with the placement of the medium's extinction.

    Attributes:
        name: name of the shape.
        points: (N, 3) world points whose hull holds the shape: mesh vertices, or the corners of the box.
        faces: (M, 3) indices of a mesh; None without a mesh.
        to_world: (4, 4) of a shape without mesh; None for a mesh.
        to_local: (4, 4) world to the unit cube of the volume under a stock ``heterogeneous``; None under other media.
        to_local_inverse: (4, 4) transpose of Mitsuba's inverse of a stock volume's transform; None under other media.
        volume: class of the volume under a stock ``heterogeneous``; empty under other media.
        grids: (4, 4) world to the unit cube of each stock grid of the extinction.
        surface: (POINTS, 3) points on a mesh, on a ball, or on the box of another shape.
        majorant: largest extinction [1/length].
        skin: largest optical depth along the normal that Mitsuba skips at the entry of a ray.
        params: parameters of the medium.
    """

    name: str
    points: np.ndarray
    faces: np.ndarray | None
    to_world: np.ndarray | None
    to_local: np.ndarray | None
    to_local_inverse: np.ndarray | None
    volume: str
    grids: tuple[np.ndarray, ...]
    surface: np.ndarray
    majorant: float
    skin: float
    params: dict[str, object]

    @property
    def overhangs(self) -> bool:
        """Whether the shape reaches outside the volume's own box."""
        return self.to_local is not None and self.overhang(self.to_local)

    def overhang(self, to_local: np.ndarray) -> bool:
        """Whether the shape reaches outside a box mapped to the unit cube."""
        q = self.points @ to_local[:3, :3].T + to_local[:3, 3]
        return bool(np.any(q < -FACE_TOLERANCE) or np.any(q > 1 + FACE_TOLERANCE))

    @property
    def diagonal(self) -> float:
        """Diagonal of the box around the shape; no chord is longer."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def holds(self, p: np.ndarray) -> bool:
        """Whether a point is inside: by crossings of a ray for a mesh, by the unit ball for a sphere, by the box for other
        shapes.
        """
        if self.faces is not None:
            return _crossings(p, self.points[self.faces]) % 2 == 1
        return bool(np.all(p > self.points.min(axis=0)) and np.all(p < self.points.max(axis=0))) and self._in_ball(p)

    def _in_ball(self, p: np.ndarray) -> bool:
        if self.to_world is None:
            return True
        local = np.linalg.solve(self.to_world, np.append(p, 1.0))[:3]
        return bool(local @ local < 1)


def read_medium_shape(shape: mi.Shape) -> MediumShape:
    """Read the facts of a shape with a medium inside."""
    geometry = traverse(shape)
    params = traverse_children(shape.interior_medium())
    volumes = _extinction_volumes(shape.interior_medium())
    stock = next((v for v in volumes if v.class_name() in ("GridVolume", "ConstVolume")), None)
    kind = medium_kind(shape.interior_medium())
    mesh = "vertex_positions" in geometry
    points = np.array(geometry["vertex_positions"], np.float64).reshape(-1, 3) if mesh else _corners(shape.bbox())
    faces = np.array(geometry["faces"]).reshape(-1, 3) if mesh else None
    to_world = _matrix(geometry["to_world"]) if shape.shape_type() == mi.ShapeType.Sphere.value else None
    to_local, scale = _stock_box(kind, volumes), first_number(params.get("scale", 1.0))
    surface = _surface(points, faces, to_world)
    return MediumShape(
        name=shape.id() or f"the {shape.class_name()}",
        points=points,
        faces=faces,
        to_world=to_world,
        to_local=to_local,
        to_local_inverse=_printed(stock, "inverse_transpose") if kind == "HeterogeneousMedium" else None,
        volume=volumes[0].class_name() if kind == "HeterogeneousMedium" else "",
        grids=tuple(_printed(v, "matrix") for v in volumes if v.class_name() == "GridVolume"),
        surface=surface,
        majorant=scale * sum(float(np.max(v.max())) for v in volumes),
        skin=scale * _skin_depth(surface + FACE_TOLERANCE * (points.mean(axis=0) - surface), volumes, to_local),
        params={key: params[key] for key in params.keys()},  # noqa: SIM118  (iteration gives pairs)
    )


def _surface(points: np.ndarray, faces: np.ndarray | None, to_world: np.ndarray | None) -> np.ndarray:
    """Points (N, 3) of a boundary: on a mesh, on a ball, or the corners of the box of another shape."""
    rng = np.random.default_rng(0)
    if faces is not None:
        share = rng.dirichlet((1, 1, 1), POINTS)
        points = np.einsum("nk,nkc->nc", share, points[faces[rng.integers(len(faces), size=POINTS)]])
    elif to_world is not None:
        d = rng.normal(size=(POINTS, 3))
        points = d / np.linalg.norm(d, axis=1, keepdims=True) @ to_world[:3, :3].T + to_world[:3, 3]
    return points


def _skin_depth(points: np.ndarray, volumes: list[mi.Volume], to_local: np.ndarray | None) -> float:
    """Largest optical depth along the normal that a restarted ray skips at some points, without the scale."""
    it = mi.Interaction3f()
    it.p = mi.Point3f(points.T.astype(np.float32))
    sigma = np.zeros(len(points))
    for volume in volumes:
        value = volume.eval(it)
        sigma = sigma + np.array(value).reshape(len(value), -1).max(axis=0)
    if to_local is not None:
        q = points @ to_local[:3, :3].T + to_local[:3, 3]
        sigma = sigma * np.all((q > -FACE_TOLERANCE) & (q < 1 + FACE_TOLERANCE), axis=1)
    return float((sigma * RESTART_DISTANCE * (1 + np.abs(points).max(axis=1))).max(initial=0))


def _extinction_volumes(medium: mi.Medium) -> list[mi.Volume]:
    """The volumes that sum to a medium's extinction."""
    return [v for name, v in find_children(medium).items() if name in ("sigma_t", "sigma_a", "sigma_s")]


def _stock_box(kind: str, volumes: list[mi.Volume]) -> np.ndarray | None:
    """World to the unit cube of the volume under a stock ``heterogeneous``; None for media without such a box.

    A ``mivol_medium`` in a boundary larger than its grids is right under stock integrators (tested to optical depths of 1800).
    A rotated ``mivol_voxels`` is vacuum outside its own box, so its axis-aligned box suffices.
    """
    if kind != "HeterogeneousMedium":
        return None
    if volumes[0].class_name() in ("GridVolume", "ConstVolume"):
        return _printed(volumes[0], "matrix")
    corners = _corners(volumes[0].bbox())
    box = np.eye(4)
    box[:3, :3], box[:3, 3] = np.diag(np.ptp(corners, axis=0)), corners.min(axis=0)
    return np.linalg.inv(box)


def first_number(value: object) -> float:
    """The first number of a value of ``mi.traverse``."""
    return float(np.ravel(np.array(value))[0])


def _printed(volume: mi.Volume | None, name: str) -> np.ndarray | None:
    """A matrix parsed from the printed form of a stock volume; Mitsuba shows the matrix in no other place."""
    found = re.search(rf"to_local = Transform\[.*?\b{name}=(\[\[.*?\]\])", str(volume), re.DOTALL)
    return np.array(re.findall(r"[-+\w.]+", found[1]), dtype=np.float64).reshape(4, 4) if found else None


def _matrix(transform: object) -> np.ndarray:
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4)


def _corners(box: object) -> np.ndarray:
    low, high = (np.array(v, np.float64).ravel() for v in (box.min, box.max))
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)


def _crossings(p: np.ndarray, triangles: np.ndarray) -> int:
    """Number of triangles met by a ray from p (Moeller, Trumbore 1997), along a direction parallel to no axis."""
    d = np.array([0.8017837, 0.2672612, 0.5345225])
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    h = np.cross(d, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.einsum("ij,ij->i", e1, h)
        s = p - a
        u = np.einsum("ij,ij->i", s, h) * inverse
        q = np.cross(s, e1)
        v = q @ d * inverse
        t = np.einsum("ij,ij->i", q, e2) * inverse
        return int(np.count_nonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)))


# -- Extinctions that differ between channels ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class RgbExtinction:
    """The parameters of a medium whose extinction differs between channels, with their values."""

    params: mi.SceneParameters
    values: dict[str, np.ndarray]

    def assign(self, values: dict[str, np.ndarray]) -> None:
        """Assign other values to the medium, for each key of ``values``."""
        for key, value in values.items():
            kind = type(self.params[key])
            self.params[key] = kind(*value.tolist()) if kind is mi.Color3f else kind(np.ascontiguousarray(value))
        self.params.update()


def find_rgb_extinctions(scene: mi.Scene) -> list[RgbExtinction]:
    """Find the media whose extinction differs between channels."""
    media = [m for s in scene.shapes() for m in (s.interior_medium(), s.exterior_medium()) if m is not None]
    media += [m for s in scene.sensors() if (m := s.get_medium()) is not None]
    found = []
    for i, medium in enumerate(media):
        if any(medium is other for other in media[:i]):
            continue
        params = traverse_children(medium)
        keys = [k for k in params.keys() if k.partition(".")[0] in ("sigma_t", "sigma_a", "sigma_s")]  # noqa: SIM118
        values = {key: _copy_values(params[key]) for key in keys}
        values = {k: v for k, v in values.items() if v.ndim and v.shape[-1] == 3 and np.any(v != v[..., :1])}
        if values:
            found.append(RgbExtinction(params, values))
    return found


def _copy_values(value: Any) -> np.ndarray:
    """Copy the values, channels last."""
    array = np.array(value)
    return array.reshape(-1) if isinstance(value, mi.Color3f) else array


@contextmanager
def use_channel(media: list[RgbExtinction], channel: int) -> Iterator[None]:
    """Give all channels the extinction of ``channel`` inside a ``with`` block."""
    try:
        for medium in media:
            medium.assign({k: np.repeat(v[..., channel : channel + 1], 3, axis=-1) for k, v in medium.values.items()})
        yield
    finally:
        for medium in media:
            medium.assign(medium.values)
