"""Random scenes by mivol and by Mitsuba's ``volpath``: are the means the same, and is every sample a radiance?"""

from __future__ import annotations

import gc
import re
from collections import Counter
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.agreement import compare_means, mean_of_rounds
from mivol.bench.harness.bars import say
from mivol.bench.studies.random_scenes.generate import RandomScene, draw_scene
from mivol.errors import MivolError

__all__ = ["Size", "try_scene", "try_scenes"]

PLACES = 12
"""Means of a scene that are compared: of each quarter of the picture, in each colour."""


@dataclass(frozen=True)
class Size:
    """How much work is done.

    Attributes:
        name: for the JSON.
        scenes: how many.
        first: seed of the first one.
        rounds: pictures of each, with seeds of their own.
        spp: samples a pixel of a picture by mivol.
        stock_spp: and by volpath.
        hard_pictures: pictures of 1024 x 1024 paths of each hard scene.
    """

    name: str = "full"
    scenes: int = 300
    first: int = 0
    rounds: int = 16
    spp: int = 64
    stock_spp: int = 64
    hard_pictures: int = 16


def try_scenes(size: Size) -> dict:
    """Are the means of random scenes those of volpath, and is every pixel a radiance?"""
    trials, refused = {}, Counter()
    for seed in range(size.first, size.first + size.scenes):
        trials[seed] = found = try_scene(seed, size)
        refused.update(found.get("refused", []))
        say(f"  scene {seed}: {said(found)}")
        gc.collect()
        dr.flush_malloc_cache()
    return {"scenes": size.scenes, "refusals": dict(refused), "trials": trials}


def try_scene(seed: int, size: Size) -> dict:
    """One scene: z of what differs most, pixels that are no radiance, or why it was refused."""
    drawn = draw_scene(seed)
    answer: dict = {"features": drawn.features}
    try:
        ours = _pictures(drawn, "mivol", size.rounds, size.spp)
    except MivolError as error:
        return answer | {"refused": [re.sub(r"[\d.]+", "#", str(error))]}
    answer["not_a_radiance"] = int(np.sum(~(np.isfinite(ours) & (ours >= 0))))
    if drawn.is_rgb:
        grey = [_pictures(draw_scene(seed, c), "volpath", size.rounds, size.stock_spp)[..., c] for c in range(3)]
        theirs = np.stack(grey, axis=-1)
    else:
        theirs = _pictures(drawn, "volpath", size.rounds, size.stock_spp)
    found = [
        compare_means(mean_of_rounds(a), mean_of_rounds(b), PLACES * size.scenes)
        for a, b in zip(_places(ours), _places(theirs), strict=True)
    ]
    worst = max(found, key=lambda f: np.inf if f["z"] is None else abs(f["z"]) / f["z_bound"])
    return answer | {"mean": float(theirs.mean()), **worst}


def _places(pictures: np.ndarray) -> np.ndarray:
    """Means (place, rounds) of the quarters of pictures (rounds, height, width, 3)."""
    h, w = (n // 2 for n in pictures.shape[1:3])
    quarters = [pictures[:, y : y + h, x : x + w].mean(axis=(1, 2)) for y in (0, h) for x in (0, w)]
    return np.concatenate([q.T for q in quarters])


def _pictures(drawn: RandomScene, name: str, rounds: int, spp: int) -> np.ndarray:
    """Pictures (rounds, height, width, 3), with seeds of their own."""
    scene = mi.load_dict(drawn.parts)
    integrator = mi.load_dict({"type": name, **drawn.settings})
    first = 1000 if name == "mivol" else 5000
    pictures = (mi.render(scene, integrator=integrator, spp=spp, seed=first + k) for k in range(rounds))
    return np.array([np.array(picture, np.float64) for picture in pictures])


def said(found: dict) -> str:
    """One line on a scene."""
    what = ", ".join(found["features"])
    if "refused" in found:
        return f"refused ({found['refused'][0]}): {what}"
    z = "none" if found["z"] is None else f"{found['z']:+.1f} of {found['z_bound']:.1f}"
    bad = f", {found['not_a_radiance']} pixels are no radiance" if found["not_a_radiance"] else ""
    return f"z {z}{bad}: {what}"
