"""Scenes as people build them: how much sooner has mivol the same error as Mitsuba, with the better of two samplers?

    mivol bench everyday                                     # 20 minutes on 2 idle cores
    mivol bench everyday --quick                             # 5 minutes, small images: do the means agree?
    mivol bench everyday --scenes tissue god_rays            # some of the scenes
    mivol bench everyday --only images --side 48 --spp 16    # a smaller question
    mivol bench everyday --only gradients --side 48 --gradient-spp 32 --scenes area_light_albedo area_light_sigma_t \
        object_albedo object_sigma_t null_envmap_albedo null_envmap_sigma_t hetero_albedo hetero_sigma_t

Fifteen scenes: homogeneous and varying media in rooms, over floors, in glass and
in fog, with lamps inside and beside, each at the depth that its light needs. All methods take the same samples per pixel and
render in turns, in rounds with their own seeds. A ratio is variance x processor time of the peer over variance x processor time
of mivol; so a ratio of 10 means the same error in a tenth of the time.

images: mean variance over pixels and colours, over ``volpath`` with the better of its samplers ``independent`` and
``multijitter``. Beside the ratio stand the median pixel's ratio to the same peer, milliseconds of one image, and z: the
difference of the means in standard errors. If a z exceeds its bound (false alarm in one run in 1000, Student's t), the study
ends with status 1.

gradients: of the mean of the image, ``mi.render`` and ``dr.backward``, with respect to the density, or the albedo in
``coloured_albedo``; over ``prbvolpath``, with a quarter of the samples. The variance is the mean over the voxels with at least
0.3 of the largest value. z compares the derivatives along the logarithm of the parameter. It decides nothing here:
``prbvolpath`` is biased in some of these scenes, and the table shows where. A gradient of one number has
four times the rounds.

The pixel that shows a point lamp inside a medium has an infinite variance, whatever the integrator, since light falls as 1 / h
with the distance h of a ray. So have gradients of ``prbvolpath`` beside such a lamp. With 6 rounds, ratios of such scenes
scatter by 10 times from run to run; use ``--rounds 24``.

The last command has four scenes of Mitsuba's own tests, read from MIVOL_DATA, each with the parameter in its name.

Conventions. z is up. The medium fills the shape ``body``, in most scenes the box or ball of edge or diameter 2 at the origin.
Coefficients are in 1 / length. Each scene has the ``max_depth`` that its light needs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.contests import (
    agreement_figures,
    compare_means,
    compete,
    finite_or_none,
    gain_figures,
    image_errors,
    mean_of_rounds,
    render_method,
)
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import AT_LEAST, Bar, Promise, Size, Study, amount, judge_agreement, say_row
from mivol.bench.scenes import DATA, ParameterGradient, camera, make_integrator
from mivol.errors import MivolError
from mivol.optim.strategy import suggest_name
from mivol.report.figures import SERIES
from mivol.scene.load import resolve_beside

ORIGIN, UP = (0, 0, 0), (0, 0, 1)


@dataclass(frozen=True)
class EverydayScene:
    """A scene and the terms of its contest.

    Attributes:
        build: side of the image -> parts of the scene; or the name of a scene of Mitsuba's own tests.
        depth: ``max_depth`` of all integrators; -1: unlimited.
        image_bar: smallest ratio of variance x time for images.
        gradient_bar: the same for gradients; None: no bar.
        parameter: parameter that gradients are with respect to.
        roulette: depth at which Russian roulette begins.
    """

    build: Callable[[int], dict] | str
    depth: int
    image_bar: float
    gradient_bar: float | None
    parameter: str = "body.interior_medium.sigma_t.data"
    roulette: int = 64

    def load(self, side: int, sampler: str = "independent", spp: int = 1) -> mi.Scene:
        """Load the scene with a sampler for ``spp`` samples per pixel."""
        if isinstance(self.build, str):
            return _load_test_scene(self.build, side, sampler, spp)
        parts = self.build(side)
        parts["sensor"]["sampler"] = {"type": sampler, "sample_count": spp}
        return mi.load_dict({"type": "scene", **parts})

    def integrator(self, name: str) -> mi.Integrator:
        """An integrator for this scene alone."""
        return make_integrator(name, self.depth, roulette=self.roulette)


TESTS = "scenes/mitsuba-data/tests/scenes/participating_media"
"""Folder of Mitsuba's own scenes with media, below MIVOL_DATA."""


