"""What a script needs in a line each: problems with a loss and an optimizer of one's own, references of every kind."""

from __future__ import annotations

import runpy
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import ball, photo
from fit_scene import KEY
from PIL import Image
from refusals import assert_refused
from tiny_experiment import SCENE

import mivol
from mivol.errors import MivolError
from mivol.experiments.script import Problem, optimize
from mivol.files import encode_srgb, read_exr, write_exr
from mivol.optim.losses import L2, Huber
from mivol.optim.priors import TotalVariation
from mivol.photos.camera import Camera
from mivol.photos.transforms import write_transforms
from mivol.scene.sensors import to_sensor

SCRIPTS = Path(__file__).resolve().parents[2] / "docs" / "scripts"


def mean_square(image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
    return dr.mean(dr.square(image - reference), axis=None)


@pytest.fixture
def scene(variant_rgb: str, folder: Path) -> mi.Scene:
    return mi.load_file(str(folder / "scene.xml"))


def seen(level: float = 0.6) -> np.ndarray:
    """A picture of the scene's sensor."""
    return np.full((6, 8, 3), level, np.float32)


def test_a_function_is_a_loss(scene: mi.Scene) -> None:
    """The mean square written down by hand has the value and the gradient of the loss of that name."""
    found = []
    for loss in (mean_square, L2()):
        problem = Problem(scene, [seen()], [KEY], loss=loss, spp=4)
        value, gradients = problem.loss_and_gradient(problem.initial_reals(), 0)
        found.append((float(value), np.array(gradients[KEY])))
    assert np.isclose(found[0][0], found[1][0], rtol=1e-6)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-5)
    assert np.abs(found[0][1]).max() > 0


def test_a_function_sees_one_view_at_a_time(scene: mi.Scene) -> None:
    """Views side by side in one image would give a loss that looks at neighbours the wrong ones."""
    shapes = []

    def look(image: mi.TensorXf, reference: mi.TensorXf) -> mi.Float:
        shapes.append(tuple(image.shape))
        return mean_square(image, reference)

    sensor = scene.sensors()[0]
    problem = Problem(scene, [seen(), seen()], [KEY], loss=look, sensors=[sensor, sensor], spp=4)
    problem.loss_and_gradient(problem.initial_reals(), 0)
    assert shapes == [(6, 8, 3)] * 2


@pytest.mark.parametrize(
    "make",
    [None, lambda: mi.ad.Adam(lr=0.1), lambda: mi.ad.SGD(lr=2.0, momentum=0.5), mivol.Adam],
    ids=["none", "Mitsuba's Adam", "Mitsuba's SGD", "ours"],
)
def test_any_optimizer_lowers_the_loss(scene: mi.Scene, make) -> None:
    """The start's transmittance of 0.6 and more is brought towards 0.3 by every optimizer; values stay in their domain."""
    sought = mivol.Parameter(KEY, domain=(0, 0.9), lr=0.1)
    fit = optimize(Problem(scene, [seen(0.3)], [sought], spp=4), make and make(), 8)
    losses = [row["loss"] for row in fit.history]
    assert losses[-1] < losses[0]
    assert np.array(fit.values()[KEY]).max() <= np.float32(0.9)


def test_a_given_optimizer_of_mitsuba_makes_the_step(scene: mi.Scene) -> None:
    """SGD without momentum goes lr times the gradient down. Such an object is false in Python, as its length is 0 at first."""
    problem = Problem(scene, [seen(0.3)], [mivol.Parameter(KEY, domain=(-np.inf, np.inf))], spp=4)
    start = problem.initial_reals()
    gradient = problem.loss_and_gradient(start, 0)[1][KEY]
    fit = optimize(problem, mi.ad.SGD(lr=0.5), 1)
    expected = np.array(start[KEY]) - 0.5 * np.array(gradient)
    assert np.abs(np.array(gradient)).max() > 0
    # One rounding of the product and one of the sum, each at most half of 2^-23 of values below 2.
    np.testing.assert_allclose(np.array(fit.values()[KEY]).ravel(), expected.ravel(), rtol=0, atol=2 * 2**-23)


def test_references_are_arrays_files_or_a_scene(scene: mi.Scene, folder: Path) -> None:
    write_exr(folder / "seen.exr", {"": seen(0.5)})
    for given in ([seen(0.5)], [folder / "seen.exr"], [str(folder / "seen.exr")], [mi.TensorXf(seen(0.5))]):
        problem = Problem(folder / "scene.xml", given, [KEY])
        assert np.array_equal(np.array(problem.views[0].reference), seen(0.5))
    (folder / "plain.xml").write_text(SCENE.replace('<string name="aovs" value="tau"/>', ""))
    plain = mi.load_file(str(folder / "plain.xml"))
    problem = Problem(plain, plain, [KEY])
    (absorbed,) = Problem(plain, plain, [KEY]).views
    (loaded,) = Problem(plain, folder / "plain.xml", [KEY]).views
    assert np.array_equal(np.array(loaded.reference), np.array(absorbed.reference))
    # Absorption has no noise but that of the places in a pixel: the scene is its own reference to a few thousandths.
    assert problem.loss_value(problem.initial_reals(), 0) < 1e-3


