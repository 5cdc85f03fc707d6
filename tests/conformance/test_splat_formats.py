"""Compact files of Gaussians: numbers are within the quantisation of a test encoder, and published scenes in several formats
agree.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gaussian_sets import in_buckets, ksplat_bytes, random_gaussians, splat_bytes, spz_bytes
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.points import compact_files
from mivol.points.gaussian_files import read_gaussians
from mivol.points.gaussians import Gaussians

Read = Callable[[bytes, str], Gaussians]

ROUNDING = 1e-6
"""Numbers below 8 in float32 and the encoders' sums of them."""


def unit(one: Gaussians) -> np.ndarray:
    """Unit quaternions, float64, w not below 0."""
    q = one.quaternions.astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True) * np.where(q[:, :1] < 0, -1, 1)


def close(found: np.ndarray, wanted: np.ndarray, bound: float | np.ndarray) -> bool:
    """Equality within a bound and rounding, number by number."""
    return bool(np.all(np.abs(found.astype(np.float64) - wanted) <= np.asarray(bound) + ROUNDING))


def colours_are_bytes(read: Gaussians, one: Gaussians) -> bool:
    """Colour and opacity are within half a step of 1 / 255; colours of the test sets lie in 0..1."""
    return close(read.base_colours(), one.base_colours(), 0.5 / 255) and close(read.opacities(), one.opacities(), 0.5 / 255)


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Read bytes as a file with a suffix."""

    def read_bytes(data: bytes, suffix: str) -> Gaussians:
        (tmp_path / f"a{suffix}").write_bytes(data)
        return read_gaussians(tmp_path / f"a{suffix}")

    return read_bytes


def needs_zstandard(version: int) -> None:
    if version == 4:
        pytest.importorskip("zstandard", reason="an SPZ of version 4 needs the optional package zstandard")


# -- SPZ ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_is_within_its_steps(read: Read, version: int, degree: int) -> None:
    """Half a step: positions 2^-12, logarithms of scales 1/16, opacities 1/255, coefficients of degree 0 (1/255)/0.15, others
    1/128. Version 2 holds x, y, z in steps of 1/127.5; later ones three entries in steps of sqrt(1/2)/511, and the fourth,
    the largest, is at least 1/2: sqrt(1 - sum) moves by at most sum |q_i| / q_4 half steps, sqrt(3) * sqrt(3/4) / (1/2) = 3.
    """
    needs_zstandard(version)
    one = random_gaussians(40, degree)
    found = read(spz_bytes(one, version), ".spz")
    assert close(found.means, one.means, 2**-13)
    assert close(found.log_scales, one.log_scales, 1 / 32)
    assert close(found.opacities(), one.opacities(), 0.5 / 255)
    assert close(found.harmonics[:, 0], one.harmonics[:, 0], 0.5 / 255 / 0.15)
    assert close(found.harmonics[:, 1:], one.harmonics[:, 1:], 1 / 256)
    if version == 2:
        assert close(found.quaternions[:, 1:], unit(one)[:, 1:], 0.5 / 127.5)
        assert (found.quaternions[:, 0] >= 0).all()
        inside = np.linalg.norm(found.quaternions[:, 1:], axis=1) < 1
        assert close(np.linalg.norm(found.quaternions[inside], axis=1), 1, 0)
    else:
        assert close(unit(found), unit(one), 3 * np.sqrt(0.5) / 511 / 2)


def test_bytes_that_gzip_would_pack_are_read_as_they_are(read: Read) -> None:
    packed = spz_bytes(random_gaussians(5, 1), 3)
    assert np.array_equal(read(gzip.decompress(packed), ".spz").harmonics, read(packed, ".spz").harmonics)


def test_harmonics_turn_with_the_axes(variant_rgb: str) -> None:
    """The colour along (x, -y, -z) with turned coefficients equals the colour along (x, y, z): each function changes only its
    sign.
    """
    d = np.array([[0.3, -0.5, 0.2], [0.6, 0.1, -0.7], [-0.2, 0.4, 0.5]], np.float32).T
    turned = d * np.array([[1], [-1], [-1]], np.float32)
    plain, other = (dr.sh_eval(mi.Vector3f(v), 3) for v in (d, turned))
    for number in range(1, 16):
        assert np.array_equal(np.array(other[number]), np.float32(compact_files.PARITY[number]) * np.array(plain[number]))


def changed(data: bytes, at: int, new: bytes) -> bytes:
    """The bytes with some bytes replaced."""
    return data[:at] + new + data[at + len(new) :]


PLAIN = gzip.decompress(spz_bytes(random_gaussians(4, 1), 3))
STREAMED = spz_bytes(random_gaussians(4, 1), 4)
HOSTILE_SPZ = {
    "another kind": (b"NGSQ" + PLAIN[4:], "first bytes b'NGSQ"),
    "version 9": (changed(PLAIN, 4, b"\x09"), "version 9, expected one of"),
    "degree 5": (changed(PLAIN, 12, b"\x05"), "harmonics of degree 5"),
    "30 bits": (changed(PLAIN, 13, b"\x1e"), "30 bits behind the point"),
    "extensions": (changed(PLAIN, 14, b"\x02"), "extensions of a vendor"),
    "one Gaussian more": (changed(PLAIN, 8, b"\x05"), "116 bytes of data, expected 145"),
    "one less, in gzip": (gzip.compress(changed(PLAIN, 8, b"\x03")), "more than 103 bytes after decompression"),
    "a damaged gzip": (spz_bytes(random_gaussians(4, 1), 3)[:30] + b"\0" * 40, "gzip"),
    "a short header": (b"NGSP\x03", "first bytes b'NGSP"),
    "streams in another number": (changed(STREAMED, 15, b"\x05"), "5 streams listed"),
    "a list beyond the end": (changed(STREAMED, 16, b"\xff\xff\xff\x7f"), "listed at byte 2147483647"),
    "a stream beyond the end": (changed(STREAMED, 32, b"\xff" * 7), "stream 0 of 72057594037927935 bytes"),
    "a stream of another size": (changed(STREAMED, 40, b"\xff"), "stream 0 of 48 bytes, 255 unpacked, expected 36"),
}


@pytest.mark.parametrize("name", HOSTILE_SPZ)
def test_hostile_spz_ends_in_a_sentence(read: Read, name: str) -> None:
    data, said = HOSTILE_SPZ[name]
    assert_refused(said, read, data, ".spz")


def test_an_spz_larger_than_memory_is_refused_before_it_is_taken(read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its 2^32 - 1 Gaussians would take 29 bytes each."""
    monkeypatch.setattr("mivol.files.npy.available_memory", lambda: 2**30)
    with pytest.raises(MivolError, match=r"arrays of 116\.0 GiB, expected at most the free memory, 1\.0 GiB"):
        read(gzip.compress(changed(PLAIN, 8, b"\xff\xff\xff\xff")), ".spz")


