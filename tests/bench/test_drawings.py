"""Figures of the benches, drawn from made-up answers, are readable."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from bench_figures import drawn
from readable_figures import assert_readable

from mivol.bench.studies import (
    depth,
    gradients,
    media_light,
    multiple_scattering,
    optical_depth,
    radiance_field,
    random_scenes,
    single_scattering,
    still_life,
    tomography,
)
from mivol.bench.studies.depth import TABLES, Cell
from mivol.bench.studies.gradients import CONTESTS
from mivol.bench.studies.gradients.density_gradient import INTEGRATORS


def contest(names: dict, stocks: tuple[str, ...]) -> dict:
    """Errors that fall with the root of time, of each method in each light, and ratios that differ by light."""
    answer = {}
    for k, (name, light) in enumerate(names.items(), 1):
        rows = [{"seconds_median": t, f"relative_error_{light.average}_over_pixels": k * t**-0.5} for t in (0.5, 2.0)]
        ratios = {
            f"mivol over {s}": {f"variance_x_time_{light.average}_over_pixels": 10.0 * k + i} for i, s in enumerate(stocks)
        }
        answer[name] = dict.fromkeys(("mivol", *stocks), rows) | ratios
    return answer


@pytest.mark.slow
def test_single_scattering(monkeypatch: pytest.MonkeyPatch) -> None:
    answer = contest(single_scattering.LIGHTS, single_scattering.PEERS)
    figure = drawn(single_scattering, monkeypatch, {"smoke": answer, "cloud": answer}, Path())
    assert_readable(figure)


def test_multiple_scattering(monkeypatch: pytest.MonkeyPatch) -> None:
    lights = multiple_scattering.CONTESTS["smoke"]
    figure = drawn(multiple_scattering, monkeypatch, {"smoke": contest(lights, single_scattering.PEERS)}, Path())
    assert_readable(figure)


def test_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    smoke = {
        light: {what: {"sigma_t >= 1": {"variance_x_time": 10.0 * k + i}} for i, what in enumerate(("mean", "L2"))}
        for k, light in enumerate(CONTESTS["smoke"][1], 4)
    }
    one = {name: {"bias_percent": 2.0 + k, "known_to_percent": 0.1 + k} for k, name in enumerate(INTEGRATORS)}
    estimators = {light: {"dense": one, "density 0": one} for light in CONTESTS["smoke"][1]}
    runs = {name: {"seconds": [1.0, 2.0 + k], "loss": [0.5, 0.0]} for k, name in enumerate(INTEGRATORS)}
    answers = {"smoke": smoke, "estimators": estimators, "tutorial": {"runs": runs}}
    assert_readable(drawn(gradients, monkeypatch, answers, Path()))


def test_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = [
        Cell("cube", light, phase, albedo, tau, 1.0, 2.0, albedo * tau / (4 + tau), 0.01 * k, 1.0)
        for k, (light, phase) in enumerate(TABLES, 1)
        for albedo in depth.ALBEDOS
        for tau in (0.1, 1.0, 10.0)
    ]
    beside = [Cell(*place, "isotropic", 0.5, 2.0, 1.0, 2.0, 0.2 + 0.1 * k, 0.01, 1.0) for k, place in enumerate(depth.MARKERS)]
    answers = {"table": {"cells": [asdict(c) for c in cells]}, "beside": {"cells": [asdict(c) for c in beside]}}
    assert_readable(drawn(depth, monkeypatch, answers, Path()))


def test_media_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ratio of 0 has no logarithm: its number stands where a bar would begin."""
    ratios = {"fire": 0.0, "fog": 37.2, "room": 0.998}
    answers = {name: {"variance_x_time_median_over_pixels": ratio} for name, ratio in ratios.items()}
    assert_readable(drawn(media_light, monkeypatch, answers, Path()))


def test_still_life(monkeypatch: pytest.MonkeyPatch) -> None:
    ramp = np.linspace(0, 1, 3 * 4 * 3).reshape(3, 4, 3)
    fits = {"SH 2": {"photograph": ramp, "view": ramp * 1.5, "psnr": 20.125, "views": 8}}
    figure = drawn(still_life, monkeypatch, {"degree": fits, "few": fits}, Path())
    assert_readable(figure)


def test_tomography(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slice is three eighths up, and white is 0.6 of the truth's brightest thousandth."""
    truth = np.arange(8.0 * 3 * 4).reshape(8, 3, 4)
    curves = {"SIRT": {"nrmse": [0.5, 0.25], "seconds": [3.0, 6.0]}}
    answer = {"object": "head", "truth": truth, "curves": curves, "volumes": {"SIRT": truth / 2}}
    figure = drawn(tomography, monkeypatch, {"solvers": answer}, Path("a.png"))
    assert_readable(figure)


def test_radiance_field(monkeypatch: pytest.MonkeyPatch) -> None:
    ratios = {kind: {"ratio_of_processor_time": k + 2.0} for k, kind in enumerate(("camera", "pixels", "any"))}
    curves = {"ours": [(1.0, 20.0), (2.0, 25.0)], "peer": [(10.0, 18.0), (20.0, 23.0)], "peer_psnr": 24.0}
    answers = {
        "step": {"fog": ratios, "shell": ratios},
        "memory": {"peak_bytes": [2**20, 4 * 2**20], "field_bytes": 3 * 2**20, "bytes_per_ray": 100.4},
        "locality": {name: {"processor_seconds": t, "steps": 100, "psnr": 10 * t} for name, t in (("tiles", 3), ("pixels", 5))},
        "fit": {"fog": curves},
    }
    assert_readable(drawn(radiance_field, monkeypatch, answers, Path()))


def test_random_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = {"1": {"z": -2.0, "z_bound": 4.0}, "2": {"z": None, "z_bound": 4.0}, "3": {"z": 5.0, "z_bound": 4.0}}
    figure = drawn(random_scenes, monkeypatch, {"trials": {"trials": trials}}, Path())
    assert_readable(figure)


def test_optical_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its figure is one of the reports; what it is given is a series of each peer."""
    given = []
    monkeypatch.setattr(optical_depth, "plot_error_against_time", lambda *place, **words: given.append((place, words)))
    points_of = [{"seconds_median": 2.0, "rms_error": 0.5}, {"seconds_median": 4.0, "rms_error": 0.25}]
    peers = {"rays": 12345, "grid": "128^3, of floats", "mivol": points_of, "volpath": points_of[:1]}
    optical_depth.draw({"peers": peers}, Path("a.png"))
    (((series, path), words),) = given
    assert [(s.name, list(s.seconds), list(s.error)) for s in series] == [
        ("mivol", [2.0, 4.0], [0.5, 0.25]),
        ("volpath", [2.0], [0.5]),
    ]
    assert path == Path("a.png")
    assert words == {
        "error": "RMS error of T against float64",
        "title": "Transmittance of 12,345 rays through the smoke 128^3: error against time",
    }
