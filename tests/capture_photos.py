"""Captures of the place without bounds that the benches trace, small, with some photographs brighter than others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.bench.studies.radiance_field.room import make_cameras, trace_image
from mivol.files import write_png
from mivol.photos import Camera, Photo
from mivol.photos.photo_file import decode_srgb
from mivol.photos.transforms import write_transforms

SIZE = (32, 24)


def cameras(count: int) -> list[Camera]:
    """All around the ball, at several heights, looking at it."""
    return make_cameras(count, SIZE)


def capture(count: int, uneven: float = 0.0) -> list[Photo]:
    """Photographs of the place; their gains are spread by exp(uneven * normal)."""
    gains = np.exp(uneven * np.random.default_rng(7).normal(size=count))
    black = np.zeros(3, np.float32)
    return [
        Photo(camera.name, np.float32(np.clip(gain * trace_image(camera), 0, 1)), None, None, camera, black)
        for camera, gain in zip(cameras(count), gains, strict=True)
    ]


def write_capture(folder: Path, count: int) -> Path:
    """The photographs and their file of cameras in a folder."""
    folder.mkdir(parents=True)
    made = capture(count)
    for photo in made:
        write_png(folder / photo.name, decode_srgb(photo.image))
    write_transforms(folder / "transforms.json", {photo.name: photo.camera for photo in made}, [])
    return folder
