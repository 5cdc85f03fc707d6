"""Scenes of pbrt-v4 with media, as scenes of Mitsuba with media of mivol.

Conventions. pbrt's world is left-handed: the camera is mirrored, and the world stays. Exposure, sensor and white balance of a
film are left out.

References: pbrt-v4 File Format (pbrt.org/fileformat-v4); Pharr, Jakob, Humphreys, "Physically Based Rendering", 4th edition,
sections 3.8.3 (equal-area mapping, after Clarberg 2008) and 12.2 (lights).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from mivol.files import read_exr, write_exr, write_whole_text
from mivol.files.mesh import Mesh, write_mesh
from mivol.files.pbrt_scene import Directive, read_pbrt_scene
from mivol.files.source import refusal
from mivol.files.volume import frame_from_box
from mivol.scene.pbrt_media import MediaWriter, Node, PlacedMedium, add, to_rgb, words

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
            ElementTree.SubElement(node, "vector", name="direction", value=words(direction))
            return
        if each.type == "point":
            place = each.numbers("from") if "from" in each.parameters else np.zeros(3)
            node = add(self.root, "emitter", "point", intensity=to_rgb(each.parameters.get("I"), 1.0, is_light=True) * scale)
            ElementTree.SubElement(node, "point", name="position", value=words((transform @ [*place, 1])[:3]))
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
