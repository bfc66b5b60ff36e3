"""The oncoming lane: where it is found, how it is driven, when it may be, and that it helps."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import small_road as roads
from spdm_jax.config import PlannerParams, pdm_closed, spdm
from spdm_jax.io.raw import RawArea, RawLane, RawRoadblock, RawScenario
from spdm_jax.proposals.borrow import (
    GAP_TIME,
    Surroundings,
    drive_borrowing,
    may_borrow,
    offered,
    overhangs,
    passing_speed,
    surroundings,
)
from spdm_jax.proposals.oncoming import OncomingLane, oncoming_lane
from spdm_jax.proposals.spline import RouteLanePaths, drive, route_lane_paths
from spdm_jax.types import ObjectType, Scenario

FEW = partial(spdm, 10, speed_fractions=(0.5, 1.0), lateral_offsets=(0.0,))
OFF = FEW(config=roads.CONFIG)
ON = FEW(config=dataclasses.replace(roads.CONFIG, borrow_oncoming=True))
PARAMS = PlannerParams()
END = 460.0
SIZE = roads.CONFIG.max_path_points


def two_way(
    *,
    spacing: float = 3.5,
    angle: float = np.pi,
    begin: float = 0.0,
    until: float = END,
    lanes: tuple[int, ...] = (0,),
    **given,
) -> RawScenario:
    """A road whose leftmost lane, the ego's, runs along y = 0, and a lane off route to its left.

    Args:
      spacing: of the two lanes, m, negative for a lane to the right.
      angle: direction of the lane beside; pi is oncoming.
      begin: station at which the lane beside begins, m.
      until: station at which it ends, m.
      lanes: numbers of the lanes on route.
      **given: as for `roads.road`.
    """
    raw = roads.road(ego_lane=0, blocks=(lanes,), cuts=(END,), **given)
    x = np.linspace(begin, until, int((until - begin) * 0.6))
    direction = np.full_like(x, angle)
    if np.cos(angle) < 0:
        x = x[::-1]
    edge = lambda left: np.stack([x, np.full_like(x, spacing + left * np.cos(angle))], 1)
    left, right = edge(1.75), edge(-1.75)
    polygon = np.concatenate([left, right[::-1]])
    raw.map.lanes["o/0"] = RawLane(
        id="o/0",
        is_connector=False,
        roadblock="o",
        centerline=np.stack([x, np.full_like(x, spacing), direction], 1),
        left_boundary=left,
        right_boundary=right,
        polygon=polygon,
        speed_limit=roads.LIMIT,
    )
    area = roads.shapely.Polygon(polygon)
    raw.map.roadblocks["o"] = RawRoadblock(id="o", is_connector=False, polygon=area, lanes=["o/0"])
    raw.map.drivable.append(RawArea("o", area))
    return raw


def van(gap: float = 25.0) -> roads.Thing:
    """A van that leaves no room for passing within the lane, `gap` m ahead of the ego."""
    x = roads.EGO_X + roads.FRONT + gap + 3.0
    kind = int(ObjectType.GENERIC_OBJECT)
    return roads.Thing(x, -0.4, length=6.0, width=2.1, type=kind, id="van")


def coming(distance: float, speed: float = 10.0) -> roads.Thing:
    """A car in the oncoming lane whose front is `distance` m ahead of the ego's rear axle."""
    return roads.Thing(roads.EGO_X + distance + 2.3, 3.5, speed=speed, heading=np.pi, id="car")


@partial(jax.jit, static_argnames="num_paths")
def look(scene: Scenario, num_paths: int = 6) -> tuple[OncomingLane, Surroundings, RouteLanePaths]:
    """What the planner finds at iteration 0."""
    state = roads.init(scene, ON.params, config=ON.config)
    given = roads.observe(scene, 0)
    centerline = jax.tree.map(lambda v: v[0], state.paths)
    lanes, route = scene.map.lanes, scene.route
    lane = oncoming_lane(lanes, route, centerline, given.ego, SIZE)
    around = surroundings(lane, centerline, given.ego, given.observation, PARAMS)
    block = lanes.roadblock[route.start_lane[state.slot]]
    line = (route, state.slot, block, centerline, state.goal, given.ego, PARAMS.spline)
    return lane, around, route_lane_paths(lanes, *line, num_paths, SIZE, offered(around))


