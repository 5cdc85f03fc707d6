"""Reference images by Mitsuba's own integrators, with their variance.

Conventions. A reference is the mean of independent batches with the variance of this mean, both float64
(:mod:`mivol.validate.reference_file` stores them). A batch is a render of ``pass_spp`` samples per pixel with its own seed.
mivol's own integrator never makes a reference. If the extinction differs between channels, each channel is rendered alone:
Mitsuba's ``heterogeneous`` tracks all channels with the same collision and is biased (0.077 for 0.135 at sigma_t = (2, 6, 9)).

Photographs. A folder of references, one a view, with a ``transforms.json`` readable by :func:`mivol.photos.load_photos`. A
reference has no alpha: the background belongs to the scene.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import check_variant
from mivol.errors import MivolError, MivolWarning
from mivol.files.atomic import lock_folder
from mivol.optim.interrupt import InterruptGuard
from mivol.photos.transforms import write_transforms
from mivol.scene.load import LoadedScene, SceneSource, content_hash, load_scene
from mivol.scene.sensors import check_film, find_sensor, to_camera
from mivol.validate.reference_file import (
    ReferenceResult,
    check_identity,
    checkpoint_path,
    drop_damaged,
    find_pass_spp,
    read_checkpoint,
    read_reference,
    reference_path,
    relative_error,
    write_checkpoint,
    write_reference,
)
from mivol.validate.statistics import Moments
from mivol.validate.trust import Doubt, RgbExtinction, find_doubts, find_rgb_extinctions, use_channel

# Mitsuba's forward integrators for media.
INTEGRATORS = ("volpath", "volpathmis")

# With 32 batches a standard error is known to 1/sqrt(2 * 31) = 13 %; fewer batches estimate the variance too poorly.
MIN_BATCHES = 32

# Paths per render, by backend: about a second on two cores, so that Ctrl-C acts soon, and enough to fill a GPU.
PATHS_PER_PASS = {"llvm": 2**18, "cuda": 2**22}

# Memory per pixel besides a batch [byte]: mean and squares of three channels in float64, and temporary copies.
BATCH_BYTES = (2 + 3) * 3 * 8

SECONDS_BETWEEN_CHECKPOINTS = 20.0


def render_reference(
    scene: SceneSource | mi.Scene | LoadedScene,
    out: str | Path,
    *,
    max_depth: int,
    target_se: float | None = None,
    relative: bool = False,
    max_spp: int = 1 << 16,
    integrator: str = "volpath",
    rr_depth: int = 5,
    hide_emitters: bool = False,
    sensor: int | Mapping[str, object] | mi.Sensor = 0,
    seed: int = 0,
    pass_spp: int | None = None,
    overrides: Mapping[str, object] | None = None,
    accept_doubts: bool = False,
    progress: bool = True,
) -> ReferenceResult:
    """Render, continue or reuse the reference image of a scene.

    Batches are added until the root mean square standard error is at most ``target_se`` or each pixel has ``max_spp`` samples.
    A sufficient reference in ``out`` is returned at once. An insufficient reference is continued, with the same result as an
    uninterrupted run: the seeds of batches do not depend on the time of rendering. Ctrl-C keeps all finished batches and is
    passed on.

    Args:
        scene: path of an XML, dict, scene, or result of ``load_scene``.
        out: an ``.exr`` file, or a folder. In a folder the file is named after the scene and the identity of the reference,
            and a damaged file is replaced; a damaged file named by ``out`` is never touched.
        max_depth: longest path; -1 is unlimited. Always required, since Mitsuba's integrators have different defaults.
        target_se: standard error to reach [radiance]; None: render ``max_spp``.
        relative: whether ``target_se`` is a fraction of the mean radiance of the image.
        max_spp: most samples per pixel and channel.
        integrator: a name in ``INTEGRATORS``.
        rr_depth: depth at which Russian roulette begins.
        hide_emitters: whether directly visible emitters are left out.
        sensor: number of a sensor of the scene, a dict, or a sensor.
        seed: another seed gives an independent reference.
        pass_spp: samples of a batch; by default chosen for short passes.
        overrides: ``-D`` parameters of an XML scene.
        accept_doubts: render even if Mitsuba is known to be wrong; the header stores the doubts.
        progress: show a progress bar.

    Bias: stopping at an estimated error favours images with an underestimated error; with 32 batches or more the mean shifts
        by less than the error over the square root of the batches (a rule of thumb, not a bound).
    Cost: at most ``max_spp`` paths per pixel, three times as many with separate channels.

    Raises:
        MivolError: an integrator that cannot make a reference, a scene for which Mitsuba is known to be wrong, a file of
            another scene or method, a film that is not rgb or luminance or does not fit into memory, a ``max_spp`` too
            small for 32 batches, or a sample that is not finite.
    """
    prepared = prepare_reference(
        scene, out, max_depth=max_depth, target_se=target_se, relative=relative, max_spp=max_spp, integrator=integrator,
        rr_depth=rr_depth, hide_emitters=hide_emitters, sensor=sensor, seed=seed, pass_spp=pass_spp, overrides=overrides,
        accept_doubts=accept_doubts,
    )  # fmt: skip
    with prepared.show_progress() if progress else nullcontext(lambda run: None) as show:
        return prepared.complete(show)


def prepare_reference(
    scene: SceneSource | mi.Scene | LoadedScene,
    out: str | Path,
    *,
    max_depth: int,
    target_se: float | None = None,
    relative: bool = False,
    max_spp: int = 1 << 16,
    integrator: str = "volpath",
    rr_depth: int = 5,
    hide_emitters: bool = False,
    sensor: int | Mapping[str, object] | mi.Sensor = 0,
    seed: int = 0,
    pass_spp: int | None = None,
    overrides: Mapping[str, object] | None = None,
    accept_doubts: bool = False,
) -> PreparedReference:
    """Check a reference, and read what is on disk, up to the first batch.

    Args:
        scene, out, max_depth, target_se, relative, max_spp, integrator, rr_depth, hide_emitters, sensor, seed, pass_spp,
            overrides, accept_doubts: as for :func:`render_reference`.

    Raises:
        MivolError: as :func:`render_reference`, samples that are not finite excepted.
    """
    if integrator not in INTEGRATORS:
        raise MivolError(
            f'"{integrator}" cannot make a reference: only Mitsuba\'s own {" and ".join(INTEGRATORS)} judge, never the '
            "integrator under test."
        )
    loaded = scene if isinstance(scene, LoadedScene) else load_scene(scene, overrides)
    method = {"integrator": integrator, "max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}
    setup = RenderSetup.from_scene(loaded, sensor, method, seed)
    check_film(setup.sensor, BATCH_BYTES)
    path = reference_path(Path(out), loaded.name, setup.identity)
    doubts = _check_trust(loaded.scene, setup.sensor, accept_doubts)
    goal = _Goal(target_se, relative, max_spp)

    if path != Path(out):
        drop_damaged(path)
    finished = _read_finished(path, setup.identity, goal)
    if finished is not None:
        return PreparedReference(setup, goal, path, doubts, sensor, method, finished)
    setup = setup.with_passes(pass_spp or find_pass_spp(path), max_spp)
    prepared = PreparedReference(setup, goal, path, doubts, sensor, method)
    prepared.run = _load_state(path, setup)
    return prepared


# -- What is rendered -----------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderSetup:
    """The inputs of a batch, and the identity that makes batches comparable."""

    scene: mi.Scene
    sensor: mi.Sensor
    integrator: mi.Integrator
    identity: dict[str, Any]
    extinction: list[RgbExtinction]
    shape: tuple[int, int, int]
    pass_spp: int = 0

    @staticmethod
    def from_scene(
        loaded: LoadedScene, sensor: int | Mapping[str, object] | mi.Sensor, method: dict[str, Any], seed: int
    ) -> RenderSetup:
        """Make the setup without the samples of a pass."""
        look = _find_given_sensor(loaded.scene, sensor)
        columns, rows = (int(n) for n in look.film().crop_size())
        channels = _channels(look.film())
        extinction = find_rgb_extinctions(loaded.scene) if channels == 3 else []
        settings = {key: value for key, value in method.items() if key != "integrator"}
        made = mi.load_dict({"type": method["integrator"], **settings})
        identity = {
            "scene": loaded.content_hash,
            "sensor": sensor if isinstance(sensor, int) else content_hash(sensor),
            **method,
            "seed": seed,
            "channels_alone": bool(extinction),
            "variant": check_variant(),
            "mitsuba": mi.__version__,
            "drjit": dr.__version__,
        }
        return RenderSetup(loaded.scene, look, made, identity, extinction, (rows, columns, channels))

    def with_passes(self, wanted: int | None, max_spp: int) -> RenderSetup:
        """Set the samples of a pass: ``wanted``, or a suitable number.

        Raises:
            MivolError: a ``max_spp`` too small for enough batches.
        """
        spp = _effective_spp(self.sensor, wanted or _choose_pass_spp(self.sensor, self.shape[0] * self.shape[1], max_spp))
        if spp * MIN_BATCHES > max_spp:
            raise MivolError(
                f"{max_spp} samples are too few for {MIN_BATCHES} batches of {spp}; allow {spp * MIN_BATCHES} or more."
            )
        return replace(self, pass_spp=spp, identity={**self.identity, "pass_spp": spp})

    def batch(self, index: int) -> np.ndarray:
        """Render batch ``index``: (H, W, C) mean of its samples.

        Raises:
            MivolError: a value of Mitsuba that is not finite.
        """
        if not self.extinction:
            image = self._render(index)
        else:
            image = np.empty(self.shape)
            for channel in range(3):
                with use_channel(self.extinction, channel):
                    image[..., channel] = self._render(3 * index + channel)[..., channel]
        if not np.isfinite(image).all():
            row, column, channel = (int(i) for i in np.argwhere(~np.isfinite(image))[0])
            raise MivolError(
                f"Mitsuba's {self.identity['integrator']} gave {image[row, column, channel]} in row {row}, column {column}, "
                f"channel {channel} of batch {index}; look for degenerate geometry or voxels there."
            )
        return image

    def _render(self, number: int) -> np.ndarray:
        # Seeds are consecutive from a hashed start: distinct within a reference, and far from the 0, 1, 2 of other renders.
        seed = (_base_seed(self.identity["seed"]) + number) % 2**32
        image = mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=self.pass_spp, seed=seed)
        return np.array(image, dtype=np.float64)[..., : self.shape[2]]


def _find_given_sensor(scene: mi.Scene, sensor: int | Mapping[str, object] | mi.Sensor) -> mi.Sensor:
    if isinstance(sensor, Mapping):
        return mi.load_dict(dict(sensor))
    return find_sensor(scene, sensor)


def _channels(film: mi.Film) -> int:
    """Colour channels of a film: 3, or 1 in mono variants."""
    printed = str(film)
    wanted, name = (("y", "ya"), "luminance") if "mono" in mi.variant() else (("rgb", "rgba"), "rgb")
    found = next((line.split("=")[1].strip(" ,") for line in printed.splitlines() if "pixel_format" in line), "")
    if found not in wanted:
        format_ = found or film.class_name()
        raise MivolError(
            f'the film has the pixel format "{format_}", expected {" or ".join(wanted)} for a reference: set pixel_format to'
            f' "{name}".'
        )
    return 3 if found.startswith("rgb") else 1


def _effective_spp(sensor: mi.Sensor, spp: int) -> int:
    """Samples actually made by the sensor's sampler: a stratified sampler rounds up."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    return int(sampler.sample_count())


