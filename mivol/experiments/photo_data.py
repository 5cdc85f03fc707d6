"""Photographs to fit, held-out photographs, and the box of the matter."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mivol.config import FieldExperiment, GaussianExperiment, PhotoExperiment
from mivol.errors import MivolError
from mivol.optim.photographs.photo_colours import EPSILON
from mivol.optim.strategy import suggest_name
from mivol.photos import Photos, PhotoSurvey, load_photos, survey_photos
from mivol.photos.dataset import BACKGROUNDS, check_alpha
from mivol.photos.region import near_and_far
from mivol.validate.metrics import check_metrics

LEARNED = {"sky": ("sky", "sky_smooth"), "nested": ("sky", "sky_smooth", "levels", "near")}
"""Fields of the plan taken from the preset ``capture``, by the word for the background."""


def read_photos(settings: PhotoExperiment, base: Path) -> tuple[Photos, Photos | None]:
    """Read the photographs to fit, and the held-out photographs (may be None).

    Raises:
        MivolError: as :func:`mivol.photos.load_photos`, metrics for larger photographs, or an unknown word for the box or the
            background.
    """
    photo_settings = settings.photos
    if isinstance(photo_settings.box, str) and photo_settings.box not in BOXES:
        raise MivolError(f'photos.box = "{photo_settings.box}" is unknown: {suggest_name(photo_settings.box, list(BOXES))}')
    box = "middle" if photo_settings.background == "nested" and photo_settings.box == "found" else photo_settings.box
    options: dict[str, Any] = {
        "scale": photo_settings.scale,
        "largest": photo_settings.largest,
        "held_out": photo_settings.held_out,
        "fold": photo_settings.fold,
        "space": photo_settings.space,
        "stored": photo_settings.stored,
        "box": SEARCHED.get(box) if isinstance(box, str) else np.array(box, np.float64),
    }
    if isinstance(settings, GaussianExperiment):
        if photo_settings.space == "linear":
            raise MivolError('photos.space = "linear" is not for Gaussians, which are fitted to code values: choose "srgb".')
        options["space"] = "srgb"
    path = base / photo_settings.path
    surveyed = {"held_out": photo_settings.held_out, "fold": photo_settings.fold, "box": options["box"]}
    fitted = survey_photos(path, split="train", **surveyed)
    is_judged = photo_settings.judged != "held_out" or photo_settings.held_out > 0
    others = survey_photos(path, split=photo_settings.judged, **surveyed).frames if is_judged else ()
    # Check before the photographs are read: otherwise another error would hide a wrong background.
    has_alpha = check_alpha([*fitted.frames, *others])
    check_background(settings, has_alpha)
    if has_alpha:
        options["background"] = photo_settings.background or None
    photos = _put_over(load_photos(path, split="train", **options), photo_settings.background)
    white = find_white(photos) if photos.space == "linear" else 1.0
    if not is_judged:
        return divide_by_white(photos, white), None
    judged = load_photos(path, split=photo_settings.judged, **options | {"space": photos.space})
    check_metrics(settings.show.metrics, *np.min([view.camera.size for view in judged.views], axis=0))
    return divide_by_white(photos, white), divide_by_white(_put_over(judged, photo_settings.background), white)


def check_background(settings: PhotoExperiment, has_alpha: bool) -> None:
    """Refuse an unknown word for the background, or a word for photographs of the other kind.

    Raises:
        MivolError: with the known words.
    """
    word = settings.photos.background
    learned = list(LEARNED) if isinstance(settings, FieldExperiment) else []
    known = list(BACKGROUNDS) if has_alpha else ["white", "black", *learned]
    if not isinstance(word, str) or word in ("", *known):
        return
    if word not in (*BACKGROUNDS, *LEARNED):
        raise MivolError(f'photos.background = "{word}" is unknown: {suggest_name(word, known)}')
    kind = "photographs with alpha" if has_alpha else "photographs without alpha"
    if word in LEARNED and not learned:
        kind = "Gaussians" if isinstance(settings, GaussianExperiment) else f'field.kind = "{settings.field.kind}"'
    raise MivolError(f'photos.background = "{word}" is not for {kind}: {", ".join(known)} or an rgb triple is expected.')


MIDDLE_GREY = 0.18
"""Median of shown photographs of radiance, over white (the key of Reinhard et al. 2002)."""


def find_white(photos: Photos) -> float:
    """Radiance of white on a screen: a power of 2, which makes divisions exact.

    The median of lit pixels (mean of rgb above 0) is then within a factor of sqrt(2) of ``MIDDLE_GREY``.
    """
    levels = np.concatenate([view.image[::2, ::2].mean(axis=2).ravel() for view in photos.views])
    lit = levels[levels > 0]
    return 2.0 ** round(math.log2(np.median(lit) / MIDDLE_GREY)) if len(lit) else 1.0


def divide_by_white(photos: Photos, white: float) -> Photos:
    """Divide the photographs by the radiance of white."""
    if white == 1:
        return photos
    by = np.float32(white)
    views = (replace(view, image=view.image / by, background=view.background / by) for view in photos.views)
    return replace(photos, views=tuple(views), white=white)


def _put_over(photos: Photos, background: str | tuple[float, float, float]) -> Photos:
    """Set the background colour of photographs without alpha; photographs with alpha already have a background colour."""
    if photos.views[0].alpha is not None:
        return photos
    colour = np.full(3, background == "white", np.float32) if isinstance(background, str) else np.array(background, np.float32)
    return replace(photos, views=tuple(replace(view, background=colour) for view in photos.views))


def note_on_alpha(survey: PhotoSurvey) -> str:
    """Return a note on the alpha of the photographs; "" without alpha.

    Raises:
        MivolError: alpha in some photographs only.
    """
    if not check_alpha(survey.frames):
        return ""
    colour = "the colour behind them is white, or photos.background"
    if any(frame.camera.distortion.is_wide for frame in survey.frames):
        return f"alpha in all photographs: {colour}"
    box = "a fit takes the box around the opaque pixels, unless photos.box names another box"
    return f"alpha in all photographs: {colour}; {box}"


def add_box(settings: PhotoExperiment, photos: Photos) -> Photos:
    """Set the box of the matter.

    Raises:
        MivolError: as :meth:`mivol.photos.Photos.silhouette_box`.
    """
    box = settings.photos.box
    return BOXES[box](photos) if isinstance(box, str) else photos


def _find_box(photos: Photos) -> Photos:
    """Box around the opaque pixels if all photographs have alpha and an image plane; otherwise the cameras' box."""
    has_silhouettes = all(view.alpha is not None and not view.camera.distortion.is_wide for view in photos.views)
    return _box_silhouettes(photos) if has_silhouettes else photos


