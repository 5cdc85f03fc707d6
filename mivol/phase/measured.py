"""Measured media by name: milk, juices, wine, coffee, soap, marble, skin.

Conventions. Coefficients are per millimetre, rgb, of the undiluted medium; g is the mean cosine of a Henyey-Greenstein phase
function, rgb. A g of 0 marks a missing measurement: coefficients of the first table are reduced (scattering that would look
isotropic), and in the second table a channel without scattering has no phase function.

Sources: Jensen, Marschner, Levoy & Hanrahan, "A Practical Model for Subsurface Light Transport", SIGGRAPH 2001; Narasimhan,
Gupta, Donner, Ramamoorthi, Nayar & Jensen, "Acquiring Scattering Properties of Participating Media by Dilution", SIGGRAPH 2006.
Their numbers were compared in two public tables, pbrt-v4 (src/pbrt/media.cpp at 5f7a6068: reduced scattering, absorption) and
Mitsuba 0.6 (src/medium/materials.h at 10af06f3: scattering, absorption, g): sigma_s (1 - g) of Mitsuba equals the reduced
scattering of pbrt-v4 in every channel. The tables differ in the red absorption of both chickens, a factor of 10; the value of
pbrt-v4 is used.
"""

from __future__ import annotations

import difflib
import re
from typing import NamedTuple

import numpy as np

from mivol.errors import MivolError

Triple = tuple[float, float, float]

