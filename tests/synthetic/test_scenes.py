"""Every named scene: what holds for all, and what each promises."""

import functools
import hashlib

import numpy as np
import pytest
import shapely

from spdm_jax.io.raw import RawScenario
from spdm_jax.synthetic import SCENES, make_scene, scene_names
from spdm_jax.types import LightStatus, ObjectType

SEEDS = (0, 1)
EGO_LENGTH, EGO_WIDTH, REAR_TO_CENTER = 5.176, 2.297, 1.461
REAR_TO_FRONT = REAR_TO_CENTER + EGO_LENGTH / 2


@functools.cache
def scene(name: str, seed: int) -> RawScenario:
    return make_scene(name, seed)


@pytest.fixture(params=[(n, s) for n in SCENES for s in SEEDS], ids=lambda p: f"{p[0]}-{p[1]}")
def raw(request) -> RawScenario:
    return scene(*request.param)


def boxes(pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Polygons `[...]` of boxes with centre poses `[..., 3]` and sizes `[..., 2]`."""
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size[..., None, :] / 2
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + cos * corner[..., 0] - sin * corner[..., 1]
    y = pose[..., 1, None] + sin * corner[..., 0] + cos * corner[..., 1]
    return np.asarray(shapely.polygons(np.stack([x, y], axis=-1)))


def ego_boxes(raw: RawScenario) -> np.ndarray:
    pose = raw.ego[:, :3].copy()
    pose[:, 0] += REAR_TO_CENTER * np.cos(pose[:, 2])
    pose[:, 1] += REAR_TO_CENTER * np.sin(pose[:, 2])
    return boxes(pose, np.full((len(pose), 2), (EGO_LENGTH, EGO_WIDTH)))


def digest(raw: RawScenario) -> str:
    parts = [raw.ego, raw.tracks.pose, raw.tracks.velocity, raw.tracks.size, raw.tracks.valid]
    for lane in raw.map.lanes.values():
        parts += [lane.centerline, lane.left_boundary, lane.right_boundary, lane.polygon]
    shapes = [a.polygon for a in raw.map.drivable + raw.map.walkways + raw.map.crosswalks]
    parts += [shapely.get_coordinates(shapes)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest()


def in_ego_frame(raw: RawScenario, xy: np.ndarray) -> np.ndarray:
    x, y, heading = raw.ego[raw.num_history, :3]
    dx, dy = xy[..., 0] - x, xy[..., 1] - y
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)


@pytest.mark.parametrize("name", scene_names())
def test_equal_seeds_give_equal_bytes_and_others_differ(name):
    first = scene(name, 0)
    assert digest(make_scene(name, 0)) == digest(first)
    assert digest(scene(name, 1)) != digest(first)


def test_shapes_and_time_axis(raw):
    num = 22 + 150 + 80
    agents = len(raw.tracks.ids)
    assert (raw.num_history, raw.num_iterations) == (22, 150)
    assert raw.time_us.shape == (num,) and raw.time_us.dtype == np.int64
    assert set(np.diff(raw.time_us)) == {100_000}
    assert raw.ego.shape == (num, 11) and raw.ego_valid.all()
    assert raw.tracks.pose.shape == (agents, num, 3)
    assert raw.tracks.velocity.shape == raw.tracks.size.shape == (agents, num, 2)
    assert raw.tracks.valid.shape == (agents, num) and raw.tracks.type.shape == (agents,)
    assert len(raw.lights) == num
    assert (raw.source, raw.map.name) == ("synthetic", "synthetic")
    for values in (raw.ego, raw.tracks.pose, raw.tracks.velocity, raw.tracks.size):
        assert np.all(np.isfinite(values))
    # Map coordinates of a UTM zone, so that the local frame matters.
    assert np.all(np.abs(raw.ego[:, :2] - [3.3e5, 4.69e6]) < 4000.0)


def test_tracks_are_seen_and_ordered_by_first_appearance(raw):
    valid = raw.tracks.valid
    assert valid.any(axis=1).all()
    assert np.all(np.diff(valid.argmax(axis=1)) >= 0)
    assert len(set(raw.tracks.ids)) == len(raw.tracks.ids)


def test_geometry_is_valid(raw):
    areas = [
        *raw.map.intersections,
        *raw.map.car_parks,
        *raw.map.drivable,
        *raw.map.crosswalks,
        *raw.map.walkways,
        *raw.map.stop_lines,
        *raw.map.roadblocks.values(),
    ]
    invalid = [a.id for a in areas if not a.polygon.is_valid or a.polygon.area < 1.0]
    invalid += [
        i for i, lane in raw.map.lanes.items() if not shapely.Polygon(lane.polygon).is_valid
    ]
    assert not invalid


def test_lanes_follow_the_heading_rule_and_lie_in_their_polygons(raw):
    for lane in raw.map.lanes.values():
        steps = np.diff(lane.centerline[:, :2], axis=0)
        heading = np.arctan2(steps[:, 1], steps[:, 0])
        error = lane.centerline[:, 2] - np.append(heading, heading[-1])
        np.testing.assert_allclose((error + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-6)
        length = np.linalg.norm(steps, axis=1)
        assert np.all((length > 0.5) & (length < 1.6)), lane.id
        area = shapely.Polygon(lane.polygon).buffer(1e-6)
        assert area.covers(shapely.LineString(lane.centerline[:, :2])), lane.id


def test_neighbouring_elements_refer_to_each_other(raw):
    lanes, blocks = raw.map.lanes, raw.map.roadblocks
    for lane in lanes.values():
        assert lane.id in blocks[lane.roadblock].lanes
        assert lane.is_connector == blocks[lane.roadblock].is_connector
        assert lane.is_connector == (lane.intersection is not None)
        for successor in lane.successors:
            after = lanes[successor]
            assert lane.id in after.predecessors
            assert lane.is_connector != after.is_connector
            assert after.roadblock in blocks[lane.roadblock].successors
            gap = lane.centerline[-1, :2] - after.centerline[0, :2]
            assert np.linalg.norm(gap) < 1e-6, (lane.id, successor)
    for block in blocks.values():
        for successor in block.successors:
            assert block.id in blocks[successor].predecessors
    intersections = {a.id for a in raw.map.intersections}
    stop_lines = {a.id for a in raw.map.stop_lines}
    for lane in lanes.values():
        assert lane.intersection is None or lane.intersection in intersections
        assert lane.stop_line is None or lane.stop_line in stop_lines


def test_roadblocks_list_lanes_from_left_to_right(raw):
    pairs = 0
    for block in raw.map.roadblocks.values():
        for left, right in zip(block.lanes, block.lanes[1:], strict=False):
            a, b = raw.map.lanes[left], raw.map.lanes[right]
            x, y, heading = a.centerline[0]
            dx, dy = b.centerline[0, :2] - [x, y]
            assert np.cos(heading) * dy - np.sin(heading) * dx == pytest.approx(-3.5, abs=0.05)
            if not block.is_connector:
                assert a.right_neighbor == right and b.left_neighbor == left
            pairs += 1
    single = {"jaywalker", "oncoming", "tight_turn", "roundabout"}
    assert pairs > 0 or raw.scenario_type in single


def test_route_leads_from_the_ego_to_the_goal(raw):
    blocks = raw.map.roadblocks
    for block, successor in zip(raw.route_roadblocks, raw.route_roadblocks[1:], strict=False):
        assert successor in blocks[block].successors
    rear = shapely.Point(raw.ego[raw.num_history, :2])
    first = raw.map.roadblocks[raw.route_roadblocks[0]]
    own = [i for i in first.lanes if shapely.Polygon(raw.map.lanes[i].polygon).covers(rear)]
    assert len(own) == 1
    # Headings agree, so the ego drives along its lane and not against it.
    line = raw.map.lanes[own[0]].centerline
    nearest = np.argmin(np.linalg.norm(line[:, :2] - raw.ego[raw.num_history, :2], axis=1))
    assert np.cos(line[nearest, 2] - raw.ego[raw.num_history, 2]) > 0.99
    assert raw.mission_goal is not None
    goal = shapely.Point(raw.mission_goal[:2])
    assert blocks[raw.route_roadblocks[-1]].polygon.buffer(1e-6).covers(goal)
    # Some lane of the first block leads to the last one along the route.
    reached = set(first.lanes)
    for block in raw.route_roadblocks[1:]:
        following = {s for i in reached for s in raw.map.lanes[i].successors}
        reached = following & set(blocks[block].lanes)
    assert reached


def test_ego_stays_on_the_road_and_hits_nothing(raw):
    surface = shapely.union_all([a.polygon.buffer(1e-3) for a in raw.map.drivable])
    ego = ego_boxes(raw)
    assert shapely.covers(surface, ego).all()
    tracks = boxes(raw.tracks.pose, raw.tracks.size)
    hits = shapely.intersects(tracks, ego) & raw.tracks.valid
    assert not hits[:, raw.num_history].any()
    assert not hits.any()


def test_vehicles_do_not_overlap(raw):
    vehicles = raw.tracks.type == ObjectType.VEHICLE
    for step in range(0, len(raw.time_us), 10):
        rows = np.flatnonzero(vehicles & raw.tracks.valid[:, step])
        shapes = boxes(raw.tracks.pose[rows, step], raw.tracks.size[rows, step])
        pairs = shapely.STRtree(shapes).query(shapes, predicate="intersects")
        assert np.all(pairs[0] == pairs[1]), step


def test_velocities_match_positions(raw):
    dt = 0.1
    both = raw.tracks.valid[:, 1:] & raw.tracks.valid[:, :-1]
    moved = np.diff(raw.tracks.pose[..., :2], axis=1) / dt
    mean = (raw.tracks.velocity[:, 1:] + raw.tracks.velocity[:, :-1]) / 2
    # A walker may set out or stop within the step.
    limit = np.where(raw.tracks.type == ObjectType.PEDESTRIAN, 1.0, 0.25)[:, None]
    assert np.all((np.linalg.norm(moved - mean, axis=-1) < limit)[both])

    heading, speed, accel = raw.ego[:, 2], raw.ego[:, 3], raw.ego[:, 5]
    moved = np.diff(raw.ego[:, :2], axis=0) / dt
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    error = moved - (velocity[1:] + velocity[:-1]) / 2
    # Where a narrow turn begins, the heading lags the chords of the path a little.
    assert np.max(np.linalg.norm(error, axis=1)) < 0.2
    np.testing.assert_allclose(np.diff(speed) / dt, accel[:-1], atol=1e-6)
    turned = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned / dt, (raw.ego[1:, 9] + raw.ego[:-1, 9]) / 2, atol=0.1)


def test_all_types_and_area_kinds_occur_somewhere():
    scenes = [scene(n, s) for n in SCENES for s in SEEDS]
    assert {int(t) for r in scenes for t in r.tracks.type} == {int(t) for t in ObjectType}
    assert {a.kind for r in scenes for a in r.map.drivable} == {0, 1, 3}
    limits = [lane.speed_limit for r in scenes for lane in r.map.lanes.values()]
    assert None in limits and 13.4 in limits


def test_open_road_is_empty():
    assert scene("open_road", 0).tracks.ids == []


@pytest.mark.parametrize("gap", [8.0, 25.0, 60.0])
@pytest.mark.parametrize("left_lane_free", [True, False])
def test_parked_car_is_exactly_as_far_as_asked(gap, left_lane_free):
    raw = make_scene(
        "parked_car", 3, gap=gap, speed=7.0, left_lane_free=left_lane_free, speed_limit=11.0
    )
    now = raw.num_history
    assert raw.ego[now, 3] == 7.0
    local = in_ego_frame(raw, raw.tracks.pose[:, now, :2])
    still = np.all(raw.tracks.velocity[:, :, :] == 0.0, axis=(1, 2)) & raw.tracks.valid[:, now]
    ahead = np.flatnonzero(still & (np.abs(local[:, 1]) < 1.0))
    assert len(ahead) == 1
    rear = local[ahead[0], 0] - raw.tracks.size[ahead[0], now, 0] / 2
    assert rear - REAR_TO_FRONT == pytest.approx(gap, abs=1e-6)
    beside = (np.abs(local[:, 1] - 3.5) < 0.5) & (np.abs(local[:, 0]) < 30.0)
    assert beside.any() != left_lane_free
    route_limits = {
        raw.map.lanes[i].speed_limit
        for block in raw.route_roadblocks
        for i in raw.map.roadblocks[block].lanes
        if not raw.map.lanes[i].is_connector
    }
    assert route_limits == {11.0}


@pytest.mark.parametrize("side", ["left", "right"])
def test_lane_ends_where_asked_and_only_the_goal_lane_goes_on(side):
    raw = make_scene("lane_ends", 2, length=70.0, goal_side=side)
    block = raw.map.roadblocks[raw.route_roadblocks[0]]
    rear = shapely.Point(raw.ego[raw.num_history, :2])
    own = next(i for i in block.lanes if shapely.Polygon(raw.map.lanes[i].polygon).covers(rear))
    lane = raw.map.lanes[own]
    goal = lane.left_neighbor if side == "left" else lane.right_neighbor
    assert goal is not None
    assert not lane.successors and raw.map.lanes[goal].successors
    end = in_ego_frame(raw, lane.centerline[-1, :2])
    assert end == pytest.approx([REAR_TO_FRONT + 70.0, 0.0], abs=1e-6)
    final = raw.map.roadblocks[raw.route_roadblocks[-1]]
    assert len(final.lanes) == 1
    # The recorded ego makes the change.
    offset = in_ego_frame(raw, raw.ego[-1, :2])[1]
    assert offset == pytest.approx(3.5 if side == "left" else -3.5, abs=0.05)


def test_jaywalker_would_be_hit_by_an_ego_that_keeps_its_speed():
    raw = make_scene("jaywalker", 1, distance=40.0, speed=10.0)
    now, meeting = raw.num_history, raw.num_history + 40
    local = in_ego_frame(raw, raw.tracks.pose[:, meeting, :2])
    walkers = np.flatnonzero(raw.tracks.type == ObjectType.PEDESTRIAN)
    met = [i for i in walkers if np.hypot(*(local[i] - [REAR_TO_FRONT + 40.0, 0.0])) < 0.2]
    assert len(met) == 1
    before = in_ego_frame(raw, raw.tracks.pose[met[0], now - 22, :2])
    assert abs(before[1]) > 2.5
    assert raw.ego[now:, 3].min() < 6.0


def test_red_light_changes_when_asked():
    raw = make_scene("red_light", 0, green_after=6.0, queued=0)
    own = next(i for i in raw.map.roadblocks["south>north"].lanes)
    cross = next(i for i in raw.map.roadblocks["east>west"].lanes)
    states = np.array([step[own] for step in raw.lights])
    green = raw.num_history + 60
    assert set(states[:green]) == {LightStatus.RED} and set(states[green:]) == {LightStatus.GREEN}
    crossing = np.array([step[cross] for step in raw.lights])
    assert not np.any((states == LightStatus.GREEN) & (crossing != LightStatus.RED))
    assert set(crossing) == {LightStatus.GREEN, LightStatus.YELLOW, LightStatus.RED}
    lane = raw.map.lanes[own]
    assert lane.has_traffic_light and lane.stop_line is not None
    stop = next(a for a in raw.map.stop_lines if a.id == lane.stop_line)
    assert stop.polygon.intersects(shapely.LineString(lane.centerline[:, :2]))
    # Nobody of the south or north enters before green.
    front = in_ego_frame(raw, raw.ego[:, :2])[:, 0] + REAR_TO_FRONT
    line = in_ego_frame(raw, lane.centerline[0, :2])[0]
    assert np.all(front[:green] < line) and front[-1] > line


@pytest.mark.parametrize(
    ("turn", "angle"), [("left", np.pi / 2), ("straight", 0.0), ("right", -np.pi / 2)]
)
def test_turns_lead_where_they_should(turn, angle):
    raw = make_scene("tight_turn", 0, turn=turn)
    assert raw.mission_goal is not None
    goal = in_ego_frame(raw, raw.mission_goal[:2])
    start = in_ego_frame(raw, raw.map.lanes[f"{raw.route_roadblocks[1]}/0"].centerline[0, :2])
    turned = np.arctan2(goal[1] - start[1], goal[0] - start[0]) - angle
    assert abs((turned + np.pi) % (2 * np.pi) - np.pi) < 0.7
