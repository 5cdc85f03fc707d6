"""Compact files of Gaussians, read and written: ``.splat`` (antimatter15), ``.ksplat`` (GaussianSplats3D), Niantic's ``.spz``.

Own readers: gaussforge 0.6 refuses sound ``.splat`` files, and accepts bytes after the end of a ``.ksplat``.

``.splat``. 32 bytes a Gaussian, no header, colours without harmonics: position and scale in float32, colour and opacity in a
byte each, the unit quaternion (w, x, y, z) as 128 + 128 q in a byte each.

``.ksplat``. A header of 4096 bytes and 1024 bytes for each section, then the sections. Level 0 stores float32. Levels 1 and 2
store positions in 16 bits around the centre of a bucket, and scales and rotations in half precision; harmonics are float32,
half precision, or bytes between two ends. Colour and opacity are bytes, quaternions (w, x, y, z). Harmonics are ordered by
degree, then by colour. Full buckets come first, with the same number of Gaussians each; a table has the counts of the other
buckets.

``.spz``, versions 2 to 4. The attributes of all Gaussians one after the other, in bytes, compressed. Versions 2 and 3 are one
gzip stream (or its plain bytes) with a header of 16 bytes. Version 4 has a header of 32 bytes, a table of streams, and a
Zstandard stream for each attribute, which needs the optional package ``zstandard``. Attributes are positions (24 bits, fixed
point), opacities, colours, scales, rotations, harmonics. Version 2 stores x, y, z of the unit quaternion in bytes. Later
versions store the three smaller entries of (x, y, z, w), 9 bits and a sign each over 0..1/sqrt(2).

Axes of ``.spz``. The format has y up and z backwards. Files of the authors of 3D Gaussian splatting, and the Gaussians
returned here, have y down and z forwards: y and z change their signs, with the harmonics that are odd in y or z.

Writers make ``.splat``, ``.ksplat`` of level 0 and ``.spz`` of version 3. Rounding is to the nearest step. What a format cannot
hold is left out with a warning: harmonics above degree 0 in ``.splat``, above degree 2 in ``.ksplat``.

Source: the open-source viewers antimatter15/splat and mkkellogg/GaussianSplats3D (MIT licence), the latter up to version 0.1;
the documentation and the open-source library of Niantic (nianticlabs/spz, MIT licence).
"""

from __future__ import annotations

import gzip
import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.errors import MivolWarning
from mivol.files.npy import check_memory
from mivol.files.source import CODECS, decompress, parse_elements, read_bytes, refusal
from mivol.points.gaussians import (
    HIGHEST_DEGREE,
    Gaussians,
    complete_quaternions,
    concatenate,
    logit,
    to_base_harmonics,
    to_log_scales,
)

HEADER_SIZE, SECTION_HEADER_SIZE = 4096, 1024
NUMBER_TYPES = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}
"""Level -> types of positions, of scales and rotations, of harmonics."""

DEFAULT_MAX_HARMONIC = 1.5
"""Limit of harmonics in bytes if the header has none."""

DEFAULT_STEPS = 32767
"""Steps of half a bucket if the header has none."""


@dataclass(frozen=True)
class Section:
    """The header of a section; counts are Gaussians, sizes are bytes."""

    count: int
    capacity: int
    bucket_capacity: int
    buckets: int
    bucket_size: float
    bucket_storage: int
    steps: int
    full: int
    partial: int
    degree: int

    def storage(self) -> int:
        """Size of the table of partly filled buckets and of the bucket centres [bytes]."""
        return 4 * self.partial + self.bucket_storage * self.buckets


