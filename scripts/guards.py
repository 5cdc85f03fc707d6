"""Which tests guard a module: those that its mutations name, those named like it, those that import it.

Nothing is written down for this: the file names of the tests, their imports and the entries of tests/mutations say it.
"""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Guards", "imported_modules", "index_guards"]

EVERYWHERE = 8
"""A test that mutations in so many folders name looks at every module: it guards those that have no mutation, too."""

SHARED = 3
"""A file of tests that mutations of so many files of a folder name looks at all of the folder: its slow tests guard that."""

MOST_FILES = 5
"""Files of tests in the second round. Modules that half of the tests import would have most of the suite run otherwise."""


@dataclass
class Guards:
    """Tests by module.

    Attributes:
        tests: the tests of the mutations of each file of the package, those of most mutations first.
        named, importing: files of tests that are called like a file, or import it, those that import the fewest first.
        everywhere: tests that guard every module.
        files: every file of tests.
    """

    tests: dict[str, list[str]] = field(default_factory=dict)
    named: dict[str, list[str]] = field(default_factory=dict)
    importing: dict[str, list[str]] = field(default_factory=dict)
    everywhere: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)

    def rounds(self, file: str) -> list[list[str]]:
        """What to run for a file of the package, round by round, the likeliest and cheapest to notice a fault first.

        First the files of tests that are called like it, the tests elsewhere that its mutations name, and those that guard
        every module; then the rest of the files that hold those tests, and those that import it, MOST_FILES at most; then those
        of all files in its folder, or all there are where the folder has none; then the slow tests of the files that are called
        like it or hold those tests, and of those that SHARED files of its folder name. Rounds may be empty; what a later round
        runs again are single tests of a file.
        """
        named, tests = self.named.get(file, []), self.tests.get(file, [])
        first = [*named, *(t for t in tests if file_of(t) not in named)]
        rest = [t for t in _once([*map(file_of, tests), *self.importing.get(file, [])]) if t not in named][:MOST_FILES]
        first += [t for t in self.everywhere if t not in first]
        near = [f for f in sorted({*self.tests, *self.named}) if Path(f).parent == Path(file).parent]
        around = _once(t for f in near for t in (*map(file_of, self.tests.get(f, [])), *self.named.get(f, [])))
        naming = Counter(test for f in near for test in {file_of(t) for t in self.tests.get(f, [])})
        own = _once([*named, *map(file_of, tests), *sorted(test for test, count in naming.items() if count >= SHARED)])
        slow = ["-m", "slow", *own] if own else []
        return [first, rest, [t for t in around or self.files if t not in (*named, *rest)], slow]


def file_of(test: str) -> str:
    """The file of a test."""
    return test.partition("::")[0]


def _once(tests: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(tests))


def index_guards(root: Path, entries: Iterable[tuple[str, str]], package: str = "mivol") -> Guards:
    """Look through the tests of a checkout.

    Args:
        root: the checkout; its tests are the files tests/**/test_*.py.
        entries: (file of the package, test that guards it) pairs.
        package: the folder of the package.
    """
    modules = {_module(path.relative_to(root)): str(path.relative_to(root)) for path in sorted((root / package).rglob("*.py"))}
    entries, counts = list(entries), defaultdict(Counter)
    for file, test in entries:
        counts[file][test] += 1
    guards = Guards(tests={file: [test for test, _ in found.most_common()] for file, found in counts.items()})
    folders = defaultdict(set)
    for file, test in entries:
        folders[test].add(Path(file).parent)
    guards.everywhere = sorted(test for test, found in folders.items() if len(found) >= EVERYWHERE)
    reads = {}
    for path in sorted((root / "tests").rglob("test_*.py")):
        name = str(path.relative_to(root))
        guards.files.append(name)
        reads[name] = {modules[m] for m in imported_modules(path.read_text()) if m in modules}
        for file in modules.values():
            if path.stem.removeprefix("test_") == Path(file).stem:
                guards.named.setdefault(file, []).append(name)
    for name in sorted(reads, key=lambda n: (len(reads[n]), n)):
        for file in reads[name]:
            guards.importing.setdefault(file, []).append(name)
    return guards


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(source: str) -> set[str]:
    """The modules that a file may import: of ``from a import b`` both ``a`` and ``a.b``."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found
