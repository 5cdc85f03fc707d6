"""Loading a scene, and what its hash notices: everything that is seen, nothing of how it is computed."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.scene.load import NOT_UTF8, _printed_settings, content_hash, describe_error, load_scene
from mivol.threads import run_child

INCLUDED = """<scene version="3.0.0">
  <default name="spp" value="4"/> <default name="depth" value="2"/>
  <integrator type="volpath"><integer name="max_depth" value="$depth"/></integrator>
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
</scene>"""

SCENE = """<scene version="3.0.0">
  <path value="textures"/>
  <default name="scale" value="2"/>
  <include filename="common.xml"/>
  <emitter type="constant"/>
  <shape type="cube">
    <bsdf type="null"/>
    <medium type="heterogeneous" name="interior">
      <volume type="gridvolume" name="sigma_t"><string name="filename" value="smoke.vol"/></volume>
      <float name="albedo" value="0"/>
      <float name="scale" value="$scale"/>
    </medium>
  </shape>
</scene>"""


@pytest.fixture
def xml(variant_rgb, tmp_path):
    """A scene of two XML files and a volume in a folder of its own."""
    (tmp_path / "textures").mkdir()
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "common.xml").write_text(INCLUDED)
    _write_volume(tmp_path, 1.0)
    return tmp_path / "scene.xml"


def _write_volume(folder, corner: float) -> None:
    values = np.ones((3, 4, 5, 1), np.float32)
    values[0, 0, 0, 0] = corner
    mi.VolumeGrid(values).write(str(folder / "textures" / "smoke.vol"))


def _described(values=None, **changes) -> dict:
    """A scene dict with a grid, an image and a nested transform."""
    values = np.ones((2, 3, 4, 1), np.float32) if values is None else values
    sigma_t = {"type": "gridvolume", "grid": mi.VolumeGrid(values)}
    medium = {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": 0.0, "scale": changes.pop("scale", 1.0)}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
    return {
        "type": "scene",
        "cube": cube | changes.pop("cube", {}),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(changes.pop("sky", np.ones((4, 8, 3), np.float32)))},
        **changes,
    }


# -- What comes in --------------------------------------------------------------------------------


def test_file_with_includes_paths_and_overrides(xml):
    """An XML with an include and a search path loads; the override arrives; all its files are named."""
    loaded = load_scene(xml, {"scale": 3})
    medium = loaded.scene.shapes()[0].interior_medium()
    assert mi.traverse(medium)["scale"] == 3.0
    assert {f.name for f in loaded.files} == {"scene.xml", "common.xml", "smoke.vol"}
    assert (loaded.name, loaded.kind) == ("scene", "file")


def test_search_paths_are_forgotten(xml):
    """Loading leaves Mitsuba's file resolver as it was."""
    before = [str(p) for p in mi.file_resolver()]
    load_scene(xml)
    assert [str(p) for p in mi.file_resolver()] == before


def test_refusals(xml, tmp_path):
    """One sentence each."""
    (tmp_path / "sphere.xml").write_text('<shape version="3.0.0" type="sphere"/>')
    (tmp_path / "broken.xml").write_text("<scene version='3.0.0'><shape")
    sphere = '<shape type="sphere"><float name="radios" value="1"/></shape>'
    (tmp_path / "typo.xml").write_text(f'<scene version="3.0.0">{sphere}</scene>')
    cases = [
        ((xml, {"scal": 3}), 'override "scal" is not used by scene.xml; did you mean "scale"'),
        ((xml, {"qqqq": 3}), 'override "qqqq" is not used by scene.xml; its parameters are: '),
        ((xml, {"sspp": 3}), 'did you mean "spp"'),
        ((tmp_path / "none.xml",), "there is no scene file"),
        ((tmp_path / "sphere.xml",), "describes a Shape, not a scene"),
        ((tmp_path / "broken.xml",), "broken.xml cannot be read"),
        ((tmp_path / "typo.xml",), "radios"),
        (({"type": "scene", "a": {"type": "sphear"}},), "sphear"),
        ((_described(), {"scale": 1}), "only XML files have parameters"),
        ((load_scene(xml).scene, {"scale": 1}), "only XML files have parameters"),
        ((3,), "not int"),
        ((load_scene(xml),), r"not LoadedScene: give its \.scene"),
    ]
    for arguments, words in cases:
        assert_refused(words, load_scene, *arguments)


