"""The settings of an experiment, as a TOML file gives them: each with unit, domain and meaning on a line.

Conventions. The physics stays in Mitsuba's XML. The TOML file names the parameters, the views and the method. An unknown key
is an error that offers the nearest valid key. The command line (``--set a.b=c``) overrides the file. Paths are relative to the
TOML file. ``run.json`` keeps the settings of :func:`resolved`.
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
from mivol.scene.sensors import Hemisphere, LookAts, Ring, SceneSensors
from mivol.schema import check_keys, explain_error
from mivol.tomography.filtered import WINDOWS
from mivol.validate.metrics import METRICS

INFINITY = math.inf

AUTO = "auto"
"""Value of settings chosen by mivol."""

DEEP_KEY = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){100}")
"""A key of a hundred names separated by dots. The time of tomllib grows with the square of this number: a file of 200 kB
takes a minute."""

LONGEST_SENTENCE = 600
"""Characters of an error message, which quotes values of any length."""

# -- Settings that several kinds of experiments share --------------------------------------------------------------------

Count = Annotated[int, msgspec.Meta(ge=1)]
"""Number of voxels or pixels along an edge."""

Depth = Annotated[int, msgspec.Meta(ge=-1)]
"""Length of the longest path, as Mitsuba's ``volpath`` counts it; -1 for no limit."""

Size = tuple[Count, Count, Count]
Vector = tuple[float, float, float]
Title = Annotated[str, setting("1", "heading of the report", min_length=1)]
Variant = Annotated[str, setting("1", "Mitsuba variant", min_length=1)]
Seed = Annotated[int, setting("1", "root of the fit's random numbers", ge=0)]
Threads = Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)]
Output = Annotated[str, setting("path", "run folder, relative to the working directory", min_length=1)]
HeldOut = Annotated[tuple[int, ...], setting("view", "indices of views that are evaluated but not fitted")]
DetectorSize = Annotated[tuple[Count, Count], setting("pixel", "(rows, columns) of computed projections")]
CheckpointSteps = Annotated[int, setting("step", "steps between two checkpoints", ge=1)]


def check_word(word: str, known: Sequence[str] | dict[str, Any], subject: str) -> None:
    """Refuse an unknown word, and offer the nearest known word.

    Raises:
        ValueError: with the word.
    """
    if word not in known:
        raise ValueError(f'unknown {subject} "{word}": {suggest_name(word, list(known))}'.rstrip("."))


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file."""


# -- Images of a scene -----------------------------------------------------------------------------------------------------


class Scene(Section):
    """The rendered scene."""

    file: Annotated[str, setting("path", "Mitsuba XML", min_length=1)]
    define: Annotated[dict[str, str | int | float | bool], setting("1", "values of the XML's $parameters")] = {}


class Truth(Section):
    """The true volume, if it is known: the references are rendered from it."""

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    file: Annotated[str, setting("path", "volume file; empty: procedural")] = ""
    procedural: Annotated[str, setting("1", "key of mivol.fields.procedural.PROCEDURAL; empty: file")] = ""
    shape: Annotated[Size, setting("voxel", "(Z, Y, X) of a procedural volume")] = (48, 48, 48)
    seed: Annotated[int, setting("1", "seed of a procedural volume", ge=0)] = 0
    peak: Annotated[float, setting("unit of the field", "largest value of a procedural volume", gt=0)] = 1.0

    def __post_init__(self) -> None:
        if bool(self.file) == bool(self.procedural):
            raise ValueError("a truth is either a file or procedural: give one of the two")


class Rendered(Section, tag_field="source", tag="render"):
    """References rendered by Mitsuba's path tracer."""

    spp: Annotated[int, setting("sample/pixel", "largest number of samples per pixel and view", ge=1)] = 1024
    standard_error: Annotated[
        float, setting("radiance", "stop earlier at this RMS standard error of the mean; 0: never", ge=0)
    ] = 0.0
    seed: Annotated[int, setting("1", "root of the references' random numbers", ge=0)] = 1
    max_depth: Annotated[Depth | None, setting("1", "longest path, as in volpath; -1: unlimited; absent: the fit's")] = None
    held_out: HeldOut = ()


class Files(Section, tag_field="source", tag="files"):
    """References from OpenEXR files, one per view."""

    paths: Annotated[tuple[str, ...], setting("path", "files in the order of the views, then of held_out", min_length=1)]
    scene: Annotated[str, setting("path", "XML of the scene in the files; empty: the fit's")] = ""
    held_out: HeldOut = ()


class Sought(Section):
    """A parameter to fit."""

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    unit: Annotated[str, setting("1", "unit of the value; empty: the usual unit of the key")] = ""
    domain: Annotated[tuple[float, float], setting("unit", "smallest and largest value")] = (0.0, INFINITY)
    map: Annotated[str, setting("1", "map from the optimizer's numbers: key of MAPS")] = "identity"
    lr: Annotated[float, setting("unit", "learning rate: typical change per step", gt=0)] = 0.1
    start: Annotated[
        float | tuple[float, ...] | None, setting("unit", "first value: one number, or one per channel; absent: the scene's")
    ] = None
    start_file: Annotated[str, setting("path", "volume with the first value; empty: start")] = ""
    start_fit: Annotated[
        Literal["", "emission"], setting("1", "emission: fit an emissive volume first, and give the first value its shape")
    ] = ""
    shape: Annotated[Size | None, setting("voxel", "(Z, Y, X) of a constant first value")] = None
    prior: Annotated[tuple[union_type(PRIORS), ...], setting("1", "regularization of the parameter")] = ()

    def __post_init__(self) -> None:
        check_word(self.map, MAPS, "map")


