"""How many pixels a second are splatted from clouds of Gaussians, or traced through them, beside what Mitsuba draws of them?

    scripts/bench_points.py                 # 3 minutes on 2 cores
    scripts/bench_points.py --quick         # under a minute, small clouds
    scripts/bench_points.py --only clouds
    scripts/bench_points.py --only chair    # fits: 3 minutes; chair_minutes 15, chair_large 5, chair_finest 20
    scripts/bench_points.py --only mip,exposure    # what two choices of a fit bring: 3 minutes

Clouds are random: means even in a unit cube, scales about a quarter of the mean distance, opacities the logistic of a normal
number, harmonics of degree 2; the camera sees the whole cube. The walk of ``bench_optical_depth`` through the tutorial's smoke
runs in turns with them: "scaled" rates are those of a machine that walks 25 M rays a second. The peer is Mitsuba's
``ellipsoids`` with ``volprim_rf_basic``, one ray a pixel, which sorts by where a ray enters an ellipsoid and stops at 64 of
them; its picture and ours differ by the order, by the ends of the ellipsoids (three standard deviations), by the low-pass
filter and by places within the pixel. "rays" traces one a pixel through the same cloud, as a medium that shows its colours in
the order of their peaks (``mivol_gaussians`` as the emission), in turns with the peer, and as the extinction of a medium before
a white sky, which nothing is sorted for. The biker (152,746 Gaussians) is read from MIVOL_DATA (default
../shared/data); where it is missing a cloud of as many takes its place, and the JSON says so. Prints JSON; writes
bench_points.json and bench_points.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import DATA, smoke
from mivol.bench.harness.bars import AT_LEAST, AT_MOST, Bar, judge
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import Contestant, Timing, race, ratio_of
from mivol.bench.studies.gaussian_choices import exposure_gain, mip_gain
from mivol.bench.studies.gaussian_fits import Fitted, fit_and_judge
from mivol.bench.studies.optical_depth.work import Work, camera_rays
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS
from mivol.photos.camera import Camera, intrinsics
from mivol.points import Gaussians, read_gaussians
from mivol.splatting import Splatter, to_tensors

__all__ = ["BENCH", "FULL", "QUICK", "Size", "compare", "dense_cloud", "main"]

WALK = 25e6
"""Rays a second of the machine that rates are scaled to."""

DEGREE, FOCAL, DISTANCE = 2, 1.6, 1.8
"""Of the harmonics; of the camera, in widths of the image, and from the centre of the cube in its edges."""

SPACING = 0.25
"""Scales of a cloud in mean distances: it hides nine tenths of what is behind it."""

RATES = {"10,000 at 200^2": 1.7, "50,000 at 400^2": 1.3}
"""What the project promises, forward and backward, in millions of pixels a second, scaled."""

RATIO, BIKER_SECONDS = 40.0, 2.0
"""At least so many times as fast as the peer; at most so many seconds for a picture of the biker."""

TRACED = 0.14
"""What the project promises of rays through Gaussians, in millions of pixels a second, scaled."""


CHAIR = {
    "chair": Fitted("minute", 1.2, 0.25, (0, 1, 2)),
    "chair_minutes": Fitted("minutes", 1.0, 0.25, (0, 1, 2)),
    "chair_large": Fitted("fine", 0.85, 1.0, (0,)),
    "chair_finest": Fitted("finest", 1.0, 1.0, (0,)),
}
"""Fits of about 1, 5, 5 and 20 minutes, judged at 200, 200, 800 and 800 pixels."""

MIP, JUDGED_AT = Fitted("minute", 0.5, 0.25, (0,)), (0.125, 0.25, 1.0)
"""A fit at 200 pixels, judged at 100, 200 and 800."""

EXPOSURE, EVERY = Fitted("minute", 0.5, 0.125, (0,)), 8
"""A fit of photographs of 135 x 240 pixels, all but every eighth."""

DECIBELS = {"chair": 34.0, "chair_minutes": 37.0, "chair_large": 31.0, "chair_finest": 32.5}
"""What the project promises of each seed [dB]."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        name: for the JSON.
        rounds: warm calls of each contestant.
        clouds: Gaussians, and pixels along the edge of the picture.
        peer: the cloud that the peer draws too.
        biker_side: pixels along the edge of its picture.
        substitute: Gaussians of the cloud in the place of the biker.
        walk_side: rays of the walk are its square.
        effort: factor on the steps of fits.
    """

    name: str = "full"
    rounds: int = 9
    clouds: tuple[tuple[int, int], ...] = ((10_000, 200), (50_000, 400))
    peer: tuple[int, int] = (10_000, 200)
    biker_side: int = 800
    substitute: int = 152_746
    walk_side: int = 1024
    effort: float = 1.0


FULL = Size()
QUICK = Size("quick", 2, ((1000, 64),), (500, 32), 64, 2000, 128, 0.02)


# -- Clouds and cameras ------------------------------------------------------------------------------------------------------


def dense_cloud(n: int, seed: int = 0) -> Gaussians:
    """n Gaussians of random places, directions, opacities and colours in the unit cube around the origin."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-0.5, 0.5, (n, 3)).astype(np.float32),
        log_scales=np.log(SPACING * n ** (-1 / 3) * rng.uniform(0.5, 1.5, (n, 3))).astype(np.float32),
        quaternions=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=n).astype(np.float32),
        harmonics=(0.3 * rng.normal(size=(n, (DEGREE + 1) ** 2, 3))).astype(np.float32),
    )


