"""Where a fit of a scene begins: the first value of each parameter, and the place of its grid.

Conventions. Memory is counted before any of it is taken: of the first grids, and of those that events refine them to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mivol.config import SceneExperiment, Sought
from mivol.errors import MivolError
from mivol.files import read_volume
from mivol.files.fetch import resolve_path as place_in
from mivol.machine import check_memory
from mivol.optim.events import Upsample, check_for_grids
from mivol.optim.parameters import GRID, Parameter, as_tensor, find
from mivol.transport.media.medium_view import find_grid_place

NUMBER_BYTES = 6 * 4
"""Of each number that is looked for: value, the scene's copy, real, derivative and two moments of the optimiser."""


@dataclass(frozen=True)
class Start:
    """A parameter and its first value."""

    parameter: Parameter
    value: np.ndarray


def make_starts(chosen: SceneExperiment, base: Path, scene: mi.Scene) -> list[Start]:
    """All parameters of a fit and where they start; the scene is not changed.

    Raises:
        MivolError: as :func:`make_start`, grids that will be refined beyond the memory, or none that could be refined.
    """
    starts = [make_start(sought, base, scene) for sought in chosen.parameter]
    grids = [start for start in starts if start.value.ndim == GRID]
    if any(isinstance(event, Upsample) for event in chosen.event):
        check_for_grids(len(grids))
    for start in grids:
        check_grid(start.parameter.name, refined(start.value.shape, chosen), "let upsample refine less, or start coarser")
    return starts


def refined(shape: Sequence[int], chosen: SceneExperiment) -> tuple[int, ...]:
    """The shape of a grid after all events of a fit."""
    factor, last = 1, chosen.fit.iterations
    for event in chosen.event:
        if isinstance(event, Upsample):
            factor *= event.factor ** sum(0 <= iteration < last for iteration in set(event.at))
    return (*(n * factor for n in shape[:3]), *shape[3:])


def check_grid(key: str, shape: Sequence[int], way_out: str) -> None:
    """Refuse a grid with which a fit would not fit into memory.

    Raises:
        MivolError: with its shape and what it takes.
    """
    said = " x ".join(str(n) for n in shape)
    check_memory(NUMBER_BYTES * math.prod(shape), f"{key} of {said} numbers, with its derivative and the optimiser,", way_out)


def make_start(sought: Sought, base: Path, scene: mi.Scene) -> Start:
    """A parameter and where it starts; the scene is not changed.

    Raises:
        MivolError: no such parameter, a start outside its domain, a file that cannot be read, or a grid beyond the memory.
    """
    params = mi.traverse(scene)
    now = as_tensor(params[find(sought.key, params)])
    # A copy: the scene may give the memory behind a view to another tensor when its parameter changes.
    value = np.array(now)
    if now.ndim < GRID and (sought.shape or sought.start_file):
        raise MivolError(
            f"{sought.key} is no grid of voxels but has the shape {now.shape}: give start, and neither shape nor start_file."
        )
    if sought.start_file:
        value = read_volume(place_in(base, sought.start_file)).values
    elif sought.start is not None:
        shape = (*sought.shape, now.shape[3]) if sought.shape else now.shape
        check_grid(sought.key, shape, "give parameter.shape fewer voxels")
        value = np.full(shape, start_of(sought, shape), dtype=np.float32)
    extent = edges_of(place_of(sought.key, scene))[::-1] if value.ndim >= GRID else (1.0, 1.0, 1.0)
    parameter = Parameter(sought.key, unit_of(sought), sought.domain, sought.map, sought.lr, extent, sought.prior)
    parameter.to_reals(mi.TensorXf(np.ascontiguousarray(value)))
    return Start(parameter, value)


def start_of(sought: Sought, shape: Sequence[int]) -> Any:
    """The start that the experiment gives: one number, or one for each of the last axis.

    Raises:
        MivolError: another count of numbers.
    """
    given = np.size(sought.start)
    if given not in (1, shape[-1]):
        raise MivolError(f"{sought.key} starts from {given} numbers and has {shape[-1]}: give one for all, or one for each.")
    return sought.start


def place_of(key: str, scene: mi.Scene) -> np.ndarray:
    """Where the grid of a parameter lies: the (4, 4) map of the unit cube to the world."""
    return find_grid_place(mi.traverse(scene).properties[key][2])


def edges_of(place: np.ndarray) -> tuple[float, float, float]:
    """Lengths (x, y, z) of the edges of a grid's box."""
    return tuple(float(edge) for edge in np.linalg.norm(place[:3, :3], axis=0))


UNITS = {
    "sigma_t": "1/length",
    "sigma_a": "1/length",
    "sigma_s": "1/length",
    "albedo": "1",
    "g": "1",
    "position": "length",
    "radiance": "radiance",
    "irradiance": "radiance sr",
    "intensity": "radiance length²",
    "reflectance": "1",
    "alpha": "1",
    "scale": "1",
}
"""By the words of a key of ``mi.traverse(scene)``. Mitsuba's extinction is ``scale`` times ``sigma_t``, its sky ``scale`` times
``data``: one of the two has the unit."""


def unit_of(sought: Sought) -> str:
    """The unit of a parameter: the experiment's, else that of the last word of the key that has one, else ""."""
    return sought.unit or next((UNITS[word] for word in reversed(sought.key.split(".")) if word in UNITS), "")
