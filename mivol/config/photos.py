"""Settings of fits of photographs, with one class for each model."""

from __future__ import annotations

from typing import Annotated, Literal

from mivol.optim.strategy import setting
from mivol.schema import (
    CheckpointSteps,
    Output,
    Section,
    Seed,
    Threads,
    Title,
    Variant,
    Vector,
    check_word,
)
from mivol.validate.metrics import METRICS


class Photographs(Section):
    """Posed photographs."""

    path: Annotated[str, setting("path", "folder or cameras: Blender, nerfstudio, instant-ngp, COLMAP, LLFF", min_length=1)]
    scale: Annotated[float, setting("1", "factor on width and height, by exact area means", gt=0, le=1)] = 1.0
    largest: Annotated[int, setting("pixel", "longest edge of a photograph; absent: photos.scale decides", ge=16)] | None = None
    background: Annotated[
        str | Vector,
        setting(
            "1",
            "colour behind the model: white, black or an rgb triple; with alpha also random (a colour per image); without "
            "alpha also sky (fitted with the field) or nested (a sky, and boxes of twice the extent each); empty: white with "
            "alpha, else the preset's, or black",
        ),
    ] = ""
    held_out: Annotated[int, setting("view", "every n-th training view is not fitted; 0: all are fitted", ge=0)] = 8
    fold: Annotated[
        int, setting("view", "number of the first view that is not fitted, below held_out: a fold of cross-validation", ge=0)
    ] = 0
    box: Annotated[
        str | tuple[Vector, Vector],
        setting(
            "1",
            "box of the matter: silhouettes (around the opaque pixels), cameras (the region that cameras share), middle "
            "(innermost of nested boxes), found (silhouettes if all photographs have alpha, else cameras), or two corners "
            "[length]",
        ),
    ] = "found"
    judged: Annotated[str, setting("1", "views that judge the fit: held_out, val or test", min_length=1)] = "held_out"
    space: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "fitted values: srgb (code values) or linear (radiance); absent: as stored in the photographs"),
    ] = None
    stored: Annotated[
        Literal["srgb", "linear"] | None,
        setting("1", "values in PNG and JPEG files; absent: linear for a PNG of gAMA 1, else srgb; OpenEXR is always linear"),
    ] = None

    def __post_init__(self) -> None:
        if self.fold and self.fold >= self.held_out:
            raise ValueError(f"fold is {self.fold}: a number below held_out = {self.held_out} is expected")
        colour = self.background
        if not isinstance(colour, str) and not all(0 <= c <= 1 for c in colour):  # NaN fails every comparison
            raise ValueError(f"background is {list(colour)}: three numbers from 0 to 1 are expected, codes of 8 bits over 255")


MOST_LEVELS = 12
"""Largest number of nested boxes; the largest box is then 2048 times the innermost."""


