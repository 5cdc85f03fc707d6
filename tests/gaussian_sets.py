"""Gaussians for tests, and encoders of their files that share no line with mivol's readers."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Iterable

import numpy as np

from mivol.points.gaussians import Gaussians

AXES = "xyz"


def random_gaussians(count: int, degree: int, seed: int = 1) -> Gaussians:
    """Gaussians with nothing special about them."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)),
        rng.uniform(-5, -2, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=count),
        rng.uniform(-0.5, 0.5, (count, (degree + 1) ** 2, 3)),
    )


def ply_bytes(
    elements: Iterable[tuple[str, int, list[tuple[str, str]]]], body: bytes, form: str = "binary_little_endian"
) -> bytes:
    """A file of these elements: (name, count, [(type, property)])."""
    lines = ["ply", f"format {form} 1.0", "comment of a test"]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {one}" for kind, one in properties)]
    return "\n".join([*lines, "end_header", ""]).encode() + body


def inria_properties(degree: int) -> list[str]:
    """The order of the authors' program, as their files have it."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"),
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def inria_row(one: Gaussians, index: int) -> dict[str, float]:
    """What the properties of one Gaussian are, one after the other."""
    row = dict.fromkeys(inria_properties(one.degree), 0.0)
    for axis in range(3):
        row[AXES[axis]] = float(one.means[index, axis])
        row[f"scale_{axis}"] = float(one.log_scales[index, axis])
        row[f"f_dc_{axis}"] = float(one.harmonics[index, 0, axis])
    above = one.harmonics.shape[1] - 1
    for colour in range(3):
        for k in range(above):
            row[f"f_rest_{colour * above + k}"] = float(one.harmonics[index, 1 + k, colour])
    for entry in range(4):
        row[f"rot_{entry}"] = float(one.quaternions[index, entry])
    row["opacity"] = float(one.opacity_logits[index])
    return row


def inria_bytes(one: Gaussians) -> bytes:
    """The file that the authors' program would write."""
    names = inria_properties(one.degree)
    rows = [inria_row(one, index) for index in range(one.count)]
    body = b"".join(struct.pack(f"<{len(names)}f", *(row[name] for name in names)) for row in rows)
    return ply_bytes([("vertex", one.count, [("float", name) for name in names])], body)


def compressed_bytes(one: Gaussians) -> bytes:
    """PlayCanvas' compressed file: one Gaussian at a time, in boxes of 256 that their numbers fill."""
    colours = 0.5 + 0.28209479177387814 * one.harmonics[:, 0].astype(np.float64)
    chunks, rows, harmonics = [], [], b""
    for start in range(0, one.count, 256):
        part = slice(start, min(start + 256, one.count))
        ends = [(a[part].min(axis=0), a[part].max(axis=0)) for a in (one.means, one.log_scales, colours)]
        chunks.append(struct.pack("<18f", *(float(v) for low, high in ends for v in (*low, *high))))
        rows += [_compressed_row(one, colours, index, ends) for index in range(part.start, part.stop)]
    for index in range(one.count):
        for code in np.clip(np.floor((one.harmonics[index, 1:].T.ravel() / 8 + 0.5) * 256), 0, 255):
            harmonics += struct.pack("B", int(code))
    box = [("float", f"{end}_{what}{axis}") for what in ("", "scale_") for end in ("min", "max") for axis in AXES]
    box += [("float", f"{end}_{colour}") for end in ("min", "max") for colour in "rgb"]
    packed = [("uint", f"packed_{name}") for name in ("position", "rotation", "scale", "color")]
    elements = [("chunk", len(chunks), box), ("vertex", one.count, packed)]
    if one.degree:
        above = 3 * (one.harmonics.shape[1] - 1)
        elements.append(("sh", one.count, [("uchar", f"f_rest_{i}") for i in range(above)]))
    return ply_bytes(elements, b"".join(chunks) + b"".join(rows) + harmonics)


