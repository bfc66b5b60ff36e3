"""IDM + MOBIL: when the ego changes lane, and when it does not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import EGO_X, Thing
from spdm_jax.io.raw import RawScenario
from spdm_jax.simulation.agent_state import AgentParams
from spdm_jax.simulation.idm_driver import idm_params
from spdm_jax.simulation.loop import Run, SimulationConfig, SimulationParams, simulate
from spdm_jax.simulation.mobil_driver import (
    Neighbours,
    changes_to_goal,
    mobil_driver,
    mobil_gain,
)

pytestmark = pytest.mark.slow  # compiles several simulations

SAMPLES = 98
DRIVER = mobil_driver(max_path_points=512)
WIDTH = roads.LANE_WIDTH


@jax.jit
def _run(scene):
    return simulate(scene, DRIVER, SimulationParams(), SimulationConfig(num_samples=SAMPLES))


def drive(raw: RawScenario) -> Run:
    """Runs a scene; y is moved so that the ego starts at 0 and the lane to its left is at 3.5."""
    longer = dataclasses.replace(raw, num_iterations=SAMPLES + 1)
    result = jax.tree.map(np.asarray, _run(roads.scene_of(longer)))
    assert not result.failed and not result.overflow
    ego = result.history.ego
    return result.replace(history=result.history.replace(ego=ego.replace(y=ego.y - ego.y[0])))


SLOW = Thing(EGO_X + 25.0, -WIDTH, speed=3.0)


def test_overtakes_a_slow_leader():
    ego = drive(roads.road(speed=8.0, things=[SLOW])).history.ego
    assert abs(ego.y[-1] - WIDTH) < 0.5
    assert ego.vx[-1] > 8.0
    assert np.max(np.abs(np.diff(ego.heading))) < 0.05


def test_stays_where_nobody_is_in_the_way():
    ego = drive(roads.road(speed=8.0)).history.ego
    np.testing.assert_allclose(ego.y, 0, atol=1e-6)


def test_stays_behind_a_slow_leader_where_the_new_follower_would_brake_hard():
    """A queue of fast followers passes; none of them leaves a gap."""
    queue = [Thing(EGO_X - 8.0 - 9.0 * i, 0.0, speed=12.0) for i in range(3)]
    result = drive(roads.road(speed=6.0, things=[SLOW, *queue]))
    ego, objects = result.history.ego, result.history.objects
    beside = objects.x[:, 3] < ego.x  # until the last of the queue has passed
    assert 10 < beside.sum() < SAMPLES - 20
    assert np.all(np.abs(ego.y[beside]) < 0.5)
    assert ego.y[-1] > 0.8 * WIDTH


def test_stays_where_the_other_lane_leaves_the_route():
    raw = roads.road(speed=8.0, things=[SLOW], blocks=((0, 1), (1,)))
    ego = drive(raw).history.ego
    np.testing.assert_allclose(ego.y, 0, atol=1e-6)


def test_no_change_towards_what_stands():
    standing = Thing(EGO_X + 30.0, 0.0)
    ego = drive(roads.road(speed=8.0, things=[SLOW, standing])).history.ego
    passed = ego.x + roads.FRONT > 30.0 + 2.3
    assert np.all(np.abs(ego.y[~passed]) < 0.3)


def test_follows_the_route_to_another_lane_and_slows_down_for_a_gap():
    """The ego's lane ends; nobody is in its way, but once somebody drives beside it."""
    free = drive(roads.lane_end(speed=8.0, length=120.0)).history.ego
    assert abs(free.y[-1] - WIDTH) < 0.5
    beside = Thing(EGO_X, 0.0, speed=10.0)
    raw = roads.lane_end(speed=8.0, length=120.0)
    pushed = dataclasses.replace(raw, tracks=roads.road(things=[beside]).tracks)
    ego = drive(pushed).history.ego
    assert free.vx[12] > 8.0 > 7.7 > ego.vx[12]
    assert abs(ego.y[-1] - WIDTH) < 0.5


