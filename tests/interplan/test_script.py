"""What happens during a run: waiting pedestrians and the end at the goal."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import road
from spdm_jax.interplan.modification_file import modifications_from
from spdm_jax.interplan.modify import modify
from spdm_jax.interplan.script import script_of
from spdm_jax.io.build import build_scenario
from spdm_jax.simulation.script import AgentPolicy, Script, past_goal, walkers_at

TOKEN = "0123456789abcdef"
SPECIAL = {
    "type": "jaywalking_pedestrian",
    "config": "dloc",
    "stopped_vehicle": [[100.0, 5.0, 0.0]],
    "pedestrian": [
        [130.0, 5.0, 130.0, -10.0, None],
        [240.0, 5.0, 240.0, -10.0, None],
        [120.0, 5.0, 120.0, -10.0, 7],
    ],
}
FILE = {TOKEN: {"special_scenario": {"0": SPECIAL}, "extra_agents_to_spawn": [[150.0, 1.0, 0]]}}
CHANGES = modifications_from({"modification_details_dictionary": FILE}).changes(f"{TOKEN}-s0")
RAW, EXTRAS = modify(road(), CHANGES)
SCENE, INFO = build_scenario(RAW)
ROOM = {"num_tracks": 64, "num_pedestrians": 4, "num_points": 32}


def script(dtype=jnp.float64) -> Script:
    made = script_of(EXTRAS, INFO.track_ids, SCENE.origin, **ROOM)
    return jax.tree.map(lambda v: jnp.asarray(v, dtype if v.dtype == np.float64 else v.dtype), made)


def test_script():
    made = script()
    assert made.policy == AgentPolicy.CAUTIOUS
    ids = np.array(INFO.track_ids)
    assert ids[np.flatnonzero(made.stopped)].tolist() == list(EXTRAS.stopped)
    assert ids[np.flatnonzero(made.cautious)].tolist() == list(EXTRAS.cautious)
    assert [ids[row] for row in made.track[:2]] == ["pedestrian-0", "pedestrian-1"]
    assert made.track[2:].tolist() == [-1, -1]
    assert np.allclose(made.start[0] + SCENE.origin, [130.0, 5.0])


@pytest.mark.parametrize("name", list(ROOM))
def test_script_needs_room(name: str):
    with pytest.raises(ValueError, match=f"{TOKEN}-s0: .* do not fit into 1"):
        script_of(EXTRAS, INFO.track_ids, SCENE.origin, **ROOM | {name: 1})


def test_script_needs_the_tracks():
    strange = dataclasses.replace(EXTRAS, stopped=("nobody",))
    with pytest.raises(ValueError, match="has no track \\['nobody'\\]"):
        script_of(strange, INFO.track_ids, SCENE.origin, **ROOM)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_run_ends_at_the_goal(dtype):
    made = script(dtype)
    ends = jax.jit(past_goal)
    # The recorded drive covers 19 m; its goal is the last pose of the rear axle.
    goal = 60.0 + 19.0 - float(SCENE.origin[0])
    y = jnp.asarray(-3.5 - SCENE.origin[1], dtype)
    for x, ended in ((goal - 0.2, False), (goal - 0.05, True), (goal + 30, True), (-99, False)):
        assert bool(ends(made, jnp.asarray(x, dtype), y)) is ended


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_pedestrians_wait_for_the_ego(dtype):
    made = script(dtype)
    scene_map = jax.tree.map(
        lambda v: jnp.asarray(v, dtype if v.dtype == np.float64 else v.dtype), SCENE.map
    )
    move = jax.jit(walkers_at)

    def at(began, x, iteration, y=-3.5):
        place = jnp.asarray([x, y], dtype) - jnp.asarray(SCENE.origin, dtype)
        return move(made, began, scene_map, *place, jnp.int32(iteration), jnp.int32(300))

    began = jnp.full(4, -1, jnp.int32)
    far = at(began, 79.0, 3)
    assert not far.present.any() and far.began.tolist() == [-1] * 4
    near = at(far.began, 81.0, 4)
    assert near.present.tolist() == [True, False, False, False]
    assert near.began[0] == 4 and near.x.dtype == dtype
    assert np.allclose(near.y[0] + SCENE.origin[1], 5.0)
    # 15 m within 154 iterations, however far the ego is by then.
    later = at(near.began, 20.0, 81)
    assert later.present[0] and np.isclose(later.y[0] + SCENE.origin[1], 5.0 - 7.5, atol=1e-5)
    done = at(near.began, 81.0, 290)
    assert np.isclose(done.y[0] + SCENE.origin[1], -10.0, atol=1e-5)
    # Beyond the ego's lane the way to its end is added: 200 m, then 40 m on and 5 m beside.
    end = np.hypot(40.0, 5.0 + 3.5)
    assert not at(began, 200.0 - (50.5 - end), 3).present[1]
    assert at(began, 200.0 - (49.5 - end), 3).present[1]
    # Off all lanes nobody begins.
    assert not at(began, 130.0, 3, y=30.0).present.any()


def test_pedestrian_near_at_the_start_begins_with_the_next_iteration():
    made = script()
    scene_map = jax.tree.map(jnp.asarray, SCENE.map)
    place = jnp.asarray([100.0, -3.5]) - SCENE.origin
    move = jax.jit(walkers_at)
    state = jnp.full(4, -1, jnp.int32)
    seen = []
    for i in range(4):
        found = move(made, state, scene_map, *place, jnp.int32(i), jnp.int32(300))
        state = found.began
        seen.append((bool(found.present[0]), float(found.y[0] + SCENE.origin[1])))
    assert [here for here, _ in seen] == [True] * 4
    step = 15.0 / 151
    assert np.allclose([y for _, y in seen], [5.0, 5.0, 5.0 - step, 5.0 - 2 * step])
