"""The page without a browser (a server that notes what is asked of it, a painter of flat pictures), and who may open it."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from mivol.cli import main
from mivol.errors import MivolError
from mivol.photos.camera_path import HomeView
from mivol.view import page as module
from mivol.view.page import FRAMES_A_SECOND, READ_ONLY, Page, cookie_name, find_fault
from mivol.view.subjects import Look
from mivol.view.transfer import COLOUR_MAPS, Transfer

BOX = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 4.0]])


class Handle:
    """A part of the page."""

    def __init__(self, value: Any, is_disabled: bool = False) -> None:
        self.value, self.content, self.is_disabled = value, value, is_disabled

    def on_update(self, call: Any) -> None:
        self.update = call

    on_click = on_update


class Server:
    """A server of viser that holds its handles by label, and what was drawn by name."""

    def __init__(self) -> None:
        self.gui, self.scene, self.initial_camera, self.is_running = self, self, SimpleNamespace(), True
        self.handles: dict[str, Handle] = {}
        self.ends: dict[str, tuple[float, float, float]] = {}
        self.drawn: dict[str, np.ndarray] = {}

    def configure_theme(self, **_: object) -> None:
        pass

    def set_up_direction(self, up: object) -> None:
        self.up = up

    def get_port(self) -> int:
        return 1234

    def stop(self) -> None:
        self.is_running = False

    def on_client_connect(self, call: Any) -> None:
        self.connect = call

    def on_client_disconnect(self, call: Any) -> None:
        self.disconnect = call

    @contextmanager
    def add_folder(self, name: str) -> Any:
        yield

    def add_markdown(self, text: str) -> Handle:
        return self.handles.setdefault("title" if "title" not in self.handles else "status", Handle(text))

    def add_slider(self, label: str, low: float, high: float, step: float, value: float, hint: str = "") -> Handle:
        self.ends[label] = low, high, step
        return self.handles.setdefault(label, Handle(value))

    def add_dropdown(self, label: str, options: object, initial_value: str) -> Handle:
        return self.handles.setdefault(label, Handle(initial_value))

    def add_checkbox(self, label: str, value: bool) -> Handle:
        return self.handles.setdefault(label, Handle(value))

    def add_button(self, label: str, disabled: bool = False) -> Handle:
        return self.handles.setdefault(label, Handle(None, disabled))

    def remove_by_name(self, name: str) -> None:
        self.drawn.pop(name, None)

    def add_spline_catmull_rom(self, name: str, places: np.ndarray, **_: object) -> None:
        self.drawn[name] = places

    def add_line_segments(self, name: str, ends: np.ndarray, **_: object) -> None:
        self.drawn[name] = ends


class FlatPainter:
    """Draws the number of the picture, and holds what was asked of it."""

    def __init__(self, subject: object, send: Any, look: Look) -> None:
        self.send, self.look, self.seen, self.count, self.changes, self.fault = send, look, {}, 0, 0, ""

    def change(self, look: Look | None = None) -> None:
        self.look, self.changes = look or self.look, self.changes + 1

    def see(self, page: int, camera: object) -> None:
        self.seen[page] = camera

    def forget(self, page: int) -> None:
        del self.seen[page]

    def draw(self, camera: object) -> np.ndarray:
        self.count += 1
        return np.full((2, 2, 3), self.count, np.uint8)

    def step(self) -> None:
        if self.fault:
            raise MivolError(self.fault)

    def give_up(self) -> None:
        self.fault = ""

    def clock(self) -> float:
        self.count += 1
        return float(self.count)


def client(number: int, x: float = 0.0) -> SimpleNamespace:
    """A page with a camera of a right angle at (x, 0, 5)."""
    camera = SimpleNamespace(
        image_width=64,
        image_height=32,
        fov=np.pi / 2,
        wxyz=(1, 0, 0, 0),
        position=np.array([x, 0, 5]),
        on_update=lambda _: None,
    )
    pictures: list[dict] = []
    scene = SimpleNamespace(set_background_image=lambda picture, **more: pictures.append(more))
    return SimpleNamespace(client_id=number, camera=camera, scene=scene, pictures=pictures, atomic=nullcontext)


def make_page(monkeypatch: pytest.MonkeyPatch, output: Path | None, survey: object = None) -> Page:
    """A page of a volume that can be cropped."""
    view = HomeView((0.0, 0.0, 1.0), (0.0, 0.0, 9.0), (0.0, 0.0, 0.0), 90.0, (200, 100))
    subject = SimpleNamespace(
        name="smoke", title="smoke, 1 m", box=BOX, survey=survey, has_values=True, can_crop=True, first_look=Look,
        first_view=lambda: view, save_crop=lambda folder, crop: folder / "smoke-crop.npz", refresh=lambda: True
    )  # fmt: skip
    monkeypatch.setattr(module, "check_viser", lambda: None)
    monkeypatch.setattr(module, "start_server", lambda port, token: Server())
    monkeypatch.setattr(module, "silence_viser", nullcontext)
    monkeypatch.setattr(module, "Painter", FlatPainter)
    return Page(subject, output)


def press(page: Page, label: str, by: SimpleNamespace | None = None) -> str:
    """Press a button and take its request; what the page says then."""
    page.server.handles[label].update(SimpleNamespace(client=by))
    page.step(0.0)
    return page.server.handles["status"].content


def test_the_first_camera_and_the_sliders(monkeypatch: pytest.MonkeyPatch) -> None:
    """A vertical field of view: tan(90 / 2 degrees) over the aspect 2. Crops leave a tenth of an edge, in steps of 0.01."""
    page = make_page(monkeypatch, None)
    camera, server = page.server.initial_camera, page.server
    assert page.address.startswith("http://127.0.0.1:1234/?token=")
    assert list(camera.position) == [0, 0, 9] and camera.fov == pytest.approx(2 * np.arctan(0.5)) and server.up == camera.up
    assert server.ends["x from"] == pytest.approx((-0.1, 1.1, 0.01)) and server.ends["z to"] == pytest.approx((-0.4, 4.4, 0.01))
    assert [server.handles[name].value for name in ("x from", "x to", "z to")] == pytest.approx([-0.1, 1.1, 4.4])
    assert server.handles["status"].content == READ_ONLY
    assert [server.handles[name].is_disabled for name in ("save crop", "render film")] == [True, True]
    assert press(page, "save crop") == READ_ONLY and press(page, "render film") == READ_ONLY


def test_a_page_begins_before_the_photograph_that_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """The photograph is a frustum's depth of 0.5 before its camera at (0, 0, 9), and hides what lies behind it."""
    monkeypatch.setattr(module, "frustum_size", lambda survey: 0.5)
    monkeypatch.setattr(module, "Frusta", lambda server, survey, fly: None)
    place = make_page(monkeypatch, None, survey=object()).server.initial_camera.position
    assert list(place[:2]) == [0, 0] and 7 < place[2] < 9 - 0.5


