"""Files of Gaussians: files of the authors' program are read in any order of properties and written to the bit; damaged files
end in a message.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from gaussian_sets import compressed_bytes, inria_bytes, inria_properties, inria_row, ply_bytes, random_gaussians
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.points.gaussian_files import read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")


def equal(a: Gaussians, b: Gaussians) -> bool:
    """Equality to the bit."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)


def angles(a: Gaussians, b: Gaussians) -> np.ndarray:
    """The angles between the rotations of two sets, (N,) [rad]."""
    cosine = np.abs(np.sum(unit(a) * unit(b), axis=1))
    return 2 * np.arccos(np.minimum(cosine, 1))


def unit(one: Gaussians) -> np.ndarray:
    """Unit quaternions, float64."""
    q = one.quaternions.astype(np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


# -- The authors' file --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", range(4))
def test_what_is_written_is_the_file_of_the_authors(tmp_path: Path, degree: int) -> None:
    """The body is equal to the bit, and every number read again is equal to the bit."""
    one = random_gaussians(7, degree)
    write_gaussians(tmp_path / "a.ply", one)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")] == inria_properties(degree)
    assert body == inria_bytes(one).partition(b"end_header\n")[2]
    assert equal(read_gaussians(tmp_path / "a.ply"), one)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_any_order_of_properties_is_read(tmp_path: Path, form: str) -> None:
    """Properties are shuffled and stored as doubles, beside a property of another program and an element of lists; text has 17
    digits.
    """
    one = random_gaussians(5, 2)
    names = [*np.random.default_rng(4).permutation(inria_properties(2)).tolist(), "confidence"]
    rows = [[{**inria_row(one, index), "confidence": 1.0}[name] for name in names] for index in range(5)]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    if order is None:
        body = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in rows).encode()
    else:
        body = b"".join(struct.pack(f"{order}{len(names)}d", *row) for row in rows)
    properties = [("double", name) for name in names]
    faces = ("face", 1, [("list uchar int", "vertex_indices")])
    (tmp_path / "a.ply").write_bytes(ply_bytes([("vertex", 5, properties), faces], body + b"\n", form))
    assert equal(read_gaussians(tmp_path / "a.ply"), one)


def change(old: bytes, new: bytes) -> bytes:
    """A valid file with a replaced part."""
    data = inria_bytes(random_gaussians(3, 1))
    assert data.count(old) == 1
    return data.replace(old, new)


