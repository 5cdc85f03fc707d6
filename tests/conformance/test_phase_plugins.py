"""The phase function plugins: the contract of Mitsuba's own tests, and stock ones where those are right."""

from __future__ import annotations

import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, assert_precise, assert_same_mean, fresh, note
from scattering_scenes import cases

from mivol.phase.table import Table
from mivol.validate.statistics import Moments
from scenes import box_of, camera, render, sky

ROOT = Path(__file__).parents[2]
EPS = 2.0**-23


def grid(values: np.ndarray, kind: str = "gridvolume") -> dict:
    values = np.asarray(values, np.float32)
    if kind == "gridvolume":
        return {"type": kind, "grid": mi.VolumeGrid(values), "raw": True}
    return {"type": kind, "data": mi.TensorXf(values[..., None])}


REGISTERED = re.findall(r'register_phase\("(\w+)"', (ROOT / "mivol/plugins/phases.py").read_text())
CLOSED_FORMS = {kind: {"type": kind} for kind in REGISTERED if kind not in ("mivol_tabulated", "mivol_mixture")}
"""Every phase function that needs no settings, with its defaults: a new one is tested by everything below."""

PEAK = Table([-1, -0.8, -0.1, 0.3, 0.95, 1.0], [1.0, 0.2, 0.0, 0.5, 2.0, 30.0])
PHASES = {
    **CLOSED_FORMS,
    "hg": {"type": "mivol_hg", "g": 0.6},
    "hg backwards": {"type": "mivol_hg", "g": -0.85},
    "hg isotropic": {"type": "mivol_hg", "g": 0.0},
    "hg nearly isotropic": {"type": "mivol_hg", "g": 1e-7},
    "cornette-shanks": {"type": "mivol_draine", "g": 0.5},
    "draine": {"type": "mivol_draine", "g": -0.6, "alpha": 27.0},
    "table": {"type": "mivol_tabulated", "values": "0.5, 1.0, 1.5"},
    "irregular table": PEAK.to_dict(),
    "moments": {"type": "mivol_tabulated", "moments": "1, 0.3, 0.2"},
    "mixture": {
        "type": "mivol_mixture",
        "front": {"type": "mivol_hg", "g": 0.8},
        "back": {"type": "hg", "g": -0.4},
        "rest": {"type": "rayleigh"},
        "weight_front": 2.0,
        "weight_back": 0.5,
        "weight_rest": 1.5,
    },
    "mixture of mixtures": {
        "type": "mivol_mixture",
        "a": {"type": "blendphase", "weight": 0.3, "x": {"type": "isotropic"}, "y": {"type": "mivol_rayleigh"}},
        "b": {"type": "mivol_mixture", "c": {"type": "mivol_hg", "g": 0.3}, "d": {"type": "isotropic"}},
    },
}


def interaction(wi: np.ndarray, points: np.ndarray | None = None) -> mi.MediumInteraction3f:
    """Interactions with directions (n, 3) back to where light's adjoint came from."""
    wi = np.atleast_2d(wi)
    mei = dr.zeros(mi.MediumInteraction3f, len(wi))
    mei.wi = mi.Vector3f(np.ascontiguousarray(wi.T, dtype=np.float32))
    mei.sh_frame = mi.Frame3f(mei.wi)
    if points is not None:
        mei.p = mi.Point3f(np.ascontiguousarray(points.T, dtype=np.float32))
    return mei


def directions(n: int, seed: int) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def vector(d: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(np.ascontiguousarray(d.T, dtype=np.float32))


def value_and_pdf(phase: mi.PhaseFunction, mei: mi.MediumInteraction3f, wo: mi.Vector3f) -> tuple[np.ndarray, np.ndarray]:
    value, pdf = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)
    return np.array(value[0], dtype=np.float64), np.array(pdf, dtype=np.float64)


