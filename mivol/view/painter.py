"""Schedule of the drawings: the newest request wins; coarse pictures come first, full pictures when the camera rests.

Conventions. Times are seconds of one clock. A picture is uint8 (H, W, 3), sRGB. Sizes are (width, height) [pixel]. Only the
thread that calls :meth:`Painter.step` draws.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mivol.files.image_files import decode_srgb, encode_srgb
from mivol.photos import Camera, intrinsics
from mivol.view.subjects import Look, Subject

SOON = 0.12
"""Time in which a coarse picture or a strip of a full one is to be drawn [s]."""

REST = 0.2
"""Time without a new request after which a camera rests [s]."""

EDGES = (400, 320, 256, 200, 160, 128, 96, 64)
"""Longest edges of coarse pictures [pixel]: few, because each size has kernels of its own."""

LONGEST = 1024
"""Longest edge of a full picture [pixel]."""

PASSES = 32
"""Most draws of which the picture of a noisy subject is the mean."""


class Inbox:
    """Requests from other threads. A newer request replaces the one with its key that has not been taken yet."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Hashable, Any]] = queue.SimpleQueue()

    def put(self, key: Hashable, value: Any = None) -> None:
        """Add a request; any thread may call this, and none waits."""
        self._queue.put((key, value))

    def take(self, timeout: float | None) -> dict[Hashable, Any]:
        """The newest request of each key, in the order of the newest; empty after ``timeout`` seconds without one."""
        found: dict[Hashable, Any] = {}
        try:
            item = self._queue.get(timeout=timeout) if timeout is None or timeout > 0 else self._queue.get_nowait()
            while True:
                found.pop(item[0], None)
                found[item[0]] = item[1]
                item = self._queue.get_nowait()
        except queue.Empty:
            return found


def to_picture(values: np.ndarray, space: str, exposure: float = 0.0) -> np.ndarray:
    """Pixels for a screen, uint8 (H, W, 3), of values (H, W, 3) in a colour space.

    Args:
        values: code values ("srgb") or radiance ("linear"); NaN becomes black.
        space: of the values.
        exposure: exposure value; each unit doubles the radiance.
    """
    values = np.maximum(np.nan_to_num(values, nan=0.0, posinf=1e4, neginf=0.0), 0)
    if exposure or space == "linear":
        radiance = decode_srgb(values) if space == "srgb" else values
        values = encode_srgb(np.clip(radiance * 2.0**exposure, 0, 1))
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)


def scale_camera(camera: Camera, longest: int) -> Camera:
    """The pinhole with at most ``longest`` pixels along its longest edge; pixels stay square."""
    scale = min(1.0, longest / max(camera.size))
    width, height = (max(1, round(edge * scale)) for edge in camera.size)
    focal = camera.K[1, 1] * height / camera.size[1]
    return replace(camera, K=intrinsics(focal, focal, width / 2, height / 2), size=(width, height))


