"""What projections are made of: beams, noise, readings, notes, number by number; helices and several sources."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.config import Cone, Parallel
from mivol.errors import MivolError
from mivol.experiments import projections, readings
from mivol.experiments.projections import make_geometry
from mivol.experiments.readings import ScanReadings, note_order, to_radians
from mivol.experiments.scan_corrections import is_cut_off
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts
from mivol.tomography.geometry import ConeBeam, ParallelBeam
from mivol.tomography.panel_views import make_helix
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import Air, Quanta, Transmission, assume_quantum_noise
from mivol.tomography.rotation_axis import Axis


@pytest.mark.parametrize(("every", "count", "wanted"), [(0, 9, []), (3, 9, [1, 4, 7]), (4, 9, [2, 6]), (2, 3, [1])])
def test_views_are_held_out_from_the_middle_of_each_step_on(every: int, count: int, wanted: list[int]) -> None:
    assert projections.held_out_views(SimpleNamespace(held_out_every=every), count).tolist() == wanted


def test_some_views_must_be_fitted() -> None:
    assert_refused("held_out_every = 1 holds out all views", projections.held_out_views, SimpleNamespace(held_out_every=1), 9)


def test_noise_is_that_of_counted_quanta() -> None:
    """Poisson numbers from the seed; a pixel that counts none has weight 0; without quanta the projections are exact."""
    exact, truth = np.array([[[0.1, 1.0, 40.0]], [[0.0, 2.0, 3.0]]]), np.zeros(2)
    found = projections.add_noise("geometry", exact, truth, 50.0, 7)
    counts = np.random.default_rng(7).poisson(50 * np.exp(-exact))
    assert counts[0, 0, 2] == 0 and (found.weights == counts).all() and found.is_noise_known
    assert found.y[0, 0, 2] == 0
    np.testing.assert_allclose(found.y[counts > 0], -np.log(counts[counts > 0] / 50), rtol=1e-14)
    quanta = found.quanta
    assert (quanta.counts == counts).all() and quanta.used.all() and quanta.used.shape == counts.shape
    assert (quanta.blank, quanta.background, found.geometry) == (50.0, 0.0, "geometry") and found.truth is truth
    still = projections.add_noise("geometry", exact, truth, 0.0, 7)
    assert still.y is exact and (still.weights == 1).all() and still.quanta is None and not still.is_noise_known


def test_a_digest_is_that_of_projections_and_weights() -> None:
    one = projections.Projections("g", np.arange(3.0), np.ones(3))
    assert one.digest() == projections.Projections("h", np.arange(3.0), np.ones(3)).digest()
    for y, weights in ((np.ones(3), np.arange(3.0)), (np.ones(3), np.ones(3)), (np.arange(3.0), 2 * np.ones(3))):
        assert one.digest() != projections.Projections("g", y, weights).digest()


class FakeGrid:
    """A grid of 2 x 3 x 4 voxels around (1, 2, 3)."""

    shape, radius, centre = (2, 3, 4), 5.0, (1.0, 2.0, 3.0)


@pytest.mark.parametrize(("views", "asked"), [(3, [0, 1, 2]), (15, [0, 2, 4, 6, 8, 10, 12, 14])])
@pytest.mark.parametrize("seen", [0.0, 1.0])
def test_some_ray_must_meet_the_grid(views: int, asked: list[int], seen: float) -> None:
    """Up to eight views are looked at, from the first to the last."""
    chosen = []

    class Projector:
        grid, n_views, geometry = FakeGrid, views, SimpleNamespace(whole_lines=True)

        def subset(self, some: np.ndarray) -> Projector:
            chosen.extend(some.tolist())
            return self

        def __matmul__(self, x: np.ndarray) -> np.ndarray:
            assert x.shape == (2, 3, 4) and (x == 1).all()
            return np.array([0.0, seen])

    if seen:
        projections.check_hits(Projector())
    else:
        assert_refused(r"which reaches 5 from \(1.0, 2.0, 3.0\)", projections.check_hits, Projector())
    assert chosen == asked


def scan(**data: object) -> SimpleNamespace:
    """The settings of a measured scan in parallel light of 2 x 3 pixels of 1 x 0.5."""
    plain = {"air": 0, "find_axis": False, "drift": 0, "saturation": 99.0, "rings": "none", "ring_width": None}
    data = plain | {"zingers": 0.0, "phase": None, "scatter": False, "hardening": 0} | data
    beam = Parallel(views=2, detector=(2, 3), pitch=(1.0, 0.5), axis_offset=0.25)
    return SimpleNamespace(data=SimpleNamespace(**data), scan=beam, solve=config.SolveSettings("pcg"))


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> ScanReadings:
    """Two views of 2 x 3 pixels, one of which no light reaches; readings are known."""
    value = np.full((2, 2, 3), 0.5)
    value[1, 0, 2] = -1.0
    found = ScanReadings(
        Transmission(value, np.full(value.shape, 1e-4)), np.array([0.0, 1.0]), None, ("r", "f", "d"), ("noted",)
    )
    monkeypatch.setattr(projections, "read_scan", lambda chosen, base, rows=None: found)
    return found


def test_readings_become_line_integrals(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    found = projections.read_measured(scan(), Path())
    np.testing.assert_allclose(found.y.ravel()[:8], np.log(2))
    assert (found.weights == 0).sum() == 1 and found.y[1, 0, 2] == 0
    assert found.notes == ("noted", "1 of 12 pixels have no light or no finite reading: they are not used")
    assert found.is_noise_known and found.quanta is None and found.geometry.axis_offset == 0.25
    assert found.geometry.angles.tolist() == [0, 1] and found.geometry.pitch == (1.0, 0.5)
    # Through the middle of air of 0.5 at either edge nothing is left to see.
    monkeypatch.setattr(projections, "normalise_air", lambda t, n: Transmission(t.value * n, t.variance))
    monkeypatch.setattr(projections, "fit_air", lambda value, n: None)
    np.testing.assert_allclose(projections.read_measured(scan(air=2), Path()).y[0], 0, atol=1e-15)


def test_air_is_not_looked_for_before_the_scatter_is_known(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scattered light brightens the air; with hardening it is behind the object only."""
    asked = []
    monkeypatch.setattr(projections, "find_air", lambda t: asked.append(t))
    for changes in ({"scatter": True}, {"scatter": True, "hardening": 2}, {}):
        projections.read_measured(scan(air=None, **changes), Path())
        asked.append(None)
    assert [t is not None for t in asked] == [False, True, False, True, False]


