"""What a scene needs: the facts found in it, before anything is rendered.

Conventions. Facts only; what is done about them is a plan's (:mod:`mivol.scene.plan`). Shapes, boundaries and places are
found once for each scene; values (is the albedo zero, which blocks are empty) are looked at again whenever an array has
been replaced, and never while a function is being recorded by ``dr.freeze``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.activation import Activation
from mivol.files import check_volume
from mivol.scene.coefficients import check_constant
from mivol.scene.load import check_variant
from mivol.scene.nesting import Room, bounds, extent, nesting_fault, room_of
from mivol.transport.direct import UNIFORM
from mivol.transport.lattice import Lattice, block_bounds, block_gaps, box_nodes, locate
from mivol.transport.light_grid import Coarse, coarsen
from mivol.transport.medium import Box, MediumView, Part, box_of_cube, kind_of, view_medium
from mivol.transport.optical_depth import interpolate
from mivol.transport.tracking import Blocks, find_blocks

__all__ = ["Boundary", "MediumFacts", "Needs", "find_needs", "is_scattering"]


AROUND = "space around shapes"


@dataclass(frozen=True)
class Boundary:
    """One medium and where it is: its name in the scene, the shape that it fills, and its box, if the shape is one.

    A medium that fills no shape of its own (around other shapes, around the camera, in instances) is behind ``AROUND``.
    """

    medium: mi.Medium
    name: str
    shape: str
    box: Box | None


@dataclass(frozen=True)
class MediumFacts:
    """What one medium is made of.

    ``resolutions`` are those of its grids (Z, Y, X), none for a homogeneous medium; ``emits`` tells whether it is a source of
    light, ``occupied`` which share of their blocks of cells holds anything; ``tau_max`` bounds the optical depth through its
    box [1] (None where it is not bounded by a box); ``unread``: values could not be read, because a function is being recorded.
    """

    name: str
    kind: str
    boundary: str
    extinction: str
    resolutions: tuple[tuple[int, int, int], ...]
    is_scattering: bool
    emits: bool
    phase: str
    occupied: float
    tau_max: float | None
    unread: bool = False


@dataclass(frozen=True)
class Needs:
    """The facts of a scene that a plan is made from.

    Attributes:
        variant: the active variant.
        boundaries: media and where they are.
        views: their extinction, in the same order, with its gradients.
        media: what each is made of, in the same order.
        surfaces: kinds of the shapes that are more than boundaries.
        is_veiled: some surface lets light through undeviated and is more than a boundary.
        emitters: kinds.
        lamps: of each emitter: ``uniform`` (the same from everywhere), ``sharp`` (of one position or direction) or ``wide``.
        refractive: names of the boundaries that bend or blur the light that passes them.
        start: medium that the sensor names.
        camera_inside: the camera may be inside the box around a boundary.
        parameters: keys whose derivatives are asked for.
        places: those of them that are of shapes and sensors.
        film_samples: pixels times samples of the sensor asked about.
    """

    variant: str
    boundaries: tuple[Boundary, ...]
    views: tuple[MediumView, ...]
    media: tuple[MediumFacts, ...]
    surfaces: tuple[str, ...]
    is_veiled: bool
    emitters: tuple[str, ...]
    lamps: tuple[str, ...]
    refractive: tuple[str, ...]
    start: mi.Medium | None
    camera_inside: bool
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    film_samples: int


@dataclass
class Survey:
    """What does not change while shapes stay where they are: found once, with what was read of each array.

    ``marks`` tells where boundaries were: shapes, and what another place would change of them; ``size`` is that of the scene.
    """

    boundaries: tuple[Boundary, ...]
    surfaces: tuple[str, ...]
    is_veiled: bool
    emitters: tuple[str, ...]
    lamps: tuple[str, ...]
    refractive: tuple[str, ...]
    marks: tuple[tuple[mi.Shape, object], ...] = ()
    size: float = 1.0
    looked_up: set = field(default_factory=set)
    scatters: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)
    places: dict = field(default_factory=dict)
    numbers: dict = field(default_factory=dict)
    warned: set = field(default_factory=set)

    @property
    def is_current(self) -> bool:
        """Whether no boundary has been moved since. What ``dr.freeze`` records stays where it is."""
        return dr.flag(dr.JitFlag.FreezingScope) or all(_is_at(shape, mark) for shape, mark in self.marks)


def find_needs(scene: mi.Scene, sensor: mi.Sensor, survey: Survey | None = None, spp: int = 0) -> Needs:
    """Ask a scene what it needs.

    Args:
        scene: a loaded scene.
        sensor: the one to render from.
        survey: an earlier survey of the same scene, to save finding what cannot have changed.
        spp: samples a pixel; 0 for the sampler's own count.

    Raises:
        MivolError: a variant or a medium that mivol does not render.
    """
    check_variant()
    survey = survey or survey_scene(scene)
    recording = bool(dr.flag(dr.JitFlag.FreezingScope))
    start = [] if sensor.get_medium() is None else [sensor.get_medium()]
    boundaries = (*survey.boundaries, *_around(start, survey.boundaries))
    views = tuple(view_medium(b.medium, b.box, survey.places) for b in boundaries)
    params = mi.traverse(scene)
    asked = tuple(k for k, v in params if dr.grad_enabled(v))
    media = tuple(_facts(b, view, survey, recording) for b, view in zip(boundaries, views, strict=True))
    return Needs(
        variant=mi.variant(),
        boundaries=boundaries,
        views=views,
        media=media,
        surfaces=survey.surfaces,
        is_veiled=survey.is_veiled,
        emitters=survey.emitters,
        lamps=survey.lamps,
        refractive=survey.refractive,
        start=sensor.get_medium(),
        camera_inside=_camera_inside(scene, sensor, survey),
        parameters=asked,
        places=tuple(k for k in asked if _is_place(k, params.properties[k][2])),
        film_samples=int(np.prod(sensor.film().crop_size())) * (spp or sensor.sampler().sample_count()),
    )


def _is_place(key: str, owner: object) -> bool:
    """Whether a parameter says where a shape or a sensor is; what is painted on a mesh does not."""
    name = key.rsplit(".", 1)[-1]
    painted = name.startswith(("vertex_", "face_")) and name not in ("vertex_positions", "vertex_normals", "vertex_texcoords")
    return isinstance(owner, mi.Shape | mi.Sensor) and not painted


def survey_scene(scene: mi.Scene) -> Survey:
    """Find the media, surfaces and emitters of a scene.

    Raises:
        MivolError: boundaries that do not agree which medium lies between them.
    """
    boundaries, surfaces, refractive, veiled = [], [], [], False
    shapes = scene.shapes()
    rooms = {s.ptr: room_of(s) for s in shapes if s.is_medium_transition()}
    for index, shape in enumerate(shapes):
        if shape.is_medium_transition():
            name = shape.id() or f"shape {index}"
            if shape.interior_medium() is not None:
                boundaries.append(_boundary(shape, name, rooms))
            if int(shape.bsdf().flags()) & (int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)):
                refractive.append(f"{name} ({shape.bsdf().class_name()})")
        if not _is_bare(shape):
            surfaces.append(shape.class_name())
            # What an instance shows has other BSDFs than its own.
            veiled |= _is_instance(shape) or mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)
    kinds = tuple(e.class_name() for e in scene.emitters())
    # Mitsuba makes one object of equal media: where one boundary has to be traced, all boundaries of that medium are.
    traced = {b.medium.ptr for b in boundaries if b.box is None}
    boundaries = [replace(b, box=None) if b.medium.ptr in traced else b for b in boundaries]
    boxed = {b.medium.ptr for b in boundaries if b.box is not None}
    edges = [s for s in shapes if s.is_medium_transition() and not (s.interior_medium() and s.interior_medium().ptr in boxed)]
    fault = None if dr.flag(dr.JitFlag.FreezingScope) else nesting_fault(scene, edges)
    if fault is not None:
        raise MivolError(fault)
    boundaries += _around([o for o in mi.traverse(scene).hierarchy if isinstance(o, mi.Medium)], boundaries)
    lamps = tuple(_lamp(e) for e in scene.emitters())
    marks = tuple((s, _mark(s)) for s in shapes if s.is_medium_transition())
    return Survey(tuple(boundaries), tuple(surfaces), bool(veiled), kinds, lamps, tuple(refractive), marks, extent(scene))


def _mark(shape: mi.Shape) -> object:
    """What another place would change of a shape: the array of a mesh's vertices, else its box."""
    params = mi.traverse(shape)
    # A rectangle is a mesh that keeps its vertices to itself.
    if "vertex_positions" in params:
        return dr.detach(params["vertex_positions"])
    return [*shape.bbox().min, *shape.bbox().max]


