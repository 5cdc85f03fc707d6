"""The list of mutations fits the code: every entry applies, its test exists, and every room of physics has some.

scripts/mutate.py applies them and demands red; that takes minutes, this takes none. The faults that it draws at random are
held against small files, where all that may and may not be broken is known.
"""

from __future__ import annotations

import ast
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from script_modules import load
from syntax import tree_of

ROOT = Path(__file__).resolve().parents[1]

MODULES = ("mutate", "mutation.faults", "mutation.guards", "mutation.recorder", "mutation.survivors")
mutate, faults, guards, recorder, survivors = map(load, MODULES)
ENTRIES = mutate.load_entries()

MOST_ENTRIES, LEAST_IN_ROOM = 400, 8
ROOMS_OF_PHYSICS = ("fields", "files", "optim", "phase", "photos", "points", "scene", "splatting", "tomography", "validate")
"""Beside the rooms of transport/."""


def has_logic(path: Path) -> bool:
    """Whether a module defines a function that does more than name a protocol."""
    functions = [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)]
    bodies = [[s for s in f.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))] for f in functions]
    return any(bodies)


@cache
def functions_in(path: Path) -> set[str]:
    return {n.name for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)}


@pytest.mark.parametrize("area", sorted({entry.area for entry in ENTRIES}))
def test_entries_apply(area: str) -> None:
    """One test for each area of the list: an item for each entry would cost more than the entry."""
    for entry in (entry for entry in ENTRIES if entry.area == area):
        after = mutate.broken(entry, ROOT)
        assert after != (ROOT / entry.file).read_text(), entry
        if entry.file.endswith(".py"):
            ast.parse(after, f"{entry.file}, broken by {entry.find!r} -> {entry.replace!r}")
        path, _, name = entry.test.partition("::")
        assert name.split("::")[-1].partition("[")[0] in functions_in(ROOT / path), entry


def test_mutations_are_few_and_in_every_room_of_physics() -> None:
    """At most MOST_ENTRIES, since a rename carries each; at least LEAST_IN_ROOM in each room with formulas or formats."""
    rooms = [ROOT / "mivol" / room for room in ROOMS_OF_PHYSICS]
    rooms += [path.parent for path in (ROOT / "mivol" / "transport").glob("*/__init__.py")]
    counts = {str(room.relative_to(ROOT)): sum((ROOT / e.file).is_relative_to(room) for e in ENTRIES) for room in rooms}
    assert {room: count for room, count in counts.items() if count < LEAST_IN_ROOM} == {}
    assert len(ENTRIES) <= MOST_ENTRIES


def test_every_module_of_transport_has_tests_of_its_own() -> None:
    """A file of tests that is called like it: who changes a module finds what guards it, and the tests that are cheapest."""
    modules = {path.stem for path in (ROOT / "mivol" / "transport").rglob("*.py") if has_logic(path)}
    tests = {path.stem.removeprefix("test_") for path in (ROOT / "tests").rglob("test_*.py")}
    assert sorted(modules - tests) == []


def test_a_text_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\ny = 1\n")
    with pytest.raises(ValueError, match="2 times"):
        mutate.broken(mutate.Mutation("area", "a.py", "= 1", "= 2", "t"), tmp_path)


def test_verdicts() -> None:
    """A test that passes, or that never ran, has noticed nothing; one that is skipped here may notice elsewhere."""
    assert mutate.verdict(1, "1 failed, 2 passed") == (True, "red")
    assert mutate.verdict(1, "Timeout (0:01:00)!")[0]
    assert mutate.verdict(-6, "")[0]
    assert mutate.verdict(0, "1 skipped")[0]
    assert not mutate.verdict(0, "3 passed, 1 skipped")[0]
    assert not mutate.verdict(2, "error during collection")[0]
    assert not mutate.verdict(1, "1 error in 0.1 s")[0]


@pytest.fixture
def bare_pytest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests of small checkouts run in processes of their own: loading plugins, which none needs, is most of their work."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")


