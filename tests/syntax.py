"""Syntax trees of source files, parsed once in a run: hundreds of tests ask for them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def tree_of(path: Path) -> ast.Module:
    """The tree of a file, shared by whoever asks: it is read, not changed."""
    return ast.parse(path.read_text(), str(path))