def read_ksplat(path: Path) -> Gaussians:
    """Read a ``.ksplat``.

    Raises:
        MivolError: another version or level, counts that contradict each other, or a truncated file.
    """
    data = read_bytes(path)
    if len(data) < HEADER_SIZE:
        raise refusal(path, f"{len(data)} bytes", f"a header of {HEADER_SIZE}", "the file is truncated: copy it again")
    major, minor, sections, count, level = struct.unpack_from("<BB2xI8xIH", data)
    if (major, minor) != (0, 1) or level not in NUMBER_TYPES:
        found = f"version {major}.{minor}, level {level}"
        raise refusal(path, found, f"version 0.1 and a level of {tuple(NUMBER_TYPES)}", "write it again with a newer program")
    low, high = struct.unpack_from("<ff", data, 36)
    ends = (low or -DEFAULT_MAX_HARMONIC, high or DEFAULT_MAX_HARMONIC)
    at = HEADER_SIZE + SECTION_HEADER_SIZE * sections
    if at > len(data):
        raise refusal(path, f"{sections} sections in {len(data)} bytes", f"{at} bytes at least", "copy the file again")
    parts = []
    for number in range(sections):
        section = _parse_section(data, HEADER_SIZE + SECTION_HEADER_SIZE * number, path)
        record = _record_type(level, section.degree)
        end = at + section.storage() + record.itemsize * section.capacity
        if end > len(data):
            raise refusal(path, f"{len(data)} bytes", f"{end} for section {number}", "the file is truncated: copy it again")
        table = np.frombuffer(data, record, section.count, at + section.storage())
        parts.append(_decode_records(table, _parse_buckets(data, at, section, path) if level else None, ends))
        at = end
    total = sum(part.count for part in parts)
    if total != count or not parts:
        raise refusal(path, f"{total} Gaussians in {len(parts)} sections", f"{count}, from the header", "write the file again")
    return concatenate(parts)


def _parse_section(data: bytes, at: int, path: Path) -> Section:
    fields = struct.unpack_from("<IIIIfH2xI4xIIH", data, at)
    section = Section(*fields[:6], fields[6] or DEFAULT_STEPS, *fields[7:])
    wrong = (
        section.count > section.capacity or section.degree > HIGHEST_DEGREE or section.full + section.partial > section.buckets
    )
    if wrong or (section.buckets and section.bucket_storage != 12):
        found = f"{section}".removeprefix("Section")
        raise refusal(path, f"a section of {found}", "numbers that fit together", "write the file again")
    return section


def _record_type(level: int, degree: int) -> np.dtype:
    """The record of one Gaussian."""
    position, number, harmonic = NUMBER_TYPES[level]
    fields = [("mean", position, 3), ("scale", number, 3), ("quaternion", number, 4), ("colour", "u1", 3), ("opacity", "u1")]
    return np.dtype([*fields, ("harmonics", harmonic, 3 * ((degree + 1) ** 2 - 1))])


def _parse_buckets(data: bytes, at: int, section: Section, path: Path) -> tuple[np.ndarray, float, int]:
    """The centre of each Gaussian's bucket (N, 3), the length of a step, and the number of steps of half a bucket."""
    partial = np.frombuffer(data, "<u4", section.partial, at)
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, at + 4 * section.partial).reshape(-1, 3)
    bucket_counts = np.concatenate([np.full(section.full, section.bucket_capacity, np.uint64), partial.astype(np.uint64)])
    if bucket_counts.sum(dtype=object) != section.count:
        found = f"{bucket_counts.sum(dtype=object)} Gaussians in buckets"
        raise refusal(path, found, f"{section.count}, from the section", "write the file again")
    return (
        centres[np.repeat(np.arange(len(bucket_counts)), bucket_counts.astype(np.int64))],
        section.bucket_size / 2 / section.steps,
        section.steps,
    )


def _decode_records(table: np.ndarray, offsets: tuple[np.ndarray, float, int] | None, ends: tuple[float, float]) -> Gaussians:
    means = table["mean"].astype(np.float64)
    if offsets is not None:
        centres, step, middle = offsets
        means = (means - middle) * step + centres
    constant = to_base_harmonics(table["colour"] / 255)[:, None]
    return Gaussians(
        means,
        to_log_scales(table["scale"]),
        table["quaternion"],
        logit(table["opacity"] / 255),
        np.concatenate([constant, _decode_harmonics(table["harmonics"], ends)], axis=1),
    )


def _decode_harmonics(stored: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """Coefficients above degree 0, (N, K - 1, 3); the file orders them by degree, then by colour."""
    values = stored.astype(np.float64)
    if stored.dtype == np.uint8:
        values = ends[0] + values / 255 * (ends[1] - ends[0])
    bands, at = [np.empty((len(values), 0, 3))], 0
    while at < values.shape[1]:
        width = 2 * len(bands) + 1
        bands.append(np.swapaxes(values[:, at : at + 3 * width].reshape(-1, 3, width), 1, 2))
        at += 3 * width
    return np.concatenate(bands, axis=1)


RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 3), ("opacity", "u1"), ("quaternion", "u1", 4)])