def _compressed_row(one: Gaussians, colours: np.ndarray, index: int, ends: list[tuple[np.ndarray, np.ndarray]]) -> bytes:
    def word(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> int:
        x, y, z = ((v - a) / max(b - a, 1e-30) for v, a, b in zip(values, low, high, strict=True))
        return round(float(x) * 2047) << 21 | round(float(y) * 1023) << 11 | round(float(z) * 2047)

    q = one.quaternions[index].astype(np.float64) / np.linalg.norm(one.quaternions[index].astype(np.float64))
    largest = int(np.argmax(np.abs(q)))
    rotation = largest
    for entry in range(4):
        if entry != largest:
            rotation = rotation << 10 | round((q[entry] * np.sign(q[largest]) / np.sqrt(2) + 0.5) * 1023)
    (low, high), opacity = ends[2], 1 / (1 + np.exp(-float(one.opacity_logits[index])))
    colour = 0
    for c in range(3):
        colour = colour << 8 | round(float((colours[index, c] - low[c]) / max(high[c] - low[c], 1e-30)) * 255)
    position, scale = word(one.means[index], *ends[0]), word(one.log_scales[index], *ends[1])
    return struct.pack("<4I", position, rotation, scale, colour << 8 | round(opacity * 255))


# -- Niantic's file -----------------------------------------------------------------------------------------------

PARITY_OF_A_HALF_TURN = "+ --+ -++-+ -+--+-+".replace(" ", "")
"""Signs of the harmonics of degree 0 to 3 under (x, y, z) to (x, -y, -z): - where y and z stand with odd powers together."""


def spz_streams(one: Gaussians, version: int) -> list[bytes]:
    """The six attributes, one number at a time, with y and z turned round."""
    streams: list[bytes] = [b""] * 6
    for index in range(one.count):
        for value, sign in zip(one.means[index], (1, -1, -1), strict=True):
            streams[0] += round(sign * float(value) * 4096).to_bytes(4, "little", signed=True)[:3]
        streams[1] += bytes([round(255 / (1 + np.exp(-float(one.opacity_logits[index]))))])
        streams[2] += bytes(round(min(max((0.5 + 0.15 * float(k)) * 255, 0), 255)) for k in one.harmonics[index, 0])
        streams[3] += bytes(round((float(s) + 10) * 16) for s in one.log_scales[index])
        w, x, y, z = one.quaternions[index].astype(np.float64) / np.linalg.norm(one.quaternions[index].astype(np.float64))
        streams[4] += _spz_rotation((x, -y, -z, w), version)
        for k in range(1, one.harmonics.shape[1]):
            sign = 1 if PARITY_OF_A_HALF_TURN[k] == "+" else -1
            streams[5] += bytes(round(sign * float(value) * 128) + 128 for value in one.harmonics[index, k])
    return streams


def _spz_rotation(q: tuple[float, ...], version: int) -> bytes:
    if version == 2:
        return bytes(round((v if q[3] >= 0 else -v) * 127.5 + 127.5) for v in q[:3])
    largest = max(range(4), key=lambda i: abs(q[i]))
    word = largest
    for i in range(4):
        if i != largest:
            is_negative = (q[i] < 0) != (q[largest] < 0)
            word = word << 10 | is_negative << 9 | round(abs(q[i]) * np.sqrt(2) * 511)
    return struct.pack("<I", word)


def spz_bytes(one: Gaussians, version: int) -> bytes:
    """The file: gzip, or for version 4 Zstandard frames whose one block is raw, as the format allows."""
    streams = spz_streams(one, version)
    streams = streams if one.degree else streams[:5]
    head = struct.pack("<4sIIBBBB", b"NGSP", version, one.count, one.degree, 12, 0, len(streams) if version == 4 else 0)
    if version < 4:
        return gzip.compress(head + b"".join(streams))
    packed = [zstandard_frame(stream) for stream in streams]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    return head + struct.pack("<I12x", 32) + table + b"".join(packed)


def zstandard_frame(data: bytes) -> bytes:
    """RFC 8878: magic, a descriptor (one segment, size in 4 bytes), the size, a last raw block of fewer than 2^17 bytes."""
    return b"\x28\xb5\x2f\xfd\xa0" + struct.pack("<I", len(data)) + (len(data) << 3 | 1).to_bytes(3, "little") + data


# -- Viewers' files -----------------------------------------------------------------------------------------------


def splat_bytes(one: Gaussians) -> bytes:
    """antimatter15's file, as its converter writes it."""
    return b"".join(
        struct.pack("<6f8B", *_floats(one, index)[:6], *_colour(one, index), *_bytes_of_rotation(one, index))
        for index in range(one.count)
    )


def _floats(one: Gaussians, index: int) -> tuple[float, ...]:
    """Mean, scale and unit quaternion."""
    q = one.quaternions[index].astype(np.float64)
    return (*one.means[index], *np.exp(one.log_scales[index].astype(np.float64)), *(q / np.linalg.norm(q)))


def _colour(one: Gaussians, index: int) -> tuple[int, ...]:
    """Colour and opacity in bytes."""
    rgb = (0.5 + 0.28209479177387814 * one.harmonics[index, 0].astype(np.float64)) * 255
    opacity = 255 / (1 + np.exp(-float(one.opacity_logits[index])))
    return tuple(round(float(min(max(v, 0), 255))) for v in (*rgb, opacity))


def _bytes_of_rotation(one: Gaussians, index: int) -> tuple[int, ...]:
    return tuple(min(round(128 + 128 * float(v)), 255) for v in _floats(one, index)[6:])


def ksplat_bytes(sections: list[Gaussians], level: int) -> bytes:
    """The viewer's file: a section a set; buckets of four, the last two partly filled, around centres 5 apart."""
    head = struct.pack(
        "<BB2xIIIIH2x3fff", 0, 1, len(sections), len(sections), 0, sum(s.count for s in sections), level, 0, 0, 0, -1, 1
    )
    heads, bodies = b"", b""
    for one in sections:
        full = (one.count - 1) // 4 if one.count > 4 else 0
        sizes = [4] * full + ([one.count - 4 * full - 1, 1] if one.count > 4 * full + 1 else [one.count - 4 * full])
        partial = len(sizes) - full
        numbers = (one.count, one.count + 2, 4, len(sizes), 5.0, 12, 32767, 0, full, partial, one.degree)
        heads += struct.pack("<IIIIfH2xIIIIH", *numbers).ljust(1024, b"\0")
        centres = [(5.0 * b, -5.0 * b, 0.0) for b in range(len(sizes))]
        own = [b for b, size in enumerate(sizes) for _ in range(size)]
        rows = b"".join(_ksplat_row(one, index, centres[own[index]], level) for index in range(one.count))
        bodies += struct.pack(f"<{partial}I", *sizes[full:]) + b"".join(struct.pack("<3f", *c) for c in centres)
        bodies += rows + bytes(2 * (len(rows) // one.count))
    return head.ljust(4096, b"\0") + heads + bodies


def in_buckets(one: Gaussians) -> Gaussians:
    """The same Gaussians, moved into the buckets that :func:`ksplat_bytes` puts them in."""
    full = (one.count - 1) // 4 if one.count > 4 else 0
    sizes = [4] * full + ([one.count - 4 * full - 1, 1] if one.count > 4 * full + 1 else [one.count - 4 * full])
    own = np.repeat(np.arange(len(sizes)), sizes)
    moved = one.means + np.stack([5.0 * own, -5.0 * own, 0 * own], axis=1)
    return Gaussians(moved, one.log_scales, one.quaternions, one.opacity_logits, one.harmonics)


def _ksplat_row(one: Gaussians, index: int, centre: tuple[float, ...], level: int) -> bytes:
    numbers = _floats(one, index)
    above = [
        float(one.harmonics[index, k, c])
        for d in range(1, one.degree + 1)
        for c in range(3)
        for k in range(d * d, (d + 1) ** 2)
    ]
    form = "f" if level == 0 else "e"
    position = [round((float(v) - c) / (2.5 / 32767)) + 32767 for v, c in zip(numbers[:3], centre, strict=True)]
    row = struct.pack("<3f", *numbers[:3]) if level == 0 else struct.pack("<3H", *position)
    row += struct.pack(f"<7{form}4B", *numbers[3:], *_colour(one, index))
    if level < 2:
        return row + struct.pack(f"<{len(above)}{form}", *above)
    return row + bytes(round((v + 1) / 2 * 255) for v in above)