# -- The contract ------------------------------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.parametrize("name", PHASES)
def test_chi_square(each_variant, name):
    """Samples are distributed as eval_pdf says."""
    given = PHASES[name]
    sample, pdf = mi.chi2.PhaseFunctionAdapter(given["type"], given)
    # A table has corners, and a lobe of width 0.05: the rule over each cell needs more points than Mitsuba's four.
    test = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=51, ires=16, seed=fresh(0)
    )
    held = test.run(significance_level=ALPHA, quiet=True)
    note(ALPHA, "directions", test.p_value)
    assert held, test.messages


@pytest.mark.parametrize("name", PHASES)
def test_normalised_and_reciprocal_and_weighted_by_value_over_pdf(each_variant, name):
    phase = mi.load_dict(PHASES[name])
    # Normalised: a mean over a quadrature in the cosine (in pieces, for the corners of tables) at one azimuth.
    corners = np.unique(np.concatenate([PEAK.cosines, [0.99, 0.999]]))
    x, w = np.polynomial.legendre.leggauss(24)
    middle, half = (corners[1:] + corners[:-1]) / 2, np.diff(corners) / 2
    c, w = (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()
    wo = np.stack([np.sqrt(1 - c * c), 0 * c, -c], axis=1)
    value, pdf = value_and_pdf(phase, interaction(np.tile([0.0, 0, 1], (len(c), 1))), vector(wo))
    # 24 nodes in each piece are exact to 1e-7 for these lobes; float32 values are right to 1e-6, and so is their mean. The
    # table of moments has nodes of its own: chords over 1/32 of the half circle are cut at other places, 1e-4.
    assert 2 * np.pi * (value @ w) == pytest.approx(1, abs=2e-4 if name == "moments" else 3e-6)
    assert np.array_equal(value, pdf)
    # Reciprocal: light may go the other way, p(wi, wo) = p(wo, wi).
    a, b = directions(512, 1), directions(512, 2)
    one, other = value_and_pdf(phase, interaction(a), vector(b))[0], value_and_pdf(phase, interaction(b), vector(a))[0]
    assert np.max(np.abs(one - other)) <= 4 * EPS * one.max()
    # Weight = value / pdf, and the density returned is that of the direction returned.
    u = np.random.default_rng(3).uniform(0, 1, (3, 512)).astype(np.float32)
    mei = interaction(a)
    wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(), mei, mi.Float(u[0]), mi.Point2f(u[1:]))
    value, density = value_and_pdf(phase, mei, wo)
    weight, pdf = np.broadcast_to(np.array(weight[0]), (512,)), np.array(pdf)
    # A direction is rounded to 3/2 eps, and the steepest lobe here changes by 1/0.05 of itself in its width.
    assert np.max(np.abs(density / pdf - 1)) <= 60 * EPS
    assert np.max(np.abs(weight - value / density)) <= 8 * EPS
    assert np.max(np.abs(np.linalg.norm(np.array(wo), axis=0) - 1)) <= 4 * EPS


def test_convention_of_directions(each_variant):
    """wi points back: straight on is -wi. The checks of Mitsuba's tests of tabphase, on irregular cosines."""
    phase = mi.load_dict({"type": "mivol_tabulated", "values": "0, 0.5, 1"})
    wo, _, pdf = phase.sample(mi.PhaseFunctionContext(), interaction([0, 0, 1]), 0.0, mi.Point2f(1, 0))
    assert dr.allclose(wo, [0, 0, -1])
    assert dr.allclose(pdf, 0.5 / dr.pi)
    phase = mi.load_dict({"type": "mivol_tabulated", "cosines": "-1, 0.5, 1", "values": "0.5, 1.0, 1.5"})
    wo = directions(256, 4)
    value, _ = value_and_pdf(phase, interaction(np.tile([0.0, 0, -1], (256, 1))), vector(wo))
    want = np.interp(wo[:, 2], [-1, 0.5, 1], [0.5, 1, 1.5]) / (2 * np.pi * np.trapezoid([0.5, 1, 1.5], [-1, 0.5, 1]))
    assert np.max(np.abs(value - want)) <= 8 * EPS


