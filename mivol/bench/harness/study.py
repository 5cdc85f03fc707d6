"""A bench as a command: its questions, its sizes, the machine it ran on, one JSON."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import msgspec
import numpy as np

from mivol.bench.harness.bars import Bar, means_that_differ, say
from mivol.errors import MivolError
from mivol.files import write_whole_text
from mivol.report.record import describe_machine, package_versions

__all__ = ["Bench", "Expected", "Question", "called"]

Question = Callable[[object], dict]
"""Takes a size, returns an answer for the JSON; the first line of its docstring is what is asked. NumPy arrays in an answer
are for its figure: the JSON leaves them out."""


class Expected(NamedTuple):
    """What a JSON of the same kind holds: the same values under some keys, and an answer to one of the questions at least."""

    same: dict[str, object]
    questions: tuple[str, ...]


def called(script: str) -> str:
    """How a bench is called: by its script, where that is what runs, else by the verb."""
    return f"{script}.py" if Path(sys.argv[0]).stem == script else f"mivol bench {script.removeprefix('bench_')}"


@dataclass(frozen=True)
class Bench:
    """A bench: its questions, and what is made of the answers.

    Attributes:
        name: of the script, and of the files it writes.
        doc: what ``--help`` prints.
        questions: by name.
        full, quick: sizes, with an attribute ``name``.
        compare: name of a question, its answer -> figures beside their bars.
        draw: answers and folder -> pictures.
        unasked: questions that are asked by name only.
    """

    name: str
    doc: str
    questions: dict[str, Question]
    full: object
    quick: object
    compare: Callable[[str, dict], list[Bar]]
    draw: Callable[[dict, Path], None]
    unasked: tuple[str, ...] = ()

    def ask(self, names: Sequence[str], size: object) -> dict:
        """Ask questions in turn: the answers by name, and under ``bars`` the figures that have one."""
        answers, bars = {}, []
        for name in names:
            say(f"{name}: {(self.questions[name].__doc__ or '').splitlines()[0]}")
            answers[name] = self.questions[name](size)
            bars += self.compare(name, answers[name])
        return {"bars": bars, **answers}

    def run(self, argv: Sequence[str] | None = None) -> int:
        """Read the command line, ask the questions, print the answers and write them beside their pictures.

        Returns:
            Exit code: 0, or 1 where means differ that have to agree, or where something is refused in a sentence.
        """
        args = self.parse(argv)
        try:
            found = self.measure(args)
        except MivolError as error:
            say(f"{called(self.name)}: {error}")
            return 1
        if beyond := means_that_differ(found["bars"]):
            say(f"the means differ ({'; '.join(beyond)}): the ratios mean nothing")
        return 1 if beyond else 0

    def measure(self, args: argparse.Namespace) -> dict:
        """What :meth:`run` does with a command line that was read; the JSON."""
        mi.set_variant(args.variant)
        size = self.quick if args.quick else self.full
        start, load = time.perf_counter(), load_of_machine()
        answers = self.ask(args.only.split(","), size)
        figures = header(size.name, args.variant, load, start) | answers
        args.out.mkdir(parents=True, exist_ok=True)
        self.draw({name: answer for name, answer in answers.items() if name != "bars"}, args.out)
        text = json.dumps(without_arrays(figures), indent=2, allow_nan=False) + "\n"
        write_whole_text(args.out / f"{self.name}.json", text)
        sys.stdout.write(text)
        return figures

    def expected(self, argv: Sequence[str]) -> Expected:
        """What the JSON of these arguments will hold; the process ends where they are wrong."""
        args = self.parse(argv)
        return Expected({"size": (self.quick if args.quick else self.full).name}, tuple(args.only.split(",")))

    def parse(self, argv: Sequence[str] | None = None) -> argparse.Namespace:
        """The command line; the process ends where it asks what is no question."""
        default = [q for q in self.questions if q not in self.unasked]
        parser = argparse.ArgumentParser(
            prog=called(self.name), description=self.doc, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        parser.add_argument("--quick", action="store_true", help="small sizes, for CI: its times mean nothing")
        parser.add_argument("--only", default=",".join(default), help=f"questions to ask, of {','.join(self.questions)}")
        parser.add_argument("--out", type=Path, default=Path("runs") / self.name)
        parser.add_argument("--variant", default="llvm_ad_rgb")
        args = parser.parse_args(argv)
        if unknown := set(args.only.split(",")) - set(self.questions):
            parser.error(f"--only: {', '.join(sorted(unknown))} is not a question; known are {', '.join(self.questions)}")
        return args


def header(size: str, variant: str, load: float | None, start: float) -> dict:
    """With what every JSON begins: size, machine, versions, load of the machine, seconds since the start."""
    return {
        "size": size,
        "machine": msgspec.to_builtins(describe_machine()),
        "versions": package_versions(),
        "variant": variant,
        "threads": dr.thread_count(),
        "load_before_and_after": [load, load_of_machine()],
        "seconds": round(time.perf_counter() - start, 1),
    }


def load_of_machine() -> float | None:
    """Processes that want to run, on the mean over a minute; None on Windows, which does not count them."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def without_arrays(answer: object) -> object:
    """An answer without the NumPy arrays in it."""
    if not isinstance(answer, dict):
        return answer
    return {name: without_arrays(value) for name, value in answer.items() if not isinstance(value, np.ndarray)}
