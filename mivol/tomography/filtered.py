"""Filtered back-projection in parallel and in cone beams: fast, in a single step and without noise weights.

Back-projection runs voxel by voxel: every voxel reads each view once, interpolated between the pixels at its shadow. The
operation is not the transpose of the projector, which spreads rays over voxels: do not use it in an iterative solver.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), sections 3.3 and 3.6; Feldkamp, Davis & Kress
1984, J. Opt. Soc. Am. A 1, 612; Parker 1982; Wang 2002; Gullberg, Crawford & Tsui 1986, IEEE Trans. Med. Imaging 5, 23 (a
rotation axis beside the central ray).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.threads import check_one_thread
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector
from mivol.tomography.ramp import filter_ramp
from mivol.tomography.redundancy import angle_steps, covers_circle, full_turn_weights, parker_weights, widest_gap

__all__ = [
    "check_circle",
    "check_directions",
    "check_parallel",
    "feldkamp",
    "filtered_backprojection",
    "pixel_matrices",
    "backproject_voxels",
]


def filtered_backprojection(projector: Projector, y: np.ndarray, window: str = "ram-lak", cutoff: float = 1.0) -> np.ndarray:
    """Reconstruct a parallel-beam scan in a single step: ``x = sum_views step share (h * y)(x . u)``.

    Views may be spread arbitrarily over half a turn or more: each view stands for its nearest directions. A detector divided
    unevenly by the rotation axis reaches its whole width over a whole turn
    (:func:`~mivol.tomography.redundancy.full_turn_weights`).

    Args:
        projector: projector of a :class:`~mivol.tomography.geometry.ParallelBeam`, with the views of ``y``.
        y: (views, rows, cols) line integrals.
        window, cutoff: as in :func:`~mivol.tomography.ramp.filter_ramp`.

    Returns:
        (Z, Y, X) float32 [1/length].

    Raises:
        MivolError: another beam, or missing directions.

    Bias: the ramp stops at the pixels' Nyquist frequency; few views leave streaks. Values are not clipped at 0.
    Cost: four reads per voxel and view.
    """
    beam, weights = projector.geometry, _parallel_weights(projector)
    weighted, matrices = _pad_detector(y * weights[:, None], pixel_matrices(beam, projector.grid, projector.views), beam.u)
    return backproject_voxels(matrices, filter_ramp(weighted, beam.pitch[1], window, cutoff), projector.grid, weighted=False)


def _parallel_weights(projector: Projector) -> np.ndarray:
    """Step times share (views, cols) of each ray."""
    beam = projector.geometry
    if not isinstance(beam, ParallelBeam):
        raise MivolError(
            f"Found {type(beam).__name__}, expected a ParallelBeam: fdk is filtered back-projection of a ConeBeam."
        )
    angles, u = beam.angles[projector.views], beam.u
    if not covers_circle(angles, np.pi):
        gap = np.degrees(widest_gap(angles, np.pi)[0])
        raise MivolError(
            f"found views with a gap of {gap:.1f} degrees among the directions of half a turn, expected them all around: "
            "choose an iterative solver (angles are radians here, and degrees in files)."
        )
    if covers_circle(angles, 2 * np.pi):
        return angle_steps(angles, 2 * np.pi)[:, None] * full_turn_weights(u)
    return np.broadcast_to(angle_steps(angles, np.pi)[:, None], (len(angles), len(u)))


def feldkamp(projector: Projector, y: np.ndarray, window: str = "ram-lak", cutoff: float = 1.0) -> np.ndarray:
    """Reconstruct a circular cone-beam scan in a single step (FDK).

    ``x = sum_views step / U^2 (h * (share cos y))``: ``U`` is the depth of a voxel over the depth of the axis, and ``cos`` the
    cosine of the angle between a ray and the central ray. The ramp acts on rows scaled to the axis. For an axis at the
    distance ``tau`` from the central ray, ``cos = (D^2 + tau p) / (D sqrt(D^2 + p^2 + q^2))`` for the ray through (p, q) in
    the axis' plane (Gullberg 1986). The shares belong to a whole turn, to a displaced detector on a whole turn, or (Parker) to
    half a turn plus the fan.

    Args, returns: as :func:`filtered_backprojection`, for a :class:`~mivol.tomography.geometry.ConeBeam`.

    Raises:
        MivolError: another beam, or fewer views than half a turn plus the angle of the fan.

    Bias: exact in the source's plane; elsewhere the bias grows with the cone's angle (Feldkamp 1984).
    Cost: four reads per voxel and view.
    """
    weights = _circle_weights(projector)
    beam, grid, scale = projector.geometry, projector.grid, _scale_to_axis(projector.geometry)
    distance, tau = beam.source_to_axis, beam.axis_offset
    # Positions from the central ray, on the detector scaled to the axis.
    p, q = (beam.u + tau) * scale, beam.v * scale
    cosine = (distance**2 + tau * p) / (distance * np.sqrt(distance**2 + p**2 + q[:, None] ** 2))
    weighted, matrices = _pad_detector(y * weights[:, None] * cosine, pixel_matrices(beam, grid, projector.views), p)
    filtered = filter_ramp(weighted, beam.pitch[1] * scale, window, cutoff)
    # t of the matrices is the depth over source_to_detector, U the depth over source_to_axis.
    return backproject_voxels(matrices, filtered * scale**2, grid, weighted=True)


def check_directions(projector: Projector) -> None:
    """Refuse scans unsuitable for filtered back-projection.

    Raises:
        MivolError: as :func:`filtered_backprojection` for a parallel beam, or :func:`feldkamp` for other beams.
    """
    (check_parallel if isinstance(projector.geometry, ParallelBeam) else check_circle)(projector)


def check_parallel(projector: Projector) -> None:
    """Refuse scans unsuitable for :func:`filtered_backprojection`.

    Raises:
        MivolError: another beam, or missing directions.
    """
    _parallel_weights(projector)


def check_circle(projector: Projector) -> None:
    """Refuse scans unsuitable for :func:`feldkamp`.

    Raises:
        MivolError: as :func:`feldkamp`.
    """
    _circle_weights(projector)


def _scale_to_axis(beam: ConeBeam) -> float:
    return beam.source_to_axis / beam.source_to_detector


def _circle_weights(projector: Projector) -> np.ndarray:
    """Step times share (views, cols) of each ray."""
    beam = projector.geometry
    if not isinstance(beam, ConeBeam):
        raise MivolError(
            f"Found {type(beam).__name__}, expected a ConeBeam on a circle: fbp is for parallel beams, for any other "
            "trajectory choose an iterative solver."
        )
    distance, tau = beam.source_to_axis, beam.axis_offset
    gamma = np.arctan2((beam.u + tau) * _scale_to_axis(beam), distance) - np.arctan2(tau, distance)
    return cone_weights(beam.angles[projector.views], gamma, _object_fan(projector, gamma))


def cone_weights(angles: np.ndarray, gamma: np.ndarray, needed: float) -> np.ndarray:
    """Step times share (views, cols) of rays at ``gamma`` to the axis, for an object within ``needed`` of the axis [rad].

    Raises:
        MivolError: views over less than half a turn plus twice ``needed``.
    """
    if covers_circle(angles, 2 * np.pi):
        return angle_steps(angles, 2 * np.pi)[:, None] * full_turn_weights(gamma)
    gap, start = widest_gap(angles, 2 * np.pi)
    beta = np.mod(angles - start + 1e-9, 2 * np.pi) - 1e-9
    arc = 2 * np.pi - gap
    excess = (arc - np.pi) / 2
    # Half a step of slack: each view stands for half a step beyond it.
    if excess + arc / len(angles) / 2 < needed:
        raise MivolError(
            f"found cone-beam views over {np.degrees(arc):.1f} degrees, expected half a turn and the fan of "
            f"{np.degrees(2 * needed):.1f} at least: choose an iterative solver."
        )
    order = np.argsort(beta, kind="stable")
    steps = np.empty(len(angles))
    steps[order] = np.gradient(beta[order])
    steps[order[[0, -1]]] /= 2
    return steps[:, None] * parker_weights(beta, gamma, excess)


def _pad_detector(y: np.ndarray, matrices: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add columns of 0 to projections and shift their matrices, until the detector reaches equally far on both sides of the
    axis.

    The filter spreads a row beyond its ends. Voxels with a shadow beyond the shorter side of a displaced detector read the
    added columns.
    """
    missing = round(abs(u[0] + u[-1]) * (len(u) - 1) / (u[-1] - u[0])) if len(u) > 1 else 0
    on_the_left = missing if u[-1] > -u[0] else 0
    moved = matrices.copy()
    moved[:, 0] += on_the_left * matrices[:, 2]
    return np.pad(y, ((0, 0), (0, 0), (on_the_left, missing - on_the_left))), moved


