"""The list of occupied cells: numbers, ways through empty cells, and positions of a ray in a cell."""

from __future__ import annotations

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from radiance_rays import looked, rays_of
from scipy.ndimage import distance_transform_cdt

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells
from mivol.transport.traversal.grid_blocks import REACH
from mivol.transport.traversal.lattice import clip_to_grid
from mivol.transport.traversal.occupied_cells import CellIndex
from mivol.transport.traversal.occupied_walk import walk_occupied_cells


def test_fractions_across_a_ray_along_an_axis_are_those_of_its_start():
    """Equal to the bit: fractions are not reversed along the ray, since 1 - (1 - frac) would round them."""
    field = SphericalGrid.from_dense(np.ones((5, 5, 5), np.float32), np.zeros((5, 5, 5, 1, 3)), np.eye(4))
    n = 64
    o = np.stack([np.full(n, -1.0), *np.random.default_rng(1).uniform(0.1, 0.9, (2, n))], axis=-1)
    rays, cells = rays_of(o, [1.0, 0.0, 0.0]), find_occupied_cells(field)
    segment = clip_to_grid(cells, rays.o, rays.d, 0, rays.t_max)
    seen, _, _ = walk_occupied_cells(cells, segment, lambda _, here, on: mi.Vector3f(here.points[0]), mi.Vector3f(0))
    start = np.array(segment.frac)
    assert np.array_equal(np.array(seen)[1:], start[1:])
    # The test is no test where the rounding is none.
    assert np.any(1 - (1 - start[1:]) != start[1:])


RES = (70, 21, 25)
"""Of which the last bricks along y and x end within the grid, and most along z are further than REACH from what is listed."""

DIRECTIONS = list(product((False, True), repeat=3))
"""Whether a ray runs upwards along x, y, z."""


def chosen(levels: int, share: float = 0.01) -> np.ndarray:
    """Some cells (levels, Z, Y, X) of the first slices, in clusters like those of surfaces."""
    is_listed = np.random.default_rng(levels).random((levels, *(n + 1 for n in RES))) < share
    is_listed[:, 9:] = False
    is_listed[0, 4:6, 5:9, 6:13] = True
    return is_listed


@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("ahead", DIRECTIONS)
def test_ways_lead_through_empty_cells_only(ahead: tuple[bool, ...], levels: int) -> None:
    """From an empty brick a way ends before the nearest non-empty brick, in all directions. Within a non-empty brick a way ends
    with the brick if no listed cell lies ahead, and otherwise with the next cell. Listed cells have no way."""
    is_listed = chosen(levels)
    index, _ = CellIndex.find(RES, levels, lambda cell: dr.gather(mi.Bool, mi.Bool(is_listed.ravel()), cell))
    free, _ = looked(index, is_listed.shape, ahead)
    bricks = tuple(-(-n // 4) for n in is_listed.shape[1:])
    padded = np.zeros((levels, *(4 * b for b in bricks)), bool)
    padded[:, : RES[0] + 1, : RES[1] + 1, : RES[2] + 1] = is_listed
    for level in range(levels):
        filled = padded[level].reshape(bricks[0], 4, bricks[1], 4, bricks[2], 4).any(axis=(1, 3, 5))
        far = np.minimum(distance_transform_cdt(~filled, "chessboard"), REACH)
        for place in np.ndindex(is_listed.shape[1:]):
            # Along x, y, z.
            brick, inside = tuple(p >> 2 for p in place), [p & 3 for p in place[::-1]]
            within = [4 - i if up else i + 1 for i, up in zip(inside, ahead, strict=True)]
            if filled[brick]:
                box = tuple(
                    slice(p, p + w) if up else slice(p - w + 1, p + 1)
                    for p, w, up in zip(place, within[::-1], ahead[::-1], strict=True)
                )
                expected = within if not padded[level][box].any() else [int(not padded[level][place])] * 3
            else:
                expected = [w + 4 * (far[brick] - 1) for w in within]
            assert free[(level, *place)].tolist() == expected, (level, place)


@pytest.mark.parametrize("levels", [1, 2])
def test_numbers_of_listed_cells(levels: int) -> None:
    is_listed = chosen(levels)
    index, listed = CellIndex.find(RES, levels, lambda cell: dr.gather(mi.Bool, mi.Bool(is_listed.ravel()), cell))
    free, number = looked(index, is_listed.shape, (True, True, True))
    assert np.array_equal(free[..., 0] == 0, is_listed)
    assert sorted(np.array(listed)) == np.flatnonzero(is_listed).tolist()
    assert np.array_equal(np.array(listed)[number[is_listed]], np.flatnonzero(is_listed))


@pytest.mark.parametrize("nodes", [[], [0], [70 * 21 * 25 - 1, 70 * 21 * 25 + 3 + 25 * (7 + 21 * 2)]])
def test_only_cells_of_bricks_at_stored_nodes_are_asked_about(nodes: list[int]) -> None:
    """A node touches two cells along each axis. All listed cells are found, and the index takes 12 bytes a brick."""
    shape, asked = (2, *(n + 1 for n in RES)), []
    is_listed = np.zeros(shape, bool)
    for node in nodes:
        level, k, j, i = np.unravel_index(node, (2, *RES))
        is_listed[level, k : k + 2, j : j + 2, i : i + 2] = True

    def is_there(cell: mi.UInt32) -> mi.Bool:
        asked.append(np.array(cell))
        return dr.gather(mi.Bool, mi.Bool(is_listed.ravel()), cell)

    index, listed = CellIndex.find(RES, 2, is_there, mi.UInt32(nodes))
    assert sorted(np.array(listed)) == np.flatnonzero(is_listed).tolist()
    bricks = {(level, *(a >> 2 for a in place)) for level, *place in np.argwhere(is_listed)}
    assert len(asked[0]) == 64 * max(len(bricks), 1)
    assert index.bytes == 4 * 2 * 18 * 6 * 7 + 12 * max(len(bricks), 1)
    assert np.array_equal(looked(index, shape, (False, True, False))[0][..., 0] == 0, is_listed)
