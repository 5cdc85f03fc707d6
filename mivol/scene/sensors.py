"""Mitsuba's sensors: found by number, checked against memory, converted to and from cameras of photographs; named rigs of them.

Conventions. Mitsuba's camera has x to the left in the image, y up and z into the scene. Its principal point offset is a
fraction of the film, positive for an optical axis left of (above) the middle of the image. Pixels are square.

Rigs. A rig makes a list of sensors about a box (2, 3) [low, high] in world units. ``distance`` counts radii of the sphere
around the box, so the same TOML serves scenes of every size. Angles are in degrees. Azimuth turns about ``up`` from the next
axis in the cycle x, y, z towards the axis after it (y up: from z to x); elevation rises from the horizon towards ``up``. A rig
is a frozen struct whose tag is its name in a TOML file: ``rig = "ring"``.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import mitsuba as mi
import msgspec
import numpy as np

from mivol.back_end import check_memory
from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos import Camera, intrinsics
from mivol.photos.camera import PIXELS_LOST
from mivol.scene_graph import traverse

FILM_NUMBERS = 5
"""Numbers summed by a film for each pixel: red, green, blue, alpha and the weight of the filter."""

PIXEL_BYTES = 4 * (FILM_NUMBERS + 4)
"""Memory of a rendered image per pixel [byte]: the sums and the developed image."""

SMALL_FILM = 1 << 24
"""Memory of a film [byte] up to which it is not compared with the free memory."""

MOST_ENTRIES = 2**32
"""Limit of Dr.Jit, which counts entries of an array in 32 bits."""


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """Find a sensor of the scene by number; a given sensor is returned unchanged.

    Raises:
        MivolError: no sensor with the number, or an object of another type.
    """
    if isinstance(sensor, mi.Sensor):
        return sensor
    if not isinstance(sensor, int | np.integer):
        raise MivolError(f"found {type(sensor).__name__}, expected a sensor or its number in the scene, from 0 on.")
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise MivolError(f"the scene has no sensor {sensor}, only {len(sensors)} of them; count from 0, or add one.")
    return sensors[sensor]


def check_film(sensor: mi.Sensor, kept: int = 0) -> None:
    """Refuse a film larger than the memory or than an array, before a render.

    Args:
        sensor: the sensor; the crop of its film counts.
        kept: memory kept by the caller besides the image [byte per pixel].

    Raises:
        MivolError: a film that does not fit; the sentence names its size.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    # Asking for the free memory takes half of the time of a recorded render.
    needed = (PIXEL_BYTES + kept) * width * height
    if needed < SMALL_FILM:
        return
    what, way_out = f"a film of {width} x {height} pixels", "give it fewer pixels, or render it in crops"
    check_memory(needed, what, way_out, on_gpu=PIXEL_BYTES * width * height)
    if FILM_NUMBERS * width * height >= MOST_ENTRIES:
        raise MivolError(f"{what} has more numbers than Dr.Jit can count in one array (2^32): {way_out}.")


AXES = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Mitsuba's camera axes in the axes of :class:`mivol.photos.Camera`."""


