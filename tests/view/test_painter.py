"""Requests of pages: the newest wins, coarse pictures come first, full ones when a camera rests."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.photos import Camera, intrinsics
from mivol.view.painter import EDGES, LONGEST, PASSES, REST, Inbox, Painter, crop_rows, scale_camera, to_picture
from mivol.view.subjects import Look, Subject

SIZE = 1200, 900


def camera(x: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = x
    return Camera(intrinsics(1000, 1000, SIZE[0] / 2, SIZE[1] / 2), SIZE, pose)


class Rays(Subject):
    """The direction of each pixel as its colour: strips that fit together give the picture of the whole."""

    name, box = "rays", np.array([[-1.0] * 3, [1.0] * 3])

    def __init__(self, clock: Clock, seconds: float, is_noisy: bool = False) -> None:
        self.clock, self.seconds, self.is_noisy, self.drawn = clock, seconds, is_noisy, []

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        self.clock.now += self.seconds * camera.size[0] * camera.size[1]
        self.drawn.append((camera.origin[0], camera.size, seed))
        x, y = np.meshgrid(np.arange(camera.size[0]) + 0.5, np.arange(camera.size[1]) + 0.5)
        u, v = (x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1]
        noise = 0.2 * (seed % 2) if self.is_noisy else 0.0
        return np.stack([0.5 + 0.5 * u, 0.5 + 0.5 * v, np.full_like(u, noise)], axis=-1)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Desk:
    """A painter with the pictures that it has sent."""

    def __init__(self, seconds: float = 1e-7, is_noisy: bool = False) -> None:
        self.clock, self.sent = Clock(), []
        self.subject = Rays(self.clock, seconds, is_noisy)
        self.painter = Painter(self.subject, lambda *given: self.sent.append(given), clock=self.clock)
        self.painter._cost = seconds

    def work(self) -> None:
        """Draw until nothing is left, and wait where the painter waits."""
        while (wait := self.painter.step()) is not None:
            self.clock.now += wait


def test_the_newest_request_of_a_key_wins() -> None:
    inbox = Inbox()
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        inbox.put(key, value)
    assert list(inbox.take(0).items()) == [("b", 2), ("a", 3)]
    assert inbox.take(0) == {}


def test_only_the_newest_camera_is_drawn() -> None:
    desk = Desk()
    for x in range(50):
        desk.painter.see("page", camera(x))
    desk.work()
    assert {x for x, _, _ in desk.subject.drawn} == {49}


def test_a_coarse_picture_comes_first_and_the_full_one_after_a_rest() -> None:
    desk = Desk()
    desk.painter.see("page", camera())
    assert desk.painter.step() == 0
    assert [(page, picture.shape, is_full) for page, picture, is_full in desk.sent] == [("page", (300, 400, 3), False)]
    rest = desk.painter.step()
    assert rest is not None and 0 < rest <= REST and len(desk.sent) == 1
    desk.work()
    assert [picture.shape for _, picture, _ in desk.sent] == [(300, 400, 3), (768, LONGEST, 3)]
    assert desk.painter.step() is None


def test_slow_subjects_get_smaller_coarse_pictures() -> None:
    desk = Desk(seconds=1e-5)
    desk.painter.see("page", camera())
    desk.painter.step()
    width = desk.sent[0][1].shape[1]
    assert width in EDGES and width < EDGES[0]


def test_strips_give_the_picture_of_the_whole() -> None:
    """A slow full picture is drawn in strips, so that a new request never waits for all of it."""
    desk = Desk(seconds=2e-6)
    desk.painter.see("page", camera())
    desk.work()
    heights = [size[1] for _, size, _ in desk.subject.drawn[1:]]
    assert len(heights) > 4 and sum(heights) == 768
    whole = desk.subject.draw(scale_camera(camera(), LONGEST), Look())
    assert np.array_equal(desk.sent[-1][1], to_picture(whole, "srgb"))


def test_a_new_camera_stops_the_full_picture_of_the_old_one() -> None:
    desk = Desk(seconds=2e-6)
    desk.painter.see("page", camera())
    desk.painter.step()
    desk.clock.now += 2 * REST
    desk.painter.step()
    desk.painter.see("page", camera(1))
    drawn = len(desk.subject.drawn)
    desk.painter.step()
    assert desk.subject.drawn[drawn][0] == 1 and desk.sent[-1][2] is False


def test_two_pages_are_drawn_and_a_closed_one_is_not() -> None:
    desk = Desk()
    for page in ("a", "b", "c"):
        desk.painter.see(page, camera())
    desk.painter.forget("c")
    desk.work()
    assert sorted(page for page, _, is_full in desk.sent if is_full) == ["a", "b"]


def test_noisy_subjects_are_averaged_over_seeds() -> None:
    desk = Desk(seconds=1e-8, is_noisy=True)
    desk.painter.see("page", camera())
    desk.work()
    assert [seed for _, _, seed in desk.subject.drawn[1:]] == list(range(PASSES))
    assert desk.sent[-1][1][..., 2].mean() == pytest.approx(0.1 * 255, abs=0.5)  # half of the seeds give 0.2; rounding of codes


def test_a_slider_draws_all_pages_anew() -> None:
    desk = Desk()
    desk.painter.see("page", camera())
    desk.work()
    before = desk.sent[-1][1]
    desk.painter.change(Look(exposure=1.0))
    desk.work()
    assert (desk.sent[-1][1][..., :2].astype(int) >= before[..., :2]).all() and desk.sent[-1][1].sum() > before.sum()


def test_exposure_doubles_radiance() -> None:
    values = np.full((1, 1, 3), 0.1)
    assert to_picture(values, "linear", 1.0)[0, 0, 0] == to_picture(2 * values, "linear")[0, 0, 0]
    assert np.array_equal(to_picture(np.full((1, 1, 3), np.nan), "srgb"), np.zeros((1, 1, 3), np.uint8))


def test_a_strip_sees_the_rows_of_the_image() -> None:
    part = crop_rows(camera(), 100, 50)
    assert part.size == (1200, 50) and part.K[1, 2] == camera().K[1, 2] - 100


@pytest.mark.parametrize(("is_noisy", "seeds"), [(True, range(3, 11)), (False, range(3, 4))])
def test_a_picture_of_a_film_is_a_mean_of_eight_draws_of_noise(is_noisy: bool, seeds: range) -> None:
    """Half of the seeds add 0.2 of blue; a subject without noise is drawn once."""
    desk = Desk(is_noisy=is_noisy)
    picture = desk.painter.draw(camera(), seed=3)
    assert [seed for _, _, seed in desk.subject.drawn] == list(seeds)
    mean = np.add(desk.subject.draw(camera(), desk.painter.look, 0), [0, 0, 0.1 * is_noisy])
    assert np.abs(picture.astype(int) - to_picture(mean, desk.subject.space, desk.painter.look.exposure)).max() <= 1


def test_a_warm_up_learns_the_time_of_a_draw() -> None:
    """Of a subject whose time is that of its pixels: as much for each pixel, and nothing else. Both sizes are drawn twice."""
    desk = Desk(seconds=3e-7)
    desk.painter._cost = desk.painter._fixed = 1.0
    desk.painter.warm_up(camera())
    assert (desk.painter._cost, desk.painter._fixed) == (pytest.approx(3e-7, rel=1e-6), pytest.approx(0, abs=1e-9))
    sizes = [size for _, size, _ in desk.subject.drawn]
    assert len(sizes) == 4 and sizes[0] == sizes[1] and sizes[2] == sizes[3] and sizes[2][0] == EDGES[0] > 5 * sizes[0][0]
