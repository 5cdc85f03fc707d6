"""Files of Gaussians: PLY and glTF, the tables of all formats, and one function to read and one to write any of them.

A new format is one reader and one line in :data:`GAUSSIAN_READERS`. Every number is checked before Gaussians are returned.

A page is one HTML file that shows Gaussians in any browser with WebGL 2, without a server and without the internet.
``gaussian_page.html`` draws: projected ellipses with a low-pass filter of 0.3 pixels^2, composited back to front, as
:mod:`mivol.splatting`. The numbers stand in the page in base64: float32 centres; logarithms of scales and coefficients of
degree 0 in 16 bits over their range; quaternions (w, x, y, z) in 16 bits and a sign; opacities in 8 bits; higher harmonics as
128 + 127 k / span in 8 bits.

Own readers, by :mod:`mivol.files.ply` and :mod:`mivol.files.mesh`: plyfile is under the GPL, and pygltflib 1.16 leaves the
arrays of the extension to the caller.

PLY. The format of 3D Gaussian splatting holds the pre-images of the activations, one property each. Properties are written in
the order of the authors' program: ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``, float32, with normals of
0, ``f_rest`` by colour (all of red, all of green, all of blue), and quaternions (w, x, y, z). Files are read with any order and
with more properties, which are dropped. Reading and writing again keeps every bit.

In the compressed format 256 Gaussians share a box of positions, of scales and of colours, and store steps inside the boxes. An
element ``chunk`` holds the ends of the boxes, in float32; without ends, colours lie in 0..1. An element ``vertex`` holds four
words of 32 bits a Gaussian, highest bits first: positions and logarithms of scales in 11, 10 and 11 bits; colour and opacity in
8 bits each; of the unit quaternion (w, x, y, z) the number of its largest entry in 2 bits and the other entries in 10 bits each
over -1/sqrt(2)..1/sqrt(2). An element ``sh`` holds harmonics in 8 bits over -4..4, in the order of the uncompressed file. Steps
include both ends; the inner values of harmonics are the middles of 256 bins.

glTF. The extension ``KHR_gaussian_splatting`` in a ``.glb``. A primitive of points holds centres, rotations (x, y, z, w),
standard deviations, opacities, and a coefficient of the harmonics (rgb) in each attribute. The basis is that of published
files, and so are the colours: sRGB code values, as displayed. glTF has y up and published files have y down, so both reader and
writer turn half a turn about z: x and y change their signs, with the harmonics that are odd in them. PlayCanvas'
splat-transform does the same.

Source: Kerbl et al. 2023 and the files published by the authors; PlayCanvas' documentation of the compressed format and its
open-source converter splat-transform; Khronos Group, extension KHR_gaussian_splatting, 2025.
"""

from __future__ import annotations

import base64
import json
import os
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.errors import MivolWarning
from mivol.files import ply
from mivol.files.atomic import write_whole
from mivol.files.mesh import GlbWriter, read_accessor, read_glb
from mivol.files.ply import read_comments, read_layout, read_tables
from mivol.files.source import check_file, parse_reals, refusal, select_by_suffix
from mivol.photos.camera_path import HomeView
from mivol.points.compact_files import read_ksplat, read_splat, read_spz, write_ksplat, write_splat, write_spz
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, complete_quaternions, logit, to_base_harmonics, to_log_scales
from mivol.points.sog import read_sog, write_sog

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
CODES = ("red", "green", "blue")
"""Colours in the place of ``COLOURS``, as nerfstudio writes them in its mode rgb: 0 to 1, or whole numbers from 0."""
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = (0, 9, 24, 45, 72)
"""Numbers of properties ``f_rest`` in files of degree 0, 1, 2, 3, 4; degree 4 is cut to ``HIGHEST_DEGREE``."""


