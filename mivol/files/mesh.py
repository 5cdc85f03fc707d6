"""Triangle meshes on disk (Stanford's ``.ply``, Wavefront's ``.obj``, glTF's ``.glb``), and the container of glTF 2.0.

Own readers and writers: plyfile is under the GPL; pygltflib 1.16 accepts a file that is cut in half, and decodes no arrays.

Conventions. Faces list their corners counterclockwise as seen from outside, from 0; an ``.obj`` counts from 1. Colours are
code values 0..1. A ``.ply`` stores them twice: ``red green blue`` are code values of 8 bits, as most programs expect; ``r g b``
are linear reflectances in float32, which Mitsuba's ``ply`` reads as ``vertex_color`` (it says that it ignores the others). An
``.obj`` has colours after the coordinates, a common extension of the format. A ``.glb`` has a texture instead of colours, if
the mesh has one: glTF multiplies the two.

Atlas. The image of a texture has square cells of n x n texels, two triangles each. The legs of the first triangle join the
centres of the texels (0, 0), (m, 0) and (0, m), m = n - 3. Linear interpolation inside it takes texels whose row and column add
up to at most m + 1; the second triangle is the first one turned by half a turn, and takes those from n on. So no texel serves
two triangles, and a cell needs no margin.

glTF. A ``.glb`` has a JSON document and one buffer. Arrays are little-endian and start at multiples of 4 bytes. glTF has y up,
in a right-handed frame; meshes keep their coordinates, and the node turns their up to y. Vertex colours of glTF are linear
reflectances, those of :class:`Mesh` are code values. The colours of a capture are its light, so the material is unlit
(``KHR_materials_unlit``).

Source: Khronos Group, glTF 2.0 specification, 2021.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import PIL.Image

from mivol.files import source
from mivol.files.atomic import write_whole
from mivol.files.image_files import decode_srgb
from mivol.files.source import read_bytes, refusal

MAGIC, VERSION = 0x46546C67, 2
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
HEAD, CHUNK = struct.Struct("<III"), struct.Struct("<II")

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Number of a component type -> type of NumPy."""

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Type of an accessor -> numbers an element."""

VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""

LINEAR, CLAMP = 9729, 33071
"""Filter of a texture; beyond the edges stand the values at the edge."""


class GlbWriter:
    """Collects arrays, and writes the file.

    Attributes:
        document: the JSON document; ``buffers``, ``bufferViews`` and ``accessors`` are filled by :meth:`add`.
    """

    def __init__(self, **document: Any) -> None:
        self.document = {"asset": {"version": "2.0", "generator": "mivol"}, "bufferViews": [], "accessors": [], **document}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: np.ndarray, target: int = VERTICES, normalized: bool = False, bounds: bool = False) -> int:
        """Add an array (N,) or (N, width) in its own type; return the number of its accessor.

        Args:
            array: uint8, uint16, uint32 or float32.
            target: ``VERTICES`` or ``INDICES``.
            normalized: whether whole numbers stand for 0..1.
            bounds: whether smallest and largest values are written, as for positions.
        """
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
        width = 1 if array.ndim == 1 else array.shape[1]
        kind = next(number for number, name in COMPONENTS.items() if np.dtype(name) == array.dtype)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data), "target": target})
        accessor = {
            "bufferView": len(self.document["bufferViews"]) - 1,
            "componentType": kind,
            "count": len(array),
            "type": next(name for name, n in WIDTHS.items() if n == width),
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": np.min(array, axis=0).tolist(), "max": np.max(array, axis=0).tolist()}
        self.document["accessors"].append(accessor)
        self._parts.append(data + bytes(-len(data) % 4))
        self._size += len(self._parts[-1])
        return len(self.document["accessors"]) - 1

    def add_texture(self, image: np.ndarray) -> None:
        """Add an image, uint8 (H, W, 3), as PNG, and show it on the first material."""
        packed = io.BytesIO()
        PIL.Image.fromarray(image).save(packed, "PNG")
        data = packed.getvalue()
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data)})
        self.document |= {
            "images": [{"bufferView": len(self.document["bufferViews"]) - 1, "mimeType": "image/png"}],
            "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
            "textures": [{"source": 0, "sampler": 0}],
        }
        self.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        self._parts.append(data + bytes(-len(data) % 4))
        self._size += len(self._parts[-1])

    def write(self, file: BinaryIO) -> None:
        """Write header, document and buffer."""
        text = json.dumps({**self.document, "buffers": [{"byteLength": self._size}]}, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        file.write(HEAD.pack(MAGIC, VERSION, HEAD.size + 2 * CHUNK.size + len(text) + self._size))
        file.write(CHUNK.pack(len(text), JSON_CHUNK) + text)
        file.write(CHUNK.pack(self._size, BINARY_CHUNK))
        for part in self._parts:
            file.write(part)


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """Read the document and the buffer of a ``.glb``.

    Raises:
        MivolError: another format or version, or a truncated or damaged file.
    """
    data = read_bytes(path)
    if len(data) < HEAD.size + CHUNK.size or HEAD.unpack_from(data)[:2] != (MAGIC, VERSION):
        raise refusal(path, f"first bytes {data[:8]!r}", "those of a binary glTF 2.0", "name another file")
    chunks, at = {}, HEAD.size
    while at + CHUNK.size <= len(data):
        size, kind = CHUNK.unpack_from(data, at)
        at += CHUNK.size
        if at + size > len(data):
            raise refusal(path, f"{len(data)} bytes", f"{at + size}", "the file is truncated: copy it again")
        chunks.setdefault(kind, data[at : at + size])
        at += size
    try:
        document = json.loads(chunks.get(JSON_CHUNK, b""))
    except (ValueError, RecursionError) as error:
        raise refusal(path, f"a damaged document ({error})", "JSON", "copy the file again") from error
    if not isinstance(document, dict):
        raise refusal(path, "a document that is no object", "one of glTF", "write the file again")
    return document, chunks.get(BINARY_CHUNK, b"")


def read_accessor(path: Path, document: dict[str, Any], data: bytes, number: int) -> np.ndarray:
    """An array (N, width) of a ``.glb``; normalized whole numbers become 0..1.

    Raises:
        MivolError: a sparse or unknown accessor, or one beyond the buffer.
    """
    try:
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        kind, width, count = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]], int(accessor["count"])
        start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        stride = int(view.get("byteStride", 0)) or kind.itemsize * width
    except (KeyError, IndexError, TypeError, ValueError) as error:
        way_out = "write the file again without compression and sparse arrays"
        raise refusal(path, f"accessor {number} without {error}", "an array in the buffer", way_out) from error
    end = start + stride * (count - 1) + kind.itemsize * width
    if "sparse" in accessor or count < 1 or start < 0 or stride < kind.itemsize * width or end > len(data):
        raise refusal(
            path, f"accessor {number} up to byte {end} of {len(data)}", "an array in the buffer", "copy the file again"
        )
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(data, "u1", offset=start), (count, kind.itemsize * width), (stride, 1), writeable=False
    )
    values = np.ascontiguousarray(rows).view(kind).reshape(count, width)
    if accessor.get("normalized") and kind.kind in "iu":
        return np.maximum(values / np.float32(np.iinfo(kind).max), -1)
    return values


def turn_to_y(up: Sequence[float]) -> list[float]:
    """Quaternion (x, y, z, w) of the smallest rotation that turns a direction to y."""
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    if y < -1 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    quaternion = np.array([-z, 0.0, x, 1 + y])
    return (quaternion / np.linalg.norm(quaternion)).tolist()


def write_glb_mesh(
    file: BinaryIO,
    points: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None,
    colours: np.ndarray | None,
    up: Sequence[float],
    texture: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """Write a triangle mesh.

    Args:
        file: destination.
        points: (V, 3) [length].
        faces: (F, 3).
        normals: unit normals (V, 3), optional.
        colours: code values (V, 3) in 0..1, optional.
        up: upward direction, which the node turns to y.
        texture: image, uint8 (H, W, 3) code values, and the place (V, 2) of each point in it, 0..1 from the upper left corner.
            It is read without smaller copies, which would mix neighbours in an atlas. glTF multiplies it with colours.
    """
    writer = GlbWriter(
        scene=0,
        scenes=[{"nodes": [0]}],
        nodes=[{"mesh": 0, "rotation": turn_to_y(up)}],
        materials=[
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        extensionsUsed=["KHR_materials_unlit"],
    )
    attributes = {"POSITION": writer.add(np.asarray(points, np.float32), bounds=True)}
    if normals is not None:
        attributes["NORMAL"] = writer.add(np.asarray(normals, np.float32))
    if colours is not None:
        # 16 bits: linear values of dark colours need more than 8.
        linear = np.round(decode_srgb(colours) * 65535).astype(np.uint16)
        opaque = np.concatenate([linear, np.full((len(linear), 1), 65535, np.uint16)], axis=1)
        attributes["COLOR_0"] = writer.add(opaque, normalized=True)
    if texture is not None:
        attributes["TEXCOORD_0"] = writer.add(np.asarray(texture[1], np.float32))
        writer.add_texture(texture[0])
    indices = writer.add(np.asarray(faces).astype(np.uint32).reshape(-1), INDICES)
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}]
    writer.write(file)


# -- Meshes ------------------------------------------------------------------------------------------------------------

PLY_HEAD = "ply\nformat binary_little_endian 1.0\n"

FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


CELLS = (8, 6, 4)
"""Texels along the edge of a cell, for two triangles; the first that fits in ``LARGEST`` is taken."""

LARGEST = 4096
"""Longest edge of a texture [texel], which every browser shows."""


@dataclass(frozen=True)
class Atlas:
    """The places of triangles in the image of a texture.

    Attributes:
        count: number of triangles.
        cell: texels along the edge of a cell.
        columns: cells along an edge of the image.

    Source: the layout is derived above.
    """

    count: int
    cell: int
    columns: int

    @classmethod
    def of(cls, count: int) -> Atlas:
        """The atlas of so many triangles.

        Raises:
            MivolError: more triangles than the largest image holds.
        """
        columns = max(1, math.isqrt(-(-count // 2) - 1) + 1)
        cell = next((n for n in CELLS if n * columns <= LARGEST), None)
        if cell is None:
            most = 2 * (LARGEST // CELLS[-1]) ** 2
            way_out = "choose a lower --resolution, or a mesh in .ply"
            raise refusal("a texture", f"{count} triangles", f"at most {most}", way_out)
        return cls(count, cell, columns)

    def corners(self) -> np.ndarray:
        """Coordinates (F, 3, 2) of the corners of each triangle in the image, 0..1, from the upper left corner."""
        legs = np.array([[0, 0], [self.cell - 3, 0], [0, self.cell - 3]]) + 0.5
        number = np.arange(self.count)
        place = np.stack([number // 2 % self.columns, number // 2 // self.columns], axis=1)[:, None] * self.cell
        return (place + np.where((number % 2 == 1)[:, None, None], self.cell - legs, legs)) / (self.cell * self.columns)

    def texels(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights (2, n * n, 3) of the corners at the texels of a cell, and which texels serve its triangles, bool (2, n * n).

        Texels beside the longest edge lie one texel outside, where the weight of the first corner is negative.
        """
        column, row = np.meshgrid(np.arange(self.cell), np.arange(self.cell))
        places = np.stack([column.ravel(), row.ravel()], axis=1)
        places = np.stack([places, self.cell - 1 - places])
        share = places / (self.cell - 3)
        weights = np.concatenate([1 - share.sum(axis=-1, keepdims=True), share], axis=-1)
        return weights, places.sum(axis=-1) <= self.cell - 2

    def paint(self, colour: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """The image, uint8 (H, W, 3), of colours.

        Args:
            colour: from numbers of triangles (N,) and weights of their corners (T, 3) to code values (N, T, 3) in 0..1.
        """
        weights, serves = self.texels()
        cells = np.zeros((self.columns**2, self.cell**2, 3), np.uint8)
        for half in range(2):
            chosen = colour(np.arange(half, self.count, 2), weights[half][serves[half]])
            cells[: len(chosen), serves[half]] = np.rint(np.clip(chosen, 0, 1) * 255)
        grid = cells.reshape(self.columns, self.columns, self.cell, self.cell, 3).swapaxes(1, 2)
        return np.ascontiguousarray(grid.reshape(self.columns * self.cell, self.columns * self.cell, 3))


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        points: world positions (V, 3) [length].
        faces: indices of points (F, 3).
        normals: unit normals (V, 3) pointing outwards, optional.
        colours: code values (V, 3) in 0..1, optional.
        up: upward direction, which a ``.glb`` turns to its y; other formats leave it out.
        texture: image of an :class:`Atlas` of the faces, uint8 (H, W, 3) code values, optional; only a ``.glb`` has it.

    Raises:
        MivolError: inconsistent shapes, or an index without a point.
    """

    points: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    up: tuple[float, ...] = (0.0, 0.0, 1.0)
    texture: np.ndarray | None = None

    def __post_init__(self) -> None:
        per_point = [a for a in (self.points, self.normals, self.colours) if a is not None]
        shapes = [a.shape for a in (*per_point, self.faces)]
        if any(a.shape != (len(self.points), 3) for a in per_point) or self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise refusal("a mesh", f"arrays of {shapes}", "(V, 3) per point and (F, 3) faces", "reshape the arrays")
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < len(self.points)):
            found = f"corners {self.faces.min()} to {self.faces.max()}"
            raise refusal("a mesh", found, f"indices of its {len(self.points)} points", "count from 0")


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write a mesh, whole or not at all; the suffix selects the format (:data:`MESH_WRITERS`).

    Raises:
        MivolError: another suffix, or a full disk.
    """
    writer = source.select_by_suffix(Path(path), MESH_WRITERS)
    write_whole(path, lambda file: writer(file, mesh))


def read_ply(path: str | os.PathLike) -> Mesh:
    """Read a ``.ply`` written by :func:`write_mesh`.

    Raises:
        MivolError: a missing or truncated file, or another layout.
    """
    data = source.read_bytes(path)
    head, end, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    counts = {w[1]: int(w[2]) for w in words if len(w) == 3 and w[0] == "element" and w[2].isdigit()}
    names = tuple(w[2] for w in words if len(w) == 3 and w[0] == "property")
    kinds = {_point_type(*kind).names: _point_type(*kind) for kind in ((n, c) for n in (False, True) for c in (False, True))}
    if not end or not head.startswith(PLY_HEAD.encode()) or names not in kinds or counts.keys() != {"vertex", "face"}:
        raise refusal(path, "another layout", "a binary mesh of mivol", "convert the file")
    n, kind = counts["vertex"], kinds[names]
    points = source.parse_elements(body[: n * kind.itemsize], kind, n, path)
    faces = source.parse_elements(body[n * kind.itemsize :], FACE, counts["face"], path)
    columns = {"points": "xyz", "normals": ("nx", "ny", "nz"), "colours": ("red", "green", "blue")}
    arrays = {k: np.stack([points[c] for c in v], axis=1) for k, v in columns.items() if v[0] in kind.names}
    if "colours" in arrays:
        arrays["colours"] = arrays["colours"] / np.float32(255)
    return Mesh(faces=faces["corners"].astype(np.int64), **arrays)


def _point_type(normals: bool, colours: bool) -> np.dtype:
    """The record of a point in a ``.ply``."""
    numbers = [*"xyz", *(("nx", "ny", "nz") if normals else ())]
    coloured = [*((c, "u1") for c in ("red", "green", "blue")), *((c, "<f4") for c in "rgb")] if colours else []
    return np.dtype([(c, "<f4") for c in numbers] + coloured)


def _write_ply(file: BinaryIO, mesh: Mesh) -> None:
    points = np.empty(len(mesh.points), _point_type(mesh.normals is not None, mesh.colours is not None))
    codes = None if mesh.colours is None else np.rint(np.clip(mesh.colours, 0, 1) * 255)
    linear = None if mesh.colours is None else decode_srgb(mesh.colours)
    values = [a for a in (mesh.points, mesh.normals, codes, linear) if a is not None]
    for name, column in zip(points.dtype.names, np.concatenate(values, axis=1).T, strict=True):
        points[name] = column
    faces = np.empty(len(mesh.faces), FACE)
    faces["count"], faces["corners"] = 3, mesh.faces
    kinds = {name: "uchar" if points.dtype[name] == np.uint8 else "float" for name in points.dtype.names}
    properties = "".join(f"property {kind} {name}\n" for name, kind in kinds.items())
    listed = f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    file.write(f"{PLY_HEAD}element vertex {len(points)}\n{properties}{listed}".encode())
    file.write(points.tobytes())
    file.write(faces.tobytes())


def _write_obj(file: BinaryIO, mesh: Mesh) -> None:
    columns = mesh.points if mesh.colours is None else np.concatenate([mesh.points, np.clip(mesh.colours, 0, 1)], axis=1)
    np.savetxt(file, columns, fmt="v" + " %.7g" * columns.shape[1])
    number = np.repeat(mesh.faces + 1, 1 if mesh.normals is None else 2, axis=1)
    if mesh.normals is not None:
        np.savetxt(file, mesh.normals, fmt="vn %.5g %.5g %.5g")
    np.savetxt(file, number, fmt="f %d %d %d" if mesh.normals is None else "f %d//%d %d//%d %d//%d")


def _write_glb(file: BinaryIO, mesh: Mesh) -> None:
    if mesh.texture is None:
        write_glb_mesh(file, mesh.points, mesh.faces, mesh.normals, mesh.colours, mesh.up)
        return
    # Each triangle has corners of its own, with places in the image.
    apart, faces = mesh.faces.ravel(), np.arange(mesh.faces.size).reshape(-1, 3)
    normals, places = None if mesh.normals is None else mesh.normals[apart], Atlas.of(len(faces)).corners().reshape(-1, 2)
    write_glb_mesh(file, mesh.points[apart], faces, normals, None, mesh.up, (mesh.texture, places))


#: suffix -> writer of a mesh to a binary file.
MESH_WRITERS: dict[str, Callable[[BinaryIO, Mesh], None]] = {".ply": _write_ply, ".obj": _write_obj, ".glb": _write_glb}
