"""Differentiable and inverse volume rendering on Mitsuba 3. Importing this needs no variant."""

from __future__ import annotations

import importlib

import mitsuba as mi

from . import plugins
from .errors import MivolError

__all__ = ["MivolError", "__version__"]

__version__ = "0.1.0"


def _on_variant_change(old: str | None, new: str) -> None:
    importlib.reload(plugins)


mi.detail.add_variant_callback(_on_variant_change)
