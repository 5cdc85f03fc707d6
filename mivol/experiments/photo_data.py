"""Photographs that are fitted, those that a fit is judged by, and the box where matter may be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mivol.config import PhotoFit
from mivol.errors import MivolError
from mivol.optim.strategy import nearest
from mivol.photos import Photos, load_photos, silhouette_box
from mivol.photos.picture import space_of
from mivol.photos.region import near_far_of


def read_photos(chosen: PhotoFit, base: Path) -> tuple[Photos, Photos | None]:
    """Photographs to fit, and those to judge by.

    Raises:
        MivolError: as :func:`mivol.photos.load_photos`, or neither a box nor one of the words for it.
    """
    wanted = chosen.photos
    if isinstance(wanted.box, str) and wanted.box not in BOXES:
        raise MivolError(f'photos.box = "{wanted.box}" is unknown: {nearest(wanted.box, list(BOXES))}')
    settings: dict[str, Any] = {
        "scale": wanted.scale,
        "largest": wanted.largest,
        "background": wanted.background or None,
        "held_out": wanted.held_out,
        "space": "srgb",
        "box": SEARCHED.get(wanted.box) if isinstance(wanted.box, str) else np.array(wanted.box, np.float64),
    }
    path = base / wanted.path
    photos = _over(load_photos(path, split="train", **settings), wanted.behind)
    if wanted.judged == "held_out" and not wanted.held_out:
        return photos, None
    return photos, _over(load_photos(path, split=wanted.judged, **settings), wanted.behind)


def _over(photos: Photos, behind: tuple[float, float, float]) -> Photos:
    """Photographs that show a colour where nothing is; those with alpha were put over theirs."""
    if photos.views[0].alpha is not None:
        return photos
    colour = np.array(behind, np.float32)
    return replace(photos, views=tuple(replace(view, background=colour) for view in photos.views))


def boxed(chosen: PhotoFit, photos: Photos) -> Photos:
    """The photographs with the box where matter may be.

    Raises:
        MivolError: as :func:`mivol.photos.silhouette_box`.
    """
    wanted = chosen.photos.box
    return BOXES[wanted](photos) if isinstance(wanted, str) else photos


def _about_silhouettes(photos: Photos) -> Photos:
    box = silhouette_box(photos)
    near_far = near_far_of([view.camera for view in photos.views], box)
    return replace(photos, survey=replace(photos.survey, box=box, box_from="about what alpha shows", near_far=near_far))


BOXES = {"cameras": lambda photos: photos, "silhouettes": _about_silhouettes, "middle": lambda photos: photos}
"""What is made of the box that was found with the photographs, by the word for it."""

SEARCHED = {"middle": "middle"}
"""Words for a box that ``load_photos`` looks for itself."""


def notes(photos: Photos, judged: Photos | None = None) -> list[str]:
    """What a reader must know of the photographs."""
    found = [f"Colours are {photos.space} code values; in a scene mivol_sh shows the radiance that they stand for."]
    if any(space_of(frame.file) == "linear" for frame in photos.survey.frames):
        found.append("The light of OpenEXR photographs was encoded; what is above 1 counts as 1.")
    if judged is not None:
        width, height = judged.views[0].camera.size
        found.append(
            f"{len(judged.views)} views are judged, the first at {width} x {height} pixels; PSNR is the mean over them, of "
            "sRGB codes of 8 bits, with the peak 1."
        )
    if photos.skipped:
        found.append(f"{len(photos.skipped)} photographs are listed and not there: {', '.join(photos.skipped[:5])} ...")
    return found