def test_the_goal_side_comes_first():
    """Three lanes, the goal on the right one: overtaking on the left would be as fast."""
    raw = roads.road(
        speed=8.0,
        ego_lane=1,
        blocks=((0, 1, 2), (0, 1, 2)),
        things=[Thing(EGO_X + 25.0, -WIDTH, speed=3.0)],
    )
    left = drive(raw).history.ego.y[-1]
    goal = np.array([400.0, -2 * WIDTH, 0.0])
    right = drive(dataclasses.replace(raw, mission_goal=goal)).history.ego.y[-1]
    assert left == pytest.approx(WIDTH, abs=0.5)
    assert right == pytest.approx(-WIDTH, abs=0.5)


def test_changes_to_goal():
    raw = roads.road(blocks=((0, 1, 2), (1, 2)))
    scene = roads.scene_of(raw)
    lanes = scene.map.lanes
    rows = {key: i for i, key in enumerate(raw.map.lanes)}
    goal = np.zeros(lanes.valid.shape, bool)
    goal[rows["b1/2"]] = True
    found = jax.jit(changes_to_goal)(lanes, lanes.valid, jnp.asarray(goal))
    counts = {key: int(found[row]) for key, row in rows.items()}
    assert counts == {
        **{"b0/0": 2, "b0/1": 1, "b0/2": 0},
        **{"c0/1": 1, "c0/2": 0, "b1/1": 1, "b1/2": 0},
    }
    away = jax.jit(changes_to_goal)(lanes, lanes.valid & ~jnp.asarray(goal), jnp.asarray(goal))
    assert int(away[rows["b1/2"]]) == 0


NOBODY = np.inf


@pytest.mark.parametrize(
    "here, there, better, safe",
    [
        # A slow leader here, nobody there.
        ((20.0, 4.0, NOBODY, 0.0), (NOBODY, 0.0, NOBODY, 0.0), True, True),
        # Nobody anywhere: nothing to gain.
        ((NOBODY, 0.0, NOBODY, 0.0), (NOBODY, 0.0, NOBODY, 0.0), False, True),
        # A fast follower close behind there.
        ((20.0, 4.0, NOBODY, 0.0), (NOBODY, 0.0, 6.0, 13.0), False, False),
        # Someone beside.
        ((20.0, 4.0, NOBODY, 0.0), (NOBODY, 0.0, -1.0, 0.0), True, False),
        # A leader there that stands too close.
        ((20.0, 4.0, NOBODY, 0.0), (9.0, 0.0, NOBODY, 0.0), False, False),
    ],
)
def test_gain(here, there, better: bool, safe: bool):
    make = lambda values: Neighbours(*map(jnp.asarray, values))
    params: AgentParams = idm_params()
    gain, is_safe = mobil_gain(
        jnp.asarray(8.0),
        jnp.asarray(5.2),
        jnp.asarray(13.4),
        make(here),
        make(there),
        params,
        jnp.asarray(0.5),
    )
    assert bool(gain > 0.2) is better
    assert bool(is_safe) is safe


def test_polite_to_who_follows():
    """The old follower gains by the change, the new one loses; both weigh by politeness."""
    make = lambda *values: Neighbours(*map(jnp.asarray, values))
    speed, length, target = (jnp.asarray(v) for v in (8.0, 5.2, 13.4))
    free = make(NOBODY, 0.0, NOBODY, 0.0)
    judge = lambda here, there, politeness: float(
        mobil_gain(speed, length, target, here, there, idm_params(), jnp.asarray(politeness))[0]
    )
    behind = make(NOBODY, 0.0, 25.0, 10.0)
    selfish = judge(behind, free, 0.0)
    assert judge(behind, free, 1.0) > selfish
    assert judge(behind, free, 0.5) == pytest.approx(
        0.5 * (selfish + judge(behind, free, 1.0)), abs=1e-9
    )
    assert judge(free, behind, 1.0) < judge(free, behind, 0.0)


@pytest.mark.slow
def test_single_precision():
    raw = dataclasses.replace(roads.road(speed=8.0, things=[SLOW]), num_iterations=SAMPLES + 1)
    ego = _run(roads.scene_of(raw, jnp.float32)).history.ego
    assert ego.x.dtype == jnp.float32
    assert abs(float(ego.y[-1] - ego.y[0]) - WIDTH) < 0.5
