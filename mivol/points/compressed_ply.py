"""PlayCanvas' compressed ``.ply``: 256 Gaussians share a box of positions, of scales and of colours, and store steps in it.

Conventions. An element ``chunk`` holds the ends of the boxes, in float32; colours may lie in 0..1 without ends. An element
``vertex`` holds four words of 32 bits a Gaussian, highest bits first: positions and logarithms of scales in 11, 10 and 11 bits;
colour and opacity in 8 bits each; of the unit quaternion (w, x, y, z) the number of its largest entry in 2 bits and the others
in 10 bits each over -1/sqrt(2)..1/sqrt(2). An element ``sh`` holds harmonics in 8 bits over -4..4, in the order of the
uncompressed file. All steps are ends included, but for harmonics, whose inner values stand for the middles of 256 bins.

Source: PlayCanvas' documentation of the format and its open-source converter splat-transform.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mivol.files.source import refusal
from mivol.points.byte_codes import completed, harmonics_of_colours
from mivol.points.gaussian_ply import rest_of_columns
from mivol.points.gaussians import Gaussians, logit

__all__ = ["gaussians_of_compressed_tables", "is_compressed"]

CHUNK = 256
"""Gaussians that share a box."""

POSITION_BITS = (11, 10, 11)
AXES = ("x", "y", "z")
COLOURS = ("r", "g", "b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
WIDEST_HARMONIC = 4.0
"""Harmonics are stored in -4..4."""


def is_compressed(tables: dict[str, np.ndarray]) -> bool:
    """Whether tables of a ``.ply`` are of this kind."""
    return "chunk" in tables and "vertex" in tables and PACKED[0] in (tables["vertex"].dtype.names or ())


def gaussians_of_compressed_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """The Gaussians of such tables; the opacity 255 of 255 becomes the logit inf, 0 becomes -inf.

    Raises:
        MivolError: a property is missing or of another type, or numbers of chunks, Gaussians and harmonics that contradict
            each other.
    """
    chunk, vertex = tables["chunk"], tables["vertex"]
    _check(tables, Path(path))
    box = np.arange(len(vertex)) // CHUNK
    steps = _unpacked(vertex["packed_color"], (8, 8, 8, 8))
    colours = steps[:, :3]
    if "min_r" in chunk.dtype.names:
        colours = _between(chunk, COLOURS, box, colours)
    harmonics = harmonics_of_colours(colours)[:, None]
    if "sh" in tables:
        harmonics = np.concatenate([harmonics, _harmonics(rest_of_columns(tables["sh"], path))], axis=1)
    scale_axes = tuple(f"scale_{axis}" for axis in AXES)
    return Gaussians(
        _between(chunk, AXES, box, _unpacked(vertex["packed_position"], POSITION_BITS)),
        _between(chunk, scale_axes, box, _unpacked(vertex["packed_scale"], POSITION_BITS)),
        _quaternions(vertex["packed_rotation"]),
        logit(steps[:, 3]),
        harmonics,
    )


def _check(tables: dict[str, np.ndarray], path: Path) -> None:
    chunk, vertex = tables["chunk"], tables["vertex"]
    ends = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in AXES]
    if "min_r" in chunk.dtype.names:
        ends += [f"{end}_{colour}" for end in ("min", "max") for colour in COLOURS]
    wanted = {**{("vertex", name): "u4" for name in PACKED}, **{("chunk", name): "f4" for name in ends}}
    for (element, name), kind in wanted.items():
        held = tables[element].dtype
        if name not in held.names or held[name].str[1:] != kind:
            found = f"no property {name!r} of type {np.dtype(kind).name} in {element!r}"
            raise refusal(path, found, "those of a compressed PLY of PlayCanvas", "compress it again")
    chunks = -(-len(vertex) // CHUNK)
    if len(chunk) != chunks:
        raise refusal(path, f"{len(chunk)} chunks", f"{chunks} for {len(vertex)} Gaussians", "compress it again")
    if "sh" in tables and len(tables["sh"]) != len(vertex):
        raise refusal(path, f"{len(tables['sh'])} rows of harmonics", f"{len(vertex)}", "compress it again")


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Fields of words, highest first, as steps 0..1 with both ends; (N, len(bits)), float64."""
    shifts = np.cumsum(bits[::-1])[::-1] - bits
    return np.stack([((words >> np.uint32(s)) & ((1 << b) - 1)) / ((1 << b) - 1) for s, b in zip(shifts, bits, strict=True)], 1)


def _between(chunk: np.ndarray, axes: tuple[str, ...], box: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Numbers at ``steps`` between the ends of each Gaussian's box, (N, 3)."""
    low, high = (np.stack([chunk[f"{end}_{axis}"].astype(np.float64) for axis in axes], 1)[box] for end in ("min", "max"))
    return low * (1 - steps) + high * steps


def _quaternions(words: np.ndarray) -> np.ndarray:
    """Unit quaternions of which the largest entry, here positive, was left out; (N, 4)."""
    others = (_unpacked(words & np.uint32((1 << 30) - 1), (2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2)
    return completed(others, (words >> np.uint32(30)).astype(np.int64))


def _harmonics(codes: np.ndarray) -> np.ndarray:
    """Coefficients of the codes 0 to 255."""
    steps = np.where(codes == 0, 0, np.where(codes == 255, 1, (codes + 0.5) / 256))
    return (steps - 0.5) * 2 * WIDEST_HARMONIC
