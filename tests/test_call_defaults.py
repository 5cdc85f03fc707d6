"""What holds where a call says nothing: numbers and switches that a public function, method or class takes by itself, and
what the flags of each verb of the command are without being given; presets and sizes of benches, which are chosen by name; and
the numbers in the constants of every module: tolerances, bounds, coefficients of published formulas.

Whoever changes one changes the results of every script that is silent about it, and no formula tells that it is wrong. So they
are recorded, module by module, and ``pytest tests/test_call_defaults.py --record`` records them anew: the change is seen then.
What is not recorded yet is not judged, and what is gone is left out of the next record.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import json
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest

import mivol
from mivol.cli import parser

RECORDED = Path(__file__).with_suffix(".json")
MODULES = sorted(m.name for m in pkgutil.walk_packages(mivol.__path__, "mivol.") if not m.name.endswith("__main__"))


def is_plain(value: object) -> bool:
    """A number, a switch or a tuple of them."""
    return isinstance(value, bool | int | float) or (isinstance(value, tuple) and value != () and all(map(is_plain, value)))


def callables(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Public functions and classes of a module, and public methods of these classes."""
    for name, found in vars(module).items():
        if name.startswith("_") or getattr(found, "__module__", "") != module.__name__:
            continue
        if inspect.isclass(found):
            yield name, found
            for method, function in vars(found).items():
                function = getattr(function, "__func__", function)
                if not method.startswith("_") and inspect.isfunction(function):
                    yield f"{name}.{method}", function
        elif inspect.isfunction(found):
            yield name, found


def defaults(called: object) -> dict[str, object]:
    """Plain defaults by parameter, as JSON holds them."""
    try:
        parameters = inspect.signature(called).parameters.values()
    except (TypeError, ValueError):
        return {}
    plain = {p.name: p.default for p in parameters if is_plain(p.default)}
    return json.loads(json.dumps(plain))


def defaults_of(name: str) -> dict[str, dict]:
    """Those of a module, by function."""
    found = {called: defaults(function) for called, function in callables(importlib.import_module(name))}
    return {called: plain for called, plain in sorted(found.items()) if plain}


def numbers(value: object) -> object:
    """The numbers and switches in a constant, and the words in settings, as JSON holds them; None in the place of all else."""
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return numbers(value.tolist())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, dict):
        return {str(key): numbers(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [numbers(each) for each in value]
    if isinstance(value, set | frozenset):
        return [key for key in sorted(value, key=str) if isinstance(key, int | float)]
    if isinstance(value, type):
        return None
    if isinstance(value, msgspec.Struct) or dataclasses.is_dataclass(value):
        names = value.__struct_fields__ if isinstance(value, msgspec.Struct) else [f.name for f in dataclasses.fields(value)]
        parts = {name: getattr(value, name) for name in names}
        return {name: part if isinstance(part, str) else numbers(part) for name, part in parts.items()}
    if hasattr(value, "matrix"):
        return np.array(value.matrix).tolist()
    return None


def has_number(found: object) -> bool:
    """Whether anything but None is left of a constant."""
    if isinstance(found, dict | list):
        return any(map(has_number, found.values() if isinstance(found, dict) else found))
    return found is not None


def tables_of(name: str) -> dict[str, object]:
    """Numbers of the constants that a module sets itself, by their names."""
    module = importlib.import_module(name)
    own = set(re.findall(r"^(_?[A-Z][A-Z0-9_]*)\b", Path(module.__file__).read_text(encoding="utf-8"), re.MULTILINE))
    found = {key: numbers(value) for key, value in vars(module).items() if key in own}
    return {key: {"table": json.loads(json.dumps(table))} for key, table in sorted(found.items()) if has_number(table)}


def flags() -> dict[str, dict]:
    """What each flag of each verb is where it is not given, but for those that are nothing then."""
    (verbs,) = (a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    shown = {
        name: {a.dest: a.default for a in verb._actions if a.default not in (None, argparse.SUPPRESS)}
        for name, verb in verbs.choices.items()
    }
    return {name: json.loads(json.dumps(plain, default=str)) for name, plain in shown.items() if plain}


def written(found: dict[str, dict]) -> str:
    """JSON with a line for each function and constant."""
    modules = []
    for name, kept in found.items():
        lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in kept.items()]
        modules.append(f" {json.dumps(name)}: {{\n" + ",\n".join(lines) + "\n }")
    return "{\n" + ",\n".join(modules) + "\n}\n"


@pytest.mark.usefixtures("variant_rgb")
def test_defaults_are_as_recorded(record: bool) -> None:
    found = {name: defaults_of(name) | tables_of(name) for name in MODULES} | {"the command": flags()}
    if record:
        RECORDED.write_text(written({name: kept for name, kept in found.items() if kept}), encoding="utf-8")
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
    known = [(module, called, name) for module, kept in recorded.items() for called, plain in kept.items() for name in plain]
    held = {key: value for key in known if (value := found.get(key[0], {}).get(key[1], {}).get(key[2])) is not None}
    assert len(held) > 0.9 * len(known)
    assert held == {(module, called, name): recorded[module][called][name] for module, called, name in held}
