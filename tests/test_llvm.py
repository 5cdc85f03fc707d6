"""The LLVM library is chosen before Dr.Jit loads one, and an unusable one stops a render with a sentence.

Each test of an import order runs in a child process, since a process can import only once.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from pathlib import Path

import pytest
import quick_kernels

import mivol
from mivol import llvm, machine, threads

OLD = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")
needs_old = pytest.mark.skipif(not OLD.exists(), reason=f"{OLD} is not here to be refused")
SWITCH = """
import mitsuba as mi
for name in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(name)
"""


def child(code: str, llvm_path: str | None = None, library_path: Path | None = None) -> tuple[int, str, str]:
    """Run code with ``DRJIT_LIBLLVM_PATH`` as given (unset by default), and this checkout first on the path."""
    env = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    env["PYTHONPATH"] = str(Path(mivol.__file__).parents[1])
    if llvm_path is not None:
        env[llvm.VARIABLE] = llvm_path
    if library_path is not None:
        env["LD_LIBRARY_PATH"] = str(library_path)
    done = threads.run_child(code, env=env)
    return done.returncode, done.stdout.strip(), done.stderr


def library(path: Path, major: int) -> Path:
    """An empty file with the name that a library of that version has on Debian."""
    path.mkdir(parents=True, exist_ok=True)
    file = path / f"libLLVM.so.{major}.1"
    file.touch()
    return file


@pytest.mark.slow
def test_import_chooses_the_best_library_before_drjit() -> None:
    code, out, err = child("import mivol, drjit; print(drjit.detail.llvm_version()[0])\n" + SWITCH)
    assert code == 0, err
    best = llvm.rank_libraries(llvm.find_libraries())[0]
    assert int(out) == best.major


def test_import_after_mitsuba_chooses_nothing() -> None:
    """Mitsuba first: what Dr.Jit found is left alone."""
    code, out, err = child("import mitsuba, mivol; print(mivol.llvm.library_origin())")
    assert code == 0, err
    assert out == llvm.LOADED_FIRST


def test_import_needs_no_library_and_never_fails() -> None:
    code, _, err = child("import mivol, mitsuba as mi; mi.set_variant('scalar_rgb')", "/no/such/library.so")
    assert code == 0, err


def test_users_choice_is_not_overridden() -> None:
    chosen = llvm.rank_libraries(llvm.find_libraries())[0].path
    script = "import mivol, os; print(os.environ['DRJIT_LIBLLVM_PATH'], mivol.llvm.library_origin())"
    code, out, err = child(script, str(chosen))
    assert code == 0, err
    assert out == f"{chosen} {llvm.BY_USER}"


def test_missing_library_stops_the_variant_with_a_sentence() -> None:
    code, out, err = child(
        "import mivol, mitsuba as mi\n"
        "try:\n    mi.set_variant('llvm_ad_rgb')\n"
        "except mivol.MivolError as error:\n    print(mi.variant(), error)",
        "/no/such/library.so",
    )
    assert code == 0, err
    assert out.startswith("None the CPU backend (llvm_ad_rgb) has no LLVM library")
    for part in ("/no/such/library.so", "unset DRJIT_LIBLLVM_PATH", "pip install", "apt ", "dnf ", "brew ", "conda "):
        assert part in out


def test_missing_library_lets_the_next_variant_serve() -> None:
    """Mitsuba takes the first variant of a list that can be had, which an ImportError leaves possible."""
    code, out, err = child(
        "import mivol, mitsuba as mi; mi.set_variant('llvm_ad_rgb', 'scalar_rgb'); print(mi.variant())", "/no/such/file"
    )
    assert code == 0, err
    assert out == "scalar_rgb"


@pytest.mark.slow
@needs_old
def test_llvm_15_is_stopped_before_it_aborts() -> None:
    code, out, _ = child("import mivol, mitsuba as mi; mi.set_variant('llvm_ad_rgb')", str(OLD))
    assert code == 1
    code, out, err = child(
        "import mivol, mitsuba as mi\ntry:\n    mi.set_variant('llvm_ad_rgb')\nexcept ImportError as error:\n    print(error)",
        str(OLD),
    )
    assert code == 0, err
    assert "cannot use LLVM 15." in out
    assert str(OLD) in out


@needs_old
def test_llvm_15_does_abort_without_the_guard() -> None:
    """The reason for all this: should it ever stop being true, OLDEST can be lowered."""
    code, _, _ = child(
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import drjit as dr\nprint(dr.minimum(dr.arange(mi.Float, 8), 3))",
        str(OLD),
    )
    assert code < 0


@pytest.mark.slow
@needs_old
def test_variant_set_before_mivol_is_imported() -> None:
    """Import does not fail; it warns, and the check that renders make raises and says what to import first."""
    code, out, err = child(
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "import drjit as dr; assert dr.detail.llvm_version()[0] == 15\n"
        "import mivol\n"
        "try:\n    mivol.llvm.check_backend()\nexcept mivol.MivolError as error:\n    print(error)\n"
        "mi.set_variant('scalar_rgb')\n"
        "try:\n    mi.set_variant('llvm_ad_rgb')\nexcept mivol.MivolError as error:\n    print('again')",
        str(OLD),
    )
    assert code == 0, err
    assert "RuntimeWarning: the CPU backend (llvm_ad_rgb) cannot use LLVM 15." in err
    assert out.endswith("again")


def test_loaded_first_names_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "loaded_version", lambda: (15, 0, 6))
    monkeypatch.setattr(llvm, "_library_origin", llvm.LOADED_FIRST)
    with pytest.raises(llvm.LlvmError, match="import mivol before mitsuba and drjit"):
        llvm.check_backend("llvm_ad_mono")


def test_library_that_does_not_load_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "loaded_version", lambda: None)
    monkeypatch.setattr(llvm, "_library_origin", llvm.BY_DRJIT)
    monkeypatch.setattr(llvm, "_load_failures", {Path("/venv/lib/libLLVM.so.23.1"): "invalid ELF header"})
    with pytest.raises(llvm.LlvmError, match=r"/venv/lib/libLLVM\.so\.23\.1 does not load \(invalid ELF header\)"):
        llvm.check_backend("llvm_ad_rgb")


@pytest.mark.skipif(sys.platform != "linux", reason="Dr.Jit needs libatomic on Linux")
def test_lack_of_libatomic_is_said(tmp_path: Path) -> None:
    """A system without it, imitated by a broken one found first: Mitsuba cannot be imported, and mivol says why."""
    (tmp_path / "libatomic.so.1").touch()
    code, _, err = child("import mivol", library_path=tmp_path)
    assert code == 1
    assert "ImportError: Dr.Jit cannot be loaded because this system lacks libatomic.so.1" in err.splitlines()[-1]
    assert "apt install libatomic1" in err
    assert llvm.missing_system_library() is None


def test_variants_without_llvm_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "loaded_version", lambda: None)
    llvm.check_backend("scalar_rgb")
    llvm.check_backend("cuda_ad_rgb")


def test_search_reads_versions_from_names_and_ranks_them(tmp_path: Path) -> None:
    for major in (16, 19, 23, 25, 24):
        library(tmp_path / "lib", major)
    (tmp_path / "lib" / "libLLVM-14.so.1").touch()
    (tmp_path / "lib" / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (tmp_path / "lib" / "libLLVMSupport.so").touch()
    found = llvm.find_libraries([tmp_path / "lib", tmp_path / "absent"])
    assert sorted(lib.major for lib in found) == [14, 16, 19, 23, 24, 25]
    usable = [23, 19] if llvm.OLDEST == 17 else [23, 19, 16]
    assert [lib.major for lib in llvm.rank_libraries(found)] == [*usable, 24, 25]


def test_search_asks_a_library_without_a_version_in_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = llvm.rank_libraries(llvm.find_libraries())[0]
    (tmp_path / "libLLVM.so").symlink_to(real.path)
    (tmp_path / "libLLVM-git.so").write_text("not a library")
    monkeypatch.setattr(llvm, "_stated_major", lambda path: None)
    assert llvm.find_libraries([tmp_path]) == [real]


def test_ensure_passes_over_a_library_that_does_not_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = llvm.rank_libraries(llvm.find_libraries())[0]
    broken = library(tmp_path, 23)
    monkeypatch.setattr(llvm, "find_libraries", lambda: [llvm.Library(broken, 23), real])
    monkeypatch.setattr(llvm, "_load_failures", {})
    monkeypatch.setattr(llvm, "_library_origin", llvm.BY_DRJIT)
    monkeypatch.setenv(llvm.VARIABLE, "")
    monkeypatch.delitem(sys.modules, "drjit")
    llvm.choose_library()
    assert os.environ[llvm.VARIABLE] == str(real.path)
    assert llvm.library_origin() == llvm.BY_MIVOL
    assert list(llvm.unloadable_libraries()) == [broken]


def test_one_thread_owns_drjit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_owner", None)
    threads.check_one_thread()
    said: list[str] = []

    def intrude() -> None:
        try:
            threads.check_one_thread()
        except mivol.MivolError as error:
            said.append(str(error))

    viewer = threading.Thread(target=intrude, name="viewer")
    viewer.start()
    viewer.join()
    assert len(said) == 1
    assert "'viewer'" in said[0]
    assert "gradients" in said[0]
    threads.check_one_thread()


def test_an_owner_that_waits_lends_drjit(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a while: the owner has it again afterwards."""
    monkeypatch.setattr(threads, "_owner", None)
    threads.check_one_thread()
    owners: list[threading.Thread | None] = []

    def differentiate() -> None:
        with threads.lend_ownership():
            threads.check_one_thread()
            owners.append(threads._owner)
        owners.append(threads._owner)

    helper = threading.Thread(target=differentiate)
    helper.start()
    helper.join()
    assert owners == [helper, threading.current_thread()]


