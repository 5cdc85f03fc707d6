"""Points become a density on a grid or Gaussians, and back.

Conventions. Grids are (Z, Y, X) at voxel centres over the unit cube, which ``to_world`` places (:mod:`mivol.space`). A density
is mass per volume [1/length^3]: its sum times the volume of a voxel is the mass.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import cKDTree

from mivol.files.source import refusal
from mivol.points.cloud import PointCloud
from mivol.points.gaussians import Gaussians, logit, to_base_harmonics
from mivol.space import check_affine, lattice_from_world


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
