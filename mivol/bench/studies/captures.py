"""Which constants of captures hold for captures that did not choose them?

    mivol bench captures --captures FOLDER NAME=FOLDER ...            # grids and Gaussians
    mivol bench captures --captures FOLDER ... --only gaussians
    mivol bench captures --captures FOLDER ... --only poses           # grids from wrong poses, with cameras that move

A capture has the name of its folder, or another name before an equals sign. Each folder holds photographs with their poses, as
for ``mivol optimize``. Fits have the presets ``capture`` (grids) and ``minute`` (Gaussians). Every eighth photograph is
judged and not fitted; at most eight are judged.

One constant at a time takes another value. Each capture is left out once: the value that is best in the mean of the other
captures is chosen, and judged by the capture left out. A constant is stable if the same value is chosen whichever capture is
left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mivol.bench.harness.study import Size, Study, amount, ask, say_row
from mivol.bench.photo_fits import PhotoProblem, prepare_fit
from mivol.errors import MivolError
from mivol.optim.loop import begin_fit
from mivol.photos import Photo, Photos, rectify
from mivol.photos.camera import align_camera, move_camera
from mivol.photos.region import viewing_distance


@dataclass(frozen=True)
class CaptureSize(Size):
    """Amount of work."""

    captures: tuple[str, ...] = amount(("",), doc="folders of captures, or names and folders with = between")
    largest: int = amount(144, 48, "longest edge of a photograph [pixel]")
    effort: float = amount(0.35, 0.02, "factor on the steps of the presets")
    held_out: int = amount(8, 4, "of so many photographs one is judged")
    judged: int = amount(8, 2, "most judged photographs of a capture")
    turn: float = amount(0.5, doc="turn of wrong poses, standard deviation about each axis [degree]")
    shift: float = amount(0.015, doc="shift of wrong poses along each axis [median distance of the cameras]")


@dataclass(frozen=True)
class Variation:
    """A value of a constant.

    Attributes:
        label: of the value.
        adapt: changes the plan before it is adapted to the photographs.
        change: changes the photographs to fit, or their box.
    """

    label: str
    adapt: Callable[[Any], Any] = lambda plan: plan
    change: Callable[[Photos], Photos] = lambda photos: photos


def change_plan(**values: Any) -> Callable[[Any], Any]:
    """Function that changes attributes of a plan."""
    return lambda plan: replace(plan, **values)


def scale_plan(**factors: float) -> Callable[[Any], Any]:
    """Function that multiplies attributes of a plan."""
    return lambda plan: replace(plan, **{name: getattr(plan, name) * factor for name, factor in factors.items()})


def scale_steps(factor: float) -> Callable[[Any], Any]:
    """Function that multiplies the steps of a plan."""
    return lambda plan: replace(
        plan, stages=tuple(replace(stage, steps=max(1, round(factor * stage.steps))) for stage in plan.stages)
    )


def scale_box(factor: float) -> Callable[[Photos], Photos]:
    """Function that scales the innermost box about its middle."""

    def scaled(photos: Photos) -> Photos:
        middle = photos.box.mean(axis=0)
        return replace(photos, survey=replace(photos.survey, box=middle + factor * (photos.box - middle)))

    return scaled


RULE = Variation("the rule")
"""The preset as it stands."""

CONSTANTS: dict[str, dict[str, tuple[Variation, ...]]] = {
    "grid": {
        "innermost box": (Variation("2/3", change=scale_box(2 / 3)), RULE, Variation("3/2", change=scale_box(3 / 2))),
        "nested boxes": (Variation("4", change_plan(levels=4, fewer_levels=False)), RULE),
        "total variation of the density": (
            Variation("x 1/3", scale_plan(tv_density=1 / 3)),
            RULE,
            Variation("x 3", scale_plan(tv_density=3)),
        ),
        "steps": (Variation("x 1/2", scale_steps(1 / 2)), RULE, Variation("x 2", scale_steps(2))),
        "distances of points": (Variation("none", change_plan(depth=0.0)), RULE),
        "free space": (Variation("none", change_plan(free_space=False)), RULE),
    },
    "gaussians": {
        "steps": (Variation("x 1/2", scale_steps(1 / 2)), RULE, Variation("x 2", scale_steps(2))),
        "share of SSIM": (Variation("0", change_plan(ssim=0.0)), RULE, Variation("0.5", change_plan(ssim=0.5))),
        "largest Gaussian": (Variation("x 1/3", scale_plan(largest=1 / 3)), RULE, Variation("x 3", scale_plan(largest=3))),
    },
}
"""Constants and their values, by the kind of fit."""

SETTINGS = {"grid": ("field", "capture"), "gaussians": ("gaussians", "minute")}
"""Table of the settings and preset, by the kind of fit."""


# -- One fit ----------------------------------------------------------------------------------------------------------------


def list_captures(size: CaptureSize) -> dict[str, Path]:
    """Folders of the captures by their names.

    Raises:
        MivolError: no folder, a folder that is missing, or two captures with the same name.
    """
    pairs = [text.partition("=") if "=" in text else (Path(text).name, "", text) for text in size.captures if text]
    folders = {name: Path(folder) for name, _, folder in pairs}
    if not folders:
        raise MivolError("found no captures: --captures expects folders of photographs with their poses.")
    if len(folders) < len(pairs):
        raise MivolError("found two captures of one name: --captures expects NAME=FOLDER for one of them.")
    missing = [folder for folder in folders.values() if not folder.exists()]
    if missing:
        raise MivolError(f"{missing[0]} is missing: --captures expects folders of photographs with their poses.")
    return folders


def fit_capture(folder: Path, kind: str, size: CaptureSize, choice: Variation = RULE, **more: Any) -> PhotoProblem:
    """Fit a capture with a value of a constant; ``more`` settings of its table."""
    table, preset = SETTINGS[kind]
    settings = {table: {"preset": preset, "effort": size.effort, **more}}
    photos = {"held_out": size.held_out, "largest": size.largest}
    fitted = prepare_fit(folder, photos, settings, adapt=choice.adapt, change=choice.change)
    problem = fitted.problem
    run = begin_fit(problem, problem.plan.optimizer, problem.plan.course()).complete().run
    problem.set_reals(run.reals)
    return fitted


def choose_judged(fitted: PhotoProblem, size: CaptureSize) -> list[Photo]:
    """Judged photographs, evenly spread and undistorted."""
    views = fitted.judged.views
    chosen = np.unique(np.linspace(0, len(views) - 1, min(size.judged, len(views))).round().astype(int))
    return [rectify(views[number]) for number in chosen]


# -- Constants, each capture left out once -----------------------------------------------------------------------------------


def measure_constants(kind: str, size: CaptureSize) -> dict:
    """Fit each capture with each value of each constant, and choose values with each capture left out."""
    captures, answer, base = list_captures(size), {}, {}
    for name, folder in captures.items():
        fitted = fit_capture(folder, kind, size)
        base[name] = fitted.score(choose_judged(fitted, size), ("psnr", "ssim"))
        say_row(name, **base[name])
    for constant, choices in CONSTANTS[kind].items():
        gains: dict[str, dict[str, float]] = {}
        for choice in choices:
            gains[choice.label] = {}
            for name, folder in captures.items():
                fitted = None if choice is RULE else fit_capture(folder, kind, size, choice)
                psnr = base[name]["psnr"] if fitted is None else fitted.score(choose_judged(fitted, size))["psnr"]
                gains[choice.label][name] = psnr - base[name]["psnr"]
            say_row(f"{constant}: {choice.label}", **gains[choice.label])
        answer[constant] = {"gains": gains, **leave_each_out(gains)}
    return {"captures": base, "constants": answer}


def leave_each_out(gains: dict[str, dict[str, float]]) -> dict:
    """Choose the value that is best in the mean of all captures but one, for each capture in turn.

    Args:
        gains: PSNR minus the PSNR of the rule [dB], by value and capture.

    Returns:
        ``chosen``: value by the capture left out; ``left_out``: mean gain of the chosen values on the captures left out [dB];
        ``is_stable``: whether one value is chosen throughout.
    """
    names = list(next(iter(gains.values())))
    chosen = {}
    for out in names:
        others = [name for name in names if name != out]
        chosen[out] = max(gains, key=lambda value: np.mean([gains[value][name] for name in others]) if others else 0.0)
    return {
        "chosen": chosen,
        "left_out": float(np.mean([gains[chosen[out]][out] for out in names])),
        "is_stable": len(set(chosen.values())) == 1,
    }


# -- Wrong poses ---------------------------------------------------------------------------------------------------------------


def disturb_poses(photos: Photos, size: CaptureSize) -> Photos:
    """The photographs with wrong poses."""
    rng, cameras = np.random.default_rng(0), [view.camera for view in photos.views]
    distance = viewing_distance(cameras, photos.box)
    moves = rng.standard_normal((len(cameras), 2, 3)) * np.array([np.radians(size.turn), size.shift * distance])[:, None]
    views = [replace(view, camera=move_camera(view.camera, *move)) for view, move in zip(photos.views, moves, strict=True)]
    return replace(photos, views=tuple(views))


def align_view(fitted: PhotoProblem, view: Photo) -> Photo:
    """A judged photograph with the pose that shows the model most like it."""
    distance = viewing_distance([photo.camera for photo in fitted.train.views], fitted.train.box)

    def render(camera: Any) -> np.ndarray:
        return fitted.show(replace(view, camera=camera))

    return replace(view, camera=align_camera(render, view.camera, view.image, view.mask, distance))


def measure_poses(size: CaptureSize) -> dict:
    """Do cameras that move with the fit of a grid help held-out photographs, with given and with wrong poses?"""
    answer = {}
    for name, folder in list_captures(size).items():
        answer[name] = {}
        for label, change in {"given": RULE.change, "wrong": lambda photos: disturb_poses(photos, size)}.items():
            for moves in (False, True):
                fitted = fit_capture(folder, "grid", size, Variation(label, change=change), poses=moves)
                views = choose_judged(fitted, size)
                aligned = [align_view(fitted, view) for view in views]
                row = {"psnr": fitted.score(views)["psnr"], "psnr_aligned": fitted.score(aligned)["psnr"]}
                answer[name][f"{label} poses, cameras {'move' if moves else 'stay'}"] = row
                say_row(f"{name}: {label} poses, cameras {'move' if moves else 'stay'}", **row)
    return answer


# -- Table ---------------------------------------------------------------------------------------------------------------------


def table(question: str, answer: dict) -> list[str]:
    """The table of a question, for the docs."""
    if question == "poses":
        head = ["| capture, poses | as posed | aligned |", "|---|---|---|"]
        rows = [(f"{name}, {label}", row) for name, found in answer.items() for label, row in found.items()]
        return [*head, *(f"| {label} | {row['psnr']:.2f} dB | {row['psnr_aligned']:.2f} dB |" for label, row in rows)]
    captures = answer["captures"]
    head = f"| constant: value | {' | '.join(captures)} | mean | chosen when left out |"
    lines = [head, "|---" * (len(captures) + 3) + "|"]
    scores = " | ".join(f"{row['psnr']:.2f} / {row['ssim']:.3f}" for row in captures.values())
    lines.append(f"| the rules | {scores} | {np.mean([row['psnr'] for row in captures.values()]):.2f} | |")
    for constant, found in answer["constants"].items():
        for value, gains in found["gains"].items():
            if value == RULE.label:
                continue
            counts = sum(chosen == value for chosen in found["chosen"].values())
            each = " | ".join(f"{gain:+.2f}" for gain in gains.values())
            lines.append(f"| {constant}: {value} | {each} | {np.mean(list(gains.values())):+.2f} | {counts} of {len(gains)} |")
    return lines


QUESTIONS = {
    "grid": ask("Which constants of grids hold for captures that did not choose them?", measure_constants, "grid"),
    "gaussians": ask(
        "Which constants of Gaussians hold for captures that did not choose them?", measure_constants, "gaussians"
    ),
    "poses": measure_poses,
}
STUDY = Study(__name__, __doc__, CaptureSize, QUESTIONS, table=table, on_request=("poses",))
