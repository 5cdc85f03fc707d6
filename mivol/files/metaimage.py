"""MetaImage (``.mhd`` with data files, ``.mha`` in one file): ``Key = Value`` lines, then the numbers, x fastest.

Own reader: SimpleITK reads this format, but takes 264 MB.

Conventions. ``Offset`` is the centre of the first voxel. Row a of ``TransformMatrix`` is the direction of axis a and the
physical frame is LPS, both as in ITK. Channels are the fastest index.

Reference: MetaIO documentation, itk.org/Wiki/ITK/MetaIO/Documentation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_steps, split_frame, to_values, turn_frame

TYPES: dict[str, str] = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}

BOOLEANS = {"true": True, "t": True, "1": True, "yes": True, "false": False, "f": False, "0": False, "no": False}


def read_metaimage(path: Path, dataset: str | None = None) -> VolumeData:
    """Read ``.mhd`` or ``.mha``: raw, zlib or ascii data in the same file, a data file, a list or a pattern of slices.

    Raises:
        MivolError: a missing or invalid key, or sizes that do not fit the data.
    """
    refuse_dataset(path, dataset)
    keys, local = _header(source.read_bytes(path), path)
    if _integers(keys, path, "NDims", 1) != [3]:
        raise refusal(path, f"NDims {keys['NDims']}", "3", "convert it to 3D")
    size = _integers(keys, path, "DimSize", 3)
    (channels,) = _integers(keys, path, "ElementNumberOfChannels", 1, default="1")
    if min(*size, channels) < 1:
        raise refusal(path, f"DimSize {keys['DimSize']} of {channels} channels", "sizes above 0", "correct the header")
    dtype = _dtype(keys, path)
    stored = _stored(keys, local, dtype, size[0] * size[1] * size[2] * channels, path)
    values = to_values(stored.reshape(*size[::-1], channels), path)
    meta = {"path": str(path), "format": "metaimage", "dtype": str(dtype), "space": "LPS", "header": keys}
    return VolumeData(values, frame_from_steps(size, *_place(keys, path)), meta)


def write_metaimage(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write an ``.mha`` of float32 in LPS; a placement without ``metadata["space"]`` counts as LPS."""
    size = values.shape[2::-1]
    steps, origin = split_frame(size, turn_frame(to_world, metadata.get("space"), "LPS"))
    spacing = np.linalg.norm(steps, axis=0)
    keys = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": _words((steps / spacing).T.ravel()),
        "Offset": _words(origin),
        "ElementSpacing": _words(spacing),
        "DimSize": " ".join(map(str, size)),
        "ElementNumberOfChannels": str(values.shape[3]),
        "ElementType": "MET_FLOAT",
        "ElementDataFile": "LOCAL",
    }
    file.write("".join(f"{key} = {value}\n" for key, value in keys.items()).encode())
    file.write(np.ascontiguousarray(values, "<f4").data)


def _words(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _header(data: bytes, path: Path) -> tuple[dict[str, str], bytes]:
    """The keys, and the bytes after ``ElementDataFile``: names of a list, or the data."""
    keys: dict[str, str] = {}
    rest = data
    while rest:
        line, _, rest = rest.partition(b"\n")
        text = line.decode("utf-8", errors="replace").strip()
        key, equals, value = text.partition("=")
        if not equals:
            if text:
                raise refusal(path, f"the header line {text[:60]!r}", "'Key = Value'", "correct the header")
            continue
        keys[key.strip()] = value.strip()
        if key.strip() == "ElementDataFile":
            return keys, rest
    raise refusal(path, "no key ElementDataFile", "the key at the end of the header", "add it or copy the file again")


def _integers(keys: dict[str, str], path: Path, name: str, count: int, default: str | None = None) -> list[int]:
    if name not in keys and default is None:
        raise refusal(path, f"no key {name}", "the key in the MetaImage header", f"add '{name} = ...'")
    return source.parse_integers(keys.get(name, default), count, path, name)


def _floats(keys: dict[str, str], path: Path, names: tuple[str, ...], default: str) -> np.ndarray:
    """The numbers under the first existing key of ``names``, as many as in ``default``."""
    name = next((name for name in names if name in keys), names[0])
    return source.parse_reals(keys.get(name, default), len(default.split()), path, name)


def _boolean(keys: dict[str, str], path: Path, *names: str) -> bool:
    for name in names:
        if name in keys:
            if keys[name].lower() not in BOOLEANS:
                raise refusal(path, f"'{name} = {keys[name]}'", "True or False", "correct the header")
            return BOOLEANS[keys[name].lower()]
    return False


def _dtype(keys: dict[str, str], path: Path) -> np.dtype:
    name = keys.get("ElementType", "").upper()
    if name not in TYPES:
        raise refusal(path, f"ElementType '{name}'", f"one of {', '.join(TYPES)}", "convert it to MET_FLOAT first")
    big = _boolean(keys, path, "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    return np.dtype(TYPES[name]).newbyteorder(">" if big else "<")


def _stored(keys: dict[str, str], local: bytes, dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    name = keys["ElementDataFile"]
    if name.upper() == "LOCAL":
        return _unpack(local, keys, dtype, count, path)
    listed = local.decode("utf-8", errors="replace").splitlines()
    return source.read_data_files(path, name, listed, count, lambda data, n, file: _unpack(data, keys, dtype, n, file))


def _unpack(data: bytes, keys: dict[str, str], dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    (skip,) = _integers(keys, path, "HeaderSize", 1, default="0")
    if "BinaryData" in keys and not _boolean(keys, path, "BinaryData"):
        return source.parse_numbers(data, count, path)
    if _boolean(keys, path, "CompressedData"):
        data = source.decompress(data[max(skip, 0) :], "zlib", count * dtype.itemsize, path)
        skip = 0
    return source.parse_elements(data, dtype, count, path, offset=len(data) - count * dtype.itemsize if skip < 0 else skip)


def _place(keys: dict[str, str], path: Path) -> tuple[np.ndarray, np.ndarray]:
    spacing = _floats(keys, path, ("ElementSpacing", "ElementSize"), "1 1 1")
    origin = _floats(keys, path, ("Offset", "Position", "Origin"), "0 0 0")
    rows = _floats(keys, path, ("TransformMatrix", "Orientation", "Rotation"), "1 0 0 0 1 0 0 0 1")
    return rows.reshape(3, 3).T * spacing, origin