def _is_at(shape: mi.Shape, mark: object) -> bool:
    now = _mark(shape)
    return now == mark if isinstance(mark, list) else now.index == mark.index


def _lamp(emitter: mi.Emitter) -> str:
    if emitter.class_name() == UNIFORM:
        return "uniform"
    return "sharp" if int(emitter.flags()) & int(mi.EmitterFlags.Delta) else "wide"


def _is_bare(shape: mi.Shape) -> bool:
    """Whether a shape is nothing but a boundary."""
    bsdf = shape.bsdf()
    return bsdf is not None and int(bsdf.flags()) & int(mi.BSDFFlags.All) == int(mi.BSDFFlags.Null) and not shape.is_emitter()


def _is_instance(shape: mi.Shape) -> bool:
    return shape.class_name() == "Instance"


def _boundary(shape: mi.Shape, name: str, rooms: dict[int, Room]) -> Boundary:
    alone = not any(room.shares(rooms[shape.ptr]) for other, room in rooms.items() if other != shape.ptr)
    is_box = shape.class_name() == "Cube" and shape.exterior_medium() is None and _is_bare(shape) and alone
    return Boundary(shape.interior_medium(), name, shape.class_name(), box_of_cube(shape) if is_box else None)


def _around(media: Iterable[mi.Medium], boundaries: Sequence[Boundary]) -> list[Boundary]:
    """Those of some media that fill no shape of their own: found on the way, by the surfaces around them."""
    held = {b.medium.ptr for b in boundaries}
    return [Boundary(m, m.id() or "a medium without an id", AROUND, None) for m in media if m.ptr not in held]


