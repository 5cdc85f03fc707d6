"""Camera rigs: every camera sees the box from where its rig says, and bad settings are refused by a sentence."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.scene.sensors import RIGS, Hemisphere, LookAts, Ring, SceneSensors, find_media_box, look_at, parse_rig

BOX = np.array([[-1.0, 0.0, 2.0], [3.0, 1.0, 4.0]])
CENTER = BOX.mean(axis=0)
RADIUS = np.linalg.norm(BOX[1] - BOX[0]) / 2

PLACED = {
    "ring": Ring(count=5, elevation=20, distance=3, width=16, height=24),
    "half ring": Ring(count=3, arc=180, start=-90, up="z", width=16, height=16),
    "hemisphere": Hemisphere(count=9, distance=2.5, width=24, height=16),
    "sphere": Hemisphere(count=7, lowest=-90, up="x", width=16, height=16),
    "look_at": LookAts(origins=((9, 2, 1), (1, 9, 3)), targets=(tuple(CENTER),), width=16, height=16),
}


def _matrix(sensor: dict) -> np.ndarray:
    return np.array(sensor["to_world"].matrix, dtype=np.float64)


def _scene(**extra) -> mi.Scene:
    t = mi.ScalarTransform4f().translate(CENTER.tolist()).scale(((BOX[1] - BOX[0]) / 2).tolist())
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.0}
    cube = {"type": "cube", "to_world": t, "bsdf": {"type": "null"}, "interior": medium}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(50)}
    return mi.load_dict({"type": "scene", "cube": cube, "floor": floor, **extra})


@pytest.mark.parametrize("rig", PLACED.values(), ids=PLACED.keys())
def test_every_camera_sees_the_whole_box(variant_rgb, rig):
    """The corners of the box, put through Mitsuba's own projection, lie inside the image."""
    corners = np.array([[BOX[i, 0], BOX[j, 1], BOX[k, 2], 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    for described in rig.sensors_about(BOX):
        sensor = mi.load_dict(described)
        local = corners @ np.linalg.inv(_matrix(described)).T
        assert np.all(local[:, 2] > 0)
        projected = np.array(sensor.projection_transform().matrix).reshape(4, 4) @ local.T
        uv = projected[:2] / projected[3]
        # 1e-5: the projection is a float32 matrix product (4 terms, eps 6e-8, entries up to 50).
        assert np.all(uv > -1e-5) and np.all(uv < 1 + 1e-5)


def test_ring_positions(variant_rgb):
    """Equal radius, equal steps, the elevation asked for; an arc has both its ends, a circle no camera twice."""
    origins = np.array([_matrix(s)[:3, 3] for s in PLACED["ring"].sensors_about(BOX)]) - CENTER
    # 1e-6 relative: positions pass through a float32 matrix (eps 6e-8) of entries below 16.
    np.testing.assert_allclose(np.linalg.norm(origins, axis=1), 3 * RADIUS, rtol=1e-6)
    np.testing.assert_allclose(origins[:, 1], 3 * RADIUS * np.sin(np.radians(20)), rtol=1e-5)
    azimuth = np.degrees(np.unwrap(np.arctan2(origins[:, 0], origins[:, 2])))
    np.testing.assert_allclose(azimuth, 72 * np.arange(5), atol=1e-3)
    arc = np.array([_matrix(s)[:3, 3] for s in PLACED["half ring"].sensors_about(BOX)]) - CENTER
    np.testing.assert_allclose(arc / (4 * RADIUS), [[0, -1, 0], [1, 0, 0], [0, 1, 0]], atol=1e-6)


def test_hemisphere_is_even(variant_rgb):
    """Each camera stands for the same area: equal steps of height, and no direction is preferred."""
    rig = Hemisphere(count=64, lowest=-90)
    origins = np.array([_matrix(s)[:3, 3] for s in rig.sensors_about(BOX)]) - CENTER
    heights = origins[:, 1] / (4 * RADIUS)
    np.testing.assert_allclose(np.diff(heights), 2 / 64, rtol=1e-3)
    # The mean of 64 unit vectors: 1/sqrt(64) = 0.125 for a random set; the spiral is 10 times better.
    assert np.linalg.norm(origins.mean(axis=0)) / (4 * RADIUS) < 0.0125
    # Each of 64 has an area of 4 pi/64, a square of side 0.44: no two are nearer than half of that.
    apart = np.linalg.norm(origins[:, None] - origins, axis=2)[np.triu_indices(64, 1)] / (4 * RADIUS)
    assert apart.min() > 0.22


def test_look_at_is_mitsubas(variant_rgb):
    """The same frame as Mitsuba's own look_at, and a right-handed rotation where up is along the view."""
    pose = look_at(np.array([1.0, 2, 3]), np.array([-2.0, 0, 5]), np.array([0.1, 1, 0]))
    theirs = mi.ScalarTransform4f().look_at([1, 2, 3], [-2, 0, 5], [0.1, 1, 0])
    np.testing.assert_allclose(pose, np.array(theirs.matrix), atol=1e-6)  # float32 entries up to 3
    for up in ([0, 2, 0], [0, 0, 0]):
        r = look_at(np.zeros(3), np.array([0.0, 5, 0]), np.array(up, dtype=float))[:3, :3]
        np.testing.assert_allclose(r.T @ r, np.eye(3), atol=1e-15)
        assert np.linalg.det(r) > 0


def test_box_is_that_of_the_media(variant_rgb):
    """A floor does not count where a medium is; without media all shapes do."""
    np.testing.assert_allclose(find_media_box(_scene()), BOX, atol=1e-6)
    only_floor = mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}})
    np.testing.assert_allclose(find_media_box(only_floor), [[-1, -1, 0], [1, 1, 0]], atol=1e-6)
    assert_refused("no shape", find_media_box, mi.load_dict({"type": "scene", "light": {"type": "constant"}}))