class SceneFitSettings(Section):
    """Length and precision of the fit."""

    iterations: Annotated[int, setting("iteration", "largest number of iterations", ge=1)] = 100
    spp: Annotated[int, setting("sample/pixel", "samples of an image and of its derivative", ge=1)] = 16
    spp_shown: Annotated[int, setting("sample/pixel", "of report images, 16 or more for z-images; 0: spp", ge=0)] = 0
    samples_per_pass: Annotated[int, setting("sample", "most samples in one kernel; Ctrl-C waits for it", ge=1)] = 1 << 20
    max_depth: Annotated[Depth | str, setting("1", "longest path, as in volpath; -1: unlimited; auto: measured")] = 6
    noise: Annotated[float, setting("1", "noise over mean radiance; max_depth = auto neglects less", gt=0)] = 0.02
    integrator: Annotated[str, setting("1", "Mitsuba integrator with derivatives", min_length=1)] = "mivol"

    def __post_init__(self) -> None:
        if isinstance(self.max_depth, str) and self.max_depth != AUTO:
            raise ValueError(f'max_depth is "{self.max_depth}": expected a whole number from -1 on, or "{AUTO}"')


class SceneExperiment(Section):
    """A fit of scene parameters to images: a file with a table ``[scene]``."""

    title: Title
    scene: Annotated[Scene, setting("1", "the rendered scene")]
    parameter: Annotated[tuple[Sought, ...], setting("1", "the parameters to fit", min_length=1)]
    views: Annotated[Ring | Hemisphere | LookAts | SceneSensors, setting("1", "the cameras")] = SceneSensors()
    held_out: Annotated[
        Ring | Hemisphere | LookAts | SceneSensors | None, setting("1", "more cameras, evaluated but not fitted")
    ] = None
    reference: Annotated[Rendered | Files, setting("1", "the images to fit")] = Rendered()
    truth: Annotated[Truth | None, setting("1", "the true volume in the references, if known")] = None
    fit: Annotated[SceneFitSettings, setting("1", "length and precision of the fit")] = SceneFitSettings()
    optimizer: Annotated[union_type(OPTIMIZERS), setting("1", "the optimizer")] = Adam()
    schedule: Annotated[union_type(SCHEDULES), setting("1", "factor on the learning rate")] = Constant()
    loss: Annotated[union_type(LOSSES), setting("1", "distance between image and reference")] = L2()
    event: Annotated[tuple[union_type(EVENTS), ...], setting("1", "actions between iterations")] = (Checkpoint(), Evaluate())
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/fit"


# -- Projections -----------------------------------------------------------------------------------------------------------


class Detector(Section, tag_field="beam"):
    """Settings of both circular beams; measured data bring the detector's size and the angles."""

    views: Annotated[int, setting("view", "number of views, evenly over the arc", ge=1)] = 90
    arc: Annotated[float, setting("degree", "angle of the whole scan; above 360 for several turns", gt=0, le=36000)] = 180.0
    detector: Annotated[tuple[Count, Count], setting("pixel", "(rows, columns)")] = (1, 128)
    pitch: Annotated[float | tuple[float, float], setting("length", "pixel distance: one, or (rows, columns)")] = 1.0
    detector_offset: Annotated[
        tuple[float, float], setting("length", "shift of the detector's middle along (rows, columns)")
    ] = (0.0, 0.0)
    axis_offset: Annotated[float, setting("length", "rotation axis from the middle, along the columns")] = 0.0
    tilt: Annotated[
        float,
        setting("degree", "how far the axis leans towards the detector (laminography); 0: across the light", gt=-90, lt=90),
    ] = 0.0
    refine: Annotated[
        tuple[Literal["shift", "axis", "tilt"], ...],
        setting(
            "1",
            "geometry as unknowns of the fit; shift: displacement and turn of the detector in each view; axis: the axis along "
            "the columns; tilt: the axis along and across the light; held-out views decide whether the result is used",
        ),
    ] = ()


class Parallel(Detector, tag="parallel"):
    """A parallel beam."""


class Cone(Detector, kw_only=True, tag="cone"):
    """A cone beam."""

    source_to_axis: Annotated[float, setting("length", "source to rotation axis", gt=0)]
    source_to_detector: Annotated[float, setting("length", "source to detector", gt=0)]
    lift: Annotated[float, setting("length", "rise of source and detector a turn, of a helix; z = 0 in the middle")] = 0.0
    sources: Annotated[
        tuple[tuple[float, float], ...],
        setting("length", "shift of each of several sources along (columns, z); each has all views, one after the other"),
    ] = ()


def is_circle(scan: object) -> bool:
    """Whether one source turns on a circle, or the light is parallel: the beam then has a rotation axis to find."""
    return isinstance(scan, Parallel) or (isinstance(scan, Cone) and not scan.lift and not scan.sources)


class Table(Section, kw_only=True, tag_field="beam", tag="table"):
    """A point source and a flat detector on any trajectory; measured data bring the detector's size."""

    file: Annotated[str, setting("path", "12 lengths per view: source, detector's middle, steps to next column and row")]
    detector: DetectorSize = (1, 128)


