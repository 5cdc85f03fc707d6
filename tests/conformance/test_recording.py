"""Kernels are recorded while no garbage is collected, and garbage is collected again after them."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest
from scattering_scenes import close_up, mivol, rough_grid, smoke

import scenes
from mivol.kernel_recording import without_garbage_collection
from mivol.scene import session

KEY = "smoke.interior_medium.sigma_t.data"


def test_collections_are_put_off_for_a_while() -> None:
    """After an error too; and they stay off where they were."""
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError), without_garbage_collection():
        assert not gc.isenabled()
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with without_garbage_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


@pytest.mark.slow_for("forward", "reverse")
@pytest.mark.parametrize("way", ["picture", "reverse", "forward"])
def test_paths_are_recorded_without_them(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    seen, name = [], "replay_branches" if way == "reverse" else "walk_path"
    walk = getattr(session, name)
    monkeypatch.setattr(session, name, lambda *a, **k: seen.append(gc.isenabled()) or walk(*a, **k))
    scene = close_up({"smoke": smoke(rough_grid(1), 0.5)[0], "sky": scenes.sky(1.0)}, res=2)
    params, integrator = mi.traverse(scene), mi.load_dict(mivol(max_depth=3))
    if way != "picture":
        dr.enable_grad(params[KEY])
    if way == "forward":
        dr.set_grad(params[KEY], 1.0)
        integrator.render_forward(scene, params, seed=0, spp=1)
    elif way == "reverse":
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (2, 2, 3)), seed=0, spp=1)
    else:
        mi.render(scene, integrator=integrator, spp=1)
    assert seen and not any(seen)
    assert gc.isenabled()
