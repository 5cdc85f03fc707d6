"""Questions of studies at tiny sizes have the answers that were recorded, times apart.

``pytest tests/bench/test_recorded_answers.py -m slow --record`` records anew, when a change of the numbers is meant.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import recorded_results

RECORDED = Path(__file__).with_suffix(".json")
CONTEST = {"max_pixels": 6, "fine_res": 16, "sparse_res": 32, "rounds": 4, "spp": 4}
"""Samples of a contest are told, because a budget of time would choose others each time."""

STUDIES: list[tuple[str, str, dict[str, object]]] = [
    ("depth", "table", {"lines": 1024, "taus": (0.1, 2.0)}),
    ("everyday", "images gradients", {"scenes": ("jade_null_sun", "thin_smoke"), "side": 4}),
    ("gradients", "estimators smoke", {
        "side": 4, "rounds": 4, "spp": 2, "table_rounds": 4, "table_side": 4, "table_spp": 2, "table_res": 4,
        "derivative_spp": 4, "difference_spp": 4, "reference_spp": 16, "most_estimates": 8,
    }),
    ("ladder", "ladder", {"side": 4, "rounds": 4, "spp": 4}),
    ("media_light", "fire fog room", CONTEST),
    ("multiple_scattering", "smoke|cloud|white box|milk", CONTEST),
    ("optical_depth", "walk image reverse peers grids", {
        "walk_side": 16, "image_side": 8, "grid_side": 16, "ct_res": 16, "sparse_res": 32, "peer_side": 8, "exact_rays": 64,
    }),
    ("points", "clouds peer rays biker", {"walk_side": 16}),
    ("preparation", "scatter", {"seeds": 1}),
    ("radiance_field", "step", {"side": 16, "fields": ("fog",), "walk_side": 16}),
    ("random_scenes", "trials built", {"scenes": 3, "built_scenes": 2, "rounds": 4, "spp": 4, "stock_spp": 4}),
    ("scan_size", "slices", {"n": 24, "views": 24, "slices": 2}),
    ("single_scattering", "smoke CT threads cloud", CONTEST),
    ("sparse", "walk picture fit", {"walk_res": 32, "cloud_res": 32, "fit_res": 16}),
    ("storage", "storage", {}),
    ("tomography", "solvers", {"size": 12, "views": 8, "iterations": 2}),
]  # fmt: skip
"""Study, questions, changes of the quick size."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "questions", "changes"), STUDIES, ids=[name for name, _, _ in STUDIES])
def test_a_tiny_study_has_the_recorded_answers(
    cpu_back_end: None, name: str, questions: str, changes: dict, record: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    study = import_module(f"mivol.bench.studies.{name}").STUDY
    size = study.size.quick().changed(**changes)
    names = questions.split("|" if "|" in questions else " ")
    recorded_results.check(RECORDED, name, lambda: dict(recorded_results.list_results(study.answer(names, size))), record)
