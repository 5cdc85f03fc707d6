"""What the pages say holds: links lead somewhere, commands and experiments are taken, the reference is what the code says."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread
from script_modules import load

import mivol
from hatch_build import absolute
from mivol import config
from mivol.bench.harness.catalogue import study_names
from mivol.cli import parser
from mivol.cluster import address
from mivol.optim.projections.inversion import ALL_SOLVERS
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
SCREENS = 2 * 1000
"""Height of two screens [pixel]."""
COLUMN, LETTER, LINE = 948, 7.3, 24
"""Of a page as GitHub shows it in a window of 1280 pixels: width of its text, of a letter, and height of a line [pixel]."""

WIDEST = 106
"""Letters of a line of code in a page of docs/ as it is shown in a window of 1280 pixels (docs/_static/wide.css), as measured
in Chromium."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(path: Path, language: str) -> list[str]:
    """The code of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)


def links(text: str) -> list[str]:
    """Targets of a page's links and pictures that are files."""
    outside_code = re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)
    return [
        m for m in re.findall(r"(?:\]\(|<img src=\")([^)#\s\"]+)", outside_code) if not m.startswith(("http://", "https://"))
    ]


def commands() -> list[tuple[str, list[str]]]:
    """Every call of mivol on a line of a shell block, with the page that shows it."""
    found = []
    for path in PAGES:
        for block in blocks(path, "sh"):
            words = [shlex.split(part, comments=True) for line in block.splitlines() for part in line.split("&&")]
            found += [(name_of(path), line[1:]) for line in words if line[:1] == ["mivol"]]
    return found


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_links_lead_to_files(path: Path) -> None:
    assert [target for target in links(path.read_text()) if not (path.parent / target).is_file()] == []


def test_links_are_seen() -> None:
    """The check itself: code and addresses are no links to files, a heading of another page is one to the page."""
    assert links("![a](b.png) [c](d.md#e) `[x](y)` [f](https://g.h) [i](#j)") == ["b.png", "d.md"]
    assert links('[<img src="a.png" width="9">](b.md)') == ["a.png", "b.md"]


def _pages() -> list[Path]:
    """Texts and notebooks of the site."""
    return [path for path in DOCS.rglob("*") if path.suffix in (".md", ".ipynb") and "_build" not in path.parts]


def test_every_page_is_listed() -> None:
    """Sphinx warns of pages missing from every table of contents; this needs no Sphinx."""
    pages = [path.relative_to(DOCS).with_suffix("").as_posix() for path in _pages()]
    assert sorted([*listed_pages("index"), *listed_pages("notes/index"), "index"]) == sorted(pages)


def listed_pages(index: str) -> list[str]:
    """The pages in the tables of contents of a page of docs/, relative to docs/."""
    trees = re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / f"{index}.md").read_text(), re.DOTALL)
    lines = [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]
    return [(Path(index).parent / line).as_posix() for line in lines]


@pytest.mark.parametrize("path", [ROOT / "ARCHITECTURE.md", *PAGES], ids=name_of)
def test_names_of_mivol_on_a_page_exist(path: Path) -> None:
    """``mivol.points.sample_points`` in the text of a page is an object of the package."""
    names = re.findall(r"\bmivol(?:\.[A-Za-z_]\w*)+", re.sub(r"\]\([^)]*\)", "]", path.read_text()))
    suffixes = {"png", "io", "git", "py", "toml", "xml", "md"}
    assert [name for name in names if name.rsplit(".", 1)[1] not in suffixes and not exists(name)] == []


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def test_names_that_do_not_exist_are_seen() -> None:
    assert exists("mivol.points.sample_points") and exists("mivol.optim.losses")
    assert not exists("mivol.points.density_of_points") and not exists("mivol.optim.lossess")


def test_only_the_index_of_notes_leads_to_notes() -> None:
    """A note answers no question of a user: pages link to the index of notes at most."""
    pages = [path for path in PAGES if path.parent.name != "notes"]
    targets = [(name_of(path), target) for path in pages for target in links(path.read_text()) if "notes/" in target]
    assert [pair for pair in targets if not pair[1].endswith("notes/index.md")] == []


PICTURE = re.compile(r'!\[[^\]]*\]\(([^)]+)|\[?<img src="([^"]+)"[^>]* width="(\d+)"')
"""A block that is a picture: its file, or its file and its width [pixel]."""


