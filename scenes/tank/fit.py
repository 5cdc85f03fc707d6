"""What a liquid is made of, from photographs of one lamp behind a tank of it, at several dilutions.

    python scenes/tank/fit.py [--liquid "ruby grapefruit juice"] [--dilutions 0.02 0.05 0.1] [--max-depth 2] [-o runs/tank]

Conventions. Lengths are mm. Unknowns of each channel are u = (log sigma_s, log sigma_a, atanh g) of the undiluted liquid; water
takes no part, so that a dilution c has c sigma_s, c sigma_a and the same g. Photographs are Mitsuba's own (volpath), with
their noise.

Levenberg-Marquardt on (image - photograph) / s, with one s for each photograph, its RMS noise: weights of single pixels would
follow their noise, and favour those that came out too dark. The images and their derivatives by u are mivol's, from samples of
their own. The covariance of u is H^-1 J^T diag(r^2) J H^-1, H = J^T J, with the residuals r themselves for the noise of both
(White 1980, Econometrica 48): pixels need not be equally noisy.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.phase.measured import named_medium
from mivol.report import figures, pixel_scale
from mivol.validate.reference import render_reference

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import numpy as np

XML = Path(__file__).parent / "scene.xml"
KEYS = {f"tank.interior_medium.{name}": name for name in ("sigma_s.value.value", "sigma_a.value.value", "phase_function.g")}
CAMERAS = 3
NAMES = ("sigma_s [1/mm]", "sigma_a [1/mm]", "g")


@dataclass(frozen=True)
class Photograph:
    """One image of one channel (H, W), the variance of its pixels, and the RMS of its noise."""

    dilution: float
    camera: int
    image: np.ndarray
    variance: np.ndarray
    noise: float


def values(u: np.ndarray) -> np.ndarray:
    """(sigma_s, sigma_a, g) of u."""
    return np.array([np.exp(u[0]), np.exp(u[1]), np.tanh(u[2])])


def photographs_of(
    xml: Path, truth: np.ndarray, cameras: int, seed: int, given: argparse.Namespace
) -> list[Photograph]:  # fmt: skip
    """What the cameras of a scene see of each dilution, by Mitsuba."""
    found = []
    for c in given.dilutions:
        known = {"sigma_s": c * truth[0], "sigma_a": c * truth[1], "g": truth[2], "size": given.size}
        for camera in range(cameras):
            made = render_reference(
                xml, given.output / "references", max_depth=given.max_depth, max_spp=given.photo_spp, sensor=camera,
                seed=seed, overrides=known, progress=False,
            )  # fmt: skip
            found.append(Photograph(c, camera, made.mean[..., 0], made.variance[..., 0], made.standard_error))
    return found


class Model:
    """Images of one channel, and their derivatives by u, for any dilution."""

    def __init__(self, xml: Path, size: int, spp: int) -> None:
        self.scene = mi.load_file(str(xml), size=size)
        self.params = mi.traverse(self.scene)
        self.params.keep(list(KEYS))
        self.spp = spp

    def image(self, u: np.ndarray, dilution: float, camera: int, seed: int, spp: int = 0) -> np.ndarray:
        """(H, W)."""
        self._put([mi.Float(float(x)) for x in u], dilution)
        return np.array(mi.render(self.scene, sensor=camera, spp=spp or self.spp, seed=seed))[..., 0]

    def slopes(self, u: np.ndarray, dilution: float, camera: int, seed: int) -> np.ndarray:
        """(H, W, 3), derivatives by u."""
        found = []
        for k in range(3):
            x = [mi.Float(float(value)) for value in u]
            dr.enable_grad(x[k])
            self._put(x, dilution)
            image = mi.render(self.scene, self.params, sensor=camera, spp=self.spp, seed=seed)
            dr.forward(x[k])
            found.append(np.array(dr.grad(image))[..., 0])
        return np.stack(found, axis=-1)

    def _put(self, u: list[mi.Float], dilution: float) -> None:
        known = (dilution * dr.exp(u[0]), dilution * dr.exp(u[1]), dr.tanh(u[2]))
        for key, value in zip(KEYS, known, strict=True):
            self.params[key] = value
        self.params.update()


def fit(model: Model, photographs: list[Photograph], u: np.ndarray, iterations: int) -> tuple[np.ndarray, np.ndarray, list]:
    """Levenberg-Marquardt with samples of its own in each iteration.

    Returns:
        u, its standard errors, and the loss of each iteration.
    """
    damping, losses = 1e-2, []
    for iteration in range(iterations):
        seed = 1000 * (iteration + 1)
        r, J = linearise(model, photographs, u, seed)
        H, losses = J.T @ J, [*losses, float(r @ r) / r.size]
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ r)
        # Logarithms may not leave where the linearisation holds: a factor e in one step.
        new = u + step * min(1.0, 1.0 / np.abs(step).max())
        better = residual(model, photographs, new, seed)
        worse = float(better @ better) > float(r @ r)
        damping = 10 * damping if worse else damping / 5
        u = u if worse else new
    inverse = np.linalg.inv(J.T @ J)
    return u, np.sqrt(np.diag(inverse @ (J.T * np.square(r)) @ J @ inverse)), losses


def residual(model: Model, photographs: list[Photograph], u: np.ndarray, seed: int) -> np.ndarray:
    """(image - photograph) / s, all pixels."""
    images = (model.image(u, p.dilution, p.camera, seed + i) for i, p in enumerate(photographs))
    return np.concatenate([((image - p.image) / p.noise).ravel() for image, p in zip(images, photographs, strict=True)])


def linearise(model: Model, photographs: list[Photograph], u: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The residual and its derivatives by u, from other samples."""
    slopes = (model.slopes(u, p.dilution, p.camera, seed + 500 + i) for i, p in enumerate(photographs))
    J = [(s / p.noise).reshape(-1, 3) for s, p in zip(slopes, photographs, strict=True)]
    return residual(model, photographs, u, seed), np.concatenate(J)


