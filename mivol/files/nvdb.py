"""NanoVDB (``.nvdb``): the bricks of named sparse grids, uncompressed or compressed by zip or Blosc.

Own reader: NanoVDB is a part of OpenVDB, which is not on PyPI.

Conventions. A file is a row of segments: a header, the facts of its grids, and the grids. A grid is one block of memory: its
head, the head of its tree, a root, two levels of inner nodes with 32^3 and 16^3 children, and leaves of 8^3 voxels, x slowest.
The nodes of a level lie side by side. The box of the active voxels becomes the volume; a level set becomes a fog as in
:mod:`mivol.files.vdb`.

Reference: Museth 2021, "NanoVDB: A GPU-friendly and portable VDB data structure for real-time rendering and simulation"; the
layout of version 32.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.npy import check_memory
from mivol.files.source import decompress, read_bytes, refusal, select_dataset
from mivol.files.vdb import decompress_blosc
from mivol.files.volume import EDGE, SparseVolumeData, VolumeData, allocate_bricks, frame_from_steps

MAGIC = (b"NanoVDB0", b"NanoVDB2")

#: major version of the layout that is read.
VERSION = 32

#: compression of a grid by number.
CODECS = ("none", "zip", "blosc")

#: class of a grid by number; others are read as fogs.
CLASSES = {1: "level set", 2: "fog volume"}

FACTS, GRID_HEAD, TREE_HEAD = 176, 672, 64
"""Sizes of the facts of a grid in a segment, of the head of a grid, and of the head of a tree [bytes]."""

BLOSC_CHUNK = 1 << 30
"""Largest part of a grid that is compressed at once by Blosc [bytes]."""

INNER = ((16, 8), (32, 128))
"""Children along an edge, and voxels along the edge of a child, of lower and upper nodes."""


def _align(size: int, to: int = 32) -> int:
    return -(-size // to) * to


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a type lie. Places and sizes are bytes; a record is as long as a multiple of 32.

    Attributes:
        name: name of the type.
        dtype: NumPy's type of a number.
        channels: numbers of a value.
        bits: bits of a quantised value in a leaf; 0: values are stored as they are; -1: each leaf says how many.
    """

    name: str
    dtype: str
    channels: int = 1
    bits: int = 0

    @property
    def number(self) -> int:
        """Size of a number, to which values are aligned. Averages and deviations are float, or double beside 8 bytes."""
        return np.dtype(self.dtype).itemsize

    @property
    def value(self) -> int:
        """Size of a value."""
        return self.number * self.channels

    @property
    def background(self) -> int:
        """Place of the background in a root, before smallest and largest value, average and deviation."""
        return _align(28, self.number)

    @property
    def root(self) -> int:
        """Size of a root before its tiles."""
        return _align(self.background + 3 * self.value + 2 * self.number)

    @property
    def tile_value(self) -> int:
        """Place of the value in a tile of the root."""
        return _align(20, self.number)

    @property
    def tile(self) -> int:
        """Size of a tile of the root."""
        return _align(self.tile_value + self.value)

    @property
    def entry(self) -> int:
        """Size of an entry in the table of an inner node: a value, or the way to a child in 8 bytes."""
        return _align(self.value, 8)

    def table(self, children: int) -> int:
        """Place of the table in an inner node, behind box, flags, two masks, range, average and deviation."""
        return _align(32 + children**3 // 4 + 2 * self.value + 2 * self.number)

    def inner(self, children: int) -> int:
        """Size of an inner node."""
        return _align(self.table(children) + self.entry * children**3)

    @property
    def values(self) -> int:
        """Place of the values in a leaf, behind box, flags, mask and range; a quantised leaf has a minimum and a step at 80."""
        return 96 if self.bits else _align(80 + 2 * self.value + 2 * self.number)

    def leaf(self, bits: int = 0) -> int:
        """Size of a leaf."""
        return self.values + (EDGE**3 * bits // 8 if self.bits else EDGE**3 * self.value)


LAYOUTS = {
    1: Layout("float", "<f4"),
    2: Layout("double", "<f8"),
    4: Layout("int32", "<i4"),
    5: Layout("int64", "<i8"),
    6: Layout("vec3f", "<f4", 3),
    7: Layout("vec3d", "<f8", 3),
    13: Layout("fp4", "<f4", bits=4),
    14: Layout("fp8", "<f4", bits=8),
    15: Layout("fp16", "<f4", bits=16),
    16: Layout("fpN", "<f4", bits=-1),
}
"""By the number of the type."""

OTHER_TYPES = {3: "int16", 8: "mask", 9: "half", 10: "uint32", 11: "bool", 12: "RGBA8", 17: "vec4f", 18: "vec4d", 19: "index"}
"""Types that are not read; points are of the types uint32 and index."""


def is_nvdb(head: bytes) -> bool:
    """Whether the first bytes are NanoVDB's."""
    return head.startswith(MAGIC)


def read_nvdb(path: Path, dataset: str | None = None) -> VolumeData:
    """Read a grid as a dense volume; arguments and errors as of :func:`read_sparse_nvdb`."""
    volume = read_sparse_nvdb(path, dataset)
    check_memory(path, volume.dense_bytes)
    return VolumeData(volume.dense(), volume.to_world, volume.meta)


def read_sparse_nvdb(path: Path, dataset: str | None = None) -> SparseVolumeData:
    """Read a grid in its leaves.

    Args:
        path: file.
        dataset: name of the grid; ``name[1]`` is the second grid of a name. None for a file of one grid.

    Returns:
        Values and placement; ``meta`` holds ``grid``, ``class``, the first index ``index_min``, and for a level set the width
        ``band`` of its narrow band [length].

    Raises:
        MivolError: a damaged or truncated file, another version or type of values, a grid without active voxels, a fog whose
            value outside of its tree is not 0, or Blosc data without the package ``blosc``.
    """
    data = read_bytes(path)
    grids = _list_grids(data, path)
    name = select_dataset(path, dataset, list(grids))
    codec, at, size = grids[name]
    if codec == "none":
        return _read_grid(_take(data, at, size, path), path, name)
    check_memory(path, size)
    if codec == "zip":
        (held,) = _unpack("<Q", data, at, path)
        return _read_grid(decompress(_take(data, at + 8, held, path), "zlib", size, path), path, name)
    chunks = []
    for begin in range(0, size, BLOSC_CHUNK):
        (held,) = _unpack("<Q", data, at, path)
        chunks.append(decompress_blosc(_take(data, at + 8, held, path), min(BLOSC_CHUNK, size - begin), path))
        at += 8 + held
    return _read_grid(b"".join(chunks), path, name)


def name_grids(path: Path) -> list[str]:
    """The names of the grids of a file, as :func:`read_nvdb` takes them.

    Raises:
        MivolError: a damaged or truncated file.
    """
    return list(_list_grids(read_bytes(path), path))


def _take(data: bytes, at: int, count: int, path: Path) -> bytes:
    if count < 0 or at < 0 or at + count > len(data):
        found = f"{len(data)} bytes, where {count} more are announced at byte {at}"
        raise refusal(path, found, "a whole file", "the file is truncated or damaged: copy it again")
    return data[at : at + count]


def _unpack(codes: str, data: bytes, at: int, path: Path) -> tuple:
    return struct.unpack(codes, _take(data, at, struct.calcsize(codes), path))


def _list_grids(data: bytes, path: Path) -> dict[str, tuple[str, int, int]]:
    """Codec, position and size in memory of each grid, by name."""
    grids: dict[str, tuple[str, int, int]] = {}
    at, seen = 0, []
    while at < len(data):
        magic, version, count, _ = _unpack("<8sIHH", data, at, path)
        if magic not in MAGIC or version >> 21 != VERSION:
            found = f"version {version >> 21} of NanoVDB's format" if magic in MAGIC else f"the bytes {magic!r} at byte {at}"
            raise refusal(path, found, f"version {VERSION}", "write it again with NanoVDB of OpenVDB 8 or later")
        at += 16
        facts = []
        for _ in range(count):
            size, held = _unpack("<2Q", data, at, path)
            (length,) = _unpack("<I", data, at + 136, path)
            (codec,) = _unpack("<H", data, at + 168, path)
            name = _take(data, at + FACTS, length, path).split(b"\0")[0].decode("utf-8", errors="replace")
            facts.append((name, codec, size, held))
            at += FACTS + length
        for name, codec, size, held in facts:
            if codec >= len(CODECS):
                raise refusal(path, f"compression {codec}", f"one of {', '.join(CODECS)}", "the file is damaged: copy it again")
            number = seen.count(name)
            seen.append(name)
            grids[f"{name}[{number}]" if number else name] = (CODECS[codec], at, size)
            at += held
    return grids


def _read_grid(data: bytes, path: Path, name: str) -> SparseVolumeData:
    grid_class, kind = _unpack("<2I", data, 632, path)
    if kind not in LAYOUTS:
        expected = ", ".join(layout.name for layout in LAYOUTS.values())
        found = f"the grid {name!r} of type {OTHER_TYPES.get(kind, kind)} of NanoVDB's"
        raise refusal(path, found, f"one of {expected}", "convert the grid, or choose another one")
    layout = LAYOUTS[kind]
    matrix = np.reshape(_unpack("<9d", data, 384, path), (3, 3))
    shift = np.array(_unpack("<3d", data, 528, path))
    offsets, counts = _unpack("<4q", data, GRID_HEAD, path), _unpack("<3I", data, GRID_HEAD + 32, path)
    root = GRID_HEAD + offsets[3]
    low, high = np.array(_unpack("<6i", data, root, path), np.int64).reshape(2, 3)
    background = np.frombuffer(_take(data, root + layout.background, layout.value, path), layout.dtype)
    if (high < low).any():
        raise refusal(path, f"no active voxel in the grid {name!r}", "at least one", "choose another grid")
    is_level_set = CLASSES.get(grid_class) == "level set"
    band = abs(float(background[0]))
    if is_level_set and not band > 0:
        raise refusal(path, f"the level set {name!r} with a band of {band}", "a band above 0", "write the grid again")
    if not is_level_set and background.any():
        found = f"the value {background.tolist()} outside of the grid {name!r}"
        raise refusal(path, found, "0", "convert the grid to a .vdb")

    def convert(values: np.ndarray) -> np.ndarray:
        return np.clip(-values / band, 0, 1) if is_level_set else values

    first, last = low // EDGE, high // EDGE
    nodes = _Nodes(data, path, layout, offsets, counts, root)
    places, values = nodes.read_leaves()
    tiles = [(value, cut) for value, cut in nodes.cut_tiles(first, last, background) if convert(value).any() and len(cut)]
    everywhere = np.concatenate([places, *(cut for _, cut in tiles)]) - first
    check_memory(path, 4 * EDGE**3 * layout.channels * len(everywhere))
    spans = last - first + 1
    inside = ((everywhere >= 0) & (everywhere < spans)).all(axis=1)
    numbers = np.where(inside, np.ravel_multi_index(np.clip(everywhere, 0, spans - 1)[:, ::-1].T, spans[::-1]), spans.prod())
    bricks = allocate_bricks(len(everywhere), layout.channels)
    bricks[: len(places)] = convert(values.reshape(-1, EDGE, EDGE, EDGE, layout.channels)).transpose(0, 3, 2, 1, 4)
    begin = len(places)
    for value, cut in tiles:
        bricks[begin : begin + len(cut)], begin = convert(value), begin + len(cut)
    held = np.flatnonzero(inside & bricks.any(axis=(1, 2, 3, 4)))
    if not len(held):
        raise refusal(path, f"no value other than 0 in the grid {name!r}", "at least one", "choose another grid")
    order = held[np.argsort(numbers[held], kind="stable")]
    size = high - low + 1
    meta = {
        "path": str(path),
        "format": "nvdb",
        "dtype": np.dtype(layout.dtype).name,
        "space": None,
        "grid": name,
        "class": CLASSES.get(grid_class, "unknown"),
        "index_min": tuple(map(int, low)),
        **({"band": float(band)} if is_level_set else {}),
    }
    return SparseVolumeData(
        bricks[order],
        everywhere[order][:, ::-1].astype(np.int32),
        tuple(map(int, size[::-1])),
        frame_from_steps(size, matrix, matrix @ low + shift),
        tuple(int(n) % EDGE for n in low[::-1]),
        meta,
    )


@dataclass
class _Nodes:
    """The nodes of a tree.

    Attributes:
        data, path: memory of the grid, and the file for refusals.
        layout: of the type of its values.
        offsets: of the leaves, the lower and the upper nodes and the root, from the head of the tree.
        counts: leaves, lower and upper nodes.
        root: position of the root.
    """

    data: bytes
    path: Path
    layout: Layout
    offsets: tuple[int, ...]
    counts: tuple[int, ...]
    root: int

    def _records(self, level: int, fields: dict[str, tuple[object, int]], size: int) -> np.ndarray:
        """The nodes of a level as records."""
        block = _take(self.data, GRID_HEAD + self.offsets[level], self.counts[level] * size, self.path)
        names, formats, places = list(fields), [f[0] for f in fields.values()], [f[1] for f in fields.values()]
        return np.frombuffer(block, np.dtype({"names": names, "formats": formats, "offsets": places, "itemsize": size}))

    def read_leaves(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 3) of the leaves with an active voxel, in bricks (x, y, z), and their values (n, 512, C)."""
        layout, fields = self.layout, {"low": ("<3i4", 0), "mask": ("64u1", 16)}
        if not layout.bits:
            fields["values"] = ((layout.dtype, (EDGE**3, layout.channels)), layout.values)
            leaves = self._records(0, fields, layout.leaf())
            leaves = leaves[leaves["mask"].any(axis=1)]
            return leaves["low"].astype(np.int64) // EDGE, leaves["values"]
        fields |= {"minimum": ("<f4", 80), "step": ("<f4", 84)}
        if layout.bits > 0:
            size = layout.leaf(layout.bits)
            leaves = self._records(0, fields | {"codes": (f"{size - 96}u1", 96)}, size)
            leaves = leaves[leaves["mask"].any(axis=1)]
            codes = _unpack_codes(leaves["codes"], layout.bits)
            values = leaves["minimum"][:, None] + leaves["step"][:, None] * codes.astype(np.float32)
            return leaves["low"].astype(np.int64) // EDGE, values[..., None]
        check_memory(self.path, 4 * EDGE**3 * self.counts[0])
        places, values = [], []
        at = GRID_HEAD + self.offsets[0]
        for _ in range(self.counts[0]):
            head = _take(self.data, at, layout.values, self.path)
            bits = 1 << (head[15] >> 5)
            codes = np.frombuffer(_take(self.data, at + layout.values, EDGE**3 * bits // 8, self.path), np.uint8)
            minimum, step = np.frombuffer(head[80:88], "<f4")
            if any(head[16:80]):
                places.append(np.frombuffer(head[:12], "<i4").astype(np.int64) // EDGE)
                values.append(minimum + step * _unpack_codes(codes[None], bits)[0].astype(np.float32))
            at += layout.leaf(bits)
        return np.array(places, np.int64).reshape(-1, 3), np.array(values, np.float32).reshape(-1, EDGE**3, 1)

    def cut_tiles(self, first: np.ndarray, last: np.ndarray, background: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Value (C,) and bricks (n, 3) of each tile between two bricks (x, y, z) that differs from the background."""
        tiles, layout = [], self.layout
        for level, (children, edge) in enumerate(INNER, 1):
            bits = children**3 // 8
            entries = {
                "names": ["value"],
                "formats": [(layout.dtype, layout.channels)],
                "offsets": [0],
                "itemsize": layout.entry,
            }
            fields = {
                "low": ("<3i4", 0),
                "child": (f"{bits}u1", 32 + bits),
                "table": ((np.dtype(entries), children**3), layout.table(children)),
            }
            for node in self._records(level, fields, layout.inner(children)):
                has_child = np.unpackbits(node["child"], bitorder="little").astype(bool)
                values = node["table"]["value"].reshape(-1, layout.channels)
                origin = node["low"].astype(np.int64) // (children * edge) * (children * edge)
                for index in np.flatnonzero(~has_child & (values != background).any(axis=1)):
                    steps = np.array(np.unravel_index(index, (children,) * 3))
                    tiles.append((values[index], _cut(origin + steps * edge, edge, first, last)))
        (count,) = _unpack("<I", self.data, self.root + 24, self.path)
        for number in range(count):
            at = self.root + layout.root + layout.tile * number
            key, child, _ = _unpack("<QqI", self.data, at, self.path)
            value = np.frombuffer(_take(self.data, at + layout.tile_value, layout.value, self.path), layout.dtype)
            if not child and (value != background).any():
                origin = [(key >> s & (1 << 21) - 1) << 12 for s in (42, 21, 0)]
                origin = np.array([o - (1 << 32) if o >= 1 << 31 else o for o in origin])
                tiles.append((value, _cut(origin, 4096, first, last)))
        return tiles


def _unpack_codes(codes: np.ndarray, bits: int) -> np.ndarray:
    """Codes (n, 512) of quantised leaves from their bytes; the first code of a byte has its lowest bits."""
    if bits >= 8:
        return codes.view(f"<u{bits // 8}")
    steps = np.arange(0, 8, bits, dtype=np.uint8)
    return (codes[..., None] >> steps & (1 << bits) - 1).reshape(len(codes), -1)


def _cut(origin: np.ndarray, edge: int, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The bricks (n, 3) of a tile between two bricks (x, y, z)."""
    begin, end = np.maximum(origin // EDGE, first), np.minimum((origin + edge) // EDGE, last + 1)
    return np.stack(np.meshgrid(*map(np.arange, begin, end), indexing="ij"), axis=-1).reshape(-1, 3)
