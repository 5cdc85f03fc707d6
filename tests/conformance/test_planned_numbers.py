"""What plans choose for made-up scenes, as sums: choices of cost and noise leave the mean of an image as it is.

A fault in a measured cost, a limit or a count makes renders slower or noisier, which no comparison of means sees. A table of
many scenes, with facts on both sides of each limit and on it, holds all numbers of the plans. Another choice that is meant
gives another sum, which the failing test prints.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from itertools import product
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from mivol.scene import choices, plan
from mivol.scene.needs import MediumFacts
from mivol.scene.survey import BranchNoise, MirrorNoise, OwnRaysNoise
from mivol.transport.path import derivatives
from mivol.transport.path.estimators import Settings

NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
FLIGHTS = "free_flight"


def medium(name: str = "fog", **more: object) -> MediumFacts:
    facts = {"kind": "k", "boundary": "a box", "extinction": "grey", "resolutions": ((10, 20, 30),), "is_scattering": True}
    return MediumFacts(name, **{**facts, "emits": False, "phase": "p", "occupied": 0.5, "tau_max": 10.0, **more})


MEDIA = {
    "fog": medium(),
    "thin": medium(occupied=plan.MAX_SKIPPED_SHARE / 2, mean_cosine=0.8, tau_max=choices.DENSE, cell_depth=0.85),
    "filled": medium(occupied=1.0, resolutions=((100, 100, 100),), mean_cosine=choices.MIN_SIDE_FLIGHT_COSINE),
    "large": medium(resolutions=((400, 400, 400),), occupied=plan.MAX_TRIMMED_SHARE, extinction="rgb", tau_max=69.9),
    "rgb": medium(extinction="rgb", cell_depth=0.86),
    "even": medium(resolutions=(), occupied=0.0, tau_min=plan.THICK, albedo_min=plan.MIN_ALBEDO),
    "sparse": medium(resolutions=((800, 80, 80),), bricks=(40,), occupied=0.1),
    "fire": medium(emits=True, is_scattering=False),
    "glowing fog": medium(emits=True),
    "Gaussians": medium(resolutions=(), gaussians=7, emits=True),
    "leaves": medium(resolutions=(), leaves=5),
    "field": medium(resolutions=(), bounded="Ball", mean_cosine=0.99),
    "recorded": medium(unread=True),
}
"""Facts of media, many of them at a limit."""

NOISE = ((1.0, 0.1, 1.0), (8.0, 0.5, 3.0), (0.2, 5.0, 0.7), (0.0, 0.0, 0.0), (2.5, 2.0, 0.04))

SETTINGS = (Settings(2), Settings(4), Settings(-1), Settings(6, near_light="segments"), Settings(5, media_light="drawn"),
            Settings(5, shadows="exact"), Settings(6, hide_emitters=True), Settings(1), Settings(3), Settings(0))  # fmt: skip


def scene(*media: MediumFacts, noise: tuple[float, float, float] = NOISE[0], **more: object) -> SimpleNamespace:
    """The facts of a scene in which every preview was made."""
    a, b, c = noise
    given = {
        "media": media, "variant": "llvm_ad_rgb", "parameters": (), "film_samples": 1 << 16, "crop_samples": 1 << 16, "spp": 16,
        "refractive": (), "emitter_kinds": ("extended",), "surfaces": ("Sphere",), "is_sealed": False, "has_lamps": True,
        "has_glass": True, "boundaries": tuple(SimpleNamespace(box=1, around=1, hole=None) for _ in media),
        "views": (), "are_emitters_far": True, "endless_media": (), "are_samples_independent": True, "is_colour_film": True,
        "emitter_distances": (0.3, math.inf), "near_gain": a, "lamp_noise": (a, b), "branch_noise": BranchNoise(b, a, 0.4, c),
        "emission_noise": OwnRaysNoise(a + b, b, c / 8),
        "mirror_noise": MirrorNoise(OwnRaysNoise(a + b, b, c / 8), b if c > 1 else math.inf),
        "media_light": SimpleNamespace(gain=a), "emitters": (),
        "refracted_noise": SimpleNamespace(by_chance=a + b, drawn=c / 4),
    }  # fmt: skip
    made = SimpleNamespace(**{**given, **more})
    made.nearness = min(made.emitter_distances, default=math.inf)
    return made


LIMITS = [
    *({"film_samples": n, "crop_samples": 3 * n} for n in
      (choices.MIN_LAMP_SAMPLES - 1, choices.MIN_LAMP_SAMPLES, choices.MIN_BRANCHING_SAMPLES - 1, 1 << 14, 1 << 18, 1 << 26)),
    *({"emitter_distances": d} for d in
      ((0.0, 1.0), (1.0,), (0.999, 1.0), (math.inf,), (), (2.0, 0.0, 0.0))),
    *({"emitter_kinds": k} for k in ((), ("delta",), ("uniform",), ("uniform", "delta"), ("extended", "delta", "uniform"))),
    *({"spp": n} for n in (1, 4, 64, 1024)),
    *({"near_gain": g} for g in (None, 1.0, 1.01)),
    *({name: True} for name in ("is_sealed",)),
    *({name: False} for name in
      ("has_lamps", "has_glass", "are_emitters_far", "are_samples_independent", "is_colour_film")),
    *({name: None} for name in
      ("lamp_noise", "branch_noise", "emission_noise", "mirror_noise", "refracted_noise", "media_light")),
    {"surfaces": ()}, {"refractive": ("glass",)}, {"endless_media": ("fog",)}, {"parameters": ("a", "b")},
    {"variant": "cuda_ad_rgb"}, {"variant": "metal_ad_rgb"},
]  # fmt: skip
"""What else may differ: each fact alone, at a limit and beside it."""


def list_plans(scenes: Iterator[tuple[SimpleNamespace, Settings]]) -> Iterator[float]:
    """All numbers of the plans, and those in their reasons."""
    for needs, settings in scenes:
        made = plan.make_plan(needs, settings)
        values = (value for name, value in vars(made).items() if name != "choices")
        for value in values:
            found = np.atleast_1d(np.array(sum(map(ord, value)) if isinstance(value, str) else value, dtype=object)).ravel()
            yield from (-1.0 if x is None else float(x) for x in found)
        for choice in made.choices:
            said = NUMBER.findall(f"{choice.choice} {choice.reason}")
            yield from (float(x.replace(",", "").rstrip(".")) for x in (*said, str(len(said))))


def by_medium() -> Iterator[float]:
    """Each medium alone, and with every other one."""
    alone = [(facts,) for facts in MEDIA.values()]
    pairs = [(MEDIA["fog"], facts) for facts in MEDIA.values()]
    return list_plans((scene(*media), settings) for media, settings in product(alone + pairs, SETTINGS))


def by_noise() -> Iterator[float]:
    """The noise that previews measured."""
    media = (MEDIA["fog"], MEDIA["glowing fog"], MEDIA["large"])
    return list_plans((scene(m, noise=noise, spp=spp), Settings(6)) for m, noise, spp in product(media, NOISE, (1, 8, 256)))


def by_limit() -> Iterator[float]:
    """One fact at a time."""
    media = (MEDIA["fog"], MEDIA["thin"], MEDIA["glowing fog"])
    given = product(media, LIMITS, (Settings(2), Settings(6)))
    return list_plans((scene(m, **more), settings) for m, more, settings in given)


def by_rays() -> Iterator[float]:
    """Paths of a baseline."""
    rays = [1, 7, 100, 1000, 4095, 4096, 12345, *(1 << k for k in range(13, 27))]
    return (float(derivatives.count_baseline_paths(n, has_table)) for n in rays for has_table in (False, True))


PLANS: dict[str, tuple[Callable[[], Iterator[float]], float]] = {
    "media": (by_medium, -221.1269846652),
    "noise": (by_noise, 90.8016426899),
    "limits": (by_limit, 2.3547124016),
    "paths of a baseline": (by_rays, -1.81897295049),
}
"""Scenes, and the sum of all numbers of their plans, each times a weight of its place."""


@pytest.mark.parametrize("name", PLANS)
def test_numbers_of_plans(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests are not checked, and the free memory is unknown."""
    for check in (key for key in vars(plan) if key.startswith("check_")):
        monkeypatch.setattr(plan, check, lambda *_: None)
    monkeypatch.setattr(plan, "free_memory", lambda: None)
    # The memory of a gradient has a copy for each thread, and processes of tests have different numbers of threads.
    monkeypatch.setattr(dr, "thread_count", lambda: 2)
    find, expected = PLANS[name]
    found = np.arcsinh(np.fromiter(find(), float))
    total = float(found @ np.cos(np.arange(found.size)))
    # Sums of float64, of which another processor may round each number by 1e-16; numbers of reasons are rounded to two digits.
    assert total == pytest.approx(expected, abs=1e-9 * found.size), found.size
