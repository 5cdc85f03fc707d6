"""A study as a command, and the harness of the studies: contestants, timings, contests, bars, agreement, figures, JSON."""

from __future__ import annotations

import json
import math
import os
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from scipy import stats
from tiny_experiment import refused, run

from mivol.bench.harness import catalogue, contests
from mivol.bench.harness.contests import (
    FALSE_ALARM,
    Contest,
    Stopwatch,
    Timing,
    compare_means,
    compete,
    find_samples,
    finite_or_none,
    mean_of_pixels,
    mean_of_rounds,
    race,
    time_ratio,
)
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import (
    AT_LEAST,
    AT_MOST,
    Promise,
    Size,
    Study,
    SweptQuestion,
    amount,
    ask,
    find_disagreements,
    judge,
    judge_agreement,
    judge_promises,
    say_row,
    without_arrays,
)
from mivol.errors import MivolError
from mivol.report.figures import STYLE
from mivol.validate.statistics import Estimate

HEADER = ["size", "machine", "versions", "date", "variant", "threads", "load_before_and_after", "seconds", "bars"]


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
    promises={name: [Promise(f"{name} [m]", ("metres",), AT_LEAST, 2.0)] for name in ("height", "width")},
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
    biased = replace(TOY, compare=lambda question, answer: [judge_agreement("toy", -7.0, 4.2)])
    assert biased.run(["--only", "height,width", *options]) == 1
    assert "the means differ (|z|: toy; |z|: toy)" in capsys.readouterr().err
    assert TOY.run(["--quick", "--only", "width", *options]) == 1
    assert "mivol bench toy: it has no width; ask for its height." in capsys.readouterr().err


def test_only_questions_without_times_go_to_a_cluster(capsys: pytest.CaptureFixture) -> None:
    """A refusal before workers start, which names the studies that take a cluster, and no other."""
    assert TOY.run(["--cluster", "local:1"], lambda study, args: pytest.fail("workers were started")) == 1
    said = capsys.readouterr().err
    assert "mivol bench toy: height measures times or memory of this machine" in said
    for name in catalogue.study_names():
        kinds = {isinstance(question, SweptQuestion) for question in catalogue.load_study(name).questions.values()}
        assert kinds == {name in said.rpartition("which")[2]}, name


