"""The command ``mivol``: each verb is one call per arrow of the scene's way to an image, a volume or a page.

Conventions. What mivol refuses, a full disk or memory and Ctrl-C become one sentence on the error output and an exit code that
is not 0; only a mistake of the program itself shows a traceback. Slow imports wait for the verb that needs them.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mivol
from mivol.cli.interrupts import Signals
from mivol.errors import MivolError

USAGE, STOPPED = 2, 130

DESCRIPTION = """Differentiable and inverse volume rendering on Mitsuba 3. Begin with "mivol doctor", which says whether a
render would work here, and "mivol demo", which lists examples. "mivol VERB --help" says what a verb takes."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``mivol`` with these arguments (by default the process's own).

    Returns:
        Exit code: 0, 1 for what was refused, 2 for wrong arguments, 130 for Ctrl-C and SIGTERM; ``validate`` has more.
    """
    signals = Signals()
    try:
        arguments = parse(list(sys.argv[1:] if argv is None else argv))
        return arguments.verb(arguments) or 0
    except BaseException as error:
        if signals.are_behind(error):
            print("mivol: stopped; what was finished is kept.", file=sys.stderr)
            return STOPPED
        if not isinstance(error, MivolError | OSError | MemoryError):
            raise
        print(f"mivol: {sentence_of(error)}", file=sys.stderr)
        return 1


def sentence_of(error: MivolError | OSError | MemoryError) -> str:
    """What is said of an error that is no mistake of the program."""
    if isinstance(error, MemoryError):
        return f"the memory does not suffice ({error or 'nothing more is known'}): take fewer voxels, pixels or views."
    return str(error)


def parse(given: Sequence[str]) -> argparse.Namespace:
    """The flags of a command, with the command as it was typed and what is a study's own; wrong ones end the process."""
    known = parser()
    arguments, rest = known.parse_known_args(given)
    arguments.rest = rest
    if rest and arguments.verb is not bench:
        known.error(f"unrecognized arguments: {' '.join(rest)}")
    arguments.command = shlex.join(["mivol", *given])
    return arguments


