"""An experiment in TOML: every setting with its unit, domain and meaning on one line.

Conventions. Physics stays in Mitsuba's XML; this file says what is looked for, from which views, and how. Unknown keys
are errors that offer the nearest valid one; the command line (``--set a.b=c``) overrides the file; paths are relative
to the TOML file. :func:`resolved` is what ``run.json`` keeps.
"""

from __future__ import annotations

import math
import re
import textwrap
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from mivol.errors import MivolError
from mivol.optim.events import EVENTS, Checkpoint, Evaluate
from mivol.optim.first_order import Adam
from mivol.optim.losses import L2, LOSSES
from mivol.optim.optimizers import OPTIMIZERS
from mivol.optim.parameters import MAPS
from mivol.optim.priors import PRIORS
from mivol.optim.projections.solvers import ALL_SOLVERS
from mivol.optim.schedules import SCHEDULES, Constant
from mivol.optim.strategy import setting, suggest_name, union_type
from mivol.scene.camera_rigs import Hemisphere, LookAts, Ring, SceneSensors
from mivol.schema import check_keys, sentence
from mivol.tomography.ramp import WINDOWS
from mivol.validate.images import METRICS

INFINITY = math.inf

AnyOptimizer, AnySchedule, AnyLoss = union_type(OPTIMIZERS), union_type(SCHEDULES), union_type(LOSSES)
AnyPrior, AnyEvent = union_type(PRIORS), union_type(EVENTS)

DEEP_KEY = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){100}")
"""A hundred names with dots between them; tomllib takes the square of their number as time, a minute for a file of 200 kB."""

Count = Annotated[int, msgspec.Meta(ge=1)]
"""Voxels or pixels along an edge."""

LONGEST_SENTENCE = 600
"""Characters of a refusal, which quotes what it found: that may be as long as its file."""


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file."""


class Scene(Section):
    """What is rendered."""

    file: Annotated[str, setting("path", "Mitsuba XML", min_length=1)]
    define: Annotated[dict[str, str | int | float | bool], setting("1", "values of the XML's $parameters")] = {}


class Truth(Section):
    """What the references show, where it is known: a volume that is put into the scene before they are rendered."""

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    file: Annotated[str, setting("path", "volume file; empty: procedural")] = ""
    procedural: Annotated[str, setting("1", "key of mivol.fields.procedural.PROCEDURAL; empty: file")] = ""
    shape: Annotated[tuple[Count, Count, Count], setting("voxel", "(Z, Y, X) of a procedural volume")] = (48, 48, 48)
    seed: Annotated[int, setting("1", "which procedural volume", ge=0)] = 0
    peak: Annotated[float, setting("unit of the field", "largest value of a procedural volume", gt=0)] = 1.0

    def __post_init__(self) -> None:
        if bool(self.file) == bool(self.procedural):
            raise ValueError("a truth is either a file or procedural: give one of the two")


class Rendered(Section, tag_field="source", tag="render"):
    """References that Mitsuba's own path tracer renders."""

    spp: Annotated[int, setting("sample/pixel", "most samples per pixel and view", ge=1)] = 1024
    standard_error: Annotated[float, setting("radiance", "stop earlier at this RMS error of the mean; 0: never", ge=0)] = 0.0
    seed: Annotated[int, setting("1", "root of the references' random numbers", ge=0)] = 1
    max_depth: Annotated[
        Annotated[int, msgspec.Meta(ge=-1)] | None, setting("1", "as Mitsuba's volpath; -1: unlimited; absent: that of the fit")
    ] = None
    held_out: Annotated[tuple[int, ...], setting("view", "views that are compared but not fitted")] = ()


class Files(Section, tag_field="source", tag="files"):
    """References from OpenEXR files, one per view."""

    paths: Annotated[tuple[str, ...], setting("path", "files in the order of the views, then of those held out", min_length=1)]
    scene: Annotated[str, setting("path", "XML that they are references of; empty: the scene's")] = ""
    held_out: Annotated[tuple[int, ...], setting("view", "views that are compared but not fitted")] = ()


