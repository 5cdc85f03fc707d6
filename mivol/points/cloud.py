"""Clouds of points: positions, optional colours, file formats, and conversions to a density or Gaussians and back.

Conventions. Positions are in the world [length], float64, since surveys count metres from a distant origin. Colours are code
values 0..1. Formats by suffix: ``.ply`` (``x y z``, ``red green blue`` in bytes; for Gaussians the centres), ``.npy`` (N, 3),
COLMAP's ``points3D.bin`` and ``points3D.txt``, ``.las`` through the optional package ``laspy``. A new format is one reader and
one line in :data:`CLOUD_READERS`.

Grids are (Z, Y, X) at voxel centres over the unit cube, which ``to_world`` places (:mod:`mivol.space`). A density is mass per
volume [1/length^3]: its sum times the volume of a voxel is the mass.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from scipy.spatial import cKDTree

from mivol.display import with_short_repr
from mivol.files import ply
from mivol.files.atomic import write_whole
from mivol.files.npy import DAMAGE, check_memory
from mivol.files.source import check_file, refusal, select_by_suffix
from mivol.photos.colmap import read_points3d
from mivol.points.gaussians import Gaussians, logit, to_base_harmonics
from mivol.space import check_affine, lattice_from_world

COLOUR = ("red", "green", "blue")
VLR_HEADER_SIZE, EVLR_HEADER_SIZE = 54, 60
"""Size of the header of a variable length record of LAS, and of an extended record [bytes] (ASPRS LAS 1.4 R15, sections 2.5 and
2.7)."""
LAS_1_0_HEADER_SIZE, LAS_HEADER_SIZE = 227, 375
"""Size of the header of LAS up to version 1.2, and of version 1.4 [bytes] (section 2.4)."""


@with_short_repr
@dataclass(frozen=True)
class PointCloud:
    """N points.

    Attributes:
        positions: (N, 3) world [length], float64.
        colours: (N, 3) code values 0..1, float32; None: no colours.

    Raises:
        MivolError: shapes that contradict each other, or whole numbers as colours.
    """

    positions: np.ndarray
    colours: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", np.ascontiguousarray(self.positions, np.float64))
        if self.positions.ndim != 2 or self.positions.shape[1] != 3:
            raise refusal("a cloud of points", f"positions of shape {self.positions.shape}", "(N, 3)", "reshape them")
        if self.colours is not None:
            if np.asarray(self.colours).dtype.kind in "iu":
                raise refusal("a cloud of points", "whole numbers as colours", "code values from 0 to 1", "divide bytes by 255")
            object.__setattr__(self, "colours", np.ascontiguousarray(self.colours, np.float32))
            if self.colours.shape != self.positions.shape:
                found = f"colours of shape {self.colours.shape}"
                raise refusal("a cloud of points", found, f"{self.positions.shape}, as the positions", "reshape them")

    @property
    def count(self) -> int:
        """Number of points, N."""
        return len(self.positions)

    def check(self, subject: object = "a cloud of points") -> PointCloud:
        """Return the cloud if every number is finite.

        Raises:
            MivolError: a number that is not finite; the message names the first point.
        """
        for name, values in (("position", self.positions), ("colour", self.colours)):
            rows = [] if values is None else np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(rows):
                found = f"a {name} that is not finite in point {rows[0]} (the first of {len(rows)})"
                raise refusal(subject, found, "finite numbers", "remove these points")
        return self


def read_points(path: str | os.PathLike) -> PointCloud:
    """Read a cloud in any format of :data:`CLOUD_READERS`.

    Raises:
        MivolError: a missing, foreign, truncated or inconsistent file, an unknown suffix, a number that is not finite, or
            ``.las`` without ``laspy``.
    """
    path = check_file(path)
    return select_by_suffix(path, CLOUD_READERS)(path).check(path)


def write_points(path: str | os.PathLike, cloud: PointCloud) -> None:
    """Write a cloud, whole or not at all; the suffix selects the format (:data:`CLOUD_WRITERS`).

    Positions are stored in float32, 24 bits of the distance from the origin; ``.npy`` holds no colours.

    Raises:
        MivolError: an unknown suffix, a number that is not finite, or a full disk.
    """
    path = Path(path)
    writer = select_by_suffix(path, CLOUD_WRITERS)
    cloud.check(path)
    write_whole(path, lambda file: writer(file, cloud))


def _read_ply(path: Path) -> PointCloud:
    vertex = ply.read_vertices(path)
    positions = ply.vertex_positions(vertex)
    if any(name not in vertex.dtype.names for name in COLOUR):
        return PointCloud(positions)
    codes = np.stack([vertex[name] for name in COLOUR], axis=1)
    return PointCloud(positions, codes / 255 if codes.dtype == np.uint8 else codes)


def _read_npy(path: Path) -> PointCloud:
    """Map the array first: its shape is known, and the file's size is checked, before memory is taken."""
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        raise refusal(path, f"a damaged array ({reason})", "a whole .npy of numbers", "write or copy it again") from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2 or mapped.shape[1] != 3 or mapped.dtype.kind not in "iuf":
        shape = getattr(mapped, "shape", "an archive")
        raise refusal(path, f"an array {shape}", "real numbers (N, 3)", "save positions only")
    check_memory(path, mapped.size * 8)
    return PointCloud(mapped)


