r"""Gaussians for splatting become a grid of density and harmonics (``mivol_sh``), and a grid becomes Gaussians.

Splatting uses an opacity o in the image, a medium an extinction. A Gaussian of extinction with covariance S and mass m (the
integral of the extinction over space [length^2]) has, along the line through its centre in the direction d, the optical depth

.. math:: \tau(d) = \frac{m}{2\pi A(d)}, \qquad A(d) = \sqrt{\det S \; d^T S^{-1} d},

where 2 pi A is the area of its projection. Splatting has the optical depth -log(1 - o) in all directions, which no m gives
unless S is round. :func:`gaussian_masses` matches the mean over directions, weighted by the projected area:

.. math:: m = -\log(1 - o)\, 2\pi \langle A \rangle, \quad \langle A \rangle = R_G(s_1^2 s_2^2,\, s_1^2 s_3^2,\, s_2^2 s_3^2)

with Carlson's R_G, since the mean projection of an ellipsoid is a quarter of its surface (Cauchy). Without the weight the mean
is infinite for flat Gaussians, whose edge has infinite depth. With the weight a flat Gaussian is twice as deep face-on as
before.

To a grid. Each covariance is widened by (half a voxel)^2 at the same mass: no Gaussian is lost between nodes, and Gaussians
thinner than a voxel become wider and fainter. A Gaussian inside the box up to ``DEPOSIT_REACH`` is normalised over the nodes,
so its mass is kept to rounding. Colours are means of the harmonics, weighted by density: overlapping Gaussians mix, while
splatting shows the nearer Gaussian.

To Gaussians. A block of voxels becomes one Gaussian of the same mass, mean and covariance. Each node stands for its tent of
interpolation, whose variance is 1/6 of a squared voxel edge along each axis. Matter that fills part of a block, for example a
surface, gives a flat Gaussian. The opacity inverts the formula above, o = 1 - exp(-m / (2 pi <A>)). Harmonics are means of the
block, weighted by mass. Harmonics of a turned grid are turned, since a grid has directions of its own frame and Gaussians have
world directions.

Error. A Gaussian of opacity o hides o exp(-q/2), matter of this mass 1 - exp(-tau exp(-q/2)), which is wider in dense regions.
Gaussians are sorted by their means, matter of a grid by position. Details below a voxel are lost.

Sources: Carlson, Numerical Algorithms 10, 1995 (R_G); Zwicker et al. 2001 (splatting of volumes, the low-pass filter).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation
from scipy.special import elliprg

from mivol.back_end import check_memory
from mivol.errors import MivolError
from mivol.fields.gaussian_field import MAX_CHUNK_PAIRS, MAX_OPACITY, find_chunk_starts, list_box_nodes
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.files import encode_srgb
from mivol.points.gaussians import CONSTANT_HARMONIC, HIGHEST_DEGREE, ROW_SHAPES, Gaussians

DEPOSIT_REACH = 4.0
"""Standard deviations along each axis of the grid up to which a Gaussian is deposited; 2e-4 of its mass lies outside."""

PAIR_BYTES = 160
"""Memory of one pair of node and Gaussian during the deposit: positions, weights and products [bytes]."""


def gaussian_masses(gaussians: Gaussians) -> np.ndarray:
    """(N,) integrals of the extinction over space [length^2], float64; opacities are clipped at :data:`MAX_OPACITY`."""
    opacity = np.minimum(gaussians.opacities().astype(np.float64), MAX_OPACITY)
    a, b, c = (gaussians.scales().astype(np.float64) ** 2).T
    return -np.log1p(-opacity) * 2 * math.pi * elliprg(a * b, a * c, b * c)


def gaussian_box(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the box around three standard deviations of the Gaussians [length], float64.

    Raises:
        MivolError: no Gaussians.
    """
    if not gaussians.count:
        raise MivolError("no Gaussians were given; at least one is expected: there is nothing to put a box around.")
    spread = 3 * np.sqrt(np.diagonal(gaussians.covariances().astype(np.float64), axis1=1, axis2=2))
    return (gaussians.means - spread).min(axis=0), (gaussians.means + spread).max(axis=0)


