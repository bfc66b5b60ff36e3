"""The built-in suites: what holds for every scene, and what each type promises."""

import functools
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from scipy.signal import savgol_filter

from spdm_jax.io.build import build_scenario
from spdm_jax.io.raw import RawLane, RawScenario, ScenarioError
from spdm_jax.io.validate import validate_raw
from spdm_jax.synthetic import SUITES, SuiteReader, suite_names
from spdm_jax.synthetic.generator import record
from spdm_jax.synthetic.hindsight import boxes, discomfort, ego_boxes, faults
from spdm_jax.types import LightStatus, ObjectType

DT = 0.1
ITERATIONS = {"common-14": 151, "interactive-8": 301}
TYPES = [(suite, kind) for suite in SUITES for kind in SUITES[suite]]
STATIC = (
    ObjectType.TRAFFIC_CONE,
    ObjectType.BARRIER,
    ObjectType.CZONE_SIGN,
    ObjectType.GENERIC_OBJECT,
)


@functools.cache
def scene(suite: str, kind: str, number: int) -> RawScenario:
    return SuiteReader(suite, [number]).read(f"{kind}-{number:02d}")


# The first scene of each type always, the others where time allows.
@pytest.fixture(
    params=[
        pytest.param((*t, n), marks=[pytest.mark.slow] if n else [], id=f"{t[1]}-{n}")
        for t in TYPES
        for n in range(10)
    ]
)
def raw(request) -> RawScenario:
    return scene(*request.param)


def filtered(values: np.ndarray, window: int, order: int, derivative: int = 0) -> np.ndarray:
    """The filter of nuPlan's comfort metrics."""
    return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=DT), float)


def digest(raw: RawScenario) -> list[bytes]:
    parts = [raw.ego, raw.tracks.pose, raw.tracks.velocity, raw.tracks.size, raw.tracks.valid]
    parts += [lane.centerline for lane in raw.map.lanes.values()]
    return [np.ascontiguousarray(part).tobytes() for part in parts]


def window(raw: RawScenario) -> np.ndarray:
    return raw.ego[raw.num_history : raw.num_history + raw.num_iterations]


def centers(raw: RawScenario) -> np.ndarray:
    return shapely.get_coordinates(shapely.centroid(ego_boxes(window(raw))))


def lane_at(raw: RawScenario, point: np.ndarray) -> RawLane:
    inside = [
        lane
        for lane in raw.map.lanes.values()
        if shapely.Polygon(lane.polygon).contains(shapely.Point(point))
    ]
    assert len(inside) == 1, [lane.id for lane in inside]
    return inside[0]


def number(lane: RawLane) -> str:
    return lane.id.rpartition("/")[2]


def seen(raw: RawScenario, iteration: int) -> np.ndarray:
    """Positions `[A, 2]` of the tracks ahead of and left of the ego's centre; NaN if not seen."""
    step = raw.num_history + iteration
    offset = raw.tracks.pose[:, step, :2] - centers(raw)[iteration]
    cos, sin = np.cos(raw.ego[step, 2]), np.sin(raw.ego[step, 2])
    local = np.stack([offset @ [cos, sin], offset @ [-sin, cos]], axis=1)
    return np.where(raw.tracks.valid[:, step, None], local, np.nan)


def gap_ahead(raw: RawScenario, iteration: int) -> tuple[float, int]:
    """Gap to the vehicle ahead on the ego's way, bumper to bumper, and its row."""
    step = raw.num_history + iteration
    rest = shapely.get_coordinates(shapely.centroid(ego_boxes(raw.ego[step:])))
    heading = raw.ego[-1, 2]
    beyond = rest[-1] + 60.0 * np.array([np.cos(heading), np.sin(heading)])
    way = shapely.LineString([*rest, beyond])
    cars = np.flatnonzero(vehicles(raw) & raw.tracks.valid[:, step])
    at = shapely.points(raw.tracks.pose[cars, step, :2])
    along = np.asarray(shapely.line_locate_point(way, at))
    ahead = (along > 0.1) & (shapely.distance(way, at) < 1.2)
    if not ahead.any():
        return np.inf, -1
    row = int(np.flatnonzero(ahead)[np.argmin(along[ahead])])
    length = raw.tracks.size[cars[row], step, 0]
    return float(along[row] - length / 2 - 5.176 / 2), int(cars[row])


def vehicles(raw: RawScenario) -> np.ndarray:
    return raw.tracks.type == ObjectType.VEHICLE


