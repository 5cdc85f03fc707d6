"""Channels of extinction: grey (1) or rgb (3) for a medium; for a scene, the larger number among its media.

Conventions. Rows are lists of one ``Float`` for each channel. A grey medium has the same value in every channel of an rgb
scene, so its derivative is the sum over the channels. In a mono variant an rgb medium is replaced by its luminance.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = [
    "LUMINANCE",
    "to_scene_channels",
    "colours_to_channels",
    "to_components",
    "to_part_channels",
    "to_spectrum",
    "take_tangent",
]


LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weight of each channel of an rgb field in the one channel of a mono variant (luminance, ITU-R BT.709, as in Mitsuba)."""


def to_spectrum(rows: list[mi.Float]) -> mi.Spectrum:
    """One number for each channel of the scene as a spectrum."""
    return mi.Spectrum(*rows) if len(rows) == 3 else mi.Spectrum(rows[0])


def take_tangent(value: mi.Spectrum) -> mi.Spectrum:
    """The tangent of a value that was computed from parameters; 0 where none of them has one.

    Only the edges of the graph are cleared, and the tangents of the parameters are kept, since other points and passes read
    them again.
    """
    return dr.forward_to(value, flags=dr.ADFlag.ClearEdges) if dr.grad_enabled(value) else dr.zeros(type(value))


def to_components(value: mi.Spectrum) -> list[mi.Float]:
    """The components of a spectrum as a list."""
    return [value[c] for c in range(dr.size_v(value))]


def colours_to_channels(value: mi.Spectrum, channels: int) -> list[mi.Float]:
    """Derivatives by the channels of an extinction, from those by the components of a spectrum: a grey one gets the sum."""
    parts = to_components(value)
    return parts if len(parts) == channels else [sum(parts[1:], parts[0])]


def to_scene_channels(values: list[mi.Float], channels: int) -> list[mi.Float]:
    """The values of a grey or rgb part for each channel of the scene."""
    if len(values) > channels:
        return _grey(values)
    return [values[c % len(values)] for c in range(channels)]


def _grey(rows: list[mi.Float]) -> list[mi.Float]:
    """Three channels as the one of a mono variant: their luminance."""
    return [sum(share * row for share, row in zip(LUMINANCE, rows, strict=True))]


def to_part_channels(weight: list[mi.Float], channels: int) -> list[mi.Float]:
    """Derivatives by the channels of a part, from derivatives by the channels of the scene.

    The transpose of :func:`to_scene_channels`.
    """
    if len(weight) == channels:
        return weight
    return [sum(weight)] if channels == 1 else [share * weight[0] for share in LUMINANCE]