class Matrices(Section, kw_only=True, tag_field="beam", tag="matrices"):
    """A point source and a flat detector on any trajectory, as projection matrices: (column, row, 1) ~ P (x, y, z, 1)."""

    file: Annotated[str, setting("path", "text, 12 numbers per view: P, row by row", min_length=1)]
    detector: DetectorSize = (1, 128)
    first_pixel: Annotated[tuple[float, float], setting("pixel", "(column, row) of the first pixel's middle under P")] = (
        0.0,
        0.0,
    )


class OfData(Section, tag_field="beam", tag="data"):
    """The geometry in the data; only source = "nikon" has a geometry."""


class Simulated(Section):
    """Noise of computed projections."""

    photons: Annotated[float, setting("quantum/pixel", "quanta per pixel without an object; 0: no noise", ge=0)] = 0.0
    seed: Annotated[int, setting("1", "root of the noise's random numbers", ge=0)] = 1


class Ellipsoids(Simulated, tag_field="source", tag="shepp_logan"):
    """Exact line integrals of the Shepp-Logan head, without a grid."""

    table: Annotated[str, setting("1", "kak-slaney, yu-ye-wang or toft-schabel", min_length=1)] = "yu-ye-wang"
    half_width: Annotated[float, setting("length", "half the width of the head's box", gt=0)] = 1.0
    scale: Annotated[float, setting("1/length", "factor on the table's values", gt=0)] = 1.0


class Known(Simulated, kw_only=True, tag_field="source", tag="volume"):
    """Projections of a volume file, by the projector of the reconstruction."""

    file: Annotated[str, setting("path", "volume with the shape of the grid", min_length=1)]
    scale: Annotated[float, setting("1/length", "factor on the volume's values", gt=0)] = 1.0


class Phase(Section, kw_only=True):
    """Paganin's filter of a single material."""

    delta_beta: Annotated[float, setting("1", "delta / beta of the material: decrement over absorption index", gt=0)]
    distance: Annotated[float, setting("mm", "object to detector; for a cone divided by the magnification", gt=0)]
    energy: Annotated[float, setting("keV", "of the light", ge=1, le=1000)]
    pixel: Annotated[float, setting("um", "edge of a pixel at the object", gt=0)]


class Readings(Section):
    """Settings of all measured projections."""

    find_axis: Annotated[
        bool | None, setting("1", "find the rotation axis; false: scan.axis_offset holds; absent: find it if that offset is 0")
    ] = None
    air: (
        Annotated[
            int,
            setting(
                "pixel",
                "columns of air at each edge, by which the views are divided; 0: none; absent: mivol looks for air, and uses "
                "it if its brightness differs from the flats",
                ge=0,
            ),
        ]
        | None
    ) = None
    drift: Annotated[int, setting("iteration", "fits of a drift of the light to each pixel; 0: none", ge=0)] = 0
    zingers: Annotated[
        float, setting("1", "pixels this many deviations brighter or darker than their neighbours are not used; 0: off", ge=0)
    ] = 0.0
    phase: Annotated[Phase | None, setting("1", "Paganin's filter, for a single material near the detector")] = None
    hardening: Annotated[
        int, setting("1", "degree of a polynomial that straightens line integrals of a single material; 0: off", ge=0, le=5)
    ] = 0
    scatter: Annotated[bool, setting("1", "with data.hardening: also fit a constant scattered light, of a single material")] = (
        False
    )
    rings: Annotated[
        Literal["none", "gain", "sort", "fit"],
        setting(
            "1",
            "steps between columns to remove, which make rings; gain: a constant factor of each pixel; fit: gain, and what is "
            "left as unknowns beside the volume; sort: the sorted values of each pixel, for factors that change with the "
            "brightness; blurs the projections",
        ),
    ] = "none"
    ring_width: (
        Annotated[
            int,
            setting(
                "pixel",
                "gain, fit: period along the detector of which half is removed, more of a shorter one; sort: columns of the "
                "median, an odd number; absent: 14 and 7",
                ge=3,
            ),
        ]
        | None
    ) = None
    saturation: Annotated[float, setting("reading", "smallest saturated reading, not used", gt=0)] = INFINITY


class Measured(Readings, kw_only=True, tag_field="source", tag="measured"):
    """An HDF5 file with flat and dark fields: NXtomo (NeXus), Data Exchange, or datasets by name."""

    file: Annotated[str, setting("path", "HDF5 file of any suffix", min_length=1)]
    group: Annotated[
        str,
        setting("1", "entry with image_key, or group with data, data_white, data_dark; empty: the first entry, else exchange"),
    ] = ""
    data: Annotated[str, setting("1", "dataset (views, rows, columns); empty: the layout's; a name: only named datasets")] = ""
    flats: Annotated[str, setting("1", "dataset of light without object: name, or other.h5:name; empty: the layout's")] = ""
    darks: Annotated[str, setting("1", "dataset without light, as flats")] = ""
    angles: Annotated[str, setting("1", "dataset with one angle per view, as flats; empty and none: evenly over scan.arc")] = ""
    angle_unit: Annotated[
        Literal["degree", "radian"] | None, setting("1", "unit of the angles; absent: their attribute units, else by the arc")
    ] = None
    rows: Annotated[
        tuple[Annotated[int, msgspec.Meta(ge=0)], Count] | None,
        setting("pixel", "first row, and row after the last, of a parallel beam; absent: all"),
    ] = None


