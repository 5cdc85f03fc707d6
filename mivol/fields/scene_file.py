"""A radiance field as a scene of Mitsuba's (``.xml``): the field in a cube, what is behind it as an environment, and a camera.

Conventions. The files that the scene names lie beside it and are named after it. Colours of a sky are those of its field: where
they are code values, the environment holds the radiance that they stand for, as ``mivol_sh`` shows it of the field.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mivol.fields.sky import Sky
from mivol.fields.spherical import SphericalGrid
from mivol.fields.spherical_files import save_field
from mivol.files import write_exr, write_whole
from mivol.photos.photo_file import decode_srgb

__all__ = ["write_scene"]

CUBE = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
"""Mitsuba's cube is [-1, 1]^3, the place of a field that of the unit cube."""

EYE = 0.5, -0.7, 0.8
"""Where the camera stands, as a place in the unit cube of the innermost box: before it, a little above its middle."""

SCENE = """<scene version="3.0.0">
    <!-- The field that mivol wrote to {field}. Put surfaces and lights into it, and move the camera. -->
    <integrator type="mivol">
        <integer name="max_depth" value="2"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="60"/>
        <transform name="to_world">
            <lookat origin="{eye}" target="{middle}" up="{up}"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="480"/>
            <integer name="height" value="360"/>
        </film>
        <sampler type="independent">
            <integer name="sample_count" value="16"/>
        </sampler>
    </sensor>
    <shape type="cube" id="field">
        <transform name="to_world">
            <matrix value="{place}"/>
        </transform>
        <bsdf type="null"/>
        <medium name="interior" type="mivol_medium">
            <volume name="emission" type="mivol_sh">
                <string name="filename" value="{field}"/>
            </volume>
        </medium>
    </shape>
{sky}</scene>
"""

ENVIRONMENT = """    <emitter type="envmap">
        <string name="filename" value="{name}"/>
    </emitter>
"""


def write_scene(path: Path, field: SphericalGrid, sky: Sky | None = None) -> list[Path]:
    """Write a scene, the field's own file, and an environment where there is a sky.

    Args:
        path: ends in .xml.
        field: what fills the cube, with all its levels.
        sky: what is behind it, in the space of the field's colours; None for black.

    Returns:
        The files that were written, the scene first.

    Raises:
        MivolError: disk full, or a folder that is not there.
    """
    own, behind = path.with_name(f"{path.stem}-field.npz"), path.with_name(f"{path.stem}-sky.exr")
    save_field(own, field)
    written = [path, own]
    if sky is not None:
        colours = np.maximum(sky.image(), 0)
        write_exr(behind, {"": colours if field.space == "linear" else decode_srgb(colours)})
        written.append(behind)
    place = field.to_world
    numbers = {
        "eye": place[:3, :3] @ EYE + place[:3, 3],
        "middle": field.middle,
        "up": place[:3, 2],
        "place": field.level_to_world(field.levels - 1) @ CUBE,
    }
    texts = {name: " ".join(f"{value:.9g}" for value in np.ravel(values)) for name, values in numbers.items()}
    commas = {name: text.replace(" ", ", ") for name, text in texts.items() if name != "place"}
    environment = "" if sky is None else ENVIRONMENT.format(name=behind.name)
    text = SCENE.format(field=own.name, sky=environment, place=texts["place"], **commas)
    write_whole(path, lambda file: file.write(text.encode()))
    return written