def test_sliders_become_a_look(monkeypatch: pytest.MonkeyPatch) -> None:
    page = make_page(monkeypatch, None)
    handles = page.server.handles
    handles["exposure"].value, handles["from"].value, handles["to"].value, handles["opacity"].value = 1.5, 0.6, 0.4, 0.2
    handles["colours"].value, handles["slice y"].value = COLOUR_MAPS[1], 0.25
    handles["exposure"].update(None)
    page.step(0.0)
    assert page.painter.look == Look(1.5, None, Transfer((0.6, 0.6), 0.2, COLOUR_MAPS[1], None))
    handles["show slices"].value = handles["show crop"].value = True
    handles["show crop"].update(None)
    page.step(0.0)
    assert page.painter.look.transfer.slices == (0.5, 0.25, 0.5)
    assert page.painter.look.crop == pytest.approx((-0.1, -0.2, -0.4, 1.1, 2.2, 4.4))
    edges = page.server.drawn["/crop"]
    lengths = np.sort(np.abs(edges[:, 1] - edges[:, 0]).sum(axis=1))
    assert edges.shape == (12, 2, 3) and lengths == pytest.approx(np.repeat([1.2, 2.4, 4.8], 4))
    assert len(np.unique(edges.reshape(-1, 3), axis=0)) == 8
    handles["show crop"].value = False
    handles["show crop"].update(None)
    page.step(0.0)
    assert page.painter.look.crop is None and "/crop" not in page.server.drawn


def test_pages_come_see_and_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    page, one = make_page(monkeypatch, None), client(7)
    page.server.connect(one)
    page.step(0.0)
    seen = page.painter.seen[7]
    # Half of the height over tan(45 degrees); the axes of OpenCV, looking along +z.
    assert seen.size == (64, 32) and seen.K[0, 0] == pytest.approx(16) and seen.forward == pytest.approx([0, 0, 1])
    for is_full in (False, True):
        page.painter.send(7, np.zeros((2, 2, 3), np.uint8), is_full)
    assert [picture["jpeg_quality"] for picture in one.pictures] == [75, 92]
    page._fly_to(one, seen)
    # The middle of the box, (0.5, 1, 2), is sqrt(0.25 + 1 + 9) away.
    assert one.camera.look_at == pytest.approx([0, 0, 5 + np.sqrt(10.25)]) and one.camera.fov == pytest.approx(np.pi / 2)
    page.server.disconnect(one)
    page.step(0.0)
    assert page.painter.seen == {}
    page.painter.send(7, np.zeros((2, 2, 3), np.uint8), True)
    assert len(one.pictures) == 2


