"""Changes applied to a small road."""

import dataclasses
import itertools
import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import shapely

import nuplan_fixture as fixture
from small_road import EGO_X, LANE_WIDTH, Thing, road
from spdm_jax.interplan.config import Density, ObstacleKind, Policy
from spdm_jax.interplan.extras import InterplanExtras, read_extras, write_extras
from spdm_jax.interplan.modification_file import modifications_from, read_modifications
from spdm_jax.interplan.modify import modify, walk_share
from spdm_jax.interplan.reader import InterplanReader
from spdm_jax.interplan.spawn import GREATEST_GAP, LEAST_GAP, draw_queue
from spdm_jax.io.build import build_scenario
from spdm_jax.io.map_query import MapQuery
from spdm_jax.io.nuplan_filter import ScenarioFilter, Window
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.types import ObjectType

TOKEN = "0123456789abcdef"
CENTER = EGO_X + 1.461
RECORDED = (
    Thing(90.0, 0.0, 5.0, id="car", length=4.0, width=1.7),
    Thing(20.0, -3.5, 5.0, id="van", length=6.0, width=2.1),
    Thing(80.0, 5.0, type=int(ObjectType.PEDESTRIAN), id="walker"),
    Thing(85.0, 5.0, type=int(ObjectType.BARRIER), id="barrier"),
    Thing(95.0, 5.0, type=int(ObjectType.BICYCLE), id="bicycle"),
)


def change(code: str, raw: RawScenario | None = None, seed: str | None = None, **fields):
    """Applies a code with what a file says about the token."""
    raw = road(things=RECORDED) if raw is None else raw
    file = modifications_from({"modification_details_dictionary": {TOKEN: fields}}, "file")
    return modify(raw, file.changes(f"{TOKEN}-{code}"), seed=seed)


def rows(raw: RawScenario, kind: ObjectType = ObjectType.VEHICLE) -> np.ndarray:
    return np.flatnonzero(raw.tracks.type == kind)


def initial(raw: RawScenario) -> np.ndarray:
    """Poses `[K, 3]` of all vehicles at iteration 0."""
    return raw.tracks.pose[rows(raw), raw.num_history]


def test_goal_alone_leaves_objects():
    raw = road(things=RECORDED)
    changed, extras = change("gs", raw)
    assert changed.tracks is raw.tracks
    assert changed.token == extras.name == f"{TOKEN}-gs"
    assert (extras.stopped, extras.pedestrians, extras.obstacle_kind) == ((), (), None)


@pytest.mark.parametrize("code, kept", [("a0", set()), ("a1", {"car", "van"})])
def test_recorded_vehicles(code: str, kept: set[str]):
    changed, _ = change(code)
    assert set(changed.tracks.ids) == kept
    build_scenario(changed)


@pytest.mark.parametrize("density", list(Density))
def test_density(density: Density):
    found = []
    for seed in "abcdefgh":
        changed, extras = change(f"d{density[0]}", seed=seed)
        assert changed.scenario_type == f"{density}_traffic_density"
        poses = initial(changed)
        assert len(poses) == len(changed.tracks.ids)
        assert set(poses[:, 1]) <= {0.0, -LANE_WIDTH} and not poses[:, 2].any()
        assert extras.policy is Policy.ASSERTIVE
        for y in (0.0, -LANE_WIDTH):
            x = np.sort(poses[poses[:, 1] == y, 0])
            # The ego takes the place of a vehicle in its own lane, which then is up to 10 m off.
            assert (np.diff(x) > 0).all()
            if y == 0.0:
                assert (np.diff(x) >= LEAST_GAP - 1e-9).all()
                assert (np.diff(x) < GREATEST_GAP[density]).all()
        found.append(len(poses))
    assert np.mean(found) > {"low": 2, "medium": 5, "high": 8}[density]
    assert np.mean(found) < {"low": 9, "medium": 16, "high": 24}[density]


def test_density_uses_recorded_bodies_first_and_then_the_egos():
    changed, _ = change("dh", seed="a")
    sizes = Counter(tuple(pair) for pair in changed.tracks.size[:, changed.num_history].tolist())
    assert sizes.pop((4.0, 1.7)) == 1 and sizes.pop((6.0, 2.1)) == 1
    assert list(sizes) == [(5.176, 2.297)]
    assert {"car", "van"} < set(changed.tracks.ids)


def test_same_seed_same_scenario():
    first, again, other = (change("dmgloc", seed=seed) for seed in ("a", "a", "b"))
    assert first[1] == again[1]
    assert np.array_equal(first[0].tracks.pose, again[0].tracks.pose)
    assert np.array_equal(first[0].ego, again[0].ego)
    assert first[0].tracks.pose.shape != other[0].tracks.pose.shape or not np.array_equal(
        first[0].tracks.pose, other[0].tracks.pose
    )