class Sought(Section):
    """A parameter that is looked for."""

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    unit: Annotated[str, setting("1", "unit of the value, for labels; empty: that which its key tells")] = ""
    domain: Annotated[tuple[float, float], setting("unit", "smallest and largest value")] = (0.0, INFINITY)
    map: Annotated[str, setting("1", "what the optimiser moves: key of MAPS")] = "identity"
    lr: Annotated[float, setting("unit", "typical change per step, in the map's reals", gt=0)] = 0.1
    start: Annotated[
        float | tuple[float, ...] | None, setting("unit", "start: one number for all, or each; absent: what the scene holds")
    ] = None
    start_file: Annotated[str, setting("path", "volume to start from; empty: start")] = ""
    start_fit: Annotated[
        Literal["", "emission"],
        setting("1", "emission: the start is given the shape of an emissive volume fitted to the views"),
    ] = ""
    shape: Annotated[tuple[Count, Count, Count] | None, setting("voxel", "(Z, Y, X) of a constant start")] = None
    prior: Annotated[tuple[AnyPrior, ...], setting("1", "what is known before")] = ()

    def __post_init__(self) -> None:
        if self.map not in MAPS:
            raise ValueError(f'unknown map "{self.map}": {suggest_name(self.map, list(MAPS))}'.rstrip("."))


AUTO = "auto"
"""A depth that is measured before the fit."""


class SceneFitSettings(Section):
    """How long and how finely."""

    iterations: Annotated[int, setting("iteration", "at most so many", ge=1)] = 100
    spp: Annotated[int, setting("sample/pixel", "samples of an image and of its derivative", ge=1)] = 16
    spp_shown: Annotated[int, setting("sample/pixel", "of images kept, 16 or more for z-images; 0: as spp", ge=0)] = 0
    samples_per_pass: Annotated[int, setting("sample", "most samples in one kernel: Ctrl-C waits for one", ge=1)] = 1 << 20
    max_depth: Annotated[
        Annotated[int, msgspec.Meta(ge=-1)] | str, setting("1", "as Mitsuba's volpath; -1: unlimited; auto: measured")
    ] = 6
    noise: Annotated[float, setting("1", "of a pixel over the mean radiance: max_depth = auto leaves out less", gt=0)] = 0.02
    integrator: Annotated[str, setting("1", "Mitsuba integrator that differentiates", min_length=1)] = "mivol"

    def __post_init__(self) -> None:
        if isinstance(self.max_depth, str) and self.max_depth != AUTO:
            raise ValueError(f'max_depth is "{self.max_depth}": expected a whole number from -1 on, or "{AUTO}"')


class SceneExperiment(Section):
    """All of ``fit.toml``."""

    title: Annotated[str, setting("1", "heading of the report", min_length=1)]
    scene: Annotated[Scene, setting("1", "what is rendered")]
    parameter: Annotated[tuple[Sought, ...], setting("1", "what is looked for", min_length=1)]
    views: Annotated[Ring | Hemisphere | LookAts | SceneSensors, setting("1", "where it is seen from")] = SceneSensors()
    held_out: Annotated[
        Ring | Hemisphere | LookAts | SceneSensors | None, setting("1", "more views, after the others: compared but not fitted")
    ] = None
    reference: Annotated[Rendered | Files, setting("1", "what was seen")] = Rendered()
    truth: Annotated[Truth | None, setting("1", "what the references show, where known")] = None
    fit: Annotated[SceneFitSettings, setting("1", "how long and how finely")] = SceneFitSettings()
    optimiser: Annotated[AnyOptimizer, setting("1", "how to walk downhill")] = Adam()
    schedule: Annotated[AnySchedule, setting("1", "factor on the learning rate")] = Constant()
    loss: Annotated[AnyLoss, setting("1", "distance of image and reference")] = L2()
    event: Annotated[tuple[AnyEvent, ...], setting("1", "what happens between iterations")] = (
        Checkpoint(),
        Evaluate(),
    )
    variant: Annotated[str, setting("1", "Mitsuba variant", min_length=1)] = "llvm_ad_rgb"
    seed: Annotated[int, setting("1", "root of the fit's random numbers", ge=0)] = 0
    threads: Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)] = 0
    output: Annotated[str, setting("path", "run folder, relative to where the command runs", min_length=1)] = "runs/fit"


# -- Tomography -------------------------------------------------------------------------------------------------------


