"""PDM-Closed, step by step, on roads where the right answer is plain."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from spdm_jax.config import BrakeParams, PlannerConfig, PlannerParams, VehicleParams
from spdm_jax.decision import brake_trajectory, target_speeds
from spdm_jax.planner import see
from spdm_jax.types import EgoState, ObjectType

PDM = roads.PDM
_see = jax.jit(see, static_argnames="config")


def test_empty_road_is_driven_at_the_limit():
    result = roads.plan(roads.road(speed=10.0), PDM)
    scores = result.scores
    assert int(result.best) == 4  # the centreline at the full limit
    assert not bool(result.emergency_brake) and not bool(result.overflow)
    np.testing.assert_allclose(result.target_speed, roads.LIMIT * np.array([0.2, 0.4, 0.6, 0.8, 1]))
    np.testing.assert_array_equal(scores.no_at_fault_collision, 1)
    assert scores.total[4] == 1.0
    trajectory = result.trajectory
    np.testing.assert_allclose(trajectory.y, trajectory.y[0], atol=1e-9)
    assert np.all(np.diff(trajectory.x) > 0.9)
    for name in EgoState.__dataclass_fields__:
        if name not in ("x", "y", "heading"):
            np.testing.assert_array_equal(getattr(trajectory, name), 0)


def test_proposals_are_paths_times_policies():
    result = roads.plan(roads.road(), PDM)
    proposals = result.proposals
    np.testing.assert_array_equal(proposals.path, np.repeat([0, 1, 2], 5))
    np.testing.assert_array_equal(proposals.policy, np.tile(np.arange(5), 3))
    np.testing.assert_array_equal(proposals.stage, 1)
    np.testing.assert_array_equal(proposals.lane, -1)
    assert proposals.valid.all()
    offset = np.repeat([0.0, -1.0, 1.0], 5)[:, None]
    np.testing.assert_allclose(proposals.y - proposals.y[0, 0], offset + np.zeros(41), atol=1e-9)


def test_first_step_always_brakes():
    """The leader vector is still zero then: full braking for one step, as published."""
    result = roads.plan(roads.road(speed=10.0), PDM)
    x = result.proposals.x[4]
    np.testing.assert_allclose(np.diff(x)[:2], [1.0, 0.1 * (10.0 - 0.3)], atol=1e-9)


def test_leader_is_followed_and_not_hit():
    car = roads.Thing(roads.EGO_X + 25.0, -3.5, speed=5.0)
    alone = roads.plan(roads.road(), PDM)
    behind = roads.plan(roads.road(things=[car]), PDM)
    assert behind.proposals.x[4, -1] < alone.proposals.x[4, -1] - 5.0
    best = int(behind.best)
    assert behind.scores.no_at_fault_collision[best] == 1
    gap = car.x + 5.0 * 8.0 - car.length / 2 - (behind.trajectory.x[-1] + 60.0 + roads.FRONT)
    assert 0.5 < gap < 15


def test_red_light_is_a_wall_until_it_turns():
    stop, go = (roads.plan(roads.road(cuts=(100.0, 420.0), red=r), PDM) for r in ((0, 1), ()))
    # The light lies behind the block's end at 100 m; the front bumper stays before it.
    reach = stop.trajectory.x[-1] + 60.0 + roads.FRONT
    assert 90.0 < reach < 100.0
    assert go.trajectory.x[-1] + 60.0 > 120.0
    # Running it would cost nothing in the score: it only acts as a leader.
    assert stop.scores.no_at_fault_collision.all()


def test_red_light_of_another_lane_does_not_count():
    other = roads.plan(roads.road(cuts=(100.0, 420.0), red=(0,)), PDM)
    assert other.trajectory.x[-1] + 60.0 > 120.0


def test_unknown_limit_falls_back():
    result = roads.plan(roads.road(limit=None), PDM)
    np.testing.assert_allclose(result.target_speed, 15.0 * np.array([0.2, 0.4, 0.6, 0.8, 1]))
    limits = jnp.asarray(np.nan), jnp.asarray(10.0)
    params = PlannerParams(speed_fractions=jnp.asarray([0.5, 1.0]))
    np.testing.assert_allclose(target_speeds(limits[0], params), [7.5, 15.0])
    np.testing.assert_allclose(target_speeds(limits[1], params), [5.0, 10.0])


def test_emergency_brake_when_a_collision_is_near_and_the_ego_slow():
    # Somebody comes towards the ego on its own lane: whatever it does, they meet in a second.
    wrong_way = roads.Thing(roads.EGO_X + roads.FRONT + 17.0, -3.5, speed=10.0, heading=np.pi)
    slow = roads.plan(roads.road(speed=4.9, things=[wrong_way]), PDM)
    fast = roads.plan(roads.road(speed=5.1, things=[wrong_way]), PDM)
    assert slow.scores.collision_time[int(slow.best)] <= 2.0
    assert bool(slow.emergency_brake) and not bool(fast.emergency_brake)
    # 1.1 x (4.9 - 4.05) m/s: speed after hard braking, still forwards.
    np.testing.assert_allclose(np.diff(slow.trajectory.x), 0.1 * 1.1 * (4.9 - 4.05), atol=1e-9)
    np.testing.assert_allclose(slow.trajectory.y, slow.trajectory.y[0])


@pytest.mark.parametrize(
    "speed, accel, rate", [(0.1, 0.5, -0.9), (0.1, 3.0, -3.4), (3.0, 0, -1.155)]
)
def test_brake_trajectory_runs_at_constant_speed(speed: float, accel: float, rate: float):
    fields = dict.fromkeys(EgoState.__dataclass_fields__, jnp.asarray(0.0))
    heading = 0.7
    given = {"heading": jnp.asarray(heading), "vx": jnp.asarray(speed), "ax": jnp.asarray(accel)}
    x, y, h = brake_trajectory(EgoState(**fields | given), VehicleParams(), BrakeParams())
    way = 0.1 * rate * np.arange(81)
    np.testing.assert_allclose(x, way * np.cos(heading), atol=1e-9)
    np.testing.assert_allclose(y, way * np.sin(heading), atol=1e-9)
    np.testing.assert_array_equal(h, heading)


def test_what_touches_the_ego_now_is_forgotten():
    """An object the ego stands in is ignored at once and gone from the next step on."""
    inside = roads.Thing(roads.EGO_X + 1.0, -3.5, id="inside")
    ahead = roads.Thing(roads.EGO_X + 40.0, -3.5, id="ahead")
    scene = roads.scene_of(roads.road(things=[inside, ahead]))
    state = roads.init(scene, PDM.params, config=PDM.config)
    given = roads.observe(scene, 0)
    first, state, _ = roads.advance(scene, given, state, PDM.params, config=PDM.config)
    forecast = jax.tree.map(np.asarray, first.forecast)
    seen = forecast.track[forecast.valid].tolist()
    assert seen == [0, 1]
    np.testing.assert_array_equal(forecast.ignored[forecast.valid], [True, False])
    assert float(first.scores.no_at_fault_collision.max()) == 1
    np.testing.assert_array_equal(np.flatnonzero(state.collided), [0])
    second, state, _ = roads.advance(scene, given, state, PDM.params, config=PDM.config)
    forecast = jax.tree.map(np.asarray, second.forecast)
    assert forecast.track[forecast.valid].tolist() == [1]
    np.testing.assert_array_equal(np.flatnonzero(state.collided), [0])


def test_red_light_the_ego_stands_in_is_ignored_from_then_on():
    # The connector is 6 m long, the ego 5.2 m: its box is inside while the rear axle is at 201.4.
    raw = roads.road(ego_x=201.4, speed=4.0, red=(0, 1))
    scene = roads.scene_of(raw)
    state = roads.init(scene, PDM.params, config=PDM.config)
    given = roads.observe(scene, 0)
    result, state, ego = roads.advance(scene, given, state, PDM.params, config=PDM.config)
    assert np.sum(np.asarray(state.passed_lights)) == 1
    assert float(result.trajectory.x[-1]) > 30
    moved = given.replace(ego=ego)
    for _ in range(5):
        result, state, ego = roads.advance(scene, moved, state, PDM.params, config=PDM.config)
        moved = moved.replace(ego=ego)
    assert float(result.trajectory.x[-1]) > 30  # though the rear is still in the connector


def test_paths_are_kept_and_never_rebuilt():
    raw = roads.road(ego_y=0.0, ego_lane=0)
    scene = roads.scene_of(raw)
    state = roads.init(scene, PDM.params, config=PDM.config)
    other = roads.observe(roads.scene_of(roads.road()), 0)  # now in the other lane
    _, following, _ = roads.advance(scene, other, state, PDM.params, config=PDM.config)
    for one, two in zip(
        jax.tree.leaves((state.paths, state.goal, state.slot)),
        jax.tree.leaves((following.paths, following.goal, following.slot)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, two)


def test_lane_that_ends_stops_the_ego():
    poses, results = roads.drive(roads.lane_end(length=90.0), PDM, 150)
    end = roads.EGO_X + 90.0
    assert np.all(np.diff(poses[:, 0]) > -1e-3)
    assert poses[-1, 3] < 0.1
    # It stops at the end of its lane, its centre not beyond.
    assert end - 15 < poses[-1, 0] < end - 1.461
    np.testing.assert_allclose(poses[:, 1], -3.5, atol=1e-6)
    assert not any(bool(result.overflow) for result in results)


@pytest.mark.parametrize(
    "mode, agents, moves",
    [("constant_velocity", 2, True), ("none", 0, False), ("perfect", 2, True)],
)
def test_forecast_modes(mode: str, agents: int, moves: bool):
    """What each mode makes of a car that leaves the recording after 2 s, and a cone."""
    car = roads.Thing(roads.EGO_X + 30, -3.5, speed=3.0, until=20)
    walker = roads.Thing(roads.EGO_X + 20, 5.0, speed=1.0, type=int(ObjectType.PEDESTRIAN))
    cone = roads.Thing(roads.EGO_X + 35, 0.0, type=int(ObjectType.TRAFFIC_CONE))
    scene = roads.scene_of(roads.road(things=[car, walker, cone]))
    config = dataclasses.replace(PDM.config, forecast=mode)
    state = roads.init(scene, PDM.params, config=PDM.config)
    params = jax.tree.map(jnp.asarray, PDM.params)
    forecast = _see(scene, roads.observe(scene, 0), state, params, config=config).forecast
    valid, kind = np.asarray(forecast.valid), np.asarray(forecast.type)
    assert np.sum(valid & np.asarray(forecast.is_agent)) == agents
    assert np.sum(valid & (kind == ObjectType.TRAFFIC_CONE)) == 1
    if moves:
        row = int(np.flatnonzero(valid & (np.asarray(forecast.track) == 0))[0])
        samples = 11 if mode == "perfect" else 41
        np.testing.assert_array_equal(forecast.sample_valid[row], np.arange(41) < samples)
        np.testing.assert_allclose(np.diff(np.asarray(forecast.x)[row, :samples]), 0.6, atol=1e-9)


def test_too_small_buffer_is_reported():
    scene = roads.scene_of(roads.road())
    small = PlannerConfig(max_path_points=64)
    assert bool(roads.init(scene, PDM.params, config=small).overflow)
    assert not bool(roads.init(scene, PDM.params, config=PDM.config).overflow)