@pytest.mark.slow
@pytest.mark.usefixtures("bare_pytest")
def test_the_runner_tells_red_from_green(tmp_path: Path) -> None:
    """A test that sees a mutation and one that does not, in a checkout of two files."""
    (tmp_path / "doubling.py").write_text("def double(x):\n    return 2 * x\n")
    (tmp_path / "test_doubling.py").write_text(
        "from doubling import double\ndef test_sees(): assert double(3) == 6\ndef test_blind(): assert double(0) == 0\n"
    )
    for name, expected in (("test_sees", (True, "red")), ("test_blind", (False, "STILL GREEN"))):
        entry = mutate.Mutation("area", "doubling.py", "2 * x", "3 * x", f"test_doubling.py::{name}")
        assert mutate.judge(tmp_path, entry, 60.0) == expected
    assert (tmp_path / "doubling.py").read_text() == "def double(x):\n    return 2 * x\n"


def test_changed_source_is_compiled_anew(tmp_path: Path) -> None:
    """Python takes bytecode for that of a text of equal length and second."""
    file = tmp_path / "a.py"
    file.write_text("x = 1\n")
    before = file.stat()
    mutate.change_source(file, "x = 2\n")
    assert int(file.stat().st_mtime) > int(before.st_mtime)
    assert file.read_text() == "x = 2\n"


# -- Faults at random --------------------------------------------------------------------------------------------------

ROOM = faults.read_package(ROOT, "mivol/transport")
"""A part of the package is enough: a syntax tree of all of it takes five seconds."""

SOURCE = '''"""Docstring with 1 + 2 and not this."""
import os.path as p
from typing import TYPE_CHECKING
__all__ = ["f", "g"][0:2]
if TYPE_CHECKING and 1 < 2:
    import ast
Kind = int | None
SIZE: tuple[int, 3] = 7

@decorated(5)
def f(a: int | None, b: float = 0.5) -> dict[str, 4]:
    """Docstring, a & b."""
    if not (a < SIZE and b):
        return -a * max(b.x, 3)
    name = f"{a + 1} in text, 100 %" + "1 < 2"
    π = [a // 2 for a in b if a is not None]  # a - b
    c = π[2] if b else π[0]
    return zip(name, select(π >= 1, a, ~b), strict=True)

class C(Base, frozen=True):
    pass

if __name__ == "__main__":
    f(9, 9)
'''

EXPECTED = {
    (8, "7", "8"), (8, "7", "14"), (8, "7", "0"),
    (11, "0.5", "1.5"), (11, "0.5", "1.0"), (11, "0.5", "0.0"),
    (13, "not (a < SIZE and b)", "True"), (13, "not (a < SIZE and b)", "False"), (13, "not ", ""), (13, "<", "<="),
    (13, "and", "or"),
    (14, "-", ""), (14, "*", "/"), (14, "max", "min"), (14, "x", "y"), (14, "3", "4"), (14, "3", "6"), (14, "3", "0"),
    (15, "+", "-"),
    (16, "//", "/"), (16, "2", "3"), (16, "2", "4"), (16, "2", "0"), (16, "is not", "is"), (16, "a is not None", "True"),
    (16, "a is not None", "False"),
    (17, "2", "3"), (17, "2", "1"), (17, "0", "1"), (17, "b", "True"), (17, "b", "False"),
    (18, ">=", ">"), (18, "π >= 1", "True"), (18, "π >= 1", "False"), (18, "1", "2"), (18, "1", "0"), (18, "~", ""),
}  # fmt: skip
"""(line, old, new) of every fault that SOURCE can be given; no more, whatever stands in strings and annotations."""


def test_what_can_be_broken_and_what_cannot():
    found = faults.find_faults("a.py", SOURCE)
    assert {(f.line, f.old, f.new) for f in found} == EXPECTED
    assert len(found) == len(EXPECTED)
    assert {f.kind for f in found} == {"operator", "function", "sign", "constant", "index", "condition"}


@pytest.mark.slow
def test_a_room_can_be_broken_in_many_places_and_each_fault_is_one():
    """Of 20 drawn faults each parses, changes the program, and leaves all but one line's text as it was."""
    drawn = faults.draw_faults(ROOM, 20, seed=11)
    assert len({(f.file, f.line) for f in drawn}) == 20
    for fault in drawn:
        before, after = ROOM[fault.file], fault.apply(ROOM[fault.file])
        assert ast.dump(ast.parse(after)) != ast.dump(ast.parse(before)), fault
        assert before[: fault.start] == after[: fault.start] and before.count("\n", 0, fault.start) == fault.line - 1
        rest = len(before) - fault.start - len(fault.old)
        assert before[len(before) - rest :] == after[len(after) - rest :]
        assert documentation(after) == documentation(before)