def test_pictures_show_line_integrals_of_the_middle_row() -> None:
    """Half of the light is log 2; pixels without light are 0."""
    light = np.full((2, 3, 2), 0.5)
    light[0, 1] = np.nan, -1.0
    name, before, after = projections.show_step("air", light, 2 * light)
    assert name == "air"
    np.testing.assert_allclose(before, [[0, 0], [np.log(2), np.log(2)]])
    np.testing.assert_allclose(after, 0, atol=1e-15)


def test_mirror_images_continue_the_views_about_the_found_axis() -> None:
    """A disc beside the axis: the first mirror image equals the view before it, as the view half a turn later would."""
    angles, columns = np.arange(12) * np.pi / 6, np.arange(40)
    y = np.exp(-(((columns - 23.0 - 6 * np.cos(angles)[:, None]) / 3) ** 2))[:, None]
    beam = ParallelBeam(angles, (1, 40), (1.0, 0.5), axis_offset=(23 - 19.5) * 0.5 + 2, detector_offset=(0, 2))
    ((name, before, after),) = projections.show_axis(beam, y)
    assert name == "axis" and before.shape == after.shape == (12, 40)
    # Beyond the first column the disc has exp(-(11 / 3)^2) = 1.45e-6.
    np.testing.assert_allclose(after, y[:, 0], atol=1.5e-6)
    assert np.abs(before - y[:, 0]).max() > 0.5
    assert projections.show_axis(ConeBeam(angles, (1, 40), 1, 2), y) == []


