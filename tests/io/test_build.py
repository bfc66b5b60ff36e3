"""Raw scenarios to scenarios: what is kept, that nothing is altered, and what is refused."""

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from random_world import world
from spdm_jax.io.build import build_scenario, raw_map, start_at
from spdm_jax.io.crop import MapIndex
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.io.route import route_tables
from spdm_jax.io.validate import validate_raw
from spdm_jax.schema import LEAVES, check_leaves, leaves_of
from spdm_jax.synthetic import make_scene
from spdm_jax.types import Array, Scenario

HISTORY_4 = 8
"""Seed of a world with 4 history steps."""
AREA_LAYERS = ("intersections", "car_parks", "drivable", "crosswalks", "walkways", "stop_lines")
worlds = st.builds(
    world,
    st.integers(0, 10_000),
    blocks=st.integers(1, 6),
    lanes=st.integers(1, 3),
    agents=st.integers(0, 4),
    areas=st.integers(0, 3),
)


def assert_same(first: Scenario, second: Scenario, ignore: tuple[str, ...] = ()) -> None:
    for (path, one), other in zip(
        leaves_of(first).items(), leaves_of(second).values(), strict=True
    ):
        if not path.startswith(ignore) or not ignore:
            assert one.dtype == other.dtype and one.tobytes() == other.tobytes(), path


@settings(max_examples=6)
@given(raw=worlds)
def test_leaves_fit_the_schema_and_are_finite(raw: RawScenario):
    scenario, info = build_scenario(raw, margin=30.0)
    leaves = leaves_of(scenario)
    assert list(leaves) == list(LEAVES)
    sizes = check_leaves(leaves)
    assert sizes["lanes"] == len(info.lane_ids)
    for path, leaf in leaves.items():
        if path != "map.lanes.speed_limit":
            assert np.isfinite(leaf).all(), path
    for path in ("map.lanes.polygon", "map.roadblocks.polygon", "map.drivable"):
        row, start, count = (leaves[f"{path}.{name}"] for name in ("row", "start", "count"))
        expected = [np.full(n, i) for i, n in enumerate(count)]
        np.testing.assert_array_equal(row, np.concatenate([np.zeros(0), *expected]))
        np.testing.assert_array_equal(start, np.cumsum(count) - count)


@settings(max_examples=6)
@given(raw=worlds, margin=st.floats(5.0, 80.0))
def test_crop_keeps_what_is_near_and_little_else(raw: RawScenario, margin: float):
    scenario, info = build_scenario(raw, margin=margin)
    path = shapely.LineString(raw.ego[raw.ego_valid, :2])
    reach = [path, *(raw.map.roadblocks[block].polygon for block in raw.route_roadblocks)]
    reach += [raw.map.roadblocks[info.roadblock_ids[i]].polygon for i in scenario.route.roadblocks]

    def near(polygon) -> bool:
        return min(polygon.distance(other) for other in reach) <= margin

    lanes = {key for key, lane in raw.map.lanes.items() if near(shapely.Polygon(lane.polygon))}
    assert lanes <= set(info.lane_ids)
    blocks = {key for key, block in raw.map.roadblocks.items() if near(block.polygon)}
    blocks |= {raw.map.lanes[lane].roadblock for lane in lanes}
    assert set(info.roadblock_ids) == blocks
    assert set(info.lane_ids) == {
        lane for lane in raw.map.lanes if raw.map.lanes[lane].roadblock in blocks
    }
    named = {raw.map.lanes[lane].intersection for lane in info.lane_ids}
    assert list(info.intersection_ids) == [
        area.id for area in raw.map.intersections if area.id in named or near(area.polygon)
    ]
    assert len(scenario.map.walkways.count) == sum(near(a.polygon) for a in raw.map.walkways)


