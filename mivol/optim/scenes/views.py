"""Views of a scene, rendered several at a time, with independent seeds.

Conventions. A :class:`View` is a sensor with a reference image (height, width, channels). A :class:`RenderBatch` renders one
view or several views side by side (Mitsuba's ``batch`` sensor). Tracing and launching a kernel costs as much for one small view
as for twenty. Only views with a box filter are put side by side, since each sample counts for a single pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError

PRIMAL, ADJOINT, HELD_OUT, FINAL = range(4)
"""Purposes of seeds: an image of a fit, its derivative, an evaluation, a final image."""


def derive_seed(*key: int) -> int:
    """A 32-bit seed from integers. SeedSequence makes the seeds of similar keys independent."""
    # An array of words is taken as it is; numbers would be converted one by one.
    words = np.array(key, np.uint32) if max(key) < 1 << 32 else key
    return int(np.random.SeedSequence(words).generate_state(1)[0])


@with_short_repr
@dataclass(frozen=True)
class View:
    """A sensor and a reference image.

    Attributes:
        name: for messages and file names.
        sensor: a Mitsuba sensor.
        reference: (height, width, channels), radiance.
    """

    name: str
    sensor: mi.Sensor
    reference: mi.TensorXf


@with_short_repr
@dataclass(frozen=True)
class RenderBatch:
    """A render of one or several views.

    Attributes:
        sensor: sensor of a view, or a batch.
        reference: (height, n width, channels).
        n_views: number of views side by side.
    """

    sensor: mi.Sensor
    reference: mi.TensorXf
    n_views: int


def count_pixels(sensor: mi.Sensor) -> int:
    """Number of pixels of a sensor's image."""
    return math.prod(int(n) for n in sensor.film().crop_size())


def check_views(views: Sequence[View]) -> None:
    """Check sizes and values of views.

    Raises:
        MivolError: no views, different sizes, a reference of another size than the sensor, or not finite.
    """
    if not views:
        raise MivolError("found no views to fit: give at least one sensor with a reference.")
    check_image_sizes({view.name: view.sensor for view in views})
    for view in views:
        width, height = (int(n) for n in view.sensor.film().crop_size())
        if view.reference.ndim != 3 or tuple(view.reference.shape[:2]) != (height, width):
            raise MivolError(
                f'the reference of view "{view.name}" has shape {tuple(view.reference.shape)}, its sensor '
                f"{width} x {height} pixels: give references of the sensor's size."
            )
        bad = np.argwhere(~np.isfinite(np.asarray(view.reference)))
        if len(bad):
            raise MivolError(
                f'the reference of view "{view.name}" is not finite at pixel (row {bad[0][0]}, column {bad[0][1]}): '
                "mask or repair it."
            )


def remove_alpha(view: View) -> View:
    """A view whose reference has colours only, where its film and its reference have alpha."""
    alpha = has_alpha(view.sensor) and view.reference.shape[2] in (2, 4)
    return replace(view, reference=drop_alpha(view.reference, view.sensor)) if alpha else view


def check_image_sizes(sensors: Mapping[str, mi.Sensor]) -> None:
    """Check for equal image sizes of sensors, by name.

    Raises:
        MivolError: different sizes, with both.
    """
    sizes = {name: " x ".join(str(int(n)) for n in sensor.film().crop_size()) for name, sensor in sensors.items()}
    (first, size), *others = sizes.items()
    for name, other in others:
        if other != size:
            raise MivolError(f'view "{name}" is {other} pixels and view "{first}" {size}: give all views one size.')


def has_alpha(sensor: mi.Sensor) -> bool:
    """Whether the last channel of a sensor's images is their alpha, which a fit does not compare."""
    return bool(mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha))


def drop_alpha(image: mi.TensorXf, sensor: mi.Sensor) -> mi.TensorXf:
    """The colours of a sensor's image (height, width, channels)."""
    return image[:, :, :-1] if has_alpha(sensor) else image


def add_alpha(adjoint: mi.TensorXf, sensor: mi.Sensor) -> mi.TensorXf:
    """The adjoint of a sensor's whole image, for the adjoint of its colours: alpha has the adjoint 0."""
    if not has_alpha(sensor):
        return adjoint
    return dr.concat([adjoint, dr.zeros(mi.TensorXf, (*adjoint.shape[:2], 1))], axis=2)


def make_single_batches(views: Sequence[View]) -> list[RenderBatch]:
    """A render for each view."""
    return [RenderBatch(view.sensor, view.reference, 1) for view in views]


def make_batches(views: Sequence[View], max_pixels: int) -> list[RenderBatch]:
    """The smallest number of renders with at most ``max_pixels`` pixels each, in the order of the views."""
    together = max(max_pixels // count_pixels(views[0].sensor), 1)
    if together == 1 or len(views) == 1 or not all(can_be_batched(view) for view in views):
        return make_single_batches(views)
    return [join_views(views[first : first + together]) for first in range(0, len(views), together)]


def can_be_batched(view: View) -> bool:
    """Whether a view's samples count for the view's pixels only, and the camera is in no medium."""
    film = view.sensor.film()
    whole = all(int(a) == int(b) for a, b in zip(film.crop_size(), film.size(), strict=True))
    plain = film.class_name() == "HDRFilm" and film.rfilter().is_box_filter()
    return whole and plain and view.reference.shape[2] in (1, 3) and view.sensor.get_medium() is None


def join_views(views: Sequence[View]) -> RenderBatch:
    """A render of several views, from left to right."""
    height, width, channels = views[0].reference.shape
    film = {
        "type": "hdrfilm",
        "width": width * len(views),
        "height": height,
        "pixel_format": "rgb" if channels == 3 else "luminance",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    sensors = {f"view_{number:04d}": view.sensor for number, view in enumerate(views)}
    sampler = {"type": "independent"}
    batch = mi.load_dict({"type": "batch", **sensors, "film": film, "sampler": sampler}, parallel=False)
    reference = np.concatenate([np.asarray(view.reference) for view in views], axis=1)
    return RenderBatch(batch, mi.TensorXf(np.ascontiguousarray(reference)), len(views))
