"""What holds where an experiment says nothing: who changes a default changes the results of every experiment that is silent."""

from __future__ import annotations

import importlib
import math

import msgspec
import pytest

from mivol.config import SceneExperiment
from mivol.optim.events import Checkpoint, Evaluate
from mivol.optim.first_order import Adam
from mivol.optim.losses import L2
from mivol.optim.schedules import Constant

DEFAULTS = {
    "config.Cone": {
        **{"views": 90, "arc": 180.0, "detector": (1, 128), "pitch": 1.0},
        **{"detector_offset": (0.0, 0.0), "axis_offset": 0.0},
    },
    "config.Detector": {
        **{"views": 90, "arc": 180.0, "detector": (1, 128), "pitch": 1.0},
        **{"detector_offset": (0.0, 0.0), "axis_offset": 0.0},
    },
    "config.Ellipsoids": {"photons": 0.0, "seed": 1, "table": "yu-ye-wang", "half_width": 1.0, "scale": 1.0},
    "config.SceneExperiment": {
        "held_out": None,
        "truth": None,
        "variant": "llvm_ad_rgb",
        "seed": 0,
        "threads": 0,
        "output": "runs/fit",
    },
    "config.FieldSettings": {
        "preset": "cpu",
        "longest": None,
        "degree": None,
        "first_degree": None,
        "effort": 1.0,
        "tv_density": None,
        "tv_sh": None,
        "sparsity": None,
        "matte": None,
        "sky": None,
        "beta": None,
    },
    "config.FieldExperiment": {
        "checkpoint_every": 500,
        "variant": "llvm_ad_rgb",
        "seed": 0,
        "threads": 0,
        "output": "runs/field",
    },
    "config.Files": {"scene": "", "held_out": ()},
    "config.Grid": {"voxel_size": 1.0, "centre": (0.0, 0.0, 0.0)},
    "config.Known": {"photons": 0.0, "seed": 1, "scale": 1.0},
    "config.Measured": {"group": "exchange", "find_axis": None, "air": 0, "drift": 0, "saturation": math.inf},
    "config.Parallel": {
        **{"views": 90, "arc": 180.0, "detector": (1, 128), "pitch": 1.0},
        **{"detector_offset": (0.0, 0.0), "axis_offset": 0.0},
    },
    "config.Photographs": {
        "scale": 1.0,
        "largest": None,
        "background": "",
        "held_out": 8,
        "box": "found",
        "judged": "held_out",
    },
    "config.Rendered": {"spp": 1024, "standard_error": 0.0, "seed": 1, "held_out": ()},
    "config.Matrices": {"detector": (1, 128), "first_pixel": (0.0, 0.0)},
    "config.Nikon": {"find_axis": None, "air": 0, "drift": 0, "saturation": math.inf, "angles": ""},
    "config.ScanExperiment": {
        **{"grid": None, "held_out_every": 0},
        **{"checkpoint_every": 5, "variant": "llvm_ad_rgb", "threads": 0, "output": "runs/scan"},
    },
    "config.SceneFitSettings": {
        "iterations": 100,
        "spp": 16,
        "spp_shown": 0,
        "samples_per_pass": 1048576,
        "max_depth": 6,
        "integrator": "mivol",
    },
    "config.ShowSettings": {"views": 4, "frames": 60, "every": 250, "metrics": ("psnr", "ssim")},
    "config.Readings": {"find_axis": None, "air": 0, "drift": 0, "saturation": math.inf},
    "config.Simulated": {"photons": 0.0, "seed": 1},
    "config.SolveSettings": {
        **{"name": "auto", "start": None, "supersampling": None, "iterations": 20, "nonnegative": True, "subsets": 10},
        **{"relaxation": 1.0, "decay": 0.99, "window": "ram-lak", "cutoff": 1.0, "tv": None, "delta": 0.1},
        **{"tv_unit": "noise", "storage": "auto", "memory": 1.0, "discrepancy": 0.0},
    },
    "config.Stack": {
        **{"find_axis": None, "air": 0, "drift": 0, "saturation": math.inf},
        **{"dataset": "", "flats": "", "darks": "", "angles": ""},
        **{"angle_unit": "degree", "first_row": "lowest"},
    },
    "config.Table": {"detector": (1, 128)},
    "config.Sought": {
        "unit": "",
        "domain": (0.0, math.inf),
        "map": "identity",
        "lr": 0.1,
        "start": None,
        "start_file": "",
        "shape": None,
        "prior": (),
    },
    "config.Truth": {"file": "", "procedural": "", "shape": (48, 48, 48), "seed": 0, "peak": 1.0},
    "optim.first_order.Adam": {"views": 0, "beta_1": 0.9, "beta_2": 0.999, "epsilon": 1e-06},
    "optim.priors.DecoupledPrior": {"weight": 1.0},
    "optim.priors.Smoothness": {"weight": 1.0, "share": 0.125, "every": 1},
    "optim.priors.Sparsity": {"weight": 1.0},
    "optim.priors.ViewDependence": {"weight": 1.0},
    "optim.events.Checkpoint": {"every": 10},
    "optim.events.Evaluate": {"every": 10},
    "optim.events.UpdateOccupancy": {"every": 64},
    "optim.events.Upsample": {"factor": 2},
    "optim.second_order.GaussNewton": {"inner": 6, "damping": 0.001},
    "optim.projections.inversion.LinearSolve": {
        **{"solver": "pcg", "subsets": 10, "drift": 0, "relaxation": 1.0, "decay": 0.99, "window": "ram-lak", "cutoff": 1.0},
        "stop_norm": 0.0,
    },
    "optim.second_order.Lbfgs": {"memory": 10},
    "optim.losses.Huber": {"pairs": False, "delta": 0.1},
    "optim.losses.L1": {"pairs": False},
    "optim.losses.L2": {"pairs": False},
    "optim.losses.Log": {"pairs": False, "floor": 0.001},
    "optim.losses.Loss": {"pairs": False},
    "optim.losses.RelativeL2": {"pairs": False, "floor": 0.01},
    "optim.optimizer.FirstOrder": {"views": 0},
    "optim.priors.Bounds": {"weight": 1.0, "low": 0.0, "high": math.inf},
    "optim.priors.HuberTotalVariation": {"weight": 1.0, "edge": 0.1},
    "optim.priors.Laplacian": {"weight": 1.0},
    "optim.priors.Prior": {"weight": 1.0},
    "optim.priors.Sparse": {"weight": 1.0, "knee": 0.001},
    "optim.priors.TotalVariation": {"weight": 1.0, "edge": 0.01},
    "optim.first_order.RMSprop": {"views": 0, "memory": 0.95, "half": False},
    "optim.schedules.Cosine": {"final": 0.0},
    "optim.schedules.Exponential": {"final": 0.1, "delay": 0},
    "optim.schedules.Step": {"at": (0.75, 0.85, 0.95), "ratio": 0.5},
    "scene.camera_rigs.Hemisphere": {
        "count": 16,
        "distance": 4.0,
        "lowest": 0.0,
        "start": 0.0,
        "up": "y",
        "fov": 0.0,
        "width": 64,
        "height": 64,
        "rfilter": "box",
        "near": 0.01,
        "far": 10000.0,
    },
    "scene.camera_rigs.LookAts": {
        "ups": ((0.0, 1.0, 0.0),),
        "fov": 0.0,
        "width": 64,
        "height": 64,
        "rfilter": "box",
        "near": 0.01,
        "far": 10000.0,
    },
    "scene.camera_rigs.PlacedRig": {"fov": 0.0, "width": 64, "height": 64, "rfilter": "box", "near": 0.01, "far": 10000.0},
    "scene.camera_rigs.Ring": {
        "count": 8,
        "distance": 4.0,
        "elevation": 0.0,
        "start": 0.0,
        "arc": 360.0,
        "up": "y",
        "fov": 0.0,
        "width": 64,
        "height": 64,
        "rfilter": "box",
        "near": 0.01,
        "far": 10000.0,
    },
    "scene.camera_rigs.SceneSensors": {"indices": ()},
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_defaults(name: str) -> None:
    module, _, struct = name.rpartition(".")
    kind = getattr(importlib.import_module(f"mivol.{module}"), struct)
    found = {f.name: f.default for f in msgspec.structs.fields(kind) if f.name in DEFAULTS[name]}
    assert found == DEFAULTS[name]


def test_a_fit_that_chooses_no_strategy():
    """Adam at a constant rate, squared differences, a checkpoint and a judgement every tenth iteration."""
    chosen = {f.name: f.default for f in msgspec.structs.fields(SceneExperiment)}
    assert (chosen["optimiser"], chosen["schedule"], chosen["loss"]) == (Adam(), Constant(), L2())
    assert chosen["event"] == (Checkpoint(every=10), Evaluate(every=10))
