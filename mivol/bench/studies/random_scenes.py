"""Do images of random scenes agree with Mitsuba's, and is the radiance of every path of hard scenes finite and not negative?

    mivol bench random_scenes                    # 20 minutes on 2 idle cores
    mivol bench random_scenes --quick            # a minute: a dozen scenes
    mivol bench random_scenes --only hard
    mivol bench random_scenes --only built
    mivol bench random_scenes --cluster local:4  # a scene is a piece of work

trials: random scenes (:func:`draw_scene`) with homogeneous media and grids, grey and rgb, in boxes and balls, one, two side by
side, or one inside the other, behind boundaries that transmit, refract or blur light; with phase functions, emitters and
surfaces; ``max_depth`` from 2 to unlimited. Each is rendered 16 times by mivol and by volpath (an rgb extinction one channel at
a time), 12 x 12 pixels, 64 samples per pixel. The means of each quarter of the image and each colour are compared by Student's
t. If all means are equal, any of all comparisons fails with a probability of 1 in 1000. Refusals are counted by their message.
The seed decides everything. Scenes avoid known errors of Mitsuba: ``heterogeneous`` has one grey majorant, so an rgb extinction
of a grid is compared with the grey scenes of its channels, and its volumes continue outside their box, so each grid fills the
box of its boundary. Emitters are not hidden.

built: as trials, with 40 random scenes as people build them: bodies, more of them homogeneous, in rooms, over floors and in
glass, and fogs without a boundary, with one to sixteen lamps inside and beside the media.

hard: an optical depth of 64, voxels of 2000, vacuum, extinctions of three colours at ratios of 10,000, nearly straight phase
functions, glass, an emitter inside: more than 1e8 paths of unlimited depth, one in each pixel. No radiance may be negative,
infinite or NaN.
"""

from __future__ import annotations

import gc
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.contests import compare_means, mean_of_rounds
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import AT_MOST, Bar, Size, Study, SweptQuestion, amount, judge, judge_agreement, say, say_row
from mivol.bench.scenes import (
    as_dense_as_smoke,
    box_scene,
    constant_light,
    emitter_inside,
    make_integrator,
    milky_glass,
    smoke,
    sun_and_sky,
    threads_in_space,
)
from mivol.errors import MivolError
from mivol.report.figures import SERIES

# -- Scenes ------------------------------------------------------------------------------------------------------------


SIDE = 12
"""Edge of the image [pixels]."""

DEPTHS = (2, 3, 4, 6, 12, -1)


@dataclass
class RandomScene:
    """A random scene.

    Attributes:
        parts: dictionary for ``mi.load_dict``.
        settings: ``max_depth`` and ``rr_depth`` of the integrators.
        features: names of the parts.
        is_rgb: an extinction has a value for each colour.
    """

    parts: dict
    settings: dict
    features: list[str]
    is_rgb: bool


@dataclass
class _Draw:
    """A scene in the making.

    Attributes:
        rng: source of all random numbers.
        channel: channel of rgb extinctions; None: all three.
        features: names of the parts so far.
        is_rgb: whether an extinction has three channels.
        is_built: whether to draw more homogeneous media, some with an rgb extinction.
    """

    rng: np.random.Generator
    channel: int | None
    features: list[str] = field(default_factory=list)
    is_rgb: bool = False
    is_built: bool = False

    def one_of(self, kinds: dict[str, float]) -> str:
        """Draw a kind in proportion to its weight, and add it to the features."""
        names, weights = list(kinds), np.array(list(kinds.values()))
        name = names[self.rng.choice(len(names), p=weights / weights.sum())]
        self.features.append(name)
        return name

    def number(self, low: float, high: float) -> float:
        """Draw a uniform number."""
        return float(self.rng.uniform(low, high))

    def chance(self, p: float) -> bool:
        """Draw an event of probability ``p``."""
        return bool(self.rng.uniform() < p)

    def colour(self, low: float, high: float) -> dict:
        """Draw a uniform colour."""
        return {"type": "rgb", "value": [self.number(low, high) for _ in range(3)]}


