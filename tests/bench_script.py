"""A bench of scripts/ as a module, and what it prints with ``--quick``."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
HEADER = {"size", "machine", "versions", "variant", "threads", "load_before_and_after", "seconds", "bars"}


def load(name: str) -> ModuleType:
    """A script as a module; scripts find what they share beside them."""
    if str(SCRIPTS) not in sys.path:
        sys.path.append(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def quick(name: str, folder: Path, *more: str) -> dict:
    """What ``--quick`` prints; the same stands in its file, under the header of every bench."""
    command = [sys.executable, SCRIPTS / f"{name}.py", "--quick", "--out", folder, *more]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert json.loads((folder / f"{name}.json").read_text()) == figures
    assert set(figures) >= HEADER
    return figures | {"folder": folder}