def _load_test_scene(name: str, side: int, sampler: str, spp: int) -> mi.Scene:
    """Load a scene of Mitsuba's own tests.

    Raises:
        MivolError: the scene is missing.
    """
    path = DATA / TESTS / f"test_{name}_volpath.xml"
    if not path.is_file():
        raise MivolError(f"{path} is missing: set MIVOL_DATA to the folder that holds {TESTS}.")
    config = mi.parser.ParserConfig(mi.variant())
    with resolve_beside(path):
        state = mi.parser.parse_file(config, str(path), res=str(side), spp=str(spp))
        for node in state.nodes:
            if node.props.plugin_name() == "independent":
                node.props.set_plugin_name(sampler)
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)


# -- Parts ------------------------------------------------------------------------------------------------------------------


def _rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def _facing(origin: Sequence[float], target: Sequence[float], up: Sequence[float] = UP) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


def _square_lamp(origin: Sequence[float], radiance: float, half_edge: float = 1.0) -> dict:
    """A square that shines at the origin."""
    place = _facing(origin, ORIGIN, (0, 1, 0)).scale(half_edge)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}


def _spot(place: mi.ScalarTransform4f, intensity: float, angle: float) -> dict:
    return {"type": "spot", "to_world": place, "intensity": intensity, "cutoff_angle": angle}


def _sky(radiance: float = 1.0) -> dict:
    return {"type": "constant", "radiance": radiance}


def _sky_and_sun(radiance: float = 1.0) -> dict:
    """An even sky, and a distant sun."""
    return {"sky": _sky(radiance), "sun": {"type": "directional", "direction": [-0.4, -0.3, -1], "irradiance": 3.0}}


def _sun_in_a_map() -> dict:
    """A dim noisy sky with a sun of one pixel. Mitsuba's maps have y up."""
    picture = 0.3 * np.random.default_rng(3).random((32, 64, 3)).astype(np.float32)
    picture[9, 14] = 2000
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(picture), "to_world": turned}}


def _floor() -> dict:
    """A large brown floor just below the body."""
    bsdf = {"type": "diffuse", "reflectance": _rgb(0.6, 0.5, 0.4)}
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.001]).scale(6), "bsdf": bsdf}


def _even(albedo: float | dict, sigma_t: float | dict, g: float = 0.0) -> dict:
    """A homogeneous medium."""
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    return {"type": "homogeneous", "albedo": albedo, "sigma_t": sigma_t, "phase": phase}


def _ball(medium: dict, bsdf: dict | None = None) -> dict:
    return {"type": "sphere", "bsdf": bsdf or {"type": "null"}, "interior": medium}


def _grid(values: np.ndarray, scale: float = 1.0) -> dict:
    """A volume (Z, Y, X, channels) over the box of half edge ``scale``."""
    place = mi.ScalarTransform4f().scale(scale).translate(-1).scale(2)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values.astype(np.float32)), "to_world": place}


def _puffs(res: int) -> np.ndarray:
    """Forty soft blobs with a peak of 1, (res, res, res, 1)."""
    rng, centres = np.random.default_rng(1), np.linspace(-1, 1, res)
    points = np.stack(np.meshgrid(centres, centres, centres, indexing="ij"), -1)
    total = np.zeros((res,) * 3)
    for _ in range(40):
        centre = rng.uniform(-0.7, 0.7, 3)
        total += np.exp(-np.sum((points - centre) ** 2, axis=-1) / (2 * rng.uniform(0.05, 0.2) ** 2))
    return (total / total.max())[..., None]


def _smoke(peak: float, g: float = 0.0, albedo: float | dict = 0.8, res: int = 64, scale: float = 1.0) -> dict:
    """A box of puffs without a visible boundary."""
    medium = _even(albedo, _grid(peak * _puffs(res), scale), g) | {"type": "heterogeneous"}
    place = mi.ScalarTransform4f().scale(scale)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}


# -- Scenes -----------------------------------------------------------------------------------------------------------------