def read_splat(path: Path) -> Gaussians:
    """Read a ``.splat``.

    Raises:
        MivolError: a size that is not a multiple of 32 bytes.
    """
    data = read_bytes(path)
    if len(data) % RECORD.itemsize:
        raise refusal(path, f"{len(data)} bytes", f"a multiple of {RECORD.itemsize}", "the file is truncated: copy it again")
    table = np.frombuffer(data, RECORD)
    return Gaussians(
        table["mean"],
        to_log_scales(table["scale"]),
        table["quaternion"] / 128 - 1,
        logit(table["opacity"] / 255),
        to_base_harmonics(table["colour"] / 255)[:, None],
    )


SPZ_MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HEAD = struct.Struct("<4sIIBBBB")
STREAM = struct.Struct("<QQ")
VERSIONS = (2, 3, 4)
EXTENSIONS = 2
"""Flag of vendor extensions, which may change the meaning of numbers."""

COLOUR_SCALE = 0.15
"""Colours are stored as 0.5 + 0.15 k, with k the coefficient of degree 0."""

PARITY = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
"""Sign of each basis function of the harmonics, degrees 0 to 3, under the half turn (x, y, z) to (x, -y, -z)."""


@dataclass(frozen=True)
class SpzHeader:
    """The header of a file."""

    version: int
    count: int
    degree: int
    fraction_bits: int
    streams: int

    def sizes(self) -> list[int]:
        """Size of each attribute [bytes]."""
        rotation = 3 if self.version == 2 else 4
        return [self.count * n for n in (9, 1, 3, 3, rotation, 3 * ((self.degree + 1) ** 2 - 1))]


def read_spz(path: Path) -> Gaussians:
    """Read a file.

    Raises:
        MivolError: another format or version, extensions, sizes that contradict each other or exceed the memory, a damaged
            stream, or version 4 without ``zstandard``.
    """
    data = read_bytes(path)
    head = _read_header_bytes(data, path)
    header = _parse_header(head, path)
    check_memory(path, sum(header.sizes()))
    attributes = _unpack_streams(data, header, path) if header.version == 4 else _split_attributes(data, header, path)
    return _decode_attributes(attributes, header)


def _read_header_bytes(data: bytes, path: Path) -> bytes:
    """The first bytes, decompressed if necessary."""
    if not data.startswith(GZIP):
        return data[: HEAD.size]
    try:
        return CODECS["gzip"]().decompress(data, HEAD.size)
    except zlib.error as error:
        raise refusal(path, f"damaged gzip data ({error})", "a sound stream", "copy the file again") from error


def _parse_header(head: bytes, path: Path) -> SpzHeader:
    if len(head) < HEAD.size or not head.startswith(SPZ_MAGIC):
        raise refusal(path, f"first bytes {head[:8]!r}", "those of an SPZ (NGSP)", "name another file")
    _, version, count, degree, bits, flags, streams = HEAD.unpack(head)
    if version not in VERSIONS:
        raise refusal(path, f"version {version}", f"one of {VERSIONS}", "convert the file with a newer program to one of those")
    if degree > HIGHEST_DEGREE or bits > 23:
        found = f"harmonics of degree {degree} and {bits} bits behind the point"
        raise refusal(path, found, f"at most {HIGHEST_DEGREE} and 23", "write the file again")
    if flags & EXTENSIONS:
        raise refusal(path, "extensions of a vendor", "a file without", "write it again without (they may rescale harmonics)")
    return SpzHeader(version, count, degree, bits, streams)


def _split_attributes(data: bytes, header: SpzHeader, path: Path) -> list[np.ndarray]:
    """The attributes of version 2 or 3, as bytes."""
    sizes = header.sizes()
    if data.startswith(GZIP):
        data = decompress(data, "gzip", HEAD.size + sum(sizes), path)
    body = parse_elements(data, "u1", sum(sizes), path, offset=HEAD.size)
    return np.split(body, np.cumsum(sizes)[:-1])


