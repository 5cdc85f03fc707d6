"""Media of pbrt-v4, as media of mivol in the XML of a scene.

Conventions. Coefficients are per length of the world, whatever the transform of a medium. Light of rgb 1 has luminance 1, as
with pbrt's sensor ``cie1931``. A grid is 0 outside of its bounds in pbrt, so it is written with a border of zeros, which the
boundary of the medium cuts at the bounds.

References: pbrt-v4 File Format (pbrt.org/fileformat-v4); Pharr, Jakob, Humphreys, "Physically Based Rendering", 4th edition,
section 11.4; Perlin 2002 (noise).
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.blackbody import XYZ_TO_SRGB, blackbody_rgb, weighted_matching_functions
from mivol.files import read_sparse_volume, write_volume
from mivol.files.nvdb import name_grids
from mivol.files.pbrt_scene import Directive
from mivol.files.source import refusal
from mivol.files.volume import frame_from_box

CLOUD_VOXELS = 256
"""Voxels along an edge of a ``cloud``: 2.5 of them in a cell of its finest noise at the default frequency."""

Node = ElementTree.Element


# -- Colours -------------------------------------------------------------------------------------------------------------


def to_rgb(value: object, default: float, is_light: bool = False) -> np.ndarray:
    """An rgb triple from a value of pbrt: numbers, a spectrum of pairs, a black body.

    A light of a spectrum is scaled to the luminance 1, as pbrt scales it; its ``scale`` counts apart.

    Raises:
        MivolError: a spectrum by the name of a file.
    """
    if value is None:
        return np.full(3, default)
    if isinstance(value, dict) and "blackbody" in value:
        rgb = blackbody_rgb(np.ravel(value["blackbody"])[0])
        return rgb / max(rgb @ LUMINANCE, 1e-300)
    if isinstance(value, dict):
        pairs = np.asarray(value["spectrum"], np.float64).reshape(-1, 2)
        nm, matching = weighted_matching_functions()
        white = matching.sum(axis=0)
        xyz = np.interp(nm, *pairs.T) @ matching / white
        rgb = np.maximum(XYZ_TO_SRGB @ xyz / XYZ_TO_SRGB.sum(axis=1), 0)
        return rgb / max(rgb @ LUMINANCE, 1e-300) if is_light else rgb
    if isinstance(value, str):
        if value == "stdillum-D65":
            return np.ones(3)  # the white of sRGB
        if value == "stdillum-A":
            return to_rgb({"blackbody": 2856.0}, default, is_light)
        raise refusal("convert_pbrt", f"the spectrum {value!r}", "numbers", "replace it in the scene by an rgb value")
    return np.broadcast_to(np.asarray(value, np.float64), 3)


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# -- XML -----------------------------------------------------------------------------------------------------------------


def add(parent: Node, tag: str, kind: str, name: str = "", **properties: object) -> Node:
    """Add an object with its properties: numbers, truth values, texts, rgb triples and matrices."""
    node = ElementTree.SubElement(parent, tag, {"type": kind} | ({"name": name} if name else {}))
    for key, value in properties.items():
        put(node, key, value)
    return node


def put(node: Node, key: str, value: object) -> None:
    """Add a property to an object."""
    if isinstance(value, np.ndarray) and value.shape == (4, 4):
        transform = ElementTree.SubElement(node, "transform", name=key)
        ElementTree.SubElement(transform, "matrix", value=words(value.ravel()))
    elif isinstance(value, np.ndarray):
        ElementTree.SubElement(node, "rgb", name=key, value=words(value))
    elif isinstance(value, bool):
        ElementTree.SubElement(node, "boolean", name=key, value=str(value).lower())
    else:
        tag = "integer" if isinstance(value, int) else "float" if isinstance(value, float) else "string"
        ElementTree.SubElement(node, tag, name=key, value=str(value))


def words(numbers: np.ndarray) -> str:
    """Numbers as a text, with nine digits."""
    return " ".join(f"{float(number):.9g}" for number in numbers)


# -- Media ---------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass
class PlacedMedium:
    """A medium: what writes it into a shape, and the bounds of its grid (4, 4), unit cube to world; None without a grid."""

    write: Callable[[Node], Node]
    bounds: np.ndarray | None


class MediaWriter:
    """Media of a scene by name, and their grids beside the XML.

    Args:
        source, target: the scene of pbrt, and the XML.
        left_out: names of what is left out, to add to.
    """

    def __init__(self, source: Path, target: Path, left_out: list[str]) -> None:
        self.source, self.target, self.left_out = source, target, left_out
        self.files = 0

    def path_beside(self, suffix: str) -> Path:
        """A new file beside the XML."""
        self.files += 1
        return self.target.with_name(f"{self.target.stem}_{self.files}{suffix}")

    def make(self, each: Directive) -> PlacedMedium:
        """Make a medium, and write its grids."""
        kind = each.text("type")
        makers = {
            "homogeneous": self.make_homogeneous,
            "uniformgrid": self.make_uniform,
            "rgbgrid": self.make_rgb,
            "cloud": self.make_cloud,
            "nanovdb": self.make_nanovdb,
        }
        if kind not in makers:
            raise refusal(
                self.source, f"the medium {each.type!r} of type {kind!r}", f"one of {', '.join(makers)}", "correct it"
            )
        return makers[kind](each)

    def make_homogeneous(self, each: Directive) -> PlacedMedium:
        """A medium that fills its boundary."""
        if "preset" in each.parameters:
            found = f"the preset {each.text('preset')!r} of the medium {each.type!r}"
            raise refusal(self.source, found, "sigma_a and sigma_s", "write the coefficients into the scene")
        sigma_t, albedo = self.coefficients(each)
        properties = {"sigma_t": sigma_t, "albedo": albedo}
        if "Le" in each.parameters:
            properties["emission"] = to_rgb(each.parameters["Le"], 0, is_light=True) * each.number("Lescale", 1.0)
        return PlacedMedium(lambda shape: self.write(shape, each, **properties), None)

    def make_uniform(self, each: Directive) -> PlacedMedium:
        """A grid of densities in the scene, with a grid of temperatures, or a light and a grid of its factors."""
        shape, bounds = self.grid_size(each)
        density = self.grid_file(each, "density", shape, bounds, 1)
        extra = []
        if (temperature := each.numbers("temperature")) is not None and len(temperature):
            heat = self.grid_file(each, "temperature", shape, bounds, 1)
            extra.append(("mivol_blackbody", heat | self.temperature(each, each.number("Lescale", 1.0))))
        elif "Le" in each.parameters:
            Le = to_rgb(each.parameters["Le"], 0, is_light=True)
            if "Lescale" in each.parameters:
                extra.append(("mivol_voxels", self.grid_file(each, "Lescale", shape, bounds, 1) | {"scale": words(Le)}))
            else:
                extra.append(("", Le))
        return self.make_grid(each, density, extra, bounds)

    def make_rgb(self, each: Directive) -> PlacedMedium:
        """Grids of coloured coefficients in the scene."""
        shape, bounds = self.grid_size(each)
        scale = each.number("scale", 1.0)
        files = {}
        for name in ("sigma_a", "sigma_s"):
            if name in each.parameters:
                files[name] = self.grid_file(each, name, shape, bounds, 3, scale)
        if not files:
            raise refusal(self.source, f"the medium {each.type!r} without sigma_a and sigma_s", "one of them", "add it")
        light = self.grid_file(each, "Le", shape, bounds, 3, each.number("Lescale", 1.0)) if "Le" in each.parameters else None

        def write(shape_node: Node) -> Node:
            medium = self.write(shape_node, each)
            for name in ("sigma_a", "sigma_s"):
                if name in files:
                    add(medium, "volume", "mivol_voxels", name, **files[name])
                else:
                    put(medium, name, 0.0)
            if light is not None:
                add(medium, "volume", "mivol_voxels", "emission", **light)
            return medium

        return PlacedMedium(write, bounds)

    def make_cloud(self, each: Directive) -> PlacedMedium:
        """A cloud of noise, as a grid beside the XML."""
        bounds = self.bounds(each)
        low, high = bounds_corners(each)
        numbers = [each.number(k, d) for k, d in (("density", 1.0), ("wispiness", 1.0), ("frequency", 5.0))]
        values = make_cloud(CLOUD_VOXELS, low, high, *numbers)
        path = self.path_beside(".vdb")
        write_volume(path, values, bounds)
        self.left_out.append("the table of pbrt's noise: the cloud has its statistics and another shape")
        return self.make_grid(each, {"filename": path.name, "use_grid_bbox": True}, [], bounds)

    def make_nanovdb(self, each: Directive) -> PlacedMedium:
        """The grids of a file, which stays in its place."""
        path = (self.source.parent / each.text("filename")).resolve()
        name = each.text("gridname", "density")
        volume = read_sparse_volume(path, name)
        to_medium, place = each.state.transform, volume.to_world
        file = {"filename": str(path), "use_grid_bbox": True, "to_world": to_medium}
        # pbrt's bounds reach from the first voxel's centre to one voxel behind the last one's.
        size = np.asarray(volume.size, np.float64)
        bounds = to_medium @ place @ frame_from_box(0.5 / size, (size + 0.5) / size)
        extra = []
        heat = each.text("temperaturename", "temperature")
        if heat in name_grids(path):
            light = {"grid": heat} | file | self.temperature(each, each.number("LeScale", each.number("Lescale", 1.0)))
            extra.append(("mivol_blackbody", light))
        return self.make_grid(each, {"grid": name} | file, extra, bounds)

    def make_grid(self, each: Directive, density: dict, lights: list[tuple[str, object]], bounds: np.ndarray) -> PlacedMedium:
        """A medium of a density grid times sigma_a and sigma_s, with at most one light."""
        sigma_t, albedo = self.coefficients(each)
        is_grey = np.ptp(sigma_t) <= 1e-6 * sigma_t.max()

        def write(shape: Node) -> Node:
            medium = self.write(shape, each, albedo=albedo, **({"scale": float(sigma_t[0])} if is_grey else {}))
            add(medium, "volume", "mivol_voxels", "sigma_t", **density, **({} if is_grey else {"scale": words(sigma_t)}))
            for kind, properties in lights:
                if kind:
                    add(medium, "volume", kind, "emission", **properties)
                else:
                    put(medium, "emission", properties)
            return medium

        return PlacedMedium(write, bounds)

    def write(self, shape: Node, each: Directive, **properties: object) -> Node:
        """Write a medium with its phase function into a shape."""
        medium = add(shape, "medium", "mivol_medium", "interior", **properties)
        if g := each.number("g", 0.0):
            add(medium, "phase", "mivol_hg", g=g)
        return medium

    def coefficients(self, each: Directive) -> tuple[np.ndarray, np.ndarray]:
        """Extinction and albedo, rgb."""
        sigma_a, sigma_s = (
            to_rgb(each.parameters.get(name), 1.0) * each.number("scale", 1.0) for name in ("sigma_a", "sigma_s")
        )
        sigma_t = sigma_a + sigma_s
        if not (np.isfinite(sigma_t) & (sigma_a >= 0) & (sigma_s >= 0)).all():
            raise refusal(
                self.source, f"coefficients of the medium {each.type!r} below 0", "finite numbers of at least 0", "correct them"
            )
        return sigma_t, np.divide(sigma_s, sigma_t, out=np.zeros(3), where=sigma_t > 0)

    def temperature(self, each: Directive, scale: float) -> dict[str, object]:
        """Parameters of the light of temperatures."""
        offset = each.number("temperatureoffset", each.number("temperaturecutoff", 0.0))
        return {"kelvin": each.number("temperaturescale", 1.0), "offset": offset, "normalize": True, "scale": scale}

    def bounds(self, each: Directive) -> np.ndarray:
        """Unit cube to world of the bounds p0 to p1."""
        return each.state.transform @ frame_from_box(*bounds_corners(each))

    def grid_size(self, each: Directive) -> tuple[tuple[int, int, int], np.ndarray]:
        """Voxels (Z, Y, X) and bounds of a grid in the scene."""
        size = tuple(int(each.number(name, 1)) for name in ("nz", "ny", "nx"))
        if min(size) < 1:
            raise refusal(self.source, f"a medium of {size[::-1]} voxels", "at least one along each axis", "correct nx, ny, nz")
        return size, self.bounds(each)

    def grid_file(
        self, each: Directive, name: str, shape: tuple[int, int, int], bounds: np.ndarray, channels: int, factor: float = 1.0
    ) -> dict[str, object]:
        """Write a grid of the scene with a border of zeros; return the properties of its volume."""
        numbers, count = each.numbers(name), int(np.prod(shape)) * channels
        if numbers is None or len(numbers) != count:
            found = f"{0 if numbers is None else len(numbers)} numbers {name} of the medium {each.type!r}"
            raise refusal(self.source, found, f"{count}", "correct nx, ny, nz or the numbers")
        values = np.pad(numbers.reshape(*shape, channels) * factor, [(1, 1)] * 3 + [(0, 0)])
        size = np.array(shape[::-1], np.float64)
        place = bounds @ frame_from_box(-1 / size, 1 + 1 / size)
        path = self.path_beside(".nrrd")
        write_volume(path, values, place)
        return {"filename": path.name, "use_grid_bbox": True}


def bounds_corners(each: Directive) -> tuple[np.ndarray, np.ndarray]:
    """The corners p0 and p1 of a medium."""
    low, high = (np.full(3, d) if each.numbers(n) is None else each.numbers(n) for n, d in (("p0", 0.0), ("p1", 1.0)))
    return np.minimum(low, high), np.maximum(low, high)


# -- Clouds --------------------------------------------------------------------------------------------------------------

OCTAVE = 1.99
"""Ratio of frequencies of two octaves."""


def make_cloud(count: int, low: np.ndarray, high: np.ndarray, density: float, wispiness: float, frequency: float) -> np.ndarray:
    """The density of pbrt's ``cloud`` at the centres of count^3 voxels of a box, float32 (Z, Y, X, 1).

    Five octaves of noise at places that two octaves of its gradient have moved, clamped and thinned with height y. The noise
    is Perlin's with a table of its own.
    """
    node = dr.arange(mi.UInt32, count**3)
    index = (node % count, node // count % count, node // count**2)
    p = mi.Point3f(
        *(
            mi.Float(a) + (mi.Float(k) + 0.5) * ((b - a) / count)
            for k, a, b in zip(index, low.tolist(), high.tolist(), strict=True)
        )
    )
    table = mi.UInt32(np.random.default_rng(0).permutation(256).astype(np.uint32))
    at = frequency * p
    if wispiness > 0:
        size, scale = 0.05 * wispiness, 10.0
        for _ in range(2):
            at += size * noise_gradient(scale * at, table)
            size, scale = 0.5 * size, OCTAVE * scale
    total, size, scale = mi.Float(0), 0.5, 1.0
    for _ in range(5):
        total += size * noise(scale * at, table)
        size, scale = 0.5 * size, OCTAVE * scale
    value = dr.clip((1 - p.y) * 4.5 * density * total, 0, 1) + 2 * dr.maximum(0, 0.5 - p.y)
    return np.array(dr.clip(value, 0, 1)).reshape(count, count, count, 1)


def noise(p: mi.Point3f, table: mi.UInt32) -> mi.Float:
    """Perlin's gradient noise: 0 at the corners of the unit lattice, between -1 and 1.

    Args:
        p: places.
        table: a permutation of 0 to 255.
    """
    cell = dr.floor(p)
    at, f = mi.Point3i(cell), p - cell
    fade = f * f * f * (f * (f * 6 - 15) + 10)
    corners = []
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                number = mi.UInt32(0)
                for axis, step in zip(at, (dx, dy, dz), strict=True):
                    number = dr.gather(mi.UInt32, table, (mi.UInt32(axis + step) + number) & 255)
                # One of the twelve directions to the middles of a cube's edges, four of them twice.
                way = number & 15
                x, y, z = f.x - dx, f.y - dy, f.z - dz
                u = dr.select(way < 8, x, y)
                v = dr.select(way < 4, y, dr.select((way == 12) | (way == 14), x, z))
                corners.append(dr.select((way & 1) == 0, u, -u) + dr.select((way & 2) == 0, v, -v))
    while len(corners) > 1:
        share = {8: fade.x, 4: fade.y, 2: fade.z}[len(corners)]
        corners = [dr.lerp(a, b, share) for a, b in zip(corners[::2], corners[1::2], strict=True)]
    return corners[0]


def noise_gradient(p: mi.Point3f, table: mi.UInt32) -> mi.Vector3f:
    """The gradient of :func:`noise` by forward differences, as pbrt takes it."""
    step, here = 0.01, noise(p, table)
    return mi.Vector3f(*(noise(p + mi.Vector3f(*(step * np.eye(3)[axis]).tolist()), table) - here for axis in range(3))) / step
