"""Closed-loop metrics on runs whose every number is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import EGO_X, FRONT, Thing
from spdm_jax.metrics import SCORED, MetricParams
from spdm_jax.metrics.comfort import SERIES
from spdm_jax.metrics.driving import driving_direction
from spdm_jax.metrics.motion import motion
from spdm_jax.metrics.named import lost_points, series, statistics
from spdm_jax.types import CollisionKind, ObjectType
from straight_run import (
    OBJECTS,
    SHIFT,
    STEPS,
    Y,
    drive,
    evaluate,
    evaluate_many,
    expert_of,
    history_of,
    judge,
    judge_moved,
    straight_map,
)

EDGE = Y - 1.75  # right edge of the road, m
HALF_WIDTH = 2.297 / 2


def scores(metrics) -> dict[str, float]:
    return dict(zip(SCORED, metrics.scores.tolist(), strict=True))


def lost(metrics) -> dict[str, float]:
    """The scores that are not 1; progress left out."""
    given = scores(metrics)
    del given["ego_progress_along_expert_route"]
    return {name: value for name, value in given.items() if value != 1}


def test_a_quiet_drive_loses_nothing_but_the_last_step():
    metrics = judge(drive())
    assert lost(metrics) == {}
    # The expert has one sample more.
    assert metrics.progress.ego_total == pytest.approx(0.1 * 10 * (STEPS - 1))
    assert metrics.progress.expert_total == pytest.approx(0.1 * 10 * STEPS)
    assert metrics.progress.ratio == pytest.approx((STEPS - 1) / STEPS)
    assert metrics.final == pytest.approx((11 + 5 * (STEPS - 1) / STEPS) / 16)
    assert metrics.mean_speed == pytest.approx(10)
    assert metrics.route[:STEPS].sum(1).tolist() == [1] * STEPS
    assert not metrics.route[STEPS:].any()
    assert lost_points(metrics, 0.1 * np.arange(64))[0].metric == "ego_progress_along_expert_route"


@pytest.mark.parametrize(
    "columns, broken",
    [
        ({"ax": 2.39}, []),
        ({"ax": 2.41}, ["ego_lon_acceleration"]),
        ({"ax": -4.04}, []),
        ({"ax": -4.06}, ["ego_lon_acceleration"]),
        ({"ay": 4.9}, ["ego_lat_acceleration"]),
        # The box centre takes part in the yaw: 1.461 (w^2 + alpha).
        ({"yaw_rate": 1.3}, ["ego_lon_acceleration"]),
        ({"yaw_acceleration": 1.6}, []),
        ({"yaw_acceleration": 1.7}, ["ego_lon_acceleration"]),
        ({"ax": np.linspace(-2, 2.0, STEPS)}, []),
        ({"heading": 0.94 * 0.1 * np.arange(STEPS)}, []),
        ({"heading": 0.96 * 0.1 * np.arange(STEPS)}, ["ego_yaw_rate"]),
        ({"heading": 0.5 * 1.92 * (0.1 * (np.arange(STEPS) - 10)) ** 2}, ["ego_yaw_rate"]),
    ],
)
def test_comfort_bounds(columns, broken):
    metrics = judge(drive(**columns))
    assert [SERIES[i] for i in np.flatnonzero(~metrics.comfort.within)] == broken
    assert metrics.comfort.score == (not broken)
    named = [
        point for point in lost_points(metrics, 0.1 * np.arange(64)) if "out of" in point.detail
    ]
    assert len(named) == len(broken)


def test_comfort_series_of_polynomials_are_their_derivatives():
    t = 0.1 * np.arange(STEPS)
    metrics = judge(drive(ax=3.0 + 2 * t, heading=0.3 * t + 0.05 * t**2))
    curves = series(metrics)
    # An even window looks half a sample ahead, but for the ends.
    inner = slice(4, STEPS - 4)
    np.testing.assert_allclose(curves["ego_lon_acceleration"][inner], 3.1 + 2 * t[inner], atol=1e-7)
    np.testing.assert_allclose(curves["ego_lon_acceleration"][:4], 3 + 2 * t[:4], atol=1e-7)
    np.testing.assert_allclose(curves["ego_lon_jerk"][12:-12], 2, atol=1e-6)
    np.testing.assert_allclose(curves["ego_yaw_rate"], 0.3 + 0.1 * t, atol=1e-7)
    np.testing.assert_allclose(curves["ego_yaw_acceleration"], 0.1, atol=1e-7)
    given = statistics(metrics)["ego_yaw_rate"]
    assert given["max_ego_yaw_rate"] == pytest.approx(0.3 + 0.1 * t[-1])
    assert given["avg_ego_yaw_rate"] == pytest.approx(np.mean(0.3 + 0.1 * t))


CONE = Thing(0, Y, type=int(ObjectType.TRAFFIC_CONE), length=0.5, width=0.5)


def ahead(gap: float, thing: Thing = CONE) -> Thing:
    """Places a thing `gap` m before the ego's front bumper at the first sample."""
    return replace(thing, x=EGO_X + FRONT + gap + thing.length / 2)