def test_flags_and_projected_area(each_variant):
    for given in PHASES.values():
        phase = mi.load_dict(given)
        assert mi.has_flag(phase.flags(), mi.PhaseFunctionFlags.Anisotropic)
        assert not mi.has_flag(phase.flags(), mi.PhaseFunctionFlags.Microflake)
        assert dr.allclose(phase.projected_area(interaction([0, 0, 1])), 1)
    mixed = mi.load_dict({"type": "mivol_mixture", "a": {"type": "isotropic"}, "b": {"type": "isotropic"}})
    assert mixed.flags() == int(mi.PhaseFunctionFlags.Isotropic)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_derivatives_by_parameters_are_differences_of_values(each_variant, name):
    """Each parameter of each closed form, at its default, against central differences of two steps."""
    phase, mei, wo = mi.load_dict(CLOSED_FORMS[name]), interaction(directions(64, 20)), vector(directions(64, 21))
    params = mi.traverse(phase)
    for key, default in ((key, float(value[0])) for key, value in params):

        def values(x: float, key: str = key) -> np.ndarray:
            params[key] = mi.Float(x)
            params.update()
            return value_and_pdf(phase, mei, wo)[0]

        fine, coarse = ((values(default + h) - values(default - h)) / (2 * h) for h in (2.0**-7, 2.0**-6))
        params[key] = mi.Float(default)
        dr.enable_grad(params[key])
        params.update()
        value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)
        dr.forward(params[key])
        slope = np.array(dr.grad(value[0]), dtype=np.float64)
        # The error of a step h is c h^2 at leading order: the difference of the two steps is 3 times that of the fine one, of
        # which all is allowed for. Values are rounded by 4 eps each.
        assert np.all(np.abs(slope - fine) <= np.abs(fine - coarse) + 4 * EPS * np.abs(value_and_pdf(phase, mei, wo)[0]) * 2**7)


# -- Loading -----------------------------------------------------------------------------------------------------------------


def test_xml(each_variant, tmp_path):
    (tmp_path / "drops.csv").write_text("angle,value\n0,3\n90,1\n180,2\n")
    scenes = {
        **{
            kind: "".join(f'<float name="{key}" value="0.3"/>' for key, _ in mi.traverse(mi.load_dict(given)))
            for kind, given in CLOSED_FORMS.items()
        },
        "mivol_tabulated": f'<string name="filename" value="{tmp_path / "drops.csv"}"/>',
        "mivol_mixture": '<phase name="a" type="hg"/><phase name="b" type="mivol_rayleigh"/>'
        '<float name="weight_a" value="0.2"/>'
        '<volume name="weight_b" type="constvolume"><float name="value" value="1"/></volume>',
    }
    for kind, inner in scenes.items():
        phase = mi.load_string(f'<phase version="3.0.0" type="{kind}">{inner}</phase>')
        assert kind in str(phase)
    tensor = mi.load_dict({"type": "mivol_tabulated", "values": mi.TensorXf([0.0, 1.0, 2.0, 1.0]), "cosines": "-1, 0, 0.5, 1"})
    assert np.array_equal(np.array(mi.traverse(tensor)["values"]), [0, 1, 2, 1])
    # Beside the table: value 1 at 90 degrees, over 2 pi times the integral (3 + 2 1 + 2)/2.
    value, _ = value_and_pdf(
        mi.load_string(f'<phase version="3.0.0" type="mivol_tabulated">{scenes["mivol_tabulated"]}</phase>'),
        interaction([0, 0, 1]),
        vector(np.array([[1.0, 0, 0]])),
    )
    assert value[0] == pytest.approx(1 / (2 * np.pi * 3.5), rel=4 * EPS)