def parser() -> argparse.ArgumentParser:
    """All verbs and their flags."""
    top = argparse.ArgumentParser(prog="mivol", description=DESCRIPTION)
    top.add_argument("--version", action="version", version=f"mivol {mivol.__version__}")
    verbs = top.add_subparsers(required=True, metavar="verb")
    for name, (verb, flags) in VERBS.items():
        sub = verbs.add_parser(
            name, help=first_line(verb), description=verb.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        sub.set_defaults(verb=verb)
        flags(sub)
    return top


def first_line(verb: Callable) -> str:
    """What a verb does, in a line."""
    return (verb.__doc__ or "").partition("\n")[0]


# -- Flags --------------------------------------------------------------------------------------------------------


def scene_flags(sub: argparse.ArgumentParser, what: str = "Mitsuba XML") -> None:
    """Mitsuba's own flags for what is loaded."""
    sub.add_argument("scene", type=Path, help=what)
    sub.add_argument("-m", "--mode", default="llvm_ad_rgb", help="variant (default: %(default)s)")
    sub.add_argument("-D", "--define", action="append", default=[], metavar="name=value", help="fill in $name")
    sub.add_argument("-a", default="", metavar="path;path", help="more folders to look for files in")
    sub.add_argument("-t", "--threads", type=int, default=0, help="threads of the CPU back end; 0: all cores")
    sub.add_argument("-v", "--verbose", action="store_true", help="Mitsuba's own messages")


def explain_flags(sub: argparse.ArgumentParser) -> None:
    """A scene, or a data set with a picture of its cameras."""
    kinds = "Mitsuba XML, an experiment (.toml), points or Gaussians (.ply, .spz, ...), or photographs: a folder or its file"
    scene_flags(sub, kinds)
    sub.add_argument("-o", "--output", type=Path, help="draw the cameras of photographs, and the boxes (.png, .svg)")
    sub.add_argument("--preset", help="of photographs: what mivol optimize --preset would do with them; capture, cpu, ...")
    sub.add_argument("--set", action="append", default=[], metavar="key=value", help="override a setting of such a fit")
    sub.add_argument("--max-depth", type=int, help="longest path asked about; default: that of the scene's integrator")
    aim = "noise of a pixel over the mean radiance; max_depth has to leave out less (default: %(default)s)"
    sub.add_argument("--noise", type=float, default=0.02, help=aim)


def render_flags(sub: argparse.ArgumentParser) -> None:
    """Mitsuba's own flags for an image, and the camera of a radiance field, of points and of Gaussians."""
    from mivol.experiments.render import DRAWN_AS

    scene_flags(sub, "Mitsuba XML, a radiance field (.npz) with --look-at, or points or Gaussians (.ply, .npy, .spz, ...)")
    where = "of a field or points: where the camera stands, and what it looks at [length]; default for points: all is seen"
    sub.add_argument("--look-at", type=float, nargs=6, metavar=("x", "y", "z", "to_x", "to_y", "to_z"), help=where)
    sub.add_argument("--up", type=float, nargs=3, metavar=("x", "y", "z"), default=[0.0, 0.0, 1.0], help="of such a picture")
    sub.add_argument("--fov", type=float, default=50.0, help="of such a picture, across [degree] (default: %(default)s)")
    sub.add_argument("--size", type=int, nargs=2, metavar=("width", "height"), default=[640, 480], help="of such a picture")
    sub.add_argument("--points", choices=DRAWN_AS, default=DRAWN_AS[0], help="what points are drawn as (default: %(default)s)")
    sizes = "of points: radius, or standard deviation of splats [length]; default: half their distance"
    sub.add_argument("--radius", type=float, help=sizes)
    sub.add_argument("--opacity", type=float, default=1.0, help="of points (default: %(default)s)")
    sub.add_argument("-s", "--sensor", type=int, default=0, help="number of the sensor")
    sub.add_argument("-o", "--output", type=Path, help="image (.exr or .png); default: the XML's name with .exr")
    sub.add_argument("--integrator", help="in place of the scene's own, with its max_depth: mivol, volpath, ...")
    sub.add_argument("--spp", type=int, help="samples per pixel; default: those of the sensor's sampler")
    sub.add_argument("--seed", type=int, default=0, help="of the random numbers (default: %(default)s)")


def reference_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of a reference."""
    scene_flags(sub)
    sub.add_argument("-s", "--sensor", type=sensor_number, default=0, help='its number, or "all": a set of photographs')
    sub.add_argument("-o", "--output", type=Path, default=Path("references"), help=".exr, or a folder")
    sub.add_argument("--max-depth", type=int, required=True, help="longest path; -1 is unlimited")
    sub.add_argument("--target", type=float, help="RMS standard error of the mean to reach [radiance]")
    sub.add_argument("--spp", type=int, default=1 << 16, help="most samples per pixel (default: %(default)s)")
    sub.add_argument("--seed", type=int, default=0, help="root of its random numbers")
    sub.add_argument("--integrator", default="volpath", help="volpath or volpathmis")


def sensor_number(text: str) -> int | str:
    """The number of a sensor, or "all"."""
    return text if text == "all" else int(text)


def optimize_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of a fit; the settings of the file come from the schema."""
    from mivol import config
    from mivol.schema import describe

    lines: list[str] = []
    for kind in config.KINDS.values():
        lines += ["", kind.__doc__.replace("``", "").rstrip(".") + ":", *describe(kind)]
    sub.epilog = "Settings of the TOML file, by kind of experiment.\n" + "\n  ".join(line.replace("%", "%%") for line in lines)
    sub.add_argument("experiment", type=Path, help="TOML file, or posed photographs: a folder or its file of cameras")
    sub.add_argument("--preset", help="of photographs without a TOML file: capture for a place around the cameras, or cpu, ...")
    sub.add_argument("--set", action="append", default=[], metavar="key=value", help="override a setting of the file")
    sub.add_argument("-o", "--output", type=Path, help="run folder")
    sub.add_argument("--resume", action="store_true", help="continue from the run folder's checkpoint")


def report_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of the page."""
    sub.add_argument("folder", type=Path, help="run folder")


def export_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of a field that becomes a file of another program."""
    from mivol.fields.field_files import FIELD_FORMATS

    known = ", ".join(f"{suffix} ({kind.name})" for suffix, kind in FIELD_FORMATS.items())
    sub.add_argument("field", type=Path, help="radiance field (.npz): mivol's, or a checkpoint of svox2")
    sub.add_argument("output", type=Path, help=f"what to write, by its suffix: {known}")
    default = "where a voxel is half opaque, or half of what thinner matter has"
    sub.add_argument("--level", type=float, help=f"extinction of a mesh's surface [1/length]; default: {default}")
    sub.add_argument("-m", "--mode", default="llvm_ad_rgb", help="variant (default: %(default)s)")


def convert_flags(sub: argparse.ArgumentParser) -> None:
    """From which file to which."""
    from mivol.points.cloud import CLOUD_READERS, CLOUD_WRITERS
    from mivol.points.gaussian_files import GAUSSIAN_READERS, GAUSSIAN_WRITERS
    from mivol.points.summary import KINDS

    known = ", ".join({**GAUSSIAN_WRITERS, **CLOUD_WRITERS})
    sub.add_argument(
        "source", type=Path, help=f"what to read: {', '.join({**GAUSSIAN_READERS, **CLOUD_READERS})}, .npz (field)"
    )
    sub.add_argument("output", type=Path, help=f"what to write: {known}, .npz (field), .obj (mesh)")
    kinds = (*KINDS, "field", "mesh")
    sub.add_argument("--to", choices=kinds, help="what to write it as; default: what the source holds, if the format can")
    along = "of a field or a mesh: voxels along the longest edge (default: 128); of Gaussians of a field: Gaussians along it"
    sub.add_argument("--resolution", type=int, help=f"{along} (default: one for two voxels)")
    corners = ("x", "y", "z", "to_x", "to_y", "to_z")
    held = "of a field or a mesh [length]; default: three standard deviations of all Gaussians"
    sub.add_argument("--box", type=float, nargs=6, metavar=corners, help=held)
    sub.add_argument(
        "-m", "--mode", default="llvm_ad_rgb", help="variant of the views of a field or a mesh (default: %(default)s)"
    )


def demo_flags(sub: argparse.ArgumentParser) -> None:
    """Which example, and what to do with it."""
    sub.add_argument("name", nargs="?", default="", help="which; without one they are listed")
    sub.add_argument("--into", type=Path, metavar="folder", help="copy the example's files there instead of running it")
    sub.add_argument("--set", action="append", default=[], metavar="key=value", help="override a setting")
    sub.add_argument("-o", "--output", type=Path, help="run folder (default: runs/NAME)")


def fetch_flags(sub: argparse.ArgumentParser) -> None:
    """Which data."""
    sub.add_argument("name", nargs="?", default="", help="which; without one they are listed, with licence and size")
    sub.add_argument("--into", type=Path, metavar="folder", help="where to keep it; default: MIVOL_CACHE, or the user's cache")


def validate_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of a comparison with Mitsuba's own path tracer."""
    scene_flags(sub)
    sub.add_argument("-s", "--sensor", type=int, default=0, help="number of the sensor")
    sub.add_argument("-o", "--output", type=Path, default=Path("validation"), help="folder (default: %(default)s)")
    sub.add_argument("--max-depth", type=int, help="longest path; default: that of the scene's integrator")
    sub.add_argument("--spp", type=int, default=256, help="samples per pixel of ours (default: %(default)s)")
    sub.add_argument("--reference-spp", type=int, default=1024, help="of Mitsuba's volpath (default: %(default)s)")
    sub.add_argument("--seed", type=int, default=0, help="root of all random numbers")
    sub.add_argument("--parameter", action="append", default=[], metavar="key", help="check the gradient of this parameter too")


def bench_flags(sub: argparse.ArgumentParser) -> None:
    """Flags that every study knows; what else is given is the study's own."""
    sub.add_argument("study", nargs="?", default="", help="which; without one they are listed")
    sub.add_argument("--quick", action="store_true", help="small work: whether it runs; its times mean nothing")
    sub.add_argument("--compare", type=Path, metavar="old.json", help="say what has changed since this result")
    sub.epilog = "Other flags are the study's own: --only, --out, --variant, ..."


def no_flags(sub: argparse.ArgumentParser) -> None:
    """None."""


# -- Verbs --------------------------------------------------------------------------------------------------------


def explain(arguments: argparse.Namespace) -> int:
    """What a scene or a fit needs, and what mivol would do: facts, choices, reasons; a small preview says which depth it needs.

    Of posed photographs: what there is, what is missing, and where asked for a picture of the cameras and the box that they
    look at. Of points and Gaussians: how many, where, how large and opaque. What is refused is said after the facts, and the
    exit code is 1.
    """
    from mivol.photos import find_format
    from mivol.points.summary import is_points_file

    if arguments.set and arguments.preset is None and arguments.scene.suffix.lower() != ".toml":
        raise MivolError(f"--set is for fits, and {arguments.scene} is none: give --preset, or the file of an experiment.")
    if arguments.scene.suffix.lower() == ".toml" or arguments.preset is not None:
        return explain_experiment(arguments)
    if is_points_file(arguments.scene):
        return explain_points(arguments)
    kind = explain_photos if arguments.scene.is_dir() or find_format(arguments.scene) else explain_scene
    return kind(arguments)


def explain_scene(arguments: argparse.Namespace) -> int:
    """Facts, choices, reasons."""
    from mivol.cli.loading import load
    from mivol.scene.explain import examine

    said = examine(load(arguments).scene, arguments.max_depth, noise=arguments.noise)
    print(said.text)
    return int(bool(said.refusal))


def explain_experiment(arguments: argparse.Namespace) -> int:
    """Facts, choices, reasons of a fit, with every check that it would make."""
    from mivol.experiments.kinds import explain_experiment as explain_settings

    said = explain_settings(*chosen_of(arguments.scene, arguments), arguments.output)
    print(said.text)
    return int(bool(said.refusal))


def explain_points(arguments: argparse.Namespace) -> int:
    """Facts of a file of points or Gaussians."""
    from mivol.points.summary import summarize_file

    facts = summarize_file(arguments.scene)
    print(facts.text)
    return int(bool(facts.refusal))


def explain_photos(arguments: argparse.Namespace) -> int:
    """Facts of a data set, and a picture of its cameras where one is asked for."""
    from mivol.experiments.photo_data import note_on_alpha
    from mivol.photos import survey_photos
    from mivol.report.cameras import plot_cameras

    survey = survey_photos(arguments.scene)
    print(survey.describe())
    if note := note_on_alpha(survey):
        print(note)
    print("--preset capture says what a fit of a place around the cameras would do, --preset cpu what one of a thing would")
    if arguments.output is not None:
        plot_cameras(survey, arguments.output)
        print(arguments.output)
    return 0


def render(arguments: argparse.Namespace) -> None:
    """Render a scene to an image, with the flags of the command ``mitsuba``; or a field or points, from where one likes."""
    from mivol.cli.loading import load
    from mivol.experiments.render import check_output, choose_integrator, name_of, render_image, write_image

    path = arguments.output or arguments.scene.with_suffix(".exr")
    check_output(path)
    if own := own_picture(arguments):
        write_image(path, own(), ["R", "G", "B"])
        print(path)
        return
    scene = load(arguments).scene
    integrator = choose_integrator(scene, arguments.integrator)
    if name_of(integrator) != "mivol":
        print(f"rendered by {name_of(integrator)}; --integrator mivol renders with mivol", file=sys.stderr)
    write_image(path, *render_image(scene, arguments.sensor, integrator, arguments.spp, arguments.seed))
    print(path)


def own_picture(arguments: argparse.Namespace) -> Callable | None:
    """What draws a picture of what is no scene: of a radiance field, of points or Gaussians; None: it is a scene.

    Raises:
        MivolError: a camera for a scene, or none for a field.
    """
    from mivol.experiments.back_end import set_variant
    from mivol.experiments.render import PointLook, view_field, view_points
    from mivol.points.summary import SUFFIXES

    suffix = arguments.scene.suffix.lower()
    is_field, is_cloud = suffix == ".npz", suffix in SUFFIXES
    if not is_cloud and is_field != (arguments.look_at is not None):
        wanted = "a radiance field needs --look-at" if is_field else "--look-at is for a radiance field (.npz) or points"
        raise MivolError(f"{arguments.scene}: {wanted}; a scene has its own cameras.")
    look = PointLook(arguments.points, arguments.radius, arguments.opacity)
    if not is_cloud and look != PointLook():
        raise MivolError(f"{arguments.scene}: --points, --radius and --opacity are for clouds of points: leave them out.")
    if not (is_field or is_cloud):
        return None
    set_variant(arguments.mode)
    camera = arguments.look_at, arguments.up, arguments.fov, tuple(arguments.size)
    return (lambda: view_points(arguments.scene, *camera, look)) if is_cloud else (lambda: view_field(arguments.scene, *camera))


def reference(arguments: argparse.Namespace) -> None:
    """Render a reference with Mitsuba's own path tracer, with its variance, until it is good enough.

    Of all sensors (-s all) with a file of cameras beside them: photographs that a radiance field is fitted to.
    """
    from mivol.cli.loading import load
    from mivol.validate.photographs import photograph
    from mivol.validate.reference import render_reference

    settings = {
        "max_depth": arguments.max_depth, "target_se": arguments.target, "max_spp": arguments.spp,
        "seed": arguments.seed, "integrator": arguments.integrator,
    }  # fmt: skip
    if arguments.sensor == "all":
        made = photograph(load(arguments), arguments.output, **settings)
    else:
        if not arguments.output.suffix:
            arguments.output.mkdir(parents=True, exist_ok=True)
        made = [render_reference(load(arguments), arguments.output, sensor=arguments.sensor, **settings)]
    print("\n".join(result.text for result in made))


def optimize(arguments: argparse.Namespace) -> None:
    """Reconstruct a volume from its views; everything that comes of it lies in the run folder."""
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.fit_kind import RunContext
    from mivol.experiments.kinds import run_experiment

    chosen, base = chosen_of(arguments.experiment, arguments)
    folder = arguments.output or Path(chosen.output)
    print(run_experiment(RunContext(chosen, base, folder, arguments.resume, TerminalProgress(), arguments.command)))


def chosen_of(path: Path, arguments: argparse.Namespace) -> tuple[Any, Path]:
    """The experiment of a file or of photographs, with --preset and --set, and the folder that its paths begin at.

    Raises:
        MivolError: photographs without a preset, a preset with a file, or as ``config.load``.
    """
    from mivol import config
    from mivol.photos import find_format

    if path.is_dir() or (path.suffix.lower() == ".json" and find_format(path)):
        if arguments.preset is None:
            raise MivolError(f"{path} holds photographs and no experiment: say how to fit them, --preset capture or cpu.")
        return config.of_photographs(path, arguments.preset, arguments.set), Path()
    if arguments.preset is not None:
        is_experiment = path.suffix.lower() == ".toml"
        found = f"--preset is for photographs, and {path} {'is an experiment' if is_experiment else 'holds none'}"
        advice = f"--set field.preset={arguments.preset} changes it" if is_experiment else "leave it out"
        raise MivolError(f"{found}: {advice}.")
    return config.load(path, arguments.set), path.parent


def report(arguments: argparse.Namespace) -> None:
    """Write the page of a run folder again."""
    from mivol.report.page import write_page

    print(write_page(arguments.folder))


def export(arguments: argparse.Namespace) -> None:
    """Write a radiance field as a mesh, as volumes, as a scene with the sky beside its file, or for another program."""
    from mivol.experiments.back_end import set_variant
    from mivol.experiments.render import sky_beside
    from mivol.fields.field_files import read_field, write_field

    set_variant(arguments.mode)
    field, sky = read_field(arguments.field), sky_beside(arguments.field)
    print("\n".join(str(path) for path in write_field(arguments.output, field, arguments.level, sky)))


def convert(arguments: argparse.Namespace) -> None:
    """Write the points or Gaussians of a file in another format, or one as the other, as a radiance field or as a mesh.

    A field (.npz) stands in scenes as mivol_sh, and becomes Gaussians (.ply) again; what either loses is said in dB, by views
    of the field and of splatted Gaussians. A mesh (.obj, or .ply with --to mesh) is fused from depths of splatted views; how
    far it lies from them is said.
    """
    source, target = arguments.source, arguments.output
    made_of_field, is_field = (path.suffix.lower() == ".npz" for path in (source, target))
    kind = arguments.to or WRITTEN_AS.get(target.suffix.lower())
    if is_field != (kind == "field"):
        raise MivolError(f"{target}: a radiance field is written as .npz, and nothing else is; leave out --to {arguments.to}.")
    if made_of_field and kind not in (None, "gaussians"):
        raise MivolError(
            f"{source}: a radiance field becomes Gaussians (.ply) here; mivol export writes it as a mesh and more."
        )
    is_gridded = kind in ("field", "mesh")
    has_box, has_resolution = arguments.box is not None, arguments.resolution is not None
    if (has_box and not is_gridded) or (has_resolution and not (is_gridded or made_of_field)):
        raise MivolError(f"{target}: --resolution and --box are for a radiance field (.npz) or a mesh: leave them out.")
    print(convert_from_field(arguments) if made_of_field else convert_points(arguments, kind))


WRITTEN_AS = {".npz": "field", ".obj": "mesh"}
"""What files of these suffixes hold."""


def convert_from_field(arguments: argparse.Namespace) -> str:
    """Gaussians of a radiance field; what was written."""
    from mivol.experiments.gaussian_conversion import convert_to_gaussians

    return convert_to_gaussians(arguments.source, arguments.output, arguments.resolution, arguments.mode)


def convert_points(arguments: argparse.Namespace, kind: str | None) -> str:
    """Points or Gaussians as a file of a kind; what was written."""
    from mivol.experiments.gaussian_conversion import convert_to_field, convert_to_mesh
    from mivol.points.summary import convert_file

    if kind not in ("field", "mesh"):
        return convert_file(arguments.source, arguments.output, kind)
    resolution = 128 if arguments.resolution is None else arguments.resolution
    make = convert_to_field if kind == "field" else convert_to_mesh
    return make(arguments.source, arguments.output, resolution, arguments.box, arguments.mode)


def demo(arguments: argparse.Namespace) -> None:
    """Run an example that comes with mivol, list them, or copy one to begin from."""
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.examples import copy_example, list_examples, run_example

    if not arguments.name:
        print(list_examples())
    elif arguments.into is not None:
        print(copy_example(arguments.name, arguments.into))
    else:
        settings = {"changes": tuple(arguments.set), "progress": TerminalProgress(), "command": arguments.command}
        print(run_example(arguments.name, arguments.output, **settings))


def fetch(arguments: argparse.Namespace) -> None:
    """Bring public data that the examples show from its public address, checked and kept in a cache."""
    from mivol.files.fetch import DATA, fetch_data, find_data_set

    if not arguments.name:
        print("\n".join(data.describe() for data in DATA.values()))
        return
    data = find_data_set(arguments.name)
    print(data.describe(), file=sys.stderr)
    print(fetch_data(data, arguments.into))


def validate(arguments: argparse.Namespace) -> int:
    """Compare mivol with Mitsuba's own path tracer on a scene: bias, z-image, relMSE, gradients, a verdict.

    The exit code is 0 where they agree, 3 where they differ, 4 where Mitsuba itself cannot be trusted.
    """
    from mivol.cli.loading import load
    from mivol.experiments.validation import Validation, validate_scene

    chosen = Validation(
        max_depth=arguments.max_depth, spp=arguments.spp, reference_spp=arguments.reference_spp, seed=arguments.seed,
        sensor=arguments.sensor, parameters=tuple(arguments.parameter),
    )  # fmt: skip
    verdict = validate_scene(load(arguments), arguments.output, chosen)
    print(verdict.text)
    return verdict.code


def bench(arguments: argparse.Namespace) -> int:
    """Run a bench: a question about speed or accuracy beside what else could be used; JSON, a figure and its bars."""
    from mivol.bench.harness.catalogue import list_studies, run_study

    if not arguments.study:
        print(list_studies())
        return 0
    flags = ["--quick"] if arguments.quick else []
    return run_study(arguments.study, [*flags, *arguments.rest], arguments.compare)


def doctor(arguments: argparse.Namespace) -> int:
    """Say whether a render would work on this machine, and what to do where not."""
    from mivol.doctor import main

    return main([])


VERBS: dict[str, tuple[Callable, Callable]] = {
    "demo": (demo, demo_flags),
    "explain": (explain, explain_flags),
    "render": (render, render_flags),
    "reference": (reference, reference_flags),
    "optimize": (optimize, optimize_flags),
    "validate": (validate, validate_flags),
    "export": (export, export_flags),
    "convert": (convert, convert_flags),
    "report": (report, report_flags),
    "fetch": (fetch, fetch_flags),
    "bench": (bench, bench_flags),
    "doctor": (doctor, no_flags),
}
