"""A sweep: one experiment with several values of some settings, a run folder each, and one table and one page of all.

Conventions. All combinations are made, the last ``--over`` varies fastest. All are checked before the first run. ``sweep.json``
keeps the finished combinations; the same command again runs the missing ones, continues interrupted runs from their checkpoint,
and keeps the others. A refused combination (a learning rate that makes the loss infinite) is a row with its reason.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import re
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from mivol import config
from mivol.display import to_toml
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, Progress, RunContext
from mivol.experiments.kinds import run_experiment
from mivol.experiments.run_folder import CHECKPOINT, SECONDS_BETWEEN_PAGES
from mivol.files.atomic import disk_faults, lock_folder, write_whole_text
from mivol.report.page import SweepNews, SweepRow, write_sweep_page
from mivol.report.record import RECORD, find_quantity, read_record

STATE, TABLE = "sweep.json", "sweep.csv"

MOST_RUNS = 10_000
"""Combinations at most: more are a mistyped range."""

LONGEST_NAME = 120
"""Characters of a run folder's name."""


@dataclass(frozen=True)
class SweepRun:
    """One combination.

    Attributes:
        name: name of the run folder inside of the sweep's folder.
        values: swept values, by setting.
        settings: all settings of the experiment.
        digest: hash of the settings with effect on the result.
    """

    name: str
    values: dict[str, Any]
    settings: config.Experiment
    digest: str


@dataclass(frozen=True)
class Sweep:
    """All runs of a sweep.

    Attributes:
        title: of the experiment.
        base: folder from which relative paths in the settings start.
        folder: folder of the sweep.
        keys: swept settings.
        runs: all combinations.
        command: command line, for the records.
    """

    title: str
    base: Path
    folder: Path
    keys: tuple[str, ...]
    runs: tuple[SweepRun, ...]
    command: str

    def context(self, run: SweepRun, progress: Progress | None = None) -> RunContext:
        """The context of a run, which continues from a checkpoint of an interrupted run with the same settings."""
        folder = self.folder / run.name
        resume = is_interrupted(folder, run.settings)
        return RunContext(run.settings, self.base, folder, resume, progress or NullProgress(), self.command)


def is_interrupted(folder: Path, settings: config.Experiment) -> bool:
    """Whether a run folder has the checkpoint of an unfinished run with these settings."""
    from mivol.optim import checkpoint

    with suppress(MivolError):
        checkpoint.check_settings(folder / CHECKPOINT, config.flatten_settings(config.list_all_settings(settings)))
        return read_record(folder).status != "finished"
    return False


def parse_over(texts: Sequence[str]) -> dict[str, list[Any]]:
    """Values by setting from ``key=value,value`` and ``key=first..last`` of the command line.

    Raises:
        MivolError: no "=", no value, a range that does not rise, the same value twice, a key twice, or too many combinations.
    """
    found: dict[str, list[Any]] = {}
    for text in texts:
        key, equals, words = text.partition("=")
        key = key.strip()
        values = _parse_values(words, text) if equals and key else []
        if not values:
            raise MivolError(f'--over "{text}" has no values: write key.of.setting=1,2,3 or seed=0..9.')
        if key in found:
            raise MivolError(f"--over names {key} twice: write all of its values once.")
        double = next((value for number, value in enumerate(values) if value in values[:number]), None)
        if double is not None:
            raise MivolError(f'--over "{text}" has the value {double} twice: write each value once.')
        found[key] = values
    if not found:
        raise MivolError("a sweep needs values to sweep over: add --over key.of.setting=1,2,3.")
    count = 1
    for values in found.values():
        count *= len(values)
    if count > MOST_RUNS:
        raise MivolError(f"these values make {count:,} runs, expected at most {MOST_RUNS:,}: give fewer values.")
    return found


