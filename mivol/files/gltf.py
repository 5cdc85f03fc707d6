"""glTF 2.0 in one binary file (``.glb``): the container, its arrays, and triangle meshes.

Own reader: pygltflib 1.16 accepts a file that is cut in half, and decodes no arrays.

Conventions. A ``.glb`` has a JSON document and one buffer. Arrays are little-endian and start at multiples of 4 bytes. glTF has
y up, in a right-handed frame; meshes keep their coordinates, and the node turns their up to y. Vertex colours of glTF are
linear reflectances, those of :class:`mivol.files.mesh.Mesh` are code values. The colours of a capture are its light, so the
material is unlit (``KHR_materials_unlit``).

Source: Khronos Group, glTF 2.0 specification, 2021.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import PIL.Image

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
