"""Gaussians in ``.ply``: the format of 3D Gaussian splatting, read and written, and PlayCanvas' compressed format, read.

Own reader, by :mod:`mivol.files.ply`: plyfile is under the GPL.

The format of 3D Gaussian splatting holds the pre-images of the activations, one property each. Properties are written in the
order of the authors' program: ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``, float32, with normals of 0,
``f_rest`` by colour (all of red, all of green, all of blue), and quaternions (w, x, y, z). Files are read with any order and
with more properties, which are dropped. Reading and writing again keeps every bit.

In the compressed format 256 Gaussians share a box of positions, of scales and of colours, and store steps inside the boxes. An
element ``chunk`` holds the ends of the boxes, in float32; without ends, colours lie in 0..1. An element ``vertex`` holds four
words of 32 bits a Gaussian, highest bits first: positions and logarithms of scales in 11, 10 and 11 bits; colour and opacity in
8 bits each; of the unit quaternion (w, x, y, z) the number of its largest entry in 2 bits and the other entries in 10 bits each
over -1/sqrt(2)..1/sqrt(2). An element ``sh`` holds harmonics in 8 bits over -4..4, in the order of the uncompressed file. Steps
include both ends; the inner values of harmonics are the middles of 256 bins.

Source: Kerbl et al. 2023 and the files published by the authors; PlayCanvas' documentation of the compressed format and its
open-source converter splat-transform.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.errors import MivolWarning
from mivol.files import ply
from mivol.files.source import refusal
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, complete_quaternions, logit, to_base_harmonics

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
CODES = ("red", "green", "blue")
"""Colours in the place of ``COLOURS``, as nerfstudio writes them in its mode rgb: 0 to 1, or whole numbers from 0."""
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = (0, 9, 24, 45, 72)
"""Numbers of properties ``f_rest`` in files of degree 0, 1, 2, 3, 4; degree 4 is cut to ``HIGHEST_DEGREE``."""


def parse_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """Make Gaussians from the element ``vertex`` of a file.

    Raises:
        MivolError: a missing property, or harmonics of no degree.
    """
    vertex = tables.get("vertex")
    names = () if vertex is None else vertex.dtype.names
    has_codes = COLOURS[0] not in names and set(CODES) <= set(names)
    colours = CODES if has_codes else COLOURS
    missing = [name for name in (*MEANS, *colours, "opacity", *SCALES, *ROTATION) if name not in names]
    if missing == ["scale_2"]:
        raise refusal(
            Path(path),
            "2D Gaussians (discs with two scales)",
            "3D Gaussians, with three",
            "export 3D Gaussians, or convert it to points by the program that wrote it",
        )
    if missing:
        raise refusal(
            Path(path),
            f"no property {missing[0]!r} of a vertex",
            "the properties of 3D Gaussians (x, f_dc_0, opacity, scale_0, rot_0, ...)",
            "name a file of Gaussians (a cloud of points is read by read_points)",
        )
    constant = _parse_codes(vertex) if has_codes else _stack_columns(vertex, COLOURS)
    return Gaussians(
        _stack_columns(vertex, MEANS),
        _stack_columns(vertex, SCALES),
        _stack_columns(vertex, ROTATION),
        vertex["opacity"].astype(np.float32),
        np.concatenate([constant[:, None], _parse_higher_harmonics(vertex, path)], axis=1),
    )


def _parse_codes(table: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0, (N, 3), from the properties ``CODES``; the largest whole number of a type stands for 1."""
    kind = table.dtype[CODES[0]]
    largest = np.iinfo(kind).max if kind.kind in "iu" else 1
    return to_base_harmonics(_stack_columns(table, CODES) / np.float32(largest))


