"""What a liquid in a tank of glass is made of, from photographs of a chequered lamp seen through it, with all its scattering.

    python scenes/tank/glass.py [--liquid "ruby grapefruit juice"] [--dilutions 0.1 0.2] [-o runs/tank_in_glass]

Conventions. Lengths are mm; unknowns u, dilutions and channels are those of ``fit.py`` beside this script. Photographs m* are
Mitsuba's (``volpath``), at unlimited depth: light is refracted and reflected by both faces of every wall.

Both the images m(u) and their derivatives J are estimates here, so that least squares on J is biased: E J^T W J is larger than
(E J)^T W (E J), and steps stop half-way. Found is instead where three weighted sums of all pixels agree with the photographs',

    Z^T W (m(u) - m*) = 0,   Newton's steps u <- u - H^-1 Z^T W (m - m*),   H = Z^T W J,

which is so for the true u on average, whatever Z and W are, as long as their noise is not that of m - m*. Z are the derivatives
at the last u, blurred by a pixel (the nearer to J, the less noise u has); W is 1 / m, smoothed, since the variance of light
that is met by chance goes as its mean. H takes Z and J from samples apart, and W is never that of the m beside it: pixels that
came out too dark would weigh more. First come steps with few samples, then, where they have settled, one with many. The
covariance is H^-1 S H^-T, S = Z^T W V W Z with V the measured variances of m and m*.

References: Hansen 1982 (Large sample properties of generalized method of moments estimators), Econometrica 50.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.phase.measured import named_medium
from mivol.report import figures

import mitsuba as mi
import numpy as np
from fit import Model, Photograph, draw, photographs_of, table, values
from scipy.ndimage import gaussian_filter

XML = Path(__file__).parent / "glass.xml"
CAMERAS = 2
BLUR = 0.7
"""Of Z and W [pixels]."""
SETTLED = 0.1
"""Largest change of u in a step of few samples after which many are taken."""
IMAGE_SPP = 16
"""Samples of an image in those of a derivative, which takes some ten times as long."""
LIMIT = 1.0
"""Largest change of u in one step: a factor e of a coefficient."""


@dataclass
class Look:
    """What the model shows of one photograph at some u: rounds (R, H, W) of images, (R, H, W, 3) of derivatives by u."""

    images: np.ndarray
    slopes: np.ndarray

    @property
    def variance(self) -> np.ndarray:
        """Of the mean image (H, W)."""
        return self.images.var(axis=0, ddof=1) / len(self.images)


@dataclass
class Moments:
    """Three weighted sums: H (3, 3), Z^T W (m - m*) and its covariance S."""

    slope: np.ndarray
    misfit: np.ndarray
    covariance: np.ndarray

    @property
    def step(self) -> np.ndarray:
        """Newton's, at most LIMIT."""
        step = -np.linalg.solve(self.slope, self.misfit)
        return step * min(1.0, LIMIT / np.abs(step).max())

    @property
    def errors(self) -> np.ndarray:
        """Standard errors of u."""
        inverse = np.linalg.inv(self.slope)
        return np.sqrt(np.diag(inverse @ self.covariance @ inverse.T))


def look_at(model: Model, photo: Photograph, u: np.ndarray, seed: int, rounds: int) -> Look:
    """Images and derivatives with samples of their own in each round."""
    seeds = range(seed, seed + rounds)
    images = [model.image(u, photo.dilution, photo.camera, s, IMAGE_SPP * model.spp) for s in seeds]
    return Look(np.array(images, float), np.array([model.slopes(u, photo.dilution, photo.camera, s + 500) for s in seeds]))


def moments_of(photo: Photograph, look: Look) -> Moments:
    """The share of one photograph in the three sums: halves of the samples weigh and look at each other."""
    images, slopes = ([rounds[k::2].mean(axis=0) for k in range(2)] for rounds in (look.images, look.slopes))
    weights = [weight_of(image) for image in images]
    weight = (weights[0] + weights[1]) / 2
    blurred = [gaussian_filter(half, (BLUR, BLUR, 0)) for half in slopes]
    z = (blurred[0] + blurred[1]) / 2
    slope = sum(np.einsum("yxi,yx,yxj->ij", b, weight, j) for b, j in zip(blurred, slopes[::-1], strict=True)) / 2
    misfit = sum(np.einsum("yxi,yx->i", z, w * (m - photo.image)) for w, m in zip(weights, images[::-1], strict=True)) / 2
    return Moments(slope, misfit, np.einsum("yxi,yx,yxj->ij", z, weight**2 * (look.variance + photo.variance), z))


