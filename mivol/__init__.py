"""Differentiable and inverse volume rendering on Mitsuba 3. The import needs no active variant.

``mivol.<tab>`` lists the functions for scripts: scenes (``load_scene``, ``explain``, ``render_reference``), fits (``Problem``,
``Parameter``, ``optimize`` and optimizers), volumes (``read_volume``, ``write_volume``, ``make_procedural``), photographs
(``load_photos``, ``fit_photographs``, ``fit_gaussians``, ``read_field``), Gaussians and points (``read_gaussians``,
``read_points``, ``Splatter``) and tomography (``Projector`` and its geometries). Each name is imported at the first use.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING

from . import llvm

llvm.choose_library()

try:
    import mitsuba as mi  # Dr.Jit loads LLVM as soon as it is imported
except (ImportError, NameError) as error:  # a NameError is how Dr.Jit 1.5 reports that its own library does not load
    raise ImportError(llvm.missing_system_library() or f"Mitsuba cannot be imported: {error}") from error

from . import back_end, plugins  # noqa: E402
from .errors import MivolError, reveal_refusals  # noqa: E402

__version__ = "0.1.0"

PUBLIC = {
    "Adam": "optim.first_order",
    "ConeBeam": "tomography.geometry",
    "GaussNewton": "optim.second_order",
    "Gaussians": "points",
    "Lbfgs": "optim.second_order",
    "ParallelBeam": "tomography.geometry",
    "Parameter": "optim.parameters",
    "PointCloud": "points",
    "Problem": "experiments.script",
    "Projector": "tomography.projector",
    "RMSprop": "optim.first_order",
    "Splatter": "splatting",
    "VoxelGrid": "tomography.geometry",
    "convert_pbrt": "scene.pbrt",
    "explain": "experiments.script",
    "fit_gaussians": "experiments.script",
    "fit_photographs": "experiments.script",
    "read_field": "fields.field_files",
    "load_photos": "photos",
    "load_scene": "scene.load",
    "make_procedural": "fields.procedural",
    "optimize": "experiments.script",
    "read_gaussians": "points",
    "read_points": "points",
    "read_volume": "files",
    "read_sparse_volume": "files",
    "SparseVolumeData": "files",
    "render_reference": "validate.reference",
    "run_algotom": "tomography.algotom",
    "write_field": "fields.field_files",
    "write_gaussians": "points",
    "write_points": "points",
    "write_grids": "files",
    "write_volume": "files",
}
"""Public names and their modules below ``mivol``. Type checkers read the list below instead."""

if TYPE_CHECKING:  # for type checkers; at run time __getattr__ imports each name at its first use
    from .experiments.script import Problem as Problem
    from .experiments.script import explain as explain
    from .experiments.script import fit_gaussians as fit_gaussians
    from .experiments.script import fit_photographs as fit_photographs
    from .experiments.script import optimize as optimize
    from .fields.field_files import read_field as read_field
    from .fields.field_files import write_field as write_field
    from .fields.procedural import make_procedural as make_procedural
    from .files import SparseVolumeData as SparseVolumeData
    from .files import read_sparse_volume as read_sparse_volume
    from .files import read_volume as read_volume
    from .files import write_grids as write_grids
    from .files import write_volume as write_volume
    from .optim.first_order import Adam as Adam
    from .optim.first_order import RMSprop as RMSprop
    from .optim.parameters import Parameter as Parameter
    from .optim.second_order import GaussNewton as GaussNewton
    from .optim.second_order import Lbfgs as Lbfgs
    from .photos import load_photos as load_photos
    from .points import Gaussians as Gaussians
    from .points import PointCloud as PointCloud
    from .points import read_gaussians as read_gaussians
    from .points import read_points as read_points
    from .points import write_gaussians as write_gaussians
    from .points import write_points as write_points
    from .scene.load import load_scene as load_scene
    from .scene.pbrt import convert_pbrt as convert_pbrt
    from .splatting import Splatter as Splatter
    from .tomography.algotom import run_algotom as run_algotom
    from .tomography.geometry import ConeBeam as ConeBeam
    from .tomography.geometry import ParallelBeam as ParallelBeam
    from .tomography.geometry import VoxelGrid as VoxelGrid
    from .tomography.projector import Projector as Projector
    from .validate.reference import render_reference as render_reference

__all__ = ["MivolError", "__version__", *PUBLIC]


def __getattr__(name: str) -> object:
    if name not in PUBLIC:
        raise AttributeError(f"module 'mivol' has no attribute {name!r}")
    return getattr(importlib.import_module(f"mivol.{PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def _on_variant_change(old: str | None, new: str) -> None:
    llvm.check_backend(new)
    back_end.spill_to_local_memory(new)
    importlib.reload(plugins)


mi.detail.add_variant_callback(_on_variant_change)
mi.render = mi.util.render = reveal_refusals(mi.render)

back_end.spill_to_local_memory()
try:
    llvm.check_backend()
except llvm.LlvmError as error:
    warnings.warn(f"{error}", RuntimeWarning, stacklevel=2)