def _object_fan(projector: Projector, gamma: np.ndarray) -> float:
    """Largest angle [rad] to the axis at which the detector sees the cylinder inside the grid."""
    grid, beam = projector.grid, projector.geometry
    radius = min(grid.extent[:2]) / 2 + np.hypot(*grid.centre[:2])
    reach = np.hypot(beam.source_to_axis, beam.axis_offset)
    object_fan = np.arcsin(min(1.0, radius / reach))
    return float(min(object_fan, max(-gamma[0], gamma[-1])))


VIEWS_AT_ONCE = 4
"""Views per kernel; the kernel reads and writes the sums once for all its views."""


def pixel_matrices(beam: FlatDetector, grid: VoxelGrid, views: Sequence[int] | np.ndarray | None = None) -> np.ndarray:
    """(views, 3, 4) float64 matrices from a voxel's indices (x, y, z, 1) to (column t, row t, t) of the shadowed pixel.

    ``t`` is the fraction of the way from the source to the detector's plane; 1 in parallel light.
    """
    panels = beam.panels(views)
    to_corner = panels.corner - panels.source if not beam.whole_lines else panels.source
    # x - S = t (corner - S + c u + r v): the inverse of the matrix of columns (u, v, corner - S) gives (c t, r t, t).
    inverse = np.linalg.inv(np.stack([panels.along_u, panels.along_v, to_corner], -1))
    start = panels.corner if beam.whole_lines else panels.source
    matrices = np.concatenate([inverse, -np.einsum("nij,nj->ni", inverse, start)[:, :, None]], -1)
    if beam.whole_lines:
        matrices[:, 2] = (0.0, 0.0, 0.0, 1.0)
    index_to_world = np.diag([*grid.voxel_size, 1.0])
    index_to_world[:3, 3] = [grid.axis(name)[0] for name in "xyz"]
    return matrices @ index_to_world


