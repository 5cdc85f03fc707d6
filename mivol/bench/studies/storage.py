"""What a scene costs on a grid: bytes per cell and per scene, from 128^3 to 1024^3 cells, as the lecture counts them.

    scripts/storage.py [--kept 0.1] [--runs runs/still_life runs/chair ...]

The lecture's own count is 4 bytes a cell, 8 bits each of r, g, b and density: 4 GiB at 1024^3, one colour for all directions.
Below it: four numbers of 32 bits (16 on disk), harmonics of degree 0 to 3 on a dense grid, and the same where only the nodes
near a surface are kept. `--kept` is their share at 128^3; a surface's share halves with each doubling of the resolution.
Memory is float32 as mivol.fields.spherical_grid lays it out: rows filled up to a multiple of 4 (degree 0 takes 4 numbers and
not 3), and for a sparse field the list of its nodes and the row of vacuum. Files are half floats, before they are compressed.

The walk reads an index beside that: two bits for each node and half a bit for each cell of the box, whatever is kept, twelve
bytes for each brick of 4^3 cells near a surface, and for each such cell the corners of it
(mivol.transport.traversal.occupied_cells). It is counted on a ball's surface that keeps as many nodes.

Quality is that of the runs' held-out views (`mivol optimize` on photographs leaves field.npz and run.json), with what their
fields take in truth. Prints a table in Markdown, then all of it as JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, row_width

__all__ = ["Fitted", "Kind", "count_cells", "dense_bytes", "file_bytes", "index_bytes", "kinds", "main", "sparse_bytes"]

SIZES = (128, 256, 512, 1024)
DEGREES = (0, 1, 2, 3)
MODEL = 64
"""Resolution at which the surface of a ball is counted."""

UNITS = ("B", "KiB", "MiB", "GiB", "TiB")


# -- Formulas -------------------------------------------------------------------------------------------------------------


def dense_bytes(nodes: int, degree: int) -> int:
    """Values of a dense field in memory."""
    return 4 * nodes * (1 + row_width(basis_size(degree)))


def sparse_bytes(kept: int, degree: int) -> int:
    """Values of a sparse field in memory, its list of nodes and its row of vacuum."""
    return 4 * (kept + 1) * (1 + row_width(basis_size(degree))) + 4 * kept


def file_bytes(kept: int, degree: int, *, sparse: bool) -> int:
    """Values of a field on disk in half floats, before they are compressed, and the list of nodes of a sparse one."""
    return 2 * kept * (1 + 3 * basis_size(degree)) + 4 * kept * sparse


def index_bytes(res: Sequence[int], cells: int, rows: int, bricks: int) -> int:
    """What the walk reads beside the values.

    Args:
        res: nodes along the axes.
        cells: how many are near a surface.
        rows: different rows at their corners.
        bricks: of 4^3 cells, that hold one of these.
    """
    nodes, all_bricks = math.prod(res), math.prod(-(-(n + 1) // 4) for n in res)
    return 8 * -(-nodes // 32) + 4 * all_bricks + 12 * bricks + 4 * 8 * cells + 4 * rows


def count_cells(keep: np.ndarray) -> tuple[int, int, int]:
    """Cells that touch a node of ``keep`` (Z, Y, X), the rows at their corners (the nodes kept, and the vacuum), and their
    bricks."""
    beyond = np.pad(keep, 1, mode="edge")
    cells = np.zeros([n + 1 for n in keep.shape], bool)
    for k in range(8):
        cells |= beyond[tuple(slice((k >> a) & 1, n + 1 + ((k >> a) & 1)) for a, n in enumerate(keep.shape))]
    bricks = {tuple(place) for place in np.argwhere(cells) >> 2}
    return int(cells.sum()), int(keep.sum() + (keep.any() and not keep.all())), len(bricks)


# -- Table ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A way to store a scene.

    Attributes:
        name: for people.
        per_cell: bytes a cell, or a node that is kept, in memory and on disk.
        scenes: bytes of a scene in memory and on disk, by resolution.
        degree: of its harmonics, where it has any.
        sparse: whether only some nodes are kept.
    """

    name: str
    per_cell: tuple[float, float]
    scenes: dict[int, tuple[int, int]]
    degree: int | None = None
    sparse: bool = False


def shell(share: float) -> np.ndarray:
    """The nodes (MODEL, MODEL, MODEL) nearest to the surface of a ball, so that ``share`` of all are kept."""
    axis = (np.arange(MODEL) + 0.5) / MODEL - 0.5
    distance = np.abs(np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) - 0.35)
    return distance < np.quantile(distance, min(share, 1.0))


def kinds(kept: float) -> list[Kind]:
    """All ways, with a share of nodes that are kept at 128^3."""
    cells = {n: n**3 for n in SIZES}
    near = {n: round(kept * SIZES[0] / n * n**3) for n in SIZES}
    found = [
        Kind("dense rgba, 8 bits (the lecture's)", (4, 4), {n: (4 * c, 4 * c) for n, c in cells.items()}),
        Kind("dense rgba", (16, 8), {n: (16 * c, 8 * c) for n, c in cells.items()}),
    ]
    for d in DEGREES:
        scenes = {n: (dense_bytes(c, d), file_bytes(c, d, sparse=False)) for n, c in cells.items()}
        found.append(Kind(f"dense SH {d}", (dense_bytes(1, d), file_bytes(1, d, sparse=False)), scenes, d))
    for d in DEGREES:
        scenes = {n: (sparse_bytes(c, d), file_bytes(c, d, sparse=True)) for n, c in near.items()}
        each = sparse_bytes(1, d) - sparse_bytes(0, d), file_bytes(1, d, sparse=True)
        found.append(Kind(f"sparse SH {d}", each, scenes, d, True))
    return [*found, index_kind(kept)]