@settings(max_examples=6)
@given(raw=worlds)
def test_map_comes_back_unaltered(raw: RawScenario):
    scenario, info = build_scenario(raw, margin=50.0)
    local, origin = raw_map(scenario, info), scenario.origin
    whole = raw.map
    assert list(local.roadblocks) == [key for key in whole.roadblocks if key in local.roadblocks]
    for key, lane in local.lanes.items():
        source = whole.lanes[key]
        np.testing.assert_array_equal(lane.centerline[:, :2] + origin, source.centerline[:, :2])
        np.testing.assert_array_equal(lane.centerline[:, 2], source.centerline[:, 2])
        np.testing.assert_array_equal(lane.left_boundary + origin, source.left_boundary)
        np.testing.assert_array_equal(lane.right_boundary + origin, source.right_boundary)
        ring = shapely.get_coordinates(shapely.Polygon(source.polygon))[:-1]
        np.testing.assert_array_equal(lane.polygon + origin, ring)
        assert lane.successors == [key for key in source.successors if key in local.lanes]
        assert lane.predecessors == [key for key in source.predecessors if key in local.lanes]
        for name in ("is_connector", "roadblock", "left_neighbor", "right_neighbor"):
            assert getattr(lane, name) == getattr(source, name)
        for name in ("speed_limit", "intersection", "has_traffic_light"):
            assert getattr(lane, name) == getattr(source, name)
        assert (lane.stop_line is None) == (source.stop_line is None)
    for key, block in local.roadblocks.items():
        source = whole.roadblocks[key]
        assert block.lanes == source.lanes
        assert block.successors == [key for key in source.successors if key in local.roadblocks]
        assert shapely.transform(block.polygon, lambda xy: xy + origin).equals(source.polygon)
    for layer in AREA_LAYERS:
        kinds = dict.fromkeys(("intersections", "drivable", "stop_lines"), True)
        wanted = {area.polygon.wkb: area for area in getattr(whole, layer)}
        for area in getattr(local, layer):
            moved = shapely.transform(area.polygon, lambda xy: xy + origin)
            source = next(a for a in wanted.values() if moved.equals(a.polygon))
            assert moved.is_valid
            if layer in kinds:
                assert area.kind == source.kind


def test_ego_tracks_and_lights_are_copied():
    raw = world(3)
    raw.map.lanes["b0l0"].successors = ["b1l0"]
    raw.lights[1] = {"b0l1": 3, "b39l0": 2}
    scenario, info = build_scenario(raw)
    assert info.iteration0_time_us == raw.time_us[raw.num_history]
    np.testing.assert_array_equal(
        np.rint(scenario.time * 1e6), raw.time_us - raw.time_us[raw.num_history]
    )
    start = raw.ego[raw.num_history, :2]
    np.testing.assert_array_equal(scenario.origin, np.round(start))
    assert abs(scenario.ego.x[raw.num_history]) <= 0.5
    np.testing.assert_array_equal(scenario.ego_valid, raw.ego_valid)
    for column, name in enumerate(dataclasses.asdict(scenario.ego)):
        expected = raw.ego[:, column] - ([*scenario.origin] + [0.0] * 9)[column]
        leaf = getattr(scenario.ego, name)
        np.testing.assert_array_equal(leaf[raw.ego_valid], expected[raw.ego_valid])
        assert not leaf[~raw.ego_valid].any()
    tracks, valid = scenario.tracks, raw.tracks.valid
    np.testing.assert_array_equal(
        tracks.y[valid], raw.tracks.pose[valid][:, 1] - scenario.origin[1]
    )
    np.testing.assert_array_equal(tracks.heading[valid], raw.tracks.pose[valid][:, 2])
    np.testing.assert_array_equal(tracks.vx[valid], raw.tracks.velocity[valid][:, 0])
    np.testing.assert_array_equal(tracks.width[valid], raw.tracks.size[valid][:, 1])
    np.testing.assert_array_equal(tracks.type, raw.tracks.type)
    row = info.lane_ids.index("b0l1")
    assert scenario.lights[1, row] == 3 and scenario.lights[1].sum() == 3


