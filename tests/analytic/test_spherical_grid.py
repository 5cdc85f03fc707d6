"""Sizes of rows of harmonics, and valid numbers of harmonics."""

from __future__ import annotations

import pytest

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, harmonic_degree, row_width


@pytest.mark.parametrize(("degree", "basis", "width"), [(0, 1, 4), (1, 4, 12), (2, 9, 28), (3, 16, 48), (4, 25, 76)])
def test_rows_of_harmonics(degree: int, basis: int, width: int) -> None:
    """(d + 1)^2 harmonics of three numbers, padded to a multiple of 4."""
    assert (basis_size(degree), harmonic_degree(basis), row_width(basis)) == (basis, degree, width)


@pytest.mark.parametrize("basis", [-4, 0, 2, 24, 26, 36])
def test_no_degree(basis: int) -> None:
    with pytest.raises(MivolError, match="1, 4, 9, 16 or 25"):
        harmonic_degree(basis)
