"""Every command that a page prints is run by somebody, or it is said why not: ``printed_commands.toml``."""

from __future__ import annotations

import ast
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from printed import commands_of, commands_of_pages
from script_modules import load
from syntax import tree_of

ROOT = Path(__file__).resolve().parents[1]
TABLE: dict[str, dict[str, str]] = tomllib.loads((ROOT / "tests" / "printed_commands.toml").read_text())


def telling(command: str) -> list[str]:
    """What whoever runs a command cannot do without: the verb of mivol, long flags, names of examples and benches."""
    words = shlex.split(command)
    verb = [words[1]] if words[0] == "mivol" else words[3:4] if words[1:3] == ["-m", "mivol"] else []
    flags = [word for word in words if word.startswith("--")]
    named = [word for word in words[2:3] if verb and verb[0] in ("demo", "bench")]
    folders = [match[1] for word in words if (match := re.match(r"scenes/(\w+)/", word))]
    return [*verb, *flags, *(n for n in named if n[:2] != "--"), *folders]


def is_there(runner: str) -> bool:
    """Is there such a test, section of CI or text of a workflow?"""
    file, _, name = runner.partition("::")
    path = ROOT / file
    if not path.is_file():
        return False
    if path.suffix == ".py":
        return any(isinstance(node, ast.FunctionDef) and node.name == name for node in tree_of(path).body)
    if file == ".ci/run":
        return re.search(rf"^section {re.escape(name)} ", path.read_text(), re.MULTILINE) is not None
    return name in path.read_text()


def test_every_printed_command_is_run_or_it_is_said_why_not() -> None:
    """Rationale: a command that nothing runs breaks unseen. Expected: the pages and the table name the same commands."""
    printed = commands_of_pages(ROOT)
    commands = [command for table in TABLE.values() for command in table]
    known = set(commands)
    assert len(known) == len(commands), "some are in two tables"
    assert {command: printed[command] for command in printed.keys() - known} == {}, "nothing is said to run these"
    assert known - printed.keys() == set(), "these are printed nowhere: take them out of printed_commands.toml"


@pytest.mark.parametrize("command", TABLE["run"])
def test_who_runs_it_is_there(command: str) -> None:
    """The test or section exists; the file of a test holds the verb, the flags and the example that the command names."""
    runner = TABLE["run"][command]
    assert is_there(runner), f"{command}: there is no {runner}"
    if runner.startswith("tests/"):
        text = (ROOT / runner.partition("::")[0]).read_text()
        assert [word for word in telling(command) if word not in text] == []


def test_long_commands_are_run_by_a_script(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    """As they are printed, with the programs of the checkout; one that fails ends the script with 1."""
    script = load("long_commands")
    assert script.main(["--list"]) == 0
    assert capfd.readouterr().out.splitlines() == list(TABLE["long"])
    table = tmp_path / "printed_commands.toml"
    table.write_text("""[long]
"python -c 'print(6 * 7)'" = "Short."
"python -c 'raise SystemExit(3)'" = "Short."
""")
    monkeypatch.setattr(script, "TABLE", table)
    assert script.main(["--only", "*print*"]) == 0
    said = capfd.readouterr()
    assert "42" in said.err and [one["exit_code"] for one in json.loads(said.out).values()] == [0]
    assert script.main([]) == 1
    assert [one["exit_code"] for one in json.loads(capfd.readouterr().out).values()] == [0, 3]
    with pytest.raises(SystemExit):
        script.main(["--only", "nothing"])
    assert "matches 'nothing'" in capfd.readouterr().err


def test_reasons_are_sentences() -> None:
    reasons = [*TABLE["long"].values(), *TABLE["not_run"].values()]
    assert [why for why in reasons if not (why.endswith(".") and len(why.split()) > 4)] == []


def test_commands_are_seen() -> None:
    """Blocks of a shell, indented lines and inline code count; comments, other languages, names and files do not."""
    page = """Call `mivol explain a.xml`, `mivol`, `mivol.load`, `a.py`, `scripts/x.py`.

```sh
./scripts/demo      # `mivol not this`
mivol fetch a && mivol fetch b
cd elsewhere
```

    python -m venv .venv && pip install x

```toml
    python = "scripts/no.py"
```
"""
    assert commands_of(page) == [
        *("./scripts/demo", "mivol fetch a", "mivol fetch b", "python -m venv .venv", "pip install x"),
        *("mivol explain a.xml", "scripts/x.py"),
    ]


def test_words_that_tell() -> None:
    assert telling("mivol demo smoke --into here") == ["demo", "--into", "smoke"]
    assert telling("python scenes/tank/fit.py --slice") == ["--slice", "tank"]


def test_a_runner_that_is_gone_is_seen() -> None:
    assert is_there("tests/test_printed.py::test_words_that_tell")
    gone = [
        "tests/test_printed.py::test_x",
        "tests/none.py::test_x",
        ".ci/run::slo",
        ".github/workflows/docs.yml::no such step",
    ]
    assert [runner for runner in gone if is_there(runner)] == []
