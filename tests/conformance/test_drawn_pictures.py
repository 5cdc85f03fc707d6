"""A seed means the same picture tomorrow: pictures, gradients and tangents of fixed seeds are as recorded, to rounding.

Means of estimators are held against twins and against Mitsuba elsewhere. A fault that leaves the mean as it is, in the
probabilities of a choice, a control variate, a reservoir or the order of random numbers, only changes the noise, which such a
test would have to measure with many samples. It changes what single samples are as well, and these are recorded:
``pytest tests/conformance/test_drawn_pictures.py -m slow --record`` records them anew, when a change of the samples is meant.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from script_modules import load

RECORDED = Path(__file__).with_suffix(".json")

CASES = (
    "constant_light", "emitter_and_sky", "sun_by_sums", "sun_by_sums_in_a_lattice", "estimated_shadows", "several_media",
    "surfaces", "emitters_of_every_kind", "free_flights", "side_flights", "white_sky",
    "refraction",
)  # fmt: skip

ROUNDING = 1e-3
"""Of the length of an array. A sample is a product of some ten factors: exponentials of optical depths below 30, which float32
has to 1e-6, and quotients of densities to as much: below 1e-4 in all, and ten times that for samples of the greatest weight.
Another sample in one pixel of 36 changes a sixth of the length."""


def sketch(values: np.ndarray) -> list[float]:
    """The length of an array, and its products with three random ones of about unit length in each direction."""
    flat = np.asarray(values, np.float64).ravel()
    weights = np.random.default_rng(flat.size).normal(size=(3, flat.size))
    return [float(np.linalg.norm(flat)), *map(float, weights @ flat)]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_seed_means_the_same_picture_tomorrow(cpu_back_end: None, name: str, record: bool, monkeypatch) -> None:
    fingerprint = load("fingerprint")
    monkeypatch.setattr(fingerprint, "RES", 6)
    monkeypatch.setattr(fingerprint, "SPP", 2)
    found = {what: sketch(values) for what, values in fingerprint.CASES[name]()}
    known = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.exists() else {}
    if record:
        text = json.dumps(dict(sorted((known | {name: found}).items())), indent=1)
        RECORDED.write_text(text + "\n", encoding="utf-8")
        known = json.loads(text)
    assert found.keys() == known[name].keys()
    for what, numbers in found.items():
        length = known[name][what][0]
        assert numbers == pytest.approx(known[name][what], rel=0, abs=ROUNDING * length), what
