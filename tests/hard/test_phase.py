"""Hard cases of phase functions, through the plugins: what float32 and optimizers do to them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest

from scenes import box_of, camera, refused, sky

EPS = 2.0**-23
N = 2**16


def interaction(n: int, wi: tuple[float, ...] = (0.0, 0.0, 1.0)) -> mi.MediumInteraction3f:
    mei = dr.zeros(mi.MediumInteraction3f, n)
    mei.wi = mi.Vector3f(*wi)
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


def sample(phase: dict, n: int = N) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stratified samples: directions (n, 3) as float64, weights and densities."""
    u = mi.Float(((np.arange(n) + 0.5) / n).astype(np.float32))
    v = mi.Float((np.arange(n) * 0.6180339887498949 % 1).astype(np.float32))
    phase = mi.load_dict(phase)
    wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(), interaction(n), 0.5, mi.Point2f(u, v))
    weight = np.broadcast_to(np.array(weight)[:1], (1, n))
    return np.array(wo, dtype=np.float64).T, weight[0], np.array(pdf, dtype=np.float64)


@pytest.mark.parametrize("g", [1e-7, 1e-6, 1e-5, 1e-4, 1e-3, -1e-7, -1e-4])
def test_small_asymmetry_keeps_its_mean_cosine(g):
    """The mean cosine of samples is g, where a quotient by 2 g gives -0.41 at 1e-7, and a threshold at 1e-3 gives 0."""
    wo, _, _ = sample({"type": "mivol_hg", "g": g})
    # Midpoints are exact for a cosine linear in u, and its curvature is of size g. Roundings of the 65536 cosines average out,
    # except that of 1 - g, the same in all: eps/4, squared.
    assert -wo[:, 2].mean() == pytest.approx(g, abs=EPS / 2)


def test_stock_is_wrong_there():
    """Stock hg cannot be the judge of small g."""
    wo, _, _ = sample({"type": "hg", "g": 1e-7})
    assert -wo[:, 2].mean() < -0.3


@pytest.mark.parametrize("kind", [{"type": "mivol_hg"}, {"type": "mivol_draine", "alpha": 2.0}])
@pytest.mark.parametrize("g", [0.999, 0.9999, 0.99999, -0.9999, -0.99999, 1 - 2.0**-24])
def test_needle_lobes(g, kind):
    """Density of a sample = value in its direction, to what the rounding of the direction allows; never NaN."""
    phase = {**kind, "g": g}
    wo, _, pdf = sample(phase, 4096)
    directions = mi.Vector3f(wo.T.astype(np.float32))
    value, density = mi.load_dict(phase).eval_pdf(mi.PhaseFunctionContext(), interaction(4096), directions)
    value, density = np.array(value[0], dtype=np.float64), np.array(density, dtype=np.float64)
    assert np.all(np.isfinite(pdf) & np.isfinite(value) & (value > 0))
    assert np.array_equal(value, density)
    # p falls as D^(-3/2), D = (1 - g)^2 + angle^2: an angle moved by eps/2 (its components are rounded to that of 1, 3 of them)
    # changes log p by 3/2 eps/(1 - g) at most.
    spread = 3 * EPS / (1 - abs(np.float32(g)).astype(np.float64))
    if spread < 0.1:
        assert np.max(np.abs(np.log(value / pdf))) <= 2 * spread


@pytest.mark.parametrize("g", [0.9999, -0.9999, 0.99999])
def test_gradients_of_needle_lobes_are_finite(g):
    """Reverse mode at the peak, beside it, and far from it."""
    m, p = oracle.turns(np.array([0, 1e-6, 1e-4, 1e-2, 1, 3, np.pi]))
    phase = mi.load_dict({"type": "mivol_hg", "g": g})
    params = mi.traverse(phase)
    dr.enable_grad(params["g"])
    params.update()
    angle = 2 * np.arctan2(np.sqrt(m), np.sqrt(p))
    wo = mi.Vector3f(*(mi.Float(x.astype(np.float32)) for x in (np.sin(angle), 0 * angle, -np.cos(angle))))
    dr.enable_grad(wo)
    value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), interaction(len(m)), wo)
    dr.backward(value[0])
    assert np.all(np.isfinite(np.array(dr.grad(params["g"]))))
    assert np.all(np.isfinite(np.array(dr.grad(wo))))