class Detector(Section, tag_field="beam"):
    """What both kinds of beam share; the detector's size and the angles come from the data where it is measured."""

    views: Annotated[int, setting("view", "number of views, evenly over the arc", ge=1)] = 90
    arc: Annotated[float, setting("degree", "angle covered", gt=0, le=360)] = 180.0
    detector: Annotated[tuple[Count, Count], setting("pixel", "(rows, columns)")] = (1, 128)
    pitch: Annotated[
        float | tuple[float, float], setting("length", "distance of pixel centres: one, or of (rows, columns)")
    ] = 1.0
    detector_offset: Annotated[
        tuple[float, float], setting("length", "shift of the detector's middle along (rows, columns)")
    ] = (
        0.0,
        0.0,
    )
    axis_offset: Annotated[float, setting("length", "rotation axis from the middle, along the columns")] = 0.0


class Parallel(Detector, tag="parallel"):
    """Parallel light."""


class Cone(Detector, kw_only=True, tag="cone"):
    """A point source."""

    source_to_axis: Annotated[float, setting("length", "source to rotation axis", gt=0)]
    source_to_detector: Annotated[float, setting("length", "source to detector", gt=0)]


class Table(Section, kw_only=True, tag_field="beam", tag="table"):
    """A point source and a flat detector on any trajectory; of measured projections, the detector's size is the data's."""

    file: Annotated[str, setting("path", "text, 12 lengths a view: source, detector's middle, steps to next column and row")]
    detector: Annotated[tuple[Count, Count], setting("pixel", "(rows, columns) of computed projections")] = (1, 128)


class Matrices(Section, kw_only=True, tag_field="beam", tag="matrices"):
    """A point source and a flat detector on any trajectory, as projection matrices: (column, row, 1) ~ P (x, y, z, 1)."""

    file: Annotated[str, setting("path", "text, 12 numbers a view: P, 3 x 4, row by row", min_length=1)]
    detector: Annotated[tuple[Count, Count], setting("pixel", "(rows, columns) of computed projections")] = (1, 128)
    first_pixel: Annotated[
        tuple[float, float], setting("pixel", "(column, row) that P gives to the middle of the first pixel")
    ] = (
        0.0,
        0.0,
    )


class OfData(Section, tag_field="beam", tag="data"):
    """The geometry that comes with the data; source = "nikon" has one."""


class Simulated(Section):
    """Noise of projections that are computed."""

    photons: Annotated[float, setting("quantum/pixel", "of the light without an object; 0: no noise", ge=0)] = 0.0
    seed: Annotated[int, setting("1", "root of the noise", ge=0)] = 1


class Ellipsoids(Simulated, tag_field="source", tag="shepp_logan"):
    """Exact chords through the Shepp-Logan head: no grid takes part in the data."""

    table: Annotated[str, setting("1", "kak-slaney, yu-ye-wang or toft-schabel", min_length=1)] = "yu-ye-wang"
    half_width: Annotated[float, setting("length", "half of the head's box", gt=0)] = 1.0
    scale: Annotated[float, setting("1/length", "factor on its values", gt=0)] = 1.0


class Known(Simulated, kw_only=True, tag_field="source", tag="volume"):
    """Projections of a volume file, by the projector that also reconstructs."""

    file: Annotated[str, setting("path", "volume of the grid's shape", min_length=1)]
    scale: Annotated[float, setting("1/length", "factor on its values", gt=0)] = 1.0


class Readings(Section):
    """What measured projections share."""

    find_axis: Annotated[
        bool | None,
        setting("1", "find the axis of a parallel or cone beam; absent: where scan.axis_offset is 0; false: it holds"),
    ] = None
    air: Annotated[int, setting("pixel", "columns at either edge that see no object; 0: light does not drift", ge=0)] = 0
    drift: Annotated[
        int, setting("iteration", "how often the drift of the light since the flats is fitted to each pixel; 0: never", ge=0)
    ] = 0
    saturation: Annotated[float, setting("reading", "readings from here on are saturated, not used; inf: none", gt=0)] = (
        INFINITY
    )


class Measured(Readings, kw_only=True, tag_field="source", tag="measured"):
    """A Data Exchange file (HDF5) with flat and dark fields."""

    file: Annotated[str, setting("path", "HDF5", min_length=1)]
    group: Annotated[str, setting("1", "where data, data_white, data_dark and theta lie")] = "exchange"


