"""Fit of Gaussians to photographs: a whole image per step, by the tile renderer.

Conventions. The reals are the tensors of :mod:`mivol.splatting.splatter` by name. Higher harmonics are stored divided by
``GaussianPlan.sheen``: their learning rate is smaller by this factor, and all numbers of a tensor have the same rate. Colours
are code values 0..1, as in the photographs. A step depends on the reals, the stage, the seed and its number; density control
also depends on sums since its last application.

References: Kerbl et al. 2023 (loss, order of views, density control); Kheradmand et al. 2024 (relocation, noise, priors).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import expit

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedKernel
from mivol.optim.gaussians.density_control import (
    CloudArrays,
    CloudChange,
    clone_and_split,
    grow,
    prune,
    relocate,
    reset_opacities,
    select_rows,
)
from mivol.optim.gaussians.gaussian_plan import CONTROLS, GaussianPlan, scene_extent
from mivol.optim.losses import ImageShape, image_loss
from mivol.optim.photographs.photo_colours import Exposure, pull_at
from mivol.optim.photographs.ray_batches import RayBatches, describe_size
from mivol.optim.problem import Divide, DividedProblem, Reals, Refinement, StagedProblem, add_parts, to_arrays, to_tensors
from mivol.optim.strategy import suggest_name
from mivol.photos import Camera
from mivol.photos.camera import move_camera
from mivol.photos.region import is_free_space
from mivol.splatting import Splatter
from mivol.splatting.splatter import NAMES, ScreenStatistics

GAIN_STEP = 0.05
"""Initial maximum change of a gain's logarithm per visit of the photograph: a gain of 1.5 needs eight visits or more."""

MOTION = 6
"""Numbers of a motion."""

MOTION_STEP = 1e-3
"""Initial maximum change of a camera's rotation [rad] and position [extent] per visit of the photograph: 0.1 to 0.3 pixels of a
photograph of 200 pixels."""

MOTION_PULL = 0.02
"""Initial share by which a motion falls per visit of the photograph."""

RESET_TO = 0.01
"""Maximum opacity after a reset of opacities."""

MOVED, SEEN = "statistics/moved", "statistics/seen"
"""Results of a part: gradient of the screen position of each Gaussian, and the number of views that show it."""