def camera_before(centre: np.ndarray, edge: float, side: int, up: float = 1.0) -> Camera:
    """A square camera that sees a cube of that centre and edge; ``up`` is -1 where the cloud's y points down."""
    pose = np.diag([up, up, 1.0, 1.0])
    pose[:3, 3] = centre + np.array([0, 0, DISTANCE * edge])
    return Camera(intrinsics(FOCAL * side, FOCAL * side, side / 2, side / 2), (side, side), pose)


class Drawing(NamedTuple):
    """A cloud, the camera before it, and the splatter of its picture."""

    reals: dict[str, mi.TensorXf]
    camera: Camera
    splatter: Splatter

    @classmethod
    def of(cls, gaussians: Gaussians, camera: Camera) -> Drawing:
        return cls(to_tensors(gaussians), camera, Splatter(*camera.size, gaussians.degree))

    def forward(self) -> Contestant:
        """The picture alone."""
        return lambda _: self.splatter.forward(self.reals, self.camera, derivatives=False)[0]

    def both(self) -> Contestant:
        """The picture, and the derivatives of the sum of its numbers."""
        ones = dr.full(mi.TensorXf, 1, (self.camera.size[1], self.camera.size[0], self.splatter.channels))
        dr.make_opaque(ones)

        def step(_: int) -> list:
            _, kept = self.splatter.forward(self.reals, self.camera)
            return list(self.splatter.backward(kept, ones)[0].values())

        return step


# -- Questions -----------------------------------------------------------------------------------------------------------------


def measure_clouds(size: Size) -> dict:
    """How many pixels a second are splatted, forward, and forward and backward?"""
    works = {f"{n:,} at {side}^2": (n, side) for n, side in size.clouds}
    contestants, pixels = {"walk": Work(smoke().values, *camera_rays(size.walk_side)).tau()}, {}
    for name, (n, side) in works.items():
        drawing = Drawing.of(dense_cloud(n), camera_before(np.zeros(3), 1.0, side))
        contestants[f"{name}, forward"] = drawing.forward()
        contestants[f"{name}, forward and backward"] = drawing.both()
        pixels |= {f"{name}, forward": side**2, f"{name}, forward and backward": side**2}
    timings = race(contestants, size.rounds)
    walk = timings.pop("walk")
    found = {name: t.report(pixels[name], "pixels") | scaled(t, pixels[name], walk, size) for name, t in timings.items()}
    return {"walk": walk.report(size.walk_side**2, "rays"), **found}