def documentation(source: str) -> list:
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef
    return [ast.get_docstring(n) for n in ast.walk(ast.parse(source)) if isinstance(n, kinds)]


def test_the_same_seed_draws_the_same_faults():
    first, again, other = (faults.draw_faults(ROOM, 20, seed) for seed in (1, 1, 2))
    assert first == again != other
    with pytest.raises(ValueError, match="2 faults are asked for; 1 lines"):
        faults.draw_faults({"a.py": "x = 1\n"}, 2, 0)


def test_lines_are_drawn_alike():
    """A line of one constant as often as one of twelve: 200 of 400, give or take 6 standard deviations of 10."""
    source = "a = 1\nb = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]\n"
    lines = [faults.draw_faults({"a.py": source}, 1, seed)[0].line for seed in range(400)]
    assert 140 <= lines.count(1) <= 260


SMALL = """import os

SIZE = 3


def scale(x, factor=2):
    'Docstring.'
    if (x
            > 0):
        return [
            x,
            factor * x,
        ]
    elif x:
        def inner(y=4):
            return y
    return x


class Box:
    edge = 1

    def grow(self, by=2):
        'Only a docstring.'

    def size(self):
        return self.edge
"""
"""A module whose statements have several lines."""


@pytest.mark.parametrize(
    ("line", "before"),
    [
        (8, ["if x > 0:"]),  # the head of a condition, without its block
        (9, ["if x > 0:"]),
        (12, ["return [x, factor * x]"]),  # a part of a statement
        (14, ["if x:"]),
        (15, ["def inner(y=4):"]),  # the outer function computes a default value of the inner
        (16, ["return y"]),
        (17, ["return x"]),
        (6, ["if x > 0:", "return y"]),  # the import computes a default value: the function stands for it, and what is in it
        (23, ["Only a docstring."]),
        (21, ["Only a docstring.", "return self.edge"]),  # and an attribute of a class: the class stands for it
        (3, ["if x > 0:", "return y", "Only a docstring.", "return self.edge"]),  # and a constant: the file stands for it
    ],
)
def test_probes_stand_before_the_statement_of_a_line(line: int, before: list[str]) -> None:
    """Nothing else changes."""
    lines = [text for text in recorder.insert_probes(SMALL, {7: line}).splitlines() if text]
    found = [after.strip(" '") for text, after in pairwise(lines) if text.strip() == "note_fault(7)"]
    assert found == before
    left = "\n".join(text for text in lines if text.strip() != "note_fault(7)")
    assert ast.dump(ast.parse(left)) == ast.dump(ast.parse(SMALL))


@pytest.fixture
def index() -> guards.Guards:
    """Five tests, of which four run line 17 of a module; one of them is in the file called like it."""
    names = ("tests/test_b.py::t", "tests/test_b.py::u", "tests/test_b.py::p[1]", "tests/test_a.py::t", "tests/test_b.py::p[2]")
    t, *others = [guards.RunTest(name, seconds) for name, seconds in zip(names, (10, 30, 40, 50, 20), strict=True)]
    runners = {fault_at(17): others, fault_at(8): [t], fault_at(17, "mivol/b.py"): [t]}
    return guards.Guards([t, *others], runners, {"mivol/a.py": ["tests/test_c.py::t"]})


def fault_at(line: int, file: str = "mivol/a.py") -> object:
    return faults.Fault(file, line, 0, "", "", "operator")


def test_the_shortest_tests_of_a_line_come_first(index) -> None:
    """The file called like the module, then short tests, then further variants of the same test."""
    found = [test.name for test in index.find_runners(fault_at(17))]
    assert found == ["tests/test_a.py::t", "tests/test_b.py::p[2]", "tests/test_b.py::u", "tests/test_b.py::p[1]"]


@pytest.mark.parametrize(("seconds", "second"), [(105.0, ["tests/test_b.py::u"]), (75.0, [])])
def test_rounds_have_a_time(index, monkeypatch: pytest.MonkeyPatch, seconds: float, second: list[str]) -> None:
    """The tests of the list come after those that run the line: many of them are slow."""
    monkeypatch.setattr(guards, "FIRST", 75.0)
    index.seconds = seconds
    first = ["tests/test_a.py::t", "tests/test_b.py::p[2]", "tests/test_c.py::t"]
    assert index.rounds(fault_at(17), SMALL) == [first, second, [], []]
    assert index.rounds(fault_at(17, "mivol/unknown.py"), SMALL) == [[], [], [], []]


