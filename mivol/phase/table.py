r"""A tabulated phase function: checked values at cosines, from numbers, Legendre moments or a file, and their lookup.

.. math:: p(c) = \frac{f(c)}{2\pi \int_{-1}^1 f\,dc}, \qquad f \text{ linear between } (c_i, f_i)

Conventions. Cosines rise from exactly -1 (straight back) to exactly 1 (straight on); values need not be normalised.
:class:`Table` holds the checked data in float64 NumPy; :class:`Lookup` holds the same data on Dr.Jit arrays. A node is stored
as 1 - c and as 1 + c, so the nodes of a forward peak of a width of 1e-4 remain distinct in float32.

Source of the inversion inside a segment: the smaller root of the quadratic, written without cancellation as in Press et al.,
Numerical Recipes, section 5.6.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.phase.closed_forms import INV_TWO_PI, LARGEST, WEIGHT, ScatteringAngle


@dataclass(frozen=True, eq=False)
class Table:
    """Values of a phase function at cosines, not normalised.

    Attributes:
        cosines: (n,) rising, from -1 to 1, float64.
        values: (n,) at least 0, not all 0, float64.
        name: name of the table in error messages.

    Raises:
        MivolError: arrays of another form, or values impossible for a phase function.
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
        """Values at equally spaced cosines from -1 to 1, as for stock ``tabphase``."""
        return cls(np.linspace(-1, 1, np.size(values)), values, name)

    @classmethod
    def from_csv(cls, path: str | os.PathLike) -> Table:
        """Read two columns: cosine and value, or angle in degrees and value if the first column is headed ``angle``.

        Lines may come in either order; a heading is optional; lines starting with ``#`` are ignored.

        Raises:
            MivolError: other content than two columns of numbers, or no phase function.
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
        r"""Sum a Legendre series and put nodes where a straight line misses the series.

        .. math:: p(c) = \frac{1}{4\pi} \sum_l (2 l + 1) \chi_l P_l(c), \qquad \chi_l = \int p\,P_l\,d\omega

        Args:
            moments: chi_0, chi_1, ...; chi_0 is 1, chi_1 the mean cosine.
            tolerance: largest distance of a line from the series halfway between nodes, as a fraction of the largest value.
            name: name of the table in error messages.

        Raises:
            MivolError: a first moment other than 1, or a series with negative values.
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
    """Refuse values impossible for a phase function.

    Raises:
        MivolError: NaN, infinite or negative values, only zeros, or a largest value outside 1e-30 to 1e30.
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
    density: Callable[[np.ndarray], np.ndarray], tolerance: float, least: int, relative_to_peak: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Choose cosines so that straight lines between them follow a function.

    Args:
        density: function of an array of cosines.
        tolerance: largest distance of a line from the function halfway (in angle), as a fraction of the value there.
        least: number of first nodes, equally spaced in angle.
        relative_to_peak: whether ``tolerance`` is a fraction of the largest value instead.

    Returns:
        cosines (n,) from -1 to 1, and the function at these cosines.
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


@dataclass
class Lookup:
    """The nodes of a table on Dr.Jit arrays. Methods take the values as an argument, since the values may be a parameter.

    Attributes:
        below_one, above_minus_one: (n,) 1 - c and 1 + c of the nodes.
        ratio: (n,) (1 + c) / (1 - c), rising from 0 to infinity: the key of the binary search.
        width: (n - 1,) differences of the cosines.
    """

    below_one: mi.Float
    above_minus_one: mi.Float
    ratio: mi.Float
    width: mi.Float

    @classmethod
    def from_table(cls, table: Table) -> Lookup:
        """Round the nodes of a table."""
        c = table.cosines
        with np.errstate(divide="ignore"):
            ratio = (1 + c) / (1 - c)
        return cls(*(mi.Float(x.astype(np.float32)) for x in (1 - c, 1 + c, ratio, np.diff(c))))

    @classmethod
    def of_regular_cosines(cls, count: int) -> Lookup:
        """The nodes of a table of ``count`` equally spaced cosines, computed by Dr.Jit."""
        k = dr.arange(mi.Float, count)
        step = 2 / (count - 1)
        below, above = (count - 1 - k) * step, k * step
        return cls(below, above, above / below, dr.full(mi.Float, step, count - 1))

    def normalise(self, values: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Project values (to 0 ... 1e30; all 1 if no value is above 1e-30), and find their integral and their cumulative
        distribution.

        Args:
            values: (n,) as given.

        Returns:
            values (n,) and integral (1,) with derivatives; cumulative (n,), 0 to 1, without.
        """
        values = WEIGHT.project(values)
        values = dr.select(dr.max(dr.detach(values)) >= 1 / LARGEST, values, 1)
        i = dr.arange(mi.UInt32, len(self.width))
        parts = 0.5 * (dr.gather(mi.Float, values, i) + dr.gather(mi.Float, values, i + 1)) * self.width
        # In float32 the sum over a table of 1000 nodes would lose the digits of its narrow segments.
        sums = dr.cumsum(mi.Float64(dr.detach(parts)))
        total = dr.gather(mi.Float64, sums, len(self.width) - 1)
        cumulative = dr.zeros(mi.Float, len(self.ratio))
        dr.scatter(cumulative, mi.Float(sums / total), i + 1)
        return values, dr.sum(parts), cumulative

    def eval(self, angle: ScatteringAngle, values: mi.Float, integral: mi.Float, active: mi.Bool = True) -> mi.Float:
        """Density [1/sr] at an angle, for the values and the integral of :meth:`normalise`.

        Error: 1e-6 of the larger of the two neighbouring values.
        """
        # The comparison is ratio (1 - c) < 1 + c, without a quotient: in inactive lanes both directions may be 0, and it 0/0.
        below, above = dr.detach(angle.below_one), dr.detach(angle.above_minus_one)
        n = len(self.width)
        i = dr.binary_search(0, n, lambda k: dr.gather(mi.Float, self.ratio, k, active) * below < above)
        i = dr.clip(dr.detach(mi.Int32(i)) - 1, 0, n - 1)
        part = self._offset(angle, i, active) * dr.rcp(dr.gather(mi.Float, self.width, i, active))
        part = dr.clip(part, 0, 1)
        left, right = (dr.gather(mi.Float, values, k, active) for k in (i, i + 1))
        return INV_TWO_PI * dr.fma(part, right - left, left) * dr.rcp(integral)

    def sample(
        self, u: mi.Float, values: mi.Float, integral: mi.Float, cumulative: mi.Float, active: mi.Bool = True
    ) -> ScatteringAngle:
        """Draw a scattering angle with density :meth:`eval`, by exact inversion: a quadratic equation in each segment."""
        n = len(self.width)
        i = dr.binary_search(0, n, lambda k: dr.gather(mi.Float, cumulative, k, active) <= u)
        i = dr.clip(mi.Int32(i) - 1, 0, n - 1)
        width, left, right = (dr.gather(mi.Float, a, k, active) for a, k in ((self.width, i), (values, i), (values, i + 1)))
        area = (u - dr.gather(mi.Float, cumulative, i, active)) * integral
        slope = (right - left) * dr.rcp(width)
        # 2 area / (left + root) is the same as (root - left) / slope, which is 0/0 on a level segment.
        root = dr.sqrt(dr.maximum(dr.fma(2 * area, slope, left * left), 0))
        offset = 2 * area * dr.rcp(dr.select(left + root > 0, left + root, 1))
        offset = dr.clip(offset, 0, width)
        return ScatteringAngle(
            dr.maximum(dr.gather(mi.Float, self.below_one, i, active) - offset, 0),
            dr.maximum(dr.gather(mi.Float, self.above_minus_one, i, active) + offset, 0),
        )

    def _offset(self, angle: ScatteringAngle, i: mi.Int32, active: mi.Bool) -> mi.Float:
        """Difference of the cosine and node i, from the smaller and therefore more accurate of 1 - c and 1 + c."""
        ahead = dr.gather(mi.Float, self.below_one, i, active) - angle.below_one
        behind = angle.above_minus_one - dr.gather(mi.Float, self.above_minus_one, i, active)
        return dr.select(angle.below_one < angle.above_minus_one, ahead, behind)
