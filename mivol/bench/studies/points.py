"""How many pixels per second are splatted from clouds of Gaussians, or traced through them, beside Mitsuba's ellipsoids?

    mivol bench points                 # 3 minutes on 2 cores
    mivol bench points --quick         # under a minute, small clouds
    mivol bench points --only clouds
    mivol bench points --only chair    # fits: 3 minutes; chair_minutes 15, chair_large 5, chair_finest 20

Clouds are random: means uniform in a unit cube, scales about a quarter of the mean distance, opacities by the logistic function
of a normal variable, harmonics of degree 2. The camera sees the whole cube. The reference walk through the tutorial's smoke
runs in turns with the clouds; "scaled" rates hold for a machine walking 25 M rays per second.

The peer is Mitsuba's ``ellipsoids`` with ``volprim_rf_basic``, one ray per pixel. It sorts ellipsoids by the entry points of
the ray and stops after 64 of them. The two images differ by the order, the ends of the ellipsoids (three standard deviations),
the low-pass filter, and the positions within the pixel.

Question ``rays`` traces one ray per pixel through the same cloud, in turns with the peer: as emission of a medium
(``mivol_gaussians``), composited in the order of the peaks, and as extinction of a medium before a white sky, without any
sorting. The biker (152,746 Gaussians) comes from MIVOL_DATA (default ../shared/data). Without the data, a random cloud of the
same size takes its place, and the JSON records this.

Photographs of the chair (NeRF-synthetic) are fitted as by ``mivol optimize``. Minutes hold for the reference machine. Training
and judged views are averaged over squares of pixels of the files; PSNR is the mean over views, over white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Contestant, Timing, race, time_ratio
from mivol.bench.harness.figures import new_figure, show_images
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Promise, Size, Study, amount, ask, say_row
from mivol.bench.photo_fits import find_data, fit_photographs, prepare_fit
from mivol.bench.scenes import DATA, REFERENCE_RATE, reference_walk
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS
from mivol.photos.camera import Camera, intrinsics
from mivol.points import Gaussians, read_gaussians
from mivol.splatting import Splatter, to_tensors

DEGREE, FOCAL, DISTANCE = 2, 1.6, 1.8
"""Degree of the harmonics; focal length in image widths, distance of the camera from the centre of the cube in edges."""

SPACING = 0.25
"""Mean scale of the Gaussians in mean distances: the cloud hides nine tenths of the background."""


class ChairFit(NamedTuple):
    """A fit of the chair.

    Attributes:
        preset, effort: settings of the table ``gaussians``.
        scale: size of training and judged views relative to the files.
        seeds: one fit for each.
        decibels: bar on the PSNR of each seed [dB].
        text: the question.
    """

    preset: str
    effort: float
    scale: float
    seeds: tuple[int, ...]
    decibels: float
    text: str


PSNR_TEXT = "What is the PSNR of the chair's test views"
CHAIR = {
    "chair": ChairFit("minute", 1.2, 0.25, (0, 1, 2), 34.0, f"{PSNR_TEXT} at 200 pixels after a minute, for three seeds?"),
    "chair_minutes": ChairFit("minutes", 1.0, 0.25, (0, 1, 2), 37.0, f"{PSNR_TEXT} at 200 pixels after five minutes?"),
    "chair_large": ChairFit("fine", 0.85, 1.0, (0,), 31.0, f"{PSNR_TEXT} at 800 pixels after five minutes?"),
    "chair_finest": ChairFit("finest", 1.0, 1.0, (0,), 32.5, f"{PSNR_TEXT} at 800 pixels after twenty minutes?"),
}


@dataclass(frozen=True)
class PointsSize(Size):
    """Amount of work."""

    rounds: int = amount(9, 2, "warm calls of each contestant")
    clouds: tuple[tuple[int, int], ...] = amount(
        ((10_000, 200), (50_000, 400), (120_000, 800)), ((1000, 64),), "Gaussians and edges", tuple
    )
    peer: tuple[int, int] = amount((10_000, 200), (500, 32), "Gaussians and edge of the image [pixels], for the peer")
    biker_side: int = amount(800, 64, "edge of the image of the biker [pixels]")
    substitute: int = amount(152_746, 2000, "Gaussians of the cloud in place of the biker")
    walk_side: int = amount(1024, 128, "the reference walk has the square of this number of rays")
    effort: float = amount(1.0, 0.02, "factor on the steps of fits")


# -- Clouds and cameras -----------------------------------------------------------------------------------------------------


def random_cloud(n: int, seed: int = 0) -> Gaussians:
    """n Gaussians with random positions, rotations, opacities and colours in the unit cube around the origin."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-0.5, 0.5, (n, 3)).astype(np.float32),
        log_scales=np.log(SPACING * n ** (-1 / 3) * rng.uniform(0.5, 1.5, (n, 3))).astype(np.float32),
        quaternions=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=n).astype(np.float32),
        harmonics=(0.3 * rng.normal(size=(n, (DEGREE + 1) ** 2, 3))).astype(np.float32),
    )