def test_moving_vehicles_start_at_the_egos_recorded_speed_and_have_a_past_only():
    changed, _ = change("dh", road(speed=7.0), seed="a")
    tracks, now = changed.tracks, changed.num_history
    speed = np.hypot(*np.moveaxis(tracks.velocity[:, now], -1, 0))
    assert set(np.round(speed, 9)) <= {0.0, 7.0} and (speed > 0).any()
    assert tracks.valid[:, : now + 1].all() and not tracks.valid[:, now + 1 :].any()
    step = tracks.pose[:, now, 0] - tracks.pose[:, now - 1, 0]
    assert np.allclose(step, 0.1 * speed)


def test_density_fills_listed_roadblocks():
    here, _ = change("dh", seed="a")
    both, _ = change("dh", seed="a", roadblock_locations_to_spawn_agents=[[300.0, 0.0]])
    assert initial(here)[:, 0].max() < 220
    assert initial(both)[:, 0].max() > 220
    with pytest.raises(ScenarioError, match=r"\[300.0, 50.0\] is in no roadblock"):
        change("dh", roadblock_locations_to_spawn_agents=[[300.0, 50.0]])


def test_extra_agents():
    agents = [[150.0, 1.0, 0], [150.0, -3.0, 3, {"snap": True, "behavior": "default"}]]
    changed, extras = change("dl", seed="a", extra_agents_to_spawn=agents)
    added = {tuple(pose[:2]): i for i, pose in zip(rows(changed), initial(changed), strict=True)}
    first, second = added[150.0, 1.0], added[150.0, -LANE_WIDTH]
    assert changed.tracks.ids[first] in extras.cautious
    assert changed.tracks.ids[second] not in extras.cautious
    now = changed.num_history
    assert not changed.tracks.velocity[first, now].any()
    assert changed.tracks.velocity[second, now, 0] == 10.0
    with pytest.raises(ScenarioError, match="is on no lane"):
        change("dl", extra_agents_to_spawn=[[150.0, 50.0, 0, {"snap": True}]])


def test_vehicle_is_not_spawned_into_others_beyond_the_egos_roadblock():
    twice = [[300.0, 0.0, 0], [302.0, 0.0, 0]]
    beyond, _ = change("dl", seed="a", extra_agents_to_spawn=twice)
    assert np.sum(initial(beyond)[:, 0] == 300.0) == 1
    assert not np.any(initial(beyond)[:, 0] == 302.0)
    near = [[30.0, 0.0, 0], [32.0, 0.0, 0]]
    here, _ = change("dl", seed="a", extra_agents_to_spawn=near)
    assert np.any(initial(here)[:, 0] == 32.0)


def special(kind: str, code: str = "", **content):
    entry = {"type": kind, "config": code or None} | content
    return change("s3", seed="a", special_scenario={"3": entry})


def test_stopped_vehicles_replace_what_they_overlap():
    place = [120.0, -1.0, 0.3]
    changed, extras = special(
        "nudge_around_parked_vehicle", "dh", stopped_vehicle=[place, [121.0, -1.0, 0.3]]
    )
    tracks, now = changed.tracks, changed.num_history
    assert len(extras.stopped) == 2
    for track, x in zip(extras.stopped, (120.0, 121.0), strict=True):
        row = tracks.ids.index(track)
        assert tracks.pose[row, :, 0].tolist() == [x] * len(changed.time_us)
        assert tracks.valid[row].all() and not tracks.velocity[row].any()
    box = shapely.box(118.0, -2.0, 123.0, 0.0)
    for row in set(range(len(tracks.ids))) - {tracks.ids.index(t) for t in extras.stopped}:
        x, y, _ = tracks.pose[row, now]
        assert not box.contains(shapely.Point(x, y))
    assert extras.obstacle_kind is ObstacleKind.STOPPED_VEHICLES
    assert extras.obstacles == ((120.0, -1.0), (121.0, -1.0))


