"""The true volume of an experiment, and the scene while it holds it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.config import Experiment
from mivol.errors import MivolError
from mivol.fields.procedural import make_procedural
from mivol.files import read_volume
from mivol.files.fetch import resolve_path
from mivol.machine import check_fits
from mivol.optim.parameters import find, like

VOXEL_BYTES = 9 * 8
"""Of a procedural volume while it is made: its places twice, and three numbers that are made of them, in float64."""


def make_truth(chosen: Experiment, base: Path, scene: mi.Scene) -> np.ndarray | None:
    """The true volume (Z, Y, X, C), where the experiment knows one.

    Raises:
        MivolError: its key is not in the scene, its file cannot be read, or it does not fit into memory.
    """
    if chosen.truth is None:
        return None
    find(chosen.truth.key, mi.traverse(scene))
    if chosen.truth.file:
        return read_volume(resolve_path(base, chosen.truth.file)).values
    wanted = chosen.truth
    said = " x ".join(str(n) for n in wanted.shape)
    check_fits(VOXEL_BYTES * math.prod(wanted.shape), f"a truth of {said} voxels", "give truth.shape fewer voxels")
    return make_procedural(wanted.procedural, wanted.shape, wanted.seed, wanted.peak)


def check_truth(chosen: Experiment) -> None:
    """Refuse a truth of a parameter that is not fitted: references would show it, and renders what the scene holds.

    Raises:
        MivolError: with its key.
    """
    if chosen.truth is not None and chosen.truth.key not in [sought.key for sought in chosen.parameter]:
        raise MivolError(
            f"truth.key is {chosen.truth.key}, which is no parameter of the fit, so the references would show another volume "
            "than the renders: look for it too, or put what is known into the scene (scene.define) and take the truth out."
        )


@contextmanager
def holding(scene: mi.Scene, key: str, values: np.ndarray) -> Iterator[None]:
    """The scene with other values of one parameter, for a while."""
    params = mi.traverse(scene)
    before = type(params[key])(params[key])
    put(params, key, values)
    try:
        yield
    finally:
        params[key] = before
        params.update()


def put(params: mi.SceneParameters, key: str, values: np.ndarray) -> None:
    """Set a parameter, in the type that the scene gives it."""
    params[key] = like(mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32)), params[key])
    params.update()