def gaussians_to_grid(gaussians: Gaussians, low: np.ndarray, high: np.ndarray, resolution: int) -> SphericalGrid:
    """Deposit Gaussians on the nodes of a grid; parts outside the box are cut off.

    Args:
        gaussians: any degree; colours stay code values (``space`` is ``srgb``).
        low, high: (3,) corners of the box [length].
        resolution: voxels along the longest edge; voxels are as near to cubes as whole numbers allow.

    Returns:
        A sparse field without an activation: its densities are extinctions [1/length].

    Raises:
        MivolError: a box without volume, a resolution below 2, an empty box, or a grid larger than the free memory (the message
            has the resolution that fits).
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if not (np.isfinite([low, high]).all() and (high > low).all()) or resolution < 2:
        found = f"a box from {low.tolist()} to {high.tolist()} of {resolution} voxels"
        raise MivolError(f"{found} was given; a corner above the other, and at least 2 voxels, are expected.")
    size = np.maximum(np.rint((high - low) / (high - low).max() * resolution), 2).astype(np.int64)  # x, y, z
    _check_grid_memory(size, gaussians.harmonics.shape[1], resolution)
    mass, harmonics = _deposit(gaussians, (gaussians.means - low) / (high - low) * size - 0.5, size, (high - low) / size)
    occupied = mass > 0
    if not occupied.any():
        raise MivolError("none of the Gaussians reaches into the box; give a box that holds them.")
    harmonics[occupied] /= mass[occupied, None]
    to_world = np.diag([*(high - low), 1.0])
    to_world[:3, 3] = low
    shape = tuple(int(n) for n in size[::-1])
    density = (mass / np.prod((high - low) / size)).reshape(shape)
    return SphericalGrid.from_dense(
        density, harmonics.reshape(*shape, -1, 3), to_world, occupied.reshape(shape), activation="none", space="srgb"
    )


MOST_LEVELS = 8
"""Largest number of nested boxes: the outermost one is 128 times as large as the innermost one."""


def gaussians_to_nested(gaussians: Gaussians, low: np.ndarray, high: np.ndarray, resolution: int) -> SphericalGrid:
    """Deposit Gaussians on nested grids: boxes of twice the extent each, until one holds all Gaussians.

    Args:
        gaussians: as :func:`gaussians_to_grid`.
        low, high: (3,) corners of the innermost box [length].
        resolution: voxels along the longest edge of each box.

    Returns:
        A nested field of at most ``MOST_LEVELS`` boxes; parts outside of the outermost one are cut off.

    Raises:
        MivolError: as :func:`gaussians_to_grid`, for the innermost box or the memory.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    middle, half, ends = (low + high) / 2, (high - low) / 2, gaussian_box(gaussians)
    grids = [gaussians_to_grid(gaussians, low, high, resolution)]
    while len(grids) < MOST_LEVELS and any((abs(end - middle) > half).any() for end in ends):
        half = 2 * half
        grids.append(gaussians_to_grid(gaussians, middle - half, middle + half, resolution))
    nested = SphericalGrid.from_levels(grids)
    covered = is_covered_by_inner(dr.arange(mi.UInt32, nested.node_count), nested.res)
    return nested.select_nodes(~np.array(covered))