def test_a_plugin_says_what_it_refuses(variant_rgb, tmp_path):
    """Mitsuba quotes the whole traceback of a plugin in Python, at whose end its sentence is."""
    grid = '<volume type="mivol_voxels" name="sigma_t"><string name="filename" value="nowhere.nrrd"/></volume>'
    medium = f'<medium type="heterogeneous" name="interior">{grid}</medium>'
    (tmp_path / "s.xml").write_text(f'<scene version="3.0.0"><shape type="cube">{medium}</shape></scene>')
    with pytest.raises(MivolError, match=r"nowhere.nrrd: found nothing there, expected an existing file") as caught:
        load_scene(tmp_path / "s.xml")
    assert "Traceback" not in str(caught.value)
    assert "MivolError" not in str(caught.value)
    assert 'volume plugin of type "mivol_voxels": ' in str(caught.value)


def test_a_refusal_that_is_no_text_says_so() -> None:
    """Python 3.11.2 drops a message of Mitsuba's that quotes bytes that are not UTF-8."""
    assert describe_error(RuntimeError("")) == NOT_UTF8
    assert describe_error(RuntimeError("  [a.cpp:1] ")) == NOT_UTF8
    assert describe_error(RuntimeError("[a.cpp:1] no such plugin")) == "no such plugin"


def test_variants_are_checked():
    """A spectral or polarised variant is refused by name."""
    mi.set_variant("scalar_spectral")
    try:
        assert_refused("scalar_spectral", load_scene, {"type": "scene"})
    finally:
        mi.set_variant("llvm_ad_rgb")


@pytest.mark.slow
def test_exr_is_read_with_one_thread(two_threads, tmp_path):
    """Mitsuba 3.9.1 waits for ever for a second thread of the pool (also with taskset); in a child that can be killed, after
    ten minutes: it takes a second, and a hang has no end."""
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    code = """
import sys
import mivol, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from mivol.scene.load import load_scene
load_scene({"type": "scene", "sky": {"type": "envmap", "filename": sys.argv[1]}})
print(dr.thread_count())
"""
    assert run_child(code, str(tmp_path / "sky.exr"), timeout=600).stdout.split() == ["1"]


# -- What the hash notices ------------------------------------------------------------------------


def test_hash_of_a_file_scene(xml, tmp_path):
    """Contents of XML, includes and volumes count; white space, place on disk, samples and integrator do not."""
    start = load_scene(xml).content_hash
    assert content_hash(xml) == start
    assert content_hash(xml, {"scale": 2}) == start
    assert content_hash(xml, {"spp": 64, "depth": 7}) == start
    assert content_hash(xml, {"scale": 3}) != start

    xml.write_text(SCENE.replace("\n", "\n   ").replace("textures", str(tmp_path / "moved")))
    (tmp_path / "textures").rename(tmp_path / "moved")
    assert content_hash(xml) == start
    (tmp_path / "moved").rename(tmp_path / "textures")
    xml.write_text(SCENE)

    _write_volume(tmp_path, 1.0 + 2**-23)
    assert content_hash(xml) != start, "one unit in the last place of one voxel"
    _write_volume(tmp_path, 1.0)
    assert content_hash(xml) == start
    (tmp_path / "common.xml").write_text(INCLUDED.replace('value="8"', 'value="9"', 1))
    assert content_hash(xml) != start, "the film of an included file"