@pytest.mark.parametrize("kind", [{"type": "mivol_hg"}, {"type": "mivol_draine", "alpha": 7.0}])
@pytest.mark.parametrize("g", [1e-7, 0.3, 0.99])
def test_negative_asymmetry_is_the_mirror_image(g, kind):
    """Values at mirrored turns are equal to the last bit, and so are samples at mirrored random numbers."""
    forward, back = (mi.load_dict({**kind, "g": s * g}) for s in (1, -1))
    ctx, mei = mi.PhaseFunctionContext(), interaction(257)
    u = mi.Float(((np.arange(257) + 0.5) / 257 * 2**20).round().astype(np.float32) / 2**20)  # 1 - u is exact
    wo, _, pdf = forward.sample(ctx, mei, 0.5, mi.Point2f(u, 0.25))
    mirrored, _, pdf_back = back.sample(ctx, mei, 0.5, mi.Point2f(1 - u, 0.25))
    assert np.array_equal(np.array(wo)[2], -np.array(mirrored)[2])
    assert np.array_equal(np.array(pdf), np.array(pdf_back))
    wo = mi.warp.square_to_uniform_sphere(mi.Point2f(0.25, u))
    assert np.array_equal(np.array(forward.eval_pdf(ctx, mei, wo)[1]), np.array(back.eval_pdf(ctx, mei, -wo)[1]))
    if g > 0.1:
        ahead = np.argmax(np.array(forward.eval_pdf(ctx, mei, wo)[1]))
        assert np.array(wo)[2][ahead] < -0.99  # straight on is -wi


def test_ends_of_rayleigh():
    """u = 0, 1/2 and 1 give cosines -1, 0 and 1, with values 3/(8 pi), 3/(16 pi), 3/(8 pi)."""
    phase = mi.load_dict({"type": "mivol_rayleigh"})
    u = mi.Point2f(mi.Float(0, 0.5, 1), 0.3)
    wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(), interaction(3), 0.5, u)
    # sinh, asinh and the third: 3 roundings of 1.
    assert -np.array(wo)[2] == pytest.approx([-1, 0, 1], abs=3 * EPS)
    assert np.array(pdf) * 8 * np.pi / 3 == pytest.approx([1, 0.5, 1], rel=4 * EPS)
    assert np.array_equal(np.array(weight).ravel(), np.ones(3))


def volume(value: float) -> dict:
    return {"type": "gridvolume", "grid": mi.VolumeGrid(np.full((2, 2, 2), value, np.float32)), "raw": True}


LOBES = {"a": {"type": "mivol_hg", "g": 0.5}, "b": {"type": "isotropic"}}
OVERSHOOTS = {
    "g at 1": ({"type": "mivol_hg", "g": 0.9}, "g", 1.0, "g of mivol_hg is 1;"),
    "g below -1": ({"type": "mivol_hg", "g": -0.9}, "g", -1.2, "-1.2"),
    "g that rounds to 1": ({"type": "mivol_hg"}, "g", 0.99999999, "above -1 and below 1"),
    "g is NaN": ({"type": "mivol_draine"}, "g", np.nan, "g of mivol_draine is nan"),
    "alpha below 0": ({"type": "mivol_draine"}, "alpha", -0.01, "alpha of mivol_draine"),
    "alpha infinite": ({"type": "mivol_draine"}, "alpha", np.inf, "finite"),
    "alpha whose norm is no number": ({"type": "mivol_draine"}, "alpha", 3e38, "at most 1e30"),
    "weights whose sum is none": ({"type": "mivol_mixture", **LOBES}, "weight_a", 3e38, "at most 1e30"),
    "a table whose integral is none": ({"type": "mivol_tabulated", "values": "1, 2"}, "values", [3e38, 3e38], "1e-30 to 1e30"),
    "a weight below 0": ({"type": "mivol_mixture", **LOBES}, "weight_a", -0.5, "weight_a of mivol_mixture"),
    "a table below 0": ({"type": "mivol_tabulated", "values": "1, 2, 3"}, "values", [1.0, -0.1, 2.0], "-0.1.* at 1"),
    "a table of zeros": ({"type": "mivol_tabulated", "values": "1, 2, 3"}, "values", [0.0, 0.0, 0.0], "0 everywhere"),
    "another length": ({"type": "mivol_tabulated", "values": "1, 2, 3"}, "values", [1.0, 1.0], "expected 3, one for"),
}


@pytest.mark.parametrize("case", OVERSHOOTS)
def test_overshoot_is_refused_when_it_is_handed_in(case):
    given, key, bad, words = OVERSHOOTS[case]
    params = mi.traverse(mi.load_dict(given))
    params[key] = mi.Float(bad)
    with refused(words):
        params.update()


@pytest.mark.parametrize("given", [{"type": "mivol_hg"}, {"type": "mivol_draine"}])
def test_overshoot_of_a_grid_names_the_voxel(given):
    params = mi.traverse(mi.load_dict({**given, "g": volume(0.5)}))
    wrong = np.full((2, 2, 2, 1), 0.5, np.float32)
    wrong[1, 0, 1] = -1.5
    params["g.data"] = mi.TensorXf(wrong)
    with refused(r"is -1.5 at \(1, 0, 1, 0\)"):
        params.update()