@pytest.mark.parametrize(
    ("at", "new", "said"), [(128, b"\0", "a damaged Zstandard stream"), (132, b"\x25", "a damaged Zstandard stream")]
)
def test_damaged_zstandard_ends_in_a_sentence(read: Read, at: int, new: bytes, said: str) -> None:
    needs_zstandard(4)
    assert STREAMED[128:132] == b"\x28\xb5\x2f\xfd"
    assert_refused(said, read, changed(STREAMED, at, new), ".spz")


# -- Viewers' files -----------------------------------------------------------------------------------------------


def test_splat_is_within_its_steps(read: Read) -> None:
    """Positions and scales are float32; quaternions have steps of 1/128, a full step where 255 means 1; w may be negative."""
    one = random_gaussians(40, 0)
    found = read(splat_bytes(one), ".splat")
    assert np.array_equal(found.means, one.means)
    assert close(found.log_scales, one.log_scales, 0)
    assert colours_are_bytes(found, one)
    q = one.quaternions.astype(np.float64)
    assert close(found.quaternions, q / np.linalg.norm(q, axis=1, keepdims=True), 1 / 128)


def test_splat_of_part_of_a_gaussian_is_refused(read: Read) -> None:
    assert_refused("63 bytes, expected a multiple of 32", read, splat_bytes(random_gaussians(2, 0))[:-1], ".splat")


def test_a_scale_of_0_is_named_by_index(read: Read) -> None:
    with pytest.raises(MivolError, match="log_scales that are not finite in Gaussian 1 "):
        read(changed(splat_bytes(random_gaussians(2, 0)), 32 + 12, bytes(4)), ".splat")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ksplat_is_within_its_steps(read: Read, level: int, degree: int) -> None:
    """Two sections, of 14 Gaussians in three full buckets and two others, and of 3. Half a step of positions is 2.5/32767/2;
    half precision rounds a number v by |v| 2^-11 at most: logarithms by 2^-11, numbers below 1 by that, coefficients below 1/2
    by half; harmonics in bytes over -1..1 lie within 1/255."""
    parts = [in_buckets(random_gaussians(14, degree)), in_buckets(random_gaussians(3, 0, seed=2))]
    found = read(ksplat_bytes(parts, level), ".ksplat")
    assert (found.count, found.degree) == (17, degree)
    for part, one in zip((found.select(slice(14)), found.select(slice(14, 17))), parts, strict=True):
        assert close(part.means, one.means, 0 if level == 0 else 1.25 / 32767)
        assert close(part.log_scales, one.log_scales, 0 if level == 0 else 2**-11)
        q = one.quaternions.astype(np.float64)
        assert close(part.quaternions, q / np.linalg.norm(q, axis=1, keepdims=True), 0 if level == 0 else 2**-11)
        assert colours_are_bytes(part, one)
        above = one.with_degree(degree).harmonics[:, 1:]
        assert close(part.harmonics[:, 1:], above, (0, 2**-12, 1 / 255)[level])


