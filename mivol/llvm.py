"""The CPU backend's compiler: finds an LLVM library that Dr.Jit can use, and stops a render that has none.

Conventions. Dr.Jit loads LLVM as soon as it is imported, from ``DRJIT_LIBLLVM_PATH`` if that is set, so :func:`ensure`
runs before; it never overrides a choice of the user's and never raises (CUDA needs no LLVM). :func:`check_backend`
raises. Dr.Jit 1.5 refuses LLVM 14 and accepts 15 and 16, which abort the process on x86-64 at the first ``minimum``:
their code generator cannot select ``llvm.minimum`` there.
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

__all__ = [
    "Library",
    "LlvmError",
    "check_backend",
    "ensure",
    "find_libraries",
    "fixes",
    "loaded_path",
    "missing_system_library",
    "origin",
    "probe",
    "rank",
    "unloadable",
    "version",
]

VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST = 15 if platform.machine() in ("arm64", "aarch64") else 17
NEWEST_TESTED = 23

BY_USER = f"named by {VARIABLE}"
BY_MIVOL = "chosen by mivol"
BY_DRJIT = "chosen by Dr.Jit's own search"
LOADED_FIRST = "chosen by Dr.Jit, which was imported before mivol"

_origin = BY_DRJIT
_unloadable: dict[Path, str] = {}


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
"""Files of the library on Linux, macOS and Windows."""


class LlvmError(MivolError, ImportError):
    """An llvm variant was asked for where no LLVM library works."""


class Library(NamedTuple):
    """An LLVM library on disk; ``major`` is its version."""

    path: Path
    major: int


def folders_of(system: str, machine: str, root: Path, prefix: Path, environment: Mapping[str, str]) -> list[Path]:
    """Where LLVM libraries usually lie.

    Args:
        system: as ``sys.platform`` names it.
        machine: as ``platform.machine()`` names it.
        root: of the file system.
        prefix: of this Python's environment.
        environment: variables; ``CONDA_PREFIX`` and, on Windows, ``ProgramFiles`` and ``LOCALAPPDATA`` count.

    Returns:
        Folders in the order of the search, whether they are there or not.
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


def _folders() -> list[Path]:
    return folders_of(sys.platform, platform.machine(), Path("/"), Path(sys.prefix), os.environ)