def _unpack_streams(data: bytes, header: SpzHeader, path: Path) -> list[np.ndarray]:
    """The attributes of version 4, as bytes."""
    sizes = header.sizes() if header.degree else header.sizes()[:-1]
    table = int.from_bytes(data[HEAD.size : HEAD.size + 4], "little")
    if header.streams != len(sizes) or table + STREAM.size * len(sizes) > len(data) or table < 2 * HEAD.size:
        found = f"{header.streams} streams listed at byte {table} of {len(data)}"
        raise refusal(path, found, f"{len(sizes)} streams and their list", "copy or write the file again")
    at, attributes = table + STREAM.size * len(sizes), []
    for number, size in enumerate(sizes):
        packed, unpacked = STREAM.unpack_from(data, table + STREAM.size * number)
        if unpacked != size or packed > len(data) - at:
            found = f"stream {number} of {packed} bytes, {unpacked} unpacked"
            raise refusal(path, found, f"{size} unpacked, of {len(data) - at} that are left", "copy or write the file again")
        attributes.append(parse_elements(_decompress_stream(data[at : at + packed], size, path), "u1", size, path))
        at += packed
    return attributes if header.degree else [*attributes, np.empty(0, np.uint8)]


def _decompress_stream(data: bytes, size: int, path: Path) -> bytes:
    """Decompress a Zstandard stream to at most ``size + 1`` bytes; the extra byte reveals excess data."""
    try:
        import zstandard
    except ImportError as error:
        way_out = f'pip install "mivol[points]" for zstandard, which cannot be imported ({error})'
        raise refusal(path, "version 4", "version 2 or 3", way_out) from error
    try:
        return zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data).read(size + 1)
    except zstandard.ZstdError as error:
        raise refusal(path, f"a damaged Zstandard stream ({error})", "a sound one", "copy the file again") from error


def _decode_attributes(attributes: list[np.ndarray], header: SpzHeader) -> Gaussians:
    positions, opacities, colours, scales, rotations, harmonics = (a.reshape(header.count, -1) for a in attributes)
    above = (harmonics.reshape(header.count, -1, 3) - 128.0) / 128
    constant = (colours / 255 - 0.5) / COLOUR_SCALE
    all_harmonics = np.concatenate([constant[:, None], above], axis=1)
    quaternions = (_decode_first_three if header.version == 2 else _decode_smallest_three)(rotations)
    return Gaussians(
        _decode_fixed_point(positions) / 2.0**header.fraction_bits * [1, -1, -1],
        scales / 16 - 10,
        quaternions * [1, 1, -1, -1],
        logit(opacities[:, 0] / 255),
        all_harmonics * PARITY[: all_harmonics.shape[1], None],
    )


def _decode_fixed_point(codes: np.ndarray) -> np.ndarray:
    """Signed integers of 24 bits, lowest byte first; (N, 9) to (N, 3)."""
    low, middle, high = np.moveaxis(codes.reshape(len(codes), 3, 3).astype(np.int32), 2, 0)
    return low | middle << 8 | (high ^ 0x80) - 0x80 << 16


def _decode_first_three(codes: np.ndarray) -> np.ndarray:
    """(w, x, y, z) from x, y, z in bytes, with w of at least 0."""
    return complete_quaternions(codes / 127.5 - 1, np.zeros(len(codes), np.int64))


def _decode_smallest_three(codes: np.ndarray) -> np.ndarray:
    """(w, x, y, z) from a word with the number of the largest of (x, y, z, w) and the other entries."""
    words = np.ascontiguousarray(codes).view("<u4")[:, 0]
    fields = np.stack([(words >> np.uint32(shift)) & 1023 for shift in (20, 10, 0)], axis=1)
    others = np.where(fields >> 9, -1, 1) * (fields & 511) / 511 * np.sqrt(0.5)
    return np.roll(complete_quaternions(others, (words >> np.uint32(30)).astype(np.int64)), 1, axis=1)


# -- Writers ----------------------------------------------------------------------------------------------------------------


FRACTION_BITS = 12
"""Bits behind the point of a position in ``.spz``, unless coordinates are large."""

HIGHEST_KSPLAT = 2
"""Highest degree of harmonics in a ``.ksplat``."""


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _unit(gaussians: Gaussians) -> np.ndarray:
    """Unit quaternions (N, 4), (w, x, y, z)."""
    return gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)


def _leave_out(gaussians: Gaussians, degree: int, suffix: str) -> Gaussians:
    """The Gaussians with harmonics up to a degree; a warning if that leaves some out."""
    if gaussians.degree <= degree:
        return gaussians
    text = f"a {suffix} holds harmonics up to degree {degree}: the higher ones, up to degree {gaussians.degree}, are left out."
    warnings.warn(text, MivolWarning, stacklevel=4)
    return gaussians.with_degree(degree)


