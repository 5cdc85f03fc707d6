"""The true volume of an experiment, and a scene that holds other values for a while."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.config import Truth
from mivol.errors import MivolError
from mivol.experiments.truth import check_truth, holding, make_truth
from mivol.files import write_volume
from scenes import box_of, grid_volume, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")

KEY = "smoke.interior_medium.sigma_t.data"


def scene() -> mi.Scene:
    box = box_of(medium("mivol_medium", grid_volume("mivol_voxels", np.ones((2, 3, 4)))), np.eye(4))
    return mi.load_dict({"type": "scene", "smoke": box})


def experiment(truth: Truth | None, *sought: str) -> SimpleNamespace:
    return SimpleNamespace(truth=truth, parameter=[SimpleNamespace(key=key) for key in sought])


def test_a_truth_is_a_file_beside_the_experiment_or_made(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4, 1)
    write_volume(tmp_path / "truth.npz", values, np.eye(4))
    assert make_truth(experiment(None), tmp_path, scene()) is None
    np.testing.assert_array_equal(make_truth(experiment(Truth(key=KEY, file="truth.npz")), tmp_path, scene()), values)
    made = make_truth(experiment(Truth(key=KEY, procedural="tangle", shape=(4, 5, 6), peak=2.0)), tmp_path, scene())
    assert made.shape[:3] == (4, 5, 6) and 0 < made.max() <= 2
    with pytest.raises(MivolError, match="nothing"):
        make_truth(experiment(Truth(key="nothing", file="truth.npz")), tmp_path, scene())


def test_a_truth_is_of_what_is_looked_for() -> None:
    check_truth(experiment(None))
    check_truth(experiment(Truth(key=KEY, file="truth.npz"), "other", KEY))
    with pytest.raises(MivolError, match="no parameter of the fit"):
        check_truth(experiment(Truth(key=KEY, file="truth.npz"), "other"))


def test_a_scene_holds_other_values_for_a_while() -> None:
    found = scene()
    params = mi.traverse(found)
    with holding(found, KEY, np.full((2, 3, 4, 1), 7.0)):
        assert set(np.array(params[KEY]).ravel()) == {7}
        assert set(np.array(mi.traverse(found)[KEY]).ravel()) == {7}
    assert set(np.array(mi.traverse(found)[KEY]).ravel()) == {1}
