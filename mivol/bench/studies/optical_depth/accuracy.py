"""How far optical depths and images of mivol are from float64, and how much sooner an image has an error than volpath's."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import smoke, threads_in_space
from mivol.bench.harness.timing import race, ratio_of
from mivol.bench.scenes import box_scene
from mivol.bench.studies.optical_depth.peers import by_drjit_dda, padded
from mivol.bench.studies.optical_depth.size import Size
from mivol.bench.studies.optical_depth.twin import exact_tau
from mivol.bench.studies.optical_depth.work import Work, camera_rays, rays_across

__all__ = ["measure_accuracy", "measure_image"]


def measure_accuracy(size: Size) -> dict:
    """How far is tau from the float64 twin, over int (sigma + h |grad sigma|)?"""
    figures = {}
    for res in size.accuracy_res:
        rng = np.random.default_rng(res)
        fields = {
            "noise": rng.uniform(0, 4, (res,) * 3).astype(np.float32),
            "threads": threads_in_space(res).values,
        }
        for name, values in fields.items():
            o, d = rays_across(rng, size.exact_rays)
            exact = exact_tau(values, *(x.T.astype(np.float64) for x in (o, d)))
            work, grid = Work(values, mi.Point3f(o), mi.Vector3f(d)), padded(values)
            figures |= {
                f"{res}^3 {name}": errors_of(work.tau()(0), *exact),
                f"{res}^3 {name}, empty blocks skipped": errors_of(work.tau(skip=True)(0), *exact),
                f"drjit.dda.integrate, {res}^3 {name}": errors_of(by_drjit_dda(work, grid), *exact),
            }
    return figures


def errors_of(tau: mi.Float, exact: np.ndarray, measure: np.ndarray) -> dict[str, float]:
    """Errors of optical depths over their measure; where that is 0 the optical depth has to be 0."""
    error, hit = np.abs(np.array(tau) - exact), measure > 0
    relative = error[hit] / measure[hit]
    return {
        "rays": int(hit.sum()),
        "largest_error": float(relative.max()),
        "rms_error": float(np.sqrt(np.mean(relative**2))),
        "error_of_99.9_percent": float(np.quantile(relative, 0.999)),
        "error_where_exactly_empty": float(error[~hit].max(initial=0)),
    }


def measure_image(size: Size) -> dict:
    """Through ``mi.render``: how much sooner than ``volpath`` at the same spp, and at the same error?"""
    found = smoke()
    scene = mi.load_dict(box_scene(found.values, size.image_side))
    integrators = {
        "mivol": mi.load_dict({"type": "mivol", "max_depth": 1}),
        "volpath, max_depth 1": mi.load_dict({"type": "volpath", "max_depth": 1}),
        "volpath, max_depth 6": mi.load_dict({"type": "volpath", "max_depth": 6}),
    }
    contestants = {
        name: lambda seed, i=i: mi.render(scene, integrator=i, spp=size.image_spp, seed=seed) for name, i in integrators.items()
    }
    timings = race(contestants, size.rounds, keep=True)
    pixels = np.random.default_rng(0).choice(size.image_side**2, size.exact_pixels, replace=False)
    exact, doubt = pixel_means(found.values, size.image_side, pixels)
    samples = size.image_side**2 * size.image_spp
    figures = {}
    for name, t in timings.items():
        errors = [image[..., 0].ravel()[pixels] - exact for image in t.results]
        figures[name] = t.report(samples, "paths") | {"rms_error": float(np.sqrt(np.mean(np.square(errors))))}
    ours = timings["mivol"]
    for name in ("volpath, max_depth 1", "volpath, max_depth 6"):
        faster = ratio_of(timings[name], ours)
        variance = (figures[name]["rms_error"] / figures["mivol"]["rms_error"]) ** 2
        figures[name] |= {"mivol_is_faster": faster, "mivol_is_faster_at_equal_error": faster * variance}
    about = {"pixels": size.image_side**2, "spp": size.image_spp, "exact_pixels": len(pixels), "rms_error_of_exact": doubt}
    return {"grid": str(found), **about, **figures}


def pixel_means(values: np.ndarray, side: int, pixels: np.ndarray, k: int = 12) -> tuple[np.ndarray, float]:
    """Mean transmittance of pixels by k x k rays of the twin in each, and how far k/2 x k/2 are from that."""
    means = []
    for parts in (k, k // 2):
        o, d = (np.array(x).T.astype(np.float64) for x in camera_rays(side, pixels, parts))
        means.append(np.exp(-exact_tau(values, o, d)[0]).reshape(len(pixels), -1).mean(axis=1))
    return means[0], float(np.sqrt(np.mean((means[0] - means[1]) ** 2)))