@given(
    st.floats(-3, 3),
    st.floats(2.6, 5.0),
    st.sampled_from([-1, 1]),
    st.floats(-0.8, 0.8),
    st.floats(-0.1, 0.1),
)
def test_path_is_the_middle_of_the_oncoming_lane(
    angle: float, spacing: float, side: int, ego_y: float, ego_heading: float
):
    raw = two_way(spacing=side * spacing, ego_y=ego_y, ego_heading=ego_heading)
    origin = np.round(roads.moved(raw, angle, (300.0, -80.0)).ego[raw.num_history, :2])
    lane, _, _ = look(roads.scene_of(roads.moved(raw, angle, (300.0, -80.0))))
    assert bool(lane.usable) and float(lane.side) == side
    assert float(lane.border) == pytest.approx(spacing / 2, abs=1e-6)
    count = int(lane.path.count)
    xy = np.stack([lane.path.x, lane.path.y], 1)[:count] + origin - (300.0, -80.0)
    cos, sin = np.cos(angle), np.sin(angle)
    along, left = xy @ (cos, sin), xy @ (-sin, cos)
    np.testing.assert_allclose(left, side * spacing, atol=1e-6)
    np.testing.assert_allclose(along, roads.EGO_X + 2.5 * np.arange(count), atol=1e-6)
    # Driven in the ego's direction.
    turn = np.asarray(lane.path.heading)[:count] - angle
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-9)


@pytest.mark.parametrize(
    "road",
    [{"spacing": 5.5}, {"angle": 0.0}, {"angle": 2.2}, {"begin": 200.0}, {"until": 50.0}],
    ids=["too far", "same direction", "across", "farther on", "behind"],
)
def test_no_other_lane_is_borrowed(road: dict):
    lane, _, found = look(roads.scene_of(two_way(things=[van()], **road)))
    assert not lane.usable and int(lane.lane) == -1
    assert not np.any(found.borrowed)
    np.testing.assert_array_equal(found.valid, [True] * 3 + [False] * 3)


def test_path_ends_with_the_lane():
    lane, around, _ = look(roads.scene_of(two_way(until=100.0, things=[van()])))
    # A lane counts up to 5 m beyond its last stored point.
    assert 40.0 < float(lane.path.length) < 47.5
    assert around.blocked and not around.room
    _, around, _ = look(roads.scene_of(two_way(until=130.0, things=[van()])))
    assert around.blocked and around.room


def test_borrowed_paths_come_before_the_own_lane():
    lane, _, found = look(roads.scene_of(two_way(things=[van()])))
    np.testing.assert_array_equal(found.borrowed, [True] * 3 + [False] * 3)
    np.testing.assert_array_equal(np.asarray(found.lane)[:3], int(lane.lane))
    x, y = np.asarray(found.path.x), np.asarray(found.path.y)
    joints = [x[k, np.argmax(np.abs(y[k] - y[k, -1]) < 1e-9)] - x[k, 0] for k in range(6)]
    np.testing.assert_allclose(joints[:3], [40, 20, 60], atol=1e-6)
    np.testing.assert_allclose(y[:3, -1] - y[:3, 0], 3.5, atol=1e-6)
    np.testing.assert_allclose(y[3:], y[3, 0], atol=1e-6)


