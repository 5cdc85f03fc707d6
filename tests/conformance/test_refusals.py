"""Refusals reach a script: as the MivolError that was raised, or in the text of the error that Mitsuba's parser makes of it."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from scattering_scenes import close_up, fog, mivol

from mivol.errors import MivolError, reveal_refusals
from scenes import grid_volume, sky

MOVED = "the derivative of fog.vertex_positions was requested"
KEY, PLACE = "fog.interior_medium.sigma_t.value.value", "fog.vertex_positions"


def foggy() -> mi.Scene:
    return close_up({"fog": fog(0.5)[0], "sky": sky()}, res=4)


def render(integrator: dict) -> None:
    mi.render(foggy(), integrator=mi.load_dict(integrator), spp=1)


def carry(through: Callable) -> None:
    """Ask for a derivative that is refused, after the picture was made."""
    scene = foggy()
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    params.update()
    image = mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=1)
    dr.enable_grad(params[PLACE])
    through(image, params[KEY])


def update() -> None:
    volume = mi.load_dict(grid_volume("mivol_voxels", np.ones((2, 2, 2, 1))))
    params = mi.traverse(volume)
    params["data"] = mi.TensorXf(np.full((2, 2, 2, 1), np.nan, np.float32))
    params.update()


QUADRATURE = mivol(max_depth=6, deterministic=True)

ROUTES = {
    "render": (lambda: render(QUADRATURE), "quadrature is for a single scattering"),
    "nested": (lambda: render({"type": "moment", "inner": QUADRATURE}), "quadrature is for a single scattering"),
    "method": (lambda: mi.load_dict(QUADRATURE).render(foggy()), "quadrature is for a single scattering"),
    "backward": (lambda: carry(lambda image, _: dr.backward(dr.mean(image, axis=None))), MOVED),
    "forward": (lambda: carry(lambda image, _: dr.forward_to(image)), MOVED),
    "from a parameter": (lambda: carry(lambda _, variable: dr.forward(variable)), MOVED),
    "update": (update, r"found nan at voxel \(z=0, y=0, x=0"),
}


@pytest.mark.parametrize("name", ROUTES)
def test_every_route_to_a_script(name):
    ask, why = ROUTES[name]
    assert_refused(why, ask)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"max_depth": 2.5}, "max_depth of the integrator mivol is 2.5; a whole number is expected, such as 6."),
        ({"max_depth": 2.0}, "max_depth of the integrator mivol is 2.0; a whole number is expected"),
        ({"max_depth": True}, "max_depth of the integrator mivol is True; a whole number is expected"),
        ({"max_depth": "2"}, "max_depth of the integrator mivol is '2'; a whole number is expected"),
        ({"rr_depth": 4.5}, "rr_depth of the integrator mivol is 4.5; a whole number is expected, such as 5."),
        ({"hide_emitters": 1}, "hide_emitters of the integrator mivol is 1; true or false is expected"),
        ({"deterministic": "yes"}, "deterministic of the integrator mivol is 'yes'; true or false is expected"),
        ({"shadows": 3}, "shadows of the integrator mivol is 3; a text is expected"),
        ({"aovs": 3}, "aovs of the integrator mivol is 3; a text is expected"),
        ({"aovs": "dept"}, "did you mean 'depth'"),
        ({"max_depth": -3}, '"max_depth" must be set to -1'),
        ({"rr_depth": 0}, '"rr_depth" must be set to a value greater than zero'),
    ],
)
def test_parameters_of_another_type(given, why):
    """The parser makes a RuntimeError of what a plugin raises, and has the sentence in its text."""
    with pytest.raises(RuntimeError, match=why):
        mi.load_dict({"type": "mivol", **given})


def test_other_errors_pass_as_they_are():
    def render(error: Exception | None) -> int:
        """A name and a text of its own."""
        if error is not None:
            raise RuntimeError("see above") from error
        return 3

    revealing = reveal_refusals(render)
    assert revealing(None) == 3
    assert (revealing.__name__, revealing.__doc__) == ("render", "A name and a text of its own.")
    with pytest.raises(RuntimeError, match="see above"):
        revealing(KeyError("a fault"))
    with pytest.raises(MivolError, match="a sentence") as info:
        revealing(MivolError("a sentence"))
    assert info.value.__cause__ is None and info.value.__context__ is None


def test_render_is_replaced_once():
    assert mi.render is mi.util.render
    assert reveal_refusals(mi.render) is mi.render
