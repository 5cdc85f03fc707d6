"""Inputs of the command line: recognise the kind of a path, and load, explain or convert it."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mivol
from mivol.errors import MivolError

if TYPE_CHECKING:
    from mivol.experiments.found_scan import ScanDraft
    from mivol.points.summary import FileSummary
    from mivol.scene.explain import Explanation
    from mivol.scene.load import LoadedScene


def explain(arguments: argparse.Namespace) -> int:
    """Say what mivol would do with a scene or an experiment, and why; only a small preview is rendered.

    For photographs, explain lists present and missing data, and draws the cameras with --output. For points and
    Gaussians, it prints their number, extent, sizes and opacities; for a volume or a field, its size, values and place. A
    folder with a DICOM series counts as a volume. A folder of TIFF files without flat and dark images and angles does too, and
    a TIFF file of several pages without flats or darks beside it, unless --set makes it a scan. If mivol refuses the input,
    explain prints the reason after the facts, and the exit code is 1.
    """
    from mivol.photos import find_format
    from mivol.points.summary import is_points_file

    if (code := explain_array(arguments)) is not None:
        return code
    if is_fit(arguments):
        from mivol.experiments.kinds import explain_experiment

        answer = explain_experiment(*load_experiment(arguments.scene, arguments), arguments.output)
    elif find_format(arguments.scene) or (arguments.scene.is_dir() and not is_points_file(arguments.scene)):
        return print_photo_facts(arguments.scene, arguments.output)
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
    """Explain a scan, or describe a volume or a field, and return the exit code; None for other inputs."""
    from mivol.experiments.found_scan import describe_missing
    from mivol.files.formats import describe_volume

    layout = raw_layout(arguments)
    is_array = bool(layout) or holds_volume(check_dataset(arguments.scene, arguments.dataset))
    if not layout and (draft := draft_scan_from(arguments.scene, arguments, is_array)):
        return explain_scan(draft)
    if not is_array and arguments.scene.suffix.lower() == ".npz":
        from mivol.experiments.field_conversion import describe_field

        print(describe_field(arguments.scene, arguments.mode).text)
        return 0
    if not is_array:
        return None
    print(describe_volume(arguments.scene, arguments.dataset, **layout))
    if arguments.dataset is None and not layout and (missing := describe_missing(arguments.scene)):
        print(missing)
    return 0


def explain_scan(draft: ScanDraft) -> int:
    """Print what was found, the steps of the fit, and the TOML file that says the same."""
    from mivol import config
    from mivol.experiments.kinds import explain_experiment

    answer = explain_experiment(config.from_dict(draft.raw), Path())
    print("\n".join([*draft.lines, answer.text, "", "# the same as a TOML file, for mivol optimize", draft.toml]))
    return int(bool(answer.refusal))


def draft_scan_from(path: Path, arguments: argparse.Namespace, is_array: bool = False) -> ScanDraft | None:
    """Return the settings of a scan without a TOML file; None for other inputs.

    An HDF5 file without the layout of a scan counts as a scan if its suffix is no volume suffix, or with ``--set``;
    ``--dataset`` makes it a volume. A folder of TIFF files that ``is_array`` counts as a scan if it has flats, darks or angles
    (a file of several pages: flats or darks beside it), or with ``--set``; a single image that ``is_array`` counts as a
    sinogram with ``--set``.

    Raises:
        MivolError: as :func:`mivol.experiments.found_scan.draft_scan`.
    """
    from mivol.experiments.found_scan import SINOGRAM, TIFF_FOLDER, draft_scan, find_scan, has_scan_files
    from mivol.files.hdf5 import is_hdf5

    is_photographs = arguments.preset is not None or arguments.model is not None
    if is_photographs or getattr(arguments, "dataset", None) is not None or path.suffix.lower() == ".toml":
        return None
    is_named = path.is_file() and is_hdf5(path) and (arguments.set or not is_array)
    kind = find_scan(path)
    has_files = kind == TIFF_FOLDER and has_scan_files(path)
    if kind in (TIFF_FOLDER, SINOGRAM) and is_array and not arguments.set and not has_files:
        return None
    return draft_scan(path, arguments.set) if is_named or kind else None


def is_fit(arguments: argparse.Namespace) -> bool:
    """Whether a fit is to be explained; refuse ``--set`` for anything else."""
    has_model = arguments.preset is not None or arguments.model is not None
    is_experiment = arguments.scene.suffix.lower() == ".toml" or has_model
    if arguments.set and not is_experiment:
        raise MivolError(f"--set is for fits, and {arguments.scene} is not a fit: give --as, or the file of an experiment.")
    return is_experiment


def check_contents(path: Path) -> None:
    """Refuse a volume, and binary data that no reader takes, in place of a scene, an experiment or a cloud."""
    from mivol.experiments.found_scan import describe_missing
    from mivol.files.formats import check_has_reader
    from mivol.files.source import check_file

    check_has_reader(path)
    if holds_volume(path):
        if not path.is_dir():
            check_file(path)
        found = describe_missing(path) or "a volume"
        raise MivolError(f"{path}: found {found}, expected a scene, a fit or points; render, explain and convert take it.")
    if path.suffix.lower() == ".npz":
        way_out = 'projections are data.file of a TOML file with data.source = "stack"'
        raise MivolError(f"{path}: found an archive of NumPy, expected a scene, a fit or points; {way_out}.")


def holds_volume(path: Path) -> bool:
    """Whether a file or a folder is a volume; a folder of photographs with cameras is not."""
    from mivol.files.formats import is_volume
    from mivol.photos import find_format

    return is_volume(path) and not (path.is_dir() and find_format(path))


def raw_layout(arguments: argparse.Namespace) -> dict[str, Any]:
    """Shape and type of raw bytes from the flags; empty without them."""
    if arguments.shape is None and arguments.dtype is None:
        return {}
    words = (arguments.shape or "").split(",")
    if arguments.shape is not None and not all(re.fullmatch(r"\s*\d{1,9}\s*", word, re.ASCII) for word in words):
        raise MivolError(f"--shape: found {arguments.shape!r}, expected Z,Y,X; write --shape 64,128,128.")
    return {"shape": None if arguments.shape is None else tuple(map(int, words)), "dtype": arguments.dtype}


def check_dataset(path: Path, dataset: str | None) -> Path:
    """Return the file; refuse ``--dataset`` for a file that is no volume."""
    if dataset is not None and not holds_volume(path):
        raise MivolError(f"--dataset names an array of a volume, and {path} is no volume: leave it out.")
    return path


def print_photo_facts(path: Path, picture: Path | None) -> int:
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

    check_contents(arguments.scene)
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


def load_experiment(path: Path, arguments: argparse.Namespace) -> tuple[Any, Path]:
    """Load the experiment of a TOML file or of photographs, with --preset and --set.

    Returns:
        The settings, and the folder from which their relative paths start.

    Raises:
        MivolError: a preset of the other model, a model for a file that is no data set, or as ``config.load``.
    """
    from mivol import config
    from mivol.photos import find_format

    check_contents(path)
    if path.is_dir() or find_format(path):
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


# -- Conversions -------------------------------------------------------------------------------------------------------

WRITTEN_AS = {".npz": "field", ".obj": "mesh"}
"""Kind of the file by suffix, for suffixes of a single kind."""


def convert(arguments: argparse.Namespace) -> None:
    """Convert points, Gaussians and radiance fields to each other, to meshes, and between file formats; volumes too.

    A field (.npz) holds a grid with spherical harmonics (mivol_sh in a scene), an octree, a hash grid or a NeRF. --to grid,
    octree, hash or nerf makes a field from another field or from Gaussians (.ply); hash and nerf fit a network to views of the
    source. --to gaussians makes Gaussians from a field. These conversions render views of source and result, and print the
    error in dB. A mesh (.obj, .glb with a texture, or .ply with --to mesh) is fused from depth images of the Gaussians; convert
    prints the distance between both. A scene of pbrt-v4 (.pbrt) becomes Mitsuba XML (.xml) with media of mivol.
    """
    if arguments.output.suffix.lower() == ".xml" and arguments.source.suffix.lower() == ".pbrt":
        print(_convert_scene(arguments))
        return
    is_array = bool(raw_layout(arguments)) or _becomes_volume(arguments.source, arguments.output)
    is_array = is_array or holds_volume(check_dataset(arguments.source, arguments.dataset))
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
    return convert_volume(arguments.source, arguments.output, arguments.dataset, **raw_layout(arguments))


def _convert_cloud(arguments: argparse.Namespace) -> str:
    """Convert points, Gaussians or a field; return the lines to print."""
    from mivol.experiments import field_conversion, gaussian_conversion
    from mivol.points.summary import convert_file, is_points_file

    source, target, resolution = arguments.source, arguments.output, arguments.resolution
    if not is_points_file(source) and source.suffix.lower() != ".npz":
        check_contents(source)
    kind = _check_conversion(arguments)
    if kind in ("hash", "nerf"):
        return field_conversion.convert_to_network(source, target, kind, arguments.mode)
    if kind == "nested":
        return field_conversion.convert_to_nested(source, target, resolution, arguments.box, arguments.mode)
    if kind in ("grid", "octree"):
        make = field_conversion.convert_to_grid if kind == "grid" else field_conversion.convert_to_octree
        return make(source, target, resolution, arguments.mode)
    if source.suffix.lower() == ".npz":
        return field_conversion.convert_to_gaussians(source, target, resolution, arguments.mode)
    if kind not in ("field", "mesh"):
        return convert_file(source, target, kind, arguments.box)
    make = gaussian_conversion.convert_to_field if kind == "field" else gaussian_conversion.convert_to_mesh
    return make(source, target, 128 if resolution is None else resolution, arguments.box, arguments.mode)


def _check_conversion(arguments: argparse.Namespace) -> str | None:
    """Return the kind of the output; refuse flags and suffixes that do not belong together."""
    source, target = arguments.source, arguments.output
    from_field, is_field = (path.suffix.lower() == ".npz" for path in (source, target))
    is_svox = target.name.lower().endswith(".svox.npz")
    kind = arguments.to or ("octree" if is_svox else WRITTEN_AS.get(target.suffix.lower()))
    if kind in ("hash", "nerf"):
        if not is_field or arguments.resolution or arguments.box:
            raise MivolError(f"{target}: --to {kind} writes an .npz, fitted to views of the source: leave out other flags.")
        return kind
    if kind == "nested":
        if from_field:
            raise MivolError(
                f"{source}: --to nested puts what lies around a box into boxes around it, and a radiance field of one box has "
                "nothing there: use it as it is, or make it a grid (--to grid)."
            )
        if not is_field:
            raise MivolError(f"{target}: --to nested makes an .npz: give a file that ends so.")
        return kind
    if from_field and is_field and kind not in ("grid", "octree"):
        raise MivolError(
            f"{target}: --to says what a field becomes: octree, hash or nerf, and grid for all but a grid of one box."
        )
    if kind in ("octree", "grid") and not is_field:
        raise MivolError(f"{target}: --to {kind} makes an .npz: give a file that ends so.")
    if kind == "octree" and not from_field and arguments.box is not None:
        raise MivolError(f"{target}: an octree is made of all Gaussians: crop them first, mivol convert a.ply b.ply --box.")
    if kind == "grid" and not from_field:
        kind = "field"
    if is_field != (kind in ("field", "octree", "grid")):
        raise MivolError(f"{target}: a radiance field is written as .npz, and nothing else is; leave out --to {arguments.to}.")
    if from_field and not is_field and kind not in (None, "gaussians"):
        raise MivolError(
            f"{source}: a radiance field becomes Gaussians (.ply) here; mivol export writes it as a mesh and more."
        )
    is_gridded = kind in ("field", "mesh", "octree")
    if arguments.box is not None and from_field:
        raise MivolError(f"{source}: --box crops Gaussians and points, not a radiance field: leave it out.")
    if arguments.resolution is not None and not (is_gridded or from_field):
        raise MivolError(f"{target}: --resolution is for a radiance field (.npz) or a mesh: leave it out.")
    return kind
