"""The command ``mivol``: a verb is one function and one entry of ``VERBS``.

Conventions. A refusal of mivol, a full disk or memory, and Ctrl-C become one sentence on the error output and a nonzero exit
code; only a bug of the program shows a traceback. Each verb makes its own slow imports.
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mivol
from mivol.cli.flags import (
    convert_flags,
    explain_flags,
    export_flags,
    flag,
    list_flag,
    optimize_flags,
    reference_flags,
    render_flags,
    sweep_flags,
    validate_flags,
    view_flags,
)
from mivol.cli.inputs import convert, draft_scan_from, explain, load_experiment, load_named_scene, parse_defines
from mivol.errors import MivolError, MivolWarning
from mivol.optim.interrupt import Signals

STOPPED, UNREAD = 130, 141

DESCRIPTION = """Differentiable and inverse volume rendering on Mitsuba 3. "mivol doctor" checks whether this machine can
render. "mivol demo" lists examples. "mivol VERB --help" explains a verb."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``mivol`` with these arguments (default: the arguments of the process).

    Returns:
        Exit code: 0 for success, 1 for a refusal, 2 for wrong arguments, 130 for Ctrl-C and SIGTERM, 141 if nobody
        reads the output any more; ``validate`` has more.
    """
    signals = Signals()
    if argv is None:  # the process is the program
        warnings.formatwarning = format_warning
    try:
        try:
            arguments = parse(list(sys.argv[1:] if argv is None else argv))
            return arguments.verb(arguments) or 0
        finally:
            sys.stdout.flush()
    except BaseException as error:
        if isinstance(error, BrokenPipeError) and _is_output_closed():
            return UNREAD
        if signals.are_behind(error):
            print("mivol: stopped; finished work is kept.", file=sys.stderr)
            return STOPPED
        if not isinstance(error, MivolError | OSError | MemoryError):
            raise
        print(f"mivol: {describe_error(error)}", file=sys.stderr)
        return 1


def _is_output_closed() -> bool:
    """Whether the reader of the output has gone, as in ``mivol explain scene.xml | head``; then the output goes nowhere.

    A text longer than Python's buffer is lost at the first write, so a further flush tells nothing, and the system is asked.
    """
    try:
        sys.stdout.flush()
        pipe = select.poll()
        pipe.register(sys.stdout.fileno(), 0)
        is_closed = bool(pipe.poll(0))
    except BrokenPipeError:
        is_closed = True
    if is_closed:
        # Python flushes once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return is_closed


def describe_error(error: MivolError | OSError | MemoryError) -> str:
    """Message for an error other than a bug."""
    if isinstance(error, MemoryError):
        return f"the memory does not suffice ({str(error) or 'nothing more is known'}): take fewer voxels, pixels or views."
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"no space is left on the disk ({error}): free some space, or write elsewhere; finished files are kept."
    return str(error)


def format_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    """Text of a warning: the sentence of a :class:`MivolWarning`, and Python's text of any other."""
    if issubclass(category, MivolWarning):
        return f"mivol: {message}\n"
    return FORMAT_OF_PYTHON(message, category, filename, lineno, line)


FORMAT_OF_PYTHON = warnings.formatwarning


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse a command; wrong arguments end the process.

    Returns:
        The flags, with the verb's function as ``verb``, the whole command line as ``command``, and the own flags of a study as
        ``rest``.
    """
    known = parser()
    if words[:1] == ["bench"] and {"-h", "--help"} & set(words[2:]):
        from mivol.bench.harness.catalogue import run_study

        run_study(words[1], ["--help"], None)  # ends the process
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
    """

    run: Callable[[argparse.Namespace], int | None]
    flags: Callable[[], list[tuple[tuple[str, ...], dict[str, Any]]]] = list

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
        """Add the flags to the parser of the verb."""
        for names, options in self.flags():
            sub.add_argument(*names, **options)


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
    from mivol.cli.inputs import check_dataset
    from mivol.experiments.render import Framing, PointLook, render_field, render_points, render_volume
    from mivol.files.formats import is_volume as is_volume_file
    from mivol.points.summary import SUFFIXES

    suffix = arguments.scene.suffix.lower()
    is_field, is_cloud = suffix == ".npz", suffix in SUFFIXES
    is_volume = not (is_field or is_cloud) and arguments.scene.exists() and is_volume_file(arguments.scene)
    if not (is_cloud or is_field or is_volume) and arguments.look_at is not None:
        raise MivolError(f"{arguments.scene}: --look-at is for a field, points or a volume; a scene has its own cameras.")
    check_dataset(arguments.scene, arguments.dataset)
    look = PointLook(arguments.points, arguments.radius, arguments.opacity)
    if not is_cloud and look != PointLook():
        raise MivolError(f"{arguments.scene}: --points, --radius and --opacity are for clouds of points: leave them out.")
    if not (is_field or is_cloud or is_volume):
        return None
    set_variant(arguments.mode)
    camera = Framing(arguments.look_at, arguments.up, arguments.fov, arguments.size and tuple(arguments.size))
    if is_volume:
        return lambda: render_volume(arguments.scene, camera, arguments.spp, arguments.seed, arguments.dataset)
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

    COLMAP finds the poses (pip install "mivol[poses]"); nothing is downloaded, and no GPU is needed. From a video, mivol first
    copies sharp frames with parallax into a folder with the name of the video. The same command continues after Ctrl-C.
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
    found = find_poses(place, say, is_video)
    print(found.describe())
    print(write_poses_page(place, found))
    folder = shlex.quote(str(place))
    print(f"mivol view {folder} shows the cameras; mivol optimize {folder} fits Gaussians")


