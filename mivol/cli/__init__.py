"""The command ``mivol``: each verb is one call per arrow of the scene's way to an image, a volume or a page.

Conventions. What mivol refuses, a full disk and Ctrl-C become one sentence on the error output and an exit code that is
not 0; only a mistake of the program itself shows a traceback. Slow imports wait for the verb that needs them.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import mivol
from mivol.errors import MivolError

USAGE, STOPPED = 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``mivol`` with these arguments (by default the process's own).

    Returns:
        Exit code: 0, 1 for what was refused, 2 for wrong arguments, 130 for Ctrl-C and SIGTERM.
    """
    arguments = parser().parse_args(argv)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return arguments.verb(arguments) or 0
    except (MivolError, OSError) as error:
        print(f"mivol: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("mivol: stopped; what was finished is kept.", file=sys.stderr)
        return STOPPED


def parser() -> argparse.ArgumentParser:
    """All verbs and their flags."""
    top = argparse.ArgumentParser(prog="mivol", description=mivol.__doc__)
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
    scene_flags(sub, "Mitsuba XML, or posed photographs: a folder or its transforms.json")
    sub.add_argument("-o", "--output", type=Path, help="picture of the cameras (.png, .svg); default: NAME-cameras.png")
    sub.add_argument("--max-depth", type=int, help="longest path asked about; default: that of the scene's integrator")
    aim = "noise of a pixel over the mean radiance; max_depth has to leave out less (default: %(default)s)"
    sub.add_argument("--noise", type=float, default=0.02, help=aim)


def render_flags(sub: argparse.ArgumentParser) -> None:
    """Mitsuba's own flags for an image."""
    scene_flags(sub)
    sub.add_argument("-s", "--sensor", type=int, default=0, help="number of the sensor")
    sub.add_argument("-o", "--output", type=Path, help="image (.exr or .png); default: the XML's name with .exr")


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

    lines = ["images:", *describe(config.Experiment), "", "projections:", *describe(config.Scan)]
    lines += ["", "photographs:", *describe(config.FieldFit)]
    sub.epilog = "settings of the file for " + "\n  ".join(line.replace("%", "%%") for line in lines)
    sub.add_argument("experiment", type=Path, help="TOML file")
    sub.add_argument("--set", action="append", default=[], metavar="key=value", help="override a setting of the file")
    sub.add_argument("-o", "--output", type=Path, help="run folder")
    sub.add_argument("--resume", action="store_true", help="continue from the run folder's checkpoint")


def report_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of the page."""
    sub.add_argument("folder", type=Path, help="run folder")


def export_flags(sub: argparse.ArgumentParser) -> None:
    """Flags of a field that becomes a file of another program."""
    from mivol.fields.export import EXPORTS

    known = ", ".join(f"{suffix} ({kind.name})" for suffix, kind in EXPORTS.items())
    sub.add_argument("field", type=Path, help="radiance field (.npz): mivol's, or a checkpoint of svox2")
    sub.add_argument("output", type=Path, help=f"what to write, by its suffix: {known}")
    default = "where a voxel is half opaque, or half of what thinner matter has"
    sub.add_argument("--level", type=float, help=f"extinction of a mesh's surface [1/length]; default: {default}")
    sub.add_argument("-m", "--mode", default="llvm_ad_rgb", help="variant (default: %(default)s)")


def no_flags(sub: argparse.ArgumentParser) -> None:
    """None."""


# -- Verbs --------------------------------------------------------------------------------------------------------


def explain(arguments: argparse.Namespace) -> None:
    """What a scene needs, and how mivol would render it: facts, choices, reasons. A small preview says which depth it needs.

    Of posed photographs: what there is, what is missing, and a picture of the cameras and the box that they look at.
    """
    from mivol.photos import find_format

    kind = explain_photos if arguments.scene.is_dir() or find_format(arguments.scene) else explain_scene
    kind(arguments)


def explain_scene(arguments: argparse.Namespace) -> None:
    """Facts, choices, reasons."""
    from mivol.cli.loading import load
    from mivol.scene.explain import explain as explain_plan

    print(explain_plan(load(arguments).scene, arguments.max_depth, noise=arguments.noise))


def explain_photos(arguments: argparse.Namespace) -> None:
    """Facts and picture of a data set."""
    from mivol.photos import survey_photos
    from mivol.report.cameras import plot_cameras

    survey = survey_photos(arguments.scene)
    path = arguments.output or Path(f"{arguments.scene.resolve().stem}-cameras.png")
    plot_cameras(survey, path)
    print(survey.text)
    print(path)


def render(arguments: argparse.Namespace) -> None:
    """Render a scene to an image, with the flags of the command ``mitsuba``."""
    from mivol.cli.loading import load
    from mivol.experiments.render import render_image, write_image

    path = arguments.output or arguments.scene.with_suffix(".exr")
    write_image(path, *render_image(load(arguments).scene, arguments.sensor))
    print(path)


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
    from mivol import config
    from mivol.cli.progress import Terminal
    from mivol.experiments.runs import run_experiment
    from mivol.experiments.task import Task

    chosen = config.load(arguments.experiment, arguments.set)
    folder = arguments.output or Path(chosen.output)
    print(run_experiment(Task(chosen, arguments.experiment.parent, folder, arguments.resume, Terminal())))


def report(arguments: argparse.Namespace) -> None:
    """Write the page of a run folder again."""
    from mivol.report.page import write_page

    print(write_page(arguments.folder))


def export(arguments: argparse.Namespace) -> None:
    """Write a radiance field as a mesh, as volumes, or for another program."""
    from mivol.experiments.back_end import set_variant
    from mivol.fields.export import export_field
    from mivol.fields.spherical_files import load_field

    set_variant(arguments.mode)
    print("\n".join(str(path) for path in export_field(arguments.output, load_field(arguments.field), arguments.level)))


def doctor(arguments: argparse.Namespace) -> int:
    """Say whether a render would work on this machine, and what to do where not."""
    from mivol.doctor import main

    return main([])


VERBS: dict[str, tuple[Callable, Callable]] = {
    "explain": (explain, explain_flags),
    "render": (render, render_flags),
    "reference": (reference, reference_flags),
    "optimize": (optimize, optimize_flags),
    "export": (export, export_flags),
    "report": (report, report_flags),
    "doctor": (doctor, no_flags),
}
