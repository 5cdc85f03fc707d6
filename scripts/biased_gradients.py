"""Scenes in which gradients of Mitsuba's prbvolpath differ from finite differences of volpath images.

    python scripts/biased_gradients.py                      # all scenes, a minute each on two cores
    python scripts/biased_gradients.py --scene god_rays     # one scene

The script needs Mitsuba 3 with its LLVM or CUDA backend. If mivol is installed, it prints its gradients
too. Each figure is the derivative of the mean of the image along log sigma_t, as mean +- standard error
of the rounds; z is the difference to the finite differences of volpath in standard errors.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

with contextlib.suppress(ModuleNotFoundError):
    import mivol  # noqa: F401  before mitsuba, so that it can choose the LLVM library

import drjit as dr
import mitsuba as mi
import numpy as np

Parts = dict[str, object]

METHODS = ["prbvolpath", "prbvolpath_patched", *(["mivol"] if "mivol" in sys.modules else [])]

SIDE = 16
"""Edge of the image [pixel]."""

STEP = 0.05
"""Finite differences between (1 - STEP) sigma_t and (1 + STEP) sigma_t."""

SIGMA_T = "body.interior_medium.sigma_t.value.value"


# -- Scenes ----------------------------------------------------------------------------------------


def god_rays() -> Parts:
    """A spot in a haze, above a floor."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.001]).scale(3)}
    return {"body": cube(0.25, 0.9), "lamp": spot(), "floor": floor, "sensor": camera(20, -0.4)}


def aquarium() -> Parts:
    """A spot in a box of water, above a ball."""
    water: Parts = {"type": "dielectric", "int_ior": "water"}
    ball = {"type": "sphere", "center": [0, 0, -0.4], "radius": 0.4}
    return {"body": cube(0.5, 0.5, water), "lamp": spot(), "ball": ball, "sensor": camera(20, -0.4)}