class Stack(Readings, kw_only=True, tag_field="source", tag="stack"):
    """Projections as images or arrays, with flat and dark fields in other files."""

    file: Annotated[
        str, setting("path", "TIFF, EDF, HIS, MRC, .npy, .npz, HDF5 (views, rows, cols), or a pattern of images", min_length=1)
    ]
    reading: Annotated[
        Literal["intensity", "transmission", "line_integral"],
        setting("1", "quantity of a pixel; an intensity needs flats"),
    ]
    dataset: Annotated[str, setting("1", "name of the array in an .npz or HDF5 file")] = ""
    flats: Annotated[str, setting("path", "readings of light without object, as file")] = ""
    darks: Annotated[str, setting("path", "readings without light, as file; empty: 0")] = ""
    angles: Annotated[str, setting("path", "text with one angle per view; empty: evenly over scan.arc")] = ""
    angle_unit: Annotated[Literal["degree", "radian"], setting("1", "unit of the angles in the file")] = "degree"
    first_row: Annotated[Literal["lowest", "highest"], setting("1", "row of the detector that the file has first")] = "lowest"

    def __post_init__(self) -> None:
        if (self.reading == "intensity") != bool(self.flats) or (self.darks and not self.flats):
            raise ValueError("an intensity needs flats, and nothing else takes flats and darks: give flats, or change reading")
        if self.reading != "intensity" and self.saturation < INFINITY:
            raise ValueError("only readings of an intensity saturate: leave saturation out, or change reading")


class Nikon(Readings, kw_only=True, tag_field="source", tag="nikon"):
    """A scan of a Nikon (X-Tek) laboratory scanner [mm]: a settings file, and TIFF files beside the settings."""

    file: Annotated[str, setting("path", ".xtekct: geometry, white level and default grid", min_length=1)]
    angles: Annotated[str, setting("path", "_ctdata.txt or .ang; empty: even steps of the file")] = ""


class Grid(Section):
    """The voxels of the reconstruction."""

    shape: Annotated[Size, setting("voxel", "(Z, Y, X)")]
    voxel_size: Annotated[float | Vector, setting("length", "edges of a voxel: one number, or (x, y, z)")] = 1.0
    centre: Annotated[Vector, setting("length", "(x, y, z) of the box's middle")] = (0.0, 0.0, 0.0)