@dataclasses.dataclass
class GaussianProblem(StagedProblem, DividedProblem):
    """Gaussians with photographs.

    Attributes:
        batches: the photographs, in the sizes of the plan.
        cameras: pinhole cameras of the full-size photographs.
        cloud: the initial Gaussians; the fitted Gaussians after :meth:`set_reals`.
        plan: plan of the fit.
        seed: root of the order of views, of backgrounds and of density control.
        safe_point: called between kernels.
        divide: computes the views of a step elsewhere; None: in this process.
        stage: number of the current stage.
        exposure: gains of the photographs, if the plan has gains.
        motions: (photographs, 6) motions of the cameras, if the plan refines poses: rotation vectors about their positions, in
            the axes of the world [rad], and translations [extent].

    Example:
        >>> cloud = make_start_cloud(find_start_points(photos, 5000, 0)[0], photos.views, degree=0)
        >>> problem = GaussianProblem(RayBatches.from_photos(photos.views, (1, 2)), cameras, cloud, PRESETS["tiny"])
        >>> reconstruct(problem, problem.plan.optimizer, problem.plan.course())
    """

    batches: RayBatches
    cameras: Sequence[Camera]
    cloud: CloudArrays
    plan: GaussianPlan
    seed: int = 0
    safe_point: Callable[[], None] = lambda: None
    divide: Divide | None = None
    stage: int = dataclasses.field(init=False, default=0)
    exposure: Exposure | None = dataclasses.field(init=False, default=None)
    motions: np.ndarray | None = dataclasses.field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.plan.control not in CONTROLS:
            raise MivolError(f'control = "{self.plan.control}" is unknown: {suggest_name(self.plan.control, list(CONTROLS))}')
        absent = {stage.shrink for stage in self.plan.stages} - self.batches.levels.keys()
        if absent:
            raise MivolError(f"the plan needs views shrunk by {min(absent)}: give this size to RayBatches.from_photos.")
        self.extent = scene_extent(self.cameras)
        if not self.extent > 1e-6 * max(np.abs(camera.origin).max() for camera in self.cameras):
            raise MivolError("all cameras are at one position, which leaves distances unknown: add views from other positions.")
        if self.plan.exposure:
            if self.batches.channels == 4:
                raise MivolError("found gains and photographs with alpha, which have equal exposures: set exposure = false.")
            self.exposure = Exposure.neutral(len(self.cameras))
        if self.plan.poses:
            self.motions = np.zeros((len(self.cameras), MOTION), np.float32)
        self.initial_count = len(self.cloud["means"])
        self._splatters: dict[tuple[int, int, float, float, int], Splatter] = {}
        self._shapes: dict[tuple[int, int], ImageShape] = {}
        self._cameras: dict[tuple[int, int], Camera] = {}
        self._order: tuple[int, np.ndarray] | None = None
        self._image_loss = RecordedKernel(image_loss)
        self.cloud = _with_degree(self.cloud, self.plan.stages[0].degree)
        self._reset_statistics()

    # -- Values -------------------------------------------------------------------------------------------------------

    def initial_reals(self) -> Reals:
        """Reals of the present cloud and gains."""
        return self._with_photographs(self._reals_of(self.cloud))

    def values(self) -> Reals:
        """The cloud as tensors, with unscaled coefficients."""
        return {name: mi.TensorXf(array) for name, array in self.cloud.items()}

    def set_reals(self, reals: Reals) -> None:
        """Set the cloud, the gains and the motions."""
        if self.exposure is not None:
            self.exposure = Exposure(reals["exposure"].array)
        if self.motions is not None:
            self.motions = np.array(reals["motions"])
        self.cloud = self._cloud_of({name: value for name, value in reals.items() if name in NAMES})

    def _with_photographs(self, reals: Reals) -> Reals:
        """Reals of the cloud, with gains and motions."""
        gains = {} if self.exposure is None else {"exposure": self.exposure.tensor}
        return reals | gains | ({} if self.motions is None else {"motions": mi.TensorXf(self.motions)})

    def _reals_of(self, cloud: CloudArrays) -> Reals:
        return {name: mi.TensorXf(array) for name, array in cloud.items()} | {
            "harmonics": mi.TensorXf(cloud["harmonics"] / self._shares(cloud["harmonics"].shape[1]))
        }

    def _cloud_of(self, reals: Reals) -> CloudArrays:
        cloud = {name: np.array(value) for name, value in reals.items()}
        cloud["harmonics"] *= self._shares(cloud["harmonics"].shape[1])
        return cloud

    def _shares(self, count: int) -> np.ndarray:
        """(count, 1) ratio of a coefficient to the real."""
        return np.array([1.0] + [self.plan.sheen] * (count - 1), np.float32)[:, None]

    # -- Loss and gradient --------------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        """Mean loss of the views of a step and the gradient; the views follow a new random order per epoch.

        Args:
            reals: of the cloud.
            iteration: selects the views.
            views: number of views; 0 takes the plan's.
        """
        count = min(views or self.plan.views, len(self.cameras))
        parts = [(number, count) for number in range(iteration * count, (iteration + 1) * count)]
        if self.divide is not None:
            found = to_tensors(self.divide(self, reals, parts))
        elif count == 1:
            found = self.compute_part(reals, *parts[0])
        else:
            total: dict[str, np.ndarray] = {}
            for part in parts:
                add_parts(total, to_arrays(self.compute_part(reals, *part)))
            found = to_tensors(total)
        self._slopes += np.array(found.pop(MOVED), np.float64)
        self._times += np.array(found.pop(SEEN), np.float64)
        loss = found.pop("loss").array
        if self.plan.control == "relocation":
            loss, found = self._add_priors(reals, loss, found)
        return loss, found

    def compute_part(self, reals: Reals, number: int, count: int) -> Reals:
        """Loss, derivatives and statistics of a view, as shares of a step of ``count`` views.

        Args:
            reals: of the cloud.
            number: number of the view in the order of all epochs.
            count: views of the step.
        """
        epoch, index = divmod(number, len(self.cameras))
        if self._order is None or self._order[0] != epoch:
            self._order = epoch, np.random.default_rng((self.seed, 2, epoch)).permutation(len(self.cameras))
        view = int(self._order[1][index])
        loss, gradient, statistics = self.view_loss_and_gradient(reals, view, self._background(number))
        found = {name: mi.TensorXf(value.array / count, value.shape) for name, value in gradient.items()}
        visible = np.asarray(statistics.visible)
        moved = np.where(visible, statistics.d_mean2d, 0).astype(np.float32)
        return found | {
            "loss": mi.TensorXf(loss / count, (1,)),
            MOVED: mi.TensorXf(moved),
            SEEN: mi.TensorXf(visible.astype(np.float32)),
        }

    def step_state(self) -> dict[str, Any]:
        """The stage."""
        return {"stage": self.stage}

    def take_step_state(self, state: dict[str, Any]) -> None:
        """Enter the stage of the same problem in another process."""
        self.stage = state["stage"]

    def view_loss_and_gradient(
        self, reals: Reals, view: int, background: np.ndarray | None = None
    ) -> tuple[mi.Float, Reals, ScreenStatistics]:
        """The loss of a view in the size of the stage, its gradient by the reals, and the screen statistics of each Gaussian.

        Args:
            reals: of the cloud.
            view: number of the view.
            background: colour behind the photograph and the cloud (3,); None keeps the photograph's own background.
        """
        shrink = self.plan.stages[self.stage].shrink
        camera = self._moved(self._camera(view, shrink), reals, view)
        splatter = self.splatter_for(camera.size, self.plan.low_pass_at(shrink), self.plan.sheen)
        image, saved = splatter.forward(reals, camera)
        self.safe_point()
        gains = self._gains_of(reals, view)
        colour, target, backdrop, counted = self._compare_with_photograph(image, view, shrink, background, gains)
        loss, slope = self._image_loss(colour, target, self._shape(camera.size), self.plan.ssim)
        d_image = _gradient_of_image(slope, backdrop, counted, gains, image.shape)
        gradient, statistics = splatter.backward(saved, d_image, self.motions is not None)
        if self.motions is not None:
            rows = np.zeros_like(self.motions)
            rows[view] = np.array(gradient.pop("pose")) * ([1] * 3 + [self.extent] * 3)
            gradient["motions"] = mi.TensorXf(rows)
        if self.exposure is not None:
            pixel, by_log = dr.arange(mi.UInt32, dr.width(colour) // 3), colour * slope
            by_log = mi.Color3f(*(dr.sum(dr.gather(mi.Float, by_log, 3 * pixel + c)) for c in range(3)))
            slopes = self.exposure.gradient(dr.opaque(mi.UInt32, view), by_log)
            gradient["exposure"] = mi.TensorXf(slopes, reals["exposure"].shape)
        # Screen positions in half edges of the image, so that one threshold fits images of all sizes.
        moved = statistics.d_mean2d * (max(camera.size) / 2)
        return loss, gradient, dataclasses.replace(statistics, d_mean2d=moved)

    def _camera(self, view: int, shrink: int) -> Camera:
        """Camera of a view at a smaller size; incomplete squares of pixels at the border are dropped."""
        if (view, shrink) not in self._cameras:
            camera, size = self.cameras[view], tuple(int(n) for n in self.batches.levels[shrink].sizes[view])
            smaller = np.diag([1 / shrink, 1 / shrink, 1.0]) @ camera.K
            self._cameras[view, shrink] = dataclasses.replace(camera, K=smaller, size=size)
        return self._cameras[view, shrink]

    def _moved(self, camera: Camera, reals: Reals, view: int) -> Camera:
        """The camera of a view after its motion."""
        if self.motions is None:
            return camera
        motion = np.array(reals["motions"], np.float64)[view]
        return move_camera(camera, motion[:3], motion[3:] * self.extent)

    def splatter_for(self, size: tuple[int, int], low_pass: float, sheen: float = 1.0) -> Splatter:
        """Renderer of images of a size (width, height) for the degree of the stage; each is made once.

        Args:
            size: of the image [pixel].
            low_pass: variance of the filter [pixel^2].
            sheen: the plan's for reals; 1 for clouds with unscaled coefficients.
        """
        key = (*size, low_pass, sheen, self.plan.stages[self.stage].degree)
        if key not in self._splatters:
            settings = {"low_pass": low_pass, "sheen": sheen, "compensated": self.plan.mip}
            self._splatters[key] = Splatter(*size, key[-1], **settings)
        return self._splatters[key]

    def _shape(self, size: tuple[int, int]) -> ImageShape:
        if size not in self._shapes:
            self._shapes[size] = ImageShape.of(*size)
        return self._shapes[size]

    def _background(self, iteration: int) -> np.ndarray | None:
        random = self.plan.random_background and self.batches.channels == 4
        return np.random.default_rng((self.seed, 3, iteration)).random(3) if random else None

    def _gains_of(self, reals: Reals, view: int) -> mi.Float:
        """Gains of the three channels of a view, evaluated."""
        if self.exposure is None:
            return dr.opaque(mi.Float, 1, 3)
        gains = dr.exp(dr.gather(mi.Float, reals["exposure"].array, 3 * dr.opaque(mi.UInt32, view) + dr.arange(mi.UInt32, 3)))
        dr.eval(gains)
        return gains

    def _compare_with_photograph(
        self, image: mi.TensorXf, view: int, shrink: int, background: np.ndarray | None, gains: mi.Float
    ) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float]:
        """Render and photograph over one background, (H, W, 3) flat and evaluated; the background (3,), and the weights of
        pixels.
        """
        codes, counted = self.batches.image(shrink, view)
        own = self.batches.backgrounds[view]
        backdrop = own if background is None else background
        colours = [dr.opaque(mi.Float, float(c)) for c in backdrop]
        pixels = image.shape[0] * image.shape[1]
        pixel = dr.arange(mi.UInt32, pixels)
        T = 1 - dr.gather(mi.Float, image.array, 4 * pixel + 3)
        rendered, target = dr.empty(mi.Float, 3 * pixels), dr.empty(mi.Float, 3 * pixels)
        for c, colour in enumerate(colours):
            value = codes[c]
            if len(codes) == 4:
                value = value + (1 - codes[3]) * (colour - dr.opaque(mi.Float, float(own[c])))
            composite = dr.gather(mi.Float, image.array, 4 * pixel + c) + T * colour
            dr.scatter(rendered, composite * dr.gather(mi.Float, gains, mi.UInt32(c)) * counted, 3 * pixel + c)
            dr.scatter(target, value * counted, 3 * pixel + c)
        dr.eval(rendered, target)
        return rendered, target, mi.Float(np.asarray(backdrop, np.float32)), counted

    def _add_priors(self, reals: Reals, loss: mi.Float, gradient: Reals) -> tuple[mi.Float, Reals]:
        """Loss and gradient with the priors of relocation: the mean opacity and the mean scale [extent]."""
        n, weight = reals["means"].shape[0], self.plan.sparsity
        each = dr.opaque(mi.Float, weight / n)
        opacity = 1 / (1 + dr.exp(-reals["opacity_logits"].array))
        scale = dr.exp(reals["log_scales"].array) * dr.opaque(mi.Float, 1 / (3 * self.extent))
        loss = loss + each * (dr.sum(opacity) + dr.sum(scale))
        slopes = {"opacity_logits": opacity * (1 - opacity), "log_scales": scale}
        more = {name: mi.TensorXf(gradient[name].array + each * slope, gradient[name].shape) for name, slope in slopes.items()}
        return loss, gradient | more

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rate of each parameter.

        With n photographs, a gain has a gradient every n steps, and Adam moves the gain by up to sqrt(n) rates.
        """
        rates = self.plan.learning_rates(iteration, self.extent)
        if self.exposure is not None:
            rates["exposure"] = GAIN_STEP * self._fall(iteration) / len(self.cameras) ** 0.5
        if self.motions is not None:
            rates["motions"] = MOTION_STEP * self._fall(iteration) / len(self.cameras) ** 0.5
        return rates

    def _fall(self, iteration: int) -> float:
        """Factor on the rates of gains and motions."""
        return self.plan.final_rate ** (iteration / max(self.plan.steps, 1))

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """Pull gains towards 1; for relocation, move transparent Gaussians at random (Kheradmand et al. 2024, eq. 8)."""
        if self.exposure is not None:
            pulled = Exposure(reals["exposure"].array).regularized(
                pull_at(GAIN_STEP * self._fall(iteration) / len(self.cameras))
            )
            dr.eval(pulled.logs)
            reals = reals | {"exposure": pulled.tensor}
        if self.motions is not None:
            # Without their mean, motions do not carry the whole scene away from the held-out photographs.
            motions = np.array(reals["motions"])
            motions = (motions - motions.mean(axis=0)) * (1 - MOTION_PULL * self._fall(iteration) / len(self.cameras))
            reals = reals | {"motions": mi.TensorXf(motions.astype(np.float32))}
        if self.plan.control != "relocation" or iteration >= self.plan.growth[1] * self.plan.steps:
            return reals
        n = reals["means"].shape[0]
        drawn = np.random.default_rng((self.seed, 4, iteration)).standard_normal((n, 3)).astype(np.float32)
        size = dr.opaque(mi.Float, self.plan.position_noise * self.learning_rates(iteration)["means"])
        return {**reals, "means": _move_randomly(reals, mi.Float(drawn.ravel()), size)}

    # -- Density ------------------------------------------------------------------------------------------------------

    def control_density(self, iteration: int) -> Refinement:
        """Add Gaussians to poorly fitted regions, remove invisible Gaussians, and restart the sums."""
        rng = np.random.default_rng((self.seed, 5, iteration))
        before = len(self.cloud["means"])
        room = self.plan.count_at(iteration, self.initial_count) - before
        change = (self._relocate if self.plan.control == "relocation" else self._clone_and_split)(room, rng)
        reset = self.plan.reset_every and iteration % self.plan.reset_every == 0
        self.cloud = reset_opacities(change.cloud, RESET_TO) if reset else change.cloud
        self._reset_statistics()

        def carry(tensors: Reals) -> Reals:
            learnt = change.carry({name: np.array(value) for name, value in tensors.items() if name in NAMES})
            if reset:
                learnt["opacity_logits"][:] = 0
            return tensors | {name: mi.TensorXf(array) for name, array in learnt.items()}

        now = len(self.cloud["means"])
        message = f"{now} Gaussians, {before} before" + (", all of opacity 0.01 at most" if reset else "")
        return Refinement(self.initial_reals(), carry, {}, message)

    def _clone_and_split(self, room: int, rng: np.random.Generator) -> CloudChange:
        """Divide Gaussians with the largest gradients of screen positions; prune transparent and very large ones."""
        slope = self._slopes / np.maximum(self._times, 1)
        rows = select_rows(slope, max(self.plan.split_threshold, np.finfo(np.float32).tiny), room)
        change = clone_and_split(self.cloud, rows, self.plan.largest_clone * self.extent, rng)
        cloud = change.cloud
        keep = expit(cloud["opacity_logits"]) >= self.plan.least_opacity
        keep &= np.exp(cloud["log_scales"].max(axis=1)) <= self.plan.largest * self._scale_at(cloud["means"])
        if self.plan.reach:
            keep &= ~is_free_space(self.cameras, cloud["means"], self.plan.reach)
        return change.then(prune(cloud, keep))

    def _scale_at(self, places: np.ndarray) -> np.ndarray | float:
        """Unit of the largest scale at places (N, 3) [length]: the extent or, for a capture, a larger distance."""
        if not self.plan.reach:
            return self.extent
        middle = np.mean([camera.origin for camera in self.cameras], axis=0)
        return np.maximum(self.extent, np.linalg.norm(places - middle, axis=1))

    def _relocate(self, room: int, rng: np.random.Generator) -> CloudChange:
        """Move transparent Gaussians to opaque Gaussians, then grow by at most 5 %."""
        moved = relocate(self.cloud, self.plan.least_opacity, rng)
        more = min(max(room, 0), max(1, len(self.cloud["means"]) // 20))
        return moved.then(grow(moved.cloud, more, self.plan.least_opacity, rng)) if more else moved

    def _reset_statistics(self) -> None:
        """Restart the sums of screen gradients and the counts of views of each Gaussian."""
        self._slopes = np.zeros(len(self.cloud["means"]))
        self._times = np.zeros(len(self.cloud["means"]))

    # -- Stages -------------------------------------------------------------------------------------------------------

    def refine(self, stage: int) -> Refinement:
        """Change to photographs of another size, and to another degree; new harmonics start at 0."""
        self.stage = stage
        now = self.plan.stages[stage]
        self.cloud = _with_degree(self.cloud, now.degree)

        def carry(tensors: Reals) -> Reals:
            learnt = _with_degree({name: np.array(value) for name, value in tensors.items()}, now.degree)
            return {name: mi.TensorXf(array) for name, array in learnt.items()}

        message = f"{describe_size(now.shrink)}, harmonics of degree {now.degree}"
        return Refinement(self.initial_reals(), carry, {}, message)

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The stage, and the sums since the last density control."""
        return {"stage": np.array(self.stage), "slopes": self._slopes, "times": self._times}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Continue from the arrays of :meth:`pack`, with the same plan, photographs and initial cloud."""
        self.stage = int(arrays["stage"])
        self.set_reals(reals)
        self._slopes, self._times = np.array(arrays["slopes"]), np.array(arrays["times"])


def _with_degree(arrays: CloudArrays, degree: int) -> CloudArrays:
    """The arrays with harmonics up to a degree: higher harmonics are dropped, new harmonics are 0."""
    harmonics, count = arrays["harmonics"], (degree + 1) ** 2
    padded = np.zeros((len(harmonics), count, 3), np.float32)
    shared = min(count, harmonics.shape[1])
    padded[:, :shared] = harmonics[:, :shared]
    return {**arrays, "harmonics": padded}


def _gradient_of_image(
    slope: mi.Float, backdrop: mi.Float, counted: mi.Float, gains: mi.Float, shape: tuple[int, ...]
) -> mi.TensorXf:
    """Derivatives by premultiplied colour and alpha, from derivatives by the composite over a background, times gains."""
    pixel = dr.arange(mi.UInt32, shape[0] * shape[1])
    dr.eval(slope)
    gradient, by_T = dr.empty(mi.Float, 4 * dr.width(pixel)), mi.Float(0)
    for c in range(3):
        component = dr.gather(mi.Float, slope, 3 * pixel + c) * counted * dr.gather(mi.Float, gains, mi.UInt32(c))
        by_T += component * dr.gather(mi.Float, backdrop, mi.UInt32(c))
        dr.scatter(gradient, component, 4 * pixel + c)
    dr.scatter(gradient, -by_T, 4 * pixel + 3)
    dr.eval(gradient)
    return mi.TensorXf(gradient, shape)


STEEPNESS, MIDDLE_OPACITY = 100.0, 0.005
"""Steepness of the logistic function ending random moves of visible Gaussians, and the middle opacity (published code)."""


def _move_randomly(reals: Reals, drawn: mi.Float, size: mi.Float) -> mi.TensorXf:
    """Positions moved by normal numbers with the shape of the Gaussians, where the opacity is almost 0."""
    index = dr.arange(mi.UInt32, reals["means"].shape[0])

    def rows(array: mi.Float, count: int) -> list[mi.Float]:
        return [dr.gather(mi.Float, array, count * index + k) for k in range(count)]

    w, x, y, z = rows(reals["quaternions"].array, 4)
    turn = dr.normalize(mi.Quaternion4f(x, y, z, w))
    matrix = dr.quat_to_matrix(mi.Matrix3f, turn)
    variance = dr.exp(2 * mi.Vector3f(*rows(reals["log_scales"].array, 3)))
    drawn_rows = rows(drawn, 3)
    along = mi.Vector3f(*(sum(matrix[i, k] * drawn_rows[i] for i in range(3)) for k in range(3)))
    step = matrix @ (variance * along)
    opacity = 1 / (1 + dr.exp(-reals["opacity_logits"].array))
    step *= size / (1 + dr.exp(STEEPNESS * (opacity - MIDDLE_OPACITY)))
    moved = dr.empty(mi.Float, 3 * dr.width(index))
    for k in range(3):
        dr.scatter(moved, dr.gather(mi.Float, reals["means"].array, 3 * index + k) + step[k], 3 * index + k)
    return mi.TensorXf(moved, reals["means"].shape)