def test_lawful_lanes_come_first_and_path_sets_nest():
    scene = roads.scene_of(two_way(lanes=(0, 1), things=[van()]))
    lane, _, whole = look(scene)
    np.testing.assert_array_equal(whole.borrowed, [False] * 3 + [True] * 3)
    assert len(set(np.asarray(whole.lane)[:3])) == 1 and int(whole.lane[3]) == int(lane.lane)
    for num in (1, 4):
        part = look(scene, num)[2]
        for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(whole), strict=True):
            np.testing.assert_array_equal(a, b[:num] if np.ndim(b) else b)


_drive = jax.jit(drive, static_argnames="num_states")
_borrow = jax.jit(drive_borrowing, static_argnames="num_states")
TARGETS = jnp.asarray([0.5, 1.0]) * roads.LIMIT


def profiles(raw: RawScenario):
    """Poses and validity of all paths, with and without borrowing, and the paths."""
    scene = roads.scene_of(raw)
    _, around, found = look(scene)
    ego = roads.observe(scene, 0).ego
    new = _borrow(found, ego, TARGETS, PARAMS, num_states=81, around=around)
    old = _drive(found, ego, TARGETS, PARAMS.spline, num_states=81)
    return [[np.asarray(v) for v in part] for part in (new, old)], around, found


@pytest.mark.parametrize("speed", [0.0, 1.0, 4.0, 8.0, 12.0])
def test_border_is_crossed_slowly(speed: float):
    (new, old), _, _ = profiles(two_way(speed=speed, things=[van(40.0)]))
    slow = float(passing_speed(PARAMS))
    assert 11 * 0.1 * slow < 2.0
    x, y, heading, valid = new
    center = y + 1.461 * np.sin(heading) - y[0, 0, 0]
    velocity = np.hypot(np.diff(x), np.diff(y)) / 0.1
    crossed = 0
    for k in range(3):
        across = center[k, 1, :-1] > 1.75
        # Its curve is too short to slow down comfortably from more.
        if across.any() and (k != 1 or speed < 5):
            crossed += 1
            assert velocity[k, 1][across].max() < 1.15 * slow
            assert velocity[k, 1, -1] == pytest.approx(slow, abs=1e-2)
    assert crossed >= (2 if speed > 5 else 1) and valid[:3, 1].all()
    assert velocity[:3, 0, -1].max() < velocity[:3, 1, -1].min() + 1e-6
    # From the own lane the own lane is driven as ever.
    for a, b in zip(new, old, strict=True):
        np.testing.assert_array_equal(a[3:], b[3:])


def test_speed_is_gained_after_the_return_only():
    (new, _), around, _ = profiles(two_way(speed=1.7, ego_y=2.6, things=[van(-1.0)]))
    assert around.entered and around.blocked
    slow = float(passing_speed(PARAMS))
    x, y, heading, valid = new
    assert valid[:, 1].all()
    lateral = y + 1.461 * np.sin(heading) - (y[0, 0, 0] - 2.6)
    velocity = np.hypot(np.diff(x), np.diff(y)) / 0.1
    for k in range(3, 6):
        out = lateral[k, 1, :-1] > 1.75
        assert out[0] and not out[-1]
        assert velocity[k, 1][out].max() < 1.01 * slow
    assert velocity[3:, 1, -1].max() > 2 * slow


def test_without_an_obstacle_nothing_is_borrowed():
    for raw in (
        two_way(),
        two_way(things=[dataclasses.replace(van(), speed=2.0)]),
        two_way(things=[dataclasses.replace(van(), y=-4.0)]),
        two_way(things=[van(-20.0)]),
        two_way(ego_y=2.6, things=[van(-20.0)]),
    ):
        lane, _, found = look(roads.scene_of(raw))
        assert lane.usable and not found.borrowed.any()
        np.testing.assert_array_equal(found.valid, [True] * 3 + [False] * 3)
    (new, _), _, _ = profiles(two_way(things=[van()]))
    assert new[3][:3, 1].all()


