"""Volume files made byte by byte, independent of NumPy's order and of the readers under test.

Every maker takes ``values`` (Z, Y, X, C) and packs them with ``struct``, one number after the other, in the order that
the format's definition states; nothing here imports mivol.
"""

from __future__ import annotations

import base64
import bz2
import gzip
import lzma
import struct
import zlib
from collections.abc import Callable

import numpy as np

#: struct codes by NumPy kind and size.
CODES = {"u1": "B", "i1": "b", "u2": "H", "i2": "h", "u4": "I", "i4": "i", "u8": "Q", "i8": "q", "f4": "f", "f8": "d"}

PACK: dict[str, Callable[[bytes], bytes]] = {
    "raw": bytes,
    "gzip": lambda data: gzip.compress(data, mtime=0),
    "bzip2": bz2.compress,
    "zlib": zlib.compress,
    "lzma": lzma.compress,
}


def numbered(nz: int = 2, ny: int = 3, nx: int = 4, channels: int = 1) -> np.ndarray:
    """Values that name their own index: 64 z + 16 y + 4 x + c (z, y, x, c < 4 fit one byte)."""
    z, y, x, c = np.meshgrid(*map(np.arange, (nz, ny, nx, channels)), indexing="ij")
    return (64 * z + 16 * y + 4 * x + c).astype(np.float32)


def in_order(values: np.ndarray) -> list[float]:
    """The numbers with the channel fastest, then x, y, z."""
    nz, ny, nx, channels = values.shape
    return [float(values[z, y, x, c]) for z in range(nz) for y in range(ny) for x in range(nx) for c in range(channels)]


def packed(numbers: list[float], dtype: str, order: str = "<") -> bytes:
    """Numbers as bytes of a type ("u2", "f4" ...) and byte order."""
    cast = float if dtype[0] == "f" else int
    return b"".join(struct.pack(order + CODES[dtype], cast(number)) for number in numbers)


def vol(values: np.ndarray, *, box: tuple = (-1, -2, -3, 3, 4, 5), encoding: int = 1, version: int = 3) -> bytes:
    """Mitsuba's grid."""
    nz, ny, nx, channels = values.shape
    head = b"VOL" + struct.pack("<B", version) + struct.pack("<i", encoding)
    head += struct.pack("<3i", nx, ny, nz) + struct.pack("<i", channels) + struct.pack("<6f", *box)
    code = {1: "<f", 2: "<e", 3: "<B"}.get(encoding, "<f")
    cast = int if encoding == 3 else float
    return head + b"".join(struct.pack(code, cast(number)) for number in in_order(values))


NRRD_TYPES = {
    "i1": "signed char", "u1": "uchar", "i2": "short", "u2": "unsigned short", "i4": "int", "u4": "unsigned int",
    "i8": "long long int", "u8": "unsigned long long int", "f4": "float", "f8": "double",
}  # fmt: skip


def nrrd_head(values: np.ndarray, *, dtype: str = "f4", order: str = "<", encoding: str = "raw", **fields: str) -> str:
    """The lines of an NRRD header, without the blank one; a channel axis, if any, is the fastest."""
    nz, ny, nx, channels = values.shape
    several = channels > 1
    lines = {
        "type": NRRD_TYPES[dtype],
        "dimension": str(3 + several),
        "sizes": " ".join(map(str, [channels] * several + [nx, ny, nz])),
        "space directions": "none " * several + "(1.5,0,0) (0,2,0) (0,0,2.5)",
        "space origin": "(10,20,30)",
        "space": "left-posterior-superior",
        "endian": "little" if order == "<" else "big",
        "encoding": encoding,
    }
    lines |= {name.replace("_", " "): text for name, text in fields.items()}
    return "NRRD0004\n# by hand\n" + "".join(f"{name}: {text}\n" for name, text in lines.items() if text)


def nrrd(values: np.ndarray, *, dtype: str = "f4", order: str = "<", encoding: str = "raw", **fields: str) -> bytes:
    """An attached NRRD."""
    head = nrrd_head(values, dtype=dtype, order=order, encoding=encoding, **fields) + "key:=value\n\n"
    if encoding == "ascii":
        return head.encode() + "\n".join(map(repr, in_order(values))).encode()
    return head.encode() + PACK[encoding](packed(in_order(values), dtype, order))


MET_TYPES = {
    "i1": "MET_CHAR", "u1": "MET_UCHAR", "i2": "MET_SHORT", "u2": "MET_USHORT", "i4": "MET_INT", "u4": "MET_UINT",
    "i8": "MET_LONG_LONG", "u8": "MET_ULONG_LONG", "f4": "MET_FLOAT", "f8": "MET_DOUBLE",
}  # fmt: skip


