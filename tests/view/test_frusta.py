"""Frusta of photographs in the live view: their size, their place and their pictures, on a server that only takes notes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from refusals import assert_refused

from mivol.files import write_exr
from mivol.photos import Camera, intrinsics
from mivol.view import frusta


def camera(x: float, y: float = 0.0, size: tuple[int, int] = (200, 100)) -> Camera:
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return Camera(intrinsics(50, 50, size[0] / 2, size[1] / 2), size, pose)


def survey(*cameras: Camera, held_out: tuple[int, ...] = (), files: list[Path] | None = None) -> SimpleNamespace:
    """Photographs of the box of edge 2 around the origin."""
    frames = [
        SimpleNamespace(
            camera=each, split="test" if k in held_out else "train", file=files[k] if files else None, orientation=1
        )
        for k, each in enumerate(cameras)
    ]
    return SimpleNamespace(frames=frames, box=np.array([[-1.0] * 3, [1.0] * 3]))


@pytest.mark.parametrize(
    ("places", "size"),
    [
        ([3], 0.05 * 3),  # a twentieth of the distance to the middle
        ([3, 3], 0.05 * 3),  # copies have no distance,
        ([3, 3, 3, 3.125, 9], 0.05 * 3),  # and do not count
        ([3, 4.5, 6], 0.05 * 4.5),  # a twentieth of the median distance, if cameras are far apart,
        ([3, 3.125, 3.25, 9], 0.4 * 0.125),  # else two fifths of the median distance of neighbours
    ],
)
def test_frusta_are_small_beside_the_subject_and_the_gaps(places: list[float], size: float) -> None:
    assert frusta.frustum_size(survey(*map(camera, places))) == pytest.approx(min(size, 0.05 * np.median(places)))


class Notes:
    """A server of viser that notes what is added."""

    def __init__(self) -> None:
        self.gui, self.scene, self.boxes, self.frames, self.added = self, self, {}, {}, []

    def add_checkbox(self, label: str, is_on: bool) -> SimpleNamespace:
        box = SimpleNamespace(call=None, on_update=lambda call: setattr(box, "call", call))
        self.boxes[label] = box
        assert is_on
        return box

    def add_frame(self, name: str, show_axes: bool) -> SimpleNamespace:
        self.frames[name] = SimpleNamespace(name=name, visible=True)
        assert not show_axes
        return self.frames[name]

    def add_camera_frustum(self, name: str, **facts: object) -> SimpleNamespace:
        handle = SimpleNamespace(name=name, image=None, call=None, on_click=lambda call: setattr(handle, "call", call), **facts)
        self.added.append(handle)
        return handle


def test_a_frustum_stands_in_its_camera_and_flies_there() -> None:
    notes, flown = Notes(), []
    photos = survey(camera(3), camera(4), camera(0, 5), held_out=(1,))
    shown = frusta.Frusta(notes, photos, lambda *given: flown.append(given))
    assert list(notes.boxes) == ["train photographs (2)", "held out photographs (1)"]
    assert [handle.color for handle in notes.added] == [
        frusta.COLOURS[k] for k in (frusta.TRAIN, frusta.HELD_OUT, frusta.TRAIN)
    ]
    for handle, frame in zip(notes.added, photos.frames, strict=True):
        # 100 rows at a focal length of 50 pixels: 45 degrees to either side. Half a turn about x, from mivol's axes to viser's.
        assert handle.fov == pytest.approx(np.pi / 2) and handle.aspect == 2
        # viser divides the volume of 2, 1 and 1 by 3 and takes the third root: two thirds of the depth cubed.
        assert handle.scale == pytest.approx(frusta.frustum_size(photos) * (2 / 3) ** (1 / 3))
        assert (handle.thickness, handle.thickness_units) == (1.5, "screen")
        assert np.abs(handle.wxyz) == pytest.approx([0, 1, 0, 0])
        assert np.array_equal(handle.position, frame.camera.origin)
        handle.call(SimpleNamespace(client="page"))
        assert flown[-1][0] == "page" and np.array_equal(flown[-1][1].origin, frame.camera.origin)
    notes.boxes["held out photographs (1)"].call(SimpleNamespace(target=SimpleNamespace(value=False)))
    assert [frame.visible for frame in notes.frames.values()] == [True, False]
    assert shown.is_loading and not frusta.Frusta(Notes(), None, print).is_loading


def test_of_many_photographs_some_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frusta, "MOST", 4)
    notes = Notes()
    frusta.Frusta(notes, survey(*map(camera, range(1, 10))), print)
    assert [handle.position[0] for handle in notes.added] == [1, 4, 7]


def test_pictures_come_one_by_one(tmp_path: Path) -> None:
    """The longest edge has 160 pixels, of OpenEXR too; a damaged file is refused, and the next one is read."""
    colour = np.zeros((200, 400, 3), np.uint8)
    colour[..., 0] = 200
    Image.fromarray(colour).save(tmp_path / "a.png")
    write_exr(tmp_path / "b.exr", {"": np.full((100, 400, 3), 1.0, np.float32)})
    (tmp_path / "c.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    Image.fromarray(colour[:20, :40]).save(tmp_path / "d.png")
    notes = Notes()
    files = [tmp_path / name for name in ("a.png", "b.exr", "c.png", "d.png")]
    shown = frusta.Frusta(notes, survey(*map(camera, range(1, 5)), files=files), print)
    shown.load_next()
    shown.load_next()
    assert_refused(r"c\.png", shown.load_next)
    shown.load_next()
    assert not shown.is_loading
    assert [None if h.image is None else h.image.shape for h in notes.added] == [(80, 160, 3), (40, 160, 3), None, (20, 40, 3)]
    assert (notes.added[0].image == [200, 0, 0]).all() and (notes.added[1].image == 255).all()
