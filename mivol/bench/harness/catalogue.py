"""The studies by name, and the changes of a result since an older one."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import pkgutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from mivol.bench import studies
from mivol.bench.harness.study import Answer, Size, Study, SweptQuestion, say
from mivol.cluster.connection import open_pool
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.optim.strategy import suggest_name

__all__ = ["find_changes", "list_studies", "load_study", "run_study", "study_names"]

NOTABLE = 0.1
"""Smallest relative change that is listed. Times on a shared machine vary as much."""


def study_names() -> list[str]:
    """Names of all studies: the modules and packages in ``mivol/bench/studies``."""
    return [module.name for module in pkgutil.iter_modules(studies.__path__)]


def load_study(name: str) -> Study:
    """Import a study.

    Raises:
        MivolError: unknown name.
    """
    if name not in study_names():
        raise MivolError(f'there is no study "{name}": {suggest_name(name, study_names())}')
    return importlib.import_module(f"{studies.__name__}.{name}").STUDY


def list_studies() -> str:
    """The studies with their questions, one in each line."""
    width = max(map(len, study_names()))
    return "\n".join(f"{name:<{width}}  {(load_study(name).doc or '').splitlines()[0]}" for name in study_names())


def compute_piece(place: Workplace, study: str, question: str, piece: Any, size: Size) -> dict:
    """Answer a piece of a question in a worker."""
    return load_study(study).questions[question].compute(piece, size)


def answer_on(pool: Pool, study: str, name: str, question: SweptQuestion, size: Size) -> dict:
    """Answer a question on workers. A piece depends on its number and the size only, so the answer does not depend on workers.

    Args:
        pool: workers.
        study, name: names of the study and of its question.
        question: the question.
        size: amount of work.

    Raises:
        MivolError: a refusal of a worker, or as :meth:`mivol.cluster.pool.Pool.run`.
    """
    pieces, found = list(question.split(size)), {}
    for piece, answer in pool.run(Unit(piece, compute_piece, (study, name, piece, size)) for piece in pieces):
        found[piece] = answer
        say(f"  {pool.describe()}, {len(found)} of {len(pieces)} pieces")
    return question.join(size, {piece: found[piece] for piece in pieces})


@contextmanager
def open_cluster(study: Study, args: argparse.Namespace) -> Iterator[Answer]:
    """Pool for the swept questions of a study: the workers of ``--cluster``, with one thread each.

    Raises:
        MivolError: as :func:`mivol.cluster.connection.open_pool`.
    """
    with open_pool(args.cluster, args.variant, 1, say) as pool:
        yield partial(answer_on, pool, study.name)
        for line in pool.describe_losses():
            say(line)


def run_study(name: str, argv: Sequence[str], older: Path | None) -> int:
    """Run a study.

    Args:
        name: name of the study.
        argv: its options.
        older: JSON file of an earlier run; the changes since then are printed.

    Returns:
        Exit code of :meth:`Study.run`.

    Raises:
        MivolError: unknown study, unreadable older result, or a result of another kind; before any measurement.
    """
    study, before = load_study(name), None
    if older is not None:
        before, args = read_result(older), study.parse(argv)
        check_kind(name, before, args.size.name, args.only)
    code = study.run(argv, open_cluster)
    if before is not None and code == 0:
        changes = find_changes(before, read_result(args.out / f"{study.stem}.json"))
        say("\n".join(changes) or f"no figure has changed by {NOTABLE:.0%} or more")
    return code


def check_kind(name: str, before: dict, size: str, questions: Sequence[str]) -> None:
    """Refuse an older result of another study, of other questions or of another size.

    Raises:
        MivolError: the result is of another kind.
    """
    if not any(question in before for question in questions):
        raise MivolError(
            f"the older result answers no question of {name} in this run ({', '.join(questions)}): "
            f"give the JSON file of mivol bench {name}."
        )
    if before.get("size") != size:
        raise MivolError(
            f"the size of the older result is {before.get('size')}, and the size of this run is {size}: "
            "use the options of the older run."
        )


def read_result(path: Path) -> dict:
    """Read the JSON file of a study.

    Raises:
        MivolError: the file is missing, or is not the JSON of a study.
    """
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise MivolError(f"{path} is not the result of a study ({error}): give the JSON file of mivol bench.") from None
    if not isinstance(result, dict):
        raise MivolError(f"{path} is not the result of a study: give the JSON file of mivol bench.")
    return result


def find_changes(before: dict, now: dict) -> list[str]:
    """List the numbers in both results that differ by ``NOTABLE`` or more, the largest change first."""
    old, new = dict(list_numbers(before)), dict(list_numbers(now))
    ratios = {key: new[key] / old[key] for key in new if key in old and old[key] * new[key] > 0}
    notable = sorted((key for key, r in ratios.items() if abs(r - 1) >= NOTABLE), key=lambda key: -abs(math.log(ratios[key])))
    return [f"{key}: {old[key]:.4g} -> {new[key]:.4g} (x {ratios[key]:.3g})" for key in notable]


def list_numbers(tree: object, prefix: str = "") -> list[tuple[str, float]]:
    """All numbers of a result by dotted key, without the numbers of the machine and the run."""
    if isinstance(tree, bool):
        return []
    if isinstance(tree, int | float):
        return [(prefix, float(tree))]
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    skipped = ("machine", "versions", "date", "threads", "load_before_and_after", "seconds", "bars") if not prefix else ()
    return [pair for key, value in items if key not in skipped for pair in list_numbers(value, f"{prefix}.{key}".lstrip("."))]