class Stack(Readings, kw_only=True, tag_field="source", tag="stack"):
    """Projections as images or arrays, with flat and dark fields beside them."""

    file: Annotated[
        str, setting("path", "TIFF, .npy, .npz or HDF5, (views, rows, cols); a pattern of TIFF files", min_length=1)
    ]
    reading: Annotated[
        Literal["intensity", "transmission", "line_integral"],
        setting("1", "what a pixel holds; an intensity needs flats and darks"),
    ]
    dataset: Annotated[str, setting("1", "which array of an .npz or HDF5 file")] = ""
    flats: Annotated[str, setting("path", "readings of light without an object, as file")] = ""
    darks: Annotated[str, setting("path", "readings without light, as file")] = ""
    angles: Annotated[str, setting("path", "text with an angle for each view; empty: evenly over scan.arc")] = ""
    angle_unit: Annotated[Literal["degree", "radian"], setting("1", "of the angles' file")] = "degree"
    first_row: Annotated[Literal["lowest", "highest"], setting("1", "which row of the detector a file's first is")] = "lowest"

    def __post_init__(self) -> None:
        if (self.reading == "intensity") != bool(self.flats and self.darks):
            raise ValueError("an intensity needs flats and darks, and nothing else takes them: give both, or change reading")
        if self.reading != "intensity" and self.saturation < INFINITY:
            raise ValueError("only readings of an intensity saturate: leave saturation out, or change reading")


class Nikon(Readings, kw_only=True, tag_field="source", tag="nikon"):
    """A scan of a Nikon (X-Tek) laboratory scanner: settings, and TIFF files beside them [mm]."""

    file: Annotated[str, setting("path", ".xtekct; geometry, white level and default grid are its", min_length=1)]
    angles: Annotated[str, setting("path", "list of angles, as _ctdata.txt or .ang; empty: the settings' even steps")] = ""


class Grid(Section):
    """Where the voxels lie."""

    shape: Annotated[tuple[Count, Count, Count], setting("voxel", "(Z, Y, X)")]
    voxel_size: Annotated[float | tuple[float, float, float], setting("length", "edges of a voxel: one, or (x, y, z)")] = 1.0
    centre: Annotated[tuple[float, float, float], setting("length", "(x, y, z) of the box's middle")] = (0.0, 0.0, 0.0)


class SolveSettings(Section):
    """How the projections are inverted."""

    name: Annotated[str, setting("1", "auto, or a key of mivol.optim.projections.solvers.ALL_SOLVERS", min_length=1)] = "auto"
    start: Annotated[
        Literal["empty", "filtered"] | None,
        setting(
            "1", "first volume: empty, or by fbp or fdk; absent: auto begins filtered where the views allow it, others empty"
        ),
    ] = None
    iterations: Annotated[int, setting("iteration", "at most so many", ge=1)] = 20
    nonnegative: Annotated[bool, setting("1", "keep every voxel at or above 0")] = True
    subsets: Annotated[int, setting("1", "subsets of views, for os-sart", ge=1)] = 10
    relaxation: Annotated[float, setting("1", "of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, setting("1", "of the relaxation, a sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, setting("1", "filter of fbp and fdk: key of mivol.tomography.ramp.WINDOWS", min_length=1)] = (
        "ram-lak"
    )
    cutoff: Annotated[float, setting("1", "where the window ends, in parts of the Nyquist frequency", gt=0, le=1)] = 1.0
    supersampling: Annotated[
        int | None, setting("1", "unknowns along each edge of a voxel, which is their mean; absent: auto takes 2, others 1")
    ] = None
    tv: Annotated[float | None, setting("tv_unit", "strength of the total variation; absent: auto takes 1, others 0: none")] = (
        None
    )
    delta: Annotated[float, setting("tv_unit", "slope below which noise is smoothed", gt=0)] = 0.1
    tv_unit: Annotated[
        Literal["length", "noise"],
        setting(
            "1", "noise: tv in parts of what balances the noise, delta of the mean value a voxel; length: 1/length, 1/length^2"
        ),
    ] = "noise"
    storage: Annotated[
        Literal["auto", "walk", "matrix"],
        setting("1", "matrix: a layer's rows are stored (parallel beams, fans); auto: where they fit and it pays"),
    ] = "auto"
    memory: Annotated[float, setting("GiB", "most that stored rows may take", gt=0)] = 1.0
    discrepancy: Annotated[float, setting("1", "stop where the residual is so many times the noise; 0: never", ge=0)] = 0.0

    @property
    def solver(self) -> str:
        """Key of ``mivol.optim.solvers.METHODS``; "auto" stands for pcg."""
        return "pcg" if self.name == AUTO else self.name

    def __post_init__(self) -> None:
        if self.name != AUTO and self.name not in ALL_SOLVERS:
            raise ValueError(f'unknown solver "{self.name}": {suggest_name(self.name, [AUTO, *ALL_SOLVERS])}'.rstrip("."))
        # NaN fails every comparison.
        if self.tv is not None and not self.tv >= 0:
            raise ValueError(f"tv is {self.tv}: a number from 0 on is expected")
        if self.supersampling is not None and self.supersampling < 1:
            raise ValueError(f"supersampling is {self.supersampling}: a whole number from 1 on is expected")
        if self.window not in WINDOWS:
            raise ValueError(f'unknown window "{self.window}": {suggest_name(self.window, list(WINDOWS))}'.rstrip("."))


class ScanExperiment(Section):
    """All of a TOML file for tomography: it has a table ``[scan]`` in place of ``[scene]``."""

    title: Annotated[str, setting("1", "heading of the report", min_length=1)]
    scan: Annotated[Parallel | Cone | Table | Matrices | OfData, setting("1", "beam and detector")]
    data: Annotated[Ellipsoids | Known | Measured | Stack | Nikon, setting("1", "what was seen")]
    grid: Annotated[Grid | None, setting("1", "where the voxels lie; absent: where a Nikon file says")] = None
    solve: Annotated[SolveSettings, setting("1", "how it is inverted")] = SolveSettings()
    held_out_every: Annotated[int, setting("view", "every so many is predicted, not fitted; 0: none", ge=0)] = 0
    checkpoint_every: Annotated[int, setting("iteration", "how often", ge=1)] = 5
    variant: Annotated[str, setting("1", "Mitsuba variant", min_length=1)] = "llvm_ad_rgb"
    threads: Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)] = 0
    output: Annotated[str, setting("path", "run folder, relative to where the command runs", min_length=1)] = "runs/scan"

    def __post_init__(self) -> None:
        if isinstance(self.scan, OfData) != isinstance(self.data, Nikon):
            raise ValueError('scan.beam = "data" and data.source = "nikon" go together: give both, or neither')
        if self.grid is None and not isinstance(self.data, Nikon):
            raise ValueError('the key "grid" is missing: give it')