def test_samples_judge_code_of_renders_that_tests_run(index) -> None:
    file = "mivol/transport/a.py"
    index.runners[fault_at(17, file)] = index.tests[:1]
    assert index.rounds(fault_at(17, file), SMALL)[3] == ["-m", "slow", guards.OF_SAMPLES]
    assert index.rounds(fault_at(17, "mivol/scene/unknown.py"), SMALL)[3] == []
    assert (ROOT / guards.OF_SAMPLES).is_file()
    assert all((ROOT / room).is_dir() for room in guards.SAMPLING)


@pytest.mark.parametrize(("line", "expected"), [(3, True), (6, True), (21, True), (8, False)])
def test_lines_of_an_import_are_judged_by_the_reference_and_the_file_of_the_module(index, line: int, expected: bool) -> None:
    """A constant, a default value and an attribute of a class; a line of a function is not of an import."""
    found = index.rounds(fault_at(line), SMALL)[0]
    assert [test in found for test in (guards.OF_IMPORTS[0], "tests/test_a.py::t")] == [expected, expected]


@pytest.mark.parametrize(
    ("file", "line", "expected"),
    [
        ("mivol/a.py", 17, ["tests/x/test_a.py"]),  # called like the module
        ("mivol/c.py", 17, ["tests/test_two.py"]),  # no recorded test runs it: files that import it
        ("mivol/b.py", 17, []),  # a recorded test runs it
    ],
)
@pytest.mark.parametrize("slow", [True, False])
def test_slow_tests_of_a_module_come_last(index, file: str, line: int, expected: list[str], slow: bool) -> None:
    index.slow, imports = (
        slow,
        "import pytest\nfrom mivol import b\nfrom mivol.c import f\n@pytest.mark.slow\ndef test(): pass\n",
    )
    index.test_files = {"tests/x/test_a.py": "@pytest.mark.slow", "tests/test_a.py": "", "tests/test_two.py": imports}
    if file == "mivol/a.py":
        which, expected = "slow", expected if slow else []
    else:  # a process that is not recorded may run the line
        which = "slow or not slow" if slow else "not slow"
    assert index.rounds(fault_at(line, file), SMALL)[2] == (["-m", which, *expected] if expected else [])


def test_a_study_may_measure_something_else():
    """Constants of studies are no faults; operators are."""
    found = {f.kind for f in faults.find_faults("mivol/bench/studies/a.py", "def f(n=3):\n    return 2 * n\n")}
    assert found == {"operator"}


