"""Gaussians as an extinction with colours, for rays: parameters, packed rows, and lists of Gaussians by cell.

Conventions. Parameters are the pre-images of the activations, with the names of :mod:`mivol.points.gaussians`: "means" (N, 3),
"log_scales" (N, 3), "quaternions" (N, 4), "opacity_logits" (N,), and optionally "harmonics" (N, K, 3), the colours
(:mod:`mivol.fields.harmonics`). :mod:`mivol.fields.gaussian_line` has the extinction of a Gaussian along a line; extinctions
add. A Gaussian ends ``REACH`` standard deviations from its mean.

Low-pass. Splatting widens each Gaussian in the image, by 0.3 pixel^2 in published files, and keeps its opacity. Fitted
Gaussians are often far thinner than 0.3 pixel^2 and look right only with this filter. ``blur`` b is the same filter in space:
the covariance becomes S + b^2 I. At a distance z from a camera of focal length f [pixel] it equals the filter of the image for
b = sqrt(0.3) z / f (a 3D filter as in Yu et al., Mip-Splatting, 2024, without their compensation of the opacity).

Limits. An opacity above ``MAX_OPACITY`` counts as ``MAX_OPACITY`` (1 would be an infinite extinction). A scale below
``MIN_RELATIVE_SCALE`` of the box counts as this scale (float32 resolves no smaller distance). Clipped values have derivative 0.

Cells. A ray reads only the lists of the cells along its path. The box of the cells lies along the world axes and holds every
Gaussian up to ``REACH`` standard deviations. Planes across each axis divide it into cells, with equal numbers of means between
neighbouring planes: a fit of photographs has most Gaussians in a hundredth of the box, and others as far as the sky. Cells are
numbered with x fastest. A list holds each Gaussian whose ellipsoid touches the cell, and may hold more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.gaussian_line import REACH, ROW_SIZE, WhitenedLine, intersect_gaussian, read_row
from mivol.fields.harmonics import SPACES, harmonic_degree, local_frame, pack_harmonics, rotate_direction
from mivol.fields.protocol import EXACT_LINE
from mivol.machine import check_memory
from mivol.points.gaussian_files import read_gaussians
from mivol.points.gaussians import Gaussians
from mivol.space import check_affine

EXTINCTION_PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits")
"""Parameters of the extinction."""

HARMONICS = "harmonics"
"""Parameter of the colours."""

MAX_OPACITY = 0.999
"""Larger opacities count as this opacity, an optical depth of 6.9; an opacity of 1 would be an infinite extinction."""

MIN_RELATIVE_SCALE = 1e-6
"""Smallest standard deviation, in edges of the box."""


class GaussianField:
    """A sum of Gaussians of extinction [1/length] (:class:`mivol.fields.protocol.Field`).

    Args:
        tensors: parameters by name.
        place: (4, 4) affine map of the Gaussians to the world; opacities do not change.
        space: meaning of colours: "srgb" (code values, as in published files) or "linear" (radiance).
        blur: b, standard deviation of the low-pass filter [length of the cloud].

    Raises:
        MivolError: parameters that no Gaussian can have (the message names the first index), lists larger than the free memory,
            another space, or a negative blur.

    Attributes:
        lists: Gaussians of each cell.
        starts, entries: the lists as device arrays.
        grid: the planes between the cells.
        flat: rows of the Gaussians, detached, for a scale of 1.
    """

    line = EXACT_LINE
    channels = 1

    def __init__(self, tensors: Mapping[str, mi.TensorXf], place: np.ndarray, space: str = "srgb", blur: float = 0.0) -> None:
        if not 0 <= blur < math.inf:
            raise MivolError(f"the blur of Gaussians is {blur:.4g}; a finite length of at least 0 is expected.")
        if space not in SPACES:
            raise MivolError(f"the space of the colours of Gaussians is {space!r}; {' or '.join(SPACES)} is expected.")
        self.tensors, self.place, self.space, self.blur = dict(tensors), check_affine(place), space, blur
        self.refresh()

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians, place: np.ndarray, space: str = "srgb", blur: float = 0.0) -> GaussianField:
        """Make a field of Gaussians."""
        return cls(
            {name: mi.TensorXf(getattr(gaussians, name)) for name in (*EXTINCTION_PARAMETERS, HARMONICS)}, place, space, blur
        )

    @classmethod
    def from_props(cls, props: mi.Properties) -> GaussianField:
        """Make a field from plugin parameters: ``filename`` or tensors; ``to_world``, ``space`` and ``blur``.

        The tensors are those in :data:`EXTINCTION_PARAMETERS`, and optionally the harmonics.

        Raises:
            MivolError: both sources or none, missing tensors, or numbers that no Gaussian can have.
        """
        place = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)
        tensors = [name for name in (*EXTINCTION_PARAMETERS, HARMONICS) if name in props]
        settings = props.get("space", "srgb"), float(props.get("blur", 0.0))
        if ("filename" in props) == bool(tensors) or (tensors and not set(EXTINCTION_PARAMETERS) <= set(tensors)):
            found = " and ".join([*(["filename"] if "filename" in props else []), *tensors]) or "none of them"
            raise MivolError(
                f"mivol_gaussians was given {found}; give filename, or {', '.join(EXTINCTION_PARAMETERS)} (and {HARMONICS})."
            )
        if tensors:
            return cls({name: mi.TensorXf(props[name]) for name in tensors}, place, *settings)
        return cls.from_gaussians(read_gaussians(str(mi.file_resolver().resolve(props["filename"]))), place, *settings)

    def refresh(self) -> None:
        """List the Gaussians again after changes of parameters. Reads values, which ``dr.freeze`` cannot record."""
        values = {name: np.array(dr.detach(tensor)) for name, tensor in self.tensors.items()}
        values.setdefault(HARMONICS, np.zeros((len(values["means"]), 1, 3), np.float32))
        read = Gaussians(**values).check("Gaussians of a medium")
        means = read.means.astype(np.float64) @ self.place[:3, :3].T + self.place[:3, 3]
        self.least_scale = _find_min_scale(read)
        scales = np.hypot(np.maximum(read.scales().astype(np.float64), self.least_scale), self.blur)
        whitening = np.swapaxes(read.rotations().astype(np.float64), 1, 2) / scales[:, :, None]
        whitening = whitening @ np.linalg.inv(self.place[:3, :3])
        self.lists: CellLists = list_gaussians(means, whitening, REACH)
        depth = -np.log1p(-np.minimum(read.opacities().astype(np.float64), MAX_OPACITY))
        # |W omega| is largest for omega along the shortest axis.
        largest = np.linalg.norm(whitening, ord=2, axis=(1, 2))
        self._bound = self.lists.max_cell_sum(depth * largest) / math.sqrt(2 * math.pi)
        self.starts, self.entries = mi.UInt32(self.lists.starts), mi.UInt32(self.lists.entries)
        # Mitsuba evaluates media inside traced loops, in which no array can be prepared.
        self.grid = PlaneGrid.from_planes(self.lists.planes)
        with dr.suspend_grad():
            self.flat = dr.detach(self.rows(mi.Float(1)))
        dr.eval(self.flat)

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self.tensors["means"].shape[0]

    @property
    def to_world(self) -> np.ndarray:
        """(4, 4) float64, unit cube to the box around all Gaussians."""
        return self.lists.to_world

    def rows(self, scale: mi.Float) -> mi.Float:
        """Rows of the Gaussians (:mod:`mivol.fields.gaussian_line`), attached to the parameters and the scale of a medium."""
        means, log_scales, quaternions = (
            _unpack_columns(self.tensors[name], n) for name, n in zip(EXTINCTION_PARAMETERS, (3, 3, 4), strict=False)
        )
        shift = [[mi.Float(float(v)) for v in row] for row in self.place[:3]]
        mean = [r[0] * means[0] + r[1] * means[1] + r[2] * means[2] + r[3] for r in shift]
        least = dr.opaque(mi.Float, self.least_scale)
        scales = [dr.maximum(dr.exp(s), least) for s in log_scales]
        step = [dr.rcp(dr.sqrt(dr.square(s) + self.blur**2) if self.blur else s) for s in scales]
        back = np.linalg.inv(self.place[:3, :3]).tolist()
        whitening = [
            [step[k] * sum(axis[i] * back[i][j] for i in range(3)) for j in range(3)]
            for k, axis in enumerate(_rotation_axes(quaternions))
        ]
        opacity = dr.minimum(_logistic(self.tensors["opacity_logits"].array), MAX_OPACITY)
        numbers = [*(w for row in whitening for w in row), *mean, opacity, dr.repeat(scale, self.count)]
        return dr.ravel(mi.ArrayXf([*numbers, *(dr.zeros(mi.Float, self.count) for _ in range(ROW_SIZE - len(numbers)))]))

    @property
    def has_colours(self) -> bool:
        """Whether the Gaussians have harmonics."""
        return HARMONICS in self.tensors

    @property
    def degree(self) -> int:
        """Degree of the harmonics."""
        return harmonic_degree(self.tensors[HARMONICS].shape[1])

    def pack_colours(self) -> mi.Float:
        """Harmonics of the Gaussians in blocks (:mod:`mivol.fields.harmonics`), attached to the parameter."""
        return pack_harmonics(self.tensors[HARMONICS], self.degree)

    def eval_basis(self, d: mi.Vector3f) -> list[mi.Float]:
        """Harmonics of unit directions of travel in the world."""
        return dr.sh_eval(rotate_direction(local_frame(self.place), d), self.degree)

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        """Extinction [1/length] at world points for light travelling along ``w``; detached."""

        def add(total: mi.Float, line: WhitenedLine, index: mi.UInt32) -> mi.Float:
            return total + line.density

        return [self.visit_at_points(mi.Ray3f(p, w), active, dr.zeros(mi.Float, dr.width(p)), add)]

    def visit_at_points(self, ray: mi.Ray3f, active: mi.Bool, state: Any, add: Callable[..., Any]) -> Any:
        """Visit the Gaussians that may contain the origins of rays: ``add(state, line, index) -> state``."""
        cell, inside = self.grid.find_cell(ray.o)
        return self.visit_cell(cell, (ray.o, ray.d), inside & active, state, add)

    def visit_cell(
        self, cell: mi.Vector3i, through: tuple[mi.Point3f, mi.Vector3f], on: mi.Bool, state: Any, add: Callable[..., Any]
    ) -> Any:
        """Visit the Gaussians of a cell: ``add(state, line, index) -> state``.

        Args:
            cell: cell of each lane.
            through: a point and the direction of the line.
            on: lanes that visit.
            state: any PyTree of Dr.Jit arrays.
            add: function traced once in the loop; ``line.hits`` marks the lanes that count.
        """
        x, y, _ = self.grid.counts
        number = mi.UInt32((cell.z * y + cell.y) * x + cell.x)
        start, end = (dr.gather(mi.UInt32, self.starts, number + k, on) for k in (0, 1))
        entries, rows = self.entries, self.flat

        def visit(at: mi.UInt32, state: Any) -> tuple[mi.UInt32, Any]:
            index = dr.gather(mi.UInt32, entries, at)
            line = intersect_gaussian(read_row(rows, index), *through)
            return at + 1, add(state, line, index)

        return dr.while_loop((start, state), lambda at, _: on & (at < end), visit, label="Gaussians of a cell")[1]

    def bound(self) -> list[float]:
        """An upper bound of the extinction [1/length]: the largest sum over a cell of the Gaussians' largest values."""
        return [self._bound]

    def parameters(self) -> dict[str, Any]:
        """Parameters by name."""
        return self.tensors


