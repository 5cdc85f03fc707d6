"""What does a scene cost on a grid: how many bytes for each cell and for the scene, from 128^3 to 1024^3 cells?

    mivol bench storage [--kept 0.1] [--runs runs/still_life runs/chair ...]

The count of the lecture is 4 bytes for each cell, 8 bits each for r, g, b and density: 4 GiB at 1024^3, with one colour for all
directions. Beside it: four numbers of 32 bits (16 on disk), harmonics of degree 0 to 3 on a dense grid, and the same with only
the nodes near the surface of a ball. ``--kept`` is the share of these nodes at 128^3; the share of a surface halves with each
doubling of the resolution. Fields of 64^3 nodes are made and written; their bytes for each node, in memory and on disk before
compression, give the bytes of larger scenes. The index of the walk is measured at two resolutions: a part of the index grows
with all nodes, the rest with the kept nodes.

Quality is the held-out PSNR of runs (``mivol optimize`` on photographs writes field.npz and run.json), with the real memory of
their fields.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
import numpy as np

from mivol.bench.harness.study import Size, Study, amount
from mivol.errors import MivolError
from mivol.fields.field_files import read_grid, write_field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells

RESOLUTIONS, DEGREES = (128, 256, 512, 1024), (0, 1, 2, 3)
RES = 64
"""Nodes along an edge of the measured fields."""


@dataclass(frozen=True)
class StorageSize(Size):
    """Options."""

    kept: float = amount(0.1, doc="share of the nodes that a sparse field keeps at 128^3")
    runs: tuple[Path, ...] = amount((), doc="run folders of fits of photographs", kind=Path)


# -- Measurement ------------------------------------------------------------------------------------------------------------


def make_field(res: int, degree: int, share: float | None) -> SphericalGrid:
    """A field of density 1; ``share``: of the nodes, the nearest to the surface of a ball, are kept; None: dense."""
    axis = (np.arange(res) + 0.5) / res - 0.5
    distance = np.abs(np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) - 0.35)
    keep = None if share is None else distance < np.quantile(distance, min(share, 1.0))
    return SphericalGrid.from_dense(np.ones((res,) * 3), np.full((*(res,) * 3, (degree + 1) ** 2, 3), 0.5), np.eye(4), keep)


def file_bytes(field: SphericalGrid) -> int:
    """Bytes of the values of a written field, and of its list of nodes, before compression."""
    with TemporaryDirectory() as folder:
        write_field(Path(folder) / "field.npz", field)
        with np.load(Path(folder) / "field.npz", allow_pickle=False) as stored:
            return sum(stored[name].nbytes for name in ("density", "sh", "nodes") if name in stored)


def index_bytes(field: SphericalGrid) -> int:
    """Memory of the index of the walk."""
    cells = find_occupied_cells(field)
    return field.sparse_index().bytes + cells.index.bytes + 4 * (dr.width(cells.corners) + dr.width(cells.rows))


def count_kept(field: SphericalGrid) -> int:
    """Number of kept nodes; a sparse field has a row of vacuum besides."""
    return field.rows - (field.nodes is not None)


def describe_kind(name: str, per_cell: tuple, cells: dict[int, float], degree: int | None = None, sparse: bool = False) -> dict:
    """A way to store a scene: bytes (memory, disk) of a cell or kept node, and of scenes by resolution."""
    scenes = {n: tuple(round(each * count) for each in per_cell) for n, count in cells.items()}
    return {"name": name, "per_cell": per_cell, "scenes": scenes, "degree": degree, "sparse": sparse}


def measure_storage(size: StorageSize) -> dict:
    """What does a scene cost in memory and on disk, for each layout and resolution?"""
    if not 0 < size.kept <= 1:
        raise MivolError(f"--kept {size.kept:g} is no share: give a number above 0 and at most 1.")
    fitted = [read_run(folder) for folder in size.runs]
    cells = {n: n**3 for n in RESOLUTIONS}
    near = {n: size.kept * RESOLUTIONS[0] / n * n**3 for n in RESOLUTIONS}
    kinds = [describe_kind("dense rgba, 8 bits (the lecture's)", (4, 4), cells), describe_kind("dense rgba", (16, 8), cells)]
    share = size.kept * RESOLUTIONS[0] / RES
    for kind, counts, kept in (("dense", cells, None), ("sparse", near, share)):
        for degree in DEGREES:
            field = make_field(RES, degree, kept)
            each = tuple(count / count_kept(field) for count in (field.bytes, file_bytes(field)))
            kinds.append(describe_kind(f"{kind} SH {degree}", each, counts, degree, kept is not None))
    # Shells of one thickness in voxels: index_bytes = a (all nodes) + b (kept nodes).
    fields = [make_field(res, 0, size.kept * RESOLUTIONS[0] / res) for res in (RES, 2 * RES)]
    a, b = np.linalg.solve([[f.node_count, count_kept(f)] for f in fields], [index_bytes(f) for f in fields])
    totals = {n: a * cells[n] + b * near[n] for n in RESOLUTIONS}
    index = describe_kind("beside it: the walk's index", (1.0, 0), totals)
    kinds.append(index | {"per_cell": (totals[RESOLUTIONS[0]] / cells[RESOLUTIONS[0]], 0)})
    return {"kept": size.kept, "kinds": kinds, "fitted": fitted}


def read_run(folder: Path) -> dict:
    """Memory [bytes], size of the file [bytes] and quality [dB] of the field of a run folder.

    Raises:
        MivolError: the folder holds no fit.
    """
    missing = [name for name in ("run.json", "field.npz") if not (folder / name).is_file()]
    if missing:
        raise MivolError(f"{folder} has no {' and no '.join(missing)}; give folders of fits to photographs.")
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    field = read_grid(folder / "field.npz")
    return {
        "title": record["title"],
        "longest": max(field.res),
        "degree": field.degree,
        "sparse": field.nodes is not None,
        "kept": count_kept(field),
        "share": count_kept(field) / math.prod(field.res),
        "memory": field.bytes,
        "file": (folder / "field.npz").stat().st_size,
        "psnr": record["results"].get("held_out_psnr"),
    }


# -- Table ------------------------------------------------------------------------------------------------------------------


def format_bytes(count: float) -> str:
    """Bytes with three digits and a unit."""
    units = ("B", "KiB", "MiB", "GiB", "TiB")
    power = min(int(math.log(max(count, 1), 1024)), len(units) - 1)
    return f"{count / 1024**power:.3g} {units[power]}"


def table(question: str, answer: dict) -> list[str]:
    """Markdown table of memory / disk, and a line for each fitted field."""
    heads = ["memory / disk", "bytes a cell", *(f"{n}^3" for n in RESOLUTIONS)]
    rows = [heads, ["---", *["---:"] * (len(heads) - 1)]]
    for kind in answer["kinds"]:
        per_cell = " / ".join(f"{b:.3g}" for b in kind["per_cell"] if b) + (" (a kept node)" if kind["sparse"] else "")
        rows.append(
            [kind["name"], per_cell, *(" / ".join(format_bytes(b) for b in kind["scenes"][n] if b) for n in RESOLUTIONS)]
        )
    return ["| " + " | ".join(row) + " |" for row in rows] + ["", *map(describe_fit, answer["fitted"])]


def describe_fit(fit: dict) -> str:
    """A line for a fitted field."""
    quality = "no held-out view" if fit["psnr"] is None else f"{fit['psnr']:.2f} dB"
    sizes = f"{format_bytes(fit['memory'])}, {format_bytes(fit['file'])} on disk, compressed"
    kind = f"{fit['longest']}^3, {'sparse' if fit['sparse'] else 'dense'} SH {fit['degree']}"
    return f"{fit['title']}: {kind}, {quality}; {fit['kept']} nodes ({100 * fit['share']:.2g} %), {sizes}"


STUDY = Study(__name__, __doc__, StorageSize, {"storage": measure_storage}, table=table)