class SolveSettings(Section):
    """Inversion of the projections."""

    name: Annotated[str, setting("1", "auto, or a key of mivol.optim.projections.solvers.ALL_SOLVERS", min_length=1)] = AUTO
    start: Annotated[
        Literal["empty", "filtered"] | None,
        setting("1", "first volume; absent: auto takes filtered if the views allow it, others empty"),
    ] = None
    iterations: (
        Annotated[int, setting("iteration", 'largest number of iterations; absent: 20, with data.rings = "fit" 80', ge=1)]
        | None
    ) = None
    nonnegative: Annotated[bool, setting("1", "keep every voxel at or above 0")] = True
    subsets: Annotated[int, setting("1", "subsets of views, for os-sart", ge=1)] = 10
    relaxation: Annotated[float, setting("1", "of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, setting("1", "factor on the relaxation per sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, setting("1", "window of fbp and fdk: key of mivol.tomography.filtered.WINDOWS", min_length=1)] = (
        "ram-lak"
    )
    cutoff: Annotated[float, setting("1", "end of the window, over the Nyquist frequency", gt=0, le=1)] = 1.0
    supersampling: (
        Annotated[int, setting("1", "unknowns along each edge of a voxel, which is their mean; absent: auto 2, others 1", ge=1)]
        | None
    ) = None
    tv: Annotated[float, setting("tv_unit", "strength of total variation; absent: auto 1, others 0", ge=0)] | None = None
    delta: Annotated[float, setting("tv_unit", "slope below which noise is smoothed", gt=0)] = 0.1
    tv_unit: Annotated[
        Literal["length", "noise"],
        setting(
            "1",
            "units of tv and delta; noise: the strength that balances the noise, and the mean value per voxel; "
            "length: 1/length and 1/length^2",
        ),
    ] = "noise"
    storage: Annotated[
        Literal["auto", "walk", "matrix"],
        setting(
            "1",
            "matrix: keep the rows of a layer as a sparse matrix (parallel beams, fans); walk: walk through the grid in each "
            "product; auto: matrix if it fits the memory and saves time",
        ),
    ] = "auto"
    memory: Annotated[float, setting("GiB", "most memory of stored rows", gt=0)] = 1.0
    discrepancy: Annotated[float, setting("1", "stop at this residual over that of the noise; 0: never", ge=0)] = 0.0

    def __post_init__(self) -> None:
        check_word(self.name, [AUTO, *ALL_SOLVERS], "solver")
        check_word(self.window, WINDOWS, "window")

    @property
    def solver(self) -> str:
        """Key of ``mivol.optim.projections.solvers.ALL_SOLVERS``; "auto" stands for pcg."""
        return "pcg" if self.name == AUTO else self.name


class Slabs(Section):
    """Reconstruction of a volume beyond memory: slabs of layers along z, each from the detector rows that it needs."""

    memory: Annotated[float, setting("GiB", "most memory of the run", gt=0)] = 4.0
    format: Annotated[
        Literal["tiff", "zarr"], setting("1", "tiff: a file for each slice; zarr: OME-Zarr, by the package tensorstore")
    ] = "tiff"


class ScanExperiment(Section):
    """A reconstruction from projections: a file with a table ``[scan]``."""

    title: Title
    scan: Annotated[Parallel | Cone | Table | Matrices | OfData, setting("1", "beam and detector")]
    data: Annotated[Ellipsoids | Known | Measured | Stack | Nikon, setting("1", "the projections")]
    grid: Annotated[
        Grid | None, setting("1", "the voxels; absent: those of a Nikon file, or a voxel a pixel of measured circular scans")
    ] = None
    solve: Annotated[SolveSettings, setting("1", "the inversion")] = SolveSettings()
    slabs: Annotated[Slabs | None, setting("1", "slabs of a volume beyond memory; absent: the whole volume at once")] = None
    held_out_every: Annotated[int, setting("view", "step between views that are not fitted; 0: none", ge=0)] = 0
    checkpoint_every: Annotated[int, setting("iteration", "iterations between two checkpoints", ge=1)] = 5
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = 0
    output: Output = "runs/scan"

    def __post_init__(self) -> None:
        if isinstance(self.scan, OfData) != isinstance(self.data, Nikon):
            raise ValueError('scan.beam = "data" and data.source = "nikon" go together: give both, or neither')
        if getattr(self.data, "rings", "none") == "fit" and (self.data.drift or self.solve.solver in ("fbp", "fdk", "ml-tr")):
            other = f"data.drift = {self.data.drift}" if self.data.drift else f"{self.solve.solver}"
            raise ValueError(f'data.rings = "fit" needs least squares with constant gains, found {other}: use rings = "gain"')
        if getattr(self.data, "rows", None) and not isinstance(self.scan, Parallel):
            raise ValueError('data.rows cuts the detector of a beam = "parallel": leave it out')
        if isinstance(self.scan, Cone) and not is_circle(self.scan) and getattr(self.data, "find_axis", None):
            raise ValueError("data.find_axis needs one source on a circle, found scan.lift or scan.sources: leave it out")
        is_measured = isinstance(self.data, Measured | Stack) and isinstance(self.scan, Detector) and is_circle(self.scan)
        if self.grid is None and not (isinstance(self.data, Nikon) or is_measured):
            raise ValueError('the key "grid" is missing: give it')


# -- Photographs -----------------------------------------------------------------------------------------------------------


class Photographs(Section):
    """Posed photographs."""

    path: Annotated[str, setting("path", "folder or cameras: Blender, nerfstudio, instant-ngp, COLMAP, LLFF", min_length=1)]
    scale: Annotated[float, setting("1", "factor on width and height, by exact area means", gt=0, le=1)] = 1.0
    largest: Annotated[int, setting("pixel", "longest edge of a photograph; absent: scale", ge=16)] | None = None
    background: Annotated[
        str | Vector,
        setting(
            "1",
            "colour behind the model: white, black or an rgb triple; with alpha also random (a colour per image); without "
            "alpha also sky (fitted with the field) or nested (a sky, and boxes of twice the extent each); empty: white with "
            "alpha, else the preset's, or black",
        ),
    ] = ""
    held_out: Annotated[int, setting("view", "step between training views that are not fitted; 0: none", ge=0)] = 8
    box: Annotated[
        str | tuple[Vector, Vector],
        setting(
            "1",
            "box of the matter: silhouettes (around the opaque pixels), cameras (what they look at), middle (innermost of "
            "nested boxes), found (silhouettes if all photographs have alpha, else cameras), or two corners [length]",
        ),
    ] = "found"
    judged: Annotated[str, setting("1", "views that judge the fit: held_out, val or test", min_length=1)] = "held_out"
    space: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "fitted values: srgb (codes) or linear (radiance); absent: as stored in the photographs"),
    ] = None
    stored: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "values in PNG and JPEG files; absent: linear for a PNG of gAMA 1, else srgb; OpenEXR is always linear"),
    ] = None

    def __post_init__(self) -> None:
        colour = self.background
        if not isinstance(colour, str) and not all(0 <= c <= 1 for c in colour):  # NaN fails every comparison
            raise ValueError(f"background is {list(colour)}: three numbers from 0 to 1 are expected, codes of 8 bits over 255")


MOST_LEVELS = 12
"""Largest number of nested boxes; the largest box is then 2048 times the innermost."""


