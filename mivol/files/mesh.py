"""Triangle meshes on disk: Stanford's ``.ply`` (binary, little endian), Wavefront's ``.obj`` (text) and glTF's ``.glb``.

Own reader and writers: plyfile is under the GPL.

Conventions. Faces list their corners counterclockwise as seen from outside, from 0; an ``.obj`` counts from 1. Colours are
code values 0..1. A ``.ply`` stores them twice: ``red green blue`` are code values of 8 bits, as most programs expect; ``r g b``
are linear reflectances in float32, which Mitsuba's ``ply`` reads as ``vertex_color`` (it says that it ignores the others). An
``.obj`` has colours after the coordinates, a common extension of the format. A ``.glb`` has a texture instead of colours, if
the mesh has one: glTF multiplies the two.

Atlas. The image of a texture has square cells of n x n texels, two triangles each. The legs of the first triangle join the
centres of the texels (0, 0), (m, 0) and (0, m), m = n - 3. Linear interpolation inside it takes texels whose row and column add
up to at most m + 1; the second triangle is the first one turned by half a turn, and takes those from n on. So no texel serves
two triangles, and a cell needs no margin.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.files import source
from mivol.files.atomic import write_whole
from mivol.files.gltf import write_glb_mesh
from mivol.files.image_files import decode_srgb
from mivol.files.source import refusal

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