@pytest.mark.parametrize(
    "things, kinds, score",
    [
        ([], [], 1),
        ([ahead(20.5)], ["STOPPED_TRACK"], 0.5),
        ([ahead(20.5), ahead(23.5)], ["STOPPED_TRACK"] * 2, 0),
        ([ahead(20.5, Thing(0, Y, type=1, length=0.6, width=0.6))], ["STOPPED_TRACK"], 0),
        ([ahead(20.5, Thing(0, Y))], ["STOPPED_TRACK"], 0),
        ([ahead(10.5, Thing(0, Y, speed=5.0))], ["ACTIVE_FRONT"], 0),
        ([Thing(EGO_X - 10, Y, speed=20.0)], ["ACTIVE_REAR"], 1),
        # Into the ego's side, which stays in its lane.
        ([Thing(EGO_X + 9, Y + 10, speed=8.0, heading=-np.pi / 2)], ["ACTIVE_LATERAL"], 1),
    ],
)
def test_collisions(things, kinds, score):
    metrics = judge(drive(), things)
    hit = metrics.collisions.kind >= 0
    assert [CollisionKind(k).name for k in metrics.collisions.kind[hit]] == kinds
    assert scores(metrics)["no_ego_at_fault_collisions"] == score
    assert metrics.collisions.at_fault.any() == (score < 1)


def test_a_collision_has_its_time_its_energy_and_happens_once():
    things = [ahead(10.3, Thing(0, Y, speed=5.0))]
    metrics = judge(drive(), things)
    # 10.3 m at 5 m/s: touching from 2.1 s on.
    assert metrics.collisions.time_index.tolist() == [21, 64, 64, 64]
    assert metrics.collisions.energy[0] == pytest.approx(0.5 * (10 - 5))
    assert np.flatnonzero(metrics.collisions.at_fault_now).tolist() == [21]
    assert metrics.collisions.count.tolist() == [0, 1, 0]
    given = statistics(metrics)["no_ego_at_fault_collisions"]
    assert given["mean_collision_energy_with_vehicles"] == pytest.approx(2.5)
    assert "mean_collision_energy_with_objects" not in given
    point = next(p for p in lost_points(metrics, 0.1 * np.arange(64)) if "collision at" in p.detail)
    assert (point.metric, point.time, point.object) == ("no_ego_at_fault_collisions", 2.1, 0)


def test_a_standing_ego_is_not_at_fault():
    metrics = judge(drive(0.0), [Thing(EGO_X + 30, Y, speed=10.0, heading=np.pi)])
    assert metrics.collisions.kind[0] == CollisionKind.STOPPED_EGO
    assert scores(metrics)["no_ego_at_fault_collisions"] == 1


def test_a_lateral_contact_counts_between_lanes():
    side = Thing(EGO_X + SHIFT, Y + 1.75 + HALF_WIDTH + 0.5 + 0.95, speed=10.0)
    # The ego straddles the line and drifts into its neighbour.
    y = Y + 1.75 + np.linspace(0, 1.0, STEPS)
    metrics = judge(drive(y=y), [side])
    assert metrics.collisions.kind[0] == CollisionKind.ACTIVE_LATERAL
    assert not metrics.corners.in_lane[metrics.collisions.time_index[0]]
    assert scores(metrics)["no_ego_at_fault_collisions"] == 0


