"""A radiance field as tensors that a scene's parameters are made of, and back.

Conventions. ``density`` is (Z, Y, X, 1) and ``sh`` (Z, Y, X, basis, 3) for a dense field, with the levels first where it is
nested; (nodes, 1) and (nodes, basis, 3) for a sparse one. Derivatives pass through; what is read from properties has none.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical import SphericalGrid, degree_of, row_width
from mivol.fields.spherical_files import load_field

__all__ = ["dense_densities", "field_from_props", "with_tensors"]


SHOWN = ("activation", "offset", "clamp", "space")
"""How values are shown: parameters of the plugin, kept in files. Tensors are radiance unless told otherwise."""


def field_from_props(props: mi.Properties) -> tuple[SphericalGrid, mi.TensorXf, mi.TensorXf]:
    """Read a field from plugin parameters: ``filename``, or ``density`` and ``sh``; ``to_world`` and how values are shown.

    Returns:
        The field and its two tensors; those that were given, where they were, with their gradients.

    Raises:
        MivolError: none or both of the sources, or values that no field can have.
    """
    tensors = [n for n in ("density", "sh") if n in props]
    if ("filename" in props) == bool(tensors) or len(tensors) == 1:
        found = " and ".join([*(["filename"] if "filename" in props else []), *tensors]) or "none of them"
        raise MivolError(f"mivol_sh was given {found}; give filename, or density and sh.")
    if tensors:
        density, sh = (props[n] for n in tensors)
        how = {"space": "linear"} | {n: props[n] for n in SHOWN if n in props}
        field = SphericalGrid.from_dense(np.array(dr.detach(density)), np.array(dr.detach(sh)), _place(props), **how)
        return field, density, sh
    field = load_field(str(mi.file_resolver().resolve(props["filename"])))
    how = {n: props.get(n, getattr(field, n)) for n in SHOWN}
    field = SphericalGrid.from_rows(field.res, field.to_world, *field.values(), field.nodes, levels=field.levels, **how)
    if "to_world" in props:
        field = replace(field, to_world=_place(props) @ field.to_world)
    values, coefficients = field.values()
    shape = field.shape if field.nodes is None else values.shape
    sh = np.ascontiguousarray(coefficients.reshape(*shape, *coefficients.shape[1:]))
    return field, mi.TensorXf(values.reshape(*shape, 1)), mi.TensorXf(sh)


def _place(props: mi.Properties) -> np.ndarray:
    return np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, dtype=np.float64)


def with_tensors(field: SphericalGrid, density: mi.TensorXf, sh: mi.TensorXf) -> SphericalGrid:
    """The same field with other values; ``sh`` may have another degree.

    Raises:
        MivolError: shapes that are not those of the field.
    """
    nodes = field.shape if field.nodes is None else (dr.width(field.nodes),)
    if tuple(density.shape) != (*nodes, 1) or tuple(sh.shape[:-2]) != nodes or sh.shape[-1] != 3:
        raise MivolError(
            f"density {tuple(density.shape)} and sh {tuple(sh.shape)} were given; {(*nodes, 1)} and {(*nodes, 'basis', 3)} are "
            "expected."
        )
    basis = sh.shape[-2]
    count, width = math.prod(nodes), row_width(basis)
    vacuum = field.nodes is not None
    flat = density.array
    if vacuum:
        row = dr.arange(mi.UInt32, count + 1)
        flat = dr.select(row < count, dr.gather(mi.Float, flat, dr.minimum(row, count - 1)), field.act.vacuum)
    entry = dr.arange(mi.UInt32, (count + vacuum) * width)
    row, column = entry // width, entry % width
    held = (row < count) & (column < 3 * basis)
    harmonics = dr.gather(mi.Float, sh.array, row * (3 * basis) + column, held)
    return replace(field, degree=degree_of(basis), density=flat, harmonics=harmonics)


def dense_densities(field: SphericalGrid) -> list[mi.TensorXf]:
    """The raw density at every node of each level, (Z, Y, X, 1), with the vacuum where nothing is stored.

    They are those of each level in lengths of the world: 2^-l of what level l stores.
    """
    if field.nodes is None and field.levels == 1:
        return [mi.TensorXf(field.density, (*field.res, 1))]
    node = dr.arange(mi.UInt32, math.prod(field.res))
    rows = [field.row_of(node + k * dr.width(node)) for k in range(field.levels)]
    parts = [dr.gather(mi.Float, field.density, row) * 2.0**-k for k, row in enumerate(rows)]
    return [mi.TensorXf(part, (*field.res, 1)) for part in parts]
