"""Light that scatters many times: how much sooner does mivol reach an error than Mitsuba's ``volpath`` and ``prbvolpath``?

    mivol bench multiple_scattering                  # 25 minutes on 2 idle cores
    mivol bench multiple_scattering --quick          # a minute, small sizes: are the means the same?
    mivol bench multiple_scattering --only smoke     # one of the volumes

The volumes fill [-1, 1]^3: the smoke of the Mitsuba tutorial at its density (x 40) and at a twentieth of this density, the
smoke upsampled to 256^3, threads in 512^3, a cloud of a large-eddy simulation with an albedo of 0.999, a white box of optical
depth 64, and milk in a glass. Other albedos are 0.75; ``max_depth`` is 6 or unlimited. Samples, rounds and variance x time are
as in ``mivol bench single_scattering``. Bars are on the mean over pixels, and on the median for unlimited depth.

Errors of unlimited paths have heavy tails. There one render takes ``LONGER`` times as long, because the variance of few samples
misses the tails, most of all for the method with the fewest samples: in the cloud the median ratio to ``volpath`` is 21 with 8
samples per pixel of ``volpath``, 39 with 32, and 50 with 128; the mean ratio is 65 to 67.

milk: skim milk (measured, rgb), 40 mm along an edge, in a box of glass. Both boundaries are smooth and refract. A large lamp
and a faint sky light the box; the depth is unlimited. Paths hit the lamp by chance after they leave the glass, and the weights
of ``volpath`` grow without bound, because extinctions differ between channels. The image is small (16 x 16), so that each pixel
has enough samples to show a part of this growth. Means are compared in diluted milk of optical depth 1. ``volpathmis``, whose
weights are bounded, takes part without a bar.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mivol.bench.harness.figures import new_figure
from mivol.bench.scenes import (
    StudyExtinction,
    as_dense_as_smoke,
    constant_light,
    directional_light,
    fine_smoke,
    les_cloud,
    milk_in_a_glass,
    smoke,
    sun_and_sky,
    threads_in_space,
)
from mivol.bench.studies.single_scattering import (
    PEERS,
    ContestSize,
    Light,
    contest_study,
    plot_contest,
)
from mivol.phase.measured import MeasuredMedium, named_medium

THIN, WHITE_DEPTH = 0.05, 64.0
"""Factor on the density of the smoke; optical depth along an edge of the white box."""

LIQUID, EDGE = "skim milk", 40.0
"""Liquid in the glass; edge of the box [mm]."""


def thin_smoke() -> StudyExtinction:
    """The smoke at a twentieth of its density."""
    dense = smoke()
    return dense._replace(values=dense.values * np.float32(THIN))


def white_box() -> StudyExtinction:
    """A constant grid in a box with an edge of 2."""
    return StudyExtinction(np.full((4, 4, 4), WHITE_DEPTH / 2, np.float32), "made up: constant")


def liquid_coefficients(liquid: MeasuredMedium) -> tuple[np.ndarray, np.ndarray]:
    """Extinction [1/length of the scene] and albedo (3,) of a liquid in a box with an edge of 2."""
    sigma_s, sigma_a = (np.array(x) * EDGE / 2 for x in (liquid.sigma_s, liquid.sigma_a))
    return sigma_s + sigma_a, sigma_s / (sigma_s + sigma_a)


def milk() -> StudyExtinction:
    """Extinction (3,) of the liquid in the glass."""
    return StudyExtinction(liquid_coefficients(named_medium(LIQUID))[0], f"{LIQUID}, {EDGE:g} mm")


VOLUMES: dict[str, Callable[[ContestSize], StudyExtinction]] = {
    "smoke": lambda _: smoke(),
    "thin smoke": lambda _: thin_smoke(),
    "cloud": lambda _: les_cloud(),
    "fine smoke": lambda size: fine_smoke(size.fine_res),
    "threads": lambda size: as_dense_as_smoke(threads_in_space(size.sparse_res)),
    "white box": lambda _: white_box(),
    "milk": lambda _: milk(),
}

CONSTANT, SUN, DIRECTIONAL = "constant light", "HG 0.8, sun in a sky", "HG 0.8, directional"
PARTS = {CONSTANT: constant_light, SUN: sun_and_sky, DIRECTIONAL: directional_light}


def _light(name: str, bar: float, depth: int = 6, albedo: float = 0.75) -> Light:
    return Light(PARTS[name], bar, by_pixel=depth < 0, albedo=albedo, depth=depth, has_tails=depth < 0)


GLASS = Light(
    milk_in_a_glass,
    10,
    by_pixel=True,
    side=16,
    albedo=tuple(liquid_coefficients(named_medium(LIQUID))[1]),
    depth=-1,
    peers=(*PEERS, "volpathmis"),
    has_tails=True,
)

CONTESTS: dict[str, dict[str, Light]] = {
    "smoke": {CONSTANT: _light(CONSTANT, 40), SUN: _light(SUN, 50), DIRECTIONAL: _light(DIRECTIONAL, 80)},
    "thin smoke": {CONSTANT: _light(CONSTANT, 5), SUN: _light(SUN, 6), DIRECTIONAL: _light(DIRECTIONAL, 9)},
    "cloud": {f"{SUN}, depth 6": _light(SUN, 80, 6, 0.999), f"{SUN}, unlimited": _light(SUN, 30, -1, 0.999)},
    "fine smoke": {CONSTANT: _light(CONSTANT, 25), SUN: _light(SUN, 25)},
    "threads": {SUN: _light(SUN, 12)},
    "white box": {f"{CONSTANT}, unlimited": _light(CONSTANT, 300, -1, 0.999)},
    "milk": {"glass, lamp and sky, unlimited": GLASS},
}
"""Lights of each volume; the bars are on the ratio to ``volpath``."""


def draw(answers: dict, path: Path) -> None:
    """Plot error against time for each light of the first volume."""
    volume = next(iter(answers))
    lights = CONTESTS[volume]
    with new_figure(path, 4.4 * len(lights), 3.8) as figure:
        for axes, (name, light) in zip(np.atleast_1d(figure.subplots(1, len(lights))), lights.items(), strict=True):
            plot_contest(axes, answers[volume][name], light)
            axes.set_title(f"{volume}: {name}")
        axes.legend()


STUDY = contest_study(__name__, __doc__, VOLUMES, CONTESTS, ("volpath",), draw)
