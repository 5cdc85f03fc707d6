"""Archives of arrays: what was written is read, and whatever else is in a file ends in one short sentence."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.files import npy
from mivol.files.npy import read_archive


def test_saved_arrays_are_read_unchanged(tmp_path: Path) -> None:
    """Numbers of every kind, text, empty arrays, Fortran order; compressed or not."""
    given = {
        "a": np.arange(12, dtype=np.float16).reshape(3, 4),
        "b": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
        "c": np.array(True),
        "d": np.array("text with an ü"),
        "e": np.empty((0, 3)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **given)
        found = read_archive(tmp_path / "a.npz")
        assert found.keys() == given.keys()
        for name, array in given.items():
            assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
            assert np.array_equal(found[name], array)


def test_an_archive_larger_than_the_free_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A megabyte of zeros in a kilobyte, with half a megabyte free: the sizes in the archive refuse it."""
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(2**17))
    assert (tmp_path / "a.npz").stat().st_size < 4096
    monkeypatch.setattr(npy, "available_memory", lambda: 2**19)
    monkeypatch.setattr(npy, "_read_member", lambda *given: pytest.fail("unpacked"))
    assert_refused("at most the free memory", read_archive, tmp_path / "a.npz")


def member(shape: str, data: bytes, descr: str = "'<f8'") -> bytes:
    """A .npy whose header says what it likes."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust((len(text) + 10) // 64 * 64 + 53) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode("latin1") + data


def objects() -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([{}]), allow_pickle=True)
    return file.getvalue()


LIES = {
    "a size that is not there": (member("(1000, 1000)", b"8 bytes."), "in 136 bytes"),
    "a size of more than there is": (member("(100000, 100000, 100000)", b""), "bytes"),
    "a negative size": (member("(-1,)", b"8 bytes."), "bytes"),
    "objects": (objects(), "numbers, truth values or text"),
    "records": (member("(1,)", b"8 bytes.", "[('a', '<f8')]"), "numbers, truth values or text"),
    "a shape of letters": (member("('a',)", b""), "a damaged archive"),
    "a header that never ends": (member("(" * 5000, b""), "a damaged archive"),
    "no header": (b"nothing", "a damaged archive"),
    "nothing": (b"", "a damaged archive"),
}


@pytest.mark.parametrize("case", LIES)
def test_inconsistent_archives_are_refused(tmp_path: Path, case: str) -> None:
    content, said = LIES[case]
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("a.npy", content)
    with pytest.raises(MivolError, match=said) as refusal:
        read_archive(tmp_path / "a.npz")
    assert len(str(refusal.value)) < 600


def test_foreign_and_truncated_files_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "torn.npz", a=np.zeros(1000))
    (tmp_path / "torn.npz").write_bytes((tmp_path / "torn.npz").read_bytes()[:4000])
    for name, said in (("one.npz", "rename the file to .npy"), ("text.npz", "a damaged archive"), ("torn.npz", "a damaged")):
        assert_refused(said, read_archive, tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / "none.npz")


def test_archives_with_random_bytes_are_read_or_refused(tmp_path: Path) -> None:
    """Two hundred archives with three bytes changed at seeded positions raise no other error."""
    np.savez_compressed(tmp_path / "a.npz", a=np.arange(50.0), b=np.array("text"), c=np.arange(6).reshape(2, 3))
    whole, rng, refused = (tmp_path / "a.npz").read_bytes(), np.random.default_rng(0), 0
    for _ in range(200):
        changed = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            changed[place] = rng.integers(256)
        (tmp_path / "b.npz").write_bytes(changed)
        try:
            read_archive(tmp_path / "b.npz")
        except MivolError as error:
            refused += 1
            assert len(str(error)) < 600
    assert refused > 100
