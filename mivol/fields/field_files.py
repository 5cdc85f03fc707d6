"""Radiance fields as files: the table :data:`FIELD_FORMATS` lists the formats by suffix.

A new format is one writer (and a parser, if mivol reads the format) and one line in the table.

Octrees. Formats that hold no octree get it as a grid with a node in the middle of each smallest cell
(:meth:`mivol.fields.octree.Octree.to_grid`), which changes views a little.

Conventions of volumes (``.vol``, ``.nrrd``). A file holds the extinction [1/length] at the nodes; a second file
(``NAME-colour``) holds the colour of degree 0 with its offset, the mean over all directions. Colours keep the space of the
field's photographs. The activation is applied at the nodes; a field applies it after interpolation, so surfaces of a ``relu``
field lie up to half a voxel elsewhere. A nested field gives a pair of files for each level (``NAME-level-1``, of twice the
extent). Level 1 and above store only the nodes that rays need outside the box of the level before.

Conventions of scenes (``.xml``). The files that a scene names lie beside it and carry its name. An environment holds radiance:
a sky of sRGB code values is decoded, as ``mivol_sh`` decodes the colours of the field.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.field_archives import (
    is_own_archive,
    is_sampled_archive,
    is_svox2,
    parse_archive,
    parse_sampled_archive,
    parse_svox2,
    write_archive,
    write_sampled_archive,
    write_svox2,
)
from mivol.fields.octree import Octree
from mivol.fields.octree_files import is_octree, is_svox, parse_octree, parse_svox, write_octree, write_svox
from mivol.fields.resampling import GRID_NODES, sample_to_grid
from mivol.fields.sampled_field import SampledField
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.surfaces import extract_surface
from mivol.files import write_exr, write_volume, write_whole
from mivol.files.image_files import decode_srgb
from mivol.files.mesh import write_mesh
from mivol.files.npy import read_archive
from mivol.files.source import refusal
from mivol.photos.camera_path import HomeView
from mivol.points.gaussians import CONSTANT_HARMONIC

FOREIGN = {".vdb": "a name for OpenVDB, for which no package can be installed"}
"""Suffixes of formats that users expect and mivol cannot write."""

PLUGIN_SETTINGS = ("activation", "offset", "clamp", "space")
"""Parameters of the plugin that interpret stored values; files keep them too."""


@dataclass(frozen=True)
class WriteOptions:
    """Options of :func:`write_field` that single formats use.

    Attributes:
        level: extinction of a mesh's surface [1/length]; None: :func:`mivol.fields.surfaces.default_level`.
        sky: background that a scene shows; other formats leave it out.
        half: whether ``.npz`` stores half floats.
        view: first view, which ``.npz`` keeps and a scene shows; other formats leave it out.
    """

    level: float | None
    sky: Sky | None
    half: bool
    view: HomeView | None


@dataclass(frozen=True)
class FieldFormat:
    """A file format of radiance fields.

    Attributes:
        name: name in messages.
        write: writer; takes path, field and options, and returns the files written.
        recognizes: test of an archive's arrays; None: the format cannot be read.
        parse: reader of such an archive; takes the file name and the arrays.
    """

    name: str
    write: Callable[[Path, Any, WriteOptions], list[Path]]
    recognizes: Callable[[dict[str, np.ndarray]], bool] | None = None
    parse: Callable[[str, dict[str, np.ndarray]], SphericalGrid | Octree] | None = None


def read_field(path: str | os.PathLike) -> SphericalGrid | SampledField | Octree:
    """Read a radiance field: an ``.npz`` of mivol (a grid, a hash grid, a NeRF, an octree), of svox2, or of svox (PlenOctrees).

    Raises:
        MivolError: a missing file, another format, or contents that contradict each other.
    """
    path = Path(path)
    if not path.is_file():
        raise MivolError(f"found no file {path}, expected a radiance field (.npz): check the path.")
    if path.suffix.lower() != ".npz" and not is_zipfile(path):
        raise refusal(path, f"a file {path.suffix or 'without a suffix'}", "a radiance field (.npz)", "give the field of a fit")
    arrays = read_archive(path)
    readable = [kind for kind in FIELD_FORMATS.values() if kind.recognizes is not None]
    for kind in readable:
        if kind.recognizes(arrays):
            return kind.parse(path.name, arrays)
    if is_sampled_archive(arrays):
        return parse_sampled_archive(path.name, arrays)
    if any(name.startswith("reals/") for name in arrays):
        raise refusal(path, "the checkpoint of a fit", "a radiance field", "give field.npz of the same run folder")
    known = " or a ".join(kind.name for kind in readable)
    raise MivolError(f"{path.name} holds {', '.join(arrays) or 'nothing'}; a {known} is expected.")


def read_grid(path: str | os.PathLike) -> SphericalGrid:
    """Read a radiance field that is a grid.

    Raises:
        MivolError: as :func:`read_field`, or a hash grid, a NeRF or an octree.
    """
    field = read_field(path)
    if isinstance(field, Octree):
        raise refusal(Path(path), "an octree", "a grid of harmonics", "convert it by mivol convert FILE grid.npz --to grid")
    if isinstance(field, SampledField):
        raise refusal(
            Path(path), f"a {field.noun}", "a grid of harmonics", "convert it by mivol convert FILE grid.npz --to grid"
        )
    return field


def write_field(
    path: str | os.PathLike,
    field: SphericalGrid | SampledField | Octree,
    level: float | None = None,
    sky: Sky | None = None,
    half: bool = True,
    view: HomeView | None = None,
) -> list[Path]:
    """Write a radiance field in the format of the suffix (:data:`FIELD_FORMATS`), whole or not at all.

    Args:
        path: destination.
        field: radiance field, nested or not, a hash grid, a NeRF or an octree.
        level: extinction of a mesh's surface [1/length]; None: :func:`mivol.fields.surfaces.default_level`.
        sky: background of the field, in the space of its colours. Only a scene (``.xml``) holds it.
        half: store half floats in ``.npz`` (11 bits), or an octree's rounded values (:mod:`mivol.fields.octree_files`). Arrays
            with a value above 65504, or with all values below 2^-12, stay float32.
        view: first view of the field (:func:`mivol.photos.camera_path.find_home_view`), kept by ``.npz`` and used by ``.xml``.

    Returns:
        Paths of the files written.

    Raises:
        MivolError: an unknown suffix, a level for a format without surfaces, a field that the format cannot hold, or a full
            disk.
    """
    path = Path(path)
    suffix = next((s for s in sorted(FIELD_FORMATS, key=len, reverse=True) if path.name.lower().endswith(s)), None)
    if suffix is None:
        known = ", ".join(f"{s} ({kind.name})" for s, kind in FIELD_FORMATS.items())
        found = FOREIGN.get(path.suffix.lower(), f"the suffix {path.suffix!r}")
        raise refusal(path, found, f"one of {known}", "choose one of those")
    if isinstance(field, SampledField):
        if suffix != ".npz":
            raise refusal(
                path, f"a {field.noun}", "an .npz", "convert it to a grid first (mivol convert FILE grid.npz --to grid)"
            )
        write_sampled_archive(path, field, half, view)
        return [path]
    kind = FIELD_FORMATS[suffix]
    if level is not None and kind.write is not _write_mesh:
        raise refusal(path, f"a level for a {kind.name}", "none", "levels are for meshes: write .ply, .obj or .glb")
    if isinstance(field, Octree) and kind.write not in (_write_npz, _write_svox):
        field = field.to_grid()
    return kind.write(path, field, WriteOptions(level, sky, half, view))


def _write_npz(path: Path, field: SphericalGrid | Octree, options: WriteOptions) -> list[Path]:
    (write_octree if isinstance(field, Octree) else write_archive)(path, field, options.half, options.view)
    return [path]


def _write_svox(path: Path, field: SphericalGrid | Octree, options: WriteOptions) -> list[Path]:
    if not isinstance(field, Octree):
        raise refusal(path, "a field on a grid", "an octree", "convert it first: mivol convert field.npz tree.npz --to octree")
    write_svox(path, field)
    return [path]


def _parse_own(name: str, arrays: dict[str, np.ndarray]) -> SphericalGrid | Octree:
    return (parse_octree if is_octree(arrays) else parse_archive)(name, arrays)


def _write_svox2(path: Path, field: SphericalGrid, options: WriteOptions) -> list[Path]:
    write_svox2(path, field)
    return [path]


def _write_volumes(path: Path, field: SphericalGrid, options: WriteOptions) -> list[Path]:
    if field.levels == 1:
        return _write_volume_pair(path, field)
    names = (path.with_name(f"{path.stem}{f'-level-{k}' if k else ''}{path.suffix}") for k in range(field.levels))
    return [file for k, name in enumerate(names) for file in _write_volume_pair(name, field.extract_level(k))]


def _write_volume_pair(path: Path, field: SphericalGrid) -> list[Path]:
    density, sh = field.to_dense()
    sigma, _ = field.activation_function.value_and_slope(mi.Float(density.reshape(-1)))
    colour = np.maximum(field.offset + float(CONSTANT_HARMONIC) * sh[..., 0, :], 0 if field.clamp else -np.inf)
    colour_path = path.with_name(f"{path.stem}-colour{path.suffix}")
    write_volume(path, np.array(sigma).reshape(field.res), field.to_world)
    write_volume(colour_path, colour, field.to_world)
    return [path, colour_path]


def _write_mesh(path: Path, field: SphericalGrid, options: WriteOptions) -> list[Path]:
    mesh = extract_surface(field, options.level, textured=path.suffix.lower() == ".glb")
    write_mesh(path, mesh if options.view is None else replace(mesh, up=options.view.up))
    return [path]


def _write_scene(path: Path, field: SphericalGrid, options: WriteOptions) -> list[Path]:
    return write_scene(path, field, options.sky, options.view)


FIELD_FORMATS: dict[str, FieldFormat] = {
    ".npz": FieldFormat("field of mivol", _write_npz, lambda arrays: is_own_archive(arrays) or is_octree(arrays), _parse_own),
    ".svox2.npz": FieldFormat("checkpoint of svox2", _write_svox2, is_svox2, parse_svox2),
    ".svox.npz": FieldFormat("PlenOctree of svox", _write_svox, is_svox, parse_svox),
    ".vol": FieldFormat("pair of Mitsuba grids", _write_volumes),
    ".nrrd": FieldFormat("pair of NRRD volumes", _write_volumes),
    ".ply": FieldFormat("mesh with colours", _write_mesh),
    ".obj": FieldFormat("mesh with colours", _write_mesh),
    ".glb": FieldFormat("mesh with a texture", _write_mesh),
    ".xml": FieldFormat("scene of Mitsuba", _write_scene),
}
"""Suffix -> format. The longest suffix that fits a name counts."""


# -- Scenes of Mitsuba -------------------------------------------------------------------------------------------------

CUBE_TO_UNIT = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
"""Map of Mitsuba's cube [-1, 1]^3 to the unit cube of a field."""

