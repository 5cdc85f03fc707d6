"""SIRT and ordered subsets for a volume on the disk: each product with A visits one slab of layers after the other.

The share of a voxel in the trilinear model ends at the neighbouring layers. So a slab stands in a grid with a layer of zeros
below and above it. The sum of these products over all slabs is the product with the whole grid, and the inner layers of their
transposes are those of the whole transpose. An iteration equals :func:`ordered_subsets_sart` to rounding.

Files of the folder, float32: ``lines.npy`` (views, rows, cols), NaN for rays that are not used; ``sums.npy``
(subsets, Z, Y, X), ``A_s^T 1`` of the used rays; ``residual.npy`` (views, rows, cols); ``volume_0.npy`` and ``volume_1.npy``,
before and after a subset in turn, so a stop within a subset costs this subset only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mivol.optim.projections.iterative import golden_order
from mivol.optim.projections.linear_problems import invert_sums
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector


@dataclass(frozen=True)
class SweepState:
    """Progress of the sweeps.

    Attributes:
        steps: finished subsets, over all sweeps.
        longest: longest ray in the grid, of each subset [length].
        largest: largest sum over rays in a voxel, of each subset [length].
        residuals: norm of the residual of each finished sweep; each subset counts before its update.
        square: squared residual of the finished subsets of the current sweep.
    """

    steps: int
    longest: tuple[float, ...]
    largest: tuple[float, ...]
    residuals: tuple[float, ...] = ()
    square: float = 0.0


@dataclass(frozen=True, eq=False)
class DiskSweeps:
    """Sweeps over the subsets of a scan, for a volume on the disk.

    Attributes:
        beam, grid: geometry, and all voxels.
        slabs: layers of each slab.
        rows_of: function from a grid to the rows that the inside of the box shadows.
        views_at_once: views of a product.
        folder: folder of the files.
        n_subsets, relaxation, decay, nonnegative: as of :func:`ordered_subsets_sart`.
    """

    beam: ParallelBeam | ConeBeam
    grid: VoxelGrid
    slabs: tuple[slice, ...]
    rows_of: Callable[[VoxelGrid], slice]
    views_at_once: int
    folder: Path
    n_subsets: int = 1
    relaxation: float = 1.0
    decay: float = 1.0
    nonnegative: bool = True

    def prepare(self, read: Callable[[slice], np.ndarray], start: Callable[[slice], np.ndarray] | None) -> SweepState:
        """Write the files before the first sweep.

        Args:
            read: function from rows to line integrals (views, rows, cols), NaN for rays that are not used.
            start: function from layers to the first volume; None: 0.
        """
        lines = self._create("lines", self.beam.shape)
        self._create("residual", self.beam.shape)
        rows = self.beam.shape[1]
        at_once = max(1, rows * self.views_at_once // self.beam.shape[0])
        for first in range(0, rows, at_once):
            part = slice(first, min(first + at_once, rows))
            lines[:, part] = read(part)
        del lines
        for name in ("volume_0", "volume_1"):
            self._create(name, self.grid.shape)
        if start is not None:
            for layers in self.slabs:
                self._open("volume_0", "r+")[layers] = start(layers)
        self._create("sums", (self.n_subsets, *self.grid.shape))
        subsets = [self._views(s) for s in range(self.n_subsets)]
        longest = [max(float(self._box.subset(some).row_sums.max()) for some in self._batches(views)) for views in subsets]
        largest = np.zeros(self.n_subsets)
        for layers in self.slabs:
            a, inner, rows_seen = self._slab(layers)
            for s, views in enumerate(subsets):
                total = np.zeros(a.grid.shape, np.float32)
                for some in self._batches(views):
                    total += a.subset(some).T @ np.isfinite(self._open("lines")[some, rows_seen]).astype(np.float32)
                self._open("sums", "r+")[s, layers] = total[inner]
                largest[s] = max(largest[s], float(total[inner].max()))
        return SweepState(0, tuple(longest), tuple(largest.tolist()))

    def run(self, state: SweepState) -> Iterator[SweepState]:
        """The state after each further subset, without end."""
        while True:
            sweep, s = divmod(state.steps, self.n_subsets)
            views = self._views(s)
            self._subtract_prediction(views, self.volume(state))
            square = state.square + self._weigh_residual(views, state.longest[s])
            strength = np.float32(self.relaxation * self.decay**sweep)
            for layers in self.slabs:
                self._update(layers, s, views, strength, state)
            residuals = state.residuals
            if s == self.n_subsets - 1:
                residuals, square = (*residuals, float(np.sqrt(square))), 0.0
            state = SweepState(state.steps + 1, state.longest, state.largest, residuals, square)
            yield state

    def volume(self, state: SweepState) -> np.ndarray:
        """The volume (Z, Y, X) of a state, read from the disk where it is used."""
        return self._open(f"volume_{state.steps % 2}")

    def _subtract_prediction(self, views: np.ndarray, volume: np.ndarray) -> None:
        for some in self._batches(views):
            self._open("residual", "r+")[some] = self._open("lines")[some]
        for layers in self.slabs:
            a, inner, rows = self._slab(layers)
            x = np.zeros(a.grid.shape, np.float32)
            x[inner] = volume[layers]
            for some in self._batches(views):
                self._open("residual", "r+")[some, rows] -= a.subset(some) @ x

    def _weigh_residual(self, views: np.ndarray, longest: float) -> float:
        """Divide the residual by the length of each ray, 0 for rays that are not used; return its square before."""
        square = 0.0
        for some in self._batches(views):
            r = np.nan_to_num(self._open("residual")[some], nan=0.0)
            square += float(np.sum(r * r, dtype=np.float64))
            self._open("residual", "r+")[some] = r * invert_sums(self._box.subset(some).row_sums, longest)
        return square

    def _update(self, layers: slice, s: int, views: np.ndarray, strength: np.float32, state: SweepState) -> None:
        a, inner, rows = self._slab(layers)
        total = np.zeros(a.grid.shape, np.float32)
        for some in self._batches(views):
            total += a.subset(some).T @ self._open("residual")[some, rows]
        change = total[inner] * invert_sums(self._open("sums")[s, layers], state.largest[s]) * strength
        x = self.volume(state)[layers] + change
        self._open(f"volume_{(state.steps + 1) % 2}", "r+")[layers] = np.maximum(x, 0) if self.nonnegative else x

    def _slab(self, layers: slice) -> tuple[Projector, slice, slice]:
        """Projector of a slab between layers of zeros, its own layers in this grid, and the rows of the projector."""
        wide = slice(max(0, layers.start - 1), min(self.grid.shape[0], layers.stop + 1))
        grid = self.grid.select_layers(wide)
        rows = self.rows_of(grid)
        inner = slice(layers.start - wide.start, layers.stop - wide.start)
        return Projector(self.beam.select_rows(rows), grid), inner, rows

    def _views(self, s: int) -> np.ndarray:
        return np.arange(golden_order(self.n_subsets)[s], self.beam.shape[0], self.n_subsets)

    def _batches(self, views: np.ndarray) -> Iterator[np.ndarray]:
        return (views[first : first + self.views_at_once] for first in range(0, len(views), self.views_at_once))

    @cached_property
    def _box(self) -> Projector:
        """The grid as one voxel, in which rays are as long as in all its voxels."""
        return Projector(self.beam, VoxelGrid((1, 1, 1), tuple(self.grid.extent), self.grid.centre))

    def _create(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        return np.lib.format.open_memmap(self.folder / f"{name}.npy", "w+", np.float32, shape)

    def _open(self, name: str, mode: str = "r") -> np.ndarray:
        """A file as an array. Each use opens it anew, so pages of earlier uses do not stay in the memory of the process."""
        return np.load(self.folder / f"{name}.npy", mmap_mode=mode)
