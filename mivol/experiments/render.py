"""An image of a scene, a radiance field, points or Gaussians.

Conventions. The image of a scene is the mean of passes of at most ``SAMPLES_PER_PASS`` samples. Ctrl-C therefore stops a
render within seconds. Channels keep Mitsuba's names, with AOVs after the colour. Fields, points and Gaussians are rendered
without a scene, through a given camera.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field
from mivol.fields.sky import Sky, read_sky
from mivol.files import write_exr, write_png
from mivol.files.atomic import check_destination
from mivol.files.image_files import decode_srgb
from mivol.files.source import check_file
from mivol.optim.photographs.field_view import render_view
from mivol.optim.scenes.views import derive_seed
from mivol.photos import Camera, aim_camera, intrinsics
from mivol.photos.camera_path import HomeView
from mivol.points.cloud import PointCloud, points_to_gaussians, read_points
from mivol.points.gaussian_files import is_gaussian_file, read_gaussian_view, read_gaussians
from mivol.points.gaussians import Gaussians
from mivol.scene.explain import describe_light
from mivol.scene.load import describe_error
from mivol.scene.sensors import check_film, find_sensor
from mivol.splatting import Splatter, to_tensors

SAMPLES_PER_PASS = 1 << 21
KEPT = 2 * 4 * 8
"""Memory per pixel beside a pass [byte]: the sum of four channels in float64, and the pass during the addition."""

COLOURS = {0: (), 1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def check_output(path: Path) -> None:
    """Refuse an output file before the image is rendered.

    Raises:
        MivolError: another suffix than .exr or .png, a missing folder, or a folder without write access.
    """
    if path.suffix.lower() not in (".exr", ".png"):
        raise MivolError(f'images are written as .exr or .png, found "{path.name}": change the name of -o.')
    check_destination(path)


def integrator_name(integrator: mi.Integrator) -> str:
    """Plugin name of an integrator."""
    return "mivol" if hasattr(integrator, "session") else str(integrator).partition("[")[0].strip()


def choose_integrator(scene: mi.Scene, name: str | None = None) -> mi.Integrator:
    """Return the scene's integrator, or the named integrator with the same ``hide_emitters`` and, if it has one, ``max_depth``.

    Raises:
        MivolError: no integrator in the scene and no name, or an unknown name.
    """
    if name is None:
        if scene.integrator() is None:
            raise MivolError("the scene has no integrator: add an integrator to the scene, or choose --integrator mivol.")
        return scene.integrator()
    light = describe_light(scene)
    try:
        return mi.load_dict({"type": name, **light})
    except RuntimeError as error:
        if "max_depth" in str(error):
            return mi.load_dict({"type": name, "hide_emitters": light["hide_emitters"]})
        raise MivolError(f'the integrator "{name}" cannot be loaded ({describe_error(error)}): choose "mivol".') from None


Passes = Callable[[Sequence[tuple[int, int]]], Iterator[tuple[np.ndarray, float]]]
"""Renders passes, each a seed and a number of samples per pixel, in their order: float32 images, and the time of each [s]."""


def render_in_turn(scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator) -> Passes:
    """The function that renders passes one after another in this process, without derivatives."""

    def render(passes: Sequence[tuple[int, int]]) -> Iterator[tuple[np.ndarray, float]]:
        for seed, spp in passes:
            start = time.monotonic()
            with dr.suspend_grad():
                image = np.array(integrator.render(scene, camera, seed=seed, spp=spp))
            yield image, time.monotonic() - start

    return render


def render_image(
    scene: mi.Scene,
    sensor: int,
    integrator: mi.Integrator | None = None,
    spp: int | None = None,
    seed: int = 0,
    passes: Passes | None = None,
) -> tuple[np.ndarray, list[str]]:
    """Render a scene: image (height, width, channels) and channel names.

    Args:
        scene: the scene.
        sensor: index of the sensor.
        integrator: integrator; None means the scene's own.
        spp: samples per pixel; None means the number of the sensor's sampler.
        seed: seed of the random numbers.
        passes: renders passes on workers; None: in this process.

    Raises:
        MivolError: an unknown sensor, no integrator, no samples, or a film beyond the memory.
    """
    integrator, camera = integrator or choose_integrator(scene), find_sensor(scene, sensor)
    spp = camera.sampler().sample_count() if spp is None else spp
    if spp < 1:
        raise MivolError(f"{spp} samples a pixel make no image: give --spp 1 or more.")
    check_film(camera, KEPT)
    most = max(SAMPLES_PER_PASS // math.prod(int(n) for n in camera.film().crop_size()), 1)
    n = math.ceil(spp / most)
    parts = [(derive_seed(seed, number) if n > 1 else seed, spp // n + (number < spp % n)) for number in range(n)]
    total = 0.0
    for (_, part), (image, _) in zip(parts, (passes or render_in_turn(scene, camera, integrator))(parts), strict=True):
        total = total + part * image.astype(np.float64)
    image = total / spp
    return image, name_channels(list(integrator.aov_names()), image.shape[2])


def name_channels(aovs: list[str], count: int) -> list[str]:
    """Names of the channels of a rendered image.

    Mitsuba's ``aov`` names four colours of each integrator inside, with a prefix, but renders the colours of the film. Those of
    the first one are the image, without a prefix.

    Args:
        aovs: the integrator's ``aov_names()``.
        count: channels of the image.
    """
    inside = [name[:-2] for name in aovs if name.endswith(".A")]
    colours_inside = {f"{prefix}.{letter}" for prefix in inside for letter in "RGBA"}
    others = len([name for name in aovs if name not in colours_inside])
    colours = COLOURS[(count - others) // max(len(inside), 1)]
    if not inside:
        return [*colours, *aovs]
    names = []
    for name in aovs:
        prefix = name[:-2]
        if name not in colours_inside:
            names.append(name)
        elif name.endswith(".R"):
            names += colours if prefix == inside[0] else [f"{prefix}.{letter}" for letter in colours]
    return names


def write_image(path: Path, image: np.ndarray, names: list[str]) -> None:
    """Write an image in the format of the file's suffix.

    Raises:
        MivolError: another suffix than .exr or .png, a .png without colours, or a disk error.
    """
    check_output(path)
    if path.suffix.lower() == ".png":
        colours = [number for number, name in enumerate(names) if name in "RGBY"]
        if not colours:
            raise MivolError(f"the image has no colours, only {', '.join(names)}: write it as .exr.")
        return write_png(path, image[..., colours])
    return write_exr(path, {name: image[..., number].astype(np.float32) for number, name in enumerate(names)})


SKY_FILE = "sky.exr"
"""Name of the fitted sky beside the field."""


class Framing(NamedTuple):
    """What a user says about a camera; None stands for the first view in the file, or a default.

    Attributes:
        look_at: positions of camera and target, six numbers [length].
        up: upward direction, three numbers.
        fov: horizontal field of view [degree].
        size: (width, height) [pixel].
    """

    look_at: Sequence[float] | None = None
    up: Sequence[float] | None = None
    fov: float | None = None
    size: tuple[int, int] | None = None

    def complete(self, view: HomeView | None) -> Framing:
        """Return the framing with nothing missing but perhaps ``look_at``, by the first view in a file.

        The kept field of view and proportions belong to the kept place, so ``look_at`` brings the defaults of both.
        """
        place, up, fov, size = self.look_at, (0.0, 0.0, 1.0) if view is None else view.up, 50.0, (640, 480)
        if view is not None and place is None:
            place, fov, size = [*view.origin, *view.target], view.fov, view.scaled(max(size))
        return Framing(place, up if self.up is None else self.up, self.fov or fov, self.size or size)


def render_field(path: Path, framing: Framing) -> np.ndarray:
    """Render a field through a pinhole, over the sky beside the file or black: linear light (height, width, 3).

    Args:
        path: file of the field.
        framing: the camera.

    Raises:
        MivolError: as :func:`mivol.fields.field_files.read_field`, no camera in the file and none given, or an invalid camera.
    """
    field, sky = read_field(path), sky_beside(path)
    framing = framing.complete(read_field_view(path))
    if framing.look_at is None:
        raise MivolError(f"{path} keeps no camera, as the field of a fit to photographs does: give --look-at.")
    camera = make_camera(*framing)
    image = render_view(field, camera, np.zeros(3) if sky is None else sky).image
    return np.maximum(image, 0) if field.space == "linear" else decode_srgb(image)


def sky_beside(path: Path) -> Sky | None:
    """Read the fitted sky beside a field's file; None without a sky.

    Raises:
        MivolError: as :func:`mivol.fields.sky.read_sky`.
    """
    beside = path.with_name(SKY_FILE)
    return read_sky(beside) if beside.is_file() else None


def make_camera(look_at: Sequence[float], up: Sequence[float], fov: float, size: tuple[int, int]) -> Camera:
    """Return the camera of :func:`render_field`.

    Raises:
        MivolError: a view along ``up``, infinite numbers or NaN, or an invalid angle or size.
    """
    if not np.isfinite([*look_at, *up]).all() or not 0 < fov < 180 or min(size) < 1:
        options = f"--look-at {list(look_at)} --up {list(up)} --fov {fov:g} --size {list(size)}"
        raise MivolError(f"{options} is no camera: give finite numbers, an angle between 0 and 180 and at least one pixel.")
    width, height = size
    focal = width / (2 * math.tan(math.radians(fov) / 2))
    template = Camera(intrinsics(focal, focal, width / 2, height / 2), size, np.eye(4))
    return aim_camera(template, np.array(look_at[:3]), np.array(look_at[3:]), np.array(up), "--look-at")


VOLUME_DEPTH, VOLUME_SAMPLES = 100.0, 32
"""Optical depth [1] along the longest edge of a volume's box if all of it had the largest value, and samples per pixel."""


