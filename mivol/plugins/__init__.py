"""Mitsuba plugins: importing or reloading this package registers each plugin for the active variant.

The body runs at import and at each reload, as in Mitsuba's own integrators. No module imports from here: plugins are reached
by name, so a stale class of an earlier variant can never be used by accident.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from mivol.back_end import check_variant

MODULES = ("volumes", "phases", "media", "sensors", "integrators")  # order = dependency order


def _register() -> None:
    if mi.variant() is None:
        return
    # In scalar_* register an integrator alone, which says what works. Mitsuba takes a plugin's kind from scalar_rgb, and a
    # volume registered as a texture (Mitsuba has no register_volume) would then be a texture in every variant.
    if mi.variant().startswith("scalar"):
        mi.register_integrator("mivol", lambda props: check_variant())
        return
    for name in MODULES:
        qualified = f"{__name__}.{name}"
        loaded = sys.modules.get(qualified)
        if loaded:
            importlib.reload(loaded)
        else:
            importlib.import_module(qualified)


_register()
