"""The back end: flags and memory of a GPU, garbage, limits of Dr.Jit, and plugins for each variant in any order.

The limits are those that the code goes around: "gone" asks for simpler code. For the plugins the package is copied, and its
shells replaced by ones that only say for which variant they are run; each order of imports is a process of its own.
"""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mivol
from mivol import back_end, machine, plugins
from mivol.errors import MivolError
from mivol.experiments import solver_choice, start
from mivol.fields.gaussian_grid import _check_grid_memory
from mivol.fields.octree import Octree
from mivol.optim.photographs.octree_building import _check_leaves
from mivol.scene.sensors import check_film
from mivol.threads import run_child
from mivol.tomography.geometry import VoxelGrid


@pytest.fixture
def spills() -> Iterator[None]:
    """Spills to shared memory are on, as Dr.Jit begins, and are what they were afterwards."""
    with dr.scoped_set_flag(dr.JitFlag.SpillToSharedMemory, True):
        yield


@pytest.mark.parametrize(("variant", "expected"), [("cuda_ad_rgb", False), ("cuda_ad_mono", False), ("llvm_ad_rgb", True)])
def test_a_variant_of_a_gpu_spills_to_local_memory(spills: None, variant: str, expected: bool) -> None:
    """Where a variant becomes active, kernels that call plugins would abort ptxas otherwise."""
    mivol._on_variant_change(None, variant)
    assert dr.flag(dr.JitFlag.SpillToSharedMemory) == expected


# -- Memory of a card, which is made up --------------------------------------------------------------------------------


def check_film_of_a_megapixel() -> None:
    check_film(mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": 1024, "height": 1024}}), 1)


def check_scan() -> None:
    settings = SimpleNamespace(solve=SimpleNamespace(solver="pcg"))
    solver_choice.check_solver_memory(settings, VoxelGrid((20, 30, 40)), rays=1000)


def make_grid_of_an_octree() -> None:
    codes, sizes = np.arange(7, dtype=np.uint64) * 8**3, np.array([3] * 6 + [0], np.uint8)
    Octree.from_rows(6, np.eye(4), codes, sizes, np.ones(7), np.zeros((7, 9, 3))).to_grid()


TASKS: dict[str, tuple[Callable[[], None], int]] = {
    "a film": (check_film_of_a_megapixel, 36 << 20),
    "a scan": (check_scan, 20 * 24000 + (8 + 28) * 1000),
    "a grid of a scene": (lambda: start.check_grid_memory("sigma_t.data", (100, 100, 100), "less"), 24 * 10**6),
    "leaves": (lambda: _check_leaves(10**6, 8), 36 * 10**6),
    "the grid of an octree": (make_grid_of_an_octree, (6 * 8**3 + 1) * 4 * (2 + 3 * 9)),
    "the grid of Gaussians": (lambda: _check_grid_memory(np.array([50, 40, 30]), 4, 50), 60000 * 4 * (2 + 3 * 4)),
}
"""Tasks with arrays on a GPU, and their memory there [byte]."""


@pytest.mark.parametrize("name", TASKS)
def test_the_memory_of_a_card_is_asked_before_a_task(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One byte less than the arrays on the card is refused; the memory of the machine is another question."""
    task, needed = TASKS[name]
    monkeypatch.setattr(back_end, "is_on_gpu", lambda: True)
    monkeypatch.setattr(machine, "available_memory", lambda: 1 << 40)
    monkeypatch.setattr(back_end, "_free_gpu_memory", lambda: needed)
    task()
    monkeypatch.setattr(back_end, "_free_gpu_memory", lambda: needed - 1)
    with pytest.raises(MivolError, match=r"on the GPU needs .* GiB of memory and .* GiB are free: "):
        task()


@pytest.mark.parametrize("name", [name for name in TASKS if name != "a grid of a scene"])
def test_a_large_card_needs_a_machine_beside_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(back_end, "is_on_gpu", lambda: True)
    monkeypatch.setattr(machine, "available_memory", lambda: 1 << 19)
    monkeypatch.setattr(back_end, "_free_gpu_memory", lambda: 1 << 40)
    with pytest.raises(MivolError, match=r"^((?!GPU).)* needs .* GiB of memory and 0\.0 GiB are free: "):
        TASKS[name][0]()


# -- Garbage -----------------------------------------------------------------------------------------------------------


def test_what_is_left_of_imports_is_not_searched_for_garbage() -> None:
    """Mitsuba and pytest leave 95,000 objects, with SciPy 300,000: 0.1 s of a collection. A test makes a few thousand."""
    assert gc.get_freeze_count() > 50_000
    assert len(gc.get_objects()) < 20_000


# -- Limits of Dr.Jit --------------------------------------------------------------------------------------------------

SCRIPTS = sorted((Path(__file__).resolve().parents[1] / "scripts" / "dr_jit_limits").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_limit_is_as_known(script: Path) -> None:
    child = run_child("import runpy, sys; import mivol; runpy.run_path(sys.argv[1])", str(script))
    assert child.returncode == 0 and "as known" in child.stdout, child.stderr


# -- Registration of plugins -------------------------------------------------------------------------------------------

PACKAGE = Path(mivol.__file__).parent
SAY = "import mitsuba as mi\nprint(__name__.rpartition('.')[2], mi.variant())\n"
ORDERS = {
    "mivol first": "import mivol, mitsuba as mi",
    "mitsuba first": "import mitsuba as mi, mivol",
    "variant first": "import mitsuba as mi; mi.set_variant('scalar_rgb'); import mivol",
}
SWITCHES = ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with a copy of the package whose shells say their name."""
    package = tmp_path / "mivol"
    (package / "plugins").mkdir(parents=True)
    for name in ("__init__.py", "back_end.py", "errors.py", "llvm.py", "machine.py", "threads.py"):
        shutil.copy(PACKAGE / name, package)
    shutil.copy(PACKAGE / "plugins" / "__init__.py", package / "plugins")
    for name in plugins.MODULES:
        (package / "plugins" / f"{name}.py").write_text(SAY)
    return tmp_path


def said(copy: Path, code: str) -> list[str]:
    """The lines that a child process prints, with the copy first on its path and an LLVM that works."""
    done = run_child(code, env={**os.environ, "PYTHONPATH": str(copy)})
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\n")[:-1]


@pytest.mark.slow_for("mitsuba first", "mivol first")
@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_each_variant_gets_its_plugins(copy: Path, order: str) -> None:
    """Scalar variants get no shell; no shell runs before there is a variant, out of order, or twice for one switch."""
    switch = "".join(f"\nmi.set_variant({name!r})" for name in SWITCHES)
    expected = [f"{shell} {name}" for name in SWITCHES if name.startswith("llvm") for shell in plugins.MODULES]
    assert said(copy, order + switch) == expected


def test_no_variant_no_plugin(copy: Path) -> None:
    assert said(copy, "import mivol, sys; print(any('plugins.volumes' in name for name in sys.modules))") == ["False"]


def test_a_scalar_variant_says_where_mivol_works() -> None:
    done = run_child("import mivol, mitsuba as mi; mi.set_variant('scalar_rgb'); mi.load_dict({'type': 'mivol'})")
    assert 'the variant "scalar_rgb" is active; mivol works in llvm_ad_rgb' in done.stderr
