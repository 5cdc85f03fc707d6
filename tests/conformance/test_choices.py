"""Choices about scenes, from facts that are made up: which one is taken, and the reason that is given for it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from mivol.scene import choices
from mivol.scene.needs import MediumFacts
from mivol.transport.path.estimators import Settings

LIT = Settings(max_depth=2)
GRID = ((10, 20, 30),)
ONCE, FLIGHTS = "single_scattering", "free_flight"


def fog(name: str = "fog", **more: object) -> MediumFacts:
    """Grey fog on a grid, filled by half, that scatters."""
    facts = {"kind": "k", "boundary": "a box", "extinction": "grey", "resolutions": GRID, "is_scattering": True, "emits": False}
    return MediumFacts(name, **{**facts, "phase": "p", "occupied": 0.5, "tau_max": None, **more})


def needs(*media: MediumFacts, emitters: tuple[str, ...] = ("delta",), **more: object) -> SimpleNamespace:
    given = {"surfaces": (), "boundaries": (), "is_sealed": False, **more}
    return SimpleNamespace(media=media, emitter_kinds=emitters, **given)


@pytest.mark.parametrize(
    ("media", "settings", "what", "why"),
    [
        ((), LIT, "none", "no shape bounds a medium"),
        (
            (fog(),),
            LIT,
            "exact optical depth; one scattering at a distance sampled in proportion to the scattered light, exact",
            "max_depth is 2",
        ),
        (
            (fog(),),
            Settings(max_depth=2, deterministic=True, shadows="grid"),
            "by quadrature, a light grid for shadows",
            "above 0",
        ),
        ((fog(),), Settings(max_depth=1), "exact optical depth; no phase function", "max_depth 1 includes no scattered light"),
        ((fog(is_scattering=False),), LIT, "exact optical depth; no phase function", "albedo 0"),
        ((fog(is_scattering=False, unread=True),), LIT, "no albedo look-up", "values cannot be read while dr.freeze records"),
        (
            (fog(is_scattering=False, bounded="Ball"), fog("b", is_scattering=False)),
            LIT,
            "transmittance of fog by ratio tracking",
            "albedo 0",
        ),
    ],
)
def test_transport(media: tuple, settings: Settings, what: str, why: str) -> None:
    segment = "single_scattering" if settings.max_depth == 2 else "absorption"
    found = choices.choose_transport(needs(*media), settings, segment)
    assert what in found.choice and why in found.reason


@pytest.mark.parametrize(("depth", "lit"), [(0, False), (1, False), (2, True), (3, True), (-1, True)])
def test_light_is_scattered_from_depth_2_on(depth: int, lit: bool) -> None:
    settings = Settings(max_depth=depth)
    assert choices.is_scattering_visible(needs(fog("a", is_scattering=False), fog()), settings) == lit
    assert not choices.is_scattering_visible(needs(fog(is_scattering=False)), settings)


@pytest.mark.parametrize(
    ("emitters", "media", "found"),
    [
        ((), (fog(),), [("directions", "none")]),
        (("uniform",), (fog(),), [("directions", "one sample of the phase function")]),
        (
            ("delta", "delta"),
            (fog(),),
            [("directions", "one, to one of 2 emitters"), ("where to scatter", "weighed by optical depth")],
        ),
        (("area",), (fog(),), [("directions", "two: an emitter sample and a phase function sample")]),
        (("delta", "uniform"), (fog(),), [("directions", "two:"), ("where to scatter", "weighed by optical depth towards")]),
        (
            ("delta",),
            (fog(), fog("b")),
            [("directions", "one, to one of 1"), ("where to scatter", "along the camera ray only")],
        ),
        (
            ("delta",),
            (fog(resolutions=()),),
            [("directions", "one, to one of 1"), ("where to scatter", "along the camera ray only")],
        ),
    ],
)
def test_lighting(emitters: tuple, media: tuple, found: list) -> None:
    chosen = choices.choose_lighting(needs(*media, emitters=emitters), LIT, ONCE)
    assert len(chosen) == len(found)
    assert all(c.subject == about and c.choice.startswith(choice) for c, (about, choice) in zip(chosen, found, strict=True))


def test_lighting_of_sealed_media():
    found = lambda kinds, **more: choices.choose_lighting(needs(fog(), emitters=kinds, **more), LIT, FLIGHTS)  # noqa: E731
    (same,), (drawn,), (met,) = found(("uniform",)), found(("area",)), found(("area",), is_sealed=True)
    assert same.choice == met.choice == "one sample of the phase function"
    assert same.reason != met.reason and "refract" in met.reason
    assert drawn.choice.startswith("an emitter sample at each collision")


def test_lighting_by_quadrature_and_without_light():
    (only,) = choices.choose_lighting(needs(fog()), Settings(max_depth=2, deterministic=True), ONCE)
    assert only.choice.startswith("at two points of each piece")
    assert choices.choose_lighting(needs(fog(is_scattering=False)), LIT, ONCE) == []


@pytest.mark.parametrize(
    ("medium", "emitters", "settings", "choice"),
    [
        (fog(), ("area",), LIT, "exact"),
        (fog(resolutions=((200, 200, 200),), occupied=0.5), ("area",), LIT, "estimated"),
        (fog(resolutions=((200, 200, 199),), occupied=0.5), ("area",), LIT, "exact"),
        (fog(resolutions=((1, 1, 1), (200, 200, 200)), occupied=0.5), ("area", "delta"), LIT, "estimated"),
        (fog(resolutions=((200, 200, 200),), occupied=1.0), ("delta",), LIT, "exact"),
        (fog(unread=True, resolutions=((200, 200, 200),), occupied=1.0), ("area",), LIT, "exact"),
        (fog(), ("area",), Settings(max_depth=2, shadows="estimated"), "estimated"),
    ],
)
def test_shadows(medium: MediumFacts, emitters: tuple, settings: Settings, choice: str) -> None:
    """From 300 occupied cells along the axes on they are estimated, but under emitters of one position alone."""
    assert choices.choose_shadows(medium, needs(medium, emitters=emitters), settings).choice == choice


@pytest.mark.parametrize(
    ("cell_depth", "emitters", "settings", "looked_up"),
    [
        (0.37, ("area",), Settings(max_depth=3), True),
        (0.38, ("area",), Settings(max_depth=3), False),
        (None, ("area",), Settings(max_depth=3), False),
        (0.37, ("area",), LIT, False),
        (0.37, ("uniform",), Settings(max_depth=3), False),
    ],
)
def test_shadows_of_gradients(cell_depth: float | None, emitters: tuple, settings: Settings, looked_up: bool) -> None:
    """In thin grids look-ups take the place of walks: up to 1.5 faces for 2 look-ups that cost 2 faces each."""
    for resolution in (20, 300):
        medium = fog(resolutions=((resolution,) * 3,), cell_depth=cell_depth)
        found = choices.choose_shadows(medium, needs(medium, emitters=emitters), settings)
        assert ("gradients take a few look-ups" in found.reason) == looked_up


def test_shadows_are_no_question_without_a_grid_or_light():
    for medium, settings in (
        (fog(resolutions=()), LIT),
        (fog(), Settings(max_depth=1)),
        (fog(), Settings(2, deterministic=True)),
    ):
        assert choices.choose_shadows(medium, needs(medium), settings) is None


@pytest.mark.parametrize(
    ("occupied", "emitters", "count"), [(0.5, ("area",), 4), (0.25, ("delta",), 8), (0.24, ("delta",), 2), (0.1, ("area",), 2)]
)
def test_points_that_scatter(occupied: float, emitters: tuple, count: int) -> None:
    medium = fog(occupied=occupied)
    found, (choice,) = choices.choose_scattering_points(needs(medium, emitters=emitters), LIT, ONCE)
    assert found == count and choice.choice == f"{count} per camera ray" and f"{occupied:.0%} of the blocks" in choice.reason


def test_one_point_scatters_where_there_is_more_than_one_grid():
    for media in ((fog(), fog("b")), (fog(resolutions=(*GRID, *GRID)),), (fog(resolutions=()),)):
        found, (choice,) = choices.choose_scattering_points(needs(*media), LIT, ONCE)
        assert found == 1 and choice.reason == "there is more than one grid or none"
    for segment in ("scattering_quadrature", "absorption", FLIGHTS):
        assert choices.choose_scattering_points(needs(fog()), LIT, segment) == (1, [])


def test_channels_emission_skipping_and_tracing():
    grey, rgb = fog(), fog("smoke", extinction="rgb", emits=True)
    assert choices.choose_channels(needs(grey)) == choices.Choice("channels", "1", "every extinction is grey")
    assert choices.choose_channels(needs(grey, rgb)).reason == "rgb extinction in smoke"
    assert choices.choose_emission(needs(grey), ONCE) == []
    assert choices.choose_emission(needs(grey, rgb), "emission")[0].reason == "smoke emit"
    assert choices.choose_emission(needs(grey, rgb), FLIGHTS)[0].choice == "at one point of each flight"
    ways = [(True, False), (True, True), (False, False)]
    said = ["skipped", "skipped before and behind the content", "walked"]
    assert [choices.choose_skipping(grey, *way).choice for way in ways] == said
    scene = needs(grey, rgb)
    scene.boundaries = (SimpleNamespace(box=1), SimpleNamespace(box=None))
    assert choices.choose_tracing(scene).reason == "not a box or ball, or overlapping another boundary: smoke"
    scene.boundaries = (SimpleNamespace(box=1), SimpleNamespace(box=1))
    assert choices.choose_tracing(scene).choice == "not traced"
    scene.surfaces = ("Sphere", "Rectangle", "Sphere")
    assert choices.choose_tracing(scene).reason == "surfaces may stop a ray: Rectangle, Sphere"


@pytest.mark.parametrize(
    ("media", "refractive", "depth", "what", "why"),
    [
        ((fog(),), (), 4, "at most 3 scatterings", "an albedo is above 0 and max_depth is 4"),
        ((fog(),), (), -1, "any number of scatterings", "an albedo is above 0 and max_depth is -1"),
        ((fog(emits=True),), (), 2, "at most 1 scatterings", "fog emits and scatters"),
        ((fog(bounded="Ball"), fog("b")), ("glass",), 2, "free flights", "fog is bounded; glass refracts"),
    ],
)
def test_free_flights(media: tuple, refractive: tuple, depth: int, what: str, why: str) -> None:
    found = choices.choose_transport(needs(*media, refractive=refractive), Settings(max_depth=depth), FLIGHTS)
    assert what in found.choice and found.reason == why


def test_lighting_of_free_flights():
    for emitters, directions in (
        (("uniform",), "one sample of the phase function"),
        (("delta", "uniform"), "an emitter sample at each"),
    ):
        (found,) = choices.choose_lighting(needs(fog(), emitters=emitters), LIT, FLIGHTS)
        assert found.choice.startswith(directions)


@pytest.mark.parametrize(
    ("medium", "choice"),
    [
        (fog(bounded="Ball"), "delta tracking"),
        (fog(bounded="GridVolume"), "delta tracking"),
        (fog(resolutions=()), "exact"),
        (fog(extinction="rgb"), "delta tracking, with one sampled channel per flight"),
        (fog(extinction="rgb", cell_depth=0.85), "delta tracking, with one sampled channel per flight"),
        (fog(extinction="rgb", cell_depth=0.86), "exact, with one sampled channel per flight"),
        (fog(cell_depth=0.86), "delta tracking"),
        (fog(unread=True), "delta tracking"),
        (fog(), "delta tracking"),
    ],
)
def test_how_flights_are_drawn(medium: MediumFacts, choice: str) -> None:
    assert choices.choose_flights(medium, FLIGHTS).choice == choice and choices.choose_flights(medium, ONCE) is None


@pytest.mark.parametrize(
    ("cosines", "far", "depth", "segment", "expected"),
    [
        ((0.8, None), True, 3, FLIGHTS, 0.8),
        ((0.3, 0.99), True, -1, FLIGHTS, 0.95),
        ((choices.MIN_SIDE_FLIGHT_COSINE,), True, 3, FLIGHTS, choices.MIN_SIDE_FLIGHT_COSINE),
        ((choices.MIN_SIDE_FLIGHT_COSINE - 0.01,), True, 3, FLIGHTS, None),
        ((None,), True, 3, FLIGHTS, None),
        ((0.8,), False, 3, FLIGHTS, None),
        ((0.8,), True, 2, FLIGHTS, None),
        ((0.8,), True, 3, ONCE, None),
    ],
)
def test_side_flights(cosines: tuple, far: bool, depth: int, segment: str, expected: float | None) -> None:
    """Of peaked phase functions, for emitters at infinity, where light scatters twice."""
    asked = needs(*(fog(mean_cosine=c) for c in cosines), are_emitters_far=far, endless_media=())
    found, said = choices.choose_side_flights(asked, Settings(max_depth=depth), segment)
    assert found == expected and len(said) == (expected is not None)
    for never in ({"is_sealed": True}, {"endless_media": ("fog",)}):
        without = SimpleNamespace(**(vars(asked) | never))
        assert choices.choose_side_flights(without, Settings(max_depth=depth), segment) == (None, [])
