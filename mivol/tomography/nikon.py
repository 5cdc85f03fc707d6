"""The geometry of a Nikon (X-Tek) scan, from what its ``.xtekct`` file says.

Conventions. At rest the light runs along +y and z is up. The sample turns clockwise as seen from above, so about it the scanner
turns counter-clockwise: by the sample's angle less half a turn, as the Core Imaging Library has it (its ``NikonDataReader`` and
``convert_geometry_to_astra_vec_3D``).
"""

from __future__ import annotations

import numpy as np

from mivol.files.nikon import NikonScan
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.panel_views import PanelViews


def nikon_geometry(scan: NikonScan, angles: np.ndarray) -> ConeBeam | PanelViews:
    """A cone beam on a circle; where the rotation axis is tilted or rolled, a table of views whose z is along the axis.

    Args:
        scan: distances, detector and axis [mm].
        angles: (views,) of the sample [degree].
    """
    theta = np.radians(np.asarray(angles, float) - 180.0)
    circle = ConeBeam(theta, scan.detector, scan.source_to_axis, scan.source_to_detector, scan.pitch, scan.axis_offset)
    if not scan.tilt and not scan.roll:
        return circle
    at_rest = ConeBeam(np.zeros(1), (1, 1), scan.source_to_axis, scan.source_to_detector, scan.pitch, scan.axis_offset).panels()
    upright = _to_z(_axis(scan.tilt, scan.roll))
    parts = [(upright @ part[0]) for part in (at_rest.source, at_rest.corner, at_rest.along_u, at_rest.along_v)]
    turns = np.stack([_turn_about_z(angle) for angle in theta])
    return PanelViews(np.hstack([turns @ part for part in parts]), scan.detector)


def _axis(tilt: float, roll: float) -> np.ndarray:
    """Direction of the rotation axis at rest: z rolled about the light's direction, then tilted about the columns'."""
    t, r = np.radians([-tilt, roll])
    return np.array([np.sin(r), -np.sin(t) * np.cos(r), np.cos(t) * np.cos(r)])


def _to_z(axis: np.ndarray) -> np.ndarray:
    """The least rotation that brings a direction on to z (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def _turn_about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
