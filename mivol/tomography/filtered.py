"""Filtered back-projection in parallel and in cone beams: fast, in a single step and without noise weights.

Back-projection runs voxel by voxel: every voxel reads each view once, interpolated between the pixels at its shadow. The
operation is not the transpose of the projector, which spreads rays over voxels: do not use it in an iterative solver. In
parallel light all layers share the columns of their shadows, so a voxel reads its rows of sixteen layers at once.

Shares. The inverse is an integral over all lines, each counted once. The share of a ray is its part of a line that the scan
measures twice; the shares of all rays on a line add up to 1. ``gamma`` is the angle [rad] between a ray and the ray through the
rotation axis, positive towards larger columns. In the geometry of :mod:`mivol.tomography.geometry` the ray (theta, gamma) and
the ray (theta + pi - 2 gamma, -gamma) run along the same line from its two ends.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), sections 3.3 (Eq. 61: the band-limited ramp),
3.4 and 3.6; Ramachandran & Lakshminarayanan 1971 (no window); Shepp & Logan 1974 (the sinc window); Feldkamp, Davis & Kress
1984, J. Opt. Soc. Am. A 1, 612; Parker 1982, Med. Phys. 9, 254 (half scans); Wang 2002, Med. Phys. 29, 1634 (displaced
detectors); Gullberg, Crawford & Tsui 1986, IEEE Trans. Med. Imaging 5, 23 (a rotation axis beside the central ray).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

from mivol.errors import MivolError
from mivol.threads import check_one_thread
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

WINDOWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ram-lak": np.ones_like,
    "shepp-logan": lambda f: np.sinc(f / 2),
    "cosine": lambda f: np.cos(np.pi * f / 2),
    "hamming": lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    "hann": lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}
"""Windows by name: the factor on a frequency ``f``, which is in units of the cutoff, from 0 to 1."""


def filter_ramp(y: np.ndarray, pitch: float, window: str = "ram-lak", cutoff: float = 1.0) -> np.ndarray:
    """Convolve each row with the band-limited ramp, zero beyond the detector.

    ``h(0) = 1 / (4 pitch^2)``, ``h(n) = -1 / (pi n pitch)^2`` for odd n, 0 for even n; the sum is multiplied by ``pitch``. The
    kernel is sampled in space, so its mean is right; a ramp sampled in frequency would shift all values of the object.

    Args:
        y: (..., cols).
        pitch: pitch of the columns [length].
        window: key of WINDOWS.
        cutoff: end of the window over the Nyquist frequency, in (0, 1].

    Returns:
        (..., cols) [1/length], float32 if ``y`` is, else float64.

    Raises:
        MivolError: an unknown window, or a cutoff outside (0, 1].
    """
    if window not in WINDOWS:
        raise MivolError(f'found the filter window "{window}", expected one of {", ".join(WINDOWS)}.')
    if not 0 < cutoff <= 1:
        raise MivolError(f"found a cutoff of {cutoff}, expected a part of the Nyquist frequency above 0, at most 1.")
    n = y.shape[-1]
    size = scipy.fft.next_fast_len(2 * n, real=True)
    k = np.minimum(np.arange(size), size - np.arange(size))
    h = np.where(k % 2 == 1, -1.0 / (np.pi * np.maximum(k, 1) * pitch) ** 2, 0.0)
    h[0] = 1.0 / (4 * pitch**2)
    f = 2 * scipy.fft.rfftfreq(size) / cutoff
    kept = np.where(f <= 1, WINDOWS[window](np.minimum(f, 1.0)), 0.0)
    response = pitch * scipy.fft.rfft(h).real * kept
    spectrum = scipy.fft.rfft(y, size)
    spectrum *= response.astype(spectrum.real.dtype)
    return scipy.fft.irfft(spectrum, size, overwrite_x=True)[..., :n]


def filtered_backprojection(projector: Projector, y: np.ndarray, window: str = "ram-lak", cutoff: float = 1.0) -> np.ndarray:
    """Reconstruct a parallel-beam scan in a single step: ``x = sum_views step share (h * y)(x . u)``.

    Views may be spread arbitrarily over half a turn or more: each view stands for its nearest directions. A detector divided
    unevenly by the rotation axis reaches its whole width over a whole turn
    (:func:`~mivol.tomography.filtered.full_turn_weights`).

    Args:
        projector: projector of a :class:`~mivol.tomography.geometry.ParallelBeam`, with the views of ``y``.
        y: (views, rows, cols) line integrals.
        window, cutoff: as in :func:`~mivol.tomography.filtered.filter_ramp`.

    Returns:
        (Z, Y, X) float32 [1/length].

    Raises:
        MivolError: another beam, or missing directions.

    Bias: the ramp stops at the pixels' Nyquist frequency; few views leave streaks. Values are not clipped at 0.
    Cost: two reads of sixteen neighbours per view and sixteen voxels along z; four reads per voxel and view with a tilt, or
    with a detector that moves along v. Memory: ``y`` once more in float32.
    """
    beam, weights = projector.geometry, _parallel_weights(projector)
    margins = _detector_margins(beam.u)
    matrices = _shift_columns(pixel_matrices(beam, projector.grid, projector.views), margins[0])
    images = _filter_views(y, lambda views: weights[views, None], margins, beam.pitch[1], window, cutoff)
    if have_layers(matrices):
        return backproject_layers(matrices, images, projector.grid)
    return backproject_voxels(matrices, images, projector.grid, weighted=False)


def _parallel_weights(projector: Projector) -> np.ndarray:
    """Step times share (views, cols) of each ray."""
    beam = projector.geometry
    if not isinstance(beam, ParallelBeam):
        raise MivolError(
            f"Found {type(beam).__name__}, expected a ParallelBeam: fdk is filtered back-projection of a ConeBeam."
        )
    _check_tilt(beam.tilt)
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


MOST_TILT = 0.1
"""Tilt [rad] up to which the ramp along the rows serves: its cosine, by which values are wrong, is then 0.995."""


def _check_tilt(tilt: float) -> None:
    if abs(tilt) > MOST_TILT:
        raise MivolError(
            f"found an axis tilted by {np.degrees(tilt):.3g} degrees, expected at most {np.degrees(MOST_TILT):.1f} for "
            "filtered back-projection: choose an iterative solver."
        )


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
    margins = _detector_margins(p)
    matrices = _shift_columns(pixel_matrices(beam, grid, projector.views), margins[0])
    # t of the matrices is the depth over source_to_detector, U the depth over source_to_axis.
    cosine *= scale**2
    images = _filter_views(y, lambda views: weights[views, None] * cosine, margins, beam.pitch[1] * scale, window, cutoff)
    return backproject_voxels(matrices, images, grid, weighted=True)


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
    _check_tilt(beam.tilt)
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


def _detector_margins(u: np.ndarray) -> tuple[int, int]:
    """Columns of 0 to add on both sides, until the detector reaches equally far on both sides of the axis.

    The filter spreads a row beyond its ends. Voxels with a shadow beyond the shorter side of a displaced detector read the
    added columns.
    """
    missing = round(abs(u[0] + u[-1]) * (len(u) - 1) / (u[-1] - u[0])) if len(u) > 1 else 0
    return (missing, 0) if u[-1] > -u[0] else (0, missing)


def _shift_columns(matrices: np.ndarray, columns: int) -> np.ndarray:
    """The matrices of a detector with ``columns`` more columns before the first."""
    moved = matrices.copy()
    moved[:, 0] += columns * matrices[:, 2]
    return moved


FILTER_BYTES = 1 << 26
"""Memory of the rows filtered at once [byte]."""


def _filter_views(
    y: np.ndarray,
    weights: Callable[[slice], np.ndarray],
    margins: tuple[int, int],
    pitch: float,
    window: str,
    cutoff: float,
) -> np.ndarray:
    """Filtered views (views, rows, cols and margins) float32, a few at a time; ``weights`` of views multiply them before."""
    n_views, rows, columns = y.shape
    images = np.empty((n_views, rows, columns + sum(margins)), np.float32)
    step = max(1, FILTER_BYTES // (4 * rows * images.shape[2]))
    for first in range(0, n_views, step):
        views = slice(first, first + step)
        weighted = np.multiply(y[views], weights(views), dtype=np.float32, casting="same_kind")
        images[views] = filter_ramp(np.pad(weighted, ((0, 0), (0, 0), margins)), pitch, window, cutoff)
    return images


def _object_fan(projector: Projector, gamma: np.ndarray) -> float:
    """Largest angle [rad] to the axis at which the detector sees the cylinder inside the grid."""
    grid, beam = projector.grid, projector.geometry
    radius = min(grid.extent[:2]) / 2 + np.hypot(*grid.centre[:2])
    reach = np.hypot(beam.source_to_axis, beam.axis_offset)
    object_fan = np.arcsin(min(1.0, radius / reach))
    return float(min(object_fan, max(-gamma[0], gamma[-1])))


# -- Shares of lines that are measured more than once ----------------------------------------------------------------------


MAX_GAP = 4.0
"""Largest gap between neighbouring views, in steps (the whole range over the number of views). Golden-angle views are at most
1.9 steps apart; a gap above 4 steps means missing directions."""

BLEND_COLUMNS = 20
"""Smallest width, in columns, of the change from a share of a half to 1 or 0 on a displaced detector: the ramp filter turns a
sharper change into a ring."""


def angle_steps(angles: np.ndarray, period: float) -> np.ndarray:
    """The part of a circle of ``period`` [rad] for which each view stands: to the middle between neighbours on both sides.

    Equal angles share their part. The steps add up to ``period``.
    """
    order = np.argsort(np.mod(angles, period), kind="stable")
    sorted_angles = np.mod(angles, period)[order]
    gaps = np.diff(sorted_angles, append=sorted_angles[:1] + period)
    steps = np.empty(len(angles))
    steps[order] = (gaps + np.roll(gaps, 1)) / 2
    return steps


def widest_gap(angles: np.ndarray, period: float) -> tuple[float, float]:
    """(width, end) of the widest arc [rad] without a view on a circle of ``period``."""
    found = np.sort(np.mod(angles, period))
    gaps = np.diff(found, append=found[:1] + period)
    widest = int(gaps.argmax())
    return float(gaps[widest]), float(found[(widest + 1) % len(found)])


def covers_circle(angles: np.ndarray, period: float) -> bool:
    """Whether the views cover a circle of ``period``."""
    return widest_gap(angles, period)[0] <= MAX_GAP * period / len(angles) + 1e-9


def full_turn_weights(gamma: np.ndarray) -> np.ndarray:
    """Shares (cols,) of the rays of a whole turn; a centred detector measures each line twice.

    The share is a half in columns mirrored by the other side of the axis. Beyond the shorter side a line is measured once and
    counts 1. The share changes smoothly from a half to 1 (and to 0 on the shorter side), over the outer fifth of the shorter
    side or BLEND_COLUMNS.
    """
    short = min(-gamma[0], gamma[-1])
    column = float(np.mean(np.diff(gamma))) if len(gamma) > 1 else 0.0
    if abs(gamma[0] + gamma[-1]) < column:
        return np.full(len(gamma), 0.5)
    if short <= 0:
        raise MivolError(
            "found a detector that lies wholly on one side of the rotation axis, expected the axis to be seen: use an "
            "iterative solver."
        )
    longer = 1.0 if gamma[-1] > -gamma[0] else -1.0
    width = min(short, max(short / 5, BLEND_COLUMNS * column))
    along = np.clip((np.abs(gamma) - (short - width)) / width, 0.0, 1.0)
    return 0.5 * (1 + longer * np.sign(gamma) * np.sin(np.pi / 2 * along) ** 2)


def parker_weights(beta: np.ndarray, gamma: np.ndarray, excess: float) -> np.ndarray:
    """Parker's shares (views, cols) of a scan over ``pi + 2 excess``.

    Args:
        beta: (views,) angle from the first view [rad].
        gamma: (cols,).
        excess: half of the scan's range beyond half a turn [rad]; at least the largest gamma that sees the object.
    """
    b = beta[:, None]
    # Parker's gamma has the opposite sign: his ray (beta, gamma) is the line of (beta + pi + 2 gamma, -gamma).
    g = np.clip(-gamma, -excess, excess)[None, :]
    rise, fall = 2 * (excess - g), 2 * (excess + g)
    tiny = np.finfo(float).tiny
    first = np.sin(np.pi / 2 * np.clip(b / np.maximum(rise, tiny), 0.0, 1.0)) ** 2
    last = np.sin(np.pi / 2 * np.clip((np.pi + 2 * excess - b) / np.maximum(fall, tiny), 0.0, 1.0)) ** 2
    return np.where(b < rise, first, np.where(b > np.pi - 2 * g, last, 1.0))


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


MOST_LAYERS, VIEWS_OF_LOOP = 16, 64
"""Most layers read at once, from neighbours in memory, and views of a kernel: the pixels that a few neighbouring voxels read in
64 views fit into a first-level cache."""


def have_layers(matrices: np.ndarray) -> bool:
    """Whether the row of a shadow in parallel light depends on z alone, in the same way in all views: to 1e-9 rows a voxel."""
    rows = matrices[:, 1]
    return bool(np.abs(rows[:, :2]).max() < 1e-9 and np.ptp(rows, axis=0).max() < 1e-9)


def backproject_layers(matrices: np.ndarray, images: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """As :func:`backproject_voxels` without weights, for parallel light about z: a shadow's row depends on z alone.

    Args:
        matrices: matrices of :func:`pixel_matrices` for a :class:`~mivol.tomography.geometry.ParallelBeam`.
        images: (views, rows, cols).
        grid: grid of the result.

    Returns:
        (Z, Y, X) float32.
    """
    check_one_thread()
    n_views, rows, columns = images.shape
    n_z, n_y, n_x = grid.shape
    place = matrices[0, 1, 2] * np.arange(n_z) + matrices[0, 1, 3]
    is_seen = (place > -0.5) & (place < rows - 0.5)
    lower = np.clip(place, 0, rows - 1).astype(int)
    fraction = (np.clip(place, 0, rows - 1) - lower).astype(np.float32)
    entries = mi.Float(np.ascontiguousarray(matrices[:, 0][:, [0, 1, 3]], np.float32).ravel())
    found = np.empty(grid.shape, np.float32)
    # A packet has a power of two of numbers.
    at_once = min(MOST_LAYERS, 1 << (n_z - 1).bit_length())
    for first in range(0, n_z, at_once):
        group = slice(first, min(first + at_once, n_z))
        # (views, cols, layers): a layer between two rows is interpolated, and layers beyond the detector are 0.
        pixels = np.zeros((n_views, columns, at_once), np.float32)
        for k, z in enumerate(range(first, group.stop)):
            if is_seen[z]:
                pixels[:, :, k] = images[:, lower[z]]
                if fraction[z]:
                    pixels[:, :, k] += fraction[z] * (images[:, lower[z] + 1] - images[:, lower[z]])
        total = _sum_layers(entries, mi.Float(pixels.ravel()), pixels.shape, (n_y, n_x))
        found[group] = np.reshape(total, (at_once, n_y, n_x))[: group.stop - first]
    return found


def _sum_layers(entries: mi.Float, pixels: mi.Float, size: tuple[int, int, int], shape: tuple[int, int]) -> np.ndarray:
    """Sums over views (layers, voxels of a layer) of ``pixels`` of size (views, cols, layers).

    ``entries`` has the affine map from (x, y, 1) to the column of each view.
    """
    n_views, columns, layers = size
    width, count = dr.opaque(mi.UInt32, shape[1]), dr.opaque(mi.UInt32, columns)
    index = dr.arange(mi.UInt32, shape[0] * shape[1])
    x, y, last = mi.Float(index % width), mi.Float(index // width), mi.Float(count - 1)

    def add_view(view: mi.UInt32, *total: mi.Float) -> tuple[mi.UInt32, *tuple[mi.Float, ...]]:
        a, b, c = (dr.gather(mi.Float, entries, 3 * view + k) for k in range(3))
        column = dr.fma(a, x, dr.fma(b, y, c))
        seen = (column > -0.5) & (column < last + 0.5)
        inside = dr.clip(column, 0, last)
        lower = mi.UInt32(inside)
        fraction = inside - mi.Float(lower)
        # Packets: the layers are neighbours in memory, and come in one load.
        left, right = (
            dr.gather(mi.ArrayXf, pixels, view * count + k, seen, shape=(layers, dr.width(index)))
            for k in (lower, dr.minimum(lower + 1, count - 1))
        )
        return view + 1, *(t + dr.lerp(p, q, fraction) for t, p, q in zip(total, left, right, strict=True))

    total = [dr.zeros(mi.Float, dr.width(index)) for _ in range(layers)]
    for first in range(0, n_views, VIEWS_OF_LOOP):
        end = dr.opaque(mi.UInt32, min(n_views, first + VIEWS_OF_LOOP))
        state = (dr.opaque(mi.UInt32, first), *total)
        total = dr.while_loop(state, lambda view, *_, end=end: view < end, add_view)[1:]
        dr.eval(total)
    return np.stack([np.array(t) for t in total])


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
