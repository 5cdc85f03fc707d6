r"""A radiance field on a grid becomes Gaussians that are splatted: the way back from :mod:`mivol.fields.gaussian_grid`.

A block of voxels is one Gaussian of the same mass (the integral of the extinction over space), the same mean and the same
covariance; each node stands for the tent that interpolates it, whose variance is 1/6 of a voxel's edge squared along each
axis. So matter that fills a part of its block, a surface for one, makes a Gaussian that is as flat as that part. Splatting
wants an opacity: the mass m and the mean projected area give

.. math:: o = 1 - \exp\Big(-\frac{m}{2\pi \langle A \rangle}\Big), \qquad \langle A \rangle = R_G(s_1^2 s_2^2, s_1^2 s_3^2,
s_2^2 s_3^2)

the inverse of ``masses_of_gaussians``. Harmonics are the means of the block's, weighed by mass. The directions of a grid are
those of its own frame; those of Gaussians are the world's, so harmonics are turned where the grid is turned.

What is lost. A Gaussian of opacity o hides o exp(-q/2), matter of that mass 1 - exp(-tau exp(-q/2)), which is wider where it is
dense; Gaussians are sorted by their means, a grid by where its matter is; sizes below a voxel.

Sources: Carlson, Numerical Algorithms 10, 1995 (R_G); Zwicker et al. 2001 (splatting of volumes: a kernel a voxel).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import elliprg

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid
from mivol.files import encode_srgb
from mivol.points.gaussians import CONSTANT_HARMONIC, HIGHEST_DEGREE, Gaussians

__all__ = ["gaussians_of_grid"]

TENT = 1 / 6
"""Variance of the tent by which a node is interpolated, along each axis [voxel^2]."""

BLOCK = 2
"""Voxels along the edge of a block where no resolution is given. On a still life of 26 x 64 x 64 nodes 5,600 such Gaussians
came as near to the field as 25,000 of one voxel (29.3 and 29.3 dB at 256 pixels, 27.7 and 26.0 at 128): what is smaller than a
pixel is widened by the splatter's low-pass filter, at the same opacity."""

FAINTEST = 1 / 255
"""Opacity below which a Gaussian is left out: no splatter draws it."""


def gaussians_of_grid(field: SphericalGrid, resolution: int | None = None) -> Gaussians:
    """Gaussians of the mass, the colours and the shape of a field's matter, one a block of voxels.

    Args:
        field: of one level.
        resolution: blocks along the longest edge, at most; None: blocks of 2 voxels along each edge.

    Returns:
        Gaussians of the field's degree, but of 3 at most; colours in code values.

    Raises:
        MivolError: a nested field, a resolution below 1, or a field in which no block would be drawn.
    """
    if field.levels > 1:
        raise MivolError(f"a field of {field.levels} nested levels was given; one grid is expected: take one of its levels.")
    if resolution is not None and resolution < 1:
        raise MivolError(f"a resolution of {resolution} blocks was given; at least 1 is expected.")
    block = BLOCK if resolution is None else math.ceil(max(field.res) / resolution)
    nodes, mass, harmonics = _matter(field)
    owner, count = _blocks(nodes, field.res, block)
    total = np.bincount(owner, mass, count)
    edges = field.to_world[:3, :3] / field.res[::-1]
    mean = _sums(owner, nodes * mass[:, None], count) / total[:, None]
    away = nodes - mean[owner]
    spread = _sums(owner, (away[:, :, None] * away[:, None, :] * mass[:, None, None]).reshape(-1, 9), count)
    covariance = (spread / total[:, None]).reshape(-1, 3, 3) + TENT * np.eye(3)
    variance, axes = np.linalg.eigh(edges @ covariance @ edges.T)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    a, b, c = variance.T
    opacity = -np.expm1(-total / (2 * math.pi * elliprg(a * b, a * c, b * c)))
    drawn = opacity >= FAINTEST
    if not drawn.any():
        most = f"the densest block of voxels hides {opacity.max(initial=0):.2g} of what is behind it"
        raise MivolError(f"{most}, and a Gaussian below {FAINTEST:.2g} is not drawn; give a lower resolution.")
    colours = _sums(owner, (harmonics * mass[:, None, None]).reshape(len(mass), -1), count) / total[:, None]
    places = (mean + 0.5) @ edges.T + field.to_world[:3, 3]
    capped = np.minimum(opacity, 1 - 2**-23)
    return Gaussians(
        places[drawn],
        0.5 * np.log(variance[drawn]),
        _quaternions(axes[drawn]),
        (np.log(capped) - np.log1p(-capped))[drawn],
        colours.reshape(count, -1, 3)[drawn],
    )


