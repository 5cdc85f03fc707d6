"""The picture of a run that goes on: which slices stand where, and when it is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread

from mivol.report.pixel_scale import EDGE, GAP, is_preview_due, write_preview


def test_three_slices_side_by_side(tmp_path: Path) -> None:
    """A box of 1 x 2 x 0.5: xy, xz and yz on one scale from 0 to the largest value, the second axis upwards."""
    volume = np.zeros((2, 4, 2), np.float32)
    volume[1, 0, 0] = 4.0  # the middle layer z = 1: low y, low x
    volume[0, 2, 1] = 2.0  # the middle y = 2 and x = 1: low z
    path = write_preview(tmp_path, volume, (1.0, 2.0, 0.5))
    shown = np.round(255 * imread(path)[..., 0]).astype(int)
    x, y, z = EDGE // 2, EDGE, EDGE // 4
    assert shown.shape == (y, x + x + y + 2 * GAP)
    xy, xz, yz = shown[:, :x], shown[y - z :, x + GAP : x + GAP + x], shown[y - z :, -y:]
    assert (shown[: y - z, x + GAP :] == 255).all() and (shown[:, x : x + GAP] == 255).all()
    assert (xy[-y // 4 :, : x // 2] == 255).all() and (xy[: -y // 4] == 0).all() and (xy[:, x // 2 :] == 0).all()
    half = int(np.round(255 * 2 / np.percentile([4.0] + 7 * [0.0] + [2.0] + 3 * [0.0] + [2.0] + 7 * [0.0], 99.8)))
    assert (xz[z // 2 :, x // 2 :] == half).all() and (xz[: z // 2] == 0).all() and (xz[:, : x // 2] == 0).all()
    assert (yz[z // 2 :, y // 2 : 3 * y // 4] == half).all() and (yz[: z // 2] == 0).all() and (yz[:, : y // 2] == 0).all()


def test_some_twenty_previews_a_run() -> None:
    """The first and the last iteration, and every twentieth part of the run; of short runs every one."""
    assert [k for k in range(1, 8) if is_preview_due(k, 7)] == [1, 2, 3, 4, 5, 6, 7]
    assert [k for k in range(1, 65) if is_preview_due(k, 64)] == sorted({1, 64, *range(3, 64, 3)})
    assert sum(is_preview_due(k, 5000) for k in range(1, 5001)) == 21