def _camera_inside(scene: mi.Scene, sensor: mi.Sensor, survey: Survey) -> bool:
    """Whether the sensor may lie in the bounding box of a boundary that has to be traced."""
    if all(b.box is not None for b in survey.boundaries):
        return False
    eye = sensor.bbox()
    boxes = [bounds(s) for s in scene.shapes() if s.is_medium_transition() or _is_instance(s)]
    # A sensor at infinity has no box of its own: its rays start outside the scene. Walls of a room are flat.
    if not eye.valid() or not boxes:
        return False
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    # Rays begin at the near plane: this far from the eye in a field of view of 150 degrees.
    ahead = 4 * sensor.near_clip() if hasattr(sensor, "near_clip") else 0.0
    return bool((np.array(eye.max) + ahead >= low).all() and (np.array(eye.min) - ahead <= high).all())


@dataclass
class _Read:
    """What was read of an array; ``floored``: its values with 0 for those below it, None where there are none."""

    bounds: mi.Float | None
    occupied: float
    maximum: float
    floored: mi.Float | None = None


def _once(survey: Survey, kind: tuple, array: mi.Float, make: Callable[[], Any]) -> Any:
    """Make something once for each state of an array, which is kept so that its number cannot be given to another one."""
    key = (*kind, array.index)
    if key not in survey.values:
        made = make()
        survey.values = dict(list(survey.values.items())[-15:])
        survey.values[key] = (array, made)
    return survey.values[key][1]


