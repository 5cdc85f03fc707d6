"""Plans: how many rays a pass holds, what a gradient takes, and which estimator is asked, from facts that are made up."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import close_up, smoke

from mivol.errors import MivolError
from mivol.scene import choices, plan
from mivol.scene.needs import MediumFacts, find_needs
from mivol.scene.plan import build_media, make_plan, plan_key
from mivol.scene.survey import survey_scene
from mivol.transport.media.grid_extinction import PACKED_LIMIT, gradient_bytes
from mivol.transport.path.estimators import Settings
from scenes import sky

GIB = 2**30


def fog(*resolutions: tuple[int, int, int], **more: object) -> MediumFacts:
    facts = {"kind": "k", "boundary": "a box", "extinction": "grey", "is_scattering": True, "emits": False, "phase": "p"}
    return MediumFacts("fog", **{**facts, "resolutions": resolutions, "occupied": 0.5, "tau_max": None, **more})


def needs(*media: MediumFacts, variant: str = "llvm_ad_rgb", **more: object) -> SimpleNamespace:
    given = {"emitter_kinds": ("delta",), "parameters": (), "film_samples": 1000, "refractive": (), **more}
    given = {"crop_samples": given["film_samples"], **given}
    return SimpleNamespace(media=media, variant=variant, **given)


@pytest.mark.parametrize(
    ("backend", "rays", "steps"), [("llvm", 2**22, 2**29), ("cuda", 2**25, 2**34), ("metal", 2**24, 2**32)]
)
def test_a_pass_ends_within_seconds(backend: str, rays: int, steps: int) -> None:
    """Rays times the cells that one of them may cross, the sum of edges of all grids, stay below a bound."""
    variant = f"{backend}_ad_rgb"
    assert plan._rays_per_pass(needs(variant=variant)) == plan._rays_per_pass(needs(fog(), variant=variant)) == rays
    assert plan._rays_per_pass(needs(fog((10, 20, 30)), variant=variant)) == rays
    large = fog((500, 1500, 3000), (100, 200, 300)), fog((400, 100, 100))
    assert plan._rays_per_pass(needs(*large, variant=variant)) == min(rays, steps // 6200)
    assert plan._rays_per_pass(needs(fog((10**5, 10**5, 10**5)), variant=variant)) == steps // 300_000


@pytest.mark.parametrize("extinction", ["grey", "rgb"])
def test_memory_of_a_gradient_is_counted(monkeypatch: pytest.MonkeyPatch, extinction: str) -> None:
    """Eight bytes a node and channel, and copies of packed corners where there is room for them, on the processor."""
    channels = 3 if extinction == "rgb" else 1
    small, large = (8, 9, 10), (2000, 2000, 2000)
    packed, nodes = gradient_bytes(small, channels), 8 * 9 * 10
    assert packed <= PACKED_LIMIT < gradient_bytes(large, channels)
    monkeypatch.setattr(plan, "free_memory", lambda: None)
    memory, choice = plan._plan_gradient_memory(needs(fog(small, extinction=extinction)))
    assert memory == packed + 8 * nodes * channels
    assert choice.choice == f"{memory / 2**20:.1f} MiB besides the rays (corners of cells, one copy per thread)"
    assert (choice.subject, choice.reason) == ("gradient step", "no parameter has gradients yet")
    elsewhere, _ = plan._plan_gradient_memory(needs(fog(small, extinction=extinction), variant="cuda_ad_rgb"))
    assert elsewhere == 8 * nodes * channels
    both, choice = plan._plan_gradient_memory(needs(fog(small, large, extinction=extinction), fog(), parameters=("a", "b")))
    assert both == memory + 8 * 2000**3 * channels
    assert "(corners of cells, one copy per thread; nodes)" in choice.choice and choice.reason.endswith(" by a, b")
    nothing, choice = plan._plan_gradient_memory(needs(fog()))
    assert nothing == 0 and choice.choice == "0.0 MiB besides the rays (no grid)"


def test_a_gradient_that_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where derivatives are asked for, and the free memory is known; to the byte."""
    asked, medium = {"parameters": ("sigma_t",)}, fog((2000, 2000, 2000))
    memory = 8 * 2000**3
    monkeypatch.setattr(plan, "free_memory", lambda: memory)
    assert plan._plan_gradient_memory(needs(medium, **asked))[0] == memory
    monkeypatch.setattr(plan, "free_memory", lambda: memory - 1)
    wanted = f"a gradient step would take {memory / GIB:.1f} GiB and {memory / GIB:.1f} GiB are free; lower the resolution"
    for variant in ("llvm_ad_rgb", "cuda_ad_rgb"):
        with pytest.raises(MivolError, match=f"{wanted} of the grids: 99 % of their nodes"):
            plan._plan_gradient_memory(needs(medium, variant=variant, **asked))
    assert plan._plan_gradient_memory(needs(medium))[0] == memory
    monkeypatch.setattr(plan, "free_memory", lambda: None)
    assert plan._plan_gradient_memory(needs(medium, **asked))[0] == memory


