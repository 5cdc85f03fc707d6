"""The table of direct light: against closed forms in a uniform grid, and the noise of the baseline that knows it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE, close_up, mivol

from mivol.transport.estimators.flights.baseline import BLOCKS, PARTS, Baseline, BaselineSums, DirectLightTable
from mivol.transport.estimators.flights.direct_light_table import tabulate_direct_light
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.path import derivatives
from scenes import box_of, camera, centred, grid_volume, media_of, medium, sky

SIGMA, ALBEDO, SHAPE = 0.9, np.array([0.9, 0.6, 0.3]), (4, 6, 9)
EDGE = BLOCKS * PARTS


def uniform(place: np.ndarray = PLACE) -> dict:
    albedo = {"type": "rgb", "value": ALBEDO.tolist()}
    return box_of(medium("heterogeneous", grid_volume("gridvolume", np.full((*SHAPE, 1), SIGMA), place), albedo), place)


def tabulate(*interiors: dict, **emitters: dict) -> DirectLightTable | None:
    boxes = {f"box{k}": box for k, box in enumerate(interiors)}
    sensor = camera([0, -4, 1], [0, 0, 0])
    media = media_of(mi.load_dict({"type": "scene", "sensor": sensor, **boxes, **emitters}))
    with dr.suspend_grad():
        return tabulate_direct_light(media, DirectLighting(media), None, 7)


def faces(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends of the parts along an axis of a grid of n nodes in [-1, 1]: the outermost cells count half."""
    ends = np.arange(EDGE + 1) * (n + 1) / EDGE - 1
    ends = np.clip(2 * (ends + 0.5) / n - 1, -1, 1)
    return ends[:-1], ends[1:]


@pytest.mark.parametrize("axis", range(3))
def test_light_of_a_sun_lies_between_the_light_of_the_ends_of_each_part(axis: int) -> None:
    """Parallel light through a uniform grid, along each axis, up to the rounding of float32 and the inset of points."""
    direction, irradiance = [0.0, 0.0, 0.0], 3.0
    direction[axis] = -1.0
    table = tabulate(uniform(), sun={"type": "directional", "direction": direction, "irradiance": irradiance})
    found = np.moveaxis(np.array(table.values).reshape(3, EDGE, EDGE, EDGE), 3 - axis, -1)
    low, high = faces(SHAPE[2 - axis])
    for colour, albedo in zip(found, ALBEDO, strict=True):
        least, most = (albedo * irradiance / (4 * np.pi) * np.exp(-SIGMA * (1 - x)) for x in (low, high))
        assert np.all((0.9999 * least <= colour) & (colour <= 1.0001 * most))
    assert np.ptp(most) > 0.5 * most.max()


def test_light_of_a_lamp_lies_between_the_light_of_the_corners_of_each_part() -> None:
    """A point lamp far above: the distance decides, beside a shadow between those of the top and of the bottom."""
    lamp, intensity = np.array([0.0, 0.0, 9.0]), 50.0
    table = tabulate(uniform(), lamp={"type": "point", "position": lamp.tolist(), "intensity": intensity})
    found = np.array(table.values).reshape(3, EDGE, EDGE, EDGE)[0]
    (x0, x1), (y0, y1), (z0, z1) = (faces(n) for n in SHAPE[::-1])
    grids = [np.meshgrid(z, y, x, indexing="ij") for z, y, x in ((z0, y0, x0), (z1, y1, x1))]
    near, far = np.minimum(*(np.abs(g) for g in grids)), np.maximum(*(np.abs(g) for g in grids))
    least, most = [], []
    for z, across, edge in ((grids[0][0], far, least), (grids[1][0], near, most)):
        r = np.sqrt((lamp[2] - z) ** 2 + across[1] ** 2 + across[2] ** 2)
        depth = SIGMA * (1 - z) * r / (lamp[2] - z)
        edge.append(ALBEDO[0] * intensity / (4 * np.pi * r**2) * np.exp(-depth))
    assert np.all((0.9999 * least[0] <= found) & (found <= 1.0001 * most[0]))


def test_a_medium_without_a_grid_has_no_light_in_the_table() -> None:
    even = box_of(medium("homogeneous", 0.5, 0.8), centred(2 * np.eye(3), (5, 0, 0)))
    sun = {"type": "directional", "direction": [0, 0, -1]}
    assert tabulate(even, sun=sun) is None
    table = tabulate(uniform(), even, sun=sun)
    values = np.array(table.values).reshape(3, -1)
    for own in table.blocks:
        part = values[:, own.first : own.first + own.count]
        assert np.all(part > 0) if own.parts == PARTS else np.all(part == 0) and own.count == BLOCKS**3


def find_baseline(monkeypatch: pytest.MonkeyPatch, g: float = 0.0, **emitters: dict) -> tuple[BaselineSums, Baseline]:
    """The baseline of a gradient of a uniform dark smoke, of a grid of cells much smaller than blocks."""
    volume, phase = grid_volume("mivol_voxels", np.full((36, 36, 36, 1), 0.5), PLACE), {"type": "hg", "g": g}
    interior = medium("mivol_medium", volume, 0.1, phase=phase)
    scene, found = close_up({"smoke": box_of(interior, PLACE), **emitters}, res=32), []
    finish = BaselineSums.finish
    monkeypatch.setattr(BaselineSums, "finish", lambda sums: found.append((sums, finish(sums))) or found[-1][1])
    params = mi.traverse(scene)
    key = "smoke.interior_medium.sigma_t.data"
    dr.enable_grad(params[key])
    params.update()
    weights = dr.full(mi.TensorXf, 1.0, (32, 32, 3))
    mi.load_dict(mivol(max_depth=3, shadows="exact")).render_backward(scene, params, weights, seed=1, spp=32)
    return found[0]


def test_baseline_of_a_large_pass_knows_the_shadows_of_a_sun(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most noise of the light about the baseline is the shadow of the smoke inside of blocks: light falls by exp(-0.17) along a
    block, and scatters again by a chance of at most 0.04."""
    sun = {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": 3.0}
    sums, known = find_baseline(monkeypatch, sun=sun)
    assert sums.table is not None
    monkeypatch.setattr(derivatives, "tabulate_direct_light", lambda *_: None)
    _, unknown = find_baseline(monkeypatch, sun=sun)
    assert known.noise[0] < 0.5 * unknown.noise[0]


@pytest.mark.parametrize("case", ["even", "small", "forward"])
def test_no_table_in_small_passes_nor_with_side_flights(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    light = {"sky": sky(1.0)} if case == "even" else {"sun": {"type": "directional", "direction": [0, 0, -1]}}
    if case == "small":
        monkeypatch.setattr(derivatives, "MIN_LISTED", 1 << 20)
    sums, _ = find_baseline(monkeypatch, g=0.8 if case == "forward" else 0.0, **light)
    assert sums.table is None