def test_the_next_thread_may_follow_one_that_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_owner", None)
    first = threading.Thread(target=threads.check_one_thread)
    first.start()
    first.join()
    threads.check_one_thread()


def test_a_child_does_not_import_from_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('a file of the user was imported')")
    monkeypatch.chdir(tmp_path)
    assert threads.run_child("import numpy").returncode == 0


def test_a_fork_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_pid", os.getpid() - 1)
    with pytest.raises(mivol.MivolError, match="forked"):
        threads.check_one_thread()


def test_machine_limits_of_a_control_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    free = machine.available_memory()
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("600000\n")
    (tmp_path / "memory.stat").write_text("anon 500000\ninactive_file 100000\n")
    assert machine.count_cores() == 1
    assert free is None or machine.available_memory() == 500000


FAKED = {
    "linux": ("usr/lib/llvm-19/lib/libLLVM.so.19.1", "usr/lib64/llvm18/lib64/libLLVM-18.so", "env/lib/libLLVM.so.20.1"),
    "darwin": ("opt/homebrew/opt/llvm@19/lib/libLLVM.dylib", "usr/local/opt/llvm/lib/libLLVM.dylib", "env/lib/libLLVM.dylib"),
    "win32": ("programs/LLVM/bin/LLVM-C.dll", "local/LLVM/bin/LLVM-C.dll", "conda/Library/bin/LLVM-C.dll"),
}