def around(raw: RawScenario, iteration: int, radius: float, kind: ObjectType) -> int:
    near = np.linalg.norm(seen(raw, iteration), axis=1) < radius
    return int(np.sum(near & (raw.tracks.type == kind)))


def own_lane_boxes(raw: RawScenario) -> np.ndarray:
    """Boxes of an ego that follows the centre of its lane from iteration 0 on."""
    lane = lane_at(raw, centers(raw)[0])
    lines = [lane.centerline]
    while lane.successors:
        lane = raw.map.lanes[lane.successors[0]]
        lines.append(lane.centerline)
    line = np.concatenate(lines)
    start = int(np.argmin(np.linalg.norm(line[:, :2] - raw.ego[raw.num_history, :2], axis=1)))
    return ego_boxes(line[start : start + 150])


def blocking(raw: RawScenario) -> list[int]:
    """Rows of the objects at rest that are in the way of who follows the lane's centre."""
    step = raw.num_history
    rows = np.flatnonzero(np.isin(raw.tracks.type, STATIC) & raw.tracks.valid[:, step])
    objects = boxes(raw.tracks.pose[rows, step], raw.tracks.size[rows, step])
    way = shapely.union_all(own_lane_boxes(raw))
    return [int(row) for row, box in zip(rows, objects, strict=True) if way.intersects(box)]


def turned(raw: RawScenario) -> float:
    heading = np.unwrap(window(raw)[:, 2])
    return float(heading[-1] - heading[0])


def test_suites_have_ten_scenes_of_each_type():
    assert suite_names() == ("common-14", "interactive-8")
    assert [len(SuiteReader(suite).tokens()) for suite in suite_names()] == [140, 80]
    for suite in suite_names():
        tokens = SuiteReader(suite).tokens()
        assert len(set(tokens)) == len(tokens)
        assert {t.rpartition("-")[0] for t in tokens} == set(SUITES[suite])
    assert SuiteReader("common-14").tokens()[3] == "starting_left_turn-03"
    assert len(SuiteReader("interactive-8", range(100, 103)).tokens()) == 24


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"'common-15' is unknown.*common-14, interactive-8"):
        SuiteReader("common-15")
    with pytest.raises(ValueError, match=r"\[-1\]"):
        SuiteReader("common-14", [0, -1])
    with pytest.raises(ScenarioError, match=r"'changing_lane-10' is not selected"):
        SuiteReader("common-14").read("changing_lane-10")


@pytest.mark.parametrize(
    "suite, kind", [("common-14", "changing_lane"), ("interactive-8", "crashed_cars")]
)
def test_equal_tokens_give_equal_bytes_and_others_differ(suite: str, kind: str):
    again = SuiteReader(suite).read(f"{kind}-00")
    assert digest(again) == digest(scene(suite, kind, 0))
    assert digest(SuiteReader(suite).read(f"{kind}-01")) != digest(again)


def test_scene_covers_a_closed_loop_run(raw: RawScenario):
    iterations = ITERATIONS[raw.log_name]
    assert (raw.num_history, raw.num_iterations) == (22, iterations)
    assert len(raw.time_us) == 22 + iterations + 79
    assert raw.ego_valid.all()
    assert raw.log_name in SUITES and raw.scenario_type in SUITES[raw.log_name]
    assert raw.source == "synthetic"
    assert 3 <= len(raw.tracks.ids) <= 150
    assert validate_raw(raw) == []
    scenario, info = build_scenario(raw)
    assert info.notes == () and info.scenario_type == raw.scenario_type
    assert bool(np.any(scenario.route.reaches_goal))


def test_expert_hits_nothing_and_stays_on_the_road(raw: RawScenario):
    ego = ego_boxes(raw.ego)
    hit = shapely.intersects(boxes(raw.tracks.pose, raw.tracks.size), ego) & raw.tracks.valid
    assert not hit[:, raw.num_history :].any()
    surface = shapely.union_all([area.polygon.buffer(1e-3) for area in raw.map.drivable])
    assert shapely.covers(surface, ego).all()


def test_expert_keeps_limits_and_comfort(raw: RawScenario):
    ego = window(raw)
    limits = {lane.speed_limit for lane in raw.map.lanes.values()} - {None}
    assert len(limits) == 1
    assert ego[:, 3].max() < limits.pop() and ego[:, 3].min() >= 0.0
    heading = np.unwrap(ego[:, 2])
    yaw_rate = filtered(heading, 5, 2, 1)
    yaw_accel = filtered(heading, 5, 3, 2)
    accel = filtered(ego[:, 5] + 1.461 * (ego[:, 9] ** 2 + ego[:, 10]), 8, 2)
    jerk = filtered(accel, 15, 2, 1)
    whole = filtered(np.hypot(ego[:, 5], ego[:, 6]), 8, 2)
    assert accel.min() > -4.05 and accel.max() < 2.40
    assert np.abs(ego[:, 6]).max() < 4.89
    assert np.abs(jerk).max() < 4.13
    assert np.abs(filtered(whole, 15, 2, 1)).max() < 8.37
    assert np.abs(yaw_rate).max() < 0.95 and np.abs(yaw_accel).max() < 1.93


