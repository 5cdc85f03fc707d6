"""Volumes in Zarr and OME-Zarr folders, through the package tensorstore.

Conventions. The first level of an OME-Zarr is read. Its scale is the distance of voxel centres, its translation the centre of
the first voxel. A plain array is (Z, Y, X), or (Z, Y, X, C) with unit cubes as voxels. A chunk without a file holds the fill
value, as the format says; a note counts such chunks. mivol writes OME-Zarr 0.4 (Zarr 2): one level, float32.

References: ngff.openmicroscopy.org, versions 0.4 and 0.5; zarr-specs.readthedocs.io, versions 2 and 3.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from mivol.files.atomic import disk_faults, write_whole_text
from mivol.files.npy import check_memory
from mivol.files.source import refusal, select_dataset
from mivol.files.volume import VolumeData, frame_from_steps, is_upright, split_frame, to_values

METADATA = ("zarr.json", ".zarray", ".zgroup", ".zattrs", ".zmetadata")

#: unit of OME-Zarr -> unit here.
UNITS = {"meter": "m", "centimeter": "cm", "millimeter": "mm", "micrometer": "um", "nanometer": "nm", "angstrom": "A"}

CHUNK = (16, 256, 256)


def is_zarr(path: Path) -> bool:
    """Whether a folder is an array or a group of Zarr."""
    return path.is_dir() and any((path / name).is_file() for name in ("zarr.json", ".zarray", ".zgroup"))


def read_zarr(path: Path, dataset: str | None = None) -> VolumeData:
    """Read an array, the first level of an OME-Zarr, or an array of a group.

    Args:
        path: folder.
        dataset: array of a group, for instance a level of an OME-Zarr; by default the first level, or the only array.

    Raises:
        MivolError: no tensorstore, damaged metadata or chunks, several times or channels without a place, or numbers that are
            not real.
    """
    about, scales = _describe(path)
    name = dataset if dataset is not None else next(iter(scales), None)
    if name is None and _node(path) != "array":
        name = select_dataset(path, None, _arrays(path))
    array = path / name if name else path
    if _node(array) != "array":
        select_dataset(path, name, _arrays(path))
        raise refusal(array, "a group", "an array", "name one of its arrays")
    stored, notes = _read_array(array)
    axes = about.get("axes") or ["z", "y", "x", "c"][: stored.ndim] if stored.ndim > 2 else ["y", "x"]
    values, kept = _order_axes(path, stored, axes)
    scale, translation = scales.get(name or "", (np.ones(stored.ndim), np.zeros(stored.ndim)))
    if len(scale) != stored.ndim or len(translation) != stored.ndim or not (np.isfinite(scale).all() and (scale > 0).all()):
        raise refusal(path, f"a scale of {list(scale)}", f"{stored.ndim} numbers above 0", "correct the metadata")
    spacing, origin = (np.array([part[axes.index(a)] if a in kept else d for a in "xyz"]) for part, d in
                       ((scale, 1.0), (translation, 0.0)))  # fmt: skip
    meta = {
        "path": str(path), "format": "zarr", "dtype": str(stored.dtype), "space": None, "dataset": name,
        "unit": about.get("unit", "voxel"), "notes": notes,
    }  # fmt: skip
    return VolumeData(values, frame_from_steps(values.shape[2::-1], np.diag(spacing), origin), meta)


def write_zarr(path: Path, values: np.ndarray, to_world: np.ndarray, metadata: dict[str, Any]) -> None:
    """Write an OME-Zarr of one level: (Z, Y, X) or (C, Z, Y, X) of float32. An earlier Zarr of that name is replaced.

    Raises:
        MivolError: no tensorstore, axes that are turned against the world's, or a destination that is no Zarr.
    """
    part = path.with_name(f".{path.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    channels = values.shape[3]
    target = ZarrSlices(part, values.shape[:3], to_world, channels, str(metadata.get("unit", "")), name=path.stem)
    target.write(0, values if channels > 1 else values[..., 0])
    if path.exists() and not is_zarr(path):
        shutil.rmtree(part)
        raise refusal(path, "something else than Zarr", "a new folder, or a Zarr to replace", "choose another name")
    with disk_faults(path, "room for a Zarr"):
        shutil.rmtree(path, ignore_errors=True)
        part.rename(path)


class ZarrSlices:
    """An OME-Zarr that is written a few slices at a time.

    Args:
        path: folder; created.
        shape: (Z, Y, X).
        to_world: unit cube to world (4, 4).
        channels: channels of a voxel.
        unit: unit of lengths, a value of ``UNITS``; other units are left out.
        resume: whether the folder holds the first slices.
        name: name of the image; None: that of the folder.

    Raises:
        MivolError: no tensorstore, or axes that are turned against the world's.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int, int],
        to_world: np.ndarray,
        channels: int = 1,
        unit: str = "",
        resume: bool = False,
        name: str | None = None,
    ) -> None:
        store = _tensorstore(path)
        steps, origin = split_frame(shape[::-1], to_world)
        if not is_upright(steps):
            raise refusal("write_volume", "turned axes for Zarr", "axes of the world", "write .nrrd, or remove the place")
        self.path = path
        more = [1] if channels > 1 else []
        if not resume:
            shutil.rmtree(path, ignore_errors=True)
            with disk_faults(path, "room for a folder"):
                path.mkdir()
            write_whole_text(path / ".zgroup", json.dumps({"zarr_format": 2}))
            word = next((word for word, short in UNITS.items() if short == unit), None)
            space = [{"name": a, "type": "space"} | ({"unit": word} if word else {}) for a in "zyx"]
            scale = [*map(float, more), *(float(s) for s in np.diag(steps)[::-1])]
            translation = [*(0.0 for _ in more), *(float(o) for o in origin[::-1])]
            about = {
                "version": "0.4",
                "name": path.stem if name is None else name,
                "axes": [{"name": "c", "type": "channel"} for _ in more] + space,
                "datasets": [{
                    "path": "0",
                    "coordinateTransformations": [
                        {"type": "scale", "scale": scale}, {"type": "translation", "translation": translation}
                    ],
                }],
            }  # fmt: skip
            write_whole_text(path / ".zattrs", json.dumps({"multiscales": [about]}))
        full = (*(channels for _ in more), *shape)
        chunks = [*more, *(min(n, c) for n, c in zip(shape, CHUNK, strict=True))]
        spec = {
            "driver": "zarr",
            "kvstore": {"driver": "file", "path": str(path / "0")},
            "metadata": {
                "shape": full, "chunks": chunks, "dtype": "<f4", "dimension_separator": "/", "fill_value": 0.0,
                "compressor": {"id": "blosc", "cname": "zstd", "clevel": 1, "shuffle": 1},
            },
        }  # fmt: skip
        self._array = store.open(spec, create=not resume, open=resume).result()

    def write(self, first: int, values: np.ndarray) -> None:
        """Write slices (n, Y, X) or (n, Y, X, C) from z = ``first`` on; float32 on the disk when the call returns."""
        stored = np.asarray(values, np.float32)
        if stored.ndim == 4:
            self._array[:, first : first + len(values)].write(np.moveaxis(stored, -1, 0)).result()
            return
        try:
            self._array[first : first + len(values)].write(stored).result()
        except ValueError as error:
            raise refusal(
                self.path, f"a failed write ({_plain(error)})", "room on the disk", "free some, then resume"
            ) from error


