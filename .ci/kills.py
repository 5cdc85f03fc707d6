"""Kill each writing verb at random moments, and fill its disk: nothing is half-written, nothing lost, the next try succeeds.

    .ci/kills.py [VERB ...] [--kills 100] [--full-disks 20] [--seed 0]

Between two changes of the disk a killed process leaves the same files whenever it dies, so moments are counted by changes (a
file opened for writing, renamed or removed, a folder made) rather than by the clock. Every change has two moments: before it,
and with it half done (a file cut off at a random length, the half of a line appended). An undisturbed run counts the changes
of a verb; the seed draws moments over its whole life. On a full disk every change from the drawn one on fails with ENOSPC.

Each try begins with what a finished run of the same verb has left, and is followed by the same command again. Checked after the
strike: every file in the folder is whole or a temporary, and each file of the finished run is as it was, or lies in
``earlier/``, or is whole and of the new run. A full disk is one sentence and exit code 1. Checked after the second try:
exit code 0, the same files as undisturbed with the same numbers, and in a run folder no temporary (verbs that write one file
leave a hidden one where they are killed: another process could be writing it).
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mivol import cli, threads
from mivol.files import read_exr, write_volume
from mivol.files.npy import read_archive

import numpy as np

LIMIT = 600
"""Seconds after which a verb that hangs is ended; undisturbed ones take some seconds."""

REMOVING = ("os.remove", "os.rmdir")
CHANGES = ("os.rename", "os.mkdir", "os.link", "os.truncate", *REMOVING)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT

SCENE = """<scene version="3.0.0">
    <integrator type="volpath"/>
    <emitter type="constant"/>
    <sensor type="perspective">
        <float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="0, 1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="6"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <shape type="cube" id="cube">
        <bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
            <float name="albedo" value="0"/>
            <volume type="gridvolume" name="sigma_t">
                <string name="filename" value="start.vol"/>
                <transform name="to_world"><scale value="2"/><translate x="-1" y="-1" z="-1"/></transform>
            </volume>
        </medium>
    </shape>
</scene>"""
KEY = "cube.interior_medium.sigma_t.data"
FIT = f"""title = "tiny"
scene.file = "scene.xml"
threads = 1
reference = {{ source = "render", spp = 32, held_out = [1] }}
views = {{ rig = "ring", count = 3, width = 8, height = 8 }}
truth = {{ key = "{KEY}", procedural = "tangle", shape = [6, 6, 6], peak = 3.0 }}
optimizer = {{ name = "adam" }}
fit = {{ iterations = 4, spp = 2 }}
event = [{{ name = "evaluate", every = 2 }}, {{ name = "checkpoint", every = 2 }}]
[[parameter]]
key = "{KEY}"
start = 0.2
shape = [3, 3, 3]
"""
SCAN = """title = "tiny scan"
threads = 1
[scan]
beam = "parallel"
views = 12
detector = [12, 12]
pitch = 0.25
[data]
source = "shepp_logan"
[grid]
shape = [8, 8, 8]
voxel_size = 0.25
[solve]
name = "sirt"
iterations = 4
"""


@dataclass(frozen=True)
class Strike:
    """What befalls a process.

    Attributes:
        kind: "kill" before a change of the disk, "tear" with it half done, "full" for no space from there on, "" for nothing.
        at: which change, from 1.
        share: of the bytes that a torn file keeps.
    """

    kind: str = ""
    at: int = 0
    share: float = 0.0


class Watch:
    """An audit hook that counts a process's changes below a folder, and strikes."""

    def __init__(self, folder: str, strike: Strike) -> None:
        self.folder, self.strike, self.count, self.refused, self.is_busy = folder, strike, 0, 0, False

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if self.is_busy or not self.changes(event, args):
            return
        self.count += 1
        if self.count < self.strike.at or not self.strike.kind:
            return
        if self.strike.kind == "full":
            if event not in REMOVING:
                self.refused += 1
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(args[0]))
            return
        self.is_busy = True
        if self.strike.kind == "tear" and event == "open":
            self.tear(Path(os.fsdecode(args[0])), str(args[1]))
        os.kill(os.getpid(), signal.SIGKILL)

    def changes(self, event: str, args: tuple[Any, ...]) -> bool:
        """Whether an event is a change of the disk in the folder; writing over a device is none."""
        if event not in CHANGES and not (event == "open" and (args[2] or 0) & WRITING):
            return False
        path = args[0]
        return isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).startswith(self.folder)

    def tear(self, path: Path, mode: str) -> None:
        """Leave what a process leaves that dies while it writes: half a line at the end, or the first bytes of the file.

        ``mivol.files.atomic`` opens a temporary twice, the second time ("rb+") when all is in it, so it is torn then.
        """
        if "a" in mode:
            with path.open("a") as file:
                file.write('{"iteration": 3, "lo')
        elif path.exists():
            os.truncate(path, int(self.strike.share * path.stat().st_size))
        else:
            path.touch()