def scaled(timing: Timing, pixels: int, walk: Timing, size: Size) -> dict[str, float]:
    """Pixels a second of a machine that walks WALK rays a second, by the clock and by processor time."""
    one = pixels * WALK / size.walk_side**2
    return {
        "pixels_per_second_scaled": one / ratio_of(timing, walk),
        "pixels_per_second_scaled_by_processor": one / ratio_of(timing, walk, "processor"),
    }


def measure_peer(size: Size) -> dict:
    """How much faster than Mitsuba's ellipsoids, forward and backward, and by what do the pictures differ?"""
    n, side = size.peer
    cloud, camera = dense_cloud(n), camera_before(np.zeros(3), 1.0, side)
    drawing, scene = Drawing.of(cloud, camera), ellipsoids(cloud, camera)
    params = mi.traverse(scene)
    keys = [key for key in params.properties if key.endswith((".data", ".opacities", ".sh_coeffs"))]

    def peers_step(seed: int) -> list:
        for key in keys:
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        dr.backward(dr.sum(mi.render(scene, params, spp=1, seed=seed), axis=None))
        return [dr.grad(params[key]) for key in keys]

    timings = race({"mivol": drawing.both(), "volprim_rf_basic": peers_step}, max(3, size.rounds // 2))
    forward = race(
        {"mivol": drawing.forward(), "volprim_rf_basic": lambda seed: mi.render(scene, spp=1, seed=seed)}, 3, keep=True
    )
    ours, peers = forward["mivol"].results[0][..., :3], forward["volprim_rf_basic"].results[0][..., :3]
    return {
        "cloud": f"{n:,} at {side}^2",
        "forward and backward": {name: t.report(side**2, "pixels") for name, t in timings.items()},
        "forward": {name: t.report(side**2, "pixels") for name, t in forward.items()},
        "mivol_is_faster": ratio_of(timings["volprim_rf_basic"], timings["mivol"]),
        "mivol_is_faster_by_processor": ratio_of(timings["volprim_rf_basic"], timings["mivol"], "processor"),
        "mivol_is_faster_forward": ratio_of(forward["volprim_rf_basic"], forward["mivol"]),
        "rms_difference": float(np.sqrt(np.mean((ours - peers) ** 2))),
        "mean_difference": float(np.mean(ours - peers)),
        "mean": float(ours.mean()),
        "pictures": np.stack([ours, peers]),
    }


def measure_rays(size: Size) -> dict:
    """How many pixels a second are traced through a cloud that shows its colours, and how many by Mitsuba's ellipsoids?"""
    n, side = size.peer
    cloud, camera = dense_cloud(n), camera_before(np.zeros(3), 1.0, side)
    shown, peers = traced_scene(cloud, camera), ellipsoids(cloud, camera)
    hidden = traced_scene(cloud, camera, as_extinction=True, sky={"type": "constant"})
    timings = race(
        {
            "walk": Work(smoke().values, *camera_rays(size.walk_side)).tau(),
            "mivol": lambda seed: mi.render(shown, spp=1, seed=seed),
            "extinction": lambda seed: mi.render(hidden, spp=1, seed=seed),
            "volprim_rf_basic": lambda seed: mi.render(peers, spp=1, seed=seed),
        },
        size.rounds,
        keep=True,
    )
    walk, peer, ours = timings["walk"], timings["volprim_rf_basic"], ("mivol", "extinction")
    pictures = [timings["mivol"].results[0][..., :3], peer.results[0][..., :3]]
    return {
        "cloud": f"{n:,} at {side}^2",
        **{name: timings[name].report(side**2, "pixels") | scaled(timings[name], side**2, walk, size) for name in ours},
        "volprim_rf_basic": peer.report(side**2, "pixels"),
        "mivol_is_faster": ratio_of(peer, timings["mivol"]),
        "mivol_is_faster_by_processor": ratio_of(peer, timings["mivol"], "processor"),
        "rms_difference": float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2))),
        "mean": float(pictures[0].mean()),
    }