BAD = [
    ({"type": "mivol_hg", "gg": 0.1}, "gg"),
    ({"type": "mivol_hg", "g": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}, "number or a volume"),
    ({"type": "mivol_rayleigh", "g": 0.1}, "unreferenced"),
    ({"type": "mivol_draine", "a": 0.1}, "unreferenced"),
    ({"type": "mivol_tabulated"}, "exactly one"),
    ({"type": "mivol_tabulated", "values": "1, 2", "moments": "1"}, "exactly one"),
    ({"type": "mivol_tabulated", "values": "1, 2, x"}, "list of numbers"),
    ({"type": "mivol_tabulated", "values": "1, 2", "angles": "1, 2"}, "angles"),
    ({"type": "mivol_tabulated", "values": "1, 2", "cosines": "-1, 0.9"}, "-1 to 0.9"),
    ({"type": "mivol_tabulated", "moments": "1, 0.9"}, "negative|more moments"),
    ({"type": "mivol_tabulated", "filename": "missing.csv"}, "cannot be read"),
    ({"type": "mivol_mixture"}, "no phase function"),
    ({"type": "mivol_mixture", "a": {"type": "hg"}, "b": {"type": "hg"}, "weight_a": 0.5}, "weight_b"),
    ({"type": "mivol_mixture", "a": {"type": "hg"}, "weight": 0.5}, "weight"),
    ({"type": "mivol_mixture", "a": {"type": "hg"}, "odd": {"type": "constvolume", "value": 1.0}}, "odd"),
]


@pytest.mark.parametrize(("given", "words"), BAD, ids=[str(i) for i in range(len(BAD))])
def test_what_cannot_be_is_refused(each_variant, given, words):
    with pytest.raises(Exception, match=words):
        mi.load_dict(given)