def test_the_found_axis_of_a_displaced_detector(tmp_path: Path) -> None:
    """The same readings and another place of the detector: the axis is displaced as much."""
    head = shepp_logan(half_width=12.0)
    beam = ParallelBeam(np.arange(48) * np.pi / 48, (1, 40), axis_offset=1.3)
    np.save(tmp_path / "y.npy", 0.05 * head.project(beam).astype("f4"))
    data = {"source": "stack", "file": str(tmp_path / "y.npy"), "reading": "line_integral"}
    found = [
        projections.read_measured(
            config.from_dict({"title": "a", "scan": {"beam": "parallel", "detector_offset": [0.0, d]}, "data": data}), Path()
        ).geometry.axis_offset
        for d in (0.0, 5.0)
    ]
    assert abs(found[0] - 1.3) < 0.2 and abs(found[1] - found[0] - 5) < 1e-9


def test_views_at_one_angle_are_no_radians() -> None:
    with pytest.raises(MivolError, match="all 20 views have the angle 0: give the angles"):
        readings.check_unit(np.zeros(20), "degree", "set angle_unit")


def test_voxels_that_hold_what_the_detector_sees() -> None:
    """A voxel a pixel at the axis; twice the wider side of the detector after a turn with the axis far from the middle."""
    turn = np.arange(40) * np.pi / 20
    for angles, offset, columns in ((turn / 2, 20.0, 60), (turn, 3.0, 60), (turn, 20.0, 100), (turn, -20.0, 100)):
        grid = projections.grid_of_detector(ParallelBeam(angles, (3, 60), (2.0, 0.5), axis_offset=offset / 2))
        assert (grid.shape, tuple(grid.voxel_size)) == ((3, columns, columns), (0.5, 0.5, 2.0))
    cone = ConeBeam(turn, (3, 60), 4.0, 8.0, (2.0, 0.5), axis_offset=5.0)
    grid = projections.grid_of_detector(cone)
    # Magnified twice, 5 is 20 columns of .5 beside the middle.
    assert (grid.shape, tuple(grid.voxel_size)) == ((3, 100, 100), (0.25, 0.25, 1.0))


