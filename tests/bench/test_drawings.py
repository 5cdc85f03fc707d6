"""Figures of the benches, drawn from made-up answers, are readable; tables hold the numbers of made-up answers."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from bench_figures import drawn
from readable_figures import assert_readable

from mivol.bench.studies import (
    cluster,
    conversions,
    depth,
    gpu,
    gradients,
    media_light,
    multiple_scattering,
    optical_depth,
    preparation,
    radiance_field,
    random_scenes,
    representations,
    single_scattering,
    steps,
    storage,
    tomography,
)
from mivol.bench.studies.depth import TABLES
from mivol.bench.studies.gradients import CONTESTS
from mivol.bench.studies.gradients.twin import INTEGRATORS


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


def of_gradients() -> dict:
    smoke = {
        light: {what: {"sigma_t >= 1": {"variance_x_time": 10.0 * k + i}} for i, what in enumerate(("mean", "L2"))}
        for k, light in enumerate(CONTESTS["smoke"][1], 4)
    }
    one = {name: {"bias_percent": 2.0 + k, "known_to_percent": 0.1 + k} for k, name in enumerate(INTEGRATORS)}
    estimators = {light: {"dense": one, "density 0": one} for light in CONTESTS["smoke"][1]}
    runs = {name: {"seconds": [1.0, 2.0 + k], "loss": [0.5, 0.0]} for k, name in enumerate(INTEGRATORS)}
    return {"smoke": smoke, "estimators": estimators, "tutorial": {"runs": runs}}


def of_depth() -> dict:
    cells = [
        {
            "light": light,
            "phase": phase,
            "albedo": albedo,
            "tau": tau,
            "error": albedo * tau / (4 + tau),
            "standard_error": 0.02,
        }
        for light, phase in TABLES
        for albedo in depth.ALBEDOS
        for tau in (0.1, 1.0, 10.0)
    ]
    return {"table": {"cells": cells}}


def of_tomography() -> dict:
    truth = np.arange(8.0 * 3 * 4).reshape(8, 3, 4)
    curves = {"SIRT": {"nrmse": [0.5, 0.25], "seconds": [3.0, 6.0]}}
    return {"solvers": {"object": "head", "truth": truth, "curves": curves, "volumes": {"SIRT": truth / 2}}}


def of_radiance_fields() -> dict:
    ratios = {kind: {"ratio_of_processor_time": k + 2.0} for k, kind in enumerate(("camera", "pixels", "any"))}
    curves = {"ours": [(1.0, 20.0), (2.0, 25.0)], "peer": [(10.0, 18.0), (20.0, 23.0)], "peer_psnr": 24.0}
    return {"step": {"fog": ratios, "shell": ratios}, "fit": {"fog": curves}}


TRIALS = {str(k): {"z": z, "z_bound": 4.0} for k, z in enumerate((-2.0, None, 5.0), 1)}
ANSWERS = {
    single_scattering: lambda: dict.fromkeys(("smoke", "cloud"), contest(single_scattering.LIGHTS, single_scattering.PEERS)),
    multiple_scattering: lambda: {"smoke": contest(multiple_scattering.CONTESTS["smoke"], single_scattering.PEERS)},
    gradients: of_gradients,
    depth: of_depth,
    # A ratio of 0 has no logarithm: its number stands where a bar would begin.
    media_light: lambda: {
        name: {"variance_x_time_median_over_pixels": ratio} for name, ratio in (("fire", 0.0), ("fog", 37.2), ("room", 0.998))
    },
    tomography: of_tomography,
    radiance_field: of_radiance_fields,
    random_scenes: lambda: {"trials": {"trials": TRIALS}},
}


@pytest.mark.slow_for("single_scattering")
@pytest.mark.parametrize("study", ANSWERS, ids=lambda study: study.__name__.rpartition(".")[-1])
def test_figures_are_readable(monkeypatch: pytest.MonkeyPatch, study: ModuleType) -> None:
    assert_readable(drawn(study, monkeypatch, ANSWERS[study](), Path("a.png")))


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


CLUSTER = {
    "reference": {"ratio": 0.61, "workers": 1.1, "uneven": 1.02, "owner": 0.03},
    "gradient": {"ratio": 0.64},
    "messages": {"seconds": {"8e4": {"median": 0.0031, "fastest": 0.0027}}, "latency": 0.0012, "bandwidth": 2.5e8},
    "scaling": [{"name": "a fit", "seconds": [4.0, 2.125], "limit": "2 workers: no more pieces of work"}],
}
AXES = {
    "scans": {"head": {"column": 59.8, "error": -0.0312, "sigma": 0.0204, "method": "mirror"}},
    "count": 1,
    "found": 1,
    "found_or_told": 1,
}
STEP = {"milliseconds": {"prbvolpath": 20.0, "mivol": 4.0}, "launches": {"prbvolpath": 61, "mivol": 8}, "ratio": 5.0}
COUNTED_STEP = STEP | {"render_launches": {"prbvolpath": 40, "mivol": 6}}
STEPS = {"a": STEP, "b": {"milliseconds": {"mivol": 1.5}, "launches": {"mivol": 3}}, "c": COUNTED_STEP}
TARGETS = {"octree": {"loss": 38.26, "psnr": 33.04}}
TABLES_OF = [
    (cluster, "overhead", {"7": {"median": 0.012, "fastest": 0.0081, "processor": 0.0064}}, [
        "a step of 100 ms with 7 reals takes 12 ms more (median; fastest 8.1 ms; processor time of owner and worker 6.4 ms)",
    ]),
    (cluster, "cluster", CLUSTER, [
        "reference: two workers take 0.610 of the time of one process",
        "gradient: two workers take 0.640 of the time of one process",
        "reference: the workers take 1.100 of the time of one process together, the slower one 1.020 of their mean, and the "
        "owner 0.030",
        "8e4 bytes to two workers and back: median 3.1 ms, fastest 2.7 ms",
        "latency 1.2 ms a worker, bandwidth 250 MB/s",
        "",
        "| workload | 1 | 2 | 4 | 8 | 16 | 32 | 100 | 1000 | fastest |",
        "|---|---|---|---|---|---|---|---|---|---|",
        "| a fit | 4 | 2.12 | 2 workers: no more pieces of work |",
    ]),
    (conversions, "matrix", {"sources": {"grid": {"psnr": 34.1, "targets": TARGETS}}}, [
        "| from, to | grid | octree | hash grid | NeRF | Gaussians |",
        "|---|---|---|---|---|---|",
        "| grid (34.1) | - | 38.3 (33.0) | - | - | - |",
    ]),
    (gpu, "samples", {"samples_per_second": {"half": 2.5e7, "single": 2e7}, "card": "a card"}, [
        "| hash grid, forward and backward, half | 25.0 M samples/s | a card |",
        "| hash grid, forward and backward, single | 20.0 M samples/s | a card |",
    ]),
    (gpu, "hash", {"psnr": 30.126, "ssim": 0.9, "seconds": 61.2, "card": "a card"}, [
        "| hash | 30.13 dB / 0.900 in 61 s | a card |",
    ]),
    (gpu, "hash", {}, []),
    (preparation, "axis", AXES, [
        "| scan | column | error | sigma | method |",
        "| --- | --- | --- | --- | --- |",
        "| head | 59.8 | -0.031 | 0.020 | mirror |",
        "",
        "within 0.2 columns: 1 of 1; or within two sigma: 1",
    ]),
    (preparation, "rings", {"head": {"none": 2.0, "gain": 1.0625}}, [
        "| scan | none | gain |",
        "| --- | ---: | ---: |",
        "| head | 2 | 1.06 |",
    ]),
    (representations, "rounds", {"32 + 32": {"psnr": 20.904, "ssim": 0.7, "steps": 512}}, [
        "| samples of a ray | PSNR / SSIM | steps |",
        "|---|---|---|",
        "| 32 + 32 | 20.90 dB / 0.700 | 512 |",
    ]),
    (representations, "samples", {"rate": 1.0}, []),
    (storage, "storage", {"fitted": [], "kinds": [
        {"name": name, "sparse": not b, "per_cell": (108.0, b), "scenes": dict.fromkeys(storage.RESOLUTIONS, (2**30, b))}
        for name, b in (("cells", 54.25), ("nodes", 0))
    ]}, [
        "| memory / disk | bytes a cell | 128^3 | 256^3 | 512^3 | 1024^3 |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        "| cells | 108 / 54.2 | 1 GiB / 54.2 B | 1 GiB / 54.2 B | 1 GiB / 54.2 B | 1 GiB / 54.2 B |",
        "| nodes | 108 (a kept node) | 1 GiB | 1 GiB | 1 GiB | 1 GiB |",
        "",
    ]),
    (steps, "gradients", {"rows": STEPS}, [
        "| scene, film | prbvolpath [ms] | mivol [ms] | ratio | launches |",
        "|---|---|---|---|---|",
        "| a | 20 | 4 | 5 | 61 / 8 |",
        "| b | | 1.5 | | 3 |",
        "| c | 20 | 4 | 5 | 61 / 8 (40 / 6) |",
    ]),
]  # fmt: skip
"""Study, question, answer, lines."""


@pytest.mark.parametrize(("study", "question", "answer", "lines"), TABLES_OF)
def test_tables_hold_their_numbers(study: ModuleType, question: str, answer: dict, lines: list[str]) -> None:
    assert study.STUDY.table(question, answer) == lines


def test_a_fit_that_was_not_made_has_no_figure() -> None:
    gpu.STUDY.draw({"hash": {}}, Path("nothing"))
