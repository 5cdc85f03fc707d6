"""The compiler of the CPU back end: find an LLVM library for Dr.Jit, and refuse to render without a usable library.

Conventions. Dr.Jit loads LLVM during its import, from ``DRJIT_LIBLLVM_PATH`` if set, so :func:`choose_library` runs first. It
never overrides a choice of the user and never raises, because CUDA needs no LLVM. :func:`check_backend` raises. Dr.Jit 1.5
refuses LLVM 14 and accepts LLVM 15 and 16; on x86-64 both abort the process at the first ``minimum``, because their code
generator cannot select ``llvm.minimum``.
"""

from __future__ import annotations

import ctypes
import importlib.abc
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from .errors import MivolError
from .threads import run_child

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST = 15 if platform.machine() in ("arm64", "aarch64") else 17
NEWEST_TESTED = 23

BY_USER = f"named by {VARIABLE}"
BY_MIVOL = "chosen by mivol"
BY_DRJIT = "chosen by Dr.Jit's own search"
LOADED_FIRST = "chosen by Dr.Jit, which was imported before mivol"

_library_origin = BY_DRJIT
_load_failures: dict[Path, str] = {}


_INSTALL = (
    ('pip install "karellen-llvm-core>=19,<24"', "Linux x86-64, no root needed"),
    ("sudo apt install libllvm19", "Debian 12 and 13, Ubuntu 24.04; else the newest libllvmNN that apt knows"),
    ("sudo dnf install llvm-libs", "Fedora, RHEL 9"),
    ("brew install llvm", "macOS"),
    ("conda install -c conda-forge libllvm20", "into the active conda environment"),
    (f"export {VARIABLE}=/path/to/libLLVM.so.19.1", "a library of your own"),
    ("use a cuda_ad_* variant", "an NVIDIA GPU; needs no LLVM"),
)


NAMES = ("libLLVM[-.]*so*", "libLLVM*.dylib", "LLVM-C.dll")
"""File names of the library on Linux, macOS and Windows."""


class LlvmError(MivolError, ImportError):
    """An llvm variant is requested and no LLVM library works."""


class Library(NamedTuple):
    """An LLVM library on disk, with its major version."""

    path: Path
    major: int


def library_folders(system: str, machine: str, root: Path, prefix: Path, environment: Mapping[str, str]) -> list[Path]:
    """List the usual folders of LLVM libraries.

    Args:
        system: ``sys.platform``.
        machine: ``platform.machine()``.
        root: root of the file system.
        prefix: folder of the Python environment.
        environment: environment variables; ``CONDA_PREFIX`` and, on Windows, ``ProgramFiles`` and ``LOCALAPPDATA`` are used.

    Returns:
        Folders in search order; folders may not exist.
    """
    bases = [prefix, *([Path(conda)] if (conda := environment.get("CONDA_PREFIX")) else [])]
    if system == "win32":
        programs = [Path(environment[name]) for name in ("ProgramFiles", "LOCALAPPDATA") if environment.get(name)]
        return [*(base / "Library" / "bin" for base in bases), *(folder / "LLVM" / "bin" for folder in programs)]
    own = [base / "lib" for base in bases]
    if system == "darwin":
        brews = [root / "opt/homebrew/opt", root / "usr/local/opt"]
        return [*own, *(brew / "llvm/lib" for brew in brews), *(lib for b in brews for lib in sorted(b.glob("llvm@*/lib")))]
    fixed = [root / f"usr/lib/{machine}-linux-gnu", root / "usr/lib64", root / "usr/local/lib"]
    return [*own, *fixed, *sorted([*root.glob("usr/lib/llvm-*/lib"), *root.glob("usr/lib64/llvm*/lib*")])]


def _usual_folders() -> list[Path]:
    return library_folders(sys.platform, platform.machine(), Path("/"), Path(sys.prefix), os.environ)