def _choose_pass_spp(sensor: mi.Sensor, pixels: int, max_spp: int) -> int:
    """The most samples of a pass; for a sampler that rounds numbers up, a square number that it keeps."""
    paths = PATHS_PER_PASS["cuda" if mi.variant().startswith("cuda") else "llvm"]
    most = max(1, min(paths // pixels, max_spp // MIN_BATCHES))
    squares = (k * k for k in range(math.isqrt(most), 0, -1))
    return next((spp for spp in (most, *squares) if _effective_spp(sensor, spp) == spp), 1)


def _base_seed(seed: int) -> int:
    return int(np.random.SeedSequence([0x6D69766F, seed]).generate_state(1)[0])


# -- Batches until it is good enough ---------------------------------------------------------------


@dataclass(frozen=True)
class _Goal:
    target_se: float | None
    relative: bool
    max_spp: int

    def reached(self, batches: int, spp: int, mean: np.ndarray, variance: np.ndarray) -> bool:
        return batches >= MIN_BATCHES and (spp >= self.max_spp or self.accurate(mean, variance))

    def accurate(self, mean: np.ndarray, variance: np.ndarray) -> bool:
        return self.target_se is not None and self.error(mean, variance) <= self.target_se

    def error(self, mean: np.ndarray, variance: np.ndarray) -> float:
        error = float(np.sqrt(variance.mean()))
        return relative_error(error, mean) if self.relative else error

    def count_batches(self, run: _BatchRun) -> int:
        """The error falls as 1/sqrt(n), which predicts the total number of batches."""
        m, most = run.moments, self.max_spp / run.pass_spp
        needed = most if not self.target_se else MIN_BATCHES
        if self.target_se and m.n > 1:
            needed = m.n * (self.error(m.mean, m.variance_of_mean) / self.target_se) ** 2
        return int(np.ceil(max(MIN_BATCHES, min(most, needed))))


@dataclass
class _BatchRun:
    """The batches of a run; ``moments`` is replaced as a whole, so an interrupt finds valid moments."""

    moments: Moments
    pass_spp: int
    seconds: float
    saved: float = field(default_factory=time.monotonic)

    def reached(self, goal: _Goal) -> bool:
        m = self.moments
        return m.n > 1 and goal.reached(m.n, m.n * self.pass_spp, m.mean, m.variance_of_mean)


@dataclass
class PreparedReference:
    """A reference before the first batch, between two batches, or as found on disk.

    Attributes:
        setup: inputs of its batches.
        goal: when to stop.
        path: the file.
        doubts: reasons not to trust the reference.
        sensor: the sensor as given.
        method: integrator and its settings.
        finished: a sufficient reference from disk; None if batches are missing.
        run: the batches so far; empty if ``finished``.
    """

    setup: RenderSetup
    goal: _Goal
    path: Path
    doubts: tuple[Doubt, ...]
    sensor: int | Mapping[str, object] | mi.Sensor
    method: dict[str, Any]
    finished: ReferenceResult | None = None
    run: _BatchRun = field(default_factory=lambda: _BatchRun(Moments.empty(), 0, 0.0))
    _is_changed: bool = False

    @property
    def is_reached(self) -> bool:
        """Whether no more batches are needed."""
        return self.finished is not None or self.run.reached(self.goal)

    def count_batches(self) -> int:
        """Number of batches that will be needed, by the present estimate of the error."""
        return self.goal.count_batches(self.run)

    def add(self, batch: np.ndarray, seconds: float) -> None:
        """Add the next batch, and write a checkpoint from time to time.

        Args:
            batch: (H, W, C) of batch number ``run.moments.n``.
            seconds: time of its render [s].
        """
        self.run.moments, self._is_changed = self.run.moments.add(batch), True
        self.run.seconds += seconds
        if time.monotonic() - self.run.saved > SECONDS_BETWEEN_CHECKPOINTS:
            self.save()

    def save(self) -> None:
        """Write the batches, if any are new."""
        if self._is_changed:
            write_checkpoint(self.path, self.setup.identity, self.run.moments, self.run.seconds)
            self.run.saved, self._is_changed = time.monotonic(), False

    def finish(self) -> ReferenceResult:
        """Write the image, and return it."""
        result = self.finished
        if result is None:
            self.save()
            m, run = self.run.moments, self.run
            spp = m.n * run.pass_spp
            result = ReferenceResult(
                m.mean, m.variance_of_mean, m.n, spp, self.setup.identity, self.path, self.doubts, run.seconds
            )
            write_reference(result)
        return replace(result, reached=self.goal.target_se is None or self.goal.accurate(result.mean, result.variance))

    def complete(self, show: Callable[[_BatchRun], None] = lambda run: None) -> ReferenceResult:
        """Render the missing batches in this process; an interrupt keeps the finished ones.

        Args:
            show: called after each batch.
        """
        try:
            with InterruptGuard() as stop:
                while not self.is_reached:
                    stop.check()
                    start = time.monotonic()
                    batch = self.setup.batch(self.run.moments.n)
                    self.add(batch, time.monotonic() - start)
                    show(self.run)
        finally:
            self.save()
        return self.finish()

    def show_progress(self) -> AbstractContextManager[Callable[[_BatchRun], None]]:
        """A progress bar of the batches; none for a finished reference."""
        return nullcontext(lambda run: None) if self.finished is not None else _progress(self.path.stem, self.goal)


@contextmanager
def _progress(name: str, goal: _Goal) -> Iterator[Callable[[_BatchRun], None]]:
    """A progress bar on the error output; a final line in notebooks and without a terminal.

    Bars of rich in a notebook need ipywidgets, and rich complains without them.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = "{task.description}", BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[error]}"), TimeRemainingColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"reference {name}", total=MIN_BATCHES, error="")

        def show(run: _BatchRun) -> None:
            if run.moments.n < 2:
                return
            reached = goal.error(run.moments.mean, run.moments.variance_of_mean)
            bar.update(task, completed=run.moments.n, total=goal.count_batches(run), error=f"error {reached:.2g}")

        yield show
        if not console.is_terminal:
            says = bar.tasks[task]
            console.print(f"{says.description}: {says.completed} batches, {says.fields['error']}", soft_wrap=True, markup=False)


# -- What is on disk already ------------------------------------------------------------------------


def _read_finished(path: Path, identity: dict[str, Any], goal: _Goal) -> ReferenceResult | None:
    """Read a sufficient reference from disk; None without such a reference."""
    if not path.exists():
        return None
    found = read_reference(path)
    check_identity(path, found.identity, identity)
    return found if goal.reached(found.batches, found.spp, found.mean, found.variance) else None


def _load_state(path: Path, setup: RenderSetup) -> _BatchRun:
    state = checkpoint_path(path)
    if not state.exists():
        return _BatchRun(Moments.empty(setup.shape), setup.pass_spp, 0.0)
    made, moments = read_checkpoint(state)
    check_identity(state, made["identity"], setup.identity)
    return _BatchRun(moments, setup.pass_spp, made["seconds"])


# -- Doubts ---------------------------------------------------------------------------------------


def _check_trust(scene: mi.Scene, sensor: mi.Sensor, accept: bool) -> tuple[Doubt, ...]:
    doubts: Sequence[Doubt] = find_doubts(scene, [sensor])
    fatal = [d for d in doubts if d.fatal]
    if fatal and not accept:
        raise MivolError(f"Mitsuba {mi.__version__} cannot be the reference for this scene: {fatal[0].sentence}")
    for doubt in doubts:
        warnings.warn(doubt.sentence, MivolWarning, stacklevel=4)
    return tuple(doubts)


def complete_in_turn(prepared: Iterator[PreparedReference]) -> Iterator[ReferenceResult]:
    """Render the missing batches of one reference after another in this process, with a progress bar each."""
    for reference in prepared:
        with reference.show_progress() as show:
            yield reference.complete(show)


def complete_quietly(prepared: Iterator[PreparedReference]) -> Iterator[ReferenceResult]:
    """Render the missing batches of one reference after another in this process, without a display."""
    for reference in prepared:
        yield reference.complete()


# -- Photographs -----------------------------------------------------------------------------------------------------------


Complete = Callable[[Iterator[PreparedReference]], Iterator[ReferenceResult]]
"""Renders the missing batches of prepared references, and yields the results in the same order."""


def render_photographs(
    scene: SceneSource | mi.Scene | LoadedScene,
    folder: str | Path,
    *,
    sensors: Sequence[int | dict | mi.Sensor] | None = None,
    test: Sequence[int] = (),
    complete: Complete | None = None,
    **reference: Any,
) -> list[ReferenceResult]:
    """Render each view of a scene as a reference, and write the cameras.

    Existing views in the folder are continued or reused, as :func:`render_reference` does.

    Args:
        scene: as for :func:`render_reference`.
        folder: created if missing; views are named ``view_000.exr`` and so on.
        sensors: numbers, dicts or sensors, all perspective; None: all sensors of the scene.
        test: numbers of the views of the test split.
        complete: renders the missing batches of prepared views, in their order; None: one view after another in this process.
        reference: settings of :func:`render_reference`, ``max_depth`` among them.

    Raises:
        MivolError: a scene without sensors, a sensor that is not perspective, another process that renders into the folder, or
            as :func:`render_reference`.
    """
    loaded = scene if isinstance(scene, LoadedScene) else load_scene(scene, reference.pop("overrides", None))
    looks = list(range(len(loaded.scene.sensors()))) if sensors is None else list(sensors)
    if not looks:
        raise MivolError("the scene has no sensor to photograph it with; add one, or give sensors.")
    names = [f"view_{number:03d}.exr" for number in range(len(looks))]
    cameras = {name: to_camera(_find_given_sensor(loaded.scene, look), name) for name, look in zip(names, looks, strict=True)}
    folder = Path(folder)
    if folder.suffix == ".exr":
        raise MivolError(f"{folder} names one image for {len(looks)} views; name a folder.")
    folder.mkdir(parents=True, exist_ok=True)
    is_shown, views = reference.pop("progress", True), zip(names, looks, strict=True)
    prepared = (prepare_reference(loaded, folder / name, sensor=look, **reference) for name, look in views)
    if complete is None:
        complete = complete_in_turn if is_shown else complete_quietly
    with lock_folder(folder):
        made = list(complete(prepared))
    write_transforms(folder / "transforms.json", cameras, [names[number] for number in test])
    return made