def weight_of(image: np.ndarray) -> np.ndarray:
    """1 / m, smoothed, (H, W); at most a hundred times that of the brightest place."""
    smooth = gaussian_filter(image, BLUR)
    return 1 / (smooth + 0.01 * smooth.max())


def measure(model: Model, photographs: list[Photograph], u: np.ndarray, seed: int, rounds: int) -> Moments:
    """The three sums over all photographs."""
    shares = [moments_of(p, look_at(model, p, u, seed + 1000 * k, rounds)) for k, p in enumerate(photographs)]
    return Moments(*(sum(getattr(share, what) for share in shares) for what in ("slope", "misfit", "covariance")))


def fit(model: Model, photographs: list[Photograph], u: np.ndarray, given: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    """u and its standard errors: steps of two rounds until they have settled, then one of many."""
    for iteration in range(given.iterations):
        step = measure(model, photographs, u, 20_000 * (iteration + 1) + given.seed * 1_000_000, 2).step
        u = u + step
        print("      {}: sigma_s {:.4f}, sigma_a {:.4f}, g {:.4f}".format(iteration + 1, *values(u)), flush=True)
        if np.abs(step).max() < SETTLED:
            break
    else:
        print(f"      not settled in {given.iterations} steps: raise --spp, what is found may be far off", flush=True)
    last = measure(model, photographs, u, 20_000 * (given.iterations + 1) + given.seed * 1_000_000, given.rounds)
    return u + last.step, last.errors


def main() -> None:
    """Fit each channel, print a table, draw the figure."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    liquid = named_medium(given.liquid)
    truth = np.array([liquid.sigma_s, liquid.sigma_a, liquid.g]).T
    model = Model(XML, given.size, given.spp)
    u = np.array([np.log(0.05), np.log(0.05), np.arctanh(0.5)])
    found, errors, photographs = np.empty((3, 3)), np.empty((3, 3)), []
    print(f"{given.liquid} in glass, dilutions {given.dilutions}, all scattering", flush=True)
    for channel, name in enumerate(("red", "green", "blue")):
        photographs.append(photographs_of(XML, truth[channel], CAMERAS, 10 * given.seed + channel, given))
        # Each channel starts from what the one before it was found to be.
        u, error = fit(model, photographs[-1], u, given)
        found[channel] = values(u)
        errors[channel] = error * [found[channel, 0], found[channel, 1], 1 - found[channel, 2] ** 2]
        print("\n".join(table(name, found[channel], errors[channel], truth[channel])), flush=True)
    known = truth != 0
    print(f"largest relative error: {np.abs(found[known] / truth[known] - 1).max():.4f}")
    figures.save_figure(draw(given, model, photographs, found, errors, truth), given.output / "tank.png")
    print(given.output / "tank.png")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--liquid", default="ruby grapefruit juice", help="a name of mivol.phase.measured.NAMES")
    parser.add_argument("--dilutions", type=float, nargs="+", default=[0.1, 0.2], help="shares of liquid in water")
    parser.add_argument("--size", type=int, default=32, help="pixels along a side")
    parser.add_argument("--spp", type=int, default=32, help="samples of a round of derivatives; images take 16 times as many")
    parser.add_argument("--photo-spp", type=int, default=4096, help="samples of the photographs")
    parser.add_argument("--iterations", type=int, default=15, help="steps of two rounds at most")
    parser.add_argument("--rounds", type=int, default=8, help="of the last step")
    parser.add_argument("--seed", type=int, default=0, help="of the photographs and of the fit")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/tank_in_glass"))
    parser.set_defaults(max_depth=-1)
    return parser.parse_args()


if __name__ == "__main__":
    main()
