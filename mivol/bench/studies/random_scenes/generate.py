"""Random scenes with media that Mitsuba renders correctly: boundaries, media, surfaces, emitters, a camera and a depth.

Two kinds: bodies before a sky (:func:`draw_scene`), and scenes as people build them: rooms, floors, glass and fog, with lamps
inside and beside the media (:func:`draw_built_scene`). The seed decides everything. Scenes avoid known errors of Mitsuba.
``heterogeneous`` has one grey majorant, so an rgb extinction of a grid is compared with the grey scenes of its channels.
Mitsuba's volumes continue outside their box, so each grid fills the box of its boundary. Emitters are not hidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

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