def camera_before(centre: np.ndarray, edge: float, side: int, up: float = 1.0) -> Camera:
    """Square camera that sees a cube; ``up`` is -1 for a cloud whose y axis points down.

    Args:
        centre, edge: centre (3,) and edge of the cube [length].
        side: edge of the image [pixels].
        up: sign of the vertical axis.
    """
    pose = np.diag([up, up, 1.0, 1.0])
    pose[:3, 3] = centre + np.array([0, 0, DISTANCE * edge])
    return Camera(intrinsics(FOCAL * side, FOCAL * side, side / 2, side / 2), (side, side), pose)


class Drawing(NamedTuple):
    """A cloud, a camera, and the splatter of the image."""

    tensors: dict[str, mi.TensorXf]
    camera: Camera
    splatter: Splatter

    @classmethod
    def make(cls, cloud: Gaussians, camera: Camera) -> Drawing:
        """Tensors of a cloud, and a splatter of the size of the image."""
        return cls(to_tensors(cloud), camera, Splatter(*camera.size, cloud.degree))

    def forward(self) -> Contestant:
        """Contestant: the image."""
        return lambda _: self.splatter.forward(self.tensors, self.camera, derivatives=False)[0]

    def both(self) -> Contestant:
        """Contestant: the image, and the derivatives of the sum of its numbers."""
        ones = dr.full(mi.TensorXf, 1, (self.camera.size[1], self.camera.size[0], self.splatter.channels))
        dr.make_opaque(ones)

        def step(_: int) -> list:
            _, kept = self.splatter.forward(self.tensors, self.camera)
            return list(self.splatter.backward(kept, ones)[0].values())

        return step


def to_sensor(camera: Camera) -> dict:
    """Mitsuba's sensor of a camera: along +z with x to the left, where the camera looks along -z with x to the right."""
    w, h = camera.size
    return {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(w / 2 / camera.K[0, 0]))),
        "to_world": mi.ScalarTransform4f(camera.to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])),
        "film": {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}},
    }


def ellipsoid_scene(cloud: Gaussians, camera: Camera) -> mi.Scene:
    """The cloud as Mitsuba's ellipsoids. ``srgb_primitives`` is off, because its derivatives are wrong."""
    quaternions = cloud.quaternions / np.linalg.norm(cloud.quaternions, axis=1, keepdims=True)
    shape = {
        "type": "ellipsoids",
        "centers": mi.TensorXf(cloud.means),
        "scales": mi.TensorXf(np.exp(cloud.log_scales)),
        "quaternions": mi.TensorXf(np.ascontiguousarray(quaternions[:, [1, 2, 3, 0]])),
        "opacities": mi.TensorXf(1 / (1 + np.exp(-cloud.opacity_logits[:, None]))),
        "sh_coeffs": mi.TensorXf(cloud.harmonics.reshape(cloud.count, -1)),
    }
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": to_sensor(camera), "cloud": shape})


def medium_scene(cloud: Gaussians, camera: Camera, as_extinction: bool = False, **more: dict) -> mi.Scene:
    """The cloud as a medium: with its colours as emission, or as an extinction."""
    names = EXTINCTION_PARAMETERS if as_extinction else (*EXTINCTION_PARAMETERS, HARMONICS)
    volume = {"type": "mivol_gaussians", "space": "linear", **{name: mi.TensorXf(getattr(cloud, name)) for name in names}}
    medium = {"type": "mivol_medium", "sigma_t" if as_extinction else "emission": volume}
    to_world = mi.ScalarTransform4f().scale(2 * float(np.abs(cloud.means).max() + 4 * np.exp(cloud.log_scales.max())))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": 1},
            "sensor": to_sensor(camera),
            "cloud": {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium},
            **more,
        }
    )


# -- Speed ------------------------------------------------------------------------------------------------------------------