def backproject_voxels(matrices: np.ndarray, images: np.ndarray, grid: VoxelGrid, weighted: bool) -> np.ndarray:
    """Sum over views of the pixel at each voxel's shadow, bilinear between pixel centres, 0 beyond the detector's edge.

    Args:
        matrices: matrices of :func:`pixel_matrices`.
        images: (views, rows, cols).
        grid: grid of the result.
        weighted: whether each reading is divided by t^2.

    Returns:
        (Z, Y, X) float32.

    Cost: four reads per voxel and view.
    """
    check_one_thread()
    total = dr.zeros(mi.Float, grid.size)
    shape = tuple(dr.opaque(mi.UInt32, n) for n in grid.shape[:0:-1])
    size = tuple(dr.opaque(mi.UInt32, n) for n in images.shape[1:])
    for first in range(0, len(matrices), VIEWS_AT_ONCE):
        some = slice(first, first + VIEWS_AT_ONCE)
        for matrix, image in zip(matrices[some], images[some], strict=True):
            entries = [dr.opaque(mi.Float, float(value)) for value in matrix.ravel()]
            pixels = mi.Float(np.ascontiguousarray(image, np.float32).ravel())
            total += _read_view(entries, pixels, grid.size, shape, size, weighted)
        dr.eval(total)
    return np.array(total).reshape(grid.shape)


def _read_view(
    entries: list[mi.Float],
    image: mi.Float,
    n: int,
    shape: tuple[mi.UInt32, mi.UInt32],
    size: tuple[mi.UInt32, mi.UInt32],
    weighted: bool,
) -> mi.Float:
    """Reading of each voxel in a view; ``shape`` is (X, Y) of the grid, ``size`` (rows, cols) of the image."""
    index = dr.arange(mi.UInt32, n)
    line, x = index // shape[0], index % shape[0]
    p = (mi.Float(x), mi.Float(line % shape[1]), mi.Float(line // shape[1]))
    column, row, t = (
        dr.fma(a, p[0], dr.fma(b, p[1], dr.fma(c, p[2], d))) for a, b, c, d in (entries[4 * i : 4 * i + 4] for i in range(3))
    )
    inverse = dr.rcp(t)
    column, row = column * inverse, row * inverse
    seen = t > 0
    parts = []
    for place, count in ((row, size[0]), (column, size[1])):
        last = mi.Float(count - 1)
        # A pixel is as wide as its pitch: half of the pixel lies beyond the outermost centres.
        seen &= (place > -0.5) & (place < last + 0.5)
        inside = dr.clip(place, 0, last)
        lower = mi.UInt32(inside)
        parts.append((lower, dr.minimum(lower + 1, count - 1), inside - mi.Float(lower)))
    (r0, r1, fr), (c0, c1, fc) = parts
    a, b, c, d = (dr.gather(mi.Float, image, r * size[1] + k, seen) for r in (r0, r1) for k in (c0, c1))
    value = dr.lerp(dr.lerp(a, b, fc), dr.lerp(c, d, fc), fr)
    return value * dr.square(inverse) if weighted else value