def _unpack_columns(tensor: mi.TensorXf, width: int) -> list[mi.Float]:
    """Columns of a tensor (N, width)."""
    index = dr.arange(mi.UInt32, tensor.shape[0]) * width
    return [dr.gather(mi.Float, tensor.array, index + c) for c in range(width)]


def _rotation_axes(quaternions: list[mi.Float]) -> list[list[mi.Float]]:
    """World axes of each Gaussian: columns of its rotation, for quaternions (w, x, y, z) of any length but 0."""
    inverse = dr.rsqrt(sum((q * q for q in quaternions[1:]), quaternions[0] * quaternions[0]))
    w, x, y, z = (q * inverse for q in quaternions)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ]


def _logistic(logit: mi.Float) -> mi.Float:
    """1 / (1 + exp(-x))."""
    return dr.rcp(1 + dr.exp(-logit))


def _find_min_scale(gaussians: Gaussians) -> float:
    """Smallest standard deviation that counts [length of the cloud]."""
    spread = REACH * np.sqrt(np.diagonal(gaussians.covariances().astype(np.float64), axis1=1, axis2=2))
    return MIN_RELATIVE_SCALE * float(((gaussians.means + spread).max(axis=0) - (gaussians.means - spread).min(axis=0)).max())


# -- Lists of Gaussians by cell --------------------------------------------------------------------------------------------


