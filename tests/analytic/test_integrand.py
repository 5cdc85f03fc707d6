"""Media that a sweep cannot integrate cell by cell are refused, with a message for each reason."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.transport.line_integrals.integrand import check_cells_shared
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.lattice import Lattice

ASKING = SimpleNamespace(request="somebody asks", alternative="do without")


def grid(*res: int, edge: float = 1.0) -> GridExtinction:
    return GridExtinction("sigma_t", Lattice(mi.TensorXf(np.ones((*res, 1), np.float32)), np.diag([edge, edge, edge, 1])))


def media(*parts: object, **more: object) -> SimpleNamespace:
    """A valid medium, and a medium of the given parts."""
    views = [MediumView(None, list(p), mi.Float(1), **m) for p, m in (((grid(1, 1, 1),), {}), (parts, more))]
    return SimpleNamespace(bodies=[Body(view, None) for view in views])


def test_grids_that_share_their_cells_and_constants_are_swept():
    check_cells_shared(media(grid(2, 3, 4), ConstantExtinction("sigma_a", mi.Float(1)), grid(2, 3, 4)), ASKING)
    check_cells_shared(media(ConstantExtinction("sigma_a", mi.Float(1))), ASKING)


@pytest.mark.parametrize("other", [(2, 3, 5), (2, 3, 4)])
def test_grids_in_other_cells_are_refused(other: tuple[int, ...]) -> None:
    """A grid of another resolution or another place is refused, at any position among the grids of the medium."""
    parts = grid(2, 3, 4), grid(2, 3, 4), grid(*other, edge=1.0 if other[2] == 5 else 2.0)
    with pytest.raises(MivolError, match=rf"somebody asks .* \(2, 3, 4\) and \(2, 3, {other[2]}\) voxels .* or do without"):
        check_cells_shared(media(*parts), ASKING)


def test_flakes_are_refused():
    with pytest.raises(MivolError, match="somebody asks and a medium has the phase function sggx; do without"):
        check_cells_shared(media(grid(2, 2, 2), microflakes=[mi.Float(1)] * 6), ASKING)