def measure_clouds(size: PointsSize) -> dict:
    """How many pixels per second are splatted, forward, and forward and backward?"""
    contestants, pixels = {"walk": reference_walk(size.walk_side)}, {}
    for n, side in size.clouds:
        drawing = Drawing.make(random_cloud(n), camera_before(np.zeros(3), 1.0, side))
        for kind, call in (("forward", drawing.forward()), ("forward and backward", drawing.both())):
            contestants[f"{n:,} at {side}^2, {kind}"] = call
            pixels[f"{n:,} at {side}^2, {kind}"] = side**2
    timings = race(contestants, size.rounds)
    walk = timings.pop("walk")
    rates = {name: report_scaled(t, pixels[name], walk, size) for name, t in timings.items()}
    for name, row in rates.items():
        say_row(name, milliseconds=1e3 * row["seconds_median"])
    return {"walk": walk.report(size.walk_side**2, "rays"), **rates}


def report_scaled(timing: Timing, pixels: int, walk: Timing, size: PointsSize) -> dict[str, float]:
    """Times and rates, with the rates of the reference machine by wall clock and by processor time."""
    scale = pixels * REFERENCE_RATE / size.walk_side**2
    return timing.report(pixels, "pixels") | {
        "pixels_per_second_scaled": scale / time_ratio(timing, walk),
        "pixels_per_second_scaled_by_processor": scale / time_ratio(timing, walk, "processor"),
    }


def measure_peer(size: PointsSize) -> dict:
    """How much faster than Mitsuba's ellipsoids is splatting, forward and backward, and how do the images differ?"""
    n, side = size.peer
    cloud, camera = random_cloud(n), camera_before(np.zeros(3), 1.0, side)
    drawing, scene = Drawing.make(cloud, camera), ellipsoid_scene(cloud, camera)
    params = mi.traverse(scene)
    keys = [key for key in params.properties if key.endswith((".data", ".opacities", ".sh_coeffs"))]

    def peer_step(seed: int) -> list:
        for key in keys:
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        dr.backward(dr.sum(mi.render(scene, params, spp=1, seed=seed), axis=None))
        return [dr.grad(params[key]) for key in keys]

    both = race({"mivol": drawing.both(), "volprim_rf_basic": peer_step}, max(3, size.rounds // 2))
    renders = {"mivol": drawing.forward(), "volprim_rf_basic": lambda seed: mi.render(scene, spp=1, seed=seed)}
    forward = race(renders, 3, keep=True)
    pictures = first_pictures(forward)
    return {
        "cloud": f"{n:,} at {side}^2",
        "forward and backward": {name: t.report(side**2, "pixels") for name, t in both.items()},
        "forward": {name: t.report(side**2, "pixels") for name, t in forward.items()},
        **speed_over_peer(both),
        "mivol_is_faster_forward": time_ratio(forward["volprim_rf_basic"], forward["mivol"]),
        **compare_pictures(pictures),
        "mean_difference": float(np.mean(pictures[0] - pictures[1])),
        "pictures": pictures,
    }


def first_pictures(timings: dict[str, Timing]) -> np.ndarray:
    """Images (2, H, W, 3) of mivol and of the peer."""
    return np.stack([timings[name].results[0][..., :3] for name in ("mivol", "volprim_rf_basic")])


def compare_pictures(pictures: np.ndarray) -> dict[str, float]:
    """RMS difference of the images, and the mean of mivol's image."""
    return {"rms_difference": float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2))), "mean": float(pictures[0].mean())}


def speed_over_peer(timings: dict[str, Timing]) -> dict[str, float]:
    """Time of the peer over the time of mivol, by wall clock and by processor time."""
    pair = timings["volprim_rf_basic"], timings["mivol"]
    return {"mivol_is_faster": time_ratio(*pair), "mivol_is_faster_by_processor": time_ratio(*pair, "processor")}


def measure_rays(size: PointsSize) -> dict:
    """How many pixels per second are traced through a cloud, and how many through Mitsuba's ellipsoids?"""
    n, side = size.peer
    cloud, camera = random_cloud(n), camera_before(np.zeros(3), 1.0, side)
    scenes = {
        "mivol": medium_scene(cloud, camera),
        "extinction": medium_scene(cloud, camera, as_extinction=True, sky={"type": "constant"}),
        "volprim_rf_basic": ellipsoid_scene(cloud, camera),
    }
    renders = {name: lambda seed, scene=scene: mi.render(scene, spp=1, seed=seed) for name, scene in scenes.items()}
    timings = race({"walk": reference_walk(size.walk_side), **renders}, size.rounds, keep=True)
    return {
        "cloud": f"{n:,} at {side}^2",
        **{name: report_scaled(timings[name], side**2, timings["walk"], size) for name in ("mivol", "extinction")},
        "volprim_rf_basic": timings["volprim_rf_basic"].report(side**2, "pixels"),
        **speed_over_peer(timings),
        **compare_pictures(first_pictures(timings)),
    }