def test_time_to_collision_counts_down_in_steps():
    # 40.05 m ahead, standing: at 10 m/s the boxes meet 4.005 s after the start.
    metrics = judge(drive(steps=32), [ahead(40.05, Thing(0, Y))])
    values = metrics.time_to_collision.values
    assert np.isinf(values[:12]).all() and np.isinf(values[32:]).all()
    np.testing.assert_allclose(values[12:32], np.arange(29, 9, -1) * 0.1)
    assert metrics.time_to_collision.object[:32].tolist() == [-1] * 12 + [0] * 20
    assert metrics.time_to_collision.minimum == pytest.approx(1.0)
    assert scores(metrics)["time_to_collision_within_bound"] == 1


def test_time_to_collision_below_the_bound():
    metrics = judge(drive(steps=33), [ahead(40.05, Thing(0, Y))])
    assert scores(metrics)["time_to_collision_within_bound"] == 0
    point = lost_points(metrics, 0.1 * np.arange(64))[-1]
    assert (point.metric, point.object) == ("time_to_collision_within_bound", 0)
    assert point.time == pytest.approx(3.2)


def test_an_object_no_longer_counts_once_it_collided():
    # Into the ego's side near its front at 0.8 s, and on across it.
    things = [Thing(EGO_X + 11.4, Y + 8.0, 8.0, -np.pi / 2, length=1.0, width=0.5)]
    metrics = judge(drive(), things)
    assert metrics.collisions.time_index[0] == 8
    assert not metrics.collisions.at_fault.any()
    assert metrics.time_to_collision.values[7] == pytest.approx(0.1)
    assert np.isinf(metrics.time_to_collision.values[8:]).all()


def alongside(x: float, y: float, dx: float, heading: float) -> float:
    """Least time to collision with a box that keeps beside the ego, whatever its heading says."""
    beside = Thing(x + dx, y + 4.5, heading=heading)
    history = history_of(drive(x=x, y=y, steps=10), [beside])
    objects = history.objects
    at = objects.x.at[:, 0].set(history.ego.x + dx)
    moving = objects.replace(x=at, vx=jnp.full_like(at, 10.0))
    metrics = evaluate(
        history.replace(objects=moving), straight_map(), expert_of(drive()), MetricParams()
    )
    return float(metrics.time_to_collision.minimum)


@pytest.mark.parametrize("y, counts", [(Y, False), (Y + 1.75, True)])
def test_objects_beside_count_only_between_lanes(y: float, counts: bool):
    # Its box is turned inwards: along its heading it would cross the ego's way.
    assert (alongside(EGO_X, y, 3.0, -0.9) < 3) == counts


def test_objects_beside_count_in_an_intersection():
    # The rear axle crosses from 200 m to 206 m within this second, or not at all.
    assert np.isinf(alongside(180.0, Y, 3.0, -0.9))
    assert alongside(195.0, Y, 3.0, -0.9) < 3


def test_objects_behind_never_count():
    straddling = Y + 1.75
    behind = Thing(EGO_X - 8, straddling, speed=20.0)
    metrics = judge(drive(y=straddling, steps=5), [behind])
    assert not metrics.corners.in_lane[:5].any()
    assert np.isinf(metrics.time_to_collision.minimum)


@pytest.mark.parametrize("over, outside, score", [(-0.1, 0, 1), (0.25, 2, 1), (0.35, 2, 0)])
def test_corners_beyond_the_edge(over, outside, score):
    metrics = judge(drive(y=EDGE - over + HALF_WIDTH))
    assert metrics.drivable_area.outside[:STEPS].sum(1).tolist() == [outside] * STEPS
    assert metrics.drivable_area.far.any() == (score == 0)
    assert scores(metrics)["drivable_area_compliance"] == score
    assert metrics.drivable_area.always_inside == (outside == 0)