def test_coloured_volumes_are_refused():
    mi.set_variant("llvm_ad_rgb")
    rgb = {"type": "constvolume", "value": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    for volume in (rgb, grid(np.full((2, 2, 2, 3), 0.5))):
        with pytest.raises(Exception, match="3 channels"):
            mi.load_dict({"type": "mivol_hg", "g": volume})


def test_switching_variants_in_one_process():
    reference = {}
    for name in ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        mi.set_variant(name)
        if name.startswith("scalar"):
            continue
        for key, given in PHASES.items():
            a, b = directions(64, 5), directions(64, 6)
            got = value_and_pdf(mi.load_dict(given), interaction(a), vector(b))[0]
            assert np.array_equal(reference.setdefault((name, key), got), got)


@pytest.mark.slow
def test_spectral_and_polarised_variants():
    """What is grey there as well: the same numbers, in each wavelength and on the diagonal."""
    a, b = directions(16, 18), directions(16, 19)
    for key, given in PHASES.items():
        results = []
        for name in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized"):
            mi.set_variant(name)
            value, pdf = mi.load_dict(given).eval_pdf(mi.PhaseFunctionContext(), interaction(a), vector(b))
            grey = np.array(value[0][0][0] if mi.is_polarized else value[0])
            assert np.array_equal(grey, np.array(pdf)), key
            results.append(grey)
        assert np.array_equal(results[0], results[1])
        assert np.array_equal(results[0], results[2])


# -- Volumes as parameters ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["gridvolume", "mivol_voxels"])
def test_volumes_are_evaluated_where_light_scatters(each_variant, kind):
    """g and a weight as grids of one voxel on either side: as the float in each half."""
    g, w = np.zeros((1, 1, 2)), np.zeros((1, 1, 2))
    g[..., 0], g[..., 1] = 0.2, 0.7
    w[..., 0], w[..., 1] = 1.0, 0.0
    field = mi.load_dict({"type": "mivol_draine", "g": grid(g, kind), "alpha": grid(10 * g, kind)})
    mixed = mi.load_dict(
        {
            "type": "mivol_mixture",
            "a": {"type": "mivol_hg", "g": grid(g, kind)},
            "b": {"type": "mivol_rayleigh"},
            "weight_a": grid(w, kind),
            "weight_b": grid(1 - w, kind),
        }
    )
    a, b = directions(128, 7), directions(128, 8)
    for x, value, other in ((0.1, 0.2, {"type": "mivol_hg", "g": 0.2}), (0.9, 0.7, {"type": "mivol_rayleigh"})):
        mei = interaction(a, np.tile([x, 0.5, 0.5], (128, 1)))
        plain = mi.load_dict({"type": "mivol_draine", "g": value, "alpha": 10 * value})
        for phase, same in ((field, plain), (mixed, mi.load_dict(other))):
            got, want = value_and_pdf(phase, mei, vector(b))[0], value_and_pdf(same, mei, vector(b))[0]
            # Between equal voxels the interpolation rounds once or twice.
            assert np.max(np.abs(got / want - 1)) <= 40 * EPS


def test_keys(each_variant):
    box = {
        "type": "mivol_mixture",
        "a": {"type": "mivol_hg", "g": grid(np.full((2, 2, 2), 0.5))},
        "b": {"type": "mivol_draine"},
        "c": {"type": "mivol_tabulated", "values": "1, 2, 3"},
        "weight_a": grid(np.ones((2, 2, 2))),
        "weight_b": 1.0,
        "weight_c": 1.0,
    }
    params = mi.traverse(mi.load_dict(box))
    keys = ["weight_a.data", "weight_b", "weight_c", "a.g.data", "b.g", "b.alpha", "c.values"]
    assert sorted(k for k, _ in params) == sorted(keys)
    for key in keys:
        assert not params.flags(key) & mi.ParamFlags.NonDifferentiable


def test_updates_are_seen(each_variant):
    phase = mi.load_dict(PHASES["mixture"])
    params = mi.traverse(phase)
    params["front.g"], params["weight_back"] = 0.1, 0.0
    params.update()
    fresh = {**PHASES["mixture"], "front": {"type": "mivol_hg", "g": 0.1}, "weight_back": 0.0}
    a, b = interaction(directions(64, 9)), vector(directions(64, 10))
    assert np.array_equal(value_and_pdf(phase, a, b)[0], value_and_pdf(mi.load_dict(fresh), a, b)[0])
    phase = mi.load_dict({"type": "mivol_tabulated", "values": "1, 1, 1"})
    params = mi.traverse(phase)
    params["values"] = mi.Float(0.5, 1.0, 1.5)
    params.update()
    assert np.array_equal(value_and_pdf(phase, a, b)[0], value_and_pdf(mi.load_dict(PHASES["table"]), a, b)[0])


# -- Stock, where it is right --------------------------------------------------------------------------------------------------


PAIRS = {
    "hg": (PHASES["hg"], {"type": "hg", "g": 0.6}),
    "rayleigh": (PHASES["mivol_rayleigh"], {"type": "rayleigh"}),
    "isotropic": (PHASES["hg isotropic"], {"type": "isotropic"}),
    "table": (PHASES["table"], {"type": "tabphase", "values": "0.5, 1.0, 1.5"}),
    "mixture": (
        {"type": "mivol_mixture", "a": {"type": "hg", "g": 0.2}, "b": {"type": "rayleigh"}, "weight_a": 0.3, "weight_b": 0.7},
        {"type": "blendphase", "a": {"type": "rayleigh"}, "b": {"type": "hg", "g": 0.2}, "weight": 0.3},
    ),
    "blend": tuple(
        {"type": "blendphase", "a": {"type": rayleigh}, "b": {"type": hg, "g": 0.6}, "weight": 0.3}
        for rayleigh, hg in (("mivol_rayleigh", "mivol_hg"), ("rayleigh", "hg"))
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_values_are_those_of_stock(each_variant, name):
    ours, stock = (mi.load_dict(given) for given in PAIRS[name])
    a, b = interaction(directions(1024, 11)), vector(directions(1024, 12))
    got, want = value_and_pdf(ours, a, b)[0], value_and_pdf(stock, a, b)[0]
    # A stock cosine is rounded by eps, and hg at g = 0.6 changes by 3 g / (1 - g)^2 of itself with it.
    assert np.max(np.abs(got / want - 1)) <= 16 * EPS


def test_components_of_a_mixture_are_those_of_a_blend(each_variant):
    """One lobe alone: values and densities times its share, samples of that lobe whatever the first number is."""
    lobes = ({"type": "hg", "g": 0.2}, {"type": "isotropic"})  # stock rayleigh counts as no component at all
    ours = mi.load_dict({"type": "mivol_mixture", "a": lobes[0], "b": lobes[1], "weight_a": 0.3, "weight_b": 0.7})
    stock = mi.load_dict({"type": "blendphase", "a": lobes[1], "b": lobes[0], "weight": 0.3})
    mei, ctx = interaction(directions(64, 13)), mi.PhaseFunctionContext()
    wo, u = vector(directions(64, 14)), mi.Point2f(0.3, 0.6)
    for mine, theirs in ((0, 1), (1, 0)):  # the blend was given in the other order
        ctx.component = mine
        got, sample = ours.eval_pdf(ctx, mei, wo), ours.sample(ctx, mei, 0.9, u)
        ctx.component = theirs
        want, expected = stock.eval_pdf(ctx, mei, wo), stock.sample(ctx, mei, 0.9, u)
        for x, y in zip((*got, *sample), (*want, *expected), strict=True):
            assert dr.allclose(x, y, rtol=16 * EPS)
    ctx.component = 2
    with pytest.raises(Exception, match="component 2"):
        ours.eval_pdf(ctx, mei, wo)


@pytest.mark.parametrize(("name", "count"), [("hg", 1), ("mivol_rayleigh", 1), ("draine", 1), ("table", 1), ("mixture", 3)])
def test_components_are_counted(each_variant, name, count):
    """One for each lobe, as stock ``hg`` and ``isotropic`` count; each has the flags of its lobe."""
    phase = mi.load_dict(PHASES[name])
    assert phase.component_count() == count
    assert [phase.flags(k) for k in range(count)] == [int(mi.PhaseFunctionFlags.Anisotropic)] * count


def test_components_of_nested_mixtures_add_up(each_variant):
    """A component within a mixture within a mixture is the share of its lobe of the share of the inner one."""
    inner = {"type": "mivol_mixture", "c": {"type": "mivol_hg", "g": 0.3}, "d": {"type": "isotropic"}}
    ours = mi.load_dict({"type": "mivol_mixture", "a": inner, "b": {"type": "mivol_rayleigh"}})
    assert ours.component_count() == 3
    turned, even = int(mi.PhaseFunctionFlags.Anisotropic), int(mi.PhaseFunctionFlags.Isotropic)
    assert [ours.flags(k) for k in range(3)] == [turned, even, turned]
    assert ours.flags() == ours.flags(True) == turned | even
    mei, wo, ctx = interaction(directions(64, 15)), vector(directions(64, 16)), mi.PhaseFunctionContext()
    lobes = ({"type": "mivol_hg", "g": 0.3}, {"type": "isotropic"}, {"type": "mivol_rayleigh"})
    for k, (lobe, share) in enumerate(zip(lobes, (0.25, 0.25, 0.5), strict=True)):
        want = mi.load_dict(lobe).eval_pdf(mi.PhaseFunctionContext(), mei, wo)[0]
        ctx.component = k
        # Shares are powers of two, and each is a sum and a quotient of exact numbers.
        assert dr.all(ours.eval_pdf(ctx, mei, wo)[0] == share * want, axis=None)


def test_stock_blend_does_not_number_ours(each_variant):
    """Mitsuba 3.9 keeps the count that its blend reads from Python. Once it no longer does, ours can be set."""
    lobes = {"a": {"type": "mivol_hg"}, "b": {"type": "hg"}}
    assert mi.load_dict({"type": "blendphase", "weight": 0.5, **lobes}).component_count() == 1
    assert mi.load_dict({"type": "mivol_mixture", **lobes}).component_count() == 2


@pytest.mark.slow_for("mixture")
@pytest.mark.statistical
@pytest.mark.parametrize("name", cases(["table", "mixture", "blend"], ["table", "blend"]))
def test_same_image_as_stock_under_volpath(name):
    """Fog lit by an emitter and a sky, several scatterings: stock and ours, pixel by pixel."""
    mi.set_variant("llvm_ad_rgb")
    means = []
    for given in PAIRS[name]:
        fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9, "phase": given}
        scene = mi.load_dict(
            {
                "type": "scene",
                "fog": box_of(fog, np.eye(4)),
                "sky": sky(0.3),
                "emitter": {"type": "directional", "direction": [0.6, 0.0, 0.8], "irradiance": 2.0},
                "sensor": camera((0.5, 0.5, -3), (0.5, 0.5, 0.5), 4),
            }
        )
        seeds = range(16) if not means else range(16, 32)
        batches = [render(scene, {"type": "volpath", "max_depth": 4}, 64, seed=fresh(s))[..., :1] for s in seeds]
        means.append(Moments.from_values(np.array(batches)))
    a, b = means
    assert_same_mean(a, b)


def test_two_media_with_different_phase_functions_in_one_loop():
    """Dispatch through pointers inside symbolic loops: same picture as stock, path by path."""
    mi.set_variant("llvm_ad_rgb")
    images = []
    for k in (0, 1):
        parts = {"type": "scene", "sky": sky(0.5), "sensor": camera((1, -4, 0.5), (1, 0.5, 0.5), 6)}
        for place, name in enumerate(("hg", "mixture")):
            fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.9, "phase": PAIRS[name][k]}
            shift = np.eye(4)
            shift[0, 3] = 1.5 * place
            parts[name] = box_of(fog, shift)
        parts["emitter"] = {"type": "point", "position": [1.2, -0.5, 1.5], "intensity": 1.0}
        images.append(render(mi.load_dict(parts), {"type": "volpath", "max_depth": 4}, 64))
    # The same random numbers give the same paths to rounding; one in 10^4 that falls on the other side of a choice may differ
    # by a whole sample of a pixel.
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=1e-3)