@pytest.mark.parametrize("name", ["lane_ends", "tight_turn"])
def test_route_holds_the_route_tables(name: str):
    raw = make_scene(name, 0)
    scenario, info = build_scenario(raw)
    tables = route_tables(raw.map, raw.route_roadblocks, raw.ego[raw.num_history, :3])
    route = scenario.route

    def ids(names: tuple[str, ...], rows: Array) -> list[str]:
        return [names[row] for row in rows if row >= 0]

    assert ids(info.roadblock_ids, route.roadblocks) == tables.roadblocks
    assert ids(info.roadblock_ids, route.given_roadblocks) == list(raw.route_roadblocks)
    assert ids(info.lane_ids, route.start_lane) == tables.start_lanes
    assert [ids(info.lane_ids, rows) for rows in route.centerline_lanes] == tables.centerline
    assert [ids(info.lane_ids, rows) for rows in route.goal_lanes] == tables.goal
    assert [ids(info.lane_ids, rows) for rows in route.branch_lanes] == tables.branches
    np.testing.assert_array_equal(route.branch_start, route.branch_lanes[:, 0])
    assert route.reaches_goal.tolist() == tables.reaches_goal
    np.testing.assert_array_equal(route.lane_on_route, route.slot_of_lane >= 0)
    np.testing.assert_array_equal(
        route.slot_of_lane[route.start_lane], np.arange(len(tables.start_lanes))
    )


def test_later_start_equals_a_build_from_there():
    # The ego drives from block 0 to block 5, of which only 4 to 6 are in the given route.
    raw = world(2, lanes=1)
    raw.route_roadblocks = ["b4", "b5", "b6"]
    stations = np.linspace(0, 5, len(raw.time_us)).astype(int)
    raw.ego[:, :3] = [raw.map.lanes[f"b{i}l0"].centerline[0] for i in stations]
    raw.ego[:, 3:] = 0.0
    raw.ego_valid[:] = True
    raw.mission_goal = raw.map.lanes["b6l0"].centerline[-1]
    scenario, info = build_scenario(raw)
    later = dataclasses.replace(
        raw, num_history=raw.num_history + 3, num_iterations=raw.num_iterations - 3
    )
    expected, expected_info = build_scenario(later)
    assert expected_info.lane_ids == info.lane_ids
    moved = start_at(scenario, info, 3)
    assert expected.origin.tolist() != moved.origin.tolist()
    assert len(scenario.route.start_lane) > len(moved.route.start_lane)
    # Frame and map stay; everything that counts from iteration 0 moves.
    for path in ("time", "num_history", "num_iterations", "lights", "ego_valid"):
        assert leaves_of(moved)[path].tobytes() == leaves_of(expected)[path].tobytes(), path
    goal = moved.route.mission_goal[:2] + moved.origin
    np.testing.assert_allclose(goal, expected.route.mission_goal[:2] + expected.origin, rtol=1e-15)
    for path, leaf in leaves_of(moved.route).items():
        if path != "mission_goal":
            np.testing.assert_array_equal(leaf, leaves_of(expected.route)[path], err_msg=path)
    np.testing.assert_array_equal(moved.ego.x, scenario.ego.x)


def test_start_outside_the_window_is_refused():
    scenario, info = build_scenario(world(1))
    assert_same(start_at(scenario, info, 0), scenario)
    with pytest.raises(ScenarioError, match="iteration 100 is outside its window"):
        start_at(scenario, info, 100)
    with pytest.raises(ScenarioError, match="iteration -1 is outside"):
        start_at(scenario, info, -1)


def test_shared_index_changes_nothing():
    first, second = world(5), world(5)
    index = MapIndex(first.map)
    assert_same(build_scenario(first, index=index)[0], build_scenario(second)[0])
    shifted = dataclasses.replace(first, num_history=first.num_history + 2, num_iterations=2)
    assert_same(build_scenario(shifted, index=index)[0], build_scenario(shifted)[0])
    with pytest.raises(ValueError, match="another map object"):
        build_scenario(second, index=index)


def test_route_repair_beyond_the_margin_is_kept():
    # The ego is 8 blocks before the route: the blocks that lead there must be in the crop.
    raw = world(2, lanes=1)
    raw.route_roadblocks = ["b8", "b9"]
    scenario, info = build_scenario(raw, margin=1.0)
    route = [info.roadblock_ids[i] for i in scenario.route.roadblocks]
    assert route == [f"b{i}" for i in range(10)]
    assert scenario.route.given_roadblocks.tolist()[2:] == [-1] * 8


def test_no_agents_no_areas_and_self_touching_polygon():
    raw = world(4, agents=0, areas=0)
    lane = raw.map.lanes["b1l0"]
    a, b, c = lane.polygon[0], lane.polygon[1], lane.polygon[-2]
    lane.polygon = np.array([a, b, a, c, (b + c) / 2, b, c])
    scenario, info = build_scenario(raw)
    assert scenario.tracks.x.shape == (0, len(raw.time_us))
    assert scenario.map.walkways.xy.shape == (0, 2)
    assert any("no drivable polygon" in note for note in info.notes)
    row = info.lane_ids.index("b1l0")
    assert scenario.map.lanes.polygon.count[row] == 7


