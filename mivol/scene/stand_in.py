"""One camera in the place of all cameras of a kind: Dr.Jit then records one render for all cameras.

Dr.Jit 1.5 finds the arrays of every plugin in memory, and records anew if other plugins share arrays with the inputs. A render
through another camera of the scene changes the shared arrays. The stand-in is a separate camera with the numbers of the
camera to render. Other sensors (``radiancemeter``, ``irradiancemeter``, ``distant``, a ``batch`` of several kinds) are sampled
before the render, and their stand-in is a film and a sampler alone.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi

from mivol.scene_graph import find_children, traverse

RECORDED_FILM = "HDRFilm"
"""The film that can be recorded."""

FOUND_SENSOR = "PerspectiveCamera"
"""The sensor whose arrays Dr.Jit finds. Mitsuba 3.9.1 shows Dr.Jit the arrays of no other camera but ``batch``."""

ARRAYS = {
    FOUND_SENSOR: ("x_fov", "principal_point_offset_x", "principal_point_offset_y"),
    "OrthographicCamera": (),
    "ThinLensCamera": ("x_fov", "aperture_radius", "focus_distance"),
}
"""Classes of cameras whose stand-in samples rays, with the names of their parameters that are arrays, besides ``to_world``."""

FORMATS = {
    "y": "luminance",
    "ya": "luminance_alpha",
    "rgb": "rgb",
    "rgba": "rgba",
    "xyz": "xyz",
    "xyza": "xyza",
}
"""Names of pixel formats of ``hdrfilm``, by the names that ``hdrfilm`` prints."""

NUMBERS = ("near_clip", "far_clip", "shutter_open", "shutter_open_time")


def describe_kind(sensor: mi.Sensor) -> str | None:
    """The common properties of sensors with the same stand-in; None if a sensor has no stand-in."""
    film, sampler, name = sensor.film(), sensor.sampler(), sensor.class_name()
    is_plain = film.class_name() == RECORDED_FILM and sampler.class_name() == "IndependentSampler"
    if not is_plain or sensor.get_medium() is not None or (is_found(sensor) and name != FOUND_SENSOR):
        return None
    # Constants of a camera in Python; parameters of a perspective camera.
    times = f"{sensor.shutter_open()} {sensor.shutter_open_time()} {sensor.needs_aperture_sample()}"
    times = "" if name == FOUND_SENSOR else times
    return f"{name}{times}{film}{sampler.sample_count()}" if _pixel_format(film) in FORMATS else None


def is_found(sensor: mi.Sensor) -> bool:
    """Whether Dr.Jit finds all arrays of a sensor: of a perspective camera, and of a ``batch`` of perspective cameras."""
    views = [sensor] if sensor.class_name() != "BatchSensor" else find_children(sensor).values()
    return {view.class_name() for view in views if isinstance(view, mi.Sensor)} == {FOUND_SENSOR}


def _pixel_format(film: mi.Film) -> str:
    found = re.search(r"pixel_format = (\w+)", str(film))
    return found.group(1) if found else ""


def reset_sampler(sensor: mi.Sensor) -> None:
    """Seed a sampler of several lanes: no task reads the numbers of the sampler, but recordings have inputs for the numbers."""
    if sensor.sampler().wavefront_size() != 1:
        sensor.sampler().seed(dr.opaque(mi.UInt32, 0), 1)


def evaluate_samplers() -> None:
    """Evaluate the numbers of all cameras' samplers in memory, one camera at a time. Call it before a new scene is recorded.

    The ``render`` of a stock integrator leaves these numbers unevaluated, as outputs of the whole rendering loop. A recording
    evaluates the arrays of all cameras in one kernel. Two loops in one kernel end the process inside Dr.Jit 1.5 if one of them
    was traced while there was one shape, and the other for several (:mod:`mivol.kernel_recording` says why).
    """
    for number in itertools.count(1):
        try:
            sensor = dr.reinterpret_array(mi.SensorPtr, mi.UInt32(number))[0]
        except RuntimeError:  # after the last camera
            return
        if sensor is not None:
            sensor.sampler().schedule_state()
            dr.eval()


def _has_no_image(film: mi.Film) -> bool:
    """Whether nothing was put on a film since it was made or cleared."""
    try:
        return film.develop(raw=True).array.state == dr.VarState.Literal
    except RuntimeError:
        return True


MAX_CAMERAS = 256
"""Most cameras whose numbers a stand-in keeps."""

MET_PIXELS = 1 << 22
"""Most pixels of films that get an image before their first render."""


@dataclass(frozen=True)
class _CameraCopy:
    """The numbers of a camera, in arrays of their own: shared arrays would tell the cameras apart.

    Attributes:
        lens: all numbers but the place.
        arrays: the parameters that are arrays, by name, without the place.
        matrices: matrix and inverse transpose of the place.
        held: the arrays of the camera. Dr.Jit would give the index of a freed array to another array.
    """

    lens: list[float]
    arrays: dict[str, mi.Float]
    matrices: list[mi.Matrix4f]
    held: list[Any]

    @classmethod
    def of(cls, numbers: list[float], names: Sequence[str], held: list[Any]) -> _CameraCopy:
        """Copy a camera: ``NUMBERS``, and arrays of these names followed by the two matrices."""
        is_own = dr.opaque(mi.Bool, True)
        arrays = {name: dr.select(is_own, array, 0) for name, array in zip(names, held[:-2], strict=True)}
        matrices = [dr.unravel(type(matrix), dr.select(is_own, dr.ravel(matrix), 0)) for matrix in held[-2:]]
        dr.eval(arrays, matrices)
        return cls([*numbers, *(float(array[0]) for array in arrays.values())], arrays, matrices, held)


class StandIn:
    """A camera in the place of other cameras.

    Args:
        sensor: a camera with a kind (:func:`describe_kind`).

    Attributes:
        camera: the camera to render.
        takes_rays: whether the camera gives a film and a sampler alone, and the rays are sampled before the render.
    """

    _known: ClassVar[WeakValueDictionary[tuple[str, str], StandIn]] = WeakValueDictionary()

    @classmethod
    def find(cls, sensor: mi.Sensor, kind: str) -> StandIn:
        """The stand-in of a camera of a kind (:func:`describe_kind`), shared by all integrators."""
        known = cls._known.get((mi.variant(), kind))
        if known is None:
            known = cls._known[mi.variant(), kind] = cls(sensor)
        return known

    def __init__(self, sensor: mi.Sensor) -> None:
        film = sensor.film()
        size, crop, offset = (tuple(int(n) for n in pair) for pair in (film.size(), film.crop_size(), film.crop_offset()))
        own = {
            **dict(zip(("width", "height", "crop_width", "crop_height"), (*size, *crop), strict=True)),
            **dict(zip(("crop_offset_x", "crop_offset_y"), offset, strict=True)),
            "pixel_format": FORMATS[_pixel_format(film)],
            "component_format": re.search(r"component_format = (\w+)", str(film)).group(1),
            "sample_border": film.sample_border(),
            "rfilter": film.rfilter(),
        }
        sampler = {"type": "independent", "sample_count": sensor.sampler().sample_count()}
        parts = {"film": {"type": "hdrfilm", **own}, "sampler": sampler}
        self._is_found = sensor.class_name() == FOUND_SENSOR
        self.takes_rays = sensor.class_name() not in ARRAYS
        if self._is_found:
            self.camera = mi.load_dict({"type": "perspective", **parts}, parallel=False)
            self._params = traverse(self.camera)
        else:
            opened, closed = sensor.shutter_open(), sensor.shutter_open() + sensor.shutter_open_time()
            parts |= {"shutter_open": opened, "shutter_close": closed, "on_lens": sensor.needs_aperture_sample()}
            self.camera = mi.load_dict({"type": "mivol_copied_camera", **parts}, parallel=False)
            if self.takes_rays:
                # A batch calls all sensors of the process in one function.
                self.camera.to_world = mi.Matrix4f(1)
                self.camera.take_lens(dr.opaque(mi.Float, 1), dr.opaque(mi.Float, 2))
        self._shown: tuple | None = None
        self._seen: tuple[int, list] | None = None
        self._lens: list[float] | None = None
        self._copies: dict[tuple, _CameraCopy] = {}
        self._met: set[int] = set()

    def show(self, sensor: mi.Sensor, state: list) -> None:
        """Take the numbers of a camera of the kind, unless it was shown last in the same state of its parameters."""
        if not self.takes_rays and self._seen != (sensor.ptr, state):
            self._take_numbers(sensor)
            self._seen = sensor.ptr, state

    def _take_numbers(self, sensor: mi.Sensor) -> None:
        given = traverse(sensor)
        numbers, names = [given[name] for name in NUMBERS], ARRAYS[sensor.class_name()]
        arrays = [*(given[name] for name in names), given["to_world"].matrix, given["to_world"].inverse_transpose]
        key = (*numbers, *dr.detail.collect_indices(arrays))
        if key == self._shown:
            return
        if key not in self._copies:
            self._copies = dict(list(self._copies.items())[1 - MAX_CAMERAS :])
            self._copies[key] = _CameraCopy.of(numbers, names, dr.detach(arrays))
        copy = self._copies[key]
        has_other_lens = copy.lens != self._lens
        if self._is_found:
            self._params["to_world"] = type(given["to_world"])(*copy.matrices)
            # An update makes 115 launches, and waits for each of 79 numbers.
            if has_other_lens:
                for name, value in (dict(zip(NUMBERS, numbers, strict=True)) | copy.arrays).items():
                    self._params[name] = value
                self._params.update()
        else:
            self.camera.to_world = copy.matrices[0]
            if has_other_lens:
                self.camera.take_lens(*(dr.opaque(mi.Float, number) for number in numbers[:2]), **copy.arrays)
        self._shown, self._lens = key, copy.lens

    def meet(self, sensor: mi.Sensor, others: Sequence[mi.Sensor], names: list[str]) -> None:
        """Give an image to films without an image, and numbers to the samplers of the cameras, as a render would do.

        Dr.Jit finds the arrays of all cameras in memory, and records anew for one more.

        Args:
            sensor: the camera to render.
            others: cameras to be rendered perhaps; cameras of the same kind are met as well.
            names: of the AOVs.
        """
        if sensor.ptr in self._met and not _has_no_image(sensor.film()):
            return
        self._met.discard(sensor.ptr)
        kind = describe_kind(sensor)
        new = [one for one in (sensor, *others) if one.ptr not in self._met and describe_kind(one) == kind]
        if len(new) * math.prod(int(n) for n in self.camera.film().crop_size()) > MET_PIXELS:
            new = new[:1]
        for sensor in new:
            self._met.add(sensor.ptr)
            reset_sampler(sensor)
            if _has_no_image(sensor.film()):
                film, channels = sensor.film(), sensor.film().prepare(names)
                width, height = (int(n) for n in film.crop_size())
                black = mi.TensorXf(dr.opaque(mi.Float, 0, width * height * channels), (height, width, channels))
                film.put_block(mi.ImageBlock(black, film.crop_offset(), None, False))

    def give_film(self, sensor: mi.Sensor, names: list[str]) -> None:
        """Put the image on the film of a camera; ``names`` of the AOVs."""
        film = sensor.film()
        film.prepare(names)
        film.put_block(mi.ImageBlock(self.camera.film().develop(raw=True), film.crop_offset(), None, False))
