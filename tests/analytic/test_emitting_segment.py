"""A segment in a medium of constant emission: Le (1 - T), and its derivatives by the extinction in both directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.scores import FORWARD, PICTURE, REVERSE
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.line_integrals.emitting_segment import Emission
from mivol.transport.media.scene_media import SceneMedia
from scenes import box_of, camera, centred, media_of

pytestmark = pytest.mark.usefixtures("variant_rgb")

SIGMA, LE, BETA = np.array([0.5, 1.0, 2.0]), np.array([1.0, 3.0, 0.5]), np.array([0.5, 0.25, 2.0])
T = np.exp(-SIGMA)
ROUNDING = 8 * 2.0**-23
CHANGE = np.array([1.0, -2.0, 0.5])


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    """A unit cube."""
    colours = {k: {"type": "constvolume", "value": {"type": "rgb", "value": v.tolist()}} for k, v in (("s", SIGMA), ("e", LE))}
    fog = {"type": "mivol_medium", "sigma_t": colours["s"], "emission": colours["e"]}
    return media_of(
        mi.load_dict({"type": "scene", "box": box_of(fog, centred(np.eye(3))), "sensor": camera([0, -4, 0], [0, 0, 0])})
    )


def segment() -> PathSegment:
    """Two lanes through the middle of it, of which the second has ended before."""
    ray = mi.Ray3f(mi.Point3f(0, 0, mi.Float(-3, -3)), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    return PathSegment(ray, dr.zeros(mi.MediumPtr, 2), mi.Spectrum(*BETA.tolist()), mi.Bool(True), None, mi.UInt32(0))


ON = (True, False)


def test_light_and_transmittance(media):
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), PICTURE, mi.Bool(*ON))
    light = BETA * LE * (1 - T)
    np.testing.assert_allclose(np.array(found.light.value), np.c_[light, np.zeros(3)], rtol=ROUNDING)
    np.testing.assert_allclose(np.array(found.T)[:, 0], T, rtol=ROUNDING)
    assert found.light.is_replayed and not np.array(found.end.si.is_valid()).any()


def test_tangents(media):
    """Le T sigma' of the light, and -sigma' of log T."""
    media.bodies[0].tangents = [mi.Color3f(*CHANGE.tolist())]
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), FORWARD, mi.Bool(*ON))
        light, log = np.array(found.light.jvp()), np.array(found.transmittance.jvp())
    np.testing.assert_allclose(light, np.c_[BETA * LE * T * CHANGE, np.zeros(3)], rtol=ROUNDING)
    np.testing.assert_allclose(log, np.c_[-CHANGE, np.zeros(3)], rtol=ROUNDING)


def test_gradients(media):
    """Of the light, reported first, and of log T: beta Le T dL - dlog."""
    media.start_gradients()
    dL, dlog = np.array([2.0, -1.0, 4.0]), np.array([0.25, 0.5, 1.0])
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), REVERSE, mi.Bool(*ON))
        found.light.vjp(mi.Spectrum(*dL.tolist()))
        found.transmittance.vjp(mi.Spectrum(*dlog.tolist()))
    np.testing.assert_allclose(np.array(media.bodies[0].gradients[0]), BETA * LE * T * dL - dlog, atol=ROUNDING)