CELLS_PER_GAUSSIAN = 1.0
"""Cells for each Gaussian: 22^3 cells for 10,000 Gaussians. On a dense cloud of this size line integrals take the same time
(within 10 %) from 0.4 to 8 cells a Gaussian; with 8 the lists take four times as long to make."""

MAX_REACHED = 64.0
"""Mean number of cells that the boxes around the Gaussians may reach into: more cells make the lists long."""

MIN_CELLS, MAX_CELLS = 8, 1 << 21
"""Limits of the number of cells."""

MAX_COUNT = 256
"""Largest number of cells along an axis."""

STEPS = 1 << 16
"""Places of planes along an axis: no cell is thinner than the box divided by this number."""

INNER = (0.05, 0.95)
"""Quantiles of the means between which the cells are nearly cubic."""

SLACK = 1e-3
"""Enlargement of the box and of each cell, in edges; float32 rounding of a ray's position must not lose a Gaussian."""

ROUNDING = 2e-6
"""Enlargement of each cell besides, relative to the largest coordinate: 16 roundings of a position in float32."""

PAIR_BYTES = 120
"""Memory of one pair of cell and Gaussian during the touch test [bytes]."""

ENTRY_BYTES = 12
"""Memory of one list entry while the lists are sorted [bytes]."""