def test_a_corner_near_a_lane_of_the_route_is_not_far():
    away = straight_map()
    away = away.replace(drivable=away.drivable.replace(xy=away.drivable.xy + 1e3))
    away = away.replace(drivable=away.drivable.replace(next_xy=away.drivable.next_xy + 1e3))
    for over, score in ((0.25, 1), (0.35, 0)):
        history = history_of(drive(y=EDGE - over + HALF_WIDTH))
        metrics = evaluate(history, away, expert_of(drive()), MetricParams())
        assert np.asarray(metrics.drivable_area.outside)[:STEPS].sum() == 2 * STEPS
        assert float(metrics.drivable_area.score) == score


def test_speeding_by_a_constant():
    metrics = judge(drive(15.0))
    assert metrics.speed_limit.over[:STEPS] == pytest.approx(15 - 13.4)
    # The sum has a sample more than the duration has steps.
    expected = 1 - (15 - 13.4) * STEPS / (2.23 * (STEPS - 1))
    assert scores(metrics)["speed_limit_compliance"] == pytest.approx(expected)
    given = statistics(metrics)["speed_limit_compliance"]
    assert given["number_of_violations_of_speed_limit_compliance"] == 1
    assert given["mean_violation_of_speed_limit_compliance"] == pytest.approx(1.6)


def test_two_violations_are_weighted_by_their_length():
    speed = np.full(STEPS, 10.0)
    speed[5:15], speed[20:25] = 14.4, 16.4
    limit = judge(drive(speed)).speed_limit
    assert (limit.number, limit.highest, limit.lowest) == (2, pytest.approx(3), pytest.approx(1))
    assert limit.mean == pytest.approx((1 * 1.0 + 3 * 0.5) / 1.5)


def test_no_limit_known():
    metrics = judge(drive(40.0), limit=None)
    assert scores(metrics)["speed_limit_compliance"] == 1
    assert np.isinf(metrics.speed_limit.limit).all()


def test_connectors_take_the_limits_around_them():
    """The run crosses the connector from 200 m to 206 m."""
    usual = straight_map()
    lanes = usual.lanes
    with_limits = lambda limits: usual.replace(lanes=lanes.replace(speed_limit=limits))
    slow = with_limits(jnp.where(lanes.is_connector, 1.0, lanes.speed_limit))
    unknown = with_limits(jnp.where(lanes.is_connector, lanes.speed_limit, jnp.nan))
    goal = expert_of(drive())
    history = history_of(drive(x=180.0))
    judged = lambda world: evaluate(history, world, goal, MetricParams()).speed_limit
    assert not np.asarray(judged(slow).over).any()
    assert np.asarray(judged(slow).limit)[:STEPS].tolist() == [13.4] * STEPS
    assert np.isinf(np.asarray(judged(unknown).limit)).all()


def test_driving_direction_starts_anew_on_each_lane():
    # The centre enters the connector at sample 19 and the lane after it at sample 25; neither that
    # sample nor the next one counts.
    metrics = judge(drive(x=180.0))
    values = metrics.driving_direction.values
    np.testing.assert_allclose(values[[5, 18, 29, 30, 45]], [5, 11, 7, 8, 11])


def test_an_arc_length_of_zero_counts_nothing():
    scene_map, params = straight_map(), MetricParams()
    ego = history_of(drive(-5.0, x=2.0 - SHIFT, steps=9)).ego
    row = int(
        np.flatnonzero(
            np.asarray(
                evaluate(history_of(drive()), scene_map, expert_of(drive()), params).route[0]
            )
        )[0]
    )
    route = jnp.zeros((64, 16), bool).at[:9, row].set(True)
    valid, time = jnp.arange(64) < 9, 0.1 * jnp.arange(64)
    move = motion(ego, params.vehicle)
    result = driving_direction(scene_map.lanes, move, route, time, valid, params)
    # 2 m before the baseline's start in steps of 0.5 m: the fourth step ends at 0.
    assert float(result.minimum) == pytest.approx(-1.5)


@pytest.mark.parametrize("speed, score", [(1.7, 1), (1.9, 0.5), (5.4, 0.5), (6.0, 0)])
def test_driving_backwards(speed, score):
    metrics = judge(drive(-speed))
    # The window of one second holds eleven differences.
    assert metrics.driving_direction.minimum == pytest.approx(-1.1 * speed)
    assert scores(metrics)["driving_direction_compliance"] == score


