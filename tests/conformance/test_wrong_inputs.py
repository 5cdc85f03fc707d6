"""Wrong inputs that no other test meets: each gets its sentence, and what is just right is taken."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.fields.activation import ACTIVATIONS, select_activation
from mivol.fields.field_archives import MAX_NODES, _check_node_count, parse_archive
from mivol.fields.procedural import make_procedural
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.events import Upsample
from mivol.optim.losses import L2, LOSSES, Huber
from mivol.optim.parameters import Parameter
from mivol.optim.projections.inversion import fdk
from mivol.optim.strategy import choose, make_table
from mivol.phase.closed_forms import droplets
from mivol.phase.measured import NAMES, named_medium
from mivol.phase.table import Table
from mivol.photos import Camera
from mivol.photos.camera import PIXELS_LOST
from mivol.scene.load import parse_dict, parse_file
from mivol.scene.refusals import check_quadrature
from mivol.scene.sensors import Ring, parse_rig, to_sensor
from mivol.transport.path.estimators import Settings
from mivol.validate.metrics import score_image
from mivol.validate.reference_file import check_identity
from mivol.validate.statistics import Estimate, p_value


def refusal_of(called: object, *arguments: object, **settings: object) -> str:
    with pytest.raises(MivolError) as refused:
        called(*arguments, **settings)
    return str(refused.value)


# -- Fields and phase functions ----------------------------------------------------------------------------------------


def test_names_that_are_not_known() -> None:
    assert [select_activation(name).name for name in ACTIVATIONS] == ["none", "relu", "softplus", "exp"]
    wanted = "the activation 'relo' was given; one of none, relu, softplus, exp is expected."
    assert refusal_of(select_activation, "relo") == wanted
    assert refusal_of(make_procedural, "tangel", (2, 2, 2), 0, 1.0) == 'unknown procedural volume "tangel": known are tangle.'
    assert make_procedural("tangle", (2, 3, 4), 0, 1.0).shape == (2, 3, 4, 1)
    assert refusal_of(named_medium, NAMES[0] + "x").startswith(f"no measured medium is called {NAMES[0] + 'x'!r}; near it are")
    assert "near it are milk, skim milk, red wine, ...:" in refusal_of(named_medium, "0000")
    assert named_medium(NAMES[0].upper().replace(" ", "_")) == named_medium(NAMES[0])


def test_droplets_have_sizes_that_the_fit_covers() -> None:
    for diameter in (4.999, 50.001, np.nan):
        assert refusal_of(droplets, diameter).startswith(f"droplets of {diameter} micrometre; the fit covers 5 to 50")
    for diameter in (5, 50):
        assert 0 < droplets(diameter)["g_hg"] < 1


def test_a_table_that_is_not_there(tmp_path: Path) -> None:
    assert refusal_of(Table.from_csv, tmp_path / "none.csv").startswith(f"phase table {tmp_path / 'none.csv'} cannot be read: ")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00,1\n")
    assert "cannot be read: " in refusal_of(Table.from_csv, tmp_path / "bytes.csv")


def grid(scale: float = 1.0, **more: object) -> SphericalGrid:
    """8 nodes in a cube about the origin."""
    place = np.diag([2 * scale] * 3 + [1.0])
    place[:3, 3] = -scale
    return SphericalGrid.from_rows((2, 2, 2), place, np.ones(8), np.zeros((8, 1, 3)), **more)


def test_nested_grids_are_of_one_kind_and_in_place() -> None:
    assert SphericalGrid.from_levels([grid(), grid(2.0)]).levels == 2
    for other in ({"activation": "exp"}, {"offset": 0.0}, {"clamp": False}, {"space": "linear"}):
        says = refusal_of(SphericalGrid.from_levels, [grid(), grid(2.0, **other)])
        assert says == "grid 1 of a nested field is of another kind than the first: give grids of one kind."
    says = refusal_of(SphericalGrid.from_levels, [grid(), grid(2.0), grid(4.0 + 1e-8)])
    assert says == "grid 2 of a nested field is not 2^2 times the first one about its middle: place it so."


def test_tensors_of_a_field_have_its_shape() -> None:
    zeros = lambda *shape: mi.TensorXf(np.zeros(shape, np.float32))  # noqa: E731
    found = grid().with_tensors(zeros(2, 2, 2, 1), zeros(2, 2, 2, 4, 3))
    assert found.degree == 1
    wrong = [((2, 2, 2), (2, 2, 2, 1, 3)), ((2, 2, 3, 1), (2, 2, 2, 1, 3)), ((2, 2, 2, 1), (2, 3, 2, 1, 3)),
             ((2, 2, 2, 1), (2, 2, 2, 1, 4))]  # fmt: skip
    for density, sh in wrong:
        says = refusal_of(grid().with_tensors, zeros(*density), zeros(*sh))
        assert says == f"density {density} and sh {sh} were given; (2, 2, 2, 1) and (2, 2, 2, 'basis', 3) are expected."


def arrays(**more: object) -> dict[str, np.ndarray]:
    """Those of a file of 8 nodes."""
    given = {
        "density": np.ones(8, np.float32), "sh": np.zeros((8, 1, 3), np.float32), "res": (2, 2, 2), "to_world": np.eye(4),
        "activation": "relu", "offset": 0.5, "clamp": True, "levels": 1, "space": "srgb",
    }  # fmt: skip
    return {name: np.array(value) for name, value in {**given, **more}.items() if value is not None}


WRONG_ARRAYS = {
    "sh": (None, "f lacks sh, which a field of mivol holds: write it again."),
    "density": (
        np.ones(7, np.float32),
        "f holds (7,) densities and (8, 1, 3) harmonics for 8 nodes; (8,) and (8, basis, 3) are expected: write it again.",
    ),
    "to_world": (
        np.eye(3),
        "f holds to_world of type float64 and shape (3, 3); type float and shape (4, 4) is expected: write it again.",
    ),
    "activation": (1, "f holds activation of type int64 and shape (); type text and shape () is expected: write it again."),
    "offset": (np.nan, "f holds offset with values that are not finite; finite numbers are expected: write it again."),
    "res": ((2, 0, 2), f"f has a grid of 2 x 0 x 2 nodes; 1 to {MAX_NODES} in all are expected."),
    "levels": (-1, f"f has a grid of -1 x 2 x 2 x 2 nodes; 1 to {MAX_NODES} in all are expected."),
}


@pytest.mark.parametrize("name", WRONG_ARRAYS)
def test_a_file_of_a_field_holds_what_it_should(name: str) -> None:
    value, says = WRONG_ARRAYS[name]
    assert parse_archive("f", arrays()).res == (2, 2, 2)
    assert refusal_of(parse_archive, "f", arrays(**{name: value})) == says


@pytest.mark.parametrize("sh", [(7, 1, 3), (8, 1, 4), (8, 3)])
def test_harmonics_of_a_file_belong_to_its_nodes(sh: tuple[int, ...]) -> None:
    says = refusal_of(parse_archive, "f", arrays(sh=np.zeros(sh, np.float32)))
    assert (
        says == f"f holds (8,) densities and {sh} harmonics for 8 nodes; (8,) and (8, basis, 3) are expected: write it again."
    )
    large = arrays(res=(2048, 2048, 1024))
    assert refusal_of(_check_node_count, "f", large).startswith("f has a grid of 2048 x 2048 x 1024 nodes;")


# -- Scenes ------------------------------------------------------------------------------------------------------------


def test_shadows_that_contradict_each_other() -> None:
    needs = SimpleNamespace(media=(), emitters=(), emitter_kinds=())
    says = lambda **given: refusal_of(check_quadrature, needs, Settings(max_depth=2, **given))  # noqa: E731
    assert says(shadows="exat").startswith("shadows is 'exat'; ") and says(shadows="exat").endswith(" is expected.")
    assert says(shadows="estimated", deterministic=True).startswith("shadows is 'estimated' and deterministic is set")
    assert says(shadows="grid").startswith("shadows is 'grid' without deterministic")
    for given in ({"shadows": "grid", "deterministic": True}, {"shadows": "estimated"}, {"shadows": "exact"}, {}):
        check_quadrature(needs, Settings(max_depth=2, **given))


def test_rigs() -> None:
    assert refusal_of(parse_rig, {"rig": "rings"}) == 'unknown rig "rings": did you mean "ring"?'
    assert refusal_of(parse_rig, {"heigth": 3}) == 'rig "ring" has no setting "heigth": did you mean "height"?'
    near = refusal_of(parse_rig, {"rig": "ring", "near": 2.0, "far": 2.0})
    assert near.startswith('rig "ring": near = 2.0 is not below far = 2.0')
    assert refusal_of(parse_rig, {"width": 0}).startswith('rig "ring": ')
    assert parse_rig({"near": 1.0, "far": 1.1}) == Ring(near=1.0, far=1.1)


def test_a_sensor_has_square_pixels() -> None:
    """Focal lengths may differ by what no pixel of the picture sees, and no more."""

    def camera(ratio: float) -> Camera:
        return Camera(np.array([[50.0 * ratio, 0, 20], [0, 50, 10], [0, 0, 1]]), (40, 20), np.eye(4), name="eye")

    off = PIXELS_LOST / 20
    assert to_sensor(camera(1 + 0.99 * off))["film"]["width"] == 40
    assert to_sensor(camera(1 - 0.99 * off))["film"]["height"] == 20
    for ratio in (1 + 1.01 * off, 1 - 1.01 * off):
        assert "focal lengths" in refusal_of(to_sensor, camera(ratio))


def test_files_that_are_no_scenes(tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text('<scene version="3.0.0"><shape></scene>')
    assert refusal_of(parse_file, tmp_path / "broken.xml", {}).startswith(f"{tmp_path / 'broken.xml'} cannot be read: ")
    (tmp_path / "ref.xml").write_text('<scene version="3.0.0"><ref id="none"/></scene>')
    assert refusal_of(parse_file, tmp_path / "ref.xml", {}).startswith(f"{tmp_path / 'ref.xml'} cannot be read: ")
    assert parse_dict({"type": "scene"}) is not None


# -- Comparisons -------------------------------------------------------------------------------------------------------


def test_images_that_cannot_be_judged() -> None:
    image = np.full((4, 5, 3), 0.5)
    assert refusal_of(score_image, image, image, metrics=("psnr", "psn")).startswith('there is no metric "psn"; choose among ')
    says = refusal_of(score_image, image, image[:3], name="a")
    assert says == "a has shape (4, 5, 3) and its photograph (3, 5, 3); render it at that size."
    for mask in (np.zeros((4, 5), bool), np.ones((5, 4), bool)):
        says = refusal_of(score_image, image, image, mask=mask, name="a")
        assert says == f"the mask of a has shape {mask.shape} or leaves no pixel; give one of (4, 5)."
    assert score_image(image, image, mask=np.eye(4, 5, dtype=bool)).name == "image"


def test_means_that_cannot_be_compared() -> None:
    one = Estimate(np.zeros((2, 2)), np.ones((2, 2)), 5)
    says = refusal_of(p_value, one, Estimate(np.zeros((2, 3)), np.ones((2, 3)), 5))
    assert says == "images of shape (2, 2) and (2, 3) cannot be compared; render both at one size."


def test_the_first_key_that_differs_is_named(tmp_path: Path) -> None:
    known = {"scene": "a", "spp": 4, "seed": 1}
    check_identity(tmp_path, known | {"more": 1}, known)
    for other in ({"spp": 5}, {"spp": None}):
        assert "spp" in refusal_of(check_identity, tmp_path, known | other, known)


# -- Fits --------------------------------------------------------------------------------------------------------------


def test_strategies() -> None:
    assert choose(LOSSES, "huber", "loss", delta=2.0) == Huber(delta=2.0)
    assert refusal_of(choose, LOSSES, "l22", "loss").startswith('unknown loss "l22": ')
    assert refusal_of(choose, LOSSES, "l2", "loss", flor=1).startswith('loss "l2": ')
    assert list(make_table(L2, Huber)) == ["l2", "huber"]
    with pytest.raises(AssertionError, match="share a name"):
        make_table(L2, Huber, L2)


def test_a_domain_has_two_ends() -> None:
    for domain in ((1.0, 1.0), (2.0, 1.0), (np.nan, 1.0)):
        says = refusal_of(Parameter, "x", domain=domain)
        assert says == f"x: domain [{domain[0]}, {domain[1]}] is empty: give the smaller bound first."
    assert Parameter("x", domain=(1.0, 1.0 + 1e-9)).domain[0] == 1.0
    assert refusal_of(Parameter, "x", map="exq").startswith('x: unknown map "exq": ')


def test_a_grid_to_refine_and_a_prior_that_nothing_takes() -> None:
    problem = SimpleNamespace(parameters=[SimpleNamespace(name="x")])
    fit = SimpleNamespace(problem=problem, run=SimpleNamespace(reals={"x": mi.TensorXf(np.zeros(3, np.float32))}))
    assert (
        refusal_of(Upsample(at=(1,)).apply, fit) == "the event 'upsample' found no grid among the parameters: remove the event."
    )
    least = SimpleNamespace(A=None, prior=object())
    assert refusal_of(lambda: next(fdk(least))).startswith("found a prior with filtered back-projection, expected none")