def main() -> None:
    """Fit each channel, print a table, draw the figure."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    liquid = named_medium(given.liquid)
    truth = np.array([liquid.sigma_s, liquid.sigma_a, liquid.g]).T
    model = Model(XML, given.size, given.spp)
    start = np.array([np.log(0.05), np.log(0.05), np.arctanh(0.5)])
    found, errors, photographs = np.empty((3, 3)), np.empty((3, 3)), []
    print(f"{given.liquid}, dilutions {given.dilutions}, photographs of depth {given.max_depth}", flush=True)
    for channel, name in enumerate(("red", "green", "blue")):
        photographs.append(photographs_of(XML, truth[channel], CAMERAS, channel, given))
        u, error, losses = fit(model, photographs[-1], start, given.iterations)
        found[channel] = values(u)
        errors[channel] = error * [found[channel, 0], found[channel, 1], 1 - found[channel, 2] ** 2]
        print("\n".join(table(name, found[channel], errors[channel], truth[channel])))
        print(f"{name:5s} squared residual, in noise: {losses[0]:.1f} -> {losses[-1]:.3f} in {given.iterations} iterations")
    known = truth != 0
    print(f"largest relative error: {np.abs(found[known] / truth[known] - 1).max():.4f}")
    figures.save_figure(draw(given, model, photographs, found, errors, truth), given.output / "tank.png")
    print(given.output / "tank.png")


def table(channel: str, found: np.ndarray, errors: np.ndarray, truth: np.ndarray) -> list[str]:
    """A line for each coefficient of a channel."""
    lines = []
    for what, x, s, t in zip(NAMES, found, errors, truth, strict=True):
        # Milks are published with g = 0.
        off = f"off by {f'{abs(x / t - 1):.2%}' if t else f'{abs(x):.4f}'}, {abs(x - t) / s:.1f} s.e."
        lines.append(f"{channel:5s} {what:15s} {x:9.5f} +- {s:.5f}  truth {t:9.5f}  {off}")
    return lines


def draw(
    given: argparse.Namespace, model: Model, photographs: list[list[Photograph]], found: np.ndarray, errors: np.ndarray,
    truth: np.ndarray,
) -> mpl.figure.Figure:  # fmt: skip
    """Photographs, fitted images, differences; and the coefficients beside the published ones."""
    count = len(given.dilutions)
    with mpl.rc_context(figures.STYLE):
        figure = mpl.figure.Figure(figsize=(2.1 * count + 3.4, 6.4))
        left, right = figure.subfigures(1, 2, width_ratios=(2.1 * count, 3.4))
        grid = left.subplots(3, count, squeeze=False)
        for column, dilution in enumerate(given.dilutions):
            first = [next(p.image for p in photos if (p.dilution, p.camera) == (dilution, 0)) for photos in photographs]
            photo = np.stack(first, axis=-1)
            us = [np.array([np.log(f[0]), np.log(f[1]), np.arctanh(f[2])]) for f in found]
            image = np.stack([model.image(u, dilution, 0, 7, given.photo_spp) for u in us], axis=-1)
            scale, difference = pixel_scale.shared_scale(photo), image - photo
            signed = pixel_scale.Scale("signed", -0.1 * scale.high, 0.1 * scale.high)
            pictures = ((photo, scale), (image, scale), (difference, signed))
            for row, (pixels, how) in enumerate(pictures):
                grid[row, column].imshow(pixel_scale.to_pixels(pixels, how))
                grid[row, column].set_axis_off()
            grid[0, column].set_title(f"1 : {1 / dilution - 1:g} in water")
        for row, text in enumerate(("photograph (volpath)", "fitted (mivol)", "difference, ±10 %")):
            grid[row, 0].text(-0.08, 0.5, text, rotation=90, va="center", ha="right", transform=grid[row, 0].transAxes)
        for k, axes in enumerate(right.subplots(3, 1)):
            x = np.arange(3)
            axes.bar(x, truth[:, k], color=figures.GRID, width=0.6, label="published")
            style = {"fmt": "o", "color": figures.SERIES[1], "capsize": 4, "label": "fitted, ± 2 s.e."}
            axes.errorbar(x, found[:, k], 2 * errors[:, k], **style)
            axes.set_xticks(x, ("red", "green", "blue"))
            axes.set_title(NAMES[k])
            low, high = found[:, k] - 2 * errors[:, k], found[:, k] + 2 * errors[:, k]
            axes.set_ylim(1.25 * min(0.0, low.min()), 1.25 * max(truth[:, k].max(), high.max()))
            if k == 0:
                axes.legend(loc="lower right", facecolor="white", frameon=True)
    return figure


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--liquid", default="ruby grapefruit juice", help="a name of mivol.phase.measured.NAMES")
    parser.add_argument("--dilutions", type=float, nargs="+", default=[0.02, 0.05, 0.1], help="shares of liquid in water")
    parser.add_argument("--max-depth", type=int, default=2, help="of the photographs; -1: all scattering")
    parser.add_argument("--size", type=int, default=64, help="pixels along a side")
    parser.add_argument("--spp", type=int, default=64, help="samples of the fit's images and derivatives")
    parser.add_argument("--photo-spp", type=int, default=1024, help="samples of the photographs")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/tank"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
