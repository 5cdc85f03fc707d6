"""Units of what is looked for: as an experiment gives them, or as the key tells.

Conventions. ``length`` is the scene's own, ``radiance`` what its emitters are given in, ``1`` a pure number; "" is a unit that
nobody knows.
"""

from __future__ import annotations

from mivol.config import Sought

__all__ = ["UNITS", "unit_of"]

UNITS = {
    "sigma_t": "1/length",
    "sigma_a": "1/length",
    "sigma_s": "1/length",
    "albedo": "1",
    "g": "1",
    "position": "length",
    "radiance": "radiance",
    "irradiance": "radiance sr",
    "intensity": "radiance length²",
    "reflectance": "1",
    "alpha": "1",
    "scale": "1",
}
"""By the words of a key of ``mi.traverse(scene)``. Mitsuba's extinction is ``scale`` times ``sigma_t``, its sky ``scale`` times
``data``: one of the two has the unit."""


def unit_of(sought: Sought) -> str:
    """The unit of a parameter: the experiment's, else that of the last word of the key that has one, else ""."""
    return sought.unit or next((UNITS[word] for word in reversed(sought.key.split(".")) if word in UNITS), "")
