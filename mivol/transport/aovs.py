r"""What a camera ray meets besides radiance: optical depth, opacity, and the mean distance at which it is stopped.

.. math:: \tau = \int \sigma\,dt, \qquad \alpha = 1 - e^{-\tau}, \qquad
          \bar t = \frac{1}{\alpha} \Big( \int t\,\sigma T\,dt + t_s T_s \Big)

Conventions. All is about the first stretch of a ray: from the camera to the first opaque surface (at t_s; alpha is 1 there), or
out of the scene. Optical depth never passes through exp. ``tau`` and ``alpha`` are means over the channels of the
extinction, and so are both sides of the quotient in ``depth``, which is 0 where nothing stops the ray; ``tau.R`` is
``tau`` where the extinction is grey. Rays and surfaces carry no derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import one_minus_exp
from mivol.transport.distance import backproject_distance, integrate_distance, push_distance
from mivol.transport.path import Reach, Way, camera_ray, optical_depth_to, revisit
from mivol.transport.world import Body, World

__all__ = ["AOVS", "backproject_aovs", "integrate_aovs", "push_aovs"]

AOVS = ("tau", "tau.R", "tau.G", "tau.B", "alpha", "depth")
"""Names: optical depth [1] (mean, and of a channel), opacity [1], and mean distance [length]."""


@dataclass
class _First:
    """The first stretch of camera rays: ``tau``, ``T`` and ``alpha`` for each channel (T is 0 behind a surface)."""

    way: Way
    end: Reach
    tau: list[mi.Float]
    T: list[mi.Float]
    alpha: list[mi.Float]


def integrate_aovs(
    scene: mi.Scene, world: World, ray: mi.Ray3f, names: tuple[str, ...], active: mi.Bool = True
) -> list[mi.Float]:
    """Integrate AOVs along camera rays.

    Args:
        scene: Mitsuba's scene.
        world: its media.
        ray: world space, unit direction.
        names: of :data:`AOVS`.
        active: lanes to integrate.

    Returns:
        One number a ray for each name, in their order.

    Raises:
        MivolError: ``depth`` of a medium that sums grids of two resolutions or places.

    Cost: a walk of the first stretch, and another one for ``depth``.
    """
    if not names:
        return []
    first = _go(scene, world, ray, active)
    rows = {"tau": first.tau, "alpha": first.alpha}
    values = {"depth": _depth(scene, world, first, active)[0]} if "depth" in names else {}
    return [values[n] if n in values else _weigh(_shares(n, world.channels), rows[_row(n)]) for n in names]


def push_aovs(
    scene: mi.Scene, world: World, ray: mi.Ray3f, names: tuple[str, ...], active: mi.Bool = True
) -> list[mi.Float]:
    """Tangents of AOVs along that which :meth:`World.start_tangent` took from the parameters.

    Args:
        scene, world, ray, names, active: as :func:`integrate_aovs`.
    """
    if not names:
        return []
    first = _go(scene, world, ray, active)
    rows, values = {}, {}
    if set(names) != {"depth"}:
        rows["tau"] = _push_tau(scene, world, first.way, active)
        rows["alpha"] = [T * d for T, d in zip(first.T, rows["tau"], strict=True)]
    if "depth" in names:
        depth, opacity = _depth(scene, world, first, active)
        dN = push_distance(scene, world, first.way, first.end, depth, active)
        values["depth"] = dN * _inverse(opacity)
    return [values[n] if n in values else _weigh(_shares(n, world.channels), rows[_row(n)]) for n in names]


def backproject_aovs(
    scene: mi.Scene, world: World, ray: mi.Ray3f, names: tuple[str, ...], daovs: list[mi.Float], active: mi.Bool = True
) -> None:
    """Add the derivatives of AOVs, weighted by ``daovs``, to the gradients of the world.

    Args:
        scene, world, ray, names, active: as :func:`integrate_aovs`.
        daovs: d loss / d AOV of each ray, in the order of ``names``.
    """
    if not names:
        return
    first = _go(scene, world, ray, active)
    weight = [mi.Float(0) for _ in range(world.channels)]
    for name, d in zip(names, daovs, strict=True):
        if name != "depth":
            slopes = first.T if _row(name) == "alpha" else [1] * world.channels
            weight = [w + d * s * T for w, s, T in zip(weight, _shares(name, world.channels), slopes, strict=True)]
    if set(names) != {"depth"}:
        _pull_tau(scene, world, first.way, weight, active)
    for name, d in zip(names, daovs, strict=True):
        if name == "depth":
            depth, opacity = _depth(scene, world, first, active)
            backproject_distance(scene, world, first.way, first.end, depth, d * _inverse(opacity), active)


def _go(scene: mi.Scene, world: World, ray: mi.Ray3f, active: mi.Bool) -> _First:
    """Carry rays to the first opaque surface or out of the scene."""
    ray = camera_ray(ray)
    medium = world.medium_at(scene, ray)
    end, tau = optical_depth_to(scene, world, ray, medium, mi.Bool(active))
    stopped = end.si.is_valid()
    T = [dr.select(stopped, 0, dr.exp(-t)) for t in tau]
    alpha = [dr.select(stopped, 1, one_minus_exp(t)) for t in tau]
    return _First(Way(ray, medium, end.t), end, tau, T, alpha)


def _depth(scene: mi.Scene, world: World, first: _First, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """The mean distance, and the opacity that it is a mean over."""
    N, opacity = integrate_distance(scene, world, first.way, first.end, mi.Bool(active))
    some = opacity > 0
    return dr.select(some, N / dr.select(some, opacity, 1), 0), opacity


def _push_tau(scene: mi.Scene, world: World, way: Way, active: mi.Bool) -> list[mi.Float]:
    def visit(tau: list[mi.Float], body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> list[mi.Float]:
        return [t + d for t, d in zip(tau, body.tangent(way.ray, t0, t1, len(tau), on), strict=True)]

    return revisit(scene, world, way, visit, [mi.Float(0) for _ in range(world.channels)], mi.Bool(active))


def _pull_tau(scene: mi.Scene, world: World, way: Way, weight: list[mi.Float], active: mi.Bool) -> None:
    def visit(state: mi.Float, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> mi.Float:
        body.backproject(way.ray, t0, t1, weight, on)
        return state

    revisit(scene, world, way, visit, mi.Float(0), mi.Bool(active))


def _row(name: str) -> str:
    return name.partition(".")[0]


def _shares(name: str, channels: int) -> list[float]:
    """What each channel counts in an AOV: a mean, or one channel alone."""
    channel = name.partition(".")[2]
    if not channel:
        return [1 / channels] * channels
    return [float(c == "RGB".index(channel) % channels) for c in range(channels)]


def _weigh(shares: list[float], rows: list[mi.Float]) -> mi.Float:
    return sum((s * row for s, row in zip(shares, rows, strict=True) if s), mi.Float(0))


def _inverse(alpha: mi.Float) -> mi.Float:
    """1 / alpha; 0 where nothing stops a ray and its depth is 0 by definition (1e-37: the inverse stays finite)."""
    some = alpha > 1e-37
    return dr.select(some, dr.rcp(dr.select(some, alpha, 1)), 0)