def _box_silhouettes(photos: Photos) -> Photos:
    box = photos.silhouette_box()
    near_far = near_and_far([view.camera for view in photos.views], box)
    return replace(photos, survey=replace(photos.survey, box=box, box_from="around the opaque pixels", near_far=near_far))


BOXES = {"found": _find_box, "cameras": lambda photos: photos, "silhouettes": _box_silhouettes, "middle": lambda photos: photos}
"""Functions setting the box, by the word in the settings."""

SEARCHED = {"middle": "middle"}
"""Words for a box found by ``load_photos``."""


def describe_photos(photos: Photos, judged: Photos | None = None) -> list[str]:
    """Return notes on the photographs for the report."""
    if photos.space == "linear":
        notes = [
            f"Colours are radiance, as in the photographs' files; an error weighs as the slope of log(y + {EPSILON:g}) says "
            f"(Mildenhall et al. 2022), where y = 1 is the radiance {photos.white:g} and shown white. Pictures, films and "
            "figures are tone-mapped: the sRGB curve of y, from 0 to 1."
        ]
    else:
        notes = ["Colours are sRGB values; in a scene, mivol_sh and mivol_gaussians convert them to radiance."]
    if "linear" in photos.stored and photos.space == "srgb":
        notes.append("Photographs of radiance were encoded as sRGB; radiance above 1 counts as 1.")
    if "srgb" in photos.stored and photos.space == "linear":
        notes.append("sRGB values of the photographs were converted to radiance.")
    if judged is not None:
        width, height = judged.views[0].camera.size
        notes.append(
            f"PSNR is the mean over the {len(judged.views)} held-out views (the first has {width} x {height} pixels). It "
            "compares 8-bit sRGB values; its peak is 1."
        )
    notes += [f"{note[:1].upper()}{note[1:]}." for note in photos.survey.notes]
    if photos.skipped:
        notes.append(f"{len(photos.skipped)} listed photographs are missing: {', '.join(photos.skipped[:5])} ...")
    return notes
