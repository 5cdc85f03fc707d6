"""Cone beams on any trajectory: where source and flat detector stand is a table, a row for each view.

Conventions. A row holds twelve lengths, x y z each: the source, the middle of the detector, the step from a pixel's centre to
that of the next column, and the step to the next row. Row 0 and column 0 are where the steps begin. This is the order of
"cone_vec" geometries elsewhere. Helices, tilted circles, tomosynthesis arcs and calibrated scanners are all such tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mivol.errors import MivolError
from mivol.tomography.geometry import Panels, view_index

COLUMNS = 12


@dataclass(frozen=True, eq=False)
class PanelViews:
    """A point source and a flat detector, placed anew in each view.

    Args:
        table: (views, 12) [length]: source, middle of the detector, step along a row, step along a column.
        detector: (rows, columns).

    Raises:
        MivolError: another shape, numbers that are not finite, steps that span no plane, a source in the detector's plane.
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
            raise MivolError(f"found a number that is not finite in view {_first(~np.isfinite(table).all(1))} of the geometry.")
        source, middle, u, v = np.split(table, 4, axis=1)
        normal = np.cross(u, v)
        size = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
        flat = ~(np.linalg.norm(normal, axis=1) > 1e-6 * size)
        if flat.any():
            raise MivolError(f"found a detector without area in view {_first(flat)}, expected steps along two directions.")
        depth = np.abs(np.einsum("ni,ni->n", normal, middle - source))
        beside = depth <= 1e-9 * np.linalg.norm(normal, axis=1) * np.linalg.norm(middle - source, axis=1)
        if beside.any():
            raise MivolError(f"found the source in the detector's plane in view {_first(beside)}, expected it outside.")
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


def _first(wrong: np.ndarray) -> int:
    return int(np.flatnonzero(wrong)[0])
