"""Float64 twin of radiance fields: one ray at a time in NumPy, every crossing of a plane sorted, nothing shared with mivol."""

from __future__ import annotations

import itertools

import numpy as np

ROOT3 = np.sqrt(3.0)


def sh_basis(d: np.ndarray, count: int) -> np.ndarray:
    """Real harmonics up to degree 2 of a unit vector, from the table of Sloan 2008 (Condon-Shortley signs)."""
    x, y, z = d
    first, second = 0.4886025119029199, 1.0925484305920792
    all_nine = [
        0.28209479177387814,
        *(-first * y, first * z, -first * x),
        *(
            second * x * y,
            -second * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -second * x * z,
            second / 2 * (x * x - y * y),
        ),
    ]
    return np.array(all_nine[:count])


def shares(dt: np.ndarray, s1: np.ndarray, s2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Optical depths of cells and the shares of their first points."""
    tau = dt / 2 * (s1 + s2)
    x = tau / ROOT3
    q = 1 + x + x * x / 2 + x**3 / (6 + 3 * x)
    both = s1 * q + s2
    return tau, np.where(both > 0, s1 * q / np.where(both > 0, both, 1), 0.5)


ACTIVATIONS = {
    "none": lambda v: v,
    "relu": lambda v: np.maximum(v, 0.0),
    "softplus": lambda v: np.logaddexp(0.0, v),
    "exp": np.exp,
}


class Twin:
    """A dense field: raw density (Z, Y, X), harmonics (Z, Y, X, basis, 3), the unit cube placed by ``to_world``."""

    def __init__(self, density, sh, to_world, activation="relu", offset=0.5, clamp=True):
        self.density, self.sh = np.asarray(density, np.float64), np.asarray(sh, np.float64)
        self.inverse, self.offset, self.clamp = np.linalg.inv(to_world), offset, clamp
        left, _, right = np.linalg.svd(np.asarray(to_world)[:3, :3])
        self.frame, self.activate = (left @ right).T, ACTIVATIONS[activation]
        self.n = np.array(self.density.shape[::-1])

    def at(self, q: np.ndarray, basis: np.ndarray) -> tuple[float, np.ndarray]:
        """Extinction and colour at a point of the lattice."""
        low = np.floor(q).astype(int)
        f = q - low
        raw, colour = 0.0, np.zeros(3)
        for corner in range(8):
            bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
            i, j, k = np.clip(low + bits, 0, self.n - 1)
            w = np.prod(np.where(bits == 1, f, 1 - f))
            raw += w * self.density[k, j, i]
            colour += w * (basis @ self.sh[k, j, i])
        colour = colour + self.offset
        return self.activate(raw), np.maximum(colour, 0) if self.clamp else colour

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
        """Where a ray enters the box and where it leaves it; the second is not above the first where it misses the box."""
        q, v = self.inverse[:3, :3] @ o + self.inverse[:3, 3], self.inverse[:3, :3] @ d
        with np.errstate(divide="ignore", invalid="ignore"):
            faces = np.sort(np.array([-q / v, (1 - q) / v]), axis=0)
        return max(0.0, np.nanmax(faces[0])), np.nanmin(faces[1])

    def cuts(
        self, o: np.ndarray, d: np.ndarray, between: tuple[float, float] = (0.0, np.inf)
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ray in the lattice, and where it crosses planes through nodes and faces of the box, ``between`` two distances."""
        q = (self.inverse[:3, :3] @ o + self.inverse[:3, 3]) * self.n - 0.5
        v = (self.inverse[:3, :3] @ d) * self.n
        t0, t1 = self.interval(o, d)
        t0, t1 = max(t0, between[0]), min(t1, between[1])
        planes = [(np.arange(self.n[a]) - q[a]) / v[a] for a in range(3) if v[a] != 0]
        inner = np.concatenate(planes)
        return q, v, np.unique(np.concatenate([[t0], inner[(inner > t0) & (inner < t1)], [t1]])) if t1 > t0 else np.empty(0)

    def render(self, o, d, rule="collocation", split=1, between=(0.0, np.inf)) -> tuple[np.ndarray, float, float]:
        """Colour, transmittance and distance; ``split`` cuts each cell into equal parts."""
        o, d = np.asarray(o, np.float64), np.asarray(d, np.float64)
        q, v, t = self.cuts(o, d, between)
        basis = sh_basis(self.frame @ d, self.sh.shape[3])
        L, T = np.zeros(4), 1.0
        for a, b in itertools.pairwise(t):
            for part in range(split):
                start, dt = a + (b - a) * part / split, (b - a) / split
                points = [0.5] if rule == "midpoint" else [0.5 - ROOT3 / 6, 0.5 + ROOT3 / 6]
                at = [(start + dt * g, *self.at(q + v * (start + dt * g), basis)) for g in points]
                colours = [np.append(c, s) for s, _, c in at]
                tau, f = (dt * at[0][1], 1.0) if rule == "midpoint" else shares(dt, at[0][1], at[1][1])
                L += T * -np.expm1(-tau) * (f * colours[0] + (1 - f) * colours[-1])
                T *= np.exp(-tau)
        return L[:3], T, L[3]


class NestedTwin:
    """Twins in nested boxes, the innermost first: each is seen where none before it is."""

    def __init__(self, levels: list[Twin]):
        self.levels = levels

    def render(self, o, d) -> tuple[np.ndarray, float, float]:
        """Colour, transmittance and distance: the ray is cut at all faces, and each part looked up by its middle."""
        o, d = np.asarray(o, np.float64), np.asarray(d, np.float64)
        boxes = [twin.interval(o, d) for twin in self.levels]
        ends = np.unique([t for a, b in boxes if b > a for t in (a, b)])
        L, T = np.zeros(4), 1.0
        for a, b in itertools.pairwise(ends):
            twin = next((w for w, (c, e) in zip(self.levels, boxes, strict=True) if c <= (a + b) / 2 <= e), None)
            if twin is not None:
                colour, through, distance = twin.render(o, d, between=(a, b))
                L += T * np.append(colour, distance)
                T *= through
        return L[:3], T, L[3]