def test_expert_gets_on_unless_traffic_stands(raw: RawScenario):
    way = window(raw)[:, 3].sum() * DT
    assert way > 15.0 or raw.scenario_type == "stationary_in_traffic"


def test_moving_vehicles_are_on_lanes(raw: RawScenario):
    step = raw.num_history
    moving = np.any(np.linalg.norm(raw.tracks.velocity, axis=-1) > 0.0, axis=1) & vehicles(raw)
    moving &= raw.tracks.valid[:, step]
    lanes = shapely.union_all([shapely.Polygon(lane.polygon) for lane in raw.map.lanes.values()])
    at = shapely.points(raw.tracks.pose[moving, step, :2])
    assert shapely.contains(lanes.buffer(1e-6), at).all()


def test_type_is_what_it_is_called(raw: RawScenario):
    globals()[f"check_{raw.scenario_type}"](raw)


def check_starting_left_turn(raw: RawScenario):
    assert 1.2 < turned(raw) < 2.0
    assert _sets_off_at_lights(raw)


def check_starting_right_turn(raw: RawScenario):
    assert -2.0 < turned(raw) < -1.2
    assert _sets_off_at_lights(raw)


def check_starting_straight_traffic_light_intersection_traversal(raw: RawScenario):
    assert abs(turned(raw)) < 0.4
    assert window(raw)[0, 3] == 0.0 and window(raw)[-1, 3] > 5.0
    assert _sets_off_at_lights(raw)


def _sets_off_at_lights(raw: RawScenario) -> bool:
    """Whether the ego crosses an intersection with lights and enters it on green."""
    area = next(a.polygon for a in raw.map.intersections if a.kind == 1)
    inside = shapely.contains(area, shapely.points(centers(raw)))
    first = int(np.argmax(inside))
    connectors = [
        lane.id
        for lane in raw.map.lanes.values()
        if lane.has_traffic_light and lane.roadblock in raw.route_roadblocks
    ]
    status = {raw.lights[raw.num_history + first][i] for i in connectors}
    return bool(inside.any()) and 0 < first < 90 and status == {LightStatus.GREEN}


def check_stopping_with_lead(raw: RawScenario):
    speed = window(raw)[:, 3]
    assert speed[0] > 7.0 and speed[-30:].min() < 0.5
    stop = int(np.argmin(speed))
    assert 0.5 < gap_ahead(raw, stop)[0] < 6.0


def check_high_lateral_acceleration(raw: RawScenario):
    assert 1.5 < np.abs(window(raw)[:, 6]).max() < 3.0


def check_high_magnitude_speed(raw: RawScenario):
    assert window(raw)[:, 3].min() > 11.0


def check_low_magnitude_speed(raw: RawScenario):
    speed = window(raw)[:, 3]
    assert 0.5 < speed.mean() < 2.5 and speed.max() < 3.5


def check_traversing_pickup_dropoff(raw: RawScenario):
    area = next(a.polygon for a in raw.map.drivable if a.id == "pickup")
    assert shapely.contains(area, shapely.points(centers(raw))).sum() > 50
    assert 2.0 < window(raw)[:, 3].min() and window(raw)[:, 3].max() < 8.3
    people = [around(raw, i, 15.0, ObjectType.PEDESTRIAN) for i in range(0, 80, 10)]
    assert max(people) >= 3


def check_waiting_for_pedestrian_to_cross(raw: RawScenario):
    speed = window(raw)[:, 3]
    slowest = int(np.argmin(speed))
    assert speed[slowest] < 2.0 and speed[-1] > 5.0
    zebra = next(a.polygon for a in raw.map.crosswalks if a.id == "zebra")
    step = raw.num_history + slowest
    people = raw.tracks.pose[raw.tracks.type == ObjectType.PEDESTRIAN, step, :2]
    assert shapely.contains(zebra, shapely.points(people)).any()
    assert zebra.distance(shapely.Point(centers(raw)[slowest])) < 15.0


