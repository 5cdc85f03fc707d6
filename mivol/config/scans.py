"""Settings of a reconstruction from projections."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from mivol.optim.projections.inversion import ALL_SOLVERS
from mivol.optim.strategy import setting
from mivol.schema import (
    AUTO,
    INFINITY,
    Count,
    DetectorSize,
    Output,
    Section,
    Size,
    Threads,
    Title,
    Variant,
    Vector,
    check_word,
)
from mivol.tomography.filtered import WINDOWS


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
            "geometry to fit with the volume; shift: displacement and turn of the detector in each view; axis: position of the "
            "axis along the columns; tilt: lean of the axis along and across the light; held-out views decide whether the "
            "result is used",
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


class ViewTable(Section, kw_only=True, tag_field="beam", tag="table"):
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


class PhaseFilter(Section, kw_only=True):
    """Paganin's filter of a single material."""

    delta_beta: Annotated[float, setting("1", "delta / beta of the material: decrement over absorption index", gt=0)]
    distance: Annotated[float, setting("mm", "object to detector; for a cone divided by the magnification", gt=0)]
    energy: Annotated[float, setting("keV", "energy of the photons", ge=1, le=1000)]
    pixel: Annotated[float, setting("um", "edge of a pixel at the object", gt=0)]


class ReadingSettings(Section):
    """Settings of all measured projections."""

    find_axis: Annotated[
        bool | Literal["entropy"] | None,
        setting(
            "1",
            "find the rotation axis; false: scan.axis_offset holds; entropy: by the entropy of slices, as a second opinion on "
            "detailed objects wider than the detector of a parallel beam (off by 0.26 columns in computed scans, mirror images "
            "by 0.12; not for much noise or axes near an edge); absent: find the axis if scan.axis_offset is 0",
        ),
    ] = None
    air: (
        Annotated[
            int,
            setting(
                "pixel",
                "columns at each edge that show air; views are divided by their mean; 0: no division; absent: mivol looks "
                "for air, and divides if its brightness differs from the flats",
                ge=0,
            ),
        ]
        | None
    ) = None
    drift: Annotated[
        int,
        setting(
            "1",
            "how often an offset and a slope over time are fitted to each pixel, spread over the iterations (5 or more apart; "
            "20 from an empty start); a fit no better than chance changes nothing; 0: never",
            ge=0,
        ),
    ] = 0
    zingers: Annotated[
        float, setting("1", "pixels this many deviations brighter or darker than their neighbours are not used; 0: off", ge=0)
    ] = 0.0
    phase: Annotated[PhaseFilter | None, setting("1", "Paganin's filter, for a single material near the detector")] = None
    hardening: Annotated[
        int, setting("1", "degree of the polynomial that corrects beam hardening in a single material; 0: off", ge=0, le=5)
    ] = 0
    scatter: Annotated[
        bool,
        setting(
            "1",
            "subtract scattered light: a smooth image, the same for all views, by which the views agree; with data.hardening "
            "a constant behind an object of a single material",
        ),
    ] = False
    rings: Annotated[
        Literal["none", "gain", "sort", "fit"],
        setting(
            "1",
            "ring removal; gain: removes a constant factor of each pixel; fit: as gain, then fits the rest of each pixel with "
            "the volume; sort: replaces sorted values of each pixel by a median, for factors that change with the "
            "brightness, and blurs the projections",
        ),
    ] = "none"
    ring_width: (
        Annotated[
            int,
            setting(
                "pixel",
                "gain, fit: period along the detector of which half is removed; shorter periods are removed, longer ones stay; "
                "sort: columns of the median, an odd number; absent: gain 14, fit 5, sort 7",
                ge=3,
            ),
        ]
        | None
    ) = None
    saturation: Annotated[float, setting("reading", "readings from this value on are saturated and not used", gt=0)] = INFINITY


FirstRow = Annotated[Literal["lowest", "highest"], setting("1", "which row of the detector comes first in the file")]