def _matter(field: SphericalGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes that hold anything (n, 3), (x, y, z), their masses [length^2] (n,) and harmonics (n, K, 3) of code values."""
    density, harmonics = field.values()
    volume = abs(float(np.linalg.det(field.to_world[:3, :3]))) / math.prod(field.res)
    mass = np.array(field.act.value_and_slope(mi.Float(density))[0], np.float64) * volume
    held = np.flatnonzero(mass > 0)
    if not len(held):
        raise MivolError("the field holds nothing; matter is expected: there is nothing to make Gaussians of.")
    z, y, x = np.unravel_index(field.listed()[held], field.res)
    return np.stack([x, y, z], axis=1).astype(np.float64), mass[held], _codes(field, harmonics[held])


def _codes(field: SphericalGrid, harmonics: np.ndarray) -> np.ndarray:
    """Harmonics (n, K, 3) in the world's frame, of code values less one half, as Gaussians have them, float64."""
    harmonics = harmonics[:, : (HIGHEST_DEGREE + 1) ** 2].astype(np.float64)
    basis = harmonics.shape[1]
    d = _directions()
    own = _columns(field.harmonics_of(d)[:basis])
    back = np.linalg.pinv(_columns(dr.sh_eval(d, math.isqrt(basis) - 1)))
    if field.space == "srgb":
        turned = np.einsum("kj,njc->nkc", back @ own, harmonics)
        turned[:, 0] += (field.offset - 0.5) / CONSTANT_HARMONIC
        return turned
    seen = (
        np.einsum("mj,njc->nmc", own, part) + field.offset for part in np.array_split(harmonics, len(harmonics) // PART + 1)
    )
    return np.concatenate([np.einsum("km,nmc->nkc", back, encode_srgb(np.maximum(part, 0)) - 0.5) for part in seen])


def _columns(values: Sequence[mi.Float]) -> np.ndarray:
    """Harmonics in all directions as a matrix (directions, K), float64; the constant one is a single number."""
    return np.stack(np.broadcast_arrays(*(np.array(value, np.float64) for value in values)), axis=1)


PART = 1 << 14
"""Nodes whose light is looked at together."""


def _directions(count: int = 64) -> mi.Vector3f:
    """Unit directions spread evenly over the sphere (a Fibonacci lattice)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn, flat = math.pi * (3 - math.sqrt(5)) * np.arange(count), np.sqrt(1 - height**2)
    return mi.Vector3f(*(np.float32(v) for v in (flat * np.cos(turn), flat * np.sin(turn), height)))


def _blocks(nodes: np.ndarray, res: tuple[int, int, int], block: int) -> tuple[np.ndarray, int]:
    """The number of each node's block, of those that hold something, and how many there are."""
    size = -(-np.array(res[::-1]) // block)
    at = nodes.astype(np.int64) // block
    held, owner = np.unique((at[:, 2] * size[1] + at[:, 1]) * size[0] + at[:, 0], return_inverse=True)
    return owner, len(held)


def _sums(owner: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """(count, columns) sums of rows over those of each owner."""
    return np.stack([np.bincount(owner, column, count) for column in rows.T], axis=1)


def _quaternions(axes: np.ndarray) -> np.ndarray:
    """(n, 4) quaternions (w, x, y, z) of rotations (n, 3, 3)."""
    return Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