def check_behind_long_vehicle(raw: RawScenario):
    for i in range(0, 151, 30):
        gap, row = gap_ahead(raw, i)
        assert 3.0 < gap < 35.0
        assert raw.tracks.size[row, raw.num_history + i, 0] >= 10.0


def check_stationary_in_traffic(raw: RawScenario):
    assert np.all(window(raw)[:40, 3] < 0.3)
    assert around(raw, 0, 15.0, ObjectType.VEHICLE) >= 3


def check_near_multiple_vehicles(raw: RawScenario):
    assert np.mean([around(raw, i, 12.0, ObjectType.VEHICLE) for i in range(0, 150, 10)]) >= 2.0
    assert window(raw)[:, 3].min() > 2.0


def check_changing_lane(raw: RawScenario):
    first, last = lane_at(raw, centers(raw)[0]), lane_at(raw, centers(raw)[120])
    assert abs(int(number(first)) - int(number(last))) == 1


def check_following_lane_with_lead(raw: RawScenario):
    rows = set()
    for i in range(0, 151, 30):
        gap, row = gap_ahead(raw, i)
        assert 4.0 < gap < 50.0
        rows.add(row)
    assert len(rows) == 1 and window(raw)[:, 3].min() > 3.0


def check_low_traffic_density(raw: RawScenario):
    _check_forced_change(raw, 40.0, 100.0)


def check_medium_traffic_density(raw: RawScenario):
    _check_forced_change(raw, 22.0, 50.0)


def check_high_traffic_density(raw: RawScenario):
    _check_forced_change(raw, 15.0, 26.0)


def _check_forced_change(raw: RawScenario, least: float, most: float):
    """The ego's lane ends, the expert changes into a gap of the other, which has such gaps."""
    first = lane_at(raw, centers(raw)[0])
    assert not first.successors
    last = lane_at(raw, centers(raw)[100])
    assert number(last) != number(first)
    line = shapely.LineString(raw.map.lanes[f"road:0/{number(last)}"].centerline[:, :2])
    cars = np.asarray(shapely.points(raw.tracks.pose[vehicles(raw), raw.num_history, :2]))
    on_goal_lane = np.asarray(shapely.line_locate_point(line, cars))[
        shapely.distance(line, cars) < 0.5
    ]
    assert len(on_goal_lane) >= 2
    assert least < np.mean(np.diff(np.sort(on_goal_lane))) < most


def check_construction_zone(raw: RawScenario):
    kinds = [raw.tracks.type[row] for row in blocking(raw)]
    assert kinds.count(ObjectType.TRAFFIC_CONE) >= 3 and ObjectType.BARRIER in kinds
    _check_passed(raw, blocking(raw), beside="0")


def check_crashed_cars(raw: RawScenario):
    rows = [row for row in blocking(raw) if raw.tracks.size[row, raw.num_history, 0] > 4.0]
    assert len(rows) == 2
    assert set(raw.tracks.type[rows]) == {ObjectType.GENERIC_OBJECT}
    _check_passed(raw, rows, beside="0")


def _check_passed(raw: RawScenario, rows: Sequence[int], beside: str):
    """The expert drives past the objects on a lane of the same direction."""
    for row in rows:
        at = np.linalg.norm(centers(raw) - raw.tracks.pose[row, raw.num_history, :2], axis=1)
        assert 0 < np.argmin(at) < 130
        assert number(lane_at(raw, centers(raw)[np.argmin(at)])) == beside


def check_jaywalking_pedestrian(raw: RawScenario):
    # Someone who drives on at the same speed hits somebody, the expert slows down.
    step, speed = raw.num_history, window(raw)[:, 3]
    reach = speed[0] * DT * np.arange(80)
    direction = np.array([np.cos(raw.ego[step, 2]), np.sin(raw.ego[step, 2])])
    driven = np.repeat(raw.ego[step : step + 1], 80, axis=0)
    driven[:, :2] += reach[:, None] * direction
    people = raw.tracks.type == ObjectType.PEDESTRIAN
    walkers = boxes(raw.tracks.pose[people, step:][:, :80], raw.tracks.size[people, step:][:, :80])
    assert shapely.intersects(walkers, ego_boxes(driven)).any()
    assert speed.min() < 0.6 * speed[0]
    crosswalks = shapely.union_all([a.polygon for a in raw.map.crosswalks])
    assert crosswalks.distance(shapely.Point(centers(raw)[np.argmin(speed)])) > 10.0