class FieldSettings(Section):
    """The radiance field and its fit."""

    kind: Annotated[Literal["grid"], setting("1", "a sparse grid of density and harmonics")] = "grid"
    preset: Annotated[str, setting("1", "nodes, steps, rates, priors: tiny, cpu, fine, capture or gpu", min_length=1)] = "cpu"
    longest: Annotated[int, setting("voxel", "voxels along the longest edge; absent: preset", ge=8)] | None = None
    degree: Annotated[int, setting("1", "of the spherical harmonics; absent: preset", ge=0, le=4)] | None = None
    first_degree: Annotated[int, setting("1", "degree of the first stage; absent: degree", ge=0, le=4)] | None = None
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    tv_density: Annotated[float, setting("photograph", "total variation of the density; absent: preset", ge=0)] | None = None
    tv_sh: Annotated[float, setting("photograph", "total variation of the colours; absent: preset", ge=0)] | None = None
    sparsity: Annotated[float, setting("photograph", "sparsity of the density; absent: preset", ge=0)] | None = None
    matte: (
        Annotated[
            float,
            setting(
                "photograph",
                "decay of view-dependent colours; absent: preset (capture with fewer than 50 photographs: 0)",
                ge=0,
            ),
        ]
        | None
    ) = None
    depth: (
        Annotated[float, setting("1", "weight of the depths of reconstructed points; absent: preset (only capture)", ge=0)]
        | None
    ) = None
    levels: (
        Annotated[
            int,
            setting(
                "1",
                "nested boxes; absent: preset (1, capture 5), or fewer if they hold points and cameras",
                ge=1,
                le=MOST_LEVELS,
            ),
        ]
        | None
    ) = None
    sky: Annotated[int, setting("row", "rows of the fitted map behind the box; 0: none", ge=0, le=4096)] | None = None
    exposure: Annotated[
        bool | None, setting("1", "gains of each photograph, dropped if they agree; absent: preset (only capture)")
    ] = None
    beta: Annotated[float, setting("1", "favours rays of opacity 0 or 1; absent: preset", ge=0)] | None = None

    def __post_init__(self) -> None:
        if self.sky == 1:
            raise ValueError("sky is 1: 0, or 2 to 4096 rows are expected")


Keyframe = tuple[float, float, float, float, float, float]


class ShowSettings(Section):
    """Images, film and curve of a fit of photographs."""

    views: Annotated[int, setting("view", "judged views that the report shows in full", ge=0)] = 4
    frames: Annotated[int, setting("frame", "frames of the film; 0: no film", ge=0, le=65536)] = 60
    way: Annotated[
        Literal["turntable", "views", "keyframes"],
        setting("1", "path of the film's camera: around the box, through the photographs' places in order, or past keyframes"),
    ] = "turntable"
    keyframes: Annotated[
        tuple[Keyframe, ...], setting("length", "camera and target points of the film, two or more, at equal intervals of time")
    ] = ()
    every: Annotated[int, setting("step", "steps between two points of the held-out curve", ge=1)] = 250
    judged: Annotated[int, setting("view", "held-out views in the curve, the same at each point; 0: all", ge=0)] = 4
    metrics: Annotated[tuple[str, ...], setting("1", "of the judged views: psnr, ssim, flip", min_length=1)] = ("psnr", "ssim")

    def __post_init__(self) -> None:
        if self.way == "keyframes" and len(self.keyframes) < 2:
            raise ValueError(f"{len(self.keyframes)} keyframes were given: at least 2 are expected")
        if self.keyframes and self.way != "keyframes":
            raise ValueError(f'keyframes were given beside way = "{self.way}": "keyframes" is expected')
        for name in self.metrics:
            check_word(name, METRICS, "metric")


class FieldExperiment(Section):
    """A fit of a radiance field to photographs: a file with a table ``[photos]``."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    field: Annotated[FieldSettings, setting("1", "the radiance field and its fit")] = FieldSettings()
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/field"


class HashSettings(Section):
    """The hash grid and its fit."""

    kind: Annotated[Literal["hash"], setting("1", "a multi-resolution hash grid with two small networks")]
    preset: Annotated[str, setting("1", "sizes, steps, rates: tiny, minute, minutes or gpu", min_length=1)] = "minute"
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    levels: Annotated[int, setting("1", "levels of the hash grid; absent: preset", ge=1, le=32)] | None = None
    features: Annotated[int, setting("1", "numbers a row: 1, 2, 4 or 8; absent: preset", ge=1, le=8)] | None = None
    log2_table: Annotated[int, setting("1", "logarithm of the most rows a level; absent: preset", ge=8, le=24)] | None = None
    coarsest: Annotated[int, setting("cell", "cells along the longest edge, first level; absent: preset", ge=1)] | None = None
    finest: Annotated[int, setting("cell", "cells along the longest edge, last level; absent: preset", ge=1)] | None = None
    width: Annotated[int, setting("neuron", "neurons of a hidden layer; absent: preset", ge=1, le=256)] | None = None
    samples: Annotated[int, setting("sample", "samples of a step; absent: preset", ge=256, le=1 << 22)] | None = None
    cells: Annotated[int, setting("cell", "cells of the map of occupied space; absent: preset", ge=4, le=256)] | None = None

    def __post_init__(self) -> None:
        if self.features not in (None, 1, 2, 4, 8):
            raise ValueError(f"features is {self.features}: 1, 2, 4 or 8 is expected")


class HashExperiment(Section):
    """A fit of a hash grid to photographs: a file with a table ``[photos]``, and ``kind = "hash"`` in its table ``[field]``."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    field: Annotated[HashSettings, setting("1", "the hash grid and its fit")]
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/field"