HOSTILE = {
    "no such property": (change(b"rot_3", b"rot_9"), "no property 'rot_3'"),
    "more than there is": (change(b"vertex 3", b"vertex 4"), "at least 416 for 4 of 'vertex'"),
    "more than any memory": (change(b"vertex 3", b"vertex 999999999999999999"), "for 999999999999999999 of 'vertex'"),
    "less than there is": (change(b"vertex 3", b"vertex 2"), "104 bytes after the last element"),
    "negative": (change(b"vertex 3", b"vertex -3"), "the line 'element vertex -3'"),
    "a name twice": (change(b" rot_3", b" rot_2"), "'rot_2' twice"),
    "an unknown type": (change(b"float rot_3", b"quad rot_3"), "the line 'property quad rot_3'"),
    "no end": (change(b"end_header\n", b""), "no end_header"),
    "harmonics of no degree": (change(b"f_rest_8", b"g_rest_8"), "8 properties f_rest"),
    "no format": (change(b"format binary_little_endian 1.0\n", b""), "without a format"),
    "another kind": (b"solid stl" + bytes(80), "first bytes b'solid st'"),
    "an element without properties": (change(b"element vertex", b"element camera 1\nelement vertex"), "'camera' without"),
    "a list": (change(b"float rot_3", b"list uchar float rot_3"), "no property 'x'"),
    "one number less": (inria_bytes(random_gaussians(3, 1))[:-4], "at least 312 for 3"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_headers_end_in_a_sentence(tmp_path: Path, name: str) -> None:
    data, said = HOSTILE[name]
    (tmp_path / "a.ply").write_bytes(data)
    assert_refused(said, read_gaussians, tmp_path / "a.ply")


def test_a_text_that_promises_too_much_is_refused(tmp_path: Path) -> None:
    properties = [("float", name) for name in inria_properties(0)]
    (tmp_path / "a.ply").write_bytes(ply_bytes([("vertex", 10**15, properties)], b"1 2 3", "ascii"))
    with pytest.raises(MivolError, match=r"found 3 numbers, expected at least 17000000000000000 for 1000000000000000"):
        read_gaussians(tmp_path / "a.ply")


def test_nan_in_a_file_is_named_by_index(tmp_path: Path) -> None:
    one = random_gaussians(6, 0)
    means = one.means.copy()
    means[4, 1] = np.nan
    (tmp_path / "a.ply").write_bytes(inria_bytes(Gaussians(**{**vars(one), "means": means})))
    assert_refused(r"a\.ply: found means that are not finite in Gaussian 4 ", read_gaussians, tmp_path / "a.ply")


def test_a_suffix_without_a_format_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0")
    for use in (
        lambda: read_gaussians(tmp_path / "a.obj"),
        lambda: write_gaussians(tmp_path / "a.obj", random_gaussians(1, 0)),
    ):
        assert_refused(r"the suffix '\.obj', expected one of \.ply", use)


def test_a_published_file_is_written_again_to_the_bit(data_dir: Path, tmp_path: Path) -> None:
    published = data_dir / "splats" / "train-1000.ply"
    write_gaussians(tmp_path / "a.ply", read_gaussians(published))
    assert (tmp_path / "a.ply").read_bytes() == published.read_bytes()


# -- PlayCanvas' compressed file ----------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_compressed_numbers_are_within_half_a_step(tmp_path: Path, degree: int) -> None:
    """300 Gaussians are two boxes. Half a step of 11 or 10 bits of a box of at most 2 (positions), 3 (logarithms of scales) and
    0.283 (colours, as harmonics 1); of 8 bits of the opacity; harmonics lie in the middle of bins of 8 / 256. Each of three
    entries of a quaternion is off by at most sqrt(1/2) / 1023, and so is the fourth, by not more than their sum: a chord of
    sqrt(3 + 9) / 2^(1/2) / 1023, of which the angle is twice the arc, and the arc at most 1.1 chords. 1e-6 is for rounding.
    """
    one = random_gaussians(300, degree)
    (tmp_path / "a.ply").write_bytes(compressed_bytes(one))
    read = read_gaussians(tmp_path / "a.ply")
    steps = np.array([2047, 1023, 2047])
    assert np.all(np.abs(read.means - one.means) <= 2 / steps / 2 + 1e-6)
    assert np.all(np.abs(read.log_scales - one.log_scales) <= 3 / steps / 2 + 1e-6)
    assert np.abs(read.harmonics[:, 0] - one.harmonics[:, 0]).max() <= 1 / 255 / 2 + 1e-6
    assert np.abs(read.opacities() - one.opacities()).max() <= 1 / 255 / 2 + 1e-6
    assert np.abs(read.harmonics[:, 1:] - one.harmonics[:, 1:]).max(initial=0) <= 8 / 256 / 2 + 1e-6
    assert angles(read, one).max() <= 2 * 1.1 * np.sqrt(12 / 2) / 1023 + 1e-6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"min_scale_z", b"min_scale_w", "no property 'min_scale_z' of type float32 in 'chunk'"),
        (b"uint packed_scale", b"float packed_scale", "no property 'packed_scale' of type uint32 in 'vertex'"),
        (b"element chunk 2", b"element chunk 1", "1 chunks, expected 2 for 300 Gaussians"),
        (b"f_rest_44", b"f_rest_45", "45 properties f_rest"),
    ],
)
def test_compressed_files_that_contradict_themselves_are_refused(tmp_path: Path, old: bytes, new: bytes, said: str) -> None:
    data = compressed_bytes(random_gaussians(300, 3))
    head, end, body = data.partition(b"end_header\n")
    assert head.count(old) == 1
    if old == b"element chunk 2":
        body = body[72:]
    (tmp_path / "a.ply").write_bytes(head.replace(old, new) + end + body)
    assert_refused(said, read_gaussians, tmp_path / "a.ply")