def read_part(part: Part, survey: Survey, name: str) -> _Read:
    """Read the bounds of a part of an extinction once for each state of its array.

    Voxels below 0, where a step of an optimiser or a filter overshot, count as 0 from here on, and have the derivative that
    they would have at 0, so that a step may bring them back. The first ones of each grid of a scene are told in a warning.

    Raises:
        MivolError: NaN or infinite values (those of a radiance field may be negative only where its activation takes them);
            the first bad voxel of a grid is named. A stock grid that is looked up otherwise than between voxel centres
            with clamped borders.
    """
    array = dr.detach(part.lattice.values.array)

    def make() -> _Read:
        values, activation, floored = part.lattice.values, part.activation, None
        if activation is not None:
            _check_stored(array, activation, name)
            # Nothing is below an empty value; an extinction rises with what is stored.
            empty = activation.empty_below
            values = mi.TensorXf(dr.maximum(array, empty) if empty is not None else dr.abs(array) + 1, values.shape)
        elif not dr.all((array >= 0) & dr.isfinite(array)):
            floored = _floor(part, survey, name)
            values = mi.TensorXf(floored, values.shape)
        blocks = block_bounds(values)
        host = np.array(blocks)
        _check_look_up(part, survey, name)
        return _Read(blocks, float((host > 0).mean()), float(host.max(initial=0.0)), floored)

    read = _once(survey, ("part",), array, make)
    if read.floored is not None:
        values = part.lattice.values
        # The stock grid is not looked up again: it interpolates the values below 0, these do not.
        part.lattice.values, part.volume = mi.TensorXf(dr.replace_grad(read.floored, values.array), values.shape), None
    return read


def _floor(part: Part, survey: Survey, name: str) -> mi.Float:
    """The values of a grid with 0 for those below it; says so once for each grid of a scene.

    Raises:
        MivolError: NaN or infinite values.
    """
    values = np.array(dr.detach(part.lattice.values))
    check_volume(values, name=name, minimum=None)
    if (name, part.name) not in survey.warned:
        survey.warned.add((name, part.name))
        warnings.warn(
            f"{int((values < 0).sum())} of {values.size} values of {part.name} of the medium in {name} are below 0, the least "
            f"{values.min():.3g}: they count as 0, with the derivative at 0; add params[key] = dr.maximum(params[key], 0) "
            "after each step or filter (this is said once).",
            RuntimeWarning,
            stacklevel=2,
        )
    floored = dr.maximum(dr.detach(part.lattice.values.array), 0)
    dr.eval(floored)
    return floored


def _check_stored(array: mi.Float, activation: Activation, name: str) -> None:
    """Refuse densities of a radiance field that are none: an activation would make vacuum of them in silence."""
    if not bool(dr.all(dr.isfinite(array) & (activation.signed | (array >= 0)))):
        low, high = float(dr.min(array)[0]), float(dr.max(array)[0])
        expected = "finite numbers" if activation.signed else "finite numbers of at least 0 (without an activation)"
        raise MivolError(
            f"the density of the field in {name} lies in [{low:.4g}, {high:.4g}] (or is NaN); {expected} are expected: clip it "
            "after each step."
        )


PROBES = 2048
"""Points at which a stock grid is looked up, half of them in its outermost half voxels, half around voxels that are not 0."""

ALIKE = 0.02
"""How far a look-up may be from the trilinear one, in differences between the 8 voxels around (it is 5e-6 of a grid's size off
where a turned stock grid does not fill its boundary; the nearest voxel is about 0.4 off)."""


