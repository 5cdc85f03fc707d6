"""The rays of scanners: parallel beam, circular cone beam, and free lists of pencil rays.

Conventions. The object stands still and the scanner turns about the z axis through the world's origin. At angle ``theta`` the
beam runs along ``w = (-sin theta, cos theta, 0)`` and the detector's columns along ``u = (cos theta, sin theta, 0)``, its rows
along ``v = z``. A pixel right of the axis sees ``u . x > 0``, so a parallel projection is the Radon transform ``s = x
cos(theta) + y sin(theta)``. Row 0 is the lowest row (smallest z) and column 0 the smallest u, as voxel 0 is the lowest along
each axis of a grid. All lengths (distances, pitches, offsets, voxels) are in the same unit, chosen by the user; reconstructed
values are per this unit, and all angles are radians. Rays go through pixel centres and are float64.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), chapter 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError

_Z = np.array([0.0, 0.0, 1.0])


class Geometry(Protocol):
    """The interface of a scanner for a projector."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(views, rows, columns) of its projections."""
        ...

    @property
    def whole_lines(self) -> bool:
        """Whether a ray is the whole straight line through ``o`` (parallel light), not the half line from ``o``."""
        ...

    def rays(self, views: Sequence[int] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True, eq=False)
class Panels:
    """Placement of the flat detector in each view, (views, 3) float64 each [length].

    Attributes:
        source: position of the source; in parallel light the direction of the beam.
        corner: centre of the pixel of row 0 and column 0.
        along_u, along_v: step from a pixel's centre to the next column, and to the next row.
    """

    source: np.ndarray
    corner: np.ndarray
    along_u: np.ndarray
    along_v: np.ndarray


class FlatDetector(Geometry, Protocol):
    """A geometry with a plane detector and a regular lattice of pixels."""

    def panels(self, views: Sequence[int] | np.ndarray | None = None) -> Panels: ...


@dataclass(frozen=True)
class VoxelGrid:
    """Placement of voxels: an axis-aligned box of ``shape`` voxels.

    Args:
        shape: (Z, Y, X) numbers of voxels.
        voxel_size: edge of a voxel [length], a number or (x, y, z).
        centre: world position (x, y, z) of the box's middle [length].
    """

    shape: tuple[int, int, int]
    voxel_size: float | tuple[float, float, float] = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        shape = _to_counts(self.shape)
        if len(shape) != 3:
            raise MivolError(f"Found a grid shape {self.shape}, expected three counts (Z, Y, X), each at least 1.")
        size = _to_lengths(self.voxel_size, 3)
        if len(size) != 3 or not (size > 0).all():
            raise MivolError(f"Found a voxel size {self.voxel_size}, expected positive lengths: one, or (x, y, z).")
        centre = _to_finite(self.centre)
        if centre.shape != (3,):
            raise MivolError(f"Found a grid centre {self.centre}, expected a finite position (x, y, z).")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "voxel_size", tuple(map(float, size)))
        object.__setattr__(self, "centre", tuple(map(float, centre)))

    @property
    def size(self) -> int:
        """Number of voxels."""
        return int(np.prod(self.shape))

    @property
    def extent(self) -> np.ndarray:
        """Edges (x, y, z) of the box [length]."""
        return np.asarray(self.voxel_size) * np.asarray(self.shape[::-1])

    @property
    def radius(self) -> float:
        """Radius of the sphere around the box [length]."""
        return float(np.linalg.norm(self.extent) / 2)

    @property
    def to_world(self) -> np.ndarray:
        """4x4 float64 matrix from the unit cube to the box."""
        matrix = np.diag([*self.extent, 1.0])
        matrix[:3, 3] = np.asarray(self.centre) - self.extent / 2
        return matrix

    def select_layers(self, layers: slice) -> VoxelGrid:
        """Return the grid of some layers along z, evenly spaced upwards."""
        z = self.axis("z")[layers]
        x_size, y_size, z_size = self.voxel_size
        shape, size = (len(z), *self.shape[1:]), (x_size, y_size, z_size * (layers.step or 1))
        return VoxelGrid(shape, size, (*self.centre[:2], float(z[0] + z[-1]) / 2))

    def axis(self, name: str) -> np.ndarray:
        """World coordinates [length] of the voxel centres along ``"x"``, ``"y"`` or ``"z"``."""
        i = "xyz".index(name)
        n = self.shape[2 - i]
        return self.centre[i] + (np.arange(n) - (n - 1) / 2) * self.voxel_size[i]


