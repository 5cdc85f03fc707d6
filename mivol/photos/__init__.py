"""Posed photographs: cameras and pixels of a data set, read and checked for a fit.

The room needs no Mitsuba. :func:`load_photos` reads a data set, :func:`survey_photos` reads its cameras without pixels,
:func:`rays` maps pixels to rays, and :func:`project` maps points to pixels.
"""

from __future__ import annotations

from mivol.photos.camera import Camera, directions, intrinsics, pixel_centres, project, rays
from mivol.photos.camera_path import aim_camera, follow_keyframes, interpolate_cameras, turntable
from mivol.photos.dataset import BACKGROUNDS, Photo, Photos, load_photos, rectify, to_pinhole
from mivol.photos.lens import Lens, distort, undistort
from mivol.photos.survey import DATA_SET_FORMATS, SPLITS, PhotoFrame, PhotoSurvey, find_format, survey_photos
from mivol.photos.transforms import write_transforms

__all__ = [
    "BACKGROUNDS",
    "DATA_SET_FORMATS",
    "SPLITS",
    "Camera",
    "Lens",
    "Photo",
    "PhotoFrame",
    "PhotoSurvey",
    "Photos",
    "aim_camera",
    "directions",
    "distort",
    "find_format",
    "follow_keyframes",
    "interpolate_cameras",
    "intrinsics",
    "load_photos",
    "pixel_centres",
    "project",
    "rays",
    "rectify",
    "survey_photos",
    "to_pinhole",
    "turntable",
    "undistort",
    "write_transforms",
]
