"""The record of a run: ``run.json`` and ``metrics.jsonl`` in the run folder.

Conventions. ``run.json`` holds one :class:`RunRecord`, rewritten whole at every change of state; its fields are the schema,
and unknown fields are errors. ``metrics.jsonl`` grows by one line per iteration. Paths are relative to the run folder, with
forward slashes. Times are in seconds, memory is in GiB. Numbers that are not finite become ``null``. Both files hide the
machine, the user and the folders: an absolute path in the settings is cut to the file name.

Files of a run folder: ``run.json``, ``metrics.jsonl``, ``report.html`` (:mod:`mivol.report.page`), and the images and
volumes listed in the record.
"""

from __future__ import annotations

import json
import math
import platform
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import msgspec

from mivol.errors import MivolError
from mivol.files import write_whole_text
from mivol.files.atomic import disk_faults
from mivol.machine import count_cores

RECORD = "run.json"
METRICS = "metrics.jsonl"
LINES = "line integral"
"""Quantity of a projection; the page calls projections measured and modelled."""
CODES = "sRGB value"
"""Quantity of a photograph and of its render."""
SINOGRAM = "sinogram"
"""View made of one detector row in all views."""
DAMAGE = (msgspec.DecodeError, UnicodeDecodeError)
"""Errors of msgspec for text that is not JSON of the expected type."""
PACKAGES = ("mivol", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "h5py", "msgspec", "matplotlib")


class Quantity(NamedTuple):
    """Label, unit and axis of a number in ``results`` or ``metrics.jsonl``.

    ``nrmse`` is the RMS error over all voxels divided by the RMS of the truth. The peak of ``psnr`` is the largest value of
    the reference.

    Attributes:
        label: name for people.
        unit: "1" for a dimensionless quantity, empty for a count, for a ratio and for an unknown unit.
        log: whether curves have a logarithmic axis.
    """

    label: str
    unit: str = ""
    log: bool = True

    @property
    def symbol(self) -> str:
        """The unit beside a number: ``[1]`` for a dimensionless quantity."""
        return "[1]" if self.unit == "1" else self.unit


QUANTITIES: dict[str, Quantity] = {
    "loss": Quantity("Loss"),
    "residual": Quantity("Residual |Ax − y| / |y|"),
    "discrepancy": Quantity("RMS of residual over noise (noise level: 1)"),
    "held_out_rms_of_residual_over_noise": Quantity("RMS of residual over noise, held-out views"),
    "gradient": Quantity("Gradient norm"),
    "nrmse": Quantity("nRMSE of the volume"),
    "psnr": Quantity("PSNR of the fitted views", "dB", log=False),
    "held_out_psnr": Quantity("PSNR of the held-out views", "dB", log=False),
    "psnr_colour_fitted": Quantity("PSNR of the held-out views after colour correction", "dB", log=False),
    "psnr_aligned": Quantity("PSNR of the held-out views after an alignment of their poses", "dB", log=False),
    "few_psnr": Quantity("PSNR of the same few held-out views", "dB", log=False),
    "ssim": Quantity("SSIM of the held-out views", log=False),
    "flip": Quantity("FLIP of the held-out views", log=False),
    "nodes": Quantity("Stored nodes", log=False),
    "gaussians": Quantity("Gaussians", log=False),
    "leaves": Quantity("Leaves", log=False),
    "numbers": Quantity("Fitted numbers", log=False),
    "samples": Quantity("Samples of a ray", log=False),
    "bytes": Quantity("Memory of the field", "MiB", log=False),
    "seconds": Quantity("Time", "s"),
    "fit_seconds": Quantity("Fit time", "s"),
    "iterations": Quantity("Iterations", log=False),
    "views": Quantity("Fitted views", log=False),
    "memory": Quantity("Peak memory", "MiB", log=False),
}


def find_quantity(name: str, units: Mapping[str, str]) -> Quantity:
    """Return label, unit and axis of a number: its entry in ``QUANTITIES``, with the unit of the run.

    Args:
        name: key in ``results`` or ``metrics.jsonl``. A key outside ``QUANTITIES`` that has a unit in the run is a parameter
            of the scene: it keeps its name and a linear axis.
        units: units of the run, by key.
    """
    known = QUANTITIES.get(name)
    if known is None:
        return Quantity(name, units[name], log=False) if name in units else Quantity(name.replace("_", " "))
    return known._replace(unit=units.get(name, known.unit))


