"""The shells: importing or reloading this package registers every plugin for the active variant.

The body runs at import and at each reload, as Mitsuba does with its own integrators. Nothing imports from
here: plugins are reached by name, so a stale class of an earlier variant can never be used by accident.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

ANY_VARIANT: tuple[str, ...] = ()  # order = dependency order
JIT_VARIANTS = ("integrators",)  # mi.ad.integrators.common does not exist in scalar_*


def _register() -> None:
    variant = mi.variant()
    if variant is None:
        return
    for name in ANY_VARIANT + (() if variant.startswith("scalar") else JIT_VARIANTS):
        qualified = f"{__name__}.{name}"
        loaded = sys.modules.get(qualified)
        if loaded:
            importlib.reload(loaded)
        else:
            importlib.import_module(qualified)


_register()
