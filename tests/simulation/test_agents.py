"""Reactive traffic on a straight road: who drives, what they follow, where they stop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
from small_road import Thing
from spdm_jax.io.raw import RawArea, RawScenario
from spdm_jax.simulation.agent_state import AgentParams, AgentSizes
from spdm_jax.simulation.drivers import constant_velocity_driver
from spdm_jax.simulation.loop import Run, SimulationConfig, SimulationParams, simulate
from spdm_jax.types import ObjectType

SAMPLES = 80
SIZES = AgentSizes(agents=8, replayed=8, path_points=401, outline_blocks=1)
CONFIG = SimulationConfig(num_samples=SAMPLES, traffic="reactive", sizes=SIZES)
LENGTH = 4.6


@jax.jit
def _run(scene, params):
    return simulate(scene, constant_velocity_driver(), params, CONFIG)


def run(raw: RawScenario, radius: float = 1000.0) -> Run:
    raw = dataclasses.replace(raw, num_iterations=SAMPLES + 1)
    params = SimulationParams(agents=AgentParams(radius=radius))
    result = _run(roads.scene_of(raw), params)
    assert not result.overflow and not result.failed
    return jax.tree.map(np.asarray, result)


def far_road(**kwargs) -> RawScenario:
    """A road whose ego stands out of the way, on lane 1 at the start."""
    return roads.road(speed=0.0, ego_x=5.0, **kwargs)


def place(result: Run, row: int) -> np.ndarray:
    """Station of an object at each sample; the scene's origin is the ego's start."""
    return result.history.objects.x[:, row] + 5.0


def test_free_agent_follows_the_model():
    """With nothing ahead the path's end is a wall; a path loses the last point of its lane."""
    result = run(far_road(things=[Thing(40.0, 0.0, speed=10.0)]))
    x, v = 40.0, 10.0
    end = 200.0 - 200.0 / 119
    for i in range(30):
        assert place(result, 0)[i] == pytest.approx(x, abs=1e-9)
        assert result.history.objects.vx[i, 0] == pytest.approx(v, abs=1e-9)
        space = end - x - LENGTH / 2
        wanted = 1.0 + 1.5 * v + v * v / (2 * np.sqrt(2.0))
        accel = np.clip(1 - (v / roads.LIMIT) ** 4 - (wanted / space) ** 2, -2, 1)
        x, v = x + 0.1 * v, max(v + 0.1 * accel, 0)
    assert result.history.objects.valid[:, 0].all()


def test_path_goes_on_beyond_its_lane():
    result = run(far_road(things=[Thing(130.0, 0.0, speed=12.0)]))
    assert result.history.objects.valid[:, 0].all()
    assert place(result, 0)[-1] > 205.0
    assert np.min(result.history.objects.vx[:, 0]) > 9.0


def test_agent_stops_behind_what_stands():
    cone = Thing(90.0, 0.2, type=int(ObjectType.TRAFFIC_CONE), length=0.5, width=0.5)
    beside = Thing(60.0, -3.5, speed=10.0)
    result = run(far_road(things=[Thing(60.0, 0.0, speed=10.0), cone, beside]))
    objects = result.history.objects
    gap = 90.0 - 0.25 - LENGTH / 2 - place(result, 0)
    assert np.all(gap > 0.2) and gap[-1] < 4.0
    assert objects.vx[-1, 0] < 0.3
    assert objects.vx[-1, 2] > 10.0


def test_agents_follow_each_other():
    things = [Thing(30.0 + 12.0 * i, 0.0, speed=8.0 - 2.0 * i) for i in range(3)]
    result = run(far_road(things=things))
    stations = np.stack([place(result, i) for i in range(3)], 1)
    assert np.all(np.diff(stations, axis=1) > LENGTH)


def test_agents_see_the_ego():
    raw = roads.road(speed=0.0, things=[Thing(roads.EGO_X - 40.0, -3.5, speed=10.0)])
    result = run(raw)
    rear = -1.127  # of the ego's box, from its rear axle in the origin
    gap = rear - LENGTH / 2 - result.history.objects.x[:, 0]
    assert np.all(gap > 0.2) and gap[-1] < 4.0


