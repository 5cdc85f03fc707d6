"""Niantic's ``.spz``, versions 2 to 4: the attributes of all Gaussians one after the other, in bytes, compressed.

Conventions. Versions 2 and 3 are one gzip stream (or its plain bytes) with a header of 16 bytes. Version 4 has a header of 32
bytes, a table of streams, and a Zstandard stream for each attribute, which needs the optional package ``zstandard``. Attributes
are positions (24 bits, fixed point), opacities, colours, scales, rotations, harmonics. Version 2 stores x, y, z of the unit
quaternion in bytes. Later versions store the three smaller entries of (x, y, z, w), 9 bits and a sign each over 0..1/sqrt(2).

Axes. The format has y up and z backwards. Files of the authors of 3D Gaussian splatting, and the Gaussians returned here, have
y down and z forwards: y and z change their signs, with the harmonics that are odd in y or z.

Source: the documentation and the open-source library of Niantic (nianticlabs/spz, MIT licence).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.npy import check_memory
from mivol.files.source import CODECS, decompress, parse_elements, read_bytes, refusal
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, complete_quaternions, logit

MAGIC = b"NGSP"
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
class Header:
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


def _parse_header(head: bytes, path: Path) -> Header:
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise refusal(path, f"first bytes {head[:8]!r}", "those of an SPZ (NGSP)", "name another file")
    _, version, count, degree, bits, flags, streams = HEAD.unpack(head)
    if version not in VERSIONS:
        raise refusal(path, f"version {version}", f"one of {VERSIONS}", "convert the file with a newer program to one of those")
    if degree > HIGHEST_DEGREE or bits > 23:
        found = f"harmonics of degree {degree} and {bits} bits behind the point"
        raise refusal(path, found, f"at most {HIGHEST_DEGREE} and 23", "write the file again")
    if flags & EXTENSIONS:
        raise refusal(path, "extensions of a vendor", "a file without", "write it again without (they may rescale harmonics)")
    return Header(version, count, degree, bits, streams)


def _split_attributes(data: bytes, header: Header, path: Path) -> list[np.ndarray]:
    """The attributes of version 2 or 3, as bytes."""
    sizes = header.sizes()
    if data.startswith(GZIP):
        data = decompress(data, "gzip", HEAD.size + sum(sizes), path)
    body = parse_elements(data, "u1", sum(sizes), path, offset=HEAD.size)
    return np.split(body, np.cumsum(sizes)[:-1])


def _unpack_streams(data: bytes, header: Header, path: Path) -> list[np.ndarray]:
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


def _decode_attributes(attributes: list[np.ndarray], header: Header) -> Gaussians:
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
