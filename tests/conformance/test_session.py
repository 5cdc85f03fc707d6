"""What an integrator is asked beside the picture: when it is computed, whether it is developed, and what it is called."""

from __future__ import annotations

from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.scene.sensors import check_film
from scenes import pencil, refused, sky


def test_a_picture_is_computed_at_once_or_when_it_is_looked_at():
    """Mitsuba's ``evaluate``; the numbers are the same."""
    # A recorded render computes its image at once.
    traced = pencil((0, 0, 0), (0, 0, 1)) | {"sampler": {"type": "stratified"}}
    scene = mi.load_dict({"type": "scene", "sky": sky(0.5), "sensor": traced})
    integrator = mi.load_dict({"type": "mivol"})
    now, later = (integrator.render(scene, spp=1, evaluate=asked) for asked in (True, False))
    assert now.array.state == dr.VarState.Evaluated and later.array.state == dr.VarState.Unevaluated
    np.testing.assert_array_equal(np.array(now), np.full((1, 1, 3), 0.5))
    np.testing.assert_array_equal(np.array(later), np.array(now))


def test_a_film_of_more_numbers_than_an_array_has_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """29308^2 pixels of five numbers are fewer than 2^32, 29309^2 are more; where memory is not known, this is left."""
    monkeypatch.setattr("mivol.machine.available_memory", lambda: None)
    for edge, fits in ((29308, True), (29309, False)):
        film = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": edge, "height": edge}})
        with nullcontext() if fits else refused("more numbers than Dr.Jit can count in one array"):
            check_film(film)


def test_a_film_is_counted_with_what_is_kept_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine numbers of four bytes a pixel, and what the caller says."""
    film = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 1024, "height": 1024}})
    monkeypatch.setattr("mivol.machine.available_memory", lambda: 36 << 20)
    check_film(film)
    with refused("a film of 1024 x 1024 pixels needs"):
        check_film(film, 1)


def test_a_film_beyond_the_memory_is_refused() -> None:
    """40 GB of pixels and more, by a picture and by both derivatives."""
    eye = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 100000, "height": 100000}})
    session, scene = mi.load_dict({"type": "mivol"}).session, mi.load_dict({"type": "scene", "sky": sky(0.5)})
    for render in (session.render, session.render_forward):
        with refused("a film of 100000 x 100000 pixels needs"):
            render(scene, eye, 0, 1)
    with refused("a film of 100000 x 100000 pixels needs"):
        session.render_backward(scene, mi.TensorXf(0.0), eye, 0, 1)


def test_pictures_are_developed():
    scene = mi.load_dict({"type": "scene", "sensor": pencil((0, 0, 0), (0, 0, 1))})
    with refused("found develop=False"):
        mi.load_dict({"type": "mivol"}).render(scene, spp=1, develop=False)


def test_an_integrator_prints_its_depths_and_aovs():
    integrator = mi.load_dict({"type": "mivol", "max_depth": 3, "rr_depth": 4, "aovs": "tau, depth"})
    assert "mivol[max_depth=3, rr_depth=4, aovs=tau,depth]" in str(integrator)
