"""GameFormer: padding, empty scenes, replaced predictions, loss; stored reference outputs."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from spdm_models import gameformer
from spdm_models.checkpoint import read_checkpoint
from spdm_models.gameformer import (
    GameFormerConfig,
    GameFormerOutput,
    apply,
    config_of,
    extras,
    init,
    rollout,
)
from spdm_models.gameformer_losses import Targets, losses, metrics
from spdm_models.optimizers import adamw
from spdm_models.params import Params
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures
from spdm_models.state_dict import flatten, from_state_dict, to_state_dict

CONFIG = GameFormerConfig(
    encoder=EncoderConfig(width=8, heads=2, layers=1), levels=1, modes=3, neighbors=2, steps=5
)
TWO_LEVELS = dataclasses.replace(CONFIG, levels=2)
KEY = jax.random.key(1)
TOLERANCE = 1e-10
FIELDS = ("ego_past", "neighbors_past", "lanes", "crosswalks", "route_lanes")


def scene(seed: int = 0) -> SceneFeatures:
    """Random but plausible numbers: a full scene with one free row in every list."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.normal(size=shape) * 3 + 1
    features = SceneFeatures(
        ego_past=draw(21, 7),
        neighbors_past=draw(3, 21, 11),
        lanes=draw(4, 50, 7),
        crosswalks=draw(2, 30, 3),
        route_lanes=draw(2, 50, 3),
    )
    for name in FIELDS[1:]:
        getattr(features, name)[-1] = 0
    return features


def future(seed: int = 0) -> Targets:
    rng = np.random.default_rng(seed)
    neighbors = rng.normal(size=(2, CONFIG.steps, 3)) * 5
    neighbors[1, 3:] = 0
    return Targets(ego=rng.normal(size=(CONFIG.steps, 3)), neighbors=neighbors)


def batch(*scenes):
    """Stacks scenes; always two, so that all tests share one program."""
    return jax.tree.map(lambda *v: jnp.stack([jnp.asarray(x) for x in v]), *scenes)


FUTURES = batch(future(0), future(1))


@pytest.fixture(scope="module")
def params() -> Params:
    """Weights large enough that every input has an effect."""
    drawn = init(CONFIG, KEY)
    return jax.tree.map(lambda v: 2.0 * v.astype(jnp.float64) + 0.01, drawn)


run = jax.jit(apply, static_argnums=1)


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=True)
def train(params, config, features, targets):
    output = apply(params, config, features)
    return losses(output, targets).total, (output, metrics(output, targets))


def outputs(params: Params, *scenes: SceneFeatures) -> list[GameFormerOutput]:
    """Predictions of two scenes, apart."""
    (_, (output, _)), _ = train(params, CONFIG, batch(*scenes), FUTURES)
    return [jax.tree.map(lambda v, i=i: v[i], output) for i in range(2)]


def close(a, b) -> None:
    for mine, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=TOLERANCE)


def test_padding_changes_nothing(params: Params):
    plain, _ = outputs(params, scene(), scene())
    grown = jax.tree.map(jnp.asarray, scene())
    for name in ("neighbors_past", "lanes", "crosswalks"):
        padded = jnp.pad(getattr(grown, name), ((0, 5), (0, 0), (0, 0)))
        grown = grown.replace(**{name: padded})
    other = run(params, CONFIG, grown)
    close((plain.levels, plain.plan), (other.levels, other.plan))


def test_order_of_the_map_changes_nothing(params: Params):
    features = scene()
    turned = features.replace(lanes=features.lanes[::-1], crosswalks=features.crosswalks[::-1])
    plain, other = outputs(params, features, turned)
    close((plain.levels, plain.plan), (other.levels, other.plan))
    moved, _ = outputs(params, features.replace(lanes=features.lanes + 1e-3), features)
    assert np.abs(np.asarray(plain.plan - moved.plan)).max() > 1e-7


