"""The commands that a page prints: lines of its shell blocks, and inline code that is a command."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

PROGRAMS = ("mivol", "python", ".venv/bin/python", "pip", "pytest", "colmap")
"""What the first word of a command may be, beside a script of the checkout."""


def is_command(words: list[str]) -> bool:
    """Is it more than the name of a program or of a file?  A script of the checkout is a command alone."""
    if not words:
        return False
    script = words[0].startswith(("./", "scripts/"))
    return script or (words[0] in PROGRAMS and len(words) > 1)


def split(text: str) -> list[list[str]]:
    """The words of every command of a line, without comments; a prompt or prose that the shell cannot read is none."""
    found = []
    for part in text.strip().split("&&"):
        try:
            found.append(shlex.split(part, comments=True))
        except ValueError:
            continue
    return [words for words in found if is_command(words)]


def commands_of(text: str) -> list[str]:
    """The commands of a page in Markdown, in its order, each once, with one blank between words.

    Args:
        text: the page. Indented blocks count where a line of them begins like a command.
    """
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines += [line for line in prose.splitlines() if line.startswith("    ")]
    lines += [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]
    return list(dict.fromkeys(shlex.join(words) for line in lines for words in split(line)))


def commands_of_pages(root: Path) -> dict[str, list[str]]:
    """Every printed command of README.md, CONTRIBUTING.md and docs/, with the pages that print it.

    The pages that are made from the code (docs/reference, docs/guards.md) print none of their own.
    """
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").glob("*.md"))]
    pages += sorted((root / "docs" / "tutorials").glob("*.md"))
    found: dict[str, list[str]] = {}
    for page in pages:
        if page.name != "guards.md":
            for command in commands_of(page.read_text()):
                found.setdefault(command, []).append(page.relative_to(root).as_posix())
    return found
