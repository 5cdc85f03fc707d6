"""The first values of the parameters of a scene fit, with their units and the places of their grids.

Conventions. Memory is checked before the allocation, for the first grids and for the refined grids of later events. ``length``
and ``radiance`` are the units of the scene; ``1`` is a pure number; "" is an unknown unit.
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
from mivol.scene_graph import traverse
from mivol.transport.media.medium_view import find_grid_place

NUMBER_BYTES = 6 * 4
"""Memory per fitted number [byte]: value, copy in the scene, optimized real, derivative and two moments of the optimizer."""


@dataclass(frozen=True)
class Start:
    """A parameter and its first value."""

    parameter: Parameter
    value: np.ndarray


def make_starts(settings: SceneExperiment, base: Path, scene: mi.Scene) -> list[Start]:
    """Return all parameters of a fit with their first values; the scene is not changed.

    Raises:
        MivolError: as :func:`make_start`, refined grids beyond the memory, or an upsample event without a grid.
    """
    starts = [make_start(entry, base, scene) for entry in settings.parameter]
    grids = [start for start in starts if start.value.ndim == GRID]
    if any(isinstance(event, Upsample) for event in settings.event):
        check_for_grids(len(grids))
    for start in grids:
        check_grid(start.parameter.name, final_shape(start.value.shape, settings), "let upsample refine less, or start coarser")
    return starts


def final_shape(shape: Sequence[int], settings: SceneExperiment) -> tuple[int, ...]:
    """Shape of a grid after all events of a fit."""
    factor, last = 1, settings.fit.iterations
    for event in settings.event:
        if isinstance(event, Upsample):
            factor *= event.factor ** sum(0 <= iteration < last for iteration in set(event.at))
    return (*(n * factor for n in shape[:3]), *shape[3:])


def check_grid(key: str, shape: Sequence[int], way_out: str) -> None:
    """Refuse a grid beyond the memory.

    Raises:
        MivolError: with its shape and size.
    """
    size = " x ".join(str(n) for n in shape)
    check_memory(NUMBER_BYTES * math.prod(shape), f"{key} of {size} numbers, with its derivative and the optimizer,", way_out)


def make_start(settings: Sought, base: Path, scene: mi.Scene) -> Start:
    """Return a parameter with its first value; the scene is not changed.

    Raises:
        MivolError: an unknown parameter, a value outside its domain, an unreadable file, or a grid beyond the memory.
    """
    params = traverse(scene)
    start_value = as_tensor(params[find(settings.key, params)])
    # A copy: the scene may give the memory behind a view to another tensor when its parameter changes.
    value = np.array(start_value)
    if start_value.ndim < GRID and (settings.shape or settings.start_file):
        raise MivolError(
            f"{settings.key} has the shape {start_value.shape}, which is not a grid of voxels: give start, but neither shape "
            "nor start_file."
        )
    if settings.start_file:
        value = read_volume(place_in(base, settings.start_file)).values
    elif settings.start is not None:
        shape = (*settings.shape, start_value.shape[3]) if settings.shape else start_value.shape
        check_grid(settings.key, shape, "give parameter.shape fewer voxels")
        value = np.full(shape, check_start(settings, shape), dtype=np.float32)
    extent = box_edges(grid_to_world(settings.key, scene))[::-1] if value.ndim >= GRID else (1.0, 1.0, 1.0)
    parameter = Parameter(settings.key, find_unit(settings), settings.domain, settings.map, settings.lr, extent, settings.prior)
    parameter.to_reals(mi.TensorXf(np.ascontiguousarray(value)))
    return Start(parameter, value)


def check_start(settings: Sought, shape: Sequence[int]) -> Any:
    """Return the first value in the settings: one number, or one number per channel.

    Raises:
        MivolError: another count of numbers.
    """
    given = np.size(settings.start)
    if given not in (1, shape[-1]):
        raise MivolError(f"{settings.key} starts from {given} numbers and has {shape[-1]} channels: give 1 or {shape[-1]}.")
    return settings.start


def grid_to_world(key: str, scene: mi.Scene) -> np.ndarray:
    """Transform (4, 4) from the unit cube to the world for the grid of a parameter."""
    return find_grid_place(traverse(scene).properties[key][2])


def box_edges(place: np.ndarray) -> tuple[float, float, float]:
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
"""Units by a word of the key. Mitsuba's extinction is ``scale`` times ``sigma_t``, its sky ``scale`` times ``data``: only one
factor has the unit."""


def find_unit(settings: Sought) -> str:
    """Unit of a parameter: the unit in the settings, else the unit of the last word of the key with an entry, else ""."""
    return settings.unit or next((UNITS[word] for word in reversed(settings.key.split(".")) if word in UNITS), "")
