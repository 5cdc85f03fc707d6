"""Reference images by Mitsuba's own integrators: the mean, and how well it is known.

Conventions. A reference is the mean of independent batches, each one render of ``pass_spp`` samples a pixel with a seed of
its own, and the variance of that mean, both float64 in memory and float32 on disk: channels R, G, B and variance.R, .G, .B
(Y and variance.Y in mono variants) of one OpenEXR file. Its header says what it is an image of (the scene's content hash)
and how it was made; beside it ``<name>.state.npz`` holds the batches so far in float64, so that stopping changes nothing
and a better reference can be asked for later. An integrator of mivol's never makes a reference.

Where the extinction differs between channels, each channel is rendered alone with its extinction in all three: Mitsuba's
``heterogeneous`` tracks all channels with one collision and is biased then (0.077 for 0.135 at sigma_t = (2, 6, 9)).
"""

from __future__ import annotations

import hashlib
import json
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mivol
from mivol.errors import MivolError
from mivol.files.atomic import write_whole
from mivol.files.exr import read_exr, write_exr
from mivol.optim.interrupt import Stop
from mivol.scene.load import LoadedScene, SceneSource, check_variant, content_hash, find_sensor, load_scene
from mivol.transport.media.read_medium import traverse_medium
from mivol.validate.statistics import Moments
from mivol.validate.trust import Doubt, trust

__all__ = ["INTEGRATORS", "Doubt", "ReferenceResult", "read_reference", "render_reference", "trust"]

# Who may judge: Mitsuba's forward integrators for media.
INTEGRATORS = ("volpath", "volpathmis")

# Fewer batches say too little of their variance: with 32 a standard error is known to 1/sqrt(2 * 31) = 13 %.
FEWEST_BATCHES = 32

# Paths in one render, by backend: below a second or so on two cores, so that Ctrl-C acts soon, and enough to fill a GPU.
PATHS_PER_PASS = {"llvm": 2**18, "cuda": 2**22}

SECONDS_BETWEEN_CHECKPOINTS = 20.0


