"""Killed at any moment and on a full disk: nothing half-written, nothing lost; .ci/kills.py does more of it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from script_modules import load

from mivol.files import write_exr, write_png, write_volume

ROOT = Path(__file__).resolve().parents[2]
VERBS = ("reference", "convert")
"""One that writes a folder, one that writes a file; the script does it to all verbs."""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked after their imports")
def test_killed_verbs_lose_nothing() -> None:
    """One kill and one full disk of each of these verbs; the moments are the script's own, drawn by its seed."""
    command = [sys.executable, str(ROOT / ".ci" / "kills.py"), *VERBS, "--kills", "1", "--full-disks", "1"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=600, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("1 kills and 1 full disks, 0 failures") == len(VERBS)


def test_half_a_file_is_seen(tmp_path: Path) -> None:
    """The check itself: each format cut in the middle is called broken, and whole it is not."""
    kills = load("kills")
    write_exr(tmp_path / "a.exr", {"": np.ones((4, 4, 3), "f")})
    write_png(tmp_path / "a.png", np.ones((4, 4, 3), "f"))
    write_volume(tmp_path / "a.vol", np.ones((2, 2, 2, 1), "f"))
    np.savez(tmp_path / "a.npz", a=np.ones(9))
    (tmp_path / "a.json").write_text('{"a": 1}')
    (tmp_path / "a.html").write_text("<html></html>\n")
    for path in sorted(tmp_path.iterdir()):
        assert kills.broken(path) == ""
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert "is not whole" in kills.broken(path)


def test_a_strike_is_at_its_change(tmp_path: Path) -> None:
    """Reading, and what lies elsewhere, is not counted; a full disk refuses from its change on, and still lets files go."""
    kills = load("kills")
    watch = kills.Watch(str(tmp_path), kills.Strike("full", at=2))
    inside, new = str(tmp_path / "a"), os.O_WRONLY | os.O_CREAT
    for event, args in (("open", (inside, "rb", os.O_RDONLY)), ("open", ("/elsewhere", "wb", new)), ("exec", (inside,))):
        watch(event, args)
    watch("open", (inside, "wb", new))
    assert (watch.count, watch.refused) == (1, 0)
    with pytest.raises(OSError, match="No space left"):
        watch("os.rename", (inside, inside, -1, -1))
    watch("os.remove", (inside, -1))
    assert (watch.count, watch.refused) == (3, 1)


def test_moments_are_drawn_over_the_whole_life() -> None:
    """All of them, where there are as many strikes; the same again with the same seed."""
    kills = load("kills")
    one, two = (kills.draw(kills.random.Random(3), 5, ("kill", "tear"), 14) for _ in range(2))
    assert one == two
    assert {(strike.kind, strike.at) for strike in one[:10]} == {(kind, at) for kind in ("kill", "tear") for at in range(1, 6)}
    assert len(one) == 14