@dataclass(frozen=True)
class CellLists:
    """The Gaussians of each cell.

    Attributes:
        planes: places of the planes across x, y and z [length], increasing, float64 numbers that float32 holds; the first and
            the last of an axis are faces of the box.
        starts: (cells + 1,) uint32; cell c owns the entries from ``starts[c]`` to ``starts[c + 1]``.
        entries: (n,) uint32, numbers of Gaussians.
    """

    planes: list[np.ndarray]
    starts: np.ndarray
    entries: np.ndarray

    @property
    def to_world(self) -> np.ndarray:
        """(4, 4) float64, unit cube to box."""
        to_world = np.diag([*(axis[-1] - axis[0] for axis in self.planes), 1.0])
        to_world[:3, 3] = [axis[0] for axis in self.planes]
        return to_world

    def max_cell_sum(self, values: np.ndarray) -> float:
        """The largest sum over the entries of a cell of ``values`` (N,), one number a Gaussian."""
        sums = np.concatenate([[0.0], np.cumsum(values[self.entries], dtype=np.float64)])
        return float(np.diff(sums[self.starts]).max(initial=0.0))


@dataclass
class PlaneGrid:
    """The planes between cells as device arrays, the same for kernels of any number of planes.

    Attributes:
        planes: places across x, then y, then z [length], increasing along each axis.
        first: index of the first plane of each axis.
        counts: number of cells along each axis.
    """

    planes: mi.Float
    first: list[mi.Int32]
    counts: list[mi.Int32]

    @classmethod
    def from_planes(cls, planes: list[np.ndarray]) -> PlaneGrid:
        """Upload the planes of the three axes."""
        sizes = [len(axis) for axis in planes]
        first = [dr.opaque(mi.Int32, sum(sizes[:a])) for a in range(3)]
        counts = [dr.opaque(mi.Int32, n - 1) for n in sizes]
        return cls(mi.Float(np.concatenate(planes).astype(np.float32)), first, counts)

    def find_cell(self, p: mi.Point3f) -> tuple[mi.Vector3i, mi.Bool]:
        """The cells that hold points, and whether the points lie in the box; other points get the nearest cell."""
        cell, inside = mi.Vector3i(), mi.Bool(True)
        for a, (x, first, count) in enumerate(zip(mi.Point3f(p), self.first, self.counts, strict=True)):
            lies_behind = lambda k, x=x, first=first, count=count: (  # noqa: E731
                (mi.Int32(k) < count) & (dr.gather(mi.Float, self.planes, first + dr.minimum(mi.Int32(k), count)) <= x)
            )
            cell[a] = dr.maximum(mi.Int32(dr.binary_search(0, MAX_COUNT, lies_behind)) - 1, 0)
            inside &= (x >= dr.gather(mi.Float, self.planes, first)) & (x <= dr.gather(mi.Float, self.planes, first + count))
        return cell, inside


def list_gaussians(means: np.ndarray, whitening: np.ndarray, reach: float) -> CellLists:
    """List the Gaussians of each cell of a box around all Gaussians.

    Args:
        means: (N, 3) float64, world [length].
        whitening: (N, 3, 3) float64 [1/length]; W (x - mean) has length 1 at one standard deviation.
        reach: radius of a Gaussian [standard deviations].

    Raises:
        MivolError: no Gaussians, or lists larger than the free memory.
    """
    if not len(means):
        raise MivolError("no Gaussians were given; at least one is expected: without Gaussians rays have nothing to cross.")
    spread = reach * np.sqrt((np.linalg.inv(whitening) ** 2).sum(axis=2))
    low, high = (means - spread).min(axis=0), (means + spread).max(axis=0)
    slack = SLACK * (high - low).max()
    low, high = low - slack, high + slack
    wanted = float(np.clip(CELLS_PER_GAUSSIAN * len(means), MIN_CELLS, MAX_CELLS))
    while True:
        planes = _place_planes(means, low, high, wanted)
        first, last = (
            np.stack([_locate_cells(planes[a], p[:, a]) for a in range(3)], axis=1) for p in (means - spread, means + spread)
        )
        counts = (last - first + 1).prod(axis=1)
        if counts.mean() <= MAX_REACHED or wanted <= MIN_CELLS:
            break
        wanted = max(wanted / 2, MIN_CELLS)
    _check_memory(counts)
    margin = ROUNDING * np.maximum(np.abs(low), np.abs(high))
    touched = [
        _find_touched_cells(index, first[index], last[index], means, whitening, (planes, margin), reach)
        for index in np.split(np.arange(len(means)), find_chunk_starts(counts))
    ]
    cells, entries = (np.concatenate(rows) for rows in zip(*touched, strict=True))
    size = np.array([len(axis) - 1 for axis in planes])
    cells = cells @ np.cumprod([1, *size[:2]])
    order = np.argsort(cells, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=int(size.prod())))])
    return CellLists(planes, starts.astype(np.uint32), entries[order].astype(np.uint32))


