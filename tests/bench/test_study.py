"""A study as a command: a study of two questions that measures nothing; its JSON, exit codes, options and refusals."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mivol.bench.harness.bars import AT_LEAST, judge, judge_agreement
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import Size, Study, amount, ask, without_arrays
from mivol.errors import MivolError

HEADER = ["size", "machine", "versions", "variant", "threads", "load_before_and_after", "seconds", "bars"]


@dataclass(frozen=True)
class ToySize(Size):
    """Amount of work."""

    height: float = amount(3.0, 2.0, "height of the toy [m]")
    colours: tuple[str, ...] = amount(("red", "blue"), doc="colours of the toy")
    parts: tuple[tuple[int, int], ...] = amount(((1, 2),), doc="no option", kind=tuple)


def measure_height(size: ToySize) -> dict:
    """How high?"""
    return {"metres": size.height, "picture": np.zeros(4), "of": {"map": np.ones(2), "place": size.name}}


def measure_width(what: str, size: ToySize) -> dict:
    if size.name == "quick":
        raise MivolError(f"{what} has no width; ask for its height.")
    return {"metres": 1.0}


def draw(answers: dict, path: Path) -> None:
    """A line; the arrays are still there."""
    assert set(answers) <= {"height", "width"}
    with new_figure(path, 2, 2) as figure:
        figure.subplots().plot([1, 2])


TOY = Study(
    "mivol.bench.studies.toy",
    "What does a toy measure?",
    ToySize,
    {"height": measure_height, "width": ask("How wide?", measure_width, "it")},
    bars=lambda question, answer: [judge(f"{question} [m]", answer["metres"], AT_LEAST, 2.0)],
    draw=draw,
    table=lambda question, answer: ["| a row |"],
    on_request=("width",),
)


def test_json_and_figure(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The printed JSON is the written JSON: header, bars, and the answers without their arrays."""
    assert TOY.run(["--quick", "--out", str(tmp_path / "made"), "--variant", variant_rgb]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert json.loads((tmp_path / "made" / "bench_toy.json").read_text()) == result
    assert list(result) == [*HEADER, "height"]
    assert result["height"] == {"metres": 2.0, "of": {"place": "quick"}}
    assert result["bars"] == [{"figure": "height [m]", "value": 2.0, "sense": AT_LEAST, "bar": 2.0, "met": True}]
    assert (result["size"], result["variant"]) == ("quick", variant_rgb)
    assert "height: How high?" in printed.err and "| a row |" in printed.err
    assert (tmp_path / "made" / "bench_toy.png").read_bytes().startswith(b"\x89PNG")


def test_exit_codes(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A missed bar is a result; means that differ, and a refusal, end with 1."""
    options = ["--out", str(tmp_path), "--variant", variant_rgb]
    assert TOY.run(["--only", "width", *options]) == 0
    assert "MISSED" in capsys.readouterr().err
    biased = replace(TOY, bars=lambda question, answer: [judge_agreement("toy", -7.0, 4.2)])
    assert biased.run(["--only", "height,width", *options]) == 1
    assert "the means differ (|z|: toy; |z|: toy)" in capsys.readouterr().err
    assert TOY.run(["--quick", "--only", "width", *options]) == 1
    assert "mivol bench toy: it has no width; ask for its height." in capsys.readouterr().err


def test_every_amount_of_work_is_an_option(capsys: pytest.CaptureFixture) -> None:
    """The name of a size lists the changes, so that results of different work are not compared."""
    size = TOY.parse(["--quick", "--height", "7", "--colours", "green", "pink"]).size
    assert size == ToySize("quick, height=7.0, colours=('green', 'pink')", 7.0, ("green", "pink"))
    assert TOY.parse([]).size == ToySize()
    assert TOY.parse([]).only == ("height",)
    assert TOY.parse(["--only", "width,height"]).only == ("width", "height")
    for options, message in ((["--only", "height,depth"], "depth is not a question"), (["--parts", "1"], "unrecognized")):
        with pytest.raises(SystemExit) as ended:
            TOY.parse(options)
        assert ended.value.code == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        TOY.parse(["--help"])
    page = capsys.readouterr().out
    assert page.startswith("usage: mivol bench toy") and "What does a toy measure?" in page
    assert "height of the toy [m] (3.0)" in page


def test_arrays_are_for_the_figure() -> None:
    answer = {"a": [1, {"b": 2}], "c": np.zeros(2), "d": {"e": np.zeros(3)}, "f": {}}
    assert without_arrays(answer) == {"a": [1, {"b": 2}], "f": {}}
