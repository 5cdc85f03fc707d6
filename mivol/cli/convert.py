"""``mivol convert``: which conversion the files and flags ask for."""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol
from mivol.cli.inputs import check_contents, check_dataset, holds_volume, raw_layout
from mivol.errors import MivolError

WRITTEN_AS = {".npz": "field", ".obj": "mesh"}
"""Kind of the file by suffix, for suffixes of a single kind."""


def convert(arguments: argparse.Namespace) -> None:
    """Convert points, Gaussians and radiance fields to each other, to meshes, and between file formats; volumes too.

    A field (.npz) is the mivol_sh of a scene, an octree, a hash grid or a NeRF. --to grid, octree, hash or nerf makes one of
    another field or of Gaussians (.ply); hash and nerf fit a network to views of the source. Fields become Gaussians as well.
    These conversions print their error in dB, from views of both. A mesh (.obj, or .glb with a texture, or .ply
    with --to mesh) is fused from depths of splatted views; convert prints the distance between mesh and splats.
    A scene of pbrt-v4 (.pbrt) becomes Mitsuba XML (.xml) with media of mivol.
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
        raise MivolError(
            f"{target}: no conversion makes a nested grid, whose outer boxes hold what lies around the cameras, since other "
            "models hold nothing outside of their one box: make a grid (--to grid), which is a nested grid of one box."
        )
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
