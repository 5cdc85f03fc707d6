"""Gaussians for tests, and encoders of their files that share no line with mivol's readers."""

from __future__ import annotations

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
