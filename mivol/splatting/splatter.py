"""The renderer of fits of Gaussians: images, and derivatives by every input of an image.

Conventions. A cloud is a dictionary of Dr.Jit tensors, as in :mod:`mivol.points.gaussians`: "means" (N, 3) [length],
"log_scales" (N, 3), "quaternions" (N, 4), (w, x, y, z) of any length, "opacity_logits" (N,), "harmonics" (N, K, 3). Images are
(height, width, 4): rgb multiplied by alpha, and alpha; black without Gaussians. A background behind the cloud is added as
``rgb + (1 - alpha) background``.

Kernels are recorded once (``dr.freeze``) and launched without tracing for any number of Gaussians, any pose and any lists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import free_memory
from mivol.errors import MivolError
from mivol.kernel_recording import RecordedKernel, copy_aligned, ensure_aligned
from mivol.photos.camera import Camera
from mivol.points import Gaussians
from mivol.splatting.compositing import CHUNK, LANES, PIXELS, Adjoint, Frame, Lists, composite, composite_adjoint
from mivol.splatting.projection import (
    EXP2,
    TILE,
    Cloud,
    DeviceCamera,
    Filter,
    Splats,
    TileGrid,
    TileLists,
    check_memory,
    count_tiles,
    list_tiles,
    nearest_first,
    pack_view,
    project,
    write_tiles,
)
from mivol.threads import check_one_thread

NAMES = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")
"""The tensors of a cloud."""

ENTRY_BYTES = 4 * (4 + LANES * PIXELS // CHUNK)
"""Memory of an entry of a list: the entry, its sorting, and T of the tile once in ``CHUNK`` entries."""

SMALL_LISTS = 1 << 26
"""Memory of lists [byte] up to which it is not compared with the free memory."""


@dataclass(frozen=True, eq=False)
class SplatterCache:
    """Intermediate results of an image for its derivatives; valid until the splatter draws the next image."""

    cloud: Cloud
    view: mi.Float
    shapes: Mapping[str, tuple[int, ...]]
    shape: mi.Float
    rest: mi.Float
    lists: Lists
    frame: Frame
    chunks: mi.UInt32
    visible: np.ndarray
    radius: np.ndarray


@dataclass(frozen=True, eq=False)
class ScreenStatistics:
    """Statistics of an image for density control.

    Attributes:
        visible: (N,) bool, listed in at least one tile.
        d_mean2d: (N,) norm of the derivative by the projected mean [1/pixel].
        radius: (N,) three standard deviations along the longer axis of the ellipse [pixel]; 0 for an invisible Gaussian.
    """

    visible: np.ndarray
    d_mean2d: np.ndarray
    radius: np.ndarray


def to_tensors(gaussians: Gaussians) -> dict[str, mi.TensorXf]:
    """The tensors of a cloud by name, for :meth:`Splatter.forward`."""
    return {name: mi.TensorXf(getattr(gaussians, name)) for name in NAMES}


class Splatter:
    """Draws clouds of Gaussians by tile-based EWA splatting, with derivatives.

    Args:
        width, height: size of the image [pixel].
        degree: degree of the harmonics, 0 to 9.
        low_pass: variance added to every ellipse [pixel^2 of the judged image].
        judged_width: width at which images are judged [pixel], by default the width of the image. The low-pass filter belongs
            to this resolution, so a fit at a lower resolution learns no blur.
        compensated: keep the integral of alpha under the low-pass filter (mip-splatting), instead of its peak.
        depth: add the expected depth, multiplied by alpha, as a channel between rgb and alpha.
        median: replace the expected depth by the depth of the splat at which the transmittance falls below a half; 0 if more
            light passes all splats. Such images have no derivatives.
        discs: draw a splat as the inside of its ellipse of one standard deviation, a point of a given radius; each pixel gets
            the covered share of its area. Such images have no derivatives.
        near: least depth of the mean of a drawn Gaussian [length]. A Gaussian reaching across the camera is drawn if its mean
            is in front of this plane.
        sheen: factor on all harmonics but the constant one. A fit that stores harmonics divided by the factor gives them a
            learning rate smaller by the factor.
        least_alpha: a splat is skipped in pixels where its alpha is below this number.

    Raises:
        MivolError: an impossible size, degree or filter, or a Mitsuba variant that does not compile.

    Example:
        >>> gaussians = mivol.read_gaussians("biker.ply")
        >>> image, _ = Splatter(800, 800, gaussians.degree).forward(to_tensors(gaussians), camera)
    """

    def __init__(
        self,
        width: int,
        height: int,
        degree: int,
        *,
        low_pass: float = 0.3,
        judged_width: int | None = None,
        compensated: bool = False,
        depth: bool = False,
        median: bool = False,
        discs: bool = False,
        near: float = 0.01,
        sheen: float = 1.0,
        least_alpha: float = 1 / 255,
    ) -> None:
        _check_variant()
        _check_settings(width, height, degree, low_pass, near, sheen, least_alpha)
        self.size, self.degree, self.depth, self.compensated = (width, height), degree, depth or median, compensated
        self.median, self.discs = median, discs
        self.channels = 5 if depth or median else 4
        columns, rows = -(-width // TILE), -(-height // TILE)
        self.n_tiles = columns * rows
        scale = 1 if judged_width is None else width / judged_width
        self._filter = Filter(*(dr.opaque(mi.Float, value) for value in (low_pass * scale**2, near, sheen)))
        self._grid = TileGrid(dr.opaque(mi.Int32, columns), dr.opaque(mi.Int32, rows), dr.opaque(mi.Float, least_alpha))
        self._width, self._height = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
        self._project = RecordedKernel(_trace_projection, degree, compensated)
        self._write, self._composite = RecordedKernel(write_tiles), RecordedKernel(composite)
        self._project_adjoint = RecordedKernel(_trace_adjoint, degree, compensated)
        # A recording holds the size of the target and of the copies of it that each thread adds to.
        self._composite_adjoints: dict[tuple[int, int], Callable[..., Adjoint]] = {}

    def __repr__(self) -> str:
        return f"Splatter({self.size[0]} x {self.size[1]}, degree {self.degree})"

    def forward(
        self, reals: Mapping[str, mi.TensorXf], camera: Camera, derivatives: bool = True
    ) -> tuple[mi.TensorXf, SplatterCache]:
        """Draw a cloud.

        Args:
            reals: the tensors of the cloud by name; no derivatives are tracked through them.
            camera: a pinhole of the size of the splatter.
            derivatives: whether :meth:`backward` will be called; False saves memory.

        Returns:
            The image (height, width, 4 or 5), and the cache for its derivatives.

        Raises:
            MivolError: tensors of the wrong shape, NaN or a quaternion without direction in them, a camera of another size or
                with a distorting lens, or lists that do not fit into memory.
        """
        check_one_thread()
        shapes = _checked_shapes(reals, self.degree)
        cloud = Cloud(*[ensure_aligned(dr.detach(reals[name].array)) for name in NAMES])
        view = pack_view(camera, self.size)
        n = shapes["means"][0]
        if n == 0:
            return self._nothing(cloud, view, shapes)
        shape, rest, depth, faulty, count, radius = self._project(
            cloud, view, self._filter, self._grid, _opaque_zeros(8 * n), _opaque_zeros(2 * n)
        )
        _check_faults(np.array(faulty))
        counts = np.array(count)
        lists = self._list(shape, np.array(depth), counts)
        frame = self._frame(lists, derivatives)
        image, chunks, frame.transmittance = self._composite((shape, rest), lists, self._grid, frame)
        visible = counts > 0
        cache = SplatterCache(
            cloud, view, shapes, shape, rest, lists, frame, chunks, visible, np.where(visible, np.array(radius), 0)
        )
        return self._tensor(image), cache

    def backward(
        self, cache: SplatterCache, d_image: mi.TensorXf, pose: bool = True
    ) -> tuple[dict[str, mi.TensorXf], ScreenStatistics]:
        """The derivatives of a number L by every input of an image.

        Args:
            cache: from :meth:`forward`.
            d_image: derivative of L by each number of the image, of the shape of the image.
            pose: whether to return the derivatives by the camera.

        Returns:
            The derivatives by name, of the shapes of the tensors of the cloud. On request also "pose" (6,): derivatives by a
            small motion of the camera, a rotation vector about its place in the axes of the world [1/rad] and a translation in
            the world [1/length]. The second result is the statistics of the screen.

        Raises:
            MivolError: a derivative of another shape, or an image drawn without derivatives, with a median depth or of discs.
        """
        if tuple(d_image.shape) != (self.size[1], self.size[0], self.channels):
            raise MivolError(
                f"Found a derivative of shape {tuple(d_image.shape)}, expected the image's "
                f"{(self.size[1], self.size[0], self.channels)}."
            )
        if self.median or self.discs:
            kind = "of discs, which have" if self.discs else "with the median depth, which has"
            raise MivolError(f"Found an image {kind} no derivatives: make a Splatter of Gaussians with depth=True instead.")
        if not cache.frame.remembers:
            raise MivolError("Found an image drawn with derivatives=False: draw it again with derivatives=True.")
        n = cache.shapes["means"][0]
        if n == 0:
            gradient = {name: dr.zeros(mi.TensorXf, shape) for name, shape in cache.shapes.items()}
            nothing = np.zeros(0, np.float32)
            gradient |= {"pose": dr.zeros(mi.TensorXf, (6,))} if pose else {}
            return gradient, ScreenStatistics(np.zeros(0, bool), nothing, nothing)
        zeros = _opaque_zeros(8 * _capacity(n)), _opaque_zeros(2 * _capacity(n))
        adjoint = Adjoint(dr.detach(d_image.array), cache.chunks, *zeros)
        size = _capacity(n), dr.thread_count()
        if size not in self._composite_adjoints:
            self._composite_adjoints[size] = RecordedKernel(composite_adjoint)
        adjoint = self._composite_adjoints[size]((cache.shape, cache.rest), cache.lists, self._grid, cache.frame, adjoint)
        target = Cloud(*[_opaque_zeros(int(np.prod(cache.shapes[name]))) for name in NAMES])
        d_cloud, by_pose, d_mean2d = self._project_adjoint(cache.cloud, cache.view, self._filter, adjoint, target)
        gradient = {name: mi.TensorXf(getattr(d_cloud, name), cache.shapes[name]) for name in NAMES}
        if pose:
            gradient["pose"] = mi.TensorXf(np.array([np.array(d).sum(dtype=np.float64) for d in by_pose], np.float32))
        return gradient, ScreenStatistics(cache.visible, np.array(d_mean2d), cache.radius)

    # -- Lists ---------------------------------------------------------------------------------------------------------------

    def _list(self, shape: mi.Float, depth: np.ndarray, counts: np.ndarray) -> Lists:
        """Lists of tiles, and the order for drawing tiles: the longest list first, so that no core ends late."""
        self._check_room(counts)
        order = nearest_first(depth, np.flatnonzero(counts))
        offsets = np.zeros(len(order) + 1, np.int32)
        np.cumsum(counts[order], out=offsets[1:])
        if len(order):
            target = dr.opaque(mi.Int32, 0, int(offsets[-1]))
            begins = copy_aligned(offsets[:-1].astype(np.uint32))
            tiles = self._write(shape, mi.UInt32(copy_aligned(order)), mi.UInt32(begins), target, self._grid)
            made = list_tiles(np.array(tiles), order, offsets, self.n_tiles)
        else:
            made = TileLists(np.zeros(0, np.uint32), np.zeros(self.n_tiles + 1, np.uint32))
        lengths = np.diff(made.starts)
        chunks = np.zeros(self.n_tiles + 1, np.uint32)
        np.cumsum(-(-lengths.astype(np.int64) // CHUNK), out=chunks[1:])
        tiles = np.argsort(-lengths.astype(np.int64), kind="stable").astype(np.uint32)
        entries = made.entries if len(made.entries) else np.zeros(1, np.uint32)
        return Lists(*[mi.UInt32(copy_aligned(a)) for a in (entries, made.starts, chunks, tiles)])

    def _check_room(self, counts: np.ndarray) -> None:
        total = int(counts.sum(dtype=np.int64))
        needed = total * ENTRY_BYTES
        # Asking for the free memory takes a tenth of the host's time of a small step.
        free = free_memory() if needed > SMALL_LISTS else None
        check_memory(needed, free, total, f"{int((counts > 0).sum()):,} Gaussians are visible")

    def _frame(self, lists: Lists, derivatives: bool) -> Frame:
        width, height = self.size
        n_chunks = int(lists.chunks[self.n_tiles]) if derivatives else 0
        transmittance = _opaque_zeros(max(n_chunks, 1) * LANES * PIXELS)
        image = _opaque_zeros(width * height * self.channels)
        return Frame(self._width, self._height, image, transmittance, self.depth, self.median, derivatives, self.discs)

    def _nothing(
        self, cloud: Cloud, view: mi.Float, shapes: Mapping[str, tuple[int, ...]]
    ) -> tuple[mi.TensorXf, SplatterCache]:
        """The image of a cloud without Gaussians."""
        nothing, empty = mi.Float(), np.zeros(0, np.float32)
        lists = Lists(mi.UInt32(), mi.UInt32(), mi.UInt32(), mi.UInt32())
        frame = Frame(self._width, self._height, nothing, nothing, self.depth, self.median, True, self.discs)
        cache = SplatterCache(cloud, view, shapes, nothing, nothing, lists, frame, mi.UInt32(), np.zeros(0, bool), empty)
        return dr.zeros(mi.TensorXf, (self.size[1], self.size[0], self.channels)), cache

    def _tensor(self, image: mi.Float) -> mi.TensorXf:
        return mi.TensorXf(image, (self.size[1], self.size[0], self.channels))


# -- Recorded functions --------------------------------------------------------------------------------------------------


def _trace_projection(
    degree: int,
    compensated: bool,
    cloud: Cloud,
    view: mi.Float,
    filtering: Filter,
    grid: TileGrid,
    shape: mi.Float,
    rest: mi.Float,
) -> tuple:
    splats = project(cloud.split(degree), DeviceCamera.unpack(view), filtering, degree, compensated)
    index = dr.arange(mi.UInt32, dr.width(splats.x))
    drawn = splats.drawn & ~splats.faulty
    dr.scatter(shape, mi.ArrayXf(splats.shape()), index)
    dr.scatter(rest, mi.ArrayXf(splats.rest()), index)
    dr.eval(shape, rest, drawn)
    return shape, rest, splats.depth, splats.faulty, count_tiles(shape, drawn, grid), _radius(splats)


def _trace_adjoint(
    degree: int, compensated: bool, cloud: Cloud, view: mi.Float, filtering: Filter, adjoint: Adjoint, target: Cloud
) -> tuple[Cloud, list[mi.Float], mi.Float]:
    parts, looking = cloud.split(degree), DeviceCamera.unpack(view)
    # A motion for each Gaussian: Dr.Jit would add up the derivatives by a single one at each step of the formula.
    nothing = mi.Float(dr.arange(mi.UInt32, dr.width(cloud.opacity_logits)) & 0)
    looking.turn, looking.shift = mi.Vector3f(nothing), mi.Vector3f(nothing)
    dr.enable_grad(parts, looking.turn, looking.shift)
    splats = project(parts, looking, filtering, degree, compensated)
    derivatives = _derivatives(splats, adjoint.shape, adjoint.rest)
    values = [*splats.shape(), *splats.rest()]
    dr.backward(sum(dr.select(splats.drawn, dr.detach(d) * v, 0) for d, v in zip(derivatives, values, strict=True)))
    target.write(dr.grad(parts))
    pose = [*dr.grad(looking.turn), *dr.grad(looking.shift)]
    return target, pose, dr.sqrt(dr.square(derivatives[0]) + dr.square(derivatives[1]))


def _opaque_zeros(size: int) -> mi.Float:
    """Zeros in memory, a number unknown to kernels."""
    return dr.opaque(mi.Float, 0, size)


def _capacity(n: int) -> int:
    """Room for derivatives of Gaussians: the size of this array is part of the kernel."""
    return max(4096, 1 << (n - 1).bit_length())


def _derivatives(splats: Splats, d_shape: mi.Float, d_rest: mi.Float) -> list[mi.Float]:
    """Derivatives by the ten numbers of each splat, from the sums of compositing."""
    index = dr.arange(mi.UInt32, dr.width(splats.x))
    x, y, xx, xy, yy, opacity, red, green = dr.gather(mi.ArrayXf, d_shape, index, shape=(8, dr.width(index)))
    blue, depth = dr.gather(mi.ArrayXf, d_rest, index, shape=(2, dr.width(index)))
    ln2 = float(np.log(2))
    a, b, c = (dr.detach(v) for v in (splats.xx, splats.xy, splats.yy))
    d_x, d_y = -ln2 * (2 * a * x + b * y), -ln2 * (2 * c * y + b * x)
    return [d_x, d_y, ln2 * xx, ln2 * xy, ln2 * yy, opacity, red, green, blue, depth]


def _radius(splats: Splats) -> mi.Float:
    """Three standard deviations along the longer axis [pixel]."""
    mean, half = 0.5 * (splats.xx + splats.yy), 0.5 * (splats.xx - splats.yy)
    # Eigenvalues of the exponent's matrix are EXP2 / variance; the one nearest to 0 belongs to the longer axis.
    nearest = mean + dr.sqrt(half * half + 0.25 * splats.xy * splats.xy)
    return 3 * dr.sqrt(EXP2 * dr.rcp(dr.minimum(nearest, -1e-30)))


def _check_variant() -> None:
    if mi.variant() is None or not mi.variant().endswith("_ad_rgb") or mi.variant().startswith("scalar"):
        raise MivolError(
            f"Found the variant {mi.variant()}, expected one that compiles: call mi.set_variant('llvm_ad_rgb') or "
            "'cuda_ad_rgb' first."
        )


def _check_settings(
    width: int, height: int, degree: int, low_pass: float, near: float, sheen: float, least_alpha: float
) -> None:
    if min(width, height) < 1 or max(width, height) > 1 << 15:
        raise MivolError(f"Found an image of {width} x {height} pixels, expected 1 to {1 << 15} along each edge.")
    if not 0 <= degree <= 9:
        raise MivolError(f"Found harmonics of degree {degree}, expected 0 to 9.")
    if not 0 < low_pass < np.inf:
        raise MivolError(f"Found low_pass = {low_pass:g}, expected a variance above 0 in pixels^2 (0.3 is usual).")
    if not 0 < near < np.inf:
        raise MivolError(f"Found near = {near:g}, expected a depth above 0.")
    if not 0 < sheen < np.inf:
        raise MivolError(f"Found sheen = {sheen:g}, expected a factor above 0 (1 leaves harmonics unchanged).")
    if not 0 < least_alpha < 1:
        raise MivolError(f"Found least_alpha = {least_alpha:g}, expected a number between 0 and 1 (1/255 is usual).")


def _checked_shapes(reals: Mapping[str, mi.TensorXf], degree: int) -> dict[str, tuple[int, ...]]:
    missing = [name for name in NAMES if name not in reals]
    if missing:
        raise MivolError(f"Found no tensor {', '.join(missing)} of the cloud, expected {', '.join(NAMES)}.")
    n = reals["means"].shape[0]
    expected = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,)}
    expected["harmonics"] = (n, (degree + 1) ** 2, 3)
    for name, shape in expected.items():
        if tuple(reals[name].shape) != shape:
            raise MivolError(f"Found {name} of shape {tuple(reals[name].shape)}, expected {shape} for degree {degree}.")
    return expected


def _check_faults(faulty: np.ndarray) -> None:
    at = np.flatnonzero(faulty)
    if len(at):
        raise MivolError(
            f"Gaussian {at[0]}{f' and {len(at) - 1} others' if len(at) > 1 else ''}: found NaN, or a quaternion that is 0 or "
            "infinite, expected numbers and a direction: take these Gaussians out."
        )