# -- Metadata --------------------------------------------------------------------------------------------------------------


def _tensorstore(path: Path) -> Any:
    try:
        import tensorstore
    except ImportError as error:
        raise refusal(
            path, "Zarr but no tensorstore", "an installed tensorstore", 'install it: pip install "mivol[lab]"'
        ) from error
    return tensorstore


def _load(path: Path) -> dict[str, Any]:
    """A JSON object; empty without the file."""
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise refusal(path, f"damaged JSON ({_plain(error)})", "the metadata of Zarr", "copy the folder again") from error
    if not isinstance(found, dict):
        raise refusal(path, f"JSON of {type(found).__name__}", "an object", "copy the folder again")
    return found


def _node(path: Path) -> str | None:
    """ "array" or "group"; None for other folders."""
    if (path / ".zarray").is_file():
        return "array"
    if (path / "zarr.json").is_file():
        return "array" if _load(path / "zarr.json").get("node_type") == "array" else "group"
    return "group" if (path / ".zgroup").is_file() else None


def _arrays(path: Path) -> list[str]:
    """Names of the arrays in a group, two levels deep."""
    inner = sorted(entry for entry in path.iterdir() if entry.is_dir())
    inner += [entry for folder in inner if _node(folder) == "group" for entry in sorted(folder.iterdir()) if entry.is_dir()]
    return [entry.relative_to(path).as_posix() for entry in inner if _node(entry) == "array"]


