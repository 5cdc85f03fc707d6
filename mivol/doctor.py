"""Check this machine: try each variant in its own process, and give advice for each fault.

A trial compiles a kernel with ``minimum`` and a scattered gradient (fatal with LLVM 15), checks the gradient, and renders four
pixels of an absorbing cube. A cheaper check is not enough, because a bad LLVM aborts the process.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from . import llvm, machine
from .threads import run_child

OK, NOTE, FAULT = "ok", "-", "FAULT"

_MARKER = "mivol trial: "

_TRIAL = """
import math, sys
import mivol
import mitsuba as mi
import drjit as dr
try:
    mi.set_variant(sys.argv[1])
    x = dr.arange(mi.Float, 64)
    dr.enable_grad(x)
    # Entries 0 to 31 are each read twice, and 15.5 cuts off the upper half: 16 entries have the gradient 2.
    dr.backward(dr.sum(dr.minimum(dr.gather(mi.Float, x, dr.arange(mi.UInt32, 64) // 2), 15.5)))
    if dr.sum(dr.grad(x))[0] != 32:
        raise RuntimeError(f"the gradient of a gather is {dr.sum(dr.grad(x))[0]}, expected 32")
    cube = {"type": "cube", "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.0}}
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
              @ mi.ScalarTransform4f().scale(0.5), "film": {"type": "hdrfilm", "width": 2, "height": 2}}
    scene = mi.load_dict({"type": "scene", "cube": cube, "sensor": sensor, "light": {"type": "constant"},
                          "integrator": {"type": "volpath", "max_depth": 2}})
    transmittance = float(dr.mean(mi.render(scene, spp=1024).array)[0])
    # Delta tracking gives 0 or 1 for each of 4096 samples: 6 standard errors of a Bernoulli mean at exp(-2).
    if abs(transmittance - math.exp(-2)) > 6 * math.sqrt(math.exp(-2) * (1 - math.exp(-2)) / 4096):
        raise RuntimeError(f"the transmittance at optical depth 2 is {transmittance:.4f}, expected {math.exp(-2):.4f}")
except Exception as error:
    sys.exit(f"MARKER{error}")
""".replace("MARKER", _MARKER)


@dataclass(frozen=True)
class Finding:
    """One line of the report: subject, state (``ok``, ``-`` or ``FAULT``), value and advice."""

    subject: str
    state: str
    value: str
    advice: tuple[str, ...] = ()


def _versions() -> list[Finding]:
    supported = (3, 11) <= sys.version_info[:2] <= (3, 13)
    found = [
        Finding(
            "Python",
            OK if supported else FAULT,
            f"{platform.python_version()}  {sys.executable}",
            () if supported else ("use Python 3.11, 3.12 or 3.13",),
        ),
        Finding("system", OK, f"{platform.system()} {platform.release()} {platform.machine()}"),
    ]
    mitsuba = importlib.metadata.version("mitsuba")
    known = mitsuba.startswith("3.9.") and mitsuba != "3.9.0"
    value = f"{mitsuba} with Dr.Jit {importlib.metadata.version('drjit')}"
    advice = () if known else ('pip install "mitsuba>=3.9.1,<3.10"',)
    return [*found, Finding("Mitsuba", OK if known else FAULT, value, advice)]


def _mivol() -> Finding:
    from . import __version__

    return Finding("mivol", OK, f"{__version__}  {Path(__file__).parent}")


def _llvm() -> list[Finding]:
    version, path = llvm.loaded_version(), llvm.loaded_path()
    if version is None or version[0] < llvm.OLDEST:
        what = "none usable" if version is None else f"{'.'.join(map(str, version))}  {path} ({llvm.library_origin()})"
        needed = f"LLVM {llvm.OLDEST} to {llvm.NEWEST_TESTED} is needed on the CPU; use one of:"
        findings = [Finding("LLVM", FAULT, what, (needed, *llvm.list_fixes()))]
    else:
        untested = version[0] > llvm.NEWEST_TESTED
        advice = (f"newer than LLVM {llvm.NEWEST_TESTED}, the newest tested version",) if untested else ()
        findings = [Finding("LLVM", OK, f"{'.'.join(map(str, version))}  {path} ({llvm.library_origin()})", advice)]
    for library in llvm.find_libraries():
        if path is None or Path(os.path.realpath(path)) != library.path:
            findings.append(Finding("", NOTE, f"{_describe_unused(library)}  {library.path}"))
    return findings


def _describe_unused(library: llvm.Library) -> str:
    if library.path in llvm.unloadable_libraries():
        return f"also here: LLVM {library.major}, does not load ({llvm.unloadable_libraries()[library.path]})"
    return f"also here: LLVM {library.major}" + (", too old" if library.major < llvm.OLDEST else "")


def _cuda() -> list[Finding]:
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.CUDA):
        return [Finding("CUDA", NOTE, "no usable NVIDIA GPU or driver; only the cuda_ad_* variants need one"), *_gpus()]
    version = ".".join(map(str, dr.detail.cuda_version()))
    value = f"driver for CUDA {version}, compute capability {dr.detail.cuda_compute_capability()}"
    findings = [Finding("CUDA", OK, value), *_gpus()]
    optix = run_child("import ctypes; ctypes.CDLL('libnvoptix.so.1')", isolated=True)
    if optix.returncode == 0:
        return [*findings, Finding("OptiX", OK, "libnvoptix.so.1 loads")]
    advice = "install the whole NVIDIA driver (in a container: NVIDIA_DRIVER_CAPABILITIES=all); shapes are traced by it"
    return [*findings, Finding("OptiX", FAULT, "libnvoptix.so.1 does not load", (advice,))]


OLDEST_DRIVER = 535
"""Oldest NVIDIA driver that Mitsuba 3.9 supports."""

BUSY_LOAD, BUSY_MEMORY = 0.2, 0.25
"""Share of time with kernels, and share of the memory in use [1], from which a GPU counts as busy."""


def _gpus() -> list[Finding]:
    """A line for each NVIDIA GPU: an old driver, a busy card, and which of several is used."""
    gpus = machine.list_gpus()
    used, findings = machine.find_used_gpu(gpus), []
    for number, gpu in enumerate(gpus):
        advice = []
        is_old = gpu.driver.partition(".")[0].isdecimal() and int(gpu.driver.partition(".")[0]) < OLDEST_DRIVER
        if is_old:
            advice.append(f"the driver is too old: Mitsuba needs {OLDEST_DRIVER} or newer; install a newer NVIDIA driver")
        is_busy = gpu.load > BUSY_LOAD or gpu.used > BUSY_MEMORY * gpu.total
        if is_busy:
            advice.append("another process uses it (nvidia-smi lists them): wait, or choose another by CUDA_VISIBLE_DEVICES")
        if len(gpus) > 1:
            choice = "mivol uses this one" if gpu is used else f"not used; CUDA_VISIBLE_DEVICES={number} chooses it"
            advice.append(choice)
        room = f"{gpu.free / 2**30:.1f} of {gpu.total / 2**30:.1f} GiB free" if gpu.total else "memory not told"
        value = f"{gpu.name}, driver {gpu.driver}, {room}, load {gpu.load:.0%}"
        findings.append(Finding(f"GPU {number}", FAULT if is_old else NOTE if is_busy else OK, value, tuple(advice)))
    return findings


def _variants_to_try() -> list[str]:
    """Variants to try: rgb and mono variants with derivatives; CUDA variants only with a usable GPU."""
    import drjit as dr
    import mitsuba as mi

    names = [name for name in mi.variants() if name.endswith(("_ad_rgb", "_ad_mono"))]
    return [name for name in names if dr.has_backend(dr.JitBackend.CUDA) or not name.startswith("cuda")]


def _try_variant(variant: str) -> Finding:
    start = time.perf_counter()
    try:
        child = run_child(_TRIAL, variant, timeout=300.0)
    except subprocess.TimeoutExpired:
        return Finding(variant, FAULT, "no answer within 300 s", ("look for another process using all cores",))
    if child.returncode == 0:
        return Finding(variant, OK, f"renders and differentiates ({time.perf_counter() - start:.1f} s with start-up)")
    if child.returncode < 0:
        value = f"a kernel kills the process ({signal.Signals(-child.returncode).name})"
        cure = ("this LLVM is unusable; use one of:", *llvm.list_fixes()) if variant.startswith("llvm") else ()
        return Finding(variant, FAULT, value, cure)
    error = child.stderr.rpartition(_MARKER)[2].strip().splitlines() or [f"the process ended with code {child.returncode}"]
    return Finding(variant, FAULT, error[0])


def _resources() -> list[Finding]:
    count, threads = machine.count_cores(), os.cpu_count() or 1
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else threads
    advice = ()
    if count < mask:
        advice = (f"Dr.Jit starts {mask} threads, the container grants {count}: call dr.set_thread_count({count})",)
    findings = [Finding("cores", OK if not advice else NOTE, f"{count} of {threads}", advice)]
    memory = machine.available_memory()
    if memory is not None:
        small = memory < 2 * 2**30
        advice = ("the examples need 2 GiB",) if small else ()
        findings.append(Finding("memory", NOTE if small else OK, f"{memory / 2**30:.1f} GiB available", advice))
    return findings


def _kernel_cache() -> Finding:
    named, home = os.environ.get("DRJIT_CACHE_DIR"), os.environ.get("HOME")
    if not named and not home:
        advice = ("set HOME or DRJIT_CACHE_DIR; without it each process compiles every kernel again",)
        return Finding("kernel cache", NOTE, "none: HOME is not set", advice)
    folder = Path(named) if named else Path(home or "") / ".drjit"
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not os.access(existing, os.W_OK):
        return Finding("kernel cache", NOTE, f"{folder} is not writable", ("set DRJIT_CACHE_DIR to a writable folder",))
    return Finding("kernel cache", OK, f"{folder}")


def diagnose() -> list[Finding]:
    """Check everything needed for a render, and try each rgb and mono variant with derivatives in a child process.

    Returns:
        The findings in reading order.

    Cost: 2 to 5 s; up to a minute without cached kernels.
    """
    trials = [_try_variant(variant) for variant in _variants_to_try()]
    return [_mivol(), *_versions(), *_llvm(), *_cuda(), *trials, *_resources(), _kernel_cache()]


def render_works(findings: Sequence[Finding]) -> bool:
    """Whether at least one variant rendered and differentiated, and all versions are supported."""
    variants = [f for f in findings if f.subject.endswith(("_ad_rgb", "_ad_mono"))]
    versions = [f for f in findings if f.subject in ("Python", "Mitsuba")]
    return any(f.state == OK for f in variants) and all(f.state == OK for f in versions)


def format_findings(findings: Sequence[Finding]) -> list[str]:
    """The findings as lines, with their advice."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.state:<6}{finding.subject:<14}{finding.value}")
        lines += [f"{'':20}> {line}" for line in finding.advice]
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Print the report.

    Args:
        argv: command line without the program's name; the only option is ``--help``.

    Returns:
        0 if a render works, else 1.
    """
    parser = argparse.ArgumentParser(prog="mivol doctor", description="Check whether a render works on this machine.")
    parser.parse_args(argv)
    findings = diagnose()
    print("\n".join(format_findings(findings)))
    works = [f.subject for f in findings if f.state == OK and f.subject.endswith(("_ad_rgb", "_ad_mono"))]
    if render_works(findings):
        print(f"\nRenders work here, with {' and '.join(works)}.")
        return 0
    print("\nRenders do not work here: see each FAULT above.")
    return 1
