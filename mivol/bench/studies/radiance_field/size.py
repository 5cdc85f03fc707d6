"""How much the bench of radiance fields measures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

__all__ = ["FULL", "QUICK", "STOP", "Size"]

STOP = 1e-4
"""Transmittance at which our rays end; the peer's end at 0."""


class PhotoFit(NamedTuple):
    """A fit to a data set of photographs.

    Attributes:
        name: of the data set.
        longest: nodes along an edge of a cube with as many; None: the preset's.
        effort: share of the preset's steps.
        preset: the preset.
    """

    name: str
    longest: int | None = None
    effort: float = 1.0
    preset: str = "cpu"

    def __str__(self) -> str:
        return f"{self.name} at {self.longest}" if self.longest else f"{self.name}, {self.preset}"


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        name: for the JSON.
        resolution: nodes along an edge of the fields.
        side: of pictures whose rays are timed [pixels].
        rounds: warm steps of each.
        steps: of the first stage of a fit.
        chair_steps: of the fit that makes the fitted field.
        fit_resolution, fit_side: nodes and pixels of fits.
        fields: names of those that are measured, in :data:`mivol.bench.studies.radiance_field.fields.FIELDS`.
        photo_fits: fits of :mod:`mivol.bench.studies.radiance_field.photographs`.
        photo_views, photo_side, photo_spp: of made-up data sets: photographs, pixels along an edge, samples a pixel.
        photo_folder: where those lie; they are made where they are missing.
        walk_side: rays of the walk that tells the machine's speed are its square.
        prior_side: longest edge of the photographs by which priors are judged [pixels].
        prior_resolution, prior_steps, prior_folds: nodes and steps of the last stage of their fits, and folds.
    """

    name: str = "full"
    resolution: int = 128
    side: int = 256
    rounds: int = 3
    steps: int = 105
    chair_steps: int = 800
    fit_resolution: int = 128
    fit_side: int = 256
    fields: tuple[str, ...] = ("shell", "fog", "fitted")
    photo_fits: tuple[PhotoFit, ...] = (
        PhotoFit("chair", 128),
        PhotoFit("chair", 256, 1.9),
        PhotoFit("chair", preset="fine"),
        PhotoFit("still_life", 128),
        PhotoFit("wires", 128),
        PhotoFit("glossy", 128),
        PhotoFit("still_life", preset="fine"),
        PhotoFit("wires", preset="fine"),
        PhotoFit("glossy", preset="fine"),
    )
    photo_views: int = 75
    photo_side: int = 200
    photo_spp: int = 32
    photo_folder: Path = Path("runs/photographs")
    walk_side: int = 1024
    prior_side: int = 80
    prior_resolution: int = 32
    prior_steps: int = 180
    prior_folds: int = 5


FULL = Size()
QUICK = Size(
    "quick",
    32,
    64,
    1,
    7,
    30,
    32,
    32,
    photo_fits=(PhotoFit("chair", 32, 0.03), PhotoFit("wires", 32, 0.03)),
    photo_views=15,
    photo_side=48,
    photo_spp=2,
    photo_folder=Path("runs/quick_photographs"),
    walk_side=64,
    prior_side=16,
    prior_resolution=16,
    prior_steps=6,
    prior_folds=1,
)
