"""The command ``mivol``: a verb is one function and one entry of ``VERBS``.

Conventions. A refusal of mivol, a full disk or memory, and Ctrl-C become one sentence on the error output and a nonzero exit
code; only a bug of the program shows a traceback. Each verb makes its own slow imports.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import mivol
from mivol.errors import MivolError
from mivol.optim.interrupt import Signals

if TYPE_CHECKING:
    from mivol.experiments.found_scan import ScanDraft
    from mivol.points.summary import FileSummary
    from mivol.scene.explain import Explanation
    from mivol.scene.load import LoadedScene

USAGE, STOPPED = 2, 130

DESCRIPTION = """Differentiable and inverse volume rendering on Mitsuba 3. "mivol doctor" checks whether this machine can
render. "mivol demo" lists examples. "mivol VERB --help" explains a verb."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``mivol`` with these arguments (default: the arguments of the process).

    Returns:
        Exit code: 0 for success, 1 for a refusal, 2 for wrong arguments, 130 for Ctrl-C and SIGTERM; ``validate`` has more.
    """
    signals = Signals()
    try:
        arguments = parse(list(sys.argv[1:] if argv is None else argv))
        return arguments.verb(arguments) or 0
    except BaseException as error:
        if signals.are_behind(error):
            print("mivol: stopped; finished work is kept.", file=sys.stderr)
            return STOPPED
        if not isinstance(error, MivolError | OSError | MemoryError):
            raise
        print(f"mivol: {describe_error(error)}", file=sys.stderr)
        return 1


def describe_error(error: MivolError | OSError | MemoryError) -> str:
    """Message for an error other than a bug."""
    if isinstance(error, MemoryError):
        return f"the memory does not suffice ({str(error) or 'nothing more is known'}): take fewer voxels, pixels or views."
    return str(error)


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse a command; wrong arguments end the process.

    Returns:
        The flags, with the verb's function as ``verb``, the whole command line as ``command``, and the own flags of a study as
        ``rest``.
    """
    known = parser()
    arguments, rest = known.parse_known_args(words)
    arguments.rest = rest
    if rest and arguments.verb is not bench:
        known.error(f"unrecognized arguments: {' '.join(rest)}")
    arguments.command = shlex.join(["mivol", *words])
    return arguments