def index_kind(kept: float) -> Kind:
    """The index, in memory only: counted at MODEL where the surface is as many voxels thick."""
    thin = shell(kept * SIZES[0] / MODEL)
    each = np.array(count_cells(thin)) / thin.sum()
    scenes = {}
    for n in SIZES:
        near = kept * SIZES[0] / n * n**3
        scenes[n] = (index_bytes((n, n, n), *(round(count * near) for count in each)), 0)
    return Kind("beside it: the walk's index", (scenes[SIZES[0]][0] / SIZES[0] ** 3, 0), scenes)


@dataclass(frozen=True)
class Fitted:
    """A field that was fitted: what it takes, and how good it is."""

    title: str
    longest: int
    degree: int
    sparse: bool
    kept: int
    share: float
    memory: int
    file: int
    psnr: float | None

    @classmethod
    def of(cls, folder: Path) -> Fitted:
        """Read a run folder.

        Raises:
            MivolError: it holds no fit.
        """
        absent = [name for name in ("run.json", "field.npz") if not (folder / name).is_file()]
        if absent:
            raise MivolError(f"{folder} has no {' and no '.join(absent)}; give folders of fits to photographs.")
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        with np.load(folder / "field.npz", allow_pickle=False) as stored:
            res, sh, sparse = stored["res"].tolist(), stored["sh"].shape, "nodes" in stored
        degree = math.isqrt(sh[1]) - 1
        memory = sparse_bytes(sh[0], degree) if sparse else dense_bytes(sh[0], degree)
        file = (folder / "field.npz").stat().st_size
        share = sh[0] / math.prod(res)
        psnr = record["results"].get("held_out_psnr")
        return cls(record["title"], max(res), degree, sparse, sh[0], share, memory, file, psnr)

    @property
    def text(self) -> str:
        """A line."""
        quality = "no held-out view" if self.psnr is None else f"{self.psnr:.2f} dB"
        took = f"{self.kept} nodes ({100 * self.share:.2g} %), {size(self.memory)}, {size(self.file)} on disk, compressed"
        return f"{self.title}: {self.longest}^3, {'sparse' if self.sparse else 'dense'} SH {self.degree}, {quality}; {took}"


def quality(kind: Kind, fitted: Sequence[Fitted]) -> str:
    """What was reached with a way of storing, by resolution."""
    found = [f for f in fitted if (f.degree, f.sparse) == (kind.degree, kind.sparse) and f.psnr is not None]
    return ", ".join(f"{f.psnr:.1f} dB at {f.longest}^3 ({f.title})" for f in found) or "not fitted"


def size(count: float) -> str:
    """Bytes with three digits."""
    power = min(int(math.log(max(count, 1), 1024)), len(UNITS) - 1)
    return f"{count / 1024**power:.3g} {UNITS[power]}"


def markdown(found: Sequence[Kind], fitted: Sequence[Fitted]) -> str:
    """The table: memory / disk."""
    heads = ["memory / disk", "bytes a cell", *(f"{n}^3" for n in SIZES), "held-out views"]
    lines = [heads, ["---", *["---:"] * (len(heads) - 2), "---"]]
    for kind in found:
        cells = [" / ".join(f"{b:.3g}" for b in kind.per_cell if b), *(pair(kind.scenes[n]) for n in SIZES)]
        judged = "" if kind is found[-1] else quality(kind, fitted)
        lines.append([kind.name, cells[0] + (" (a kept node)" if kind.sparse else ""), *cells[1:], judged])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def pair(counts: tuple[int, int]) -> str:
    """Memory / disk; one of them where the other is nothing."""
    return " / ".join(size(count) for count in counts if count)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, what was fitted, and both as JSON; the exit code."""
    given = arguments(argv)
    try:
        fitted = [Fitted.of(folder) for folder in given.runs]
    except MivolError as error:
        print(f"storage: {error}", file=sys.stderr)
        return 1
    found = kinds(given.kept)
    shares = ", ".join(f"{100 * given.kept * SIZES[0] / n:.3g} %" for n in SIZES)
    print(markdown(found, fitted))
    print(f"\nKept near a surface: {shares} of the nodes.")
    print("".join(f"\n{f.text}" for f in fitted))
    rows = [asdict(kind) for kind in found]
    print(json.dumps({"kept": given.kept, "kinds": rows, "fitted": [asdict(f) for f in fitted]}))
    return 0


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="storage.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kept", type=float, default=0.1, help="share of the nodes that a sparse field keeps at 128^3")
    parser.add_argument("--runs", type=Path, nargs="*", default=[], help="run folders of fits to photographs")
    given = parser.parse_args(argv)
    if not 0 < given.kept <= 1:
        parser.error(f"--kept {given.kept:g} is no share: give a number above 0 and at most 1")
    return given