# -- Photographs --------------------------------------------------------------------------------------------------


class Photographs(Section):
    """Posed photographs."""

    path: Annotated[str, setting("path", "folder or file of cameras: Blender, nerfstudio, instant-ngp, COLMAP", min_length=1)]
    scale: Annotated[float, setting("1", "of width and height, by exact means over area", gt=0, le=1)] = 1.0
    largest: Annotated[int | None, setting("pixel", "longest edge of any photograph; absent: as scale says")] = None
    background: Annotated[
        str | tuple[float, float, float],
        setting(
            "1",
            "where nothing is, white, black or an rgb triple; of images with alpha also random (a colour for each), of those "
            "without also sky (learned with the field) or nested (boxes of twice the extent each, and a sky); empty: no alpha, "
            "and what the preset has, else black",
        ),
    ] = ""
    held_out: Annotated[int, setting("view", "every so many of the training views is compared, not fitted; 0: none", ge=0)] = 8
    box: Annotated[
        str | tuple[tuple[float, float, float], tuple[float, float, float]],
        setting(
            "1",
            "where matter may be: silhouettes (of alpha), cameras (what they look at), middle (of nested boxes), found "
            "(silhouettes where all photographs have alpha, else cameras), or two corners [length]",
        ),
    ] = "found"
    judged: Annotated[str, setting("1", "views to report at the end: held_out, val or test", min_length=1)] = "held_out"
    space: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "values that are fitted: srgb (codes) or linear (radiance); absent: what the photographs hold"),
    ] = None
    stored: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "what PNG and JPEG hold; absent: linear where a PNG says so (gAMA 1), else srgb; OpenEXR is linear"),
    ] = None

    def __post_init__(self) -> None:
        if self.largest is not None and self.largest < 16:
            raise ValueError(f"largest is {self.largest}: at least 16 pixels are expected")
        colour = self.background
        if not isinstance(colour, str) and not all(0 <= c <= 1 for c in colour):  # NaN fails every comparison
            raise ValueError(f"background is {list(colour)}: three numbers from 0 to 1 are expected, codes of 8 bits over 255")


MOST_LEVELS = 12
"""Nested boxes that may be asked for: the largest is then 2048 times the innermost."""


