"""`mivol doctor` says whether a render works, and its exit code agrees."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol import doctor, llvm, machine

OLD = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")


@pytest.mark.slow
def test_report_of_this_machine(capsys: pytest.CaptureFixture[str]) -> None:
    """The suite runs here, so a render works here."""
    assert doctor.main([]) == 0
    said = capsys.readouterr().out
    for subject in ("mivol", "Python", "Mitsuba", "LLVM", "CUDA", "llvm_ad_rgb", "cores", "memory", "kernel cache"):
        assert subject in said
    assert "Renders work here" in said


def test_no_variant_works(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(llvm, "loaded_version", lambda: None)
    monkeypatch.setattr(doctor, "_TRIAL", "import sys; sys.exit('mivol trial: it is broken')")
    assert doctor.main([]) == 1
    said = capsys.readouterr().out
    assert "FAULT llvm_ad_rgb   it is broken" in said
    assert "pip install" in said
    assert "do not work here" in said


def test_trial_that_kills_its_process_is_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_TRIAL", "import os; os.abort()")
    found = doctor._try_variant("llvm_ad_rgb")
    assert found.state == doctor.FAULT
    assert "SIGABRT" in found.value


@pytest.mark.skipif(not OLD.exists(), reason=f"{OLD} is not here to be tried")
def test_trial_finds_out_llvm_15(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel of the trial is one that LLVM 15 dies of, when nothing guards it."""
    monkeypatch.setenv(llvm.VARIABLE, str(OLD))
    monkeypatch.setattr(doctor, "_TRIAL", doctor._TRIAL.replace("import mivol\n", ""))
    assert "SIGABRT" in doctor._try_variant("llvm_ad_rgb").value


def test_an_unsupported_mitsuba_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.importlib.metadata, "version", lambda name: "3.8.0")
    findings = doctor._versions()
    assert [f.subject for f in findings if f.state == doctor.FAULT] == ["Mitsuba"]
    assert not doctor.render_works([*findings, doctor.Finding("llvm_ad_rgb", doctor.OK, "works")])


@pytest.mark.parametrize(("version", "state"), [((3, 10), "FAULT"), ((3, 11), "ok"), ((3, 13), "ok"), ((3, 14), "FAULT")])
def test_advice_for_an_unsupported_python(monkeypatch: pytest.MonkeyPatch, version: tuple[int, int], state: str) -> None:
    monkeypatch.setattr(doctor.sys, "version_info", (*version, 0))
    python = doctor._versions()[0]
    assert (python.subject, python.state, bool(python.advice)) == ("Python", state, state == doctor.FAULT)


@pytest.mark.parametrize(("major", "noted"), [(llvm.NEWEST_TESTED, False), (llvm.NEWEST_TESTED + 1, True)])
def test_an_untested_llvm_is_noted(monkeypatch: pytest.MonkeyPatch, major: int, noted: bool) -> None:
    monkeypatch.setattr(llvm, "loaded_version", lambda: (major, 99 * (not noted), 0))
    found = doctor._llvm()[0]
    assert (found.state, bool(found.advice)) == (doctor.OK, noted)


def test_cores_and_memory_are_noted_where_there_is_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """More processors than the container grants, and less than 2 GiB."""
    monkeypatch.setattr(doctor.os, "cpu_count", lambda: 8)
    monkeypatch.setattr(doctor.os, "sched_getaffinity", lambda process: range(4), raising=False)
    for cores, memory, state in ((4, 2 * 2**30, doctor.OK), (2, 2 * 2**30 - 1, doctor.NOTE)):
        monkeypatch.setattr(doctor.machine, "count_cores", lambda cores=cores: cores)
        monkeypatch.setattr(doctor.machine, "available_memory", lambda memory=memory: memory)
        first, second = doctor._resources()
        assert (first.subject, first.state, first.value) == ("cores", state, f"{cores} of 8")
        assert (second.subject, second.state, second.value) == ("memory", state, "2.0 GiB available")
        assert bool(first.advice) == bool(second.advice) == (state == doctor.NOTE)
    assert first.advice == ("Dr.Jit starts 4 threads, the container grants 2: call dr.set_thread_count(2)",)
    assert second.advice == ("the examples need 2 GiB",)
    monkeypatch.setattr(doctor.machine, "available_memory", lambda: None)
    assert [finding.subject for finding in doctor._resources()] == ["cores"]


NVIDIA_SMI = """#!/bin/sh
echo "NVIDIA A100, 470.82.01, 40960, 300, 0"
echo "NVIDIA H200, 580.65.06, 143771, 90000, 97"
echo "NVIDIA Thor, 580.65.06, [N/A], [N/A], [N/A]"
"""


def test_gpus_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An old driver, a busy card, several cards, and a card that does not tell its memory."""
    program = tmp_path / "nvidia-smi"
    program.write_text(NVIDIA_SMI)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    old, busy, silent = doctor._gpus()
    assert (old.state, busy.state, silent.state) == (doctor.FAULT, doctor.NOTE, doctor.OK)
    assert "too old: Mitsuba needs 535" in old.advice[0] and old.advice[1] == "not used; CUDA_VISIBLE_DEVICES=0 chooses it"
    assert busy.value == "NVIDIA H200, driver 580.65.06, 52.5 of 140.4 GiB free, load 97%"
    assert "another process uses it" in busy.advice[0] and busy.advice[1] == "mivol uses this one"
    assert machine.find_used_gpu(machine.list_gpus()).free == (143771 - 90000) << 20
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-1a2b")
    assert machine.find_used_gpu(machine.list_gpus()) is None
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    assert machine.list_gpus() == []