def meta_head(values: np.ndarray, *, dtype: str = "f4", order: str = "<", data: str = "LOCAL", **keys: str) -> bytes:
    """A MetaImage header up to and with its last line."""
    nz, ny, nx, channels = values.shape
    lines = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryDataByteOrderMSB": "False" if order == "<" else "True",
        "DimSize": f"{nx} {ny} {nz}",
        "ElementSpacing": "1.5 2 2.5",
        "Offset": "10 20 30",
        "ElementNumberOfChannels": str(channels),
        "ElementType": MET_TYPES[dtype],
    } | keys
    text = "".join(f"{name} = {value}\n" for name, value in lines.items() if value)
    return (text + f"ElementDataFile = {data}\n").encode()


def mha(values: np.ndarray, *, dtype: str = "f4", order: str = "<", **keys: str) -> bytes:
    """A MetaImage in one file, zlib-packed where CompressedData says so, text where BinaryData is False."""
    if keys.get("BinaryData") == "False":
        return meta_head(values, dtype=dtype, order=order, **keys) + " ".join(map(repr, in_order(values))).encode()
    data = packed(in_order(values), dtype, order)
    if keys.get("CompressedData") == "True":
        data = zlib.compress(data)
    return meta_head(values, dtype=dtype, order=order, **keys) + data


NIFTI_TYPES = {"i1": 256, "u1": 2, "i2": 4, "u2": 512, "i4": 8, "u4": 768, "i8": 1024, "u8": 1280, "f4": 16, "f8": 64}


def nifti(
    values: np.ndarray,
    *,
    dtype: str = "f4",
    order: str = "<",
    version: int = 1,
    sform: list[float] | None = None,
    qform: list[float] | None = None,
    pixdim: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5),
    scale: tuple[float, float] = (0.0, 0.0),
    code: int | None = None,
    axis: int = 5,
) -> bytes:
    """NIfTI-1 or -2 in one file; channels, if any, are the axis of that number (slowest)."""
    nz, ny, nx, channels = values.shape
    dim = [axis if channels > 1 else 3, nx, ny, nz, 1, 1, 1, 1]
    dim[axis] = channels
    head = bytearray(348 if version == 1 else 540)

    def put(code: str, offset: int, *numbers: float) -> None:
        struct.pack_into(order + code, head, offset, *numbers)

    real = "f" if version == 1 else "d"
    at = (
        {"dim": 40, "type": 70, "pixdim": 76, "offset": 108, "scale": 112, "unit": 123, "codes": 252, "q": 256, "s": 280}
        if version == 1
        else {"dim": 16, "type": 12, "pixdim": 104, "offset": 168, "scale": 176, "unit": 500, "codes": 344}
        | {"q": 352, "s": 400}
    )
    put("i", 0, len(head))
    put("8h" if version == 1 else "8q", at["dim"], *dim)
    put("h", at["type"], NIFTI_TYPES[dtype] if code is None else code)
    put("8" + real, at["pixdim"], *pixdim, 1, 1, 1, 1)
    put("f" if version == 1 else "q", at["offset"], len(head) + 4)
    put("2" + real, at["scale"], *scale)
    put("B" if version == 1 else "i", at["unit"], 2)
    put("2h" if version == 1 else "2i", at["codes"], int(qform is not None), int(sform is not None))
    put("6" + real, at["q"], *(qform or [0] * 6))
    put("12" + real, at["s"], *(sform or [0] * 12))
    magic_at = 344 if version == 1 else 4
    magic = b"n+1\0" if version == 1 else b"n+2\0\r\n\x1a\n"
    head[magic_at : magic_at + len(magic)] = magic
    planes = [float(values[z, y, x, c]) for c in range(channels) for z in range(nz) for y in range(ny) for x in range(nx)]
    return bytes(head) + bytes(4) + packed(planes, dtype, order)


VTK_TYPES = {f"{code}{size}": f"{name}{8 * size}" for code, name in (("i", "Int"), ("u", "UInt")) for size in (1, 2, 4, 8)}
VTK_TYPES |= {"f4": "Float32", "f8": "Float64"}


def vti_block(data: bytes, word: str, order: str, compressor: str | None, size: int) -> tuple[bytes, bytes]:
    """(header, bytes) of one array: its length, or the table of its packed blocks."""
    if compressor is None:
        return struct.pack(order + word, len(data)), data
    blocks = [data[i : i + size] for i in range(0, len(data), size)]
    pieces = [PACK[compressor](block) for block in blocks]
    last = len(data) % size
    table = [len(blocks), size, last, *map(len, pieces)]
    return struct.pack(f"{order}{len(table)}{word}", *table), b"".join(pieces)