def _parse_values(words: str, text: str) -> list[Any]:
    """The values after "="; a value outside TOML's syntax is a text."""
    if match := re.fullmatch(r"\s*(-?\d+)\.\.(-?\d+)\s*", words):
        first, last = int(match[1]), int(match[2])
        if first >= last or last - first >= MOST_RUNS:
            raise MivolError(f'--over "{text}" is no range: write the smaller number first, at most {MOST_RUNS:,} of them.')
        return list(range(first, last + 1))
    with suppress(ValueError):
        return tomllib.loads(f"values = [{words}]")["values"]
    return [_parse_value(word.strip()) for word in words.split(",") if word.strip()]


def _parse_value(word: str) -> Any:
    try:
        return tomllib.loads(f"value = {word}")["value"]
    except ValueError:
        return word


def plan_sweep(path: Path, over: Sequence[str], changes: Sequence[str], folder: Path | None = None, command: str = "") -> Sweep:
    """Make and check the settings of all runs.

    Args:
        path: experiment (.toml).
        over: values by setting, as :func:`parse_over`.
        changes: ``a.b=c`` for all runs.
        folder: folder of the sweep; None: the experiment's output with ``_sweep``.
        command: command line, for the records.

    Raises:
        MivolError: as :func:`parse_over` and :func:`mivol.config.load`, with the first wrong combination.
    """
    values = parse_over(over)
    runs, names = [], set()
    first = config.load(path, changes)
    for combination in itertools.product(*values.values()):
        chosen = dict(zip(values, combination, strict=True))
        settings = config.load(path, [*changes, *(f"{key}={to_toml(value)}" for key, value in chosen.items())])
        flat = config.flatten_settings(config.list_all_settings(settings))
        digest = hashlib.sha256(msgspec.json.encode(flat, order="sorted")).hexdigest()
        name = run_name(chosen)
        runs.append(SweepRun(name if name not in names else f"{name}-{digest[:8]}", chosen, settings, digest))
        names.add(name)
    output = Path(f"{first.output.rstrip('/')}_sweep") if folder is None else folder
    return Sweep(first.title, path.parent, output, tuple(values), tuple(runs), command)


def run_name(values: dict[str, Any]) -> str:
    """Name of a run folder: the last part of each setting with its value, in the characters that every disk allows."""
    words = []
    for key, value in values.items():
        same = [other for other in values if other.rpartition(".")[2] == key.rpartition(".")[2]]
        words.append(f"{key if len(same) > 1 else key.rpartition('.')[2]}={_format_value(value)}")
    name = re.sub(r"[^A-Za-z0-9_.=+-]+", "-", "_".join(words))
    if len(name) <= LONGEST_NAME:
        return name
    return f"{name[: LONGEST_NAME - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _format_value(value: Any) -> str:
    """A value as people write it."""
    return f"{value:g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


# -- Runs --------------------------------------------------------------------------------------------------------------------

Tell = Callable[[SweepNews], None]
"""Receives how the work proceeds."""

Execute = Callable[[Sweep, Iterator[SweepRun], Tell], Iterator[tuple[SweepRun, str]]]
"""Runs combinations, and yields each as it ends, with the reason of a refusal or ""."""


def run_in_turn(progress: Progress) -> Execute:
    """The function that runs combinations one after another in this process."""

    def execute(sweep: Sweep, runs: Iterator[SweepRun], tell: Tell) -> Iterator[tuple[SweepRun, str]]:
        for run in runs:
            progress.say([f"run {run.name}"])
            tell(SweepNews({run.name: ""}, is_running=True))
            try:
                run_experiment(sweep.context(run, progress))
            except MivolError as error:
                if is_fault_of_disk(error):
                    raise
                yield run, str(error)
            else:
                yield run, ""

    return execute


def is_fault_of_disk(error: BaseException) -> bool:
    """Whether a refusal comes from the disk or a lock, and so would stop every run."""
    return isinstance(error.__cause__, OSError) or "another run uses the folder" in str(error)