@pytest.mark.parametrize(
    ("media", "settings", "more", "segment"),
    [
        ((fog(),), Settings(max_depth=2), {}, "single_scattering"),
        ((fog(),), Settings(max_depth=1), {}, "absorption"),
        ((fog(),), Settings(max_depth=2), {"emitter_kinds": ()}, "absorption"),
        ((fog(is_scattering=False),), Settings(max_depth=2), {}, "absorption"),
        ((fog(is_scattering=False), fog()), Settings(max_depth=2), {}, "single_scattering"),
        ((fog(),), Settings(max_depth=2, deterministic=True), {}, "scattering_quadrature"),
        ((fog(),), Settings(max_depth=3), {}, "free_flight"),
        ((fog(),), Settings(max_depth=2), {"refractive": ("glass",)}, "free_flight"),
        ((fog(), fog(bounded="Ball")), Settings(max_depth=2), {}, "free_flight"),
        ((fog(bounded="Ball", is_scattering=False), fog(is_scattering=False)), Settings(), {}, "tracked_absorption"),
        ((fog(emits=True, is_scattering=False), fog(is_scattering=False)), Settings(), {}, "emission"),
        ((fog(emits=True),), Settings(max_depth=2), {"emitter_kinds": ()}, "free_flight"),
    ],
)
def test_one_estimator_answers(media: tuple, settings: Settings, more: dict, segment: str) -> None:
    assert plan.choose_segment(needs(*media, **more), settings) == segment


