"""The page of the viewer in headless Chromium: open, drag, sliders, crop, film, many events, two pages, the gate.

The viewer runs as a user starts it, in a process of its own. Every picture that a test judges is also written to the folder of
artefacts.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import browser
import numpy as np
import pytest
from browser import Browser, Tab

from mivol.points import Gaussians, read_gaussians, write_gaussians
from mivol.view.page import check_viser

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.PROGRAM is None, reason="needs Chromium (apt install chromium)"),
]

EVENTS, SECONDS = 100, 60
"""Random events a second, and for how long."""

SHOWN = slice(200, 600), slice(50, 600)
"""Rows and columns of the window that show the picture alone, beside the notice of software WebGL and the panel."""


@dataclass
class Viewer:
    """A running viewer.

    Attributes:
        address: with the token.
        output: folder of crops and films.
        process: the viewer.
    """

    address: str
    output: Path
    process: subprocess.Popen


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """A viewer of a red ball on the left and a green one on the right."""
    check_viser()
    folder = tmp_path_factory.mktemp("view")
    means = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    colours = np.array([[[1.7, -1.7, -1.7]], [[-1.7, 1.7, -1.7]]])
    write_gaussians(folder / "balls.ply", Gaussians(means, np.full((2, 3), -1.5), np.eye(4)[[0, 0]], np.full(2, 9.0), colours))
    command = [sys.executable, "-m", "mivol", "view", str(folder / "balls.ply"), "--write", str(folder / "out")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    line = process.stdout.readline()
    try:
        yield Viewer(re.search(r"http://\S+", line)[0], folder / "out", process)
    finally:
        process.send_signal(signal.SIGINT)
        process.stdout.close()
        assert process.wait(timeout=60) == 130


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """The browser."""
    with browser.start_browser() as started:
        yield started


def open_page(chromium: Browser, viewer: Viewer) -> Tab:
    """A tab with the page, once it shows the balls."""
    tab = chromium.tab(viewer.address)
    tab.wait_for("document.querySelector('canvas') !== null")
    wait_until(lambda: len(seen_colours(tab)) == 2)
    return tab


def wait_until(holds, seconds: float = 60) -> None:
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.2)


def seen_colours(tab: Tab, path: Path | None = None) -> dict[str, float]:
    """Mean column of the red and of the green pixels in the picture, by colour; a colour that is not seen is left out."""
    rows, columns = SHOWN
    red, green, _ = tab.screenshot(path)[rows, columns].transpose(2, 0, 1).astype(int)
    masks = {"red": (red > 120) & (green < 60), "green": (green > 120) & (red < 60)}
    return {name: float(np.nonzero(mask)[1].mean()) for name, mask in masks.items() if mask.sum() > 50}


def settled_colours(tab: Tab) -> dict[str, float]:
    """The colours of a page at rest, once its full picture has replaced the coarse one."""
    found: list[dict[str, float]] = []
    wait_until(lambda: found.append(seen_colours(tab)) or found[-10:] == 10 * found[-1:])
    return found[-1]


def set_number(tab: Tab, label: str, value: str) -> None:
    """Type a number into the box of a slider."""
    y = tab.find(label)[1]
    place = tab.run(f"""(() => {{ const boxes = [...document.querySelectorAll('input')].filter(e =>
        Math.abs(e.getBoundingClientRect().y + e.getBoundingClientRect().height / 2 - {y}) < 14 && e.type !== 'hidden');
        const r = boxes[boxes.length - 1].getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()""")
    for _ in range(3):
        tab.click(tuple(place))
    tab.send("Input.dispatchKeyEvent", type="keyDown", key="a", code="KeyA", modifiers=2, commands=["selectAll"])
    tab.send("Input.insertText", text=value)
    for kind in ("keyDown", "keyUp"):
        tab.send("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)


def test_open_drag_and_slide(viewer: Viewer, chromium: Browser, artefacts: Path) -> None:
    """A drag by half of the window turns the balls; exposure turns the picture dark."""
    tab = open_page(chromium, viewer)
    first = seen_colours(tab, artefacts / "view_open.png")
    assert first["red"] < first["green"]
    tab.drag((100, 500), (560, 500))
    wait_until(lambda: seen_colours(tab).get("red", 0) > seen_colours(tab).get("green", 1e9))
    tab.screenshot(artefacts / "view_turned.png")
    set_number(tab, "exposure", "-5")
    wait_until(lambda: not seen_colours(tab))
    tab.screenshot(artefacts / "view_dark.png")
    set_number(tab, "exposure", "0")
    wait_until(lambda: len(seen_colours(tab)) == 2)
    assert tab.errors == []


def hold_key(tab: Tab, letter: str, seconds: float) -> None:
    """Hold a key down."""
    key = {"key": letter, "code": f"Key{letter.upper()}", "windowsVirtualKeyCode": ord(letter.upper())}
    tab.send("Input.dispatchKeyEvent", type="keyDown", **key)
    time.sleep(seconds)
    tab.send("Input.dispatchKeyEvent", type="keyUp", **key)


def test_keys_fly(viewer: Viewer, chromium: Browser, artefacts: Path) -> None:
    """D flies to the right, so the balls move to the left; S flies back, so they come together."""
    tab = open_page(chromium, viewer)
    tab.click((300, 250))
    first = seen_colours(tab)
    hold_key(tab, "d", 0.1)
    wait_until(lambda: seen_colours(tab).get("green", np.inf) < first["green"] - 10)
    tab.screenshot(artefacts / "view_flown.png")
    hold_key(tab, "s", 1.0)
    wait_until(lambda: len(seen := seen_colours(tab)) == 2 and seen["green"] - seen["red"] < first["green"] - first["red"] - 10)
    assert tab.errors == []


def test_a_crop_is_seen_and_saved(viewer: Viewer, chromium: Browser, artefacts: Path) -> None:
    tab = open_page(chromium, viewer)
    tab.click((802, tab.find("show crop")[1]))
    set_number(tab, "x to", "0")
    wait_until(lambda: set(seen_colours(tab)) == {"red"})
    tab.screenshot(artefacts / "view_crop.png")
    tab.click(tab.find("save crop"))
    wait_until(lambda: (viewer.output / "balls-crop.ply").exists())
    assert read_gaussians(viewer.output / "balls-crop.ply").means.tolist() == [[-0.5, 0, 0]]
    tab.click((802, tab.find("show crop")[1]))
    wait_until(lambda: len(seen_colours(tab)) == 2)


def test_a_film_between_two_views(viewer: Viewer, chromium: Browser) -> None:
    tab = open_page(chromium, viewer)
    set_number(tab, "seconds", "1")
    tab.click(tab.find("add this view"))
    tab.drag((200, 500), (300, 500))
    tab.click(tab.find("add this view"))
    tab.wait_for("document.body.innerText.includes('2 views on the path')")
    tab.click(tab.find("render film"))
    wait_until(lambda: any(path.stat().st_size for path in viewer.output.glob("balls-film.*")), 120)


def test_two_pages_have_cameras_of_their_own(viewer: Viewer, chromium: Browser) -> None:
    """A drag in one page leaves the other as it is; a closed page ends nothing."""
    one, other = open_page(chromium, viewer), open_page(chromium, viewer)
    before = settled_colours(other)
    one.show()
    one.drag((100, 500), (560, 500))
    wait_until(lambda: seen_colours(one).get("red", 0) > seen_colours(one).get("green", 1e9))
    other.show()
    wait_until(lambda: seen_colours(other) == before)
    one.send("Page.close")
    other.drag((300, 500), (340, 500))
    wait_until(lambda: seen_colours(other) != before)


def test_a_storm_of_events_leaves_the_page_alive(viewer: Viewer, chromium: Browser, artefacts: Path) -> None:
    """After random drags, wheels and moves the camera still follows, and the newest request is drawn last."""
    tab, rng = open_page(chromium, viewer), np.random.default_rng(0)
    kinds = ("mouseMoved", "mousePressed", "mouseReleased", "mouseWheel")
    start = time.monotonic()
    for number in range(EVENTS * SECONDS):
        kind = kinds[rng.choice(4, p=[0.85, 0.05, 0.05, 0.05])]
        place = tuple(rng.uniform((60, 220), (600, 600)).tolist())
        turn = {"deltaX": 0, "deltaY": float(rng.normal(0, 60))}
        more = turn if kind == "mouseWheel" else {"button": "left", "buttons": 1, "clickCount": 1}
        tab.post("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], **more)
        time.sleep(max(0.0, start + number / EVENTS - time.monotonic()))
    tab.mouse("mouseReleased", (300, 400), button="left", clickCount=1)
    tab.screenshot(artefacts / "view_storm.png")
    assert viewer.process.poll() is None and tab.errors == []
    fresh = open_page(chromium, viewer)
    fresh.drag((100, 500), (560, 500))
    wait_until(lambda: seen_colours(fresh).get("red", 0) > seen_colours(fresh).get("green", 1e9))


@pytest.mark.parametrize(
    ("query", "headers"),
    [("", {}), ("?token=wrong", {}), (None, {"Host": "evil.example"}), (None, {"Origin": "http://evil.example"})],
)
def test_strangers_are_turned_away(viewer: Viewer, query: str | None, headers: dict[str, str]) -> None:
    base, _, token = viewer.address.partition("?")
    request = urllib.request.Request(f"{base}?{token}" if query is None else base + query, headers=headers)
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=30)
    assert refused.value.code == 403
    refused.value.close()
    with urllib.request.urlopen(viewer.address, timeout=30) as answer:
        assert answer.status == 200
