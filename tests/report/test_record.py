"""What a record says of the machine and of the packages, and lines of metrics."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from mivol.errors import MivolError
from mivol.report import record


def test_a_machine_is_described_by_proc_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Memory in GiB to a tenth, and the model of the processor. Without the files: no memory, and the architecture."""
    monkeypatch.setattr(record, "count_cores", lambda: 3)
    monkeypatch.setattr(record, "Path", lambda name: tmp_path / Path(name).name)
    assert record.describe_machine() == record.Machine(3, None, platform.machine())
    (tmp_path / "meminfo").write_text("MemTotal:       24576000 kB\nMemFree: 1 kB\n")
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nmodel name\t: Some CPU @ 2 GHz\nflags\t: a b\nmodel name\t: Other\n")
    assert record.describe_machine() == record.Machine(3, 23.4, "Some CPU @ 2 GHz")
    assert record.describe_machine("A GPU").device == "A GPU"


def test_missing_packages_have_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "PACKAGES", ("numpy", "no-such-package"))
    found = record.package_versions()
    assert list(found) == ["python", "system", "numpy"]
    assert found["python"] == platform.python_version() and found["system"].endswith(platform.machine())


def test_a_quantity_has_the_unit_of_the_run() -> None:
    """Known keys keep their labels. A parameter keeps its key and a linear axis; other keys become words."""
    units = {"loss": "radiance²", "lamp_1.position[0]": "length", "g[0]": "1"}
    loss, place, g, other, psnr = (
        record.find_quantity(name, units) for name in ("loss", "lamp_1.position[0]", "g[0]", "my_number", "psnr")
    )
    assert loss == record.QUANTITIES["loss"]._replace(unit="radiance²")
    assert (place, place.symbol) == (record.Quantity("lamp_1.position[0]", "length", log=False), "length")
    assert (g.unit, g.symbol) == ("1", "[1]")
    assert (other, other.symbol) == (record.Quantity("my number"), "")
    assert psnr == record.QUANTITIES["psnr"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_reported_with_the_file(tmp_path: Path) -> None:
    """The error of the system names no file."""
    (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
    with pytest.raises(MivolError, match=r"metrics\.jsonl: found no space left on the disk while writing, expected room for"):
        record.append_metrics(tmp_path, 1, 0.1, loss=2.0)
