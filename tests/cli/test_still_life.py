"""The still life's photographs: what they show is view-dependent where it should be, and lies in the box that is said."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import bench_script
import mitsuba as mi
import numpy as np
import pytest

from mivol.photos import load_photos, project

SCRIPT = Path(__file__).resolve().parents[2] / "scenes" / "still_life" / "photographs.py"


@pytest.fixture(scope="module")
def still_life() -> ModuleType:
    spec = importlib.util.spec_from_file_location("still_life", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_photographs_of_the_still_life(still_life, variant_rgb, tmp_path):
    """The metal cube's upper face changes with the view, the matt one's does not; each is where the camera says.

    The sky's smooth light on a matt face is known to a tenth or so by 16 samples, which sRGB makes a twentieth of 0.6; the
    metal shows now a light of 3 and now the sky of 0.2, whose code values lie 0.5 apart.
    """
    names = still_life.make(tmp_path, views=10, size=48, spp=16)
    train, test = (load_photos(tmp_path, split=s, background="black", box=still_life.BOX) for s in ("train", "test"))
    assert (len(names), len(train.views), len(test.views)) == (10, 8, 2)
    views = [*train.views, *test.views]
    corners = np.stack(np.meshgrid(*still_life.BOX.T), -1).reshape(-1, 3)
    things, shown = still_life.still_life(tmp_path / "knot.ply"), {}
    for name in ("cube_2", "cube_3"):
        top = np.array(things[name]["to_world"] @ mi.ScalarPoint3f(0, 0, 1)).reshape(3)
        above = [view for view in views if view.camera.origin[2] > top[2] + 1]
        places = [np.floor(project(view.camera, top)[0]).astype(int) for view in above]
        shown[name] = [view.image[row, column] for view, (column, row) in zip(above, places, strict=True)]
        assert all(view.alpha[row, column] == 1 for view, (column, row) in zip(above, places, strict=True))
    spread = {name: np.ptp(np.mean(colours, axis=1)) for name, colours in shown.items()}
    assert spread["cube_3"] < 0.1
    assert spread["cube_2"] > 0.2
    assert all((project(view.camera, corners)[1] > 0).all() for view in views)
    # Nothing is cut off, and nothing but what stands there is in the pictures.
    frame = [np.concatenate([v.alpha[0], v.alpha[-1], v.alpha[:, 0], v.alpha[:, -1]]) for v in views]
    assert np.max(frame) == 0
    assert 0.2 < np.mean([view.alpha.mean() for view in views]) < 0.7


def test_the_box_holds_all_of_the_still_life(still_life, variant_rgb, tmp_path):
    still_life.write_mesh(tmp_path / "knot.ply", still_life.knot())
    found = mi.load_dict(still_life.still_life(tmp_path / "knot.ply")).bbox()
    low, high = (np.array(corner).reshape(3) for corner in (found.min, found.max))
    # The sky of the scene has no size; float32 places corners within 1e-6.
    assert (low >= still_life.BOX[0] - 1e-6).all()
    assert (high <= still_life.BOX[1] + 1e-6).all()


def test_what_is_there_is_not_rendered_again(still_life, variant_rgb, tmp_path):
    """The same set is left alone; with other samples, or half done, it is made anew."""
    names = still_life.make(tmp_path, views=5, size=24, spp=4)
    first = (tmp_path / names[0]).read_bytes()
    (tmp_path / names[0]).write_bytes(b"mine")
    assert still_life.make(tmp_path, views=5, size=24, spp=4) == names
    assert (tmp_path / names[0]).read_bytes() == b"mine"
    still_life.make(tmp_path, views=5, size=24, spp=9)
    assert (tmp_path / names[0]).read_bytes() not in (b"mine", first)
    still_life.make(tmp_path, views=5, size=24, spp=4)
    assert (tmp_path / names[0]).read_bytes() == first


def test_every_fit_of_the_bench(tmp_path):
    """A quick run fits and judges all five; its figures mean nothing."""
    figures = bench_script.quick("bench_still_life", tmp_path)
    assert {q: set(figures[q]) for q in ("degree", "few")} == {
        "degree": {"SH 0", "SH 0, no TV", "SH 2"},
        "few": {"no TV", "TV"},
    }
    for found in (*figures["degree"].values(), *figures["few"].values()):
        assert found["psnr"] == pytest.approx(np.mean(found["each"]))
        assert found["psnr"] > 10
    assert (figures["degree"]["SH 2"]["views"], figures["few"]["TV"]["views"]) == (12, 6)
    assert (tmp_path / "bench_still_life.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_field_sees_directions_and_total_variation_helps(tmp_path):
    """Two degrees more are worth 1.5 dB on views between the others, and total variation something where views are few."""
    command = [sys.executable, str(bench_script.SCRIPTS / "bench_still_life.py"), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    bars = json.loads(done.stdout)["bars"]
    assert len(bars) == 2
    assert all(bar["met"] for bar in bars), bars
