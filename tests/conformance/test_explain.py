"""The text that says what a scene needs: every fact of a medium in its line."""

from __future__ import annotations

import bounded_ball
import mitsuba as mi
import numpy as np
import pytest

from mivol.experiments.script import explain
from mivol.scene.explain import _padded_box, choose_recording
from scenes import ball_of, box_of, camera, centred, grid_volume, medium

PLACE = centred(2 * np.eye(3))


def facts(interior: dict, depth: int = 1, **more: dict) -> dict[str, str]:
    """The lines of facts, by their first word."""
    scene = mi.load_dict({"type": "scene", "fog": box_of(interior, PLACE), "sensor": camera([0, -9, 0], [0, 0, 0]), **more})
    lines = explain(scene, max_depth=depth).partition("plan\n")[0].splitlines()[1:]
    return {line.split()[0]: line.split(maxsplit=1)[1] for line in lines}


def test_a_number_in_a_box_is_homogeneous():
    """Its optical depth is that of the diagonal of a box of 2."""
    found = facts(medium("homogeneous", 0.5))
    assert found["medium"].startswith("fog: HomogeneousMedium in a box")
    assert ", grey extinction, homogeneous, albedo 0, IsotropicPhaseFunction, optical depth at most 1.73" in found["medium"]
    assert (found["surfaces"], found["emitters"]) == ("none", "none")
    assert found["camera"] == "outside all traced boundaries" and found["variant"].startswith(mi.variant())


def test_the_padded_box_holds_the_medium():
    """A cube from -1 to 1, and a thousandth of its edge on each side."""
    scene = mi.load_dict({"type": "scene", "fog": box_of(medium("homogeneous", 0.5), PLACE)})
    place = _padded_box(scene, scene.shapes()[0].interior_medium()).to_world
    corners = np.array([[0, 0, 0, 1], [1, 1, 1, 1]]) @ np.array(place).T
    np.testing.assert_allclose(corners[:, :3], [[-1.002] * 3, [1.002] * 3], rtol=1e-6)


def test_a_grid_says_its_voxels_and_a_bounded_field_its_name():
    grid = grid_volume("mivol_voxels", np.ones((3, 4, 5, 3)), PLACE)
    assert ", rgb extinction, 3x4x5, scatters, " in facts(medium("mivol_medium", grid, 0.5))["medium"]
    bounded_ball.register()
    ball = facts(medium("mivol_medium", {"type": "test_ball", "sigma": 1.5}))["medium"]
    assert ", grey extinction, a bounded Ball, albedo 0, " in ball


def test_surfaces_emitters_and_a_camera_inside():
    inside = ball_of(medium("homogeneous", 0.5), (0, -9, 0), 2.0) | {"type": "cylinder", "p0": [0, -11, 0], "p1": [0, -7, 0]}
    del inside["center"]
    found = facts(medium("homogeneous", 0.5), wall={"type": "rectangle"}, sky={"type": "constant"}, around=inside)
    assert found["surfaces"] == "Rectangle" and found["emitters"].startswith("ConstantBackgroundEmitter")
    assert found["camera"] == "may be inside a medium"


@pytest.mark.parametrize(("value", "doubtful"), [(0.01, False), (5.0, True)])
def test_what_one_scattering_leaves_out(value: float, doubtful: bool) -> None:
    """Of thin fog little, of dense fog most; of fog that does not scatter nothing is said."""
    parts = {"fog": box_of(medium("homogeneous", value, 0.9), PLACE), "sky": {"type": "constant"}}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": camera([0, -9, 0], [0, 0, 0])})
    text = explain(scene, max_depth=2)
    assert "of the light that fog scatters (albedo 0.90, optical depth" in text and "constant light, isotropic phase)" in text
    assert ("depth 2 is a poor model of this medium" in text) == doubtful
    assert "one scattering" not in explain(scene, max_depth=1)


def test_a_surface_in_a_medium_does_not_hide_it():
    """A diffuse ball whose exterior is the fog: the warning is about media inside opaque shapes only."""
    fog = medium("homogeneous", 0.5) | {"id": "fog"}
    stone = {"type": "sphere", "radius": 0.2, "exterior": {"type": "ref", "id": "fog"}}
    parts = {"smoke": box_of(fog, PLACE), "stone": stone, "sensor": camera([0, -9, 0], [0, 0, 0])}
    assert "opaque" not in explain(mi.load_dict({"type": "scene", **parts}))
    parts["stone"] = {"type": "sphere", "radius": 0.2, "interior": medium("homogeneous", 0.7)}
    assert "the medium of stone lies behind an opaque" in explain(mi.load_dict({"type": "scene", **parts}))


@pytest.mark.parametrize(("for_images", "subject"), [(True, "images"), (False, "gradients")])
def test_what_is_not_recorded_is_traced_with_its_reason(monkeypatch: pytest.MonkeyPatch, for_images: bool, subject: str):
    scene = mi.load_dict({"type": "scene", "pane": {"type": "rectangle", "bsdf": {"type": "dielectric"}}})
    for unrecorded, choice in ((None, "recorded in the first call"), ("a GPU", "traced in every call")):
        monkeypatch.setattr("mivol.scene.explain.find_unrecorded", lambda *_, found=unrecorded: found)
        found = choose_recording(scene, None, None, None, for_images)
        assert found.subject == subject and found.choice.startswith(choice)
        assert found.reason == unrecorded or found.reason.endswith("anew: the film, the number of samples, pane.bsdf.eta")


@pytest.mark.parametrize("volume", ["grid", "hash grid"])
def test_quadrature_is_explained_with_the_depth_that_it_leaves_out(volume: str) -> None:
    """Previews of other depths draw light; another depth keeps the other settings."""
    sigma_t = {"type": "mivol_hash", "majorant": 3.0, "levels": 2, "finest": 6, "log2_table": 8}
    if volume == "grid":
        sigma_t = grid_volume("mivol_voxels", np.full((2, 2, 2, 1), 1.5), np.eye(4))
    integrator = {"type": "mivol", "max_depth": 2, "deterministic": True}
    scene = mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": camera((0.5, -2, 0.6), (0.5, 0.5, 0.5), 4, 16)}
        | {"lamp": {"type": "point", "position": [2, -1, 2]}, "box": box_of(medium("mivol_medium", sigma_t, 0.5), np.eye(4))}
    )
    text = explain(scene, noise=0.05)
    assert "one scattering by quadrature" in text and "depth 2 leaves out" in text and "refused" not in text
    assert ("two points in each half of a cell" in text) == (volume == "hash grid")
    assert "max_depth is 4; quadrature is for a single scattering" in explain(scene, max_depth=4)
