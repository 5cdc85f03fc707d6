"""Replays that read from memory what the first walk has found: the same derivatives, and nothing walked or traced again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import fresh
from scattering_gradients import backward
from scattering_scenes import PLACE, cases, close_up, mivol, rough_grid, sun

from mivol.transport.estimators.segment import KnownFlight
from mivol.transport.path import derivatives
from mivol.transport.path.kept_segments import KeptSegments, SegmentNumber
from scenes import ball_of, box_of, grid_volume, medium, sky

SMOKE, FOG = "smoke.interior_medium.", "fog.interior_medium."
DENSITY, ALBEDO, SUN = SMOKE + "sigma_t.data", SMOKE + "albedo.data", "sun.irradiance.value"


def smoky(rgb: bool = False, **parts: dict) -> mi.Scene:
    """A grid under the sun; each albedo is large enough for collisions to find its derivative."""
    density = 0.1 + rough_grid(4, 3.0)
    density = np.concatenate([density, 0.2 * density, 2 * density], axis=-1) if rgb else density
    albedo = grid_volume("mivol_voxels", 0.3 + 0.5 * rough_grid(5, 1.0, (3, 3, 3)), PLACE)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", density, PLACE), albedo)
    return close_up({"smoke": box_of(interior, PLACE), "sun": sun([0.3, 0.2, -1.0])[0], **parts}, res=8)


def floor() -> dict:
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    return {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def ball(bsdf: str) -> dict:
    """A ball of fog, whose boundary is traced."""
    return ball_of(medium("mivol_medium", 1.5, 0.8), (0.3, -1.7, 0.4), 0.5) | {"bsdf": {"type": bsdf}}


def two_balls() -> mi.Scene:
    """Homogeneous media alone, whose shadow rays know their lengths in media."""
    fogs = {name: ball_of(medium("mivol_medium", 1.5, 0.8), (x, 0, 0.2), 0.6) for name, x in (("fog", -0.7), ("other", 0.7))}
    return close_up({**fogs, "floor": floor(), "sun": sun([0.3, 0.2, -1.0])[0]}, res=8)


SCENES = {
    "grid": (smoky, DENSITY),
    "floor": (lambda: smoky(floor=floor()), DENSITY),
    "albedo": (lambda: smoky(floor=floor(), lit=sky(0.3)), (ALBEDO, SUN)),
    "rgb": (lambda: smoky(rgb=True, floor=floor()), DENSITY),
    "beside traced fog": (lambda: smoky(fog=ball("null"), floor=floor()), DENSITY),
    "beside fog in glass": (lambda: smoky(fog=ball("dielectric"), lit=sky(0.3)), DENSITY),
    "beside fog in thin glass": (lambda: smoky(fog=ball("thindielectric"), floor=floor()), DENSITY),
    "two fogs": (two_balls, (FOG + "sigma_t.value.value", FOG + "albedo.value.value")),
}


def gradient(scene: mi.Scene, key: str | tuple[str, ...], depth: int = 5) -> np.ndarray:
    """The derivative of the mean image, also by several numbers at once."""
    integrator, weight = mi.load_dict(mivol(max_depth=depth, rr_depth=3)), np.full((8, 8, 3), 1 / 192)
    if isinstance(key, str):
        return backward(scene, key, weight, 64, fresh(3), integrator)
    params = mi.traverse(scene)
    values = [type(params[k])(dr.detach(params[k])) for k in key]
    for k, value in zip(key, values, strict=True):
        dr.enable_grad(value)
        params[k] = value
    params.update()
    integrator.render_backward(scene, params, mi.TensorXf(weight.astype(np.float32)), seed=fresh(3), spp=64)
    return np.concatenate([np.array(dr.grad(value), np.float64).ravel() for value in values])


@pytest.mark.usefixtures("traced_balls")
@pytest.mark.parametrize(
    "name", cases(SCENES, slow=[name for name in SCENES if name not in ("floor", "rgb", "beside traced fog")])
)
def test_segments_in_memory_change_no_derivative(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With no, some or all segments in memory: the same terms in another order."""
    (build, key), found = SCENES[name], []
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    for most in (0, 2, 5):
        monkeypatch.setattr(derivatives, "MAX_SEGMENTS", most)
        found.append(gradient(build(), key))
    assert np.abs(found[0]).max() > 0
    for other in found[1:]:
        # A voxel has at most 4096 float32 terms of both signs.
        np.testing.assert_allclose(other, found[0], rtol=1e-4, atol=1e-5 * np.abs(found[0]).max())


