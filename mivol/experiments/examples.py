"""The examples of mivol: their list, their files, and their runs.

Conventions. An example is a folder of ``scenes/`` with a ``fit.toml``; a wheel installs the examples in ``mivol/examples``.
An example of public data has a stand-in, a procedural volume from a seed, and runs without the data.
"""

from __future__ import annotations

import re
import runpy
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mivol import config
from mivol.display import to_toml
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, Progress, RunContext
from mivol.experiments.kinds import run_experiment
from mivol.fields.procedural import make_procedural
from mivol.files import write_volume
from mivol.files.atomic import disk_faults
from mivol.files.fetch import PREFIX, find_local_file, resolve_path
from mivol.optim.strategy import suggest_name

INSTALLED = Path(__file__).resolve().parents[1] / "examples"
CHECKOUT = Path(__file__).resolve().parents[2] / "scenes"


TEXTS = (".toml", ".xml", ".md", ".py")
"""Suffixes of files with names of other files in the text."""

NEIGHBOUR = re.compile(r"\.\./demo/([\w.]+)")
"""A file of the example ``demo`` in the text of another example."""


@dataclass(frozen=True)
class ProceduralData:
    """A procedural volume in place of public data.

    Attributes:
        data: name of the public data.
        setting: setting of the experiment with the file.
        shape: shape (Z, Y, X).
        peak: largest value, about as in the public data.
    """

    data: str
    setting: str
    shape: tuple[int, int, int]
    peak: float

    says = "a procedural volume replaces it"

    def make(self, folder: Path) -> list[str]:
        """Write the volume to a folder; return the settings with its path."""
        return [f"{self.setting}={to_toml(str(self.write(folder)))}"]

    def write(self, folder: Path) -> Path:
        """Write the volume to a folder; return its path."""
        path = folder.resolve() / f"{self.data}.vol"
        write_volume(path, make_procedural("tangle", self.shape, 2, self.peak))
        return path

    def place(self, named: str, folder: Path) -> Path:
        """Return the path in a script's argument: a path, or ``data:NAME``; the stand-in replaces missing data.

        Raises:
            MivolError: other data that have not been fetched.
        """
        if named != PREFIX + self.data or find_local_file(self.data) is not None:
            return resolve_path(Path(), named).resolve()
        print(f'the public data set "{self.data}" is not on this machine: {self.says} (get it: mivol fetch {self.data})')
        return self.write(folder)


@dataclass(frozen=True)
class ComputedScan:
    """Computed projections of ellipsoids in place of a public scan, with noise from the experiment's seed.

    Attributes:
        data: name of the public data.
        settings: settings replacing the settings of the file.
    """

    data: str
    settings: tuple[str, ...]

    says = "exact projections of a phantom, with noise, replace it"

    def make(self, folder: Path) -> list[str]:
        """Return the settings; nothing is written."""
        return list(self.settings)


@dataclass(frozen=True)
class Example:
    """An example.

    Attributes:
        says: subject of the example.
        stand_in: replacement of the public data; None without public data.
        photographs: script making the photographs, in the example's folder; may be "".
        scan: script making the readings, with an own stand-in, in the example's folder; may be "".
        folder: folder of the files; "" means the example's name.
        file: experiment of the example.
    """

    says: str
    stand_in: ProceduralData | ComputedScan | None = None
    photographs: str = ""
    scan: str = ""
    folder: str = ""
    file: str = "fit.toml"

    def source(self, name: str) -> Path:
        """Folder of the files of the example with this name."""
        return examples_folder() / (self.folder or name)


def _smoke_stand_in(setting: str) -> ProceduralData:
    return ProceduralData("smoke", setting, (53, 45, 44), 1.8)


_SLICES = ComputedScan(
    "tooth_projections",
    (
        "scan.views=181",
        "scan.detector=[2, 190]",
        "scan.pitch=0.010526316",
        'data={source="shepp_logan", scale=2.0, photons=1e5}',
        "grid.shape=[2, 190, 190]",
        "grid.voxel_size=0.010526316",
        "solve.tv=0",
        "solve.iterations=20",
    ),
)
"""As many views as the tooth, and half as many columns; the head fills the detector."""

SCAN_FILES = {"scan.file": "panels.txt", "data.file": "readings.npy", "data.flats": "flats.npy", "data.darks": "darks.npy"}
"""Settings of an example with a ``scan``, and the files written by the script."""

EXAMPLES: dict[str, Example] = {
    "demo": Example("a tangle of absorbing matter from 16 pictures, about a minute"),
    "bonsai": Example("a bonsai from a simulated cone-beam scan, with the geometry of its views in a table", scan="scan.py"),
    "shepp_logan": Example("the head phantom of Shepp and Logan from cone-beam projections"),
    "still_life": Example("glossy and matt things from photographs, as a radiance field", photographs="photographs.py"),
    "gaussians": Example(
        "the same things as 3D Gaussians", photographs="photographs.py", folder="still_life", file="gaussians.toml"
    ),
    "smoke": Example("an absorbing smoke from 16 pictures", _smoke_stand_in("truth.file")),
    "white_smoke": Example("a smoke that scatters, under a white sky", _smoke_stand_in("truth.file")),
    "lamp": Example("where is the lamp behind a known smoke?", _smoke_stand_in("scene.define.volume")),
    "tooth": Example("a tooth from synchrotron projections", _SLICES),
    "cloud": Example("a cloud under sun and sky", ProceduralData("cloud", "truth.file", (26, 37, 32), 0.12)),
}


