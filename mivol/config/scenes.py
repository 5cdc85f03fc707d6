"""Settings of a fit of scene parameters to images."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from mivol.optim.events import EVENTS, Checkpoint, Evaluate
from mivol.optim.first_order import OPTIMIZERS, Adam
from mivol.optim.losses import L2, LOSSES
from mivol.optim.optimizer import SCHEDULES, Constant
from mivol.optim.parameters import MAPS
from mivol.optim.priors import PRIORS
from mivol.optim.strategy import setting, union_type
from mivol.scene.sensors import Hemisphere, LookAts, Ring, SceneSensors
from mivol.schema import (
    AUTO,
    Depth,
    HeldOut,
    Output,
    Section,
    Seed,
    Size,
    Threads,
    Title,
    Variant,
    check_word,
)


class Scene(Section):
    """The rendered scene."""

    file: Annotated[str, setting("path", "Mitsuba XML", min_length=1)]
    define: Annotated[dict[str, str | int | float | bool], setting("1", "values of the XML's $parameters")] = {}


class Truth(Section):
    """The true volume, if it is known: the references are rendered from it."""

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    file: Annotated[str, setting("path", "volume file; empty: procedural")] = ""
    procedural: Annotated[str, setting("1", "name of a procedural volume: tangle; empty: truth.file")] = ""
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

    may_be_infinite: ClassVar[tuple[str, ...]] = ("domain",)

    key: Annotated[str, setting("1", "key of mi.traverse(scene)", min_length=1)]
    unit: Annotated[str, setting("1", "unit of the value; empty: the usual unit of the key")] = ""
    domain: Annotated[
        tuple[float, float] | None, setting("unit", "smallest and largest value; absent: the usual ones of the key")
    ] = None
    map: Annotated[str, setting("1", "map from the optimizer's numbers: identity, softplus, log or logistic")] = "identity"
    lr: Annotated[float, setting("unit", "learning rate: typical change per step", gt=0)] = 0.1
    start: Annotated[
        float | tuple[float, ...] | None, setting("unit", "first value: one number, or one per channel; absent: the scene's")
    ] = None
    start_file: Annotated[str, setting("path", "volume with the first value; empty: parameter.start")] = ""
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
    spp_shown: Annotated[
        int, setting("sample/pixel", "samples of report images, 16 or more for z-images; 0: fit.spp", ge=0)
    ] = 0
    samples_per_pass: Annotated[int, setting("sample", "most samples in one kernel; Ctrl-C waits for it", ge=1)] = 1 << 20
    max_depth: Annotated[
        Depth | str | None, setting("1", "longest path, as in volpath; -1: unlimited; auto: measured; absent: the scene's")
    ] = None
    noise: Annotated[float, setting("1", "accepted noise over mean radiance; max_depth = auto leaves out less light", gt=0)] = (
        0.02
    )
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
