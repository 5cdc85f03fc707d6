r"""Tables of a value: entries at equal steps, linear between them, constant beyond their ends.

.. math:: y(s) = (1 - f) y_i + f y_{i+1}, \qquad i + f = (n - 1)\, \frac{s - s_0}{s_1 - s_0}

Conventions. A table is a tensor (n, C), its first entry at s_0 and its last at s_1 (its domain).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError

__all__ = ["check_domain", "check_table", "domain_of", "look_up", "rows_of"]


def look_up(table: mi.TensorXf, domain: tuple[float, float], s: mi.Float) -> list[mi.Float]:
    """The table at values s, a list of channels; attached to both."""
    n, channels = table.shape
    low, high = domain
    u = dr.clip((s - low) * ((n - 1) / (high - low)), 0, n - 1)
    i = dr.minimum(mi.UInt32(u), n - 2)
    f, at = u - mi.Float(i), dr.ravel(table)
    ends = [[dr.gather(mi.Float, at, (i + k) * channels + c) for k in (0, 1)] for c in range(channels)]
    return [dr.lerp(*pair, f) for pair in ends]


def rows_of(text: object, what: str) -> np.ndarray:
    """Rows between commas, numbers between spaces: (n, C).

    Raises:
        MivolError: other things than numbers.
    """
    try:
        return np.array([[float(v) for v in row.split()] for row in str(text).split(",")])
    except ValueError as error:
        raise MivolError(f"{what} is {str(text)!r}; rows of numbers are expected, as in '0 0 0, 1 0.5 0.2'.") from error


def domain_of(text: object, what: str) -> tuple[float, float]:
    """The two ends of a domain.

    Raises:
        MivolError: other things than two numbers.
    """
    ends = rows_of(text, what).ravel().tolist()
    if len(ends) != 2:
        raise MivolError(f"{what} is {text}; two numbers in rising order are expected.")
    return ends[0], ends[1]


def check_table(rows: np.ndarray, what: str, channels: tuple[int, ...] = (1, 3)) -> None:
    """Refuse what is no table.

    Args:
        rows: (n, C).
        what: the table's name in a sentence.
        channels: how many numbers an entry may have.

    Raises:
        MivolError: fewer than two entries, another number of channels, entries that are negative or not finite.
    """
    if rows.ndim != 2 or rows.shape[0] < 2 or rows.shape[1] not in channels or not (np.isfinite(rows) & (rows >= 0)).all():
        raise MivolError(
            f"{what} has the shape {rows.shape} and entries from {rows.min(initial=0):.4g}; at least two entries of "
            f"{' or '.join(map(str, channels))} finite numbers that are not negative are expected: clip them after each step."
        )


def check_domain(domain: tuple[float, float], what: str) -> None:
    """Refuse ends that are not finite or not in rising order.

    Raises:
        MivolError: such ends.
    """
    low, high = domain
    if not (np.isfinite([low, high]).all() and low < high):
        raise MivolError(f"{what} is {low:g}, {high:g}; two numbers in rising order are expected.")