@dataclass(frozen=True)
class ReferenceResult:
    """A reference image.

    Attributes:
        mean: (H, W, C) radiance.
        variance: (H, W, C) of the mean.
        batches: independent batches behind both.
        spp: samples behind each pixel and channel.
        identity: what it is an image of, and how it was made; equal for references that may be averaged.
        path: its file.
        doubts: why it should not be believed, where there are reasons.
        seconds: time spent rendering, all sessions together.
        reached: whether it has the accuracy that was asked for; False where ``max_spp`` came first.
    """

    mean: np.ndarray
    variance: np.ndarray
    batches: int
    spp: int
    identity: dict[str, Any]
    path: Path
    doubts: tuple[Doubt, ...] = ()
    seconds: float = 0.0
    reached: bool = True

    @property
    def standard_error(self) -> float:
        """Root mean square over pixels and channels of the standard error of the mean [radiance]."""
        return float(np.sqrt(self.variance.mean()))

    @property
    def relative_error(self) -> float:
        """``standard_error`` divided by the mean absolute radiance of the image."""
        return _relative(self.standard_error, self.mean)

    @property
    def text(self) -> str:
        """One paragraph."""
        how = self.identity
        missed = "" if self.reached else ", above the target"
        one = "each channel alone" if how["channels_alone"] else "all channels at once"
        doubts = "".join(f" Doubt: {d.sentence}" for d in self.doubts)
        return (
            f"{self.path.name}: {self.mean.shape[1]}x{self.mean.shape[0]} by {how['integrator']} "
            f"(max_depth {how['max_depth']}, {one}), {self.spp} samples a pixel in {self.batches} batches, "
            f"standard error {self.standard_error:.3g} "
            f"({100 * self.relative_error:.2g} % of the mean{missed}), {self.seconds:.0f} s.{doubts}"
        )


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
    sensor: int | dict | mi.Sensor = 0,
    seed: int = 0,
    pass_spp: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    accept_doubts: bool = False,
    progress: bool = True,
) -> ReferenceResult:
    """Render, continue or fetch the reference image of a scene.

    Batches are added until the root mean square standard error is at most ``target_se`` or each pixel has ``max_spp``
    samples. What ``out`` holds already counts: enough of it is returned at once, less is continued, and gives what one
    uninterrupted run gives (the seeds of batches do not depend on when they are rendered). Ctrl-C keeps all finished
    batches and is passed on.

    Args:
        scene: path of an XML, dict, scene, or what ``load_scene`` gave.
        out: an ``.exr`` file, or a folder: the file is then named after the scene and what identifies the reference.
        max_depth: longest path; -1 is unlimited. Always said, since Mitsuba's integrators have different defaults.
        target_se: standard error to reach [radiance]; None: render ``max_spp``.
        relative: ``target_se`` is a fraction of the mean radiance of the image.
        max_spp: samples a pixel and channel at most.
        integrator: one of ``INTEGRATORS``.
        rr_depth: depth at which Russian roulette begins.
        hide_emitters: whether emitters seen directly are left out.
        sensor: number of one of the scene's, a dict, or a sensor.
        seed: another seed gives an independent reference.
        pass_spp: samples of one batch; by default as many as keep a pass short.
        overrides: ``-D`` parameters of an XML scene.
        accept_doubts: render even where Mitsuba is known to be wrong; the doubts are stored in the header.
        progress: show a progress bar.

    Bias: stopping at an estimated error favours images whose error is underestimated; with 32 batches or more the mean
        shifts by less than the error itself over the square root of the batches (a rule of thumb, not a bound).
    Cost: ``max_spp`` paths a pixel at most, three times that where channels are rendered alone.

    Raises:
        MivolError: an integrator that is no reference, a scene for which Mitsuba is known to be wrong, a file that is the
            reference of another scene or was made differently, a film that is not rgb or luminance, a target that cannot be
            reached by 32 batches, a sample that is not finite.
    """
    if integrator not in INTEGRATORS:
        raise MivolError(
            f'"{integrator}" cannot make a reference: only Mitsuba\'s own {" and ".join(INTEGRATORS)} judge, never the '
            "integrator under test."
        )
    loaded = scene if isinstance(scene, LoadedScene) else load_scene(scene, overrides)
    method = {"integrator": integrator, "max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide_emitters}
    setup = _Setup.of(loaded, sensor, method, seed)
    path = _destination(Path(out), loaded.name, setup.identity)
    doubts = _judge(loaded.scene, setup.sensor, accept_doubts)
    goal = _Goal(target_se, relative, max_spp)

    result = _finished(path, setup.identity, goal)
    if result is None:
        setup = setup.with_passes(pass_spp or _stored_pass_spp(path), max_spp)
        progress_bar = _progress(path.stem, goal) if progress else nullcontext(lambda run: None)
        with progress_bar as show:
            result = _render_until(goal, setup, _load_state(path, setup), path, doubts, show)
    return replace(result, reached=target_se is None or goal.accurate(result.mean, result.variance))


def read_reference(path: str | Path, content_hash: str | None = None) -> ReferenceResult:
    """Read a reference from its file.

    Args:
        path: the EXR.
        content_hash: of the scene that it must be a reference of; None: any.

    Raises:
        MivolError: not a reference of mivol's, or that of another scene.
    """
    channels, header = read_exr(path)
    if "mivol_reference" not in header:
        raise MivolError(f"{path} is an image but not a reference of mivol's; make one with mivol reference.")
    made = json.loads(header["mivol_reference"])
    names = [name for name in ("R", "G", "B", "Y") if name in channels]
    if content_hash is not None and made["identity"]["scene"] != content_hash:
        raise MivolError(_other(Path(path), "scene", made["identity"]["scene"], content_hash))
    return ReferenceResult(
        mean=np.stack([channels[n] for n in names], axis=-1).astype(np.float64),
        variance=np.stack([channels[f"variance.{n}"] for n in names], axis=-1).astype(np.float64),
        batches=made["batches"],
        spp=made["spp"],
        identity=made["identity"],
        path=Path(path),
        doubts=tuple(Doubt(**d) for d in made["doubts"]),
        seconds=made["seconds"],
    )


# -- What is rendered -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Setup:
    """Everything that one batch needs, and the identity that makes batches comparable."""

    scene: mi.Scene
    sensor: mi.Sensor
    integrator: mi.Integrator
    identity: dict[str, Any]
    extinction: list[_Extinction]
    shape: tuple[int, int, int]
    pass_spp: int = 0

    @staticmethod
    def of(loaded: LoadedScene, sensor: int | dict | mi.Sensor, method: dict[str, Any], seed: int) -> _Setup:
        """The setup, but for the samples of a pass."""
        look = _sensor(loaded.scene, sensor)
        columns, rows = (int(n) for n in look.film().crop_size())
        channels = _channels(look.film())
        extinction = _rgb_extinction(loaded.scene) if channels == 3 else []
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
        return _Setup(loaded.scene, look, made, identity, extinction, (rows, columns, channels))

    def with_passes(self, wanted: int | None, max_spp: int) -> _Setup:
        """With ``wanted`` samples a pass, or as many as suit.

        Raises:
            MivolError: ``max_spp`` does not suffice for enough batches of so many.
        """
        spp = _real_spp(self.sensor, wanted or _pass_spp(self.shape[0] * self.shape[1], max_spp))
        if spp * FEWEST_BATCHES > max_spp:
            raise MivolError(
                f"{max_spp} samples are too few for {FEWEST_BATCHES} batches of {spp}; allow {spp * FEWEST_BATCHES} or more."
            )
        return replace(self, pass_spp=spp, identity={**self.identity, "pass_spp": spp})

    def batch(self, index: int) -> np.ndarray:
        """(H, W, C) mean of the samples of batch ``index``.

        Raises:
            MivolError: Mitsuba gave a value that is not finite.
        """
        if not self.extinction:
            image = self._render(index)
        else:
            image = np.empty(self.shape)
            for channel in range(3):
                with _grey_extinction(self.extinction, channel):
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


def _sensor(scene: mi.Scene, sensor: int | dict | mi.Sensor) -> mi.Sensor:
    if isinstance(sensor, Mapping):
        return mi.load_dict(dict(sensor))
    return find_sensor(scene, sensor)


def _channels(film: mi.Film) -> int:
    """Colour channels of a film: 3, or 1 in mono variants."""
    printed = str(film)
    wanted = ("y", "ya") if "mono" in mi.variant() else ("rgb", "rgba")
    found = next((line.split("=")[1].strip(" ,") for line in printed.splitlines() if "pixel_format" in line), "")
    if found not in wanted:
        format_ = found or film.class_name()
        raise MivolError(f'the film has the pixel format "{format_}"; a reference needs {" or ".join(wanted)}.')
    return 3 if found.startswith("rgb") else 1


def _real_spp(sensor: mi.Sensor, spp: int) -> int:
    """Samples that the sensor's sampler makes of so many: a stratified one rounds up."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    return int(sampler.sample_count())


def _pass_spp(pixels: int, max_spp: int) -> int:
    paths = PATHS_PER_PASS["cuda" if mi.variant().startswith("cuda") else "llvm"]
    return max(1, min(paths // pixels, max_spp // FEWEST_BATCHES))


def _base_seed(seed: int) -> int:
    return int(np.random.SeedSequence([0x6D69766F, seed]).generate_state(1)[0])


# -- Extinction, one channel at a time ------------------------------------------------------------


@dataclass(frozen=True)
class _Extinction:
    """The parameters of one medium that make its extinction differ between channels, with their values."""

    params: mi.SceneParameters
    values: dict[str, np.ndarray]

    def assign(self, values: dict[str, np.ndarray]) -> None:
        for key, value in values.items():
            kind = type(self.params[key])
            self.params[key] = kind(*value.tolist()) if kind is mi.Color3f else kind(np.ascontiguousarray(value))
        self.params.update()


def _rgb_extinction(scene: mi.Scene) -> list[_Extinction]:
    """Media whose extinction differs between channels."""
    media = [m for s in scene.shapes() for m in (s.interior_medium(), s.exterior_medium()) if m is not None]
    media += [m for s in scene.sensors() if (m := s.get_medium()) is not None]
    found = []
    for i, medium in enumerate(media):
        if any(medium is other for other in media[:i]):
            continue
        params = traverse_medium(medium)
        keys = [k for k in params.keys() if k.partition(".")[0] in ("sigma_t", "sigma_a", "sigma_s")]  # noqa: SIM118
        values = {key: _array(params[key]) for key in keys}
        values = {k: v for k, v in values.items() if v.ndim and v.shape[-1] == 3 and np.any(v != v[..., :1])}
        if values:
            found.append(_Extinction(params, values))
    return found


def _array(value: Any) -> np.ndarray:
    """A copy of the values, channels last."""
    array = np.array(value)
    return array.reshape(-1) if isinstance(value, mi.Color3f) else array


@contextmanager
def _grey_extinction(media: list[_Extinction], channel: int) -> Iterator[None]:
    """Give all channels the extinction of one, for a while."""
    try:
        for medium in media:
            medium.assign({k: np.repeat(v[..., channel : channel + 1], 3, axis=-1) for k, v in medium.values.items()})
        yield
    finally:
        for medium in media:
            medium.assign(medium.values)


# -- Batches until it is good enough ---------------------------------------------------------------


@dataclass(frozen=True)
class _Goal:
    target_se: float | None
    relative: bool
    max_spp: int

    def reached(self, batches: int, spp: int, mean: np.ndarray, variance: np.ndarray) -> bool:
        return batches >= FEWEST_BATCHES and (spp >= self.max_spp or self.accurate(mean, variance))

    def accurate(self, mean: np.ndarray, variance: np.ndarray) -> bool:
        error = float(np.sqrt(variance.mean()))
        return self.target_se is not None and (_relative(error, mean) if self.relative else error) <= self.target_se


@dataclass
class _Run:
    """Batches so far; ``moments`` is replaced whole, so that an interrupt finds it valid."""

    moments: Moments
    pass_spp: int
    seconds: float
    saved: float = field(default_factory=time.monotonic)

    def reached(self, goal: _Goal) -> bool:
        m = self.moments
        return m.n > 1 and goal.reached(m.n, m.n * self.pass_spp, m.mean, m.variance_of_mean)


def _relative(error: float, mean: np.ndarray) -> float:
    level = float(np.abs(mean).mean())
    return error / level if level > 0 else (0.0 if error == 0 else float("inf"))


def _render_until(
    goal: _Goal, setup: _Setup, run: _Run, path: Path, doubts: tuple[Doubt, ...], show: Callable[[_Run], None]
) -> ReferenceResult:
    rendered = False
    try:
        with Stop() as stop:
            while not run.reached(goal):
                stop.check()
                start = time.monotonic()
                batch = setup.batch(run.moments.n)
                run.moments, rendered = run.moments.add(batch), True
                run.seconds += time.monotonic() - start
                show(run)
                if time.monotonic() - run.saved > SECONDS_BETWEEN_CHECKPOINTS:
                    _save_state(path, setup, run)
    finally:
        if rendered:
            _save_state(path, setup, run)
    result = _result(setup, run, path, doubts)
    _write(result)
    return result


def _result(setup: _Setup, run: _Run, path: Path, doubts: tuple[Doubt, ...]) -> ReferenceResult:
    m = run.moments
    return ReferenceResult(
        m.mean, m.variance_of_mean, m.n, m.n * run.pass_spp, setup.identity, path, doubts, run.seconds
    )


@contextmanager
def _progress(name: str, goal: _Goal) -> Iterator[Callable[[_Run], None]]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    error_column = TextColumn("{task.fields[error]}")
    with Progress("{task.description}", BarColumn(), MofNCompleteColumn(), error_column, TimeRemainingColumn()) as bar:
        task = bar.add_task(f"reference {name}", total=FEWEST_BATCHES, error="")

        def show(run: _Run) -> None:
            if run.moments.n < 2:
                return
            error = float(np.sqrt(run.moments.variance_of_mean.mean()))
            reached = _relative(error, run.moments.mean) if goal.relative else error
            # The error falls as 1/sqrt(n): batches still to come follow from the error now.
            most = goal.max_spp / run.pass_spp
            needed = run.moments.n * (reached / goal.target_se) ** 2 if goal.target_se else most
            total = int(np.ceil(max(FEWEST_BATCHES, min(most, needed))))
            bar.update(task, completed=run.moments.n, total=total, error=f"error {reached:.2g}")

        yield show


# -- On disk --------------------------------------------------------------------------------------


def _destination(out: Path, name: str, identity: dict[str, Any]) -> Path:
    if out.suffix.lower() == ".exr":
        return out
    if out.suffix or (out.exists() and not out.is_dir()):
        raise MivolError(f"a reference is an OpenEXR file, not {out.name}; give a name that ends in .exr, or a folder.")
    out.mkdir(parents=True, exist_ok=True)
    how = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return out / f"{name}-{identity['scene'][:12]}-{how[:8]}.exr"


def _state_path(path: Path) -> Path:
    return path.with_suffix(".state.npz")


def _finished(path: Path, identity: dict[str, Any], goal: _Goal) -> ReferenceResult | None:
    """What is on disk, if it is good enough."""
    if not path.exists():
        return None
    found = read_reference(path)
    _check_identity(path, found.identity, identity)
    return found if goal.reached(found.batches, found.spp, found.mean, found.variance) else None


def _check_identity(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    for key, value in wanted.items():
        if found.get(key) != value:
            raise MivolError(_other(path, key, found.get(key), value))


def _other(path: Path, key: str, found: Any, wanted: Any) -> str:
    if key == "scene":
        return (
            f"{path} is the reference of another scene (content {str(found)[:12]}, not {str(wanted)[:12]}); choose another "
            "file, or delete it."
        )
    return f"{path} was made with {key} = {found}, not {wanted}; choose another file, or delete it."


def _stored_pass_spp(path: Path) -> int | None:
    """Samples of a pass of what is on disk, so that a reference can be continued to a higher accuracy."""
    state = _state_path(path)
    if state.exists():
        return int(_read_state(state)[0]["identity"]["pass_spp"])
    return int(read_reference(path).identity["pass_spp"]) if path.exists() else None


def _save_state(path: Path, setup: _Setup, run: _Run) -> None:
    text = json.dumps({"identity": setup.identity, "seconds": run.seconds})
    m = run.moments
    write_whole(_state_path(path), lambda file: np.savez(file, n=m.n, mean=m.mean, m2=m.m2, made=np.array(text)))
    run.saved = time.monotonic()


def _read_state(state: Path) -> tuple[dict[str, Any], Moments]:
    try:
        with state.open("rb") as file, np.load(file) as stored:
            return json.loads(str(stored["made"])), Moments(int(stored["n"]), stored["mean"], stored["m2"])
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise MivolError(f"{state} is not a whole checkpoint of a reference; delete it to start over.") from error


def _load_state(path: Path, setup: _Setup) -> _Run:
    state = _state_path(path)
    if not state.exists():
        return _Run(Moments.empty(setup.shape), setup.pass_spp, 0.0)
    made, moments = _read_state(state)
    _check_identity(state, made["identity"], setup.identity)
    return _Run(moments, setup.pass_spp, made["seconds"])


def _write(result: ReferenceResult) -> None:
    names = "RGB" if result.mean.shape[-1] == 3 else "Y"
    channels = {name: result.mean[..., i] for i, name in enumerate(names)}
    channels |= {f"variance.{name}": result.variance[..., i] for i, name in enumerate(names)}
    made = {
        "identity": result.identity,
        "batches": result.batches,
        "spp": result.spp,
        "seconds": result.seconds,
        "doubts": [vars(d) for d in result.doubts],
        "mivol": mivol.__version__,
    }
    write_exr(result.path, channels, {"mivol_reference": json.dumps(made)})


# -- Doubts ---------------------------------------------------------------------------------------


def _judge(scene: mi.Scene, sensor: mi.Sensor, accept: bool) -> tuple[Doubt, ...]:
    doubts: Sequence[Doubt] = trust(scene, [sensor])
    fatal = [d for d in doubts if d.fatal]
    if fatal and not accept:
        raise MivolError(f"Mitsuba {mi.__version__} is no reference here: {fatal[0].sentence}")
    for doubt in doubts:
        warnings.warn(doubt.sentence, RuntimeWarning, stacklevel=3)
    return tuple(doubts)