def test_oncoming_traffic_is_waited_for():
    driven = lambda *things, **road: profiles(two_way(things=things, **road))[0][0][3][:3, 1]
    assert not driven(van(), coming(80.0)).any()
    assert driven(van(), coming(400.0)).all()  # ends up behind the road: far enough away
    assert driven(van(), coming(15.0)).all()  # past before the ego is out
    assert driven(van(), coming(-20.0)).all()
    assert not driven(van(), coming(80.0), ego_y=1.0).any()
    # Across already: what follows is for scoring to say.
    assert driven(van(), coming(80.0), ego_y=2.6, speed=1.7).all()


_may = jax.jit(may_borrow)


@given(
    st.floats(3, 40),
    st.floats(5, 60),
    st.floats(0.5, 6),
    st.floats(0.5, 2.0),
    st.floats(-20, 250),
    st.floats(0.6, 15),
)
def test_gate_keeps_the_ego_clear(
    first: float, rest: float, until: float, pace: float, distance: float, speed: float
):
    """Brute force over time: where the gate is open, the two never share a stretch of the lane."""
    back = first + rest
    around = Surroundings(
        oncoming=None,  # type: ignore[arg-type]
        back=jnp.asarray(back),
        blocked=jnp.asarray(True),
        room=jnp.asarray(True),
        entered=jnp.asarray(False),
        ahead=jnp.asarray([distance, jnp.inf]),
        behind=jnp.asarray([distance + 4.6, jnp.inf]),
        speed=jnp.asarray([speed, 0.0]),
    )
    values = (jnp.asarray([first]), jnp.asarray([[until]]), jnp.asarray([pace]))
    allowed = bool(_may(around, *values, PARAMS)[0, 0])
    rear, front = overhangs(PARAMS.vehicle)
    time = np.linspace(0, rest / pace, 400)
    ego = first + pace * time
    near = distance - speed * (until + time)
    clear = (near > ego + front) | (near + 4.6 < ego - rear)
    assert clear.all() or not allowed
    later = near - speed * GAP_TIME - pace * GAP_TIME
    if (later > back + front).all() or (near + 4.6 < first - rear).all():
        assert allowed


@pytest.mark.slow
def test_only_with_the_switch_a_blocked_lane_is_passed():
    raw = two_way(speed=6.0, things=[van(22.0)])
    end = roads.EGO_X + roads.FRONT + 22.0
    waiting, _ = roads.drive(raw, OFF, 140)
    assert waiting[-1, 0] + roads.FRONT < end and waiting[-1, 3] < 0.1
    poses, results = roads.drive(raw, ON, 240)
    assert poses[-1, 0] > end + 6.0 and abs(poses[-1, 1]) < 1.75
    assert poses[:, 1].max() > 1.7
    center = poses[:, 1] + 1.461 * np.sin(poses[:, 2])
    # What nuPlan's metric sums: the way against the lane within 1.1 s.
    against = np.where(center > 1.75, 0.1 * poses[:, 3], 0)
    assert np.convolve(against, np.ones(11)).max() < 2.0
    for result in results:
        best = int(result.best)
        assert result.scores.no_at_fault_collision[best] == 1
        assert result.scores.drivable_area[best] == 1 and not result.overflow
    # Somebody comes: it stays where it is.
    held, _ = roads.drive(two_way(speed=6.0, things=[van(22.0), coming(90.0, 8.0)]), ON, 60)
    assert held[:, 1].max() < 1.0 and held[-1, 0] + roads.FRONT < end


@pytest.mark.slow
def test_without_an_oncoming_lane_the_switch_changes_nothing():
    raw = roads.road(things=[roads.parked(25.0)])
    one, other = roads.plan(raw, OFF), roads.plan(raw, ON)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_the_switch_is_off_unless_asked_for():
    assert not spdm(60).config.borrow_oncoming and not pdm_closed(15).config.borrows
    assert ON.config.borrows
    # Without stage 2 there is nothing to borrow with: still PDM-Closed.
    assert not spdm(15, config=ON.config).config.borrows