def parse_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """Make Gaussians from the element ``vertex`` of a file.

    Raises:
        MivolError: a missing property, or harmonics of no degree.
    """
    vertex = tables.get("vertex")
    names = () if vertex is None else vertex.dtype.names
    has_codes = COLOURS[0] not in names and set(CODES) <= set(names)
    colours = CODES if has_codes else COLOURS
    missing = [name for name in (*MEANS, *colours, "opacity", *SCALES, *ROTATION) if name not in names]
    if missing == ["scale_2"]:
        raise refusal(
            Path(path),
            "2D Gaussians (discs with two scales)",
            "3D Gaussians, with three",
            "export 3D Gaussians, or convert it to points by the program that wrote it",
        )
    if missing:
        raise refusal(
            Path(path),
            f"no property {missing[0]!r} of a vertex",
            "the properties of 3D Gaussians (x, f_dc_0, opacity, scale_0, rot_0, ...)",
            "name a file of Gaussians (a cloud of points is read by read_points)",
        )
    constant = _parse_codes(vertex) if has_codes else _stack_columns(vertex, COLOURS)
    return Gaussians(
        _stack_columns(vertex, MEANS),
        _stack_columns(vertex, SCALES),
        _stack_columns(vertex, ROTATION),
        vertex["opacity"].astype(np.float32),
        np.concatenate([constant[:, None], _parse_higher_harmonics(vertex, path)], axis=1),
    )


