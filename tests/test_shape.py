"""The figures of tests/shape.py, on a package small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

import shape


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
