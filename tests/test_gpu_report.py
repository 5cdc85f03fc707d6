"""The report of a GPU: parts that pass, fail, wait and lack their data, in one JSON file and one table."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from conftest import ON_A_GPU
from script_modules import load

from mivol.bench.harness.catalogue import load_study
from mivol.bench.studies.gpu import STUDY, GpuSize

report = load("gpu_report")


def part(name: str, code: str, limit: float = 60, needs: str = "") -> report.Part:
    return report.Part(name, limit, lambda variant, out: ["-c", code], needs)


def test_parts_are_run_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    parts = (
        part("table", "print('hello'); print('| a | 1 |')"),
        part("figures", "print('question?', ' a: 1', ' b: 2', ' c: 3', '{', '}', sep=chr(10))"),
        part("broken", "import os; print('last words', flush=True); os.abort()"),
        part("waiting", "import time; time.sleep(600)", limit=1),
        part("fit", "raise SystemExit", needs="nowhere"),
        dataclasses.replace(part("long", "print('long')"), is_more=True),
    )
    monkeypatch.setattr(report, "PARTS", parts)
    monkeypatch.setattr(report, "list_gpus", list)
    assert report.main(["--variant", "llvm_ad_rgb", "--out", str(tmp_path)]) == 1
    assert json.loads((tmp_path / "report.json").read_text())["date"] in (tmp_path / "report.md").read_text()
    told = json.loads((tmp_path / "report.json").read_text())
    states = {found["name"]: found["state"] for found in told["parts"]}
    assert states == {"table": "ok", "figures": "ok", "broken": "failed", "waiting": "out of time", "fit": "left out"}
    lines = {found["name"]: found["lines"] for found in told["parts"]}
    assert (lines["table"], lines["figures"]) == (["| a | 1 |"], ["question?", "a: 1", "b: 2", "c: 3"])
    assert lines["broken"] == ["last words"] and "MIVOL_DATA" in lines["fit"][0]
    assert "| waiting | out of time | 1 |" in capsys.readouterr().out
    assert report.main(["--variant", "llvm_ad_rgb", "--out", str(tmp_path), "--only", "table"]) == 0
    assert report.main(["--variant", "llvm_ad_rgb", "--out", str(tmp_path), "--only", "long"]) == 0
    assert [found["name"] for found in json.loads((tmp_path / "report.json").read_text())["parts"]] == ["long"]


def test_a_rehearsal_asks_studies_for_small_sizes_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    echo = "import sys; print('|', *sys.argv[1:], '|')"
    names = "bench", "tests", "optimize"
    parts = [report.Part(n, 60, lambda variant, out, n=n: ["-c", echo, n], amounts=("--large",)) for n in names]
    monkeypatch.setattr(report, "PARTS", parts)
    monkeypatch.setattr(report, "list_gpus", list)
    assert report.main(["--variant", "llvm_ad_rgb", "--out", str(tmp_path), "--quick"]) == 0
    said = capsys.readouterr().out
    assert "| bench --quick |" in said and "| tests |" in said and "| optimize --preset tiny |" in said
    assert "no GPU" in said and "figures mean nothing" in said and "--large" not in said
    assert report.main(["--variant", "llvm_ad_rgb", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert all(f"| {name} --large |" in said for name in names) and "figures mean nothing" not in said


def test_a_machine_without_a_gpu(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(report, "list_gpus", list)
    with pytest.raises(SystemExit):
        report.main([])
    assert "nvidia-smi finds no NVIDIA GPU here" in capsys.readouterr().err


def test_the_parts_take_12_minutes_and_their_tests_exist() -> None:
    """Questions of one study write into folders of their own; fits of the bench end within their limits."""
    assert [sum(p.limit for p in report.PARTS if p.is_more == is_more) for is_more in (False, True)] == [12 * 60, 16 * 60]
    studies = {part.name: part.command("cuda_ad_rgb", Path("out")) for part in report.PARTS}
    folders = [command[command.index("--out") + 1] for command in studies.values() if "--out" in command]
    assert len(set(folders)) == len(folders)
    limits, size = {part.name: part.limit for part in report.PARTS}, GpuSize()
    assert size.hash_seconds + 60 <= limits["chair_hash"] and size.nerf_seconds + 60 <= limits["chair_nerf"]
    for name, question in {"samples": "samples", "chair_hash": "hash", "chair_nerf": "nerf"}.items():
        assert studies[name][-2:] == ["--only", question] and question in STUDY.questions
    assert all((report.ROOT / "tests" / module).is_file() for module in ON_A_GPU)
    # Each study takes the options of its part.
    for part in report.PARTS:
        if "bench" in (command := [*studies[part.name], *part.amounts]):
            load_study(command[3]).parse(command[4:])
