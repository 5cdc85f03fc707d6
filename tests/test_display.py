"""Objects show themselves in a line, however large they are, and in notebooks as a small picture."""

from __future__ import annotations

import base64
import io
import math
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import ball, photo
from fit_scene import KEY
from PIL import Image
from tiny_experiment import write_experiment

import mivol
from mivol.display import curve_html, format_duration, summarize, to_toml, with_short_repr
from mivol.experiments.script import Problem, optimize
from mivol.files import VolumeData
from mivol.files.image_files import EDGE, GAP, pairs_html

SHORT = 400
"""Letters of a line that a person reads."""


@with_short_repr
@dataclass(frozen=True)
class Thing:
    values: np.ndarray
    path: Path
    names: tuple[str, ...]
    about: dict[str, int]
    _own: int = 3
    hidden: int = field(default=1, repr=False)


def test_values_as_toml_read_back() -> None:
    """TOML has no null, so None is left out of tables; paths keep their backslashes."""
    value = {"domain": (0.0, math.inf), "name": 'C:\\runs\\"näher"', "steps": [{"at": (5, 7), "end": None}], "on": True}
    expected = {"domain": [0.0, math.inf], "name": 'C:\\runs\\"näher"', "steps": [{"at": [5, 7]}], "on": True}
    assert tomllib.loads(f"value = {to_toml(value)}")["value"] == expected


DURATIONS = {
    0.0123: "12 ms",
    0.94: "940 ms",
    0.95: "0.9 s",
    9.94: "9.9 s",
    9.95: "10 s",
    119.4: "119 s",
    120: "2.0 min",
    7199: "120.0 min",
    7200: "2.0 h",
}


@pytest.mark.parametrize("seconds", DURATIONS)
def test_durations_have_a_suitable_unit(seconds: float) -> None:
    assert format_duration(seconds) == DURATIONS[seconds]


def test_values_in_a_few_words() -> None:
    thing = Thing(np.zeros((3, 4), np.float32), Path("a/b.vol"), ("x",) * 9, {str(n): n for n in range(6)})
    assert repr(thing) == "Thing(values=float32 (3, 4), path='b.vol', names=[9 x str], about={6 of 0, 1, 2, 3, ...})"
    assert summarize((1, 2.5, None, "a")) == "[1, 2.5, None, 'a']"
    assert summarize(SimpleNamespace()) == "SimpleNamespace"


def objects(folder: Path) -> dict[str, object]:
    """One of each kind that a script holds."""
    scene = mi.load_file(str(write_experiment(folder) / "scene.xml"))
    problem = Problem(scene, [np.full((6, 8, 3), 0.6, np.float32)], [KEY], spp=2)
    return {
        "volume": VolumeData(np.random.default_rng(0).random((30, 20, 10, 1), np.float32), np.eye(4)),
        "field": ball(16),
        "photo": photo(ball(8), 0, 16),
        "view": problem.views[0],
        "problem": problem,
        "fit": optimize(problem, mivol.Adam(), 3),
        "scene": mivol.load_scene(folder / "scene.xml"),
        "geometry": mivol.ParallelBeam(np.linspace(0, 3, 500), (4, 4), 1.0),
    }


def test_every_repr_is_a_line(variant_rgb: str, tmp_path: Path) -> None:
    for name, thing in objects(tmp_path).items():
        assert "\n" not in repr(thing), name
        assert len(repr(thing)) < SHORT, name
    made = objects(tmp_path)
    assert repr(made["volume"]).startswith("VolumeData(values=float32 (30, 20, 10, 1), to_world=float64 (4, 4)")
    assert repr(made["fit"]).startswith("Fit(3 of 3 iterations in ")
    assert "1 views of 8 x 6 pixels, l2, fits cube" in repr(made["problem"])


def test_notebooks_show_pictures(variant_rgb: str, tmp_path: Path) -> None:
    """Slices of a volume and a field, facts of a scene, the curve of a fit; no script in any of them."""
    made = objects(tmp_path)
    shown = {name: made[name]._repr_html_() for name in ("volume", "field", "scene", "fit")}
    assert not any("<script" in text for text in shown.values())
    for name in ("volume", "field"):
        data = re.search(r'base64,([^"]+)"', shown[name])[1]
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
        assert picture.shape[1] > 100
        # The gaps are white; the middle slices of the ball do not reach its darkest corners.
        assert picture.max() == 255
        assert picture.min() < 100
    assert "optical depth at most" in shown["scene"]
    assert "<polyline" in shown["fit"]


def test_a_slice_lies_as_in_the_world(variant_rgb: str) -> None:
    """A volume that is bright at the top of its middle slice along z (large y) is bright in the first rows of the picture."""
    values = np.zeros((2, 8, 8, 1), np.float32)
    values[:, 7] = 1.0
    text = VolumeData(values, np.eye(4))._repr_html_()
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(re.search(r'base64,([^"]+)"', text)[1]))))
    assert picture[5, 5] == 255
    assert picture[150, 5] == 0


def test_curves_leave_out_what_is_not_finite() -> None:
    text = curve_html([1.0, float("nan"), 10.0, 100.0], "a < b")
    assert re.findall(r"[\d.]+,[\d.]+", text.split('points="')[1].split('"')[0]) == ["0.0,100.0", "213.3,50.0", "320.0,0.0"]
    assert "a &lt; b" in text
    assert "<svg" not in curve_html([1.0], "one point is no curve")


def pictures_of(text: str) -> list[np.ndarray]:
    """The pictures of a HTML text, (H, W, 3)."""
    return [np.array(Image.open(io.BytesIO(base64.b64decode(data)))) for data in re.findall(r"base64,([^\"]+)", text)]


def test_a_view_is_shown_beside_its_render() -> None:
    """White is the largest value seen; half of it is the code 188 of sRGB; a single channel is grey."""
    seen = np.full((2, 4, 1), 0.5, np.float32)
    seen[0, 0] = 2.0
    rendered = np.full((2, 4, 1), 1.0, np.float32)
    rendered[1, 3] = np.nan
    text = pairs_html([("left <1>", seen, rendered)])
    (picture,) = pictures_of(text)
    assert "left &lt;1&gt;: photograph, render" in text
    assert picture.shape == (EDGE // 2, 2 * EDGE + GAP, 3)
    assert picture[0, 0].tolist() == [255] * 3
    # 0.25 and 0.5 of white in sRGB: 137 and 188.
    assert picture[-1, 0].tolist() == [137] * 3
    assert picture[0, EDGE + GAP].tolist() == [188] * 3
    assert picture[-1, -1].tolist() == [0] * 3
    assert pairs_html([]) == ""


def test_a_fit_shows_the_first_views_with_what_was_found(variant_rgb: str, tmp_path: Path) -> None:
    fit = objects(tmp_path)["fit"]
    text = fit._repr_html_()
    (picture,) = pictures_of(text)
    assert "<svg" in text
    # The reference is one number everywhere, and the largest: white.
    assert (picture[:, :EDGE] == 255).all()
    assert picture[:, EDGE + GAP :].min() < 255
    fit.problem.views = tuple(fit.problem.views) * 5
    assert len(pictures_of(fit._repr_html_())) == 3
