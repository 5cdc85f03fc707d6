"""Where Mitsuba 3.9.1 cannot be the judge: the cases in which its ``volpath`` is known to be wrong.

Conventions. A doubt is fatal where the image is wrong, and a remark where it is right but may surprise, or is slightly
off. Every case was reproduced on the 3.9.1 wheel; tests/conformance/test_reference.py shows each still wrong, so that a
release that mends one is noticed. Extinction that differs between channels is no doubt here:
:func:`mivol.validate.reference.render_reference` renders it one channel at a time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import mitsuba as mi
import numpy as np

from mivol.scene.nesting import bounds, nesting_fault
from mivol.validate.medium_shapes import RESTART, MediumShape, number, read_medium_shape

__all__ = ["CHECKS", "Doubt", "trust"]

# exp(-x) is 0 in float32 (denormals flushed) from 87.3: the density of passing untouched, by which Mitsuba divides.
DEEPEST = 87.0

# Mean cosine of `hg` samples, measured: -0.41 at g = 1e-7, -0.029 at 1e-6; the error falls as 1/g.
SMALLEST_G = 1e-3

# Mitsuba's shadow rays end math::ShadowEpsilon, 10 RayEpsilon, of their length before an emitter: nearer to it than this, times
# (1 + max|p|), one that starts anew at a boundary reaches behind its surface, and is dark.
NEAR_EMITTER = 0.1

TOUCHES = 512
"""Those of them that are looked at for another boundary."""

# The smallest share of the light that is worth a word: below the noise of most references.
SMALLEST_SKIN = 2e-3


@dataclass(frozen=True)
class Doubt:
    """One reason not to believe an image of Mitsuba's.

    Attributes:
        kind: key of ``CHECKS``.
        sentence: what was found, what Mitsuba makes of it, the way out.
        fatal: the image would be wrong.
    """

    kind: str
    sentence: str
    fatal: bool = True


def trust(scene: mi.Scene, sensors: Sequence[mi.Sensor] | None = None) -> list[Doubt]:
    """Every reason not to believe what Mitsuba 3.9.1 renders of a scene.

    Args:
        scene: the scene.
        sensors: the cameras that will look at it; by default its own.
    """
    boundaries = [read_medium_shape(s) for s in scene.shapes() if s.interior_medium() is not None]
    doubts = [Doubt(kind, *found) for kind, check in CHECKS.items() for b in boundaries for found in check(b)]
    doubts += [Doubt("touching", _touching(a, b)) for a, b in combinations(boundaries, 2) if _touch(a, b)]
    fault = nesting_fault(scene)
    doubts += [Doubt("overlap", fault)] if fault is not None else []
    emitting = [s for s in scene.shapes() if s.is_emitter()]
    doubts += [Doubt("near emitter", *found) for shape in emitting for b in boundaries for found in _near_emitter(shape, b)]
    for sensor in scene.sensors() if sensors is None else sensors:
        doubts += [Doubt("camera inside", sentence) for sentence in _camera_inside(sensor, boundaries)]
        doubts += [Doubt("sampler", SAMPLER)] if boundaries and sensor.sampler().class_name() == "LowDiscrepancySampler" else []
    return doubts


# -- The checks -----------------------------------------------------------------------------------

Found = Iterator[tuple[str, bool]]


def _not_finite(b: MediumShape) -> Found:
    if not np.isfinite(b.majorant) or b.majorant < 0:
        yield (
            f"the extinction inside {b.name} has {b.majorant} as its largest value; its voxels must be finite and not negative."
        ), True


def _rotated(b: MediumShape) -> Found:
    linear = [np.abs(to_local[:3, :3]) for to_local in b.grids if b.overhang(to_local)]
    if any(np.any(np.sort(m, axis=1)[:, :2] > 1e-5 * m.max(axis=1, keepdims=True)) for m in linear):
        yield (
            f"the grid inside {b.name} is rotated or sheared and {b.name} is larger than the grid's own box: Mitsuba fills the "
            "grid's upright bounding box with clamped values; make the boundary the grid's own box."
        ), True


def _too_deep(b: MediumShape) -> Found:
    depth = b.majorant * b.diagonal
    if b.overhangs and depth > DEEPEST:
        yield (
            f"{b.name} is larger than the box of its grid, and the largest extinction times its diagonal is {depth:.3g}, above "
            f"{DEEPEST:g}: Mitsuba shows 0 where a ray misses the grid (issue 336); make the boundary the grid's own box."
        ), True


def _constant_box(b: MediumShape) -> Found:
    if b.volume == "ConstVolume" and b.overhangs:
        yield (
            f"the heterogeneous medium inside {b.name} has a constant extinction, which Mitsuba puts into the unit cube of the "
            f"constvolume only, not into all of {b.name}; use the medium homogeneous if all of it was meant."
        ), False


def _mirrored(b: MediumShape) -> Found:
    turned = b.to_world is not None and np.linalg.det(b.to_world[:3, :3]) < 0
    if b.faces is not None:
        p, q, r = (b.points[b.faces[:, i]] - b.points.mean(axis=0) for i in range(3))
        turned = np.einsum("ij,ij->", p, np.cross(q, r)) < 0
    if turned:
        yield (
            f"the normals of {b.name} point inwards (a mirroring to_world?), so that Mitsuba has the medium outside; "
            "mirror the grid, not the shape."
        ), True


def _wrong_inverse(b: MediumShape) -> Found:
    if b.to_local is None or b.to_local_inverse is None:
        return
    # 1e-4: both are printed with 6 digits.
    product = b.to_local @ b.to_local_inverse.T
    if np.abs(product - np.eye(4)).max() > 1e-4 * max(1.0, np.abs(b.to_local).max() * np.abs(b.to_local_inverse).max()):
        yield (
            f"the transform of the volume inside {b.name} and Mitsuba's inverse of it do not match (a rotation axis of length "
            "other than 1?); normalise the axis."
        ), True


def _small_g(b: MediumShape) -> Found:
    g = number(b.params.get("phase_function.g", 0.0))
    if 0 < abs(g) < SMALLEST_G and not _is_black(b):
        yield (
            f"the phase function inside {b.name} is hg with g = {g:.2g}: the mean cosine of Mitsuba's samples is off by about "
            "3e-8/g; use the isotropic phase function."
        ), False


def _microflakes(b: MediumShape) -> Found:
    if any(re.search(r"^phase_function.*\bS\.", key) for key in b.params) and not _is_black(b):
        yield (
            f"the phase function inside {b.name} has microflakes (sggx), and Mitsuba draws their directions from another "
            "density than it divides by; light them by emitters of one position or direction, or use another phase function."
        ), True


def _is_black(b: MediumShape) -> bool:
    albedo = [np.asarray(v) for k, v in b.params.items() if k.startswith(("albedo", "sigma_s"))]
    return bool(albedo) and all(np.all(v == 0) for v in albedo)


def _emission(b: MediumShape) -> Found:
    key = next((k for k in b.params if k.startswith("emission")), None)
    if key is not None and np.any(np.asarray(b.params[key]) != 0):
        yield f"the medium inside {b.name} emits light, which Mitsuba's integrators do not render; set its emission to 0.", True


def _thick_skin(b: MediumShape) -> Found:
    if b.skin > SMALLEST_SKIN and not _is_black(b):
        yield (
            f"the medium inside {b.name} is dense where it touches it: Mitsuba starts rays a little behind the surface where "
            f"they enter, and loses about {b.skin:.1%} of the light that comes back head-on, more aslant; leave the outermost "
            "voxels empty, or allow for that much."
        ), False


CHECKS: dict[str, Callable[[MediumShape], Found]] = {
    "not finite": _not_finite,
    "rotated grid": _rotated,
    "too deep": _too_deep,
    "constant box": _constant_box,
    "mirrored": _mirrored,
    "wrong inverse": _wrong_inverse,
    "small g": _small_g,
    "microflakes": _microflakes,
    "emission": _emission,
    "thick skin": _thick_skin,
}


def _touch(a: MediumShape, b: MediumShape) -> bool:
    """Whether part of one's surface lies on the other's: a point that passes the one changes sides of the other as well."""
    return _lies_on(a, b) or _lies_on(b, a)


def _lies_on(a: MediumShape, b: MediumShape) -> bool:
    p = a.surface[:TOUCHES]
    out = p - a.points.mean(axis=0)
    step = RESTART * (1 + np.abs(p).max(axis=1, keepdims=True)) * out / np.linalg.norm(out, axis=1, keepdims=True)
    near = np.all((p >= b.points.min(axis=0) - np.abs(step)) & (p <= b.points.max(axis=0) + np.abs(step)), axis=1)
    changes = sum(b.holds(q + s) != b.holds(q - s) for q, s in zip(p[near], step[near], strict=True))
    return changes >= 0.01 * len(p)


def _touching(a: MediumShape, b: MediumShape) -> str:
    return (
        f"{a.name} and {b.name} touch: Mitsuba starts rays a little behind the surface they leave, and so inside the other "
        "without having entered its medium, which is then vacuum; leave a gap of a thousandth of the scene, or make one grid "
        "of both."
    )


SAMPLER = (
    "the camera's sampler is ldsampler, some of whose dimensions depend on each other (correlations of 0.24): Mitsuba's free "
    "flights, which draw many numbers a path, are off by percents; use the independent or the multijitter sampler."
)


def _near_emitter(shape: mi.Shape, b: MediumShape) -> Found:
    near, far = (np.array(v, np.float64) for v in bounds(shape))
    low, high = b.points.min(axis=0), b.points.max(axis=0)
    reach = NEAR_EMITTER * (1 + np.abs([near, far, low, high]).max())
    gap = np.linalg.norm(np.maximum(0, np.maximum(near - high, low - far)))
    if 0 < gap < reach:
        whole = float(np.linalg.norm(np.maximum(far, high) - np.minimum(near, low)))
        yield (
            f"the emitter {shape.id() or shape.class_name()} is {gap:.2g} from {b.name}: Mitsuba's shadow rays that leave a "
            f"boundary within about {reach:.2g} of a emitter end behind its surface, and are dark; move it away, or make "
            f"the scene {reach / gap:.0f} times as large.",
            whole < 2 * reach,
        )


def _camera_inside(sensor: mi.Sensor, boundaries: list[MediumShape]) -> Iterator[str]:
    if sensor.get_medium() is not None:
        return
    origin = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)[:3, 3]
    for b in boundaries:
        if b.holds(origin):
            yield (
                f"the camera at {np.round(origin, 4).tolist()} is inside {b.name}, and Mitsuba starts its paths in vacuum; "
                'give the sensor the medium that it is in (<ref name="medium" .../>).'
            )


