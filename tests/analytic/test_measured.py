"""Measured media by name, against the published tables."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.phase import measured
from mivol.phase.domain import ASYMMETRY
from mivol.phase.measured import ALIASES, NAMES, named_medium

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_named_media_are_the_published_ones():
    """A few numbers of each table; the scattering coefficients of the second table as printed, computed from the reduced
    ones.
    """
    sigma_a, sigma_s, g = named_medium("Skim milk")
    assert (sigma_a, sigma_s, g) == ((0.0014, 0.0025, 0.0142), (0.70, 1.22, 1.90), (0.0, 0.0, 0.0))
    sigma_a, sigma_s, g = named_medium("lowfat_milk")
    assert sigma_a == (0.002875, 0.00575, 0.0115)
    assert g == (0.932, 0.902, 0.859)
    assert sigma_s == pytest.approx((13.1157, 15.4445, 17.9572), rel=5e-5)  # five digits were printed
    sigma_a, sigma_s, g = named_medium("red wine")
    assert sigma_a == (0.11632, 0.25191, 0.29434)
    assert sigma_s == pytest.approx((0.00081, 0, 0), abs=5e-6)
    assert named_medium("chicken 1").sigma_a[0] == 0.015


def test_no_number_of_the_tables_was_changed():
    """Sums by columns of the numbers typed from the papers: a single wrong digit changes a sum."""
    sums = [sum(sum(row[k]) for row in measured._JENSEN_2001.values()) for k in range(2)]
    assert sums == pytest.approx([101.52, 4.231], rel=1e-12)
    sums = [sum(sum(row[k]) for row in measured._NARASIMHAN_2006.values()) for k in range(3)]
    assert sums == pytest.approx([68.0478653809, 284.2882205, 87.445], rel=1e-12)


def test_every_named_medium_is_physical():
    for name in (*NAMES, *ALIASES):
        medium = named_medium(name)
        assert all(x >= 0 for x in (*medium.sigma_a, *medium.sigma_s))
        ASYMMETRY.check(np.array(medium.g), name)
        assert min(medium.g) <= medium.mean_g() <= max(medium.g)
    assert len(NAMES) == 47


def test_unknown_medium_is_refused():
    with pytest.raises(MivolError, match="lowfat milk"):
        named_medium("lofat milk")


def test_named_medium_as_a_plugin():
    medium = named_medium("regular milk")
    rgb = medium.to_dict(mm_per_unit=10.0, dilution=0.1)
    assert rgb["sigma_a"]["value"] == pytest.approx(medium.sigma_a)
    grey = medium.to_dict(mm_per_unit=1000.0, channel=2)
    assert grey["sigma_s"] == pytest.approx(1000 * medium.sigma_s[2])
    assert grey["phase"] == {"type": "mivol_hg", "g": 0.681}
    # The mean is weighted by scattering: (18.2052 0.75 + 20.3826 0.714 + 22.3698 0.681) / 60.9576.
    assert rgb["phase"]["g"] == pytest.approx(0.712641, abs=1e-5)
    for wrong in ({"mm_per_unit": 0}, {"mm_per_unit": 1, "dilution": 2}, {"mm_per_unit": 1, "channel": 3}):
        with pytest.raises(MivolError):
            medium.to_dict(**wrong)
    for given in (rgb, grey):
        mi.load_dict(given)