def to_sensor(camera: Camera, near_far: tuple[float, float] = (1e-2, 1e4), *, pixel_format: str = "rgb") -> dict:
    """Convert a camera to a perspective sensor with a box filter, for ``mitsuba.load_dict``.

    Args:
        camera: a pinhole with square pixels (see :func:`mivol.photos.rectify`).
        near_far: clipping distances [length].
        pixel_format: pixel format of the film.

    Raises:
        MivolError: lens distortion, or pixels that are not square; Mitsuba has no such camera.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.K
    if camera.distortion or abs(fx / fy - 1) * max(camera.size) / 2 > PIXELS_LOST:
        way = "cut pinholes out of it" if camera.distortion.is_wide else "resample it with mivol.photos.rectify"
        found = "a lens with distortion" if camera.distortion else f"focal lengths {fx:.6g} and {fy:.6g}"
        raise refusal(camera.name, found, "a pinhole with square pixels", way)
    width, height = camera.size
    return {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(width / 2 / fx)),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - cx / width,
        "principal_point_offset_y": 0.5 - cy / height,
        "near_clip": near_far[0],
        "far_clip": near_far[1],
        "to_world": mi.ScalarTransform4f(camera.to_world @ AXES),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": pixel_format,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def to_camera(sensor: mi.Sensor, name: str = "sensor") -> Camera:
    """Convert a perspective sensor to a camera. For a cropped film the camera sees the crop.

    Raises:
        MivolError: another kind of sensor.
    """
    if sensor.class_name() != "PerspectiveCamera":
        raise refusal(name, f"a {sensor.class_name()}", "a perspective sensor", "photographs have pinhole cameras")
    params = traverse(sensor)
    film = sensor.film()
    full, crop, size = (np.array(v, float).ravel() for v in (film.size(), film.crop_offset(), film.crop_size()))
    offset = np.array([_number(params[f"principal_point_offset_{axis}"]) for axis in "xy"])
    f = full[0] / 2 / math.tan(math.radians(_number(params["x_fov"])) / 2)
    cx, cy = full * (0.5 - offset) - crop
    pose = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    return Camera(intrinsics(f, f, cx, cy), (int(size[0]), int(size[1])), pose @ AXES, name=name)


def _number(value: object) -> float:
    return float(np.array(value).ravel()[0])


# -- Rigs -------------------------------------------------------------------------------------------------------------------


Vector = tuple[float, float, float]


def _setting(unit: str, meaning: str, **domain: float) -> msgspec.Meta:
    return msgspec.Meta(description=meaning, extra={"unit": unit}, **domain)


Pixels = Annotated[int, _setting("pixel", "edge of the image", ge=1, le=65536)]
UpAxis = Annotated[Literal["x", "y", "z"], _setting("1", "axis of the world that points up")]
ViewCount = Annotated[int, _setting("1", "number of views", ge=1, le=65536)]
Degrees = Annotated[float, _setting("degree", "angle of the first camera around the object")]


class Rig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="rig"):
    """A way to place cameras."""

    def sensors(self, scene: mi.Scene) -> list[dict | mi.Sensor]:
        """Make a sensor for each view: dicts for ``mitsuba.load_dict``, or existing sensors of the scene."""
        raise NotImplementedError


class PlacedRig(Rig, frozen=True, kw_only=True):
    """Settings shared by all rigs of perspective cameras.

    With ``fov`` 0 the sphere around the box just fits the shorter side of the image.
    """

    fov: Annotated[float, _setting("degree", "field of view of the shorter side; 0: fit the box", ge=0, lt=180)] = 0.0
    width: Pixels = 64
    height: Pixels = 64
    rfilter: Annotated[str, _setting("1", "Mitsuba's reconstruction filter", min_length=1)] = "box"
    near: Annotated[float, _setting("length", "near clipping distance", gt=0)] = 1e-2
    far: Annotated[float, _setting("length", "far clipping distance", gt=0)] = 1e4

    def __post_init__(self) -> None:
        if self.near >= self.far:
            raise ValueError(f"near = {self.near} is not below far = {self.far}")

    def poses(self, center: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """(origin, target, up) of each camera about the sphere around the box."""
        raise NotImplementedError

    def sensors(self, scene: mi.Scene) -> list[dict | mi.Sensor]:
        """Make perspective cameras about the scene's media, or about the whole scene without media."""
        return self.sensors_about(find_media_box(scene))

    def sensors_about(self, box: np.ndarray) -> list[dict]:
        """Make perspective cameras about a box.

        Args:
            box: (2, 3) low and high corner [length].

        Raises:
            MivolError: an empty or infinite box, or a camera that looks at its own position.
        """
        center, radius = _bounding_sphere(box)
        return [self._sensor(*pose, radius) for pose in self.poses(center, radius)]

    def _sensor(self, origin: np.ndarray, target: np.ndarray, up: np.ndarray, radius: float) -> dict:
        return {
            "type": "perspective",
            "fov": self.fov or _fitting_fov(radius, float(np.linalg.norm(target - origin))),
            "fov_axis": "smaller",
            "near_clip": self.near,
            "far_clip": self.far,
            "to_world": mi.ScalarTransform4f(look_at(origin, target, up)),
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "pixel_format": "luminance" if "mono" in (mi.variant() or "") else "rgb",
                "component_format": "float32",
                "rfilter": {"type": self.rfilter},
            },
            "sampler": {"type": "independent"},
        }