@pytest.mark.slow
@pytest.mark.usefixtures("bare_pytest")
def test_a_recording_tells_which_tests_run_a_line(tmp_path: Path) -> None:
    """Lines of a shared fixture belong to every test that uses it; a test that fails is recorded like others.

    The source of a function is the one with probes: Dr.Jit compiles functions with symbolic loops from it.
    """
    (tmp_path / "scripts").symlink_to(ROOT / "scripts")
    for name, text in {
        "mivol/__init__.py": "",
        "mivol/a.py": "def f():\n    return 1\n\n\ndef g():\n    return 2\n",
        "tests/test_a.py": "import inspect\nimport pytest\nfrom mivol.a import f, g\n"
        "def test_s(): assert 'note_fault(0)' in inspect.getsource(f)\n"
        "@pytest.fixture(scope='module')\ndef two(): return g()\n"
        "def test_f(): assert f() == 2\ndef test_g(two): assert two == 2\ndef test_h(two): assert two + f() == 3\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    drawn = [fault_at(line) for line in (2, 6)]
    guards.write_faults(tmp_path / "faults", drawn)
    guards.record_suite(tmp_path, 1, tmp_path / "faults")
    index = guards.read_recording(tmp_path / "faults", {})
    names = [{t.function.rpartition("::")[2] for t in index.find_runners(fault)} for fault in drawn]
    assert names == [{"test_f", "test_h"}, {"test_g", "test_h"}]
    assert [t.name.rpartition("_")[2] for t in index.tests if t.passed] == ["s", "g", "h"]


HALVING = "def half(x):\n    return x / 2\ndef least(x):\n    return x if x < 9 else 9\n"


@pytest.fixture
def checkout(tmp_path: Path, bare_pytest: None, monkeypatch: pytest.MonkeyPatch) -> object:
    """Two copies of a checkout with a test that sees half of the module, and one that is red anyway."""
    monkeypatch.setattr(guards, "OF_IMPORTS", ())
    for name in ("broken", "untouched"):
        (tmp_path / name / "tests").mkdir(parents=True)
        (tmp_path / name / "halving.py").write_text(HALVING)
        (tmp_path / name / "tests" / "test_halving.py").write_text(
            "from halving import half, least\n"
            "def test_red_anyway(): assert half(2) == 3\n"
            "def test_half(): assert half(6) == 3 and least(9) == 9\n"
        )
    return survivors.Checkout(tmp_path / "broken", tmp_path / "untouched", 60.0)


def guards_of_halving(fault: object, *names: str) -> guards.Guards:
    """Guards by which these tests run the line of a fault."""
    tests = [guards.RunTest(f"tests/test_halving.py::{name}", 1.0) for name in names or ("test_red_anyway", "test_half")]
    return guards.Guards(tests, {fault: tests})


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "killer"), [("/", "*", "tests/test_halving.py::test_half"), ("<", "<=", "")])
def test_a_fault_is_killed_by_a_test_that_is_green_without_it(checkout, old: str, new: str, killer: str) -> None:
    """9 is returned for 9 by either comparison: that fault is no fault. A test that is red anyway kills nothing."""
    start = HALVING.index(f" {old} ") + 1
    fault = faults.Fault("halving.py", 2, start, old, new, "operator")
    index = guards_of_halving(fault)
    verdict = survivors.judge_fault(checkout, fault, index)
    assert (verdict.killed, verdict.test) == (bool(killer), killer)
    assert (checkout.broken / "halving.py").read_text() == HALVING


@pytest.mark.slow
def test_a_fault_that_nothing_can_be_imported_with_is_killed(checkout) -> None:
    fault = faults.Fault("halving.py", 1, 0, "def half(x):", "half = 1 +\\\n", "operator")
    index = guards_of_halving(fault)
    assert survivors.judge_fault(checkout, fault, index).killed


@pytest.mark.slow
def test_a_test_that_is_red_by_chance_kills_nothing(checkout) -> None:
    """It fails where it is run for the first time, in the broken copy, and in no later run."""
    mark = checkout.broken / "mark"
    text = f"from pathlib import Path\ndef test_half():\n    m = Path({str(mark)!r})\n    first = not m.exists()\n"
    for copy in (checkout.broken, checkout.untouched):
        (copy / "tests" / "test_halving.py").write_text(text + "    m.touch()\n    assert not first\n")
    fault = faults.Fault("halving.py", 2, HALVING.index("/"), "/", "*", "operator")
    index = guards_of_halving(fault, "test_half")
    assert not survivors.judge_fault(checkout, fault, index).killed
    assert mark.exists()


def test_a_test_that_does_not_end_kills(checkout) -> None:
    (checkout.broken / "tests" / "test_halving.py").write_text("import time\ndef test_half(): time.sleep(60)\n")
    hasty = survivors.Checkout(checkout.broken, checkout.untouched, 1.0)
    fault = faults.Fault("halving.py", 2, HALVING.index("/"), "/", "*", "operator")
    index = guards_of_halving(fault, "test_half")
    assert survivors.judge_fault(hasty, fault, index).test == "a test that does not end"


def test_faults_are_drawn_from_a_part_of_the_package() -> None:
    files = {fault.file for fault in mutate.draw("mivol/phase/*", 40, 3)}
    assert files and all(file.startswith("mivol/phase/") for file in files)
    with pytest.raises(ValueError, match=r"40 faults are asked for; [0-9]+ lines can be broken"):
        mutate.draw("mivol/__init__.py", 40, 3)


def test_survivors_are_counted_and_named():
    one, two = (faults.Fault("a.py", k, 0, "+", "-", "operator") for k in (1, 2))
    said = []
    verdicts = [survivors.Verdict(one, True, "tests/test_a.py::t", 1.0), survivors.Verdict(two, False, "", 2.0)]
    survivors.report(iter(verdicts), 2, said.append)
    assert said[-2:] == ["1 of 2 faults were killed (50 %)", "survived: a.py:2: operator '+' -> '-'"]
    assert "tests/test_a.py::t" in said[0] and "SURVIVED" in said[1]