def test_pieces_of_a_question_on_workers(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer of workers that finish in another order is the answer of this process, order included."""
    squares = SweptQuestion(
        "How large?",
        lambda size: [3, 1, 2],
        lambda piece, size: {"square": piece**2 * size.height},
        lambda size, found: {"metres": size.height, "squares": list(found.items())},
    )
    toy = replace(TOY, questions={"height": squares}, promises={}, on_request=())
    pool = SimpleNamespace(
        describe=lambda: "3 workers",
        run=lambda units: ((unit.key, unit.function(None, *unit.args)) for unit in sorted(units, key=lambda unit: unit.key)),
    )
    monkeypatch.setattr(catalogue, "load_study", lambda name: toy)
    options, answers = ["--out", str(tmp_path), "--variant", variant_rgb], []
    for more in ([], ["--cluster", "local:3"]):
        assert toy.run([*options, *more], lambda study, args: nullcontext(partial(catalogue.answer_on, pool, study.name))) == 0
        said = capsys.readouterr()
        answers.append(json.loads(said.out)["height"])
    assert answers[0] == answers[1]
    assert answers[0]["squares"] == [[3, {"square": 27.0}], [1, {"square": 3.0}], [2, {"square": 12.0}]]
    assert "3 workers, 3 of 3 pieces" in said.err


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


def test_a_bar_that_is_reached_is_met() -> None:
    assert [judge("x", value, AT_LEAST, 2.0)["met"] for value in (1.9, 2.0)] == [False, True]
    assert [judge("x", value, AT_MOST, 2.0)["met"] for value in (2.0, 2.1)] == [True, False]


def test_means_that_differ_are_named(capsys: pytest.CaptureFixture) -> None:
    """Either sign counts, and so does a difference without noise; a missed bar does not. Means that agree are not printed."""
    rows = [judge_agreement("a", -1.0, 2.0), judge_agreement("b", -3.0, 2.0), judge_agreement("c", None, 2.0)]
    assert find_disagreements([*rows, judge("speed", 1.0, AT_LEAST, 9.0)]) == ["|z|: b", "|z|: c"]
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    printed = capsys.readouterr().err
    assert "|z|: a" not in printed
    assert "|z|: b: 3, bar at most 2: MISSED" in printed


def test_promises_find_their_figures() -> None:
    """A star stands for every key; a figure that the answer lacks or that is None has no bar."""
    answer = {"cost": {"a": {"b": 2.0}, "c": {"b": 5.0}, "d": {"b": None}}, "rate": 3e6}
    promises = [
        Promise("cost of {}", ("cost", "*", "b"), AT_MOST, 4),
        Promise("rate [M/s]", ("rate",), AT_LEAST, 4, 1e-6),
        Promise("speed", ("speed", "*"), AT_LEAST, 1),
    ]
    bars = [(bar["figure"], bar["value"], bar["met"]) for bar in judge_promises(promises, answer)]
    assert bars == [("cost of a", 2, True), ("cost of c", 5, False), ("rate [M/s]", pytest.approx(3), False)]


def test_rows_of_progress_have_three_digits(capsys: pytest.CaptureFixture) -> None:
    say_row("smoke", variance_x_time=61.63, z=None)
    assert capsys.readouterr().err == "  smoke: variance x time 61.6, z none\n"


def test_pixels_that_share_their_noise_are_not_taken_for_many() -> None:
    """The same number in all pixels of a round: the error is that of 8 numbers, not of 16000."""
    rng = np.random.default_rng(6)
    shared = np.repeat(rng.normal(10, 1, (8, 1)), 2000, axis=1)
    result = mean_of_pixels(shared)
    assert result.var == pytest.approx(np.var(shared[:, 0], ddof=1) / 8)
    assert result.dof == 7


def test_the_noisiest_pixels_have_the_degrees_of_freedom() -> None:
    """Rounds alternate in sign so that their means hide the noise: 50 equal pixels of 6 rounds have 250 degrees of freedom, one
    pixel that outweighs 49 others has 5."""
    signs = np.where(np.add.outer(np.arange(6), np.arange(50)) % 2, 1.0, -1.0)
    equal = mean_of_pixels(10 + signs)
    assert equal.var == pytest.approx(6 / 5 / 6 / 50)
    assert equal.dof == pytest.approx(250)
    one = np.zeros(50)
    one[3], one[4] = 1.0, 1.0
    assert mean_of_pixels(10 + signs * (one + 1e-9)).dof == pytest.approx(10)


def test_bounds_are_those_of_student() -> None:
    """4 and 9 values of one variance: the bound is t's at the degrees of freedom that Welch's formula gives by hand."""
    a, b = Estimate(1.0, 0.25, 3), Estimate(2.0, 0.1, 8)
    result = compare_means(a, b, 1)
    dof = 0.35**2 / (0.25**2 / 3 + 0.1**2 / 8)
    assert result["z"] == pytest.approx(-1 / math.sqrt(0.35))
    assert result["z_bound"] == pytest.approx(-stats.t.ppf(FALSE_ALARM / 2, dof), rel=1e-6)
    assert result["percent"] == pytest.approx(-50)
    assert result["standard_error_percent"] == pytest.approx(50 * math.sqrt(0.35))


def test_means_of_rounds() -> None:
    assert mean_of_rounds(np.array([1.0, 3.0])) == Estimate(2.0, 1.0, 1)


def test_what_json_cannot_say_is_none() -> None:
    result = compare_means(Estimate(1.0, 0.0, 3), Estimate(0.0, 0.0, 3), 1)
    assert (result["z"], result["percent"], result["standard_error_percent"]) == (None, None, None)
    assert finite_or_none(math.inf) is None and finite_or_none(2) == 2.0
    without_noise = compare_means(Estimate(1.0, 0.0, 5.0), Estimate(2.0, 0.0, 5.0), 1)
    assert without_noise["z"] is None and without_noise["percent"] == pytest.approx(-50)


@pytest.mark.parametrize(("a_sample", "a_call", "expected"), [(0.01, 0, 64), (1.0, 0, 4), (1e-9, 0, 4096), (0.012, 0.1, 64)])
def test_samples_for_a_time(
    monkeypatch: pytest.MonkeyPatch, variant_rgb: str, a_sample: float, a_call: float, expected: int
) -> None:
    """The largest power of two between 4 and 4096 that takes 1 s by a clock of the test, with the fixed cost of a call."""
    now = [0.0]
    monkeypatch.setattr(contests.time, "process_time", lambda: now[0])

    def render(seed: int, spp: int) -> mi.Float:
        now[0] += a_call + a_sample * spp
        return mi.Float(0)

    assert find_samples(render, 1.0) == expected


def test_every_call_has_its_own_seed(variant_rgb: str) -> None:
    """12 samples: 12, 3 and 1 (not 0) by level. No seed is used twice, and another seed of the contest moves all of them."""
    calls: list[tuple] = []
    methods = {name: lambda seed, spp, name=name: calls.append((name, seed, spp)) or mi.Float(seed) for name in ("a", "b")}
    contest = compete(methods, 2, 1.0, 12, levels=(1, 4, 16))
    assert contest.spp == {(name, level): n for name in ("a", "b") for level, n in ((1, 12), (4, 3), (16, 1))}
    assert {(name, spp) for name, _, spp in calls} == {(name, spp) for name, _ in contest.spp for spp in (12, 3, 1)}
    seeds = {seed for _, seed, _ in calls}
    assert len(seeds) == len(calls) == 18
    assert len(contest.results("a", 4)) == 2
    calls.clear()
    compete(methods, 2, 1.0, 12, levels=(1, 4, 16), seed=3)
    assert {seed - 300_000 for _, seed, _ in calls} == seeds
    assert compete(methods, 2, 1.0, 12).spp == {("a", 1): 12, ("b", 1): 12}


def test_variances_and_ratios_of_times() -> None:
    """Deviations of 1 and 2 in four rounds (variances 4/3 and 16/3), three times the time, five times the processor time."""
    swing = np.array([-1.0, 1, -1, 1])[:, None]
    slow, fast = Timing({}, [3.0] * 4, [5.0] * 4, list(7 + 2 * swing)), Timing({}, [1.0] * 4, [1.0] * 4, list(7 + swing))
    contest = Contest({("slow", 1): slow, ("fast", 1): fast}, {})
    assert contest.variances("slow") == pytest.approx(16 / 3) and contest.variances("fast") == pytest.approx(4 / 3)
    assert contest.time_ratios("slow", "fast") == {"time": 3, "processor_time": 5}


def test_contestants_take_turns(variant_rgb: str) -> None:
    """Each is called once uncounted, with the number 0, then in every round, in another order than in the round before."""
    calls = []
    contestants = {name: lambda k, name=name: calls.append((k, name)) or mi.Float(k) for name in "abc"}
    result = race(contestants, 3, keep=True)
    assert calls[:3] == [(0, "a"), (0, "b"), (0, "c")]
    assert ["".join(name for k, name in calls if k == number) for number in (1, 2, 3)] == ["bca", "cab", "abc"]
    assert [np.ravel(r).tolist() for r in result["b"].results] == [[1], [2], [3]]
    assert len(result["c"].seconds) == len(result["c"].processor) == 3


def test_first_calls_count_their_kernels(variant_rgb: str) -> None:
    """A kernel that neither this process nor the cache on disk has seen: it holds a number that is new in each run."""
    new = int.from_bytes(os.urandom(3), "big") / 2**24
    x = dr.arange(mi.Float, 1000)
    dr.eval(x)
    first = contests.time_first_call(lambda _: dr.sin(x) * new + dr.cos(x))
    assert set(first) == {"seconds", "compile_seconds", "kernels_compiled", "kernels_from_disk"}
    assert first["kernels_compiled"] == 1
    assert contests.time_first_call(lambda _: dr.sin(x) * new + dr.cos(x))["kernels_compiled"] == 0


def test_first_calls_add_up_what_the_compiler_took(monkeypatch: pytest.MonkeyPatch, variant_rgb: str) -> None:
    """Milliseconds of Dr.Jit; kernels that were known or found on disk are not compiled, and other entries are no kernels."""
    jit, other = dr.KernelType.JIT, next(kind for kind in dr.KernelType if kind != dr.KernelType.JIT)
    kernel = {"type": jit, "codegen_time": 200.0, "backend_time": 300.0, "cache_hit": False, "cache_disk": False}
    result = [kernel, {**kernel, "cache_hit": True, "cache_disk": True}, {**kernel, "type": other}]
    monkeypatch.setattr(dr, "kernel_history", lambda: result)
    first = contests.time_first_call(lambda _: mi.Float(1))
    assert (first["compile_seconds"], first["kernels_compiled"], first["kernels_from_disk"]) == (1.0, 1, 1)


def test_ratios_are_medians_of_rounds() -> None:
    """2 in two rounds and 10 in one: neither the mean nor the ratio of medians."""
    slow = Timing({}, [2.0, 40.0, 60.0], [3.0, 3.0, 3.0])
    fast = Timing({}, [1.0, 20.0, 6.0], [1.0, 1.0, 3.0])
    assert time_ratio(slow, fast) == 2
    assert time_ratio(slow, fast, "processor") == 3
    report = slow.report(80, "rays")
    assert (report["seconds_median"], report["seconds_min"], report["rays_per_second_median"]) == (40, 2, 2)
    assert report["rays_per_second_best"] == 40


def test_a_stopwatch_adds_up_its_blocks(monkeypatch: pytest.MonkeyPatch, variant_rgb: str) -> None:
    """What stands between two blocks is not counted."""
    now = [0.0]
    monkeypatch.setattr(contests.time, "process_time", lambda: 2 * now[0])
    monkeypatch.setattr(contests.time, "perf_counter", lambda: now[0])
    watch = Stopwatch()
    for inside, outside in ((1.0, 100.0), (2.0, 100.0)):
        with watch:
            now[0] += inside
        now[0] += outside
    assert (watch.seconds, watch.processor) == (3.0, 6.0)


def test_the_fastest_call_counts() -> None:
    """Three calls, of 5, 2 and 4 seconds."""
    clock = iter([0.0, 5.0, 10.0, 12.0, 20.0, 24.0])
    calls = []
    assert contests.fastest(lambda: calls.append(0), lambda: next(clock)) == 2
    assert len(calls) == 3


def test_peak_memory_of_a_call(variant_rgb: str) -> None:
    """An array of 4 MB, which is freed when the call ends."""
    assert contests.peak_bytes(lambda: dr.eval(dr.arange(mi.Float, 1 << 20) + 1)) >= 4 << 20


def test_a_figure_is_written_when_its_block_ends(tmp_path: Path) -> None:
    """In the style of the reports, with labels 1, 3, 10, ... and their unit on an axis of ratios."""
    path = tmp_path / "a.png"
    with new_figure(path, 3, 2) as figure:
        axes = figure.subplots()
        axes.loglog([1, 30], [1, 2])
        use_plain_ticks(axes.xaxis, "×")
        assert axes.title.get_fontsize() == STYLE["axes.titlesize"]
        figure.canvas.draw()
        labels = [label.get_text() for label in axes.get_xticklabels()]
        assert not path.exists()
    assert {"1×", "3×", "10×", "30×"} <= set(labels)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_block_that_fails_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), new_figure(tmp_path / "a.png", 1, 1):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_every_module_is_a_study(capsys: pytest.CaptureFixture) -> None:
    """The list has a question for each study, and wrong options are refused in the name of the verb."""
    assert run("bench") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == catalogue.study_names()
    assert len(lines) > 12 and all("?" in line for line in lines)
    for name in catalogue.study_names():
        study = catalogue.load_study(name)
        assert study.name == name and set(study.on_request) < set(study.questions)
        assert all(question.__doc__ for question in study.questions.values())
        with pytest.raises(SystemExit):
            run("bench", name, "--wrong")
        assert capsys.readouterr().err.startswith(f"usage: mivol bench {name} [-h]")


def write(path: Path, seconds: float, size: str = "quick") -> Path:
    walk = {"rate": 10.0, "cost": [seconds, 1.0], "on": True}
    path.write_text(json.dumps({"size": size, "seconds": 3.0, "machine": {"cores": 2}, "walk": walk}))
    return path


def test_changes_since_an_older_result(tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study that writes a fixed result. A result of another size or of other questions is refused before any measurement."""
    runs = []

    class FixedStudy:
        stem = "new"

        def parse(self, argv: list[str]) -> SimpleNamespace:
            return SimpleNamespace(size=SimpleNamespace(name="quick"), only=("walk", "run"), out=tmp_path)

        def run(self, argv: list[str], open_cluster: object = None) -> int:
            runs.append(argv)
            write(tmp_path / "new.json", 4.0)
            return 0

    monkeypatch.setattr(catalogue, "load_study", lambda name: FixedStudy())
    old = write(tmp_path / "old.json", 2.0)
    options = ["bench", "depth", "--quick", "--compare", old, "--lines", "8"]
    assert run(*options) == 0
    assert capsys.readouterr().err == "walk.cost.0: 2 -> 4 (x 2)\n"
    write(old, 4.1)
    assert run(*options) == 0
    assert "no figure has changed by 10% or more" in capsys.readouterr().err
    assert runs == [["--quick", "--lines", "8"]] * 2
    write(old, 2.0, "full")
    assert "the size of the older result is full, and the size of this run is quick" in refused(capsys, *options)
    old.write_text('{"size": "quick", "swim": {}}')
    assert "answers no question of depth in this run (walk, run)" in refused(capsys, *options)
    assert len(runs) == 2


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert 'did you mean "depth"' in refused(capsys, "bench", "deph")
    for text in ("[1]", "{", "[" * 100000):
        (tmp_path / "old.json").write_text(text)
        assert_refused("not the result of a study", catalogue.read_result, tmp_path / "old.json")


def test_the_largest_change_comes_first() -> None:
    """Numbers of the machine and of the run are not compared; the same words inside a question are."""
    before, now = {"size": "q", "a": 1.0, "b": 1.0, "c": 1.0, "d": 0.0}, {"size": "q", "a": 1.2, "b": 0.1, "c": 1.05, "d": 3.0}
    assert catalogue.find_changes(before, now) == ["b: 1 -> 0.1 (x 0.1)", "a: 1 -> 1.2 (x 1.2)"]
    own = {"machine": {"cores": 2}, "versions": {"a": 1}, "date": "a", "threads": 2, "load_before_and_after": [1]}
    own |= {"seconds": 3, "bars": [4]}
    walk = {"seconds": 2.0, "on": True, "name": "x", "costs": [1, {"machine": 5}]}
    numbers = catalogue.list_numbers(own | {"walk": walk})
    assert numbers == [("walk.seconds", 2.0), ("walk.costs.0", 1.0), ("walk.costs.1.machine", 5.0)]
