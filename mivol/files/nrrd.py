"""NRRD: a header of ``field: value`` lines, then the numbers, the first axis fastest, or the names of data files.

Own reader: pynrrd 1.1 does not read lists and patterns of files, line skips of compressed data, or several blanks between
numbers in text.

Conventions. Axes with a vector in ``space directions`` are x, y, z in the order of the file. Without these vectors the axes of
``kinds`` "domain" or "space" count, without ``kinds`` all three axes. One more axis at any position holds the channels.
``space origin`` is the centre of the first voxel. A line skip precedes decompression, a byte skip follows it; a byte skip of -1
reads the end of a raw file. The frame stays as in the file (``meta["space"]`` is "LPS" or "RAS" if named there).

Reference: "Definition of NRRD File Format", teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.source import refusal, refuse_dataset
from mivol.files.volume import VolumeData, frame_from_steps, split_frame, to_values

MAGIC = b"NRRD000"


def _names(dtype: str, *names: str) -> dict[str, str]:
    return dict.fromkeys(names, dtype)


#: type in the header -> NumPy type without byte order.
TYPES: dict[str, str] = {
    **_names("i1", "signed char", "int8", "int8_t"),
    **_names("u1", "uchar", "unsigned char", "uint8", "uint8_t"),
    **_names("i2", "short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    **_names("u2", "ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    **_names("i4", "int", "signed int", "int32", "int32_t"),
    **_names("u4", "uint", "unsigned int", "uint32", "uint32_t"),
    **_names("i8", "longlong", "long long", "long long int", "signed long long", "signed long long int"),
    **_names("i8", "int64", "int64_t"),
    **_names("u8", "ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    **_names("f4", "float"),
    **_names("f8", "double"),
}

#: encoding in the header -> packing of the bytes.
ENCODINGS: dict[str, str] = {
    "raw": "raw",
    "gz": "gzip",
    "gzip": "gzip",
    "bz2": "bzip2",
    "bzip2": "bzip2",
    "txt": "ascii",
    "text": "ascii",
    "ascii": "ascii",
}

SPACES: dict[str, str] = {
    "left-posterior-superior": "LPS",
    "lps": "LPS",
    "right-anterior-superior": "RAS",
    "ras": "RAS",
    "left-anterior-superior": "LAS",
    "las": "LAS",
}

SPACE_NAMES: dict[str, str] = {name: long for long, name in SPACES.items() if "-" in long}

#: spelling of a field without blank -> name of the field.
ALIASES: dict[str, str] = {
    "datafile": "data file",
    "lineskip": "line skip",
    "byteskip": "byte skip",
    "axismins": "axis mins",
    "axismaxs": "axis maxs",
    "centerings": "centers",
}


def read_nrrd(path: Path, dataset: str | None = None) -> VolumeData:
    """Read ``.nrrd`` or ``.nhdr``: raw, gzip, bzip2 or ascii data, attached or detached.

    Raises:
        MivolError: a missing or invalid field, sizes that do not fit the data, or ambiguous axes.
    """
    refuse_dataset(path, dataset)
    fields, comments, attached = _header(source.read_bytes(path), path)
    words = _field(fields, "sizes", path)
    sizes = source.parse_integers(words, max(len(words.split()), 1), path, "sizes")
    if [len(sizes)] != source.parse_integers(_field(fields, "dimension", path), 1, path, "dimension") or min(sizes) < 1:
        raise refusal(path, f"sizes {sizes}", f"{fields['dimension']} sizes above 0", "correct the header")
    dtype = _dtype(fields, path)
    stored = _stored(fields, comments, attached, dtype, math.prod(sizes), path)
    spatial, channel = _axes(fields, sizes, path)
    grid = stored.reshape(sizes[::-1]).transpose([len(sizes) - 1 - axis for axis in (*spatial[::-1], *channel)])
    size = [sizes[axis] for axis in spatial]
    steps, origin = _place(fields, spatial, size, path)
    meta = {
        "path": str(path),
        "format": "nrrd",
        "dtype": str(dtype),
        "space": SPACES.get(fields.get("space", "").lower()),
        "unit": _read_unit(fields, spatial),
        "header": fields,
    }
    return VolumeData(to_values(grid, path), frame_from_steps(size, steps, origin), meta)


def write_nrrd(file: BinaryIO, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write an attached, gzip-compressed float32 NRRD, with ``metadata`` as ``key:=value`` lines."""
    nz, ny, nx, channels = values.shape
    steps, origin = split_frame((nx, ny, nz), to_world)
    directions = [_vector(step) for step in steps.T]
    space = metadata.get("space")
    lines = [
        "NRRD0004",
        "type: float",
        f"dimension: {3 + (channels > 1)}",
        f"space: {SPACE_NAMES[space]}" if space in SPACE_NAMES else "space dimension: 3",
        "sizes: " + " ".join(map(str, ([channels] if channels > 1 else []) + [nx, ny, nz])),
        "space directions: " + " ".join((["none"] if channels > 1 else []) + directions),
        "kinds: " + " ".join((["vector"] if channels > 1 else []) + ["domain"] * 3),
        "endian: little",
        "encoding: gzip",
        f"space origin: {_vector(origin)}",
    ]
    unit = str(metadata.get("unit", "")).replace('"', "")
    if unit not in ("", "voxel", "unknown"):
        lines.append("space units:" + f' "{unit}"' * 3)
    for key, value in metadata.items():
        if key not in ("space", "unit"):
            escaped = str(value).replace("\\", "\\\\").replace("\n", "\\n")
            lines.append(f"{key}:={escaped}")
    file.write(("\n".join(lines) + "\n\n").encode("utf-8"))
    file.write(gzip.compress(np.ascontiguousarray(values, "<f4").tobytes(), 6, mtime=0))