def _place_planes(means: np.ndarray, low: np.ndarray, high: np.ndarray, cells: float) -> list[np.ndarray]:
    """Planes across x, y and z, at quantiles of the means, for about the given number of cells."""
    inner = np.diff(np.quantile(means, INNER, axis=0), axis=0)[0]
    edge = np.maximum(inner, SLACK * (high - low).max())
    counts = np.clip(np.rint(edge / (edge.prod() / cells) ** (1 / 3)), 1, MAX_COUNT).astype(int)
    planes = []
    for a, count in enumerate(counts):
        places = np.quantile(means[:, a], np.arange(1, count) / count)
        # Many means in one place would give several planes there.
        steps = np.unique(np.rint((places - low[a]) / (high[a] - low[a]) * STEPS))
        inside = low[a] + steps[(steps > 0) & (steps < STEPS)] / STEPS * (high[a] - low[a])
        planes.append(np.unique(np.float32([low[a], *inside, high[a]])).astype(np.float64))
    return planes


def _locate_cells(planes: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Cells of coordinates along an axis; (N,) int64."""
    return np.clip(np.searchsorted(planes, x, side="right") - 1, 0, len(planes) - 2)


def _find_touched_cells(
    index: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    means: np.ndarray,
    whitening: np.ndarray,
    grid: tuple[list[np.ndarray], np.ndarray],
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of touched cells (n, 3) and Gaussians (n,); ``grid`` holds the planes and the margin around cells [length]."""
    planes, margin = grid
    sizes = last - first + 1
    owner = np.repeat(index, sizes.prod(axis=1))
    cell = np.repeat(first, sizes.prod(axis=1), axis=0) + list_box_nodes(sizes)
    near, far = (np.stack([planes[a][cell[:, a] + k] for a in range(3)], axis=1) for k in (0, 1))
    W = whitening[owner]
    # Largest distance of a point of the cell from its middle, in standard deviations: |W| applied to half the edges.
    size = np.linalg.norm(np.einsum("nij,nj->ni", np.abs(W), (0.5 + SLACK) * (far - near) + margin), axis=1)
    distance = np.linalg.norm(np.einsum("nij,nj->ni", W, (near + far) / 2 - means[owner]), axis=1)
    touches = distance - size <= reach
    return cell[touches], owner[touches]


def _check_memory(counts: np.ndarray) -> None:
    """Refuse lists that exceed the free memory, counting all entries and one chunk of pairs."""
    needed = ENTRY_BYTES * int(counts.sum()) + PAIR_BYTES * (MAX_CHUNK_PAIRS + int(counts.max()))
    what = f"a table of {len(counts)} Gaussians, which reach into {counts.mean():.0f} cells each,"
    check_memory(needed, what, f"remove the widest of them, which reaches into {counts.max()} cells")


MAX_CHUNK_PAIRS = 1 << 21
"""Pairs of nodes and boxes listed at once. A chunk may exceed the limit by one box."""


def list_box_nodes(sizes: np.ndarray) -> np.ndarray:
    """Integer offsets (x, y, z) of all nodes of boxes with the given sizes (n, 3), box by box, each from (0, 0, 0)."""
    counts = sizes.prod(axis=1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x, y = (np.repeat(sizes[:, axis], counts) for axis in (0, 1))
    return np.stack([number % x, number // x % y, number // (x * y)], axis=1)


def find_chunk_starts(counts: np.ndarray) -> np.ndarray:
    """Indices that split a list of boxes, with the given node counts, into chunks of about ``MAX_CHUNK_PAIRS`` nodes."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // MAX_CHUNK_PAIRS)) + 1
