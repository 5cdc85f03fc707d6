"""An image in passes."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mivol.experiments import render


def test_render_in_passes_is_the_mean(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three passes of 3 samples: interior pixels differ from one pass of 9 only by where samples fall, 4 % of tau."""
    scene = mi.load_file(str(folder / "scene.xml"), spp=9)
    once, names = render.render_image(scene, 0)
    monkeypatch.setattr(render, "SAMPLES_PER_PASS", 3 * 48)
    split, _ = render.render_image(scene, 0)
    assert names == ["R", "G", "B", "tau"]
    assert np.isclose(split[3, 4, 0], once[3, 4, 0], rtol=0.02)
    assert not np.array_equal(split, once)
