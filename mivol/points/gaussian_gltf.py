"""Gaussians in glTF: the extension ``KHR_gaussian_splatting`` in a ``.glb``, read and written.

Own reader, by :mod:`mivol.files.gltf`: pygltflib 1.16 leaves the arrays of the extension to the caller.

Conventions. A primitive of points holds centres, rotations (x, y, z, w), standard deviations, opacities, and a coefficient of
the harmonics (rgb) in each attribute. The basis is that of published files, and so are the colours: sRGB code values, as
displayed. glTF has y up and published files have y down, so both reader and writer turn half a turn about z: x and y change
their signs, with the harmonics that are odd in them. PlayCanvas' splat-transform does the same.

Source: Khronos Group, extension KHR_gaussian_splatting, 2025.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.files.gltf import GlbWriter, read_accessor, read_glb
from mivol.files.source import refusal
from mivol.points.gaussians import HIGHEST_DEGREE, Gaussians, logit, to_log_scales

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
"""Mode of a primitive of points."""

COLOUR_SPACE = "srgb_rec709_display"

TURN = np.array([-1.0, -1.0, 1.0])
"""Signs of x, y, z under half a turn about z."""

PARITY = np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
"""Sign of each basis function of the harmonics, degrees 0 to 3, under half a turn about z: that of its order m."""


def turn(gaussians: Gaussians) -> Gaussians:
    """The Gaussians after half a turn about z; twice gives the same Gaussians, with quaternions of the other sign."""
    w, x, y, z = gaussians.quaternions.T
    return Gaussians(
        gaussians.means * TURN,
        gaussians.log_scales,
        np.stack([-z, -y, x, w], axis=1),
        gaussians.opacity_logits,
        gaussians.harmonics * PARITY[: gaussians.harmonics.shape[1], None],
    )


def attribute_names(degree: int) -> list[str]:
    """Names of the coefficients up to a degree, in the order of the harmonics."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


def write_gaussian_glb(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write Gaussians; programs without the extension show coloured points."""
    turned = turn(gaussians)
    unit = turned.quaternions / np.linalg.norm(turned.quaternions, axis=1, keepdims=True)
    codes = np.concatenate([turned.base_colours(), turned.opacities()[:, None]], axis=1)
    writer = GlbWriter(scene=0, scenes=[{"nodes": [0]}], nodes=[{"mesh": 0}], extensionsUsed=[EXTENSION])
    attributes = {
        "POSITION": writer.add(turned.means, bounds=True),
        "COLOR_0": writer.add(np.round(np.clip(codes, 0, 1) * 255).astype(np.uint8), normalized=True),
        f"{EXTENSION}:ROTATION": writer.add(np.roll(unit, -1, axis=1).astype(np.float32)),
        f"{EXTENSION}:SCALE": writer.add(turned.scales()),
        f"{EXTENSION}:OPACITY": writer.add(turned.opacities()),
    }
    for number, name in enumerate(attribute_names(turned.degree)):
        attributes[name] = writer.add(turned.harmonics[:, number])
    about = {"kernel": "ellipse", "colorSpace": COLOUR_SPACE, "sortingMethod": "cameraDistance", "projection": "perspective"}
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: about}}]}]
    writer.write(file)


def read_gaussian_glb(path: Path) -> Gaussians:
    """Read the first primitive of Gaussians of a file; transforms of nodes are refused.

    Raises:
        MivolError: no Gaussians, another colour space or kernel, compressed attributes, a moved node, or attributes that
            contradict each other.
    """
    document, data = read_glb(path)
    primitive = _find_primitive(document, path)
    attributes, about = primitive.get("attributes", {}), primitive["extensions"][EXTENSION]
    if about.get("extensions"):
        found = f"Gaussians compressed by {', '.join(about['extensions'])}"
        raise refusal(path, found, "plain attributes", "write the file again without compression")
    if about.get("kernel", "ellipse") != "ellipse" or about.get("colorSpace", COLOUR_SPACE) != COLOUR_SPACE:
        found = f"kernel {about.get('kernel')}, colours {about.get('colorSpace')}"
        raise refusal(path, found, f"kernel ellipse, colours {COLOUR_SPACE}", "convert the file by the program that wrote it")
    degree = max((d for d in range(HIGHEST_DEGREE + 1) if set(attribute_names(d)) <= attributes.keys()), default=None)
    needed = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
    missing = [name for name in needed if name not in attributes] + ["SH_DEGREE_0_COEF_0"] * (degree is None)
    if missing:
        raise refusal(path, f"Gaussians without {missing[0]}", f"the attributes of {EXTENSION}", "write the file again")
    means, rotations, scales, opacities = (read_accessor(path, document, data, attributes[name]) for name in needed)
    harmonics = [read_accessor(path, document, data, attributes[name]) for name in attribute_names(degree)]
    if {len(array) for array in (rotations, scales, opacities, *harmonics)} != {len(means)}:
        raise refusal(path, "attributes of different lengths", "one value a Gaussian", "write the file again")
    return turn(
        Gaussians(
            means, to_log_scales(scales), np.roll(rotations, 1, axis=1), logit(opacities[:, 0]), np.stack(harmonics, axis=1)
        )
    )


def _find_primitive(document: dict, path: Path) -> dict:
    """The first primitive of Gaussians."""
    for number, mesh in enumerate(document.get("meshes", [])):
        for primitive in mesh.get("primitives", []):
            if EXTENSION in primitive.get("extensions", {}):
                nodes = [node for node in document.get("nodes", []) if node.get("mesh") == number]
                if any(node.keys() & {"matrix", "rotation", "translation", "scale"} for node in nodes):
                    raise refusal(path, "Gaussians in a moved node", "a node without a transform", "apply the transform first")
                return primitive
    raise refusal(path, f"no primitive of {EXTENSION}", "a glTF of 3D Gaussians", "name another file (meshes are written only)")
