"""A smoke that scatters, a radiance field from photographs, lit Gaussians and a ball of glass, on one table.

    python scenes/still_life/photographs.py --size 320                      # photographs of a still life
    mivol optimize scenes/still_life/fit.toml --set field.longest=128       # the radiance field: runs/still_life/fit
    python scenes/knot/render.py                                            # the Gaussians: runs/knot/knot.ply
    python scenes/showcase/render.py [-o runs/showcase]                     # image.png, tangent.png, showcase.jpg

``tangent.png`` shows a derivative of the image: how each pixel changes when the smoke becomes denser (red: brighter, blue:
darker). It is computed by forward differentiation of the same paths, through the smoke, its shadow, the glass and the table.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol
from mivol.files import write_exr, write_png

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

XML = Path(__file__).parent / "scene.xml"
RUNS = Path("runs")
DENSITY = "smoke.interior_medium.sigma_t.data"
PEAK = 24.0
"""Largest extinction of the smoke [1/length]; the smoke is 1.2 wide."""


def main() -> None:
    """Render the image and its derivative, and write both."""
    args = parse_arguments()
    mi.set_variant("llvm_ad_rgb")
    commands = {args.field: "mivol optimize scenes/still_life/fit.toml", args.needles: "python scenes/knot/render.py"}
    for path, command in commands.items():
        if not path.exists():
            raise SystemExit(f"{path} is missing: run {command} first (all commands: the first lines of this script).")
    args.output.mkdir(parents=True, exist_ok=True)
    smoke = args.output / "smoke.vol"
    mivol.write_volume(smoke, PEAK * make_plume()[..., None])
    files = {"smoke": smoke, "field": args.field, "needles": args.needles}
    paths = {name: str(path.resolve()) for name, path in files.items()}
    scene = mi.load_file(str(XML), **paths, width=9 * args.size // 4, height=args.size, spp=args.spp)
    image = np.array(mi.render(scene))
    write_exr(args.output / "image.exr", {"": image})
    write_png(args.output / "image.png", image)
    tangent = differentiate_by_density(scene, args.tangent_spp)
    write_exr(args.output / "tangent.exr", {"": tangent})
    write_png(args.output / "tangent.png", colour_by_sign(tangent, image))
    join_side_by_side(args.output)
    print(args.output / "showcase.jpg")


def join_side_by_side(folder: Path) -> None:
    """Write showcase.jpg, the picture of the README: the image on the left, its derivative on the right."""
    left, right = (Image.open(folder / f"{name}.png").convert("RGB") for name in ("image", "tangent"))
    pair = Image.new("RGB", (left.width + right.width + 8, left.height), "white")
    pair.paste(left, (0, 0))
    pair.paste(right, (left.width + 8, 0))
    pair.save(folder / "showcase.jpg", quality=88)


def differentiate_by_density(scene: mi.Scene, spp: int) -> np.ndarray:
    """The derivative (H, W, 3) of the image by s, at s = 1, for a smoke with the extinction s * sigma_t."""
    params = mi.traverse(scene)
    dr.enable_grad(params[DENSITY])
    # d (s sigma_t) / d s = sigma_t: the tangent of each voxel is its own value.
    dr.set_grad(params[DENSITY], dr.detach(params[DENSITY]))
    params.update()
    return np.array(scene.integrator().render_forward(scene, params, spp=spp))


def colour_by_sign(tangent: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Red for pixels that become brighter and blue for those that become darker, over the darkened grey image (H, W, 3)."""
    change = tangent.mean(axis=2)
    change = np.clip(change / np.quantile(np.abs(change), 0.99), -1, 1)[..., None]
    grey = 0.12 * np.clip(image.mean(axis=2, keepdims=True), 0, 1)
    return grey + np.maximum(change, 0) * [1.0, 0.25, 0.05] + np.maximum(-change, 0) * [0.05, 0.3, 1.0]


def make_plume(shape: tuple[int, int, int] = (160, 96, 96), seed: int = 3) -> np.ndarray:
    """A widening, swirling column of smoke, torn by turbulence, without a simulation.

    Three fields of turbulence displace the points, which makes the curls. A fourth field eats holes into the column's edge.

    Args:
        shape: voxels (Z, Y, X).
        seed: of the turbulence.

    Returns:
        Density (Z, Y, X), float32, in [0, 1], 0 on the outermost voxels.
    """
    rng = np.random.default_rng(seed)
    here = np.indices(shape, dtype=np.float64)
    height = here[0] / shape[0]
    push = np.stack([turbulence(shape, rng) for _ in range(3)])
    moved = here + push * (2 + 13 * height)
    z, y, x = (moved[k] / shape[2] for k in range(3))
    top = shape[0] / shape[2]
    angle, lean = 5.0 * z / top, 0.10 * np.clip(z / top, 0, 1.2)
    radius = 0.05 + 0.27 * np.clip(z / top, 0, 1) ** 0.9
    away = np.hypot(y - 0.5 - lean * np.sin(angle), x - 0.5 - lean * np.cos(angle) * np.clip(2 * z, 0, 1)) / radius
    column = np.clip(1.35 - away, 0, 1)
    torn = map_coordinates(turbulence(shape, rng), moved, order=1, mode="grid-wrap")
    density = np.clip(1.6 * column * (0.75 + 0.55 * torn) - 0.35 * height, 0, 1)
    fade = np.clip((1 - height) / 0.22, 0, 1) ** 1.5 / (1 + 4 * height)
    edge = np.minimum.reduce([np.minimum(here[k], shape[k] - 1 - here[k]) for k in range(3)])
    return (density * fade * np.clip(edge / 4, 0, 1)).astype(np.float32)


def turbulence(shape: tuple[int, int, int], rng: np.random.Generator, largest: float = 30) -> np.ndarray:
    """Gaussian noise with the power spectrum |k|^-13/3 below a largest wavelength [voxel]; mean 0, variance 1."""
    waves = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), np.fft.rfftfreq(shape[2]), indexing="ij")
    square = sum(k**2 for k in waves)
    spectrum = np.fft.rfftn(rng.normal(size=shape)) * (square + largest**-2) ** (-13 / 12)
    spectrum[0, 0, 0] = 0
    field = np.fft.irfftn(spectrum, shape, axes=(0, 1, 2))
    return field / field.std()


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path, default=RUNS / "still_life" / "fit" / "field.npz", help="a radiance field")
    parser.add_argument("--needles", type=Path, default=RUNS / "knot" / "knot.ply", help="Gaussians, of any format")
    parser.add_argument("--size", type=int, default=320, help="height of the image [pixel]")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of the image")
    parser.add_argument("--tangent-spp", type=int, default=128, help="samples a pixel of the derivative")
    parser.add_argument("-o", "--output", type=Path, default=RUNS / "showcase")
    return parser.parse_args()


if __name__ == "__main__":
    main()