def _vector(numbers: np.ndarray) -> str:
    return "(" + ",".join(repr(float(number)) for number in numbers) + ")"


def _header(data: bytes, path: Path) -> tuple[dict[str, str], list[str], bytes]:
    """The fields (names in lower case), the lines after ``data file: LIST``, and the bytes after the blank line."""
    end = re.search(rb"\r?\n\r?\n", data)
    head, attached = (data[: end.start()], data[end.end() :]) if end else (data, b"")
    lines = head.decode("utf-8", errors="replace").splitlines()
    fields: dict[str, str] = {}
    for number, line in enumerate(lines[1:], start=1):
        if line.startswith("#") or not line.strip():
            continue
        match = re.match(r"([^:]+):(=| ?)(.*)", line)
        if not match:
            raise refusal(path, f"the header line {line[:60]!r}", "'field: value'", "correct the header")
        name, kind, value = match.groups()
        name = name.strip() if kind == "=" else name.strip().lower()
        if kind != "=":
            fields[ALIASES.get(name, name)] = value.strip()
            if ALIASES.get(name, name) == "data file" and value.strip().upper().startswith("LIST"):
                return fields, lines[number + 1 :], b""
    return fields, [], attached


def _field(fields: dict[str, str], name: str, path: Path) -> str:
    if name not in fields:
        raise refusal(path, f"no field '{name}'", "the field in the NRRD header", f"add '{name}: ...' to the header")
    return fields[name]


def _dtype(fields: dict[str, str], path: Path) -> np.dtype:
    name = _field(fields, "type", path).lower()
    if name not in TYPES:
        raise refusal(path, f"the type '{name}'", "an integer or float type", "convert it to float first")
    dtype = np.dtype(TYPES[name])
    if dtype.itemsize == 1 or _packing(fields, path) == "ascii":
        return dtype
    endian = _field(fields, "endian", path).lower()
    if endian not in ("little", "big"):
        raise refusal(path, f"'endian: {endian}'", "little or big", "correct the header")
    return dtype.newbyteorder("<" if endian == "little" else ">")


def _packing(fields: dict[str, str], path: Path) -> str:
    name = _field(fields, "encoding", path).lower()
    if name not in ENCODINGS:
        raise refusal(path, f"the encoding '{name}'", "raw, gzip, bzip2 or ascii", "convert it to raw first")
    return ENCODINGS[name]


