"""Plans of radiance field fits: stages, rates, grids and memory."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from ball_photos import BOX, PLAN
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, row_width
from mivol.optim.photographs import radiance_plan
from mivol.optim.photographs.radiance_plan import (
    PRESETS,
    RAY,
    SHELL,
    RadiancePlan,
    RadianceStage,
    allocated_bytes,
    check_memory,
    estimate_bytes,
)
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.photos import Photo
from mivol.space import place_grid


def test_memory_is_checked_first(variant_rgb: str, photos: list[Photo]) -> None:
    views = RayBatches.from_photos(photos[:2])
    text = check_memory(PRESETS["cpu"], BOX, views, limit=1 << 40)
    assert "MiB" in text
    assert_refused(r"512 nodes along an edge .* longest = (\d+) fits", check_memory, PRESETS["gpu"], BOX, views, limit=2 << 30)
    assert_refused("no resolution fits", check_memory, PRESETS["gpu"], BOX, views, limit=1000)


def test_an_array_takes_a_power_of_two() -> None:
    assert [allocated_bytes(n) for n in (0, 1, 2, 3, 4, 5, 1 << 20, (1 << 20) + 1)] == [0, 1, 2, 4, 4, 8, 1 << 20, 1 << 21]


@pytest.mark.parametrize("degree", [0, 2])
def test_bytes_of_a_stage(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, degree: int) -> None:
    """Density and coefficients (padded to four numbers) are there three times in float32, their squares twice in halves; a
    table of each pinhole is there once, derived once, and once more for each thread that adds to it. A row has six neighbours,
    a cell and what it takes to list it, a node half a byte."""
    plan, box = (
        RadiancePlan((RadianceStage(8, 1, 4, 2, 32), RadianceStage(16, 1, 1, 3, 64)), degree=degree),
        np.array([[-1.0] * 3, [1.0, 1, 0]]),
    )
    # Powers of two are held as they are: 2^10 rows with two views, of which a table takes 2^15 bytes.
    coefficients, nodes = 4 if degree == 0 else 32, np.prod(place_grid(box, 16)[0])
    assert allocated_bytes(row_width(basis_size(degree))) == coefficients
    for threads in (2, 8):
        monkeypatch.setattr(radiance_plan.dr, "thread_count", lambda threads=threads: threads)
        found = estimate_bytes(plan, replace(plan.stages[1], views=2), box, rows=1024)
        copies = 2 + threads * variant_rgb.startswith("llvm")
        lists = 1024 * (6 * 4 + 8 * 4 + 90) + nodes // 2
        assert found == 1024 * 16 * (1 + coefficients) + copies * 2**15 + lists + 2 * 64 * TILE**2 * RAY
    # The first stage keeps every node, later ones the shell that fits have kept; of a coarse grid that is all.
    finer = replace(plan, stages=(*plan.stages, RadianceStage(4 * SHELL, 1, 1, 3, 64)))
    for stage, share in zip(finer.stages, (1, 1, 0.25), strict=True):
        nodes = int(np.prod(place_grid(box, stage.longest)[0]))
        assert estimate_bytes(finer, stage, box) == estimate_bytes(finer, stage, box, rows=int(share * nodes))


#: The tables of 16 views make the first stage of the last one the larger.
PLANS = PRESETS | {"many views first": RadiancePlan((RadianceStage(64, 1, 1, 16, 64), RadianceStage(128, 1, 1, 2, 64)))}
TOO_LARGE = [("cpu", 36, 40), ("cpu", 128, 100), ("gpu", 300, 500), ("many views first", 128, 300)]


@pytest.mark.parametrize(("preset", "longest", "limit"), TOO_LARGE)
def test_suggested_resolution_fits(variant_rgb: str, photos: list[Photo], preset: str, longest: int, limit: int) -> None:
    """Taken as the next ``longest``, whichever stage then takes the most; one more is refused. Limits in MiB."""
    views = RayBatches.from_photos(photos[:2])

    def memory(nodes: int) -> str:
        return check_memory(PLANS[preset].with_longest(nodes), BOX, views, limit=limit << 20)

    with pytest.raises(MivolError) as refused:
        memory(longest)
    fits = int(re.search(r"longest = (\d+) fits", str(refused.value)).group(1))
    assert "about" in memory(fits)
    assert_refused(f"longest = {fits} fits", memory, fits + 1)


def test_grids_have_cubic_voxels_and_cover_the_box(variant_rgb: str) -> None:
    box = np.array([[0.0, 1, 2], [1, 1.5, 4]])
    res, to_world = place_grid(box, 20)
    assert res == (20, 5, 10)
    np.testing.assert_allclose(np.diag(to_world)[:3] / res[::-1], 0.1)
    np.testing.assert_allclose(to_world[:3, 3], box[0], atol=1e-12)
    flat, place = place_grid(np.array([[0.0, 0, 0], [1, 0, 0.05]]), 10)
    assert flat == (1, 1, 10)
    np.testing.assert_allclose(place[:3, 3], [0, -0.05, -0.025], atol=1e-12)


def test_former_last_stage_takes_half_its_steps() -> None:
    plan = RadiancePlan((RadianceStage(8, 10), RadianceStage(16, 31)))
    assert [(stage.longest, stage.steps) for stage in plan.with_longest(40).stages] == [(8, 10), (16, 15), (40, 31)]
    assert [(stage.longest, stage.steps) for stage in plan.with_longest(12).stages] == [(8, 10), (12, 31)]
    assert plan.with_longest(16) == plan


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_learns_densities_and_colours_to_its_end(name: str) -> None:
    plan = PRESETS[name]
    assert min(plan.learning_rates(0)) > 0 and min(plan.learning_rates(plan.steps)) > 0


def test_schedules() -> None:
    plan = replace(PLAN, delay=0.1, last=0.01)
    assert (plan.stage_starts, plan.steps) == ((60,), 150)
    assert [event.due(step) for event in plan.course().events[:1] for step in (0, 59, 60, 61)] == [False, False, True, False]
    assert (plan.drop_steps, replace(plan, drop=0.1).drop_steps, replace(plan, drop=1e-6).drop_steps) == ((), (69,), (61,))
    dropping = replace(plan, drop=0.1).course().events[1]
    assert [step for step in range(150) if dropping.due(step)] == [69]
    assert plan.learning_rates(0) == pytest.approx((0.1, 0.05))
    assert plan.learning_rates(150) == pytest.approx((0.1, 0.0005))
    slower = replace(plan, stages=(replace(plan.stages[0], rate=0.25), plan.stages[1]))
    assert [slower.learning_rates(step)[0] / plan.learning_rates(step)[0] for step in (0, 59, 60, 150)] == pytest.approx(
        [0.25, 0.25, 1, 1]
    )
    assert [slower.learning_rates(step)[1] == plan.learning_rates(step)[1] for step in (0, 59, 60)] == [True] * 3
    climbing = RadiancePlan((RadianceStage(8, 1), RadianceStage(16, 1), RadianceStage(32, 1)), degree=2, first_degree=0)
    assert [climbing.degree_at(k) for k in range(3)] == [0, 1, 2]
    assert [replace(climbing, first_degree=None).degree_at(k) for k in range(3)] == [2, 2, 2]