def examples_folder() -> Path:
    """Folder of the examples: in the package, or beside the package in a checkout."""
    return INSTALLED if INSTALLED.is_dir() else CHECKOUT


def list_examples() -> str:
    """List the examples, one per line."""
    width = max(map(len, EXAMPLES))
    return "\n".join(f"{name:<{width}}  {example.says}" for name, example in EXAMPLES.items())


def find_example(name: str) -> Example:
    """Return the example with this name.

    Raises:
        MivolError: an unknown name, with the nearest known name.
    """
    if name not in EXAMPLES:
        raise MivolError(f'there is no example "{name}": {suggest_name(name, list(EXAMPLES))}')
    return EXAMPLES[name]


def copy_example(name: str, into: Path) -> Path:
    """Copy the files of an example.

    Args:
        name: key of ``EXAMPLES``.
        into: new folder for the files.

    Returns:
        The experiment in the copy.

    Raises:
        MivolError: an unknown example, an existing folder with files, or a disk error.
    """
    example = find_example(name)
    if into.exists() and (not into.is_dir() or any(into.iterdir())):
        raise MivolError(f'"{into}" exists and is not an empty folder: name a new or an empty folder.')
    source = example.source(name)
    with disk_faults(into, "room for the files of the example", " (nothing was left half-written)"), whole_folder(into):
        for path in sorted(source.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                target = into / path.relative_to(source)
                target.parent.mkdir(parents=True, exist_ok=True)
                if path.suffix in TEXTS:
                    copy_text(path, target, source, into)
                else:
                    shutil.copyfile(path, target)
    return into / example.file


def copy_text(path: Path, target: Path, source: Path, into: Path) -> None:
    """Copy a text of an example from ``source``, and adapt the paths in the text to ``into``.

    Files of a neighbour (``../demo/empty.vol``) are copied into the same folder. Runs go to the working directory, as for the
    example's scripts, and commands contain the new folder.
    """
    text = path.read_text(encoding="utf-8")
    for name in NEIGHBOUR.findall(text):
        shutil.copyfile(source.parent / "demo" / name, into / name)
    text = NEIGHBOUR.sub(r"\1", text).replace("../../runs/", f"{Path('runs').resolve().as_posix()}/")
    target.write_text(text.replace(f"scenes/{source.name}/", f"{into.as_posix()}/"), encoding="utf-8")


@contextmanager
def whole_folder(path: Path) -> Iterator[None]:
    """Remove the folder after an error in the block."""
    try:
        yield
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def run_example(
    name: str, folder: Path | None, *, changes: tuple[str, ...] = (), progress: Progress | None = None, command: str = ""
) -> Path:
    """Run an example; return the report page.

    Args:
        name: key of ``EXAMPLES``.
        folder: run folder; None means the ``output`` of the changes, or runs/NAME.
        changes: settings as in ``--set``.
        progress: display of the run's progress.
        command: command line, for the record.

    Raises:
        MivolError: an unknown example, or a refusal of the fit.
    """
    example, progress = find_example(name), progress or NullProgress()
    source = example.source(name)
    # First check the changes: an invalid setting is refused before files are made.
    output = config.load(source / example.file, (f"output=runs/{name}", *changes)).output
    folder = folder or Path(output)
    all_changes = (*prepare(name, example, source, folder, progress), *changes)
    experiment = config.load(source / example.file, all_changes)
    return run_experiment(RunContext(experiment, source, folder, progress=progress, command=command))


def prepare(name: str, example: Example, source: Path, folder: Path, progress: Progress) -> list[str]:
    """Make the photographs, the readings or the stand-in of an example; return the settings with their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    if example.photographs:
        photographs = folder.resolve() / "photographs"
        if not (photographs / "transforms.json").exists():
            progress.say(["making the photographs"])
            run_script(source / example.photographs, ["-o", str(photographs)])
        return [f"photos.path={to_toml(str(photographs))}"]
    if example.scan:
        readings = folder.resolve() / "scan"
        if not (readings / "truth.npz").exists():
            progress.say(["making the readings"])
            run_script(source / example.scan, ["-o", str(readings)])
        return [f"{setting}={to_toml(str(readings / file))}" for setting, file in SCAN_FILES.items()]
    if example.stand_in is None or find_local_file(example.stand_in.data) is not None:
        return []
    stand_in = example.stand_in
    progress.say([
        f'the public data set "{stand_in.data}" is not on this machine: {stand_in.says} (get it: mivol fetch {stand_in.data})'
    ])  # fmt: skip
    return stand_in.make(folder)


def run_script(path: Path, arguments: list[str]) -> None:
    """Run a script of an example in this process, where Mitsuba is loaded already."""
    before = sys.argv
    sys.argv = [str(path), *arguments]
    try:
        runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.argv = before
