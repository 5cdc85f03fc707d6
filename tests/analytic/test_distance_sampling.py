"""The distance drawn in the kept piece of a ray, against the inverse of its optical depth on paper."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import close_up, point, smoke

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.emitters import ChosenEmitter
from mivol.transport.estimators.single_scattering.distance_sampling import Candidate, DistanceProposal, sample_distance
from mivol.transport.path.estimators import Settings

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("ends", [(0.5, 2.0), (2.0, 0.5), (0.5, 200.0), (1e-3, 0.02)])
def test_collisions_in_a_cell_of_linear_extinction(ends):
    """In a cell of length d, tau(x) = d (a x + (b - a) x^2 / 2) equals -log(1 - u (1 - exp(-tau(1)))) at the drawn x."""
    values = np.repeat(np.float32([ends[0], *ends, ends[1]]), 4).reshape(4, 2, 2, 1)
    scene = close_up({"smoke": smoke(values)[0], "emitter": point([0, 0, 30.0])[0]})
    survey, settings, n = survey_scene(scene), Settings(max_depth=2), 64
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        media = build_media(scene, needs, make_plan(needs, settings), survey)
        # Voxels 1 and 2 of 4 along z: between -0.25 and 0.25 of the box [-1, 1].
        begin, length, u = 4.75, 0.5, (np.arange(n) + 0.5) / n
        zero, one = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -5 + zero), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
        kept = Candidate(one, begin * one, zero, length * one, [zero], zero, mi.UInt32(zero), mi.Bool(True), mi.UInt32(1))
        numbers = mi.Point2f(mi.Float(0.5), mi.Float(np.float32(u)))
        proposal = DistanceProposal(media, ray, ChosenEmitter(mi.UInt32(0), None, None), None, 0.0)
        event = sample_distance(proposal, kept, one, numbers, mi.Bool(True))
    a, b = map(float, np.float32(ends))
    goal = -np.log1p(u * np.expm1(-length * (a + b) / 2))
    x = (-a + np.sqrt(a * a + 2 * (b - a) * goal / length)) / (b - a)
    # Optical depths are rounded a few times, and so is 1 - u (1 - exp(-tau)), of which the logarithm is taken; Newton's steps
    # end there, and a distance of 5 is rounded by 2^-22.
    sigma = a + (b - a) * x
    rounding = 2.0**-24 * (8 * length * (a + b) / 2 + 4 * np.exp(goal)) / (sigma * length) + 2.0**-23
    off = np.abs(np.array(event.t, np.float64) - begin - length * x)
    np.testing.assert_array_less(off, 2.0**-22 + length * rounding)
    # Its density is sigma exp(-tau) over what the cell takes; tau is off by sigma times the error of the distance.
    density = sigma * np.exp(-goal) / -np.expm1(-length * (a + b) / 2)
    np.testing.assert_allclose(np.array(event.pdf), density, rtol=1e-4)