@pytest.mark.slow
def test_who_drives_and_who_vanishes():
    things = [
        Thing(60.0, 0.3, speed=5.0),  # is put onto its baseline
        Thing(100.0, -3.5, speed=1.0, type=int(ObjectType.BICYCLE)),
        Thing(150.0, -3.5, speed=1.0, heading=np.pi / 2, type=int(ObjectType.PEDESTRIAN)),
        Thing(80.0, 20.0),  # parked off the road
        Thing(62.0, -0.3, speed=5.0),  # overlaps the first once both are on the baseline
    ]
    raw = far_road(things=things)
    result = run(raw)
    objects = result.history.objects
    np.testing.assert_array_equal(
        objects.valid[:, :5], [[True, False, True, False, False]] * SAMPLES
    )
    np.testing.assert_allclose(objects.y[:, 0] - objects.y[0, 0], 0, atol=1e-9)
    walked = objects.y[:, 2] - objects.y[0, 2]
    np.testing.assert_allclose(walked, 0.1 * np.arange(SAMPLES), atol=1e-9)


def test_far_agents_leave_for_good():
    things = [Thing(60.0, 0.0, speed=12.0), Thing(90.0, -3.5)]
    result = run(far_road(things=things), radius=60.0)
    valid = result.history.objects.valid
    # The ego's centre is 1.461 m ahead of its rear axle.
    outside = place(result, 0) - 5.0 - 1.461 > 60.0
    first = int(np.argmax(~valid[:, 0]))
    assert 0 < first and outside[first - 1] and not outside[first - 2]
    assert not valid[first:, 0].any()
    np.testing.assert_array_equal(valid[:, 1], np.arange(SAMPLES) == 0)


@pytest.mark.parametrize("stop_line", [False, True])
def test_red_light_stops(stop_line: bool):
    """Either the route ends before the red connector, or a stop polygon bars the way."""
    raw = far_road(things=[Thing(160.0, 0.0, speed=10.0)], red=(0,))
    lane = raw.map.lanes["c0/0"]
    bar = 199.0
    if stop_line:
        # Green until the agent has taken the connector into its route.
        lights = [{"c0/0": 1 if i < 5 else 3} for i in range(roads.NUM_STEPS)]
        lane = dataclasses.replace(lane, stop_line="bar", has_traffic_light=True)
        raw.map.stop_lines.append(RawArea("bar", roads.shapely.box(bar, -1.5, bar + 1, 1.5)))
        raw = dataclasses.replace(raw, lights=lights)
    raw.map.lanes["c0/0"] = lane
    result = run(raw)
    front = place(result, 0) + LENGTH / 2
    assert np.max(front) < bar
    assert front[-1] > bar - 6.0
    assert result.history.objects.vx[-1, 0] < 1.5


def test_missing_limits_take_the_agent_before():
    """The first agent falls back on 10 m/s, as published."""
    result = run(far_road(things=[Thing(30.0, 0.0, speed=9.9)], limit=None))
    speed = result.history.objects.vx[:, 0]
    assert np.all(speed < 10.0)


def test_a_road_without_objects():
    assert not run(far_road()).history.objects.valid.any()


def test_more_agents_than_room_is_overflow():
    things = [Thing(30.0 + 15.0 * i, 0.0, speed=5.0) for i in range(9)]
    raw = dataclasses.replace(far_road(things=things), num_iterations=SAMPLES + 1)
    assert _run(roads.scene_of(raw), SimulationParams()).overflow


@pytest.mark.slow
def test_batches_repeat_single_runs():
    raws = [
        far_road(things=[Thing(60.0, 0.0, speed=10.0), Thing(90.0, 0.0, speed=2.0)]),
        far_road(things=[Thing(40.0, -3.5, speed=3.0)]),
    ]
    scenes = [roads.scene_of(dataclasses.replace(raw, num_iterations=SAMPLES + 1)) for raw in raws]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    batched = jax.jit(jax.vmap(_run, in_axes=(0, None)))(both, SimulationParams())
    for i, scene in enumerate(scenes):
        alone = _run(scene, SimulationParams()).history.objects
        ours = jax.tree.map(lambda leaf, i=i: leaf[i], batched.history.objects)
        np.testing.assert_array_equal(ours.valid, alone.valid)
        for name in ("x", "y", "heading", "vx"):
            mine = np.where(ours.valid, getattr(ours, name), 0)
            theirs = np.where(alone.valid, getattr(alone, name), 0)
            np.testing.assert_allclose(mine, theirs, atol=1e-9)