def _deposit(gaussians: Gaussians, centres: np.ndarray, size: np.ndarray, voxel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masses (nodes,) and harmonics times mass (nodes, 3 K) of the Gaussians, whose centres are in lattice coordinates."""
    covariances = gaussians.covariances().astype(np.float64) / np.outer(voxel, voxel) + 0.25 * np.eye(3)
    reach = DEPOSIT_REACH * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    first, last = np.ceil(centres - reach).astype(np.int64), np.floor(centres + reach).astype(np.int64)
    reaching = np.flatnonzero(((last >= 0) & (first < size)).all(axis=1) & (gaussians.opacities() > 0))
    is_whole = ((first >= 0) & (last < size)).all(axis=1)
    first, last = np.maximum(first, 0), np.minimum(last, size - 1)
    # A Gaussian that leaves the box is normalised by its integral: its nodes outside may exceed the memory.
    integral = (2 * math.pi) ** 1.5 * np.sqrt(np.linalg.det(covariances))
    sizes = last - first + 1
    harmonics = gaussians.harmonics.reshape(gaussians.count, -1)
    rows = np.concatenate([np.ones((gaussians.count, 1)), harmonics], axis=1) * gaussian_masses(gaussians)[:, None]
    sums = np.zeros((int(np.prod(size)), rows.shape[1]))
    for part in np.split(reaching, find_chunk_starts(sizes[reaching].prod(axis=1))):
        owner = np.repeat(np.arange(len(part)), sizes[part].prod(axis=1))
        node = first[part][owner] + list_box_nodes(sizes[part])
        offset = node - centres[part][owner]
        weight = np.exp(-0.5 * np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariances[part])[owner], offset))
        weight /= np.where(is_whole[part], np.bincount(owner, weight, len(part)), integral[part])[owner]
        touched, place = np.unique(node @ np.array([1, size[0], size[0] * size[1]]), return_inverse=True)
        weights = csr_matrix((weight, (place, owner)), shape=(len(touched), len(part)))
        sums[touched] += weights @ rows[part]
    return sums[:, 0], sums[:, 1:]


def _check_grid_memory(size: np.ndarray, basis: int, resolution: int) -> None:
    """Refuse a grid that exceeds the free memory, counting sums, the field, and the pairs of one wide Gaussian."""
    pairs = PAIR_BYTES * MAX_CHUNK_PAIRS
    needed = (16 * (1 + 3 * basis) + PAIR_BYTES) * int(np.prod(size)) + pairs

    def advise(free: float) -> str:
        fitting = int(resolution * max((free - pairs) / (needed - pairs), 0) ** (1 / 3))
        return f"a resolution of at most {fitting} fits"

    # A GPU holds the row, the density and the coefficients of each node, and no pairs: the advice is on the safe side.
    on_gpu = 4 * (2 + 3 * basis) * int(np.prod(size))
    check_memory(needed, f"a grid of {size[0]} x {size[1]} x {size[2]} nodes and {basis} harmonics", advise, on_gpu=on_gpu)


TENT_VARIANCE = 1 / 6
"""Variance of a node's tent of interpolation along each axis [voxel^2]."""

BLOCK_EDGE = 2
"""Default edge of a block [voxel]. On a still life of 26 x 64 x 64 nodes, 5,600 such Gaussians matched the field as well as
25,000 Gaussians of one voxel (29.3 and 29.3 dB at 256 pixels, 27.7 and 26.0 dB at 128), since the splatter's low-pass filter
widens Gaussians below a pixel at the same opacity."""

MIN_OPACITY = 1 / 255
"""Gaussians of smaller opacity are left out; no splatter draws them."""


def grid_to_gaussians(field: SphericalGrid, resolution: int | None = None) -> Gaussians:
    """Make Gaussians of the mass, colours and shape of a field's matter, one a block of voxels.

    Args:
        field: of a single level.
        resolution: largest number of blocks along the longest edge; None: blocks with an edge of 2 voxels.

    Returns:
        Gaussians of the field's degree, at most 3, with colours in code values.

    Raises:
        MivolError: a nested field, a resolution below 1, or a field without a visible block.
    """
    if field.levels > 1:
        raise MivolError(f"a field of {field.levels} nested levels was given; one grid is expected: take one of its levels.")
    if resolution is not None and resolution < 1:
        raise MivolError(f"a resolution of {resolution} blocks was given; at least 1 is expected.")
    block = BLOCK_EDGE if resolution is None else math.ceil(max(field.res) / resolution)
    nodes, mass, harmonics = _collect_mass(field)
    owner, count = _group_nodes(nodes, field.res, block)
    total = np.bincount(owner, mass, count)
    edges = field.to_world[:3, :3] / field.res[::-1]
    mean = _sum_by_owner(owner, nodes * mass[:, None], count) / total[:, None]
    offset = nodes - mean[owner]
    spread = _sum_by_owner(owner, (offset[:, :, None] * offset[:, None, :] * mass[:, None, None]).reshape(-1, 9), count)
    covariance = (spread / total[:, None]).reshape(-1, 3, 3) + TENT_VARIANCE * np.eye(3)
    variance, axes = np.linalg.eigh(edges @ covariance @ edges.T)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    a, b, c = variance.T
    opacity = -np.expm1(-total / (2 * math.pi * elliprg(a * b, a * c, b * c)))
    drawn = opacity >= MIN_OPACITY
    if not drawn.any():
        most = f"the densest block of voxels hides {opacity.max(initial=0):.2g} of what is behind it"
        raise MivolError(f"{most}, and a Gaussian below {MIN_OPACITY:.2g} is not drawn; give a lower resolution.")
    colours = _sum_by_owner(owner, (harmonics * mass[:, None, None]).reshape(len(mass), -1), count) / total[:, None]
    places = (mean + 0.5) @ edges.T + field.to_world[:3, 3]
    capped = np.minimum(opacity, 1 - 2**-23)
    return Gaussians(
        places[drawn],
        0.5 * np.log(variance[drawn]),
        _to_quaternions(axes[drawn]),
        (np.log(capped) - np.log1p(-capped))[drawn],
        colours.reshape(count, -1, 3)[drawn],
    )


def nested_to_gaussians(field: SphericalGrid, resolution: int | None) -> Gaussians:
    """Gaussians of a nested field: those of each level, outside of the box of the level before (:func:`grid_to_gaussians`).

    Raises:
        MivolError: as :func:`grid_to_gaussians`, if no level has a visible block.
    """
    z, y, x = (np.abs((np.arange(n) + 0.5) / n - 0.5) < 0.25 for n in field.res)
    inner = z[:, None, None] & y[:, None] & x
    parts = []
    for number in range(field.levels):
        level = field.extract_level(number)
        outside = level if number == 0 else level.select_nodes(~inner)
        if len(outside.stored_nodes()) and outside.values()[0].max() > 0:
            parts.append(grid_to_gaussians(outside, resolution))
    if not parts:
        raise MivolError("the field holds nothing; matter is expected: there is nothing to make Gaussians of.")
    return Gaussians(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in (*ROW_SHAPES, "harmonics")})


