"""A fire as a fluid simulation made it: temperature and soot to light, by Planck's and Kirchhoff's laws.

    python scenes/fire/render.py [--data FOLDER/fds_fire_t12] [--exposure 3] [-o runs/fire]

Conventions. The files are temperature [K] and the extinction of visible light by soot [1/m]. Emission is the radiance of a
black body in linear sRGB, W m^-2 sr^-1 weighed by the CIE functions; the picture shows 1 - exp(-exposure x radiance). The
exposure [W^-1 m^2 sr] is a choice of the photographer; where none is given, the brightest hundredth of the picture is shown at
SHOWN of white. Without the simulation's files a plume of seeded puffs stands in for them.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.fields.blackbody import LUMENS_PER_WATT, blackbody_rgb
from mivol.files import read_volume, write_exr, write_png

import mitsuba as mi
import numpy as np

HERE = Path(__file__).parent
DATA = Path(os.environ.get("MIVOL_DATA", HERE.parents[2] / "shared" / "data")) / "volumes_pbrt" / "fds_fire_t12"
NAMES = {"temperature": "12SmokeKelvinTemperature.pbrt", "extinction": "12SmokeExtinction.pbrt"}
SHOWN = 0.9
"""Of white: where the brightest hundredth of the pixels lies in the picture, so that flames keep their shades."""


def plume(shape: tuple[int, int, int] = (21, 41, 81), puffs: int = 60, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Temperature [K] and extinction [1/m] of a made-up fire, (Z, Y, X) with x up: hot puffs that widen and cool, rising."""
    rng = np.random.default_rng(seed)
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    heat, soot = np.zeros(shape), np.zeros(shape)
    for height in np.linspace(0.05, 0.9, puffs):
        width, aside = 0.05 + 0.08 * height, rng.normal(0.5, 0.08 * height + 0.03, 2)
        off = ((x - height) / 0.05) ** 2 + ((y - aside[0]) / width) ** 2 + ((z - aside[1]) / (2 * width)) ** 2
        puff = np.exp(-0.5 * off)
        heat = np.maximum(heat, puff * (1 - 0.7 * height))
        soot = np.maximum(soot, puff)
    return 293 + 1025 * heat, 30 * soot


def load(data: Path, output: Path) -> tuple[np.ndarray, Path]:
    """Temperature [K] and the file of extinctions, of the simulation or of its stand-in."""
    if data != DATA or data.is_dir():
        return read_volume(data / NAMES["temperature"]).values[..., 0], data / NAMES["extinction"]
    print("the simulation's files are not here: a plume of seeded puffs stands in for them (--data names the files' folder)")
    temperature, extinction = plume()
    np.save(output / "extinction.npy", extinction.astype(np.float32))
    return temperature, output / "extinction.npy"


def find_exposure(image: np.ndarray) -> float:
    """The factor on radiance at which the brightest hundredth of the pixels reaches SHOWN of white [W^-1 m^2 sr]."""
    return float(-np.log1p(-SHOWN) / np.quantile(image.max(axis=-1), 0.99))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of 12SmokeKelvinTemperature.pbrt and its neighbours")
    parser.add_argument("--exposure", type=float, metavar="W^-1 m^2 sr", help="factor on radiance; default: from the picture")
    parser.add_argument("--size", type=int, default=384, help="pixels a side")
    parser.add_argument("--spp", type=int, default=128, help="samples a pixel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/fire"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")

    given.output.mkdir(parents=True, exist_ok=True)
    temperature, extinction = load(given.data, given.output)
    emission = blackbody_rgb(temperature)
    np.save(given.output / "emission.npy", emission.astype(np.float32))
    print(f"temperatures {temperature.min():.0f} to {temperature.max():.0f} K")

    files = {"extinction": extinction, "emission": given.output / "emission.npy"}
    scene = mi.load_file(
        str(HERE / "scene.xml"), size=given.size, spp=given.spp, **{k: str(p.resolve()) for k, p in files.items()}
    )
    image = np.array(mi.render(scene))
    luminance = LUMENS_PER_WATT * image @ [0.2126, 0.7152, 0.0722]
    print(f"luminance {np.median(luminance):.0f} cd/m2 in the median, {luminance.max():.0f} cd/m2 at most")
    write_exr(given.output / "fire.exr", {"": image})
    exposure = find_exposure(image) if given.exposure is None else given.exposure
    write_png(given.output / "fire.png", 1 - np.exp(-exposure * image))
    print(
        f"radiances are {np.median(image):.2g} W m^-2 sr^-1 in the median and {image.max():.2g} at most, a screen ends at 1: "
        f"{given.output / 'fire.png'} shows 1 - exp(-{exposure:.3g} radiance)"
    )


if __name__ == "__main__":
    main()
