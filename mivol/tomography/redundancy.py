"""Redundancy weights of filtered back-projection: the share of each ray in a line that the scan measures twice.

Conventions. The inverse is an integral over all lines, each counted once. A share is the part of a ray in its line; the shares
of all rays on a line add up to 1. ``gamma`` is the angle [rad] between a ray and the ray through the rotation axis, positive
towards larger columns. In the geometry of :mod:`mivol.tomography.geometry` the ray (theta, gamma) and the ray (theta + pi - 2
gamma, -gamma) run along the same line from its two ends.

References: Parker 1982, Med. Phys. 9, 254 (half scans); Wang 2002, Med. Phys. 29, 1634 (displaced detectors); Kak & Slaney
1988, section 3.4.
"""

from __future__ import annotations

import numpy as np

from mivol.errors import MivolError

MAX_GAP = 4.0
"""Largest gap between neighbouring views, in steps (the whole range over the number of views). Golden-angle views are at most
1.9
steps apart; a gap above 4 steps means missing directions."""

BLEND_COLUMNS = 20
"""Smallest width, in columns, of the change from a share of a half to 1 or 0 on a displaced detector: the ramp filter turns a
sharper change into a ring."""


def angle_steps(angles: np.ndarray, period: float) -> np.ndarray:
    """The part of a circle of ``period`` [rad] for which each view stands: to the middle between neighbours on both sides.

    Equal angles share their part. The steps add up to ``period``.
    """
    order = np.argsort(np.mod(angles, period), kind="stable")
    sorted_angles = np.mod(angles, period)[order]
    gaps = np.diff(sorted_angles, append=sorted_angles[:1] + period)
    steps = np.empty(len(angles))
    steps[order] = (gaps + np.roll(gaps, 1)) / 2
    return steps


def widest_gap(angles: np.ndarray, period: float) -> tuple[float, float]:
    """(width, end) of the widest arc [rad] without a view on a circle of ``period``."""
    found = np.sort(np.mod(angles, period))
    gaps = np.diff(found, append=found[:1] + period)
    widest = int(gaps.argmax())
    return float(gaps[widest]), float(found[(widest + 1) % len(found)])


def covers_circle(angles: np.ndarray, period: float) -> bool:
    """Whether the views cover a circle of ``period``."""
    return widest_gap(angles, period)[0] <= MAX_GAP * period / len(angles) + 1e-9


def full_turn_weights(gamma: np.ndarray) -> np.ndarray:
    """Shares (cols,) of the rays of a whole turn; a centred detector measures each line twice.

    The share is a half in columns mirrored by the other side of the axis. Beyond the shorter side a line is measured once and
    counts 1. The share changes smoothly from a half to 1 (and to 0 on the shorter side), over the outer fifth of the shorter
    side or BLEND_COLUMNS.
    """
    short = min(-gamma[0], gamma[-1])
    column = float(np.mean(np.diff(gamma))) if len(gamma) > 1 else 0.0
    if abs(gamma[0] + gamma[-1]) < column:
        return np.full(len(gamma), 0.5)
    if short <= 0:
        raise MivolError(
            "found a detector that lies wholly on one side of the rotation axis, expected the axis to be seen: use an "
            "iterative solver."
        )
    longer = 1.0 if gamma[-1] > -gamma[0] else -1.0
    width = min(short, max(short / 5, BLEND_COLUMNS * column))
    along = np.clip((np.abs(gamma) - (short - width)) / width, 0.0, 1.0)
    return 0.5 * (1 + longer * np.sign(gamma) * np.sin(np.pi / 2 * along) ** 2)


def parker_weights(beta: np.ndarray, gamma: np.ndarray, excess: float) -> np.ndarray:
    """Parker's shares (views, cols) of a scan over ``pi + 2 excess``.

    Args:
        beta: (views,) angle from the first view [rad].
        gamma: (cols,).
        excess: half of the scan's range beyond half a turn [rad]; at least the largest gamma that sees the object.
    """
    b = beta[:, None]
    # Parker's gamma has the opposite sign: his ray (beta, gamma) is the line of (beta + pi + 2 gamma, -gamma).
    g = np.clip(-gamma, -excess, excess)[None, :]
    rise, fall = 2 * (excess - g), 2 * (excess + g)
    tiny = np.finfo(float).tiny
    first = np.sin(np.pi / 2 * np.clip(b / np.maximum(rise, tiny), 0.0, 1.0)) ** 2
    last = np.sin(np.pi / 2 * np.clip((np.pi + 2 * excess - b) / np.maximum(fall, tiny), 0.0, 1.0)) ** 2
    return np.where(b < rise, first, np.where(b > np.pi - 2 * g, last, 1.0))