def _parse_higher_harmonics(table: np.ndarray, path: str | os.PathLike) -> np.ndarray:
    """Coefficients above degree 0, (N, K - 1, 3), from the properties ``f_rest_0``, ``f_rest_1``, ...

    Raises:
        MivolError: a missing property, or a number of properties that fits no degree.
    """
    count = sum(name.startswith("f_rest_") for name in table.dtype.names)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in REST_COUNTS or any(name not in table.dtype.names for name in names):
        found = f"{count} properties f_rest"
        raise refusal(Path(path), found, f"f_rest_0, f_rest_1, ...: {REST_COUNTS} of them", "write the file again")
    if not count:
        return np.empty((len(table), 0, 3), np.float32)
    kept = (HIGHEST_DEGREE + 1) ** 2 - 1
    if count > 3 * kept:
        warnings.warn(f"{path}: harmonics of degree 4 are cut to degree {HIGHEST_DEGREE}.", MivolWarning, stacklevel=2)
    return np.swapaxes(_stack_columns(table, names).reshape(len(table), 3, count // 3), 1, 2)[:, :kept]


def write_gaussian_ply(file: BinaryIO, gaussians: Gaussians, comment: str = "") -> None:
    """Write Gaussians in the format of the authors' program, with a comment in the header unless it is empty."""
    rest = np.swapaxes(gaussians.harmonics[:, 1:], 1, 2).reshape(gaussians.count, -1)
    parts = {
        MEANS: gaussians.means,
        NORMALS: np.zeros((gaussians.count, 3)),
        COLOURS: gaussians.harmonics[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): gaussians.opacity_logits[:, None],
        SCALES: gaussians.log_scales,
        ROTATION: gaussians.quaternions,
    }
    table = np.empty(gaussians.count, [(name, "<f4") for names in parts for name in names])
    for names, values in parts.items():
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    ply.write_table(file, table, comment)


def _stack_columns(table: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    """Properties as float32 (N, len(names))."""
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


CHUNK_SIZE = 256
"""Gaussians in a box."""

POSITION_BITS = (11, 10, 11)
AXES = ("x", "y", "z")
CHANNELS = ("r", "g", "b")
PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
MAX_HARMONIC = 4.0
"""Harmonics are stored in -4..4."""


def is_compressed(tables: dict[str, np.ndarray]) -> bool:
    """Whether the tables of a ``.ply`` are in the compressed format."""
    return "chunk" in tables and "vertex" in tables and PACKED_PROPERTIES[0] in (tables["vertex"].dtype.names or ())


def parse_compressed_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """Make Gaussians from the tables of a compressed file; the opacity 255 of 255 becomes the logit inf, 0 becomes -inf.

    Raises:
        MivolError: a missing property or another type, or numbers of chunks, Gaussians and harmonics that contradict each
            other.
    """
    chunk, vertex = tables["chunk"], tables["vertex"]
    _check_compressed_tables(tables, Path(path))
    box = np.arange(len(vertex)) // CHUNK_SIZE
    steps = _unpack_bits(vertex["packed_color"], (8, 8, 8, 8))
    colours = steps[:, :3]
    if "min_r" in chunk.dtype.names:
        colours = _interpolate_in_box(chunk, CHANNELS, box, colours)
    harmonics = to_base_harmonics(colours)[:, None]
    if "sh" in tables:
        harmonics = np.concatenate([harmonics, _decode_harmonics(_parse_higher_harmonics(tables["sh"], path))], axis=1)
    scale_axes = tuple(f"scale_{axis}" for axis in AXES)
    return Gaussians(
        _interpolate_in_box(chunk, AXES, box, _unpack_bits(vertex["packed_position"], POSITION_BITS)),
        _interpolate_in_box(chunk, scale_axes, box, _unpack_bits(vertex["packed_scale"], POSITION_BITS)),
        _unpack_quaternions(vertex["packed_rotation"]),
        logit(steps[:, 3]),
        harmonics,
    )


def _check_compressed_tables(tables: dict[str, np.ndarray], path: Path) -> None:
    chunk, vertex = tables["chunk"], tables["vertex"]
    ends = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in AXES]
    if "min_r" in chunk.dtype.names:
        ends += [f"{end}_{colour}" for end in ("min", "max") for colour in CHANNELS]
    wanted = {**{("vertex", name): "u4" for name in PACKED_PROPERTIES}, **{("chunk", name): "f4" for name in ends}}
    for (element, name), kind in wanted.items():
        record = tables[element].dtype
        if name not in record.names or record[name].str[1:] != kind:
            found = f"no property {name!r} of type {np.dtype(kind).name} in {element!r}"
            raise refusal(path, found, "those of a compressed PLY of PlayCanvas", "compress it again")
    chunks = -(-len(vertex) // CHUNK_SIZE)
    if len(chunk) != chunks:
        raise refusal(path, f"{len(chunk)} chunks", f"{chunks} for {len(vertex)} Gaussians", "compress it again")
    if "sh" in tables and len(tables["sh"]) != len(vertex):
        raise refusal(path, f"{len(tables['sh'])} rows of harmonics", f"{len(vertex)}", "compress it again")


def _unpack_bits(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Fields of words, highest bits first, as steps 0..1 with both ends; (N, len(bits)), float64."""
    shifts = np.cumsum(bits[::-1])[::-1] - bits
    return np.stack([((words >> np.uint32(s)) & ((1 << b) - 1)) / ((1 << b) - 1) for s, b in zip(shifts, bits, strict=True)], 1)


def _interpolate_in_box(chunk: np.ndarray, axes: tuple[str, ...], box: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Values at ``steps`` between the ends of each Gaussian's box, (N, 3)."""
    low, high = (np.stack([chunk[f"{end}_{axis}"].astype(np.float64) for axis in axes], 1)[box] for end in ("min", "max"))
    return low * (1 - steps) + high * steps


def _unpack_quaternions(words: np.ndarray) -> np.ndarray:
    """Unit quaternions without their largest entry, which is positive; (N, 4)."""
    others = (_unpack_bits(words & np.uint32((1 << 30) - 1), (2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2)
    return complete_quaternions(others, (words >> np.uint32(30)).astype(np.int64))


def _decode_harmonics(codes: np.ndarray) -> np.ndarray:
    """Coefficients of the codes 0 to 255."""
    steps = np.where(codes == 0, 0, np.where(codes == 255, 1, (codes + 0.5) / 256))
    return (steps - 0.5) * 2 * MAX_HARMONIC
