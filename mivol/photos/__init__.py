"""Posed photographs: cameras and pixels of a data set, read and checked, ready to be fitted.

Needs no Mitsuba. :func:`load_photos` reads, :func:`survey_photos` looks without reading pixels, :func:`rays` says what a pixel
sees, :func:`project` where a point lies in the image.
"""

from __future__ import annotations

from mivol.photos.camera import Camera, directions, intrinsics, pixel_centres, project, rays
from mivol.photos.camera_path import aim_camera, follow_keyframes, interpolate_cameras, turntable
from mivol.photos.dataset import BACKGROUNDS, Photo, Photos, load_photos, rectify, to_pinhole
from mivol.photos.lens import Lens, distort, undistort
from mivol.photos.survey import FORMATS, SPLITS, PhotoFrame, PhotoSurvey, find_format, survey_photos
from mivol.photos.transforms import write_transforms

__all__ = [
    "BACKGROUNDS",
    "FORMATS",
    "SPLITS",
    "Camera",
    "PhotoFrame",
    "Lens",
    "Photo",
    "Photos",
    "PhotoSurvey",
    "interpolate_cameras",
    "directions",
    "distort",
    "aim_camera",
    "find_format",
    "intrinsics",
    "load_photos",
    "follow_keyframes",
    "to_pinhole",
    "pixel_centres",
    "project",
    "rays",
    "rectify",
    "survey_photos",
    "turntable",
    "undistort",
    "write_transforms",
]