def many_lamps() -> Parts:
    """Sixteen small balls of light in a fog, above a floor."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.99]).scale(0.99)}
    parts: Parts = {"body": cube(0.5, 0.8), "floor": floor, "sensor": camera()}
    for i in range(16):
        x, y = i % 4, i // 4
        centre = [0.4 * x - 0.6, 0.4 * y - 0.6, 0.3 - 0.6 * ((x + y) % 2)]
        light = {"type": "area", "radiance": 20.0}
        parts[f"lamp_{i}"] = {"type": "sphere", "center": centre, "radius": 0.05, "emitter": light}
    return parts


def milk_in_glass() -> Parts:
    """A ball of milky glass under an even sky."""
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"}, "interior": medium(8.0, 0.97, 0.6)}
    return {"body": ball, "sky": {"type": "constant"}, "sensor": camera()}


def medium(sigma_t: float, albedo: float, g: float = 0.0) -> Parts:
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    return {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo, "phase": phase}


def cube(sigma_t: float, albedo: float, bsdf: Parts | None = None) -> Parts:
    return {"type": "cube", "bsdf": bsdf or {"type": "null"}, "interior": medium(sigma_t, albedo)}


def spot() -> Parts:
    """A spot near the top of the cube, which shines downwards."""
    place = mi.ScalarTransform4f().look_at([0, 0, 0.9], [0, 0, 0], [0, 1, 0])
    return {"type": "spot", "to_world": place, "intensity": 10.0, "cutoff_angle": 35}


def camera(fov: float = 40, height: float = 0) -> Parts:
    """A camera that looks at a point of the z axis."""
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 4, height], [0, 0, height], [0, 0, 1])
    return {"type": "perspective", "fov": fov, "to_world": place, "film": film}


SCENES: dict[str, tuple[Callable[[], Parts], int]] = {
    "god_rays": (god_rays, 2),
    "aquarium": (aquarium, 3),
    "many_lamps": (many_lamps, 4),
    "milk_in_glass": (milk_in_glass, 6),
}
"""Builder and max_depth by name."""


# -- prbvolpath with two lines changed -------------------------------------------------------------

PATCH = {
    # Count the transmittance of the last segment of a shadow ray, which ends at a lamp inside the medium.
    "(active_surface | active_medium) & (": "(active_surface | active_medium | escaped_medium) & (",
    # End paths at max_depth at surfaces too, as volpath does.
    "throughput[perform_rr] = throughput * dr.rcp(q)\n": (
        "throughput[perform_rr] = throughput * dr.rcp(q)\n            active &= depth < self.max_depth\n"
    ),
}
"""Lines of prbvolpath.py, and what they become."""

RENAMED = {
    '"prbvolpath"': '"prbvolpath_patched"',
    "from .common": "from mitsuba.python.ad.integrators.common",
}


def register_patched() -> None:
    """Register a copy of prbvolpath with the lines of PATCH as the integrator prbvolpath_patched."""
    text = (Path(mi.__file__).parent / "python/ad/integrators/prbvolpath.py").read_text()
    for old, new in (PATCH | RENAMED).items():
        if text.count(old) != 1:
            raise SystemExit(f"prbvolpath of Mitsuba {mi.__version__} is another one: not one {old!r}")
        text = text.replace(old, new)
    # Dr.Jit reads the source of the functions from a file.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "prbvolpath_patched.py"
        path.write_text(text)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec and spec.loader
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


# -- Derivatives of the mean of the image along log sigma_t ----------------------------------------


class Derivative:
    """Derivatives of one scene by one integrator."""

    def __init__(self, scene: str, integrator: str) -> None:
        build, depth = SCENES[scene]
        self.scene = mi.load_dict({"type": "scene", **build()})
        self.integrator = mi.load_dict({"type": integrator, "max_depth": depth, "rr_depth": 64})
        self.params = mi.traverse(self.scene)
        self.sigma_t = float(np.array(self.params[SIGMA_T]).item())

    def mean_image(self, factor: float, spp: int, seed: int) -> float:
        self.params[SIGMA_T] = mi.Float(factor * self.sigma_t)
        self.params.update()
        image = mi.render(self.scene, integrator=self.integrator, spp=spp, seed=mi.UInt32(seed))
        return float(np.mean(np.array(image), dtype=np.float64))

    def finite_difference(self, spp: int, seed: int) -> float:
        more, less = (self.mean_image(1 + step, spp, seed) for step in (STEP, -STEP))
        return (more - less) / (2 * STEP)

    def gradient(self, spp: int, seed: int) -> float:
        value = mi.Float(self.sigma_t)
        dr.enable_grad(value)
        self.params[SIGMA_T] = value
        self.params.update()
        options = {"integrator": self.integrator, "spp": spp, "seed": mi.UInt32(seed)}
        image = mi.render(self.scene, self.params, **options)
        dr.backward(dr.mean(image, axis=None))
        return self.sigma_t * float(np.array(dr.grad(value)).item())


def measure(scene: str, spp: int, rounds: int, seed: int = 0) -> dict[str, list[float]]:
    """Each derivative, once a round."""
    found = {}
    for name in ("volpath", "prbvolpath"):
        difference = Derivative(scene, name).finite_difference
        found[f"finite differences, {name}"] = [difference(spp, seed + r) for r in range(rounds)]
    for name in METHODS:
        gradient = Derivative(scene, name).gradient
        found[f"gradient, {name}"] = [gradient(max(1, spp // 8), seed + rounds + r) for r in range(rounds)]
    return found


def summarize(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard error of rounds."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) / math.sqrt(len(values))


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--scene", choices=SCENES, help="one scene; default: all")
    parser.add_argument("--spp", type=int, default=4096, help="samples per pixel; an eighth for gradients")
    parser.add_argument("--rounds", type=int, default=16, help="renders with their own seeds, at least 2")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    args = parser.parse_args(words)
    mi.set_variant(args.variant)
    register_patched()
    for scene in [args.scene] if args.scene else SCENES:
        found = {name: summarize(values) for name, values in measure(scene, args.spp, args.rounds).items()}
        truth, error = found["finite differences, volpath"]
        print(f"{scene}: derivative of the mean of the image along log sigma_t")
        for name, (mean, se) in found.items():
            z = f"   z = {(mean - truth) / math.hypot(error, se):+.1f}" if "gradient" in name else ""
            print(f"    {name:<32} {mean:+.6f} +- {se:.6f}{z}", flush=True)


if __name__ == "__main__":
    main()