def parser() -> argparse.ArgumentParser:
    """Parser of the verbs and flags."""
    top = argparse.ArgumentParser(prog="mivol", description=DESCRIPTION)
    top.add_argument("--version", action="version", version=f"mivol {mivol.__version__}")
    verbs = top.add_subparsers(required=True, metavar="verb", title="verbs")
    for name, verb in VERBS.items():
        sub = verbs.add_parser(
            name, help=verb.summary, description=verb.description, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        sub.set_defaults(verb=verb.run)
        verb.add_flags(sub)
    return top


class Verb(NamedTuple):
    """A verb of the command.

    Attributes:
        run: function of the parsed flags; the docstring is the help, and the result is the exit code, or None (code 0).
        flags: function returning the flags; imports are delayed until the parser is made.
        epilog: function returning the last part of the help.
    """

    run: Callable[[argparse.Namespace], int | None]
    flags: Callable[[], list[tuple[tuple[str, ...], dict[str, Any]]]] = list
    epilog: Callable[[], str] = str

    @property
    def description(self) -> str:
        """The docstring of the function."""
        lines = (self.run.__doc__ or "").strip().splitlines()
        return "\n".join(line.removeprefix("    ") for line in lines)

    @property
    def summary(self) -> str:
        """The first line of the docstring."""
        return self.description.partition("\n")[0]

    def add_flags(self, sub: argparse.ArgumentParser) -> None:
        """Add the flags and the epilog to the parser of the verb."""
        for names, options in self.flags():
            sub.add_argument(*names, **options)
        sub.epilog = self.epilog().replace("%", "%%")


# -- Flags -----------------------------------------------------------------------------------------------------------------


def flag(*names: str, **options: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the arguments of ``ArgumentParser.add_argument``."""
    return names, options


MODE = flag("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant (default: %(default)s)")
SENSOR = flag("-s", "--sensor", type=int, default=0, help="index of the sensor (default: %(default)s)")
SEED = flag("--seed", type=int, default=0, help="seed of the random numbers (default: %(default)s)")
CLUSTER = flag(
    "--cluster", metavar="WHERE", help="run on workers of Dask: local:N, tcp://host:port, tls://host:port, or a TOML file"
)
DATASET = flag("--dataset", help="array of a volume file with several arrays, or series of DICOM (default: the only one)")
SHAPE = flag("--shape", metavar="Z,Y,X", help="voxels of raw bytes without a header, with --dtype")
DTYPE = flag("--dtype", help="type of raw bytes: uint16, float32, >i2 for big-endian, ...")
MAX_DEPTH = flag("--max-depth", type=int, help="longest path (default: the max_depth of the scene's integrator)")


def list_flag(name: str, metavar: str, text: str) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Flag for repeated use."""
    return flag(name, action="append", default=[], metavar=metavar, help=text)


def scene_flags(text: str = "scene: Mitsuba XML") -> list[tuple[tuple[str, ...], dict[str, Any]]]:
    """The flags of the command ``mitsuba`` for a scene."""
    return [
        flag("scene", type=Path, help=text),
        MODE,
        flag("-D", "--define", action="append", default=[], metavar="name=value", help="value of the scene's $name"),
        flag("-a", default="", metavar="path;path", help="more folders with files of the scene"),
        flag("-t", "--threads", type=int, default=0, help="threads of the CPU back end; 0: all cores (default: %(default)s)"),
        flag("-v", "--verbose", action="store_true", help="show Mitsuba's messages"),
    ]


def model_flags(text: str) -> list[tuple[tuple[str, ...], dict[str, Any]]]:
    """Flags for the model of a fit to photographs."""
    from mivol.config import MODELS

    return [
        flag("--as", dest="model", choices=tuple(MODELS), help=f"for photographs: {text}"),
        flag(
            "--preset",
            help="preset of that model; of Gaussians: minute (default), minutes, fine, ...; of a grid: cpu (default) for an "
            "object, capture for a place around the cameras, ...; of a hash grid: minute (default), minutes, gpu; of a "
            "NeRF: tiny, minutes (default), gpu; of an "
            "octree: the grid's",
        ),
    ]


def explain_flags() -> list:
    """Flags of ``mivol explain``."""
    return [
        *scene_flags(
            "scene (.xml), experiment (.toml), points or Gaussians (.ply, .spz, ...), field (.npz), volume (.vdb, .nrrd, ...), "
            "scan (HDF5, .xtekct, folder), or photographs (folder, file)"
        ),
        flag("-o", "--output", type=Path, help="image (.png, .svg) of the cameras of photographs, and of the boxes"),
        *model_flags("explain the fit of mivol optimize with this --as"),
        list_flag("--set", "key=value", "override a setting of the experiment"),
        DATASET,
        SHAPE,
        DTYPE,
        MAX_DEPTH,
        flag(
            "--noise", type=float, default=0.02,
            help="noise of a pixel over the mean radiance; the proposed max_depth neglects less (default: %(default)s)",
        ),
    ]  # fmt: skip


def render_flags() -> list:
    """Flags of ``mivol render``."""
    from mivol.experiments.render import DRAWN_AS

    return [
        *scene_flags("scene (.xml), radiance field (.npz), points or Gaussians (.ply, .npy, .spz, ...) or volume (.vdb, ...)"),
        flag(
            "--look-at", type=float, nargs=6, metavar=("x", "y", "z", "to_x", "to_y", "to_z"),
            help="for a field, points or a volume: positions of camera and target [length] (default: the view that a fit keeps "
            "in its file, or a view of everything)",
        ),
        flag("--up", type=float, nargs=3, metavar=("x", "y", "z"),
             help="upward direction of that camera (default: up in the photographs of a fit, else 0 0 1)"),
        flag("--fov", type=float, help="horizontal field of view of that camera [degree] (default: of the kept view, or 50)"),
        flag("--size", type=int, nargs=2, metavar=("width", "height"),
             help="image size of that camera [pixel] (default: proportions of the kept view, or 640 480)"),
        flag("--points", choices=DRAWN_AS, default=DRAWN_AS[0], help="shape of drawn points (default: %(default)s)"),
        flag("--radius", type=float,
             help="radius of discs, or standard deviation of splats [length] (default: half the median distance of points)"),
        flag("--opacity", type=float, default=1.0, help="opacity of points (default: %(default)s)"),
        SENSOR,
        flag("-o", "--output", type=Path, help="image, .exr or .png (default: the name of the input with .exr)"),
        flag("--integrator", help="integrator in place of the scene's, with the same max_depth: mivol, volpath, ..."),
        flag("--spp", type=int, help="samples per pixel (default: the number of the sensor's sampler)"),
        SEED,
        CLUSTER,
    ]  # fmt: skip


def reference_flags() -> list:
    """Flags of ``mivol reference``."""
    return [
        *scene_flags(),
        flag("-s", "--sensor", type=lambda text: text if text == "all" else int(text), default=0,
             help="index of the sensor, or all for a set of photographs (default: %(default)s)"),
        flag("-o", "--output", type=Path, default=Path("references"), help=".exr file, or a folder (default: %(default)s)"),
        flag("--max-depth", type=int, required=True, help="longest path; -1: unlimited"),
        flag("--target", type=float, help="RMS standard error of the mean at which rendering stops [radiance]"),
        flag("--spp", type=int, default=1 << 16, help="largest number of samples per pixel (default: %(default)s)"),
        SEED,
        flag("--integrator", default="volpath", help="volpath or volpathmis (default: %(default)s)"),
        CLUSTER,
    ]  # fmt: skip


def optimize_flags() -> list:
    """Flags of ``mivol optimize``."""
    return [
        flag(
            "experiment",
            type=Path,
            help="experiment (.toml), a scan (HDF5, .xtekct, folder), or posed photographs: a folder or a file of cameras",
        ),
        *model_flags("the model to fit, if there is no TOML file (default: gaussians)"),
        list_flag("--set", "key=value", "override a setting of the experiment"),
        flag("-o", "--output", type=Path, help="run folder (default: the experiment's output)"),
        flag("--resume", action="store_true", help="continue from the checkpoint in the run folder"),
        CLUSTER,
    ]


def sweep_flags() -> list:
    """Flags of ``mivol sweep``."""
    return [
        flag("experiment", type=Path, help="experiment (.toml)"),
        list_flag("--over", "key=values", "values of a setting: fit.spp=4,16,64 or seed=0..9; again for more settings"),
        list_flag("--set", "key=value", "override a setting of all runs"),
        flag("-o", "--output", type=Path, help="folder of the sweep (default: the experiment's output with _sweep)"),
        CLUSTER,
    ]


def describe_settings() -> str:
    """All settings of a TOML file, by kind of experiment."""
    from mivol import config
    from mivol.schema import describe

    lines = ["Settings of the TOML file, by kind of experiment."]
    for kind in config.EXPERIMENTS:
        lines += ["", f"{kind.__doc__}".replace("``", "").rstrip(".") + ":", *describe(kind)]
    return "\n  ".join(lines)


def validate_flags() -> list:
    """Flags of ``mivol validate``."""
    return [
        *scene_flags(),
        SENSOR,
        flag("-o", "--output", type=Path, default=Path("validation"), help="folder of the results (default: %(default)s)"),
        MAX_DEPTH,
        flag("--spp", type=int, default=256, help="samples per pixel of mivol (default: %(default)s)"),
        flag("--reference-spp", type=int, default=1024, help="samples per pixel of Mitsuba's volpath (default: %(default)s)"),
        SEED,
        list_flag("--parameter", "key", "check the gradient of this parameter too"),
        CLUSTER,
    ]


def export_flags() -> list:
    """Flags of ``mivol export``."""
    from mivol.fields.field_files import FIELD_FORMATS

    formats = ", ".join(f"{suffix} ({kind.name})" for suffix, kind in FIELD_FORMATS.items())
    return [
        flag("field", type=Path, help="radiance field (.npz) of mivol, or a checkpoint of svox2"),
        flag("output", type=Path, help=f"file to write; its suffix chooses the format: {formats}"),
        flag("--level", type=float,
             help="extinction at a mesh's surface [1/length] (default: a voxel of opacity 0.5, or half the maximum if lower)"),
        MODE,
    ]  # fmt: skip


def convert_flags() -> list:
    """Flags of ``mivol convert``."""
    from mivol.files.formats import VOLUME_SUFFIXES, WRITERS
    from mivol.points.cloud import CLOUD_READERS, CLOUD_WRITERS
    from mivol.points.gaussian_files import GAUSSIAN_READERS, GAUSSIAN_WRITERS
    from mivol.points.summary import KINDS

    readable, writable = ({**GAUSSIAN_READERS, **CLOUD_READERS}, {**GAUSSIAN_WRITERS, **CLOUD_WRITERS})
    return [
        flag("source", type=Path,
             help=f"file to read: {', '.join(readable)}, .npz (field); volumes: {', '.join(VOLUME_SUFFIXES)}"),
        flag("output", type=Path,
             help=f"file to write: {', '.join(writable)}, .npz (field), .obj (mesh); volumes: {', '.join(WRITERS)}"),
        DATASET,
        SHAPE,
        DTYPE,
        flag("--to", choices=(*KINDS, "field", "mesh", "octree", "grid", "hash", "nerf"),
             help="kind of the output (default: as the source, if possible)"),
        flag("--resolution", type=int,
             help="for a field or a mesh: voxels along the longest edge (default: 128); for Gaussians from a field: Gaussians "
             "along that edge (default: one per two voxels); for an octree: leaves along the edge of its cube, a power of two "
             "(default: two per voxel)"),
        flag("--box", type=float, nargs=6, metavar=("x", "y", "z", "to_x", "to_y", "to_z"),
             help="box of a field or a mesh (default: three standard deviations around all Gaussians), or box that crops "
             "Gaussians or points [length]"),
        MODE,
    ]  # fmt: skip


def view_flags() -> list:
    """Flags of ``mivol view``."""
    return [
        *scene_flags(
            "run folder, posed photographs, field (.npz), points or Gaussians (.ply, ...), volume (.vdb, ...), or scene (.xml)"
        ),
        flag("--photos", type=Path, metavar="FOLDER", help="show the cameras of these photographs too"),
        flag("--write", type=Path, metavar="FOLDER", help="write crops and films there (default: nothing is written)"),
        flag("--port", type=int, default=8080, help="port; a taken one is passed over (default: %(default)s)"),
        DATASET,
    ]


# -- Verbs -----------------------------------------------------------------------------------------------------------------


def demo(arguments: argparse.Namespace) -> None:
    """Run an example, list the examples, or copy the files of an example."""
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.examples import copy_example, list_examples, run_example

    if not arguments.name:
        print(list_examples())
    elif arguments.into is not None:
        print(copy_example(arguments.name, arguments.into))
    else:
        options = {"changes": tuple(arguments.set), "progress": TerminalProgress(), "command": arguments.command}
        print(run_example(arguments.name, arguments.output, **options))


def explain(arguments: argparse.Namespace) -> int:
    """Say what mivol would do with a scene or an experiment, and why, before it renders more than a small preview.

    For photographs, explain lists present and missing data, and draws the cameras with --output. For points and
    Gaussians, it prints their number, extent, sizes and opacities; for a volume or a field, its size, values and place. The
    folder of a DICOM series is a volume; so is a folder of TIFF files without flats, darks and angles, unless --set makes it
    a scan. A refusal comes after the facts, with exit code 1.
    """
    from mivol.photos import find_format
    from mivol.points.summary import is_points_file

    if (code := explain_array(arguments)) is not None:
        return code
    if _is_experiment(arguments):
        from mivol.experiments.kinds import explain_experiment

        answer = explain_experiment(*load_experiment(arguments.scene, arguments), arguments.output)
    elif not is_points_file(arguments.scene) and (arguments.scene.is_dir() or find_format(arguments.scene)):
        return explain_photos(arguments.scene, arguments.output)
    else:
        answer = _explain_file(arguments)
    print(answer.text)
    return int(bool(answer.refusal))


def _explain_file(arguments: argparse.Namespace) -> Explanation | FileSummary:
    """Explain points, Gaussians or a scene."""
    from mivol.points.summary import is_points_file, summarize_file

    if is_points_file(arguments.scene):
        return summarize_file(arguments.scene)
    from mivol.scene.explain import explain_scene

    return explain_scene(load_named_scene(arguments).scene, arguments.max_depth, noise=arguments.noise)


def explain_array(arguments: argparse.Namespace) -> int | None:
    """Explain a scan, or describe a volume or a field, and return the exit code; None for anything else."""
    from mivol.experiments.found_scan import TIFF_FOLDER, find_scan
    from mivol.files.formats import describe_volume

    layout = _raw_layout(arguments)
    is_array = bool(layout) or _is_array(_check_dataset(arguments.scene, arguments.dataset))
    if not layout and (draft := draft_of(arguments.scene, arguments, is_array)):
        return explain_scan(draft)
    if not is_array and arguments.scene.suffix.lower() == ".npz":
        from mivol.experiments.octree_conversion import describe_field

        print(describe_field(arguments.scene, arguments.mode).text)
        return 0
    if not is_array:
        return None
    print(describe_volume(arguments.scene, arguments.dataset, **layout))
    if arguments.dataset is None and arguments.scene.is_dir() and find_scan(arguments.scene) == TIFF_FOLDER:
        print(
            "a volume, for want of flats, darks and angles: mivol optimize takes it as a scan, mivol explain does so with --set"
        )
    return 0


def explain_scan(draft: ScanDraft) -> int:
    """Print what was found, the steps of the fit, and the TOML file that says the same."""
    from mivol import config
    from mivol.experiments.kinds import explain_experiment

    answer = explain_experiment(config.from_dict(draft.raw), Path())
    print("\n".join([*draft.lines, answer.text, "", "# the same as a TOML file, for mivol optimize", draft.toml]))
    return int(bool(answer.refusal))


def draft_of(path: Path, arguments: argparse.Namespace, is_array: bool = False) -> ScanDraft | None:
    """Return the settings of a scan without a TOML file; None for anything else.

    An HDF5 file without the layout of a scan counts as one if its suffix is not that of a volume, or with ``--set``;
    ``--dataset`` makes it a volume. So does a folder of TIFF files for ``is_array``: it is a scan with flats, darks or angles.

    Raises:
        MivolError: as :func:`mivol.experiments.found_scan.draft_scan`.
    """
    from mivol.experiments.found_scan import TIFF_FOLDER, draft_scan, find_scan, has_scan_files
    from mivol.files.hdf5 import is_hdf5

    is_photographs = arguments.preset is not None or arguments.model is not None
    if is_photographs or getattr(arguments, "dataset", None) is not None or path.suffix.lower() == ".toml":
        return None
    is_named = path.is_file() and is_hdf5(path) and (arguments.set or not is_array)
    kind = find_scan(path)
    if kind == TIFF_FOLDER and is_array and not arguments.set and not has_scan_files(path):
        return None
    return draft_scan(path, arguments.set) if is_named or kind else None


def _is_experiment(arguments: argparse.Namespace) -> bool:
    """Whether a fit is to be explained; refuse ``--set`` for anything else."""
    has_model = arguments.preset is not None or arguments.model is not None
    is_experiment = arguments.scene.suffix.lower() == ".toml" or has_model
    if arguments.set and not is_experiment:
        raise MivolError(f"--set is for fits, and {arguments.scene} is not a fit: give --as, or the file of an experiment.")
    return is_experiment


def _check_contents(path: Path) -> None:
    """Refuse a volume, and binary data that no reader takes, in place of a scene, an experiment or a cloud."""
    from mivol.files.formats import is_unread, refuse_unread

    if is_unread(path):
        raise refuse_unread(path)
    if _is_array(path):
        raise MivolError(f"{path}: found a volume, expected a scene, a fit or points; render, explain and convert take it.")


def _is_array(path: Path) -> bool:
    """Whether a file or a folder is a volume; a folder of photographs with cameras is none."""
    from mivol.files.formats import is_volume
    from mivol.photos import find_format

    return is_volume(path) and not (path.is_dir() and find_format(path))


def _raw_layout(arguments: argparse.Namespace) -> dict[str, Any]:
    """Shape and type of raw bytes from the flags; empty without them."""
    if arguments.shape is None and arguments.dtype is None:
        return {}
    words = (arguments.shape or "").split(",")
    if arguments.shape is not None and not all(re.fullmatch(r"\s*\d{1,9}\s*", word, re.ASCII) for word in words):
        raise MivolError(f"--shape: found {arguments.shape!r}, expected Z,Y,X; write --shape 64,128,128.")
    return {"shape": None if arguments.shape is None else tuple(map(int, words)), "dtype": arguments.dtype}


def _check_dataset(path: Path, dataset: str | None) -> Path:
    """Return the file; refuse ``--dataset`` for a file that is no volume."""
    if dataset is not None and not _is_array(path):
        raise MivolError(f"--dataset names an array of a volume, and {path} is no volume: leave it out.")
    return path


def explain_photos(path: Path, picture: Path | None) -> int:
    """Print the facts of a data set, and draw the cameras into an image."""
    from mivol.experiments.photo_data import note_on_alpha
    from mivol.photos import survey_photos
    from mivol.report.cameras import plot_cameras

    survey = survey_photos(path)
    print(survey.describe())
    if note := note_on_alpha(survey):
        print(note)
    print("--as gaussians, grid, hash, nerf or octree explains a fit; --as grid --preset capture is for a place around cameras")
    if picture is not None:
        plot_cameras(survey, picture)
        print(picture)
    return 0


def load_named_scene(arguments: argparse.Namespace) -> LoadedScene:
    """Load the scene of the flags, with variant and threads.

    Raises:
        MivolError: an unknown variant, a define without "=", or an invalid scene.
    """
    import mitsuba as mi

    from mivol.back_end import choose_back_end
    from mivol.scene.load import load_scene

    _check_contents(arguments.scene)
    choose_back_end(arguments.mode, arguments.threads)
    mi.set_log_level(mi.LogLevel.Debug if arguments.verbose else mi.LogLevel.Warn)
    for folder in filter(None, arguments.a.split(";")):
        mi.file_resolver().append(folder)
    return load_scene(arguments.scene, parse_defines(arguments.define))


def parse_defines(pairs: list[str]) -> dict[str, str]:
    """Convert ``name=value`` pairs to a dict.

    Raises:
        MivolError: a pair without "=".
    """
    wrong = next((pair for pair in pairs if "=" not in pair), None)
    if wrong is not None:
        raise MivolError(f'-D "{wrong}" defines nothing: write -D name=value.')
    return dict(pair.split("=", 1) for pair in pairs)


def render(arguments: argparse.Namespace) -> None:
    """Render an image of a scene, a radiance field, points, Gaussians or a volume.

    A volume is shown as a smoke under a sky and a sun. For a scene, the flags are the flags of the command mitsuba.
    """
    from mivol.cli.cluster import check_alone, render_passes
    from mivol.experiments.render import check_output, choose_integrator, integrator_name, render_image, write_image

    path = arguments.output or arguments.scene.with_suffix(".exr")
    check_output(path)
    if view := view_without_scene(arguments):
        check_alone(arguments)
        write_image(path, *view())
        print(path)
        return
    loaded = load_named_scene(arguments)
    scene, integrator = loaded.scene, choose_integrator(loaded.scene, arguments.integrator)
    if integrator_name(integrator) != "mivol":
        print(f"rendered by {integrator_name(integrator)}; --integrator mivol renders with mivol", file=sys.stderr)
    with render_passes(arguments, loaded) as passes:
        write_image(path, *render_image(scene, arguments.sensor, integrator, arguments.spp, arguments.seed, passes))
    print(path)


def view_without_scene(arguments: argparse.Namespace) -> Callable | None:
    """Return the function to render a radiance field, points, Gaussians or a volume; None if the file is a scene.

    Raises:
        MivolError: a camera for a scene.
    """
    from mivol.back_end import set_variant
    from mivol.experiments.render import Framing, PointLook, render_field, render_points, render_volume
    from mivol.files.formats import is_volume as is_volume_file
    from mivol.points.summary import SUFFIXES

    suffix = arguments.scene.suffix.lower()
    is_field, is_cloud = suffix == ".npz", suffix in SUFFIXES
    is_volume = not (is_field or is_cloud) and arguments.scene.exists() and is_volume_file(arguments.scene)
    if not (is_cloud or is_field or is_volume) and arguments.look_at is not None:
        raise MivolError(f"{arguments.scene}: --look-at is for a field, points or a volume; a scene has its own cameras.")
    look = PointLook(arguments.points, arguments.radius, arguments.opacity)
    if not is_cloud and look != PointLook():
        raise MivolError(f"{arguments.scene}: --points, --radius and --opacity are for clouds of points: leave them out.")
    if not (is_field or is_cloud or is_volume):
        return None
    set_variant(arguments.mode)
    camera = Framing(arguments.look_at, arguments.up, arguments.fov, arguments.size and tuple(arguments.size))
    if is_volume:
        return lambda: render_volume(arguments.scene, camera, arguments.spp, arguments.seed)
    if is_cloud:
        return lambda: (render_points(arguments.scene, camera, look), ["R", "G", "B"])
    return lambda: (render_field(arguments.scene, camera), ["R", "G", "B"])


def reference(arguments: argparse.Namespace) -> None:
    """Render a reference and its variance with Mitsuba's path tracer, up to a given error.

    With --sensor all, the images of every sensor and a file of cameras are written: photographs for a fit.
    """
    from mivol.cli.cluster import complete_references
    from mivol.validate.reference import prepare_reference, render_photographs

    options = {
        "max_depth": arguments.max_depth, "target_se": arguments.target, "max_spp": arguments.spp,
        "seed": arguments.seed, "integrator": arguments.integrator,
    }  # fmt: skip
    loaded, out = load_named_scene(arguments), arguments.output
    with complete_references(arguments, loaded) as complete:
        if arguments.sensor == "all":
            results = render_photographs(loaded, out, complete=complete, **options)
        else:
            if not out.suffix:
                out.mkdir(parents=True, exist_ok=True)
            results = list(complete(iter([prepare_reference(loaded, out, sensor=arguments.sensor, **options)])))
    print("\n".join(result.text for result in results))


def poses(arguments: argparse.Namespace) -> None:
    """Find the poses of a folder of photographs or of a video, and write them to FOLDER/sparse/0 for mivol optimize.

    COLMAP searches (pip install "mivol[poses]"); nothing is downloaded, and no GPU is needed. Of a video, sharp frames between
    which the camera moved become photographs in a folder of the video's name. The same command continues after Ctrl-C.
    """
    from mivol.photos import video
    from mivol.photos.poses import check_colmap, find_poses
    from mivol.report.cameras import write_poses_page

    check_colmap()

    def say(line: str) -> None:
        print(line, file=sys.stderr)

    place = arguments.folder
    is_video = place.suffix.lower() in video.SUFFIXES and not place.is_dir()
    if arguments.fps is not None and not is_video:
        raise MivolError(f"--fps is for videos, and {place} is none: leave it out.")
    place = video.extract_frames(place, arguments.fps, say) if is_video else place
    found = find_poses(place, say)
    print(found.describe())
    print(write_poses_page(place, found))
    folder = shlex.quote(str(place))
    print(f"mivol view {folder} shows the cameras; mivol optimize {folder} fits Gaussians")


def optimize(arguments: argparse.Namespace) -> None:
    """Fit a volume, scene parameters, a radiance field or Gaussians to images, projections or photographs.

    The projections of a scan need no TOML file: an HDF5 file (NXtomo, Data Exchange), an .xtekct file, or a folder of TIFF
    files. optimize says what was found, assumed and chosen. All results are written into the run folder.
    """
    from mivol import config
    from mivol.cli.cluster import distribute_fit
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.fit_kind import RunContext
    from mivol.experiments.kinds import run_experiment

    progress, notes = TerminalProgress(), ()
    if draft := draft_of(arguments.experiment, arguments):
        settings, base, notes = config.from_dict(draft.raw, str(arguments.experiment)), Path(), draft.lines
        progress.say(notes)
    else:
        settings, base = load_experiment(arguments.experiment, arguments)
    folder = arguments.output or Path(settings.output)
    with distribute_fit(arguments, settings) as distribution:
        if distribution is not None:
            progress.note = distribution.describe
        given = arguments.resume, progress, arguments.command, notes, distribution
        print(run_experiment(RunContext(settings, base, folder, *given)))


def load_experiment(path: Path, arguments: argparse.Namespace) -> tuple[Any, Path]:
    """Load the experiment of a TOML file or of photographs, with --preset and --set.

    Returns:
        The settings, and the folder from which their relative paths start.

    Raises:
        MivolError: a preset of the other model, a model for a file that is no data set, or as ``config.load``.
    """
    from mivol import config
    from mivol.photos import find_format

    _check_contents(path)
    if path.is_dir() or (path.suffix.lower() == ".json" and find_format(path)):
        model = arguments.model or next(iter(config.MODELS))
        _check_preset(model, arguments.preset)
        return config.of_photographs(path, model, arguments.preset, arguments.set), Path()
    if arguments.preset is not None or arguments.model is not None:
        is_experiment = path.suffix.lower() == ".toml"
        fault = f"--as and --preset are for photographs, and {path} {'is an experiment' if is_experiment else 'holds none'}"
        advice = "its tables [gaussians] or [field] name model and preset" if is_experiment else "leave them out"
        raise MivolError(f"{fault}: {advice}.")
    return config.load(path, arguments.set), path.parent


def _check_preset(model: str, preset: str | None) -> None:
    """Refuse a preset that only the other model has; a preset of no model is refused with the settings."""
    from mivol.optim.gaussians.gaussian_plan import PRESETS as GAUSSIANS
    from mivol.optim.photographs.radiance_plan import PRESETS as GRIDS
    from mivol.optim.photographs.sampled_problem import PRESETS as SAMPLED

    presets = {"gaussians": GAUSSIANS, "grid": GRIDS, **SAMPLED, "octree": GRIDS}
    other = next((name for name, known in presets.items() if preset in known), model)
    if preset not in presets[model] and other != model:
        known = ", ".join(presets[model])
        raise MivolError(f"--preset {preset} is a preset of --as {other}, and --as {model} has {known}: add --as {other}.")


def sweep(arguments: argparse.Namespace) -> int:
    """Fit an experiment with several values of some settings: a run folder each, one table and one page of all.

    All combinations are checked first. The same command again runs what is missing and continues interrupted runs.
    """
    from mivol.cli.cluster import sweep

    return sweep(arguments)


def validate(arguments: argparse.Namespace) -> int:
    """Compare mivol with Mitsuba's path tracer on a scene: bias, z-image, relMSE, gradients and a verdict.

    The exit code is 0 if both agree, 3 if they differ, and 4 if Mitsuba's image is not reliable.
    """
    from mivol.cli.cluster import validate_on_workers
    from mivol.experiments.validation import Validation, validate_scene

    options = Validation(
        max_depth=arguments.max_depth, spp=arguments.spp, reference_spp=arguments.reference_spp, seed=arguments.seed,
        sensor=arguments.sensor, parameters=tuple(arguments.parameter),
    )  # fmt: skip
    loaded = load_named_scene(arguments)
    with validate_on_workers(arguments, loaded, arguments.max_depth) as workers:
        verdict = validate_scene(loaded, arguments.output, options, **workers)
    print(verdict.text)
    return verdict.code


def export(arguments: argparse.Namespace) -> None:
    """Write a radiance field as a mesh, volumes, a scene with its sky, or a file of another program.

    A hash grid or a NeRF becomes a grid of 128 nodes along its longest edge first, and export prints the loss in dB; mivol
    convert --to grid makes grids of other resolutions.
    """
    from mivol.back_end import set_variant
    from mivol.experiments.octree_conversion import GRID_NODES, sample_to_grid
    from mivol.experiments.render import sky_beside
    from mivol.fields.field_archives import read_field_view
    from mivol.fields.field_files import read_field, write_field
    from mivol.fields.sampled_field import SampledField

    set_variant(arguments.mode)
    field, sky, view = read_field(arguments.field), sky_beside(arguments.field), read_field_view(arguments.field)
    is_copy = arguments.output.suffix == ".npz" and not arguments.output.name.endswith((".svox2.npz", ".svox.npz"))
    if isinstance(field, SampledField) and not is_copy:
        field, lines = sample_to_grid(field, GRID_NODES)
        print(lines)
    print("\n".join(str(path) for path in write_field(arguments.output, field, arguments.level, sky, view=view)))


def convert(arguments: argparse.Namespace) -> None:
    """Convert points, Gaussians and radiance fields to each other, to meshes, and between file formats; volumes too.

    A field (.npz) is the mivol_sh of a scene, an octree, a hash grid or a NeRF; --to grid, octree, hash or nerf turns one into
    another, hash and nerf also Gaussians, by a fit to views of the source.
    Conversions between kinds of fields and Gaussians (.ply) print their error in dB, from views of both. A mesh (.obj, or .ply
    with --to mesh) is fused from depths of splatted views; convert prints the distance between mesh and splats.
    A scene of pbrt-v4 (.pbrt) becomes Mitsuba XML (.xml) with media of mivol.
    """
    if arguments.output.suffix.lower() == ".xml" and arguments.source.suffix.lower() == ".pbrt":
        print(_convert_scene(arguments))
        return
    is_array = bool(_raw_layout(arguments)) or _becomes_volume(arguments.source, arguments.output)
    is_array = is_array or _is_array(_check_dataset(arguments.source, arguments.dataset))
    print((_convert_volume if is_array else _convert_cloud)(arguments))


def _becomes_volume(source: Path, target: Path) -> bool:
    """Whether an archive, as a fit writes volumes, is to be written in a format of volumes alone."""
    from mivol.files.formats import VOLUME_SUFFIXES

    return source.suffix.lower() in (".npz", ".npy") and target.name.lower().endswith(VOLUME_SUFFIXES)


def _convert_scene(arguments: argparse.Namespace) -> str:
    """Convert a scene of pbrt; return the lines to print."""
    import mitsuba as mi

    mi.set_variant(arguments.mode)
    return mivol.convert_pbrt(arguments.source, arguments.output)


def _convert_volume(arguments: argparse.Namespace) -> str:
    """Convert a volume; return the line to print."""
    from mivol.files.formats import convert_volume

    if arguments.to or arguments.resolution or arguments.box:
        raise MivolError(
            f"{arguments.source}: --to, --resolution and --box are for points, Gaussians and fields: leave them out."
        )
    return convert_volume(arguments.source, arguments.output, arguments.dataset, **_raw_layout(arguments))


def _convert_cloud(arguments: argparse.Namespace) -> str:
    """Convert points, Gaussians or a field; return the lines to print."""
    from mivol.experiments import gaussian_conversion
    from mivol.points.summary import convert_file, is_points_file

    source, target, resolution = arguments.source, arguments.output, arguments.resolution
    if not is_points_file(source) and source.suffix.lower() != ".npz":
        _check_contents(source)
    kind = _check_conversion(arguments)
    if kind in ("hash", "nerf"):
        from mivol.experiments.network_conversion import convert_to_network

        return convert_to_network(source, target, kind, arguments.mode)
    if source.suffix.lower() == ".npz" and target.suffix.lower() == ".npz":
        from mivol.experiments import octree_conversion

        if kind == "grid":
            return octree_conversion.convert_to_grid(source, target, resolution, arguments.mode)
        return octree_conversion.convert_to_octree(source, target, resolution, arguments.mode)
    if source.suffix.lower() == ".npz":
        return gaussian_conversion.convert_to_gaussians(source, target, resolution, arguments.mode)
    if kind not in ("field", "mesh"):
        return convert_file(source, target, kind, arguments.box)
    make = gaussian_conversion.convert_to_field if kind == "field" else gaussian_conversion.convert_to_mesh
    return make(source, target, 128 if resolution is None else resolution, arguments.box, arguments.mode)


def _check_conversion(arguments: argparse.Namespace) -> str | None:
    """Return the kind of the output; refuse flags and suffixes that do not belong together."""
    source, target = arguments.source, arguments.output
    from_field, is_field = (path.suffix.lower() == ".npz" for path in (source, target))
    kind = arguments.to or WRITTEN_AS.get(target.suffix.lower())
    if kind in ("hash", "nerf"):
        if not is_field or arguments.resolution or arguments.box:
            raise MivolError(f"{target}: --to {kind} writes an .npz, fitted to views of the source: leave out other flags.")
        return kind
    if from_field and is_field and arguments.to not in ("grid", "octree"):
        raise MivolError(
            f"{target}: --to says what a field becomes: octree, hash or nerf; a field other than a grid also becomes a grid."
        )
    if kind in ("octree", "grid") and not (from_field and is_field):
        raise MivolError(f"{target}: --to {kind} makes an .npz from a radiance field (.npz); make a field first: --to field.")
    if is_field != (kind in ("field", "octree", "grid")):
        raise MivolError(f"{target}: a radiance field is written as .npz, and nothing else is; leave out --to {arguments.to}.")
    if from_field and not is_field and kind not in (None, "gaussians"):
        raise MivolError(
            f"{source}: a radiance field becomes Gaussians (.ply) here; mivol export writes it as a mesh and more."
        )
    is_gridded = kind in ("field", "mesh")
    if arguments.box is not None and from_field:
        raise MivolError(f"{source}: --box crops Gaussians and points, not a radiance field: leave it out.")
    if arguments.resolution is not None and not (is_gridded or from_field):
        raise MivolError(f"{target}: --resolution is for a radiance field (.npz) or a mesh: leave it out.")
    return kind


WRITTEN_AS = {".npz": "field", ".obj": "mesh"}
"""Kind of the file by suffix, for suffixes of a single kind."""


def view(arguments: argparse.Namespace) -> None:
    """Look at a run, a model, photographs, a volume or a scene in a browser, until Ctrl-C.

    The page (pip install "mivol[viewer]") is for this machine only: the address has a token, and another host is turned away.
    Drag to turn, scroll to come closer, W A S D Q E to fly, click a camera to look from there. A run may still be fitting.
    """
    import mitsuba as mi

    from mivol.back_end import choose_back_end
    from mivol.view.page import Page, check_viser, serve
    from mivol.view.runs import open_subject

    check_viser()
    choose_back_end(arguments.mode, arguments.threads)
    mi.set_log_level(mi.LogLevel.Debug if arguments.verbose else mi.LogLevel.Warn)
    for folder in filter(None, arguments.a.split(";")):
        mi.file_resolver().append(folder)
    defines = parse_defines(arguments.define)
    subject = open_subject(arguments.scene, arguments.photos, arguments.dataset, defines)
    page = Page(subject, arguments.write, arguments.port)
    page.warm_up()
    print(f"open {page.address} in a browser of this machine; Ctrl-C ends the viewer", flush=True)
    serve(page)


def report(arguments: argparse.Namespace) -> None:
    """Write the report page of a run folder again."""
    from mivol.report.page import write_page

    print(write_page(arguments.folder))


def fetch(arguments: argparse.Namespace) -> None:
    """Download public data of the examples into a cache, and verify the data."""
    from mivol.files.fetch import DATA, fetch_data, find_data_set

    if not arguments.name:
        print("\n".join(data.describe() for data in DATA.values()))
        return
    data = find_data_set(arguments.name)
    print(data.describe(), file=sys.stderr)
    print(fetch_data(data, arguments.into))


def bench(arguments: argparse.Namespace) -> int:
    """Run a study of speed or accuracy beside other programs; write JSON and a figure, and check limits."""
    from mivol.bench.harness.catalogue import list_studies, run_study

    if not arguments.study:
        print(list_studies())
        return 0
    flags = ["--quick"] if arguments.quick else []
    return run_study(arguments.study, [*flags, *arguments.rest], arguments.compare)


def doctor(arguments: argparse.Namespace) -> int:
    """Check whether this machine can render, and say how to fix a missing part."""
    from mivol.doctor import main

    return main([])


VERBS: dict[str, Verb] = {
    "demo": Verb(
        demo,
        lambda: [
            flag("name", nargs="?", default="", help="name of the example; without a name, demo lists the examples"),
            flag("--into", type=Path, metavar="folder", help="copy the example's files into this folder, and do not run it"),
            list_flag("--set", "key=value", "override a setting"),
            flag("-o", "--output", type=Path, help="run folder (default: runs/NAME)"),
        ],
    ),
    "explain": Verb(explain, explain_flags),
    "render": Verb(render, render_flags),
    "reference": Verb(reference, reference_flags),
    "poses": Verb(
        poses,
        lambda: [
            flag("folder", type=Path, help="folder of photographs, in images/ or in itself; or a video (.mp4, .mov, ...)"),
            flag("--fps", type=float, help="frames of a video a second, at most (default: 2, and at most 300 in all)"),
        ],
    ),
    "optimize": Verb(optimize, optimize_flags, describe_settings),
    "sweep": Verb(sweep, sweep_flags),
    "validate": Verb(validate, validate_flags),
    "view": Verb(view, view_flags),
    "export": Verb(export, export_flags),
    "convert": Verb(convert, convert_flags),
    "report": Verb(report, lambda: [flag("folder", type=Path, help="run folder")]),
    "fetch": Verb(
        fetch,
        lambda: [
            flag(
                "name", nargs="?", default="", help="name of the data; without a name, fetch lists them with licence and size"
            ),
            flag("--into", type=Path, metavar="folder", help="folder (default: MIVOL_CACHE, or the user's cache)"),
        ],
    ),
    "bench": Verb(
        bench,
        lambda: [
            flag("study", nargs="?", default="", help="name of the study; without a name, bench lists the studies"),
            flag("--quick", action="store_true", help="run small work that tests the study; its times mean nothing"),
            flag("--compare", type=Path, metavar="old.json", help="print the changes since an earlier result"),
        ],
        lambda: "A study has more flags of its own: --only, --out, --variant, ...",
    ),
    "doctor": Verb(doctor),
}
