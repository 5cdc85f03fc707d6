"""Which tests guard a module: the files of tests named like the module, those that expect its messages or import it, and the
tests of its mutations.

Nothing is written down for this: file names, texts, imports and the entries of tests/mutations say it.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

__all__ = ["Guards", "index_guards"]

MOST_FILES = 8
"""Files of tests in the second round. Half of the tests import some modules; all of those would be most of the suite."""

SHORTEST_TEXT = 16
"""Letters of a text that tests and a module share only if the tests expect a message of the module."""


@dataclass
class Guards:
    """Tests by module.

    Attributes:
        tests: the tests that the mutations of a file name.
        named: the files of tests that are named like a file.
        expecting: the files of tests that expect a message of a file.
        importing: the files of tests that import a file, directly or through another module, the nearest first.
        files: every file of tests.
    """

    tests: dict[str, list[str]] = field(default_factory=dict)
    named: dict[str, list[str]] = field(default_factory=dict)
    expecting: dict[str, list[str]] = field(default_factory=dict)
    importing: dict[str, list[str]] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    def rounds(self, file: str) -> list[list[str]]:
        """The arguments of pytest for a fault in a file, round by round, the likeliest and cheapest tests first.

        1. the files of tests named like the file, and the single tests that its mutations name;
        2. the rest of the files that hold those tests, the files that expect its messages, and the nearest files that import
           it, MOST_FILES in all;
        3. the tests of the other modules in its folder, and as many importing files again; without either, all tests;
        4. the slow tests of rounds 1 and 2.

        A round may be empty.
        """
        named, tests, importing = self.named.get(file, []), self.tests.get(file, []), self.importing.get(file, [])
        first = [*named, *(t for t in tests if file_of(t) not in named)]
        candidates = _unique([*map(file_of, tests), *self.expecting.get(file, []), *importing])
        second = [t for t in candidates if t not in named][:MOST_FILES]
        near = [f for f in sorted({*self.tests, *self.named}) if Path(f).parent == Path(file).parent]
        around = _unique(t for f in near for t in (*self.named.get(f, []), *map(file_of, self.tests.get(f, []))))
        around += [t for t in importing[: 2 * MOST_FILES] if t not in around]
        third = [t for t in around or self.files if t not in (*named, *second)]
        own = _unique([*named, *second])
        return [first, second, third, ["-m", "slow", *own] if own else []]


def file_of(test: str) -> str:
    """The file of a test."""
    return test.partition("::")[0]


def _unique(tests: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(tests))


def index_guards(root: Path, entries: Iterable[tuple[str, str]], package: str = "mivol") -> Guards:
    """Look through the tests of a checkout.

    Args:
        root: the checkout; its tests are the files tests/**/test_*.py.
        entries: (file of the package, test that guards it) pairs.
        package: the folder of the package.
    """
    modules = {_module(p.relative_to(root)): str(p.relative_to(root)) for p in sorted((root / package).rglob("*.py"))}
    helpers = {p.stem: str(p.relative_to(root)) for p in sorted((root / "tests").glob("*.py"))}
    names = modules | helpers
    names |= {
        name: file for m, f in modules.items() if Path(f).stem == "__init__" for name, file in _exports(root / f, m, names)
    }
    for file in modules.values():
        plugins = re.findall(r"register_\w+\(\s*\"(\w+)\"", (root / file).read_text())
        names |= {f"'{plugin}'": file for plugin in plugins}  # quoted, as no module is
    imports = {file: _files_of(root / file, names) for file in (*modules.values(), *helpers.values())}
    imports[modules[package]] = set()  # every test imports the package itself, for what it passes on or for nothing
    guards = Guards()
    for file, test in entries:
        if test not in guards.tests.setdefault(file, []):
            guards.tests[file].append(test)
    reached, messages = {}, {file: "\n".join(_texts(root / file)) for file in modules.values()}
    all_messages = "\n".join(messages.values())
    for path in sorted((root / "tests").rglob("test_*.py")):
        name = str(path.relative_to(root))
        guards.files.append(name)
        reached[name] = _distances(_files_of(path, names), imports)
        expected = [text for text in _long_parts(path) if text in all_messages]
        for file in modules.values():
            if any(text in messages[file] for text in expected):
                guards.expecting.setdefault(file, []).append(name)
            if path.stem.removeprefix("test_") == _name(Path(file)):
                guards.named.setdefault(file, []).append(name)
    # Among tests equally far from a module, those that reach the fewest modules are about it rather than about the whole.
    for name in sorted(reached, key=lambda name: (len(reached[name]), name)):
        for file in reached[name].keys() & set(modules.values()):
            guards.importing.setdefault(file, []).append(name)
    for file, tests in guards.importing.items():
        tests.sort(key=lambda name: reached[name][file])
    return guards


def _distances(start: set[str], imports: dict[str, set[str]]) -> dict[str, int]:
    """The number of imports between a test and each file that the test reaches."""
    found, front, distance = {}, set(start), 0
    while front:
        found |= dict.fromkeys(front, distance)
        front = {f for file in front for f in imports[file]} - set(found)
        distance += 1
    return found


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _texts(path: Path) -> Iterator[str]:
    """The constant texts of a file, also within formatted ones, without its docstrings."""
    tree = _tree(path)
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
            yield node.value


def _long_parts(path: Path) -> set[str]:
    """The sentences of a file's texts, between numbers, quotation marks and the operators of regular expressions."""
    parts = (part.strip() for text in _texts(path) for part in re.split(r"[\d\n\"'\\^$.*+?()\[\]{}|<>:=]+", text))
    return {part for part in parts if len(part) >= SHORTEST_TEXT and " " in part}


def _exports(path: Path, package: str, names: dict[str, str]) -> Iterator[tuple[str, str]]:
    """The (dotted name, file that defines it) pairs of what a package imports to pass on."""
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = f"{package}.{node.module}" if node.level else node.module
            if module in names:
                yield from ((f"{package}.{alias.asname or alias.name}", names[module]) for alias in node.names)


def _files_of(path: Path, names: dict[str, str]) -> set[str]:
    """The files that a file imports; a name that a package only passes on counts as imported from where it is defined."""
    found = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            found |= {names[alias.name] for alias in node.names if alias.name in names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            dotted = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {names.get(name) or names[node.module] for name in dotted if name in names or node.module in names}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = f"{node.value.id}.{node.attr}"  # mivol.optimize after import mivol
            found |= {names[name]} if name in names else set()
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            name = f"'{node.value}'"  # a plugin, as a scene names it
            found |= {names[name]} if name in names else set()
    return found


def _name(path: Path) -> str:
    """The last part of a module's dotted name: a package is called like its folder."""
    return _module(path).rpartition(".")[2]


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