def test_a_replay_reads_its_flights_and_its_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other numbers in memory leave no derivative: dark shadows by the sun, and flights without collisions by the albedo."""
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    flight_at = KeptSegments.flight_at
    with monkeypatch.context() as patch:
        patch.setattr(KeptSegments, "shadow_at", lambda kept, index, active: (mi.Float(0), active))
        assert not np.any(gradient(smoky(), SUN))
    monkeypatch.setattr(KeptSegments, "flight_at", lambda *given: replace(flight_at(*given), t=mi.Float64(dr.inf)))
    assert not np.any(gradient(smoky(), (ALBEDO, SUN))[:27])


@pytest.mark.parametrize(("bsdf", "key", "skips"), [("null", DENSITY, True), ("null", FOG + "sigma_t.value.value", False)])
@pytest.mark.usefixtures("traced_balls")
def test_boundaries_are_traced_again_for_their_own_derivatives(
    bsdf: str, key: str, skips: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A replay for the medium of a box needs no boundary of another; a medium behind a traced boundary needs its own."""
    made = []
    empty = KeptSegments.empty
    monkeypatch.setattr(derivatives, "MIN_LISTED", 1)
    monkeypatch.setattr(KeptSegments, "empty", lambda *given, **named: made.append(named) or empty(*given, **named))
    gradient(smoky(fog=ball(bsdf)), (key, SUN))
    assert [named["skips_boundaries"] for named in made] == [skips]


def test_what_is_written_is_read() -> None:
    """A collision, an end at a surface, a way out, and a segment without room."""
    kept = KeptSegments.empty(4, 1, keeps_shadows=True, keeps_places=False, skips_boundaries=True)
    hit = SimpleNamespace(on=mi.Bool([True, False, False, True]), t=mi.Float64([2, 3, 4, 5]), body=mi.UInt32([1, 0, 0, 0]))
    si = SimpleNamespace(is_valid=lambda: mi.Bool([False, True, False, False]))
    index, room = mi.UInt32([3, 2, 1, 0]), mi.Bool([True, True, True, False])
    kept.set_flight(index, SimpleNamespace(collision=hit, end=SimpleNamespace(si=si)), room)
    kept.set_shadow(index, mi.Spectrum(mi.Float([0.5, 0, -1, 1])), room)
    other = KnownFlight(mi.Float64(7), mi.UInt32(9), mi.Bool([False] * 4))
    flight = kept.flight_at(index, room, other)
    assert np.array(flight.t).tolist() == [2, np.inf, np.inf, 7] and np.array(flight.body)[[0, 3]].tolist() == [1, 9]
    assert np.array(flight.on).tolist() == np.array(room).tolist()
    assert np.array(flight.meets_no_surface).tolist() == [True, False, True, False]
    T, known = kept.shadow_at(index, room)
    assert np.array(T)[:3].tolist() == [0.5, 0, -1] and np.array(known).tolist() == np.array(room).tolist()


def test_a_number_moves_on_with_its_segments() -> None:
    """Lanes that follow a segment take the next number; without room left, none is left later either."""
    number = SegmentNumber(mi.UInt32([0, 1, 2]), mi.UInt32([2, 2, 0])).after(10, mi.Bool([True, False, True]))
    assert np.array(number.index).tolist() == [10, 1, 12] and np.array(number.left).tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("bounded", "surfaces", "depth", "expected"),
    [(False, True, 6, (5, 5)), (False, False, 6, (1, 5)), (False, False, 3, (1, 2)), (False, True, 1, (0, 0)),
     (False, True, 99, (5, 5)), (True, True, 6, (0, 0))],
)  # fmt: skip
def test_as_many_segments_are_kept_as_a_path_has(bounded: bool, surfaces: bool, depth: int, expected: tuple) -> None:
    """At most 5; a stem among media alone has one. Fields known at points keep none."""
    media = SimpleNamespace(is_bounded=bounded, has_surfaces=surfaces)
    estimators = SimpleNamespace(media=media, settings=SimpleNamespace(depth_limit=depth))
    assert derivatives._count_segments(estimators) == expected