class SweepFolder:
    """The folder of a sweep: which runs have ended, the table and the page."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep, self.news, self.written = sweep, SweepNews(), 0.0
        self.state: dict[str, dict[str, str]] = {}
        with suppress(OSError, ValueError, TypeError, AttributeError):
            self.state = dict(json.loads((sweep.folder / STATE).read_text(encoding="utf-8"))["runs"])

    def has(self, run: SweepRun) -> bool:
        """Whether a run has ended, with the same settings."""
        known = self.state.get(run.name, {})
        if known.get("settings") != run.digest:
            return False
        return bool(known.get("refused")) or (self.sweep.folder / run.name / RECORD).is_file()

    def note(self, run: SweepRun, refusal: str) -> None:
        """Note the end of a run, and write the table and the page."""
        self.state[run.name] = {"settings": run.digest, "refused": refusal}
        names = {run.name for run in self.sweep.runs}
        kept = {name: entry for name, entry in self.state.items() if name in names or (self.sweep.folder / name).is_dir()}
        write_whole_text(self.sweep.folder / STATE, json.dumps({"runs": kept}, indent=1, ensure_ascii=False) + "\n")
        self.write()

    def tell(self, news: SweepNews) -> None:
        """Note how the work proceeds, and write the page from time to time."""
        self.news = news
        if time.monotonic() - self.written > SECONDS_BETWEEN_PAGES:
            self.write()

    def end(self) -> Path:
        """Write the page of a sweep that is not under way any more."""
        self.news = replace(self.news, progress={}, is_running=False)
        return self.write()

    def rows(self) -> list[SweepRow]:
        """One row a combination."""
        return [self._row(run) for run in self.sweep.runs]

    def _row(self, run: SweepRun) -> SweepRow:
        row = SweepRow(run.name, {key: _format_value(value) for key, value in run.values.items()})
        if not self.has(run):
            progress = self.news.progress.get(run.name)
            return row if progress is None else replace(row, status="running", reason=progress)
        if refusal := self.state[run.name]["refused"]:
            return replace(row, status="refused", reason=refusal)
        record = read_record(self.sweep.folder / run.name)
        units = {name: find_quantity(name, record.units).symbol for name in record.results}
        return replace(row, status=record.status, results=dict(record.results), units=units)

    def write(self) -> Path:
        """Write ``sweep.csv`` and ``sweep.html``; return the page."""
        self.written = time.monotonic()
        rows = self.rows()
        names = list(dict.fromkeys(name for row in rows for name in row.results))
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["run", *self.sweep.keys, "status", *names, "reason"])
        for row in rows:
            results = [row.results.get(name, "") for name in names]
            table.writerow([row.name, *row.values.values(), row.status, *results, row.reason])
        write_whole_text(self.sweep.folder / TABLE, text.getvalue())
        return write_sweep_page(self.sweep.folder, self.sweep.title, self.sweep.keys, rows, self.news)


def run_sweep(sweep: Sweep, execute: Execute, say: Callable[[list[str]], None] = lambda lines: None) -> tuple[Path, int]:
    """Run the missing combinations of a sweep.

    Args:
        sweep: from :func:`plan_sweep`.
        execute: :func:`run_in_turn`, or ``mivol.cluster.sweep.run_on``.
        say: receives lines about the sweep.

    Returns:
        The page, and the number of refused combinations.

    Raises:
        MivolError: another sweep uses the folder, or a disk error.
        KeyboardInterrupt: Ctrl-C; finished runs are kept, and the same command continues.
    """
    with disk_faults(sweep.folder, "room for a folder"):
        sweep.folder.mkdir(parents=True, exist_ok=True)
    with lock_folder(sweep.folder):
        state = SweepFolder(sweep)
        missing = [run for run in sweep.runs if not state.has(run)]
        kept = len(sweep.runs) - len(missing)
        say([f"sweep of {len(sweep.runs)} runs" + (f", {kept} of them finished before" if kept else "")])
        try:
            for run, refusal in execute(sweep, iter(missing), state.tell):
                state.note(run, refusal)
                ended = sum(map(state.has, sweep.runs))
                say([f"{ended} of {len(sweep.runs)} runs: {run.name} " + (f"refused: {refusal}" if refusal else "finished")])
        except BaseException:
            with suppress(MivolError):
                state.end()
            raise
        page = state.end()
        return page, sum(row.status == "refused" for row in state.rows())