def test_irregular_time_stamps_set_the_window():
    time = np.cumsum(np.full(STEPS, 0.2))
    metrics = judge(drive(-5.0), time=time)
    # One second is five steps now, so six differences of 0.5 m.
    assert metrics.driving_direction.minimum == pytest.approx(-3.0)


def test_a_lane_change():
    y = Y + np.interp(np.arange(STEPS), [10, 40], [0, 3.5])
    metrics = judge(drive(y=y))
    half = 1.75 - HALF_WIDTH  # m to the line, then to the other side of it
    rate = 3.5 / 30
    leaves, arrives = 10 + half / rate, 40 - half / rate
    first, last = int(np.ceil(leaves)), int(np.ceil(arrives))
    changes = metrics.lane_changes
    assert (changes.number, changes.failed_ratio) == (1, 0)
    assert np.flatnonzero(changes.succeeded).tolist() == [last]
    assert changes.longest == pytest.approx(0.1 * (last - first))
    assert np.flatnonzero(~metrics.corners.in_lane[:STEPS]).tolist() == list(range(first, last))


def test_a_lane_change_given_up_and_one_cut_off():
    y = Y + np.interp(np.arange(STEPS), [5, 15, 25, 40, 49], [0, 1.5, 0, 0, 1.5])
    changes = judge(drive(y=y)).lane_changes
    assert (changes.number, changes.failed_ratio) == (2, 1)
    assert np.flatnonzero(changes.ended)[-1] == STEPS - 1


def test_progress_across_a_connector_and_off_the_road():
    onward = drive(x=180.0)  # the connector lies between 200 m and 206 m
    metrics = judge(onward, expert=onward)
    assert metrics.progress.ratio == 1
    np.testing.assert_allclose(metrics.progress.values[1:STEPS], 1.0)
    assert metrics.progress.expert_total == pytest.approx(49.0)
    # From sample 10 on far beside the road: progress stops.
    y = np.where(np.arange(STEPS) < 10, Y, Y - 30)
    aside = judge(drive(x=180.0, y=y), expert=onward)
    assert aside.progress.ego_total == pytest.approx(9)
    assert scores(aside)["ego_is_making_progress"] == 0
    assert np.isclose(aside.progress.ratio, 9 / 49)


def test_progress_counts_roadblocks_that_were_skipped():
    onward = drive(x=180.0)
    y = np.full(STEPS, Y)
    # The box centre is beside the road on the whole connector.
    y[15:30] = Y - 30
    metrics = judge(drive(x=180.0, y=y), expert=onward)
    assert metrics.progress.values[30] == pytest.approx(16)
    assert metrics.progress.ratio == pytest.approx(1)


@pytest.mark.parametrize(
    "speed, expert, ratio",
    [
        (0.0, 0.0, 1.0),  # both stand
        (0.3, 0.3, 1.0),  # both below the threshold
        (5.0, 10.0, 4.9 * 5 / (5.0 * 10)),
        (0.0, 10.0, 2 / 50),
        (-0.3, 10.0, 2 / 50),
        (-0.6, 10.0, 0.0),
    ],
)
def test_progress_ratio(speed, expert, ratio):
    metrics = judge(drive(speed), expert=drive(expert, steps=STEPS + 1))
    assert metrics.progress.ratio == pytest.approx(ratio)


def test_an_expert_without_a_route_asks_for_nothing():
    metrics = judge(drive(0.0), expert=drive(y=-100.0))
    assert not metrics.progress.has_route
    assert metrics.progress.ratio == 1
    assert (
        "ego_total_progress_along_route"
        not in statistics(metrics)["ego_progress_along_expert_route"]
    )


def test_errors_against_the_expert():
    metrics = judge(drive(y=Y + 3, heading=0.2))
    rear = np.array([SHIFT * (np.cos(0.2) - 1), 3 + SHIFT * np.sin(0.2)])
    given = statistics(metrics)
    assert given["ego_expert_l2_error"]["max_ego_expert_l2_error"] == pytest.approx(np.hypot(*rear))
    with_yaw = given["ego_expert_l2_error_with_yaw"]
    assert with_yaw["p90_ego_expert_l2_error_with_yaw"] == pytest.approx(
        np.hypot(*rear) + 2.5 * 0.2
    )


