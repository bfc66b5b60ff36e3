"""Scripted runs: the goal, waiting pedestrians, stopped and cautious vehicles, policies."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import EGO_X, Thing
from spdm_jax.config import VehicleParams
from spdm_jax.geometry import box_at, ego_box
from spdm_jax.io.raw import RawScenario
from spdm_jax.simulation.agent_state import AgentParams, AgentSizes, road_facts
from spdm_jax.simulation.drivers import constant_velocity_driver
from spdm_jax.simulation.loop import (
    Run,
    SimulationConfig,
    SimulationParams,
    logged_objects,
    simulate,
)
from spdm_jax.simulation.placement import place_agents
from spdm_jax.simulation.script import AgentPolicy, Script, ego_reach, heeds_reach
from spdm_jax.types import ObjectType

pytestmark = pytest.mark.slow  # compiles several simulations

SAMPLES = 80
SIZES = AgentSizes(agents=8, replayed=8, path_points=401, outline_blocks=1)
CONFIG = SimulationConfig(num_samples=SAMPLES, traffic="reactive", sizes=SIZES)
TRACKS = roads.PADDING.tracks[0]
ORIGIN_Y = -4.0
LANE_0 = 0.0 - ORIGIN_Y
"""y of lane 0 in the local frame, whose origin is the ego's start rounded to metres."""
FRONT = 2.3


def script(
    *,
    goal: float = 1000.0,
    policy: AgentPolicy = AgentPolicy.ASSERTIVE,
    seed: int = 0,
    stopped: Sequence[int] = (),
    cautious: Sequence[int] = (),
    walker: int = -1,
    start: tuple[float, float] = (0.0, 0.0),
    stop: tuple[float, float] = (0.0, 0.0),
) -> Script:
    """A script; positions are relative to the ego's start."""
    flags = lambda rows: jnp.zeros(TRACKS, bool).at[jnp.asarray(rows, int)].set(True)
    pair = lambda point: jnp.array([point, (0.0, 0.0)])
    return Script(
        policy=jnp.int32(policy),
        seed=jnp.uint32(seed),
        stopped=flags(stopped),
        cautious=flags(cautious),
        track=jnp.array([walker, -1], jnp.int32),
        start=pair(start),
        stop=pair(stop),
        course=jnp.array([[0.0, 0.0], [600.0, 0.0], [600.0, 0.0]]),
        end=jnp.asarray(goal),
    )


@jax.jit
def _run(scene, script):
    driver, params = constant_velocity_driver(), SimulationParams()
    return simulate(scene, driver, params, CONFIG, script=script)


def run(raw: RawScenario, play: Script) -> Run:
    raw = dataclasses.replace(raw, num_iterations=SAMPLES + 1)
    result = _run(roads.scene_of(raw), play)
    assert not result.overflow and not result.failed
    return jax.tree.map(np.asarray, result)


def test_the_run_ends_before_the_step_past_the_goal():
    history = run(roads.road(speed=10.0), script(goal=21.5)).history
    # The centre is 1.461 m ahead of the rear axle and 1 m farther with every sample.
    centre = 1.461 + np.arange(SAMPLES)
    np.testing.assert_array_equal(history.valid, centre <= 21.5)
    np.testing.assert_allclose(
        history.ego.x[history.valid], centre[history.valid] - 1.461, atol=1e-6
    )
    assert np.isfinite(history.ego.x).all()


def test_a_pedestrian_waits_for_the_ego_and_bars_the_way():
    walker = Thing(EGO_X + 80.0, -3.5, type=int(ObjectType.PEDESTRIAN), until=-roads.NUM_STEPS)
    things = [walker, Thing(EGO_X, 0.0, speed=8.0)]
    play = script(walker=0, start=(80.0, LANE_0), stop=(80.0, LANE_0 - 1.0))
    history = run(roads.road(speed=10.0, things=things), play).history
    objects = history.objects
    # It sees the ego where it was a sample before.
    centre = 1.461 + np.arange(-1, SAMPLES - 1)
    near = np.abs(80.0 - centre) <= 50.0
    begins = int(np.argmax(near))
    np.testing.assert_array_equal(objects.valid[:, 0], np.arange(SAMPLES) >= begins)
    walked = (np.arange(SAMPLES) - begins) / (SAMPLES + 1)
    there = objects.valid[:, 0]
    np.testing.assert_allclose(objects.y[there, 0], LANE_0 - walked[there], atol=1e-9)
    assert not objects.vx[there, 0].any() and not objects.vy[there, 0].any()
    # The agent drives on freely until it is there, then brakes.
    assert np.all(np.diff(objects.vx[:begins, 1]) > 0)
    assert objects.vx[begins + 10, 1] < objects.vx[begins, 1]
    assert np.all(objects.x[there, 1] + FRONT < 80.0)