# -- dr.freeze, derivatives through the integrators ----------------------------------------------------------------------------


FROZEN = {
    "hg": (PHASES["hg"], "g", 0.9),
    "draine": (PHASES["draine"], "alpha", 0.5),
    "table": (PHASES["irregular table"], "values", 1.2),
    "mixture": (PHASES["mixture"], "weight_front", 0.7),
    "lobe of a mixture": (PHASES["mixture"], "front.g", 0.7),
}


def foggy(phase: dict) -> mi.Scene:
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.9, "phase": phase}
    emitter = {"type": "directional", "direction": [0.6, 0.0, 0.8], "irradiance": 2.0}
    sensor = camera((0.5, 0.5, -3), (0.5, 0.5, 0.5), 4)
    return mi.load_dict({"type": "scene", "fog": box_of(fog, np.eye(4)), "sky": sky(0.3), "emitter": emitter, "sensor": sensor})


@pytest.mark.slow_for("table")
@pytest.mark.parametrize("name", cases(FROZEN, ["hg", "draine", "mixture"]))
def test_a_recording_follows_parameters(name):
    """Each call gives the image of an ordinary render, to the last bit, with fewer recordings than calls."""
    mi.set_variant("llvm_ad_rgb")
    phase, key, factor = FROZEN[name]
    scene = foggy(phase)
    integrator, params = mi.load_dict({"type": "volpath", "max_depth": 3}), mi.traverse(scene)
    key = "fog.interior_medium.phase_function." + key
    frozen = dr.freeze(lambda scene, integrator, seed: mi.render(scene, integrator=integrator, spp=4, seed=seed))
    means = []
    for _ in range(6):
        shape = np.linspace(1, factor, dr.width(params[key])) if dr.width(params[key]) > 1 else factor
        params[key] = mi.Float(np.array(params[key]) * shape)
        params.update()
        image = np.array(frozen(scene, integrator, mi.UInt32(7)))
        assert np.array_equal(image, np.array(mi.render(scene, integrator=integrator, spp=4, seed=7)))
        means.append(image.mean())
    assert frozen.n_recordings < 6
    assert len(set(means)) == 6