class FieldSettings(Section):
    """The radiance field and how it is fitted."""

    preset: Annotated[str, setting("1", "nodes, steps, rates and priors: tiny, cpu, fine, capture or gpu", min_length=1)] = (
        "cpu"
    )
    longest: Annotated[int | None, setting("voxel", "along the longest edge in the end; absent: the preset's")] = None
    degree: Annotated[int | None, setting("1", "of the spherical harmonics; absent: the preset's")] = None
    first_degree: Annotated[int | None, setting("1", "of the first stage, raised from there; absent: degree")] = None
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    tv_density: Annotated[float | None, setting("photograph", "total variation of the density; absent: the preset's")] = None
    tv_sh: Annotated[float | None, setting("photograph", "total variation of the colours; absent: the preset's")] = None
    sparsity: Annotated[float | None, setting("photograph", "of the density; absent: the preset's")] = None
    matte: Annotated[
        float | None,
        setting(
            "photograph", "colours that change little with the direction; absent: the preset's (capture of less than 50: 0)"
        ),
    ] = None
    depth: Annotated[
        float | None, setting("1", "weight of the distances that a model's points tell; absent: the preset's (only capture)")
    ] = None
    levels: Annotated[
        int | None, setting("1", "nested boxes; absent: the preset's (1, capture 5), fewer where a model's points need no more")
    ] = None
    sky: Annotated[int | None, setting("row", "of a map of what is behind the box, learned with the field; 0: none")] = None
    exposure: Annotated[
        bool | None, setting("1", "gains of each photograph, left out where they agree; absent: the preset's (only capture)")
    ] = None
    beta: Annotated[float | None, setting("1", "asks rays to end in matter or to pass; absent: the preset's")] = None

    def __post_init__(self) -> None:
        for name in ("degree", "first_degree"):
            if not 0 <= (getattr(self, name) or 0) <= 4:
                raise ValueError(f"{name} is {getattr(self, name)}: 0 to 4 is expected")
        if not math.isfinite(self.effort):
            raise ValueError(f"effort is {self.effort}: a finite number above 0 is expected")
        if self.sky is not None and self.sky != 0 and not 2 <= self.sky <= 4096:
            raise ValueError(f"sky is {self.sky}: 0, or 2 to 4096 rows are expected")
        if self.longest is not None and self.longest < 8:
            raise ValueError(f"longest is {self.longest}: at least 8 is expected")
        if self.levels is not None and not 1 <= self.levels <= MOST_LEVELS:
            raise ValueError(f"levels is {self.levels}: 1 to {MOST_LEVELS} is expected")
        for name in ("tv_density", "tv_sh", "sparsity", "matte", "depth", "beta"):
            if not 0 <= (getattr(self, name) or 0) < math.inf:  # NaN fails every comparison
                raise ValueError(f"{name} is {getattr(self, name)}: a finite number of at least 0 is expected")


Keyframe = tuple[float, float, float, float, float, float]


class ShowSettings(Section):
    """What is made of a fitted field."""

    views: Annotated[int, setting("view", "judged views that are shown beside their photographs", ge=0)] = 4
    frames: Annotated[int, setting("frame", "of a film; 0: none", ge=0, le=65536)] = 60
    way: Annotated[
        Literal["turntable", "views", "keyframes"],
        setting("1", "of the film's camera: around the box, through the photographs' places in their order, or past keyframes"),
    ] = "turntable"
    keyframes: Annotated[
        tuple[Keyframe, ...],
        setting("length", "where the film's camera stands and what it looks at, at least two, in equal times"),
    ] = ()
    every: Annotated[int, setting("step", "between two points of the curve of held-out views", ge=1)] = 250
    judged: Annotated[int, setting("view", "held-out views in that curve, the same at each point; 0: all", ge=0)] = 4
    metrics: Annotated[tuple[str, ...], setting("1", "of the judged views: psnr, ssim, flip", min_length=1)] = ("psnr", "ssim")

    def __post_init__(self) -> None:
        if self.way == "keyframes" and len(self.keyframes) < 2:
            raise ValueError(f"{len(self.keyframes)} keyframes were given: at least 2 are expected")
        if self.keyframes and self.way != "keyframes":
            raise ValueError(f'keyframes were given beside way = "{self.way}": "keyframes" is expected')
        unknown = next((name for name in self.metrics if name not in METRICS), None)
        if unknown is not None:
            raise ValueError(f'unknown metric "{unknown}": {suggest_name(unknown, list(METRICS))}'.rstrip("."))