# name: reduced scattering, absorption [1/mm]
_JENSEN_2001 = {
    "apple": ((2.29, 2.39, 1.97), (0.003, 0.0034, 0.046)),
    "chicken 1": ((0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
    "chicken 2": ((0.19, 0.25, 0.32), (0.018, 0.088, 0.2)),
    "cream": ((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    "ketchup": ((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    "marble": ((2.19, 2.62, 3.0), (0.0021, 0.0041, 0.0071)),
    "potato": ((0.68, 0.7, 0.55), (0.0024, 0.009, 0.12)),
    "skim milk": ((0.7, 1.22, 1.9), (0.0014, 0.0025, 0.0142)),
    "skin 1": ((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    "skin 2": ((1.09, 1.59, 1.79), (0.013, 0.07, 0.145)),
    "spectralon": ((11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
    "whole milk": ((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
}

# name: reduced scattering, absorption [1/mm], mean cosine
_NARASIMHAN_2006 = {
    "lowfat milk": ((0.89187, 1.5136, 2.532), (0.002875, 0.00575, 0.0115), (0.932, 0.902, 0.859)),
    "reduced milk": ((2.4858, 3.1669, 4.5214), (0.0025556, 0.0051111, 0.012778), (0.819, 0.797, 0.746)),
    "regular milk": ((4.5513, 5.8294, 7.136), (0.0015333, 0.0046, 0.019933), (0.75, 0.714, 0.681)),
    "espresso": ((0.72378, 0.84557, 1.0247), (4.7984, 6.5751, 8.8493), (0.907, 0.896, 0.88)),
    "mint mocha coffee": ((0.31602, 0.38538, 0.48131), (3.772, 5.8228, 7.82), (0.91, 0.907, 0.914)),
    "lowfat soy milk": ((0.30576, 0.34233, 0.61664), (0.0014375, 0.0071875, 0.035937), (0.85, 0.853, 0.842)),
    "regular soy milk": ((0.59223, 0.73866, 1.4693), (0.0019167, 0.0095833, 0.065167), (0.873, 0.858, 0.832)),
    "lowfat chocolate milk": ((0.64925, 0.83916, 1.1057), (0.0115, 0.0368, 0.1564), (0.934, 0.927, 0.916)),
    "regular chocolate milk": ((1.4585, 2.1289, 2.9527), (0.010063, 0.043125, 0.14375), (0.862, 0.838, 0.806)),
    "coke": ((8.9053e-5, 8.372e-5, 0.0), (0.10014, 0.16503, 0.2468), (0.965, 0.972, 0.0)),
    "pepsi": ((6.1697e-5, 4.2564e-5, 0.0), (0.091641, 0.14158, 0.20729), (0.926, 0.979, 0.0)),
    "sprite": ((6.0306e-6, 6.4139e-6, 6.5504e-6), (0.001886, 0.0018308, 0.0020025), (0.943, 0.953, 0.952)),
    "gatorade": ((0.0024574, 0.003007, 0.0037325), (0.024794, 0.019289, 0.008878), (0.933, 0.933, 0.935)),
    "chardonnay": ((1.7982e-5, 1.3758e-5, 1.2023e-5), (0.010782, 0.011855, 0.023997), (0.914, 0.958, 0.975)),
    "white zinfandel": ((1.7501e-5, 1.9069e-5, 1.288e-5), (0.012072, 0.016184, 0.019843), (0.919, 0.943, 0.972)),
    "merlot": ((2.1129e-5, 0.0, 0.0), (0.11632, 0.25191, 0.29434), (0.974, 0.0, 0.0)),
    "budweiser beer": ((2.4356e-5, 2.4079e-5, 1.0564e-5), (0.011492, 0.024911, 0.057786), (0.917, 0.956, 0.982)),
    "coors light beer": ((5.0922e-5, 4.301e-5, 0.0), (0.006164, 0.013984, 0.034983), (0.918, 0.966, 0.0)),
    "clorox": ((0.0024035, 0.0031373, 0.003991), (0.0033542, 0.014892, 0.026297), (0.912, 0.905, 0.892)),
    "apple juice": ((0.00013612, 0.00015836, 0.000227), (0.012957, 0.023741, 0.052184), (0.947, 0.949, 0.945)),
    "cranberry juice": ((0.00010402, 0.00011646, 7.8139e-5), (0.039437, 0.094223, 0.12426), (0.947, 0.951, 0.974)),
    "grape juice": ((5.382e-5, 0.0, 0.0), (0.10404, 0.23958, 0.29325), (0.961, 0.0, 0.0)),
    "ruby grapefruit juice": ((0.011002, 0.010927, 0.011036), (0.085867, 0.18314, 0.25262), (0.929, 0.929, 0.931)),
    "white grapefruit juice": ((0.22826, 0.23998, 0.32748), (0.0138, 0.018831, 0.056781), (0.548, 0.545, 0.565)),
    "shampoo": ((0.0007176, 0.0008303, 0.0009016), (0.014107, 0.045693, 0.061717), (0.91, 0.905, 0.92)),
    "strawberry shampoo": ((0.00015671, 0.00015947, 1.518e-5), (0.01449, 0.05796, 0.075823), (0.927, 0.935, 0.994)),
    "head & shoulders shampoo": ((0.023805, 0.028804, 0.034306), (0.084621, 0.15688, 0.20365), (0.911, 0.896, 0.884)),
    "lemon tea powder": ((0.040224, 0.045264, 0.051081), (2.4288, 4.5757, 7.2127), (0.946, 0.946, 0.949)),
    "orange juice powder": ((0.00015617, 0.00017482, 0.0001762), (0.001449, 0.003441, 0.007863), (0.919, 0.918, 0.922)),
    "pink lemonade powder": ((0.00012103, 0.00013073, 0.00012528), (0.001165, 0.002366, 0.003195), (0.902, 0.902, 0.904)),
    "cappuccino powder": ((1.8436, 2.5851, 2.1662), (35.844, 49.547, 61.084), (0.849, 0.843, 0.926)),
    "salt powder": ((0.027333, 0.032451, 0.031979), (0.28415, 0.3257, 0.34148), (0.802, 0.793, 0.821)),
    "sugar powder": ((0.00022272, 0.00025513, 0.000271), (0.012638, 0.031051, 0.050124), (0.921, 0.919, 0.931)),
    "suisse mocha powder": ((2.7979, 3.5452, 4.3365), (17.502, 27.004, 35.433), (0.907, 0.894, 0.888)),
    "pacific ocean surface water": ((0.0001764, 0.00032095, 0.00019617), (0.031845, 0.031324, 0.030147), (0.902, 0.825, 0.914)),
}

_TABLE = {**{name: (*row, (0.0, 0.0, 0.0)) for name, row in _JENSEN_2001.items()}, **_NARASIMHAN_2006}

NAMES = tuple(sorted(_TABLE))
"""The names of all media."""

ALIASES = {
    "milk": "regular milk",
    "soy milk": "regular soy milk",
    "chocolate milk": "regular chocolate milk",
    "red wine": "merlot",
    "white wine": "chardonnay",
    "beer": "budweiser beer",
    "coffee": "espresso",
    "grapefruit juice": "white grapefruit juice",
    "sea water": "pacific ocean surface water",
}
"""Everyday names, and the media they stand for."""


class MeasuredMedium(NamedTuple):
    """A medium, undiluted.

    Attributes:
        sigma_a: absorption coefficient [1/mm], rgb.
        sigma_s: scattering coefficient [1/mm], rgb.
        g: mean cosine of the scattering angle [1], rgb.
    """

    sigma_a: Triple
    sigma_s: Triple
    g: Triple

    def mean_g(self) -> float:
        """A g for all channels: the mean, weighted by the scattering coefficients."""
        total = sum(self.sigma_s)
        return float(np.dot(self.g, self.sigma_s) / total) if total > 0 else 0.0

    def to_dict(self, mm_per_unit: float, dilution: float = 1.0, channel: int | None = None) -> dict[str, object]:
        """The medium as a plugin for ``mi.load_dict``: a ``mivol_medium`` with a ``mivol_hg``.

        A phase function has a single g for all channels, so an rgb medium takes :meth:`mean_g`. If g differs much between
        channels (low-fat milk: 0.93 to 0.86), render the channels separately.

        Args:
            mm_per_unit: length of a scene unit [mm]: 1000 for a scene in metres.
            dilution: fraction of the medium in clear water, above 0 and at most 1.
            channel: 0, 1 or 2 for a grey medium with the coefficients and g of this channel; by default rgb.

        Raises:
            MivolError: an impossible unit, dilution or channel.
        """
        if not (np.isfinite(mm_per_unit) and mm_per_unit > 0):
            raise MivolError(f"mm_per_unit is {mm_per_unit}; the length of a scene unit in millimetres is expected, above 0.")
        if not 0 < dilution <= 1:
            raise MivolError(f"dilution is {dilution}; a share above 0 and at most 1 is expected.")
        if channel not in (None, 0, 1, 2):
            raise MivolError(f"channel is {channel}; 0, 1, 2 or None is expected.")

        def scene_coefficient(coefficient: Triple) -> object:
            values = [x * mm_per_unit * dilution for x in coefficient]
            return {"type": "rgb", "value": values} if channel is None else values[channel]

        g = self.mean_g() if channel is None else self.g[channel]
        return {
            "type": "mivol_medium",
            "sigma_a": scene_coefficient(self.sigma_a),
            "sigma_s": scene_coefficient(self.sigma_s),
            "phase": {"type": "mivol_hg", "g": g},
        }


def named_medium(name: str) -> MeasuredMedium:
    """Look up a measured medium.

    Args:
        name: a name of :data:`NAMES` or :data:`ALIASES`, in capitals or not, words apart or joined by - or _.

    Returns:
        ``sigma_a, sigma_s, g``, rgb triples; coefficients in 1/mm.

    Raises:
        MivolError: an unknown name; the message suggests the nearest known names.
    """
    known = {_normalise_name(n): n for n in (*NAMES, *ALIASES)}
    match = known.get(_normalise_name(name))
    if match is None:
        near = difflib.get_close_matches(_normalise_name(name), known, n=3, cutoff=0.5)
        near = ", ".join(known[n] for n in near) or "milk, skim milk, red wine, ..."
        raise MivolError(f"no measured medium is called {name!r}; near it are {near}: see mivol.phase.measured.NAMES.")
    reduced, sigma_a, g = _TABLE[ALIASES.get(match, match)]
    sigma_s = tuple(float(np.round(s / (1 - k), 9)) for s, k in zip(reduced, g, strict=True))
    return MeasuredMedium(sigma_a, sigma_s, g)


def _normalise_name(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
