"""Differentiable and inverse volume rendering on Mitsuba 3. Importing this needs no variant."""

from __future__ import annotations

import importlib
import warnings

from . import llvm

llvm.ensure()

try:
    import mitsuba as mi  # Dr.Jit loads LLVM as soon as it is imported
except (ImportError, NameError) as error:  # a NameError is how Dr.Jit 1.5 reports that its own library does not load
    raise ImportError(llvm.missing_system_library() or f"Mitsuba cannot be imported: {error}") from error

from . import plugins  # noqa: E402
from .errors import MivolError, reveal_refusals  # noqa: E402

__all__ = ["MivolError", "__version__"]

__version__ = "0.1.0"


def _on_variant_change(old: str | None, new: str) -> None:
    llvm.check_backend(new)
    importlib.reload(plugins)


mi.detail.add_variant_callback(_on_variant_change)
mi.render = mi.util.render = reveal_refusals(mi.render)

try:
    llvm.check_backend()
except llvm.LlvmError as error:
    warnings.warn(f"{error}", RuntimeWarning, stacklevel=2)