@with_short_repr
@dataclass(frozen=True, eq=False)
class PencilRays:
    """A free list of half lines; each ray is a view of its own.

    Args:
        o: (N, 3) starting points [length].
        d: (N, 3) directions of arbitrary positive length; they are normalised.
    """

    o: np.ndarray
    d: np.ndarray
    whole_lines: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        o, d = np.array(self.o, float), np.array(self.d, float)
        if o.ndim != 2 or o.shape[1] != 3 or o.shape != d.shape or len(o) == 0:
            raise MivolError(f"Found rays of shapes {o.shape} and {d.shape}, expected two equal arrays (N, 3), N at least 1.")
        norm = np.linalg.norm(d, axis=1)
        bad = np.flatnonzero(~(np.isfinite(o).all(1) & np.isfinite(norm) & (norm > 0)))
        if len(bad):
            raise MivolError(
                f"Found an unusable ray at index {bad[0]}, expected finite origins and directions that are not zero."
            )
        object.__setattr__(self, "o", _make_read_only(o))
        object.__setattr__(self, "d", _make_read_only(d / norm[:, None]))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(N, 1, 1)."""
        return len(self.o), 1, 1

    def rays(self, views: Sequence[int] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions, each (views, 1, 1, 3) float64."""
        index = view_index(views, len(self.o))
        return self.o[index][:, None, None], self.d[index][:, None, None]