@dataclass(frozen=True)
class Verb:
    """A command that writes.

    Attributes:
        earlier: words of the command whose result lies there already.
        words: of the command that is struck; "{here}" is the folder of the try.
        output: what it writes: a file's or a folder's name in the folder of the try.
    """

    earlier: tuple[str, ...]
    words: tuple[str, ...]
    output: str


def _optimize(name: str) -> Verb:
    words = ("optimize", f"{{here}}/{name}.toml", "-o", "{here}/run")
    return Verb((*words, "--set", "title=earlier"), words, "run")


VERBS: dict[str, Verb] = {
    "optimize": _optimize("fit"),
    "scan": _optimize("scan"),
    "reference": Verb(
        ("reference", "{here}/scene.xml", "--max-depth", "2", "--spp", "32", "-o", "{here}/refs/a.exr"),
        ("reference", "{here}/scene.xml", "--max-depth", "2", "--spp", "64", "-o", "{here}/refs/a.exr"),
        "refs",
    ),
    "report": Verb(("optimize", "{here}/scan.toml", "-o", "{here}/run"), ("report", "{here}/run"), "run"),
    "export": Verb(
        ("export", "{here}/field.npz", "{here}/out/a.vol"), ("export", "{here}/other.npz", "{here}/out/a.vol"), "out"
    ),
    "convert": Verb(
        ("convert", "{here}/points.npy", "{here}/out/a.ply"), ("convert", "{here}/others.npy", "{here}/out/a.ply"), "out"
    ),
}


# -- One process ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Done:
    """How a process ended.

    Attributes:
        words: of its command.
        code: exit code; minus the signal's number where one ended it.
        said: what it wrote to its outputs.
        changes: of the disk that it made; 0 where it was killed.
        refused: how many of them a full disk refused.
    """

    words: tuple[str, ...]
    code: int
    said: str
    changes: int
    refused: int


def run(here: Path, verb: Verb, words: tuple[str, ...], strike: Strike | None = None) -> Done:
    """Run a command of ``mivol`` in a process of its own, struck or not.

    The process is a fork of this one, in which Dr.Jit has not begun (no variant is set), so that imports are paid once.
    """
    words = tuple(word.format(here=here) for word in words)
    watch = Watch(str(here / verb.output), strike or Strike())
    said, counted = here.with_suffix(".said"), here.with_suffix(".changes")
    counted.write_text("0 0")
    code = forked(lambda: struck(watch, words, counted), said)
    return Done(words, code, said.read_text(), *map(int, counted.read_text().split()))


def struck(watch: Watch, words: tuple[str, ...], counted: Path) -> int:
    """Run a command in this process and strike it; what it counted goes to a file."""
    sys.addaudithook(watch)
    code = cli.main(words)
    watch.is_busy = True
    counted.write_text(f"{watch.count} {watch.refused}")
    return code


