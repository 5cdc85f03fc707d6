"""What a record says of the machine and of the packages."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from mivol.report import record


def test_a_machine_is_described_by_what_the_system_tells(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Memory in GiB, to a tenth; the processor's own name. Where the system has no such files, none and the architecture."""
    monkeypatch.setattr(record, "cores", lambda: 3)
    monkeypatch.setattr(record, "Path", lambda name: tmp_path / Path(name).name)
    assert record.describe_machine() == record.Machine(3, None, platform.machine())
    (tmp_path / "meminfo").write_text("MemTotal:       24576000 kB\nMemFree: 1 kB\n")
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Some CPU @ 2 GHz\nflags\t: a b\nmodel name\t: Other\n")
    assert record.describe_machine() == record.Machine(3, 23.4, "Some CPU @ 2 GHz")
    assert record.describe_machine("A GPU").device == "A GPU"


def test_packages_that_are_not_there_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "PACKAGES", ("numpy", "no-such-package"))
    found = record.versions()
    assert list(found) == ["python", "system", "numpy"]
    assert found["python"] == platform.python_version() and found["system"].endswith(platform.machine())
