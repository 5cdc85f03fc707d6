"""The flags of the verbs.

Conventions. A flag is a pair of names and options for ``ArgumentParser.add_argument``. Flags that list the words of a table
import the table inside their function, so that only the parser pays for the import.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


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


def scene_flags(text: str = "scene: Mitsuba XML", metavar: str = "scene") -> list[tuple[tuple[str, ...], dict[str, Any]]]:
    """The flags of the command ``mitsuba`` for a scene."""
    return [
        flag("scene", type=Path, metavar=metavar, help=text),
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
            "NeRF: tiny, minutes (default), gpu; of an octree: the preset of its grid",
        ),
    ]


def explain_flags() -> list:
    """Flags of ``mivol explain``."""
    return [
        *scene_flags(
            "scene (.xml), experiment (.toml), points or Gaussians (.ply, .spz, ...), field (.npz), volume (.vdb, .nrrd, ...), "
            "scan (HDF5, .xtekct, folder), or photographs (folder, file)",
            "source",
        ),
        flag("-o", "--output", type=Path, help="image to write (.png, .svg): the cameras of photographs, and the boxes"),
        *model_flags("explain the fit of this model by mivol optimize"),
        list_flag("--set", "key=value", "override a setting of the experiment"),
        DATASET,
        SHAPE,
        DTYPE,
        MAX_DEPTH,
        flag(
            "--noise", type=float, default=0.02,
            help="accepted noise of a pixel over its mean radiance; the proposed max_depth leaves out less light than this "
            "(default: %(default)s)",
        ),
    ]  # fmt: skip


def render_flags() -> list:
    """Flags of ``mivol render``."""
    from mivol.experiments.render import DRAWN_AS

    return [
        *scene_flags(
            "scene (.xml), radiance field (.npz), points or Gaussians (.ply, .npy, .spz, ...) or volume (.vdb, ...)", "source"
        ),
        flag(
            "--look-at", type=float, nargs=6, metavar=("x", "y", "z", "to_x", "to_y", "to_z"),
            help="for a field, points or a volume: positions of camera and target [length] (default: the view in the file of "
            "a fit, or a view of everything)",
        ),
        flag("--up", type=float, nargs=3, metavar=("x", "y", "z"),
             help="upward direction of that camera (default: up in the photographs of a fit, else 0 0 1)"),
        flag("--fov", type=float, help="horizontal field of view of that camera [degree] (default: as in the file, or 50)"),
        flag("--size", type=int, nargs=2, metavar=("width", "height"),
             help="image size of that camera [pixel] (default: proportions of the view in the file, or 640 480)"),
        flag("--points", choices=DRAWN_AS, default=DRAWN_AS[0], help="shape of drawn points (default: %(default)s)"),
        flag("--radius", type=float,
             help="radius of discs, or standard deviation of splats [length] (default: half the median distance of points)"),
        flag("--opacity", type=float, default=1.0, help="opacity of points (default: %(default)s)"),
        DATASET,
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
        flag("--settings", action=PrintSettings, nargs="?", default=argparse.SUPPRESS, metavar="WORD",
             help="print the settings of TOML files, all or those with this word in the name, and end"),
    ]  # fmt: skip


def sweep_flags() -> list:
    """Flags of ``mivol sweep``."""
    return [
        flag("experiment", type=Path, help="experiment (.toml)"),
        list_flag("--over", "key=values", "values of a setting: fit.spp=4,16,64 or seed=0..9; again for more settings"),
        list_flag("--set", "key=value", "override a setting of all runs"),
        flag("-o", "--output", type=Path, help="folder of the sweep (default: the experiment's output with _sweep)"),
        CLUSTER,
    ]


class PrintSettings(argparse.Action):
    """The flag ``--settings``: print settings and end the process, as ``--help`` does."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: object, values: Any, option: str | None = None) -> None:
        lines = list_settings(values or "")
        if not lines:
            parser.error(f"found no setting with {values} in its name: --settings without a word prints all.")
        print("\n".join(lines))
        parser.exit()


def list_settings(word: str) -> list[str]:
    """Return the settings with a word in the name, a line each, below the kind of experiment that takes them."""
    from mivol import config
    from mivol.schema import describe

    lines = []
    for kind in config.EXPERIMENTS:
        # A setting begins a line; its name ends at the first blank or colon.
        if chosen := [line for line in describe(kind) if word in line.split(" ", 1)[0].rstrip(":")]:
            lines += [f"{kind.__doc__}".replace("``", "").rstrip(".") + ":", *(f"  {line}" for line in chosen)]
    return lines


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
        flag("field", type=Path, help="radiance field (.npz) of mivol, a checkpoint of svox2, or Gaussians (.ply, ...)"),
        flag("output", type=Path, help=f"file to write; its suffix chooses the format: {formats}"),
        flag("--level", type=float,
             help="extinction at a mesh's surface [1/length] (default: a voxel of opacity 0.5, or half the maximum if lower)"),
        MODE,
    ]  # fmt: skip


def convert_flags() -> list:
    """Flags of ``mivol convert``."""
    from mivol.files.formats import FOLDER_WRITERS, VOLUME_SUFFIXES, WRITERS
    from mivol.points.cloud import CLOUD_READERS, CLOUD_WRITERS
    from mivol.points.gaussian_files import GAUSSIAN_READERS, GAUSSIAN_WRITERS
    from mivol.points.summary import KINDS

    readable, writable = ({**GAUSSIAN_READERS, **CLOUD_READERS}, {**GAUSSIAN_WRITERS, **CLOUD_WRITERS})
    return [
        flag("source", type=Path,
             help=f"file to read: {', '.join(readable)}, .npz (field); volumes: {', '.join(VOLUME_SUFFIXES)}"),
        flag("output", type=Path,
             help=f"file to write: {', '.join(writable)}, .npz (field), .obj (mesh); "
                  f"volumes: {', '.join(WRITERS | FOLDER_WRITERS)}"),
        DATASET,
        SHAPE,
        DTYPE,
        flag("--to", choices=(*KINDS, "field", "mesh", "octree", "grid", "nested", "hash", "nerf"),
             help="kind of the output (default: the kind of the source, if possible)"),
        flag("--resolution", type=int,
             help="for a grid or a mesh: voxels along the longest edge (default: 128; 64 in each box of a nested grid); for "
             "Gaussians from a field: Gaussians "
             "along that edge (default: one per two voxels); for an octree: leaves along the edge of its cube, a power of two "
             "(default: two per voxel)"),
        flag("--box", type=float, nargs=6, metavar=("x", "y", "z", "to_x", "to_y", "to_z"),
             help="box of a field or a mesh (default: three standard deviations around all Gaussians), innermost box of a "
             "nested grid (default: around the middle half of the Gaussians), or box that crops Gaussians or points [length]"),
        MODE,
    ]  # fmt: skip


def view_flags() -> list:
    """Flags of ``mivol view``."""
    return [
        *scene_flags(
            "run folder, posed photographs, field (.npz), points or Gaussians (.ply, ...), volume (.vdb, ...), or scene (.xml)",
            "source",
        ),
        flag("--photos", type=Path, metavar="FOLDER", help="show the cameras of these photographs too"),
        flag("--write", type=Path, metavar="FOLDER", help="write crops and films there (default: nothing is written)"),
        flag("--port", type=int, default=8080, help="port; if it is taken, the next free port (default: %(default)s)"),
        DATASET,
    ]