class Silent:
    """An optimizer that begins nothing."""

    def begin(self, problem: Problem) -> None:
        pass


def refuses(sentence: str):
    return pytest.raises(MivolError, match=sentence)


def test_what_a_script_gets_wrong_is_said(scene: mi.Scene) -> None:
    with refuses("2 references for 1 sensors"):
        Problem(scene, [seen(), seen()], [KEY])
    with refuses(r"shape \(6,\), expected \(height, width, channels\)"):
        Problem(scene, [np.zeros(6)], [KEY])
    with refuses("the single file seen.exr, expected a list of images"):
        Problem(scene, "seen.exr", [KEY])
    with refuses("found a single str, expected a list"):
        Problem(scene, [seen()], KEY)
    with refuses("found int in the list, expected keys"):
        Problem(scene, [seen()], [3])
    with refuses("found int"):
        Problem(scene, [seen()], [KEY], loss=3)
    with refuses(r"found the class Adam, expected an object: write Adam\(\.\.\.\)"):
        optimize(Problem(scene, [seen()], [KEY]), mivol.Adam, 1)
    with refuses(r"found the class L2, expected an object"):
        Problem(scene, [seen()], [KEY], loss=L2)
    with refuses(r"Adam: Expected `float` < 1.0 - at `\$.beta_1`"):
        optimize(Problem(scene, [seen()], [KEY]), mivol.Adam(beta_1=1.5), 1)
    with refuses(r"Huber: Expected `float` > 0.0 - at `\$.delta`"):
        Problem(scene, [seen()], [KEY], loss=Huber(delta=-1.0))
    with refuses(r"TotalVariation: Expected `float` >= 0.0 - at `\$.weight`"):
        mivol.Parameter(KEY, priors=[TotalVariation(weight=-1.0)])
    with refuses("found the priors L2.*expected a list of priors"):
        mivol.Parameter(KEY, priors=L2())
    for name, value in (("spp", 0), ("spp", 1.5), ("seed", -1)):
        with refuses(f"found {value} as {name}, expected a whole number from"):
            Problem(scene, [seen()], [KEY], **{name: value})
    with refuses("found -1 as iterations, expected a whole number from 0 on"):
        optimize(Problem(scene, [seen()], [KEY]), iterations=-1)
    with refuses("integrator: found dict, expected an integrator"):
        Problem(scene, [seen()], [KEY], integrator={"type": "mivol"})
    with refuses("the scene has no sensor 1"):
        Problem(scene, [seen()], [KEY], sensors=[1])
    with refuses("found str, expected a sensor or its number"):
        Problem(scene, [seen()], [KEY], sensors=["camera"])
    with refuses("Silent.begin returned a NoneType, expected a mivol.optim.optimizer.OptimizerRun"):
        optimize(Problem(scene, [seen()], [KEY]), Silent(), 1)
    with refuses("found str"):
        optimize(Problem(scene, [seen()], [KEY]), "adam", 1)
    for loss, sentence in (
        (lambda image, reference: 0.5, "returned a float"),
        (lambda image, reference: image - reference, r"returned a TensorXf of shape \(6, 8, 3\)"),
        (lambda image, reference: mi.Float(0.5), "has no derivative by the image"),
    ):
        problem = Problem(scene, [seen()], [KEY], loss=loss)
        with refuses(sentence):
            problem.loss_and_gradient(problem.initial_reals(), 0)


def test_the_package_shows_what_a_script_needs() -> None:
    """Every name is there, has a docstring, and is listed; none other is."""
    for name in mivol.PUBLIC:
        assert (getattr(mivol, name).__doc__ or "").strip(), name
        assert name in dir(mivol)
    with pytest.raises(AttributeError, match="no attribute 'frog'"):
        mivol.frog  # noqa: B018


@pytest.mark.parametrize("path", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.stem)
def test_scripts_of_the_docs_are_short(path: Path) -> None:
    assert sum(bool(line.strip()) for line in path.read_text().splitlines()) <= 15