def traced_scene(cloud: Gaussians, camera: Camera, as_extinction: bool = False, **more: dict) -> mi.Scene:
    """The cloud as a medium that holds all of it: with its colours as they are, or as an extinction."""
    names = EXTINCTION_PARAMETERS if as_extinction else (*EXTINCTION_PARAMETERS, HARMONICS)
    rays = {"type": "mivol_gaussians", "space": "linear", **{name: mi.TensorXf(getattr(cloud, name)) for name in names}}
    medium = {"type": "mivol_medium", "sigma_t" if as_extinction else "emission": rays}
    place = mi.ScalarTransform4f().scale(2 * float(np.abs(cloud.means).max() + 4 * np.exp(cloud.log_scales.max())))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": 1},
            "sensor": sensor_of(camera),
            "cloud": {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium},
            **more,
        }
    )


def sensor_of(camera: Camera) -> dict:
    """A camera as Mitsuba has it: along +z with x to the left, where ours looks along -z with x to the right."""
    w, h = camera.size
    return {
        "type": "perspective",
        "fov": float(np.rad2deg(2 * np.arctan(w / 2 / camera.K[0, 0]))),
        "to_world": mi.ScalarTransform4f(camera.to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])),
        "film": {"type": "hdrfilm", "width": w, "height": h, "rfilter": {"type": "box"}},
    }


def ellipsoids(cloud: Gaussians, camera: Camera) -> mi.Scene:
    """The cloud as Mitsuba draws it; colours are kept as they are, for with ``srgb_primitives`` its derivatives are wrong."""
    shape = {
        "type": "ellipsoids",
        "centers": mi.TensorXf(cloud.means),
        "scales": mi.TensorXf(np.exp(cloud.log_scales)),
        "quaternions": mi.TensorXf(np.ascontiguousarray(_unit(cloud.quaternions)[:, [1, 2, 3, 0]])),
        "opacities": mi.TensorXf(1 / (1 + np.exp(-cloud.opacity_logits[:, None]))),
        "sh_coeffs": mi.TensorXf(cloud.harmonics.reshape(cloud.count, -1)),
    }
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor_of(camera), "cloud": shape})


def _unit(quaternions: np.ndarray) -> np.ndarray:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def measure_biker(size: Size) -> dict:
    """How long does one picture of the biker take?"""
    path = DATA / "splats" / "biker.compressed.ply"
    here = path.is_file() and size.name == FULL.name
    cloud = read_gaussians(path) if here else dense_cloud(size.substitute)
    low, high = np.percentile(cloud.means, [2, 98], axis=0)
    camera = camera_before((low + high) / 2, float((high - low).max()), size.biker_side, up=-1.0)
    drawing = Drawing.of(cloud, camera)
    timing = race({"forward": drawing.forward()}, size.rounds, keep=True)["forward"]
    return {
        "cloud": path.name if here else "made up",
        "gaussians": cloud.count,
        **timing.report(size.biker_side**2, "pixels"),
        "pictures": timing.results[0][None, ..., :3],
    }


def measure_chair(size: Size) -> dict:
    """How many dB have test views of the chair at 200 pixels after a minute, with three seeds?"""
    return _fit("chair", size)


def measure_chair_minutes(size: Size) -> dict:
    """How many dB have test views of the chair at 200 pixels after five minutes, with three seeds?"""
    return _fit("chair_minutes", size)


def measure_chair_large(size: Size) -> dict:
    """How many dB have test views of the chair at 800 pixels after five minutes?"""
    return _fit("chair_large", size)