def _parse_codes(table: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0, (N, 3), from the properties ``CODES``; the largest whole number of a type stands for 1."""
    kind = table.dtype[CODES[0]]
    largest = np.iinfo(kind).max if kind.kind in "iu" else 1
    return to_base_harmonics(_stack_columns(table, CODES) / np.float32(largest))


def _parse_higher_harmonics(table: np.ndarray, path: str | os.PathLike) -> np.ndarray:
    """Coefficients above degree 0, (N, K - 1, 3), from the properties ``f_rest_0``, ``f_rest_1``, ...

    Raises:
        MivolError: a missing property, or a number of properties that fits no degree.
    """
    count = sum(name.startswith("f_rest_") for name in table.dtype.names)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in REST_COUNTS or any(name not in table.dtype.names for name in names):
        found = f"{count} properties f_rest"
        raise refusal(Path(path), found, f"f_rest_0, f_rest_1, ...: {REST_COUNTS} of them", "write the file again")
    if not count:
        return np.empty((len(table), 0, 3), np.float32)
    kept = (HIGHEST_DEGREE + 1) ** 2 - 1
    if count > 3 * kept:
        warnings.warn(f"{path}: harmonics of degree 4 are cut to degree {HIGHEST_DEGREE}.", MivolWarning, stacklevel=2)
    return np.swapaxes(_stack_columns(table, names).reshape(len(table), 3, count // 3), 1, 2)[:, :kept]


def write_gaussian_ply(file: BinaryIO, gaussians: Gaussians, comment: str = "") -> None:
    """Write Gaussians in the format of the authors' program, with a comment in the header unless it is empty."""
    rest = np.swapaxes(gaussians.harmonics[:, 1:], 1, 2).reshape(gaussians.count, -1)
    parts = {
        MEANS: gaussians.means,
        NORMALS: np.zeros((gaussians.count, 3)),
        COLOURS: gaussians.harmonics[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): gaussians.opacity_logits[:, None],
        SCALES: gaussians.log_scales,
        ROTATION: gaussians.quaternions,
    }
    table = np.empty(gaussians.count, [(name, "<f4") for names in parts for name in names])
    for names, values in parts.items():
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    ply.write_table(file, table, comment)


def _stack_columns(table: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    """Properties as float32 (N, len(names))."""
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


CHUNK_SIZE = 256
"""Gaussians in a box."""

POSITION_BITS = (11, 10, 11)
AXES = ("x", "y", "z")
CHANNELS = ("r", "g", "b")
PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
MAX_HARMONIC = 4.0
"""Harmonics are stored in -4..4."""


def is_compressed(tables: dict[str, np.ndarray]) -> bool:
    """Whether the tables of a ``.ply`` are in the compressed format."""
    return "chunk" in tables and "vertex" in tables and PACKED_PROPERTIES[0] in (tables["vertex"].dtype.names or ())


def parse_compressed_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """Make Gaussians from the tables of a compressed file; the opacity 255 of 255 becomes the logit inf, 0 becomes -inf.

    Raises:
        MivolError: a missing property or another type, or numbers of chunks, Gaussians and harmonics that contradict each
            other.
    """
    chunk, vertex = tables["chunk"], tables["vertex"]
    _check_compressed_tables(tables, Path(path))
    box = np.arange(len(vertex)) // CHUNK_SIZE
    steps = _unpack_bits(vertex["packed_color"], (8, 8, 8, 8))
    colours = steps[:, :3]
    if "min_r" in chunk.dtype.names:
        colours = _interpolate_in_box(chunk, CHANNELS, box, colours)
    harmonics = to_base_harmonics(colours)[:, None]
    if "sh" in tables:
        harmonics = np.concatenate([harmonics, _decode_harmonics(_parse_higher_harmonics(tables["sh"], path))], axis=1)
    scale_axes = tuple(f"scale_{axis}" for axis in AXES)
    return Gaussians(
        _interpolate_in_box(chunk, AXES, box, _unpack_bits(vertex["packed_position"], POSITION_BITS)),
        _interpolate_in_box(chunk, scale_axes, box, _unpack_bits(vertex["packed_scale"], POSITION_BITS)),
        _unpack_quaternions(vertex["packed_rotation"]),
        logit(steps[:, 3]),
        harmonics,
    )


def _check_compressed_tables(tables: dict[str, np.ndarray], path: Path) -> None:
    chunk, vertex = tables["chunk"], tables["vertex"]
    ends = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in AXES]
    if "min_r" in chunk.dtype.names:
        ends += [f"{end}_{colour}" for end in ("min", "max") for colour in CHANNELS]
    wanted = {**{("vertex", name): "u4" for name in PACKED_PROPERTIES}, **{("chunk", name): "f4" for name in ends}}
    for (element, name), kind in wanted.items():
        record = tables[element].dtype
        if name not in record.names or record[name].str[1:] != kind:
            found = f"no property {name!r} of type {np.dtype(kind).name} in {element!r}"
            raise refusal(path, found, "those of a compressed PLY of PlayCanvas", "compress it again")
    chunks = -(-len(vertex) // CHUNK_SIZE)
    if len(chunk) != chunks:
        raise refusal(path, f"{len(chunk)} chunks", f"{chunks} for {len(vertex)} Gaussians", "compress it again")
    if "sh" in tables and len(tables["sh"]) != len(vertex):
        raise refusal(path, f"{len(tables['sh'])} rows of harmonics", f"{len(vertex)}", "compress it again")


def _unpack_bits(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Fields of words, highest bits first, as steps 0..1 with both ends; (N, len(bits)), float64."""
    shifts = np.cumsum(bits[::-1])[::-1] - bits
    return np.stack([((words >> np.uint32(s)) & ((1 << b) - 1)) / ((1 << b) - 1) for s, b in zip(shifts, bits, strict=True)], 1)


def _interpolate_in_box(chunk: np.ndarray, axes: tuple[str, ...], box: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Values at ``steps`` between the ends of each Gaussian's box, (N, 3)."""
    low, high = (np.stack([chunk[f"{end}_{axis}"].astype(np.float64) for axis in axes], 1)[box] for end in ("min", "max"))
    return low * (1 - steps) + high * steps


def _unpack_quaternions(words: np.ndarray) -> np.ndarray:
    """Unit quaternions without their largest entry, which is positive; (N, 4)."""
    others = (_unpack_bits(words & np.uint32((1 << 30) - 1), (2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2)
    return complete_quaternions(others, (words >> np.uint32(30)).astype(np.int64))


def _decode_harmonics(codes: np.ndarray) -> np.ndarray:
    """Coefficients of the codes 0 to 255."""
    steps = np.where(codes == 0, 0, np.where(codes == 255, 1, (codes + 0.5) / 256))
    return (steps - 0.5) * 2 * MAX_HARMONIC


# -- Gaussians in glTF -------------------------------------------------------------------------------------------------

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
"""Mode of a primitive of points."""

COLOUR_SPACE = "srgb_rec709_display"

TURN = np.array([-1.0, -1.0, 1.0])
"""Signs of x, y, z under half a turn about z."""

PARITY = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
"""Sign of each basis function of the harmonics, degrees 0 to 3, under half a turn about z: that of its order m."""


def turn_half(gaussians: Gaussians) -> Gaussians:
    """The Gaussians after half a turn about z; twice gives the same Gaussians, with quaternions of the other sign."""
    w, x, y, z = gaussians.quaternions.T
    return Gaussians(
        gaussians.means * TURN,
        gaussians.log_scales,
        np.stack([-z, -y, x, w], axis=1),
        gaussians.opacity_logits,
        gaussians.harmonics * PARITY[: gaussians.harmonics.shape[1], None],
    )


def attribute_names(degree: int) -> list[str]:
    """Names of the coefficients up to a degree, in the order of the harmonics."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


def write_gaussian_glb(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write Gaussians; programs without the extension show coloured points."""
    turned = turn_half(gaussians)
    unit = turned.quaternions / np.linalg.norm(turned.quaternions, axis=1, keepdims=True)
    codes = np.concatenate([turned.base_colours(), turned.opacities()[:, None]], axis=1)
    writer = GlbWriter(scene=0, scenes=[{"nodes": [0]}], nodes=[{"mesh": 0}], extensionsUsed=[EXTENSION])
    attributes = {
        "POSITION": writer.add(turned.means, bounds=True),
        "COLOR_0": writer.add(np.round(np.clip(codes, 0, 1) * 255).astype(np.uint8), normalized=True),
        f"{EXTENSION}:ROTATION": writer.add(np.roll(unit, -1, axis=1).astype(np.float32)),
        f"{EXTENSION}:SCALE": writer.add(turned.scales()),
        f"{EXTENSION}:OPACITY": writer.add(turned.opacities()),
    }
    for number, name in enumerate(attribute_names(turned.degree)):
        attributes[name] = writer.add(turned.harmonics[:, number])
    about = {"kernel": "ellipse", "colorSpace": COLOUR_SPACE, "sortingMethod": "cameraDistance", "projection": "perspective"}
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: about}}]}]
    writer.write(file)


