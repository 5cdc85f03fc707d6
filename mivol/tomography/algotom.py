"""Methods of the package algotom on mivol's projections. mivol runs without them, and never installs algotom.

Conventions. Projections are (views, rows, cols), lowest row first, angles are radians, and columns are counted from 0.

Reference: Vo, Atwood, Drakopoulos & Connolley 2021, Opt. Express 29, 17849 (algotom).
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from mivol.errors import MivolError

AXIS_FINDERS = ("find_center_vo", "find_center_360")
"""Methods of ``algotom.prep.calculation`` for a sinogram of half a turn, and of a turn."""

VIEW_METHODS = {"remove_zinger": "removal", "remove_blob": "removal", "unwarp_projection": "correction"}
"""Methods for the images of views, and their modules in ``algotom.prep``."""

STRIPES = "remove_all_stripe", "remove_dead_stripe", "remove_large_stripe", "remove_stripe_based_"
"""Beginnings of the names of methods of ``algotom.prep.removal`` for sinograms."""

AXIS_ROWS, HALF_TURNS = 5, 5
"""Most rows, and half turns of a longer scan, in which an axis is looked for."""


def run_algotom(
    method: str, y: np.ndarray, angles: np.ndarray | None = None, **options: float | str | bool | np.ndarray | None
) -> np.ndarray:
    """Apply a method of algotom to projections.

    * ``remove_all_stripe``, ``remove_dead_stripe``, ``remove_large_stripe``, ``remove_stripe_based_...``: each row's sinogram;
    * ``remove_zinger``, ``remove_blob``, ``unwarp_projection``: each view's image, highest row first, as images are stored;
    * ``find_center_vo``: up to five rows and half turns, with ``angles``; ``find_center_360``: up to five rows of a turn.

    Args:
        method: name of a function in ``algotom.prep``.
        y: (views, rows, cols), line integrals or what the method expects.
        angles: (views,) [rad], for ``find_center_vo``; without them, all views count as one half turn.
        options: further arguments of the method.

    Returns:
        Projections like ``y``. An axis finder returns columns (n,) instead; their scatter shows how reliable they are.

    Raises:
        MivolError: algotom is not installed, an unknown method or option, projections of another shape, or a method that fails.

    Example:
        >>> columns = mivol.run_algotom("find_center_vo", y, angles, step=0.1)
        >>> y = mivol.run_algotom("remove_all_stripe", y, snr=3.0)
    """
    y = np.asarray(y)
    if y.ndim != 3 or 0 in y.shape:
        raise MivolError(f"found projections of shape {y.shape}, expected (views, rows, cols): pass y[:, None] for a sinogram.")
    if angles is not None and np.shape(angles) != (len(y),):
        raise MivolError(f"found angles of shape {np.shape(angles)} for {len(y)} views, expected one for each: correct them.")
    call = _find_method(method, options)

    def run(part: np.ndarray) -> Any:
        try:
            return call(part, **options)
        except Exception as error:  # algotom raises errors of many classes
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise MivolError(f"algotom's {method} failed on {part.shape} values ({reason}): change its options.") from error

    if method in AXIS_FINDERS:
        rows = np.unique(np.linspace(0, y.shape[1] - 1, AXIS_ROWS).astype(int))
        turns = _half_turns(len(y), angles) if method == "find_center_vo" else [np.arange(len(y))]
        return np.array([float(np.ravel(run(y[turn, row]))[0]) for row in rows for turn in turns])
    result = np.empty(y.shape, np.result_type(y.dtype, np.float32))
    if method in VIEW_METHODS:
        for k, view in enumerate(y):
            result[k] = run(view[::-1].copy())[::-1]
    else:
        for row in range(y.shape[1]):
            result[:, row] = run(y[:, row].copy())
    return result


def _find_method(method: str, options: dict[str, Any]) -> Callable[..., Any]:
    is_stripe = method.startswith(STRIPES)
    if not (is_stripe or method in AXIS_FINDERS or method in VIEW_METHODS):
        known = ", ".join((*STRIPES[:3], f"{STRIPES[3]}...", *VIEW_METHODS, *AXIS_FINDERS))
        raise MivolError(f"found the method {method!r}, expected one of algotom's {known}: correct the name.")
    name = "removal" if is_stripe else VIEW_METHODS.get(method, "calculation")
    try:
        call = getattr(importlib.import_module(f"algotom.prep.{name}"), method, None)
    except ImportError as error:
        raise MivolError(f"found no algotom, expected it for {method}: install it by pip install algotom.") from error
    if call is None:
        raise MivolError(f"found no {method} in algotom.prep.{name}, expected it: correct the name, or update algotom.")
    taken = inspect.signature(call).parameters
    unknown = [key for key in options if key not in taken]
    if unknown and not any(one.kind is one.VAR_KEYWORD for one in taken.values()):
        raise MivolError(f"found the option {unknown[0]!r} of {method}, expected one of {', '.join([*taken][1:])}: correct it.")
    return call


def _half_turns(views: int, angles: np.ndarray | None) -> list[np.ndarray]:
    """Indices of the views of half turns, each with the view half a turn after the first, if the scan has it."""
    if angles is None:
        return [np.arange(views)]
    order = np.argsort(angles, kind="stable")
    turned = np.asarray(angles, float)[order] - np.asarray(angles, float)[order[0]]
    step = float(np.median(np.diff(turned))) if views > 1 else np.pi
    last = int((turned <= turned[-1] - np.pi + step / 2).sum()) - 1
    starts = turned[np.unique(np.linspace(0, max(last, 0), HALF_TURNS).round().astype(int))]
    return [order[(turned > start - step / 2) & (turned < start + np.pi + step / 2)] for start in starts]
