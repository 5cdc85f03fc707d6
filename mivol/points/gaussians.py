"""3D Gaussians as NumPy arrays: the model that files hold, fits change and renderers draw.

Conventions. Arrays hold the pre-images of the activations, as published files do, so a file that was read can be written again
to the bit: scales are ``exp(log_scales)``, opacities are ``logistic(opacity_logits)``. Quaternions are (w, x, y, z), of any
length but 0. ``harmonics`` are coefficients of real spherical harmonics in the basis and order of ``drjit.sh_eval``; the colour
along the unit direction d from the camera to the mean is ``max(0, 0.5 + sum_b Y_b(d) k_b)``. Colours are sRGB code values, as
in published files, and a renderer composites the code values.

Compact formats store colours, opacities and rotations in bytes; the functions at the end return their pre-images. The opacity
255 of 255 is the logit inf, 0 is -inf.

Source: Kerbl, Kopanas, Leimkuehler, Drettakis, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023, section 4,
and the files published by the authors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mivol.display import with_short_repr
from mivol.files.source import refusal

CONSTANT_HARMONIC = 0.5 / np.sqrt(np.pi)
"""The constant value of the spherical harmonic of degree 0."""

HIGHEST_DEGREE = 3
"""Highest degree of the harmonics of published files."""

ROW_SHAPES = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": ()}
"""Shape of one Gaussian's part of each array, except the harmonics."""


