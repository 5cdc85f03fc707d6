"""The commands that the pages print can be typed: their verbs, flags, names and files exist."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from mivol.bench.harness.catalogue import load_study, study_names
from mivol.cli import VERBS
from mivol.cli import parser as mivol_parser
from mivol.experiments.examples import EXAMPLES
from mivol.files.fetch import DATA

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = ("mivol", "python", ".venv/bin/python", "pip", "pytest", "colmap")
"""The first words of commands that are not scripts of the checkout."""


def split_line(line: str) -> Iterator[list[str]]:
    """The words of each command of a line, without comments. Prose, prompts and the bare name of a program are no commands."""
    for part in line.strip().split("&&"):
        with contextlib.suppress(ValueError):
            words = shlex.split(part, comments=True)
            if words and (words[0].startswith(("./", ".ci/", "scripts/")) or (words[0] in PROGRAMS and len(words) > 1)):
                yield words


def find_commands(page: str) -> list[str]:
    """The commands of a page in Markdown: lines of shell blocks, indented lines and inline code, each once."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    prose = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    lines += [line for line in prose.splitlines() if line.startswith("    ")]
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
    return list(dict.fromkeys(shlex.join(words) for line in lines for words in split_line(line)))


def find_faults(command: str) -> list[str]:
    """The words of a command that name nothing: an empty list for a command that can be typed."""
    words = shlex.split(command)
    program, *rest = words if words[0] not in ("python", ".venv/bin/python") else words[1:]
    if program == "-m":
        program, *rest = rest
    missing = [word for word in words if word.startswith(("scenes/", "scripts/", ".ci/", "./")) and not any(ROOT.glob(word))]
    if missing:
        return missing
    if program == "mivol":
        return _faults_of_verb(*rest)
    if program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        named = [name for word in rest for group in re.findall(r"^(?:mivol|\.)\[(.*)\]$", word) for name in group.split(",")]
        return [name for name in named if name not in extras]
    if program.endswith(".py") and (ROOT / program).is_file():
        text = (ROOT / program).read_text()
        return [flag for flag in _flags(rest) if not re.search(rf"(?<![\w-]){re.escape(flag)}(?![\w-])", text)]
    return []


def _flags(words: list[str] | tuple[str, ...]) -> list[str]:
    return [word.partition("=")[0] for word in words if re.match(r"--?[a-zA-Z]", word)]


def _faults_of_verb(verb: str, *rest: str) -> list[str]:
    """Flags that a verb does not take, and unknown names of examples, benches and data sets; capitals stand for any name."""
    if verb not in VERBS:
        return [] if verb.isupper() else [verb]
    known = {"demo": EXAMPLES, "bench": study_names(), "fetch": DATA}.get(verb, rest)
    unknown = [name for name in rest[:1] if not name.startswith("-") and name not in known and not name.isupper()]
    help_text = _help_of(lambda: mivol_parser().parse_args([verb, "--help"]))
    if verb == "bench" and rest and not unknown:
        study = load_study(rest[0])
        help_text += _help_of(lambda: study.parse(["--help"]))
        only = [name for word, value in pairwise(rest) if word == "--only" for name in value.split(",")]
        unknown = [name for name in only if name not in study.questions]
    return unknown + [flag for flag in _flags(rest) if not re.search(rf"(?<![\w-]){flag}(?![\w-])", help_text)]


def _help_of(call: Callable) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        call()
    return said.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_commands_of_a_page_can_be_typed(page: Path) -> None:
    assert {command: faults for command in find_commands(page.read_text()) if (faults := find_faults(command))} == {}


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        ("mivol optimise fit.toml", "optimise"),
        ("mivol optimize fit.toml --resum", "--resum"),
        ("mivol optimize scenes/smoke/fits.toml", "scenes/smoke/fits.toml"),
        ("python -m mivol demo smok", "smok"),
        ("mivol bench optical_depths", "optical_depths"),
        ("mivol fetch toot", "toot"),
        ("mivol bench points --onl chair", "--onl"),
        ("mivol bench points --only chairs", "chairs"),
        ("python scenes/bonsai/scan.py --slices", "--slices"),
        ("pip install '.[llvn]'", "llvn"),
    ],
)
def test_a_word_that_names_nothing_is_found(command: str, fault: str) -> None:
    assert find_faults(command) == [fault]


def test_commands_are_lines_of_shell_blocks_indented_lines_and_inline_code() -> None:
    """Comments, other languages, names and files are none."""
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
    assert find_commands(page) == [
        *("./scripts/demo", "mivol fetch a", "mivol fetch b", "python -m venv .venv", "pip install x"),
        *("mivol explain a.xml", "scripts/x.py"),
    ]