@pytest.mark.parametrize("system", FAKED)
def test_search_knows_where_each_system_keeps_libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str) -> None:
    """A tree as that system has it: every library in it is found, and nothing of the other systems'."""
    for names in FAKED.values():
        for name in names:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).touch()
    monkeypatch.setattr(llvm, "probe_version", lambda path: (19, ""))
    variables = {"ProgramFiles": tmp_path / "programs", "LOCALAPPDATA": tmp_path / "local", "CONDA_PREFIX": tmp_path / "conda"}
    environment = {name: str(path) for name, path in variables.items()}
    folders = llvm.library_folders(system, "x86_64", tmp_path, tmp_path / "env", environment)
    found = {lib.path.relative_to(tmp_path).as_posix() for lib in llvm.find_libraries(folders)}
    assert set(FAKED[system]) <= found
    own = {"env/lib/libLLVM.so.20.1", "env/lib/libLLVM.dylib"}
    assert found - set(FAKED[system]) <= own


def test_the_pool_changes_once_its_kernels_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    import drjit as dr

    done: list[object] = []
    monkeypatch.setattr(dr, "sync_thread", lambda: done.append("ended"))
    monkeypatch.setattr(dr, "set_thread_count", done.append)
    threads.set_thread_count(3)
    assert done == ["ended", 3]


# -- The tests' own kernels ----------------------------------------------------------------------------------------------------


def optimise(text: bytes) -> str:
    """An LLVM module after the passes that Dr.Jit asks for, run by the library that Dr.Jit loaded."""
    lib = ctypes.CDLL(os.environ[llvm.VARIABLE])
    for name in ("ContextCreate", "CreateMemoryBufferWithMemoryRangeCopy", "RunPasses", "CreatePassBuilderOptions"):
        getattr(lib, f"LLVM{name}").restype = ctypes.c_void_p
    lib.LLVMPrintModuleToString.restype = ctypes.c_char_p
    lib.LLVMCreateMemoryBufferWithMemoryRangeCopy.argtypes = ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p
    context, module, options = ctypes.c_void_p(lib.LLVMContextCreate()), ctypes.c_void_p(), lib.LLVMCreatePassBuilderOptions()
    buffer = ctypes.c_void_p(lib.LLVMCreateMemoryBufferWithMemoryRangeCopy(text, len(text), b"sum"))
    assert not lib.LLVMParseIRInContext(context, buffer, ctypes.byref(module), None)
    assert not lib.LLVMRunPasses(module, b"default<O2>", None, ctypes.c_void_p(options))
    return lib.LLVMPrintModuleToString(module).decode()


def test_kernels_of_tests_are_compiled_quickly_and_kept_apart(cpu_back_end: None) -> None:
    """LLVM leaves a sum with 0 as it is, and a kernel that no run has seen adds a file to the folder of the tests."""
    import drjit as dr
    import mitsuba as mi

    if not quick_kernels.can_leave_out(os.environ[llvm.VARIABLE]):
        pytest.skip("kernels are optimised: MIVOL_TESTS asks for it, or LLVM is old")
    assert "add i32" in optimise(b"define i32 @sum(i32 %x) {\n  %y = add i32 %x, 0\n  ret i32 %y\n}\n")
    folder = Path(os.environ["DRJIT_CACHE_DIR"])
    before = set(folder.iterdir())
    dr.eval(dr.arange(mi.Float, 3) * dr.opaque(mi.Float, 2.0) + int.from_bytes(os.urandom(3)) / 7)
    assert set(folder.iterdir()) > before and folder == quick_kernels.folder
