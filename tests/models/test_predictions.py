"""What takes the place of a network's predictions: the record, reactions to a plan, zeros."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from small_road import EGO_X, LANE_WIDTH, NUM_HISTORY, Thing, observe, road, scene_of
from spdm_jax.agents.forecast import ForecastPoses
from spdm_jax.types import EgoState, ObjectType
from spdm_models.predictions import drive_states, futures_of, logged_futures, reacting_futures
from spdm_models.scene_features import FeatureConfig, pick_neighbors, recorded_history

STEPS, COUNT = 40, 4
LEAD = Thing(EGO_X + 20, -LANE_WIDTH, speed=8.0, id="lead")
LEAVER = Thing(EGO_X + 30, 0.0, speed=5.0, id="leaver", until=10)
WALKER = Thing(
    EGO_X + 10, 4.0, speed=1.0, heading=-np.pi / 2, type=int(ObjectType.PEDESTRIAN), length=0.5
)


@pytest.fixture(scope="module")
def scene():
    return scene_of(road(things=[LEAD, LEAVER, WALKER], ego_heading=0.2))


def sight(scene, iteration=0):
    given = observe(scene, iteration)
    return given, pick_neighbors(recorded_history(scene, iteration), FeatureConfig(neighbors=COUNT))


def rows_of(scene, neighbors) -> dict[str, int]:
    """Neighbours by where they stand in the scene's table, which is the order of the things."""
    names = ("lead", "leaver", "walker")
    return {names[t]: i for i, t in enumerate(np.asarray(neighbors.track)[:3].tolist())}


def in_scene(futures: np.ndarray, ego: EgoState) -> np.ndarray:
    """Poses of the ego frame in the scene's."""
    cos, sin = np.cos(float(ego.heading)), np.sin(float(ego.heading))
    x, y, heading = np.moveaxis(futures, -1, 0)
    placed = ego.x + cos * x - sin * y, ego.y + sin * x + cos * y, ego.heading + heading
    return np.stack(placed, axis=-1)


def expected(scene, thing: Thing, ahead: np.ndarray, iteration: int) -> np.ndarray:
    """A thing keeps its velocity."""
    seconds = 0.1 * (iteration + ahead)
    way = thing.speed * seconds
    x = thing.x + way * np.cos(thing.heading) - (EGO_X + 0.0)
    y = thing.y + way * np.sin(thing.heading)
    return np.stack([x, y, np.full_like(x, thing.heading)], axis=-1)


@pytest.mark.parametrize("iteration", [0, 5])
def test_the_record_is_read_in_the_frame_of_the_ego_now(scene, iteration):
    given, neighbors = sight(scene, iteration)
    # The ego of a closed loop is not where the record has it.
    elsewhere = given.ego.replace(x=given.ego.x + 3, heading=given.ego.heading - 0.7)
    given = given.replace(ego=elsewhere)
    found = np.asarray(logged_futures(scene, given, neighbors, COUNT, STEPS))
    assert found.shape == (COUNT, STEPS, 3)
    placed = in_scene(found, elsewhere)
    begin = observe(scene, 0).ego
    ahead = np.arange(1, STEPS + 1)
    rows = rows_of(scene, neighbors)
    for name, thing in (("lead", LEAD), ("leaver", LEAVER), ("walker", WALKER)):
        wanted = expected(scene, thing, ahead, iteration)
        wanted[:, 0] += float(begin.x)
        wanted[:, 1] += float(begin.y) + LANE_WIDTH
        np.testing.assert_allclose(placed[rows[name]], wanted, atol=1e-6)
    assert not found[3].any()


def test_at_the_end_of_the_record_everyone_goes_on(scene):
    given, neighbors = sight(scene)
    last = scene.tracks.x.shape[1] - 1
    late = given.replace(observation=given.observation.replace(step=jnp.int32(NUM_HISTORY + 90)))
    assert NUM_HISTORY + 90 + STEPS > last
    found = np.asarray(logged_futures(scene, late, neighbors, COUNT, STEPS))
    lead = in_scene(found, given.ego)[rows_of(scene, neighbors)["lead"]]
    np.testing.assert_allclose(np.diff(lead[:, 0]), 0.8, atol=1e-6)