class NerfSettings(Section):
    """The coordinate network and its fit."""

    kind: Annotated[Literal["nerf"], setting("1", "one coordinate network, density and colour of a place and a direction")]
    preset: Annotated[str, setting("1", "sizes, steps, rates: tiny, minutes or gpu", min_length=1)] = "minutes"
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    depth: Annotated[int, setting("layer", "layers of the trunk; absent: preset", ge=1, le=16)] | None = None
    width: Annotated[int, setting("neuron", "neurons of such a layer; absent: preset", ge=1, le=1024)] | None = None
    skip: (
        Annotated[int, setting("layer", "layer after which the place is put in again; 0: none; absent: preset", ge=0, le=15)]
        | None
    ) = None
    place: Annotated[int, setting("1", "frequencies of the place; absent: preset", ge=0, le=16)] | None = None
    direction: Annotated[int, setting("1", "frequencies of the direction; absent: preset", ge=0, le=16)] | None = None
    branch: Annotated[int, setting("neuron", "hidden neurons of the colours; absent: preset", ge=1, le=1024)] | None = None
    relu: Annotated[int, setting("1", "1: density by a ReLU, 0: by softplus; absent: preset", ge=0, le=1)] | None = None
    harmonics: (
        Annotated[int, setting("1", "degree of harmonics for the colours (NeRF-SH); -1: a branch; absent: preset", ge=-1, le=4)]
        | None
    ) = None
    coarse: (
        Annotated[int, setting("sample", "samples of a ray by a coarse network; 0: one network; absent: preset", ge=0, le=1024)]
        | None
    ) = None
    fine: (
        Annotated[int, setting("sample", "samples where the coarse network has weight; absent: preset", ge=0, le=1024)] | None
    ) = None
    samples: Annotated[int, setting("sample", "samples of a step; absent: preset", ge=256, le=1 << 22)] | None = None
    cells: Annotated[int, setting("cell", "cells of the map of occupied space; absent: preset", ge=4, le=256)] | None = None


class NerfExperiment(Section):
    """A fit of a NeRF to photographs: a file with a table ``[photos]``, and ``kind = "nerf"`` in its table ``[field]``."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    field: Annotated[NerfSettings, setting("1", "the network and its fit")]
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/field"


class OctreeSettings(Section):
    """The octree and its fit: a grid first, or a field of a file."""

    kind: Annotated[Literal["octree"], setting("1", "a grid, its octree, and a fit of the leaves")]
    start: Annotated[
        str,
        setting(
            "path",
            "field (.npz) to begin at: grid, octree, hash grid or NeRF; hash or nerf: fit one first; empty: fit a grid first",
        ),
    ] = ""
    preset: Annotated[str, setting("1", "of the grid: tiny, cpu, fine or gpu", min_length=1)] = "cpu"
    effort: Annotated[float, setting("1", "factor on the steps of grid and octree", gt=0)] = 1.0
    longest: (
        Annotated[int, setting("voxel", "voxels of the grid along its longest edge; absent: preset", ge=8, le=2048)] | None
    ) = None
    degree: Annotated[int, setting("1", "of the spherical harmonics; absent: preset", ge=0, le=4)] | None = None
    depth: (
        Annotated[int, setting("1", "levels of the octree below its root; absent: leaves of half a voxel", ge=1, le=12)] | None
    ) = None
    keep_weight: Annotated[
        float, setting("1", "share of a pixel below which a leaf that weighs less in all views is dropped", ge=0, lt=1)
    ] = 0.015
    tolerance: Annotated[float, setting("1", "change of views up to which eight leaves become one", ge=0, lt=1)] = 0.15
    steps: Annotated[int, setting("step", "steps of the octree, before effort", ge=1)] = 400


class OctreeExperiment(Section):
    """A fit of an octree to photographs: a file with a table ``[photos]``, and ``kind = "octree"`` in its table ``[field]``."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    field: Annotated[OctreeSettings, setting("1", "the octree and its fit")]
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/octree"


class GaussianSettings(Section):
    """The Gaussians and their fit."""

    preset: Annotated[str, setting("1", "steps, sizes, rates: tiny, minute, minutes, fine, finest or gpu", min_length=1)] = (
        "minute"
    )
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    minutes: (
        Annotated[float, setting("min", "as many steps as take about this time on two idle cores; no clock is read", gt=0)]
        | None
    ) = None
    start: Annotated[int, setting("1", "first Gaussians without known points; absent: preset", ge=4)] | None = None
    most: Annotated[int, setting("1", "Gaussians at the end of growth; absent: preset", ge=4)] | None = None
    degree: Annotated[int, setting("1", "of the spherical harmonics; absent: preset", ge=0, le=3)] | None = None
    control: Annotated[str | None, setting("1", "density control: clone_split or relocation; absent: preset")] = None
    ssim: Annotated[float, setting("1", "weight of SSIM in the loss; absent: preset", ge=0, le=1)] | None = None
    mip: Annotated[bool, setting("1", "keep the light of Gaussians smaller than a pixel, for other sizes")] = False
    exposure: Annotated[bool, setting("1", "gains of each photograph, for photographs without alpha")] = False
    views: Annotated[int, setting("1", "photographs of a step, which workers of a cluster share; fewer steps then", ge=1)] = 1

    def __post_init__(self) -> None:
        if self.minutes is not None and self.effort != 1:
            raise ValueError(f"minutes is {self.minutes} beside effort {self.effort}: only one of the two is expected")


