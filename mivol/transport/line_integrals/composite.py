r"""Emission-absorption compositing of all media along a ray, with the tangent and the transpose of the sum.

.. math:: N = \sum_i T_1 \cdots T_{i-1} N_i

A sweep integrates each medium alone: :mod:`mivol.transport.line_integrals.body_sweep`, or for Gaussians
:mod:`mivol.transport.media.gaussian_sweep`. Media are disjoint, so the middles of their intervals give their order along the
ray, and the optical depth of the media in front attenuates each medium.

Conventions. Media in boxes are integrated once and kept in a list. Traced intervals come in the order of the ray, in a loop
that keeps only sums. Rows are channels or colours, followed by the rows of tangents if tangents are followed.

References: Max 1995 (the discrete emission-absorption integral).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import maximum, one_minus_exp
from mivol.transport.line_integrals.body_sweep import BodySweep
from mivol.transport.line_integrals.integrand import LineIntegral, check_cells_shared
from mivol.transport.media.compositing import BodyIntegral, transmittance_of, zeros
from mivol.transport.media.gaussian_sweep import GaussianSweep
from mivol.transport.media.ray_intervals import MediumInterval, find_boxed_intervals, trace_boundaries

__all__ = ["Composite", "composite_ray", "vjp_composite"]


@dataclass
class _BoxedMedium:
    """A medium in a box along a ray.

    Attributes:
        interval: interval of the ray in the medium.
        middle: middle of the interval, which orders the media.
        own: integral of the medium alone.
        front: optical depth in front of the medium.
        attenuated: N of the medium, attenuated to the camera.
        behind: N behind the medium, attenuated to the camera.
    """

    interval: MediumInterval
    middle: mi.Float64
    own: BodyIntegral
    front: list[mi.Float64]
    attenuated: list[mi.Float]
    behind: list[mi.Float]


@dataclass
class _TracedSums:
    """Sums over the traced intervals.

    Attributes:
        tau: optical depth.
        N: sum, attenuated to the camera.
        fronts: for each boxed medium, the optical depth of the traced intervals in front.
        behinds: for each boxed medium, N of the traced intervals behind, attenuated to the camera.
        max_opaque: largest N of an interval if the interval were opaque.
    """

    tau: list[mi.Float64]
    N: list[mi.Float]
    fronts: list[list[mi.Float64]]
    behinds: list[list[mi.Float]]
    max_opaque: mi.Float


@dataclass
class Composite:
    """The sum along a ray, with the parts that the transpose needs.

    Attributes:
        boxes, traced: media in boxes, and sums over traced intervals.
        tau: optical depth [1] of the whole ray, each row (then its tangent).
        last: contribution of the end of the ray, attenuated to the camera.
        N: sum, each row (then its tangent).
    """

    boxes: list[_BoxedMedium]
    traced: _TracedSums
    tau: list[mi.Float64]
    last: list[mi.Float]
    N: list[mi.Float]


def composite_ray(line: LineIntegral, end: list[mi.Float], tangent: bool = False, skip: bool = False) -> Composite:
    """Integrate each medium alone, and composite the media in the order of the ray.

    Args:
        line: line integral.
        end: contribution of the end of the ray, each row, not attenuated.
        tangent: whether to follow tangents, which the media took from the parameters.
        skip: whether to skip empty blocks, which changes the order of sums.

    Raises:
        MivolError: a medium with grids of two resolutions or places, or with an extinction that depends on the direction.

    Cost: a walk of each medium.
    """
    media, integrand, ray_segment = line.media, line.integrand, line.ray_segment
    check_cells_shared(media, integrand)
    rows = integrand.rows * (2 if tangent else 1)

    boxes = []
    for interval in find_boxed_intervals(media, ray_segment.ray, ray_segment.length, line.active):
        middle = interval.middle() if len(media.bodies) > 1 else mi.Float64(0)
        own = make_sweep(line, interval, tangent).integrate(skip)
        boxes.append(_BoxedMedium(interval, middle, own, zeros(mi.Float64, rows), [], zeros(mi.Float, rows)))

    def add_interval(t: _TracedSums, interval: MediumInterval) -> _TracedSums:
        own, middle = make_sweep(line, interval, tangent).integrate(skip), interval.middle()
        attenuated = _multiply_transmittance(_add_rows(t.tau, _tau_in_front(boxes, middle, rows)), own.N, integrand.rows)
        opacity = [one_minus_exp(mi.Float(x)) for x in own.tau[: integrand.rows]]
        means = [dr.select(a > 0, n / dr.select(a > 0, a, 1), 0) for n, a in zip(own.N, opacity, strict=False)]
        return _TracedSums(
            _add_rows(t.tau, own.tau),
            _add_rows(t.N, attenuated),
            [_add_rows(f, _mask_rows(middle < b.middle, own.tau)) for f, b in zip(t.fronts, boxes, strict=True)],
            [_add_rows(g, _mask_rows(middle > b.middle, attenuated)) for g, b in zip(t.behinds, boxes, strict=True)],
            dr.maximum(t.max_opaque, maximum(means)),
        )

    traced = _TracedSums(
        zeros(mi.Float64, rows),
        zeros(mi.Float, rows),
        [zeros(mi.Float64, rows) for _ in boxes],
        [zeros(mi.Float, rows) for _ in boxes],
        mi.Float(0),
    )
    if media.traced:
        ray, medium, passes_null = ray_segment.ray, ray_segment.medium, ray_segment.passes_null
        _, traced = trace_boundaries(media, ray, medium, add_interval, traced, line.active, passes_null)
    return _composite_media(boxes, traced, end, integrand.rows, rows)


def make_sweep(line: LineIntegral, interval: MediumInterval, tangent: bool = False) -> BodySweep | GaussianSweep:
    """The sweep over one medium."""
    if interval.body.view.gaussians is None:
        return BodySweep(line, interval, tangent)
    return GaussianSweep(interval, line.integrand.rows, tangent)


def _composite_media(
    boxes: list[_BoxedMedium], traced: _TracedSums, end: list[mi.Float], channels: int, rows: int
) -> Composite:
    """Find the light in front of and behind each boxed medium, and N of the whole ray."""
    for box, front in zip(boxes, traced.fronts, strict=True):
        box.front = _add_rows(front, _tau_in_front(boxes, box.middle, rows))
        box.attenuated = _multiply_transmittance(box.front, box.own.N, channels)
    total = traced.tau
    for box in boxes:
        total = _add_rows(total, box.own.tau)
    last = _multiply_transmittance(total, end + zeros(mi.Float, rows - channels), channels)
    N = _add_rows(traced.N, last)
    for box, behind in zip(boxes, traced.behinds, strict=True):
        N = _add_rows(N, box.attenuated)
        box.behind = _add_rows(behind, _add_rows(last, _visible_behind(boxes, box.middle, rows)))
    return Composite(boxes, traced, total, last, N)


def vjp_composite(line: LineIntegral, composite: Composite, weight: list[mi.Float], rest: list[mi.Float]) -> None:
    """Add ``weight`` times the derivatives of N to the gradients of the media: the transpose of the tangent.

    The light behind a cell is a sum, not a difference, so a voxel behind an optical depth of 50 gets its derivative of the size
    e^-50. Only the light behind a traced interval is a difference of two sums; it is clamped to the largest value that the
    transmittance in front of the interval allows.

    Args:
        line: line integral of :func:`composite_ray`.
        composite: result of :func:`composite_ray`.
        weight: d loss / d N of each row.
        rest: d loss / d log T of each row, with T the transmittance of the whole ray, for light from behind its end.

    Cost: a walk of each medium, and one packed write of 8 a cell and channel; traced intervals are walked twice.
    """
    media, integrand, ray_segment = line.media, line.integrand, line.ray_segment
    for box in composite.boxes:
        ahead = _add_rows(box.front, box.own.tau)
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, box.behind, rest, strict=True)]
        make_sweep(line, box.interval).vjp(weight, ahead, behind)

    def add_gradients(passed: BodyIntegral, interval: MediumInterval) -> BodyIntegral:
        sweep, middle = make_sweep(line, interval), interval.middle()
        own = sweep.integrate(False)
        front = _add_rows(passed.tau, _tau_in_front(composite.boxes, middle, integrand.rows))
        ahead, N = _add_rows(front, own.tau), _add_rows(passed.N, _multiply_transmittance(front, own.N, integrand.rows))
        P = [transmittance_of(a) for a in ahead]
        near, far = integrand.lower_bound(interval.t1), composite.traced.max_opaque
        remaining = [dr.clip(n - m, p * near, p * far) for n, m, p in zip(composite.traced.N, N, P, strict=True)]
        visible = _add_rows(remaining, _add_rows(composite.last, _visible_behind(composite.boxes, middle, integrand.rows)))
        behind = [dr.fma(w, b, r) for w, b, r in zip(weight, visible, rest, strict=True)]
        sweep.vjp(weight, ahead, behind)
        return BodyIntegral(_add_rows(passed.tau, own.tau), N)

    if media.traced:
        empty = BodyIntegral(zeros(mi.Float64, integrand.rows), zeros(mi.Float, integrand.rows))
        ray, medium, passes_null = ray_segment.ray, ray_segment.medium, ray_segment.passes_null
        trace_boundaries(media, ray, medium, add_gradients, empty, line.active, passes_null)


# -- Rows of media in the order of the ray -----------------------------------------------------------------------------


def _tau_in_front(boxes: list[_BoxedMedium], middle: mi.Float64, rows: int) -> list[mi.Float64]:
    """Optical depth of the boxed media in front of a distance."""
    total = zeros(mi.Float64, rows)
    for box in boxes:
        total = _add_rows(total, _mask_rows(box.middle < middle, box.own.tau))
    return total


def _visible_behind(boxes: list[_BoxedMedium], middle: mi.Float64, rows: int) -> list[mi.Float]:
    """N of the boxed media behind a distance, attenuated to the camera."""
    total = zeros(mi.Float, rows)
    for box in boxes:
        total = _add_rows(total, _mask_rows(box.middle > middle, box.attenuated))
    return total


def _multiply_transmittance(front: list[mi.Float64], N: list[mi.Float], channels: int) -> list[mi.Float]:
    """Rows of N and of its tangent, attenuated by rows of optical depth."""
    P = [transmittance_of(f) for f in front[:channels]]
    attenuated = [p * n for p, n in zip(P, N, strict=False)]
    changes = zip(P, N, N[channels:], front[channels:], strict=False)
    return attenuated + [p * (dn - mi.Float(df) * n) for p, n, dn, df in changes]


def _add_rows(a: list, b: list) -> list:
    return [x + y for x, y in zip(a, b, strict=True)]


def _mask_rows(mask: mi.Bool, rows: list) -> list:
    return [dr.select(mask, row, 0) for row in rows]