class Ring(PlacedRig, frozen=True, tag="ring"):
    """Cameras on a circle about the ``up`` axis, looking at the middle of the box.

    A full circle (``arc`` 360) has ``count`` equal steps and does not repeat the first camera. A shorter arc has a camera at
    both ends.
    """

    count: ViewCount = 8
    distance: Annotated[float, _setting("radius of the box", "camera to middle", gt=1)] = 4.0
    elevation: Annotated[float, _setting("degree", "height above the horizon", ge=-90, le=90)] = 0.0
    start: Degrees = 0.0
    arc: Annotated[float, _setting("degree", "angle that the cameras span around the object", gt=0, le=360)] = 360.0
    up: UpAxis = "y"

    def poses(self, center: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Equal steps of azimuth at the same elevation."""
        steps = self.count if self.arc == 360 else max(self.count - 1, 1)
        for azimuth in self.start + self.arc * np.arange(self.count) / steps:
            direction = _direction(azimuth, np.sin(np.radians(self.elevation)), self.up)
            yield center + self.distance * radius * direction, center, _unit_vector(self.up)


class Hemisphere(PlacedRig, frozen=True, tag="hemisphere"):
    """Cameras spread evenly over the part of a sphere above ``lowest``, on a golden-angle spiral.

    Camera i of n has the height (i + 1/2)/n of the way from the lowest height to the top, so all cameras stand for the same
    area, and the azimuth i times the golden angle, 180 (3 - sqrt(5)) degrees.
    """

    count: ViewCount = 16
    distance: Annotated[float, _setting("radius of the box", "camera to middle", gt=1)] = 4.0
    lowest: Annotated[float, _setting("degree", "lowest elevation; -90 is the whole sphere", ge=-90, lt=90)] = 0.0
    start: Degrees = 0.0
    up: UpAxis = "y"

    def poses(self, center: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Equal steps of height, golden steps of azimuth."""
        low = np.sin(np.radians(self.lowest))
        golden = 180 * (3 - np.sqrt(5))
        for i in range(self.count):
            direction = _direction(self.start + i * golden, low + (1 - low) * (i + 0.5) / self.count, self.up)
            yield center + self.distance * radius * direction, center, _unit_vector(self.up)


class LookAts(PlacedRig, frozen=True, tag="look_at"):
    """Cameras at given positions.

    ``targets`` and ``ups`` hold an entry for each origin, or a single entry for all.
    """

    origins: Annotated[tuple[Vector, ...], _setting("length", "camera positions", min_length=1)]
    targets: Annotated[tuple[Vector, ...], _setting("length", "points looked at", min_length=1)]
    ups: Annotated[tuple[Vector, ...], _setting("1", "directions up in the image", min_length=1)] = ((0.0, 1.0, 0.0),)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("targets", "ups"):
            found, wanted = len(getattr(self, name)), len(self.origins)
            if found not in (1, wanted):
                raise ValueError(f"{found} {name} for {wanted} origins; give 1 or as many")

    def poses(self, center: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """The poses as given; the box only sets a missing field of view."""
        n = len(self.origins)
        targets, ups = (v * n if len(v) == 1 else v for v in (self.targets, self.ups))
        yield from ((np.array(o), np.array(t), np.array(u)) for o, t, u in zip(self.origins, targets, ups, strict=True))


class SceneSensors(Rig, frozen=True, tag="scene"):
    """The scene's own sensors: all sensors, or the sensors with given numbers."""

    indices: Annotated[tuple[int, ...], _setting("1", "numbers of the sensors; empty: all")] = ()

    def sensors(self, scene: mi.Scene) -> list[dict | mi.Sensor]:
        """Return existing sensors.

        Raises:
            MivolError: no sensor in the scene, or no sensor with a given number.
        """
        own = list(scene.sensors())
        if not own:
            raise MivolError("the scene has no sensor; add one to it, or choose another rig.")
        wrong = [i for i in self.indices if not 0 <= i < len(own)]
        if wrong:
            raise MivolError(f"the scene has no sensor {wrong[0]}; its sensors are 0 to {len(own) - 1}.")
        return [own[i] for i in self.indices] if self.indices else own


RIGS: dict[str, type[Rig]] = {r.__struct_config__.tag: r for r in (Ring, Hemisphere, LookAts, SceneSensors)}


def parse_rig(table: Mapping[str, Any]) -> Rig:
    """Parse a rig from a table such as ``[views]`` of a TOML file.

    Args:
        table: ``rig`` (a key of ``RIGS``) and its settings.

    Raises:
        MivolError: an unknown rig or setting (with the nearest name), or a value outside the domain.
    """
    name = table.get("rig", "ring")
    if name not in RIGS:
        raise MivolError(f'unknown rig "{name}": {_nearest(str(name), list(RIGS))}')
    unknown = next((key for key in table if key != "rig" and key not in RIGS[name].__struct_fields__), None)
    if unknown is not None:
        raise MivolError(f'rig "{name}" has no setting "{unknown}": {_nearest(unknown, RIGS[name].__struct_fields__)}')
    try:
        return msgspec.convert({**table, "rig": name}, RIGS[name])
    except msgspec.ValidationError as error:
        raise MivolError(f'rig "{name}": {error}.') from None


def _nearest(word: str, known: list[str] | tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f'did you mean "{close[0]}"?' if close else "known are: " + ", ".join(known) + "."


# -- Geometry -------------------------------------------------------------------------------------


def look_at(origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera to world, (4, 4) float64, in Mitsuba's frame: x to the left in the image, y up, z into the scene.

    If ``up`` is parallel to the view, the coordinate axis with the smallest component along the view replaces ``up``.

    Raises:
        MivolError: origin and target coincide.
    """
    forward = np.asarray(target, dtype=np.float64) - origin
    length = np.linalg.norm(forward)
    if not length > 0:
        raise MivolError(f"a camera at {np.asarray(origin).tolist()} looks at its own position; move origin or target.")
    forward /= length
    left = np.cross(up, forward)
    # 1e-6: half a second of arc, below which float32 directions cannot tell up from forward.
    if np.linalg.norm(left) < 1e-6 * np.linalg.norm(up) or not np.any(up):
        left = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4)
    pose[:3, :] = np.column_stack([left, np.cross(forward, left), forward, origin])
    return pose


def find_media_box(scene: mi.Scene) -> np.ndarray:
    """Find the box (2, 3) around all shapes that bound a medium, or around the whole scene without media [length].

    Raises:
        MivolError: a scene without shapes.
    """
    shapes = [s for s in scene.shapes() if s.interior_medium() is not None or s.exterior_medium() is not None]
    boxes = [s.bbox() for s in shapes] or [scene.bbox()]
    low = np.min([np.array(b.min).ravel() for b in boxes], axis=0)
    high = np.max([np.array(b.max).ravel() for b in boxes], axis=0)
    if not np.all(np.isfinite([low, high])) or np.any(low > high):
        raise MivolError("the scene holds no shape for cameras to look at; give it one, or use the rig look_at.")
    return np.array([low, high], dtype=np.float64)


def _bounding_sphere(box: np.ndarray) -> tuple[np.ndarray, float]:
    low, high = np.asarray(box, dtype=np.float64)
    if not np.all(np.isfinite([low, high])) or np.any(low > high) or np.all(low == high):
        text = np.asarray(box).tolist()
        raise MivolError(f"cameras cannot be placed about the box {text}; it must be finite and not empty.")
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _fitting_fov(radius: float, distance: float) -> float:
    """Full angle of the cone that touches a sphere: sin(fov/2) = radius/distance."""
    if distance <= radius:
        raise MivolError(
            f"a camera {distance:.4g} from its target is inside the sphere of radius {radius:.4g} about the box; give it a fov."
        )
    return float(2 * np.degrees(np.arcsin(radius / distance)))


def _unit_vector(name: str) -> np.ndarray:
    return np.eye(3)["xyz".index(name)]


def _direction(azimuth: float, height: float, up: str) -> np.ndarray:
    """Unit vector at an azimuth [degree] and a height (sine of the elevation) above the plane perpendicular to ``up``."""
    u = "xyz".index(up)
    first, second = np.eye(3)[(u + 1) % 3], np.eye(3)[(u + 2) % 3]
    phi = np.radians(azimuth)
    return np.sqrt(max(0.0, 1 - height**2)) * (np.cos(phi) * first + np.sin(phi) * second) + height * np.eye(3)[u]