def render_volume(
    path: Path, framing: Framing, spp: int | None = None, seed: int = 0, dataset: str | None = None
) -> tuple[np.ndarray, list[str]]:
    """Render a volume as a smoke of albedo 0.9 in its box, under a sky and a sun, with up to seven scatterings: linear light.

    Values are scaled to ``VOLUME_DEPTH``, since a file does not tell the unit of an extinction.

    Args:
        path: file of :func:`mivol.files.read_volume` with values of which the largest is above 0.
        framing: the camera; without a place, it sees the whole box.
        spp: samples per pixel; None means ``VOLUME_SAMPLES``.
        seed: seed of the random numbers.
        dataset: name of the grid in a file of several.

    Raises:
        MivolError: as :func:`mivol.files.read_volume`, a volume without a positive value, or an invalid camera.
    """
    try:
        named = {} if dataset is None else {"grid": dataset}
        grid = mi.load_dict({"type": "mivol_voxels", "filename": str(path), "use_grid_bbox": True, "signed": True, **named})
    except RuntimeError as error:
        said = describe_error(error)
        raise MivolError(said.partition('"mivol_voxels": ')[2] or said) from None
    low, high = (np.array(corner, np.float64) for corner in (grid.bbox().min, grid.bbox().max))
    top = float(grid.max())
    if top <= 0:
        raise MivolError(f"{path}: found no value above 0, which a smoke needs; mivol explain {path} prints its values.")
    place, up, fov, size = framing.complete(None)
    place = place or frame_points(np.array([low, high]), up, fov, size)
    make_camera(place, up, fov, size)
    smoke = {"type": "mivol_medium", "sigma_t": grid, "albedo": 0.9, "scale": VOLUME_DEPTH / (top * float((high - low).max()))}
    box = mi.ScalarTransform4f().translate((low + high) / 2).scale((high - low) / 2)
    # Mitsuba's camera sees from 0.01 to 10,000: neither a cloud in metres nor a cell in metres.
    far = 2 * float(np.linalg.norm(np.subtract((low + high) / 2, place[:3])) + np.linalg.norm(high - low))
    sun = mi.ScalarVector3f(*(np.cross(np.subtract(place[3:], place[:3]), up) - np.array(up) * np.linalg.norm(high - low)))
    scene = mi.load_dict(
        {
            "type": "scene",
            "smoke": {"type": "cube", "to_world": box, "bsdf": {"type": "null"}, "interior": smoke},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.03, 0.05, 0.09]}},
            "sun": {"type": "directional", "direction": sun, "irradiance": {"type": "rgb", "value": [8.0, 7.5, 7.0]}},
            "sensor": {
                "type": "perspective",
                "fov": fov,
                "near_clip": 1e-6 * far,
                "far_clip": far,
                "to_world": mi.ScalarTransform4f().look_at(origin=place[:3], target=place[3:], up=list(up)),
                "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgb"},
                "sampler": {"type": "independent", "sample_count": VOLUME_SAMPLES},
            },
        }
    )
    return render_image(scene, 0, mi.load_dict({"type": "mivol", "max_depth": 8}), spp, seed)


