"""DTPP's network and losses on made-up scenes: masks, padding, degenerate inputs, errors."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from spdm_models import dtpp
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_losses import CLIP_NORM, DTPPTargets, loss, optimizer, smooth_l1
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures
from spdm_models.state_dict import from_state_dict, to_state_dict

NEIGHBORS, BRANCHES, STEPS = 3, 4, 20
FIRST_STEPS = 10
CONFIG = DTPPConfig(EncoderConfig(width=16, heads=2, layers=1), neighbors=2, seconds=2)
MIXED = DTPPConfig(
    EncoderConfig(width=16, heads=2, layers=1), neighbors=2, seconds=2, reference_mask_order=True
)


def make_features(seed: int) -> SceneFeatures:
    random = np.random.default_rng(seed)
    shapes = {
        "ego_past": (21, 7),
        "neighbors_past": (NEIGHBORS, 21, 11),
        "lanes": (2, 50, 7),
        "crosswalks": (1, 30, 3),
        "route_lanes": (1, 50, 3),
    }
    return SceneFeatures(
        **{k: random.normal(size=shape).astype(np.float32) for k, shape in shapes.items()}
    )


def make_branches(seed: int, real: int = BRANCHES) -> np.ndarray:
    branches = np.random.default_rng(seed).normal(size=(BRANCHES, STEPS, 6)).astype(np.float32)
    branches[real:] = 0
    return branches


def make_targets(seed: int) -> DTPPTargets:
    random = np.random.default_rng(seed)
    return DTPPTargets(
        ego_future=random.normal(size=(STEPS, 3)).astype(np.float32),
        neighbors_future=random.normal(size=(2, STEPS, 3)).astype(np.float32),
    )


def stack(*trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


@pytest.fixture(scope="module")
def params():
    # Drawn on the host: a program that draws every array compiles for seconds.
    random = np.random.default_rng(0)
    draw = lambda leaf: jnp.asarray(0.3 * random.normal(size=leaf.shape), leaf.dtype)
    return jax.tree.map(draw, dtpp.abstract(CONFIG))


def evaluate(params, config, features, branches, targets):
    """Loss and outputs of a batch; the same branches serve both stages."""
    encoding = dtpp.encode(params, config, features)
    short = branches.at[..., FIRST_STEPS:, :].set(0)
    first = dtpp.decode(params, config, encoding, features, short, FIRST_STEPS)
    second = dtpp.decode(params, config, encoding, features, branches, STEPS)
    parts = loss(first, second, short, branches, targets)
    return parts.total, (parts, first, second)


def on_batch(function, params):
    """Calls a compiled function with batches of two; results on the host."""
    compiled = jax.jit(function, static_argnums=1)

    def call(features, branches, targets=None):
        targets = targets or stack(make_targets(7), make_targets(8))
        given = jax.tree.map(jnp.asarray, (features, branches, targets))
        return jax.tree.map(np.asarray, compiled(params, CONFIG, *given))

    return call


@pytest.fixture(scope="module")
def run(params):
    """Total loss, its parts, and the outputs of both stages."""

    def flat(*args):
        total, aux = evaluate(*args)
        return total, *aux

    return on_batch(flat, params)


@pytest.fixture(scope="module")
def gradients(params):
    """Gradients of the total loss."""
    return on_batch(lambda *args: jax.grad(evaluate, has_aux=True)(*args)[0], params)


def test_batch_neighbours_change_nothing(run):
    features = [make_features(i) for i in range(3)]
    branches = [make_branches(i, real) for i, real in enumerate((4, 2, 3))]
    one = run(stack(features[0], features[1]), np.stack(branches[:2]))[3]
    other = run(stack(features[2], features[0]), np.stack([branches[2], branches[0]]))[3]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[0], b[1], rtol=1e-5, atol=1e-5), one, other
    )
    assert one.futures.shape == (2, BRANCHES, 2, STEPS, 3)
    assert one.scoring.scores.dtype == np.float32


def test_the_reference_mixes_the_masks_of_a_batch(run, params):
    features = [make_features(i) for i in range(2)]
    features[1].lanes[:] = 0
    branches = jnp.stack([make_branches(0, 4), make_branches(1, 1)])

    @jax.jit
    def mixed(features, branches):
        encoding = dtpp.encode(params, MIXED, features)
        return dtpp.decode(params, MIXED, encoding, features, branches, STEPS).futures

    both = stack(*features)
    clean = run(both, branches)[3].futures
    futures = np.asarray(mixed(both, branches))
    assert np.max(np.abs(futures - clean)[0]) > 1e-3
    # Two samples with the same masks do not notice.
    twice = stack(features[0], make_features(5))
    branches = jnp.stack([make_branches(0), make_branches(1)])
    clean = run(twice, branches)[3].futures
    futures = np.asarray(mixed(twice, branches))
    np.testing.assert_allclose(futures, clean, atol=1e-5)
    with pytest.raises(ValueError, match="exactly one leading axis"):
        jax.eval_shape(mixed, features[0], branches[0])


def test_branches_do_not_see_each_other(run):
    both = stack(make_features(0), make_features(1))
    one = run(both, np.stack([make_branches(0, 2)] * 2))
    other = run(both, np.stack([make_branches(0, 4)] * 2))
    for a, b in ((one[2], other[2]), (one[3], other[3])):
        np.testing.assert_allclose(a.futures[:, :2], b.futures[:, :2], atol=1e-5)
        np.testing.assert_allclose(a.scoring.scores[:, :2], b.scoring.scores[:, :2], atol=1e-5)
        assert np.all(np.isneginf(a.scoring.scores[:, 2:]))
        assert np.all(np.isfinite(b.scoring.scores))


def test_a_second_does_not_see_later_ones(run):
    both = stack(make_features(0), make_features(1))
    branches = np.stack([make_branches(0)] * 2)
    later = branches.copy()
    # The whole branch enters by its last step, the seconds one by one.
    later[:, :, FIRST_STEPS : STEPS - 1] += 0.5
    one, other = run(both, branches)[3], run(both, later)[3]
    early = np.s_[..., :FIRST_STEPS, :]
    np.testing.assert_allclose(one.futures[early], other.futures[early], atol=1e-5)
    assert np.max(np.abs(one.futures - other.futures)) > 1e-3


def test_masked_map_pieces_and_padding_do_not_matter(run):
    features = [make_features(0), make_features(1)]
    features[0].lanes[1] = 0
    features[0].neighbors_past[2] = 0
    one = run(stack(*features), np.stack([make_branches(0)] * 2))[3]
    # A polyline with one x of exactly zero in every segment counts as padding.
    features[0].lanes[1] = 3.0
    features[0].lanes[1, ::10, 0] = 0
    other = run(stack(*features), np.stack([make_branches(0)] * 2))[3]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), one, other)


def empty_scene(kind: str):
    """A batch of two whose first scene lacks something."""
    features = [make_features(0), make_features(1)]
    targets = make_targets(7)
    if kind != "map":
        features[0].neighbors_past[:] = 0
        targets.neighbors_future[:] = 0
    if kind != "neighbours":
        features[0].lanes[:] = 0
        features[0].crosswalks[:] = 0
    branches = make_branches(0, 2)
    if kind == "everything":
        # At rest the reference takes the ego for absent.
        features[0].ego_past[:] = 0
        branches[:] = 0
        branches[0, :, 5] = 0.01
    branches = np.stack([branches, make_branches(1)])
    return stack(*features), branches, stack(targets, make_targets(8))


EMPTY = ("neighbours", "map", "everything")


def all_finite(tree) -> bool:
    return all(bool(np.all(np.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("kind", EMPTY)
def test_empty_scenes_have_finite_scores_and_losses(run, kind: str):
    total, parts, first, second = run(*empty_scene(kind))
    assert all_finite((total, parts))
    for output in (first, second):
        assert all_finite((output.futures, output.scoring.scores[0, 0], output.ego_future))
        if kind != "map":
            assert np.all(output.scoring.collision[0] == 0)


@pytest.mark.slow
def test_gradients_of_empty_scenes_are_finite(gradients):
    for kind in EMPTY:
        assert all_finite(gradients(*empty_scene(kind))), kind
    both = stack(make_features(0), make_features(1))
    assert all_finite(gradients(both, np.stack([make_branches(0), make_branches(0, 0)])))


def test_a_sample_without_branches_takes_no_part_in_the_choice(run):
    both = stack(make_features(0), make_features(1))
    alone = run(both, np.stack([make_branches(0)] * 2))
    total, parts, _, _ = run(both, np.stack([make_branches(0), make_branches(0, 0)]))
    assert all_finite((total, parts))
    scores = alone[3].scoring.scores[0].astype(float)
    expected = np.log(np.sum(np.exp(scores - scores[0])))
    np.testing.assert_allclose(parts.second.choice, expected, rtol=1e-4)


def test_loss_is_the_sum_of_its_parts(run):
    both = stack(make_features(0), make_features(1))
    branches = np.stack([make_branches(0), make_branches(1)])
    targets = stack(make_targets(7), make_targets(8))
    targets.neighbors_future[0, 1] = 0
    total, parts, _, second = run(both, branches, targets)
    known = targets.neighbors_future != 0
    gap = np.where(known, second.futures[:, 0] - targets.neighbors_future, 0)
    huber = np.where(np.abs(gap) < 1, 0.5 * gap**2, np.abs(gap) - 0.5)
    np.testing.assert_allclose(parts.second.prediction, huber.sum() / (2 * STEPS), rtol=1e-4)
    gap = second.ego_future - targets.ego_future
    huber = np.where(np.abs(gap) < 1, 0.5 * gap**2, np.abs(gap) - 0.5)
    np.testing.assert_allclose(parts.second.ego, huber.sum() / (2 * STEPS), rtol=1e-4)
    np.testing.assert_allclose(parts.second.weights, np.mean(second.scoring.weights**2), rtol=1e-5)
    stages = [
        p.prediction + p.choice + 0.1 * p.ego + 0.01 * p.weights for p in parts.__dict__.values()
    ]
    np.testing.assert_allclose(total, stages[0] + 0.2 * stages[1], rtol=1e-5)


def test_smooth_l1():
    gaps = jnp.asarray([0.0, 0.5, -1.0, 3.0])
    np.testing.assert_allclose(smooth_l1(gaps, jnp.zeros(4)), [0, 0.125, 0.5, 2.5])


def test_given_futures_replace_the_predictions(params):
    features = make_features(0)
    branches = jnp.asarray(make_branches(0))
    futures = jnp.asarray(make_targets(3).neighbors_future)

    @jax.jit
    def score(features, futures, valid):
        encoding = dtpp.encode(params, CONFIG, features)
        return dtpp.decode(
            params,
            CONFIG,
            encoding,
            features,
            branches,
            STEPS,
            futures=futures,
            neighbor_valid=valid,
        )

    there = jnp.asarray([True, True])
    with_both = score(features, futures, there)
    np.testing.assert_array_equal(with_both.futures[2], futures)
    nobody = score(features, futures, ~there)
    np.testing.assert_array_equal(nobody.scoring.collision, 0)
    offset = branches[:, None, :, :2] - futures[..., :2]
    close = np.exp(-0.2 * np.sum(np.square(offset), -1)).sum((1, 2))
    np.testing.assert_allclose(with_both.scoring.collision, close, rtol=1e-5)
    cost = np.sum(
        with_both.scoring.weights
        * np.concatenate([with_both.scoring.driving, with_both.scoring.latent], -1),
        -1,
    )
    np.testing.assert_allclose(with_both.scoring.scores, -cost - 10 * close, rtol=1e-5)


def test_encoder_and_decoder_are_clipped_apart():
    given = {"encoder": {"w": np.array([300.0, 400.0])}, "decoder": {"w": np.array([3.0, 0])}}
    step = optimizer(1.0)
    _, state = jax.jit(step.update)(given, step.init(given), given)
    moments = optax.tree.get(state, "mu")
    # Adam keeps a tenth of the clipped gradient.
    np.testing.assert_allclose(
        moments["encoder"]["w"], 0.1 * CLIP_NORM * np.array([0.6, 0.8]), rtol=1e-6
    )
    np.testing.assert_allclose(moments["decoder"]["w"], [0.3, 0])


def test_state_dict_of_torch_comes_back(params):
    state = to_state_dict(params, dtpp.extras(CONFIG))
    assert state["decoder.casual_mask"].shape == (60, 60)
    assert dtpp.config_of(state) == DTPPConfig(EncoderConfig(width=16, layers=1), seconds=2)
    back = from_state_dict(state, dtpp.abstract(CONFIG), dtpp.extras(CONFIG))
    jax.tree.map(np.testing.assert_array_equal, back, params)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("decoder.time_embed.weight", None, "decoder.time_embed.weight is missing"),
        (
            "decoder.time_embed.weight",
            np.zeros((3, 16)),
            r"has shape \(3, 16\), expected \(2, 16\)",
        ),
        (
            "decoder.scorer.weights_decoder.2.bias",
            np.full(8, np.nan),
            "8 values that are not",
        ),
        ("decoder.score.bias", np.zeros(1), "decoder.score.bias is unknown to this model"),
        ("decoder.time_index", np.zeros((30, 2)), "decoder.time_index differs"),
    ],
)
def test_checkpoints_that_do_not_fit_are_refused(params, name: str, value, message: str):
    state = to_state_dict(params, dtpp.extras(CONFIG)) | {name: value}
    state = {k: v for k, v in state.items() if v is not None}
    with pytest.raises(ValueError, match=message):
        from_state_dict(state, dtpp.abstract(CONFIG), dtpp.extras(CONFIG))


def test_other_state_dicts_are_told_apart():
    with pytest.raises(ValueError, match="no state dict of DTPP"):
        dtpp.config_of({"encoder.x": np.zeros(1)})


def test_wrong_shapes_are_named(params):
    features = make_features(0)
    encoding = jax.eval_shape(lambda: dtpp.encode(params, CONFIG, features))
    with pytest.raises(ValueError, match=r"branches has shape \(4, 9, 6\)"):
        dtpp.decode(params, CONFIG, encoding, features, jnp.zeros((4, 9, 6)), 9)
    with pytest.raises(ValueError, match="steps is 30; a stage has 2 to 20"):
        dtpp.decode(params, CONFIG, encoding, features, jnp.zeros((4, 20, 6)), 30)
    with pytest.raises(ValueError, match=r"features.lanes has shape"):
        dtpp.encode(params, CONFIG, features.replace(lanes=np.zeros((2, 50, 6))))


def test_a_new_network_has_the_shapes_of_a_checkpoint():
    new = dtpp.init(CONFIG, jax.random.key(0))
    expected = jax.tree.map(lambda leaf: leaf.shape, dtpp.abstract(CONFIG))
    assert jax.tree.map(lambda leaf: leaf.shape, new) == expected


def test_parameter_count_of_the_full_network():
    sizes = [leaf.size for leaf in jax.tree.leaves(dtpp.abstract(DTPPConfig()))]
    tables = (50 + 30) * 256
    assert sum(sizes) - tables == 5_898_906