def _jade(side: int) -> dict:
    ball = _ball(_even(_rgb(0.9, 0.8, 0.6), 4.0))
    return _sun_in_a_map() | {"body": ball, "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _wax(side: int) -> dict:
    ball = _ball(_even(_rgb(0.95, 0.85, 0.6), 6.0), {"type": "roughdielectric", "alpha": 0.2})
    lamp = _square_lamp((2, 2, 3), 30.0, 0.5)
    return {"sky": _sky(), "lamp": lamp, "body": ball, "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _tissue(side: int) -> dict:
    lamp = _square_lamp((0, 1, 4), 20.0)
    return {"lamp": lamp, "body": _ball(_even(0.99, 30.0, 0.7)), "sensor": camera(side, (0, 4, 1), ORIGIN)}


def _fog(side: int) -> dict:
    """A fog without a boundary: the camera stands in the fog, and looks past a lamp at a wall."""
    grey = {"type": "diffuse", "reflectance": 0.5}
    wall = {"type": "rectangle", "to_world": _facing((4, 0, 0), ORIGIN).scale(6), "bsdf": grey}
    lamp = {"type": "point", "position": [2.0, 0, 1.0], "intensity": 10.0}
    sensor = camera(side, ORIGIN, (1, 0, 0)) | {"medium": {"type": "ref", "id": "fog"}}
    # Mitsuba resolves a reference only to an object that it has loaded before.
    return {"fog": _even(0.6, 0.2), "wall": wall, "lamp": lamp, "sensor": sensor}


def _god_rays(side: int) -> dict:
    haze = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": {"type": "null"}}
    return {
        "body": haze | {"interior": _even(0.9, 0.25, 0.5)},
        "lamp": _spot(_facing((0, 0, 1.9), ORIGIN, (0, 1, 0)), 40.0, 35.0),
        "ball": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}},
        "floor": _floor(),
        "sensor": camera(side, (0, 6, 1), ORIGIN),
    }


def _aquarium(side: int) -> dict:
    """A box of coloured water with a lamp and a ball inside, seen through its flat side."""
    middle = (0, 4, 0)
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate(middle).scale(3)}
    glass = {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.0}
    return {
        "body": box | {"bsdf": glass, "interior": _even(_rgb(0.3, 0.5, 0.6), _rgb(0.5, 0.3, 0.25), 0.8)},
        "lamp": _spot(_facing((1.5, 2, 1.5), middle), 30.0, 30.0),
        "ball": {"type": "sphere", "center": list(middle), "radius": 0.7, "bsdf": {"type": "diffuse"}},
        "sensor": camera(side, (0, -3, 0), middle),
    }


def _milk(side: int) -> dict:
    """A ball of milk in a thin ball of glass."""
    return {
        "sky": _sky(),
        "lamp": _square_lamp((3, 2, 4), 20.0, 0.7),
        "glass": {"type": "sphere", "radius": 1.1, "bsdf": {"type": "dielectric", "int_ior": 1.5}},
        "body": _ball(_even(_rgb(0.99, 0.97, 0.9), 8.0, 0.6), {"type": "dielectric", "int_ior": 1.33, "ext_ior": 1.5}),
        "floor": _floor(),
        "sensor": camera(side, (0, 4, 1.5), ORIGIN),
    }


def _smoke_on_floor(side: int) -> dict:
    return _sky_and_sun(0.4) | {"body": _smoke(12.0), "floor": _floor(), "sensor": camera(side, (0, 6, 2.5), (0, 0, -0.2))}


def _smoke_in_room(side: int) -> dict:
    """Smoke in Mitsuba's Cornell box in place of its two boxes; there, y is up."""
    stock = mi.cornell_box()
    room = {name: part for name, part in stock.items() if isinstance(part, dict) and part["type"] in ("rectangle", "diffuse")}
    sensor = camera(side, (0, 0, 3.9), ORIGIN, 39.3077, (0, 1, 0)) | {"near_clip": 0.001}
    return room | {"body": _smoke(8.0, res=48, scale=0.6), "sensor": sensor}


def _smoke_under(lights: Callable[[], dict], *smoke: float) -> Callable[[int], dict]:
    """Make the builder of a scene of one smoke, seen from above, from its lights."""
    return lambda side: lights() | {"body": _smoke(*smoke), "sensor": camera(side, (0, 5, 2), ORIGIN)}


