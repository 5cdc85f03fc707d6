"""Density control of Gaussians: clone, split, prune, reset opacities; or relocate unused Gaussians.

Conventions. A cloud is a dict of float32 arrays by the names of :mod:`mivol.splatting.splatter` ("means", "log_scales", ...),
row by row. Arrays are never changed in place: a :class:`CloudChange` holds the new rows, the old row of each, and which rows
lost their moments, so that an optimizer's moments can follow. At a tie the smallest row number comes first.

References: Kerbl et al. 2023 (ACM TOG 42(4), section 5.2, and the released code's constants); Kheradmand et al. 2024 (3D
Gaussian Splatting as Markov Chain Monte Carlo, NeurIPS: eqs. 9 and 10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, gammaln, logit

from mivol.errors import MivolError

CloudArrays = dict[str, NDArray[np.float32]]
"""A cloud, or moments of a cloud, by name; the first axis counts Gaussians."""

SHRINK = 1.6
"""Factor by which each half of a split Gaussian is smaller (Kerbl et al. 2023)."""

MOST_COPIES = 51
"""Maximum number of Gaussians at a position in the sum below, which loses digits beyond (as the published code)."""


@dataclass(frozen=True)
class CloudChange:
    """A cloud after a change.

    Attributes:
        cloud: its arrays.
        parent: (M,) old row of each row.
        forgets: (M,) bool: whether the parent's moments are invalid.
    """

    cloud: CloudArrays
    parent: NDArray[np.int64]
    forgets: NDArray[np.bool_]

    def carry(self, learnt: CloudArrays) -> CloudArrays:
        """Moments of the old rows, for the new rows; 0 for invalid moments."""
        moments = {name: array[self.parent] for name, array in learnt.items()}
        for array in moments.values():
            array[self.forgets] = 0
        return moments

    def then(self, later: CloudChange) -> CloudChange:
        """This change, followed by another change of the cloud, as a single change."""
        return CloudChange(later.cloud, self.parent[later.parent], self.forgets[later.parent] | later.forgets)


def keep_cloud(cloud: CloudArrays) -> CloudChange:
    """A change without effect on the cloud."""
    n = len(cloud["means"])
    return CloudChange(cloud, np.arange(n), np.zeros(n, bool))


def select_rows(score: NDArray, least: float, most: int) -> NDArray[np.int64]:
    """Rows with a score of at least ``least``, in ascending order: at most the ``most`` highest."""
    rows = np.flatnonzero(score >= least)
    if len(rows) > most:
        rows = rows[np.argsort(-score[rows], kind="stable")[: max(most, 0)]]
    return np.sort(rows)


def clone_and_split(cloud: CloudArrays, rows: NDArray[np.int64], largest_clone: float, rng: np.random.Generator) -> CloudChange:
    """Divide some Gaussians: duplicate small Gaussians, and replace large Gaussians by two halves.

    A clone stands at the parent's position; derivatives and moments of both differ from the next step on. Both halves of a
    split are drawn from the Gaussian's normal distribution, and are smaller by 1.6.

    Args:
        cloud: N Gaussians.
        rows: rows to divide, each once.
        largest_clone: scale [length] above which a Gaussian is split.
        rng: positions of the halves.
    """
    n = len(cloud["means"])
    is_large = np.exp(cloud["log_scales"][rows].max(axis=1)) > largest_clone
    clones, split = rows[~is_large], rows[is_large]
    stays = np.ones(n, bool)
    stays[split] = False
    parent = np.concatenate([np.flatnonzero(stays), clones, split, split])
    arrays = {name: array[parent] for name, array in cloud.items()}
    halves = slice(len(parent) - 2 * len(split), len(parent))
    drawn = rng.standard_normal((2 * len(split), 3)) * np.exp(arrays["log_scales"][halves])
    turned = np.einsum("nij,nj->ni", rotations(arrays["quaternions"][halves]), drawn)
    arrays["means"][halves] += turned.astype(np.float32)
    arrays["log_scales"][halves] -= np.float32(math.log(SHRINK))
    return CloudChange(arrays, parent, np.arange(len(parent)) >= n - len(split))


def prune(cloud: CloudArrays, keep: NDArray[np.bool_]) -> CloudChange:
    """Only the Gaussians of ``keep``.

    Raises:
        MivolError: no Gaussian remains.
    """
    parent = np.flatnonzero(keep)
    if len(parent) == 0:
        raise MivolError(
            "no Gaussian remains, since all became transparent: lower the learning rates, or prune at a smaller opacity."
        )
    return CloudChange({name: array[parent] for name, array in cloud.items()}, parent, np.zeros(len(parent), bool))


def reset_opacities(cloud: CloudArrays, highest: float) -> CloudArrays:
    """The cloud with opacities of at most ``highest``: needed Gaussians become opaque again, the others can be pruned."""
    return {**cloud, "opacity_logits": np.minimum(cloud["opacity_logits"], np.float32(logit(highest)))}


def relocate(cloud: CloudArrays, unused_below: float, rng: np.random.Generator) -> CloudChange:
    """Move almost transparent Gaussians to other Gaussians, drawn in proportion to their opacity.

    Gaussians that share a position keep the composite of the old one (:func:`split_opacity_and_scale`).
    """
    opacity = expit(cloud["opacity_logits"].astype(np.float64))
    unused, used = np.flatnonzero(opacity < unused_below), np.flatnonzero(opacity >= unused_below)
    if len(unused) == 0 or len(used) == 0:
        return keep_cloud(cloud)
    source = rng.choice(used, len(unused), p=opacity[used] / opacity[used].sum())
    parent = np.arange(len(opacity))
    parent[unused] = source
    return _shared(cloud, parent, unused_below)


def grow(cloud: CloudArrays, count: int, least_opacity: float, rng: np.random.Generator) -> CloudChange:
    """Add ``count`` Gaussians at existing Gaussians, drawn in proportion to their opacity, without changing images."""
    opacity = expit(cloud["opacity_logits"].astype(np.float64))
    source = rng.choice(len(opacity), count, p=opacity / opacity.sum())
    return _shared(cloud, np.concatenate([np.arange(len(opacity)), source]), least_opacity)


def _shared(cloud: CloudArrays, parent: NDArray[np.int64], least_opacity: float) -> CloudChange:
    """Copies of rows, which share the opacity and scale of each position."""
    copies = np.minimum(np.bincount(parent, minlength=len(cloud["means"]))[parent], MOST_COPIES)
    arrays = {name: array[parent] for name, array in cloud.items()}
    shares = copies > 1
    opacity = expit(arrays["opacity_logits"][shares].astype(np.float64))
    each, factor = split_opacity_and_scale(opacity, copies[shares])
    each = np.clip(each, least_opacity, 1 - 2**-23)
    arrays["opacity_logits"][shares] = logit(each).astype(np.float32)
    arrays["log_scales"][shares] += np.log(factor)[:, None].astype(np.float32)
    return CloudChange(arrays, parent, shares)


def split_opacity_and_scale(opacity: NDArray, copies: NDArray) -> tuple[NDArray, NDArray]:
    """Opacity and scale factor of N equal Gaussians that replace a single Gaussian (Kheradmand et al. 2024, eqs. 9, 10).

    Opacities compose to the old opacity at the centre; the factor keeps the integral of the composite along a line through the
    centre.

    Args:
        opacity: (M,) of the replaced Gaussian, in (0, 1).
        copies: (M,) N, 1 to 51.
    """
    each = -np.expm1(np.log1p(-opacity) / copies)
    total = np.zeros_like(each)
    for i in range(1, int(copies.max(initial=1)) + 1):
        k = np.arange(i)
        binomial = np.exp(gammaln(i) - gammaln(k + 1) - gammaln(i - k))
        terms = binomial * (-1.0) ** k / np.sqrt(k + 1) * each[:, None] ** (k + 1)
        total += np.where(i <= copies, terms.sum(axis=1), 0)
    return each, opacity / total


def rotations(quaternions: NDArray) -> NDArray:
    """(N, 3, 3) rotations of quaternions (w, x, y, z) of a length above 0."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
