"""HDF5 files as a beamline's software writes them, on 5 views of 2 x 3 pixels; counts tell where they were."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

KEY = [1, 2, 0, 0, 3, 0, 0, 0, 1, 2]
"""Flat, dark, views with an invalid frame between, flat, dark."""

FRAMES = np.arange(60, dtype="u2").reshape(10, 2, 3)
VIEWS, FLATS, DARKS = ([2, 3, 5, 6, 7], [0, 8], [1, 9])
DEGREES = np.where(np.array(KEY) == 0, np.cumsum(np.array(KEY) == 0) * 36.0 - 36.0, 0.0)


def write_nxtomo(path: Path, entry: str = "entry", **changes: object) -> Path:
    """Write frames behind an external link, ``image_key`` beside them; ``changes`` replace image_key or angles."""
    frames = path.with_name(f"{path.stem}_frames.h5")
    with h5py.File(frames, "w") as file:
        file["entry/data/data"] = FRAMES
    with h5py.File(path, "a") as file:
        group = file.create_group(entry)
        group.attrs["NX_class"] = "NXentry"
        group["definition"] = "NXtomo"
        detector = group.create_group("instrument/detector")
        detector["data"] = h5py.ExternalLink(frames.name, "entry/data/data")
        detector["image_key"] = changes.get("image_key", KEY)
        for axis, size in (("x", 2.0), ("y", 4.0)):
            detector[f"{axis}_pixel_size"] = size
            detector[f"{axis}_pixel_size"].attrs["units"] = "um"
        detector["distance"] = 0.05
        group["instrument/source/distance"] = -55.0
        group["sample/rotation_angle"] = changes.get("angles", DEGREES)
        group["data/data"] = h5py.SoftLink(f"/{entry}/instrument/detector/data")
        group["data/rotation_angle"] = h5py.SoftLink(f"/{entry}/sample/rotation_angle")
    return path


def write_named(path: Path) -> Path:
    """Write arrays at paths that no layout has; one flat as an image, angles with a unit."""
    with h5py.File(path, "w") as file:
        file["scan/camera/frames"] = FRAMES[VIEWS]
        file["before/reference"] = FRAMES[0]
        file["before/background"] = FRAMES[DARKS]
        file["scan/stage"] = np.radians(DEGREES[VIEWS])
        file["scan/stage"].attrs["units"] = "rad"
    return path