@pytest.mark.slow
def test_scripts_of_the_docs_run(two_threads: None, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten pictures of a denser cube: its density is found to a tenth, and the light that is put in its place is orange."""
    monkeypatch.chdir(folder)
    sky = '<emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>'
    text = SCENE.replace('<emitter type="constant"/>', sky).replace('"tau"', '""')
    sensor = text[text.index("<sensor") : text.index("</sensor>") + 9]
    turned = [sensor.replace("0, 1, 4", f"{4 * np.sin(a):.4f}, 1, {4 * np.cos(a):.4f}") for a in np.linspace(0, 3, 10)]
    (folder / "scene.xml").write_text(text.replace(sensor, "\n".join(turned)))
    scene = mi.load_file(str(folder / "scene.xml"))
    params = mi.traverse(scene)
    params[KEY] = mi.TensorXf(np.full((2, 2, 2, 1), 0.75, np.float32))
    params.update()
    (folder / "pictures").mkdir()
    for number in range(10):
        image = np.array(mi.render(scene, sensor=number, spp=64))
        write_exr(folder / "pictures" / f"{number:02d}.exr", {"": image})
    runpy.run_path(str(SCRIPTS / "own_loss.py"))
    np.testing.assert_allclose(mivol.read_volume("density.vol").values, 0.75, rtol=0.1)
    runpy.run_path(str(SCRIPTS / "relight.py"))
    channels, _ = read_exr(folder / "relit.exr")
    assert channels["R"].mean() > 1.5 * channels["B"].mean() > 0


@pytest.mark.slow
def test_the_first_example_has_a_derivative(two_threads: None) -> None:
    """Before a white sky more smoke of albedo 0.8 darkens the picture: on the whole the derivative is below 0."""
    made = runpy.run_path(str(SCRIPTS / "gradient.py"))
    slope = np.array(dr.grad(made["params"]["smoke.interior_medium.sigma_t.data"]))
    assert slope.shape == (40, 40, 40, 1)
    assert np.isfinite(slope).all()
    assert slope.sum() < 0


@pytest.mark.slow
def test_photographs_of_the_docs_become_a_scene(two_threads: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve views of a ball, with alpha: the scene shows something other than its floor, and what the photographs showed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photographs").mkdir()
    field, cameras = ball(), {}
    for number in range(12):
        view = photo(field, number, 32)
        rgba = np.dstack([view.image, np.clip(view.alpha, 0, 1)])
        Image.fromarray(np.round(rgba * 255).astype(np.uint8)).save(tmp_path / "photographs" / f"{number}.png")
        cameras[f"{number}.png"] = view.camera
    write_transforms(tmp_path / "photographs" / "transforms.json", cameras, [])
    text, tiny = (SCRIPTS / "photographs.py").read_text(), '"field.preset": "tiny"'
    assert text.count(tiny) == 1
    exec(compile(text.replace(tiny, f'{tiny}, "field.effort": 0.3'), "photographs.py", "exec"), {"__name__": "__main__"})
    image = np.array(mi.Bitmap("scene.exr"))[..., :3]
    assert np.isfinite(image).all()
    assert image.reshape(-1, 3).std(axis=0).min() > 0.02
    shown = [encode_srgb(seen_by(cameras["0.png"], space)) for space in ("srgb", "linear")]
    rgba = np.array(Image.open("photographs/0.png")) / 255
    photograph = rgba[..., 3:] * rgba[..., :3] + 1 - rgba[..., 3:]
    errors = [np.sqrt(np.mean(np.square(one - photograph))) for one in shown]
    # Codes that count as light are shown up to 0.24 too bright (0.5 as 0.74); a tiny field errs by less than half of that.
    assert errors[0] < 0.5 * errors[1]


def seen_by(camera: Camera, space: str) -> np.ndarray:
    """What a photograph's camera sees of the fitted field in a scene, before a white sky."""
    T = mi.ScalarTransform4f
    field = mivol.read_field("field/field.npz")
    volume = {"type": "mivol_sh", "filename": "field/field.npz", "space": space}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "mivol_medium", "emission": volume}}
    box["to_world"] = T(field.to_world).translate(0.5).scale(0.5)
    parts = {"box": box, "sky": {"type": "constant"}, "camera": to_sensor(camera), "integrator": {"type": "mivol"}}
    return np.array(mi.render(mi.load_dict({"type": "scene", **parts}), spp=16))[..., :3]


def test_wrong_arguments_of_explain_and_optimize_are_named(variant_rgb: str) -> None:
    integrator = mi.load_dict({"type": "mivol"})
    for depth in (integrator, 2.5, -2):
        assert_refused("as max_depth, expected a whole number from -1 on", mivol.explain, {"type": "scene"}, depth)
    assert_refused("found str, expected a problem", optimize, "scene.xml")
