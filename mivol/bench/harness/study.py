"""A study: questions, amount of work, command line, bars, and one JSON file with the machine and the versions.

A bar is the promised bound of a measured figure.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self, TypedDict

import drjit as dr
import mitsuba as mi
import msgspec
import numpy as np

from mivol.errors import MivolError
from mivol.files import write_whole_text
from mivol.report.record import describe_machine, package_versions

__all__ = [
    "AT_LEAST",
    "AT_MOST",
    "Bar",
    "Promise",
    "Question",
    "Size",
    "Study",
    "SweptQuestion",
    "amount",
    "ask",
    "find_disagreements",
    "judge",
    "judge_agreement",
    "judge_promises",
    "say",
    "say_row",
]

AT_LEAST, AT_MOST = "at least", "at most"
AGREEMENT = "|z|: "
"""Prefix of the figures of :func:`judge_agreement`."""


class Bar(TypedDict):
    """A figure: label, value, sense and value of the bound, and whether the bound is met."""

    figure: str
    value: float
    sense: str
    bar: float
    met: bool


class Promise(NamedTuple):
    """A declared bar.

    Attributes:
        label: label of the figure; braces stand for the keys that "*" has matched.
        keys: keys of the figure in the answer; "*" matches every key.
        sense: AT_LEAST or AT_MOST.
        bar: bound.
        factor: factor from the value in the answer to the figure.
    """

    label: str
    keys: tuple[str, ...]
    sense: str
    bar: float
    factor: float = 1.0


def say(text: str) -> None:
    """Print progress to standard error; standard output is for the JSON."""
    print(text, file=sys.stderr, flush=True)


def say_row(place: str, **numbers: float | None) -> None:
    """Print a line of progress: a place and its numbers, with three digits."""
    shown = (f"{name.replace('_', ' ')} {'none' if value is None else f'{value:.3g}'}" for name, value in numbers.items())
    say(f"  {place}: {', '.join(shown)}")


def judge(figure: str, value: float, sense: str, bar: float, quiet: bool = False) -> Bar:
    """Compare a figure with its bar, and print both.

    Args:
        figure: label of the figure.
        value: measured value.
        sense: AT_LEAST or AT_MOST.
        bar: bound.
        quiet: print only missed bars.
    """
    met = value >= bar if sense == AT_LEAST else value <= bar
    if not (quiet and met):
        say(f"  {figure}: {value:.3g}, bar {sense} {bar:g}{'' if met else ': MISSED'}")
    return {"figure": figure, "value": value, "sense": sense, "bar": bar, "met": bool(met)}


def judge_promises(promises: Iterable[Promise], answer: dict) -> list[Bar]:
    """Compare the figures of an answer with their bars. A figure that the answer lacks, or that is None, has no bar."""
    return [
        judge(promise.label.format(*names), promise.factor * value, promise.sense, promise.bar)
        for promise in promises
        for names, value in find_figures(answer, promise.keys)
        if value is not None
    ]


def find_figures(answer: dict, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float | None]]:
    """Figures at some keys, with the keys that "*" has matched."""
    if not keys:
        yield (), answer
        return
    first, *rest = keys
    for name in answer if first == "*" else [first] if first in answer else []:
        for names, value in find_figures(answer[name], tuple(rest)):
            yield ((name, *names) if first == "*" else names), value


def judge_agreement(label: str, z: float | None, bound: float) -> Bar:
    """Compare the difference of two means, in standard errors, with its bound; print only a difference above the bound.

    Different means without noise have no z (None) and miss every bound.
    """
    return judge(AGREEMENT + label, sys.float_info.max if z is None else abs(z), AT_MOST, bound, quiet=True)


def find_disagreements(bars: list[Bar]) -> list[str]:
    """Labels of the means that differ. Time ratios of methods with different means are meaningless."""
    return [bar["figure"] for bar in bars if bar["figure"].startswith(AGREEMENT) and not bar["met"]]


# -- Studies -----------------------------------------------------------------------------------------------------------


def amount(full: Any, quick: Any = None, doc: str = "", kind: type | None = None) -> Any:
    """Declare a field of a :class:`Size`.

    Args:
        full: value for published figures.
        quick: value for CI; None: the same as ``full``.
        doc: description with the unit, for ``--help``.
        kind: type of the value on the command line; None: the type of ``full``.
    """
    kind = kind or (type(full[0]) if isinstance(full, tuple) else type(full))
    return field(default=full, metadata={"quick": full if quick is None else quick, "doc": doc, "kind": kind})


@dataclass(frozen=True)
class Size:
    """Amount of work of a study. Each field declared by :func:`amount` is also an option of the command line.

    Attributes:
        name: "full" or "quick", and the changed fields.
    """

    name: str = "full"

    @classmethod
    def quick(cls) -> Self:
        """The amount of work for CI."""
        return cls("quick", **{f.name: f.metadata["quick"] for f in fields(cls) if f.metadata})

    def changed(self, **values: Any) -> Self:
        """A size with other values, which its name lists."""
        return replace(self, name=", ".join([self.name, *(f"{key}={value}" for key, value in values.items())]), **values)


Question = Callable[[Any], dict]
"""Size -> answer for the JSON; the first line of the docstring is the question. An answer may hold NumPy arrays for the figure;
the JSON leaves them out."""


def ask(text: str, measure: Callable[..., dict], *arguments: object) -> Question:
    """Make a question from its text and a function of some arguments and the size."""
    question = partial(measure, *arguments)
    question.__doc__ = text
    return question


class SweptQuestion:
    """A question whose answer joins the answers to pieces, as scenes of a seed each, without a time among them.

    Attributes:
        split: size -> pieces, plain Python.
        compute: piece, size -> answer to the piece.
        join: size, answers by piece in their order -> answer; by default these answers.
    """

    def __init__(
        self,
        text: str,
        split: Callable[[Any], Sequence[Any]],
        compute: Callable[[Any, Any], dict],
        join: Callable[[Any, dict[Any, dict]], dict] = lambda size, answers: answers,
    ) -> None:
        """Make a question.

        Args:
            text: the question.
            split, compute, join: as the attributes.
        """
        self.__doc__ = text
        self.split, self.compute, self.join = split, compute, join

    def __call__(self, size: Any) -> dict:
        return self.join(size, {piece: self.compute(piece, size) for piece in self.split(size)})


Answer = Callable[[str, SweptQuestion, Any], dict]
"""Name of a question, the question, size -> answer, computed elsewhere."""

OpenCluster = Callable[["Study", argparse.Namespace], AbstractContextManager[Answer]]
"""Study, parsed command line -> what answers its swept questions."""


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        module: ``__name__`` of its module.
        doc: text of ``--help``: the docstring of the module, which begins with a question.
        size: class of its sizes.
        questions: by name.
        compare: name of a question, its answer -> figures beside bars that are not declared.
        draw: answers by question, path of the figure -> writes the figure.
        table: name of a question, its answer -> lines of a Markdown table; printed as progress.
        on_request: questions that only ``--only`` asks.
        promises: declared bars, by question.
    """

    module: str
    doc: str | None
    size: type[Size]
    questions: dict[str, Question]
    compare: Callable[[str, dict], list[Bar]] = lambda question, answer: []
    draw: Callable[[dict, Path], None] = lambda answers, path: None
    table: Callable[[str, dict], list[str]] = lambda question, answer: []
    on_request: tuple[str, ...] = ()
    promises: dict[str, list[Promise]] = field(default_factory=dict)

    def bars(self, question: str, answer: dict) -> list[Bar]:
        """Figures of an answer beside their bars."""
        return judge_promises(self.promises.get(question, []), answer) + self.compare(question, answer)

    @property
    def name(self) -> str:
        """Name on the command line."""
        return self.module.rpartition(".")[2]

    @property
    def stem(self) -> str:
        """Stem of the names of the JSON file and the figure, and default name of their folder."""
        return f"bench_{self.name}"

    def answer(self, names: Sequence[str], size: Size, elsewhere: Answer | None = None) -> dict:
        """Ask questions in turn; the answers by name, and the figures with a bar under ``bars``.

        Args:
            names: of the questions.
            size: amount of work.
            elsewhere: answers swept questions on the workers of a cluster; None: in this process.
        """
        answers, bars = {}, []
        for name in names:
            say(f"{name}: {(self.questions[name].__doc__ or '').splitlines()[0]}")
            question = self.questions[name]
            answers[name] = question(size) if elsewhere is None else elsewhere(name, question, size)
            if lines := self.table(name, answers[name]):
                say("\n".join(lines))
            bars += self.bars(name, answers[name])
        return {"bars": bars, **answers}

    def run(self, argv: Sequence[str], open_cluster: OpenCluster | None = None) -> int:
        """Read the command line, ask the questions, print the answers, and write JSON and figure.

        Args:
            argv: the command line.
            open_cluster: opens what answers swept questions, with ``--cluster``.

        Returns:
            Exit code: 0, or 1 after a refusal or if means differ that must agree.
        """
        args = self.parse(argv)
        try:
            self.check_cluster(args)
            with nullcontext() if args.cluster is None else open_cluster(self, args) as elsewhere:
                result = self.measure(args, elsewhere)
        except MivolError as error:
            say(f"mivol bench {self.name}: {error}")
            return 1
        if differing := find_disagreements(result["bars"]):
            say(f"the means differ ({'; '.join(differing)}): the ratios are meaningless")
        return 1 if differing else 0

    def measure(self, args: argparse.Namespace, elsewhere: Answer | None = None) -> dict:
        """Ask the questions of a parsed command line, and write the result, which is returned; as :meth:`answer`."""
        mi.set_variant(args.variant)
        start, load = time.perf_counter(), mean_load()
        answers = self.answer(args.only, args.size, elsewhere)
        result = header(args.size.name, args.variant, load, start) | answers
        args.out.mkdir(parents=True, exist_ok=True)
        self.draw({name: answer for name, answer in answers.items() if name != "bars"}, args.out / f"{self.stem}.png")
        text = json.dumps(without_arrays(result), indent=2, allow_nan=False) + "\n"
        write_whole_text(args.out / f"{self.stem}.json", text)
        sys.stdout.write(text)
        return result

    def check_cluster(self, args: argparse.Namespace) -> None:
        """Refuse ``--cluster`` for questions that measure this machine.

        Raises:
            MivolError: with the question.
        """
        timed = [name for name in args.only if not isinstance(self.questions[name], SweptQuestion)]
        if args.cluster is not None and timed:
            raise MivolError(
                f"{timed[0]} measures times or memory of this machine, or starts workers of its own: leave out --cluster, "
                "which random_scenes, depth and preparation take."
            )

    def parse(self, argv: Sequence[str]) -> argparse.Namespace:
        """Parse the command line; the process ends with a usage message if an argument is wrong.

        Returns:
            ``size``, ``only`` (the questions), ``out`` (the folder), ``cluster`` (None: no cluster) and ``variant``.
        """
        default = [name for name in self.questions if name not in self.on_request]
        parser = argparse.ArgumentParser(
            prog=f"mivol bench {self.name}", description=self.doc, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        parser.add_argument("--quick", action="store_true", help="small sizes, for CI: the times mean nothing")
        parser.add_argument("--only", default=",".join(default), help=f"questions to ask, of {','.join(self.questions)}")
        parser.add_argument("--out", type=Path, default=Path("runs") / self.stem, help="folder of the JSON file and the figure")
        parser.add_argument(
            "--cluster", metavar="WHERE", help="workers for questions without times: local:N, an address, a file"
        )
        parser.add_argument("--variant", default="llvm_ad_rgb", help="variant of Mitsuba (llvm_ad_rgb)")
        self._add_amounts(parser.add_argument_group("amount of work"))
        args = parser.parse_args(argv)
        args.only = tuple(args.only.split(","))
        if unknown := set(args.only) - set(self.questions):
            parser.error(f"--only: {', '.join(sorted(unknown))} is not a question; choose from {', '.join(self.questions)}")
        changes = {f.name: getattr(args, f.name) for f in fields(self.size) if getattr(args, f.name, None) is not None}
        changes = {key: tuple(value) if isinstance(value, list) else value for key, value in changes.items() if key != "name"}
        size = self.size.quick() if args.quick else self.size()
        args.size = size.changed(**changes) if changes else size
        return args

    def _add_amounts(self, group: argparse._ArgumentGroup) -> None:
        for f in fields(self.size):
            kind = f.metadata.get("kind")
            if kind not in (int, float, str, Path):
                continue
            flag, text = f"--{f.name.replace('_', '-')}", f"{f.metadata['doc']} ({f.default})".replace("%", "%%")
            group.add_argument(flag, type=kind, help=text, nargs="+" if type(f.default) is tuple else None)


def header(size: str, variant: str, load: float | None, start: float) -> dict:
    """First values of every JSON file: size, machine, versions, load of the machine, seconds since ``start``."""
    return {
        "size": size,
        "machine": msgspec.to_builtins(describe_machine()),
        "versions": package_versions(),
        "date": time.strftime("%Y-%m-%d"),
        "variant": variant,
        "threads": dr.thread_count(),
        "load_before_and_after": [load, mean_load()],
        "seconds": round(time.perf_counter() - start, 1),
    }


def mean_load() -> float | None:
    """Mean number of runnable processes in the last minute; None on Windows."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def without_arrays(answer: object) -> object:
    """Copy an answer without its NumPy arrays, and without tables of nothing but arrays."""
    if not isinstance(answer, dict):
        return answer
    kept = {name: without_arrays(value) for name, value in answer.items() if not isinstance(value, np.ndarray)}
    return {name: value for name, value in kept.items() if value != {} or answer[name] == {}}
