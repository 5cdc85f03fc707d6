"""From a checkout with nothing set up to passing tests in one command, quiet and quick the second time; and the demo."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SET_BY_US = ("DRJIT_LIBLLVM_PATH", "PYTHONPATH", "VIRTUAL_ENV", "PYTHON")
SHORT_DEMO = (
    *("views.count=4", "views.width=16", "views.height=16", "reference.held_out=[2]", "reference.spp=32"),
    *("truth.shape=[10,10,10]", "parameter.0.shape=[5,5,5]", "fit.iterations=1", "event.0.at=[1]"),
)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy without the virtual environment, in a folder whose name has a blank."""
    copy = tmp_path / "a checkout"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", ".*_cache"))
    return copy


def run(checkout: Path, *args: str, **extra: str) -> subprocess.CompletedProcess[str]:
    """Run a command in the checkout as a user would who never heard of this virtual environment."""
    own = str(Path(sys.prefix) / "bin")
    path = os.pathsep.join(p for p in os.environ["PATH"].split(os.pathsep) if p != own)
    env = {key: value for key, value in os.environ.items() if key not in SET_BY_US} | {"PATH": path} | extra
    return subprocess.run(args, cwd=checkout, env=env, capture_output=True, text=True, check=False)


def test_wrong_python_is_refused(checkout: Path) -> None:
    done = run(checkout, "./scripts/test", PYTHON="/bin/false")
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "mivol: PYTHON=/bin/false is not a Python 3.11, 3.12 or 3.13 that runs: unset it or name another one."
    )


@pytest.fixture
def packages(tmp_path: Path) -> str:
    """A folder with the packages of this environment, without mivol and LLVM. pip unpacks none of these again, which took most
    of the test's time; any new environment of a contributor unpacks all."""
    folder = tmp_path / "packages"
    folder.mkdir()
    for package in Path(sysconfig.get_path("purelib")).iterdir():
        if not re.search("mivol|llvm", package.name):
            (folder / package.name).symlink_to(package)
    return str(folder)


@pytest.mark.slow
def test_two_runs_of_one_command(checkout: Path, packages: str) -> None:
    """The second run says nothing of a set-up, and the log of the first stays untouched."""
    said, logged = [], []
    for asked in (("tests/analytic/test_numerics.py", "-n", "0"), ("--version",)):
        done = run(checkout, "./scripts/test", *asked, PYTHONPATH=packages)
        assert done.returncode == 0, done.stderr + done.stdout
        said.append(done.stderr)
        logged.append((checkout / ".venv" / "setup.log").stat().st_mtime_ns)
    assert "setting up .venv" in said[0] and said[1] == ""
    assert logged[0] == logged[1]
    shorter = (part for change in SHORT_DEMO for part in ("--set", change))
    demo = run(checkout, "./scripts/demo", *shorter, PYTHONPATH=packages)
    assert demo.returncode == 0, demo.stderr
    assert (checkout / "runs" / "demo" / "report.html").is_file()
    doctor = run(checkout, ".venv/bin/mivol", "doctor", PYTHONPATH=packages)
    assert doctor.returncode == 0, doctor.stdout