def _coloured_albedo(side: int) -> dict:
    albedo = _grid(np.random.default_rng(0).uniform(0.3, 0.95, (16, 16, 16, 3)))
    return {"sky": _sky(), "body": _smoke(15.0, albedo=albedo), "sensor": camera(side, (0, 5, 2), ORIGIN)}


def _lamp_inside() -> dict:
    return {"lamp": {"type": "point", "position": [0.1, 0.2, 0.1], "intensity": 5.0}}


def _lamp_beside() -> dict:
    return {"lamp": _square_lamp((0, 1.5, 1.6), 20.0, 0.4)}


EVEN, ALBEDO = "body.interior_medium.sigma_t.value.value", "body.interior_medium.albedo.data"

SCENES = {
    "jade_null_sun": EverydayScene(_jade, 12, 2.5, 2, EVEN),
    "wax_rough_glass": EverydayScene(_wax, 16, 2, 2, EVEN),
    "tissue": EverydayScene(_tissue, -1, 12, 4, EVEN, roulette=20),
    "fog_unbounded": EverydayScene(_fog, 8, 10, None, "fog.sigma_t.value.value"),
    "god_rays": EverydayScene(_god_rays, 8, 6, 8, EVEN),
    "aquarium": EverydayScene(_aquarium, 10, 3, None, EVEN),
    "milk_in_glass": EverydayScene(_milk, 10, 2, 3, EVEN),
    "smoke_sun_map": EverydayScene(_smoke_under(_sun_in_a_map, 20.0, 0.8), 16, 40, 40),
    "smoke_on_floor": EverydayScene(_smoke_on_floor, 16, 9, 20),
    "smoke_in_room": EverydayScene(_smoke_in_room, 10, 3, 15),
    "thin_smoke": EverydayScene(_smoke_under(_sky_and_sun, 1.0), 8, 10, 900),
    "smoke_point_inside": EverydayScene(_smoke_under(_lamp_inside, 10.0), 8, 15, 20),
    "smoke_area_close": EverydayScene(_smoke_under(_lamp_beside, 10.0), 8, 6, 12),
    "coloured_albedo": EverydayScene(_coloured_albedo, 8, 20, 10, ALBEDO),
    "cloud_bright": EverydayScene(_smoke_under(lambda: _sky_and_sun(0.3), 80.0, 0.85, 0.999), 64, 120, None),
}
"""The scenes by name."""

MITSUBAS_SCENES = {
    f"{scene}_{coefficient}": EverydayScene(file, 6, 1.5, 2, f"medium1.{coefficient}.{values}", roulette=5)
    for scene, file, extinction in (
        ("area_light", "homo_area_light", "value.value"),
        ("object", "homo_obj_inside_medium", "value.value"),
        ("null_envmap", "homo_null_envmap", "value.value"),
        ("hetero", "hetero_sigmat", "data"),
    )
    for coefficient, values in (("albedo", "value.value"), ("sigma_t", extinction))
}
"""Scenes of Mitsuba's own tests, with the parameters of their gradients: measured on demand."""

ALL_SCENES = SCENES | MITSUBAS_SCENES
"""All scenes that can be named."""


# -- The contest -------------------------------------------------------------------------------------------------------

SAMPLERS = {"volpath": "independent", "volpath, multijitter": "multijitter"}
"""Samplers of the peers of images."""

PEER = "prbvolpath"
MORE_ROUNDS = 4
"""Factor on the rounds of single-number gradients, whose variance 24 rounds measure only within a factor of 1.5."""

DENSE = 0.3
"""Voxels with at least this share of the largest value count."""


@dataclass(frozen=True)
class EverydaySize(Size):
    """Amount of work."""

    scenes: tuple[str, ...] = amount(tuple(SCENES), doc="scenes to measure")
    side: int = amount(96, 12, "edge of the image [pixels]")
    spp: int = amount(64, 4, "samples per pixel of one image")
    gradient_spp: int = amount(16, 1, "samples per pixel of one gradient")
    rounds: int = amount(6, 4, "images and gradients of each method")
    seed: int = amount(0, doc="seed of all renders")