def _stated_major(path: Path) -> int | None:
    found = re.match(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
    return int(found[1]) if found else None


def probe_version(path: Path | str) -> tuple[int | None, str]:
    """Load a library in a child process, safe from crashes, and read its version.

    Returns:
        The major version and an empty string, or None and the error.
    """
    code = (
        "import ctypes, sys\n"
        "lib = ctypes.CDLL(sys.argv[1])\n"
        "v = [ctypes.c_uint() for _ in range(3)]\n"
        "lib.LLVMGetVersion(*map(ctypes.byref, v))\n"
        "print(v[0].value)\n"
    )
    try:
        child = run_child(code, str(path), timeout=30.0, isolated=True)
    except (OSError, subprocess.SubprocessError) as error:
        return None, str(error)
    if child.returncode == 0:
        return int(child.stdout), ""
    if "LLVMGetVersion" in child.stderr:
        return None, "the file is older than LLVM 16, or not an LLVM library"
    last = child.stderr.strip().splitlines()[-1:] or [f"loading it ends the process with code {child.returncode}"]
    return None, last[0].removeprefix("OSError: ")


def find_libraries(folders: Iterable[Path] | None = None) -> list[Library]:
    """Find all LLVM libraries in the usual folders: this environment, conda, system, Homebrew.

    The version comes from the file name, or else from the library, loaded in a child process.

    Args:
        folders: folders to search; None: the usual folders.

    Returns:
        One entry for each real file, in search order.
    """
    found: dict[Path, Library] = {}
    for folder in _usual_folders() if folders is None else folders:
        for path in sorted(path for name in NAMES for path in folder.glob(name)):
            real = Path(os.path.realpath(path))
            if real in found or not real.is_file():
                continue
            major = _stated_major(real) or probe_version(real)[0]
            if major is not None:
                found[real] = Library(real, major)
    return list(found.values())


def rank_libraries(libraries: Sequence[Library]) -> list[Library]:
    """Sort the usable libraries, best first: tested versions from the newest, then untested versions from the oldest."""
    tested = [lib for lib in libraries if OLDEST <= lib.major <= NEWEST_TESTED]
    newer = [lib for lib in libraries if lib.major > NEWEST_TESTED]
    return sorted(tested, key=lambda lib: -lib.major) + sorted(newer, key=lambda lib: lib.major)


def _can_load(path: Path) -> bool:
    try:
        # Loaded in this process, where Dr.Jit is about to load the same file. Local symbols cannot shadow other libraries.
        ctypes.CDLL(str(path), mode=ctypes.RTLD_LOCAL)
    except OSError as error:
        _load_failures[path] = str(error)
        return False
    return True


def choose_library() -> None:
    """Choose the LLVM library for Dr.Jit, and check LLVM at each import of an llvm variant.

    Sets ``DRJIT_LIBLLVM_PATH``, also for child processes, to the best loadable library. Changes nothing if the variable is set,
    if Dr.Jit is already loaded, or if no library is usable. Never raises.
    """
    global _library_origin
    if not any(isinstance(finder, _VariantGuard) for finder in sys.meta_path):
        sys.meta_path.insert(0, _VariantGuard())
    if os.environ.get(VARIABLE):
        _library_origin = BY_USER
    elif "drjit" in sys.modules:
        _library_origin = LOADED_FIRST
    else:
        for library in rank_libraries(find_libraries()):
            if _can_load(library.path):
                os.environ[VARIABLE] = str(library.path)
                _library_origin = BY_MIVOL
                return


class _VariantGuard(importlib.abc.MetaPathFinder):
    """Refuses to import ``mitsuba.llvm_*`` without a usable LLVM; the error of Mitsuba gives no advice."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if name.startswith("mitsuba.llvm_"):
            check_backend(name.removeprefix("mitsuba."))


def missing_system_library() -> str | None:
    """Advice if the system lacks libatomic, needed by the wheel of Dr.Jit and missing in slim images; else None."""
    if sys.platform != "linux":
        return None
    try:
        ctypes.CDLL("libatomic.so.1")
    except OSError as error:
        return (
            f"Dr.Jit cannot be loaded because this system lacks libatomic.so.1 ({error}): sudo apt install libatomic1, or "
            "sudo dnf install libatomic; without root: apt-get download libatomic1 && dpkg-deb -x libatomic1_*.deb ~/libatomic "
            "&& export LD_LIBRARY_PATH=~/libatomic/usr/lib/x86_64-linux-gnu"
        )
    return None


def loaded_version() -> tuple[int, int, int] | None:
    """Version of the LLVM library loaded by Dr.Jit; None without a library."""
    import drjit as dr

    found = tuple(dr.detail.llvm_version())
    return None if found[0] < 0 else found


def library_origin() -> str:
    """Who chose the library, in words: the user, mivol or Dr.Jit."""
    return _library_origin


def unloadable_libraries() -> dict[Path, str]:
    """Libraries of a usable version refused by the loader of the system, with the error."""
    return dict(_load_failures)


def loaded_path() -> Path | None:
    """Path of the LLVM library of this process, from the memory map or from the variable; None if unknown."""
    maps = Path("/proc/self/maps")
    if maps.exists():
        for line in maps.read_text().splitlines():
            name = line.rpartition(" ")[2]
            if "/libLLVM" in name:
                return Path(name)
    named = os.environ.get(VARIABLE)
    return Path(named) if named else None


def check_backend(variant: str | None = None) -> None:
    """Refuse a variant before an unusable LLVM library compiles a kernel.

    Args:
        variant: variant to check; None: the active variant. Only llvm variants are checked.

    Raises:
        LlvmError: the variant needs LLVM, and Dr.Jit has no library or a library known to abort the process. The message lists
            the found library, the needed versions and the commands to install one.
    """
    import mitsuba as mi

    variant = variant or mi.variant()
    if variant is None or not variant.startswith("llvm"):
        return
    found = loaded_version()
    if found is None or found[0] < OLDEST:
        raise LlvmError(_describe_failure(variant, found))


def _describe_failure(variant: str, found: tuple[int, int, int] | None) -> str:
    what = "has no LLVM library" if found is None else "cannot use LLVM " + ".".join(map(str, found))
    aborts = "; 15 and 16 load, but abort Python at the first kernel on x86-64" if OLDEST > 15 else ""
    return "\n".join(
        [
            f"the CPU backend ({variant}) {what}",
            f"  found   : {_describe_library()}",
            f"  needed  : LLVM {OLDEST} to {NEWEST_TESTED}{aborts}",
            "  fix with one of these, then start Python again:",
            *(f"    {fix}" for fix in list_fixes()),
            "  to list all libraries: mivol doctor",
        ]
    )


def _describe_library() -> str:
    if _library_origin == BY_USER:
        path = Path(os.environ[VARIABLE])
        major = _stated_major(path) if path.is_file() else None
        return f"{path} ({_library_origin}): {f'LLVM {major}' if major else probe_version(path)[1]}"
    if _load_failures:
        return "; ".join(f"{path} does not load ({why})" for path, why in _load_failures.items())
    path = loaded_path()
    return f"{path} ({_library_origin})" if path else "nothing in the usual places"


def list_fixes() -> list[str]:
    """Commands to get a working LLVM library, the surest first, each with its conditions."""
    better = [lib for lib in rank_libraries(find_libraries()) if lib.path not in _load_failures]
    lines = []
    if better and _library_origin == LOADED_FIRST:
        lines.append(f"import mivol before mitsuba and drjit: it then chooses {better[0].path}")
    if better and _library_origin == BY_USER:
        lines.append(f"unset {VARIABLE}: mivol then chooses {better[0].path}")
    return lines + [f"{command:<52}{note}" for command, note in _INSTALL]