def check_nudge_around_parked_vehicle(raw: RawScenario):
    assert len(blocking(raw)) == 1
    # The middle of the ego stays on its lane all the time.
    own = {raw.map.lanes[i].roadblock for i in raw.map.lanes if i.startswith("road:")}
    lanes = [shapely.Polygon(la.polygon) for la in raw.map.lanes.values() if la.roadblock in own]
    assert shapely.covers(shapely.union_all(lanes).buffer(1e-3), shapely.points(centers(raw))).all()
    _check_type(raw, blocking(raw))


def check_overtake_parked_vehicle(raw: RawScenario):
    rows = blocking(raw)
    assert len(rows) == 1
    _check_type(raw, rows)
    away = np.linalg.norm(centers(raw) - raw.tracks.pose[rows[0], raw.num_history, :2], axis=1)
    beside = int(np.argmin(away))
    assert 40 < beside < 145
    assert lane_at(raw, centers(raw)[beside]).id.startswith("road~")
    # Oncoming traffic passes before, and there is none close by when the expert is out.
    oncoming = np.cos(raw.tracks.pose[..., 2] - raw.ego[raw.num_history, 2]) < -0.5
    oncoming &= raw.tracks.valid & vehicles(raw)[:, None]
    at = raw.tracks.pose[:, :, :2] - raw.tracks.pose[rows[0], raw.num_history, :2]
    close = oncoming & (np.linalg.norm(at, axis=-1) < 25.0)
    now = raw.num_history
    assert close[:, now : now + beside].any()
    assert not close[:, now + beside - 10 : now + beside + 10].any()


def _check_type(raw: RawScenario, rows: Sequence[int]):
    """What is parked on a lane must not be of a type that simulated traffic lets drive off."""
    assert set(raw.tracks.type[list(rows)]) == {ObjectType.GENERIC_OBJECT}


def test_lights_change_at_crossings():
    for kind in ("stopping_with_lead", "starting_straight_traffic_light_intersection_traversal"):
        lights = scene("common-14", kind, 0).lights
        statuses = {tuple(sorted(step.items())) for step in lights[22:]}
        assert len(statuses) >= 2
        # Never green for both roads.
        for step in lights:
            green = {i.split(">")[0] for i, s in step.items() if s == LightStatus.GREEN}
            assert not (green & {"north", "south"} and green & {"east", "west"})


def test_faults_are_found():
    good = scene("common-14", "following_lane_with_lead", 0)
    assert faults(good) == []
    now = good.num_history

    def changed(change) -> list[str]:
        raw = record(
            SUITES["common-14"]["following_lane_with_lead"],
            np.random.default_rng(0),
            token="t",
            scenario_type="following_lane_with_lead",
        )
        raw.ego, raw.tracks, raw.map = good.ego.copy(), good.tracks, good.map
        change(raw.ego)
        return faults(raw)

    def ahead(ego: np.ndarray):
        gap, _ = gap_ahead(good, 50)
        heading = ego[now + 50, 2]
        ego[now + 50, :2] += (gap + 1.0) * np.array([np.cos(heading), np.sin(heading)])

    def aside(ego: np.ndarray):
        ego[:, :2] += 60.0 * np.array([-np.sin(ego[now, 2]), np.cos(ego[now, 2])])

    def fast(ego: np.ndarray):
        ego[now + 20, 3] = 14.0

    def jerky(ego: np.ndarray):
        ego[now + 20 : now + 30, 5] = -3.9

    assert any("hits track-" in f for f in changed(ahead))
    assert "leaves the drivable area" in changed(aside)
    assert "is too fast" in changed(fast)
    assert {f.split(" -")[0] for f in changed(jerky)} >= {"has acceleration"}


def test_discomfort_names_what_is_too_much():
    ego = np.zeros((151, 11))
    ego[:, 3] = 5.0
    assert discomfort(ego) == {}
    time = DT * np.arange(151)
    ego[:, 2] = 0.9 * time
    ego[:, 9] = 0.9
    assert set(discomfort(ego)) == {"yaw rate"}
    ego[:, 2], ego[:, 9] = time**2, 0.0
    assert set(discomfort(ego)) == {"yaw acceleration"}
    ego[:, 2] = 0.0
    ego[:, 5] = np.clip(5.0 * (time - 7.0), -3.5, 2.1)
    jerk = filtered(filtered(ego[:, 5], 8, 2), 15, 2, 1)
    assert discomfort(ego) == {"jerk": pytest.approx(jerk[np.argmax(np.abs(jerk))])}
    ego[:, 5], ego[:, 6] = 0.0, 4.5
    assert set(discomfort(ego)) == {"lateral acceleration"}