@with_short_repr
@dataclass(frozen=True)
class Gaussians:
    """N Gaussians. Input arrays of any real type become float32 and C-contiguous.

    Attributes:
        means: (N, 3) centres, world [length].
        log_scales: (N, 3) logarithms of the standard deviations along the axes of each Gaussian [log length].
        quaternions: (N, 4) rotations of these axes into the world, (w, x, y, z), of any length but 0.
        opacity_logits: (N,) logits of the opacity at the centre; +-inf is an opacity of 1 or 0.
        harmonics: (N, K, 3) coefficients of the colour, K = (degree + 1)^2.

    Raises:
        MivolError: shapes that contradict each other. Only :meth:`check` looks at the numbers.
    """

    means: np.ndarray
    log_scales: np.ndarray
    quaternions: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray

    def __post_init__(self) -> None:
        for name in (*ROW_SHAPES, "harmonics"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float32))
        n = len(self.means) if self.means.ndim else 0
        for name, width in ROW_SHAPES.items():
            if getattr(self, name).shape != (n, *width):
                found = f"{name} of shape {getattr(self, name).shape}"
                raise refusal("Gaussians", found, f"{(n, *width)} beside means of shape {self.means.shape}", "reshape them")
        if self.harmonics.shape not in [(n, (d + 1) ** 2, 3) for d in range(HIGHEST_DEGREE + 1)]:
            raise refusal(
                "Gaussians",
                f"harmonics of shape {self.harmonics.shape}",
                f"({n}, K, 3) with K = 1, 4, 9 or 16",
                "reshape them, or leave out what lies above degree 3",
            )

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    def scales(self) -> np.ndarray:
        """(N, 3) standard deviations [length]."""
        return np.exp(self.log_scales)

    def opacities(self) -> np.ndarray:
        """(N,) opacities at the centres, 0..1."""
        with np.errstate(over="ignore"):  # exp(-logit) is infinite for an opacity that rounds to 0
            return 1 / (1 + np.exp(-self.opacity_logits))

    def rotations(self) -> np.ndarray:
        """(N, 3, 3) rotations; columns are the axes of the Gaussian in the world."""
        w, x, y, z = (self.quaternions / np.linalg.norm(self.quaternions, axis=1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))

    def covariances(self) -> np.ndarray:
        """(N, 3, 3) covariance matrices in the world [length^2]."""
        axes = self.rotations() * self.scales()[:, None, :]
        return axes @ np.swapaxes(axes, 1, 2)

    def base_colours(self) -> np.ndarray:
        """(N, 3) mean colours over all directions, code values; not clipped."""
        return np.float32(0.5) + np.float32(CONSTANT_HARMONIC) * self.harmonics[:, 0]

    def select(self, index: np.ndarray | slice) -> Gaussians:
        """A subset: numbers, booleans (N,), or a slice."""
        return Gaussians(**{name: getattr(self, name)[index] for name in (*ROW_SHAPES, "harmonics")})

    def with_degree(self, degree: int) -> Gaussians:
        """The Gaussians with harmonics up to another degree: higher coefficients are dropped, new coefficients are 0.

        Raises:
            MivolError: a degree below 0 or above 3.
        """
        if degree not in range(HIGHEST_DEGREE + 1):
            raise refusal("Gaussians", f"degree {degree}", f"0 to {HIGHEST_DEGREE}", "choose one of those")
        harmonics = np.zeros((self.count, (degree + 1) ** 2, 3), np.float32)
        kept = min(harmonics.shape[1], self.harmonics.shape[1])
        harmonics[:, :kept] = self.harmonics[:, :kept]
        return Gaussians(self.means, self.log_scales, self.quaternions, self.opacity_logits, harmonics)

    def check(self, subject: object = "Gaussians") -> Gaussians:
        """Return the Gaussians if a renderer can draw every number.

        Args:
            subject: origin of the Gaussians in messages, for example their file.

        Raises:
            MivolError: NaN, an infinite number other than a logit, or a quaternion of length 0. The message names the first
                index.
        """
        for name in ("means", "log_scales", "quaternions", "harmonics"):
            _check_rows(subject, ~np.isfinite(getattr(self, name)), f"{name} that are not finite")
        _check_rows(subject, np.isnan(self.opacity_logits), "opacity_logits of NaN")
        _check_rows(subject, ~np.any(self.quaternions, axis=1), "quaternions of length 0")
        return self


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of several sets, in order, with harmonics up to the highest degree of a set.

    Raises:
        MivolError: no sets.
    """
    if not parts:
        raise refusal("concatenate", "no Gaussians", "at least one set", "give some")
    degree = max(part.degree for part in parts)
    same = [part.with_degree(degree) for part in parts]
    return Gaussians(**{name: np.concatenate([getattr(part, name) for part in same]) for name in (*ROW_SHAPES, "harmonics")})


def logit(opacity: np.ndarray) -> np.ndarray:
    """Logits of opacities: log(o / (1 - o)), float64; -inf for 0 and inf for 1."""
    opacity = np.asarray(opacity, np.float64)
    with np.errstate(divide="ignore"):
        return np.log(opacity) - np.log1p(-opacity)


def _check_rows(subject: object, wrong: np.ndarray, what: str) -> None:
    """Refuse a set with wrong numbers; the message names the first index and the number of wrong Gaussians."""
    rows = np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1)) if wrong.size else np.empty(0, int)
    if rows.size:
        found = f"{what} in Gaussian {rows[0]} (the first of {rows.size})"
        raise refusal(subject, found, "numbers that can be drawn", "remove these Gaussians, or write the file again")


def to_base_harmonics(colours: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0 of colours in 0..1."""
    return (colours - 0.5) / CONSTANT_HARMONIC


def to_log_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms of scales; a scale of 0 or below gives -inf or NaN, which :meth:`Gaussians.check` refuses by index."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.asarray(scales, np.float64))


def complete_quaternions(others: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Unit quaternions of which a format leaves out one non-negative entry.

    Args:
        others: (N, 3) stored entries, in order.
        which: (N,) number of the missing entry.

    Returns:
        (N, 4).
    """
    rows = np.arange(len(others))
    quaternions = np.empty((len(others), 4))
    quaternions[rows, which] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    for number in range(3):
        quaternions[rows, number + (which <= number)] = others[:, number]
    return quaternions
