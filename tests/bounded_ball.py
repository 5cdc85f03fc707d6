"""A field of which no more than a majorant is declared, and whose optical depth is known on paper: a ball in a box.

:math:`f(x) = \\sigma` for |x - c| < r, so that tau = sigma times the chord.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.protocol import BOUNDED, accumulate_tracked


class Ball:
    """A sphere of constant extinction; its majorant is ``slack`` times as large as need be."""

    line, may_jump, resolution = BOUNDED, True, (40, 40, 40)

    def __init__(self, sigma: mi.Float | mi.Color3f, radius: float, centre: tuple, slack: float = 1.0) -> None:
        self.sigma, self.radius, self.centre, self.slack = sigma, radius, mi.ScalarPoint3f(centre), slack
        self.channels = 3 if dr.size_v(sigma) == 3 else 1
        self.to_world = np.eye(4)
        self.to_world[:3] = np.c_[2 * radius * np.eye(3), np.array(centre) - radius]

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        inside = active & (dr.squared_norm(p - self.centre) < self.radius**2)
        each = [self.sigma] if self.channels == 1 else [self.sigma.x, self.sigma.y, self.sigma.z]
        return [dr.select(inside, value, 0) for value in each]

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
        accumulate_tracked(self, p, w, d, active)

    def bound(self) -> list[float]:
        return [self.slack * float(v) for v in np.array(dr.detach(self.sigma)).ravel()]

    def parameters(self) -> dict[str, Any]:
        return {"sigma": self.sigma}


def register() -> None:
    """Register two shells of the field for the active variant. ``strangers_ball`` does not hand the field to mivol."""

    class StrangersBall(mi.Volume):
        def __init__(self, props: mi.Properties) -> None:
            given = props["sigma"]
            sigma = mi.Float(given) if isinstance(given, float) else mi.Color3f(*given)
            dr.make_opaque(sigma)
            centre = tuple(props.get("centre", mi.ScalarPoint3f(0)))
            self.ball = Ball(sigma, props.get("radius", 1.0), centre, props.get("slack", 1.0))
            self.sigma = sigma
            props["to_world"] = mi.ScalarTransform4f(self.ball.to_world)
            super().__init__(props)

        def eval(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Spectrum:
            values = self.ball.eval(it.p, mi.Vector3f(0), active)
            return mi.Spectrum(*values) if len(values) == 3 else mi.Spectrum(values[0])

        def eval_1(self, it: mi.Interaction3f, active: mi.Bool = True) -> mi.Float:
            return self.ball.eval(it.p, mi.Vector3f(0), active)[0]

        def max(self) -> float:
            return max(self.ball.bound())

        def channel_count(self) -> int:
            return self.ball.channels

        def traverse(self, callback: mi.TraversalCallback) -> None:
            for name, value in self.ball.parameters().items():
                callback.put(name, value, mi.ParamFlags.Differentiable)

    class BallVolume(StrangersBall):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.mivol_extinction = self.ball

    mi.register_texture("test_ball", BallVolume)
    mi.register_texture("strangers_ball", StrangersBall)