class FieldSettings(Section):
    """The radiance field and the fit."""

    kind: Annotated[Literal["grid"], setting("1", "a sparse grid of density and harmonics")] = "grid"
    preset: Annotated[str, setting("1", "nodes, steps, rates, priors: tiny, cpu, fine, capture or gpu", min_length=1)] = "cpu"
    longest: Annotated[int, setting("voxel", "voxels along the longest edge; absent: preset", ge=8)] | None = None
    degree: Annotated[int, setting("1", "degree of the spherical harmonics; absent: preset", ge=0, le=4)] | None = None
    first_degree: Annotated[int, setting("1", "degree of the first stage; absent: degree", ge=0, le=4)] | None = None
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    tv_density: (
        Annotated[float, setting("photograph", "weight of total variation of the density; absent: preset", ge=0)] | None
    ) = None
    tv_sh: Annotated[float, setting("photograph", "weight of total variation of the colours; absent: preset", ge=0)] | None = (
        None
    )
    sparsity: Annotated[float, setting("photograph", "weight of a prior for empty space; absent: preset", ge=0)] | None = None
    matte: (
        Annotated[
            float,
            setting(
                "photograph",
                "weight decay of view-dependent colours; absent: preset (capture, fewer than 50 photographs: 0)",
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
    sky: (
        Annotated[int, setting("row", "rows of the fitted sky behind the boxes; 0: no sky; absent: preset", ge=0, le=4096)]
        | None
    ) = None
    exposure: Annotated[
        bool | None,
        setting("1", "fit gains of each photograph, and drop them if exposures agree; absent: preset (only capture)"),
    ] = None
    poses: Annotated[bool, setting("1", "cameras move with the fit, for poses that are off by a pixel or more")] = False
    beta: Annotated[float, setting("1", "weight of a prior for rays of opacity 0 or 1; absent: preset", ge=0)] | None = None

    def __post_init__(self) -> None:
        if self.sky == 1:
            raise ValueError("sky is 1: 0, or 2 to 4096 rows are expected")


Keyframe = tuple[float, float, float, float, float, float]


class ShowSettings(Section):
    """Images, film and curve of a fit of photographs."""

    views: Annotated[int, setting("view", "held-out views that the report shows in full", ge=0)] = 4
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
    metrics: Annotated[tuple[str, ...], setting("1", "metrics of the held-out views: psnr, ssim, flip", min_length=1)] = (
        "psnr",
        "ssim",
    )

    def __post_init__(self) -> None:
        if self.way == "keyframes" and len(self.keyframes) < 2:
            raise ValueError(f"{len(self.keyframes)} keyframes were given: at least 2 are expected")
        if self.keyframes and self.way != "keyframes":
            raise ValueError(f'keyframes were given beside way = "{self.way}": "keyframes" is expected')
        for name in self.metrics:
            check_word(name, METRICS, "metric")


class PhotoExperiment(Section):
    """Settings of all fits to photographs."""

    title: Title
    photos: Annotated[Photographs, setting("1", "the photographs")]
    show: Annotated[ShowSettings, setting("1", "images, film and curve")] = ShowSettings()
    checkpoint_every: CheckpointSteps = 500
    variant: Variant = "llvm_ad_rgb"
    seed: Seed = 0
    threads: Threads = 0
    output: Output = "runs/field"


class FieldExperiment(PhotoExperiment, kw_only=True):
    """A fit of a radiance field to photographs: a file with a table ``[photos]``."""

    field: Annotated[FieldSettings, setting("1", "the radiance field and its fit")] = FieldSettings()


class HashSettings(Section):
    """The hash grid and the fit."""

    kind: Annotated[Literal["hash"], setting("1", "a multi-resolution hash grid with two small networks")]
    preset: Annotated[str, setting("1", "sizes, steps, rates: tiny, minute, minutes or gpu", min_length=1)] = "minute"
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    levels: Annotated[int, setting("1", "levels of the hash grid; absent: preset", ge=1, le=32)] | None = None
    features: Annotated[int, setting("1", "features of a table row: 1, 2, 4 or 8; absent: preset", ge=1, le=8)] | None = None
    log2_table: Annotated[int, setting("1", "log2 of the most table rows of a level; absent: preset", ge=8, le=24)] | None = (
        None
    )
    coarsest: Annotated[int, setting("cell", "cells along the longest edge, coarsest level; absent: preset", ge=1)] | None = (
        None
    )
    finest: Annotated[int, setting("cell", "cells along the longest edge, finest level; absent: preset", ge=1)] | None = None
    width: Annotated[int, setting("neuron", "neurons of a hidden layer; absent: preset", ge=1, le=256)] | None = None
    samples: Annotated[int, setting("sample", "samples of a step; absent: preset", ge=256, le=1 << 22)] | None = None
    cells: Annotated[int, setting("cell", "edge of the map of occupied cells; absent: preset", ge=4, le=256)] | None = None
    precision: (
        Annotated[Literal["single", "half"], setting("1", "size of the floats in the table that rays read; absent: preset")]
        | None
    ) = None

    def __post_init__(self) -> None:
        if self.features not in (None, 1, 2, 4, 8):
            raise ValueError(f"features is {self.features}: 1, 2, 4 or 8 is expected")


class HashExperiment(PhotoExperiment, kw_only=True):
    """A fit of a hash grid to photographs: a file with a table ``[photos]``, and ``kind = "hash"`` in its table ``[field]``."""

    field: Annotated[HashSettings, setting("1", "the hash grid and its fit")]


class NerfSettings(Section):
    """The coordinate network and the fit."""

    kind: Annotated[Literal["nerf"], setting("1", "one network from position and direction to density and colour")]
    preset: Annotated[str, setting("1", "sizes, steps, rates: tiny, minutes or gpu", min_length=1)] = "minutes"
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    depth: Annotated[int, setting("layer", "layers of the trunk; absent: preset", ge=1, le=16)] | None = None
    width: Annotated[int, setting("neuron", "neurons of a layer of the trunk; absent: preset", ge=1, le=1024)] | None = None
    skip: (
        Annotated[int, setting("layer", "layer after which the position enters again; 0: none; absent: preset", ge=0, le=15)]
        | None
    ) = None
    place: Annotated[int, setting("1", "frequencies of the encoded position; absent: preset", ge=0, le=16)] | None = None
    direction: Annotated[int, setting("1", "frequencies of the encoded direction; absent: preset", ge=0, le=16)] | None = None
    branch: (
        Annotated[int, setting("neuron", "neurons of the hidden layer for colours; absent: preset", ge=1, le=1024)] | None
    ) = None
    relu: Annotated[int, setting("1", "1: density by a ReLU, 0: by softplus; absent: preset", ge=0, le=1)] | None = None
    harmonics: (
        Annotated[int, setting("1", "degree of colour harmonics (NeRF-SH); -1: a branch instead; absent: preset", ge=-1, le=4)]
        | None
    ) = None
    coarse: (
        Annotated[int, setting("sample", "samples of a ray by a coarse network; 0: one network; absent: preset", ge=0, le=1024)]
        | None
    ) = None
    fine: (
        Annotated[
            int, setting("sample", "samples of a ray where the coarse network sees matter; absent: preset", ge=0, le=1024)
        ]
        | None
    ) = None
    samples: Annotated[int, setting("sample", "samples of a step; absent: preset", ge=256, le=1 << 22)] | None = None
    cells: Annotated[int, setting("cell", "edge of the map of occupied cells; absent: preset", ge=4, le=256)] | None = None


class NerfExperiment(PhotoExperiment, kw_only=True):
    """A fit of a NeRF to photographs: a file with a table ``[photos]``, and ``kind = "nerf"`` in its table ``[field]``."""

    field: Annotated[NerfSettings, setting("1", "the network and its fit")]


class OctreeSettings(Section):
    """The octree and the fit: a grid first, or a field of a file."""

    kind: Annotated[Literal["octree"], setting("1", "a grid, its octree, and a fit of the leaves")]
    start: Annotated[
        str,
        setting(
            "path",
            "field (.npz) to begin at: grid, octree, hash grid or NeRF; hash or nerf: fit one first; empty: fit a grid first",
        ),
    ] = ""
    preset: (
        Annotated[
            str,
            setting(
                "1",
                "preset of the first grid (tiny, cpu, fine, gpu) or network; absent: cpu, minute (hash) or minutes (nerf)",
                min_length=1,
            ),
        ]
        | None
    ) = None
    effort: Annotated[float, setting("1", "factor on the steps of the octree and of the first grid or network", gt=0)] = 1.0
    longest: (
        Annotated[int, setting("voxel", "voxels of the grid along its longest edge; absent: preset", ge=8, le=2048)] | None
    ) = None
    degree: Annotated[int, setting("1", "degree of the spherical harmonics; absent: preset", ge=0, le=4)] | None = None
    depth: (
        Annotated[int, setting("1", "levels of the octree below its root; absent: leaves of half a voxel", ge=1, le=12)] | None
    ) = None
    keep_weight: Annotated[
        float, setting("1", "a leaf with a smaller weight in every pixel of all views is dropped", ge=0, lt=1)
    ] = 0.015
    tolerance: Annotated[float, setting("1", "eight leaves become one if no pixel changes by more than this", ge=0, lt=1)] = (
        0.15
    )
    steps: Annotated[int, setting("step", "steps of the fit of the leaves, before effort", ge=1)] = 400


class OctreeExperiment(PhotoExperiment, kw_only=True):
    """A fit of an octree to photographs: a file with a table ``[photos]``, and ``kind = "octree"`` in its table ``[field]``."""

    field: Annotated[OctreeSettings, setting("1", "the octree and its fit")]
    output: Output = "runs/octree"


class GaussianSettings(Section):
    """The Gaussians and their fit."""

    preset: Annotated[str, setting("1", "steps, sizes, rates: tiny, minute, minutes, fine, finest or gpu", min_length=1)] = (
        "minute"
    )
    effort: Annotated[float, setting("1", "factor on the preset's steps", gt=0)] = 1.0
    minutes: (
        Annotated[float, setting("min", "time on two idle cores that sets the number of steps; no clock is read", gt=0)] | None
    ) = None
    start: Annotated[int, setting("1", "number of first Gaussians if no points are known; absent: preset", ge=4)] | None = None
    most: Annotated[int, setting("1", "largest number of Gaussians; absent: preset", ge=4)] | None = None
    degree: Annotated[int, setting("1", "degree of the spherical harmonics; absent: preset", ge=0, le=3)] | None = None
    control: Annotated[str | None, setting("1", "density control: clone_split or relocation; absent: preset")] = None
    ssim: Annotated[float, setting("1", "weight of SSIM in the loss; absent: preset", ge=0, le=1)] | None = None
    mip: Annotated[bool, setting("1", "anti-aliasing filter, for images of other sizes than the photographs")] = False
    exposure: (
        Annotated[bool, setting("1", "fit gains of each photograph without alpha; absent: if exposures differ")] | None
    ) = None
    poses: Annotated[bool, setting("1", "cameras move with the fit, for poses that are off by a pixel or more")] = False
    views: Annotated[int, setting("1", "photographs in a step; more photographs mean fewer steps", ge=1)] = 1

    def __post_init__(self) -> None:
        if self.minutes is not None and self.effort != 1:
            raise ValueError(f"minutes is {self.minutes} beside effort {self.effort}: only one of the two is expected")


class GaussianExperiment(PhotoExperiment, kw_only=True):
    """A fit of Gaussians to photographs: a file with tables ``[photos]`` and ``[gaussians]``."""

    gaussians: Annotated[GaussianSettings, setting("1", "the Gaussians and their fit")]
    output: Output = "runs/gaussians"
