"""The reference pages of the docs, made from what the code says of itself: plugins, verbs, settings of experiments, Python.

scripts/reference_pages.py            are docs/reference/*.md what the code says?
scripts/reference_pages.py --write    write them anew
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import mivol

import mitsuba as mi

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "reference"
MADE = "<!-- Made by scripts/reference_pages.py --write: change what the code says, not this page. -->\n\n"


def row(*cells: str) -> str:
    """A row of a Markdown table; a bar inside a cell is escaped."""
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """A Markdown table."""
    return [row(*head), "|" + "---|" * len(head), *(row(*cells) for cells in rows), ""]


# -- Docstrings -----------------------------------------------------------------------------------------------------------


def as_markdown(text: str) -> str:
    """A docstring's markup as Markdown: double backticks are single ones, and roles are names."""
    return re.sub(r":\w+:`~?([^`]*)`", r"`\1`", text).replace("``", "`")


def sections(doc: str) -> list[tuple[str, str]]:
    """A docstring as (heading, text): the first has no heading, the others are ``Args:``, ``Raises:`` and the like."""
    found: list[tuple[str, str]] = [("", "")]
    for line in inspect.cleandoc(doc).splitlines():
        heading = re.fullmatch(r"([A-Z]\w+):", line)
        if heading:
            found.append((heading[1], ""))
        elif found[-1][0] and line and not line.startswith(" "):
            found.append(("", line + "\n"))
        else:
            found[-1] = (found[-1][0], f"{found[-1][1]}{line}\n")
    return [(heading, text.strip("\n")) for heading, text in found]


def entries(text: str) -> list[tuple[str, str]]:
    """``name: meaning`` of an indented section, each with the lines that go on."""
    found: list[tuple[str, str]] = []
    for line in inspect.cleandoc(text).splitlines():
        name, colon, meaning = line.partition(": ")
        if line.startswith(" ") or not colon:
            last = found.pop() if found else ("", "")
            found.append((last[0], f"{last[1]} {line.strip()}"))
        else:
            found.append((name, meaning))
    return found


def documented(doc: str) -> list[str]:
    """A docstring as lines of Markdown: text, tables of names and meanings, and examples as code."""
    lines = []
    for heading, text in sections(doc):
        if heading == "Example":
            lines += ["```pycon", inspect.cleandoc(text), "```", ""]
        elif heading in ("Args", "Parameters", "Attributes", "Raises"):
            rows = [(f"`{name}`" if name else "", as_markdown(meaning)) for name, meaning in entries(text)]
            lines += table((heading.lower(), ""), rows)
        elif text:
            lines += [f"*{heading}*: {as_markdown(inspect.cleandoc(text))}" if heading else as_markdown(text), ""]
    return lines


# -- Plugins --------------------------------------------------------------------------------------------------------------


def plugins() -> Iterator[tuple[str, str, str]]:
    """Kind, name and docstring of every plugin, read from the source: the classes need a variant, their text does not."""
    for file in ("integrators", "media", "phases", "volumes"):
        source = (ROOT / "mivol" / "plugins" / f"{file}.py").read_text(encoding="utf-8")
        for node in ast.parse(source).body:
            doc = (ast.get_docstring(node, clean=False) if isinstance(node, ast.ClassDef) else None) or ""
            tag = re.match(r'``<(\w+) type="(\w+)">``: ', doc)
            if tag:
                yield tag[1], tag[2], doc[tag.end() :]


def plugin_page() -> str:
    """All plugins, each with its parameters."""
    lines = ["# Plugins", "", "`import mivol` registers them; they stand in a scene's XML or dict like Mitsuba's own.", ""]
    for kind, name, doc in plugins():
        doc = doc[0].upper() + doc[1:]
        lines += [f'## `<{kind} type="{name}">`', "", *documented(doc)]
    return page(lines)


# -- Verbs ----------------------------------------------------------------------------------------------------------------


def flag_rows(sub: argparse.ArgumentParser) -> list[tuple[str, str]]:
    """The arguments of a verb, and what they mean."""
    rows = []
    for action in sub._actions:
        if action.dest == "help":
            continue
        names = ", ".join(action.option_strings) or action.metavar or action.dest
        named = action.metavar or action.dest.upper()
        named = named if isinstance(named, str) else " ".join(named)
        value = "" if action.nargs == 0 or not action.option_strings else f" {named}"
        rows.append((f"`{names}{value}`", (action.help or "") % {"default": action.default}))
    return rows


def verb_page() -> str:
    """All verbs of the command, with their flags."""
    from mivol.cli import VERBS

    lines = ["# Command line", "", "`mivol VERB --help` prints the same. Exit codes: 0, 1 for what was refused, 2 for wrong"]
    lines += ["arguments, 130 for Ctrl-C; `mivol validate` has two more.", ""]
    for name, verb in VERBS.items():
        sub = argparse.ArgumentParser(prog=f"mivol {name}")
        verb.add_flags(sub)
        lines += [f"## `mivol {name}`", "", as_markdown(verb.description), ""]
        rows = flag_rows(sub)
        lines += table(("argument", ""), rows) if rows else []
    return page(lines)


# -- Settings -------------------------------------------------------------------------------------------------------------


