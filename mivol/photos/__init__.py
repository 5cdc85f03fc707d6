"""Posed photographs: cameras and pixels of a data set, read and checked, ready to be fitted.

Needs no Mitsuba. :func:`load_photos` reads, :func:`survey_photos` looks without reading pixels, :func:`rays` says what a pixel
sees, :func:`project` where a point lies in the image.
"""

from __future__ import annotations

from mivol.photos.camera import Camera, directions, intrinsics, pixel_centres, project, rays
from mivol.photos.camera_path import between, facing, past, turntable
from mivol.photos.dataset import BACKGROUNDS, Photo, Photos, load_photos, pinhole_of, rectified
from mivol.photos.lens import Lens, distort, undistort
from mivol.photos.silhouette import silhouette_box
from mivol.photos.survey import FORMATS, SPLITS, Frame, PhotoSurvey, find_format, survey_photos
from mivol.photos.transforms import write_transforms

__all__ = [
    "BACKGROUNDS",
    "FORMATS",
    "SPLITS",
    "Camera",
    "Frame",
    "Lens",
    "Photo",
    "Photos",
    "PhotoSurvey",
    "between",
    "directions",
    "distort",
    "facing",
    "find_format",
    "intrinsics",
    "load_photos",
    "past",
    "pinhole_of",
    "pixel_centres",
    "project",
    "rays",
    "rectified",
    "silhouette_box",
    "survey_photos",
    "turntable",
    "undistort",
    "write_transforms",
]
