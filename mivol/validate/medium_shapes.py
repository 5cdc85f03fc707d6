"""Shapes that hold media, as NumPy arrays: where each lies, what its medium's extinction is given on, how dense it is."""

from __future__ import annotations

import re
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.transport.media.medium_view import find_children, medium_kind, traverse_medium

__all__ = ["ON_FACE", "RESTART", "MediumShape", "number", "read_medium_shape"]

ON_FACE = 1e-4
"""Mitsuba prints transforms to 6 digits, and float32 vertices carry 1e-7 of their size: what lies this little outside the unit
cube lies on its face."""

RESTART = 1500 * 2.0**-24
"""math::RayEpsilon of float32: Mitsuba restarts a ray at p on a surface (1 + max|p|) times this behind it, along the normal."""

POINTS = 4096
"""Points of a boundary at which its extinction is looked up."""


@dataclass(frozen=True)
class MediumShape:
    """A shape that holds a medium, and where the medium's extinction is given.

    Attributes:
        name: of the shape.
        points: (N, 3) world points whose hull holds the shape: mesh vertices, else the corners of its box.
        faces: (M, 3) indices of a mesh, else None.
        to_world: (4, 4) of a shape that is no mesh, else None.
        to_local: (4, 4) world to the unit cube of the volume under a stock ``heterogeneous``, else None.
        to_local_inverse: (4, 4) transpose of what Mitsuba takes for the inverse of a stock volume's, else None.
        volume: class of the volume under a stock ``heterogeneous``, else "".
        grids: (4, 4) world to the unit cube of each stock grid of the extinction.
        surface: (POINTS, 3) points on the shape, or on its box where it is neither a mesh nor a ball.
        majorant: largest extinction [1/length].
        skin: largest optical depth, along the normal, of what Mitsuba leaps over where a ray enters.
        params: what can be traversed of the medium.
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
        """Whether the shape reaches outside a box that is mapped to the unit cube."""
        q = self.points @ to_local[:3, :3].T + to_local[:3, 3]
        return bool(np.any(q < -ON_FACE) or np.any(q > 1 + ON_FACE))

    @property
    def diagonal(self) -> float:
        """Of the box about the shape: no chord is longer."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def holds(self, p: np.ndarray) -> bool:
        """Whether a point is inside: by crossings of a ray for a mesh, by the unit ball for a sphere, else by the box."""
        if self.faces is not None:
            return _crossings(p, self.points[self.faces]) % 2 == 1
        return bool(np.all(p > self.points.min(axis=0)) and np.all(p < self.points.max(axis=0))) and self._in_ball(p)

    def _in_ball(self, p: np.ndarray) -> bool:
        if self.to_world is None:
            return True
        local = np.linalg.solve(self.to_world, np.append(p, 1.0))[:3]
        return bool(local @ local < 1)


def read_medium_shape(shape: mi.Shape) -> MediumShape:
    """Read what there is to know of a shape with a medium inside."""
    geometry = mi.traverse(shape)
    params = traverse_medium(shape.interior_medium())
    volumes = _extinction_volumes(shape.interior_medium())
    stock = next((v for v in volumes if v.class_name() in ("GridVolume", "ConstVolume")), None)
    kind = medium_kind(shape.interior_medium())
    mesh = "vertex_positions" in geometry
    points = np.array(geometry["vertex_positions"], np.float64).reshape(-1, 3) if mesh else _corners(shape.bbox())
    faces = np.array(geometry["faces"]).reshape(-1, 3) if mesh else None
    to_world = _matrix(geometry["to_world"]) if shape.shape_type() == mi.ShapeType.Sphere.value else None
    to_local, scale = _reach(kind, volumes), number(params.get("scale", 1.0))
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
        skin=scale * _skin(surface + ON_FACE * (points.mean(axis=0) - surface), volumes, to_local),
        params={key: params[key] for key in params.keys()},  # noqa: SIM118  (iteration gives pairs)
    )


def _surface(points: np.ndarray, faces: np.ndarray | None, to_world: np.ndarray | None) -> np.ndarray:
    """Points (N, 3) of a boundary: of a mesh, of a ball, else the corners of a box about it."""
    rng = np.random.default_rng(0)
    if faces is not None:
        share = rng.dirichlet((1, 1, 1), POINTS)
        points = np.einsum("nk,nkc->nc", share, points[faces[rng.integers(len(faces), size=POINTS)]])
    elif to_world is not None:
        d = rng.normal(size=(POINTS, 3))
        points = d / np.linalg.norm(d, axis=1, keepdims=True) @ to_world[:3, :3].T + to_world[:3, 3]
    return points


def _skin(points: np.ndarray, volumes: list[mi.Volume], to_local: np.ndarray | None) -> float:
    """Largest optical depth, along the normal, of what a restarted ray leaps over at some points, but for the scale."""
    it = mi.Interaction3f()
    it.p = mi.Point3f(points.T.astype(np.float32))
    sigma = np.zeros(len(points))
    for volume in volumes:
        value = volume.eval(it)
        sigma = sigma + np.array(value).reshape(len(value), -1).max(axis=0)
    if to_local is not None:
        q = points @ to_local[:3, :3].T + to_local[:3, 3]
        sigma = sigma * np.all((q > -ON_FACE) & (q < 1 + ON_FACE), axis=1)
    return float((sigma * RESTART * (1 + np.abs(points).max(axis=1))).max(initial=0))


def _extinction_volumes(medium: mi.Medium) -> list[mi.Volume]:
    """The volumes whose sum is a medium's extinction."""
    return [v for name, v in find_children(medium).items() if name in ("sigma_t", "sigma_a", "sigma_s")]


def _reach(kind: str, volumes: list[mi.Volume]) -> np.ndarray | None:
    """World to the unit cube of the volume under a stock ``heterogeneous``; None for media that have no such box.

    A ``mivol_medium`` in a boundary larger than its grids is right under stock integrators (seen at depths of 1800), and a
    turned ``mivol_voxels`` is vacuum outside its own box: its upright box is enough here.
    """
    if kind != "HeterogeneousMedium":
        return None
    if volumes[0].class_name() in ("GridVolume", "ConstVolume"):
        return _printed(volumes[0], "matrix")
    corners = _corners(volumes[0].bbox())
    box = np.eye(4)
    box[:3, :3], box[:3, 3] = np.diag(np.ptp(corners, axis=0)), corners.min(axis=0)
    return np.linalg.inv(box)


def number(value: object) -> float:
    """The first number of whatever ``mi.traverse`` hands out."""
    return float(np.ravel(np.array(value))[0])


def _printed(volume: mi.Volume | None, name: str) -> np.ndarray | None:
    """A matrix from the printed form of a stock volume, the only place where Mitsuba shows it."""
    found = re.search(rf"to_local = Transform\[.*?\b{name}=(\[\[.*?\]\])", str(volume), re.DOTALL)
    return np.array(re.findall(r"[-+\w.]+", found[1]), dtype=np.float64).reshape(4, 4) if found else None


def _matrix(transform: object) -> np.ndarray:
    return np.array(transform.matrix, dtype=np.float64).reshape(4, 4)


def _corners(box: object) -> np.ndarray:
    low, high = (np.array(v, np.float64).ravel() for v in (box.min, box.max))
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)


def _crossings(p: np.ndarray, triangles: np.ndarray) -> int:
    """How many triangles a ray from p meets (Moeller, Trumbore 1997), along a direction that follows no axis."""
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
