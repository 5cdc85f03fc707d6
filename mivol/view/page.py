"""The page in a browser, by viser: pictures behind, cameras and boxes in front, sliders beside; and who may open the page.

Conventions. Callbacks of viser run in its threads and only fill the inbox; :func:`serve` draws in the calling thread. viser's
cameras have OpenCV's axes and a vertical field of view [radian]. Sliders are shared by all pages, cameras are each page's own.

The gate. Any program of this machine, and any web page in a browser of it, can reach a port of the loopback address. A request
passes with the token in its address (``/?token=...``) or in the cookie that the answer to such a request sets; with a ``Host``
of this machine (a foreign name that resolves to 127.0.0.1 is the attack called DNS rebinding); and, from a browser, with an
``Origin`` of the page itself (pages may open web sockets to any host).
"""

from __future__ import annotations

import hmac
import http
import importlib.util
import secrets
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mivol.errors import MivolError
from mivol.experiments.film import film_suffix, write_video
from mivol.experiments.render import make_camera
from mivol.photos import Camera, interpolate_cameras, intrinsics
from mivol.photos.camera import FLIP
from mivol.view.frusta import Frusta, frustum_size
from mivol.view.painter import LONGEST, Inbox, Painter, scale_camera
from mivol.view.subjects import Look, Subject, new_file
from mivol.view.transfer import COLOUR_MAPS, Transfer

LOOPBACK = "127.0.0.1"

HOSTS = (LOOPBACK, "localhost")


def find_fault(path: str, headers: Mapping[str, str], token: str, port: int) -> str:
    """Why a request is turned away; empty for a request that passes.

    Args:
        path: of the request, with the query.
        headers: of the request; ``Host``, ``Origin`` and ``Cookie`` count.
        token: of the page.
        port: of the page.
    """
    places = [f"{host}:{port}" for host in HOSTS]
    if headers.get("Host", "").lower() not in places:
        return f"found another host, expected {places[0]}"
    origin = headers.get("Origin")
    if origin is not None and origin.lower() not in [f"http://{place}" for place in places]:
        return "found a request of another page, expected one of this page"
    given = [*urllib.parse.parse_qs(urllib.parse.urlsplit(path).query).get("token", [])]
    for part in headers.get("Cookie", "").split(";"):
        name, _, value = part.strip().partition("=")
        given += [value] if name == cookie_name(port) else []
    if not any(hmac.compare_digest(word.encode(), token.encode()) for word in given):
        return "found no token or a wrong one, expected the whole address that mivol view printed"
    return ""


def cookie_name(port: int) -> str:
    """Name of the cookie with the token; cookies know no ports, so the name has it."""
    return f"mivol_view_{port}"


