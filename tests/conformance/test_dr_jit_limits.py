"""The limits of Dr.Jit's recordings that the code goes around are still there: "gone" asks for simpler code."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol.threads import run_child

SCRIPTS = sorted((Path(__file__).resolve().parents[2] / "scripts" / "dr_jit_limits").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_limit_is_as_known(script: Path) -> None:
    child = run_child("import runpy, sys; import mivol; runpy.run_path(sys.argv[1])", str(script))
    assert child.returncode == 0 and "as known" in child.stdout, child.stderr
