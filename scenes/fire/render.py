"""A fire as a fluid simulation made it: temperature and soot to light, by Planck's and Kirchhoff's laws.

    python scenes/fire/render.py [--data ../shared/data/volumes_pbrt/fds_fire_t12] [--exposure 1.6] [-o runs/fire]

Conventions. The files are temperature [K] and the extinction of visible light by soot [1/m]. Emission is the radiance of a
black body in linear sRGB, W m^-2 sr^-1 weighed by the CIE functions; the picture shows 1 - exp(-exposure x radiance), where the
exposure [W^-1 m^2 sr] is a choice of the photographer.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder of 12SmokeKelvinTemperature.pbrt and its neighbours")
    parser.add_argument("--exposure", type=float, default=1.6, metavar="W^-1 m^2 sr", help="factor on radiance")
    parser.add_argument("--size", type=int, default=384, help="pixels a side")
    parser.add_argument("--spp", type=int, default=128, help="samples a pixel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/fire"))
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")

    temperature = read_volume(given.data / "12SmokeKelvinTemperature.pbrt").values[..., 0]
    emission = blackbody_rgb(temperature)
    given.output.mkdir(parents=True, exist_ok=True)
    np.save(given.output / "emission.npy", emission.astype(np.float32))
    print(f"temperatures {temperature.min():.0f} to {temperature.max():.0f} K")

    files = {"extinction": given.data / "12SmokeExtinction.pbrt", "emission": given.output / "emission.npy"}
    scene = mi.load_file(
        str(HERE / "scene.xml"), size=given.size, spp=given.spp, **{k: str(p.resolve()) for k, p in files.items()}
    )
    image = np.array(mi.render(scene))
    luminance = LUMENS_PER_WATT * image @ [0.2126, 0.7152, 0.0722]
    print(f"luminance {np.median(luminance):.0f} cd/m2 in the median, {luminance.max():.0f} cd/m2 at most")
    write_exr(given.output / "fire.exr", {"": image})
    write_png(given.output / "fire.png", 1 - np.exp(-given.exposure * image))
    print(f"{given.output / 'fire.png'}: exposure {given.exposure:g} per W m^-2 sr^-1")


if __name__ == "__main__":
    main()