class FieldExperiment(Section):
    """All of ``fit.toml`` of a radiance field."""

    title: Annotated[str, setting("1", "heading of the report", min_length=1)]
    photos: Annotated[Photographs, setting("1", "what was seen")]
    field: Annotated[FieldSettings, setting("1", "what is looked for")] = FieldSettings()
    show: Annotated[ShowSettings, setting("1", "what is made of it")] = ShowSettings()
    checkpoint_every: Annotated[int, setting("step", "how often", ge=1)] = 500
    variant: Annotated[str, setting("1", "Mitsuba variant", min_length=1)] = "llvm_ad_rgb"
    seed: Annotated[int, setting("1", "root of the fit's random numbers", ge=0)] = 0
    threads: Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)] = 0
    output: Annotated[str, setting("path", "run folder, relative to where the command runs", min_length=1)] = "runs/field"


class GaussianSettings(Section):
    """The Gaussians and how they are fitted."""

    preset: Annotated[str, setting("1", "steps, sizes, rates: tiny, minute, minutes, fine, finest or gpu", min_length=1)] = (
        "minute"
    )
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    minutes: Annotated[
        float | None, setting("min", "as many steps as take about so long on two idle cores; no clock is asked")
    ] = None
    start: Annotated[int | None, setting("1", "Gaussians at first, where no points are known; absent: the preset's")] = None
    most: Annotated[int | None, setting("1", "Gaussians at the end of growth; absent: the preset's")] = None
    degree: Annotated[int | None, setting("1", "of the spherical harmonics; absent: the preset's")] = None
    control: Annotated[str | None, setting("1", "of the density: clone_split or relocation; absent: the preset's")] = None
    ssim: Annotated[float | None, setting("1", "share of SSIM in the loss; absent: the preset's")] = None
    mip: Annotated[bool, setting("1", "what is smaller than a pixel keeps its light, so that other sizes look right, too")] = (
        False
    )
    exposure: Annotated[bool, setting("1", "gains of each photograph, of those without alpha")] = False

    def __post_init__(self) -> None:
        if not math.isfinite(self.effort):
            raise ValueError(f"effort is {self.effort}: a finite number above 0 is expected")
        if self.minutes is not None and not (0 < self.minutes < math.inf and self.effort == 1):
            found = f"minutes is {self.minutes} beside effort {self.effort}"
            raise ValueError(f"{found}: a finite number above 0, and no effort, are expected")
        for name in ("start", "most"):
            value = getattr(self, name)
            if value is not None and value < 4:
                raise ValueError(f"{name} is {value}: at least 4 is expected")
        if not 0 <= (self.degree or 0) <= 3:
            raise ValueError(f"degree is {self.degree}: 0 to 3 is expected")
        if not 0 <= (self.ssim or 0) <= 1:  # NaN fails every comparison
            raise ValueError(f"ssim is {self.ssim}: a number from 0 to 1 is expected")


class GaussianExperiment(Section):
    """All of a TOML file that fits Gaussians to photographs: it has a table ``[gaussians]`` in place of ``[field]``."""

    title: Annotated[str, setting("1", "heading of the report", min_length=1)]
    photos: Annotated[Photographs, setting("1", "what was seen")]
    gaussians: Annotated[GaussianSettings, setting("1", "what is looked for")]
    show: Annotated[ShowSettings, setting("1", "what is made of it")] = ShowSettings()
    checkpoint_every: Annotated[int, setting("step", "how often", ge=1)] = 500
    variant: Annotated[str, setting("1", "Mitsuba variant", min_length=1)] = "llvm_ad_rgb"
    seed: Annotated[int, setting("1", "root of the fit's random numbers", ge=0)] = 0
    threads: Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)] = 0
    output: Annotated[str, setting("path", "run folder, relative to where the command runs", min_length=1)] = "runs/gaussians"


PhotoExperiment = FieldExperiment | GaussianExperiment
"""A fit of photographs, of either model."""

Experiment = SceneExperiment | ScanExperiment | PhotoExperiment
"""Settings of an experiment of any kind."""

TITLES: dict[str, type[Section]] = {
    "images": SceneExperiment,
    "projections": ScanExperiment,
    "photographs": FieldExperiment,
    "photographs, to Gaussians": GaussianExperiment,
}
"""Kinds of experiments, by the data that they fit."""

#: Table of the file that tells which experiment it is; without any of them it is one on a scene.
KINDS: dict[str, type] = {"scan": ScanExperiment, "gaussians": GaussianExperiment, "photos": FieldExperiment}