def measure_biker(size: PointsSize) -> dict:
    """How long does one image of the biker take?"""
    path = DATA / "splats" / "biker.compressed.ply"
    is_biker = path.is_file() and not size.name.startswith("quick")
    cloud = read_gaussians(path) if is_biker else random_cloud(size.substitute)
    low, high = np.percentile(cloud.means, [2, 98], axis=0)
    camera = camera_before((low + high) / 2, float((high - low).max()), size.biker_side, up=-1.0)
    timing = race({"forward": Drawing.make(cloud, camera).forward()}, size.rounds, keep=True)["forward"]
    return {
        "cloud": path.name if is_biker else "made up",
        "gaussians": cloud.count,
        **timing.report(size.biker_side**2, "pixels"),
        "pictures": timing.results[0][None, ..., :3],
    }


# -- Fits -------------------------------------------------------------------------------------------------------------------


def fit_chair(wanted: ChairFit, size: PointsSize) -> dict:
    """Fit the chair once for each seed, and judge by the test views."""
    photos = {"background": "white", "judged": "test", "held_out": 0, "box": "silhouettes", "scale": wanted.scale}
    settings = {"gaussians": {"preset": wanted.preset, "effort": wanted.effort * size.effort}}
    seeds = {}
    for seed in wanted.seeds:
        prepared = prepare_fit(find_data("chair"), photos, settings, seed)
        minutes = fit_photographs(prepared.problem, size.walk_side).seconds / 60
        psnr = prepared.score(prepared.judged.views)["psnr"]
        seeds[str(seed)] = {"psnr": psnr, "minutes": minutes, "gaussians": len(prepared.problem.cloud["means"])}
        say_row(f"{wanted.preset}, seed {seed}", psnr=psnr, minutes=minutes)
    views = prepared.judged.views
    return {"pixels": list(views[0].camera.size), "views": len(views), "steps": prepared.steps, "seeds": seeds}


# -- Bars and figure --------------------------------------------------------------------------------------------------------


SCALED = "[M pixels/s, scaled]"
PROMISES = {
    "clouds": [
        Promise(f"{name} {SCALED}", (name, "pixels_per_second_scaled"), AT_LEAST, bar, 1e-6)
        for name, bar in (("10,000 at 200^2, forward and backward", 1.7), ("50,000 at 400^2, forward and backward", 1.3))
    ],
    "peer": [Promise("rate over volprim_rf_basic's, forward and backward", ("mivol_is_faster",), AT_LEAST, 40)],
    "rays": [Promise(f"traced, forward {SCALED}", ("mivol", "pixels_per_second_scaled"), AT_LEAST, 0.14, 1e-6)],
    "biker": [Promise("an image of the biker [s]", ("seconds_median",), AT_MOST, 2)],
} | {name: [Promise(f"{name}, seed {{}} [dB]", ("seeds", "*", "psnr"), AT_LEAST, fit.decibels)] for name, fit in CHAIR.items()}


def draw(answers: dict, path: Path) -> None:
    """Show the images of the peer's cloud, their difference, and the biker."""
    images = {}
    if "peer" in answers:
        mivol, peer = answers["peer"]["pictures"]
        images = {"mivol": mivol, "volprim_rf_basic": peer, "difference, + 1/2": mivol - peer + 0.5}
    if "biker" in answers:
        images[f"{answers['biker']['cloud']}, {answers['biker']['seconds_median']:.2f} s"] = answers["biker"]["pictures"][0]
    if not images:
        return
    with new_figure(path, 4 * len(images), 4.4) as figure:
        show_images(np.ravel(figure.subplots(1, len(images), squeeze=False)), images)


QUESTIONS: dict[str, Callable[[PointsSize], dict]] = {
    "clouds": measure_clouds,
    "peer": measure_peer,
    "rays": measure_rays,
    "biker": measure_biker,
    **{name: ask(wanted.text, fit_chair, wanted) for name, wanted in CHAIR.items()},
}
STUDY = Study(__name__, __doc__, PointsSize, QUESTIONS, draw=draw, on_request=tuple(CHAIR), promises=PROMISES)