def _read_colmap(path: Path) -> PointCloud:
    positions, codes = read_points3d(path)
    return PointCloud(positions, codes / 255)


def _read_las(path: Path) -> PointCloud:
    try:
        import laspy
    except ImportError as error:
        way_out = f'pip install "mivol[points]" for laspy, which cannot be imported ({error})'
        raise refusal(path, "a LAS file", "a format that mivol reads by itself", way_out) from error
    try:
        _check_las_records(path)
        with laspy.open(path) as file:
            check_memory(path, file.header.point_count * 8 * 6)
            points = file.read()
    except (laspy.LaspyException, MemoryError, *DAMAGE) as error:
        raise refusal(path, f"a damaged LAS file ({error})", "a whole one", "copy it again") from error
    colours = None
    if {"red", "green", "blue"} <= set(points.point_format.dimension_names):
        colours = np.stack([points.red, points.green, points.blue], axis=1) / 65535
    return PointCloud(np.asarray(points.xyz), colours)


def _check_las_records(path: Path) -> None:
    """Refuse more variable length records than fit into the file; laspy would read empty records for hours."""
    with path.open("rb") as file:
        head = file.read(LAS_HEADER_SIZE)
    if len(head) < LAS_1_0_HEADER_SIZE:
        raise ValueError("it ends in its header")
    needed = VLR_HEADER_SIZE * struct.unpack_from("<I", head, 100)[0]
    if head[24:26] >= b"\x01\x04" and len(head) == LAS_HEADER_SIZE:
        needed += EVLR_HEADER_SIZE * struct.unpack_from("<I", head, 243)[0]
    if needed > path.stat().st_size:
        raise ValueError("more variable length records than it has room for")


def _write_ply(file: BinaryIO, cloud: PointCloud) -> None:
    fields = [(name, "<f4") for name in ply.POSITION] + [(name, "u1") for name in (() if cloud.colours is None else COLOUR)]
    table = np.empty(cloud.count, fields)
    for name, column in zip(ply.POSITION, cloud.positions.T, strict=True):
        table[name] = column
    if cloud.colours is not None:
        for name, column in zip(COLOUR, cloud.colours.T, strict=True):
            table[name] = np.rint(np.clip(column, 0, 1) * 255)
    ply.write_table(file, table)


def _write_npy(file: BinaryIO, cloud: PointCloud) -> None:
    np.lib.format.write_array(file, cloud.positions.astype(np.float32), version=(1, 0), allow_pickle=False)


CLOUD_READERS: dict[str, Callable[[Path], PointCloud]] = {
    ".ply": _read_ply,
    ".npy": _read_npy,
    ".bin": _read_colmap,
    ".txt": _read_colmap,
    ".las": _read_las,
}
"""Suffix -> reader(path)."""

CLOUD_WRITERS: dict[str, Callable[[BinaryIO, PointCloud], None]] = {".ply": _write_ply, ".npy": _write_npy}
"""Suffix -> writer(file, cloud)."""


# -- Conversions -------------------------------------------------------------------------------------------------------


def points_to_density(
    positions: np.ndarray, resolution: tuple[int, int, int], to_world: np.ndarray, masses: np.ndarray | None = None
) -> np.ndarray:
    """The density of points on a grid: each point gives its mass to the eight voxel centres around it by trilinear weights.

    Within half a voxel of a face the weights of centres outside go to the centres inside. The mass is kept everywhere, the
    centre of mass only away from the faces.

    Args:
        positions: (N, 3) world [length].
        resolution: (Z, Y, X) of the grid.
        to_world: (4, 4) unit cube to world.
        masses: (N,); None: 1 each.

    Returns:
        (Z, Y, X) float64 [mass / length^3].

    Raises:
        MivolError: a point outside the box (the message names the first index), or shapes that contradict each other.

    Source: Hockney, Eastwood, Computer Simulation Using Particles, 1988 (cloud in cell).
    """
    positions = np.asarray(positions, np.float64)
    masses = np.ones(len(positions)) if masses is None else np.asarray(masses, np.float64)
    if positions.ndim != 2 or positions.shape[1:] != (3,) or masses.shape != positions.shape[:1]:
        found = f"positions of shape {positions.shape} and masses of shape {masses.shape}"
        raise refusal("points_to_density", found, "(N, 3) and (N,)", "reshape them")
    to_lattice = lattice_from_world(to_world, resolution)
    q = positions @ to_lattice[:, :3].T + to_lattice[:, 3]
    size = np.array(resolution[::-1])
    # Rounding may move a point on a face out of the box, by about 2^-50 of the lattice coordinates.
    outside = np.flatnonzero(~((q >= -0.5 - 1e-9 * size) & (q <= size - 0.5 + 1e-9 * size)).all(axis=1))
    if outside.size:
        found = f"point {outside[0]} outside the box (the first of {outside.size})"
        raise refusal("points_to_density", found, "points inside", "enlarge the box, or leave these points out")
    low = np.floor(q)
    fraction = q - low
    mass = np.zeros(np.prod(resolution))
    for corner in itertools.product((0, 1), repeat=3):
        node = np.clip(low + corner, 0, size - 1).astype(np.int64)
        weight = np.where(corner, fraction, 1 - fraction).prod(axis=1) * masses
        mass += np.bincount((node[:, 2] * size[1] + node[:, 1]) * size[0] + node[:, 0], weight, len(mass))
    return mass.reshape(resolution) / _voxel_volume(resolution, to_world)


