"""Which test guards which module: a page made from tests/mutations.

    scripts/guard_page.py            is docs/guards.md what the mutations say?
    scripts/guard_page.py --write    write it anew
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

from mutate import ROOT, load_entries

PAGE = ROOT / "docs" / "guards.md"
HEAD = """# Which test guards which module

Made by `scripts/guard_page.py --write` from the entries of `tests/mutations`: each is a fault of one line, and the test that
must go red when the fault is put in (`scripts/mutate.py`). A module that has no entry has no row.

| module | faults | tests |
|---|---|---|
"""


def page(root: Path = ROOT) -> str:
    """The page, a row for each module: how many faults it has, and the tests that notice them."""
    faults, tests = defaultdict(int), defaultdict(dict)
    for entry in load_entries(root):
        faults[entry.file] += 1
        tests[entry.file][entry.test.partition("[")[0].removeprefix("tests/")] = None
    rows = [f"| `{file}` | {faults[file]} | {_listed(tests[file])} |" for file in sorted(faults)]
    return HEAD + "\n".join(rows) + "\n"


def _listed(tests: dict[str, None]) -> str:
    """Tests by their files."""
    by_file = defaultdict(list)
    for test in sorted(tests):
        file, _, name = test.partition("::")
        by_file[file].append(name.removeprefix("test_").replace("_", " "))
    return "; ".join(f"`{file}`: {', '.join(names)}" for file, names in by_file.items())


def main(argv: list[str] | None = None) -> int:
    """0 where the page is what the mutations say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the page anew")
    args = parser.parse_args(argv)
    if args.write:
        PAGE.write_text(page())
        return 0
    if not PAGE.is_file() or PAGE.read_text() != page():
        print("docs/guards.md is not what tests/mutations say: run scripts/guard_page.py --write.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