@pytest.mark.parametrize(
    "bad",
    [
        {"type": "mivol_hg", "g": 1.0},
        {"type": "mivol_hg", "g": -1.0},
        {"type": "mivol_draine", "alpha": -1.0},
        {"type": "mivol_mixture", **LOBES, "weight_a": -1.0, "weight_b": 1.0},
        {"type": "mivol_mixture", **LOBES, "weight_a": 0.0, "weight_b": 0.0},
        {"type": "mivol_tabulated", "values": "1, -1"},
        {"type": "mivol_tabulated", "values": "0, 0"},
    ],
)
def test_values_outside_are_refused_at_load(bad):
    with pytest.raises(Exception, match="expected"):
        mi.load_dict(bad)


def test_inside_a_recording_an_overshoot_is_projected():
    """dr.freeze cannot read: g = 1.5 renders as the largest g below 1, a negative weight as 0, and nothing is NaN."""
    phase = {"type": "mivol_mixture", "a": {"type": "mivol_hg", "g": 0.5}, "b": {"type": "mivol_rayleigh"}}
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.9, "phase": phase}
    parts = {"box": box_of(fog, np.eye(4)), "sky": sky(), "sensor": camera((0.5, -3, 0.5), (0.5, 0.5, 0.5), 4)}
    scene = mi.load_dict({"type": "scene", **parts})
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "volpath", "max_depth": 3})
    prefix = "box.interior_medium.phase_function."

    @dr.freeze
    def step(scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, g: mi.Float, w: mi.Float) -> mi.TensorXf:
        params[prefix + "a.g"], params[prefix + "weight_a"] = g, w
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=4, seed=3)

    images = {}
    for g, w in ((0.5, 1.0), (0.3, 0.5), (1.5, 1.0), (1 - 2.0**-24, 1.0), (0.3, -2.0), (0.3, 0.0)):
        images[g, w] = np.array(step(scene, integrator, params, dr.opaque(mi.Float, g), dr.opaque(mi.Float, w)))
        assert np.all(np.isfinite(images[g, w]))
    assert np.array_equal(images[1.5, 1.0], images[1 - 2.0**-24, 1.0])
    assert np.array_equal(images[0.3, -2.0], images[0.3, 0.0])
    assert not np.array_equal(images[0.3, 0.5], images[0.5, 1.0])


def test_values_of_unknown_volumes_are_projected():
    """A grid under another plugin's own key cannot be read when it is handed in; what it gives is moved into the domain."""
    phase = mi.load_dict({"type": "mivol_hg", "g": volume(0.5)})
    grid = phase.parameters["g"]
    inner = mi.traverse(grid)
    inner["data"] = mi.TensorXf(np.full((2, 2, 2, 1), 3.0, np.float32))
    inner.update()  # of the grid alone: the phase function is not told
    mei = interaction(8)
    wo, _, pdf = phase.sample(mi.PhaseFunctionContext(), mei, 0.5, mi.Point2f(dr.linspace(mi.Float, 0.01, 0.99, 8), 0.3))
    assert np.all(np.isfinite(np.array(pdf)))
    assert np.all(np.array(wo)[2] < -0.999)


def test_gradient_of_an_image_by_g_at_zero():
    """Single scattering of an emitter behind thin fog: dL/dg = L 3 cos at g = 0, straight from the closed form of p."""
    fog = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 1.0, "phase": {"type": "mivol_hg", "g": 0.0}}
    parts = {
        "box": box_of(fog, np.eye(4)),
        "emitter": {"type": "directional", "direction": [0.6, 0.0, 0.8], "irradiance": 1.0},
        "sensor": camera((0.5, 0.5, -40), (0.5, 0.5, 0.5), 2, fov=0.3),
    }
    scene = mi.load_dict({"type": "scene", **parts})
    params = mi.traverse(scene)
    key = "box.interior_medium.phase_function.g"
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "prbvolpath", "max_depth": 2})
    with dr.suspend_grad():
        image = integrator.render(scene, seed=1, spp=4096)
    integrator.render_backward(scene, params, dr.full(mi.TensorXf, 1 / 12, image.shape), seed=1, spp=4096)
    gradient, mean = float(dr.grad(params[key])[0]), float(np.array(image).mean())
    # Light travels along (0.6, 0, 0.8), and to the camera within 0.2 degrees of (0, 0, -1): cos = -0.8 to 0.003 * 0.6. The same
    # seed gives L and dL/dg the same paths, so nothing else differs.
    assert gradient == pytest.approx(3 * -0.8 * mean, rel=0.003)