def test_special_scenario_without_density_removes_all_vehicles():
    changed, extras = special("overtake_parked_vehicle", stopped_bus=[[120.0, -3.0, 0.0]])
    assert changed.tracks.ids == list(extras.stopped)
    assert changed.tracks.size[0, 0].tolist() == [7.4557, 2.0786]
    assert changed.scenario_type == extras.scenario_type == "overtake_parked_vehicle"
    # Bodies that a0 has removed are not used again.
    spent, _ = special("overtake_parked_vehicle", "a0", stopped_vehicle=[[120.0, -3.0, 0.0]])
    assert spent.tracks.size[0, 0].tolist() == [5.176, 2.297]
    kept, _ = special("overtake_parked_vehicle", "a1", stopped_vehicle=[[120.0, -3.0, 0.0]])
    assert len(kept.tracks.ids) == 1 and kept.tracks.ids[0] in ("car", "van")


def test_cones_and_pedestrians():
    changed, extras = special(
        "approaching_construction_zone",
        cones=[[100.0, -3.0], [105.0, -3.5]],
        pedestrian=[[110.0, 5.0, 110.0, -10.0, None], [120.0, 5.0, 120.0, -10.0, 4]],
    )
    tracks, now = changed.tracks, changed.num_history
    cones = rows(changed, ObjectType.TRAFFIC_CONE)
    assert tracks.valid[cones].all() and (tracks.size[cones] == 0.5).all()
    assert len(np.unique(tracks.pose[cones, 0, 2])) == 2
    assert extras.obstacles == ((100.0, -3.0), (105.0, -3.5))
    waits, walks = (tracks.ids.index(who.track) for who in extras.pedestrians)
    assert not tracks.valid[waits].any() and tracks.valid[walks].all()
    assert not tracks.velocity[[waits, walks]].any()
    y = tracks.pose[walks, now:, 1]
    # 15 m in 20 iterations (the scenario's length), beginning with iteration 4.
    assert y[:5].tolist() == [5.0] * 5
    assert np.allclose(np.diff(y[4:25]), -0.75) and (y[24:] == -10.0).all()
    assert np.allclose(tracks.pose[walks, now, 2], -np.pi / 2)
    build_scenario(changed)


def test_pedestrian_walks_for_150_iterations_more_than_it_waits():
    share = walk_share(np.array([0, 10, 90, 170, 200]), 10, 300)
    assert share.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert walk_share(np.array([150]), 200, 300) == 0.0


def test_jaywalkers_obstacle_is_where_they_go():
    _, extras = special("jaywalking_pedestrian", pedestrian=[[110.0, 5.0, 112.0, -10.0, None]])
    assert extras.obstacles == ((112.0, -10.0),)
    assert extras.obstacle_kind is ObstacleKind.PEDESTRIANS


def test_queue():
    line = shapely.LineString([(0, 0), (300, 0)])
    for seed in range(20):
        rng = random.Random(seed)
        queue = draw_queue(line, 150.0, 33, 12.0, False, 1.0, 2.0, rng)
        place = np.array([p for p, _ in queue.places])
        speed = np.array([v for _, v in queue.places])
        assert (np.diff(place) < 0).all() and (place >= 0).all() and (place <= 290).all()
        assert ((speed >= 0) & (speed <= 12)).all()
        assert (np.abs(place - 150.0) >= 10.0).all()
        alone = draw_queue(line, None, 33, 12.0, False, 1.0, 2.0, random.Random(seed))
        assert alone.ego_speed is None
        # Speeds differ from half the gap per second, and from the stopping speed, by noise only.
        gaps = -np.diff([p for p, _ in alone.places])
        assert (np.array([v for _, v in alone.places])[1:] < gaps / 2 + 5).all()


def test_queues_leader():
    line = shapely.LineString([(0, 0), (60, 0)])
    draws = [
        draw_queue(line, None, 11, None, free, 1.5, 2.0, random.Random(i)).places[0]
        for free, i in itertools.product((True, False), range(200))
    ]
    assert {place for place, _ in draws} == {50.0}
    speed = np.array([v for _, v in draws]).reshape(2, 200).mean(1)
    assert np.allclose(speed, [10.0, np.sqrt(10.0)], atol=0.25)


def test_ego_takes_the_speed_of_its_place():
    speeds = []
    for seed in "abcdefghij":
        changed, _ = change("dh", seed=seed)
        raw = road()
        ego = changed.ego - raw.ego
        ego[raw.num_history, 3] = 0.0
        assert not ego.any()
        speeds.append(changed.ego[raw.num_history, 3])
        taken = initial(changed)
        own = taken[taken[:, 1] == -LANE_WIDTH, 0]
        if speeds[-1] != 10.0:
            assert (np.abs(own - CENTER) >= LEAST_GAP - 1e-9).all()
    assert len({v for v in speeds if v != 10.0}) > 3


