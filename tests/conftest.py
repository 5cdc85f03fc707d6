"""What every test shares: the variant, the data, the seeds, a folder for pictures, and a clean Dr.Jit afterwards."""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import IO

import one_blas_thread  # noqa: F401  (before NumPy)
import quick_kernels  # (before Dr.Jit)

# isort: split
import mivol  # noqa: F401  (before Mitsuba: it chooses the LLVM library)

# isort: split
import drjit
import false_alarms
import mitsuba as mi
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from mivol import machine
from mivol.threads import set_thread_count

ROOT = Path(__file__).resolve().parents[1]


ON_A_GPU = (
    "analytic/test_direct_lighting.py",
    "analytic/test_grid_blocks.py",
    "analytic/test_interpolation.py",
    "analytic/test_tracking.py",
    "conformance/test_emission.py",
    "conformance/test_film.py",
    "conformance/test_free_flight.py",
    "conformance/test_projector.py",
    "conformance/test_session.py",
    "conformance/test_surfaces.py",
    "gradient/test_derivatives.py",
    "gradient/test_flight_derivatives.py",
    "gradient/test_grid_extinction.py",
    "gradient/test_splatter.py",
    "hard/test_optical_depth.py",
    "optim/test_radiance_problem.py",
)
"""Modules with the marker ``gpu``: one for each kind of kernel that a GPU compiles."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the suite."""
    parser.addoption("--variant", default="llvm_ad_rgb", help="the Mitsuba variant of the fixture variant_rgb")
    parser.addoption("--seeds", type=int, default=1, help="how many rounds of seeds tests of noise run with")
    parser.addoption("--artefacts", type=Path, default=ROOT / "runs" / "tests", help="where tests leave pictures")
    parser.addoption("--record", action="store_true", help="record test_drawn_pictures.json anew")


