"""Scenes of pbrt-v4 with media, as scenes of Mitsuba with media of mivol.

Conventions. pbrt's world is left-handed: the camera is mirrored, and the world stays. Exposure, sensor and white balance of a
film are left out. Coefficients of media are per length of the world, whatever the transform of a medium. Light of rgb 1 has
luminance 1, as with pbrt's sensor ``cie1931``. A grid is 0 outside of its bounds in pbrt, so it is written with a border of
zeros, which the boundary of the medium cuts at the bounds.

References: pbrt-v4 File Format (pbrt.org/fileformat-v4); Pharr, Jakob, Humphreys, "Physically Based Rendering", 4th edition,
sections 3.8.3 (equal-area mapping, after Clarberg 2008), 11.4 (media) and 12.2 (lights); Perlin 2002 (noise).
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
from mivol.files import read_exr, read_sparse_volume, write_exr, write_volume, write_whole_text
from mivol.files.mesh import Mesh, write_mesh
from mivol.files.nvdb import name_grids
from mivol.files.pbrt_scene import Directive, read_pbrt_scene
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
        ElementTree.SubElement(transform, "matrix", value=to_text(value.ravel()))
    elif isinstance(value, np.ndarray):
        ElementTree.SubElement(node, "rgb", name=key, value=to_text(value))
    elif isinstance(value, bool):
        ElementTree.SubElement(node, "boolean", name=key, value=str(value).lower())
    else:
        tag = "integer" if isinstance(value, int) else "float" if isinstance(value, float) else "string"
        ElementTree.SubElement(node, tag, name=key, value=str(value))


def to_text(numbers: np.ndarray) -> str:
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
                extra.append(("mivol_voxels", self.grid_file(each, "Lescale", shape, bounds, 1) | {"scale": to_text(Le)}))
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
            add(medium, "volume", "mivol_voxels", "sigma_t", **density, **({} if is_grey else {"scale": to_text(sigma_t)}))
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


SKY_ROWS = 512
"""Rows of a sky that is resampled from pbrt's square image."""


def convert_pbrt(source: Path | str, target: Path | str) -> str:
    """Write the scene of a ``.pbrt`` as Mitsuba XML: camera, film, lights, shapes, and media as ``mivol_medium``.

    Media ``homogeneous``, ``uniformgrid``, ``rgbgrid``, ``cloud`` and ``nanovdb`` are converted with their emission. A sphere
    of the material ``interface`` that holds the bounds of a grid becomes the box of the bounds. Grids, meshes and skies are
    written beside the XML; a ``.nvdb`` stays in its place.

    Args:
        source: scene of pbrt-v4.
        target: ``.xml`` to write.

    Returns:
        A line for the written file, and one that names everything that is left out.

    Raises:
        MivolError: a damaged scene, another suffix, a medium or light that is wrong, or no active variant of Mitsuba.
    """
    source, target = Path(source), Path(target)
    if target.suffix.lower() != ".xml":
        raise refusal(target, f"the suffix {target.suffix!r}", ".xml", "name a Mitsuba scene")
    directives, left_out = read_pbrt_scene(source)
    scene = _Scene(source, target, left_out)
    for directive in directives:
        scene.take(directive)
    scene.finish()
    ElementTree.indent(scene.root)
    write_whole_text(target, ElementTree.tostring(scene.root, encoding="unicode") + "\n")
    line = f"{target}: {scene.counts['shape']} shapes, {scene.counts['medium']} media, {scene.counts['emitter']} lights"
    return line + (f"\nleft out: {', '.join(dict.fromkeys(scene.left_out))}" if scene.left_out else "")


# -- Scene ---------------------------------------------------------------------------------------------------------------


PHOTOMETRIC = {"distant": ("illuminance", 1.0), "infinite": ("illuminance", np.pi), "point": ("power", 4 * np.pi)}
"""Kind of light -> its photometric parameter, and the value for light of luminance (or intensity) 1."""


