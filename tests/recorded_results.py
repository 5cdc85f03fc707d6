"""What a command computes is what was recorded: numbers in its files and in what it prints, without times and memory.

``--record`` records anew. A run is made twice then, and only numbers that are the same both times are kept.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from mivol.files import read_exr

ROUNDING = 1e-3
"""Of the length of an array, as for single samples of renders (tests/conformance/test_drawn_pictures.py)."""

OF_THE_MACHINE = re.compile(
    r"second|time|date|memory|bytes|version|machine|host|load|python|clock|processor|launch|rate|per_s|scaled|started|command"
    r"|free|ratio|latency|bandwidth|gib|minutes|milli|fastest|commit|folder|path|mivol_"
    r"|first_call|^bars$|^config$|camera order|random order"
)
"""Names of numbers that another machine, or another hour, changes."""

MEASURED = re.compile(
    r"\d (?:s|ms|min|h|GiB|MiB|MB|KiB|kB|GB|cores|threads|M|rays)\b|\d(?: of)? (?:seconds|minutes)|/s\b|\d:\d\d"
)
"""Texts with a time, an amount of memory or a rate."""

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


def sketch(values: np.ndarray) -> list[float]:
    """The length of an array, and its products with three random ones of about unit length in each direction."""
    flat = np.nan_to_num(np.asarray(values, np.float64).ravel(), nan=-3.5, posinf=1e3, neginf=-1e3)
    weights = np.random.default_rng(flat.size).normal(size=(3, flat.size))
    return [float(np.linalg.norm(flat)), *map(float, weights @ flat)]


def list_results(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """The numbers of nested tables and lists, each with its place; arrays as sketches."""
    if OF_THE_MACHINE.search(name.rpartition("/")[2].lower()):
        return
    if isinstance(value, dict):
        for key, item in value.items():
            yield from list_results(item, f"{name}/{key}")
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        yield name, sketch(value)
    elif isinstance(value, list | tuple):
        if value and all(isinstance(item, int | float) for item in value):
            yield name, sketch(np.array(value, float))
        else:
            for k, item in enumerate(value):
                yield from list_results(item, f"{name}/{k}")
    elif isinstance(value, bool | int | float | np.number):
        yield name, sketch(np.array([value], float))
    elif isinstance(value, str):
        yield from list_numbers(value, name)


def list_numbers(text: str, name: str) -> Iterator[tuple[str, object]]:
    """The numbers of a text without its tags, times and rates."""
    text = re.sub(r"<(style|script).*?</\1>|data:[^\"')]*", "", text, flags=re.DOTALL)
    pieces = [piece for piece in re.split(r"[<>\n;]", text) if not MEASURED.search(piece) and "/tmp/" not in piece]
    if numbers := [float(n) for piece in pieces for n in NUMBER.findall(piece)]:
        yield name, sketch(np.array(numbers))


def read_results(folder: Path) -> Iterator[tuple[str, object]]:
    """The numbers of all files below a folder, by file and place."""
    for path in sorted(folder.rglob("*")):
        name, text = str(path.relative_to(folder)), path.suffix
        if text == ".json":
            yield from list_results(json.loads(path.read_text()), name)
        elif text == ".jsonl":
            for k, line in enumerate(path.read_text().splitlines()):
                yield from list_results(json.loads(line), f"{name}/{k}")
        elif text in (".npz", ".npy"):
            with io.BytesIO(path.read_bytes()) as file:
                arrays = np.load(file, allow_pickle=False)
                yield from list_results(dict(arrays) if text == ".npz" else arrays, name)
        elif text == ".exr":
            yield from list_results(read_exr(path), name)
        elif text in (".png", ".jpg"):
            with Image.open(path) as image:
                yield name, sketch(np.asarray(image))
        elif text in (".html", ".txt", ".md", ".csv", ".toml", ".xml"):
            yield from list_numbers(path.read_text(), name)
        elif path.is_file():
            yield name, sketch(np.frombuffer(path.read_bytes(), np.uint8))


def is_same(one: list[float], other: list[float]) -> bool:
    """Whether two sketches are of the same values, up to rounding."""
    return all(abs(a - b) <= ROUNDING * one[0] for a, b in zip(one, other, strict=True))


def check(recorded: Path, name: str, run: Callable[[], dict], record: bool) -> None:
    """Compare what a run computes with what was recorded under its name."""
    known = json.loads(recorded.read_text(encoding="utf-8")) if recorded.exists() else {}
    found = run()
    if record:
        again = run()
        kept = sorted(key for key, value in found.items() if key in again and is_same(value, again[key]))
        known[name] = {key: [float(f"{x:.6g}") for x in found[key]] for key in kept}
        text = json.dumps(dict(sorted(known.items())), indent=1)
        # A sketch is a line.
        recorded.write_text(
            re.sub(r"\[\s+([^\]]*?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text) + "\n", encoding="utf-8"
        )
    missing = [key for key in known[name] if key not in found]
    assert missing == [], missing
    pairs = [(key, value, found[key]) for key, value in known[name].items()]
    different = [f"{key}: {new}, recorded {old}" for key, old, new in pairs if not is_same(old, new)]
    assert different == [], "\n".join(different)