SOUND = ksplat_bytes([in_buckets(random_gaussians(14, 1))], 1)
HOSTILE_KSPLAT = {
    "a short header": (SOUND[:4000], "4000 bytes, expected a header of 4096"),
    "version 1.1": (changed(SOUND, 0, b"\x01"), "version 1.1, level 1"),
    "level 3": (changed(SOUND, 20, b"\x03"), "version 0.1, level 3"),
    "many sections": (changed(SOUND, 4, b"\xff\xff\xff\xff"), "4294967295 sections in"),
    "another count": (changed(SOUND, 16, b"\x0d"), "14 Gaussians in 1 sections, expected 13"),
    "a large section": (changed(SOUND, 4096 + 4, b"\xff\xff\xff\xff"), "for section 0; the file is truncated"),
    "more than its room": (changed(SOUND, 4096, b"\x20"), "a section of"),
    "degree 9": (changed(SOUND, 4096 + 40, b"\x09"), "a section of"),
    "more full buckets": (changed(SOUND, 4096 + 32, b"\x05"), "a section of"),
    "buckets of another size": (changed(SOUND, 4096 + 8, b"\x05"), "17 Gaussians in buckets, expected 14"),
    "cut": (SOUND[:-1], "for section 0; the file is truncated"),
}


@pytest.mark.parametrize("name", HOSTILE_KSPLAT)
def test_hostile_ksplat_ends_in_a_sentence(read: Read, name: str) -> None:
    data, said = HOSTILE_KSPLAT[name]
    assert_refused(said, read, data, ".ksplat")


# -- Published scenes in several formats --------------------------------------------------------------------------


@pytest.mark.parametrize("version", [3, 4])
def test_four_published_splats_agree_in_three_formats(data_dir: Path, version: int) -> None:
    """The set's ``.splat``, ``.ksplat`` and SPZ of versions 3 and 4. (Version 2 there has other colours and axes.)"""
    needs_zstandard(version)
    folder = data_dir / "splats" / "fixtures"
    exact, other, packed = (read_gaussians(folder / f"minimal{end}") for end in (".splat", ".ksplat", f"-v{version}.spz"))
    for name in ("means", "log_scales", "opacity_logits", "harmonics"):
        assert np.array_equal(getattr(exact, name), getattr(other, name))
    assert close(packed.means, exact.means, 2**-13)
    assert close(packed.log_scales, exact.log_scales, 1 / 32)
    assert close(packed.opacities(), exact.opacities(), 1 / 255)
    assert close(packed.harmonics[:, 0], exact.harmonics[:, 0], 0.5 / 255 / 0.15)


def test_a_published_scan_agrees_in_two_formats(data_dir: Path) -> None:
    """152 746 Gaussians as PlayCanvas' compressed file and as the SPZ of version 4 made of it: half a step of the SPZ, whose
    logarithms of scales end at -10, opacities are the same bytes, and colours end at +-0.5/0.15. Quaternions: three entries
    are off by half a step of sqrt(1/2)/511, the fourth by at most three of these (as above)."""
    needs_zstandard(4)
    exact, packed = (read_gaussians(data_dir / "splats" / f"biker{end}") for end in (".compressed.ply", ".spz"))
    assert exact.count == packed.count == 152746
    assert close(packed.means, exact.means, 2**-13)
    assert close(packed.log_scales, np.maximum(exact.log_scales, -10), 1 / 32)
    assert np.array_equal(packed.opacity_logits, exact.opacity_logits)
    assert close(packed.harmonics, np.clip(exact.harmonics, -0.5 / 0.15, 0.5 / 0.15), 0.5 / 255 / 0.15)
    cosine = np.abs(np.sum(unit(packed) * unit(exact), axis=1))
    assert np.sqrt(2 * (1 - np.minimum(cosine, 1))).max() <= np.sqrt(12) * np.sqrt(0.5) / 511 / 2 + ROUNDING
