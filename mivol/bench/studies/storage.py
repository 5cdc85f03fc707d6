"""What does a scene cost on a grid: how many bytes for each cell and for the scene, from 128^3 to 1024^3 cells?

    mivol bench storage [--kept 0.1] [--runs runs/still_life runs/chair ...]

The count of the lecture is 4 bytes for each cell, 8 bits each for r, g, b and density: 4 GiB at 1024^3, with one colour for all
directions. Beside it: four numbers of 32 bits (16 on disk), harmonics of degree 0 to 3 on a dense grid, and the same with only
the nodes near a surface. ``--kept`` is the share of these nodes at 128^3; the share of a surface halves with each doubling of
the resolution. Memory is float32 in the layout of mivol.fields.spherical_grid: rows padded to a multiple of 4 (degree 0 takes 4
numbers, not 3); a sparse field also has the list of its nodes and the row of vacuum. Files are half floats before compression.

The walk also reads an index: two bits for each node and half a bit for each cell of the box, whatever is kept; twelve bytes for
each brick of 4^3 cells near a surface; and the corners of each such cell (mivol.transport.traversal.occupied_cells). The index
is counted on the surface of a ball that keeps as many nodes.

Quality is the held-out PSNR of runs (``mivol optimize`` on photographs writes field.npz and run.json), with the real memory of
their fields.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mivol.bench.harness.study import Size, Study, amount
from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, row_width

__all__ = [
    "STUDY", "FittedField", "Layout", "StorageSize", "count_cells", "dense_bytes", "file_bytes", "index_bytes", "make_layouts",
    "sparse_bytes",
]  # fmt: skip

RESOLUTIONS, DEGREES = (128, 256, 512, 1024), (0, 1, 2, 3)
BALL_RES = 64
"""Resolution at which the surface of a ball is counted."""

UNITS = ("B", "KiB", "MiB", "GiB", "TiB")


@dataclass(frozen=True)
class StorageSize(Size):
    """Options."""

    kept: float = amount(0.1, doc="share of the nodes that a sparse field keeps at 128^3")
    runs: tuple[Path, ...] = amount((), doc="run folders of fits of photographs", kind=Path)


# -- Formulas ---------------------------------------------------------------------------------------------------------------


def dense_bytes(nodes: int, degree: int) -> int:
    """Memory of the values of a dense field [bytes]."""
    return 4 * nodes * (1 + row_width(basis_size(degree)))


def sparse_bytes(kept: int, degree: int) -> int:
    """Memory of the values of a sparse field, its list of nodes and its row of vacuum [bytes]."""
    return 4 * (kept + 1) * (1 + row_width(basis_size(degree))) + 4 * kept


def file_bytes(kept: int, degree: int, *, sparse: bool) -> int:
    """Half floats on disk before compression, with the list of nodes of a sparse field [bytes]."""
    return 2 * kept * (1 + 3 * basis_size(degree)) + 4 * kept * sparse


def index_bytes(res: Sequence[int], cells: int, rows: int, bricks: int) -> int:
    """Memory of the index of the walk [bytes].

    Args:
        res: nodes along the axes.
        cells: number of cells near a surface.
        rows: number of different rows at their corners.
        bricks: number of bricks of 4^3 cells with such cells.
    """
    nodes, all_bricks = math.prod(res), math.prod(-(-(n + 1) // 4) for n in res)
    return 8 * -(-nodes // 32) + 4 * all_bricks + 12 * bricks + 4 * 8 * cells + 4 * rows


def count_cells(keep: np.ndarray) -> tuple[int, int, int]:
    """Count the cells with a kept node, the rows at their corners (kept nodes and vacuum), and their bricks.

    Args:
        keep: mask of the kept nodes (Z, Y, X).
    """
    padded = np.pad(keep, 1, mode="edge")
    cells = np.zeros([n + 1 for n in keep.shape], bool)
    for k in range(8):
        cells |= padded[tuple(slice((k >> a) & 1, n + 1 + ((k >> a) & 1)) for a, n in enumerate(keep.shape))]
    bricks = {tuple(cell) for cell in np.argwhere(cells) >> 2}
    return int(cells.sum()), int(keep.sum() + (keep.any() and not keep.all())), len(bricks)


# -- Layouts ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layout:
    """A way to store a scene.

    Attributes:
        name: label.
        per_cell: bytes of a cell, or of a kept node, in memory and on disk.
        scenes: bytes of a scene in memory and on disk, by resolution.
        degree: degree of the harmonics; None: no harmonics.
        sparse: only some nodes are kept.
    """

    name: str
    per_cell: tuple[float, float]
    scenes: dict[int, tuple[int, int]]
    degree: int | None = None
    sparse: bool = False


def ball_shell(share: float) -> np.ndarray:
    """Mask (BALL_RES,)^3 of the nodes nearest to the surface of a ball; ``share``: their share of all nodes."""
    axis = (np.arange(BALL_RES) + 0.5) / BALL_RES - 0.5
    distance = np.abs(np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) - 0.35)
    return distance < np.quantile(distance, min(share, 1.0))


def make_layouts(kept: float) -> list[Layout]:
    """All layouts; ``kept`` is the share of kept nodes at 128^3. The last layout is the index of the walk."""
    cells = {n: n**3 for n in RESOLUTIONS}
    near = {n: round(kept * RESOLUTIONS[0] / n * n**3) for n in RESOLUTIONS}
    layouts = [
        Layout("dense rgba, 8 bits (the lecture's)", (4, 4), {n: (4 * c, 4 * c) for n, c in cells.items()}),
        Layout("dense rgba", (16, 8), {n: (16 * c, 8 * c) for n, c in cells.items()}),
    ]
    for d in DEGREES:
        scenes = {n: (dense_bytes(c, d), file_bytes(c, d, sparse=False)) for n, c in cells.items()}
        layouts.append(Layout(f"dense SH {d}", (dense_bytes(1, d), file_bytes(1, d, sparse=False)), scenes, d))
    for d in DEGREES:
        scenes = {n: (sparse_bytes(c, d), file_bytes(c, d, sparse=True)) for n, c in near.items()}
        each = sparse_bytes(1, d) - sparse_bytes(0, d), file_bytes(1, d, sparse=True)
        layouts.append(Layout(f"sparse SH {d}", each, scenes, d, True))
    return [*layouts, index_layout(kept)]


def index_layout(kept: float) -> Layout:
    """The index, in memory only, counted at BALL_RES for a surface with the same thickness in voxels."""
    thin = ball_shell(kept * RESOLUTIONS[0] / BALL_RES)
    each = np.array(count_cells(thin)) / thin.sum()
    scenes = {}
    for n in RESOLUTIONS:
        near = kept * RESOLUTIONS[0] / n * n**3
        scenes[n] = (index_bytes((n, n, n), *(round(count * near) for count in each)), 0)
    return Layout("beside it: the walk's index", (scenes[RESOLUTIONS[0]][0] / RESOLUTIONS[0] ** 3, 0), scenes)


@dataclass(frozen=True)
class FittedField:
    """A fitted field: memory [bytes], size of the file [bytes], quality [dB]."""

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
    def read(cls, folder: Path) -> FittedField:
        """Read a run folder.

        Raises:
            MivolError: the folder holds no fit.
        """
        missing = [name for name in ("run.json", "field.npz") if not (folder / name).is_file()]
        if missing:
            raise MivolError(f"{folder} has no {' and no '.join(missing)}; give folders of fits to photographs.")
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        with np.load(folder / "field.npz", allow_pickle=False) as stored:
            res, sh, sparse = stored["res"].tolist(), stored["sh"].shape, "nodes" in stored
        degree = math.isqrt(sh[1]) - 1
        memory = sparse_bytes(sh[0], degree) if sparse else dense_bytes(sh[0], degree)
        share, size = sh[0] / math.prod(res), (folder / "field.npz").stat().st_size
        psnr = record["results"].get("held_out_psnr")
        return cls(record["title"], max(res), degree, sparse, sh[0], share, memory, size, psnr)


def measure_storage(size: StorageSize) -> dict:
    """What does a scene cost in memory and on disk, for each layout and resolution?"""
    if not 0 < size.kept <= 1:
        raise MivolError(f"--kept {size.kept:g} is no share: give a number above 0 and at most 1.")
    fitted = [asdict(FittedField.read(folder)) for folder in size.runs]
    return {"kept": size.kept, "kinds": [asdict(layout) for layout in make_layouts(size.kept)], "fitted": fitted}


# -- Table ------------------------------------------------------------------------------------------------------------------


def format_bytes(count: float) -> str:
    """Bytes with three digits and a unit."""
    power = min(int(math.log(max(count, 1), 1024)), len(UNITS) - 1)
    return f"{count / 1024**power:.3g} {UNITS[power]}"


def quality_cell(layout: dict, fitted: list[dict]) -> str:
    """PSNR of the fitted fields with a layout."""
    fits = [f for f in fitted if (f["degree"], f["sparse"]) == (layout["degree"], layout["sparse"]) and f["psnr"] is not None]
    return ", ".join(f"{f['psnr']:.1f} dB at {f['longest']}^3 ({f['title']})" for f in fits) or "not fitted"


def table(question: str, answer: dict) -> list[str]:
    """Markdown table of memory / disk, the kept shares, and a line for each fitted field."""
    heads = ["memory / disk", "bytes a cell", *(f"{n}^3" for n in RESOLUTIONS), "held-out views"]
    rows = [heads, ["---", *["---:"] * (len(heads) - 2), "---"]]
    *layouts, index = answer["kinds"]
    for layout in (*layouts, index):
        per_cell = " / ".join(f"{b:.3g}" for b in layout["per_cell"] if b) + (" (a kept node)" if layout["sparse"] else "")
        sizes = (" / ".join(format_bytes(count) for count in layout["scenes"][n] if count) for n in RESOLUTIONS)
        rows.append([layout["name"], per_cell, *sizes, "" if layout is index else quality_cell(layout, answer["fitted"])])
    shares = ", ".join(f"{100 * answer['kept'] * RESOLUTIONS[0] / n:.3g} %" for n in RESOLUTIONS)
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return [*lines, "", f"Kept near a surface: {shares} of the nodes.", *map(describe_fit, answer["fitted"])]


def describe_fit(fit: dict) -> str:
    """A line for a fitted field."""
    quality = "no held-out view" if fit["psnr"] is None else f"{fit['psnr']:.2f} dB"
    sizes = f"{format_bytes(fit['memory'])}, {format_bytes(fit['file'])} on disk, compressed"
    kind = f"{fit['longest']}^3, {'sparse' if fit['sparse'] else 'dense'} SH {fit['degree']}"
    return f"{fit['title']}: {kind}, {quality}; {fit['kept']} nodes ({100 * fit['share']:.2g} %), {sizes}"


STUDY = Study(__name__, __doc__, StorageSize, {"storage": measure_storage}, table=table)
