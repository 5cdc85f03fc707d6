"""Posed photographs: cameras and pixels of a data set, read and checked, ready to be fitted.

Needs no Mitsuba. :func:`load_photos` reads, :func:`survey_photos` looks without reading pixels, :func:`rays` says what a pixel
sees, :func:`project` where a point lies in the image.
"""

from __future__ import annotations

from mivol.photos.camera import Camera, directions, intrinsics, pixel_centres, project, rays
from mivol.photos.dataset import BACKGROUNDS, FORMATS, SPLITS, Frame, Photo, Photos, Survey, load_photos, survey_photos
from mivol.photos.lens import Lens, distort, undistort

__all__ = [
    "BACKGROUNDS",
    "FORMATS",
    "SPLITS",
    "Camera",
    "Frame",
    "Lens",
    "Photo",
    "Photos",
    "Survey",
    "directions",
    "distort",
    "intrinsics",
    "load_photos",
    "pixel_centres",
    "project",
    "rays",
    "survey_photos",
    "undistort",
]