def test_a_path_and_its_film(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two of three added views, a second of film, and no second film meanwhile; a refusal is said and ends the film."""
    written: list[tuple[Path, list]] = []
    monkeypatch.setattr(module, "write_video", lambda path, frames, fps: written.append((path, list(frames), fps)))
    page = make_page(monkeypatch, tmp_path)
    assert "add two views" in press(page, "render film")
    assert press(page, "add this view", client(1, 0)) == "1 views on the path"
    assert "/path" not in page.server.drawn
    for x in (1.0, 2.0):
        said = press(page, "add this view", client(1, x))
    assert said == "3 views on the path"
    assert press(page, "remove last view") == "2 views on the path"
    assert page.server.drawn["/path"].tolist() == [[0, 0, 5], [1, 0, 5]]
    page.server.handles["seconds"].value = 1
    page._begin_film()
    assert page.server.handles["status"].content == "film: 0 of 25 frames"
    page._begin_film()
    assert page.server.handles["status"].content == "a film is in the making"
    for count in range(1, FRAMES_A_SECOND + 1):
        page.step(0.0)
        assert page.server.handles["status"].content == f"film: {count} of 25 frames"
    page.step(0.0)
    ((path, frames, fps),) = written
    assert page.server.handles["status"].content == f"wrote {path}" and path.stem == "smoke-film" and fps == FRAMES_A_SECOND
    assert [frame[0, 0, 0] for frame in frames] == list(range(1, 26))
    page._begin_film()
    monkeypatch.setattr(page, "_film_step", lambda: (_ for _ in ()).throw(OSError("the disk is full")))
    page.step(0.0)
    assert page.server.handles["status"].content == "refused: the disk is full" and page._film is None


def test_a_crop_is_saved_and_faults_are_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    page = make_page(monkeypatch, tmp_path)
    assert press(page, "save crop") == "tick show crop first"
    page.server.handles["show crop"].value = True
    page.server.handles["show crop"].update(None)
    page.step(0.0)
    assert press(page, "save crop") == f"wrote {tmp_path / 'smoke-crop.npz'}"
    page.painter.fault = "the model is gone."
    page.step(0.0)
    assert page.server.handles["status"].content == "refused: the model is gone." and page.painter.fault == ""
    page.subject.title = "later"
    module.serve(page, iter([False, False, True]).__next__)
    assert page.server.handles["title"].content == "**later**" and not page.server.is_running


# -- The gate ----------------------------------------------------------------------------------------------------------

PORT, TOKEN = 8080, "a-token"
OWN = {"Host": "127.0.0.1:8080"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/?token=a-token", OWN),
        ("/?token=a-token", {"Host": "localhost:8080"}),
        ("/", OWN | {"Cookie": f"other=1; {cookie_name(PORT)}=a-token"}),
        ("/", OWN | {"Cookie": f"{cookie_name(PORT)}=a-token", "Origin": "http://127.0.0.1:8080"}),
    ],
)
def test_requests_with_the_token_pass(path: str, headers: dict[str, str]) -> None:
    assert find_fault(path, headers, TOKEN, PORT) == ""


@pytest.mark.parametrize(
    ("path", "headers", "word"),
    [
        ("/", OWN, "token"),
        ("/?token=", OWN, "token"),
        ("/?token=a-tokem", OWN, "token"),
        ("/", OWN | {"Cookie": f"{cookie_name(8081)}=a-token"}, "token"),
        ("/?token=a-token", {"Host": "evil.example:8080"}, "host"),
        ("/?token=a-token", {"Host": "127.0.0.1:8081"}, "host"),
        ("/?token=a-token", {}, "host"),
        ("/?token=a-token", OWN | {"Origin": "http://evil.example"}, "another page"),
        ("/?token=a-token", OWN | {"Origin": "null"}, "another page"),
    ],
)
def test_other_requests_are_turned_away(path: str, headers: dict[str, str], word: str) -> None:
    assert word in find_fault(path, headers, TOKEN, PORT)


def test_viser_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Before the path is looked at: the wheel alone names its extra."""
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    assert main(["view", "nothing"]) == 1
    assert 'pip install "mivol[viewer]"' in capsys.readouterr().err


@pytest.mark.parametrize("port", [0, 70_000])
def test_ports_that_no_server_has_are_refused(port: int) -> None:
    assert_refused("expected 1 to 65535", module.start_server, port, TOKEN)
