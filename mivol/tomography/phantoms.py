"""Phantoms with exact line integrals: sums of homogeneous ellipsoids, such as the Shepp-Logan heads.

Conventions. An ellipsoid is ``|S R (x - c)| <= 1`` with semi-axes ``1 / diag(S) = (a, b, c)`` and the rotation ``R`` of the
Euler angles (phi about z, theta about the new x, psi about the newest z). The values of overlapping ellipsoids add up.
Projections are exact chords in float64 without a grid, so a reconstruction from them cannot commit the inverse crime.

References: Kak & Slaney, Principles of Computerized Tomographic Imaging (1988), section 3.1 (chord of an ellipse), p. 102
(table). Yu, Ye & Wang, Proc. SPIE 5535, 550 (2004) (contrast). Toft, The Radon Transform (1996), and M. Schabel, "3D
Shepp-Logan phantom", MATLAB Central File Exchange 9416 (modified head). The numbers of all three were compared with CERN/TIGRE
at e702473, Python/tigre/utilities/sl3d.py (BSD-3, T. Sadakane).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.tomography.geometry import Geometry, VoxelGrid

# Rows: semi-axes a, b, c; centre x, y, z; Euler angles phi, theta, psi in degrees; value.
_KAK_SLANEY = (
    (0.6900, 0.920, 0.900, 0.00, 0.000, 0.000, 0, 0, 0, 2.00),
    (0.6624, 0.874, 0.880, 0.00, 0.000, 0.000, 0, 0, 0, -0.98),
    (0.4100, 0.160, 0.210, -0.22, 0.000, -0.250, 108, 0, 0, -0.02),
    (0.3100, 0.110, 0.220, 0.22, 0.000, -0.250, 72, 0, 0, -0.02),
    (0.2100, 0.250, 0.500, 0.00, 0.350, -0.250, 0, 0, 0, 0.02),
    (0.0460, 0.046, 0.046, 0.00, 0.100, -0.250, 0, 0, 0, 0.02),
    (0.0460, 0.023, 0.020, -0.08, -0.650, -0.250, 0, 0, 0, 0.01),
    (0.0460, 0.023, 0.020, 0.06, -0.650, -0.250, 90, 0, 0, 0.01),
    (0.0560, 0.040, 0.100, 0.06, -0.105, 0.625, 90, 0, 0, 0.02),
    (0.0560, 0.056, 0.100, 0.00, 0.100, 0.625, 0, 0, 0, -0.02),
)
_YU_YE_WANG_VALUES = (1.0, -0.8, -0.2, -0.2, 0.2, 0.2, 0.1, 0.1, 0.2, -0.2)
_TOFT_SCHABEL = (
    (0.6900, 0.9200, 0.81, 0.00, 0.0000, 0.00, 0, 0, 0, 1.0),
    (0.6624, 0.8740, 0.78, 0.00, -0.0184, 0.00, 0, 0, 0, -0.8),
    (0.1100, 0.3100, 0.22, 0.22, 0.0000, 0.00, -18, 0, 10, -0.2),
    (0.1600, 0.4100, 0.28, -0.22, 0.0000, 0.00, 18, 0, 10, -0.2),
    (0.2100, 0.2500, 0.41, 0.00, 0.3500, -0.15, 0, 0, 0, 0.1),
    (0.0460, 0.0460, 0.05, 0.00, 0.1000, 0.25, 0, 0, 0, 0.1),
    (0.0460, 0.0460, 0.05, 0.00, -0.1000, 0.25, 0, 0, 0, 0.1),
    (0.0460, 0.0230, 0.05, -0.08, -0.6050, 0.00, 0, 0, 0, 0.1),
    (0.0230, 0.0230, 0.02, 0.00, -0.6060, 0.00, 0, 0, 0, 0.1),
    (0.0230, 0.0460, 0.02, 0.06, -0.6050, 0.00, 0, 0, 0, 0.1),
)


@dataclass(frozen=True, eq=False)
class EllipsoidPhantom:
    """A sum of homogeneous ellipsoids.

    Args:
        to_body: (N, 3, 3) matrices ``S R`` from an ellipsoid to the unit sphere [1/length].
        centres: (N, 3) centres x, y, z [length].
        values: (N,) contribution of each ellipsoid to the field [1/length].
    """

    to_body: np.ndarray
    centres: np.ndarray
    values: np.ndarray

    def scaled(self, length: float) -> EllipsoidPhantom:
        """The same object, ``length`` times as large; its values per the new unit do not change."""
        return EllipsoidPhantom(self.to_body / length, self.centres * length, self.values)

    def eval_points(self, points: np.ndarray) -> np.ndarray:
        """The field at ``points`` (..., 3) [length], (...) float64 [1/length]."""
        field = np.zeros(points.shape[:-1])
        for to_body, centre, value in zip(self.to_body, self.centres, self.values, strict=True):
            q = (points - centre) @ to_body.T
            field += value * (np.einsum("...i,...i", q, q) <= 1.0)
        return field

    def voxelise(self, grid: VoxelGrid, supersampling: int) -> np.ndarray:
        """Mean of the field over sub-points of each voxel.

        Args:
            grid: placement of the voxels.
            supersampling: sub-points along each edge of a voxel. At a surface, their mean misses the true mean of the voxel by
                about 1 / (2 supersampling) of the step.

        Returns:
            (Z, Y, X) float32 [1/length].

        Cost: a test per voxel and ellipsoid; sub-points only in voxels near a surface.
        """
        steps = (np.arange(supersampling) + 0.5) / supersampling - 0.5
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) * grid.voxel_size
        x, y, z = (grid.axis(name) for name in "xyz")
        volume = np.zeros(grid.shape)
        centres = np.empty((len(y), len(x), 3))
        centres[..., 0], centres[..., 1] = x, y[:, None]
        for plane, height in zip(volume, z, strict=True):
            centres[..., 2] = height
            for to_body, centre, value in zip(self.to_body, self.centres, self.values, strict=True):
                plane += value * _covered_share(centres, offsets, to_body, centre)
        return volume.astype(np.float32)

    def integrate_lines(self, o: np.ndarray, d: np.ndarray, whole_lines: bool = False) -> np.ndarray:
        """Exact line integrals.

        In the frame of the unit sphere the ray is ``q + t e``. With ``m`` the ``t`` nearest the centre, the chord is ``2
        sqrt(1 - |q + m e|^2) / |e|``. Unlike ``sqrt(B^2 - A C)``, this form loses no digits to cancellation for a distant
        origin.

        Args:
            o: (..., 3) points on the rays [length].
            d: (..., 3) unit directions.
            whole_lines: integrate both ways from ``o``, not only forwards.

        Returns:
            (...) float64, dimensionless.
        """
        total = np.zeros(o.shape[:-1])
        start = -np.inf if whole_lines else 0.0
        for to_body, centre, value in zip(self.to_body, self.centres, self.values, strict=True):
            q, e = (o - centre) @ to_body.T, d @ to_body.T
            speed2 = np.einsum("...i,...i", e, e)
            nearest = -np.einsum("...i,...i", q, e) / speed2
            foot = q + nearest[..., None] * e
            half = np.sqrt(np.maximum(1.0 - np.einsum("...i,...i", foot, foot), 0.0) / speed2)
            total += value * (np.maximum(nearest + half, start) - np.maximum(nearest - half, start))
        return total

    def project(self, geometry: Geometry) -> np.ndarray:
        """Exact projections of the phantom, (views, rows, cols) float64, computed view by view."""
        return np.concatenate(
            [self.integrate_lines(*geometry.rays([view]), geometry.whole_lines) for view in range(geometry.shape[0])]
        )


def _kak_slaney() -> EllipsoidPhantom:
    return _from_table(np.array(_KAK_SLANEY))


def _yu_ye_wang() -> EllipsoidPhantom:
    table = np.array(_KAK_SLANEY)
    table[:, 9] = _YU_YE_WANG_VALUES
    return _from_table(table)


def _toft_schabel() -> EllipsoidPhantom:
    return _from_table(np.array(_TOFT_SCHABEL), centres_turn=True)


#: Heads inside the cube [-1, 1]^3. "kak-slaney" has the water contrast of 1 %, the others are made to be looked at.
SHEPP_LOGAN = {"kak-slaney": _kak_slaney, "yu-ye-wang": _yu_ye_wang, "toft-schabel": _toft_schabel}


def shepp_logan(variant: str = "yu-ye-wang", half_width: float = 1.0) -> EllipsoidPhantom:
    """A three-dimensional Shepp-Logan head inside the cube of ``half_width`` [length] around the origin.

    Raises: MivolError: a variant missing from SHEPP_LOGAN.
    """
    if variant not in SHEPP_LOGAN:
        raise MivolError(f"Found no Shepp-Logan head '{variant}', expected one of {', '.join(SHEPP_LOGAN)}.")
    return SHEPP_LOGAN[variant]().scaled(half_width)


def random_ellipsoids(n: int, seed: int, half_width: float = 1.0) -> EllipsoidPhantom:
    """``n`` ellipsoids of value 0.2 to 1, in random orientations, inside the ball of radius ``half_width``.

    Args:
        n: number of ellipsoids.
        seed: seed of the generator; the same seed gives the same phantom.
        half_width: radius of the ball around all ellipsoids [length].
    """
    rng = np.random.default_rng(seed)
    axes = rng.uniform(0.05, 0.35, (n, 3))
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    room = 1.0 - axes.max(axis=1)
    centres = directions * (room * rng.uniform(size=n) ** (1 / 3))[:, None]
    angles = np.degrees(rng.uniform(0, 2 * np.pi, (n, 3)))
    values = rng.uniform(0.2, 1.0, (n, 1))
    return _from_table(np.hstack([axes, centres, angles, values])).scaled(half_width)


def _from_table(table: np.ndarray, centres_turn: bool = False) -> EllipsoidPhantom:
    """With ``centres_turn`` the centres are given in the rotated frame, as in the toft-schabel head."""
    rotations = np.stack([_euler_matrix(*np.radians(row[6:9])) for row in table])
    centres = np.einsum("nji,nj->ni", rotations, table[:, 3:6]) if centres_turn else table[:, 3:6]
    return EllipsoidPhantom(rotations / table[:, 0:3, None], centres, table[:, 9])


def _euler_matrix(phi: float, theta: float, psi: float) -> np.ndarray:
    """World to body: z by phi, x by theta, z by psi, the frame turning with the body."""

    def about_z(a: float) -> np.ndarray:
        return np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])

    about_x = np.array([[1, 0, 0], [0, np.cos(theta), np.sin(theta)], [0, -np.sin(theta), np.cos(theta)]])
    return about_z(psi) @ about_x @ about_z(phi)


def _covered_share(points: np.ndarray, offsets: np.ndarray, to_body: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Share of ``points + offsets`` inside an ellipsoid, for each of ``points`` (..., 3)."""
    q = (points - centre) @ to_body.T
    moved = offsets @ to_body.T
    r, reach = np.linalg.norm(q, axis=-1), np.linalg.norm(moved, axis=-1).max()
    share = (r <= 1.0).astype(float)
    cut = np.abs(r - 1.0) <= reach
    share[cut] = (np.linalg.norm(q[cut][:, None] + moved, axis=-1) <= 1.0).mean(axis=1)
    return share