class _Scene:
    """A scene that is written."""

    def __init__(self, source: Path, target: Path, left_out: list[str]) -> None:
        self.source, self.target, self.left_out = source, target, left_out
        self.root = ElementTree.Element("scene", version="3.0.0")
        self.counts = {"shape": 0, "medium": 0, "emitter": 0}
        self.media: dict[str, PlacedMedium] = {}
        self.writer = MediaWriter(source, target, left_out)
        self.first: dict[str, Directive] = {}

    def take(self, each: Directive) -> None:
        """Take one directive."""
        if each.name in ("Camera", "Film", "Sampler", "Integrator"):
            self.first[each.name] = each
        elif each.name == "MakeNamedMedium":
            self.media[each.type] = self.writer.make(each)
            self.counts["medium"] += 1
        elif each.name == "LightSource":
            self.add_light(each)
        elif each.name == "Shape":
            self.add_shape(each)

    def finish(self) -> None:
        """Add integrator, sampler, film and camera."""
        camera, film, sampler, integrator = (self.first.get(n) for n in ("Camera", "Film", "Sampler", "Integrator"))
        depth = 5 if integrator is None else int(integrator.number("maxdepth", 5))
        # pbrt counts bounces, Mitsuba segments.
        add(self.root, "integrator", "mivol", max_depth=depth + 1)
        if camera is None or camera.type != "perspective":
            self.left_out.append("no camera" if camera is None else f"the camera {camera.type!r}")
            return
        to_world = np.linalg.inv(camera.state.transform) @ np.diag([-1.0, 1, 1, 1])
        node = add(self.root, "sensor", "perspective", fov=camera.number("fov", 90.0), fov_axis="smaller", to_world=to_world)
        self.note_rest(camera, ("fov",))
        size = (
            [1280, 720] if film is None else [int(film.number(k, d)) for k, d in (("xresolution", 1280), ("yresolution", 720))]
        )
        pixels = add(node, "film", "hdrfilm", width=size[0], height=size[1])
        add(pixels, "rfilter", "gaussian")
        if film is not None:
            self.note_rest(film, ("xresolution", "yresolution", "filename", "diagonal", "savefp16"))
        add(node, "sampler", "independent", sample_count=16 if sampler is None else int(sampler.number("pixelsamples", 16)))

    def note_rest(self, each: Directive, taken: tuple[str, ...]) -> None:
        """Name the parameters that were not taken."""
        self.left_out += [f"{each.name.lower()} {name}" for name in each.parameters if name not in taken]

    # -- Lights ----------------------------------------------------------------------------------------------------------

    def add_light(self, each: Directive) -> None:
        """Add a light without a shape."""
        transform, scale = each.state.transform, each.number("scale", 1.0)
        self.counts["emitter"] += 1
        name, full = PHOTOMETRIC.get(each.type, ("", 1.0))
        if each.type == "infinite" and "filename" in each.parameters:
            name = ""  # of an image it is known only after an integral over its upper half
        self.left_out += [
            f"{n} of the light {each.type!r}" for n in ("power", "illuminance") if n in each.parameters and n != name
        ]
        if name and each.number(name, 0.0) > 0:
            scale *= each.number(name, 0.0) / full
        if each.type == "infinite" and "filename" in each.parameters:
            sky = self.source.parent / each.text("filename")
            path = self.writer.path_beside(".exr")
            write_exr(path, {"": unfold_sky(_read_image(sky)) * np.float32(scale)})
            # Mitsuba's envmap has its pole along y and its middle column along +z.
            add(self.root, "emitter", "envmap", filename=path.name, to_world=_rotation_part(transform) @ SKY_TO_PBRT)
            return
        if each.type == "infinite":
            add(self.root, "emitter", "constant", radiance=to_rgb(each.parameters.get("L"), 1.0, is_light=True) * scale)
            return
        if each.type == "distant":
            begin, end = (
                each.numbers(n) if n in each.parameters else np.array(d)
                for n, d in (("from", [0.0, 0, 0]), ("to", [0.0, 0, 1]))
            )
            L = to_rgb(each.parameters.get("L"), 1.0, is_light=True) * scale
            direction = transform[:3, :3] @ (end - begin)
            node = add(self.root, "emitter", "directional", irradiance=L)
            ElementTree.SubElement(node, "vector", name="direction", value=to_text(direction))
            return
        if each.type == "point":
            place = each.numbers("from") if "from" in each.parameters else np.zeros(3)
            node = add(self.root, "emitter", "point", intensity=to_rgb(each.parameters.get("I"), 1.0, is_light=True) * scale)
            ElementTree.SubElement(node, "point", name="position", value=to_text((transform @ [*place, 1])[:3]))
            return
        self.counts["emitter"] -= 1
        self.left_out.append(f"the light {each.type!r}")

    # -- Shapes ----------------------------------------------------------------------------------------------------------

    def add_shape(self, each: Directive) -> None:
        """Add a shape with its material, its area light and the medium inside."""
        state = each.state
        medium = self.media.get(state.medium[0]) if state.medium[0] else None
        is_interface = state.material[0] in ("interface", "", "none")
        if state.medium[1]:
            self.left_out.append(f"the medium {state.medium[1]!r} outside of a shape")
        if medium is not None and medium.bounds is not None and is_interface and _contains_bounds(each, medium.bounds):
            node = add(self.root, "shape", "cube", to_world=medium.bounds @ frame_from_box((0.5,) * 3, (1.0,) * 3))
            is_kept = True
        else:
            node, is_kept = self.make_shape(each)
        if not is_kept:
            return
        self.counts["shape"] += 1
        self.add_material(node, *(("interface", {}) if is_interface else state.material))
        if medium is not None:
            medium.write(node)
        if state.area_light is not None:
            light = state.area_light
            radiance = to_rgb(light.get("L"), 1.0, is_light=True) * float(np.ravel(light.get("scale", 1.0))[0])
            add(node, "emitter", "area", radiance=radiance)
            self.counts["emitter"] += 1

    def make_shape(self, each: Directive) -> tuple[Node, bool]:
        """The shape, and whether it is known."""
        transform = each.state.transform
        if each.type == "sphere" and _is_similarity(transform):
            return add(self.root, "shape", "sphere", to_world=transform @ np.diag([*[each.number("radius", 1.0)] * 3, 1])), True
        if each.type == "disk":
            radius, height = each.number("radius", 1.0), each.number("height", 0.0)
            place = np.diag([radius, radius, 1, 1])
            place[2, 3] = height
            return add(self.root, "shape", "disk", to_world=transform @ place), True
        if each.type == "plymesh":
            path = (self.source.parent / each.text("filename")).resolve()
            return add(self.root, "shape", "ply", filename=str(path), to_world=transform), True
        if each.type in ("trianglemesh", "bilinearmesh") and each.numbers("P") is not None:
            points = each.numbers("P").reshape(-1, 3)
            corners = 3 if each.type == "trianglemesh" else 4
            given = each.numbers("indices")
            faces = (np.arange(len(points) if corners == 4 else 3) if given is None else given).astype(int).reshape(-1, corners)
            if corners == 4:
                faces = np.concatenate([faces[:, [0, 1, 3]], faces[:, [0, 3, 2]]])
            path = self.writer.path_beside(".ply")
            write_mesh(path, Mesh(points, faces))
            return add(self.root, "shape", "ply", filename=path.name, to_world=transform), True
        self.left_out.append(f"the shape {each.type!r}" + (" with unequal scales" if each.type == "sphere" else ""))
        return Node("shape"), False

    def add_material(self, node: Node, kind: str, parameters: dict) -> None:
        """Add a material: interfaces, diffuse and coated ones, glass; others as diffuse ones, which are named."""
        if kind == "interface":
            add(node, "bsdf", "null")
            return
        value = parameters.get("reflectance")
        if isinstance(value, str):
            self.left_out.append(f"the texture {value!r}")
            value = None
        reflectance = to_rgb(value, 0.5)
        if kind in ("dielectric", "thindielectric"):
            eta = parameters.get("eta", 1.5)
            add(node, "bsdf", kind, int_ior=1.5 if isinstance(eta, str | dict) else float(np.ravel(eta)[0]))
        elif kind == "coateddiffuse":
            rough = float(np.ravel(parameters.get("roughness", 0.0))[0])
            coat = add(node, "bsdf", "twosided")
            if rough > 0:
                add(coat, "bsdf", "roughplastic", diffuse_reflectance=reflectance, alpha=max(rough**0.5, 1e-3))
            else:
                add(coat, "bsdf", "plastic", diffuse_reflectance=reflectance)
        else:
            if kind != "diffuse":
                self.left_out.append(f"the material {kind!r} (diffuse instead)")
            add(add(node, "bsdf", "twosided"), "bsdf", "diffuse", reflectance=reflectance)