def test_a_plan_holds_what_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids of few occupied blocks are skipped, shadows of many cells estimated, passes counted upwards."""
    for name in ("check_scattering", "check_emission_cells", "check_quadrature", "check_placements", "check_bounded"):
        monkeypatch.setattr(plan, name, lambda *_: None)
    monkeypatch.setattr(plan, "free_memory", lambda: None)
    thin, thick = (
        fog((200, 200, 200), occupied=plan.MAX_SKIPPED_SHARE - 1e-9),
        fog((300, 300, 300), occupied=plan.MAX_SKIPPED_SHARE),
    )
    homogeneous = fog(occupied=0.0)
    asked = needs(thin, thick, homogeneous, film_samples=2**24 + 1, emitter_kinds=("extended",), surfaces=("Rectangle",),
                  boundaries=[SimpleNamespace(box="a box", hole=None)] * 3, are_emitters_far=False,
                  has_lamps=False, emitters=(), emitter_distances=(0.2, 0.0, math.inf, 0.0))  # fmt: skip
    made = plan.make_plan(asked, Settings(max_depth=2))
    assert (made.skips_empty, made.trims) == ((True, True, False), (False, True, False))
    assert made.estimates_shadows == (False, True, False)
    assert (made.segment, made.scattering_points, made.side_flight_cosine) == ("single_scattering", 1, None)
    assert made.pass_rays == min(2**22, 2**29 // 1500)
    assert made.near_emitters == (1, 3)
    assert made.occupied == math.ceil(8 * (plan.MAX_SKIPPED_SHARE - 1e-9)) / 8
    passes = math.ceil((2**24 + 1) / made.pass_rays)
    said = {choice.subject: choice.choice for choice in made.choices}
    assert said["passes"] == f"{passes}, of at most {made.pass_rays:,} rays each"
    assert [c.choice for c in made.choices if c.subject == "empty space in fog"] == [
        "skipped",
        "skipped before and behind the content",
    ]
    assert [c.choice for c in made.choices if c.subject == "shadows of fog"] == ["exact", "estimated"]
    assert made.gradient_bytes == plan._plan_gradient_memory(asked)[0]
    asked.media = (thin, fog((300, 300, 300), occupied=plan.MAX_TRIMMED_SHARE), homogeneous)
    assert plan.make_plan(asked, Settings(max_depth=2)).skips_empty == (True, False, False)


def test_facts_with_the_same_key_have_the_same_decisions(monkeypatch: pytest.MonkeyPatch) -> None:
    """For numbers drawn around their limits; some of them differ, and some share a key."""
    for name in ("check_scattering", "check_emission_cells", "check_quadrature", "check_placements", "check_bounded"):
        monkeypatch.setattr(plan, name, lambda *_: None)
    for module in (plan, choices):
        monkeypatch.setattr(module, "MIN_FILLED_SHARE", 0.3)  # not at a step of the share
    rng, decisions = np.random.default_rng(5), {}
    for _ in range(400):
        occupied = rng.uniform() * rng.choice([0.3, 1.0])
        numbers = {
            "occupied": occupied,
            "tau_max": 140 * rng.uniform(),
            "albedo_min": rng.uniform(),
            "tau_min": 2 * rng.uniform(),
            "cell_depth": 2 * rng.uniform(),
        }
        facts = fog((100, 100, 180), **numbers)
        lit = {
            "emitter_kinds": ("extended",),
            "emitter_distances": (0.2,),
            "near_gain": 2.0,
            "surfaces": (),
            "has_lamps": False,
            "emitters": (),
            "has_glass": False,
        }
        asked = needs(facts, boundaries=[SimpleNamespace(box="a box", hole=None, around=None)], are_emitters_far=False,
                      nearness=0.2, is_sealed=False, branch_noise=None, are_samples_independent=False,
                      views=(), **lit)  # fmt: skip
        for depth in (2, 4):
            made = plan.make_plan(asked, Settings(max_depth=depth)).decisions
            assert decisions.setdefault((depth, plan_key(facts)), made) == made
    assert 20 < len(decisions) < 400 and len(set(decisions.values())) > 20


CASES = [
    (False, False, 2, False, False, False),
    (True, False, 2, False, False, False),
    (False, True, 2, False, False, False),
    (False, False, 4, False, False, False),
    (False, False, 4, True, False, False),
    (False, False, 4, True, True, True),
]


@pytest.mark.parametrize(("skips", "tracks", "depth", "near", "points", "looks"), CASES)
def test_a_grid_has_what_the_plan_asks_for(
    skips: bool, tracks: bool, depth: int, near: bool, points: bool, looks: bool
) -> None:
    """Nothing is read from the grid that no estimator will ask for."""
    values = np.zeros((8, 8, 8, 1), np.float32)
    values[2:4, 2:4, 2:4] = 1
    scene = close_up({"smoke": smoke(values)[0], "sky": sky()})
    survey, settings = survey_scene(scene), Settings(max_depth=depth)
    needs = find_needs(scene, scene.sensors()[0], survey)
    plan = make_plan(needs, settings)
    assert (plan.segment == "free_flight") == (depth == 4)
    asked = {"draws_near_light": near, "draws_points": points, "looks_up": looks}
    plan = replace(plan, skips_empty=(skips,), estimates_shadows=(tracks,), **asked)
    media = build_media(scene, needs, plan, survey)
    ((part,),) = [body.view.parts for body in media.bodies]
    assert (part.lattice.empty_distances is not None) == skips
    assert (part.lattice.block_ranges is not None) == (tracks or depth == 4)
    assert (part.rough is not None) == (near and not points)
    assert (None if part.largest is None else part.largest[0]) == (1 if looks else None)
    assert media.bodies[0].estimates_shadows == tracks
    assert not media.has_surfaces


@pytest.mark.parametrize(("depth", "scatterings"), [(-1, math.inf), (0, 0), (1, 0), (2, 1), (6, 5)])
def test_scatterings(depth: int, scatterings: float) -> None:
    """Depth 1 is what the camera sees directly, and each event adds 1; no limit is no limit."""
    assert Settings(max_depth=depth).scatterings == scatterings


def test_what_holds_where_nothing_is_said(variant_rgb: str) -> None:
    """The defaults of the integrator's documentation, for a scene file as for a script."""
    assert Settings() == Settings(max_depth=6, rr_depth=5, hide_emitters=False, deterministic=False, shadows="auto")
    assert mi.load_dict({"type": "mivol"}).session.settings == Settings()
