"""One-line faults of the kinds that programmers make, drawn at random from source files.

A fault replaces one piece of a file's text: an operator, a sign, a constant, an index or a whole condition. They are
found in the syntax tree, so that docstrings, other strings, annotations, imports, decorators and ``__all__`` are never
touched, nor what only a type checker or a direct call of the file runs. Constants of the studies of the bench are left alone,
too: sizes, seeds and scenes choose what is measured, so another value is another measurement and no fault.
"""

from __future__ import annotations

import ast
import io
import random
import tokenize
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

__all__ = ["Fault", "draw_faults", "find_faults", "read_package"]

OPERATORS = {
    "+": "-", "-": "+", "*": "/", "/": "*", "//": "/", "%": "//", "**": "*", "<<": ">>", ">>": "<<", "&": "|", "|": "&",
    "+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "&=": "|=", "|=": "&=", "<<=": ">>=", ">>=": "<<=",
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==",
    "in": "not in", "not in": "in", "is": "is not", "is not": "is", "and": "or", "or": "and",
}  # fmt: skip
"""What takes the place of an operator."""

FUNCTIONS = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any",
    "floor": "ceil", "ceil": "floor", "sin": "cos", "cos": "sin",
}  # fmt: skip
"""What takes the place of the name of a function that is called."""

AXES = {"x": "y", "y": "z", "z": "x"}
"""What takes the place of a component of a vector."""

OF_TYPES = ("isinstance", "issubclass", "cast", "TypeVar")
"""Functions whose arguments are types, in which ``|`` is no operation on values."""

GENERICS = ("Annotated", "Callable", "Literal", "dict", "list", "tuple", "type")
BUILT_IN = ("bool", "bytes", "complex", "dict", "float", "int", "list", "object", "set", "str", "tuple")

DECLARATIONS = ("annotation", "returns", "decorator_list", "type_params", "bases")
"""Fields of nodes that say what something is, not what it does; the keywords of a class are such, too."""

STUDIES = "bench/studies/"
"""Folder of the modules whose constants choose a measurement."""

SMALL, LARGE = 1e-6, 1e6
"""Outside of them a constant stands for zero or for infinity: twice as much of it is the same."""


@dataclass(frozen=True, order=True)
class Fault:
    """Put ``new`` in the place of ``old``, which begins at the character ``start`` of a file.

    Attributes:
        file: relative to the checkout.
        line: where ``start`` is, from 1.
        kind: operator, function, sign, constant, index or condition.
    """

    file: str
    line: int
    start: int
    old: str
    new: str
    kind: str

    def apply(self, text: str) -> str:
        """The text of the file with the fault in it."""
        return text[: self.start] + self.new + text[self.start + len(self.old) :]

    def __str__(self) -> str:
        old, new = (" ".join(t.split()) for t in (self.old, self.new))
        return f"{self.file}:{self.line}: {self.kind} {old[:60]!r} -> {new!r}"


class _Text:
    """A file's characters by the places that ``ast`` gives (lines, and bytes in them), and the operators between two."""

    def __init__(self, source: str) -> None:
        self.source, self._lines = source, source.splitlines(keepends=True)
        self._begin = [0]
        for line in self._lines:
            self._begin.append(self._begin[-1] + len(line))
        tokens = [t for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type in (tokenize.OP, tokenize.NAME)]
        self._tokens = [(self._begin[t.start[0] - 1] + t.start[1], t.string) for t in tokens]

    def place(self, line: int, column: int) -> int:
        return self._begin[line - 1] + len(self._lines[line - 1].encode()[:column].decode())

    def span(self, node: ast.AST) -> tuple[int, int]:
        return self.place(node.lineno, node.col_offset), self.place(node.end_lineno, node.end_col_offset)

    def operator(self, start: int, end: int) -> tuple[int, str]:
        """Place and text of the operator between two operands; parentheses around them are passed over."""
        between = self._tokens[bisect_left(self._tokens, (start, "")) : bisect_left(self._tokens, (end, ""))]
        words = [(place, word) for place, word in between if word not in ("(", ")")]
        first, (last, word) = words[0][0], words[-1]
        return first, self.source[first : last + len(word)]


def read_package(root: Path, package: str = "mivol") -> dict[str, str]:
    """The text of each Python file of a package, by its name relative to ``root``."""
    return {str(path.relative_to(root)): path.read_text() for path in sorted((root / package).rglob("*.py"))}


def draw_faults(sources: Mapping[str, str], count: int, seed: int) -> list[Fault]:
    """Draw faults on different lines: first the lines, all alike, then on each line a place, then what to put there.

    Args:
        sources: text of each file by its name.
        count: number of faults.
        seed: the same sources and seed give the same faults.

    Raises:
        ValueError: fewer lines than ``count`` can be broken.
    """
    lines = defaultdict(lambda: defaultdict(list))
    for file in sorted(sources):
        for fault in find_faults(file, sources[file]):
            lines[file, fault.line][fault.start, fault.old].append(fault)
    if count > len(lines):
        raise ValueError(f"{count} faults are asked for; {len(lines)} lines can be broken.")
    generator = random.Random(seed)
    chosen = [lines[line] for line in generator.sample(sorted(lines), count)]
    return [generator.choice(places[generator.choice(sorted(places))]) for places in chosen]


@cache
def find_faults(file: str, source: str) -> tuple[Fault, ...]:
    """All faults that a file can be given, in the order of its text."""
    text, tree, found = _Text(source), ast.parse(source, file), set()
    indices = {id(n.slice) for n in ast.walk(tree) if _has_index(n)}
    for node in _walk(tree):
        if id(node) in indices:
            continue
        for start, end, new, kind in _faults_of(node, text):
            if kind == "constant" and STUDIES in file:
                continue
            line = source.count("\n", 0, start) + 1
            found.add(Fault(file, line, start, source[start:end], new, kind))
    return tuple(sorted(found, key=lambda f: (f.start, f.old, f.new)))