def test_air_is_looked_for_unless_the_settings_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found is said and used if it is needed; 0 leaves the light, and nothing that is not needed changes a bit."""
    light = Transmission(np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 1e-4))
    air = Air(np.array([0.5, 0.5]), 4, 0.001, True)
    monkeypatch.setattr(projections, "find_air", lambda t: air)
    found, factor, (note,) = projections.correct_air(light, None)
    assert (found.value == 1).all() and (factor == 0.5).all() and factor.shape == (2, 1, 1)
    assert note.startswith("the air at both edges of the detector has 0.5 +- 0.001 of the flats' light: views are divided")
    assert projections.correct_air(light, 0) == (light, None, [])
    air = replace(air, is_needed=False)
    assert projections.correct_air(light, None) == (light, None, [])
    air = replace(air, is_believed=False)
    assert "have 0.5 of the flats' light, too far from 1" in (found := projections.correct_air(light, None))[2][0]
    assert found[:2] == (light, None) and "data.air = 4 divides by it" in found[2][0]
    air = replace(air, is_needed=True, factor=np.array([0.5, 0.6]))
    assert "has 0.5 to 0.6 of" in projections.correct_air(light, None)[2][0]


@pytest.mark.parametrize("beam", ["parallel", "cone"])
def test_lost_views_are_left_out_and_said(tmp_path: Path, beam: str, variant_rgb: str) -> None:
    """The shutter closed for view 5, and view 17 is saturated: the others give the axis, and the air of .8, as without them."""
    distances = {"source_to_axis": 400.0, "source_to_detector": 500.0} if beam == "cone" else {}
    angles = np.radians(360 / 40 * np.arange(40))
    place = {"axis_offset": 2.0}
    geometry = ConeBeam(angles, (2, 60), **distances, **place) if beam == "cone" else ParallelBeam(angles, (2, 60), **place)
    head = shepp_logan(half_width=16.0)
    light = 0.8 * np.exp(-0.02 * head.integrate_lines(*geometry.rays(), whole_lines=True)).astype(np.float32)
    scan = {"beam": beam, "arc": 360.0, **distances}
    settings = {"title": "a", "scan": scan, "data": {"source": "stack", "file": "a.npy", "reading": "transmission"}}

    def read() -> projections.Projections:
        np.save(tmp_path / "a.npy", light)
        return projections.read_measured(config.from_dict(settings, "a"), tmp_path)

    whole = read()
    light[5], light[17] = 0, 2.5
    found = read()
    assert found.geometry.axis_offset == pytest.approx(whole.geometry.axis_offset, abs=0.1)
    used = np.setdiff1d(np.arange(40), (5, 17))
    assert (found.weights[[5, 17]] == 0).all() and (found.weights[used] > 0).all()
    np.testing.assert_allclose(found.y[used], whole.y[used], atol=1e-6)
    assert found.notes[:2] == (
        "1 of 40 views are not used, because they are without light: 5 (counted from 0)",
        "1 of 40 views are not used, because they are brighter than any view can be: 17 (counted from 0)",
    )
    light[:] = 0
    assert projections.leave_out_lost_views(assume_quantum_noise(light))[1] == []


def test_a_scan_without_rings_stays() -> None:
    """80 views of noise, whose columns agree in no two arcs: the same array, and a line that says so."""
    y = np.random.default_rng(3).normal(size=(80, 2, 40))
    for rings in ("gain", "fit"):
        found, notes = projections.correct_rings(y, np.ones(y.shape), scan(rings=rings).data)
        assert found is y and notes == [f'no rings above chance: nothing is removed (data.rings = "{rings}")']


def test_rings_stay_unless_the_settings_say(measured: ScanReadings) -> None:
    """Off, the line integrals are the same array and nothing is said; on, what is removed from the middle row is kept."""
    before = projections.read_measured(scan(), Path())
    assert before.removed_rings is None
    y, notes = projections.correct_rings(before.y, before.weights, scan().data)
    assert y is before.y and notes == []
    measured.transmission.value[:, 1, 1] *= 1.5
    before = projections.read_measured(scan(), Path()).y
    found = projections.read_measured(scan(rings="sort", ring_width=3), Path())
    # Columns of log 2, log 2 - log 1.5, log 2: the median is log 2.
    np.testing.assert_allclose(found.y[found.weights > 0], np.log(2), rtol=1e-14)
    np.testing.assert_array_equal(found.removed_rings, (before - found.y)[:, 1])
    size = np.sqrt(np.mean((before - found.y) ** 2))
    assert found.notes[1] == f'ring removal (data.rings = "sort", 3 columns) changed the line integrals by {size:.2g} (RMS)'
    found = projections.read_measured(scan(rings="gain", ring_width=3), Path())
    assert 'data.rings = "gain", 3 columns' in found.notes[1] and found.removed_rings[0, 1] < 0
    with pytest.raises(MivolError, match=r"ring width of 14, expected a number from 3 to the 3 columns: set data.ring_width"):
        projections.read_measured(scan(rings="gain"), Path())
    with pytest.raises(MivolError, match=r"ring width of 7, expected an odd number from 3 to the 3 columns"):
        projections.read_measured(scan(rings="sort"), Path())


def test_an_axis_that_is_found_takes_the_place_of_the_settings(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Column 1.75 of three lies 0.75 of a column beyond the middle, and columns are 0.5 wide."""
    monkeypatch.setattr(projections, "find_axis", lambda y, w, angles: Axis(1.75, 0.125, "some way"))
    found = projections.read_measured(scan(find_axis=True), Path())
    assert found.geometry.axis_offset == 0.375
    assert "rotation axis at column 1.75 +- 0.12 (some way)" in found.notes