def read_gaussian_glb(path: Path) -> Gaussians:
    """Read the first primitive of Gaussians of a file; transforms of nodes are refused.

    Raises:
        MivolError: no Gaussians, another colour space or kernel, compressed attributes, a moved node, or attributes that
            contradict each other.
    """
    document, data = read_glb(path)
    primitive = _find_primitive(document, path)
    attributes, about = primitive.get("attributes", {}), primitive["extensions"][EXTENSION]
    if about.get("extensions"):
        found = f"Gaussians compressed by {', '.join(about['extensions'])}"
        raise refusal(path, found, "plain attributes", "write the file again without compression")
    if about.get("kernel", "ellipse") != "ellipse" or about.get("colorSpace", COLOUR_SPACE) != COLOUR_SPACE:
        found = f"kernel {about.get('kernel')}, colours {about.get('colorSpace')}"
        raise refusal(path, found, f"kernel ellipse, colours {COLOUR_SPACE}", "convert the file by the program that wrote it")
    degree = max((d for d in range(HIGHEST_DEGREE + 1) if set(attribute_names(d)) <= attributes.keys()), default=None)
    needed = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
    missing = [name for name in needed if name not in attributes] + ["SH_DEGREE_0_COEF_0"] * (degree is None)
    if missing:
        raise refusal(path, f"Gaussians without {missing[0]}", f"the attributes of {EXTENSION}", "write the file again")
    means, rotations, scales, opacities = (read_accessor(path, document, data, attributes[name]) for name in needed)
    harmonics = [read_accessor(path, document, data, attributes[name]) for name in attribute_names(degree)]
    if {len(array) for array in (rotations, scales, opacities, *harmonics)} != {len(means)}:
        raise refusal(path, "attributes of different lengths", "one value a Gaussian", "write the file again")
    return turn_half(
        Gaussians(
            means, to_log_scales(scales), np.roll(rotations, 1, axis=1), logit(opacities[:, 0]), np.stack(harmonics, axis=1)
        )
    )


