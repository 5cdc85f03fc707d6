"""Every bench by its name, and what has changed in its figures since an older result."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Sequence
from pathlib import Path

from mivol.bench.harness.bars import say
from mivol.bench.harness.study import Expected
from mivol.errors import MivolError
from mivol.optim.strategy import suggest_name

__all__ = ["STUDIES", "changes", "list_studies", "run_study"]

STUDIES = {
    "optical_depth": "bench_optical_depth",
    "single_scattering": "bench_single_scattering",
    "multiple_scattering": "bench_multiple_scattering",
    "gradients": "bench_gradients",
    "tomography": "tomography",
    "radiance_field": "bench_radiance_field",
    "still_life": "bench_still_life",
    "media_light": "bench_media_light",
    "depth": "bench_depth",
    "random_scenes": "bench_random_scenes",
    "ladder": "bench_ladder",
    "points": "bench_points",
    "representations": "bench_representations",
}
"""Module of ``mivol.bench`` -> stem of the JSON that it writes."""

NOTABLE = 0.1
"""Relative change of a figure from which on it is listed; times on a shared machine vary by as much."""


def list_studies() -> str:
    """The studies with their questions, one a line."""
    width = max(map(len, STUDIES))
    asked = {
        name: (importlib.import_module(f"mivol.bench.studies.{name}").__doc__ or "").partition("\n")[0] for name in STUDIES
    }
    return "\n".join(f"{name:<{width}}  {question}" for name, question in asked.items())


def run_study(name: str, argv: Sequence[str], older: Path | None = None) -> int:
    """Run a study; its exit code.

    Args:
        name: key of ``STUDIES``.
        argv: the study's own flags.
        older: a JSON that the study wrote before: what has changed since is said.

    Raises:
        MivolError: no such study, or an older result that cannot be read or is of another kind; before anything is measured.
    """
    if name not in STUDIES:
        raise MivolError(f'there is no study "{name}": {suggest_name(name, list(STUDIES))}')
    study = importlib.import_module(f"mivol.bench.studies.{name}")
    before = None
    if older is not None:
        before = read_result(older)
        check_kind(name, before, study.BENCH.expected(argv) if hasattr(study, "BENCH") else study.expected(argv))
    code = study.main(list(argv))
    if before is not None and code == 0:
        now = read_result(folder_of(name, argv) / f"{STUDIES[name]}.json")
        say("\n".join(changes(before, now)) or f"no figure has changed by {NOTABLE:.0%} or more")
    return code


def check_kind(name: str, before: dict, expected: Expected) -> None:
    """Refuse an older result of another study, of other questions or of another size.

    Raises:
        MivolError: what it is, and what will be measured.
    """
    if not any(question in before for question in expected.questions):
        raise MivolError(
            f"the older result answers none of the questions of {name} that are asked ({', '.join(expected.questions)}): "
            f"give the JSON that mivol bench {name} wrote."
        )
    for key, value in expected.same.items():
        if before.get(key) != value:
            raise MivolError(
                f"the older result is of the {key} {before.get(key)} and this one {value}: "
                "compare like with like, by the flags that it was made with."
            )


def folder_of(name: str, argv: Sequence[str]) -> Path:
    """Where a study writes: what follows ``--out``, or its default."""
    flags = [part for flag in argv for part in (flag.split("=", 1) if flag.startswith("--out=") else [flag])]
    return Path(flags[flags.index("--out") + 1]) if "--out" in flags[:-1] else Path("runs") / f"bench_{name}"


def read_result(path: Path) -> dict:
    """What a study wrote.

    Raises:
        MivolError: no such file, or not JSON of a study.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise MivolError(f"{path} is no result of a study ({error}): give the JSON that mivol bench wrote.") from None
    if not isinstance(found, dict):
        raise MivolError(f"{path} is no result of a study: give the JSON that mivol bench wrote.")
    return found


def changes(before: dict, now: dict) -> list[str]:
    """Figures that differ by ``NOTABLE`` or more, the largest change first; figures that only one result has are left out."""
    old, new = dict(numbers_in(before)), dict(numbers_in(now))
    ratios = {key: new[key] / old[key] for key in new if key in old and old[key] * new[key] > 0}
    notable = [key for key, ratio in ratios.items() if abs(ratio - 1) >= NOTABLE]
    notable.sort(key=lambda key: -abs(math.log(ratios[key])))
    return [f"{key}: {old[key]:.4g} -> {new[key]:.4g} (x {ratios[key]:.3g})" for key in notable]


def numbers_in(tree: object, prefix: str = "") -> list[tuple[str, float]]:
    """Every number of a result by dotted key, without the machine's and the run's own."""
    if isinstance(tree, bool):
        return []
    if isinstance(tree, int | float):
        return [(prefix, float(tree))]
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    skipped = ("machine", "versions", "threads", "load_before_and_after", "seconds", "bars") if not prefix else ()
    found = []
    for key, value in items:
        if key not in skipped:
            found += numbers_in(value, f"{prefix}.{key}".lstrip("."))
    return found