def draw_scene(seed: int, channel: int | None = None) -> RandomScene:
    """Draw a scene.

    Args:
        seed: decides everything.
        channel: keep only this channel of rgb extinctions; None: keep all three.
    """
    draw = _Draw(np.random.default_rng(seed), channel)
    parts: dict = {"type": "scene"}
    parts |= _bodies(draw)
    parts |= _surfaces(draw)
    parts |= _emitters(draw)
    parts["sensor"] = _camera(draw, parts)
    return _finish(draw, parts)


def draw_built_scene(seed: int, channel: int | None = None) -> RandomScene:
    """Draw a scene as people build them: homogeneous media more often than grids, and up to sixteen lamps inside and beside.

    Args:
        seed: decides everything.
        channel: keep only this channel of rgb extinctions; None: keep all three.
    """
    draw = _Draw(np.random.default_rng([seed, 1]), channel, is_built=True)
    place = PLACES[draw.one_of(dict.fromkeys(PLACES, 1.0))]
    parts = {"type": "scene"} | place(draw) | _lamps(draw)
    if "sensor" not in parts:
        parts["sensor"] = _view([draw.number(-1, 1), -3.3, draw.number(-0.5, 1)])
    return _finish(draw, parts)


def _finish(draw: _Draw, parts: dict) -> RandomScene:
    """Draw the depth."""
    depth = DEPTHS[draw.rng.integers(len(DEPTHS))]
    draw.features.append(f"depth {depth}")
    settings = {"max_depth": depth, "rr_depth": int(draw.rng.choice([5, 20]))}
    return RandomScene(parts, settings, draw.features, draw.is_rgb)


# -- Media --------------------------------------------------------------------------------------------------------------


def _bodies(draw: _Draw) -> dict:
    """Draw one body, two side by side, or one inside the other."""
    kind = draw.one_of({"one body": 0.65, "side by side": 0.2, "nested": 0.15})
    first = _body(draw, [-0.9 if kind == "side by side" else 0.0, 0, 0], draw.number(0.7, 1.1), "m1")
    if kind == "one body":
        return {"body": first}
    if kind == "side by side":
        return {"body": first, "other": _body(draw, [1.6, 0, 0], draw.number(0.5, 0.7), "m2")}
    inner = _body(draw, [0.05, -0.1, 0.02], 0.3, "m2")
    inner["exterior"] = {"type": "ref", "id": "m1"}
    # Mitsuba resolves a reference only to an object that it has loaded before.
    return {"a": first, "b": inner}


def _body(draw: _Draw, centre: list[float], size: float, name: str) -> dict:
    """Draw a closed shape with a medium."""
    place = mi.ScalarTransform4f().translate(centre)
    if draw.one_of({"cube": 0.6, "sphere": 0.4}) == "cube":
        axis = draw.rng.normal(size=3)
        place = place.rotate((axis / np.linalg.norm(axis)).tolist(), draw.number(0, 90))
        place = place.scale([size * draw.number(0.6, 1.0) for _ in range(3)])
        shape = {"type": "cube", "to_world": place}
    else:
        place, shape = place.scale(size), {"type": "sphere", "center": centre, "radius": size}
    to_grid = place @ mi.ScalarTransform4f().translate(-1).scale(2)
    return shape | {"bsdf": _boundary(draw), "interior": _medium(draw, to_grid, size) | {"id": name}}


def _boundary(draw: _Draw) -> dict:
    ior = draw.number(1.1, 1.6)
    boundaries: dict[str, dict] = {
        "null": {"type": "null"},
        "dielectric": {"type": "dielectric", "int_ior": ior},
        "roughdielectric": {"type": "roughdielectric", "int_ior": ior, "alpha": draw.number(0.1, 0.5)},
        "thindielectric": {"type": "thindielectric", "int_ior": ior},
        "mask": {"type": "mask", "opacity": draw.number(0.2, 0.8), "nested": {"type": "diffuse"}},
    }
    weights = {"null": 0.6, "dielectric": 0.12, "roughdielectric": 0.12, "thindielectric": 0.08, "mask": 0.08}
    return boundaries[draw.one_of(weights)]