def busy() -> tuple[dict, list[Thing]]:
    """A run that loses points in every way at once."""
    y = Y + np.interp(np.arange(STEPS), [5, 30], [0, 3.0])
    ego = drive(14.5, y=y, heading=0.1 * np.sin(np.arange(STEPS) / 5.0), ax=2.0)
    things = [
        ahead(20.5),
        ahead(30.2, Thing(0, Y + 2, speed=3.0, heading=0.2)),
        Thing(EGO_X - 10, Y, speed=22.0),
        Thing(EGO_X + 40, Y + 12, speed=4.0, heading=-np.pi / 2, type=2, length=1.8, width=0.7),
    ]
    return ego, things


def close(one, other, rtol=1e-7, atol=1e-6):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(
            np.asarray(a, float), np.asarray(b, float), rtol, atol
        ),
        one,
        other,
    )


def test_the_frame_does_not_matter():
    ego, things = busy()
    close(judge(ego, things), judge_moved(ego, things, 0.7, (31.0, -12.5)))


def test_the_order_of_objects_does_not_matter():
    ego, things = busy()
    one, other = judge(ego, things), judge(ego, things[::-1])
    close(one.scores, other.scores)
    close(one.collisions.time_index, other.collisions.time_index[::-1])
    close(one.time_to_collision.values, other.time_to_collision.values)
    met = one.time_to_collision.object
    close(np.where(met >= 0, OBJECTS - 1 - met, -1), other.time_to_collision.object)


@pytest.mark.parametrize("steps", [3, 4, 7, 20])
def test_a_run_that_ends_early_is_the_run_cut_off(steps):
    """Padded with samples of a drive that would change every metric, if they counted."""
    ego, things = busy()
    cut = {name: column[:steps] for name, column in ego.items()}
    expert, params = expert_of(drive(steps=STEPS + 1)), MetricParams()
    history = history_of(ego, things)
    history = history.replace(valid=jnp.arange(64) < steps)
    one = evaluate(history, straight_map(), expert, params)
    other = evaluate(history_of(cut, things), straight_map(), expert, params)
    close(one.scores, other.scores)
    close(statistics_of(one), statistics_of(other))
    close(series(one), series(other))
    # The filters need four samples.
    assert np.isnan(one.final) == (steps < 4)


def statistics_of(metrics) -> dict:
    return {k: {n: v for n, v in s.items()} for k, s in statistics(metrics).items()}


@pytest.mark.slow
def test_a_batch_is_its_runs():
    ego, things = busy()
    runs = [history_of(ego, things), history_of(drive())]
    stack = lambda trees: jax.tree.map(lambda *v: jnp.stack(v), *trees)
    expert = expert_of(drive(steps=STEPS + 1))
    many = evaluate_many(stack(runs), straight_map(), stack([expert, expert]))
    for i, history in enumerate(runs):
        single = evaluate(history, straight_map(), expert, MetricParams())
        close(jax.tree.map(lambda v, i=i: v[i], many), single)


@pytest.mark.slow
def test_float32_stays_float32_and_agrees():
    ego, things = busy()
    history = history_of(ego, things, dtype=jnp.float32)
    expert = expert_of(drive(steps=STEPS + 1), dtype=jnp.float32)
    metrics = evaluate(history, straight_map(dtype="float32"), expert, MetricParams())
    floats = [v for v in jax.tree.leaves(metrics) if jnp.issubdtype(v.dtype, jnp.floating)]
    assert {v.dtype for v in floats} == {jnp.dtype(jnp.float32)}
    close(metrics.scores, judge(ego, things).scores, atol=1e-3)


def test_an_ego_that_is_not_a_number_has_no_score():
    ego = drive()
    ego["x"][20:] = np.nan
    ego["vx"][20:] = np.nan
    ego["ax"][20:] = np.nan
    assert np.isnan(judge(ego).final)