DRAWN_AS = ("discs", "splats")
"""Shapes of points: a disc that faces the camera, or a Gaussian (EWA splatting, Zwicker et al. 2001)."""

FROM = (1.0, -1.5, 0.7)
"""Direction from the middle of a cloud to the default camera; z is up."""

SHARE = 0.01
"""Share of the points outside the default view at either end of each axis."""


@dataclass(frozen=True)
class PointLook:
    """Appearance of points.

    Attributes:
        drawn_as: shape, from :data:`DRAWN_AS`.
        radius: radius of a disc, or standard deviation of a splat [length]; None means half the median distance to the nearest
            points.
        opacity: opacity of a point, above 0 and up to 1.

    Raises:
        MivolError: a number outside the domain.
    """

    drawn_as: str = "discs"
    radius: float | None = None
    opacity: float = 1.0

    def __post_init__(self) -> None:
        if not 0.03 <= self.opacity <= 1:
            raise MivolError(f"points of opacity {self.opacity:g}: expected 0.03 to 1; choose an opacity in this range.")
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise MivolError(f"points of radius {self.radius:g}: expected a length above 0; choose a positive radius.")


def render_points(path: Path, framing: Framing, look: PointLook) -> np.ndarray:
    """Render points or Gaussians through a pinhole over black: linear light (height, width, 3).

    Points are sorted by depth and composited front to back. A point smaller than a pixel covers a share of the pixel. The
    light of the point therefore decreases with the inverse square of the distance.

    Args:
        path: file of points or Gaussians in a known format; points without colours are coloured by their local density.
        framing: the camera; without a place, and without one in the file, it sees nearly all points.
        look: appearance of points; Gaussians have their own sizes and opacities.

    Raises:
        MivolError: as the readers, an invalid camera, or an appearance for Gaussians.
    """
    is_cloud = not is_gaussian_file(check_file(path))
    if not is_cloud and look != PointLook():
        raise MivolError(f"{path} holds Gaussians, which have their own shapes: leave out the options for points.")
    gaussians = to_gaussians(read_points(path), look) if is_cloud else read_gaussians(path)
    place, up, fov, size = framing.complete(None if is_cloud else read_gaussian_view(path))
    camera = make_camera(place or frame_points(gaussians.means, up, fov, size), up, fov, size)
    return decode_srgb(splat_points(gaussians, camera, is_cloud, is_cloud and look.drawn_as == "discs"))