CAPTURE = {
    "photos": {"largest": 240, "box": "middle"},
    "show": {"views": 64},
}
"""What a file with ``field.preset = "capture"`` need not say: the size that its grids tell, nested boxes, all views shown."""

#: Settings that change how a run is stored or how fast it is, not what comes out.
NOT_RESULT = ("output", "threads", "title", "checkpoint_every", "show")


def load(path: str | Path, changes: Sequence[str] = ()) -> Experiment:
    """Read an experiment.

    Args:
        path: TOML file.
        changes: ``a.b=c`` from the command line; entries of a list by number, ``parameter.0.lr=0.1``.

    Raises:
        MivolError: no such file, not TOML, an unknown key, a wrong type, or a value outside its domain.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        if DEEP_KEY.search(text):
            raise RecursionError
        raw = tomllib.loads(text)
    except FileNotFoundError:
        raise MivolError(f"found no file {path}: give the path of an experiment in TOML.") from None
    except RecursionError:
        raise MivolError(f"{path} nests its values deeper than an experiment does: close its brackets.") from None
    except (ValueError, IsADirectoryError) as error:  # of TOML, of UTF-8, and of numbers of thousands of digits
        raise MivolError(f"{path} is not TOML: {error}.") from None
    for change in changes:
        apply_change(raw, change)
    return from_dict(raw, path.name)


def from_dict(raw: dict[str, Any], name: str = "experiment") -> Experiment:
    """An experiment from plain dicts and lists; its tables tell which it is (``KINDS``).

    Raises:
        MivolError: as :func:`load`; ``name`` begins the sentence.
    """
    kind = next((KINDS[table] for table in KINDS if table in raw), SceneExperiment)
    raw = _with_capture(raw)
    check_keys(raw, kind, "", name)
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        said = textwrap.shorten(sentence(raw, str(error)), LONGEST_SENTENCE, placeholder=" ...")
        raise MivolError(f"{name}: {said}") from None


def of_photographs(path: Path, preset: str, changes: Sequence[str] = ()) -> FieldExperiment:
    """The experiment of a folder of photographs, or of a file of cameras, that has no file of its own.

    Raises:
        MivolError: as :func:`load`.
    """
    raw = {"title": path.resolve().name, "photos": {"path": str(path)}, "field": {"preset": preset}}
    for change in changes:
        apply_change(raw, change)
    return from_dict(raw, str(path))


def _with_capture(raw: dict[str, Any]) -> dict[str, Any]:
    """Settings with those of ``CAPTURE`` where that is the preset and they are not given."""
    field = raw.get("field")
    if "photos" not in raw or not isinstance(field, dict) or field.get("preset") != "capture":
        return raw
    given = {table: raw.get(table, {}) for table in CAPTURE}
    return raw | {name: CAPTURE[name] | held if isinstance(held, dict) else held for name, held in given.items()}


def resolved(experiment: Experiment) -> dict[str, Any]:
    """Every setting, defaults included, as plain dicts and lists."""
    return msgspec.to_builtins(experiment)


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """The same by dotted key, without what does not change the result."""
    if isinstance(tree, dict | list | tuple) and len(tree):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        found: dict[str, Any] = {}
        for key, value in items:
            if prefix or key not in NOT_RESULT:
                found |= flat(value, f"{prefix}.{key}" if prefix else str(key))
        return found
    return {prefix: tree}


# -- Command line -------------------------------------------------------------------------------------------------


def apply_change(raw: dict[str, Any], change: str) -> None:
    """Put ``a.b=c`` into ``raw``; c is read as TOML where it is TOML, else as text.

    Raises:
        MivolError: no "=", or a step into something that has no parts.
    """
    dotted, equals, text = change.partition("=")
    if not equals or not dotted.strip():
        raise MivolError(f'--set "{change}" is no change: write key.of.setting=value.')
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        value = text
    *steps, last = dotted.strip().split(".")
    place: Any = raw
    for step in steps:
        place = place.setdefault(step, {}) if isinstance(place, dict) else _entry(place, step, change)
    if isinstance(place, dict):
        place[last] = value
    else:
        _entry(place, last, change)
        place[int(last)] = value


def _entry(place: Any, step: str, change: str) -> Any:
    if not isinstance(place, list) or not step.isdigit() or int(step) >= len(place):
        raise MivolError(f'--set "{change}": "{step}" is not there to change: entries of a list count from 0.')
    return place[int(step)]