def _medium(draw: _Draw, to_grid: mi.ScalarTransform4f, size: float) -> dict:
    tau, albedo = 10 ** draw.number(-0.7, 1.1), _albedo(draw, to_grid)
    kind = draw.one_of({"homogeneous": 1.5 if draw.is_built else 0.3, "grid": 0.45, "rgb grid": 0.25})
    phase = _phase(draw)
    if kind == "homogeneous":
        medium = {"type": "homogeneous", "sigma_t": tau / (2 * size), "albedo": albedo, "phase": phase}
        if draw.is_built and draw.chance(0.3):
            draw.features.append("rgb homogeneous")
            medium |= {"sigma_t": draw.colour(0.3, 1), "scale": tau / size}
        return medium
    channels = 3 if kind == "rgb grid" else 1
    res = [int(draw.rng.integers(1, 9)) for _ in range(3)]
    values = draw.rng.uniform(0, 1, (*res, channels)) ** draw.number(0.5, 4)
    if draw.chance(0.3):
        values *= draw.rng.uniform(size=res)[..., None] < 0.5
    if channels == 3:
        draw.is_rgb = True
        values *= 10 ** draw.rng.uniform(-1, 0, 3)
        values = values if draw.channel is None else values[..., draw.channel : draw.channel + 1]
    sigma_t = _grid(values * tau / size, to_grid)
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": albedo, "phase": phase}


def _albedo(draw: _Draw, to_grid: mi.ScalarTransform4f) -> dict | float:
    kind = draw.one_of({"one albedo": 0.4, "white": 0.1, "colour": 0.2, "albedo grid": 0.3})
    if kind == "albedo grid":
        return _grid(draw.rng.uniform(0, 1, (3, 2, 4, 3)), to_grid)
    return {"one albedo": draw.number(0.0, 0.99), "white": 1.0}.get(kind) or draw.colour(0.2, 0.95)


def _grid(values: np.ndarray, to_world: mi.ScalarTransform4f) -> dict:
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values.astype(np.float32)), "raw": True, "to_world": to_world}


def _phase(draw: _Draw) -> dict:
    g = draw.number(-0.6, 0.9)
    table = ",".join(f"{v:.4f}" for v in draw.rng.uniform(0.1, 1, 7))
    phases: dict[str, dict] = {
        "isotropic": {"type": "isotropic"},
        "hg": {"type": "hg", "g": g},
        "rayleigh": {"type": "rayleigh"},
        "tabphase": {"type": "tabphase", "values": table},
        "blendphase": {"type": "blendphase", "weight": draw.number(0.1, 0.9),
                       "a": {"type": "hg", "g": g}, "b": {"type": "isotropic"}},
    }  # fmt: skip
    return phases[draw.one_of({"isotropic": 0.25, "hg": 0.4, "rayleigh": 0.1, "tabphase": 0.1, "blendphase": 0.15})]


# -- Surfaces, emitters, camera ----------------------------------------------------------------------------------------------


def _surfaces(draw: _Draw) -> dict:
    parts = {}
    if draw.chance(0.4):
        down = mi.ScalarTransform4f().translate([0, 0, -1.7]).scale(4)
        bsdf = {"type": "diffuse", "reflectance": draw.colour(0.1, 0.9)}
        parts["floor"] = {"type": "rectangle", "to_world": down, "bsdf": bsdf}
        draw.features.append("floor")
    if draw.chance(0.3):
        bsdfs = {
            "diffuse ball": {"type": "twosided", "nested": {"type": "diffuse"}},
            "plastic ball": {"type": "plastic", "diffuse_reflectance": draw.colour(0.1, 0.6)},
            "metal ball": {"type": "roughconductor", "alpha": draw.number(0.2, 0.5)},
        }
        bsdf = bsdfs[draw.one_of(dict.fromkeys(bsdfs, 1.0))]
        parts["ball"] = {"type": "sphere", "center": [0.2, -1.5, 0.9], "radius": 0.3, "bsdf": bsdf}
    return parts


def _emitters(draw: _Draw) -> dict:
    """Draw one or two emitters, and add a faint sky to scenes without a sky, which could be black."""
    parts: dict = {}
    for k in range(1 if draw.chance(0.6) else 2):
        kind = draw.one_of({name: 1.0 for name in EMITTERS if name not in SKIES or not SKIES & set(draw.features)})
        parts[f"emitter{k}"] = EMITTERS[kind](draw)
    if not SKIES & set(draw.features):
        parts["sky"] = {"type": "constant", "radiance": 0.2}
    return parts


