"""The entry points: names, options, errors, and the reader."""

import inspect

import pytest

from spdm_jax.io.raw import Reader, ScenarioError, iter_scenarios
from spdm_jax.synthetic import SCENES, SyntheticReader, make_scene, scene_names


def test_names_are_the_scenes():
    assert scene_names() == tuple(SCENES)
    assert {"parked_car", "lane_ends", "jaywalker", "red_light", "open_road"} <= set(scene_names())


def test_every_option_has_a_default():
    for name, function in SCENES.items():
        _, *options = inspect.signature(function).parameters.values()
        assert all(o.default is not inspect.Parameter.empty for o in options), name


def test_reader_offers_names_times_seeds():
    reader: Reader = SyntheticReader(["open_road", "lane_ends"], seeds=(4, 2))
    tokens = reader.tokens()
    assert tuple(tokens) == ("open_road-4", "open_road-2", "lane_ends-4", "lane_ends-2")
    read = list(iter_scenarios(reader))
    assert [r.token for r in read] == list(tokens)
    assert [r.scenario_type for r in read] == ["open_road"] * 2 + ["lane_ends"] * 2


def test_reader_selects_all_by_default():
    assert len(SyntheticReader().tokens()) == len(SCENES)


@pytest.mark.parametrize("token", ["open_road-9", "nonsense", ""])
def test_reader_refuses_other_tokens(token):
    with pytest.raises(ScenarioError, match="is not selected"):
        SyntheticReader(["open_road"]).read(token)


def test_reader_refuses_unknown_names_and_seeds():
    with pytest.raises(ValueError, match="opne_road"):
        SyntheticReader(["opne_road"])
    with pytest.raises(ValueError, match="-3"):
        SyntheticReader(["open_road"], seeds=[-3])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("nonsense", {}, "scene 'nonsense' is unknown"),
        ("open_road", {"gap": 3.0}, "no option 'gap'"),
        ("open_road", {"seed": -1}, "seed is -1"),
        ("parked_car", {"gap": 0.0}, "gap is 0.0"),
        ("lane_ends", {"length": 5.0}, "length is 5.0"),
        ("lane_ends", {"goal_side": "up"}, "goal_side is 'up'"),
        ("curve", {"radius": 10.0}, "radius is 10.0"),
        ("jaywalker", {"walk_speed": 0.0}, "walk_speed 0.0"),
        ("oncoming", {"bicycle_gap": -1.0}, "bicycle_gap is -1.0"),
        ("intersection", {"turn": "back"}, "turn is 'back'"),
        ("intersection", {"distance": 1.0}, "distance is 1.0"),
        ("red_light", {"distance": 15.0, "queued": 2}, "distance is 15.0"),
    ],
)
def test_errors_name_what_is_wrong(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_scene(name, **options)