class GaussianExperiment(Section):
    """A fit of Gaussians to photographs: a file with tables ``[photos]`` and ``[gaussians]``."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    gaussians: Annotated[GaussianSettings, setting("1", "the Gaussians and their fit")]
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/gaussians"


PhotoExperiment = FieldExperiment | HashExperiment | NerfExperiment | OctreeExperiment | GaussianExperiment
"""A fit of photographs, with one of the models."""

Experiment = SceneExperiment | ScanExperiment | PhotoExperiment
"""An experiment of any kind."""

KINDS: dict[str, type[Section]] = {
    "scene": SceneExperiment,
    "scan": ScanExperiment,
    "gaussians": GaussianExperiment,
    "photos": FieldExperiment,
}
"""Kinds of experiments by a table of the file; the first present table decides."""

FIELD_KINDS: dict[str, type[Section]] = {
    "grid": FieldExperiment,
    "hash": HashExperiment,
    "nerf": NerfExperiment,
    "octree": OctreeExperiment,
}
"""Kinds of fits with a table ``[photos]``, by the setting ``field.kind``."""

EXPERIMENTS = (
    SceneExperiment,
    ScanExperiment,
    FieldExperiment,
    HashExperiment,
    NerfExperiment,
    OctreeExperiment,
    GaussianExperiment,
)
"""Settings of all kinds of experiments."""

CAPTURE = {"photos": {"largest": 240, "box": "middle"}, "show": {"views": 64}}
"""Defaults of a file with ``field.preset = "capture"``: photograph size resolved by the grids, nested boxes, views."""

NOT_RESULT = ("output", "threads", "title", "checkpoint_every", "show")
"""Settings without effect on result and checkpoint."""


def load(path: str | Path, changes: Sequence[str] = ()) -> Experiment:
    """Read an experiment from a TOML file.

    Args:
        path: TOML file.
        changes: ``a.b=c`` from the command line; entries of a list by index, ``parameter.0.lr=0.1``.

    Raises:
        MivolError: a missing file, invalid TOML, an unknown key, a wrong type, or a value outside its domain.
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
    """Make an experiment from dicts and lists; the tables determine the kind (``KINDS``).

    Args:
        raw: tables and settings, as in TOML.
        name: beginning of an error message.

    Raises:
        MivolError: as :func:`load`.
    """
    kind = _find_kind(raw, name)
    raw = _with_capture(raw)
    check_keys(raw, kind, "", name)
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        reason = textwrap.shorten(explain_error(raw, str(error)), LONGEST_SENTENCE, placeholder=" ...")
        raise MivolError(f"{name}: {reason}") from None


def _find_kind(raw: dict[str, Any], name: str) -> type[Section]:
    """The kind of an experiment by its tables, and by the kind of its field.

    Raises:
        MivolError: an unknown kind of field.
    """
    kind = next((KINDS[table] for table in KINDS if table in raw), SceneExperiment)
    field = raw.get("field")
    if kind is not FieldExperiment or not isinstance(field, dict) or "kind" not in field:
        return kind
    word = str(field["kind"])
    if word not in FIELD_KINDS:
        raise MivolError(f'{name}: field.kind = "{word}" is unknown: {suggest_name(word, list(FIELD_KINDS))}')
    return FIELD_KINDS[word]


MODELS: dict[str, dict[str, dict[str, str]]] = {
    "gaussians": {"gaussians": {}},
    "grid": {"field": {}},
    "hash": {"field": {"kind": "hash"}},
    "nerf": {"field": {"kind": "nerf"}},
    "octree": {"field": {"kind": "octree"}},
}
"""Table of a model with its first settings, by the word of ``mivol optimize --as``; the first word is the default."""


def of_photographs(
    path: Path, model: str = "gaussians", preset: str | None = None, changes: Sequence[str] = ()
) -> PhotoExperiment:
    """Make the experiment of photographs without a TOML file.

    Args:
        path: folder of photographs, or file of cameras.
        model: key of ``MODELS``.
        preset: preset of that model; by default the preset of an empty file.
        changes: as in :func:`load`.

    Raises:
        MivolError: as :func:`load`.
    """
    chosen = {} if preset is None else {"preset": preset}
    tables = {table: settings | chosen for table, settings in MODELS[model].items()}
    raw = {"title": path.resolve().name, "photos": {"path": str(path)}, **tables}
    for change in changes:
        apply_change(raw, change)
    return from_dict(raw, str(path))


def _with_capture(raw: dict[str, Any]) -> dict[str, Any]:
    """Add the defaults of ``CAPTURE`` to a file with the preset ``capture``."""
    field = raw.get("field")
    if "photos" not in raw or not isinstance(field, dict) or field.get("preset") != "capture":
        return raw
    tables = {table: raw.get(table, {}) for table in CAPTURE}
    return raw | {name: CAPTURE[name] | table if isinstance(table, dict) else table for name, table in tables.items()}


def resolved(experiment: Experiment) -> dict[str, Any]:
    """Return all settings, defaults included, as dicts and lists."""
    return msgspec.to_builtins(experiment)


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the settings with effect on the result, by dotted key."""
    if isinstance(tree, dict | list | tuple) and len(tree):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        values: dict[str, Any] = {}
        for key, value in items:
            if prefix or key not in NOT_RESULT:
                values |= flat(value, f"{prefix}.{key}" if prefix else str(key))
        return values
    return {prefix: tree}


# -- Command line ----------------------------------------------------------------------------------------------------------


def apply_change(raw: dict[str, Any], change: str) -> None:
    """Put ``a.b=c`` into ``raw``; a value outside TOML's syntax is a text.

    Raises:
        MivolError: no "=", or a key below a value without parts.
    """
    dotted, equals, text = change.partition("=")
    if not equals or not dotted.strip():
        raise MivolError(f'--set "{change}" is not a change: write key.of.setting=value.')
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
        raise MivolError(f'--set "{change}": "{step}" does not exist: entries of a list count from 0.')
    return place[int(step)]