def chosen_scenes(names: Sequence[str]) -> dict[str, EverydayScene]:
    """The scenes of the given names.

    Raises:
        MivolError: an unknown scene.
    """
    for name in names:
        if name not in ALL_SCENES:
            raise MivolError(f'there is no scene "{name}": {suggest_name(name, ALL_SCENES)}')
    return {name: ALL_SCENES[name] for name in names}


def measure_images(size: EverydaySize) -> dict:
    """How much sooner has an image of mivol the same error as one of volpath?"""
    return _measure_scenes(_contend_images, size)


def measure_gradients(size: EverydaySize) -> dict:
    """How much sooner does a gradient of mivol reach the error of prbvolpath?"""
    return _measure_scenes(_contend_gradients, size)


def _measure_scenes(contend: Callable[[EverydayScene, EverydaySize], dict], size: EverydaySize) -> dict:
    rows = {}
    for name, scene in chosen_scenes(size.scenes).items():
        rows[name] = row = contend(scene, size)
        say_row(name, ratio=row["ratio"], z=row["z"])
        dr.flush_malloc_cache()
    ratios = [row["ratio"] for row in rows.values() if row["ratio"]]
    return {"scenes": rows, "geometric_mean": float(np.exp(np.mean(np.log(ratios)))) if ratios else None}


def _contend_images(scene: EverydayScene, size: EverydaySize) -> dict:
    """Errors and times of all methods, and the figures of mivol over the better peer."""
    samplers = {"mivol": "independent"} | SAMPLERS
    methods = {
        name: render_method(scene.load(size.side, sampler, size.spp), scene.integrator(name.partition(",")[0]))
        for name, sampler in samplers.items()
    }
    contest = compete(methods, size.rounds, 0.0, size.spp, seed=size.seed)
    counts = np.ones((size.side,) * 2, bool)
    comparisons = len(size.scenes) * len(SAMPLERS)
    gains = {
        peer: gain_figures(contest, peer, "mivol", counts) | agreement_figures(contest, peer, "mivol", counts, comparisons)
        for peer in SAMPLERS
    }
    better = min(gains, key=lambda peer: gains[peer]["variance_x_time_mean_over_pixels"])
    errors = {name: image_errors(contest, name, 1, counts) for name in methods}
    return {
        **errors,
        **{f"mivol over {peer}": gain for peer, gain in gains.items()},
        "peer": better,
        "ratio": gains[better]["variance_x_time_mean_over_pixels"],
        "median_ratio": gains[better]["variance_x_time_median_over_pixels"],
        "milliseconds": {name: 1e3 * contest.timings[name, 1].median for name in (better, "mivol")},
        "means": {name: errors[name]["mean"] for name in (better, "mivol")},
        "z": max((gains[peer]["z"] for peer in SAMPLERS), key=lambda z: np.inf if z is None else abs(z)),
        "z_bound": gains[better]["z_bound"],
    }


def _contend_gradients(scene: EverydayScene, size: EverydaySize) -> dict:
    """Variances and times of the gradients of both integrators, and derivatives along the logarithm of the parameter."""
    gradients = {
        name: ParameterGradient(scene.load(size.side), scene.integrator(name), scene.parameter) for name in (PEER, "mivol")
    }
    methods = {name: partial(g.of_loss, _mean_of_image) for name, g in gradients.items()}
    values = np.array(gradients["mivol"].params[scene.parameter], np.float64).ravel()
    dense = values >= DENSE * values.max()
    rounds = size.rounds * (MORE_ROUNDS if values.size <= 3 else 1)
    contest = compete(methods, rounds, 0.0, size.gradient_spp, seed=size.seed)
    times = contest.time_ratios(PEER, "mivol")
    variances = {name: contest.variances(name).ravel()[dense] for name in methods}
    along = {name: mean_of_rounds(contest.results(name).reshape(rounds, -1) @ values) for name in methods}
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, median = variances[PEER].mean() / variances["mivol"].mean(), np.nanmedian(variances[PEER] / variances["mivol"])
    # A gradient that is always 0 is no result.
    ratios = {"ratio": ratio or np.nan, "median_ratio": median}
    return {
        "variance": {name: float(v.mean()) for name, v in variances.items()},
        **{name: finite_or_none(ratio * times["processor_time"]) for name, ratio in ratios.items()},
        "milliseconds": {name: 1e3 * contest.timings[name, 1].median for name in methods},
        "means": {name: mean.mean for name, mean in along.items()},
        "standard_errors": {name: mean.var**0.5 for name, mean in along.items()},
        **times,
        **compare_means(along["mivol"], along[PEER], len(size.scenes)),
    }