def join_channels(numbers: Iterable[tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    """Join the figures of all channels of a parameter, whose labels are ``label[0]``, ``label[1]``.

    Args:
        numbers: figure, symbol of the unit, and label.
    """
    groups: dict[tuple[str, str], list[str]] = {}
    for figure, symbol, label in numbers:
        groups.setdefault((symbol, re.sub(r"\[\d+\]$", "", label)), []).append(figure)
    return [(" ".join(figures), symbol, label) for (symbol, label), figures in groups.items()]


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    pass


class PlanLine(_Entry):
    """One choice of the plan with its reason."""

    choice: str
    reason: str


class Image(_Entry):
    """An image of the run: linear values (height, width[, 1 or 3]) in ``.exr`` or ``.npy``, or a ``.png`` or ``.mp4`` to show.

    Images of the same ``view`` belong together: the page shows ``reference`` and ``render`` beside their difference, and the
    z-image (difference divided by standard error) if the view has a ``standard error``.
    """

    path: str
    role: Literal["reference", "render", "difference", "standard error", "slice", "picture", "film"]
    view: str = ""
    held_out: bool = False
    layer: str = ""
    """Layer of an OpenEXR file; empty for the main image or the only channel."""
    quantity: str = "radiance"
    unit: str = ""
    caption: str = ""
    small: bool = False
    """Whether the page shows the image in a scrollable list."""


class Volume(_Entry):
    """A grid of the run, (Z, Y, X, C), in any format of :func:`mivol.files.read_volume`."""

    path: str
    role: Literal["truth", "reconstruction", "start"]
    quantity: str = "sigma_t"
    unit: str = "1/length"
    size: tuple[float, float, float] | None = None
    """Edges of the box along x, y, z [length]; by default from the ``to_world`` of the file."""
    caption: str = ""
    profiles: bool = False
    """Whether the page shows profiles along the three axes through the middle voxel."""


class Table(_Entry):
    """A table of the page: header and rows; the first column is text."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Machine(_Entry):
    """The properties of the machine that determine speed."""

    cores: int
    memory: float | None = None
    """GiB of main memory."""
    device: str = ""


class RunRecord(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """The content of ``run.json``."""

    title: str
    machine: Machine
    schema: Literal[1] = 1
    judged: str = ""
    """Number and size of the held-out views behind the results."""
    method: str = ""
    """Model, solver and optimised parameters in one line."""
    status: Literal["running", "finished", "stopped"] = "running"
    started: str = ""
    """UTC, ISO 8601, to the second."""
    command: str = ""
    config: dict[str, Any] = {}
    versions: dict[str, str] = {}
    seeds: dict[str, int] = {}
    plan: list[PlanLine] = []
    timings: dict[str, float] = {}
    """Seconds by stage, in order; the stages do not overlap."""
    results: dict[str, float | None] = {}
    """Final numbers by name; :data:`QUANTITIES` has the labels."""
    units: dict[str, str] = {}
    """Units of numbers in ``results`` and ``metrics.jsonl`` that depend on the fit; "1" for dimensionless numbers."""
    images: list[Image] = []
    volumes: list[Volume] = []
    tables: list[Table] = []
    notes: list[str] = []
    """Sentences for the reader: limits, refusals, events."""
    citations: list[str] = []
    """Keys of :data:`mivol.cite.CITATIONS`."""

    @classmethod
    def new(cls, title: str, *, device: str = "", **fields: Any) -> RunRecord:
        """Return the record of a run starting now on this machine, with the installed versions."""
        now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        return cls(title=title, machine=describe_machine(device), versions=package_versions(), started=now, **fields)


def package_versions() -> dict[str, str]:
    """Return the versions of Python, the system and the installed packages of ``PACKAGES``."""
    versions = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def describe_machine(device: str = "") -> Machine:
    """Return the usable cores, the main memory and ``device``, by default the model of the processor."""
    return Machine(cores=count_cores(), memory=_memory(), device=device or _processor())


def _memory() -> float | None:
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return None
    return round(int(meminfo.read_text().split()[1]) / 2**20, 1)


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    named = re.search(r"^model name\s*:\s*(.+)$", cpuinfo.read_text() if cpuinfo.exists() else "", re.MULTILINE)
    return named[1] if named else platform.machine()


def write_record(record: RunRecord, folder: str | Path) -> Path:
    """Write ``run.json``, whole or not at all.

    Absolute paths inside ``config``, ``command``, ``plan``, ``notes``, ``title`` and ``method`` are cut to the file name.

    Raises:
        MivolError: an image or a volume outside the run folder.
    """
    for part in (*record.images, *record.volumes):
        _check_inside(part.path)
    plain = msgspec.to_builtins(record)
    for field in ("config", "command", "plan", "notes", "title", "method"):
        plain[field] = _hide_folders(plain[field])
    path = Path(folder) / RECORD
    write_whole_text(path, json.dumps(_null_nonfinite(plain), indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    return path


def read_record(folder: str | Path) -> RunRecord:
    """Read ``run.json``.

    Raises:
        MivolError: no file, no JSON, an unknown, missing or wrong field, or a path outside the run folder.
    """
    path = Path(folder) / RECORD
    if not path.is_file():
        raise MivolError(f'no {RECORD} in "{Path(folder).name}"; give a run folder written by `mivol optimize`.')
    try:
        record = msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except DAMAGE as error:
        raise MivolError(f"{RECORD} is not the record of a run: {error}; restore it or make the run again.") from None
    for part in (*record.images, *record.volumes):
        _check_inside(part.path)
    return record


def append_metrics(folder: str | Path, iteration: int, seconds: float, **values: float) -> None:
    """Append one line to ``metrics.jsonl``: iteration, seconds since the start, and numbers by name.

    :func:`read_metrics` skips a half-written last line.

    Raises:
        MivolError: full disk, exceeded quota, missing permission or another error of the system.
    """
    row = {"iteration": int(iteration), "seconds": float(seconds)} | {name: float(v) for name, v in values.items()}
    path = Path(folder) / METRICS
    with disk_faults(path, "room for another line"), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(_null_nonfinite(row), allow_nan=False) + "\n")


def read_metrics(folder: str | Path) -> list[dict[str, float | None]]:
    """Return the rows of ``metrics.jsonl`` in order, without the half-written last line of a killed run.

    Without the file the list is empty.

    Raises:
        MivolError: a complete line is not a JSON object.
    """
    path = Path(folder) / METRICS
    if not path.is_file():
        return []
    *whole, _ = path.read_bytes().split(b"\n")
    try:
        return [msgspec.json.decode(line, type=dict[str, float | None]) for line in whole]
    except DAMAGE as error:
        raise MivolError(f"{METRICS} has a line that is not an object of numbers: {error}; remove that line.") from None


def rewind_metrics(folder: str | Path, iteration: int) -> None:
    """Remove the rows after ``iteration``, which a resumed run writes again."""
    rows = [row for row in read_metrics(folder) if row["iteration"] <= iteration]
    text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    write_whole_text(Path(folder) / METRICS, text)


def _check_inside(path: str) -> None:
    pure = PurePosixPath(path)
    if not path or pure.is_absolute() or ".." in pure.parts or "\\" in path:
        raise MivolError(f'the record names "{path}"; give a path inside the run folder, relative to it.')


_ABSOLUTE_PATH = re.compile(r"(?<![\w.:/\\])(?:~?/(?:[^\s/\"'=,;]+/)+|[A-Za-z]:\\(?:[^\s\\\"']+\\)+)")


def _hide_folders(value: Any) -> Any:
    """Remove the folders of absolute paths from all strings of a nested value."""
    if isinstance(value, str):
        return _ABSOLUTE_PATH.sub("", value)
    if isinstance(value, dict):
        return {key: _hide_folders(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_hide_folders(item) for item in value]
    return value


def _null_nonfinite(value: Any) -> Any:
    """Replace all numbers of a nested value that are not finite by ``None``."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _null_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_null_nonfinite(item) for item in value]
    return value
