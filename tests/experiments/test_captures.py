"""A capture of an unbounded place, from a folder of photographs to its page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from capture_photos import DISTANCE, capture, write_capture

from mivol.cli import main
from mivol.fields.field_files import read_field
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos.region import is_free_space, middle_box
from mivol.validate.metrics import score_image

PLAN = replace(
    PRESETS["capture"], stages=(RadianceStage(12, 60, 1, 6, 24), RadianceStage(24, 140, 1, 6, 24)), degree=0, sky=16, levels=4
)


def held_out_psnr(plan: RadiancePlan) -> list[float]:
    """PSNR of every fourth photograph after a fit to the others."""
    photos = capture(24)
    train, aside = [p for n, p in enumerate(photos) if n % 4], photos[::4]
    box = middle_box([photo.camera for photo in train])
    fit = begin_fit(RadianceProblem(RayBatches.from_photos(train), box, plan), plan.optimizer, plan.course()).complete()
    seen = [render_view(fit.problem.field, photo.camera, fit.problem.sky).image for photo in aside]
    return [score_image(image, photo.image).values["psnr"] for image, photo in zip(seen, aside, strict=True)]


@pytest.mark.slow
def test_nested_boxes_hold_the_walls_that_one_box_and_a_sky_do_not(variant_rgb: str) -> None:
    """Walls at three times the cameras' distance move against the ball: no sky at infinity shows them from all places."""
    nested, one = held_out_psnr(PLAN), held_out_psnr(replace(PLAN, levels=1, near=0.0))
    assert np.mean(nested) > np.mean(one) + MARGIN


MARGIN = 1.0
"""[dB] They were 2.3 apart; which pixels are drawn moves either by some tenths."""


def test_nodes_in_free_space_hold_no_matter(variant_rgb: str) -> None:
    """At the start, after steps, and on the nodes of the next stage; other nodes have matter."""
    photos = capture(5)
    box, all_cameras = middle_box([photo.camera for photo in photos]), [photo.camera for photo in photos]
    plan = replace(PLAN, stages=(RadianceStage(6, 2, 1, 3, 4), RadianceStage(8, 1, 1, 3, 4)), levels=3, free_space=True)
    fit = begin_fit(RadianceProblem(RayBatches.from_photos(photos), box, plan), plan.optimizer, plan.course())
    for stage in (0, 0, 0, 1):
        field, density = fit.problem.field, np.array(fit.run.reals["density"])
        free = is_free_space(all_cameras, field.node_positions(), DISTANCE)
        assert fit.problem.stage == stage and 0 < free.mean() < 0.9
        assert not density[: len(free)][free].any() and (density[: len(free)][~free] > 0).any()
        if not fit.is_done:
            fit.advance()


def test_free_space_that_no_node_is_in_changes_nothing(variant_rgb: str) -> None:
    """All photographs look at the inner box, and none stands in it."""
    photos = capture(8)
    batches, box = RayBatches.from_photos(photos), middle_box([photo.camera for photo in photos])
    plan = replace(PLAN, stages=(RadianceStage(6, 3, 1, 3, 4),), levels=1)
    without, ruled = (RadianceProblem(batches, box, replace(plan, free_space=rule)) for rule in (False, True))
    start = without.initial_reals()
    changed = {name: mi.TensorXf(np.array(value) - 0.3) for name, value in start.items()}
    for problem in (without, ruled):
        problem.loss_and_gradient(problem.initial_reals(), 0)
    moved, kept = (problem.after_step(dict(changed), 0) for problem in (without, ruled))
    for name, value in ruled.initial_reals().items():
        np.testing.assert_array_equal(np.array(value), np.array(start[name]), err_msg=name)
        np.testing.assert_array_equal(np.array(kept[name]), np.array(moved[name]), err_msg=name)


def test_positions_of_stored_nodes(variant_rgb: str) -> None:
    """Centres of the cells of each level; nodes that an inner level covers are not stored."""
    plan = replace(PLAN, stages=(RadianceStage(16, 1, 1, 3, 4),), levels=2)
    field = RadianceProblem(RayBatches.from_photos(capture(3)), np.array([[-1.0, -1, -0.5], [1, 1, 0.5]]) + 5, plan).field
    assert field.res == (8, 16, 16) and 2048 < len(field.stored_nodes()) < 4096
    level, z, y, x = np.unravel_index(field.stored_nodes(), (2, 8, 16, 16))
    expected = 5 + 2.0 ** level[:, None] * np.stack([x - 7.5, y - 7.5, z - 3.5], axis=1) / 8
    np.testing.assert_allclose(field.node_positions(), expected, rtol=1e-12)


@pytest.mark.slow
def test_what_is_near_a_camera_moves_less(variant_rgb: str) -> None:
    """Photographs 2 from the middle; all that they see is nearer than 100 times that: derivatives go by t^2 / 200^2."""
    photos = capture(4)
    slopes = []
    for near in (0.0, 100.0):
        plan = replace(PLAN, near=near)
        problem = RadianceProblem(RayBatches.from_photos(photos), middle_box([photo.camera for photo in photos]), plan)
        slopes.append(np.linalg.norm(np.array(problem.loss_and_gradient(problem.initial_reals(), 0)[1]["density"])))
    # Of all together: rays that want opposite things of a node may leave any ratio at it.
    assert 0 < slopes[1] < (REACH / 200) ** 2 * slopes[0]


REACH = 0.9 * 2**3 * 3**0.5 + 2
"""[length] From a camera to the farthest corner of the outermost box at most."""


@pytest.mark.slow
def test_a_folder_of_photographs_becomes_a_page(tmp_path: Path) -> None:
    """With the command alone: all held-out views are on the page with their own figures, the worst first."""
    folder, run = write_capture(tmp_path / "photos", 16), tmp_path / "run"
    few = ["--set", "field.longest=16", "--set", "field.effort=0.1", "--set", "show.frames=0"]
    assert main(["optimize", "--as", "grid", "--preset", "capture", str(folder), "-o", str(run), *few]) == 0
    record = json.loads((run / "run.json").read_text())
    table = next(t for t in record["tables"] if t["title"].startswith("Held-out views, at 32 x 24"))
    assert {row[0] for row in table["rows"]} == {"view_00.png", "view_08.png"}
    figures = [float(row[1]) for row in table["rows"]]
    assert figures == sorted(figures) and np.mean(figures) == pytest.approx(record["results"]["held_out_psnr"], abs=0.01)
    # A fit of two numbers a channel is nearer to the photograph than the view itself, but for 8 bits.
    assert all(float(row[3]) > float(row[1]) - 0.1 for row in table["rows"])
    page = (run / "report.html").read_text()
    assert "view_08.png" in page and "after colour correction" in page
    assert record["judged"] == "2 views at 32 x 24 pixels" and "2 views at 32 x 24 pixels; " in page.replace("\u00a0", " ")
    assert page.count("|Render − reference|") >= 2 and "the worst of 2: PSNR" in page
    field = read_field(run / "field.npz")
    assert field.levels == 5 and field.degree == 1
    assert (run / "volumes/density-level-4.vol").is_file()
    assert {"5 nested boxes" in line["choice"] for line in record["plan"]} == {True, False}
