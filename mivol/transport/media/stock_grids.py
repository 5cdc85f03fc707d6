"""The place and the interpolation of Mitsuba's ``gridvolume``, both hidden by Mitsuba."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import is_recording
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.grid_walk import NodeArray, corner_nodes, read_nodes
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice, locate_cell

POINTS = 2048
"""Points for testing the interpolation of a stock grid: half in the outermost half voxels, half around nonzero voxels."""

TOLERANCE = 0.02
"""Largest deviation from trilinear interpolation, over the range of the 8 surrounding voxels. A rotated stock grid that does
not fill its boundary deviates by 5e-6 of its size, a nearest-voxel filter by about 0.4."""


MAX_PLACES = 256
"""Most places of grids that are kept."""


@dataclass
class StockGrids:
    """Place and interpolation of the grids of a scene, each found once.

    Attributes:
        places: (4, 4) float64 maps of the unit cube to the world, by volume and boundary.
        trilinear: whether a stock grid is interpolated as by mivol, by volume; without undecided grids.
    """

    places: dict = field(default_factory=dict)
    trilinear: dict = field(default_factory=dict)

    def place(self, volume: mi.Volume, boundary: Box | None) -> np.ndarray:
        """Place of a grid (:func:`find_grid_place`)."""
        key = (volume.ptr, None if boundary is None else boundary.to_world.tobytes())
        if key not in self.places:
            # A boundary that moves has a new key in each step.
            self.places = dict(list(self.places.items())[-MAX_PLACES:])
            self.places[key] = find_grid_place(volume, boundary)
        return self.places[key]

    def is_trilinear(self, volume: mi.Volume, lattice: Lattice) -> bool:
        """Whether a stock grid is trilinear between voxels, with clamped borders, like a lattice of the same values.

        A constant grid counts as trilinear until the values change, and every grid while ``dr.freeze`` records.
        """
        if volume.ptr not in self.trilinear and not is_recording():
            answer = compare_look_up(volume, lattice)
            if answer is None:
                return True
            self.trilinear[volume.ptr] = answer
        return self.trilinear.get(volume.ptr, True)

    def is_unknown(self, child: mi.Object) -> bool:
        """Whether a part of a medium is a stock grid whose look-ups were not compared yet."""
        return isinstance(child, mi.Volume) and child.class_name() == "GridVolume" and child.ptr not in self.trilinear

    def is_called(self, volume: mi.Volume) -> bool:
        """Whether transport calls a volume at points, as far as its look-ups are known; it reads the values of others."""
        return not holds_values(volume) or not self.trilinear.get(volume.ptr, True)


def holds_values(volume: mi.Volume) -> bool:
    """Whether a volume is a grid or a constant of Mitsuba, or a grid of mivol, so that its values may be read."""
    return volume.class_name() in ("GridVolume", "ConstVolume") or hasattr(volume, "mivol_to_world")


def compare_look_up(volume: mi.Volume, lattice: Lattice) -> bool | None:
    """Compare values of a stock grid with trilinear values, since Mitsuba exposes neither filter nor borders.

    Returns:
        Whether the values agree; None if all voxels around the points are equal, or some are not finite.
    """
    rng, sizes = np.random.default_rng(0), np.array(lattice.res[::-1])
    u, axis, border = rng.uniform(1e-3, 1 - 1e-3, (POINTS, 3)), rng.integers(3, size=POINTS), np.arange(POINTS // 2)
    u[border, axis[border]] = rng.uniform(0.05, 0.45, len(border)) / sizes[axis[border]]
    held = np.argwhere(np.array(lattice.values).any(axis=3))[:, ::-1]
    if len(held):
        chosen = held[rng.integers(len(held), size=POINTS - len(border))]
        u[len(border) :] = np.clip((chosen + rng.uniform(0, 1, chosen.shape)) / sizes, 1e-3, 1 - 1e-3)
    it = dr.zeros(mi.Interaction3f, POINTS)
    it.p = lattice.to_world_points(mi.Vector3f(u.T.astype(np.float32)))
    cell, frac, _ = locate_cell(lattice, it.p, mi.Vector3f(0, 0, 1), mi.Float(0))
    values = [NodeArray(dr.detach(lattice.values.array), lattice.channels)]
    corners, c = read_nodes(values, corner_nodes(cell, lattice, mi.Bool(True)), mi.Bool(True))[0], lattice.channels
    expected, actual = [interpolate(row, frac) for row in corners], volume.eval_1(it) if c == 1 else volume.eval(it)
    # One kernel: each conversion to NumPy would be a kernel of its own.
    dr.eval(expected, actual, corners)
    expected, actual = np.array([np.array(row) for row in expected]), np.array(actual).reshape(c, -1)
    spread = np.ptp(np.array([[np.array(v) for v in row] for row in corners]), axis=1)
    if not spread.any() or not np.isfinite(spread).all():
        return None
    error, scale = np.abs(expected - actual), float(np.abs(expected).max())
    groups = [*(border[axis[border] == a] for a in range(3)), slice(len(border), None)]
    return all(error[:, s].sum() <= TOLERANCE * spread[:, s].sum() + 1e-5 * scale * POINTS for s in groups)


def find_grid_place(volume: mi.Volume, boundary: Box | None = None) -> np.ndarray:
    """Find the place of a grid volume: the (4, 4) float64 map of the unit cube to the world.

    A ``mivol_voxels`` has its own map. A stock ``gridvolume`` only prints its transform, to 6 digits, and returns its bounding
    box, in float32. Together they are exact for boxes along the axes. A rotated grid is exact if it fills its boundary, and
    otherwise right to 5e-6 of its size.
    """
    if hasattr(volume, "mivol_to_world"):
        return volume.mivol_to_world
    text = str(volume)
    rows = re.search(r"inverse_transpose=\[\[(.*?)\]\]", text, re.S).group(1)
    place = np.array([[float(v) for v in row.split(",")] for row in re.split(r"\],\s*\[", rows)]).T
    box = volume.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    place[:3, :3] *= ((high - low) / np.abs(place[:3, :3]).sum(axis=1))[:, None]
    place[:3, 3] = (low + high - place[:3, :3].sum(axis=1)) / 2
    place[3] = (0, 0, 0, 1)
    if boundary is not None and boundary.matches(place, 1e-5):
        return _same_axes(boundary.to_world, place)
    return place


def _same_axes(exact: np.ndarray, rough: np.ndarray) -> np.ndarray:
    """The exact box, with its axes in the order and the direction of the axes of the rough box."""
    edges = exact[:3, :3]
    permutation = np.linalg.solve(edges, rough[:3, :3])  # of the axes, with signs, to the digits of ``rough``
    axes = edges @ np.round(permutation)
    centre = exact[:3, 3] + edges.sum(axis=1) / 2
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = axes, centre - axes.sum(axis=1) / 2
    return place
