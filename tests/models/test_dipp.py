"""DIPP's network and losses on made-up scenes: masks, padding, degenerate inputs, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_models import dipp
from spdm_models.dipp import DIPPConfig, DIPPFeatures
from spdm_models.dipp_losses import future_loss, motion_metrics, planner_loss
from spdm_models.dipp_planner import DIPPPlannerConfig
from spdm_models.state_dict import flatten, from_state_dict, to_state_dict

NEIGHBORS, HISTORY, LANES, CROSSWALKS, POINTS = 3, 4, 2, 1, 3
STEPS = 10
CONFIG = DIPPConfig(width=8, horizon=STEPS)
PLANNER = DIPPPlannerConfig(horizon=STEPS, safety_steps=(0, 4, 9))
ROWS = 260


def make_features(seed: int, neighbors: int = NEIGHBORS) -> DIPPFeatures:
    """One scene; neighbours beyond the given number are missing."""
    random = np.random.default_rng(seed)
    ego = random.normal(size=(HISTORY, 8))
    ego[-1, :3], ego[:, 5:] = 0, (5, 2, 1.5)
    others = random.normal(size=(NEIGHBORS, HISTORY, 9)) * 5
    others[..., 5:8], others[..., 8] = (4.5, 2, 1.6), np.arange(1, NEIGHBORS + 1)[:, None]
    others[neighbors:] = 0
    lanes = random.normal(size=(1 + NEIGHBORS, LANES, POINTS, 17))
    lanes[..., 10:] = random.integers(0, 2, size=lanes[..., 10:].shape)
    crosswalks = random.normal(size=(1 + NEIGHBORS, CROSSWALKS, POINTS, 3))
    lanes[1 + neighbors :], crosswalks[1 + neighbors :] = 0, 0
    return DIPPFeatures(
        ego=ego.astype(np.float32),
        neighbors=others.astype(np.float32),
        map_lanes=lanes.astype(np.float32),
        map_crosswalks=crosswalks.astype(np.float32),
    )


def make_path(limit: float = 8.0) -> np.ndarray:
    path = np.zeros((ROWS, 5), np.float32)
    path[:, 0] = 0.1 * (np.arange(ROWS) - 200)
    path[:, 4] = limit
    return path


def make_truth(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(1 + NEIGHBORS, STEPS, 3)).astype(np.float32)


def stack(*trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


@pytest.fixture(scope="module")
def params():
    """Weights without compiling the program that draws them."""
    random = np.random.default_rng(0)
    draw = lambda leaf: (0.3 * random.normal(size=leaf.shape)).astype(np.float32)
    return jax.tree.map(draw, dipp.abstract_params(CONFIG))


@pytest.fixture(scope="module")
def forward(params):
    compiled = jax.jit(dipp.apply, static_argnums=1)
    return lambda features: jax.tree.map(
        np.asarray, compiled(params, CONFIG, jax.tree.map(jnp.asarray, features))
    )


@pytest.fixture(scope="module")
def train(params):
    """Loss with the planner in the loop and its gradients, for batches of two."""

    def loss(params, features, path, truth):
        output = dipp.apply(params, CONFIG, features)
        now = features.ego[:, -1], features.neighbors[:, :, -1]
        parts = planner_loss(output, *now, path, truth, PLANNER)
        return parts.total, (parts, output)

    compiled = jax.jit(jax.value_and_grad(loss, has_aux=True))
    path, truth = np.stack([make_path()] * 2), np.stack([make_truth(0), make_truth(1)])

    def call(*features):
        (_, (parts, output)), gradients = compiled(params, stack(*features), path, truth)
        return jax.tree.map(np.asarray, (parts, output, flatten(gradients)))

    return call


def test_batch_neighbours_change_nothing(forward):
    scenes = [make_features(i) for i in range(3)]
    one = forward(stack(scenes[0], scenes[1]))
    other = forward(stack(scenes[2], scenes[0]))
    for a, b in (
        (one.controls[0], other.controls[1]),
        (one.predictions[0], other.predictions[1]),
        (one.scores[0], other.scores[1]),
    ):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_missing_neighbours_and_map_elements_are_ignored(forward):
    clean, dirty = make_features(0, neighbors=2), make_features(0, neighbors=2)
    dirty.neighbors[2, :, :7] = 9.0
    # Height and type stay 0; an element whose first x is 0 is none.
    dirty.map_lanes[0, 1, :, 1:10], clean.map_lanes[0, 1] = 7.0, 0
    dirty.map_lanes[0, 1, 0, 0] = 0
    dirty.map_lanes[0, 1, :, 10:] = 0
    one, other = forward(stack(clean, clean)), forward(stack(dirty, dirty))
    for a, b in (
        (one.controls, other.controls),
        (one.predictions[:, :, :2], other.predictions[:, :, :2]),
        (one.encoding.agent_agent[:, :3], other.encoding.agent_agent[:, :3]),
        (one.encoding.agent_map[:, :, :3], other.encoding.agent_map[:, :, :3]),
    ):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    assert np.abs(one.encoding.agent_agent - other.encoding.agent_agent).max() > 1e-3


def test_another_neighbour_changes_the_plan(forward):
    two, three = forward(stack(*[make_features(0, n) for n in (2, 3)])).controls
    assert np.abs(two - three).max() > 1e-5


def test_types_choose_their_encoder(forward):
    scene, other = make_features(0), make_features(0)
    other.neighbors[0, :, 8] = 2.0
    actors = forward(stack(scene, other)).encoding.actors
    changed = np.abs(actors[0] - actors[1]).max(axis=1)
    assert changed[1] > 1e-3
    assert changed[[0, 2, 3]].max() == 0


@pytest.mark.slow
def test_empty_scenes_give_finite_losses_and_gradients(train):
    at_rest, alone = make_features(0, neighbors=0), make_features(1, neighbors=0)
    at_rest.ego[:, :5] = 0
    for name in ("map_lanes", "map_crosswalks"):
        getattr(alone, name)[:] = 0
    parts, output, gradients = train(at_rest, alone)
    for value in (*jax.tree.leaves(parts), *jax.tree.leaves(output), *gradients.values()):
        assert np.isfinite(value).all()


def test_empty_scenes_give_finite_outputs(forward):
    at_rest, alone = make_features(0, neighbors=0), make_features(1, neighbors=0)
    at_rest.ego[:, :5] = 0
    for name in ("map_lanes", "map_crosswalks"):
        getattr(alone, name)[:] = 0
    for value in jax.tree.leaves(forward(stack(at_rest, alone))):
        assert np.isfinite(value).all()


@pytest.mark.slow
def test_gradients_reach_what_they_should(train):
    parts, _, gradients = train(make_features(0), make_features(1))
    for table in ("self_type", "left_type", "right_type", "traffic_light_type"):
        rows = gradients[f"lane_net.{table}.weight"]
        assert np.all(rows[0] == 0)
        assert np.abs(rows[1]).max() > 0
    # Through the unrolled solve to the planner's weights and the predictions.
    assert np.abs(gradients["plan.cost.2.weight"]).max() > 0
    assert np.abs(gradients["predict.decode.3.weight"]).max() > 0
    parts_sum = parts.futures.total + parts.plan + 1e-3 * parts.plan_cost
    np.testing.assert_allclose(parts.total, parts_sum, rtol=1e-6)


@pytest.mark.slow
def test_new_weights_start_as_torch_starts_them():
    weights = flatten(dipp.init(CONFIG, jax.random.key(0)))
    assert not np.any(weights["lane_net.self_type.weight"][0])
    assert np.all(weights["agent_map.map_attention.ffn.0.weight"] == 1)
    bound = 1 / np.sqrt(CONFIG.width)
    drawn = np.abs(weights["vehicle_net.motion.weight_hh_l0"])
    assert 0.9 * bound < drawn.max() <= bound


@pytest.mark.slow
def test_scores_train_their_head_only(params):
    features = stack(make_features(0), make_features(1))
    spread = lambda p: jnp.sum(dipp.apply(p, CONFIG, features).scores ** 2)
    gradients = flatten(jax.jit(jax.grad(spread))(params))
    reached = {name.split(".")[0] for name, g in gradients.items() if np.abs(g).max() > 0}
    assert reached == {"score"}


def test_float64_in_float64_out(params):
    wide = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, jnp.float64), params)
    features = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, jnp.float64), make_features(0))
    output = jax.eval_shape(lambda p, f: dipp.apply(p, CONFIG, f), wide, features)
    floats = [v for v in jax.tree.leaves(output) if v.dtype != bool]
    assert {v.dtype for v in floats} == {jnp.dtype(jnp.float64)}
    assert output.predictions.shape == (3, NEIGHBORS, STEPS, 3)


def test_future_loss_of_a_perfect_mode_is_the_scores_cross_entropy():
    truth = np.stack([make_truth(0), make_truth(1)])
    futures = np.stack([truth + 5, truth, truth - 5], axis=1)
    scores = np.array([[0.0, 1.0, 2.0], [1.0, 1.0, 1.0]])
    loss = future_loss(*map(jnp.asarray, (futures[:, :, 0], futures[:, :, 1:], scores, truth)))
    expected = -np.mean([np.log(np.exp(1) / np.exp([0, 1, 2]).sum()), np.log(1 / 3)])
    np.testing.assert_allclose(loss.total, expected, rtol=1e-6)
    assert loss.best_mode.tolist() == [1, 1]


def test_unseen_futures_cost_nothing():
    truth = np.stack([make_truth(0)])
    truth[:, 2] = 0
    given = [jnp.asarray(v) for v in (truth[:, None, 0], truth[:, None, 1:] + 3, np.zeros((1, 1)))]
    given[1] = given[1].at[:, :, 1].set(99.0)
    loss = lambda futures: future_loss(given[0], futures, given[2], jnp.asarray(truth)).total
    assert float(loss(given[1])) == float(loss(given[1].at[:, :, 1].set(-7.0)))
    metrics = motion_metrics(given[0][:, 0], given[1][:, 0], jnp.asarray(truth))
    np.testing.assert_allclose(metrics, [0, 0, np.hypot(3, 3), np.hypot(3, 3)], atol=1e-5)


def test_checkpoints_round_trip_and_say_what_is_wrong(params):
    state = to_state_dict(params, dipp.EXTRAS)
    template = dipp.abstract_params(CONFIG)
    again = from_state_dict(state, template, dipp.EXTRAS)
    jax.tree.map(np.testing.assert_array_equal, params, again)
    state["plan.scale"] = np.ones(7)
    state["score.decode.3.bias"] = np.array([np.nan])
    del state["predict.decode.1.bias"]
    with pytest.raises(ValueError, match="3 keys") as error:
        from_state_dict(state, template, dipp.EXTRAS)
    for name in ("plan.scale", "score.decode.3.bias", "predict.decode.1.bias is missing"):
        assert name in str(error.value)


def test_full_size_has_the_published_number_of_parameters():
    shapes = flatten(dipp.abstract_params(DIPPConfig())).values()
    assert sum(int(np.prod(leaf.shape)) for leaf in shapes) == 7_738_180


def test_errors_name_the_field(params):
    with pytest.raises(ValueError, match="width is 12"):
        DIPPConfig(width=12)
    assert hash(CONFIG) == hash(DIPPConfig(width=8, horizon=STEPS))
    features = make_features(0)
    with pytest.raises(ValueError, match="map_lanes has shape"):
        dipp.apply(params, CONFIG, features.replace(map_lanes=features.map_lanes[:2]))
    with pytest.raises(ValueError, match="ego has shape"):
        dipp.apply(params, CONFIG, features.replace(ego=features.ego[:, :7]))