def _find_primitive(document: dict, path: Path) -> dict:
    """The first primitive of Gaussians."""
    for number, mesh in enumerate(document.get("meshes", [])):
        for primitive in mesh.get("primitives", []):
            if EXTENSION in primitive.get("extensions", {}):
                nodes = [node for node in document.get("nodes", []) if node.get("mesh") == number]
                if any(node.keys() & {"matrix", "rotation", "translation", "scale"} for node in nodes):
                    raise refusal(path, "Gaussians in a moved node", "a node without a transform", "apply the transform first")
                return primitive
    raise refusal(path, f"no primitive of {EXTENSION}", "a glTF of 3D Gaussians", "name another file (meshes are written only)")


# -- The tables --------------------------------------------------------------------------------------------------------

TEMPLATE = Path(__file__).with_name("gaussian_page.html")

MOST = 1 << 20
"""Largest number of Gaussians: rows of 256 in the texture of harmonics, which has 4096 rows on any device with WebGL 2."""

CLIPPED = 0.9999
"""Quantile of the absolute values of higher harmonics at which their range ends."""

TOWARDS = np.array([1.0, -1.5, 0.7])
"""Direction from the middle to the first camera without a view; z is up."""

ANGLE = 50.0
"""Field of view of the first camera without a view [degree]."""


def write_gaussian_page(file: BinaryIO, gaussians: Gaussians, view: HomeView | None = None) -> None:
    """Write the page.

    Args:
        file: destination.
        gaussians: contents.
        view: first view; None: a view of everything.

    Raises:
        MivolError: more than ``MOST``.
    """
    if gaussians.count > MOST:
        way_out = "remove faint ones, or write a .sog for a larger viewer"
        raise refusal("a page", f"{gaussians.count} Gaussians", f"at most {MOST}", way_out)
    unit = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    scales, scale_ends = _to_steps(gaussians.log_scales)
    colours, colour_ends = _to_steps(gaussians.harmonics[:, 0])
    higher = gaussians.harmonics[:, 1:]
    span = max(float(np.quantile(np.abs(higher), CLIPPED)), 1e-6) if higher.size else 1.0
    parts = [
        gaussians.means.astype("<f4"),
        scales,
        np.round(unit * 32767).astype("<i2"),
        colours,
        np.round(gaussians.opacities() * 255).astype(np.uint8),
        np.round(128 + 127 * np.clip(higher / span, -1, 1)).astype(np.uint8),
    ]
    view = view or _view_everything(gaussians)
    about = {
        "count": gaussians.count,
        "degree": gaussians.degree,
        "scales": scale_ends,
        "colours": colour_ends,
        "span": span,
        "view": {"up": view.up, "origin": view.origin, "target": view.target, "fov": view.fov, "size": view.size},
    }
    text = TEMPLATE.read_text(encoding="utf-8").replace("ABOUT", json.dumps(about), 1)
    before, after = text.split("DATA", 1)
    file.write(before.encode())
    file.write(base64.b64encode(b"".join(part.tobytes() for part in parts)))
    file.write(after.encode())


