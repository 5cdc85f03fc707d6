"""Colours of media: an extinction is grey (1 channel) or rgb (3), the media of a scene have the larger number.

Conventions. Rows are lists of one ``Float`` for each channel. A grey medium counts in every channel of an rgb scene; its
derivative is the sum over channels. In a mono variant an rgb medium counts by its luminance.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

__all__ = ["as_rows", "by_channel", "colours", "for_part", "spectrum", "tangent_of"]


LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Share of each channel of an rgb field in the one channel of a mono variant (ITU-R BT.709, as in Mitsuba)."""


def spectrum(rows: list[mi.Float]) -> mi.Spectrum:
    """One number for each channel of the scene as a spectrum."""
    return mi.Spectrum(*rows) if len(rows) == 3 else mi.Spectrum(rows[0])


def tangent_of(value: mi.Spectrum) -> mi.Spectrum:
    """The tangent of a value that was computed from parameters; 0 where none of them has one.

    The tangents that it reads are kept: other points and passes read them again.
    """
    return dr.forward_to(value, flags=dr.ADFlag.ClearEdges) if dr.grad_enabled(value) else dr.zeros(type(value))


def colours(value: mi.Spectrum) -> list[mi.Float]:
    """The numbers of a spectrum, one for each colour."""
    return [value[c] for c in range(dr.size_v(value))]


def by_channel(value: mi.Spectrum, channels: int) -> list[mi.Float]:
    """The derivative of each channel of the extinction from that of each colour: a grey one gets the sum."""
    parts = colours(value)
    return parts if len(parts) == channels else [sum(parts[1:], parts[0])]


def as_rows(values: list[mi.Float], channels: int) -> list[mi.Float]:
    """The values of a grey or rgb part for each channel of the scene."""
    if len(values) > channels:
        return _grey(values)
    return [values[c % len(values)] for c in range(channels)]


def _grey(rows: list[mi.Float]) -> list[mi.Float]:
    """Three channels as the one of a mono variant."""
    return [sum(share * row for share, row in zip(LUMINANCE, rows, strict=True))]


def for_part(weight: list[mi.Float], channels: int) -> list[mi.Float]:
    """The derivative of each channel of a part: its own, the sum for a grey part, the share in the grey of a mono variant."""
    if len(weight) == channels:
        return weight
    return [sum(weight)] if channels == 1 else [share * weight[0] for share in LUMINANCE]
