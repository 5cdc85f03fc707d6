"""Plugins are registered for each variant that becomes active, whichever of mivol, Mitsuba and the variant comes first.

The package is copied and its shells replaced by ones that only say for which variant they are run; each order of
imports is a process of its own. tests/conformance/test_plugins.py does the same with the real shells.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import mivol
from mivol import plugins
from mivol.threads import run_child

PACKAGE = Path(mivol.__file__).parent
SAY = "import mitsuba as mi\nprint(__name__.rpartition('.')[2], mi.variant())\n"
ORDERS = {
    "mivol first": "import mivol, mitsuba as mi",
    "mitsuba first": "import mitsuba as mi, mivol",
    "variant first": "import mitsuba as mi; mi.set_variant('scalar_rgb'); import mivol",
}
SWITCHES = ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with a copy of the package whose shells say their name."""
    package = tmp_path / "mivol"
    (package / "plugins").mkdir(parents=True)
    for name in ("__init__.py", "back_end.py", "errors.py", "llvm.py", "machine.py", "threads.py"):
        shutil.copy(PACKAGE / name, package)
    shutil.copy(PACKAGE / "plugins" / "__init__.py", package / "plugins")
    for name in plugins.MODULES:
        (package / "plugins" / f"{name}.py").write_text(SAY)
    return tmp_path


def said(copy: Path, code: str) -> list[str]:
    """The lines that a child process prints, with the copy first on its path and an LLVM that works."""
    done = run_child(code, env={**os.environ, "PYTHONPATH": str(copy)})
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")[:-1]


@pytest.mark.slow_for("mitsuba first", "mivol first")
@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_each_variant_gets_its_plugins(copy: Path, order: str) -> None:
    """Scalar variants get no shell; no shell runs before there is a variant, out of order, or twice for one switch."""
    switch = "".join(f"\nmi.set_variant({name!r})" for name in SWITCHES)
    expected = [f"{shell} {name}" for name in SWITCHES if name.startswith("llvm") for shell in plugins.MODULES]
    assert said(copy, order + switch) == expected


def test_no_variant_no_plugin(copy: Path) -> None:
    assert said(copy, "import mivol, sys; print(any('plugins.volumes' in name for name in sys.modules))") == ["False"]


def test_a_scalar_variant_says_where_mivol_works() -> None:
    done = run_child("import mivol, mitsuba as mi; mi.set_variant('scalar_rgb'); mi.load_dict({'type': 'mivol'})")
    assert 'the variant "scalar_rgb" is active; mivol works in llvm_ad_rgb' in done.stderr