def sample_points(density: np.ndarray, to_world: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Draw points from a density that is constant in each voxel.

    Voxels are drawn by systematic sampling (one random number shifts ``count`` equal steps of the cumulated mass), so each
    voxel gets its share of the points to less than one point. Positions inside a voxel are uniform.

    Args:
        density: (Z, Y, X), at least 0.
        to_world: (4, 4) unit cube to world.
        count: number of points.
        seed: seed of the random numbers.

    Returns:
        (count, 3) world [length], float64, in random order.

    Raises:
        MivolError: another shape, a density that is negative or not finite, or a density without mass.
    """
    density = np.asarray(density, np.float64)
    if density.ndim != 3 or not np.isfinite(density).all() or (density < 0).any() or not density.any():
        found = f"a density of shape {density.shape}, from {density.min(initial=0)} to {density.max(initial=0)}"
        raise refusal("sample_points", found, "(Z, Y, X), not below 0, with mass", "clip it, or give another")
    rng = np.random.default_rng(seed)
    cumulated = np.cumsum(density.ravel())
    steps = (np.arange(count) + rng.uniform()) * (cumulated[-1] / count)
    last = np.flatnonzero(density.ravel())[-1]  # rounding may move the last step beyond the last voxel with mass
    voxels = rng.permutation(np.minimum(np.searchsorted(cumulated, steps, side="right"), last))
    corner = np.stack(np.unravel_index(voxels, density.shape), axis=1)[:, ::-1]
    unit = (corner + rng.uniform(size=(count, 3))) / np.array(density.shape[::-1])
    m = check_affine(to_world)
    return unit @ m[:3, :3].T + m[:3, 3]


def _voxel_volume(resolution: tuple[int, int, int], to_world: np.ndarray) -> float:
    """[length^3]."""
    return float(abs(np.linalg.det(check_affine(to_world)[:3, :3])) / np.prod(resolution))


NEIGHBOURS = 3

MIN_RELATIVE_SCALE = 1e-3
"""Smallest scale over the median; coincident points would have scale 0."""

GREY = 0.5
"""Colour of points without colours."""


def points_to_gaussians(cloud: PointCloud, opacity: float = 0.1) -> Gaussians:
    """Make a round Gaussian at each point, as wide as the root mean square distance to the three nearest points.

    Args:
        cloud: at least four points.
        opacity: opacity of every Gaussian, 0..1.

    Returns:
        N Gaussians of degree 0, with the colours of the points, or grey.

    Raises:
        MivolError: fewer than four points, mostly coincident points, or an opacity outside 0..1.

    Source: Kerbl et al. 2023, section 5.1.
    """
    if not 0 <= opacity <= 1:
        raise refusal("points_to_gaussians", f"opacity={opacity}", "0 to 1", "choose one of those")
    if cloud.count <= NEIGHBOURS:
        found = f"{cloud.count} points"
        raise refusal("points_to_gaussians", found, f"at least {NEIGHBOURS + 1}, for the distances among them", "add some")
    distances = cKDTree(cloud.positions).query(cloud.positions, NEIGHBOURS + 1)[0][:, 1:]
    scales = np.sqrt((distances**2).mean(axis=1))
    median = float(np.median(scales))
    if median == 0:
        raise refusal("points_to_gaussians", "points that mostly coincide", "points apart", "remove what is there twice")
    scales = np.maximum(scales, MIN_RELATIVE_SCALE * median)
    colours = np.full((cloud.count, 3), GREY) if cloud.colours is None else cloud.colours
    return Gaussians(
        cloud.positions,
        np.repeat(np.log(scales)[:, None], 3, axis=1),
        np.tile([1.0, 0, 0, 0], (cloud.count, 1)),
        np.full(cloud.count, logit(opacity)),
        to_base_harmonics(colours)[:, None],
    )


def gaussians_to_points(gaussians: Gaussians) -> PointCloud:
    """The centres, with the mean colour over all directions, clipped to 0..1; sizes and opacities are lost."""
    return PointCloud(gaussians.means, np.clip(gaussians.base_colours(), 0, 1))