def test_batch_neighbours_change_nothing(params: Params):
    first, second = outputs(params, scene(0), scene(1))
    other, again = outputs(params, scene(1), scene(0))
    close((first, second), (again, other))
    assert np.abs(np.asarray(first.plan - second.plan)).max() > 1e-3


def emptied(features: SceneFeatures, *names: str) -> SceneFeatures:
    return features.replace(**{name: 0 * getattr(features, name) for name in names})


@pytest.mark.slow
@pytest.mark.parametrize(
    "missing",
    [
        ("neighbors_past",),
        ("crosswalks",),
        ("route_lanes",),
        ("lanes", "crosswalks", "route_lanes"),
        ("ego_past",),
        ("ego_past", "neighbors_past"),
        FIELDS,
    ],
)
def test_empty_scenes_are_finite(params: Params, missing: tuple[str, ...]):
    scenes = batch(emptied(scene(), *missing), scene(1))
    (loss, (output, _)), slope = train(params, CONFIG, scenes, FUTURES)
    for leaf in jax.tree.leaves((loss, output, slope)):
        assert np.isfinite(leaf).all()


@pytest.mark.slow
def test_replaced_predictions(params: Params):
    own, _ = outputs(params, scene(), scene())
    positions = FUTURES.neighbors[0, ..., :2]
    given = run(params, CONFIG, jax.tree.map(jnp.asarray, scene()), positions)
    for level in given.levels:
        for mode in range(CONFIG.modes):
            np.testing.assert_array_equal(level.gaussians[1:, mode, :, :2], positions)
    # Level 0 itself does not see them; the ego's later levels do, and its plan with them.
    close(own.levels[0].gaussians[:1], given.levels[0].gaussians[:1])
    close(own.levels[0].scores, given.levels[0].scores)
    assert np.abs(np.asarray(own.plan - given.plan)).max() > 1e-6


@pytest.mark.slow
def test_dropout_needs_a_key():
    config = dataclasses.replace(CONFIG, levels=0)
    weights = init(config, KEY)
    features = jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), scene())
    # A generator that compiles faster than the default.
    keys = [jax.random.key(i, impl="unsafe_rbg") for i in (0, 0, 1)]
    first, again, other = (run(weights, config, features, None, key).plan for key in keys)
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.slow
def test_training_lowers_the_loss(params: Params):
    scenes = batch(scene(0), scene(1))
    optimizer = adamw(1e-3, params, 5.0)
    state, before = optimizer.init(params), flatten(params)

    @jax.jit
    def step(params, state, gradients):
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), state

    totals = []
    for _ in range(8):
        (total, _), gradients = train(params, CONFIG, scenes, FUTURES)
        params, state = step(params, state, gradients)
        totals.append(float(total))
    assert totals[-1] < totals[0]
    for name, value in flatten(params).items():
        assert np.array_equal(value, before[name]) == name.endswith(".pe"), name


def test_rollout():
    ego = jnp.array([3.0, 4.0, 0.5, 3.0, 4.0, 0.0, 0.0])
    still = rollout(ego, jnp.zeros((10, 2)))
    # At 5 m/s along the heading, from the origin.
    distance = 0.5 * np.arange(1, 11)
    expected = np.stack([distance * np.cos(0.5), distance * np.sin(0.5), 0 * distance + 0.5], -1)
    np.testing.assert_allclose(still, expected, atol=1e-12)
    wild = rollout(ego, jnp.tile(jnp.array([-99.0, 99.0]), (40, 1)))
    # Braking is cut at 5 m/s^2 and stops after 1 s; the curvature is cut at 0.5 1/m.
    np.testing.assert_array_equal(wild[10:], jnp.broadcast_to(wild[10], wild[10:].shape))
    np.testing.assert_allclose(wild[-1, 2], 0.5 + 0.5 * (5.0 - 0.5 * np.arange(1, 11)).sum() * 0.1)