def to_gaussians(cloud: PointCloud, look: PointLook) -> Gaussians:
    """Round Gaussians of equal radius at the points; points without colours are coloured by their local density."""
    gaussians = points_to_gaussians(cloud, look.opacity)
    if cloud.colours is None:
        gaussians = points_to_gaussians(replace(cloud, colours=density_colours(gaussians.scales()[:, 0])), look.opacity)
    radius = 0.5 * float(np.median(gaussians.scales())) if look.radius is None else look.radius
    return replace(gaussians, log_scales=np.full((gaussians.count, 3), math.log(radius)))


def density_colours(distances: np.ndarray) -> np.ndarray:
    """Colours (N, 3) of points by the logarithms of the distances between neighbours; dense points are bright."""
    height = -np.log(distances.astype(np.float64))
    low, high = np.quantile(height, [SHARE, 1 - SHARE])
    return mpl.colormaps[COLOUR_MAP]((height - low) / max(high - low, 1e-12))[:, :3]


COLOUR_MAP = "magma"


def frame_points(places: np.ndarray, up: Sequence[float], fov: float, size: tuple[int, int]) -> list[float]:
    """Position of a camera that sees a ball about the middle 98 % of the points along each axis, and the ball's centre."""
    low, high = np.quantile(places.astype(np.float64), [SHARE, 1 - SHARE], axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    half = min(math.radians(fov) / 2, math.atan(math.tan(math.radians(fov) / 2) * size[1] / size[0]))
    towards = np.array(FROM) / np.linalg.norm(FROM)
    return [*(middle + towards * radius / math.sin(half)), *middle]


def splat_points(gaussians: Gaussians, camera: Camera, compensated: bool, discs: bool) -> np.ndarray:
    """Code values (height, width, 3) over black."""
    splatter = Splatter(*camera.size, gaussians.degree, compensated=compensated, discs=discs)
    return np.array(splatter.forward(to_tensors(gaussians), camera, derivatives=False)[0])[..., :3]