def test_a_new_value_needs_no_new_kernel():
    """Numbers are arrays to the compiler: the second value of a parameter runs the kernel of the first."""
    mi.set_variant("llvm_ad_rgb")
    phase = mi.load_dict({"type": "mivol_draine"})
    params, mei, wo = mi.traverse(phase), interaction(directions(16, 16)), vector(directions(16, 17))
    dr.eval(mei, wo)
    hits = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for g, alpha in ((0.1, 0.5), (0.2, 0.7)):
            params["g"], params["alpha"] = g, alpha
            params.update()
            dr.kernel_history_clear()
            dr.eval(phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)[0])
            hits.append([k["cache_hit"] for k in dr.kernel_history([dr.KernelType.JIT])])
    assert hits[1] == [True]


@pytest.mark.slow
@pytest.mark.parametrize("name", cases(["draine", "table", "mixture"], ["draine", "mixture"]))
def test_gradient_of_a_recording(name):
    """Update, render and reverse pass in one recording, as without one."""
    mi.set_variant("llvm_ad_rgb")
    phase, key, factor = FROZEN[name]
    scene = foggy(phase)
    integrator, params = mi.load_dict({"type": "prbvolpath", "max_depth": 3}), mi.traverse(scene)
    key = "fog.interior_medium.phase_function." + key
    start = np.array(params[key])

    def step(scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, x: mi.Float) -> mi.Float:
        dr.enable_grad(x)
        params[key] = x
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=3)
        dr.backward(dr.mean(image * image, axis=None))
        return dr.grad(x)

    frozen = dr.freeze(step)
    for call in range(3):
        x, y = mi.Float(start * factor**call), mi.Float(start * factor**call)
        dr.eval(x, y)
        replayed, plain = np.array(frozen(scene, integrator, params, x)), np.array(step(scene, integrator, params, y))
        # The order of sums over threads is not fixed: float32 sums of some thousand terms.
        assert np.max(np.abs(replayed - plain)) <= 1e-5 * np.max(np.abs(plain))
        assert np.any(plain != 0)


