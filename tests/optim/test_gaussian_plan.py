"""Plans of Gaussian fits: counts, rates, filters and memory against formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.optim.events import CoarseToFine, ControlDensity, UpdateOccupancy
from mivol.optim.first_order import Adam
from mivol.optim.gaussians.gaussian_plan import PRESETS, GaussianPlan, GaussianStage, check_memory, estimate_bytes, scene_extent
from mivol.photos import Camera

PLAN = GaussianPlan(
    (GaussianStage(100, 30, 0), GaussianStage(200, 50, 1), GaussianStage(400, 120, 3)),
    start=100,
    most=900,
    control_every=7,
    growth=(0.1, 0.6),
)


def test_plan_counts_steps_and_stage_starts() -> None:
    more = UpdateOccupancy(every=3)
    course = PLAN.course(more)
    assert (PLAN.steps, PLAN.degree, PLAN.stage_starts) == (200, 3, (30, 80))
    assert course.iterations == 200
    assert course.events == (CoarseToFine(at=(30, 80)), ControlDensity(every=7, begin=20, end=120), more)
    # Control begins at 1 at the earliest, when there is something to tell, and ends after it has begun.
    assert replace(PLAN, growth=(0.0, 0.0)).course().events[1] == ControlDensity(every=7, begin=1, end=2)
    assert PLAN.optimizer == Adam(epsilon=1e-12)


@pytest.mark.parametrize("step", [0, 12, 13, 14, 20, 63, 112, 113, 114, 199])
@pytest.mark.parametrize("start", [100, 500, 900, 1200])
def test_growth_is_linear_in_time(step: int, start: int) -> None:
    """Growth is spread over the steps 20 to 120, and what is allowed holds to the next change, 7 steps on."""
    share = np.clip((step + 7 - 20) / 100, 0, 1)
    assert PLAN.count_at(step, start) == start + round(max(900 - start, 0) * share)


def test_growth_over_no_steps_is_a_jump() -> None:
    sudden = replace(PLAN, growth=(0.1, 0.1))
    assert [sudden.count_at(step, 100) for step in (0, 13, 14, 50)] == [100, 100, 900, 900]


@pytest.mark.parametrize("step", [0, 50, 200])
def test_rates_are_geometric(step: int) -> None:
    """Places go from their first rate to their last, times the extent; the others to 0.3 of it: two roundings of each."""
    plan, share = replace(PLAN, position_rate=3e-3, final_position_rate=2e-5), step / 200
    falls = {"log_scales": 2e-2, "quaternions": 4e-3, "opacity_logits": 0.05, "harmonics": 1e-2}
    wanted = {"means": 2.5 * 3e-3 ** (1 - share) * 2e-5**share} | {k: v * 0.3**share for k, v in falls.items()}
    assert plan.learning_rates(step, 2.5) == pytest.approx(wanted, rel=1e-13)


@pytest.mark.parametrize("shrink", [1, 2, 4, 8])
def test_low_pass_has_the_variance_of_averaged_pixels(shrink: int) -> None:
    """That of the full size and of ``shrink`` points side by side, in units of the larger pixels."""
    points = np.arange(shrink)
    assert PLAN.low_pass_at(shrink) == pytest.approx((0.3 + points.var()) / shrink**2, rel=1e-14)


@pytest.mark.parametrize("edge", [50, 100, 141, 142, 290, 400, 800, 6000])
def test_photographs_shrink_by_the_nearest_power_of_two(edge: int) -> None:
    wanted = [max((1, 2, 4, 8, 16, 32, 64), key=lambda n, e=stage.edge: -abs(math.log2(edge / n / e))) for stage in PLAN.stages]
    made = PLAN.for_edge(edge)
    assert [stage.shrink for stage in made.stages] == wanted
    assert replace(made, stages=PLAN.stages) == PLAN
    assert [replace(stage, shrink=1) for stage in made.stages] == list(PLAN.stages)


def test_effort_scales_steps() -> None:
    assert [stage.steps for stage in PLAN.scaled(0.1).stages] == [3, 5, 12]
    assert [stage.steps for stage in PLAN.scaled(1e-6).stages] == [1, 1, 1]
    assert PLAN.scaled(2.0).steps == 400


def test_extent_follows_the_cameras() -> None:
    """Cameras at 0, 1 and 5 along an axis: their mean is 2, the farthest is 3 away."""
    poses = [np.eye(4) for _ in range(3)]
    for pose, x in zip(poses, (0.0, 1.0, 5.0), strict=True):
        pose[1, 3] = x
    K = np.array([[50.0, 0, 20], [0, 50, 20], [0, 0, 1]])
    assert scene_extent([Camera(K, (40, 40), pose) for pose in poses]) == pytest.approx(3.3, rel=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_memory_estimate_matches_its_formula(degree: int) -> None:
    """A Gaussian has 3 + 3 + 4 + 1 numbers and 3 for each harmonic: six float32 of each; 32 entries of lists of 100 bytes."""
    plan = replace(PLAN, stages=(GaussianStage(100, 30, degree),))
    assert estimate_bytes(plan, 1000, 0) == 1000 * (24 * (3 + 3 + 4 + 1 + 3 * (degree + 1) ** 2) + 3200)
    assert estimate_bytes(plan, 0, 5000) == 5000 * 160


def test_memory_is_described_and_checked(variant_rgb: str) -> None:
    """What is needed is what is there, to the byte; what fits is what would be taken."""
    pictures, pixels = 3 << 20, 10_000
    needed = pictures + estimate_bytes(PLAN, 900, pixels)
    said = f"about {needed / 2**20:.0f} MiB: 3 for photographs, the rest for Gaussians and an image"
    assert check_memory(PLAN, pictures, pixels, needed) == check_memory(PLAN, pictures, pixels) == said
    assert check_memory(replace(PLAN, start=900, most=1), pictures, pixels, needed) == said
    wanted = "a fit of 900 Gaussians needs 0.0 GiB of memory and 0.0 GiB are free: gaussians.most = 899 fits."
    with pytest.raises(MivolError) as refused:
        check_memory(PLAN, pictures, pixels, needed - 1)
    assert str(refused.value) == wanted
    with pytest.raises(MivolError, match=r"read the photographs smaller \(photos.scale\)"):
        check_memory(PLAN, pictures, pixels, pictures + estimate_bytes(PLAN, 1, pixels))
    large = 1 << 40
    with pytest.raises(MivolError, match=r"needs 1,024\.0 GiB of memory and 2\.0 GiB are free: read the photographs smaller"):
        check_memory(PLAN, large, 0, 2 << 30)


def test_minutes_become_steps_without_a_clock() -> None:
    """Twice the minutes are twice the steps, larger photographs take fewer, and the plan's own minutes leave it as it is."""
    plan = PRESETS["minute"].for_edge(200)
    own = plan.minutes(200 * 200)
    # 400 steps of (5 + 0.75 x 4.6 + 0.23 x 10) ms and 2000 of (5 + 0.75 x 10 + 0.23 x 40) ms
    assert own == pytest.approx((400 * 10.75 + 2000 * 21.7) / 60e3, rel=0.01)
    assert plan.in_minutes(own, 200 * 200) == plan
    assert plan.in_minutes(2 * own, 200 * 200).steps == 2 * plan.steps
    assert plan.in_minutes(own, 400 * 400).steps < 0.6 * plan.steps
