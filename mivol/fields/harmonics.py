r"""Colours of Gaussians as rays see them: rows of harmonics, the light of one along a direction, and its derivative.

.. math:: c(\omega) = L\Big(\max\big(0,\; \tfrac12 + \sum_b Y_b(\omega)\, k_b\big)\Big)

with L the light of a code value where colours are sRGB codes, as in published files, and the number itself where they are
radiance (``linear``).

Conventions. The direction is that in which the ray travels, in the frame of the cloud: the rotation (and mirror image) of its
placement is taken off. Splatting takes the direction from the camera to the mean; that of the ray needs no camera, so it
holds behind glass and in mirrors too. Below a sum of -1/2 a channel is black, with a derivative of 0, as in
:mod:`mivol.splatting.projection`. A row of harmonics is [basis][rgb], filled up to whole blocks of ``ROW`` numbers, so that a
block moves as one packet.

Sources: Kerbl et al. 2023 (the model); Moenne-Loccoz et al. 2024 (the direction of the ray).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.gaussian_line import ROW_SIZE, read_row

__all__ = [
    "blocks_per_gaussian",
    "eval_colour",
    "eval_colour_slopes",
    "read_harmonics",
    "pack_harmonics",
    "sum_harmonics",
    "MAX_DEGREE",
    "SPACES",
    "basis_size",
    "harmonic_degree",
    "row_width",
    "decode_srgb_code",
    "srgb_slope",
    "local_frame",
    "rotate_direction",
]


MAX_DEGREE = 4


SPACES = ("srgb", "linear")
"""What the colours of a field may be, as of photographs (:mod:`mivol.photos.dataset`)."""


def basis_size(degree: int) -> int:
    """Number of harmonics up to a degree."""
    return (degree + 1) ** 2


def harmonic_degree(basis: int) -> int:
    """The degree of so many harmonics.

    Raises:
        MivolError: not 1, 4, 9, 16 or 25.
    """
    degree = math.isqrt(max(basis, 0)) - 1
    if degree < 0 or degree > MAX_DEGREE or basis_size(degree) != basis:
        raise MivolError(f"{basis} harmonics were given; 1, 4, 9, 16 or 25 (degrees 0 to {MAX_DEGREE}) are expected.")
    return degree


def row_width(basis: int) -> int:
    """Numbers of a row of harmonics: 3 for each, filled up to a multiple of 4, so that rows move as packets."""
    return -(-3 * basis // 4) * 4


def decode_srgb_code(code: mi.Float) -> mi.Float:
    """The light of an sRGB code value: the curve of IEC 61966-2-1, followed on above 1 and, straight, below 0.

    The same curve as :func:`mivol.photos.photo_file.decode_srgb`, with derivatives.
    """
    # Below -0.055 the power is NaN. It is not selected there, and Dr.Jit takes a derivative of 0 times NaN for 0.
    bent = dr.power((code + 0.055) / 1.055, 2.4)
    return dr.select(code <= 0.04045, code / 12.92, bent)


def srgb_slope(code: mi.Float) -> mi.Float:
    """The derivative of :func:`decode_srgb_code`."""
    return dr.select(code <= 0.04045, 1 / 12.92, (2.4 / 1.055) * dr.power((code + 0.055) / 1.055, 1.4))


def local_frame(to_world: np.ndarray) -> np.ndarray:
    """(3, 3) map of world directions to a field's own frame: the inverse of the polar factor of its placement (Higham 1986)."""
    left, _, right = np.linalg.svd(to_world[:3, :3])
    return (left @ right).T


def rotate_direction(frame: np.ndarray, d: mi.Vector3f) -> mi.Vector3f:
    """Directions in another frame."""
    rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in frame]
    return mi.Vector3f(*(dr.fma(r[0], d.x, dr.fma(r[1], d.y, r[2] * d.z)) for r in rows))


def blocks_per_gaussian(degree: int) -> int:
    """Blocks of ``ROW`` numbers that the harmonics of one Gaussian take."""
    return -(-3 * basis_size(degree) // ROW_SIZE)


def pack_harmonics(harmonics: mi.TensorXf, degree: int) -> mi.Float:
    """The harmonics (N, K, 3) as rows of whole blocks, with their derivatives."""
    used, width = 3 * basis_size(degree), ROW_SIZE * blocks_per_gaussian(degree)
    if used == width:
        return harmonics.array
    index = dr.arange(mi.UInt32, harmonics.shape[0] * width)
    number, column = index // width, index % width
    return dr.gather(mi.Float, harmonics.array, number * used + column, column < used)


def read_harmonics(rows: mi.Float, first: mi.UInt32, degree: int) -> list[mi.Float]:
    """The harmonics of one Gaussian, whose blocks begin with number ``first``."""
    return [value for block in range(blocks_per_gaussian(degree)) for value in read_row(rows, first + block)]


def sum_harmonics(row: list[mi.Float], basis: list[mi.Float]) -> list[mi.Float]:
    """sum_b Y_b k_b of each channel."""
    return [sum((y * row[3 * b + c] for b, y in enumerate(basis)), mi.Float(0)) for c in range(3)]


def eval_colour(row: list[mi.Float], basis: list[mi.Float], space: str) -> list[mi.Float]:
    """The radiance of red, green and blue that a Gaussian shows."""
    codes = [dr.maximum(total + 0.5, 0) for total in sum_harmonics(row, basis)]
    return codes if space == "linear" else [decode_srgb_code(code) for code in codes]


def eval_colour_slopes(row: list[mi.Float], basis: list[mi.Float], space: str) -> list[mi.Float]:
    """Derivatives of :func:`eval_colour` by the sums over the harmonics."""
    codes = [total + 0.5 for total in sum_harmonics(row, basis)]
    return [dr.select(code > 0, 1 if space == "linear" else srgb_slope(code), 0) for code in codes]