def test_expert_follows_the_lanes_to_the_goal():
    changed, extras = change("gl", goal={"left": "340, 0.2"})
    now, count = changed.num_history, changed.num_iterations
    assert changed.route_roadblocks == ["b0", "c0", "b1"]
    goal = changed.mission_goal
    assert goal is not None and np.allclose(goal, [340.0, 0.0, 0.0])
    assert extras.goal == tuple(goal)
    # Of equally good start lanes the leftmost counts: the way is on lane 0.
    course = np.array(extras.course)
    assert np.allclose(course[:, 1], 0.0) and np.isclose(course[0, 0], CENTER)
    assert np.isclose(course[-1, 0], 460.0)
    assert np.isclose(extras.end, 340.0 - CENTER - 0.1)
    centers = changed.ego[now:, :2] + [1.461, 0.0]
    assert np.allclose(centers[0], [CENTER, -LANE_WIDTH])
    for i in (1, 7, count - 1):
        assert np.allclose(centers[i], course[int(len(course) / count * i)])
    assert np.allclose(centers[count:], course[-1])
    assert (changed.ego[now:, 3] == 10.0).all()
    build_scenario(changed)


def test_goal_in_another_lane_of_the_egos_roadblock():
    changed, extras = change(
        "gr", road(blocks=((0, 1, 2),), cuts=(400.0,)), goal={"right": [300, -7]}
    )
    assert changed.route_roadblocks == ["b0"]
    assert np.allclose(np.array(extras.course)[:, 1], -7.0)


def test_lane_that_nothing_leads_to_is_reached_by_a_lane_change():
    # Lane 2 begins with the second block: the way ends beside it and moves over.
    raw = road(blocks=((0, 1), (0, 1, 2)))
    changed, extras = change("gr", raw, goal={"right": [400, -7]})
    assert changed.route_roadblocks == ["b0", "c0", "b1"]
    course = np.array(extras.course)
    assert set(np.round(course[:, 1], 6)) == {-3.5, -7.0}


@pytest.mark.parametrize(
    "place, words", [("700, 0", "more than 300 m"), ("10, 0", "no way from roadblock b1")]
)
def test_goals_out_of_reach(place: str, words: str):
    raw = road(ego_x=250.0, blocks=((0, 1), (0, 1), (0, 1)), cuts=(200.0, 600.0, 900.0))
    with pytest.raises(ScenarioError, match=rf"{TOKEN}-gl: goal left: .*{words}"):
        change("gl", raw, goal={"left": place})


def test_density_or_goal_needs_a_lane():
    raw = road(ego_y=30.0)
    for code in ("dl", "gs"):
        with pytest.raises(ScenarioError, match="ego is on no lane at iteration 0"):
            change(code, raw)
    changed, _ = change("a0", raw)
    assert changed.tracks.ids == []


def forked() -> RawScenario:
    """A road that forks to the left, straight on and to the right, and forks again."""
    roads = {
        "A": fixture.Road((0, 0), (100, 0), lanes=2),
        "L": fixture.Road((115, 15), (115, 100)),
        "S": fixture.Road((130, 0), (230, 0), lanes=2),
        "R": fixture.Road((115, -15), (115, -100)),
        "SL": fixture.Road((245, 15), (245, 100)),
        "SS": fixture.Road((260, 0), (360, 0)),
    }
    links = [
        ("A", "L", [(0, 0)]),
        ("A", "S", [(0, 0), (1, 1)]),
        ("A", "R", [(1, 0)]),
        ("S", "SL", [(0, 0)]),
        ("S", "SS", [(1, 0)]),
    ]
    raw_map = fixture.road_map(roads, links)
    return dataclasses.replace(
        road(ego_y=-1.75),
        map=raw_map,
        lights=[{} for _ in range(102)],
        route_roadblocks=["A", "A-S", "S", "S-SS", "SS"],
    )


@pytest.mark.parametrize(
    "command, expected",
    [
        ("l", ["A", "A-L", "L"]),
        ("s", ["A", "A-S", "S", "S-SS", "SS"]),
        ("r", ["A", "A-R", "R"]),
    ],
)
def test_commands_are_followed_at_every_intersection(command: str, expected: list[str]):
    changed, extras = change(f"g{command}", forked(), goal={"left": None})
    assert changed.route_roadblocks == expected
    course, goal = np.array(extras.course), changed.mission_goal
    # Two seconds of driving: the plan ends with the lane that they end on.
    assert goal is not None and np.allclose(course[-1], goal[:2])
    assert np.isclose(extras.end, shapely.LineString(course).length - 0.1)
    assert np.isclose(course[-1, 0], 100.0)