EYE = 0.5, -0.7, 0.8
"""Position of the camera in the unit cube of the innermost box: before the box, a little above its middle."""

SCENE = """<scene version="3.0.0">
    <!-- The {kind} that mivol wrote to {file}. Put surfaces and lights into it, and move the camera. -->
    <integrator type="mivol">
        <integer name="max_depth" value="2"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="{fov}"/>
        <transform name="to_world">
            <lookat origin="{eye}" target="{target}" up="{up}"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{width}"/>
            <integer name="height" value="{height}"/>
        </film>
        <sampler type="independent">
            <integer name="sample_count" value="{samples}"/>
        </sampler>
    </sensor>
    <shape type="cube" id="field">
        <transform name="to_world">
            <matrix value="{place}"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="mivol_medium">
            <volume name="emission" type="{volume}">
                <string name="filename" value="{file}"/>{more}
            </volume>
        </medium>
    </shape>
{sky}</scene>
"""

ENVIRONMENT = """    <emitter type="envmap">
        <string name="filename" value="{name}"/>
    </emitter>
"""


LONGEST_EDGE = 480
"""Longest edge of the image of a scene [pixel]."""


def write_scene(path: Path, field: SphericalGrid, sky: Sky | None = None, view: HomeView | None = None) -> list[Path]:
    """Write a scene of Mitsuba with the field in a cube, a camera, and an environment map of the sky.

    Args:
        path: ends in .xml.
        field: content of the cube, with all its levels.
        sky: background, in the space of the field's colours; None: black.
        view: the camera of the scene; None: before the box, with up along its z.

    Returns:
        Paths of the files written, the scene first.

    Raises:
        MivolError: a full disk, or a missing folder.
    """
    field_path, sky_path = path.with_name(f"{path.stem}-field.npz"), path.with_name(f"{path.stem}-sky.exr")
    write_archive(field_path, field, view=view)
    written = [path, field_path]
    if sky is not None:
        colours = np.maximum(sky.image(), 0)
        write_exr(sky_path, {"": colours if field.space == "linear" else decode_srgb(colours)})
        written.append(sky_path)
    place = field.to_world
    if view is None:
        eye = place[:3, :3] @ EYE + place[:3, 3]
        view = HomeView(tuple(place[:3, 2]), tuple(eye), tuple(field.middle), 60.0, (4, 3))
    environment = "" if sky is None else ENVIRONMENT.format(name=sky_path.name)
    given = {"kind": "field", "volume": "mivol_sh", "file": field_path.name, "more": "", "sky": environment, "samples": 16}
    write_emission_scene(path, field.level_to_world(field.levels - 1), view, **given)
    return written


