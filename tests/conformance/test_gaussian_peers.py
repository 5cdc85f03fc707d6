"""What mivol writes of Gaussians is opened by others, with the same numbers: Mitsuba's ellipsoids, PlayCanvas' converter."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from gaussian_sets import random_gaussians

from mivol.points.gaussian_files import read_gaussians, write_gaussians

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")


@pytest.mark.parametrize("degree", [0, 3])
def test_mitsuba_opens_what_is_written(variant_rgb: str, tmp_path: Path, degree: int) -> None:
    """Mitsuba holds centre, scale, unit quaternion (x, y, z, w), opacity and coefficients in float32: activations are rounded
    some eight times, 8 * 2^-24 of numbers not above 1; the rest are the same numbers."""
    one = random_gaussians(6, degree)
    write_gaussians(tmp_path / "a.ply", one)
    held = mi.traverse(mi.load_dict({"type": "ellipsoids", "filename": str(tmp_path / "a.ply")}))
    means, scales, quaternions = np.split(np.array(held["data"]).reshape(6, 10), [3, 6], axis=1)
    assert np.array_equal(means, one.means)
    assert np.abs(scales - one.scales()).max() <= 8 * 2**-24
    unit = one.quaternions / np.linalg.norm(one.quaternions, axis=1, keepdims=True)
    assert np.abs(np.roll(quaternions, 1, axis=1) - unit).max() <= 8 * 2**-24
    assert np.abs(np.array(held["opacities"]).ravel() - one.opacities()).max() <= 8 * 2**-24
    assert np.array_equal(np.array(held["sh_coeffs"]).reshape(one.harmonics.shape), one.harmonics)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_opens_what_is_written(tmp_path: Path, degree: int) -> None:
    """It writes the same PLY again to the bit; its compressed PLY and SPZ are read here within half a step of positions: in a
    box of at most 2 in 10 bits, and 2^-12."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform is not on the PATH: npm install --global @playcanvas/splat-transform")
    one = random_gaussians(300, degree)
    write_gaussians(tmp_path / "a.ply", one)
    for name in ("b.ply", "b.compressed.ply", "b.spz"):
        subprocess.run([program, tmp_path / "a.ply", tmp_path / name], check=True, timeout=60, capture_output=True)
    again = read_gaussians(tmp_path / "b.ply")
    assert all(np.array_equal(getattr(again, name), getattr(one, name)) for name in ARRAYS)
    for name, bound in (("b.compressed.ply", 1 / 1023), *((("b.spz", 2**-13),) if has_zstandard() else ())):
        packed = read_gaussians(tmp_path / name)
        apart = np.abs(packed.means[:, None] - one.means).max(axis=2)
        assert len(set(apart.argmin(axis=1))) == 300
        assert apart.min(axis=1).max() <= bound + 1e-6


def has_zstandard() -> bool:
    """Whether an SPZ of version 4 can be read."""
    try:
        import zstandard  # noqa: F401
    except ImportError:
        return False
    return True