def setting_rows(kind: type) -> list[tuple[str, ...]]:
    """Key, default, domain, unit and meaning of every setting."""
    from mivol.schema import settings_in

    rows = []
    for key, default, domain, unit, meaning, choices, is_table in settings_in(kind):
        named = f": {', '.join(f'`{name}`' for name in choices)}" if choices else ""
        said = f"**{meaning}**" if is_table else meaning
        rows.append((f"`{key}`", f"`{default}`" if default else "", domain, "" if unit == "1" else unit, said + named))
    return rows


SETTINGS_HEAD = """\
`mivol optimize fit.toml` reads one of seven kinds of file. The tables in the headings below tell the kinds apart. Bold rows are
tables; other rows are settings, and a setting without a default is required. Paths are relative to the file.

`--set parameter.0.lr=0.2` on the command line overrides the file; the first entry of a list has the number 0.
`optimizer[adam].beta_1` exists for `optimizer = { name = "adam" }` only, and `views[ring,hemisphere].distance` for two kinds of
views. The key for the choice is `name`, but `rig` for views, `source` for references and data, and `beam` for scans. An unknown
key is an error, whose message names the most similar key. `mivol optimize --settings WORD` prints the settings with a word in
their names.
"""


def toml_page() -> str:
    """All settings of the kinds of experiment."""
    from mivol import config

    kinds = {
        "Images of a scene (a table `[scene]`)": config.SceneExperiment,
        "Projections (a table `[scan]`)": config.ScanExperiment,
        "Photographs (a table `[photos]`)": config.FieldExperiment,
        'Photographs, hash grid (tables `[photos]` and `[field]` with `kind = "hash"`)': config.HashExperiment,
        'Photographs, NeRF (tables `[photos]` and `[field]` with `kind = "nerf"`)': config.NerfExperiment,
        'Photographs, octree (tables `[photos]` and `[field]` with `kind = "octree"`)': config.OctreeExperiment,
        "Gaussians (tables `[photos]` and `[gaussians]`)": config.GaussianExperiment,
    }
    lines = ["# Settings of an experiment", "", *SETTINGS_HEAD.splitlines(), ""]
    for title, kind in kinds.items():
        rows = setting_rows(kind)
        lines += [f"## {title}", ""]
        if kind not in (config.SceneExperiment, config.ScanExperiment, config.FieldExperiment):
            shared = setting_rows(config.FieldExperiment)
            rows = [row for row in rows if row not in shared or row[0].startswith(("`field", "`gaussians"))]
            lines += [
                "`[photos]`, `[show]` and the keys without a table are as in the section *Photographs*, except for this table:",
                "",
            ]
        lines += table(("key", "default", "domain", "unit", "meaning"), rows)
    return page(lines)


# -- Python ---------------------------------------------------------------------------------------------------------------


def written(parameter: inspect.Parameter) -> str:
    """A parameter as a call's documentation shows it: its type without what else is noted about it, and its default."""
    note = parameter.annotation
    kind = note if isinstance(note, str) else inspect.formatannotation(getattr(note, "__origin__", note))
    if parameter.default is inspect.Parameter.empty:
        return f"{'**' * (parameter.kind is inspect.Parameter.VAR_KEYWORD)}{parameter.name}: {kind}"
    default = "..." if " at 0x" in repr(parameter.default) else repr(parameter.default)
    return f"{parameter.name}: {kind} = {default}"


def signature(name: str, thing: Callable) -> str:
    """The call as it is written, a parameter a line where it is long."""
    parameters = [p for p in inspect.signature(thing).parameters.values() if p.name != "self"]
    keywords = [p.kind is inspect.Parameter.KEYWORD_ONLY for p in parameters]
    plain = [written(p) for p in parameters]
    if any(keywords):
        plain.insert(keywords.index(True), "*")
    given = "" if inspect.isclass(thing) else f" -> {inspect.signature(thing).return_annotation}"
    short = f"mivol.{name}({', '.join(plain)}){given}"
    return short if len(short) <= 100 else f"mivol.{name}(\n" + "".join(f"    {p},\n" for p in plain) + f"){given}"


def python_page() -> str:
    """Everything that ``mivol.<tab>`` shows."""
    lines = ["# Python", "", "What `mivol.<tab>` shows. `import mivol` comes before `import mitsuba` and `import drjit`.", ""]
    for name in sorted(mivol.PUBLIC, key=str.lower):
        thing = getattr(mivol, name)
        lines += [f"## `mivol.{name}`", "", "```python", signature(name, thing), "```", ""]
        lines += documented(inspect.getdoc(thing) or "")
    return page(lines)


def page(lines: list[str]) -> str:
    """Lines as a file, without trailing blanks."""
    return MADE + "\n".join(line.rstrip() for line in lines).rstrip("\n") + "\n"


PAGES = {"plugins.md": plugin_page, "command_line.md": verb_page, "settings.md": toml_page, "python.md": python_page}


def main(argv: list[str] | None = None) -> int:
    """0 where the pages are what the code says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the pages anew")
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    wrong = [name for name, make in PAGES.items() if not current(name, make(), args.write)]
    for name in wrong:
        print(f"docs/reference/{name} is not what the code says: run scripts/reference_pages.py --write.", file=sys.stderr)
    return int(bool(wrong))


def current(name: str, text: str, write: bool) -> bool:
    """Is a page what it should be? It is so once it has been written."""
    path = FOLDER / name
    if write:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return path.is_file() and path.read_text(encoding="utf-8") == text


if __name__ == "__main__":
    sys.exit(main())
