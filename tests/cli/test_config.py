"""Experiments in TOML: what they mean, what overrides them, and a sentence for everything that is wrong in one."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from pathlib import Path

import msgspec
import pytest
from refusals import assert_refused

from mivol import config
from mivol.errors import MivolError
from mivol.optim.priors import TotalVariation
from mivol.optim.second_order import GaussNewton
from mivol.schema import describe, describe_domain, list_structs, settings_in

ROOT = Path(__file__).resolve().parents[2]
SMALLEST = """
title = "a"
[scene]
file = "scene.xml"
[[parameter]]
key = "cube.interior_medium.sigma_t.data"
prior = [{ name = "tv", weight = 0.5 }]
[views]
rig = "ring"
"""


def raw() -> dict:
    return copy.deepcopy(tomllib.loads(SMALLEST))


def test_defaults_and_given_values() -> None:
    found = config.from_dict(raw())
    assert found.parameter[0].prior == (TotalVariation(weight=0.5),)
    assert found.parameter[0].domain is None
    assert found.views.count == 8
    assert found.fit.integrator == "mivol"


def test_resolved_settings_are_an_experiment_again() -> None:
    found = config.from_dict(raw())
    again = config.from_dict(config.list_all_settings(found))
    assert again == found


def test_every_setting_says_what_it_is() -> None:
    """Each line of the help names a setting, and each setting has one; units are said where there are any."""
    lines = describe(config.SceneExperiment)
    assert any(line.startswith("optimizer[adam].beta_1 = 0.9: ") for line in lines)
    assert any(line.startswith("fit.spp = 16 [sample/pixel]: ") for line in lines)
    assert any(line.startswith("parameter.0.prior.0[tv,huber_tv,laplacian,l1,bounds].weight = 1.0: ") for line in lines)
    assert all(line.partition(": ")[2].strip() for line in lines)


def test_command_line_overrides_the_file(tmp_path: Path) -> None:
    path = tmp_path / "fit.toml"
    path.write_text(SMALLEST)
    changes = ["fit.iterations=7", "parameter.0.lr=0.5", "views.count=3", 'optimizer={name="gauss_newton"}', "title=two words"]
    found = config.load(path, [*changes, "optimizer.inner=4", "parameter.0.prior.0.weight=2"])
    assert (found.fit.iterations, found.parameter[0].lr, found.views.count) == (7, 0.5, 3)
    assert found.optimizer == GaussNewton(inner=4)
    assert found.title == "two words"
    assert found.parameter[0].prior[0].weight == 2.0
    assert config.load(path, ["parameter.0.domain=[0, inf]"]).parameter[0].domain == (0.0, math.inf)


def test_flat_names_everything_that_changes_the_result() -> None:
    flat = config.flatten_settings(config.list_all_settings(config.from_dict(raw())))
    assert flat["parameter.0.prior.0.weight"] == 0.5
    assert flat["optimizer.beta_1"] == 0.9
    assert not {"title", "output", "threads"} & set(flat)


@pytest.mark.parametrize("path", sorted((ROOT / "scenes").glob("*/*.toml")), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_shipped_experiments_are_valid(path: Path) -> None:
    found = config.load(path)
    assert not isinstance(found, config.SceneExperiment) or (path.parent / found.scene.file).exists()


#: what is wrong -> (changes to the smallest experiment, what the sentence must say)
WRONG = {
    "misspelt key": (["titel=x"], 'unknown key "titel": did you mean "title"'),
    "misspelt key in a section": (["fit.iteratons=3"], 'unknown key "fit.iteratons": did you mean "iterations"'),
    "misspelt key in a list": (["parameter.0.domian=[0, 1]"], '"parameter.0.domian": did you mean "domain"'),
    "misspelt key of a strategy": (['loss={name="huber", detla=1}'], '"loss.detla": did you mean "delta"'),
    "key of another strategy": (['loss={name="l1", delta=1}'], 'unknown key "loss.delta"'),
    "misspelt strategy": (['optimizer={name="addam"}'], 'optimizer.name = "addam" is unknown: did you mean "adam"'),
    "misspelt prior": (['parameter.0.prior=[{name="tvv"}]'], 'prior.0.name = "tvv" is unknown: did you mean "tv"'),
    "strategy without a name": (["schedule={final=0.1}"], '"schedule.name" is missing'),
    "misspelt rig": (['views.rig="rings"'], 'views.rig = "rings" is unknown: did you mean "ring"'),
    "misspelt source": (['reference={source="file", paths=["a"]}'], 'did you mean "files"'),
    "wrong type": (['fit.iterations="many"'], "fit.iterations = 'many': expected `int`"),
    "section of wrong type": (["scene=3"], "scene = 3: expected `object`"),
    "table where a list is expected": (['parameter={key="a"}'], "parameter: expected `array`"),
    "outside its domain": (["fit.spp=0"], "fit.spp = 0: expected `int` >= 1"),
    "outside an open domain": (["parameter.0.lr=0"], "parameter.0.lr = 0: expected `float` > 0"),
    "no views": (["views.count=0"], "views.count = 0: expected `int` >= 1"),
    "no reference files": (['reference={source="files", paths=[]}'], "length >= 1"),
    "no parameter": (["parameter=[]"], "length >= 1"),
    "missing key": (["scene={}"], 'the key "scene.file" is missing'),
    "unknown map": (['parameter.0.map="softpluss"'], 'did you mean "softplus"?'),
    "truth of two sources": (['truth={key="a", file="b", procedural="tangle"}'], "either a file or procedural"),
    "a change without a value": (["fit.iterations"], "write key.of.setting=value"),
    "a change of an entry that is not there": (["parameter.3.lr=1"], '"3" does not exist'),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_settings(case: str) -> None:
    """Rationale: configuration that accepts a misspelt key runs with the default and says nothing."""
    changes, sentence = WRONG[case]
    settings = raw()
    with pytest.raises(MivolError) as caught:
        for change in changes:
            config.apply_change(settings, change)
        config.from_dict(settings, "fit.toml")
    message = str(caught.value)
    assert sentence in message
    assert "\n" not in message
    assert message.endswith((".", "?"))


def test_wrong_files(tmp_path: Path) -> None:
    assert_refused("found no file", config.load, tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("title = ")
    assert_refused("is not TOML", config.load, tmp_path / "bad.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    assert_refused("is not TOML", config.load, tmp_path / "binary.toml")
    assert_refused("is not TOML", config.load, tmp_path)
    xml = tmp_path / "scene.xml"
    xml.write_text('\n<scene version="3.0.0"/>')
    with pytest.raises(MivolError) as refused:
        config.load(xml)
    assert str(refused.value) == f"{xml}: found XML, expected an experiment in TOML; name the scene in its table [scene]."


def test_an_experiment_without_a_title_has_the_name_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "warm fog.toml"
    path.write_text('photos = {path = "photographs"}\n')
    assert config.load(path).title == "warm fog"
    assert config.load(path, ["title=mist"]).title == "mist"


def test_the_schema_is_strict() -> None:
    """Every struct that a file can fill refuses unknown fields by itself, too."""
    seen = list(config.EXPERIMENTS)
    for struct in seen:
        assert struct.__struct_config__.forbid_unknown_fields, struct
        for field in msgspec.structs.fields(struct):
            seen += [s for s in list_structs(getattr(field.type, "__origin__", field.type)) if s not in seen]
    assert len(seen) > 12


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("show.way=orbit", ('show.way = "orbit" is unknown', "keyframes, turntable, views")),
        ("show.way=vews", ('show.way = "vews" is unknown: did you mean "views"',)),
    ],
)
def test_a_word_that_is_none_of_a_setting_says_which_there_are(tmp_path: Path, change: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "fit.toml"
    path.write_text('title = "A"\n[photos]\npath = "photographs"\n')
    with pytest.raises(MivolError) as refused:
        config.load(path, (change,))
    assert all(each in str(refused.value) for each in words)
    assert config.load(path, ("show.way=views",)).show.way == "views"


def test_the_kind_of_a_field_decides_its_settings() -> None:
    raw = {"title": "A", "photos": {"path": "photographs"}}
    assert isinstance(config.from_dict(raw | {"field": {"kind": "grid"}}), config.FieldExperiment)
    chosen = config.from_dict(raw | {"field": {"kind": "hash", "levels": 4}})
    assert isinstance(chosen, config.HashExperiment) and chosen.field.levels == 4
    chosen = config.from_dict(raw | {"field": {"kind": "nerf", "depth": 4}})
    assert isinstance(chosen, config.NerfExperiment) and chosen.field.depth == 4
    for field, said in (
        ({"kind": "nerf", "levels": 4}, 'unknown key "field.levels"'),
        ({"kind": "hsah"}, 'field.kind = "hsah" is unknown: did you mean "hash"'),
        ({"kind": "hash", "degree": 2}, 'unknown key "field.degree"'),
        ({"kind": "hash", "features": 3}, "features is 3: 1, 2, 4 or 8 is expected"),
        ({"levels": 2, "log2_table": 10}, 'unknown key "field.log2_table"'),
    ):
        with pytest.raises(MivolError) as refused:
            config.from_dict(raw | {"field": field})
        assert said in str(refused.value)


def test_settings_say_what_they_are_chosen_from() -> None:
    choices = {setting.key: setting.choices for setting in settings_in(config.FieldExperiment)}
    assert choices["show.way"] == ("turntable", "views", "keyframes") and choices["show.views"] == ()
    assert "(turntable | views | keyframes)" in next(
        line for line in describe(config.FieldExperiment) if line.startswith("show.way")
    )


def test_a_setting_of_several_choices_is_said_once() -> None:
    """The distances of ring and hemisphere are equal; the default counts are not."""
    lines = describe(config.SceneExperiment)
    starts = [line.split(":")[0] for line in lines if line.startswith("views[") and re.search(r"\.(distance|count) ", line)]
    assert starts[:3] == [
        "views[ring].count = 8",
        "views[ring,hemisphere].distance = 4.0 [radius of the box]",
        "views[hemisphere].count = 16",
    ]
    assert "fit.max_depth = absent" in {line.split(":")[0] for line in lines}


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ({}, ""),
        ({"ge": 0, "le": 4}, "0 to 4"),
        ({"gt": 0.0, "le": 1.0}, "above 0.0, at most 1.0"),
        ({"ge": 0, "lt": 1}, "at least 0, below 1"),
        ({"ge": -1}, "at least -1"),
    ],
)
def test_domains_are_said_in_words(bounds: dict[str, float], said: str) -> None:
    assert describe_domain(msgspec.Meta(**bounds)) == said