def _check_look_up(part: Part, survey: Survey, name: str) -> None:
    """Refuse a stock grid with another filter or with borders that are not clamped: it tells neither, but its values do."""
    volume, lattice = part.volume, part.lattice
    mixes = mi.is_monochromatic and lattice.channels > 1
    if volume is None or volume.ptr in survey.looked_up or mixes:
        return
    rng, sizes = np.random.default_rng(0), np.array(lattice.res[::-1])
    u, axis, border = rng.uniform(1e-3, 1 - 1e-3, (PROBES, 3)), rng.integers(3, size=PROBES), np.arange(PROBES // 2)
    u[border, axis[border]] = rng.uniform(0.05, 0.45, len(border)) / sizes[axis[border]]
    held = np.argwhere(np.array(lattice.values).any(axis=3))[:, ::-1]
    if len(held):
        chosen = held[rng.integers(len(held), size=PROBES - len(border))]
        u[len(border) :] = np.clip((chosen + rng.uniform(0, 1, chosen.shape)) / sizes, 1e-3, 1 - 1e-3)
    it = dr.zeros(mi.Interaction3f, PROBES)
    it.p = lattice.place(mi.Vector3f(u.T.astype(np.float32)))
    cell, frac, _ = locate(lattice, it.p, mi.Vector3f(0, 0, 1), mi.Float(0))
    nodes, c = box_nodes(cell, dr.full(dr.mask_t(mi.Vector3f), True), lattice.res), lattice.channels
    corners = [[dr.gather(mi.Float, dr.detach(lattice.values.array), k * c + i) for k in nodes] for i in range(c)]
    ours = np.array([np.array(interpolate(row, frac)) for row in corners])
    theirs = np.array(volume.eval_1(it))[None] if c == 1 else np.array(volume.eval(it))
    spread = np.ptp(np.array([[np.array(v) for v in row] for row in corners]), axis=1)
    off, most = np.abs(ours - theirs), float(np.abs(ours).max())
    groups = [*(border[axis[border] == a] for a in range(3)), slice(len(border), None)]
    if any(off[:, s].sum() > ALIKE * spread[:, s].sum() + 1e-5 * most * PROBES for s in groups):
        raise MivolError(
            f"{part.name} of the medium in {name} is a gridvolume with another filter_type than trilinear or another wrap_mode "
            "than clamp: its values between voxels are not those that rays are integrated over; leave both at these, or "
            "resample the grid."
        )
    if spread.any():
        survey.looked_up.add(volume.ptr)


def read_gaps(part: Part, survey: Survey, name: str) -> mi.UInt8:
    """Measure the gaps between the blocks of a part that hold anything, once for each state of its array."""
    array, res = dr.detach(part.lattice.values.array), part.lattice.res
    return _once(survey, ("gaps",), array, lambda: block_gaps(read_part(part, survey, name).bounds, res))


def read_blocks(part: Part, survey: Survey) -> Blocks:
    """Read what the blocks of a grid hold, once for each state of its array."""
    values = part.lattice.values
    return _once(survey, ("blocks",), dr.detach(values.array), lambda: find_blocks(values))


def read_coarse(survey: Survey, lattice: Lattice, shift: int, lists: bool) -> Coarse:
    """Make a grid coarser once for each state of its array and place; anew where a function is being recorded."""
    if dr.flag(dr.JitFlag.FreezingScope):
        return coarsen(lattice, shift, lists)
    kind = ("coarse", shift, lists, lattice.gaps is None, lattice.to_world.tobytes())
    return _once(survey, kind, dr.detach(lattice.values.array), lambda: coarsen(lattice, shift, lists))


def is_scattering(view: MediumView, survey: Survey, name: str) -> bool:
    """Whether any albedo (or sigma_s) of a medium is above 0, or its derivative is asked for. Each array is read once.

    Raises:
        MivolError: an albedo outside [0, 1].
    """
    positive = [_is_positive(a, survey, name, view.share is not None) for a in view.albedo]
    return any(positive)


def _is_positive(values: mi.TensorXf, survey: Survey, name: str, is_albedo: bool) -> bool:
    flat = dr.detach(dr.ravel(values))

    def make() -> bool:
        low, high = float(dr.min(flat)[0]), float(dr.max(flat)[0])
        # NaN fails every comparison.
        if is_albedo and not (low >= 0 and high <= 1 and bool(dr.all(dr.isfinite(flat)))):
            raise MivolError(
                f"the albedo of the medium in {name} lies in [{low:.9g}, {high:.9g}] (or is NaN); the share of light that is "
                "scattered lies in [0, 1]: clip it after each step."
            )
        return high > 0

    return _once(survey, ("albedo",), flat, make) or dr.grad_enabled(values)


def check_numbers(view: MediumView, survey: Survey, name: str) -> None:
    """Look at the constants of an extinction and its scale. Each state of them is read once.

    Raises:
        MivolError: a number that is NaN, infinite or negative.
    """
    for key, given in view.numbers.items():
        # A copy is kept: what traverse hands out changes in place, and the index of an array that is gone is given to others.
        value = dr.detach(given)
        state = _state(value)
        if survey.numbers.get((view.medium.ptr, key), (None, None))[1] != state:
            check_constant(value, key, f" of the medium in {name}")
            survey.numbers[view.medium.ptr, key] = (value, state)


def _state(value: float | mi.Float | mi.Color3f) -> float | tuple[int, ...]:
    """What changes with a number: itself, or the indices of its arrays."""
    if not dr.is_array_v(value):
        return value
    return (value.index,) if dr.depth_v(value) == 1 else tuple(v.index for v in value)


def check_light(view: MediumView, survey: Survey, name: str) -> None:
    """Look at what a medium emits. Each array is read once.

    Raises:
        MivolError: light that is negative, infinite or NaN.
    """
    for values in view.lights:
        flat = dr.detach(dr.ravel(values))
        _once(survey, ("light",), flat, lambda flat=flat: _check_emission(flat, name))


def _check_emission(flat: mi.Float, name: str) -> None:
    if not bool(dr.all(dr.isfinite(flat) & (flat >= 0))):
        low, high = float(dr.min(flat)[0]), float(dr.max(flat)[0])
        raise MivolError(
            f"the emission of the medium in {name} lies in [{low:.4g}, {high:.4g}] (or is NaN); light is finite and at "
            "least 0: clip it after each step."
        )


def _facts(boundary: Boundary, view: MediumView, survey: Survey, recording: bool) -> MediumFacts:
    grids = [p.lattice for p in view.parts if p.lattice is not None]
    phase = boundary.medium.phase_function()
    common = {
        "name": boundary.name,
        "kind": kind_of(boundary.medium),
        "boundary": _where(boundary),
        "extinction": "rgb" if view.channels == 3 else "grey",
        "resolutions": tuple(g.res for g in grids),
        "phase": _phase_name(phase),
        "emits": view.emits,
    }
    if recording:
        # What it was when it was last read; a medium that was never read may scatter.
        known = survey.scatters.get(boundary.name, True)
        return MediumFacts(**common, is_scattering=known, occupied=1.0, tau_max=None, unread=True)
    check_numbers(view, survey, boundary.name)
    check_light(view, survey, boundary.name)
    reads = [read_part(p, survey, boundary.name) for p in view.parts if p.lattice is not None]
    occupied = min((r.occupied for r in reads), default=1.0)
    scatters = survey.scatters[boundary.name] = is_scattering(view, survey, boundary.name)
    return MediumFacts(**common, is_scattering=scatters, occupied=occupied, tau_max=_tau_max(boundary, view, reads))


def _where(boundary: Boundary) -> str:
    if boundary.box is not None:
        return "a box"
    return f"{AROUND}, traced" if boundary.shape == AROUND else f"a {boundary.shape}, traced"


def _phase_name(phase: mi.PhaseFunction | None) -> str:
    """The kind of a phase function (Mitsuba calls every Python class by its base)."""
    if phase is None:
        return "none"
    return phase.class_name() if phase.class_name() != "PhaseFunction" else str(phase).partition("[")[0]


def _tau_max(boundary: Boundary, view: MediumView, reads: list[_Read]) -> float | None:
    """Bound the optical depth through a medium: its largest extinction times the diagonal of its box."""
    constants = [float(np.max(np.array(dr.detach(p.constant)))) for p in view.parts if p.constant is not None]
    if boundary.box is None:
        return None
    corners = boundary.box.corners()
    diagonal = max(np.linalg.norm(corners[i] - corners[7 - i]) for i in range(4))
    scale = float(np.max(np.array(dr.detach(view.scale))))
    return scale * (sum(constants) + sum(r.maximum for r in reads)) * float(diagonal)
