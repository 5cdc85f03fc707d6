"""The peer of the study of radiance fields: the method of Mitsuba's tutorial, written from its description.

A density (1 channel) and harmonics of degree 2 (27 channels) are two ``mi.Texture3f`` over the unit cube. A ray takes steps of
1 / resolution from its entry point. At each step, density = max(0, texture), colour = clip(sum of harmonics, 0, 1), opacity =
1 - exp(-density step). The second pass follows the ray again, subtracts the light of each step from the remaining radiance, and
lets Dr.Jit differentiate the step alone (path replay: Vicini et al. 2021). The fit has 4 stages of doubling resolution up to
128^3 with 105 steps each, in turns over 7 views of 256 x 256 pixels, all rays of a view in each step, Adam with a rate of 0.05
for both grids, and an L1 loss; it starts from density 0.01 and coefficients 0.1. No step is skipped, and a ray ends early only
at transmittance 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

DEGREE, CHANNELS = 2, 27
LEARNING_RATE = 0.05
START_DENSITY, START_COEFFICIENT = 0.01, 0.1


@dataclass
class Peer:
    """A field in two textures.

    Attributes:
        density: (n, n, n, 1) [1/length].
        harmonics: (n, n, n, 27).
    """

    density: mi.TensorXf
    harmonics: mi.TensorXf

    def __post_init__(self) -> None:
        self.resolution = self.density.shape[0]

    @classmethod
    def start(cls, resolution: int) -> Peer:
        """The initial field of the tutorial."""
        made = [(START_DENSITY, 1), (START_COEFFICIENT, CHANNELS)]
        return cls(*(dr.full(mi.TensorXf, value, (*(resolution,) * 3, channels)) for value, channels in made))

    def textures(self) -> tuple[mi.Texture3f, mi.Texture3f]:
        """Textures that propagate derivatives to the tensors."""
        how = {"wrap_mode": dr.WrapMode.Clamp, "use_accel": False, "migrate": False}
        return mi.Texture3f(self.density, **how), mi.Texture3f(self.harmonics, **how)

    @dr.syntax
    def follow(
        self, textures: tuple, o: mi.Point3f, d: mi.Vector3f, left: mi.Color3f | None = None, by: mi.Color3f | None = None
    ) -> mi.Color3f:
        """Radiance along rays of the unit cube; with ``left`` (the radiance) and ``by`` (its derivative), the reverse pass."""
        density, harmonics = textures
        primal = by is None
        box = mi.ScalarBoundingBox3f([0, 0, 0], [1, 1, 1])
        hit, t, far = box.ray_intersect(mi.Ray3f(o, d))
        step = 1.0 / self.resolution
        basis = dr.sh_eval(d, DEGREE)
        L = mi.Color3f(0) if primal else mi.Color3f(left)
        weight = mi.Float(1)
        active = mi.Bool(hit)
        t = dr.maximum(t, 0)
        while dr.hint(active, exclude=[density, harmonics]):
            p = o + t * d
            with dr.resume_grad(when=not primal):
                opacity = 1 - dr.exp(-dr.maximum(density.eval(p, active)[0], 0) * step)
                values = harmonics.eval(p, active)
                colour = mi.Color3f(0)
                for b, y in enumerate(basis):
                    colour += mi.Color3f(values[3 * b], values[3 * b + 1], values[3 * b + 2]) * y
                colour = dr.clip(colour, 0, 1)
                shown = weight * opacity * colour
                if dr.hint(primal, mode="scalar"):
                    L = dr.select(active, L + shown, L)
                else:
                    L = dr.select(active, L - dr.detach(shown), L)
                    through = 1 - opacity
                    ahead = dr.select(dr.detach(through) > 0, through / dr.detach(through), 1) * L
                    dr.backward_from(dr.select(active, dr.dot(by, shown + ahead), 0))
            weight *= dr.detach(1 - opacity)
            t += step
            active &= (t < far) & (weight > 0)
        return L

    def render(self, o: mi.Point3f, d: mi.Vector3f) -> mi.Color3f:
        """Radiance along rays."""
        with dr.suspend_grad():
            return self.follow(self.textures(), o, d)

    def backward(self, o: mi.Point3f, d: mi.Vector3f, radiance: mi.Color3f, by: mi.Color3f) -> tuple[mi.Float, mi.Float]:
        """Derivatives of a scalar by density and harmonics, from its derivative by the radiance."""
        for tensor in (self.density, self.harmonics):
            dr.enable_grad(tensor)
            dr.set_grad(tensor, 0)
        textures = self.textures()
        with dr.suspend_grad():
            self.follow(textures, o, d, radiance, by)
        slopes = dr.grad(self.density).array, dr.grad(self.harmonics).array
        dr.disable_grad(self.density, self.harmonics)
        return slopes

    def fit(self, views: list[tuple[mi.Point3f, mi.Vector3f, mi.Color3f]], steps: int) -> Iterator[None]:
        """Take steps with one view each; yields after each step."""
        adam = mi.ad.Adam(lr=LEARNING_RATE)
        adam["density"], adam["harmonics"] = self.density, self.harmonics
        for step in range(steps):
            o, d, target = views[step % len(views)]
            L = self.render(o, d)
            dr.eval(L)
            by = dr.sign(L - target) / (3 * dr.width(o))
            for name, slope in zip(("density", "harmonics"), self.backward(o, d, L, by), strict=True):
                dr.set_grad(adam[name], mi.TensorXf(slope, adam[name].shape))
            adam.step()
            self.density, self.harmonics = (dr.detach(adam[name]) for name in ("density", "harmonics"))
            yield

    def refined(self) -> Peer:
        """The field of the next stage, with twice the resolution."""
        n = 2 * self.resolution
        return Peer(*(dr.resample(t, (n, n, n, t.shape[3]), filter="linear") for t in (self.density, self.harmonics)))
