"""The arrows between the rooms: a module imports only its own room and rooms above it in ORDER."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "mivol"
ORDER = [
    *("errors", "threads", "machine", "llvm", "numerics", "space", "files", "photos", "fields", "phase"),
    *("transport", "tomography", "scene", "plugins", "optim", "validate", "report", "config", "doctor", "experiments"),
    *("bench", "cli", "__main__"),
]
STARTS_THREADS = {"threading", "multiprocessing", "subprocess", "concurrent", "_thread", "asyncio"}
STARTS_NOTHING = {
    *("subprocess.SubprocessError", "subprocess.TimeoutExpired", "threading.current_thread", "threading.main_thread"),
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The first part of a module's name below the package; empty for the root."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


def imported(path: Path) -> Iterator[tuple[str, int]]:
    """Full names of everything that a module imports, wherever the statement stands, with line numbers."""
    package = ["mivol", *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            yield from ((f"{module}.{alias.name}", node.lineno) for alias in node.names)


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


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_up(path: Path) -> None:
    room = room_of(path)
    assert room == "" or room in ORDER, f"{room} has no place in ORDER"
    assert wrong_arrows(room, imported(path)) == []


def test_nothing_imports_the_benches() -> None:
    """They measure mivol; nothing that a user runs needs them."""
    rooms = {path: room_of(path) for path in MODULES}
    found = [
        path.name for path, room in rooms.items() if room != "bench" for name, _ in imported(path) if "mivol.bench" in name
    ]
    assert found == []


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_threads_starts_threads_and_processes(path: Path) -> None:
    """One thread of a process uses Dr.Jit, and what starts another must go through the module that says so."""
    if room_of(path) == "threads":
        return
    tree = ast.parse(path.read_text(), str(path))
    used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    starts = {name for name in used - STARTS_NOTHING if name.split(".")[0] in STARTS_THREADS}
    froms = {name for name, _ in imported(path) if "." in name and name.split(".")[0] in STARTS_THREADS}
    assert starts | froms == set()


def test_only_plugins_define_classes_with_mitsuba_bases() -> None:
    """But for callbacks that ask an object for its parameters: Mitsuba never holds one."""
    found = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(), str(path))):
            if isinstance(node, ast.ClassDef) and room_of(path) != "plugins":
                bases = {ast.unparse(base) for base in node.bases} - {"mi.TraversalCallback"}
                found += [f"{path.name}: {node.name}" for base in bases if base.startswith("mi.")]
    assert found == []


def test_wrong_arrows_are_seen() -> None:
    """The check itself, on imports that it must refuse."""
    names = [("mivol.cli.main", 1), ("mivol.plugins.media", 2), ("mivol.space.Box", 3), ("numpy", 4), ("mivol.new", 5)]
    assert [message[:7] for message in wrong_arrows("fields", names)] == ["line 1:", "line 2:", "line 5:"]