def _is_similarity(transform: np.ndarray) -> bool:
    gram = transform[:3, :3].T @ transform[:3, :3]
    return bool(np.allclose(gram, gram[0, 0] * np.eye(3), rtol=0, atol=1e-6 * gram[0, 0]))


def _contains_bounds(each: Directive, bounds: np.ndarray) -> bool:
    """Whether a sphere holds the bounds of a grid. Other boundaries stay."""
    if each.type != "sphere":
        return False
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ bounds.T
    local = np.linalg.solve(each.state.transform, corners.T)[:3]
    return bool(np.linalg.norm(local, axis=0).max() <= each.number("radius", 1.0) * (1 + 1e-6))


# -- Skies ---------------------------------------------------------------------------------------------------------------

SKY_TO_PBRT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From the axes of Mitsuba's sky (pole along y) to the axes of pbrt's sky (pole along z)."""


def _rotation_part(transform: np.ndarray) -> np.ndarray:
    """The turning part of a transform."""
    matrix = np.eye(4)
    matrix[:3, :3] = transform[:3, :3] / np.linalg.norm(transform[:3, :3], axis=0)
    return matrix


def _read_image(path: Path) -> np.ndarray:
    if path.suffix.lower() != ".exr":
        raise refusal(path, f"a sky with the suffix {path.suffix!r}", ".exr", "convert the image to OpenEXR")
    channels, _ = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise refusal(path, f"channels {', '.join(channels)}", "R, G and B", "convert the image")
    return np.stack([channels[name] for name in "RGB"], axis=2)


def unfold_sky(square: np.ndarray) -> np.ndarray:
    """The sky (rows, 2 rows, 3) of Mitsuba from pbrt's square image, in the equal-area mapping of an octahedron.

    Args:
        square: (n, n, 3); row 0 is at v = 0.

    Returns:
        Rows from the pole +y down, columns around it, as Mitsuba's ``envmap``.
    """
    rows = min(SKY_ROWS, max(16, len(square)))
    theta, phi = np.meshgrid((np.arange(rows) + 0.5) * np.pi / rows, (np.arange(2 * rows) + 0.5) * np.pi / rows, indexing="ij")
    # Mitsuba: column u at (sin(2 pi u), ., -cos(2 pi u)) in x and z.
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])
    u, v = fold_direction(SKY_TO_PBRT[:3, :3] @ local.reshape(3, -1))
    n = len(square)
    x, y = u * n - 0.5, v * n - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    at = lambda a, b: square[np.clip(b, 0, n - 1), np.clip(a, 0, n - 1)]  # noqa: E731
    near = (1 - fx) * at(i, j) + fx * at(i + 1, j)
    far = (1 - fx) * at(i, j + 1) + fx * at(i + 1, j + 1)
    return ((1 - fy) * near + fy * far).reshape(rows, 2 * rows, 3).astype(np.float32)


def fold_direction(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates in the unit square of directions (3, n), by the equal-area mapping of Clarberg (2008)."""
    x, y, z = np.abs(d)
    r = np.sqrt(np.maximum(1 - z, 0))
    angle = np.arctan2(np.minimum(x, y), np.maximum(x, y)) * (2 / np.pi)
    angle = np.where(x < y, 1 - angle, angle)
    v = angle * r
    u = r - v
    u, v = np.where(d[2] < 0, 1 - v, u), np.where(d[2] < 0, 1 - u, v)
    return (np.copysign(u, d[0]) + 1) / 2, (np.copysign(v, d[1]) + 1) / 2