def test_reactions_are_asked_for_beside_each_plan_and_read_every_tenth_second(scene):
    given, neighbors = sight(scene)
    ego = given.ego
    time = 0.1 * np.arange(1, STEPS + 1)
    plans = np.stack(
        [np.stack([speed * time, 0 * time, 0 * time], axis=-1) for speed in (4.0, 10.0)]
    )
    asked: list[EgoState] = []

    def react(states: EgoState) -> ForecastPoses:
        """Track k follows the ego at 10 k m, and its heading passes from pi to -pi."""
        asked.append(states)
        tracks = jnp.arange(scene.tracks.type.shape[0])[None, :, None]
        shape = (2, tracks.shape[1], 41)
        sample = jnp.minimum(2 * jnp.arange(41), STEPS)
        x = states.x[:, None, sample] - 10.0 * tracks
        y = jnp.broadcast_to(states.y[:, None, sample], shape)
        turn = jnp.broadcast_to(3.1 + 0.01 * jnp.arange(41), shape)
        heading = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
        return ForecastPoses(x, y, heading, jnp.ones(shape, bool))

    found = reacting_futures(react, ego, jnp.asarray(plans), neighbors, COUNT)
    assert found.shape == (2, COUNT, STEPS, 3)
    (states,) = asked
    assert states.x.shape == (2, STEPS + 1)
    np.testing.assert_allclose(states.x[:, 0], float(ego.x))
    np.testing.assert_allclose(states.vx[:, 0], float(ego.vx))
    np.testing.assert_allclose(states.vx[:, 1:], [[4.0] * STEPS, [10.0] * STEPS], atol=1e-6)
    for plan in range(2):
        placed = in_scene(np.asarray(found[plan]), ego)
        for row, track in enumerate(np.asarray(neighbors.track)[:3].tolist()):
            wanted = np.asarray(states.x[plan, 1:]) - 10.0 * track
            np.testing.assert_allclose(placed[row, :, 0], wanted, atol=1e-6)
            turned = placed[row, :, 2] - (3.1 + 0.005 * np.arange(1, STEPS + 1))
            np.testing.assert_allclose(np.sin(turned), 0, atol=1e-6)
            assert np.all(np.cos(turned) > 0)
    assert not np.asarray(found[:, 3]).any()


def test_who_is_gone_goes_on_as_before():
    scene = scene_of(road(things=[LEAD]))
    given, neighbors = sight(scene)

    def react(states: EgoState) -> ForecastPoses:
        shape = (1, scene.tracks.type.shape[0], 41)
        x = jnp.broadcast_to(given.ego.x + 20 + 1.6 * jnp.arange(41), shape)
        valid = jnp.broadcast_to(jnp.arange(41) < 5, shape)
        return ForecastPoses(jnp.where(valid, x, 0), 0 * x, 0 * x, valid)

    plan = jnp.zeros((1, STEPS, 3))
    found = reacting_futures(react, given.ego, plan, neighbors, 1)
    np.testing.assert_allclose(np.diff(found[0, 0, :, 0]), 0.8, atol=1e-6)


def test_kinds_of_prediction(scene):
    given, neighbors = sight(scene)
    ask = lambda kind: futures_of(kind, scene, given, neighbors, COUNT, STEPS)
    assert ask("learned") is None
    plans = jnp.zeros((3, 20, 3))
    none, perfect = ask("none"), ask("perfect")
    assert none is not None and perfect is not None
    assert none(plans).shape == perfect(plans).shape == (3, COUNT, 20, 3)
    assert not np.asarray(none(plans)).any()
    logged = logged_futures(scene, given, neighbors, COUNT, STEPS)
    np.testing.assert_array_equal(perfect(plans)[2], logged[:, :20])


def test_states_of_a_drive_turn_with_the_ego(scene):
    ego = observe(scene, 0).ego
    states = drive_states(ego, jnp.asarray([[[1.0, 0.0, 0.1]]]))
    moved = jax.tree.map(lambda v: v[0, 1], states)
    np.testing.assert_allclose(moved.x - ego.x, np.cos(0.2), atol=1e-9)
    np.testing.assert_allclose(moved.y - ego.y, np.sin(0.2), atol=1e-9)
    np.testing.assert_allclose(moved.heading, 0.3, atol=1e-9)
