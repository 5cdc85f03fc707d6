"""What was done and what came of it: ``run.json`` and ``metrics.jsonl`` in a run's folder.

Conventions. ``run.json`` holds one :class:`RunRecord`, written whole at every change of state; its fields are the
schema, unknown ones are errors. ``metrics.jsonl`` grows by one line an iteration. Paths are relative to the folder, with
forward slashes. Times are seconds, memory GiB. Numbers that are not finite are ``null``. Nothing in either names the
machine, its user or a place on its disk: of an absolute path in the configuration only the file's own name is kept.

Files of a run folder: ``run.json``, ``metrics.jsonl``, ``report.html`` (:mod:`mivol.report.page`), and the images and
volumes that the record lists, wherever it says they are.
"""

from __future__ import annotations

import json
import math
import platform
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import msgspec

from mivol.errors import MivolError
from mivol.files import write_whole_text
from mivol.files.atomic import disk_faults
from mivol.machine import cores

__all__ = [
    "QUANTITIES",
    "Image",
    "Machine",
    "PlanLine",
    "Quantity",
    "RunRecord",
    "Table",
    "Volume",
    "append_metrics",
    "describe_machine",
    "find_quantity",
    "read_metrics",
    "read_record",
    "rewind_metrics",
    "package_versions",
    "write_record",
]

RECORD = "run.json"
METRICS = "metrics.jsonl"
LINES = "line integral"
"""The quantity of a projection, which is measured and modelled, not rendered."""
CODES = "sRGB value"
"""The quantity of a photograph, and of what is held against it."""
SINOGRAM = "sinogram"
"""The view that holds one row of a detector in all views."""
DAMAGE = (msgspec.DecodeError, UnicodeDecodeError)
"""What msgspec raises on text that is no JSON of the wanted kind."""
PACKAGES = ("mivol", "mitsuba", "drjit", "numpy", "scipy", "OpenEXR", "h5py", "msgspec", "matplotlib")


class Quantity(NamedTuple):
    """How a number of ``results`` or ``metrics.jsonl`` is named, drawn and printed.

    ``nrmse`` is the root mean square error over all voxels divided by the truth's root mean square; ``psnr`` takes the
    reference's largest value as its peak.
    """

    label: str
    unit: str = ""
    log: bool = True

    @property
    def beside(self) -> str:
        """The unit as it stands beside a figure: [1] is a pure number, "" a count, a ratio that the label names, or unknown."""
        return "[1]" if self.unit == "1" else self.unit


QUANTITIES: dict[str, Quantity] = {
    "loss": Quantity("Loss"),
    "residual": Quantity("Residual |Ax − y| / |y|"),
    "discrepancy": Quantity("Residual over noise, RMS (1: as small as the noise)"),
    "held_out_rms_of_residual_over_noise": Quantity("Residual over noise, RMS of the held-out views"),
    "gradient": Quantity("Norm of the gradient"),
    "nrmse": Quantity("nRMSE of the volume"),
    "psnr": Quantity("PSNR of the fitted views", "dB", log=False),
    "held_out_psnr": Quantity("PSNR of the held-out views", "dB", log=False),
    "psnr_colour_fitted": Quantity("PSNR of the held-out views, colours fitted", "dB", log=False),
    "few_psnr": Quantity("PSNR of the same few held-out views", "dB", log=False),
    "ssim": Quantity("SSIM of the held-out views", log=False),
    "flip": Quantity("FLIP of the held-out views", log=False),
    "nodes": Quantity("Nodes that are stored", log=False),
    "gaussians": Quantity("Gaussians", log=False),
    "bytes": Quantity("Memory of the field", "MiB", log=False),
    "seconds": Quantity("Time", "s"),
    "fit_seconds": Quantity("Time of the fit", "s"),
    "iterations": Quantity("Iterations", log=False),
    "views": Quantity("Views fitted", log=False),
    "memory": Quantity("Peak memory", "MiB", log=False),
}


def find_quantity(name: str, units: Mapping[str, str]) -> Quantity:
    """How a number is named and printed: by ``QUANTITIES``, with the unit that a run has for it.

    Numbers that a run alone has a unit for keep their names, which are keys of a scene, and even steps.
    """
    known = QUANTITIES.get(name)
    if known is None:
        return Quantity(name, units[name], log=False) if name in units else Quantity(name.replace("_", " "))
    return known._replace(unit=units.get(name, known.unit))


