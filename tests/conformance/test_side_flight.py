"""Side flights towards the emitter of the next collision do not change the mean of images."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, difference, over_pixels
from scattering_scenes import close_up, mivol, rough_grid, smoke

from mivol.scene import plan
from mivol.scene.needs import find_needs
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import Settings


@pytest.mark.slow_for("sun")
@pytest.mark.statistical
@pytest.mark.parametrize("lit", small.cases(["sun", "sky"], slow=("sky",)))
def test_side_flights_keep_the_mean(lit, monkeypatch):
    """The same mean with and without side flights."""
    image = mi.Bitmap(np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 4)
    far = {"sun": small.sun([0.3, 0.2, -1.0])[0], "sky": {"type": "envmap", "bitmap": image}}[lit]
    scene = close_up({"smoke": smoke(rough_grid(7, 6.0), 0.9, name="hg", g=0.8)[0], "far": far}, res=8)
    with_them = over_pixels(small.moments(scene, mivol(max_depth=5), 256))
    monkeypatch.setattr(plan, "choose_side_flights", lambda *_: (None, []))
    without = over_pixels(small.moments(scene, mivol(max_depth=5), 256, first=500))
    assert_same_mean(with_them, without, rounding=1e-6, what="radiance")
    assert_precise(difference(with_them, without), 0.03 * without.mean, what="radiance")


@pytest.mark.parametrize(
    ("g", "emitter", "depth", "flies"),
    [(0.8, "sun", 3, True), (0.8, "sun", 2, False), (0.3, "sun", 3, False), (0.8, "point", 3, False)],
)
def test_a_plan_takes_them_where_they_pay(g, emitter, depth, flies):
    """The plan needs peaked phase functions, two scattering events, and emitters at infinity."""
    shine = small.sun([0.3, 0.2, -1.0])[0] if emitter == "sun" else small.point([1.5, 1, 2.0])[0]
    scene = close_up({"smoke": smoke(rough_grid(7), 0.9, name="hg", g=g)[0], "emitter": shine}, res=2)
    made = plan.make_plan(find_needs(scene, scene.sensors()[0], survey_scene(scene)), Settings(max_depth=depth))
    assert (made.side_flight_cosine is not None) == flies
    if flies:
        # Means of 4096 samples: 1 / 64 of the spread of the cosine, which is below 1.
        assert made.side_flight_cosine == pytest.approx(g, abs=0.02)