def _stored(fields: dict[str, str], listed: list[str], attached: bytes, dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    if "data file" not in fields:
        return _unpack(attached, fields, dtype, count, path)
    return source.read_data_files(
        path, fields["data file"], listed, count, lambda data, n, file: _unpack(data, fields, dtype, n, file)
    )


def _unpack(data: bytes, fields: dict[str, str], dtype: np.dtype, count: int, path: Path) -> np.ndarray:
    (line_skip,) = source.parse_integers(fields.get("line skip", "0"), 1, path, "line skip")
    (byte_skip,) = source.parse_integers(fields.get("byte skip", "0"), 1, path, "byte skip")
    if not 0 <= line_skip <= data.count(b"\n"):
        found = f"'line skip: {line_skip}' in a file of fewer lines"
        raise refusal(path, found, "at most the lines of the file", "correct the header")
    data = data.split(b"\n", line_skip)[-1]
    packing = _packing(fields, path)
    if packing == "ascii":
        return source.parse_numbers(data[max(byte_skip, 0) :], count, path)
    promised = count * dtype.itemsize
    if packing != "raw":
        data = source.decompress(data, packing, max(byte_skip, 0) + promised, path)
    return source.parse_elements(data, dtype, count, path, offset=len(data) - promised if byte_skip < 0 else byte_skip)


def _axes(fields: dict[str, str], sizes: list[int], path: Path) -> tuple[list[int], list[int]]:
    """Indices of the spatial axes (x, y, z) and of the channel axis, if present."""
    if "space directions" in fields:
        spatial = [axis for axis, vector in enumerate(_vectors(fields, path)) if vector is not None]
    elif "kinds" in fields:
        kinds = fields["kinds"].lower().split()
        spatial = [axis for axis, kind in enumerate(kinds) if kind in ("domain", "space", "???", "none")]
    else:
        spatial = list(range(len(sizes)))
    channel = [axis for axis in range(len(sizes)) if axis not in spatial]
    if len(spatial) != 3 or len(channel) > 1 or max(spatial) >= len(sizes):
        raise refusal(
            path,
            f"{len(sizes)} axes of which {len(spatial)} are spatial",
            "3 spatial axes and at most one of channels",
            "mark the axes with 'kinds' or 'space directions'",
        )
    return spatial, channel


def _vectors(fields: dict[str, str], path: Path) -> list[np.ndarray | None]:
    vectors = re.findall(r"none|\(([^)]*)\)", fields["space directions"])
    return [source.parse_reals(numbers, 3, path, "space directions") if numbers else None for numbers in vectors]


def _place(fields: dict[str, str], spatial: list[int], size: list[int], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps (3, 3) and the first voxel's centre (3,)."""
    origin = source.parse_reals(fields.get("space origin", "(0,0,0)").strip("() "), 3, path, "space origin")
    if "space directions" in fields:
        return np.array([vector for vector in _vectors(fields, path) if vector is not None]).T, origin
    count = max(spatial) + 1
    spacing = _per_axis(fields, "spacings", spatial, count, 1.0, path)
    low = _per_axis(fields, "axis mins", spatial, count, np.nan, path)
    if "spacings" not in fields and "axis maxs" in fields:
        spacing = (_per_axis(fields, "axis maxs", spatial, count, np.nan, path) - low) / size
    if "space origin" not in fields:
        origin = np.where(np.isnan(low), 0.0, low + spacing / 2)
    return np.diag(spacing), origin


def _read_unit(fields: dict[str, str], spatial: list[int]) -> str | None:
    """The unit of length, if it is the same along all three axes: ``space units``, or ``units`` of each axis of the file."""
    units = re.findall(r'"([^"]*)"', fields.get("space units", ""))
    if not units:
        of_axes = re.findall(r'"([^"]*)"', fields.get("units", ""))
        units = [of_axes[axis] for axis in spatial if axis < len(of_axes)]
    return units[0] if len(units) == 3 and len(set(units)) == 1 and units[0] else None


def _per_axis(fields: dict[str, str], name: str, spatial: list[int], count: int, default: float, path: Path) -> np.ndarray:
    """The numbers of the spatial axes; ``default`` for a missing field and for NaN."""
    values = source.parse_reals(fields.get(name) or "nan " * count, count, path, name)
    return np.array([default if np.isnan(values[axis]) else values[axis] for axis in spatial])