def vti(
    values: np.ndarray,
    *,
    dtype: str = "f4",
    order: str = "<",
    mode: str = "raw",
    header_type: str = "UInt32",
    compressor: str | None = None,
    cells: bool = False,
    split: bool = False,
    direction: str = "1 0 0 0 1 0 0 0 1",
    first: tuple[int, int, int] = (0, 0, 0),
) -> bytes:
    """VTK's XML image; mode "ascii", "inline" (base64 in the element), "base64" or "raw" (appended).

    ``split`` pads the length of an uncompressed inline block on its own, as some writers do.
    """
    nz, ny, nx, channels = values.shape
    last = [f + n - (0 if cells else 1) for f, n in zip(first, (nx, ny, nz), strict=True)]
    extent = " ".join(f"{a} {b}" for a, b in zip(first, last, strict=True))
    word = {"UInt32": "I", "UInt64": "Q"}[header_type]
    head, data = vti_block(packed(in_order(values), dtype, order), word, order, compressor, 16)
    coded = base64.b64encode(head) + base64.b64encode(data) if compressor or split else base64.b64encode(head + data)
    body, appended, form = "", b"", "appended"
    if mode == "ascii":
        body, form = " ".join(map(repr, in_order(values))), "ascii"
    elif mode == "inline":
        body, form = coded.decode(), "binary"
    else:
        other = b"\0" * 7 if mode == "raw" else b"AAAA"
        appended = other + (head + data if mode == "raw" else coded)
    offset = 7 if mode == "raw" else 4
    names = {"zlib": "vtkZLibDataCompressor", "lzma": "vtkLZMADataCompressor", None: ""}
    squeeze = f' compressor="{names.get(compressor, compressor)}"' if compressor else ""
    kind = "CellData" if cells else "PointData"
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order='
        f'"{"LittleEndian" if order == "<" else "BigEndian"}" header_type="{header_type}"{squeeze}>\n'
        f'<ImageData WholeExtent="{extent}" Origin="10 20 30" Spacing="1.5 2 2.5" Direction="{direction}">\n'
        f'<Piece Extent="{extent}"><{kind} Scalars="rho"><DataArray type="{VTK_TYPES[dtype]}" Name="rho" '
        f'NumberOfComponents="{channels}" format="{form}" offset="{offset}">{body}</DataArray></{kind}></Piece>\n'
        "</ImageData>\n"
    )
    if appended:
        coding = "raw" if mode == "raw" else "base64"
        return f'{text}<AppendedData encoding="{coding}">\n_'.encode() + appended + b"\n</AppendedData>\n</VTKFile>\n"
    return (text + "</VTKFile>\n").encode()


def vtk(values: np.ndarray, *, binary: bool = True, kind: str = "SCALARS", cells: bool = False) -> bytes:
    """Legacy VTK, float, big-endian where binary."""
    nz, ny, nx, channels = values.shape
    count = nx * ny * nz
    head = (
        f"# vtk DataFile Version 3.0\nby hand\n{'BINARY' if binary else 'ASCII'}\nDATASET STRUCTURED_POINTS\n"
        f"DIMENSIONS {nx + cells} {ny + cells} {nz + cells}\nSPACING 1.5 2 2.5\nORIGIN 10 20 30\n"
        f"{'CELL' if cells else 'POINT'}_DATA {count}\n"
    )
    head += {
        "SCALARS": f"SCALARS rho float {channels}\nLOOKUP_TABLE default\n",
        "VECTORS": "VECTORS rho float\n",
        "FIELD": f"FIELD FieldData 1\nrho {channels} {count} float\n",
    }[kind]
    numbers = in_order(values)
    return head.encode() + (packed(numbers, "f4", ">") if binary else " ".join(map(repr, numbers)).encode()) + b"\n"


def pbrt(values: np.ndarray) -> bytes:
    """pbrt-v2's volumegrid in the box (0, 0, 0) to (8, 6, 4)."""
    nz, ny, nx, _ = values.shape
    return (
        f'Volume "volumegrid" "integer nx" {nx} "integer ny" {ny} "integer nz" [ {nz} ]\n'
        f'"color sigma_a" [1 1 1] "point p0" [ 0 0 0 ] "point p1" [ 8 6 4 ]\n"float density" [\n'
        f"{' '.join(map(repr, in_order(values)))} ]\n"
    ).encode()


def les(cells: list[tuple], *, size: str = "4,3,2", altitudes: str = "0.40,0.44") -> bytes:
    """A cloud of listed cells (i, j, k, lwc, reff)."""
    rows = "".join(",".join(map(str, cell)) + "\n" for cell in cells)
    return f"# cloud\n{size}  # sizes\n0.020,0.030\n{altitudes}\nx,y,z,lwc,reff\n{rows}".encode()