def _direction(draw: _Draw) -> np.ndarray:
    """Draw a direction, mostly upwards."""
    d = draw.rng.normal(size=3) * [1, 1, 0.5] + [0, 0, 1.2]
    return d / np.linalg.norm(d)


def _from(draw: _Draw, distance: float) -> mi.ScalarTransform4f:
    """Draw a position at a distance, aimed at the centre."""
    origin = (distance * _direction(draw)).tolist()
    return mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0.1, 0.9, 0.2])


def _envmap(draw: _Draw) -> dict:
    picture = draw.rng.uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 2
    picture[2, 5] = 20.0
    return {"type": "envmap", "bitmap": mi.Bitmap(picture)}


def _ball(draw: _Draw, inside: bool) -> dict:
    centre = [0.15, 0.1, 0.2] if inside else (2.2 * _direction(draw)).tolist()
    emitter = {"type": "area", "radiance": draw.colour(1, 6)}
    return {"type": "sphere", "center": centre, "radius": 0.2 if inside else 0.5, "emitter": emitter}


EMITTERS: dict[str, Callable[[_Draw], dict]] = {
    "constant": lambda draw: {"type": "constant", "radiance": draw.colour(0.2, 1)},
    "envmap": _envmap,
    "directional": lambda draw: {"type": "directional", "direction": (-_direction(draw)).tolist(),
                                 "irradiance": draw.colour(1, 4)},
    "point": lambda draw: {"type": "point", "position": (2.5 * _direction(draw)).tolist(), "intensity": draw.colour(5, 15)},
    "spot": lambda draw: {"type": "spot", "to_world": _from(draw, 3.0), "intensity": draw.colour(10, 30), "cutoff_angle": 30.0},
    "square": lambda draw: {"type": "rectangle", "to_world": _from(draw, 2.6).scale(draw.number(0.4, 1.0)),
                            "emitter": {"type": "area", "radiance": draw.colour(1, 6)}},
    "ball of light": lambda draw: _ball(draw, False),
    "ball of light inside": lambda draw: _ball(draw, True),
}  # fmt: skip

SKIES = {"constant", "envmap"}
"""Emitters of which a scene has one at most."""


def _camera(draw: _Draw, parts: dict) -> dict:
    origin = [draw.number(-1, 1), -4.5, draw.number(-0.5, 1.5)]
    body = parts.get("body", parts.get("a"))
    medium = {}
    # For nested bodies the position could lie in the inner body, but the sensor names the outer one.
    if body["bsdf"]["type"] == "null" and draw.chance(0.15) and "b" not in parts:
        draw.features.append("camera inside")
        origin = [0.02, -0.35, 0.05] if "other" not in parts else [-0.9, -0.2, 0.05]
        medium = {"medium": {"type": "ref", "id": "m1"}}
    return _view(origin) | medium


def _view(origin: list[float]) -> dict:
    """A camera aimed at the first body."""
    return {
        "type": "perspective",
        "fov": 42,
        "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        "sampler": {"type": "independent"},
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=[0.1, 0, 0], up=[0, 0, 1]),
    }


# -- Scenes as people build them --------------------------------------------------------------------------------------------


