"""Where the media, surfaces and emitters of a scene are: found once, and valid while no shape moves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedFunctions, is_recording
from mivol.scene.nesting import OrientedBox, find_nesting_fault, oriented_box, scene_diagonal, shape_bounds
from mivol.scene_graph import traverse
from mivol.transport.estimators.lighting.emitters import UNIFORM_EMITTER, find_lit_box
from mivol.transport.media.body import Body
from mivol.transport.media.medium_view import MediumView, nested_field, view_medium
from mivol.transport.media.phases import Phase
from mivol.transport.media.stock_grids import StockGrids
from mivol.transport.path.event import GLASS
from mivol.transport.traversal.box import Box, fit_ball, fit_box

MAX_FOLLOWED_SURFACES = 16
"""Most surfaces whose placement is compared when a parameter has changed: 20 microseconds each."""

MAX_FACES = 64
"""Most faces of a mesh whose planes are looked for."""

MAX_SURFACE_BOXES = 8
"""Most boxes around surfaces: testing a ray against eight boxes takes a third of the time of tracing the ray."""

BOX_MARGIN = 1e-5
"""Width by which a box exceeds its surface, over its size and distance from the origin [1]: tracing in float32 is off by 1e-7
of these, and a ray spawned at a surface begins 1e-4 of them away."""

OUTSIDE_SHAPES = "space around shapes"
"""Class of shape of a medium that fills no shape."""


@dataclass(frozen=True)
class BranchNoise:
    """What a preview measures of paths up to and behind their first collision.

    Attributes:
        stem, branch: variance in a pixel of the light of a stem (up to and at the first collision), and of a branch behind it.
        share: share of camera rays with a collision [1].
        events: mean number of scattering events of a branch.
    """

    stem: float
    branch: float
    share: float
    events: float


@dataclass(frozen=True)
class OwnRaysNoise:
    """What a preview measures of light that may have camera rays of its own: variances in a pixel, for one sample.

    Attributes:
        paths: of all light, by paths alone.
        rest: of the light of paths without this light.
        rays: of this light, along rays of its own.
    """

    paths: float
    rest: float
    rays: float


@dataclass(frozen=True)
class MirrorNoise:
    """Noise of the light mirrored by glass, measured by a preview: variances in a pixel, for one sample.

    Attributes:
        own: of paths, and of own camera rays for the light mirrored by the first glass.
        kept: of paths with a kept mirrored ray; infinite without exact transmittances.
    """

    own: OwnRaysNoise
    kept: float


@dataclass(frozen=True)
class RefractedNoise:
    """Noise of paths beside lamps behind smooth glass, measured by a preview: variances in a pixel, for one sample.

    Attributes:
        by_chance: of paths that meet these lamps by chance.
        drawn: of paths that draw a direction to a lamp at each vertex.
    """

    by_chance: float
    drawn: float


@dataclass(frozen=True, kw_only=True)
class ShapeFacts:
    """The facts about shapes and emitters.

    Attributes:
        surfaces: class names of the shapes that are more than boundaries.
        has_null_transmission: whether a surface passes light undeviated and is more than a boundary.
        emitters: class names of the emitters.
        emitter_kinds: kind of each emitter: ``uniform`` (environment of one radiance), ``delta`` (one position or direction)
            or ``extended``.
        are_emitters_far: whether all emitters are at infinity, and at least one emitter is not ``uniform``.
        refractive: names of the boundaries that refract or blur transmitted light.
        is_sealed: whether every medium lies behind refracting boundaries without undeviated light, with all emitters outside
            and hittable by paths. Emitter sampling then finds no light from inside a medium.
        stops_rays: whether every traced boundary of a medium stops or turns all rays, so that a segment stays in one medium.
        has_glass: whether a surface is smooth glass, and every surface that only mirrors and transmits is.
        flipped: whether the normals of each shape are flipped, as by a mirrored transform.
        surface_boxes: (3, 4) maps from the world to cubes [-1, 1]^3 around the ``surfaces``; None for many surfaces, with
            instances, or with a traced boundary of a medium.
        lit_box: corners (2, 3) of the box around the boundaries of media [length]
            (:func:`mivol.transport.estimators.lighting.emitters.find_lit_box`).
    """

    surfaces: tuple[str, ...] = ()
    has_null_transmission: bool = False
    emitters: tuple[str, ...] = ()
    emitter_kinds: tuple[str, ...] = ()
    are_emitters_far: bool = False
    refractive: tuple[str, ...] = ()
    is_sealed: bool = False
    stops_rays: bool = False
    has_glass: bool = False
    flipped: tuple[bool, ...] = ()
    surface_boxes: tuple[np.ndarray, ...] | None = None
    lit_box: np.ndarray | None = None

    @property
    def structure(self) -> tuple:
        """All but the places of shapes: facts with the same structure have the same plan."""
        placed = {"surface_boxes": self.surface_boxes and len(self.surface_boxes), "lit_box": None}
        return tuple(({name.name: getattr(self, name.name) for name in fields(ShapeFacts)} | placed).values())


@dataclass
class SceneSurvey:
    """The media of a scene, the facts about shapes and emitters, and a cache of values read from arrays.

    Attributes:
        boundaries: the media with their boundaries.
        facts: the facts about shapes and emitters.
        marks: placement of each boundary, and of each surface with a box: the array of its vertices, its matrix, or its box.
        size: diagonal of the box around all shapes [length].
        tracer: scene of the surfaces and traced boundaries alone; None to trace the whole scene.
        scatters: whether each medium scattered at the last reading, by name.
        values, numbers: results of reading arrays and constants (:mod:`mivol.scene.readings`).
        reads: keys of the values that the previous render and the present one have read.
        distances: distances of blocks to occupied blocks, with the pattern of these, by medium and part.
        recorded: kernels that read grids.
        grids: places and filters of stock grids.
        cosines: mean cosines of phase functions, by the name of the medium.
        warned: media and grids with a warning already given.
        misplaced: names of the grids of each medium that lie outside of its shapes.
        media_light: the light of the media with the arrays behind the light, and the density, boxes and gain of the last
            prediction (:mod:`mivol.scene.media_light`); None before the first reading.
        gain_of_draws: measured gain of sampling the light of media [1] (:mod:`mivol.scene.previews`); None before a
            measurement.
        near_gain: measured gain of drawing the light of near emitters along segments [1]; None before a measurement.
        lamp_noise: measured variances of the light of lamps seen directly, and of all other light, by sensor.
        emission_noise: what previews have measured of the light of media seen directly, by sensor.
        branch_noise: what previews have measured of branching paths, by sensor.
        mirror_noise: what previews have measured of the light that glass mirrors to the camera, by sensor.
        refracted_noise: what previews have measured of the light of lamps behind glass, by sensor.
    """

    boundaries: tuple[Boundary, ...]
    facts: ShapeFacts
    marks: tuple[tuple[mi.Shape, object], ...] = ()
    size: float = 1.0
    tracer: mi.Scene | None = None
    scatters: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)
    reads: list[set] = field(default_factory=lambda: [set(), set()])
    distances: dict = field(default_factory=dict)
    recorded: RecordedFunctions = field(default_factory=RecordedFunctions)
    grids: StockGrids = field(default_factory=StockGrids)
    numbers: dict = field(default_factory=dict)
    cosines: dict = field(default_factory=dict)
    warned: set = field(default_factory=set)
    misplaced: dict = field(default_factory=dict)
    media_light: tuple | None = None
    gain_of_draws: float | None = None
    near_gain: float | None = None
    lamp_noise: dict[int, tuple[float, float]] = field(default_factory=dict)
    emission_noise: dict[int, OwnRaysNoise] = field(default_factory=dict)
    branch_noise: dict[int, BranchNoise] = field(default_factory=dict)
    mirror_noise: dict[int, MirrorNoise] = field(default_factory=dict)
    refracted_noise: dict[int, RefractedNoise] = field(default_factory=dict)

    @property
    def may_gain(self) -> bool:
        """Whether the last prediction found a gain of sampling the light of media."""
        return self.media_light is not None and self.media_light[3][2] > 1

    @property
    def usable_tracer(self) -> mi.Scene | None:
        """The tracer; None while ``dr.freeze`` records a function that has not been given it."""
        return None if is_recording() else self.tracer

    @property
    def is_current(self) -> bool:
        """Whether no boundary has moved since the survey. While ``dr.freeze`` records, placements cannot be read and count as
        unmoved.
        """
        return is_recording() or not self._find_moved()

    def _find_moved(self) -> set[int]:
        """Pointers of the shapes that have moved since the survey."""
        return {shape.ptr for shape, mark in self.marks if not _is_unmoved(shape, mark)}

    def follow_shapes(self, scene: mi.Scene) -> SceneSurvey | None:
        """The survey of the same scene whose shapes have moved, with all that was read of values so far; None if more than
        places has changed.

        Raises:
            MivolError: boundaries that disagree about the medium between them.
        """
        now = survey_scene(scene, self)
        if now.facts.structure != self.facts.structure or len(now.boundaries) != len(self.boundaries):
            return None
        if any(a.structure != b.structure for a, b in zip(now.boundaries, self.boundaries, strict=True)):
            return None
        placed = {name: getattr(now, name) for name in ("boundaries", "facts", "marks", "size", "tracer")}
        return replace(self, misplaced={}, **placed)


def survey_scene(scene: mi.Scene, before: SceneSurvey | None = None) -> SceneSurvey:
    """Find the media, surfaces and emitters of a scene.

    Args:
        scene: the scene.
        before: a survey of the same shapes, some of which may have moved since.

    Raises:
        MivolError: boundaries that disagree about the medium between them.
    """
    moved = None if before is None else before._find_moved()
    boundaries, surfaces, refractive, has_null = [], [], [], False
    shapes = scene.shapes()
    boxes = {s.ptr: oriented_box(s) for s in shapes if s.is_medium_transition()}
    named = {s.get_medium().ptr for s in scene.sensors() if s.get_medium() is not None}
    for index, shape in enumerate(shapes):
        if shape.is_medium_transition():
            name = shape.id() or f"shape {index}"
            if shape.interior_medium() is not None:
                boundaries.append(_make_boundary(shape, name, boxes, named))
            if int(shape.bsdf().flags()) & (int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)):
                refractive.append(f"{name} ({shape.bsdf().class_name()})")
        if not _is_bare(shape):
            surfaces.append(shape)
            # The shapes of an instance have other BSDFs than the instance itself.
            has_null |= is_instance(shape) or mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)
    # Mitsuba merges equal media into one object: if a boundary of a medium is traced, all its boundaries are.
    traced = {b.medium.ptr for b in boundaries if b.box is None}
    boundaries = [replace(b, box=None) if b.medium.ptr in traced else b for b in boundaries]
    boxed = {b.medium.ptr for b in boundaries if b.box is not None}
    edges = [s for s in shapes if s.is_medium_transition() and not (s.interior_medium() and s.interior_medium().ptr in boxed)]
    is_checked = moved is not None and not any(s.is_medium_transition() and s.ptr in moved for s in shapes)
    fault = None if is_recording() or is_checked else find_nesting_fault(scene, edges)
    if fault is not None:
        raise MivolError(fault)
    around = find_outside_media([o for o in traverse(scene).hierarchy if isinstance(o, mi.Medium)], boundaries)
    endless = _find_endless_media(boundaries, shapes, boxes)
    boundaries = [replace(b, around=None) if b.medium.ptr in endless else b for b in boundaries]
    boundaries = [part for boundary in boundaries for part in _split_levels(boundary)] + around
    solid = [*surfaces, *(s for s in edges if _is_bare(s))]
    # A GPU traces rays in hardware.
    follows = mi.variant().startswith("llvm") and 0 < len(solid) <= MAX_FOLLOWED_SURFACES and not is_recording()
    # Mitsuba cannot put an instance into another scene, and keeps its box if a shape of its group moves.
    has_instances = any(is_instance(s) for s in solid)
    is_traced_alone = follows and boxed and not has_instances
    if moved is not None and not any(s.ptr in moved for s in solid):
        tracer = before.tracer
    else:
        tracer = _make_tracer(solid) if is_traced_alone else None
    # Inside of a traced boundary, every ray meets its box.
    has_boxes = follows and not has_instances and all(b.box or b.shape == OUTSIDE_SHAPES for b in boundaries)
    pieces = tuple(rows for s in solid for rows in _surface_boxes(s)) if has_boxes else ()
    marked = [s for s in shapes if s.is_medium_transition() or follows]
    marks = tuple((s, _read_placement(s)) for s in marked)
    facts = ShapeFacts(
        surfaces=tuple(s.class_name() for s in surfaces),
        has_null_transmission=bool(has_null),
        emitters=tuple(e.class_name() for e in scene.emitters()),
        emitter_kinds=tuple(_emitter_kind(e) for e in scene.emitters()),
        are_emitters_far=_are_emitters_far(scene.emitters()),
        refractive=tuple(refractive),
        is_sealed=_are_sealed(boundaries, shapes, scene.emitters()),
        has_glass=_has_glass(surfaces),
        stops_rays=not has_null and not any(_is_bare(edge) for edge in edges),
        flipped=tuple(shape.has_flipped_normals() for shape in shapes),
        surface_boxes=pieces if 0 < len(pieces) <= MAX_SURFACE_BOXES else None,
        lit_box=find_lit_box(scene),
    )
    return SceneSurvey(tuple(boundaries), facts, marks, scene_diagonal(scene), tracer)


def _find_endless_media(boundaries: Sequence[Boundary], shapes: Sequence[mi.Shape], boxes: dict[int, OrientedBox]) -> set[int]:
    """Pointers of the media that also surround a shape outside of the shapes they fill: such a medium has no known end."""
    endless = set()
    for shape in shapes:
        if shape.is_medium_transition() and shape.exterior_medium() is not None:
            medium = shape.exterior_medium().ptr
            if not any(b.medium.ptr == medium and b.around.contains(boxes[shape.ptr]) for b in boundaries):
                endless.add(medium)
    return endless


def _read_placement(shape: mi.Shape) -> object:
    """The placement of a shape: the array of its points, else the matrix or the bounding box."""
    params = traverse(shape)
    # A rectangle is a mesh, but does not expose its vertices.
    points = next((params[name] for name in ("vertex_positions", "control_points") if name in params), None)
    if points is None and "to_world" in params:
        points = params["to_world"].matrix
    return [*shape.bbox().min, *shape.bbox().max] if points is None else dr.detach(points)


def _has_glass(surfaces: Sequence[mi.Shape]) -> bool:
    """Whether smooth glass is among some surfaces, and no other BSDF has its components (a mask on a mirror has)."""
    if any(is_instance(shape) for shape in surfaces):
        return False
    bsdfs = (shape.bsdf() for shape in surfaces)
    names = {bsdf.class_name() for bsdf in bsdfs if int(bsdf.flags()) & int(mi.BSDFFlags.All) in GLASS}
    return bool(names) and names <= {"SmoothDielectric", "ThinDielectric"}


def _make_tracer(shapes: list[mi.Shape]) -> mi.Scene:
    """A scene of some shapes of another scene."""
    names = [shape.id() for shape in shapes]
    tracer = mi.load_dict({"type": "scene"} | {f"surface {k}": shape for k, shape in enumerate(shapes)}, optimize=False)
    # Mitsuba has renamed the shapes by their new keys, and a user finds parameters by the old names.
    for shape, name in zip(shapes, names, strict=True):
        shape.set_id(name)
    return tracer


def _surface_boxes(shape: mi.Shape) -> list[np.ndarray]:
    """(3, 4) maps from the world to cubes [-1, 1]^3 around the pieces of a shape.

    The faces of a small mesh count as pieces by their planes, since Mitsuba merges the walls of a room into one mesh.
    """
    params = traverse(shape)
    if shape.class_name() == "Rectangle":
        placed = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        return [_map_to_cube((placed @ [[-1, 1, 1, -1], [-1, -1, 1, 1], [0] * 4, [1] * 4])[:3].T)]
    if shape.class_name() != "Cube" and "faces" in params and len(params["faces"]) <= 3 * MAX_FACES:
        points = np.array(params["vertex_positions"], dtype=np.float64).reshape(-1, 3)
        return [_map_to_cube(points[indices]) for indices in _find_planes(points, np.array(params["faces"]).reshape(-1, 3))]
    return [_map_to_cube(np.stack(shape_bounds(shape)))]


def _find_planes(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """The indices of the vertices in each plane of a mesh."""
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    size = np.ptp(points, axis=0).max()
    away = np.abs(np.einsum("fa,gca->fgc", normals, corners) - np.einsum("fa,fa->f", normals, corners[:, 0])[:, None, None])
    same, found = (away < BOX_MARGIN / 2 * size).all(axis=2), []
    left = np.ones(len(faces), bool)
    while left.any():
        chosen = left & same[np.argmax(left)]
        chosen[np.argmax(left)] = True
        found.append(np.unique(faces[chosen]))
        left &= ~chosen
    return found


def _map_to_cube(points: np.ndarray) -> np.ndarray:
    """A (3, 4) map from the world to the cube [-1, 1]^3 around points: a box in the plane of flat ones, else along the axes."""
    centred = points - points.mean(axis=0)
    axes = np.eye(3)
    if len(points) > 2:
        _, widths, across = np.linalg.svd(centred, full_matrices=False)
        is_tilted = np.abs(across[-1]).max() < 1 - BOX_MARGIN
        if widths[-1] <= BOX_MARGIN / 2 * widths[0] and is_tilted:
            axes = across
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    margin = BOX_MARGIN * (np.abs(points).max() + (high - low).max())
    half = np.maximum((high - low) / 2 + margin, 1e-30)
    return np.c_[axes, -(low + high) / 2] / half[:, None]


def _is_unmoved(shape: mi.Shape, mark: object) -> bool:
    now = _read_placement(shape)
    return now == mark if isinstance(mark, list) else dr.detail.collect_indices(now) == dr.detail.collect_indices(mark)


def _emitter_kind(emitter: mi.Emitter) -> str:
    if emitter.class_name() == UNIFORM_EMITTER:
        return "uniform"
    return "delta" if int(emitter.flags()) & int(mi.EmitterFlags.Delta) else "extended"


def _are_emitters_far(emitters: list[mi.Emitter]) -> bool:
    """Whether all emitters are at infinity, and at least one emitter is not uniform."""
    infinite = all(int(e.flags()) & int(mi.EmitterFlags.Infinite) for e in emitters)
    return infinite and any(_emitter_kind(e) != "uniform" for e in emitters)


def _are_sealed(boundaries: Sequence[Boundary], shapes: Sequence[mi.Shape], emitters: Sequence[mi.Emitter]) -> bool:
    """Whether all media lie behind purely refracting shapes, with all emitters outside and hittable by paths."""
    if not boundaries or any(b.shape == OUTSIDE_SHAPES for b in boundaries):
        return False
    holders = [s for s in shapes if s.is_medium_transition() and s.interior_medium() is not None]
    if not all(_refracts_all_light(s) for s in holders) or any(_emitter_kind(e) == "delta" for e in emitters):
        return False
    lamps = [oriented_box(s) for s in shapes if s.is_emitter()]
    return not any(oriented_box(s).shares(lamp) for s in holders for lamp in lamps)


def _refracts_all_light(shape: mi.Shape) -> bool:
    """Whether a shape transmits light only by refraction."""
    flags = int(shape.bsdf().flags())
    bends = flags & (int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission))
    return bool(bends) and not flags & (int(mi.BSDFFlags.Null) | int(mi.BSDFFlags.DiffuseTransmission))


def _is_bare(shape: mi.Shape) -> bool:
    """Whether a shape is only a boundary: a ``null`` BSDF, and no emitter."""
    bsdf = shape.bsdf()
    return bsdf is not None and int(bsdf.flags()) & int(mi.BSDFFlags.All) == int(mi.BSDFFlags.Null) and not shape.is_emitter()


def is_instance(shape: mi.Shape) -> bool:
    """Whether a shape is an instance of a shape group."""
    return shape.class_name() == "Instance"


def _make_boundary(shape: mi.Shape, name: str, boxes: dict[int, OrientedBox], named: set[int]) -> Boundary:
    """Find the boundary made by a shape; ``named`` has the pointers of media named by sensors."""
    alone = not any(box.shares(boxes[shape.ptr]) for other, box in boxes.items() if other != shape.ptr)
    box = None
    if alone and shape.exterior_medium() is None and _is_bare(shape) and not shape.has_flipped_normals():
        box = fit_box(shape)
        if shape.class_name() == "Sphere" and shape.interior_medium().ptr not in named:
            # Outside of the sphere, the medium of a sensor inside it has no end until a boundary is met.
            box = fit_ball(shape)
    return Boundary(shape.interior_medium(), name, shape.class_name(), box, around=boxes[shape.ptr])


def find_outside_media(media: Iterable[mi.Medium], boundaries: Sequence[Boundary]) -> list[Boundary]:
    """Find the media that fill no shape. A ray learns of such a medium from the exterior of a boundary or from the sensor."""
    held = {b.medium.ptr for b in boundaries}
    found = [Boundary(m, m.id() or "a medium without an id", OUTSIDE_SHAPES, None) for m in media if m.ptr not in held]
    return [part for boundary in found for part in _split_levels(boundary)]


def _split_levels(boundary: Boundary) -> list[Boundary]:
    """Split the boundary of a nested radiance field into levels; other boundaries stay whole.

    A level fills the part of the box inside the boundary, without the box of the level before.

    Raises:
        MivolError: a nested field in a shape other than a box.
    """
    field = nested_field(boundary.medium)
    if field is None:
        return [boundary]
    if boundary.box is None or boundary.box.is_round:
        raise MivolError(
            f"the medium in {boundary.name} is a nested field, whose levels are boxes, but {boundary.shape} is not a "
            "separate box: give the medium a cube with a null BSDF that overlaps no other medium's shape."
        )
    boxes = [Box(field.level_to_world(level)) for level in range(field.levels)]
    return [
        replace(
            boundary,
            name=boundary.name if level == 0 else f"{boundary.name} (level {level})",
            box=box if boundary.box.contains(box.to_world, LEVEL_TOLERANCE) else boundary.box,
            level=level,
            hole=None if level == 0 else boxes[level - 1],
        )
        for level, box in enumerate(boxes)
    ]


LEVEL_TOLERANCE = 1e-6
"""Largest distance by which a level may exceed its boundary [edge of the level]: vertices of the boundary are float32."""


@dataclass(frozen=True)
class Boundary:
    """A medium, and the boundary that the medium fills.

    Attributes:
        medium: Mitsuba's object.
        name: name of the shape.
        shape: class of the shape; ``OUTSIDE_SHAPES`` for a medium around shapes, around the camera or in instances.
        box: the shape as a box or ball overlapped by no other boundary; None if rays must be traced to the shape.
        level: level of a nested radiance field; each level is a medium of its own.
        hole: box of the inner level, left out by this level; None for other media.
        around: box around the shape; None if the medium fills no shape or also surrounds a shape.
    """

    medium: mi.Medium
    name: str
    shape: str
    box: Box | None
    level: int = 0
    hole: Box | None = None
    around: OrientedBox | None = None

    @property
    def structure(self) -> tuple:
        """All but the place of the boundary."""
        box = None if self.box is None else self.box.is_round
        return self.medium.ptr, self.name, self.shape, box, self.level, self.hole is None, self.around is None

    def view(self, grids: StockGrids, phase: Phase | None = None, scale: float | None = None) -> MediumView:
        """View the medium as a sum of fields; arguments as in :func:`mivol.transport.media.medium_view.view_medium`.

        Raises:
            MivolError: a medium that mivol does not render.
        """
        box = None if self.box is None or self.box.is_round else self.box
        return view_medium(self.medium, box, grids, self.level, phase, scale)

    def body(self, view: MediumView, estimates_shadows: bool = False) -> Body:
        """Place a view of the medium inside its boundary."""
        return Body(view, self.box, estimates_shadows, self.hole)
