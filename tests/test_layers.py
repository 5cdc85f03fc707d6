"""The arrows between the rooms: a module imports its own room and rooms above it in ORDER; the figures of tests/shape.py."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import shape
from syntax import tree_of

PACKAGE = Path(__file__).resolve().parents[1] / "mivol"
ORDER = [
    *("errors", "display", "cite", "threads", "machine", "llvm", "back_end", "kernel_recording", "scene_graph", "numerics"),
    *("space", "files", "photos", "points", "fields", "phase"),
    *("transport", "splatting", "tomography", "scene", "plugins", "optim", "validate", "report", "schema", "config", "doctor"),
    *("experiments", "cluster", "view", "bench", "cli", "__main__"),
]
INSIDE = {
    "transport": ["traversal", "media", "estimators", "line_integrals", "path"],
    "optim": ["photographs", "gaussians", "scenes", "projections"],
}
"""Rooms with rooms of their own, lowest first: a module there imports its own room, those before it, and modules that stand
directly in the outer room. The latter import no inner room."""
STARTS_THREADS = {"threading", "multiprocessing", "subprocess", "concurrent", "_thread", "asyncio"}
STARTS_NOTHING = {
    *("subprocess.SubprocessError", "subprocess.TimeoutExpired", "threading.current_thread", "threading.main_thread")
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The first part of a module's name below the package; empty for the root."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


@cache
def imported(path: Path) -> list[tuple[str, int]]:
    """Full names of everything that a module imports, wherever the statement stands, with line numbers."""
    package = ["mivol", *path.relative_to(PACKAGE).parent.parts]
    found = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            found += [(f"{module}.{alias.name}", node.lineno) for alias in node.names]
    return found


def wrong_arrows(room: str, names: Iterable[tuple[str, int]]) -> list[str]:
    """Imports of a room below, of a name that ORDER does not know, or of the plugins, which only the root registers."""
    wrong = []
    for name, line in names:
        parts = name.split(".")
        if parts[0] != "mivol" or len(parts) < 2 or parts[1].startswith("_"):
            continue
        allowed = set(ORDER if room == "" else ORDER[: ORDER.index(room) + 1])
        if parts[1] not in allowed or (parts[1] == "plugins" and room not in ("", "plugins")):
            wrong.append(f"line {line}: {name}")
    return wrong


def of_modules(faults: Callable[[Path], object]) -> dict[str, object]:
    """What is wrong with each module of which something is. One test asks all: items cost more than they ask."""
    return {str(path.relative_to(PACKAGE)): wrong for path in MODULES if (wrong := faults(path))}


def test_imports_point_up() -> None:
    assert {room_of(path) for path in MODULES} - {""} <= set(ORDER)
    assert of_modules(lambda path: wrong_arrows(room_of(path), imported(path))) == {}


def test_nothing_imports_the_benches() -> None:
    """They measure mivol; nothing that a user runs needs them, but the verb that runs them."""
    rooms = {path: room_of(path) for path in MODULES}
    found = [name for path, room in rooms.items() if room != "bench" for name, _ in imported(path) if "mivol.bench" in name]
    assert set(found) == {"mivol.bench.harness.catalogue.list_studies", "mivol.bench.harness.catalogue.run_study"}


def test_imports_point_up_inside_a_room() -> None:
    assert of_modules(lambda path: wrong_arrows_inside(path.relative_to(PACKAGE).parts, imported(path))) == {}


def wrong_arrows_inside(parts: tuple[str, ...], names: Iterable[tuple[str, int]]) -> list[str]:
    """Imports of an inner room that stands behind the module's own, or of one that INSIDE does not know."""
    if parts[0] not in INSIDE:
        return []
    order, wrong = INSIDE[parts[0]], []
    allowed = order[: order.index(parts[1]) + 1] if len(parts) > 2 else []
    for name, line in names:
        target = name.split(".")
        is_inner = target[:2] == ["mivol", parts[0]] and (PACKAGE / parts[0] / target[2]).is_dir()
        if is_inner and target[2] not in allowed:
            wrong.append(f"line {line}: {name}")
    return wrong


def test_no_circle_of_imports() -> None:
    """Imports for types alone count: who needs them cannot be read without the others."""
    assert shape.find_circles(PACKAGE, tree_of) == []


def test_wrong_arrows_inside_a_room_are_seen() -> None:
    names = [("mivol.transport.path.walk.Path", 1), ("mivol.transport.media.body.Body", 2), ("mivol.fields.sky", 3)]
    assert wrong_arrows_inside(("transport", "estimators", "segment.py"), names) == ["line 1: mivol.transport.path.walk.Path"]
    names = [("mivol.optim.problem.Reals", 1), ("mivol.optim.scenes.views.View", 2)]
    assert wrong_arrows_inside(("optim", "photographs", "exposure.py"), names) == ["line 2: mivol.optim.scenes.views.View"]
    assert wrong_arrows_inside(("optim", "second_order.py"), names) == ["line 2: mivol.optim.scenes.views.View"]


def starts_of_threads(path: Path) -> set[str]:
    """Names by which a module starts threads or processes."""
    attributes = [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Attribute)]
    used = {f"{node.value.id}.{node.attr}" for node in attributes if isinstance(node.value, ast.Name)}
    used |= {name for name, _ in imported(path) if "." in name}
    return {name for name in used - STARTS_NOTHING if name.split(".")[0] in STARTS_THREADS}


def test_only_threads_starts_threads_and_processes() -> None:
    """One thread of a process uses Dr.Jit, and what starts another must go through the module that says so."""
    assert set(of_modules(starts_of_threads)) == {"threads.py"}


def test_only_plugins_define_classes_with_mitsuba_bases() -> None:
    """But for callbacks that ask an object for its parameters: Mitsuba never holds one."""
    found = []
    for path in MODULES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef) and room_of(path) != "plugins":
                bases = {ast.unparse(base) for base in node.bases} - {"mi.TraversalCallback"}
                found += [f"{path.name}: {node.name}" for base in bases if base.startswith("mi.")]
    assert found == []


def test_wrong_arrows_are_seen() -> None:
    """The check itself, on imports that it must refuse."""
    names = [("mivol.cli.main", 1), ("mivol.plugins.media", 2), ("mivol.space.Box", 3), ("numpy", 4), ("mivol.new", 5)]
    assert [message[:7] for message in wrong_arrows("fields", names)] == ["line 1:", "line 2:", "line 5:"]


# -- Figures of the shape ----------------------------------------------------------------------------------------------


def test_figures_of_a_small_package(tmp_path: Path) -> None:
    """Functions of many parameters are named, `self` does not count, and imports for types alone close a circle."""
    package = tmp_path / "small"
    package.mkdir()
    (package / "a.py").write_text(
        "from small.b import B\n\n\nclass A:\n    def many(self, a, b, c, d, *, e, f, g):\n        return B\n\n"
        "    def few(self, a, b, c, d, e, f):\n        return a\n"
    )
    (package / "b.py").write_text("from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from small import a\n")
    (package / "c.py").write_text("from small.a import A\n")
    found = shape.measure(package)
    assert found["functions of 7 parameters and more"] == {"a.py:many": 7}
    assert found["modules in circles of imports"] == ["small.a", "small.b"]
    assert (found["files"], found["functions"]) == (3, 2)


def test_circles_are_seen() -> None:
    assert shape.circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == ["b", "c"]