class Measured(ReadingSettings, kw_only=True, tag_field="source", tag="measured"):
    """An HDF5 file with flat and dark fields: NXtomo (NeXus), Data Exchange, or datasets by name."""

    file: Annotated[str, setting("path", "HDF5 file of any suffix", min_length=1)]
    group: Annotated[
        str,
        setting("1", "entry with image_key, or group with data, data_white, data_dark; empty: the first entry, else exchange"),
    ] = ""
    data: Annotated[
        str, setting("1", "dataset (views, rows, columns); empty: by the layout; if named, name the others too")
    ] = ""
    flats: Annotated[str, setting("1", "dataset of light without object: name, or other.h5:name; empty: by the layout")] = ""
    darks: Annotated[str, setting("1", "dataset without light, as flats")] = ""
    angles: Annotated[str, setting("1", "dataset with one angle per view, as flats; none found: evenly over scan.arc")] = ""
    angle_unit: Annotated[
        Literal["degree", "radian"] | None,
        setting("1", "unit of the angles; absent: by their attribute units, else by their range"),
    ] = None
    rows: Annotated[
        tuple[Annotated[int, msgspec.Meta(ge=0)], Count] | None,
        setting("pixel", "first row, and row after the last, as in the file, of a parallel beam; absent: all"),
    ] = None
    first_row: FirstRow = "lowest"


class Stack(ReadingSettings, kw_only=True, tag_field="source", tag="stack"):
    """Projections as images or arrays, with flat and dark fields in other files."""

    file: Annotated[
        str,
        setting(
            "path",
            "TIFF, EDF, HIS, MRC, .npy, .npz, HDF5 (views, rows, cols), DICOM views, or a pattern of images",
            min_length=1,
        ),
    ]
    reading: Annotated[
        Literal["intensity", "transmission", "line_integral"],
        setting("1", "quantity of a pixel; an intensity needs flats or light"),
    ]
    images: Annotated[
        Literal["views", "sinograms"],
        setting("1", "axes of the file: views (view, row, column), or sinograms of corrected values (row, view, column)"),
    ] = "views"
    dataset: Annotated[str, setting("1", "name of the array in an .npz or HDF5 file")] = ""
    flats: Annotated[str, setting("path", "readings of light without object, as file")] = ""
    darks: Annotated[str, setting("path", "readings without light, as file; empty: 0")] = ""
    light: Annotated[float, setting("reading", "reading without the object, in place of flats; 0: flats, or none", ge=0)] = 0.0
    angles: Annotated[str, setting("path", "text with one angle per view, or DICOM views; empty: evenly over scan.arc")] = ""
    angle_unit: Annotated[Literal["degree", "radian"], setting("1", "unit of the angles in the file")] = "degree"
    first_row: FirstRow = "lowest"

    def __post_init__(self) -> None:
        has_light = bool(self.flats) != bool(self.light)
        if (self.reading == "intensity") != has_light or (self.darks and not has_light) or (self.flats and self.light):
            raise ValueError(
                "an intensity needs flats or light, one of them, and nothing else takes flats, light and darks: give flats, or "
                "change reading"
            )
        if self.reading == "intensity" and self.images == "sinograms":
            raise ValueError('sinograms hold corrected values: give reading = "transmission" or "line_integral"')
        if self.reading != "intensity" and self.saturation < INFINITY:
            raise ValueError("only readings of an intensity saturate: leave saturation out, or change reading")