def test_query_belongs_to_the_map():
    raw, file = road(), modifications_from({"modification_details_dictionary": {}})
    with pytest.raises(ValueError, match="another map"):
        modify(raw, file.changes(f"{TOKEN}-a0"), query=MapQuery(road().map))


def test_without_a_goal_the_recorded_drive_is_the_way():
    changed, extras = change("a0")
    assert changed.route_roadblocks == road().route_roadblocks
    assert np.isclose(extras.course[0][0], CENTER)
    assert len(extras.course) == changed.num_iterations
    assert np.isclose(extras.end, 19.0 - 1.461 - 0.1)


def test_extras_survive_a_file(tmp_path: Path):
    _, extras = special(
        "jaywalking_pedestrian",
        "dm",
        pedestrian=[[110.0, 5.0, 112.0, -10.0, None], [1.0, 5.0, 1.0, -10.0, 4]],
        stopped_vehicle=[[120.0, -3.0, 0.0]],
    )
    _, plain = change("dhgloc", extra_agents_to_spawn=[[150.0, 1.0, 0]])
    path = tmp_path / "scene.interplan.json"
    for record in (extras, plain):
        write_extras(path, record)
        found = read_extras(path)
        assert found == record and isinstance(found, InterplanExtras)
        assert isinstance(found.policy, Policy)
    write_extras(path, dataclasses.replace(extras, obstacles=()))
    with pytest.raises(ScenarioError, match="'ego_sorts_jaywalking_pedestrian' without obstacles"):
        read_extras(path)
    path.write_text('{"name": "x"}')
    with pytest.raises(ScenarioError, match="no record of an interPlan scenario"):
        read_extras(path)


FILE = """
modification_details_dictionary:
  27b62ec6fac3c3bb:
    goal: {left: null, right: null, straight: null}
    special_scenario:
      '0': {type: approaching_construction_zone, config: dl,
            cones: [[588775.0, 4479745.0]], pedestrian: [[588790, 4479740, 588795, 4479730, null]]}
  7e3e3769e416290e:
    goal: {left: "588820.0, 4479720.0"}
    special_scenario:
      '4': {type: nudge_around_parked_vehicle, stopped_vehicle: [[588775.0, 4479741.0, -0.5]]}
"""


def test_file_on_real_roads(shared: Path, tmp_path: Path):
    data = shared / "data" / "nuplan_format" / "pit_3bffdcff"
    if not data.is_dir():
        pytest.skip("reference data not at hand")
    pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
    path = tmp_path / "changes.yaml"
    path.write_text(FILE)
    names = [
        *(f"27b62ec6fac3c3bb-{code}" for code in ("dhgloa", "dlgsom", "s0")),
        *(f"7e3e3769e416290e-{code}" for code in ("dmgroc", "gl", "s4", "a1")),
    ]
    reader = InterplanReader(
        data, read_modifications(path), ScenarioFilter(scenario_tokens=(*names, "f" * 16 + "-a0"))
    )
    assert reader.tokens() == names
    for name in names:
        raw, extras = reader.read_with_extras(name)
        scenario, info = build_scenario(raw)
        assert info.token == extras.name == name
        assert {*extras.stopped, *(who.track for who in extras.pedestrians)} <= {*info.track_ids}
        assert scenario.ego_valid.all() and 0 < extras.end
        if "g" in name:
            # The expert keeps to lanes that follow the ego's, away from where it starts.
            query = MapQuery(raw.map)
            ego = raw.ego[raw.num_history + 1 : raw.num_history + raw.num_iterations]
            ahead = 1.461 * np.stack([np.cos(ego[:, 2]), np.sin(ego[:, 2])], 1)
            assert query.is_drivable(ego[:, :2] + ahead).all()
    again = reader.read(names[0])
    assert np.array_equal(again.tracks.pose, reader.read(names[0]).tracks.pose)


def test_reader_needs_names_with_codes(shared: Path):
    data = shared / "data" / "nuplan_format" / "pit_3bffdcff"
    if not data.is_dir():
        pytest.skip("reference data not at hand")
    config = modifications_from({"modification_details_dictionary": {}})
    with pytest.raises(ScenarioError, match="names no changed scenario"):
        InterplanReader(data, config, ScenarioFilter(scenario_tokens=("27b62ec6fac3c3bb",)))
    reader = InterplanReader(
        data,
        config,
        ScenarioFilter(scenario_tokens=("27b62ec6fac3c3bb-a0",)),
        window=Window(5.0, 0.0),
    )
    assert reader.read("27b62ec6fac3c3bb-a0").num_iterations == 50
    with pytest.raises(ScenarioError, match="is not selected"):
        reader.read("27b62ec6fac3c3bb-a1")
