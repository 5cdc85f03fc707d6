"""Cone beams on arbitrary trajectories: a table places source and flat detector in each view.

Conventions. A row of the table holds twelve lengths, x y z each: the source, the middle of the detector, the step from a
pixel's centre to the next column, and the step to the next row. The steps start at row 0 and column 0. Other projects call
this order "cone_vec". Helices, tilted circles, tomosynthesis arcs and calibrated scanners are such tables.

*Projection matrices.* A matrix P (3 x 4) of a calibration maps a world position to a pixel: ``(column, row, 1) ~ P (x, y, z,
1)``, whole numbers at the middles of pixels unless ``first_pixel`` says otherwise. A factor on the matrix, even a negative
factor, changes nothing.

*Nikon (X-Tek) scans.* At rest the light runs along +y and z is up. The sample turns clockwise as seen from above, so the
scanner turns counter-clockwise about the sample: by the sample's angle less half a turn, as in the Core Imaging Library
(``NikonDataReader`` and ``convert_geometry_to_astra_vec_3D``).

Reference: Hartley & Zisserman, Multiple View Geometry in Computer Vision (2004), section 6.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mivol.errors import MivolError
from mivol.files.nikon import NikonScan
from mivol.tomography.geometry import ConeBeam, Panels, view_index

COLUMNS = 12


@dataclass(frozen=True, eq=False)
class PanelViews:
    """A point source and a flat detector, placed anew in each view.

    Args:
        table: (views, 12) [length]: source, middle of the detector, step along a row, step along a column.
        detector: (rows, columns).

    Raises:
        MivolError: another shape, numbers that are not finite, steps that span no plane, or a source in the detector's plane.
    """

    table: np.ndarray
    detector: tuple[int, int]
    whole_lines: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        table = np.array(self.table, float)
        if table.ndim != 2 or table.shape[1] != COLUMNS or len(table) == 0:
            raise MivolError(
                f"found a geometry table of shape {table.shape}, expected (views, {COLUMNS}): x y z of the source, of the "
                "detector's middle, of the step to the next column and of the step to the next row."
            )
        if not np.isfinite(table).all():
            raise MivolError(
                f"found a number that is not finite in view {_first_index(~np.isfinite(table).all(1))} of the geometry."
            )
        source, middle, u, v = np.split(table, 4, axis=1)
        normal = np.cross(u, v)
        size = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
        flat = ~(np.linalg.norm(normal, axis=1) > 1e-6 * size)
        if flat.any():
            raise MivolError(
                f"found a detector without area in view {_first_index(flat)}, expected steps along two directions."
            )
        depth = np.abs(np.einsum("ni,ni->n", normal, middle - source))
        beside = depth <= 1e-9 * np.linalg.norm(normal, axis=1) * np.linalg.norm(middle - source, axis=1)
        if beside.any():
            raise MivolError(f"found the source in the detector's plane in view {_first_index(beside)}, expected it outside.")
        table.setflags(write=False)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "detector", tuple(int(n) for n in self.detector))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(views, rows, columns)."""
        return len(self.table), *self.detector

    def panels(self, views: Sequence[int] | np.ndarray | None = None) -> Panels:
        """Source and detector of each view."""
        source, middle, u, v = np.split(self.table[view_index(views, len(self.table))], 4, axis=1)
        rows, columns = self.detector
        return Panels(source, middle - (columns - 1) / 2 * u - (rows - 1) / 2 * v, u, v)

    def rays(self, views: Sequence[int] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The source, and unit directions towards the pixel centres, each (views, rows, cols, 3) float64."""
        panels = self.panels(views)
        rows, columns = (np.arange(n, dtype=float) for n in self.detector)
        d = (panels.corner - panels.source)[:, None, None, :] + columns[:, None] * panels.along_u[:, None, None, :]
        d = d + rows[:, None, None] * panels.along_v[:, None, None, :]
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return np.broadcast_to(panels.source[:, None, None, :], d.shape), d


def _first_index(wrong: np.ndarray) -> int:
    return int(np.flatnonzero(wrong)[0])


def make_helix(beam: ConeBeam, lift: float, shifts: Sequence[Sequence[float]] = ()) -> PanelViews:
    """Lift source and detector of a cone beam with the angle, and give it several sources.

    Args:
        beam: cone beam. With ``n`` shifts its views are ``n`` runs of equal length, a run of each source.
        lift: rise a turn, along z [length]. The middle of the angles is at the height of the beam.
        shifts: shift of each source along (the detector's columns, z) [length]; none: one source, not shifted.

    Raises:
        MivolError: views that do not divide among the sources.
    """
    panels, views = beam.panels(), len(beam.angles)
    shifts = np.reshape(shifts or ((0.0, 0.0),), (-1, 2))
    if views % len(shifts):
        raise MivolError(f"found {views} views of {len(shifts)} sources, expected as many views of each source.")
    shift = np.repeat(shifts, views // len(shifts), axis=0)
    middle = (beam.angles.min() + beam.angles.max()) / 2
    rise = (lift * (beam.angles - middle) / (2 * np.pi))[:, None] * np.array([0.0, 0.0, 1.0])
    u = panels.along_u / np.linalg.norm(panels.along_u, axis=1, keepdims=True)
    source = panels.source + rise + shift[:, :1] * u + shift[:, 1:] * np.array([0.0, 0.0, 1.0])
    rows, columns = beam.detector
    centre = panels.corner + rise + (columns - 1) / 2 * panels.along_u + (rows - 1) / 2 * panels.along_v
    return PanelViews(np.hstack([source, centre, panels.along_u, panels.along_v]), beam.detector)


MIN_SINGULAR_VALUE = 1e-12
"""Smallest over largest singular value of a matrix below which float64 cannot place its source."""


def panels_from_matrices(
    matrices: np.ndarray,
    detector: tuple[int, int],
    seen: Sequence[float] = (0.0, 0.0, 0.0),
    first_pixel: Sequence[float] = (0.0, 0.0),
) -> PanelViews:
    """Find the source and a detector of each view from its projection matrix.

    With ``P = (M | p)`` the source is ``-M^-1 p``, and the ray through a pixel runs along ``M^-1 (column, row, 1)``. A matrix
    does not give the distance of the detector, so the detector is placed through ``seen``. ``seen`` also selects the half of
    each line.

    Args:
        matrices: (views, 3, 4).
        detector: (rows, columns).
        seen: a position in front of every source [length].
        first_pixel: (column, row) of the middle of the first pixel.

    Raises:
        MivolError: another shape, or (with the number of the first such view) numbers that are not finite, no source (a
            singular M, as of parallel light), or ``seen`` beside the source.
    """
    p = np.asarray(matrices, np.float64)
    if p.ndim != 3 or p.shape[1:] != (3, 4) or len(p) == 0:
        raise MivolError(f"found projection matrices of shape {p.shape}, expected (views, 3, 4), one for each view.")
    _check_views(~np.isfinite(p).all((1, 2)), "numbers that are not finite", "finite ones: complete the matrix")
    m = p[:, :, :3]
    # Rows have different units (pixels, pixels, 1), and matrices arbitrary factors: normalise before judging singularity.
    lengths = np.linalg.norm(m, axis=2, keepdims=True)
    values = np.linalg.svd(m / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    _check_views(
        values[:, -1] <= MIN_SINGULAR_VALUE * values[:, 0],
        "a singular left half",
        "three independent rows: a point source has them",
    )
    inverse = np.linalg.inv(m)
    source = -(inverse @ p[:, :, 3:])[..., 0]
    depth = m[:, 2] @ np.asarray(seen, float) + p[:, 2, 3]
    beside = np.abs(depth) <= MIN_SINGULAR_VALUE * lengths[:, 2, 0] * np.linalg.norm(source - seen, axis=1)
    _check_views(
        beside, f"{tuple(map(float, seen))} beside the source", "the grid's centre before it: check the unit of lengths"
    )
    step_u, step_v, corner = (inverse * depth[:, None, None]).transpose(2, 0, 1)
    corner = source + corner + first_pixel[0] * step_u + first_pixel[1] * step_v
    rows, columns = detector
    middle = corner + (columns - 1) / 2 * step_u + (rows - 1) / 2 * step_v
    return PanelViews(np.hstack([source, middle, step_u, step_v]), detector)


def _check_views(wrong: np.ndarray, found: str, expected: str) -> None:
    if wrong.any():
        raise MivolError(f"found {found} in the projection matrix of view {int(np.argmax(wrong))}, expected {expected}.")


def geometry_from_nikon(scan: NikonScan, angles: np.ndarray) -> ConeBeam | PanelViews:
    """Make a cone beam on a circle; for a tilted or rolled rotation axis, a table of views with z along the axis.

    Args:
        scan: distances, detector and axis [mm].
        angles: (views,) of the sample [degree].
    """
    theta = np.radians(np.asarray(angles, float) - 180.0)
    circle = ConeBeam(theta, scan.detector, scan.source_to_axis, scan.source_to_detector, scan.pitch, scan.axis_offset)
    if not scan.tilt and not scan.roll:
        return circle
    at_rest = ConeBeam(np.zeros(1), (1, 1), scan.source_to_axis, scan.source_to_detector, scan.pitch, scan.axis_offset).panels()
    upright = _rotate_to_z(_axis_at_rest(scan.tilt, scan.roll))
    parts = [(upright @ part[0]) for part in (at_rest.source, at_rest.corner, at_rest.along_u, at_rest.along_v)]
    turns = np.stack([_rotate_about_z(angle) for angle in theta])
    return PanelViews(np.hstack([turns @ part for part in parts]), scan.detector)


def _axis_at_rest(tilt: float, roll: float) -> np.ndarray:
    """Direction of the rotation axis at rest: z rolled about the light's direction, then tilted about the direction of the
    columns.
    """
    t, r = np.radians([-tilt, roll])
    return np.array([np.sin(r), -np.sin(t) * np.cos(r), np.cos(t) * np.cos(r)])


def _rotate_to_z(axis: np.ndarray) -> np.ndarray:
    """The smallest rotation from a direction to z (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def _rotate_about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
