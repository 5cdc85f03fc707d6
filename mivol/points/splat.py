"""The formats of two web viewers: ``.splat`` (antimatter15) and ``.ksplat`` (GaussianSplats3D).

``.splat``. 32 bytes a Gaussian, no header, colours without harmonics: position and scale in float32, colour and opacity in a
byte each, the unit quaternion (w, x, y, z) as 128 + 128 q in a byte each.

``.ksplat``. A header of 4096 bytes and 1024 bytes for each section, then the sections. Level 0 stores float32. Levels 1 and 2
store positions in 16 bits around the centre of a bucket, and scales and rotations in half precision; harmonics are float32,
half precision, or bytes between two ends. Colour and opacity are bytes, quaternions (w, x, y, z). Harmonics are ordered by
degree, then by colour. Full buckets come first, with the same number of Gaussians each; a table has the counts of the other
buckets.

Source: the open-source viewers antimatter15/splat and mkkellogg/GaussianSplats3D (MIT licence), the latter up to version 0.1.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.source import read_bytes, refusal
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, concatenate, logit, to_base_harmonics, to_log_scales

HEADER_SIZE, SECTION_HEADER_SIZE = 4096, 1024
NUMBER_TYPES = {0: ("<f4", "<f4", "<f4"), 1: ("<u2", "<f2", "<f2"), 2: ("<u2", "<f2", "u1")}
"""Level -> types of positions, of scales and rotations, of harmonics."""

CENTRE_SIZE = 12
"""Size of the centre of a bucket [bytes]."""

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
