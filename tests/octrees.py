"""Octrees for tests: random ones, and a float64 twin of the march that knows no tree."""

from __future__ import annotations

import numpy as np

from mivol.fields.octree import Octree, edges_of

PLACE = np.array([[1.0, 0, 0, -0.5], [0, 2, 0, -1], [0, 0, 1.5, -0.75], [0, 0, 0, 1]])


def random_octree(depth: int, seed: int = 1, split: float = 0.5, degree: int = 1, colours: str = "clamp") -> Octree:
    """An octree with leaves of all sizes and vacuum between them."""
    rng, leaves, stack = np.random.default_rng(seed), [], [(0, depth)]
    while stack:
        code, size = stack.pop()
        if size > 0 and (size == depth or rng.random() < split):
            stack += [(code + k * 8 ** (size - 1), size - 1) for k in range(8)]
        elif rng.random() > 0.4:
            leaves.append((code, size))
    codes, sizes = zip(*sorted(leaves), strict=True)
    values = rng.random(len(codes)) * 3, rng.normal(size=(len(codes), (degree + 1) ** 2, 3)) * 0.3
    return Octree.from_rows(depth, PLACE, np.array(codes, np.uint64), np.array(sizes, np.uint8), *values, colours)


def hard_rays(seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Rays from outside and inside, along axes, in planes between leaves, and through corners: o and d, float32."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(48, 3))
    o *= 3 / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-0.4, 0.4, (48, 3)) - o
    o[:8] = rng.uniform(-0.3, 0.3, (8, 3))
    signs = np.where(np.arange(6) < 3, 1, -1)[:, None]
    d[8:14] = np.eye(3)[np.arange(6) % 3] * signs
    o[8:14] = -d[8:14] * 3 + rng.uniform(-0.2, 0.2, (6, 3))
    o[14:17], d[14:17] = -3 * np.eye(3), np.eye(3)  # in the middle planes of the cube, from face to face
    o[17] = [-1, -2, -1.5]
    d[17] = -o[17]  # through the corners of the diagonal
    d[18], o[18] = [1, 2, 0], [-1, -2, 0.1]  # through edges
    return np.float32(o), np.float32(d / np.linalg.norm(d, axis=1)[:, None])


def twin(
    tree: Octree, density: np.ndarray, sh: np.ndarray, o: np.ndarray, d: np.ndarray, basis: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Radiance, transmittance, and distance times opacity of a ray, from its interval in each leaf, in float64."""
    inverse = np.linalg.inv(tree.to_world)
    q, v = inverse[:3] @ np.append(np.float64(o), 1), inverse[:3, :3] @ np.float64(d)
    low = tree.corners() / 2**tree.depth
    high = low + edges_of(tree.sizes)[:, None] / 2**tree.depth
    start, end = np.zeros(len(low)), np.full(len(low), np.inf)
    for a in range(3):
        if v[a] == 0:
            end[(q[a] < low[:, a]) | (q[a] >= high[:, a])] = -1
            continue
        sides = (low[:, a] - q[a]) / v[a], (high[:, a] - q[a]) / v[a]
        start, end = np.maximum(start, np.minimum(*sides)), np.minimum(end, np.maximum(*sides))
    hit = np.flatnonzero(end > start)
    L, T, far = np.zeros(3), 1.0, 0.0
    for i in hit[np.argsort(start[hit])]:
        dt = end[i] - start[i]
        tau = density[i] * dt
        sums = (0.5 + basis @ sh[i]) if tree.colours == "clamp" else basis @ sh[i] + tree.offset
        colour = np.maximum(sums, 0) if tree.colours == "clamp" else 1 / (1 + np.exp(-sums))
        alpha = -np.expm1(-tau)
        L += T * alpha * colour
        # int_0^dt sigma e^(-sigma u) u du
        far += T * (start[i] * alpha + (alpha / density[i] - dt * np.exp(-tau) if tau > 1e-6 else 0.5 * tau * dt))
        T *= np.exp(-tau)
    return L, T, far