def test_stopped_vehicles_stay_where_they_are():
    things = [
        Thing(EGO_X + 60.0, 0.4, heading=0.2),  # on lane 0, across its line
        Thing(EGO_X + 63.0, 0.6),  # touches the first
        Thing(EGO_X + 20.0, 20.0),  # off all lanes
        Thing(EGO_X + 10.0, 0.0, speed=8.0),
    ]
    play = script(stopped=(0, 1, 2))
    objects = run(roads.road(speed=5.0, things=things), play).history.objects
    assert objects.valid[:, :4].all()
    for row, thing in enumerate(things[:3]):
        np.testing.assert_allclose(objects.x[:, row], thing.x - EGO_X, atol=1e-9)
        np.testing.assert_allclose(objects.y[:, row], thing.y - ORIGIN_Y, atol=1e-9)
        np.testing.assert_allclose(objects.heading[:, row], thing.heading, atol=1e-9)
        assert not objects.vx[:, row].any()
    assert np.all(objects.x[:, 3] + FRONT < 60.0 - FRONT + 0.1)
    assert objects.vx[-1, 3] < 2.5


def test_cautious_vehicles_take_the_ego_for_standing():
    raw = roads.road(speed=9.0, things=[Thing(EGO_X - 25.0, -3.5, speed=9.0)])
    usual, cautious = (
        run(raw, script(cautious=range(count))).history.objects.vx[:, 0] for count in (0, 1)
    )
    assert usual.min() > 7.0
    assert cautious[20] < usual[20] - 1.0


def _cutting_in(policy: AgentPolicy, seed: int = 0) -> np.ndarray:
    """Speed of a follower on lane 0, towards which the ego on lane 1 heads."""
    raw = roads.road(speed=2.0, ego_heading=0.2, things=[Thing(EGO_X - 15.0, 0.0, speed=9.0)])
    return run(raw, script(policy=policy, seed=seed)).history.objects.vx[:, 0]


def test_policies_for_an_ego_that_cuts_in():
    """The ego itself stays off the agent's corridor for a second; its reach does not."""
    assertive = _cutting_in(AgentPolicy.ASSERTIVE)
    mixed = _cutting_in(AgentPolicy.MIXED)
    cautious = _cutting_in(AgentPolicy.CAUTIOUS)
    at = 8
    assert assertive[at] > mixed[at] > cautious[at]
    np.testing.assert_array_equal(mixed, _cutting_in(AgentPolicy.MIXED))
    assert np.any(mixed != _cutting_in(AgentPolicy.MIXED, seed=1))


def test_who_heeds_the_reach():
    things = [
        Thing(180.0, 0.0),  # another roadblock
        Thing(212.0, -3.5),  # the ego's lane
        Thing(212.0, 0.0),  # beside it, behind
        Thing(240.0, 0.0),  # beside it, ahead
    ]
    scene = roads.scene_of(roads.road(ego_x=225.0, ego_heading=np.pi / 4, things=things))
    vehicle, params = VehicleParams(), AgentParams()

    @jax.jit
    def heeded(scene, play, speed, at_x):
        ego = jax.tree.map(lambda v: v[scene.num_history], scene.ego)
        objects = logged_objects(scene, scene.num_history)
        facts = road_facts(scene.map, SIZES)
        agents = place_agents(scene.map, facts, objects, ego, vehicle, params, SIZES).agents
        box = ego_box(ego, vehicle)._replace(x=at_x)
        reach = ego_reach(box, speed)
        return heeds_reach(play, agents, scene.map, box, reach, jnp.int32(3))[:4]

    asked = lambda policy, speed=4.0, at_x=1.0: heeded(
        scene, script(policy=policy), jnp.asarray(speed), jnp.asarray(at_x)
    ).tolist()
    assert asked(AgentPolicy.ASSERTIVE) == [True, False, False, False]
    assert asked(AgentPolicy.CAUTIOUS) == [True, False, True, False]
    assert asked(AgentPolicy.MIXED)[0::3] == [True, False]
    # An agent from elsewhere that the reach touches does not mind it.
    near = [Thing(198.0, 0.0)]
    scene = roads.scene_of(roads.road(ego_x=225.0, ego_heading=2.8, things=near))
    assert asked(AgentPolicy.CAUTIOUS, at_x=-15.0, speed=0.0)[0] is True
    assert asked(AgentPolicy.CAUTIOUS, at_x=-15.0, speed=4.0)[0] is False


@pytest.mark.parametrize("speed, front", [(0.0, 2.588), (10.0, 31.1485)])
def test_reach_of_the_ego(speed: float, front: float):
    box = box_at(3.0, 1.0, np.pi / 2, 2.588, 1.1485)
    reach = ego_reach(box, jnp.asarray(speed))
    assert reach.y + reach.half_length == pytest.approx(1.0 + front)
    assert reach.y - reach.half_length == pytest.approx(1.0 - 2.588)
    assert reach.x == pytest.approx(3.0) and reach.half_width == box.half_width


def test_single_precision():
    raw = roads.road(speed=10.0, things=[Thing(EGO_X + 30.0, 0.0, speed=8.0)])
    scene = roads.scene_of(dataclasses.replace(raw, num_iterations=SAMPLES + 1), jnp.float32)
    play = script(goal=21.5, policy=AgentPolicy.MIXED)
    play = jax.tree.map(lambda v: v.astype(jnp.float32) if v.dtype == jnp.float64 else v, play)
    history = _run(scene, play).history
    assert history.ego.x.dtype == history.objects.x.dtype == jnp.float32
    assert int(history.valid.sum()) == 21