def test_hash_of_a_dict(variant_rgb):
    """Grids, images, transforms and numbers count; the integrator does not."""
    start = content_hash(_described())
    assert load_scene(_described()).content_hash == start
    assert content_hash(_described(integrator={"type": "volpath", "max_depth": 3})) == start
    one_voxel, one_texel = np.ones((2, 3, 4, 1), np.float32), np.ones((4, 8, 3), np.float32)
    one_voxel[1, 2, 3, 0] += 2**-23
    one_texel[3, 7, 2] += 2**-23
    changed = {
        "voxel": _described(one_voxel),
        "same bytes, other shape": _described(np.ones((3, 2, 4, 1), np.float32)),
        "texel": _described(sky=one_texel),
        "number": _described(scale=1.0 + 2**-50),
        "transform": _described(cube={"to_world": mi.ScalarTransform4f().scale(2)}),
        "emitter more": _described(sun={"type": "directional"}),
    }
    hashes = {name: content_hash(scene) for name, scene in changed.items()}
    assert start not in hashes.values()
    assert len(set(hashes.values())) == len(hashes)


def test_hash_of_an_object(variant_rgb):
    """The same dict instantiated twice agrees; a parameter or the place of a volume changes it; rendering does not."""
    scene = mi.load_dict(_described(s={"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}))
    again = mi.load_dict(_described(s={"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}))
    start = content_hash(scene)
    assert content_hash(again) == start
    mi.render(scene, spp=2, integrator=mi.load_dict({"type": "volpath"}))
    assert content_hash(scene) == start
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("sigma_t.data"))  # noqa: SIM118  (iteration gives pairs)
    params[key] = params[key] + 1e-3
    params.update()
    assert load_scene(scene).content_hash != start


@pytest.mark.slow
def test_hash_is_the_same_in_another_process(variant_rgb, xml):
    """Nothing in it depends on addresses, on the seed of Python's own hash, or on the order of a set."""
    code = (
        "import sys, mivol, mitsuba as mi\n"
        "from mivol.scene.load import load_scene\n"
        "mi.set_variant(sys.argv[1])\n"
        "loaded = load_scene(sys.argv[2])\n"
        "print(loaded.content_hash, load_scene(loaded.scene).content_hash)\n"
    )
    command = [sys.executable, "-c", code, variant_rgb, str(xml)]
    out = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = load_scene(xml)
    assert out.stdout.split() == [loaded.content_hash, load_scene(loaded.scene).content_hash]


def test_detached_voxels_count(variant_rgb, tmp_path):
    """A header that names a raw file: the raw file's bytes are part of the hash."""
    (tmp_path / "a.mhd").write_text("ObjectType = Image\nNDims = 3\nElementDataFile = a.raw\n")
    medium = {"type": "homogeneous", "sigma_t": {"type": "not_a_plugin", "filename": str(tmp_path / "a.mhd")}}
    scene = {"type": "scene", "s": {"type": "sphere", "interior": medium}}
    hashes = []
    for values in (b"\0" * 8, b"\1" * 8):
        (tmp_path / "a.raw").write_bytes(values)
        hashes.append(content_hash(scene))
    assert hashes[0] != hashes[1]


def test_what_cannot_be_hashed_says_so(variant_rgb):
    """A Python object whose contents are not numbers: the scene is refused a hash, by the name of the entry."""
    box = mi.ScalarBoundingBox3f([0, 0, 0], [1, 1, 1])
    with pytest.raises(MivolError, match='"note" of the scene is a (Scalar)?BoundingBox3f'):
        content_hash({"type": "scene", "s": {"type": "sphere", "note": box}})


def test_what_stands_behind_a_sampler_is_kept():
    """A sampler, an integrator and addresses change from run to run; brackets inside of them do not end them."""
    text = "Camera[ sampler = IndependentSampler[ seeds = [1, [2]], n = 3 ], film = Film[ 0x7f3a, object_12 ], fov = 40 ]"
    assert _printed_settings(text) == "Camera[ sampler = , film = Film[ ,  ], fov = 40 ]"