def test_the_axis_by_entropy_is_told_beside_the_other(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """The found axis without a deviation, and what the usual methods say, or why they say nothing."""
    monkeypatch.setattr(projections, "axis_from_entropy", lambda y, w, angles: Axis(1.75, np.nan, "entropy"))
    monkeypatch.setattr(projections, "find_axis", lambda y, w, angles: Axis(1.5, 0.125, "some way"))
    found = projections.read_measured(scan(find_axis="entropy"), Path())
    assert found.geometry.axis_offset == 0.375
    assert "rotation axis at column 1.75 (entropy; no standard deviation is known)" in found.notes
    assert "data.find_axis = true says column 1.50 +- 0.12 (some way)" in found.notes

    def refuse(*_: object) -> Axis:
        raise MivolError("no axis.")

    monkeypatch.setattr(projections, "find_axis", refuse)
    found = projections.read_measured(scan(find_axis="entropy"), Path())
    assert "data.find_axis = true finds none: no axis." in found.notes


def test_views_without_any_light_are_refused(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flats that are far too bright leave no reading above its noise."""
    monkeypatch.setattr(projections, "to_line_integrals", lambda t: (np.zeros(t.value.shape), np.zeros(t.value.shape)))
    with pytest.raises(MivolError, match="found no reading of the views with light, expected some: give flats"):
        projections.read_measured(scan(find_axis=True), Path())


def test_an_offset_in_the_settings_holds_where_nothing_more_is_said(
    measured: ScanReadings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is not looked for then, which is said; without an offset it is."""
    monkeypatch.setattr(projections, "find_axis", lambda y, w, angles: Axis(1.75, 0.125, "some way"))
    chosen = scan(find_axis=None)
    found = projections.read_measured(chosen, Path())
    assert found.geometry.axis_offset == 0.25
    assert "the rotation axis is where scan.axis_offset has it, 0.25: data.find_axis = true looks for it" in found.notes
    chosen.scan = Parallel(views=2, detector=(2, 3), pitch=(1.0, 0.5))
    assert projections.read_measured(chosen, Path()).geometry.axis_offset == 0.375
    chosen.data.find_axis = False
    found = projections.read_measured(chosen, Path())
    assert found.geometry.axis_offset == 0 and not any("axis" in note for note in found.notes)


def test_the_axis_of_a_cone_takes_the_place_of_the_settings(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Column 1.75 lies 0.375 beyond the middle, half as far at the axis; where the scan does not tell it, that is said."""
    chosen = scan(find_axis=True)
    chosen.scan = Cone(views=2, detector=(2, 3), pitch=(1.0, 0.5), axis_offset=0.25, source_to_axis=4, source_to_detector=8)
    monkeypatch.setattr(projections, "axis_from_fans", lambda y, w, beam: Axis(1.75, 0.125, "some way"))
    found = projections.read_measured(chosen, Path())
    assert found.geometry.axis_offset == 0.1875
    assert "rotation axis at column 1.75 +- 0.12 (some way)" in found.notes

    def nothing(*_: object) -> None:
        raise MivolError("found nothing.")

    monkeypatch.setattr(projections, "axis_from_fans", nothing)
    found = projections.read_measured(chosen, Path())
    assert found.geometry.axis_offset == 0.25
    assert "the rotation axis is where scan.axis_offset has it, 0.25: found nothing." in found.notes


def test_as_many_views_as_the_geometry_has(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(projections, "make_beam", lambda *asked: SimpleNamespace(shape=(3, 2, 3)))
    assert_refused("found 2 projections and a geometry of 3 views", projections.read_measured, scan(), Path())


def test_quanta_are_those_of_the_readings(measured: ScanReadings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where air is named the light is as bright as it is there; a drift, ring removal, or no readings, leave none."""
    blank = np.full((2, 2, 3), 8.0)
    made = Quanta(np.ones((2, 2, 3)), blank, 0.5, np.ones((2, 2, 3), bool))
    monkeypatch.setattr(projections, "count_quanta", lambda *asked: made if asked == ("r", "f", "d", 99.0) else None)
    assert projections.count_measured_quanta(scan(), measured) is made
    assert (projections.count_measured_quanta(scan(), measured, np.full((2, 1, 1), 0.5)).blank == 4).all()
    bare = ScanReadings(measured.transmission)
    for chosen, found in ((scan(drift=1), measured), (scan(rings="gain"), measured), (scan(), bare)):
        assert_refused("ml-tr needs counts of quanta", projections.count_measured_quanta, chosen, found)
    problems = {"pcg": SimpleNamespace(problem=LeastSquares), "ml-tr": SimpleNamespace(problem=PoissonCounts)}
    monkeypatch.setattr(projections, "ALL_SOLVERS", problems)
    chosen = scan()
    chosen.solve = config.SolveSettings("ml-tr")
    assert projections.read_measured(chosen, Path()).quanta is made


def test_angles_in_the_wrong_unit_are_noticed() -> None:
    """Up to 8 turns may be radians; 16 views and more within a turn of 2 pi are no degrees, 15 may be."""
    turns = np.array([0.0, 16 * np.pi])
    assert to_radians(turns, "radian") is turns
    assert to_radians(np.array([0.0, 180.0]), "degree").tolist() == [0, np.pi]
    assert_refused(r"span 51 radians \(8 turns\)", to_radians, np.array([0.0, 51.0]), "radian")
    assert_refused("16 views span 6.283 degrees", to_radians, np.linspace(0, 2 * np.pi, 16), "degree")
    to_radians(np.linspace(0, 2 * np.pi, 15), "degree")
    to_radians(np.linspace(0, 6.3, 16), "degree")


def test_angles_that_turn_back_are_noted() -> None:
    """Against the way that most steps go; equal ones do not turn."""
    assert (
        note_order(np.array([0.0, 1.0, 1.0, 2.0])) == note_order(np.array([2.0, 1.0, 0.0])) == note_order(np.array([1.0])) == []
    )
    (said,) = note_order(np.radians([0.0, 10, 5, 20, 15, 30]))
    assert said == ("the angles turn back 2 times (view 2 at 5.00 degrees follows view 1 at 10.00): they are used as given")
    assert "turn back 1 times (view 3 at 2.00" in note_order(np.radians([3.0, 2, 1, 2, 0]))[0]


def test_angles_of_a_stack(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evenly over the arc where none are listed, else those of the file, one a view."""
    beam = Parallel(views=2, detector=(2, 3), arc=90.0)
    chosen = SimpleNamespace(data=SimpleNamespace(angles="", angle_unit="degree"), scan=beam)
    np.testing.assert_allclose(readings.read_angles(chosen, Path(), 3), np.radians([0, 30, 60]))
    monkeypatch.setattr(readings, "read_tilt_angles", lambda path: np.array([10.0, 20.0]) if str(path) == "b/a" else 0)
    chosen.data.angles = "a"
    np.testing.assert_allclose(readings.read_angles(chosen, Path("b"), 2), np.radians([10, 20]))
    assert_refused("a has 2 angles for 3 projections", readings.read_angles, chosen, Path("b"), 3)


def test_views_brighter_than_the_flats_are_refused() -> None:
    """The median decides, and pixels that are not finite do not count."""
    value = np.full((2, 2, 3), 1.2)
    value[0, 0] = np.nan, 9.0, 9.0
    projections.check_light(Transmission(value, value))
    projections.check_light(Transmission(np.full((1, 1, 2), np.nan), value))
    with pytest.raises(MivolError, match="found views with 4 times the light of the flats .* set data.air"):
        projections.check_light(Transmission(np.full((2, 2, 3), 4.0), value))


@pytest.mark.parametrize(
    ("rows", "wanted"), [([0.0, 1, 2, 1, 0.05], False), ([0.0, 1, 2, 1, 0.2], True), ([2.0, 1, 1, 0, 0], True)]
)
def test_an_object_that_goes_on_beyond_the_rows_is_named(rows: list[float], wanted: bool) -> None:
    """A tenth of the mean mass of a row, in the first or last one; unused pixels do not count."""
    y = np.array(rows)[None, :, None] * np.ones((3, 1, 4))
    weights = np.ones(y.shape)
    assert is_cut_off(y, weights) == wanted
    y[0, 0, 0], weights[0, 0, 0] = 1000.0, 0.0
    assert is_cut_off(y, weights) == wanted


# -- Trajectories ------------------------------------------------------------------------------------------------------

SCENES = Path(__file__).parents[2] / "scenes/trajectories"
BEAM = ConeBeam(np.radians([0.0, 90.0, 360.0, 720.0]), (3, 5), 4.0, 6.0, 0.5, 0.25, (0.125, 0.0))


def test_a_helix_rises_with_the_angle() -> None:
    """A lift of 2 a turn: over two turns the heights of source and detector are -2, -1.5, 0 and 2; nothing else moves."""
    found, flat = make_helix(BEAM, 2.0).panels(), BEAM.panels()
    rise = np.array([-2.0, -1.5, 0.0, 2.0])[:, None] * [0, 0, 1]
    np.testing.assert_allclose(found.source, flat.source + rise, atol=1e-12)
    np.testing.assert_allclose(found.corner, flat.corner + rise, atol=1e-12)
    np.testing.assert_array_equal(found.along_u, flat.along_u)


def test_sources_have_all_views_one_after_the_other() -> None:
    """Two sources: views 0 and 1 of the first, 2 and 3 of the second; shifted along the columns and z, the detector rests."""
    found, flat = make_helix(BEAM, 0.0, [(0.5, 0.0), (-1.0, 2.0)]).panels(), BEAM.panels()
    u = flat.along_u / 0.5
    np.testing.assert_allclose(found.source[:2], flat.source[:2] + 0.5 * u[:2], atol=1e-12)
    np.testing.assert_allclose(found.source[2:], flat.source[2:] - 1.0 * u[2:] + [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(found.corner, flat.corner, atol=1e-12)
    assert_refused("found 4 views of 3 sources, expected as many views of each source", make_helix, BEAM, 0.0, [(0, 0)] * 3)


def test_settings_spread_the_views_of_each_source() -> None:
    settings = config.load(SCENES / "sources.toml", ["scan.views=5"])
    beam = make_geometry(settings, SCENES)
    assert beam.shape[0] == 15
    heights = beam.panels().source[:, 2].reshape(3, 5)
    np.testing.assert_allclose(heights, np.repeat([[-0.8], [0.0], [0.8]], 5, axis=1), atol=1e-12)
    np.testing.assert_allclose(*beam.panels().corner.reshape(3, 5, 3)[[0, 2]], atol=1e-12)


def test_an_axis_is_found_on_a_circle_only() -> None:
    text = 'title = "t"\nscan = { beam = "cone", lift = 1, source_to_axis = 2, source_to_detector = 3 }\n'
    data = 'data = { source = "stack", file = "a.npy", reading = "transmission", find_axis = true }\n'
    for changed, found in (("", "find_axis"), ("find_axis = true", "grid")):
        raw = text + (data if not changed else data.replace(", find_axis = true", ""))
        assert_refused(found, config.from_dict, tomllib.loads(raw), "t.toml")
    raw = text.replace("lift = 1, ", "") + data.replace("= true", '= "entropy"')
    assert_refused('"entropy" needs beam = "parallel"', config.from_dict, tomllib.loads(raw), "t.toml")


README = (SCENES / "README.md").read_text()
ERRORS = {name: float(error) for name, error in re.findall(r"^\| `(\w+)\.toml` .* \| (0\.\d+)[\w ]* \|$", README, re.M)}
"""The errors that the README states."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ERRORS)
def test_errors_of_the_trajectories(variant_rgb: str, tmp_path: Path, name: str) -> None:
    """As stated, and 3 % for other processors: fits without noise have no random numbers."""
    assert main(["optimize", str(SCENES / f"{name}.toml"), "-o", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run/run.json").read_text())["results"]["nrmse"] == pytest.approx(ERRORS[name], rel=0.03)


def test_each_trajectory_has_its_error() -> None:
    assert {file.stem for file in SCENES.glob("*.toml")} == set(ERRORS)
    assert all(len(file.read_text().splitlines()) <= 10 for file in SCENES.glob("*.toml"))
