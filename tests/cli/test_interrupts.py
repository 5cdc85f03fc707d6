"""Ctrl-C is one sentence and exit code 130, wherever it strikes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from mivol import cli
from mivol.optim.interrupt import Signals

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The process's own handlers come back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def swallowed() -> None:
    """What a call back from C++ makes of Ctrl-C: an error that has forgotten its reason."""
    with suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    raise RuntimeError("something in C++ went wrong")


def chained() -> None:
    """What dr.custom makes of it where the fit's own handler raised."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        raise RuntimeError("see above") from error


@pytest.mark.parametrize("strike", [swallowed, chained])
def test_ctrl_c_behind_another_error_is_one_sentence(
    strike, ctrl_c: None, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(cli.VERBS, "doctor", cli.Verb(lambda arguments: strike()))
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err == "mivol: stopped; finished work is kept.\n"


def test_another_error_shows_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mistake of the program itself is not called an interruption."""
    monkeypatch.setitem(cli.VERBS, "doctor", cli.Verb(lambda arguments: {}["no"]))
    with pytest.raises(KeyError):
        cli.main(["doctor"])
    assert not Signals().came


def test_ctrl_c_while_flags_are_read_is_one_sentence(
    ctrl_c: None, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a verb's flags need is imported then, which takes a second."""
    monkeypatch.setitem(cli.VERBS, "doctor", cli.Verb(cli.doctor, lambda: os.kill(os.getpid(), signal.SIGINT)))
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err == "mivol: stopped; finished work is kept.\n"


STRIKES = {
    "at once": "os.kill(os.getpid(), signal.SIGINT)",
    "in a library that makes another error of it": """
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    raise ImportError("a name is not defined")
""",
    "in a library that swallows it": """
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    pass
""",
}
"""Packages whose import is struck by Ctrl-C."""


@pytest.mark.parametrize("strike", STRIKES)
def test_ctrl_c_while_mitsuba_is_imported_is_one_sentence(tmp_path: Path, strike: str) -> None:
    (tmp_path / "mivol").mkdir()
    (tmp_path / "mivol" / "__init__.py").write_text(f"import os, signal\n{STRIKES[strike]}\n")
    (tmp_path / "mivol" / "cli.py").write_text("main = lambda: 0")
    # A shell may have started the tests with Ctrl-C ignored.
    first = f"signal.signal(signal.SIGINT, signal.default_int_handler); sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]"
    command = [sys.executable, "-P", "-c", f"import signal, sys; {first}; import mivol_command; sys.exit(mivol_command.main())"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (130, "mivol: stopped before anything was done.\n")