def _to_steps(values: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Values in 16 bits over their range, and the ends of the range."""
    low, high = float(values.min()), float(values.max())
    return np.round((values - low) / max(high - low, 1e-30) * 65535).astype("<u2"), (low, high)


def _view_everything(gaussians: Gaussians) -> HomeView:
    """A view of the middle 98 % of the centres along each axis."""
    low, high = np.quantile(gaussians.means.astype(np.float64), [0.01, 0.99], axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 3 * float(np.median(gaussians.scales())))
    origin = middle + TOWARDS / np.linalg.norm(TOWARDS) * radius / np.sin(np.radians(ANGLE) / 2)
    return HomeView((0.0, 0.0, 1.0), tuple(origin.tolist()), tuple(middle.tolist()), ANGLE, (1, 1))


def _read_ply(path: Path) -> Gaussians:
    tables = read_tables(path)
    return (parse_compressed_tables if is_compressed(tables) else parse_tables)(tables, path)


GAUSSIAN_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": _read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".ksplat": read_ksplat,
    ".sog": read_sog,
    ".glb": read_gaussian_glb,
}
"""Suffix -> reader(path)."""

GAUSSIAN_WRITERS: dict[str, Callable[[BinaryIO, Gaussians], None]] = {
    ".ply": write_gaussian_ply,
    ".spz": write_spz,
    ".splat": write_splat,
    ".ksplat": write_ksplat,
    ".sog": write_sog,
    ".glb": write_gaussian_glb,
    ".html": write_gaussian_page,
}
"""Suffix -> writer(file, gaussians). A ``.html`` is a page that shows the Gaussians; it is not read."""


def is_gaussian_file(path: Path) -> bool:
    """Whether a file holds Gaussians: by its suffix, and for a ``.ply`` by the properties in its header.

    Raises:
        MivolError: a ``.ply`` with an unreadable header.
    """
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in GAUSSIAN_READERS
    return not {"opacity", "packed_position"}.isdisjoint(read_layout(path).get("vertex", ()))


def read_gaussians(path: str | os.PathLike) -> Gaussians:
    """Read Gaussians in any format of :data:`GAUSSIAN_READERS`.

    Raises:
        MivolError: a missing, foreign, truncated or inconsistent file, an unknown suffix, or numbers that no renderer can draw
            (the message names the first index).

    Example:
        >>> read_gaussians("point_cloud.ply").degree
        3
    """
    path = check_file(path)
    return select_by_suffix(path, GAUSSIAN_READERS)(path).check(path)


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians, view: HomeView | None = None) -> None:
    """Write Gaussians, whole or not at all; the suffix selects the format (:data:`GAUSSIAN_WRITERS`).

    Args:
        path: destination.
        gaussians: contents.
        view: first view; a ``.ply`` keeps it as a comment, a ``.html`` begins with it, other formats leave it out.

    Raises:
        MivolError: an unknown suffix, an empty set for a format other than ``.ply``, numbers that no renderer can draw, or a
            full disk.
    """
    path = Path(path)
    writer = select_by_suffix(path, GAUSSIAN_WRITERS)
    if path.name.lower().endswith(".compressed.ply"):
        raise refusal(path, "a name for PlayCanvas' compressed .ply, which is read only", "another", "write a .sog or an .spz")
    gaussians.check(path)
    if not gaussians.count and writer is not write_gaussian_ply:
        raise refusal(path, "no Gaussians", "at least one", "write a .ply, or choose another file")
    if view is not None and writer is write_gaussian_page:
        writer = partial(write_gaussian_page, view=view)
    if view is not None and writer is write_gaussian_ply:
        comment = " ".join([VIEW_COMMENT, *(f"{number:.9g}" for number in view.numbers)])
        writer = partial(write_gaussian_ply, comment=comment)
    write_whole(path, lambda file: writer(file, gaussians))


VIEW_COMMENT = "mivol_view"
"""First word of the comment with the first view in a ``.ply``."""


def read_gaussian_view(path: Path) -> HomeView | None:
    """Read the first view in a file of Gaussians; None without a view.

    Raises:
        MivolError: a ``.ply`` with an unreadable header, or numbers of no camera.
    """
    if path.suffix.lower() != ".ply":
        return None
    words = next((comment.split() for comment in read_comments(path) if comment.startswith(f"{VIEW_COMMENT} ")), None)
    if words is None:
        return None
    return HomeView.from_numbers(parse_reals(" ".join(words[1:]), len(words) - 1, path, VIEW_COMMENT), path)
