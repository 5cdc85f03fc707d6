"""Channels of extinction: grey (1) or rgb (3) for a medium; for a scene, the larger number among its media.

Conventions. Rows are lists with a ``Float`` for each channel. A grey medium has the same value in every channel of an rgb
scene, so its derivative is the sum over the channels. In a mono variant the luminance replaces an rgb medium.
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
"""Weight of each channel of an rgb field in the channel of a mono variant (luminance, ITU-R BT.709, as in Mitsuba)."""


def to_spectrum(rows: list[mi.Float]) -> mi.Spectrum:
    """A number for each channel of the scene, as a spectrum."""
    return mi.Spectrum(*rows) if len(rows) == 3 else mi.Spectrum(rows[0])


def take_tangent(value: mi.Spectrum) -> mi.Spectrum:
    """The tangent of a value computed from parameters; 0 without a tangent.

    Only the edges of the graph are cleared; the tangents of the parameters stay, since other points and passes read them again.
    """
    return dr.forward_to(value, flags=dr.ADFlag.ClearEdges) if dr.grad_enabled(value) else dr.zeros(type(value))


def to_components(value: mi.Spectrum) -> list[mi.Float]:
    """The components of a spectrum, as a list."""
    return [value[c] for c in range(dr.size_v(value))]


def colours_to_channels(value: mi.Spectrum, channels: int) -> list[mi.Float]:
    """Derivatives by the channels of an extinction, from derivatives by the colours of a spectrum: a grey extinction gets the
    sum.
    """
    parts = to_components(value)
    return parts if len(parts) == channels else [sum(parts[1:], parts[0])]


def to_scene_channels(values: list[mi.Float], channels: int) -> list[mi.Float]:
    """The values of a grey or rgb part for each channel of the scene."""
    if len(values) > channels:
        return _grey(values)
    return [values[c % len(values)] for c in range(channels)]


def _grey(rows: list[mi.Float]) -> list[mi.Float]:
    """The luminance of three channels, for a mono variant."""
    return [sum(share * row for share, row in zip(LUMINANCE, rows, strict=True))]


def to_part_channels(weight: list[mi.Float], channels: int) -> list[mi.Float]:
    """Derivatives by the channels of a part, from derivatives by the channels of the scene.

    The transpose of :func:`to_scene_channels`.
    """
    if len(weight) == channels:
        return weight
    return [sum(weight)] if channels == 1 else [share * weight[0] for share in LUMINANCE]