class _TurningDetector:
    """A flat detector that turns with the beam about the z axis.

    Tilt. The axis leans by ``tilt`` towards the detector: the light runs along ``cos(tilt) w + sin(tilt) z``, and the rows
    along ``cos(tilt) z - sin(tilt) w`` (laminography; 0: the light is perpendicular to the axis).

    Moves. In a view, the detector stands displaced by (along v, along u) pixels, and turned in its plane about its middle, from
    the columns towards the rows [rad]. The object then appears displaced the other way.
    """

    @property
    def shape(self) -> tuple[int, int, int]:
        """(views, rows, columns)."""
        return len(self.angles), *self.detector

    def select_rows(self, rows: slice) -> Self:
        """Return the same beam on some rows of the detector, evenly spaced upwards."""
        v = self.v[rows]
        pitch = self.pitch[0] * (rows.step or 1), self.pitch[1]
        offset = float(v[0] + v[-1]) / 2, self.detector_offset[1]
        return replace(self, detector=(len(v), self.detector[1]), pitch=pitch, detector_offset=offset)

    @property
    def u(self) -> np.ndarray:
        """Position of each column [length] from the rotation axis, for a cone beam from its foot on the detector."""
        columns = self.detector[1]
        return (np.arange(columns) - (columns - 1) / 2) * self.pitch[1] + self.detector_offset[1] - self.axis_offset

    @property
    def v(self) -> np.ndarray:
        """Position of each row on the detector [length] from z = 0, for a cone beam from the central ray."""
        rows = self.detector[0]
        return (np.arange(rows) - (rows - 1) / 2) * self.pitch[0] + self.detector_offset[0]

    @property
    def is_upright(self) -> bool:
        """Whether all views have their columns along the rotation axis, and their light perpendicular to it."""
        return not self.tilt and self.moves is None

    def _axes(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Directions (views, 3) of the columns, of the rows and of the light."""
        u, w = _beam_axes(self.angles[index])
        if not self.tilt:
            return u, np.broadcast_to(_Z, u.shape), w
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        return u, c * _Z - s * w, c * w + s * _Z

    def _panels(self, index: np.ndarray, source: np.ndarray, corner: np.ndarray, u: np.ndarray, v: np.ndarray) -> Panels:
        """The panels of views, moved; ``u`` and ``v`` are directions."""
        along_u, along_v = self.pitch[1] * u, self.pitch[0] * v
        if self.moves is None:
            return Panels(source, corner, along_u, along_v)
        rows, columns = (n - 1 for n in self.detector)
        row, column, turn = self.moves[index].T[..., None]
        middle = corner + (columns / 2 + column) * along_u + (rows / 2 + row) * along_v
        c, s = np.cos(turn), np.sin(turn)
        along_u, along_v = self.pitch[1] * (c * u + s * v), self.pitch[0] * (c * v - s * u)
        return Panels(source, middle - columns / 2 * along_u - rows / 2 * along_v, along_u, along_v)

    def _pixels(self, panels: Panels) -> np.ndarray:
        """Positions (views, rows, cols, 3) of the pixels' middles."""
        rows, columns = (np.arange(n, dtype=float) for n in self.detector)
        row = panels.corner[:, None, None] + rows[:, None, None] * panels.along_v[:, None, None]
        return row + columns[:, None] * panels.along_u[:, None, None]


@with_short_repr
@dataclass(frozen=True, eq=False)
class ParallelBeam(_TurningDetector):
    """Parallel light and a flat detector, turning together about the z axis.

    Args:
        angles: view angles [rad].
        detector: (rows, columns).
        pitch: distance of pixel centres [length], a number or (along v, along u).
        axis_offset: position of the rotation axis on the detector, from the middle of the detector along +u [length]. An axis
            at column ``c`` (pixel centres are whole numbers) means ``(c - (columns - 1) / 2) * pitch``.
        detector_offset: shift of the detector's middle (along v, along u) [length]; along u the shift cancels ``axis_offset``.
        tilt: angle by which the axis leans towards the detector [rad]; 0: the light is perpendicular to the axis.
        moves: (views, 3) displacement (along v, along u) [pixel] and turn in its plane [rad] of the detector; None: 0.
    """

    angles: np.ndarray
    detector: tuple[int, int]
    pitch: float | tuple[float, float] = 1.0
    axis_offset: float = 0.0
    detector_offset: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0
    moves: np.ndarray | None = None
    whole_lines: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        _check_detector(self)

    def rays(self, views: Sequence[int] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Points of the lines nearest the rotation axis, and unit directions, each (views, rows, cols, 3) float64."""
        index = view_index(views, len(self.angles))
        if not self.is_upright:
            panels = self.panels(index)
            pixels = self._pixels(panels)
            d = panels.source[:, None, None]
            return pixels - (pixels * d).sum(-1, keepdims=True) * d, np.broadcast_to(d, pixels.shape)
        u, w = _beam_axes(self.angles[index])
        v_of_row, u_of_col = self.v, self.u
        o = np.zeros((len(u), *self.detector, 3))
        o += u_of_col[:, None] * u[:, None, None, :]
        o[..., 2] = v_of_row[:, None]
        return o, np.broadcast_to(w[:, None, None, :], o.shape)

    def panels(self, views: Sequence[int] | np.ndarray | None = None) -> Panels:
        """The detector's plane through the axis; ``source`` is the direction of the light."""
        index = view_index(views, len(self.angles))
        u, v, w = self._axes(index)
        return self._panels(index, w, self.u[0] * u + self.v[0] * v, u, v)


@with_short_repr
@dataclass(frozen=True, eq=False)
class ConeBeam(_TurningDetector):
    """A point source and a flat detector on circles about the z axis.

    Args:
        angles: view angles [rad].
        detector: (rows, columns).
        source_to_axis: distance from the source to the rotation axis, along the central ray [length].
        source_to_detector: distance from the source to the detector's plane [length].
        pitch: distance of pixel centres on the detector [length], a number or (along v, along u).
        axis_offset: distance of the rotation axis from the central ray along +u, in the axis' plane (not magnified) [length].
        detector_offset: shift of the detector's middle from the central ray (along v, along u) [length].
        tilt: angle by which the axis leans towards the detector [rad]; 0: the central ray is perpendicular to the axis.
        moves: (views, 3) displacement (along v, along u) [pixel] and turn in its plane [rad] of the detector; None: 0.
    """

    angles: np.ndarray
    detector: tuple[int, int]
    source_to_axis: float
    source_to_detector: float
    pitch: float | tuple[float, float] = 1.0
    axis_offset: float = 0.0
    detector_offset: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0
    moves: np.ndarray | None = None
    whole_lines: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        lengths = _to_finite([self.source_to_axis, self.source_to_detector])
        if lengths.shape != (2,) or not (lengths > 0).all():
            raise MivolError(
                f"Found {self.source_to_axis} from source to axis and {self.source_to_detector} from source to "
                "detector, expected positive lengths."
            )
        if self.source_to_detector < self.source_to_axis:
            raise MivolError(
                f"Found the detector {self.source_to_detector} from the source, in front of the axis at {self.source_to_axis}: "
                "swap source_to_axis and source_to_detector, or give the distance from the source, not from the axis."
            )
        _check_detector(self)

    def rays(self, views: Sequence[int] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The source, and unit directions towards the pixel centres, each (views, rows, cols, 3) float64."""
        index = view_index(views, len(self.angles))
        if not self.is_upright:
            panels = self.panels(index)
            d = self._pixels(panels) - panels.source[:, None, None]
            return np.broadcast_to(panels.source[:, None, None], d.shape), d / np.linalg.norm(d, axis=-1, keepdims=True)
        u, w = _beam_axes(self.angles[index])
        v_of_row, u_of_col = self.v, self.u
        source = self._sources(u, w)
        d = np.zeros((len(u), *self.detector, 3))
        d += (u_of_col + self.axis_offset)[:, None] * u[:, None, None, :] + self.source_to_detector * w[:, None, None, :]
        d[..., 2] = v_of_row[:, None]
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return np.broadcast_to(source[:, None, None, :], d.shape), d

    def panels(self, views: Sequence[int] | np.ndarray | None = None) -> Panels:
        """Source and detector of each view."""
        index = view_index(views, len(self.angles))
        u, v, w = self._axes(index)
        source = self._sources(u, w)
        corner = source + (self.u[0] + self.axis_offset) * u + self.v[0] * v + self.source_to_detector * w
        return self._panels(index, source, corner, u, v)

    def _sources(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        return -self.axis_offset * u - self.source_to_axis * w


def tigre_cone_beam(n: int = 256, n_views: int = 100) -> tuple[ConeBeam, VoxelGrid]:
    """The cone beam of TIGRE's own algorithm tests ("configuration 1"), at a chosen resolution.

    A cube of 256 mm, source to axis 1000 mm, source to detector 1536 mm, a square detector of 409.6 mm, full circle with the
    last view on top of the first. Lengths are mm.

    Args:
        n: voxels along an edge, and pixels along a detector's edge (256 in TIGRE).
        n_views: number of views (100 in TIGRE).

    References: CERN/TIGRE at e702473, Python/tests/generate_configurations.py and geometry_default.py.
    """
    angles = np.linspace(0.0, 2 * np.pi, n_views)
    beam = ConeBeam(angles, (n, n), source_to_axis=1000.0, source_to_detector=1536.0, pitch=409.6 / n)
    return beam, VoxelGrid((n, n, n), voxel_size=256.0 / n)


def _check_detector(beam: ParallelBeam | ConeBeam) -> None:
    angles = _to_finite(beam.angles).reshape(-1)
    if len(angles) == 0:
        raise MivolError(f"Found the view angles {beam.angles!r:.60}, expected at least one, all finite, in radians.")
    detector = _to_counts(beam.detector)
    if len(detector) != 2:
        raise MivolError(f"Found a detector of {beam.detector} pixels, expected (rows, columns), each at least 1.")
    pitch = _to_lengths(beam.pitch, 2)
    if len(pitch) != 2 or not (pitch > 0).all():
        raise MivolError(f"Found a pixel pitch {beam.pitch}, expected positive lengths: one, or (along v, along u).")
    offsets = [beam.axis_offset, *np.atleast_1d(beam.detector_offset).tolist()]
    if _to_finite(offsets).shape != (3,):
        raise MivolError(f"Found offsets {offsets} of axis and detector (v, u), expected three finite lengths.")
    if not abs(beam.tilt) < np.pi / 2:
        raise MivolError(f"Found a tilt of {beam.tilt} rad, expected less than a quarter of a turn either way.")
    if beam.moves is not None:
        moves = _to_finite(beam.moves)
        if moves.shape != (len(angles), 3):
            raise MivolError(f"Found moves of shape {np.shape(beam.moves)}, expected three finite numbers a view.")
        object.__setattr__(beam, "moves", _make_read_only(moves))
    object.__setattr__(beam, "angles", _make_read_only(angles))
    object.__setattr__(beam, "detector", detector)
    object.__setattr__(beam, "pitch", tuple(map(float, pitch)))


def view_index(views: Sequence[int] | np.ndarray | None, n_views: int) -> np.ndarray:
    """Numbers of views as an array; all views for None.

    Raises:
        MivolError: numbers other than a row of 0 to ``n_views`` - 1.
    """
    if views is None:
        return np.arange(n_views)
    found = np.atleast_1d(_to_finite(views))
    index = found.astype(int)
    is_empty = hasattr(views, "__len__") and len(views) == 0
    if found.ndim != 1 or (index != found).any() or (found.size == 0 and not is_empty):
        raise MivolError(f"Found {views!r:.80} for views, expected whole numbers in a row, from 0 to {n_views - 1}.")
    wrong = index[(index < 0) | (index >= n_views)]
    if len(wrong):
        raise MivolError(f"Found view {wrong[0]}, expected views from 0 to {n_views - 1}.")
    return index


def _to_finite(given: object) -> np.ndarray:
    """Convert to float64 numbers; empty for other objects or for numbers that are not finite."""
    try:
        found = np.array(given, float)
    except (TypeError, ValueError):
        return np.empty(0)
    return found if np.isfinite(found).all() else np.empty(0)


def _to_lengths(given: object, count: int) -> np.ndarray:
    """Convert to ``count`` lengths, from a single number or ``count`` numbers; empty for other objects."""
    found = _to_finite(given)
    return np.broadcast_to(found, (count,)) if found.shape in ((), (1,), (count,)) else np.empty(0)


def _to_counts(given: object) -> tuple[int, ...]:
    """Convert to whole numbers of at least 1; empty for other numbers."""
    found = np.atleast_1d(_to_finite(given))
    return tuple(found.astype(int).tolist()) if found.ndim == 1 and (found % 1 == 0).all() and (found >= 1).all() else ()


def _beam_axes(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    c, s, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    return np.stack([c, s, zero], -1), np.stack([-s, c, zero], -1)


def _make_read_only(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a


def subdivide_grid(grid: VoxelGrid, parts: int, geometry: Geometry) -> VoxelGrid:
    """Divide the voxels of a grid into ``parts`` along each axis, for a parallel beam along x and y only.

    A ray sees edges inside voxels. Line integrals of sharp edges agree with no field of voxels, and least squares trades the
    misfit for ripples at the edges that grow with each iteration. Finer unknowns absorb the misfit, and their mean loses the
    ripples. Each row of a parallel beam sees a single height, so finer layers could not be distinguished.
    """
    times = (1 if isinstance(geometry, ParallelBeam) else parts, parts, parts)
    shape = tuple(k * n for k, n in zip(times, grid.shape, strict=True))
    return VoxelGrid(shape, tuple(edge / k for edge, k in zip(grid.voxel_size, times[::-1], strict=True)), grid.centre)


def voxel_means(x: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Means over blocks: a field (Z, Y, X) on a subdivided grid becomes a field of ``shape``, in the same dtype.

    The mean of values at the middles of equal parts equals the mean of the field up to its curvature.
    """
    # Axis by axis, as sums of slices: seven times as fast as a mean over axes of blocks.
    for axis, (coarse, fine) in enumerate(zip(shape, x.shape, strict=True)):
        if (parts := fine // coarse) > 1:
            first, *rest = (x[(*[slice(None)] * axis, slice(part, None, parts))] for part in range(parts))
            x = sum(rest, first) / np.asarray(parts, x.dtype)
    return x