def _room(draw: _Draw) -> dict:
    """A closed room with a square lamp below its ceiling; the camera stands inside."""
    box = mi.ScalarTransform4f().translate([0, -0.8, 0]).scale([2.2, 3.0, 2.2])
    walls = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": draw.colour(0.2, 0.8)}}
    down = mi.ScalarTransform4f().look_at(origin=[0.3, 0.2, 2.1], target=[0.3, 0.2, 0], up=[0, 1, 0]).scale(0.5)
    lamp = {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": draw.colour(3, 9)}}
    return {"room": {"type": "cube", "to_world": box, "bsdf": walls}, "ceiling": lamp, "body": _small_body(draw)}


def _floor(draw: _Draw) -> dict:
    """A body over a floor, under a faint sky."""
    down = mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(4)
    floor = {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": draw.colour(0.1, 0.9)}}
    return {"sky": {"type": "constant", "radiance": draw.number(0.1, 0.6)}, "floor": floor, "body": _small_body(draw)}


def _glass(draw: _Draw) -> dict:
    """A ball of liquid in a thin ball of glass, under a sky with a sun."""
    radius, place = draw.number(0.5, 0.9), mi.ScalarTransform4f()
    liquid = _medium(draw, place.scale(radius).translate(-1).scale(2), radius) | {"id": "m1"}
    inner = {"type": "dielectric", "int_ior": draw.number(1.2, 1.4), "ext_ior": 1.5}
    return {
        "sky": _envmap(draw),
        "glass": {"type": "sphere", "radius": 1.1 * radius, "bsdf": {"type": "dielectric", "int_ior": 1.5}},
        "body": {"type": "sphere", "radius": radius, "bsdf": inner, "interior": liquid},
    }


def _fog(draw: _Draw) -> dict:
    """A fog without a boundary before a wall; the camera and all lamps stand in the fog."""
    fog = {"type": "homogeneous", "id": "fog", "sigma_t": draw.number(0.05, 0.5), "albedo": draw.number(0.3, 0.95)}
    back = mi.ScalarTransform4f().look_at(origin=[0, 2.5, 0], target=[0, 0, 0], up=[0, 0, 1]).scale(5)
    wall = {"type": "rectangle", "to_world": back, "bsdf": {"type": "diffuse", "reflectance": draw.colour(0.2, 0.8)}}
    sensor = _view([0.2, -3.3, 0.3]) | {"medium": {"type": "ref", "id": "fog"}}
    # Mitsuba resolves a reference only to an object that it has loaded before.
    return {"fog": fog | {"phase": _phase(draw)}, "wall": wall, "sensor": sensor}


PLACES: dict[str, Callable[[_Draw], dict]] = {"room": _room, "over a floor": _floor, "in glass": _glass, "in fog": _fog}


def _small_body(draw: _Draw) -> dict:
    """A body within a distance of 1.4 of the origin."""
    return _body(draw, [0.0, 0, 0], draw.number(0.5, 0.8), "m1")


def _lamps(draw: _Draw) -> dict:
    """Draw one, three or sixteen lamps of one power in all, inside the first body (distance 0.2) or around it."""
    count = {"one lamp": 1, "three lamps": 3, "sixteen lamps": 16}[
        draw.one_of({"one lamp": 0.4, "three lamps": 0.3, "sixteen lamps": 0.3})
    ]
    parts = {}
    for k in range(count):
        kind = draw.one_of({"point lamp": 1.0, "spot lamp": 1.0, "lamp with a shape": 1.0})
        is_inside = draw.chance(0.4)
        if is_inside:
            draw.features.append("lamp inside")
        at = (0.2 if is_inside else draw.number(1.5, 1.9)) * _direction(draw)
        intensity = {"type": "rgb", "value": [draw.number(1, 4) / count for _ in range(3)]}
        if kind == "point lamp":
            parts[f"lamp{k}"] = {"type": "point", "position": at.tolist(), "intensity": intensity}
        elif kind == "spot lamp":
            aim = mi.ScalarTransform4f().look_at(origin=at.tolist(), target=(-at).tolist(), up=[0.1, 0.9, 0.2])
            parts[f"lamp{k}"] = {"type": "spot", "to_world": aim, "intensity": intensity, "cutoff_angle": 40.0}
        else:
            emitter = {"type": "area", "radiance": {"type": "rgb", "value": [v * 30 for v in intensity["value"]]}}
            parts[f"lamp{k}"] = {"type": "sphere", "center": at.tolist(), "radius": 0.08, "emitter": emitter}
    return parts


# -- The study ---------------------------------------------------------------------------------------------------------


MEANS = 12
"""Compared means of a scene: of each quarter of the image, in each colour."""

DrawScene = Callable[[int, int | None], RandomScene]
"""Seed, channel of rgb extinctions or None -> scene."""

HARD_SIDE = 1024
"""Edge of an image of a hard scene [pixels], with one path in each pixel."""


@dataclass(frozen=True)
class RandomSize(Size):
    """Amount of work."""

    scenes: int = amount(300, 12, "number of random scenes")
    built_scenes: int = amount(40, 4, "number of random scenes as people build them")
    first: int = amount(0, doc="seed of the first scene")
    rounds: int = amount(16, doc="images of each scene")
    spp: int = amount(64, doc="samples per pixel of an image by mivol")
    stock_spp: int = amount(64, doc="samples per pixel of an image by volpath")
    hard_pictures: int = amount(16, 1, "images of 1024 x 1024 paths of each hard scene")


# -- Random scenes ----------------------------------------------------------------------------------------------------------


def make_trials(text: str, draw: DrawScene, resize: Callable[[RandomSize], RandomSize]) -> SweptQuestion:
    """A question about random scenes; a scene is a piece.

    Args:
        text: the question.
        draw: makes a scene.
        resize: puts the number of scenes into ``scenes``.
    """

    def split(size: RandomSize) -> list[int]:
        return list(range(size.first, size.first + resize(size).scenes))

    def compute(seed: int, size: RandomSize) -> dict:
        trial = try_scene(seed, resize(size), draw)
        outcome = trial.get("refused", [f"z {trial.get('z')} of {trial.get('z_bound')}"])[0]
        say(f"  scene {seed}: {outcome}: {', '.join(trial['features'])}")
        gc.collect()
        dr.flush_malloc_cache()
        return trial

    def join(size: RandomSize, trials: dict[int, dict]) -> dict:
        refused = Counter(reason for trial in trials.values() for reason in trial.get("refused", []))
        return {"scenes": resize(size).scenes, "refusals": dict(refused), "trials": trials}

    return SweptQuestion(text, split, compute, join)


measure_trials = make_trials(
    "Do the means of random scenes agree with volpath's, and is every pixel finite and not negative?",
    draw_scene,
    lambda size: size,
)
measure_built = make_trials(
    "The same for random scenes as people build them: rooms, floors, glass, fog, and lamps inside.",
    draw_built_scene,
    lambda size: replace(size, scenes=size.built_scenes),
)


def try_scene(seed: int, size: RandomSize, draw: DrawScene) -> dict:
    """Compare one scene: the largest z over the bound and the pixels without a valid radiance, or the reason of a refusal."""
    scene = draw(seed, None)
    answer: dict = {"features": scene.features}
    try:
        images = render_rounds(scene, "mivol", size.rounds, size.spp)
    except MivolError as error:
        return answer | {"refused": [re.sub(r"[\d.]+", "#", str(error))]}
    answer["not_a_radiance"] = int(np.sum(~(np.isfinite(images) & (images >= 0))))
    if scene.is_rgb:
        channels = [render_rounds(draw(seed, c), "volpath", size.rounds, size.stock_spp)[..., c] for c in range(3)]
        expected = np.stack(channels, axis=-1)
    else:
        expected = render_rounds(scene, "volpath", size.rounds, size.stock_spp)
    agreements = [
        compare_means(mean_of_rounds(a), mean_of_rounds(b), MEANS * size.scenes)
        for a, b in zip(quarter_means(images), quarter_means(expected), strict=True)
    ]
    worst = max(agreements, key=lambda f: np.inf if f["z"] is None else abs(f["z"]) / f["z_bound"])
    return answer | {"mean": float(expected.mean()), **worst}


def quarter_means(images: np.ndarray) -> np.ndarray:
    """Means (12, rounds) of the quarters of images (rounds, height, width, 3), by quarter and colour."""
    h, w = (n // 2 for n in images.shape[1:3])
    quarters = [images[:, y : y + h, x : x + w].mean(axis=(1, 2)) for y in (0, h) for x in (0, w)]
    return np.concatenate([q.T for q in quarters])


def render_rounds(drawn: RandomScene, name: str, rounds: int, spp: int) -> np.ndarray:
    """Images (rounds, height, width, 3) by one integrator, with separate seeds."""
    scene = mi.load_dict(drawn.parts)
    integrator = mi.load_dict({"type": name, **drawn.settings})
    first = 1000 if name == "mivol" else 5000
    images = (mi.render(scene, integrator=integrator, spp=spp, seed=first + k) for k in range(rounds))
    return np.array([np.array(image, np.float64) for image in images])


# -- Hard scenes ------------------------------------------------------------------------------------------------------------


def _constant_box(sigma_t: float, albedo: float, light: dict, res: int = 4) -> dict:
    return box_scene(np.full((res,) * 3, sigma_t, np.float32), HARD_SIDE, albedo, **light)


def _rgb_box() -> dict:
    """Extinctions of three colours at ratios of 10,000; red is 0 in half of the box."""
    values = np.random.default_rng(1).uniform(0, 1, (8, 8, 8, 3)) * np.array([4.0, 4e-4, 40.0])
    values[:4, ..., 0] = 0
    scene = box_scene(np.zeros((2, 2, 2), np.float32), HARD_SIDE, 0.99, **emitter_inside())
    scene["box"]["interior"]["sigma_t"]["grid"] = mi.VolumeGrid(values.astype(np.float32))
    return scene


def _smoke_box(albedo: float, light: dict) -> dict:
    return box_scene(smoke().values, HARD_SIDE, albedo, **light)


def _peaked(g: float) -> dict:
    """A sun in a sky, with a phase function that nearly follows a line."""
    return sun_and_sky() | {"phase": {"type": "hg", "g": g}}


HARD: dict[str, Callable[[], dict]] = {
    "white box of optical depth 64": lambda: _constant_box(32, 0.999, constant_light()),
    "one voxel of optical depth 2000": lambda: _constant_box(1e3, 0.9, sun_and_sky(), 1),
    "empty box": lambda: _constant_box(0, 0.9, sun_and_sky()),
    "thin as 1e-12": lambda: _constant_box(1e-12, 0.9, sun_and_sky()),
    "colours at ratios of 10,000": _rgb_box,
    "HG 0.99": lambda: _smoke_box(0.99, _peaked(0.99)),
    "HG -0.99": lambda: _smoke_box(0.99, _peaked(-0.99)),
    "emitter inside": lambda: _smoke_box(1.0, emitter_inside()),
    "glass": lambda: _smoke_box(1.0, milky_glass()),
    "threads": lambda: box_scene(as_dense_as_smoke(threads_in_space(128)).values, HARD_SIDE, 0.75, **sun_and_sky()),
}
"""Hard scenes, rendered with unlimited depth."""


def try_hard(name: str, size: RandomSize) -> dict:
    """Count the radiances of a hard scene that are not finite or negative."""
    scene, integrator = mi.load_dict(HARD[name]()), make_integrator("mivol", -1)
    counts = {"paths": 0, "not_finite": 0, "negative": 0, "brightest": 0.0}
    for k in range(size.hard_pictures):
        image = np.array(mi.render(scene, integrator=integrator, spp=1, seed=k))
        counts["paths"] += image.shape[0] * image.shape[1]
        counts["not_finite"] += int(np.sum(~np.isfinite(image)))
        counts["negative"] += int(np.sum(image < 0))
        counts["brightest"] = max(counts["brightest"], float(np.nanmax(image)))
    dr.flush_malloc_cache()
    say_row(name, **counts)
    return counts


measure_hard = SweptQuestion(
    "Is the radiance of every path of hard scenes finite and not negative?",
    lambda size: list(HARD),
    try_hard,
)


# -- Bars and figure --------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge refusals, pixels without a valid radiance, and every z."""
    if question == "hard":
        faults = {f"samples that are no radiance: {name}": f["not_finite"] + f["negative"] for name, f in answer.items()}
        return [judge(label, count, AT_MOST, 0, quiet=True) for label, count in faults.items()]
    rendered = {seed: trial for seed, trial in answer["trials"].items() if "refused" not in trial}
    rows = [judge("refused scenes", sum(answer["refusals"].values()), AT_MOST, 0)]
    rows.append(judge("pixels that are no radiance", sum(t["not_a_radiance"] for t in rendered.values()), AT_MOST, 0))
    return rows + [
        judge_agreement(f"{question}, scene {seed}", trial["z"], trial["z_bound"]) for seed, trial in rendered.items()
    ]


def draw(answers: dict, path: Path) -> None:
    """Draw a histogram of the largest z of each scene over its bound."""
    trials = [trial for answer in answers.values() for trial in answer.get("trials", {}).values()]
    shares = [abs(f["z"]) / f["z_bound"] for f in trials if f.get("z") is not None]
    with new_figure(path, 5, 4) as figure:
        axes = figure.subplots()
        axes.hist(shares, bins=np.linspace(0, 1.5, 31), color=SERIES[0])
        axes.axvline(1, color=SERIES[1], linestyle="--", label="the bound")
        axes.set(title="Random scenes against volpath", xlabel="largest |z| of 12 means, over its bound [1]", ylabel="scenes")
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.legend()


STUDY = Study(
    __name__, __doc__, RandomSize, {"trials": measure_trials, "built": measure_built, "hard": measure_hard}, compare, draw
)
