"""`scripts/bench_radiance_field.py`: the peer computes the same light and derivatives, so its ratios compare the same work."""

from __future__ import annotations

from types import ModuleType

import bench_script
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.line_integrals.radiance_field import bake, cells_of, model_of, render


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    return bench_script.load("bench_radiance_field")


def test_the_peer_sees_the_same_and_derives_the_same(variant_rgb: str, bench: ModuleType) -> None:
    field, _ = bench.fog(bench.QUICK)
    density, sh = field.to_dense()
    field = type(field).from_dense(density, sh * np.float32(0.3), field.to_world)
    task = bench.tasks(bench.QUICK)["camera"]
    cells, peer = cells_of(field), bench.peer_of(field)
    seen = render(cells, bake(field, cells, task.pinholes, mi.UInt32(0)), model_of(field), task.rays)
    ours = np.array(seen.colour)
    theirs = np.array(peer.render(mi.Point3f((task.rays.o + 1) * 0.5), task.rays.d))
    # The peer's last step reaches up to a whole one behind the box: an optical depth of 1.5 * 2 / 32 too much.
    assert np.abs(ours - theirs).max() < 1.5 * 2 / 32
    assert np.abs(ours - theirs).mean() < 0.02 * ours.max()
    assert ours.max() > 0.2
    slopes = [[np.array(a) for a in step(0)] for step in (bench.our_step(field, task), bench.peer_step(peer, task))]
    # The longer way again, twice over: the derivative is of a square.
    density = slopes[0][0], slopes[1][0] * 2  # the peer's lengths are half of ours
    sh = slopes[0][1].reshape(-1, field.width)[:, :27], slopes[1][1].reshape(-1, 27)
    for a, b in (density, sh):
        assert np.vdot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b)) > 0.98
        assert np.linalg.norm(a) == pytest.approx(np.linalg.norm(b), rel=0.1)
    dr.sync_thread()


@pytest.mark.slow
def test_every_question_is_answered(tmp_path, bench: ModuleType) -> None:
    quick = bench_script.quick("bench_radiance_field", tmp_path)
    assert set(bench.BENCH.questions) <= set(quick)
    for figures in quick["step"].values():
        assert all(figures[kind]["ratio_of_processor_time"] > 0 for kind in ("camera", "pixels", "any"))
    assert 0 < quick["memory"]["bytes_per_ray"] < 512
    for figures in quick["fit"].values():
        assert figures["peer_psnr"] > 5 and all(np.diff([t for t, _ in figures["ours"]]) > 0)
    assert (tmp_path / "bench_radiance_field.png").read_bytes().startswith(b"\x89PNG")