class Nikon(ReadingSettings, kw_only=True, tag_field="source", tag="nikon"):
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

    name: Annotated[str, setting("1", "solver: auto, pcg, cgls, sirt, sart, os-sart, ml-tr, fbp or fdk", min_length=1)] = AUTO
    start: Annotated[
        Literal["empty", "filtered"] | None,
        setting("1", "first volume; absent: auto takes filtered if the views allow it, others empty"),
    ] = None
    iterations: (
        Annotated[int, setting("iteration", 'largest number of iterations; absent: 20, with data.rings = "fit" 60', ge=1)]
        | None
    ) = None
    nonnegative: Annotated[bool, setting("1", "keep every voxel at or above 0")] = True
    subsets: Annotated[int, setting("1", "subsets of views, for os-sart", ge=1)] = 10
    relaxation: Annotated[float, setting("1", "relaxation of the first sweep of sart and os-sart", gt=0, lt=2)] = 1.0
    decay: Annotated[float, setting("1", "factor on the relaxation per sweep", gt=0, le=1)] = 0.99
    window: Annotated[str, setting("1", "window of fbp and fdk: ram-lak, shepp-logan, cosine, hamming, hann", min_length=1)] = (
        "ram-lak"
    )
    cutoff: Annotated[float, setting("1", "highest frequency of the window, over the Nyquist frequency", gt=0, le=1)] = 1.0
    supersampling: (
        Annotated[
            int, setting("1", "unknowns along each edge of a voxel; the voxel is their mean; absent: auto 2, others 1", ge=1)
        ]
        | None
    ) = None
    tv: Annotated[float, setting("tv_unit", "strength of total variation; absent: auto 1, others 0", ge=0)] | None = None
    delta: Annotated[float, setting("tv_unit", "slopes below this value are smoothed quadratically", gt=0)] = 0.1
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
    memory: Annotated[float, setting("GiB", "most memory for the stored matrix", gt=0)] = 1.0
    discrepancy: Annotated[float, setting("1", "stop when the residual is this multiple of the noise; 0: never", ge=0)] = 0.0

    def __post_init__(self) -> None:
        check_word(self.name, [AUTO, *ALL_SOLVERS], "solver")
        check_word(self.window, WINDOWS, "window")

    @property
    def solver(self) -> str:
        """Key of ``mivol.optim.projections.inversion.ALL_SOLVERS``; "auto" stands for pcg."""
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
    scan: Annotated[Parallel | Cone | ViewTable | Matrices | OfData, setting("1", "beam and detector")]
    data: Annotated[Ellipsoids | Known | Measured | Stack | Nikon, setting("1", "the projections")]
    grid: Annotated[
        Grid | None, setting("1", "the voxels; absent: those of a Nikon file, or a voxel a pixel of measured circular scans")
    ] = None
    solve: Annotated[SolveSettings, setting("1", "the inversion")] = SolveSettings()
    slabs: Annotated[Slabs | None, setting("1", "slabs of a volume beyond memory; absent: the whole volume at once")] = None
    held_out_every: Annotated[int, setting("view", "every n-th view is not fitted; 0: all are fitted", ge=0)] = 0
    checkpoint_every: Annotated[int, setting("iteration", "iterations between two checkpoints", ge=1)] = 5
    unit: Annotated[str, setting("1", "unit of all lengths, such as mm, kept with the volume; empty: unknown")] = ""
    keep_state: Annotated[
        bool,
        setting(
            "1",
            "keep the solver's state of a finished run, so that more iterations continue as if it had not ended; otherwise "
            "they continue from its volume",
        ),
    ] = False
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = 0
    output: Output = "runs/scan"

    def __post_init__(self) -> None:
        if isinstance(self.scan, OfData) != isinstance(self.data, Nikon):
            raise ValueError('scan.beam = "data" and data.source = "nikon" go together: give both, or neither')
        if getattr(self.data, "rings", "none") == "fit" and (self.data.drift or self.solve.solver not in ("pcg", "cgls")):
            other = f"data.drift = {self.data.drift}" if self.data.drift else f"{self.solve.solver}"
            way = 'choose pcg, or use rings = "gain"'
            raise ValueError(f'data.rings = "fit" needs conjugate gradients and constant gains, found {other}: {way}')
        if getattr(self.data, "rows", None) and not isinstance(self.scan, Parallel):
            raise ValueError('data.rows cuts the detector of a beam = "parallel": leave it out')
        if getattr(self.data, "find_axis", None) == "entropy" and not isinstance(self.scan, Parallel):
            raise ValueError('data.find_axis = "entropy" needs beam = "parallel": give data.find_axis = true')
        if isinstance(self.scan, Cone) and not is_circle(self.scan) and getattr(self.data, "find_axis", None):
            raise ValueError("data.find_axis needs one source on a circle, found scan.lift or scan.sources: leave it out")
        is_measured = isinstance(self.data, Measured | Stack) and isinstance(self.scan, Detector) and is_circle(self.scan)
        if self.grid is None and not (isinstance(self.data, Nikon) or is_measured):
            raise ValueError('the key "grid" is missing: give it')
