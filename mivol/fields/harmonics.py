r"""Directional colour in spherical harmonics: the basis, sRGB code values, radiance, and the colours of Gaussians.

.. math:: c(\omega) = L\Big(\max\big(0,\; \tfrac12 + \sum_b Y_b(\omega)\, k_b\big)\Big)

The colour of a Gaussian. L decodes sRGB code values, as published files hold them; for linear colours L is the identity.

Conventions. The direction is the direction of travel of the ray, in the frame of the cloud: the rotation (and mirror image) of
the placement is removed. Splatting takes the direction from the camera to the mean; the direction of the ray needs no camera,
so the colour is also defined behind glass and in mirrors. Below a sum of -1/2 a channel is black with derivative 0, as in
:mod:`mivol.splatting.projection`. A Gaussian's row of harmonics is [basis][rgb], padded to whole blocks of ``ROW_SIZE``
numbers, which Dr.Jit moves as packets.

References: Kerbl et al. 2023 (the model); Moenne-Loccoz et al. 2024 (the direction of the ray); Higham 1986 (the polar factor).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.gaussian_line import ROW_SIZE, read_row

MAX_DEGREE = 4


SPACES = ("srgb", "linear")
"""Meanings of a field's colours, as for photographs (:mod:`mivol.photos.dataset`): sRGB code values or radiance."""


def basis_size(degree: int) -> int:
    """Number of harmonics up to a degree."""
    return (degree + 1) ** 2


def harmonic_degree(basis: int) -> int:
    """The degree of a number of harmonics.

    Raises:
        MivolError: a number other than 1, 4, 9, 16 or 25.
    """
    degree = math.isqrt(max(basis, 0)) - 1
    if degree < 0 or degree > MAX_DEGREE or basis_size(degree) != basis:
        raise MivolError(f"{basis} harmonics were given; 1, 4, 9, 16 or 25 (degrees 0 to {MAX_DEGREE}) are expected.")
    return degree


def row_width(basis: int) -> int:
    """Size of a grid's row of harmonics: 3 numbers a harmonic, padded to a multiple of 4, so that rows move as packets."""
    return -(-3 * basis // 4) * 4


def decode_srgb_code(code: mi.Float) -> mi.Float:
    """Radiance of an sRGB code value: the curve of IEC 61966-2-1, continued above 1 and, as a line, below 0.

    The same curve as :func:`mivol.photos.photo_file.decode_srgb`, with derivatives.
    """
    # Below -0.055 the power is NaN. The line is selected there, and Dr.Jit evaluates a derivative of 0 times NaN as 0.
    bent = dr.power((code + 0.055) / 1.055, 2.4)
    return dr.select(code <= 0.04045, code / 12.92, bent)


def srgb_slope(code: mi.Float) -> mi.Float:
    """The derivative of :func:`decode_srgb_code`."""
    return dr.select(code <= 0.04045, 1 / 12.92, (2.4 / 1.055) * dr.power((code + 0.055) / 1.055, 1.4))


def local_frame(to_world: np.ndarray) -> np.ndarray:
    """(3, 3) map of world directions to a field's own frame: the inverse polar factor of the placement (Higham 1986)."""
    left, _, right = np.linalg.svd(to_world[:3, :3])
    return (left @ right).T


def rotate_direction(frame: np.ndarray, d: mi.Vector3f) -> mi.Vector3f:
    """Directions multiplied by a (3, 3) matrix."""
    rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in frame]
    return mi.Vector3f(*(dr.fma(r[0], d.x, dr.fma(r[1], d.y, r[2] * d.z)) for r in rows))


def blocks_per_gaussian(degree: int) -> int:
    """Blocks of ``ROW_SIZE`` numbers for the harmonics of a Gaussian."""
    return -(-3 * basis_size(degree) // ROW_SIZE)


def pack_harmonics(harmonics: mi.TensorXf, degree: int) -> mi.Float:
    """The harmonics (N, K, 3) as rows of whole blocks; derivatives pass through."""
    used, width = 3 * basis_size(degree), ROW_SIZE * blocks_per_gaussian(degree)
    if used == width:
        return harmonics.array
    index = dr.arange(mi.UInt32, harmonics.shape[0] * width)
    number, column = index // width, index % width
    return dr.gather(mi.Float, harmonics.array, number * used + column, column < used)


def read_harmonics(rows: mi.Float, first: mi.UInt32, degree: int) -> list[mi.Float]:
    """The harmonics of a Gaussian, whose first block has the number ``first``."""
    return [value for block in range(blocks_per_gaussian(degree)) for value in read_row(rows, first + block)]


def sum_harmonics(row: list[mi.Float], basis: list[mi.Float]) -> list[mi.Float]:
    """sum_b Y_b k_b of each channel."""
    return [sum((y * row[3 * b + c] for b, y in enumerate(basis)), mi.Float(0)) for c in range(3)]


def eval_colour(row: list[mi.Float], basis: list[mi.Float], space: str) -> list[mi.Float]:
    """The radiance of a Gaussian: red, green and blue."""
    codes = [dr.maximum(total + 0.5, 0) for total in sum_harmonics(row, basis)]
    return codes if space == "linear" else [decode_srgb_code(code) for code in codes]


def eval_colour_slopes(row: list[mi.Float], basis: list[mi.Float], space: str) -> list[mi.Float]:
    """Derivatives of :func:`eval_colour` with respect to the sums of harmonics."""
    codes = [total + 0.5 for total in sum_harmonics(row, basis)]
    return [dr.select(code > 0, 1 if space == "linear" else srgb_slope(code), 0) for code in codes]