def measure_chair_finest(size: Size) -> dict:
    """How many dB have test views of the chair at 800 pixels after twenty minutes?"""
    return _fit("chair_finest", size)


def measure_mip(size: Size) -> dict:
    """How many dB do test views of the chair gain by the mip filter, at the size of the fit and at others?"""
    return mip_gain(DATA / "multiview" / "chair", replace(MIP, effort=MIP.effort * size.effort), JUDGED_AT)


def measure_exposure(size: Size) -> dict:
    """How many dB do held-out photographs of the fox gain by a gain for each?"""
    return exposure_gain(DATA / "multiview" / "fox", replace(EXPOSURE, effort=EXPOSURE.effort * size.effort), EVERY)


def _fit(name: str, size: Size) -> dict:
    walk = race({"walk": Work(smoke().values, *camera_rays(size.walk_side)).tau()}, max(size.rounds, 3))["walk"]
    asked = replace(CHAIR[name], effort=CHAIR[name].effort * size.effort)
    seconds = float(np.median(walk.processor))
    return fit_and_judge(DATA / "multiview" / "chair", asked, seconds, size.walk_side**2 / WALK)


# -- Bars and figure ----------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """The figures of an answer that have a bar."""
    if question == "clouds":
        rates = {name: answer.get(f"{name}, forward and backward") for name in RATES}
        what = "forward and backward [M pixels/s, scaled]"
        return [
            judge(f"{name}, {what}", rate["pixels_per_second_scaled"] / 1e6, AT_LEAST, RATES[name])
            for name, rate in rates.items()
            if rate is not None
        ]
    if question == "peer":
        return [judge("rate over volprim_rf_basic's, forward and backward", answer["mivol_is_faster"], AT_LEAST, RATIO)]
    if question == "rays":
        what = f"{answer['cloud']}, traced, forward [M pixels/s, scaled]"
        return [judge(what, answer["mivol"]["pixels_per_second_scaled"] / 1e6, AT_LEAST, TRACED)]
    if question in DECIBELS:
        seeds, what = answer["seeds"], f"{question}, {answer['pixels'][0]} pixels [dB]"
        return [judge(f"{what}, seed {seed}", one["psnr"], AT_LEAST, DECIBELS[question]) for seed, one in seeds.items()]
    if question == "biker":
        return [judge("a picture of the biker [s]", answer["seconds_median"], AT_MOST, BIKER_SECONDS)]
    return []


def draw(answers: dict, folder: Path) -> None:
    """The pictures of the peer's cloud, their difference, and the biker."""
    shown = {}
    if "peer" in answers:
        ours, peers = answers["peer"]["pictures"]
        shown = {"mivol": ours, "volprim_rf_basic": peers, "difference, + 1/2": ours - peers + 0.5}
    if "biker" in answers:
        shown[f"{answers['biker']['cloud']}, {answers['biker']['seconds_median']:.2f} s"] = answers["biker"]["pictures"][0]
    if not shown:
        return
    with drawn(folder / "bench_points.png", 4 * len(shown), 4.4) as figure:
        for ax, (title, picture) in zip(np.ravel(figure.subplots(1, len(shown), squeeze=False)), shown.items(), strict=True):
            ax.imshow(np.clip(picture, 0, 1))
            ax.set_title(title)
            ax.axis("off")


QUESTIONS = {
    "clouds": measure_clouds,
    "peer": measure_peer,
    "rays": measure_rays,
    "biker": measure_biker,
    "chair": measure_chair,
    "chair_minutes": measure_chair_minutes,
    "chair_large": measure_chair_large,
    "chair_finest": measure_chair_finest,
    "mip": measure_mip,
    "exposure": measure_exposure,
}
BENCH = Bench("bench_points", __doc__, QUESTIONS, FULL, QUICK, compare, draw, unasked=(*CHAIR, "mip", "exposure"))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
