"""A scattering event in one of two media: its medium and its coefficients."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.single_scattering.distance_sampling import MediumEvent
from mivol.transport.estimators.single_scattering.scattering_derivatives import (
    Scattering,
    event_interaction,
    event_sigma_s,
    event_sigma_t,
)
from mivol.transport.media.scene_media import SceneMedia
from scenes import box_of, camera, centred, media_of, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")

HERE, THERE = centred(np.eye(3)), centred(np.eye(3), (0, 0, 2))


def scene_of(*interiors: dict) -> SceneMedia:
    """Boxes on the z axis, about 0 and 2."""
    boxes = {f"box{k}": box_of(own, place) for k, (own, place) in enumerate(zip(interiors, (HERE, THERE), strict=False))}
    return media_of(mi.load_dict({"type": "scene", **boxes, "sensor": camera([0, -4, 1], [0, 0, 1])}))


def upwards(media: SceneMedia) -> list[int]:
    """Indices of the media, the lower one first: Mitsuba orders shapes as it likes."""
    return np.argsort([body.box.to_world[2, 3] for body in media.bodies]).tolist()


def event(media: SceneMedia) -> MediumEvent:
    """Events in the lower medium, in the upper medium, and in none."""
    low, top = upwards(media)[0], upwards(media)[-1]
    sigma, t = mi.Float(5, 6, 7), mi.Float64(1, 3, 3)
    return MediumEvent(t, t, mi.Float(1), [sigma] * 3, [sigma] * 3, mi.UInt32(low, top, top), mi.Bool(True, True, False))


def upward() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(0, 0, -1), mi.Vector3f(0, 0, 1), mi.Float(0, 0, 0), mi.Color0f())


GREY = {"sigma_t": 2.0, "albedo": 0.25}
COLOURS = {
    "type": "mivol_medium",
    "sigma_a": 0.5,
    "sigma_s": {"type": "constvolume", "value": {"type": "rgb", "value": [1, 2, 4]}},
}


LANES = [[True, False, False], [False, True, False]]


def test_events_know_their_medium():
    media = scene_of(medium("mivol_medium", **GREY), COLOURS)
    found, order = event(media), upwards(media)
    at = media.bodies_at(found.body, found.on)
    assert [np.array(at[k][1]).tolist() for k in order] == LANES
    assert [at[k][0] for k in order] == [media.bodies[k] for k in order]
    mei = event_interaction(media, upward(), event(media))
    pointers = [mi.MediumPtr(media.bodies[k].view.medium) for k in order]
    assert [np.array(mei.medium == p).tolist() for p in pointers] == LANES
    np.testing.assert_array_equal(np.array(mei.p.z), [0, 2, 2])


def test_coefficients_are_those_of_the_medium():
    """The albedo times the extinction, or sigma_s itself; 0 without a scattering event."""
    media = scene_of(medium("mivol_medium", **GREY), COLOURS)
    mei = event_interaction(media, upward(), event(media))
    found = np.array(event_sigma_s(media, upward(), event(media), mei))
    np.testing.assert_array_equal(found, [[0.5, 1, 0], [0.5, 2, 0], [0.5, 4, 0]])
    low, top = (media.bodies[k] for k in upwards(media))
    for body, expected in ((low, [2, 2, 2]), (top, [1.5, 2.5, 4.5])):
        sigma_t = event_sigma_t(media, body, upward(), event(media), mi.Bool(True))
        np.testing.assert_array_equal(np.array(sigma_t).ravel(), expected)


def test_a_single_walk_knows_the_extinction_already():
    """The event of a single medium carries the extinction; no second look-up."""
    media = scene_of(medium("mivol_medium", **GREY))
    found = event_sigma_t(media, media.bodies[0], upward(), event(media), mi.Bool(True))
    np.testing.assert_array_equal(np.array(found), [[5, 6, 7]] * 3)


def test_the_weight_of_an_event_is_its_gain_times_all_direct_light():
    value = mi.Spectrum(1, 2, 4)
    dr.enable_grad(value)
    samples = [SimpleNamespace(value=value), SimpleNamespace(value=mi.Spectrum(3))]
    found = Scattering(None, None, mi.Spectrum(0.5, 1, 2), samples, mi.Spectrum(7), mi.Float(0)).weight
    assert np.array(found).ravel().tolist() == [2, 5, 14] and not dr.grad_enabled(found)