def write_splat(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write a ``.splat``."""
    plain = _leave_out(gaussians, 0, ".splat")
    table = np.empty(plain.count, RECORD)
    table["mean"], table["scale"] = plain.means, plain.scales()
    table["colour"], table["opacity"] = _to_bytes(255 * plain.base_colours()), _to_bytes(255 * plain.opacities())
    table["quaternion"] = _to_bytes(128 + 128 * _unit(plain))
    file.write(table.tobytes())


def write_ksplat(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write a ``.ksplat`` of one section with float32 numbers; colours and opacities have 8 bits."""
    kept = _leave_out(gaussians, HIGHEST_KSPLAT, ".ksplat")
    count, higher = kept.count, 3 * ((kept.degree + 1) ** 2 - 1)
    fields = [("mean", "<f4", 3), ("scale", "<f4", 3), ("quaternion", "<f4", 4), ("colour", "u1", 3), ("opacity", "u1")]
    record = np.dtype([*fields, ("harmonics", "<f4", higher)])
    table = np.empty(count, record)
    table["mean"], table["scale"], table["quaternion"] = kept.means, kept.scales(), _unit(kept)
    table["colour"], table["opacity"] = _to_bytes(255 * kept.base_colours()), _to_bytes(255 * kept.opacities())
    bands = [kept.harmonics[:, d * d : (d + 1) ** 2] for d in range(1, kept.degree + 1)]
    rows = [np.swapaxes(band, 1, 2).reshape(count, -1) for band in bands]
    table["harmonics"] = np.concatenate([np.empty((count, 0), np.float32), *rows], axis=1)
    header, section = bytearray(HEADER_SIZE), bytearray(SECTION_HEADER_SIZE)
    struct.pack_into("<BB2xIIIIH", header, 0, 0, 1, 1, 1, count, count, 0)
    struct.pack_into("<IIIIfH2xIIIIH", section, 0, count, count, 0, 0, 0.0, 0, 0, table.nbytes, 0, 0, kept.degree)
    file.write(bytes(header) + bytes(section) + table.tobytes())


def write_spz(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write an ``.spz`` of version 3.

    Raises:
        MivolError: coordinates beyond 2^23.
    """
    largest = float(np.abs(gaussians.means).max(initial=0))
    if largest >= 1 << 23:
        raise refusal("an .spz", f"coordinates up to {largest:.3g}", "less than 2^23", "scale the scene, or write a .ply")
    bits = min(FRACTION_BITS, int(np.floor(np.log2(((1 << 23) - 1) / max(largest, 1e-6)))))
    fixed = np.round(gaussians.means.astype(np.float64) * [1, -1, -1] * 2.0**bits).astype(np.int32)
    positions = np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16 & 255], axis=2).astype(np.uint8)
    harmonics = gaussians.harmonics * PARITY[: gaussians.harmonics.shape[1], None]
    attributes = [
        positions,
        _to_bytes(255 * gaussians.opacities()),
        _to_bytes(255 * (0.5 + COLOUR_SCALE * harmonics[:, 0])),
        _to_bytes(16 * (gaussians.log_scales + 10)),
        _pack_smallest_three(_unit(gaussians) * [1, 1, -1, -1]),
        _to_bytes(128 + 128 * harmonics[:, 1:]),
    ]
    head = HEAD.pack(SPZ_MAGIC, 3, gaussians.count, gaussians.degree, bits, 0, 0)
    # No time in the header: the same Gaussians give the same file.
    file.write(gzip.compress(head + b"".join(array.tobytes() for array in attributes), mtime=0))


def _pack_smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """Words (N,) of unit quaternions (w, x, y, z): see :mod:`mivol.points.compact_files`."""
    entries = np.roll(quaternions, -1, axis=1)
    largest = np.argmax(np.abs(entries), axis=1)
    rows = np.arange(len(entries))
    entries = entries * np.where(entries[rows, largest] < 0, -1, 1)[:, None]
    others = entries[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = np.round(np.abs(others) * np.sqrt(2) * 511).astype(np.uint32)
    codes = np.minimum(codes, 511) | (others < 0).astype(np.uint32) << 9
    word = largest.astype(np.uint32) << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]
    return word.astype("<u4")
