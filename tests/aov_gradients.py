"""Gradients of AOVs through an integrator, for tests of AOVs and of compositing."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

NAMES = "tau,tau.G,alpha,depth"
DATA, VALUE = "interior_medium.sigma_t.data", "interior_medium.sigma_t.value.value"


def mivol(aovs: str = NAMES) -> mi.Integrator:
    return mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": aovs})


def vjp(scene: mi.Scene, integrator: mi.Integrator, keys: list[str], w: np.ndarray, spp: int) -> dict[str, np.ndarray]:
    """J^T w, w a weight of each AOV."""
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    w = np.concatenate([np.zeros((*w.shape[:2], 3)), w], axis=2)
    integrator.render_backward(scene, params, mi.TensorXf(w.astype(np.float32)), seed=7, spp=spp)
    gradients = {key: np.array(dr.grad(params[key]), dtype=np.float64) for key in keys}
    for key in keys:
        dr.disable_grad(params[key])
    return gradients


def aovs(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> np.ndarray:
    return np.array(integrator.render(scene, seed=7, spp=spp), dtype=np.float64)[..., 3:]