def forked(work: Callable[[], int], said: Path) -> int:
    """The exit code of work done in a fork, whose outputs go to a file; minus the number of the signal that ended it."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    code = 70  # of a traceback, which goes to the file
    try:
        signal.alarm(LIMIT)
        file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        threads._pid = os.getpid()  # Dr.Jit's threads begin with the first variant, which is set in here
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


# -- What must hold ---------------------------------------------------------------------------------------------------


def is_temporary(path: Path) -> bool:
    """Whether a file is one that ``mivol.files.atomic`` has not finished."""
    return path.name.startswith(".") and path.name.endswith(".part")


def files_of(folder: Path) -> dict[str, Path]:
    """All files by their name in the folder, temporaries left out."""
    return {p.relative_to(folder).as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file() and not is_temporary(p)}


def broken(path: Path) -> str:
    """What is wrong with a file, read by its format; "" where it is whole."""
    try:
        WHOLE.get(path.suffix, lambda path: None)(path)
    except Exception as error:
        return f"{path.name} is not whole: {type(error).__name__}: {error}"
    return ""


def whole_lines(path: Path) -> None:
    """All lines of ``metrics.jsonl`` but an unfinished last one."""
    for line in path.read_text().split("\n")[:-1]:
        json.loads(line)


def whole_page(path: Path) -> None:
    """A page to its end."""
    if not path.read_text().rstrip().endswith("</html>"):
        raise ValueError("no </html>")


def whole_picture(path: Path) -> None:
    """A picture to its last pixel."""
    from PIL import Image

    with Image.open(path) as image:
        image.load()


def whole_volume(path: Path) -> None:
    """A volume, its size by its head."""
    from mivol.files import read_volume

    read_volume(path)


def whole_points(path: Path) -> None:
    """A file of points to its last one."""
    from mivol.points.cloud import read_points

    read_points(path)


WHOLE: dict[str, Callable[[Path], Any]] = {
    ".json": lambda path: json.loads(path.read_text()),
    ".jsonl": whole_lines,
    ".html": whole_page,
    ".npz": read_archive,
    ".exr": read_exr,
    ".png": whole_picture,
    ".vol": whole_volume,
    ".ply": whole_points,
}


def kept(name: str, before: bytes, folder: Path, fresh: dict[str, Path]) -> bool:
    """Whether a file of the finished run is still somewhere, or has made place for a whole one that the new run writes too."""
    places = [folder / name, folder / "earlier" / name]
    if any(place.is_file() and place.read_bytes() == before for place in places):
        return True
    return name in fresh and name not in RECORDED and (folder / name).is_file()


RECORDED = ("run.json", "metrics.jsonl", "checkpoint.npz", "best.npz", "report.html")
"""What of a finished run stays until another one has finished: in its place, or in ``earlier/``."""


def numbers(path: Path) -> Any:
    """What a file says, without time and memory."""
    if path.name == "run.json":
        record = json.loads(path.read_text())
        results = {name: value for name, value in record["results"].items() if "seconds" not in name and name != "memory"}
        return record["title"], record["status"], results
    if path.name == "metrics.jsonl":
        return [{**json.loads(line), "seconds": 0} for line in path.read_text().splitlines()]
    if path.suffix == ".exr":
        return [(name, plane.tobytes()) for name, plane in read_exr(path)[0].items()]
    if path.suffix == ".npz" and not path.name.startswith(("checkpoint", "best")) and ".state" not in path.name:
        return [(name, array.tobytes()) for name, array in read_archive(path).items() if array.dtype.kind == "f"]
    return path.read_bytes() if path.suffix in (".vol", ".ply") else None


def same(folder: Path, fresh: dict[str, Path], is_swept: bool) -> list[str]:
    """How a folder differs from what an undisturbed run leaves."""
    found = {name: path for name, path in files_of(folder).items() if not name.startswith("earlier/")}
    wanted = {name: path for name, path in fresh.items() if not name.startswith("earlier/")}
    wrong = [f"{name} is missing" for name in wanted.keys() - found] + [f"{name} is too much" for name in found.keys() - wanted]
    wrong += [f"{name} differs" for name in found.keys() & wanted if numbers(found[name]) != numbers(wanted[name])]
    left = [path.name for path in folder.rglob("*") if is_temporary(path)] if is_swept else []
    return wrong + [f"{name} was not swept" for name in left]


# -- Tries ------------------------------------------------------------------------------------------------------------


def prepare(folder: Path) -> None:
    """What the commands read."""
    folder.mkdir()
    (folder / "scene.xml").write_text(SCENE)
    (folder / "fit.toml").write_text(FIT)
    (folder / "scan.toml").write_text(SCAN)
    write_volume(folder / "start.vol", np.full((2, 2, 2, 1), 0.25, "f"))
    for name in ("refs", "out"):
        (folder / name).mkdir()
    rng = np.random.default_rng(1)
    for name in ("points", "others"):
        np.save(folder / f"{name}.npy", rng.random((20, 3)))
    if forked(lambda: make_fields(folder), folder.with_suffix(".said")):
        sys.exit(folder.with_suffix(".said").read_text())


def make_fields(folder: Path) -> int:
    """Two radiance fields."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from mivol.fields.field_files import write_field
    from mivol.fields.spherical_grid import SphericalGrid

    rng = np.random.default_rng(2)
    for name in ("field", "other"):
        dense = rng.random((4, 4, 4, 1), np.float32), rng.random((4, 4, 4, 1, 3), np.float32)
        write_field(folder / f"{name}.npz", SphericalGrid.from_dense(*dense, np.eye(4)))
    return 0