def crop_rows(camera: Camera, top: int, rows: int) -> Camera:
    """The camera that sees some rows of the image."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2] - top
    return replace(camera, K=intrinsics(fx, fy, cx, cy), size=(camera.size[0], rows))


@dataclass
class Canvas:
    """The picture of one page.

    Attributes:
        camera: camera at the full size of the page's picture.
        asked: time of the newest request [s].
        is_coarse: whether the coarse picture has been sent.
        rows: strips of the full picture so far.
        total: sum of the draws of a noisy subject.
        passes: draws in the sum.
        is_full: whether the full picture has been sent.
    """

    camera: Camera
    asked: float
    is_coarse: bool = False
    rows: tuple[np.ndarray, ...] = ()
    total: np.ndarray | None = None
    passes: int = 0
    is_full: bool = False


class Painter:
    """Draws the pictures of all pages, a piece at a time.

    Args:
        subject: drawn model.
        send: receives the name of a page, a picture, and whether it is full.
        look: first look.
        clock: seconds.

    Attributes:
        look: values of the sliders, set by :meth:`change`.
        drawn: number of pieces drawn so far.
    """

    def __init__(
        self,
        subject: Subject,
        send: Callable[[Hashable, np.ndarray, bool], None],
        look: Look = Look(),  # noqa: B008  (frozen)
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.subject, self.send, self.clock, self.look = subject, send, clock, look
        self.drawn = 0
        self._pages: dict[Hashable, Canvas] = {}
        # A draw of n pixels takes about fixed + cost n seconds; both are learned.
        self._fixed, self._cost = 0.0, 1e-6

    def see(self, page: Hashable, camera: Camera) -> None:
        """Draw a page anew, from another camera."""
        self._pages[page] = Canvas(camera, self.clock())

    def forget(self, page: Hashable) -> None:
        """Draw a page no more."""
        self._pages.pop(page, None)

    def change(self, look: Look | None = None) -> None:
        """Draw all pages anew, with another look or another state of the subject."""
        self.look = self.look if look is None else look
        for page, canvas in self._pages.items():
            self._pages[page] = Canvas(canvas.camera, self.clock())

    def step(self) -> float | None:
        """Draw the most urgent piece.

        Returns:
            0 if a piece was drawn; otherwise the time until a camera rests [s], or None if nothing is left to do.
        """
        waiting = [(canvas.asked, page) for page, canvas in self._pages.items() if not canvas.is_coarse]
        if waiting:
            self._draw_coarse(min(waiting, key=lambda item: item[0])[1])
            return 0.0
        unfinished = [(canvas.asked, page) for page, canvas in self._pages.items() if not canvas.is_full]
        if not unfinished:
            return None
        asked, page = min(unfinished, key=lambda item: item[0])
        rest = asked + REST - self.clock()
        if rest > 0:
            return rest
        self._draw_piece(page)
        return 0.0

    def give_up(self) -> None:
        """Draw nothing more until the next request, after a refusal."""
        for canvas in self._pages.values():
            canvas.is_coarse = canvas.is_full = True

    def draw(self, camera: Camera, seed: int = 0) -> np.ndarray:
        """A picture of a camera with the present look, for a film: the mean of 8 draws of a noisy subject."""
        count = 8 if self.subject.is_noisy else 1
        values = sum(self.subject.draw(camera, self.look, seed + number) for number in range(count))
        return to_picture(np.asarray(values) / count, self.subject.space, self.look.exposure)

    def warm_up(self, camera: Camera) -> None:
        """Draw a small and a large coarse picture twice each: compiles the kernels, then learns the time of a draw."""
        times, counts, largest = [], [], min(EDGES[0], max(camera.size))
        for edge in (max(largest // 6, 1), largest):
            small = scale_camera(camera, edge)
            self.subject.draw(small, self.look, 0)
            start = self.clock()
            self.subject.draw(small, self.look, 0)
            times.append(self.clock() - start)
            counts.append(small.size[0] * small.size[1])
        self._cost = max((times[1] - times[0]) / (counts[1] - counts[0]), times[1] / counts[1] / 10)
        self._fixed = max(times[0] - self._cost * counts[0], 0.0)

    # -- Pieces --------------------------------------------------------------------------------------------------------

    def _timed(self, camera: Camera, seed: int) -> np.ndarray:
        """Values of a camera; learns the time of a draw."""
        start, expected = self.clock(), self._expect(camera.size[0] * camera.size[1])
        values = self.subject.draw(camera, self.look, seed)
        # A first draw of a size compiles kernels: one slow draw moves the estimate by at most a factor of 2.
        ratio = 0.5 + 0.5 * min((self.clock() - start) / expected, 3)
        self._fixed, self._cost = ratio * self._fixed, ratio * self._cost
        self.drawn += 1
        return values

    def _expect(self, pixels: float) -> float:
        """Time of a draw [s]."""
        return self._fixed + self._cost * pixels

    def _draw_coarse(self, page: Hashable) -> None:
        canvas = self._pages[page]
        shares = (canvas.camera.size[0] * canvas.camera.size[1]) / max(canvas.camera.size) ** 2
        # Where the fixed part alone takes too long, fewer pixels do not help.
        soon = max(SOON, 2 * self._fixed)
        edge = next((edge for edge in EDGES if self._expect(edge**2 * shares) <= soon), EDGES[-1])
        values = self._timed(scale_camera(canvas.camera, edge), 0)
        canvas.is_coarse = True
        self._send(page, values, False)

    def _draw_piece(self, page: Hashable) -> None:
        canvas = self._pages[page]
        camera = scale_camera(canvas.camera, LONGEST)
        width, height = camera.size
        pieces = 1
        while pieces < 16 and height // (2 * pieces) >= 16:
            if width * height * self._cost / pieces <= max(SOON - self._fixed, self._fixed):
                break
            pieces *= 2
        top = sum(map(len, canvas.rows))
        rows = min(-(-height // pieces), height - top)
        canvas.rows = (*canvas.rows, self._timed(crop_rows(camera, top, rows), canvas.passes))
        if top + rows < height:
            return
        values, canvas.rows = np.concatenate(canvas.rows), ()
        canvas.passes += 1
        canvas.total = values if canvas.total is None else canvas.total + values
        canvas.is_full = not self.subject.is_noisy or canvas.passes >= PASSES
        if canvas.is_full or canvas.passes & (canvas.passes - 1) == 0:
            self._send(page, canvas.total / canvas.passes, True)

    def _send(self, page: Hashable, values: np.ndarray, is_full: bool) -> None:
        self.send(page, to_picture(values, self.subject.space, self.look.exposure), is_full)