def pytest_configure(config: pytest.Config) -> None:
    """Chances of false alarms are counted. Workers of pytest-xdist share the cores: a thread more than a worker has cores spins
    for 20 ms after each kernel, and takes the time from the worker beside."""
    config.pluginmanager.register(false_alarms.Count())
    quick_kernels.leave_out_passes()
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
    if workers > 1:
        drjit.set_thread_count(max(1, machine.count_cores() // workers))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test with an argument ``seed``, or of noise, runs once for each of ``--seeds`` rounds of seeds."""
    rounds = metafunc.config.getoption("--seeds")
    if "seed" in metafunc.fixturenames:
        metafunc.parametrize("seed", range(rounds))
    elif rounds > 1 and metafunc.definition.get_closest_marker("statistical"):
        # Read by false_alarms.fresh; the name of a test stays what it is where there is but one round.
        metafunc.fixturenames.append("seed")
        metafunc.parametrize("seed", range(rounds))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the variants of ``slow_for`` as slow, and the modules for a GPU.

    Raises:
        pytest.UsageError: a test has no such variant. One that was renamed would run in every suite without a word.
    """
    unmatched: dict[str, set[str]] = {}
    for item in items:
        if item.path.is_relative_to(ROOT / "tests") and item.path.relative_to(ROOT / "tests").as_posix() in ON_A_GPU:
            item.add_marker(pytest.mark.gpu)
        if marker := item.get_closest_marker("slow_for"):
            test, _, variant = item.nodeid.partition("[")
            left = unmatched.setdefault(test, set(marker.args))
            if variant[:-1] in marker.args:
                item.add_marker(pytest.mark.slow)
                left.discard(variant[:-1])
    is_whole = not any("::" in arg for arg in config.args) and config.getoption("--seeds") == 1
    if is_whole and (gone := {test: ids for test, ids in unmatched.items() if ids}):
        raise pytest.UsageError(f"slow_for names variants that do not exist: {gone}")


def pytest_collection_finish() -> None:
    """What the imports made is not garbage."""
    _collect_new_garbage()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[None]:
    """After each test, and when pytest has let go of its fixtures, memory is given back to the system, and kernels that were
    recorded are forgotten, so that no test sees another's."""
    result = yield
    _collect_new_garbage()
    if mi.variant() is not None and not mi.variant().startswith("scalar"):
        drjit.sync_thread()
        drjit.kernel_history_clear()
        drjit.flush_malloc_cache()
    return result


def _collect_new_garbage() -> None:
    """Collect garbage, and look at what is left never again: modules, syntax trees and the records of pytest grow to so many
    objects that a collection of all of them lasts 0.1 s to 0.3 s, once a test."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def record(request: pytest.FixtureRequest) -> bool:
    """Whether figures are recorded anew."""
    return request.config.getoption("--record")


@pytest.fixture(autouse=True)
def variant_rgb(request: pytest.FixtureRequest) -> str:
    """An rgb variant with derivatives is active in each test that asks for no other; its name."""
    name = request.config.getoption("--variant")
    # Each switch compiles Mitsuba's integrators anew, and at a thousand functions Dr.Jit warns.
    if "each_variant" not in request.fixturenames:
        mi.set_variant(name)
    return name


@pytest.fixture(params=["llvm_ad_rgb", "llvm_ad_mono"])
def each_variant(request: pytest.FixtureRequest) -> str:
    """Each JIT variant of the CPU for rgb and mono, one after the other; its name."""
    mi.set_variant(request.param)
    return request.param


@pytest.fixture(autouse=True)
def own_sessions(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """An integrator takes over no recordings of an earlier integrator, which a test may have made with other code."""
    if "shared_sessions" not in request.fixturenames:
        monkeypatch.setattr("mivol.scene.session.take_session", lambda integrator, session, scene: session)


@pytest.fixture
def shared_sessions() -> None:
    """Integrators take over the sessions of earlier integrators, as those of users do."""


@pytest.fixture
def cpu_back_end(variant_rgb: str) -> None:
    """The test is of what a GPU does otherwise: sums in one order, tables and walks that pay on few cores only."""
    if not variant_rgb.startswith("llvm"):
        pytest.skip(f"{variant_rgb} does this otherwise: the test is of the CPU back end")


@pytest.fixture
def plain_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are saved as their words, or as a grey pixel: the test is of what runs find. Drawing takes longer than a small
    run."""

    def save(figure: Figure, file: IO, *, format: str, **_: object) -> None:
        if format == "svg":
            words = (f"<text>{escape(text.get_text())}</text>" for text in figure.findobj(Text))
            file.write(f'<svg viewBox="0 0 1 1">{"".join(words)}</svg>')
        else:
            Image.new("L", (1, 1)).save(file, format)

    monkeypatch.setattr(Figure, "savefig", save)


@pytest.fixture
def traced_balls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Null spheres are traced, as boundaries of all other shapes are; their balls are not clipped in closed form."""
    monkeypatch.setattr("mivol.scene.survey.fit_ball", lambda shape: None)


@pytest.fixture
def two_threads(variant_rgb: str) -> None:
    """The pool has two threads at least, as a user's has, whose scripts a test may run: both add to one gradient. Mitsuba waits
    for ever for the second to read an EXR or to write one."""
    set_thread_count(max(2, drjit.thread_count()))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data: ``MIVOL_DATA``, else ``../shared/data`` beside the checkout."""
    folder = Path(os.environ.get("MIVOL_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}: set MIVOL_DATA to the folder that holds it")
    return folder


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """SIGINT is heard, as at a terminal, even where a shell started the tests in the background with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def artefacts(request: pytest.FixtureRequest) -> Path:
    """An empty folder of this test's own that outlives the run, for pictures to look at."""
    folder = request.config.getoption("--artefacts") / re.sub(r"[^\w.=-]+", "_", request.node.nodeid)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def whole_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives replay the very paths of a picture, or of forward derivatives, of their seed: paths have no branches, and the
    baseline of reverse derivatives is that of forward ones, its mean in all blocks."""
    from mivol.transport.estimators.flights.baseline import Baseline

    monkeypatch.setattr("mivol.scene.plan.choose_branches", lambda *_: (False, []))
    monkeypatch.setattr(Baseline, "_read", lambda self, block, active: self.average)


@pytest.fixture
def flies(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan uses free flights at depth 2 too, instead of the estimator of single scattering."""
    from mivol.scene import plan

    choose = plan.choose_segment_estimator
    monkeypatch.setattr(plan, "choose_segment_estimator", lambda asked: "free_flight" if asked.scatters else choose(asked))


@pytest.fixture(autouse=True)
def _same_threads() -> Iterator[None]:
    """Forget how many threads a test asked for."""
    threads = drjit.thread_count()
    yield
    if drjit.thread_count() != threads:
        set_thread_count(threads)