def _mean_of_image(image: mi.TensorXf) -> mi.Float:
    return dr.mean(image, axis=None)


# -- Bars, table and figure -------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means of images."""
    rows = [(name, peer, row[f"mivol over {peer}"]) for name, row in answer["scenes"].items() for peer in SAMPLERS
            if question == "images"]  # fmt: skip
    return [judge_agreement(f"{name}, {peer}", figures["z"], figures["z_bound"]) for name, peer, figures in rows]


def promise(question: str, bars: dict[str, float | None], mean: float) -> list[Promise]:
    """Bars on the ratios of scenes, and on the geometric mean of the measured scenes."""
    label = f"variance x time, {question}"
    ratios = [Promise(f"{label}: {name}", ("scenes", name, "ratio"), AT_LEAST, bar) for name, bar in bars.items() if bar]
    return [*ratios, Promise(f"{label}: geometric mean", ("geometric_mean",), AT_LEAST, mean)]


PROMISES = {
    "images": promise("images", {name: scene.image_bar for name, scene in ALL_SCENES.items()}, 8),
    "gradients": promise("gradients", {name: scene.gradient_bar for name, scene in ALL_SCENES.items()}, 5),
}


def tabulate(question: str, answer: dict) -> list[str]:
    """A row for each scene."""
    lines = [
        f"| {question} | ratio | median | peer | ms, peer / mivol | mean, peer / mivol | z |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in answer["scenes"].items():
        ratios = " | ".join("none" if row[key] is None else f"{row[key]:.2f}" for key in ("ratio", "median_ratio"))
        times = " / ".join(f"{t:.0f}" for t in row["milliseconds"].values())
        means = " / ".join(f"{mean:.4g}" for mean in row["means"].values())
        z = "none" if row["z"] is None else f"{row['z']:+.1f}{'' if abs(row['z']) <= row['z_bound'] else ' (differs)'}"
        lines.append(f"| {name} | {ratios} | {next(iter(row['means']))} | {times} | {means} | {z} |")
    mean = answer["geometric_mean"]
    return [*lines, f"| geometric mean | {'none' if mean is None else f'{mean:.2f}'} | | | | | |"]


def draw(answers: dict, path: Path) -> None:
    """A panel for each question: a bar for the ratio of each scene, from the strongest to the weakest."""
    rows = max(len(answer["scenes"]) for answer in answers.values())
    with new_figure(path, 6.4 * len(answers), 1.2 + 0.3 * rows) as figure:
        for axes, (question, answer) in zip(np.atleast_1d(figure.subplots(1, len(answers))), answers.items(), strict=True):
            _plot_bars(axes, {name: row["ratio"] for name, row in answer["scenes"].items() if row["ratio"]})
            axes.set(title=question, xlabel=f"variance x time of {'volpath' if question == 'images' else PEER} over mivol")


def _plot_bars(axes: Axes, ratios: dict[str, float]) -> None:
    """Horizontal bars that begin at a ratio of 1, on a logarithmic axis."""
    names = sorted(ratios, key=ratios.__getitem__)
    values = np.array([ratios[name] for name in names])
    bars = axes.barh(names, values - 1, left=1, color=[SERIES[0] if v >= 1 else SERIES[1] for v in values])
    axes.bar_label(bars, [f"{v:.2g}×" if v < 100 else f"{v:.0f}×" for v in values], padding=2)
    axes.axvline(1, color="black", linewidth=1)
    low, high = min([*values, 1]), max([*values, 1])
    margin = max(2.0, (high / low) ** 0.15)  # room for the labels
    axes.set(xscale="log", xlim=(low / margin, high * margin))
    use_plain_ticks(axes.xaxis, "×")


QUESTIONS = {"images": measure_images, "gradients": measure_gradients}
STUDY = Study(__name__, __doc__, EverydaySize, QUESTIONS, compare, draw, tabulate, promises=PROMISES)