def test_ego_at_rest_and_triangular_lane():
    raw = world(9)
    raw.ego[:] = raw.ego[raw.num_history]
    raw.ego_valid[:] = True
    x, y = raw.ego[raw.num_history, :2]
    # Only the inside of the triangle is near the path and the route.
    triangle = np.array([[x - 500, y - 400], [x + 500, y - 400], [x, y + 800]])
    raw.map.lanes["b40l0"].polygon = triangle
    _, info = build_scenario(raw, margin=20.0)
    assert {"b0l0", "b40l0"} <= set(info.lane_ids)


def test_usable_oddities_are_noted():
    raw = world(6)
    raw.lights[0] = {"elsewhere": 1}
    raw.route_roadblocks = ["unknown", *raw.route_roadblocks]
    raw.tracks.valid[1, 2] = True
    raw.tracks.pose[1, 2] = raw.ego[raw.num_history, :3]
    raw.tracks.velocity[1, 2] = np.nan
    scenario, info = build_scenario(raw)
    text = "\n".join(info.notes)
    assert info.notes[0] == "made up"
    assert "lights of 1 unknown lanes ignored, first 'elsewhere'" in text
    assert "1 route roadblocks not in the map ignored, first 'unknown'" in text
    assert "1 track velocities are not finite" in text
    assert scenario.tracks.vx[1, 2] == 0.0 and scenario.tracks.valid[1, 2]
    assert scenario.lights[0].sum() == 0


def _set(path: str, value: object) -> Callable[[RawScenario], None]:
    """Returns a change of one attribute, such as `tracks.ids`."""

    def change(raw: RawScenario) -> None:
        *owners, name = path.split(".")
        target: object = raw
        for owner in owners:
            target = getattr(target, owner)
        setattr(target, name, value)

    return change


def _put(path: str, index: tuple, value: float) -> Callable[[RawScenario], None]:
    def change(raw: RawScenario) -> None:
        target: object = raw
        for owner in path.split("."):
            target = getattr(target, owner)
        np.asarray(target)[index] = value

    return change


def _lane(**values: object) -> Callable[[RawScenario], None]:
    def change(raw: RawScenario) -> None:
        raw.map.lanes["b0l0"] = dataclasses.replace(raw.map.lanes["b0l0"], **values)

    return change


def _seen_nan_pose(raw: RawScenario) -> None:
    raw.tracks.valid[2, 1] = True
    raw.tracks.pose[2, 1] = (0.0, np.nan, 0.0)


def _seen_flat_box(raw: RawScenario) -> None:
    raw.tracks.valid[2, 1] = True
    raw.tracks.pose[2, 1] = 0.0
    raw.tracks.size[2, 1] = (4.0, 0.0)


def _no_route_lanes(raw: RawScenario) -> None:
    raw.route_roadblocks = ["b0"]
    raw.map.roadblocks = {"b0": dataclasses.replace(raw.map.roadblocks["b0"], lanes=())}
    raw.map.lanes = {
        key: dataclasses.replace(lane, roadblock="?")
        for key, lane in raw.map.lanes.items()
        if key[:2] != "b0"
    }


def _flat_area(raw: RawScenario) -> None:
    box = shapely.Polygon([raw.ego[raw.num_history, :2]] * 3)
    raw.map.drivable[1] = dataclasses.replace(raw.map.drivable[1], polygon=box)


def _line_area(raw: RawScenario) -> None:
    line = shapely.LineString(raw.map.lanes["b0l0"].left_boundary)
    raw.map.walkways[0] = dataclasses.replace(raw.map.walkways[0], polygon=line)


def _far_ego(raw: RawScenario) -> None:
    raw.ego[:, 0] += 5000.0


def _stray_lane(raw: RawScenario) -> None:
    raw.map.roadblocks["b0"].lanes = [*raw.map.roadblocks["b0"].lanes, "b1l0"]