def height_of(text: str) -> float:
    """About how high a page of Markdown is when it is shown [pixel]; its pictures lie where the README names them.

    Of the README as it was measured in Chromium (1952 pixels, its equation as a line of text) it is 2 % off.
    """
    found = 64.0
    for block in re.findall(r"^```.*?^```|(?:^[^\n]+\n?)+", text, re.MULTILINE | re.DOTALL):
        seen = re.sub(r"\]\([^)]*\)", "]", block)
        if block.startswith("```"):
            found += 48 + 0.82 * LINE * (block.count("\n") - 1)
        elif block.startswith("#"):
            found += 3 * LINE
        elif picture := PICTURE.match(block):
            rows, columns = imread(ROOT / (picture[1] or picture[2])).shape[:2]
            found += 16 + float(picture[3] or COLUMN) * rows / columns
        elif block.startswith("|"):
            found += 16 + 1.55 * LINE * (seen.count("\n") - 1)
        else:
            items = re.split(r"^\* ", seen, flags=re.MULTILINE)
            found += 16 + LINE * sum(-(-len(" ".join(item.split())) * LETTER // COLUMN) for item in items)
    return found


def test_height_of_a_page_grows_with_what_it_shows() -> None:
    """The check itself, by hand: a heading, a line, a line of code in a block, and two items of which one takes two lines."""
    nothing, line = height_of(""), 16 + LINE
    assert height_of("# A\n") == nothing + 3 * LINE and height_of("a\nb\n") == nothing + line
    assert height_of("```sh\na\n```\n") == pytest.approx(nothing + 48 + 0.82 * LINE)
    assert height_of(f"* a\n* {'b' * 200}\n") == nothing + 16 + 3 * LINE
    assert height_of("[a](b)\n\nc\n") == nothing + 2 * line
    rows, columns = imread(DOCS / "demo.png").shape[:2]
    assert height_of("![a](docs/demo.png)\n") == nothing + 16 + COLUMN * rows / columns
    assert height_of('[<img src="docs/demo.png" width="50">](b)\n') == nothing + 16 + 50 * rows / columns


def test_readme_leads_with_a_sentence_a_picture_an_equation_and_two_commands() -> None:
    """Two screens, the first things first."""
    text = (ROOT / "README.md").read_text()
    assert height_of(text) <= SCREENS
    sentence, picture, equation = text.split("\n\n")[1:4]
    assert (sentence.count("."), picture[:2], equation[:2]) == (2, "![", "$$")  # mitsuba-renderer.org has a dot
    (commands,) = blocks(ROOT / "README.md", "sh")
    assert [line.split()[0] for line in commands.splitlines()] == ["./scripts/demo", "./scripts/test"]


def test_example_of_the_readme_is_a_script_that_is_run() -> None:
    (code,) = blocks(ROOT / "README.md", "python")
    assert (DOCS / "scripts" / "gradient.py").read_text().split("\n", 1)[1] == code


def test_code_of_the_tutorials_holds(variant_rgb: str) -> None:
    """What it imports is there; the projector's lines, which need no files, run."""
    code = [text for path in PAGES if path.parent.name == "tutorials" for text in blocks(path, "python")]
    assert len(code) > 2
    for node in (node for text in code for node in ast.walk(ast.parse(text))):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("mivol"):
            assert not [a.name for a in node.names if not hasattr(importlib.import_module(node.module), a.name)], node.module
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mivol":
            assert node.attr in mivol.PUBLIC
    held: dict[str, Any] = {}
    exec(next(text for text in code if "Projector" in text), held)
    assert held["y"].shape == (60, 1, 64)
    assert held["back"].shape == held["x"].shape


def test_commands_of_the_pages_are_taken() -> None:
    """Each parses: a flag or verb that is gone, or misspelt, is an error."""
    found = commands()
    assert len(found) > 10
    for page, words in found:
        try:
            parser().parse_args(words)
        except SystemExit:
            pytest.fail(f"{page}: mivol {shlex.join(words)} is not taken")


def test_experiments_of_the_pages_are_taken() -> None:
    """Every setting is known and has a value of its domain; a table of a cluster names its scheduler."""
    trees = [(path, tomllib.loads(text)) for path in PAGES for text in blocks(path, "toml")]
    clusters = [address.from_dict(tree, name_of(path)) for path, tree in trees if "scheduler" in tree]
    assert [found.scheduler for found in clusters] == ["slurm", "address"]
    kinds = {type(config.from_dict(tree, name_of(path))) for path, tree in trees if "scheduler" not in tree}
    assert kinds == set(config.EXPERIMENTS)


def test_reference_is_what_the_code_says(variant_rgb: str) -> None:
    """docs/reference is made by scripts/reference_pages.py --write."""
    made = load("reference_pages")
    for name, make in made.PAGES.items():
        assert made.current(name, make(), False), f"docs/reference/{name}: run scripts/reference_pages.py --write"


def test_flags_are_shown_as_they_are_typed() -> None:
    """Several values of a flag by their names, and no dash in the place of two hyphens."""
    assert "| `--up x y z` |" in (DOCS / "reference" / "command_line.md").read_text()
    assert re.search(r"^smartquotes = False$", (DOCS / "conf.py").read_text(), re.MULTILINE)


def test_docstrings_become_tables_and_code(variant_rgb: str) -> None:
    made = load("reference_pages")
    doc = "Says ``a``.\n\nArgs:\n    x: first,\n        and more [m].\n\nExample:\n    >>> f(1)\n\nLast."
    lines = made.documented(doc)
    assert "Says `a`." in lines[0]
    assert "| `x` | first, and more [m]. |" in lines
    assert ">>> f(1)" in lines
    assert lines[-2] == "Last."


def test_links_on_pypi_lead_to_the_repository() -> None:
    """Pictures to their bytes, files to their pages, addresses and headings stay."""
    text = "![p](docs/a.png) [l](b.md#c) [h](#d) [w](https://x.y)"
    made = "![p](https://r/raw/v1/docs/a.png) [l](https://r/blob/v1/b.md#c) [h](#d) [w](https://x.y)"
    assert absolute(text, "https://r", "v1") == made
    wide = absolute('[<img src="a.png" alt="p">](b.md) <img src="https://x.y/z.png">', "https://r", "v1")
    assert wide == '[<img src="https://r/raw/v1/a.png" alt="p">](https://r/blob/v1/b.md) <img src="https://x.y/z.png">'


def test_theory_says_what_each_name_computes() -> None:
    """Every estimator and solver that a plan or a file chooses from, with its bench; optimizers and losses have docstrings."""
    text = (DOCS / "theory.md").read_text()
    chosen = [*SEGMENT_ESTIMATORS, *ALL_SOLVERS]
    assert len(chosen) > 10
    assert [name for name in chosen if f"`{name}`" not in text] == []
    assert [study for study in study_names() if f"`{study}`" not in text] == []


@pytest.mark.parametrize("path", [*sorted(DOCS.rglob("*.md")), *sorted(DOCS.rglob("*.ipynb"))], ids=name_of)
def test_fractions_have_braces(path: Path) -> None:
    """What makes MathML of the formulas takes both digits of "frac12" for the numerator, without a warning."""
    assert re.findall(r"frac\s*\d\S*", path.read_text()) == []


def test_formulas_need_no_script() -> None:
    """The pages are built with MathML; a build that makes a warning of one fails (docs.yml)."""
    assert re.search(r'^html_math_renderer = "mathml"$', (DOCS / "conf.py").read_text(), re.MULTILINE)
    assert "sphinx -W" in (ROOT / ".github" / "workflows" / "docs.yml").read_text()


def code_of(path: Path) -> list[str]:
    """Lines of code that a page shows: of blocks, of cells, or all of a script."""
    if path.suffix == ".ipynb":
        cells = [cell["source"] for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        return [line for source in cells for line in "".join(source).splitlines()]
    if path.suffix == ".py":
        return path.read_text().splitlines()
    return [
        line for _, block in re.findall(r"^```(.*)\n(.*?)^```", path.read_text(), re.M | re.S) for line in block.splitlines()
    ]


@pytest.mark.parametrize("path", [*_pages(), *sorted((DOCS / "scripts").glob("*.py"))], ids=name_of)
def test_code_is_seen_whole(path: Path) -> None:
    """In a window of 1280 pixels: longer lines would have to be scrolled."""
    assert [line for line in code_of(path) if len(line) > WIDEST] == []
