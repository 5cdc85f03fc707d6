"""Procedural volumes: seeded densities for demos and tests, with the same numbers on every machine.

Conventions. A recipe maps points (..., 3) in the unit cube, as (x, y, z), and a generator to values in [0, 1]. Volumes sample
the recipe at voxel centres, so every resolution shows the same object. PROCEDURAL lists the recipes. A cumulus is made in
bricks: no array of the whole box exists at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from mivol.errors import MivolError
from mivol.files import SparseVolumeData
from mivol.files.volume import EDGE, VOXELS


def tangle(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Soft blobs with filaments wound around them: smooth regions, thin structures and empty space.

    Seven anisotropic Gaussians have random frames. Three tubes of Gaussian cross-section follow closed curves
    c + sum_k a_k cos(2 pi k s) + b_k sin(2 pi k s), k = 1, 2.
    """
    total = np.zeros(p.shape[:-1])
    for _ in range(7):
        centre, radii = rng.uniform(0.3, 0.7, 3), rng.uniform(0.05, 0.13, 3)
        frame, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        total += rng.uniform(0.25, 0.7) * np.exp(-0.5 * np.sum(((p - centre) @ frame / radii) ** 2, axis=-1))
    for _ in range(3):
        total = np.maximum(total, tube(p, rng))
    return np.clip(total, 0.0, 1.0) * inside(p)


def tube(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """exp(-1/2 (distance to a random closed curve / 0.022)^2), with the curve sampled at 160 points."""
    s = 2.0 * np.pi * np.arange(160)[:, None] / 160
    curve = 0.5 + sum(
        np.outer(np.cos(k * s), rng.uniform(-0.26, 0.26, 3)) / k + np.outer(np.sin(k * s), rng.uniform(-0.26, 0.26, 3)) / k
        for k in (1, 2)
    )
    nearest, _ = KDTree(curve).query(p)
    return np.exp(-0.5 * (nearest / 0.022) ** 2)


def inside(p: np.ndarray) -> np.ndarray:
    """A window: 1 inside the cube, smoothly 0 towards its faces, which keeps the object off the box."""
    from_middle = np.max(np.abs(p - 0.5), axis=-1)
    return np.clip((0.48 - from_middle) / 0.06, 0.0, 1.0)


PROCEDURAL: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {"tangle": tangle}


def make_procedural(name: str, shape: Sequence[int], seed: int, peak: float) -> np.ndarray:
    """Make a procedural volume.

    Args:
        name: "tangle", the only key of PROCEDURAL.
        shape: (Z, Y, X).
        seed: selects the object.
        peak: largest possible value [unit of the field].

    Returns:
        (Z, Y, X, 1) float32 in [0, peak].

    Raises:
        MivolError: unknown name, or a shape that is not three whole numbers from 1 on.
    """
    if name not in PROCEDURAL:
        raise MivolError(f'unknown procedural volume "{name}": known are {", ".join(PROCEDURAL)}.')
    if not isinstance(shape, Sequence) or len(shape) != 3 or not all(isinstance(n, int | np.integer) and n > 0 for n in shape):
        raise MivolError(f"found the shape {shape!r}, expected numbers of voxels along z, y and x; write (40, 40, 40).")
    axes = [(np.arange(n) + 0.5) / n for n in shape]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    values = PROCEDURAL[name](np.stack([x, y, z], axis=-1), np.random.default_rng(seed))
    return (peak * values[..., None]).astype(np.float32)


CHUNK = 4096
"""Bricks of a cumulus that are made at once."""

OCTAVES = [(8 * 2**k, 0.62**k) for k in range(5)]
"""Period of each octave of noise of a cumulus [1/length], and its amplitude."""


class Cumulus:
    """Signed depth below the surface of a cloud, at points of the unit cube; positive inside.

    The cloud is a heap of balls over a flat base, with octaves of noise on its surface.
    """

    def __init__(self, balls: int = 26, seed: int = 11) -> None:
        rng = np.random.default_rng(seed)
        angle, away = rng.uniform(0, 2 * np.pi, balls), 0.3 * np.sqrt(rng.uniform(0, 1, balls))
        radius = rng.uniform(0.05, 0.12, balls) * (1.2 - 1.6 * away)
        height = 0.2 + rng.uniform(0, 0.38, balls) * (1 - away / 0.32) + radius / 2
        self.balls = np.column_stack([0.5 + away * np.cos(angle), 0.5 + away * np.sin(angle), height, radius])
        grids = [rng.uniform(-1, 1, (n, n, n, 1)).astype(np.float32) for n, _ in OCTAVES]
        self.noise = [mi.Texture3f(mi.TensorXf(grid), wrap_mode=dr.WrapMode.Repeat) for grid in grids]

    def depth(self, p: mi.Point3f, erosion: float = 0.045) -> mi.Float:
        """Depth [length]; the noise moves the surface by at most twice the erosion."""
        inside = mi.Float(-1)
        for x, y, z, radius in self.balls.tolist():
            inside = dr.maximum(inside, radius - dr.norm(p - mi.Point3f(x, y, z)))
        eroded = sum(amplitude * noise.eval(p)[0] for (_, amplitude), noise in zip(OCTAVES, self.noise, strict=True))
        return dr.minimum(inside + erosion * eroded, (p.z - 0.2) + 0.3 * erosion * eroded)


def make_cumulus(voxels: int, extinction: float = 150.0, cumulus: Cumulus | None = None) -> SparseVolumeData:
    """Make a cloud in bricks, in about 3 % of the box.

    Args:
        voxels: voxels along each edge of the box.
        extinction: extinction in the cloud [1/length], for a box of edge 1; it rises from 0 at the surface within four voxels.
        cumulus: shape of the cloud; None: that of the default seed.
    """
    cumulus = cumulus or Cumulus()
    counts = -(-voxels // EDGE)
    # A brick whose middle lies more than three bricks outside of the surface has no voxel inside.
    index = dr.arange(mi.UInt32, counts**3)
    places = (index // counts**2, index // counts % counts, index % counts)
    middle = mi.Point3f(*((mi.Float(k) + 0.5) * (EDGE / voxels) for k in places[::-1]))
    near = dr.compress(cumulus.depth(middle) > -EDGE / voxels * 3).numpy()
    values, numbers = [], []
    for begin in range(0, len(near), CHUNK):
        bricks = near[begin : begin + CHUNK]
        node = dr.arange(mi.UInt32, len(bricks) * VOXELS)
        brick, inner = dr.gather(mi.UInt32, mi.UInt32(bricks), node // VOXELS), node % VOXELS
        z = brick // counts**2 * EDGE + inner // EDGE**2
        y = brick // counts % counts * EDGE + inner // EDGE % EDGE
        x = brick % counts * EDGE + inner % EDGE
        depth = cumulus.depth(mi.Point3f(*((mi.Float(k) + 0.5) / voxels for k in (x, y, z))))
        block = np.array(extinction * dr.clip(depth * voxels / 4, 0, 1)).reshape(-1, EDGE, EDGE, EDGE, 1)
        held = block.any(axis=(1, 2, 3, 4))
        values.append(block[held])
        numbers.append(bricks[held])
    rows = np.stack(np.unravel_index(np.concatenate(numbers), (counts,) * 3), axis=1).astype(np.int32)
    return SparseVolumeData(np.concatenate(values), rows, (voxels,) * 3, np.eye(4))