def _stated_major(path: Path) -> int | None:
    found = re.match(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
    return int(found[1]) if found else None


def probe(path: Path | str) -> tuple[int | None, str]:
    """Load a library in a child process (which survives one that crashes) and ask its version.

    Returns:
        The major version and an empty string, or None and what went wrong.
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
        return None, "it is older than LLVM 16, or no LLVM library at all"
    last = child.stderr.strip().splitlines()[-1:] or [f"loading it ends the process with code {child.returncode}"]
    return None, last[0].removeprefix("OSError: ")


def find_libraries(folders: Iterable[Path] | None = None) -> list[Library]:
    """Every LLVM library in the usual places: this environment, conda, the system's folders, Homebrew.

    The version is the one that the file's name states, else the one that the library states to a child process.

    Args:
        folders: where to look instead.

    Returns:
        One entry for each real file, in the order of the search.
    """
    found: dict[Path, Library] = {}
    for folder in _folders() if folders is None else folders:
        for path in sorted(path for name in NAMES for path in folder.glob(name)):
            real = Path(os.path.realpath(path))
            if real in found or not real.is_file():
                continue
            major = _stated_major(real) or probe(real)[0]
            if major is not None:
                found[real] = Library(real, major)
    return list(found.values())


def rank(libraries: Sequence[Library]) -> list[Library]:
    """The libraries that Dr.Jit can use, best first: the newest that was tested, then the least new of the untested."""
    tested = [lib for lib in libraries if OLDEST <= lib.major <= NEWEST_TESTED]
    newer = [lib for lib in libraries if lib.major > NEWEST_TESTED]
    return sorted(tested, key=lambda lib: -lib.major) + sorted(newer, key=lambda lib: lib.major)


def _loads(path: Path) -> bool:
    try:
        # In this process: Dr.Jit is about to load the same file here. Local symbols, so that it cannot shadow anything.
        ctypes.CDLL(str(path), mode=ctypes.RTLD_LOCAL)
    except OSError as error:
        _unloadable[path] = str(error)
        return False
    return True


def ensure() -> None:
    """Choose the LLVM library before Dr.Jit does, and watch over the import of llvm variants.

    Sets ``DRJIT_LIBLLVM_PATH`` (child processes inherit it) to the best library that loads. Leaves everything alone
    where the variable is set, where Dr.Jit is loaded already, and where no library serves. Never raises.
    """
    global _origin
    if not any(isinstance(finder, _VariantGuard) for finder in sys.meta_path):
        sys.meta_path.insert(0, _VariantGuard())
    if os.environ.get(VARIABLE):
        _origin = BY_USER
    elif "drjit" in sys.modules:
        _origin = LOADED_FIRST
    else:
        for library in rank(find_libraries()):
            if _loads(library.path):
                os.environ[VARIABLE] = str(library.path)
                _origin = BY_MIVOL
                return


class _VariantGuard(importlib.abc.MetaPathFinder):
    """Refuses to import ``mitsuba.llvm_*`` without a usable LLVM: Mitsuba's own error would not say what to do."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if name.startswith("mitsuba.llvm_"):
            check_backend(name.removeprefix("mitsuba."))


def missing_system_library() -> str | None:
    """What to do where the system lacks the one library that Dr.Jit's wheel needs and slim images leave out."""
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


def version() -> tuple[int, int, int] | None:
    """The version of the LLVM library that Dr.Jit has loaded, None where it has none."""
    import drjit as dr

    found = tuple(dr.detail.llvm_version())
    return None if found[0] < 0 else found


def origin() -> str:
    """Who chose the library, in words."""
    return _origin


def unloadable() -> dict[Path, str]:
    """Libraries of a usable version that the system's loader refused when mivol chose, and why."""
    return dict(_unloadable)


def loaded_path() -> Path | None:
    """The LLVM library of this process, as far as the system (or the variable) tells."""
    maps = Path("/proc/self/maps")
    if maps.exists():
        for line in maps.read_text().splitlines():
            name = line.rpartition(" ")[2]
            if "/libLLVM" in name:
                return Path(name)
    named = os.environ.get(VARIABLE)
    return Path(named) if named else None


def check_backend(variant: str | None = None) -> None:
    """Stop before a kernel is compiled by an LLVM library that cannot do it.

    Args:
        variant: the variant to judge; by default the active one. Variants that are not of the llvm kind always pass.

    Raises:
        LlvmError: the variant needs LLVM and Dr.Jit has none, or one that would abort the process. The message says
            what was found, what is needed and how to get it.
    """
    import mitsuba as mi

    variant = variant or mi.variant()
    if variant is None or not variant.startswith("llvm"):
        return
    found = version()
    if found is None or found[0] < OLDEST:
        raise LlvmError(_sentence(variant, found))


def _sentence(variant: str, found: tuple[int, int, int] | None) -> str:
    what = "has no LLVM library" if found is None else "cannot use LLVM " + ".".join(map(str, found))
    aborts = "; 15 and 16 load, but abort Python at the first kernel on x86-64" if OLDEST > 15 else ""
    return "\n".join(
        [
            f"the CPU backend ({variant}) {what}",
            f"  found   : {_found()}",
            f"  needed  : LLVM {OLDEST} to {NEWEST_TESTED}{aborts}",
            "  fix, any one of these, then start Python again:",
            *(f"    {fix}" for fix in fixes()),
            "  to see what is there: mivol doctor",
        ]
    )


def _found() -> str:
    if _origin == BY_USER:
        path = Path(os.environ[VARIABLE])
        major = _stated_major(path) if path.is_file() else None
        return f"{path} ({_origin}): {f'LLVM {major}' if major else probe(path)[1]}"
    if _unloadable:
        return "; ".join(f"{path} does not load ({why})" for path, why in _unloadable.items())
    path = loaded_path()
    return f"{path} ({_origin})" if path else "nothing in the usual places"


def fixes() -> list[str]:
    """What can be done where no LLVM library works, the surest first: commands, each with its conditions."""
    better = [lib for lib in rank(find_libraries()) if lib.path not in _unloadable]
    lines = []
    if better and _origin == LOADED_FIRST:
        lines.append(f"import mivol before mitsuba and drjit: it then chooses {better[0].path}")
    if better and _origin == BY_USER:
        lines.append(f"unset {VARIABLE}: mivol then chooses {better[0].path}")
    return lines + [f"{command:<52}{note}" for command, note in _INSTALL]
