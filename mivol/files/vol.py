"""Mitsuba's grid file ``.vol``: a header of 48 bytes, then the numbers, x fastest after the channel.

Own reader: Mitsuba's needs a variant and reads float32 only.

Layout, little endian: "VOL", version 3 (uint8), encoding (int32), voxels along x, y, z (3 int32), channels (int32), box corners
(6 float32), data. Encoding 1 is float32, the only encoding of Mitsuba 3. Mitsuba 0.6 (``gridvolume``) also defines 2 float16,
3 uint8 (0..255 for 0..1) and 4 quantised directions, which are refused. Stock ``gridvolume`` ignores the box without
``use_grid_bbox``.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_box, to_values

MAGIC = b"VOL"
VERSION = 3
HEADER = struct.Struct("<3sB5i6f")

#: encoding -> (type on disk, factor to the stored quantity).
ENCODINGS: dict[int, tuple[str, float]] = {1: ("<f4", 1.0), 2: ("<f2", 1.0), 3: ("u1", 1 / 255)}


def read_vol(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a ``.vol`` file with its box.

    Raises:
        MivolError: a truncated or too long file, another version or encoding, or sizes below 1.
    """
    refuse_dataset(path, dataset)
    data = source.read_bytes(path)
    if len(data) < HEADER.size:
        raise refusal(path, f"{len(data)} bytes", f"a header of {HEADER.size}", "the file is truncated: copy it again")
    _, version, encoding, nx, ny, nz, channels, *box = HEADER.unpack_from(data)
    if version != VERSION:
        raise refusal(path, f"version {version} of the format", "version 3", "write it again with Mitsuba 3 or mivol")
    if encoding not in ENCODINGS:
        raise refusal(path, f"encoding {encoding}", "1 (float32), 2 (float16) or 3 (uint8)", "write it again as float32")
    if min(nx, ny, nz, channels) < 1:
        raise refusal(path, f"{nx} x {ny} x {nz} voxels of {channels} channels", "at least 1 each", "write the file again")
    dtype, factor = ENCODINGS[encoding]
    stored = source.parse_elements(data, dtype, nx * ny * nz * channels, path, offset=HEADER.size)
    values = to_values(stored.reshape(nz, ny, nx, channels), path)
    if factor != 1:
        values *= np.float32(factor)
    meta = {"path": str(path), "format": "vol", "dtype": str(stored.dtype), "space": None, "encoding": encoding}
    return VolumeData(values, frame_from_box(box[:3], box[3:]), meta)


def write_vol(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write version 3 in float32. The corners of the axis-aligned box are rounded to float32.

    Raises:
        MivolError: a rotated, sheared or mirrored ``to_world``, or metadata, which the format cannot hold.
    """
    if metadata:
        raise refusal("write_volume", "metadata for a .vol file", "no metadata", "write .npz, or remove the metadata")
    sides = np.diagonal(to_world)[:3]
    if np.count_nonzero(to_world[:3, :3] - np.diag(sides)) or sides.min() <= 0:
        raise refusal(
            "write_volume",
            "a rotated, sheared or mirrored to_world for a .vol file",
            "an axis-aligned box",
            "write .npz or .nrrd, or give the transform in the scene",
        )
    low = to_world[:3, 3]
    box = np.array([low, low + sides], np.float64)
    if np.abs(box).max() > np.finfo(np.float32).max or (np.diff(box.astype(np.float32), axis=0) <= 0).any():
        raise refusal(
            "write_volume",
            f"a box from {low.tolist()} with sides {sides.tolist()} for a .vol file",
            "corners that differ in float32",
            "write .npz or .nrrd, or move the box nearer to the origin",
        )
    nz, ny, nx, channels = values.shape
    file.write(HEADER.pack(MAGIC, VERSION, 1, nx, ny, nz, channels, *box.ravel()))
    file.write(np.ascontiguousarray(values, "<f4").data)
