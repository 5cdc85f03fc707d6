"""A bench as a command, on a bench of two questions that measures nothing: its JSON, its exit code, its refusals."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mivol.bench.harness.bars import AT_LEAST, judge, judge_agreement
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench, without_arrays
from mivol.errors import MivolError

ROOT = Path(__file__).resolve().parents[2]
BENCHES = {
    "bench_depth": "depth",
    "bench_gradients": "gradients",
    "bench_optical_depth": "optical_depth",
    "bench_radiance_field": "radiance_field",
    "bench_representations": "representations",
    "bench_ladder": "ladder",
    "bench_multiple_scattering": "multiple_scattering",
    "bench_random_scenes": "random_scenes",
    "bench_single_scattering": "single_scattering",
    "bench_still_life": "still_life",
    "bench_tomography": "tomography",
    "storage": "storage",
}
HEADER = ["size", "machine", "versions", "variant", "threads", "load_before_and_after", "seconds", "bars"]


@dataclass(frozen=True)
class Size:
    """A size."""

    name: str


def ask_height(size: Size) -> dict:
    """How high?"""
    return {"metres": 3.0, "picture": np.zeros(4), "of": {"map": np.ones(2), "place": size.name}}


def ask_width(size: Size) -> dict:
    """How wide?"""
    if size.name == "quick":
        raise MivolError("it has no width; ask for its height.")
    return {"metres": 1.0}


def draw(answers: dict, folder: Path) -> None:
    """A line; the arrays are still there."""
    assert set(answers) <= {"height", "width"}
    with drawn(folder / "toy.png", 2, 2) as figure:
        figure.subplots().plot([1, 2])


TOY = Bench(
    name="toy",
    doc="What a toy measures.",
    questions={"height": ask_height, "width": ask_width},
    full=Size("full"),
    quick=Size("quick"),
    compare=lambda question, answer: [judge(f"{question} [m]", answer["metres"], AT_LEAST, 2.0)],
    draw=draw,
    unasked=("width",),
)


def test_json_and_figure(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """What is printed is what is written: the header, the bars, the answers without their arrays."""
    assert TOY.run(["--quick", "--out", str(tmp_path / "made"), "--variant", variant_rgb]) == 0
    said = capsys.readouterr()
    figures = json.loads(said.out)
    assert json.loads((tmp_path / "made" / "toy.json").read_text()) == figures
    assert list(figures) == [*HEADER, "height"]
    assert figures["height"] == {"metres": 3.0, "of": {"place": "quick"}}
    assert figures["bars"] == [{"figure": "height [m]", "value": 3.0, "sense": AT_LEAST, "bar": 2.0, "met": True}]
    assert (figures["size"], figures["variant"]) == ("quick", variant_rgb)
    assert "height: How high?" in said.err
    assert (tmp_path / "made" / "toy.png").read_bytes().startswith(b"\x89PNG")


def test_missed_bars_are_said_and_differing_means_end_with_1(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """A bar that is missed is a finding; means that differ make the ratios meaningless."""
    where = ["--out", str(tmp_path), "--variant", variant_rgb]
    assert TOY.run(["--only", "width", *where]) == 0
    assert "MISSED" in capsys.readouterr().err
    biased = replace(TOY, compare=lambda question, answer: [judge_agreement("toy", -7.0, 4.2)])
    assert biased.run(["--only", "height,width", *where]) == 1
    assert "the means differ (|z|: toy; |z|: toy)" in capsys.readouterr().err


def test_refusals(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A question that is none ends the command line; what a question refuses becomes one sentence."""
    assert TOY.expected(["--quick"]) == ({"size": "quick"}, ("height",))
    assert TOY.expected(["--only", "width,height"]) == ({"size": "full"}, ("width", "height"))
    with pytest.raises(SystemExit) as ended:
        TOY.run(["--only", "height,depth"])
    assert ended.value.code == 2
    assert "--only: depth is not a question; known are height, width" in capsys.readouterr().err
    assert TOY.run(["--quick", "--only", "width", "--out", str(tmp_path), "--variant", variant_rgb]) == 1
    assert "mivol bench toy: it has no width; ask for its height." in capsys.readouterr().err


def test_arrays_are_for_the_figure() -> None:
    assert without_arrays({"a": [1, {"b": 2}], "c": np.zeros(2)}) == {"a": [1, {"b": 2}]}


@pytest.mark.parametrize("script", BENCHES)
def test_scripts_only_call_their_module(script: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script imports main and ends with what it returns; ``--help`` prints what the module says of itself."""
    module = __import__(f"mivol.bench.studies.{BENCHES[script]}", fromlist=["main"])
    text = (ROOT / "scripts" / f"{script}.py").read_text()
    assert text.startswith(f'#!/usr/bin/env python3\n"""{module.__doc__.splitlines()[0]}')
    assert text.endswith(
        f"import sys\n\nfrom mivol.bench.studies.{BENCHES[script]} import main\n\n"
        'if __name__ == "__main__":\n    sys.exit(main())\n'
    )
    monkeypatch.setattr(sys, "argv", [f"scripts/{script}.py"])
    with pytest.raises(SystemExit) as ended:
        module.main(["--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"usage: {script}.py")
    assert module.__doc__.splitlines()[0] in printed


@pytest.mark.slow
def test_a_script_runs() -> None:
    """One of them as a process, in the environment of the tests: its exit code is main's."""
    command = [sys.executable, str(ROOT / "scripts" / "storage.py"), "--runs", str(ROOT / "nowhere")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "has no run.json and no field.npz" in done.stderr
    assert done.stdout == ""