# The texts name field, index and value.
REFUSED = {
    "nan ego": (_put("ego", (4, 1), np.nan), r"ego\[4, 1\] = nan is not finite"),
    "inf ego": (_put("ego", (5, 3), np.inf), r"ego\[5, 3\] = inf is not finite"),
    "unknown ego": (_put("ego_valid", (4,), False), r"ego_valid\[4\] is False"),
    "ego shape": (_set("ego", np.zeros((3, 11))), r"ego has shape \(3, 11\), expected"),
    "nan track": (_seen_nan_pose, r"tracks.pose\[2, 1, 1\] = nan is not finite"),
    "flat box": (_seen_flat_box, r"tracks.size\[2, 1\] = \[4.0, 0.0\] \(track 'track2'\)"),
    "same track": (_set("tracks.ids", ["a", "b", "a"]), r"tracks.ids\[2\] = 'a' repeats"),
    "track type": (_put("tracks.type", (1,), 9), r"tracks.type\[1\] = 9"),
    "track shape": (
        _set("tracks.valid", np.ones((1, 2), bool)),
        r"tracks.valid has shape \(1, 2\)",
    ),
    "time": (_put("time_us", (3,), 0), r"time_us\[3\] = 0 is not later"),
    "float time": (_set("time_us", np.arange(12.0)), "time_us has shape .* expected"),
    "window": (_set("num_iterations", 999), "num_iterations = 999 do not fit"),
    "no window": (_set("num_iterations", 0), "num_iterations = 0 do not fit"),
    "history": (_set("num_history", -1), "num_history = -1"),
    "lights": (_set("lights", [{}]), "lights has 1 steps"),
    "light": (lambda raw: raw.lights[2].update(b0l0=7), r"lights\[2\]\['b0l0'\] = 7"),
    "goal": (_set("mission_goal", np.array([0, np.nan, 0])), r"mission_goal\[1\] = nan"),
    "no route": (_set("route_roadblocks", []), "route_roadblocks is empty"),
    "no lanes": (_no_route_lanes, "names no lane of the map"),
    "far ego": (_far_ego, r"the ego is outside map road: ego\[4\] = "),
    "ring": (_lane(polygon=np.zeros((2, 2))), r"lanes\['b0l0'\].polygon has shape \(2, 2\)"),
    "flat area": (_flat_area, r"drivable\['drivable-1'\].polygon: a ring has 1 distinct"),
    "line area": (_line_area, r"walkways\['walkways-0'\].polygon is LINESTRING"),
    "centerline": (_lane(centerline=np.zeros((1, 3))), r"centerline has shape \(1, 3\)"),
    "nan boundary": (_lane(left_boundary=np.full((2, 2), np.nan)), r"left_boundary\[0, 0\] = nan"),
    "limit": (_lane(speed_limit=-3.0), r"lanes\['b0l0'\].speed_limit = -3.0"),
    "key": (_lane(id="x"), r"lanes\['b0l0'\].id = 'x'"),
    "stray lane": (_stray_lane, "names lane 'b1l0', whose roadblock is 'b1'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_unusable_scenarios_are_refused(case: str):
    change, text = REFUSED[case]
    raw = world(HISTORY_4)
    assert raw.num_history == 4
    validate_raw(raw)
    change(raw)
    with pytest.raises(ScenarioError, match=text) as refused:
        build_scenario(raw)
    assert f"world{HISTORY_4}" in str(refused.value)
    if case != "no lanes":
        with pytest.raises(ScenarioError, match=re.escape(str(refused.value)[:40])):
            validate_raw(raw)


def test_route_in_another_map_is_refused():
    raw = world(HISTORY_4)
    raw.route_roadblocks = ["x", "y"]
    with pytest.raises(ScenarioError, match=r"none of the 2 route_roadblocks \(first 'x'\)"):
        build_scenario(raw)


def test_bad_element_far_away_does_no_harm():
    raw = world(HISTORY_4)
    raw.map.lanes["b44l0"].polygon = np.full((5, 2), np.nan)
    raw.map.lanes["b43l0"].polygon[1] = np.nan
    raw.map.lanes["b42l0"].polygon = raw.map.lanes["b42l0"].polygon[[0, 1, 0]]
    build_scenario(raw)
    with pytest.raises(ScenarioError, match=r"b4[234]l0"):
        validate_raw(raw)