@contextmanager
def guard_server(token: str, port: Callable[[], int]) -> Iterator[None]:
    """Put the gate before every server of ``websockets`` that starts meanwhile.

    viser has no option for it. Whoever starts a server here asks it afterwards for a page without a token, and stops if the
    answer is not a refusal.

    Args:
        token: of the page.
        port: returns the port of the server, known once it listens.
    """
    from websockets.asyncio import server

    original = server.serve

    def serve(*args: Any, process_request: Callable, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            fault = find_fault(request.path, request.headers, token, port())
            if fault:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{fault}\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Set-Cookie"] = f"{cookie_name(port())}={token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Cache-Control"] = "no-store"
            return response

        return original(*args, process_request=answer, **options)

    server.serve = serve
    try:
        yield
    finally:
        server.serve = original


# -- The page ----------------------------------------------------------------------------------------------------------

PORT = 8080

FRAMES_A_SECOND = 25

FILM_EDGE = 480
"""Longest edge of a film [pixel]."""

CROP_MARGIN = 0.1
"""What the first crop box leaves around the box of the subject, over the edges of that box."""

REFRESH = 1.0
"""Time between two looks at the files of a run [s]."""

READ_ONLY = "read only: start with --write FOLDER to save"


def check_viser() -> None:
    """Refuse to begin without viser.

    Raises:
        MivolError: viser is missing.
    """
    if importlib.util.find_spec("viser") is None:
        raise MivolError('the viewer needs viser, which is not installed: pip install "mivol[viewer]".')


def to_camera(camera: Any, size: tuple[int, int] | None = None) -> Camera:
    """The pinhole of a page's camera (a ``viser.CameraHandle``)."""
    width, height = size or (max(int(camera.image_width), 16), max(int(camera.image_height), 16))
    focal = height / 2 / np.tan(float(camera.fov) / 2)
    pose = np.eye(4)
    w, x, y, z = camera.wxyz
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix() * FLIP
    pose[:3, 3] = camera.position
    return Camera(intrinsics(focal, focal, width / 2, height / 2), (width, height), pose, name="page")


def start_server(port: int, token: str) -> Any:
    """Start viser behind the gate, on the loopback address.

    Raises:
        MivolError: a port that no server can have, or a gate that does not hold.
    """
    import viser

    if not 1 <= port <= 65535:
        raise MivolError(f"--port {port}: found no port, expected 1 to 65535; leave it out for {PORT}.")

    found = {"port": port}
    with guard_server(token, lambda: found["port"]), silence_viser():
        server = viser.ViserServer(host=LOOPBACK, port=port, label="mivol view", verbose=False)
        found["port"] = server.get_port()
    try:
        with urllib.request.urlopen(f"http://{LOOPBACK}:{server.get_port()}/", timeout=10) as answer:
            status = answer.status
    except urllib.error.HTTPError as error:
        status = error.code
    if status != 403:
        server.stop()
        raise MivolError(
            f"a page without a token got the answer {status}, expected 403: use a tested version of viser (1.1.1)."
        )
    return server


@contextmanager
def silence_viser() -> Any:
    """Keep viser's own lines from the terminal."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


@dataclass
class FilmJob:
    """A film in the making.

    Attributes:
        cameras: cameras of the frames.
        path: file to write.
        frames: pictures so far.
    """

    cameras: list[Camera]
    path: Path
    frames: list[np.ndarray] = field(default_factory=list)


class Page:
    """The server with its sliders, bound to a painter.

    Args:
        subject: what is shown.
        output: folder for crops and films; None writes nothing.
        port: port to try first.

    Attributes:
        address: address with the token.
        painter: draws the pictures.
        inbox: requests of the pages.
    """

    def __init__(self, subject: Subject, output: Path | None = None, port: int = PORT) -> None:
        check_viser()
        self.subject, self.output, self.inbox = subject, output, Inbox()
        self.painter = Painter(subject, self._send, subject.first_look())
        self._clients: dict[int, Any] = {}
        self._keys: list[Camera] = []
        self._film: FilmJob | None = None
        token = secrets.token_urlsafe(16)
        self.server = start_server(port, token)
        self.address = f"http://{LOOPBACK}:{self.server.get_port()}/?token={token}"
        self._place_camera()
        self._build()
        self.frusta = Frusta(self.server, subject.survey, self._fly_to)
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(lambda client: self.inbox.put(("leave", client.client_id)))

    def warm_up(self) -> None:
        """Draw the first view in all sizes of coarse pictures that suit it, so that no page waits for kernels."""
        view = self.subject.first_view()
        width, height = view.scaled(LONGEST)
        self.painter.warm_up(make_camera([*view.origin, *view.target], view.up, view.fov, (width, height)))

    # -- Pages ---------------------------------------------------------------------------------------------------------

    def _place_camera(self) -> None:
        view, camera = self.subject.first_view(), self.server.initial_camera
        aspect, origin = view.size[0] / view.size[1], np.array(view.origin)
        if self.subject.survey is not None:
            # Before the photographs that stand there and beside, which would hide the model.
            ahead = view.target - origin
            origin += 3 * frustum_size(self.subject.survey) * ahead / np.linalg.norm(ahead)
        camera.position, camera.look_at, camera.up = origin, view.target, view.up
        camera.fov = 2 * np.arctan(np.tan(np.radians(view.fov) / 2) / aspect)
        self.server.scene.set_up_direction(view.up)

    def _connect(self, client: Any) -> None:
        self.inbox.put(("camera", client.client_id), client)
        client.camera.on_update(lambda camera: self.inbox.put(("camera", client.client_id), client))

    def _send(self, page: Any, picture: np.ndarray, is_full: bool) -> None:
        client = self._clients.get(page)
        if client is not None:
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=92 if is_full else 75)

    def _fly_to(self, client: Any, camera: Camera) -> None:
        """Move a page's camera to a place."""
        reach = np.linalg.norm(self.subject.box.mean(axis=0) - camera.origin)
        with client.atomic():
            client.camera.position = camera.origin
            client.camera.look_at = camera.origin + max(float(reach), 1e-3) * camera.forward
            client.camera.up_direction = camera.to_world[:3, 1]
            client.camera.fov = 2 * np.arctan(camera.size[1] / 2 / camera.K[1, 1])

    # -- Sliders -------------------------------------------------------------------------------------------------------

    def _on_look(self, handle: Any) -> None:
        handle.on_update(lambda event: self.inbox.put("look"))

    def _on_press(self, button: Any, name: str) -> None:
        @button.on_click
        def _(event: Any) -> None:
            self.inbox.put((name, secrets.token_hex(4)), event.client)

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(dark_mode=True, control_layout="collapsible", show_logo=False, show_share_button=False)
        self._title = gui.add_markdown(f"**{self.subject.title}**")
        self._exposure = gui.add_slider("exposure", -5.0, 5.0, 0.1, 0.0, hint="each unit doubles the light")
        self._on_look(self._exposure)
        if self.subject.has_values:
            self._build_volume(gui)
        if self.subject.can_crop:
            self._build_crop(gui)
        self._build_film(gui)
        self._status = gui.add_markdown("" if self.output else READ_ONLY)

    def _build_volume(self, gui: Any) -> None:
        plain = self.painter.look.transfer
        with gui.add_folder("transfer function"):
            self._window = [gui.add_slider(name, 0.0, 1.0, 0.005, plain.window[end]) for end, name in enumerate(("from", "to"))]
            self._opacity = gui.add_slider("opacity", 0.01, 1.0, 0.01, plain.opacity)
            self._colours = gui.add_dropdown("colours", COLOUR_MAPS, initial_value=plain.colours)
        with gui.add_folder("slices"):
            self._is_sliced = gui.add_checkbox("show slices", False)
            self._slices = [gui.add_slider(f"slice {axis}", 0.0, 1.0, 0.005, 0.5) for axis in "xyz"]
        for handle in (*self._window, self._opacity, self._colours, self._is_sliced, *self._slices):
            self._on_look(handle)

    def _build_crop(self, gui: Any) -> None:
        low, high = self.subject.box
        low, high = low - CROP_MARGIN * (high - low), high + CROP_MARGIN * (high - low)
        step = 10.0 ** np.floor(np.log10((high - low).max() / 100))
        low, high = np.floor(low / step) * step, np.ceil(high / step) * step
        with gui.add_folder("crop"):
            self._is_cropped = gui.add_checkbox("show crop", False)
            self._crop: list[Any] = []
            for end, word in ((0, "from"), (1, "to")):
                for axis, letter in enumerate("xyz"):
                    ends = float(np.round(low[axis], 9)), float(np.round(high[axis], 9))
                    self._crop.append(gui.add_slider(f"{letter} {word}", *ends, float(step), ends[end]))
            save = gui.add_button("save crop", disabled=self.output is None)
        for handle in (self._is_cropped, *self._crop):
            self._on_look(handle)
        self._on_press(save, "save crop")

    def _build_film(self, gui: Any) -> None:
        with gui.add_folder("film"):
            add, remove = gui.add_button("add this view"), gui.add_button("remove last view")
            self._seconds = gui.add_slider("seconds", 1, 30, 1, 4)
            render = gui.add_button("render film", disabled=self.output is None)
        for button, name in ((add, "add view"), (remove, "remove view"), (render, "render film")):
            self._on_press(button, name)

    def _read_look(self) -> Look:
        transfer, crop = Transfer(), None
        if self.subject.has_values:
            slices = tuple(float(handle.value) for handle in self._slices) if self._is_sliced.value else None
            window = tuple(float(handle.value) for handle in self._window)
            transfer = Transfer((window[0], max(window)), float(self._opacity.value), self._colours.value, slices)
        if self.subject.can_crop and self._is_cropped.value:
            crop = tuple(float(handle.value) for handle in self._crop)
        self._draw_box(crop)
        return Look(float(self._exposure.value), crop, transfer)

    def _draw_box(self, crop: tuple[float, ...] | None) -> None:
        """The edges of the crop box in the scene."""
        if crop is None:
            self.server.scene.remove_by_name("/crop")
            return
        corners = np.reshape(crop, (2, 3))
        ends = [
            [[corners[(k >> a) & 1, a] for a in range(3)], [corners[1 if a == axis else (k >> a) & 1, a] for a in range(3)]]
            for axis in range(3) for k in range(8) if not (k >> axis) & 1
        ]  # fmt: skip
        self.server.scene.add_line_segments("/crop", np.array(ends, np.float32), colors=(255, 180, 0), thickness=2.0,
                                            thickness_units="screen")  # fmt: skip

    # -- What the buttons do -------------------------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        self._status.content = text

    def _save_crop(self) -> None:
        crop = self.painter.look.crop
        if self.output is None or crop is None:
            self._say(READ_ONLY if self.output is None else "tick show crop first")
            return
        self._say(f"wrote {self.subject.save_crop(self.output, crop)}")

    def _change_path(self, camera: Camera | None) -> None:
        """Add a view to the path, or remove the last one."""
        if camera is None:
            self._keys = self._keys[:-1]
        else:
            self._keys.append(camera)
        self._say(f"{len(self._keys)} views on the path")
        self.server.scene.remove_by_name("/path")
        if len(self._keys) > 1:
            places = np.array([key.origin for key in self._keys], np.float32)
            self.server.scene.add_spline_catmull_rom("/path", places, color=(255, 80, 80), line_width=2.0)

    def _begin_film(self) -> None:
        if self.output is None or len(self._keys) < 2 or self._film is not None:
            found = "a film is in the making" if self._film else "add two views first: move, then press add this view"
            self._say(READ_ONLY if self.output is None else found)
            return
        first = scale_camera(self._keys[0], FILM_EDGE)
        count = int(self._seconds.value) * FRAMES_A_SECOND
        cameras = interpolate_cameras([replace(key, K=first.K, size=first.size) for key in self._keys], count)
        self._film = FilmJob(cameras, new_file(self.output, f"{self.subject.name}-film", film_suffix()))
        self._say(f"film: 0 of {len(cameras)} frames")

    def _film_step(self) -> None:
        """Draw the next frame of the film; write the file after the last."""
        job = self._film
        if len(job.frames) < len(job.cameras):
            job.frames.append(self.painter.draw(job.cameras[len(job.frames)]))
            self._say(f"film: {len(job.frames)} of {len(job.cameras)} frames")
            return
        self._film = None
        write_video(job.path, iter(job.frames), fps=FRAMES_A_SECOND)
        self._say(f"wrote {job.path}")

    def _act(self, request: tuple, client: Any) -> None:
        """Do what a button asks; a refusal is shown on the page."""
        name, page = request
        actions: dict[str, Callable[[], None]] = {
            "leave": lambda: (self._clients.pop(page, None), self.painter.forget(page)),
            "save crop": self._save_crop,
            "add view": lambda: self._change_path(to_camera(client.camera)),
            "remove view": lambda: self._change_path(None),
            "render film": self._begin_film,
        }
        if name == "camera":
            self._clients[page] = client
            self.painter.see(page, to_camera(client.camera))
        else:
            actions[name]()

    # -- The loop ------------------------------------------------------------------------------------------------------

    def step(self, longest: float = REFRESH) -> None:
        """Take the newest requests, and draw one piece or wait for at most ``longest`` seconds."""
        wait = self._draw_piece()
        if wait is None and (self._film is not None or self.frusta.is_loading):
            self._film_step_or_thumbnail()
            wait = 0.0
        timeout = min(longest, longest if wait is None else wait)
        for request, value in self.inbox.take(timeout).items():
            try:
                if request == "look":
                    self.painter.change(self._read_look())
                else:
                    self._act(request, value)
            except (MivolError, OSError) as error:
                self._say(f"refused: {error}")

    def _draw_piece(self) -> float | None:
        """As :meth:`Painter.step`; a refusal is shown on the page, and the pictures stay until the next request."""
        try:
            return self.painter.step()
        except MivolError as error:
            self.painter.give_up()
            self._say(f"refused: {error}")
            return None

    def _film_step_or_thumbnail(self) -> None:
        try:
            if self._film is not None:
                self._film_step()
            else:
                self.frusta.load_next()
        except (MivolError, OSError) as error:
            self._film = None
            self._say(f"refused: {error}")

    def refresh(self) -> None:
        """Show what has changed on disk."""
        if self.subject.refresh():
            self._title.content = f"**{self.subject.title}**"
            self.painter.change()

    def stop(self) -> None:
        """Close the server."""
        with silence_viser():
            self.server.stop()


def serve(page: Page, is_over: Callable[[], bool] = lambda: False) -> None:
    """Draw until Ctrl-C, or until ``is_over``; pages come and go."""
    looked = page.painter.clock()
    try:
        while not is_over():
            page.step()
            if page.painter.clock() - looked > REFRESH:
                page.refresh()
                looked = page.painter.clock()
    finally:
        page.stop()