def write_emission_scene(path: Path, to_world: np.ndarray, view: HomeView, **given: object) -> None:
    """Write a scene of a medium that only emits, in a cube, and a camera.

    Args:
        path: ends in .xml.
        to_world: (4, 4), unit cube to the box of the medium.
        view: the camera.
        given: the other values of ``SCENE``.
    """
    width, height = view.scaled(LONGEST_EDGE)
    place = to_world @ CUBE_TO_UNIT
    numbers = {"eye": view.origin, "target": view.target, "up": view.up, "fov": view.fov, "place": place}
    texts = {name: " ".join(f"{value:.9g}" for value in np.ravel(values)) for name, values in numbers.items()}
    commas = {name: text.replace(" ", ", ") for name, text in texts.items() if name != "place"}
    text = SCENE.format(place=texts["place"], width=width, height=height, **commas, **given)
    write_whole(path, lambda file: file.write(text.encode()))


# -- Parameters of a scene ---------------------------------------------------------------------------------------------


def field_from_props(props: mi.Properties) -> tuple[SphericalGrid, mi.TensorXf, mi.TensorXf]:
    """Make a field from plugin parameters: ``filename``, or ``density`` and ``sh``; ``to_world`` and :data:`PLUGIN_SETTINGS`.

    The file of an octree, a hash grid or a NeRF becomes a grid, of the latter two with ``nodes`` along its longest edge.
    Tensors hold linear radiance unless ``space`` says otherwise.

    Returns:
        The field, its densities and its harmonics (:meth:`SphericalGrid.with_tensors` has the shapes). Given tensors keep
        their gradients.

    Raises:
        MivolError: both sources or none, or values that no field can have.
    """
    tensors = [n for n in ("density", "sh") if n in props]
    if ("filename" in props) == bool(tensors) or len(tensors) == 1:
        found = " and ".join([*(["filename"] if "filename" in props else []), *tensors]) or "none of them"
        raise MivolError(f"mivol_sh was given {found}; give filename, or density and sh.")
    to_world = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
    if tensors:
        if "nodes" in props:
            raise MivolError(
                "mivol_sh was given nodes beside density and sh; nodes are for a hash grid or a NeRF: leave them out."
            )
        density, sh = (props[n] for n in tensors)
        settings = {"space": "linear"} | {n: props[n] for n in PLUGIN_SETTINGS if n in props}
        field = SphericalGrid.from_dense(np.array(dr.detach(density)), np.array(dr.detach(sh)), to_world, **settings)
        return field, density, sh
    path = str(mi.file_resolver().resolve(props["filename"]))
    field = read_field(path)
    if isinstance(field, SampledField):
        field = sample_to_grid(field, int(props.get("nodes", GRID_NODES)))
    elif "nodes" in props:
        raise refusal(Path(path), "nodes that are stored", "a hash grid or a NeRF, which has none", "leave nodes out")
    elif isinstance(field, Octree):
        field = field.to_grid()
    field = field.with_rows(*field.values(), field.nodes, **{n: props.get(n, getattr(field, n)) for n in PLUGIN_SETTINGS})
    if "to_world" in props:
        field = replace(field, to_world=to_world @ field.to_world)
    values, coefficients = field.values()
    shape = field.shape if field.nodes is None else values.shape
    sh = np.ascontiguousarray(coefficients.reshape(*shape, *coefficients.shape[1:]))
    return field, mi.TensorXf(values.reshape(*shape, 1)), mi.TensorXf(sh)