def test_samples_carry_no_derivative_and_values_do(each_variant):
    for given, key in ((phase, key) for phase, key, _ in FROZEN.values()):
        phase = mi.load_dict(given)
        params = mi.traverse(phase)
        dr.enable_grad(params[key])
        params.update()
        mei = interaction(directions(16, 15))
        wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(), mei, 0.4, mi.Point2f(0.2, 0.7))
        assert not dr.grad_enabled(wo, weight, pdf)
        value, pdf = phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)
        assert dr.grad_enabled(value)
        assert not dr.grad_enabled(pdf)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", ["table", "lobe of a mixture"])
def test_image_gradient_against_finite_differences(name):
    """prbvolpath's derivative of the mean of an image by a phase parameter, in a medium of one scattering."""
    mi.set_variant("llvm_ad_rgb")
    phase, key, _ = FROZEN[name]
    scene = foggy(phase)
    integrator, params = mi.load_dict({"type": "prbvolpath", "max_depth": 2}), mi.traverse(scene)
    key = "fog.interior_medium.phase_function." + key
    start = np.array(params[key], dtype=np.float64)
    change = np.zeros_like(start)
    change[len(start) // 2] = 0.05  # of g = 0.6 or 0.8, or of one value of a table, 0.5
    got, want = [], []
    for seed in map(fresh, range(16)):
        params[key] = mi.Float(start.astype(np.float32))
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=256, seed=seed).array))
        got.append(np.array(dr.grad(params[key]), dtype=np.float64) @ change)
        dr.disable_grad(params[key])
        images = []
        for sign in (1, -1):
            params[key] = mi.Float((start + sign * change).astype(np.float32))
            params.update()
            images.append(render(scene, {"type": "prbvolpath", "max_depth": 2}, 256, seed=100 + seed).mean())
        want.append((images[0] - images[1]) / 2)
    got, want = (Moments.from_values(np.array(x)[:, None]) for x in (got, want))
    # The step is 1/8 of the way to g = 1 at most: its cube is 1/500 of the difference, below the noise of either.
    assert_same_mean(got, want)
    assert_precise(got, np.abs(want.mean) / 3)