def _collect_mass(field: SphericalGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes with matter (n, 3), (x, y, z), their masses [length^2] (n,) and harmonics (n, K, 3) of code values."""
    density, harmonics = field.values()
    volume = abs(float(np.linalg.det(field.to_world[:3, :3]))) / math.prod(field.res)
    mass = np.array(field.activation_function.value_and_slope(mi.Float(density))[0], np.float64) * volume
    occupied = np.flatnonzero(mass > 0)
    if not len(occupied):
        raise MivolError("the field holds nothing; matter is expected: there is nothing to make Gaussians of.")
    z, y, x = np.unravel_index(field.stored_nodes()[occupied], field.res)
    return np.stack([x, y, z], axis=1).astype(np.float64), mass[occupied], _encode_harmonics(field, harmonics[occupied])


def _encode_harmonics(field: SphericalGrid, harmonics: np.ndarray) -> np.ndarray:
    """Harmonics (n, K, 3) in the world frame, of code values minus 1/2, as Gaussians hold them, float64."""
    harmonics = harmonics[:, : (HIGHEST_DEGREE + 1) ** 2].astype(np.float64)
    basis = harmonics.shape[1]
    d = _fibonacci_directions(64)
    own = _stack_columns(field.eval_basis(d)[:basis])
    back = np.linalg.pinv(_stack_columns(dr.sh_eval(d, math.isqrt(basis) - 1)))
    if field.space == "srgb":
        turned = np.einsum("kj,njc->nkc", back @ own, harmonics)
        turned[:, 0] += (field.offset - 0.5) / CONSTANT_HARMONIC
        return turned
    radiance = (
        np.einsum("mj,njc->nmc", own, part) + field.offset
        for part in np.array_split(harmonics, len(harmonics) // LIGHT_CHUNK + 1)
    )
    return np.concatenate([np.einsum("km,nmc->nkc", back, encode_srgb(np.maximum(part, 0)) - 0.5) for part in radiance])


def _stack_columns(values: Sequence[mi.Float]) -> np.ndarray:
    """Harmonics in all directions as a matrix (directions, K), float64; the constant harmonic is a single number."""
    return np.stack(np.broadcast_arrays(*(np.array(value, np.float64) for value in values)), axis=1)


LIGHT_CHUNK = 1 << 14
"""Nodes whose light is evaluated at once."""


def _fibonacci_directions(count: int) -> mi.Vector3f:
    """Unit directions spread evenly over the sphere (a Fibonacci lattice)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn, flat = math.pi * (3 - math.sqrt(5)) * np.arange(count), np.sqrt(1 - height**2)
    return mi.Vector3f(*(np.float32(v) for v in (flat * np.cos(turn), flat * np.sin(turn), height)))


def _group_nodes(nodes: np.ndarray, res: tuple[int, int, int], block: int) -> tuple[np.ndarray, int]:
    """The number of each node's block among the blocks with matter, and the number of these blocks."""
    size = -(-np.array(res[::-1]) // block)
    at = nodes.astype(np.int64) // block
    occupied, owner = np.unique((at[:, 2] * size[1] + at[:, 1]) * size[0] + at[:, 0], return_inverse=True)
    return owner, len(occupied)


def _sum_by_owner(owner: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """(count, columns) sums of the rows of each owner."""
    return np.stack([np.bincount(owner, column, count) for column in rows.T], axis=1)


def _to_quaternions(axes: np.ndarray) -> np.ndarray:
    """(n, 4) quaternions (w, x, y, z) of rotations (n, 3, 3)."""
    return Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