def test_scene_sensors(variant_rgb):
    """The scene's own, all or some; none and wrong numbers are refused."""
    scene = _scene(a={"type": "perspective"}, b={"type": "orthographic"})
    assert len(SceneSensors().sensors(scene)) == 2
    chosen = SceneSensors(indices=(1,)).sensors(scene)
    assert [s.class_name() for s in chosen] == [scene.sensors()[1].class_name()]
    assert_refused("no sensor 2; its sensors are 0 to 1", SceneSensors(indices=(2,)).sensors, scene)


BAD = {
    "unknown rig": ({"rig": "rnig"}, 'did you mean "ring"'),
    "unknown setting": ({"rig": "ring", "elevaton": 3}, 'did you mean "elevation"'),
    "a rig like none": ({"rig": "wwwww"}, "known are: ring, hemisphere, look_at, scene\\."),
    "too close": ({"rig": "ring", "distance": 0.5}, "distance"),
    "no views": ({"rig": "hemisphere", "count": 0}, "count"),
    "wrong type": ({"rig": "ring", "count": "eight"}, "count"),
    "clipping": ({"rig": "ring", "near": 5, "far": 2}, "near = 5"),
    "targets": ({"rig": "look_at", "origins": [[0, 0, 1]] * 3, "targets": [[0, 0, 0]] * 2}, "2 targets for 3 origins"),
    "missing": ({"rig": "look_at", "origins": [[0, 0, 1]]}, "targets"),
}


@pytest.mark.parametrize(("table", "words"), BAD.values(), ids=BAD.keys())
def test_bad_tables_are_refused(table, words):
    """One sentence that names the setting."""
    assert_refused(words, parse_rig, table)


@pytest.mark.parametrize("name", RIGS)
def test_tables_name_every_rig(name):
    """Each rig is reached by its tag."""
    needed = {"look_at": {"origins": [[0, 0, 1]], "targets": [[0, 0, 0]]}}
    assert type(parse_rig({"rig": name, **needed.get(name, {})})) is RIGS[name]


def test_bad_boxes_and_poses(variant_rgb):
    """Empty and infinite boxes, a camera inside without a fov, a camera that looks at itself."""
    for box in (np.zeros((2, 3)), [[0, 0, 0], [1, np.inf, 1]], [[1, 1, 1], [0, 0, 0]]):
        assert_refused("finite and not empty", Ring().sensors_about, np.array(box))
    inside = LookAts(origins=(tuple(CENTER + 0.1),), targets=(tuple(CENTER),))
    assert_refused("give it a fov", inside.sensors_about, BOX)
    # On the sphere of radius 5 about a flat box: half a turn, which no pinhole sees.
    with pytest.raises(MivolError, match="give it a fov"):
        LookAts(origins=((0, 0, 5),), targets=((0, 0, 0),)).sensors_about(np.array([[-3.0, -4, 0], [3, 4, 0]]))
    assert_refused("looks at its own position", LookAts(origins=((1, 1, 1),), targets=((1, 1, 1),), fov=30).sensors_about, BOX)