def optimize(arguments: argparse.Namespace) -> None:
    """Fit a volume, scene parameters, a radiance field or Gaussians to images, projections or photographs.

    The projections of a scan need no TOML file: an HDF5 file (NXtomo, Data Exchange), an .xtekct file, or a folder of TIFF
    files. mivol prints what it found, assumed and chose. All results are written into the run folder. --settings prints the
    settings of TOML files.
    """
    from mivol import config
    from mivol.cli.cluster import distribute_fit
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.fit_kind import RunContext
    from mivol.experiments.kinds import run_experiment

    progress, notes = TerminalProgress(), ()
    if draft := draft_scan_from(arguments.experiment, arguments):
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


def sweep(arguments: argparse.Namespace) -> int:
    """Fit an experiment with several values of some settings: a run folder for each fit, a table and a page of the sweep.

    Every combination is checked before the first fit. The same command again runs missing fits and continues interrupted fits.
    """
    from mivol.cli.cluster import sweep

    return sweep(arguments)


def validate(arguments: argparse.Namespace) -> int:
    """Compare mivol with Mitsuba's path tracer on a scene: bias, z-image (difference / error), relMSE, gradients, verdict.

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
    """Write a radiance field as a mesh, volumes, a scene with its sky, or a file of another program; Gaussians as a scene.

    A hash grid or a NeRF becomes a grid of 128 nodes along its longest edge first, and export prints the loss in dB; mivol
    convert --to grid makes grids of other resolutions.
    """
    from mivol.back_end import set_variant
    from mivol.experiments.field_conversion import grid_of_network
    from mivol.experiments.gaussian_conversion import convert_to_scene
    from mivol.experiments.render import sky_beside
    from mivol.fields.field_archives import read_field_view
    from mivol.fields.field_files import read_field, write_field
    from mivol.fields.sampled_field import SampledField
    from mivol.files.formats import check_has_reader
    from mivol.points.summary import SUFFIXES

    set_variant(arguments.mode)
    if arguments.field.suffix.lower() in SUFFIXES:
        if arguments.level is not None:
            raise MivolError(f"{arguments.field}: --level is for the mesh of a field: leave it out.")
        print("\n".join(str(path) for path in convert_to_scene(arguments.field, arguments.output)))
        return
    check_has_reader(arguments.field)
    field, sky, view = read_field(arguments.field), sky_beside(arguments.field), read_field_view(arguments.field)
    is_copy = arguments.output.suffix == ".npz" and not arguments.output.name.endswith((".svox2.npz", ".svox.npz"))
    if isinstance(field, SampledField) and not is_copy:
        field, lines = grid_of_network(field)
        print(lines)
    print("\n".join(str(path) for path in write_field(arguments.output, field, arguments.level, sky, view=view)))


def view(arguments: argparse.Namespace) -> None:
    """Show a run, a model, photographs, a volume or a scene in a browser, until you press Ctrl-C.

    The page (pip install "mivol[viewer]") is for this machine only: the address has a token, and another host is turned away.
    Drag to turn, scroll to come closer, W A S D Q E to fly, click a camera to look from there. A run may still be fitting.
    """
    import mitsuba as mi

    from mivol.back_end import choose_back_end
    from mivol.view.page import Page, check_viser, serve
    from mivol.view.subjects import open_subject

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
    """Run a study of speed or accuracy beside other programs, write JSON and a figure, and check the results against limits.

    A study has more flags of its own: --only, --out, --variant, ... (mivol bench STUDY --help).
    """
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
            flag("--fps", type=float, help="most frames per second of a video (default: 2, and at most 300 in all)"),
        ],
    ),
    "optimize": Verb(optimize, optimize_flags),
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
    ),
    "doctor": Verb(doctor),
}