def _describe(path: Path) -> tuple[dict[str, Any], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Names of the axes and unit of an OME-Zarr; scale and translation by level, the first level first."""
    attributes = _load(path / "zarr.json").get("attributes", {}) if (path / "zarr.json").is_file() else _load(path / ".zattrs")
    try:
        attributes = attributes.get("ome", attributes)
        scales = attributes.get("multiscales")
        if not scales:
            return {}, {}
        about, whole = scales[0], scales[0].get("coordinateTransformations", [])
        axes = [axis["name"] if isinstance(axis, dict) else axis for axis in about.get("axes", ["t", "c", "z", "y", "x"])]
        units = {axis.get("unit") for axis in about.get("axes", []) if isinstance(axis, dict) and axis.get("type") == "space"}
        levels = {}
        for level in about["datasets"]:
            scale, translation = np.ones(len(axes)), np.zeros(len(axes))
            for step in [*level.get("coordinateTransformations", []), *whole]:
                factor = np.array(step.get("scale", np.ones(len(axes))), float)
                scale, translation = scale * factor, translation * factor + np.array(step.get("translation", 0.0), float)
            levels[str(level["path"])] = (scale, translation)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        found = f"metadata of OME-Zarr with a fault ({_plain(error)})"
        raise refusal(path, found, "axes, datasets and their scales", "correct it, or name the array by dataset") from error
    unit = UNITS.get(str(next(iter(units)))) if len(units) == 1 else None
    return {"axes": axes} | ({"unit": unit} if unit else {}), levels


def _read_array(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """The numbers of an array, and notes."""
    store = _tensorstore(path)
    driver = "zarr" if (path / ".zarray").is_file() else "zarr3"
    try:
        array = store.open({"driver": driver, "kvstore": {"driver": "file", "path": str(path)}}, read=True, open=True).result()
        kind = np.dtype(array.dtype.numpy_dtype).kind
    except (ValueError, TypeError, KeyError) as error:
        raise refusal(path, f"a damaged Zarr ({_plain(error)})", "a whole Zarr", "copy the folder again") from error
    if kind not in "uifb":
        raise refusal(path, f"values of type {array.dtype.name}", "real numbers", "convert them")
    # tensorstore holds a whole chunk, however little of the array lies in it, and ends the process without memory.
    chunk = array.chunk_layout.write_chunk.shape
    check_memory(path, max(math.prod(array.shape), math.prod(chunk)) * max(4, array.dtype.numpy_dtype.itemsize))
    try:
        stored = np.asarray(array.read().result())
    except ValueError as error:
        raise refusal(path, f"a damaged chunk ({_plain(error)})", "whole chunks", "copy the folder again") from error
    chunks = math.prod(-(-n // c) for n, c in zip(array.shape, chunk, strict=True))
    present = sum(name not in METADATA for _, _, names in os.walk(path) for name in names)
    if present < chunks:
        return stored, (f"{chunks - present} of {chunks} chunks have no file: they hold the fill value, {array.fill_value}.",)
    return stored, ()


def _order_axes(path: Path, stored: np.ndarray, axes: list[str]) -> tuple[np.ndarray, list[str]]:
    """Values (Z, Y, X, C), and the axes in the array."""
    if len(axes) != stored.ndim or len(set(axes)) != len(axes) or not {"x", "y"} <= set(axes):
        raise refusal(path, f"axes {axes} for an array of shape {stored.shape}", "a name for each, x and y among them",
                      "correct the metadata")  # fmt: skip
    others = [k for k, axis in enumerate(axes) if axis not in ("z", "y", "x", "c")]
    if any(stored.shape[k] > 1 for k in others):
        raise refusal(path, f"the axes {''.join(axes)} of shape {stored.shape}", "one time", "extract a volume")
    values = stored.reshape([n for k, n in enumerate(stored.shape) if k not in others])
    kept = [axis for k, axis in enumerate(axes) if k not in others]
    ordered = values.transpose([kept.index(axis) for axis in ("z", "y", "x", "c") if axis in kept])
    ordered = ordered if "z" in kept else ordered[None]
    return to_values(ordered, path), kept


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())[:120].rstrip(". ")
