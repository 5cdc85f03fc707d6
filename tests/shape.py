"""The shape of the code: sizes of functions and files, parameters, circles of imports. Prints JSON.

tests/shape.py              of this checkout
tests/shape.py OTHER        of another one
"""

from __future__ import annotations

import argparse
import ast
import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path

__all__ = ["circles", "find_circles", "measure"]

ROOT = Path(__file__).resolve().parents[1]
MANY = 7
LONG_FUNCTION, LONG_FILE = 60, 300


def main(argv: list[str] | None = None) -> int:
    """Print the figures of a checkout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", nargs="?", type=Path, default=ROOT)
    args = parser.parse_args(argv)
    print(json.dumps(measure(args.checkout / "mivol"), indent=2))
    return 0


def measure(package: Path) -> dict[str, object]:
    """Figures of a package."""
    trees = {path: ast.parse(path.read_text(), str(path)) for path in sorted(package.rglob("*.py"))}
    lines = {str(path.relative_to(package)): len(path.read_text().splitlines()) for path in trees}
    bodies, parameters = {}, {}
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                name = f"{path.relative_to(package)}:{node.name}"
                bodies[name], parameters[name] = _body(node), _parameters(node)
    trains = sum(_is_train(node) for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    circle = sorted(_circles_of(package, trees))
    return {
        "files": len(trees),
        "lines": sum(lines.values()),
        "median lines of a file": statistics.median(lines.values()),
        f"files of {LONG_FILE} lines and more": _largest(lines, LONG_FILE),
        "functions": len(bodies),
        "median lines of a body": statistics.median(bodies.values()),
        f"bodies of {LONG_FUNCTION} lines and more": _largest(bodies, LONG_FUNCTION),
        f"functions of {MANY} parameters and more": _largest(parameters, MANY),
        "signatures with scene and its media apart": trains,
        "modules in circles of imports": circle,
    }


def _body(node: ast.FunctionDef) -> int:
    """Lines of a function without its signature and docstring."""
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def _parameters(node: ast.FunctionDef) -> int:
    """Parameters without self and cls."""
    names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    return len([n for n in names if n not in ("self", "cls")])


def _is_train(node: ast.FunctionDef) -> bool:
    """Whether a function takes a scene and, beside it, the media that were made from it."""
    names = {a.arg for a in node.args.args}
    return "scene" in names and bool(names & {"world", "media"})


def _largest(sizes: dict[str, int], least: int) -> dict[str, int]:
    return {name: size for name, size in sorted(sizes.items(), key=lambda item: -item[1]) if size >= least}


def parse(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(), str(path))


def find_circles(package: Path, tree_of: Callable[[Path], ast.Module] = parse) -> list[str]:
    """Modules of a package that can be reached from themselves along imports, those for types alone included."""
    return _circles_of(package, {path: tree_of(path) for path in sorted(package.rglob("*.py"))})


def _circles_of(package: Path, trees: dict[Path, ast.Module]) -> list[str]:
    names = {".".join((package.name, *path.relative_to(package).with_suffix("").parts)): path for path in trees}
    return circles({name: _imported(trees[path], set(names)) - {name} for name, path in names.items()})


def circles(edges: dict[str, set[str]]) -> list[str]:
    """Nodes of a graph that can be reached from themselves, in the order of ``edges`` (node -> nodes it points to)."""
    found = []
    for start in edges:
        seen, ahead = set(), list(edges[start])
        while ahead:
            node = ahead.pop()
            if node not in seen:
                seen.add(node)
                ahead += edges.get(node, ())
        found += [start] if start in seen else []
    return found


def _imported(tree: ast.Module, modules: set[str]) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & modules


if __name__ == "__main__":
    sys.exit(main())
