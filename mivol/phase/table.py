"""A table of a phase function: values at cosines, checked, from numbers, Legendre moments or a file.

Conventions. Cosines rise from exactly -1 (straight back) to exactly 1 (straight on); values need not be normalised. float64
NumPy; :mod:`mivol.phase.tabulated` is the same on Dr.Jit arrays.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mivol.errors import MivolError
from mivol.phase.domain import LARGEST

__all__ = ["Table", "adapt_nodes", "check_values"]


@dataclass(frozen=True, eq=False)
class Table:
    """Values of a phase function at cosines, not normalised.

    Attributes:
        cosines: (n,) rising, from -1 to 1, float64.
        values: (n,) at least 0, not all 0, float64.
        name: what the table is called in a sentence that refuses it.

    Raises:
        MivolError: arrays of another form, or values that no phase function has.
    """

    cosines: np.ndarray
    values: np.ndarray
    name: str = "the phase table"

    def __post_init__(self) -> None:
        for field in ("cosines", "values"):
            object.__setattr__(self, field, np.asarray(getattr(self, field), dtype=np.float64).ravel())
        c = self.cosines
        if len(c) < 2 or len(c) != len(self.values):
            raise MivolError(
                f"{self.name} has {len(c)} cosines and {len(self.values)} values; as many of one as of the other, and at least "
                "2, are expected."
            )
        falls = np.flatnonzero(~(np.diff(c) > 0))
        if len(falls):
            i = falls[0]
            raise MivolError(
                f"the cosines of {self.name} go from {c[i]:.9g} to {c[i + 1]:.9g} at {i + 1}; they must rise: sort the table "
                "and take out what occurs twice."
            )
        if c[0] != -1 or c[-1] != 1:
            raise MivolError(
                f"the cosines of {self.name} go from {c[0]:.9g} to {c[-1]:.9g}; -1 to 1 is expected: add values for straight "
                "back (-1) and straight on (1)."
            )
        check_values(self.values, self.name)

    @classmethod
    def regular(cls, values: np.ndarray, name: str = "the phase table") -> Table:
        """Values at equally spaced cosines from -1 to 1, as stock ``tabphase`` takes them."""
        return cls(np.linspace(-1, 1, np.size(values)), values, name)

    @classmethod
    def from_csv(cls, path: str | os.PathLike) -> Table:
        """Read two columns: cosine and value, or angle in degrees and value if the first column is headed ``angle``.

        Lines may come in either order; a heading is optional; lines that start with ``#`` are left out.

        Raises:
            MivolError: what is not two columns of numbers, or no phase function.
        """
        name = f"phase table {os.fspath(path)}"
        try:
            with open(path, newline="", encoding="utf-8-sig") as file:  # noqa: PTH123  (a path of any kind)
                rows = [row for row in csv.reader(file) if "".join(row).strip() and not row[0].lstrip().startswith("#")]
        except (OSError, UnicodeDecodeError) as error:
            raise MivolError(f"{name} cannot be read: {error}.") from error
        other = next((row for row in rows if len(row) != 2), None)
        if other is not None:
            raise MivolError(f"{name} has the line {','.join(other)!r}; two columns, with a comma between them, are expected.")
        heading = rows.pop(0)[0].strip().lower() if rows and not _is_number(rows[0][0]) else "cos"
        if heading not in ("cos", "angle"):
            raise MivolError(f"{name} heads its first column {heading!r}; cos, or angle (in degrees), is expected.")
        try:
            first, values = np.array([[float(x) for x in row] for row in rows]).reshape(-1, 2).T
        except ValueError as error:
            raise MivolError(f"{name} is not two columns of numbers: {error}.") from error
        if heading == "angle" and not np.all((first >= 0) & (first <= 180)):
            raise MivolError(
                f"the angles of {name} go from {first.min():.9g} to {first.max():.9g} degrees; 0 (straight on) to 180 "
                "(straight back) is expected: give each angle once."
            )
        cosines = np.cos(np.radians(first)) if heading == "angle" else first
        order = np.argsort(cosines, kind="stable")
        return cls(cosines[order], values[order], name)

    @classmethod
    def from_moments(cls, moments: np.ndarray, tolerance: float = 1e-3, name: str = "the phase table") -> Table:
        r"""Sum a Legendre series and put nodes where a straight line misses it.

        .. math:: p(c) = \frac{1}{4\pi} \sum_l (2 l + 1) \chi_l P_l(c), \qquad \chi_l = \int p\,P_l\,d\omega

        Args:
            moments: chi_0, chi_1, ...; chi_0 is 1, chi_1 the mean cosine.
            tolerance: how far a line may miss the series halfway between nodes, as a part of its largest value.
            name: what the table is called in a sentence that refuses it.

        Raises:
            MivolError: a first moment that is not 1, or a series that is negative somewhere.
        """
        moments = np.asarray(moments, dtype=np.float64).ravel()
        if len(moments) == 0 or not np.isclose(moments[0], 1, rtol=1e-6) or not np.all(np.isfinite(moments)):
            raise MivolError(f"the Legendre moments of {name} start with {moments[:1]}; finite ones, chi_0 = 1, are expected.")
        series = np.arange(1, 2 * len(moments), 2) / 2 * moments

        def density(cosines: np.ndarray) -> np.ndarray:
            return np.polynomial.legendre.legval(cosines, series)

        least = max(33, 4 * len(moments) + 1)  # at least two nodes on each swing of the highest polynomial
        cosines, values = adapt_nodes(density, tolerance, least, relative_to_peak=True)
        # A series that touches 0 is rounded below it; one that is truncated goes well below.
        rounding = len(moments) * 2.0**-50 * values.max()
        if values.min() < -rounding:
            where = cosines[values.argmin()]
            raise MivolError(
                f"the Legendre series of {name} is {values.min():.3g} at cos = {where:.4f}, where none is below 0; "
                "give more moments, or a table of values."
            )
        return cls(cosines, np.maximum(values, 0), name)

    @property
    def density(self) -> np.ndarray:
        """Values divided by their integral over the cosine."""
        return self.values / np.trapezoid(self.values, self.cosines)

    def moments(self, count: int) -> np.ndarray:
        """The first Legendre moments chi_l of the piecewise linear function, to rounding."""
        nodes, weights = np.polynomial.legendre.leggauss(count // 2 + 2)  # exact for degree count + 1 and more
        c = self.cosines
        x = (c[:-1, None] + c[1:, None]) / 2 + np.diff(c)[:, None] / 2 * nodes
        p = np.interp(x, c, self.density) * np.diff(c)[:, None] / 2 * weights
        return np.array([(p * np.polynomial.legendre.Legendre.basis(k)(x)).sum() for k in range(count)])

    @property
    def mean_cosine(self) -> float:
        """The asymmetry parameter g."""
        return float(self.moments(2)[1])

    def to_dict(self) -> dict[str, str]:
        """The plugin for ``mi.load_dict``. Numbers are written as text: rounded to float32, cosines near 1 would coincide."""
        text = {key: ", ".join(f"{x:.17g}" for x in getattr(self, key)) for key in ("cosines", "values")}
        return {"type": "mivol_tabulated", **text}


def check_values(values: np.ndarray, name: str) -> None:
    """Refuse values that no phase function has.

    Raises:
        MivolError: NaN, infinite or negative, all of them 0, or the largest beyond 1e-30 to 1e30.
    """
    bad = np.flatnonzero(~(np.isfinite(values) & (values >= 0)))
    if len(bad):
        raise MivolError(
            f"{name} has the value {values[bad[0]]:.9g} at {bad[0]}; finite numbers of at least 0 are expected: clip them "
            "after each step."
        )
    most = values.max(initial=0)
    if most == 0:
        raise MivolError(f"{name} is 0 everywhere; at least one value above 0 is expected.")
    if not 1 / LARGEST <= most <= LARGEST:
        raise MivolError(
            f"the largest value of {name} is {most:.3g}; 1e-30 to 1e30 is expected: only their ratios count, divide by it."
        )


def adapt_nodes(
    density: Callable[[np.ndarray], np.ndarray], tolerance: float, least: int = 33, relative_to_peak: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Choose cosines so that straight lines between them follow a function.

    Args:
        density: function of an array of cosines.
        tolerance: how far a line may miss it halfway (in angle), as a part of the value there.
        least: nodes to start with, equally spaced in angle.
        relative_to_peak: as a part of the largest value instead.

    Returns:
        cosines (n,) from -1 to 1, and the function there.
    """
    angles = np.linspace(np.pi, 0, least)
    cosines = _cosines(angles)
    values = density(cosines)
    todo = np.ones(least - 1, dtype=bool)
    for _ in range(16):
        left = np.flatnonzero(todo)
        if len(left) == 0:
            break
        middle = (angles[left] + angles[left + 1]) / 2
        c = _cosines(middle)
        f = density(c)
        line = np.interp(c, cosines, values)
        miss = np.abs(f - line) > tolerance * (np.abs(values).max() if relative_to_peak else np.abs(f))
        where = left + 1
        angles, cosines, values = (np.insert(a, where, b) for a, b in ((angles, middle), (cosines, c), (values, f)))
        todo = np.zeros(len(angles) - 1, dtype=bool)
        first = left + np.arange(len(left))
        todo[first], todo[first + 1] = miss, miss
    return cosines, values


def _cosines(angles: np.ndarray) -> np.ndarray:
    return np.where(angles == 0, 1, np.where(angles == np.pi, -1, np.cos(angles)))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
