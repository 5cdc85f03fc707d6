"""Are the tests able to fail?  Break one line at a time in a copy of the checkout, and see whether a test goes red.

Each entry of tests/mutations/*.toml names a file, a text that occurs in it once, the text to put in its place, and a
test. All chosen tests must pass on the untouched copy, and each must fail on its broken one; a crash or a hang of the
broken one counts as failing, an import that breaks does not.

    scripts/mutate.py                        all of them
    scripts/mutate.py --sample 12 --seed 7   twelve, drawn by the seed
    scripts/mutate.py --only '*lattice*'     those whose file, test or list matches
    scripts/mutate.py --random 60 --seed 7   not these: 60 faults drawn from the whole package, and the share that the
                                             tests of their lines notice; from a part of it with --only 'mivol/scene/*'.
                                             The default suite is run once first (with --slow all tests), to record which
                                             tests run which of these lines.
    scripts/mutate.py --random 60 --seed 7 --faults FOLDER
                                             only draw them: pytest -p mutation.recorder, with MIVOL_FAULTS=FOLDER and
                                             PYTHONPATH=scripts, then puts the recording beside them
    scripts/mutate.py --faults FOLDER        judge these; without the first 40 with --from 41
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import os
import random
import re
import shutil
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from mutation.faults import Fault, draw_faults, read_package
from mutation.guards import ALL, group_entries, read_faults, read_recording, record_suite, write_faults
from mutation.survivors import GREEN, UNFINISHED, Checkout, change_source, judge_all, report, run_pytest

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = (".git", ".venv", "runs", "__pycache__", ".pytest_cache", ".ruff_cache", ".hypothesis", "dist", "build")
PYTEST_FAILED = 1


@dataclass(frozen=True)
class Mutation:
    """One line to break and the test that must notice."""

    area: str
    file: str
    find: str
    replace: str
    test: str

    def __str__(self) -> str:
        return f"{self.file}: {_short(self.find)} -> {_short(self.replace)}"


def _short(text: str) -> str:
    line = " ".join(text.split())
    return repr(line if len(line) <= 48 else line[:45] + "...")


def load_entries(root: Path = ROOT) -> list[Mutation]:
    """All entries of a checkout, in the order of the files.

    Raises:
        ValueError: an entry has a missing or an unknown key.
    """
    entries = []
    for path in sorted((root / "tests" / "mutations").glob("*.toml")):
        for number, fields in enumerate(tomllib.loads(path.read_text()).get("mutation", []), 1):
            if set(fields) != {"file", "find", "replace", "test"}:
                raise ValueError(f"{path}: entry {number} has the keys {sorted(fields)}, not file, find, replace, test.")
            entries.append(Mutation(path.stem, **fields))
    return entries


def broken(entry: Mutation, root: Path) -> str:
    """The text of the entry's file with the mutation in it.

    Raises:
        ValueError: the text to find does not occur exactly once.
    """
    text = (root / entry.file).read_text()
    if text.count(entry.find) != 1:
        raise ValueError(f"{entry.file} contains {entry.find!r} {text.count(entry.find)} times; once is needed.")
    return text.replace(entry.find, entry.replace)


def verdict(code: int, output: str) -> tuple[bool, str]:
    """Whether the broken copy was noticed, and in a few words how, by what :func:`mutation.survivors.run_pytest` returns."""
    if UNFINISHED.search(output):
        return True, "red (hangs)"
    if code < 0:
        return True, f"red (signal {-code})"
    if code == PYTEST_FAILED and " failed" in output:
        return True, "red"
    if code != GREEN:
        return False, f"DID NOT RUN (pytest ended with {code})"
    return (False, "STILL GREEN") if re.search(r"\b\d+ passed", output) else (True, "skipped here")


def judge(copy: Path, entry: Mutation, limit: float) -> tuple[bool, str]:
    """Break the copy, run the test, mend the copy."""
    file = copy / entry.file
    whole = file.read_text()
    change_source(file, broken(entry, copy))
    try:
        return verdict(*run_pytest(copy, [entry.test], limit))
    finally:
        change_source(file, whole)


def choose(entries: list[Mutation], only: str, sample: int | None, seed: int) -> list[Mutation]:
    """The entries asked for."""
    chosen = [e for e in entries if any(fnmatch.fnmatch(name, only) for name in (e.file, e.test, e.area))]
    if sample is None or sample >= len(chosen):
        return chosen
    return sorted(random.Random(seed).sample(chosen, sample), key=entries.index)


@contextlib.contextmanager
def copies(count: int) -> Iterator[list[Path]]:
    """Copies of the checkout, as long as they are needed."""
    with tempfile.TemporaryDirectory(prefix="mivol-mutate-") as folder:
        found = [Path(folder) / str(k) / "checkout" for k in range(count)]
        for copy in found:
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
        yield found


def judge_entries(chosen: list[Mutation], limit: float) -> int:
    """Say what becomes of each entry; the number of those that their test did not notice.

    Raises:
        RuntimeError: a test is red without a mutation.
    """
    missed = 0
    with copies(1) as (copy,):
        code, output = run_pytest(copy, list(dict.fromkeys(entry.test for entry in chosen)), limit)
        if code != GREEN:
            raise RuntimeError(f"pytest ends with {code} before any mutation:\n{output[-2000:]}")
        for entry in chosen:
            start = time.perf_counter()
            noticed, how = judge(copy, entry, limit)
            missed += not noticed
            print(f"{how:<14}{time.perf_counter() - start:6.1f} s  {entry}  [{entry.test}]", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} mutations noticed")
    return missed


def draw(only: str, count: int, seed: int) -> list[Fault]:
    """Faults drawn from the files of the package that match.

    Raises:
        ValueError: those files have fewer lines to break than faults are asked for.
    """
    return draw_faults({file: text for file, text in read_package(ROOT).items() if fnmatch.fnmatch(file, only)}, count, seed)


def judge_random(args: argparse.Namespace) -> None:
    """Say which faults their tests notice: a measurement, whose reader judges survivors.

    The faults and the recording of the suite are those of a folder; without one they are made here.

    Raises:
        ValueError: as :func:`draw`; or no fault is left to judge.
    """
    # Each process of tests takes its share of the cores, as tests/conftest.py does for those of pytest-xdist.
    os.environ["PYTEST_XDIST_WORKER_COUNT"] = str(args.jobs)
    with copies(args.jobs + 1) as (untouched, *broken):
        folder = args.faults or untouched.parent / "faults"
        if args.faults is None:
            write_faults(folder, draw(args.only, args.random, args.seed))
            record_suite(untouched, args.jobs, folder, args.slow)
        faults = read_faults(folder)[args.first - 1 :]
        if not faults:
            raise ValueError(f"{folder} holds fewer than {args.first} faults.")
        test_files = {str(path.relative_to(ROOT)): path.read_text() for path in sorted((ROOT / "tests").rglob("test_*.py"))}
        guards = read_recording(folder, group_entries((e.file, e.test) for e in load_entries()), test_files, args.slow)
        guards.seconds = args.seconds
        first = Checkout(broken[0], untouched, args.limit, {test.name: test.passed for test in guards.tests})
        checkouts = [first, *(replace(first, broken=copy) for copy in broken[1:])]
        report(judge_all(faults, guards, checkouts), len(faults), lambda line: print(line, flush=True))


def main(argv: list[str] | None = None) -> int:
    """Judge the chosen entries, 0 where each was noticed; or draw faults, and count those that are noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", metavar="GLOB", help="entries whose file, test or list matches; files to break")
    parser.add_argument("--sample", type=int, metavar="N", help="a random choice of so many")
    parser.add_argument("--random", type=int, metavar="N", help="instead of entries, so many faults drawn from the package")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the random choice")
    parser.add_argument("--from", dest="first", type=int, default=1, metavar="N", help="of --random: continue at the Nth fault")
    parser.add_argument("--jobs", type=int, default=2, metavar="J", help="faults of --random that are judged at a time")
    parser.add_argument("--slow", action="store_true", help="of --random: record and run slow tests, too")
    parser.add_argument("--faults", type=Path, metavar="FOLDER", help="where --random only draws to; without it: judge these")
    parser.add_argument("--seconds", type=float, default=ALL, metavar="S", help="of --random: recorded time of a fault's tests")
    parser.add_argument("--limit", type=float, default=300, metavar="SECONDS", help="time that one test may take")
    args = parser.parse_args(argv)
    os.environ.setdefault("MIVOL_DATA", str(ROOT.parent / "shared" / "data"))
    if args.random is not None or args.faults is not None:
        if args.jobs < 1 or args.first < 1:
            parser.error("--jobs and --from take a number of 1 or more")
        if args.random is not None and args.faults is not None:
            write_faults(args.faults, draw(args.only, args.random, args.seed))
        else:
            judge_random(args)
        return 0
    chosen = choose(load_entries(), args.only, args.sample, args.seed)
    if not chosen:
        parser.error(f"no entry of tests/mutations matches {args.only!r}")
    return 1 if judge_entries(chosen, args.limit) else 0


if __name__ == "__main__":
    sys.exit(main())