def test_metrics_leave_out_who_is_missing(params: Params):
    scenes, gone = batch(scene(0), scene(1)), FUTURES.replace(neighbors=0 * FUTURES.neighbors)
    full, empty = (train(params, CONFIG, scenes, t)[0][1][1] for t in (FUTURES, gone))
    assert np.isfinite(jax.tree.leaves(full)).all()
    assert np.isnan(empty.prediction_ade) and np.isnan(empty.prediction_fde)
    assert empty.plan_ade == full.plan_ade


def test_sizes_are_read_from_the_weights():
    weights, more = init(TWO_LEVELS, KEY), extras(TWO_LEVELS)
    state = to_state_dict(weights, more)
    heads = dataclasses.replace(TWO_LEVELS.encoder, heads=8)
    assert config_of(state) == dataclasses.replace(TWO_LEVELS, encoder=heads)
    close(from_state_dict(state, gameformer.abstract(TWO_LEVELS), more), weights)
    # One module of the reference under two names.
    stage = "decoder.interaction_stage.{}.future_encoder.mlp.0.bias".format
    np.testing.assert_array_equal(state[stage(0)], state[stage(1)])
    with pytest.raises(ValueError, match="no state dict of GameFormer"):
        config_of({"a": np.zeros(1)})


def test_parameter_counts():
    """The published sizes; position tables are no parameters."""

    def count(levels: int, modes: int, layers: int) -> int:
        config = GameFormerConfig(EncoderConfig(layers=layers), levels=levels, modes=modes)
        shapes = flatten(gameformer.abstract(config))
        return sum(int(np.prod(v.shape)) for k, v in shapes.items() if not k.endswith(".pe"))

    assert count(3, 6, 3) == 11_854_756
    assert count(3, 15, 6) == 14_226_340
    assert count(0, 6, 3) == 6_162_401


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"lanes": jnp.zeros((4, 49, 7))}, r"features.lanes has shape \(4, 49, 7\), .*any, 50, 7"),
        ({"ego_past": jnp.zeros((21, 6))}, r"features.ego_past has shape"),
        ({"route_lanes": jnp.zeros((1, 2, 50, 3))}, r"features.route_lanes has shape"),
        ({"neighbors_past": jnp.zeros((3, 20, 11))}, r"features.neighbors_past has shape"),
        (
            {"neighbors_past": jnp.zeros((1, 21, 11))},
            r"features\.neighbors_past holds 1 neighbours, fewer than the 2",
        ),
    ],
)
def test_shapes_are_checked(params: Params, changes: dict, message: str):
    with pytest.raises(ValueError, match=message):
        apply(params, CONFIG, scene().replace(**changes))


@pytest.mark.slow
def test_stored_reference(shared: Path):
    folder = shared / "golden" / "models" / "gameformer"
    state = read_checkpoint(folder / "small_L0m6_seed0_params.npz")
    config = config_of(state)
    params = from_state_dict(state, gameformer.abstract(config), extras(config), dtype=np.float64)
    data = np.load(folder / "small_L0m6_seed0.npz")
    names = ("ego_agent_past", "neighbor_agents_past", "map_lanes", "map_crosswalks", "route_lanes")
    inputs = {f: jnp.asarray(data[f"in/{n}"], float) for f, n in zip(FIELDS, names, strict=True)}
    output = run(params, config, SceneFeatures(**inputs))
    np.testing.assert_allclose(output.plan, data["f64/ego_plan"], rtol=0, atol=1e-9)
    scores = data["f64/decoder/level_0_scores"]
    np.testing.assert_allclose(output.levels[0].scores, scores, rtol=0, atol=1e-9)
    # The rest is stored in float32.
    np.testing.assert_allclose(output.encoding.tokens, data["out/encoder/encoding"], atol=4e-6)
    futures = data["out/decoder/level_0_interactions"]
    np.testing.assert_allclose(output.levels[0].gaussians, futures, rtol=0, atol=4e-5)