def _has_index(node: ast.AST) -> bool:
    """Whether a node takes an element by a number that is written there."""
    return isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant) and type(node.slice.value) is int


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes that run when a user runs the program."""
    if _is_left_out(node):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in DECLARATIONS or (isinstance(node, ast.ClassDef) and name == "keywords"):
            continue
        children = value if isinstance(value, list) else [value]
        for child in children:
            if isinstance(child, ast.AST):
                yield from _walk(child)


def _is_left_out(node: ast.AST) -> bool:
    if isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr):
        return True
    if isinstance(node, ast.Assign):
        # ``Alias = A | B`` is a type as well.
        alias = isinstance(node.value, ast.BinOp | ast.Subscript) and _is_type(node.value)
        return alias or any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets)
    if isinstance(node, ast.If):
        return any(isinstance(n, ast.Name) and n.id in ("TYPE_CHECKING", "__name__") for n in ast.walk(node.test))
    # zip(..., strict=True) finds a fault elsewhere, and no other test of it is possible.
    if isinstance(node, ast.keyword):
        return node.arg == "strict"
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in OF_TYPES


def _is_type(value: ast.expr | None) -> bool:
    """Whether an expression reads as a type: names of classes, alone, of arguments or joined by ``|``."""
    if isinstance(value, ast.BinOp):
        return isinstance(value.op, ast.BitOr) and _is_type(value.left) and _is_type(value.right)
    if isinstance(value, ast.Subscript):
        return isinstance(value.value, ast.Name) and value.value.id in GENERICS
    name = value.attr if isinstance(value, ast.Attribute) else getattr(value, "id", "")
    return name[:1].isupper() or name in BUILT_IN or (isinstance(value, ast.Constant) and value.value is None)


def _faults_of(node: ast.AST, text: _Text) -> Iterator[tuple[int, int, str, str]]:
    """(start, end, new text, kind) of each fault at a node itself."""
    if isinstance(node, ast.BinOp):
        yield from _swap_operator(text, text.span(node.left)[1], text.span(node.right)[0])
    elif isinstance(node, ast.AugAssign):
        yield from _swap_operator(text, text.span(node.target)[1], text.span(node.value)[0])
    elif isinstance(node, ast.Compare):
        operands = [node.left, *node.comparators]
        for a, b in pairwise(operands):
            yield from _swap_operator(text, text.span(a)[1], text.span(b)[0])
    elif isinstance(node, ast.BoolOp):
        for a, b in pairwise(node.values):
            yield from _swap_operator(text, text.span(a)[1], text.span(b)[0])
    elif isinstance(node, ast.UnaryOp):
        start = text.span(node)[0]
        yield start, text.span(node.operand)[0] if _is_bare(node, text) else start + _width(node.op), "", "sign"
    elif isinstance(node, ast.Constant):
        yield from _other_constants(node, text)
    elif isinstance(node, ast.Attribute) and node.attr in AXES and isinstance(node.ctx, ast.Load):
        end = text.span(node)[1]
        yield end - 1, end, AXES[node.attr], "index"
    elif _has_index(node):
        start, end = text.span(node.slice)
        for other in {node.slice.value + 1, abs(node.slice.value - 1)}:
            yield start, end, repr(other), "index"
    elif isinstance(node, ast.Call):
        yield from _swap_function(node, text)
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield from _force(node.test, text, ("False",) if isinstance(node, ast.While) else ("True", "False"))
    elif isinstance(node, ast.comprehension):
        for test in node.ifs:
            yield from _force(test, text, ("True", "False"))


def _swap_operator(text: _Text, start: int, end: int) -> Iterator[tuple[int, int, str, str]]:
    place, word = text.operator(start, end)
    other = OPERATORS.get(" ".join(word.split()))
    if other is not None:
        yield place, place + len(word), other, "operator"


def _width(op: ast.unaryop) -> int:
    return len("not ") if isinstance(op, ast.Not) else 1


def _is_bare(node: ast.UnaryOp, text: _Text) -> bool:
    """Whether nothing but spaces stands between the operator and what it is applied to."""
    start = text.span(node)[0] + _width(node.op)
    return text.source[start : text.span(node.operand)[0]].strip() == ""


def _other_constants(node: ast.Constant, text: _Text) -> Iterator[tuple[int, int, str, str]]:
    start, end = text.span(node)
    value = node.value
    if isinstance(value, bool):
        yield start, end, str(not value), "constant"
    elif isinstance(value, int | float):
        zero = type(value)(0)
        others = {value + 1, zero} | ({2 * value} if SMALL <= abs(value) <= LARGE else set())
        for other in sorted(others - {value}):
            yield start, end, repr(other), "constant"


def _swap_function(node: ast.Call, text: _Text) -> Iterator[tuple[int, int, str, str]]:
    """Another function; a forced condition of ``dr.select``."""
    name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
    end = text.span(node.func)[1]
    if name in FUNCTIONS:
        yield end - len(name), end, FUNCTIONS[name], "function"
    if name == "select" and len(node.args) == 3:
        yield from _force(node.args[0], text, ("True", "False"))


def _force(test: ast.expr, text: _Text, values: tuple[str, ...]) -> Iterator[tuple[int, int, str, str]]:
    """A condition that always or never holds; one that also names a value is left alone."""
    if any(isinstance(n, ast.NamedExpr) for n in ast.walk(test)):
        return
    start, end = text.span(test)
    for value in values:
        if text.source[start:end] != value:
            yield start, end, value, "condition"