class _Part(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    pass


class PlanLine(_Part):
    """One line of the plan: what was chosen, and why."""

    choice: str
    reason: str


class Image(_Part):
    """An image of the run: ``.exr``, ``.npy`` of linear values (height, width[, 1 or 3]); ``.png``, ``.mp4`` shown as they are.

    Images of one ``view`` belong together: its ``reference`` and ``render`` are shown beside their difference, with a
    z-image (difference over standard error) where the difference's ``standard error`` is there.
    """

    path: str
    role: Literal["reference", "render", "difference", "standard error", "slice", "picture", "film"]
    view: str = ""
    held_out: bool = False
    layer: str = ""
    """Which layer of an OpenEXR file; empty: the picture itself, or the only channel."""
    quantity: str = "radiance"
    unit: str = ""
    caption: str = ""
    small: bool = False
    """Whether it is one of many that a page is scrolled through."""


class Volume(_Part):
    """A grid of the run, (Z, Y, X, C), in any format of :func:`mivol.files.read_volume`."""

    path: str
    role: Literal["truth", "reconstruction", "start"]
    quantity: str = "sigma_t"
    unit: str = "1/length"
    size: tuple[float, float, float] | None = None
    """World lengths of the box's edges along x, y, z; where missing, those of the file's own ``to_world``."""
    caption: str = ""
    profiles: bool = False
    """Whether values along the three lines through its middle are drawn."""


class Table(_Part):
    """A table of the page: what its first row says, then its rows; the first column is text."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Machine(_Part):
    """Where it ran, as far as it matters to speed."""

    cores: int
    memory: float | None = None
    """GiB of main memory."""
    device: str = ""


class RunRecord(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """All of ``run.json``."""

    title: str
    machine: Machine
    schema: Literal[1] = 1
    judged: str = ""
    """By which views the results are judged: how many, and at which size."""
    method: str = ""
    """One line: model, solver, what is optimised."""
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
    """Final numbers; names of :data:`QUANTITIES` are printed with their labels."""
    units: dict[str, str] = {}
    """Units of numbers of ``results`` and ``metrics.jsonl`` that depend on what was fitted; "1" is a pure number."""
    images: list[Image] = []
    volumes: list[Volume] = []
    tables: list[Table] = []
    notes: list[str] = []
    """Sentences that a reader must know: limits, refusals, events."""
    citations: list[str] = []
    """Keys of :data:`mivol.cite.CITATIONS`."""

    @classmethod
    def new(cls, title: str, *, device: str = "", **fields: Any) -> RunRecord:
        """A record of a run that starts now, on this machine, with the versions that are installed."""
        now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
        return cls(title=title, machine=describe_machine(device), versions=package_versions(), started=now, **fields)


def package_versions() -> dict[str, str]:
    """Versions of Python, the system and the packages that results depend on; those not installed are left out."""
    found = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def describe_machine(device: str = "") -> Machine:
    """Cores that this process may use, main memory and ``device`` (by default the processor's model)."""
    return Machine(cores=cores(), memory=_memory(), device=device or _processor())


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
    """Write ``run.json`` whole.

    Absolute paths inside ``config``, ``command``, ``plan`` and ``notes`` are cut to the file's own name.

    Raises:
        MivolError: an image or a volume lies outside the folder.
    """
    for part in (*record.images, *record.volumes):
        _check_inside(part.path)
    plain = msgspec.to_builtins(record)
    for field in ("config", "command", "plan", "notes", "title", "method"):
        plain[field] = _without_places(plain[field])
    path = Path(folder) / RECORD
    write_whole_text(path, json.dumps(_finite(plain), indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    return path


def read_record(folder: str | Path) -> RunRecord:
    """Read ``run.json``.

    Raises:
        MivolError: no such file, not JSON, an unknown, missing or wrong field, or a path that leaves the folder.
    """
    path = Path(folder) / RECORD
    if not path.is_file():
        raise MivolError(f'no {RECORD} in "{Path(folder).name}"; give the folder that `mivol optimize` wrote.')
    try:
        record = msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except DAMAGE as error:
        raise MivolError(f"{RECORD} is not the record of a run: {error}; restore it or make the run again.") from None
    for part in (*record.images, *record.volumes):
        _check_inside(part.path)
    return record


def append_metrics(folder: str | Path, iteration: int, seconds: float, **values: float) -> None:
    """Add one line to ``metrics.jsonl``: the iteration, the seconds since the start, and numbers by name.

    Raises:
        MivolError: what the system refuses (disk full, quota, permission ...); of half a line nothing is read.
    """
    row = {"iteration": int(iteration), "seconds": float(seconds)} | {name: float(v) for name, v in values.items()}
    path = Path(folder) / METRICS
    with disk_faults(path, "room for another line"), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(_finite(row), allow_nan=False) + "\n")


def read_metrics(folder: str | Path) -> list[dict[str, float | None]]:
    """Rows of ``metrics.jsonl``, in order; none where there is no file. A last line without its end is a killed run's.

    Raises:
        MivolError: a whole line is not a JSON object.
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
    """Drop the rows after ``iteration``, so that a run resumed from there says nothing twice."""
    rows = [row for row in read_metrics(folder) if row["iteration"] <= iteration]
    text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    write_whole_text(Path(folder) / METRICS, text)


def _check_inside(path: str) -> None:
    pure = PurePosixPath(path)
    if not path or pure.is_absolute() or ".." in pure.parts or "\\" in path:
        raise MivolError(f'the record names "{path}"; give a path inside the run folder, relative to it.')


_PLACE = re.compile(r"(?<![\w.:/\\])(?:~?/(?:[^\s/\"'=,;]+/)+|[A-Za-z]:\\(?:[^\s\\\"']+\\)+)")


def _without_places(value: Any) -> Any:
    """``value`` with the folders of absolute paths taken out of every string in it."""
    if isinstance(value, str):
        return _PLACE.sub("", value)
    if isinstance(value, dict):
        return {key: _without_places(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_places(item) for item in value]
    return value


def _finite(value: Any) -> Any:
    """``value`` with ``None`` for every number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value
