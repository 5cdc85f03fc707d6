"""Scripts as modules, for tests of their parts."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (ROOT / "scripts", ROOT / ".ci")


def load(name: str) -> ModuleType:
    """A script of scripts/ or .ci/ as a module; it imports its neighbours by their names."""
    sys.path.extend(str(folder) for folder in FOLDERS if str(folder) not in sys.path)
    return importlib.import_module(name)