@contextmanager
def copy_of(source: Path) -> Iterator[Path]:
    """A folder of the same files at the same place in every try, for what names it."""
    here = source.with_name("here")
    shutil.rmtree(here, ignore_errors=True)
    shutil.copytree(source, here)
    yield here


def judge(here: Path, verb: Verb, strike: Strike, before: dict[str, bytes], fresh: dict[str, Path]) -> list[str]:
    """Strike a command and try again; what does not hold."""
    folder = here / verb.output
    first = run(here, verb, verb.words, strike)
    wrong = [said for path in files_of(folder).values() if (said := broken(path))]
    wrong += [f"{name} of the finished run is lost" for name in before if not kept(name, before[name], folder, fresh)]
    if strike.kind == "full":
        wrong += one_sentence(first)
    elif first.code != -signal.SIGKILL:
        wrong.append(f"was not killed but left with {first.code}: {first.said[-300:]}")
    second = run(here, verb, verb.words)
    if second.code:
        return [*wrong, f"the next try left with {second.code}: {second.said[-300:]}"]
    return wrong + same(folder, fresh, verb.words[0] == "optimize")


def one_sentence(done: Done) -> list[str]:
    """What is wrong with how a full disk was said."""
    said = [line for line in done.said.splitlines() if line.startswith("mivol: ")]
    if done.code == 0 and done.refused == 0:  # nothing was left to write
        return []
    if done.code == 1 and len(said) == 1 and "Traceback" not in done.said:
        return []
    return [f"a full disk left with {done.code} and said: {done.said[-600:]}"]


def try_verb(name: str, folder: Path, kills: int, full_disks: int, seed: int) -> list[str]:
    """All tries of a verb; what does not hold, a line each."""
    verb, rng = VERBS[name], random.Random(f"{seed} {name}")
    start, undisturbed = folder / f"{name}.start", folder / f"{name}.fresh"
    with copy_of(folder / "inputs") as here:
        must(run(here, verb, verb.earlier))
        shutil.copytree(here, start)
        changes = must(run(here, verb, verb.words)).changes
        shutil.copytree(here, undisturbed)
    before = {file: path.read_bytes() for file, path in files_of(start / verb.output).items()}
    fresh = files_of(undisturbed / verb.output)
    strikes = draw(rng, changes, ("kill", "tear"), kills) + draw(rng, changes, ("full",), full_disks)
    failures = []
    for strike in strikes:
        with copy_of(start) as here:
            failures += [f"{name}, {strike}: {said}" for said in judge(here, verb, strike, before, fresh)]
    tried = f"{kills} kills and {full_disks} full disks"
    print(f"{name}: {changes} changes of the disk, {tried}, {len(failures)} failures", flush=True)
    return failures


def must(done: Done) -> Done:
    """An undisturbed command succeeds."""
    if done.code:
        sys.exit(f"undisturbed, {' '.join(done.words)} left with {done.code}: {done.said[-2000:]}")
    return done


def draw(rng: random.Random, changes: int, kinds: tuple[str, ...], count: int) -> list[Strike]:
    """Strikes at different moments; at all of them, again and again, where there are fewer moments than strikes."""
    moments = [(kind, at) for at in range(1, changes + 1) for kind in kinds]
    drawn: list[tuple[str, int]] = []
    while len(drawn) < count:
        drawn += rng.sample(moments, min(len(moments), count - len(drawn)))
    return [Strike(kind, at, rng.random()) for kind, at in drawn]


def main() -> int:
    """Exit code: 0 where everything holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verbs", nargs="*", choices=[[], *VERBS], help=f"of {', '.join(VERBS)}; default: all")
    parser.add_argument("--kills", type=int, default=100, help="of each verb (default: %(default)s)")
    parser.add_argument("--full-disks", type=int, default=20, help="of each verb (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    failures = []
    with tempfile.TemporaryDirectory() as made:
        prepare(Path(made) / "inputs")
        for name in given.verbs or VERBS:
            failures += try_verb(name, Path(made), given.kills, given.full_disks, given.seed)
    print("\n".join(failures))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
