"""The ``.ply`` of 3D Gaussian splatting, in and out: pre-images of the activations, one property each.

Conventions. Written in the order of the authors' program: ``x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3``,
float32, normals of 0, ``f_rest`` by colour first (all of red, all of green, all of blue), quaternions (w, x, y, z). Read in any
order and with other properties among them, which are left out; what was read and is written again is the same to the bit.

Source: Kerbl et al. 2023 and the files that its authors publish.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.files import ply
from mivol.files.source import refusal
from mivol.points.gaussians import Gaussians

__all__ = ["gaussians_of_tables", "rest_of_columns", "write_gaussian_ply"]

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
COLOURS = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = (0, 9, 24, 45)
"""So many ``f_rest`` has a file of degree 0, 1, 2, 3."""


def gaussians_of_tables(tables: dict[str, np.ndarray], path: str | os.PathLike) -> Gaussians:
    """The Gaussians of a file's element ``vertex``.

    Raises:
        MivolError: a property is missing, or harmonics of no degree.
    """
    vertex = tables.get("vertex")
    held = () if vertex is None else vertex.dtype.names
    missing = [name for name in (*MEANS, *COLOURS, "opacity", *SCALES, *ROTATION) if name not in held]
    if missing:
        raise refusal(
            Path(path),
            f"no property {missing[0]!r} of a vertex",
            "the properties of 3D Gaussians (x, f_dc_0, opacity, scale_0, rot_0, ...)",
            "name a file of Gaussians (a cloud of points is read by read_points)",
        )
    constant = _columns(vertex, COLOURS)
    return Gaussians(
        _columns(vertex, MEANS),
        _columns(vertex, SCALES),
        _columns(vertex, ROTATION),
        vertex["opacity"].astype(np.float32),
        np.concatenate([constant[:, None], rest_of_columns(vertex, path)], axis=1),
    )


def rest_of_columns(table: np.ndarray, path: str | os.PathLike) -> np.ndarray:
    """Coefficients above degree 0, (N, K - 1, 3), of the properties ``f_rest_0``, ``f_rest_1``, ...

    Raises:
        MivolError: their number is that of no degree, or one is missing.
    """
    count = sum(name.startswith("f_rest_") for name in table.dtype.names)
    names = [f"f_rest_{i}" for i in range(count)]
    if count not in REST_COUNTS or any(name not in table.dtype.names for name in names):
        found = f"{count} properties f_rest"
        raise refusal(Path(path), found, f"f_rest_0, f_rest_1, ...: {REST_COUNTS} of them", "write the file again")
    if not count:
        return np.empty((len(table), 0, 3), np.float32)
    return np.swapaxes(_columns(table, names).reshape(len(table), 3, count // 3), 1, 2)


def write_gaussian_ply(file: BinaryIO, gaussians: Gaussians) -> None:
    """Write them as the authors' program does."""
    rest = np.swapaxes(gaussians.harmonics[:, 1:], 1, 2).reshape(gaussians.count, -1)
    parts = {
        MEANS: gaussians.means,
        NORMALS: np.zeros((gaussians.count, 3)),
        COLOURS: gaussians.harmonics[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): gaussians.opacity_logits[:, None],
        SCALES: gaussians.log_scales,
        ROTATION: gaussians.quaternions,
    }
    table = np.empty(gaussians.count, [(name, "<f4") for names in parts for name in names])
    for names, values in parts.items():
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    ply.write_table(file, table)


def _columns(table: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    """Some properties as float32 (N, len(names))."""
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)
