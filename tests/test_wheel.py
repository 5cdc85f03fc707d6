"""What ``pip install mivol`` installs: the whole package, its licence, the command, the entry point for Mitsuba."""

from __future__ import annotations

import configparser
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_wheel(tmp_path: Path) -> None:
    """Built by hatchling itself, without the network: everything under mivol/, and nothing of the checkout around it."""
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (path,) = tmp_path.glob("mivol-*-py3-none-any.whl")
    with zipfile.ZipFile(path) as wheel:
        names = wheel.namelist()
        (points,) = [name for name in names if name.endswith("entry_points.txt")]
        parsed = configparser.ConfigParser()
        parsed.read_string(wheel.read(points).decode())
        (metadata,) = [wheel.read(name).decode() for name in names if name.endswith("METADATA")]
    sources = {str(p.relative_to(ROOT)) for p in (ROOT / "mivol").rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    scenes = [p for p in (ROOT / "scenes").rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    examples = {f"mivol/examples/{p.relative_to(ROOT / 'scenes').as_posix()}" for p in scenes}
    assert {name for name in names if ".dist-info/" not in name} == sources | examples | {"mivol_command.py"}
    assert parsed["console_scripts"]["mivol"] == "mivol_command:main"
    assert parsed["mitsuba"]["mivol"] == "mivol.plugins"
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert "Requires-Dist: mitsuba<3.10,>=3.9.1" in metadata
    # SSIM, which fits of photographs are judged by, is no extra (such a line would end with its name).
    assert "Requires-Dist: scikit-image>=0.25" in metadata.splitlines()
    assert "License-Expression: BSD-3-Clause" in metadata
    # On PyPI no file of the checkout lies beside the description.
    assert "](docs/" not in metadata
    assert "/raw/v0.1.0/docs/showcase.jpg)" in metadata
