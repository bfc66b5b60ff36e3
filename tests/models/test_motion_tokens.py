"""Motion tokens: vocabulary, tokenising, nucleus sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_models.motion_tokens import (
    TokenBox,
    compose,
    corner_distance,
    detokenize,
    draw,
    k_disks,
    nucleus,
    steps_between,
    tokenize,
)

BOX = TokenBox(4.6, 2.0)
STEPS = 6
pose = st.tuples(*[st.floats(-50, 50)] * 2, st.floats(-3.1, 3.1)).map(np.array)

_detokenize = jax.jit(detokenize)
_tokenize = jax.jit(tokenize, static_argnums=2)
_nucleus = jax.jit(nucleus, static_argnums=1)
_draw = jax.jit(draw, static_argnames="order")


def corners(poses: np.ndarray) -> np.ndarray:
    """`[N, 4, 2]` of the box at poses `[N, 3]`."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    half = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (0.5 * BOX.length, 0.5 * BOX.width)
    return poses[:, None, :2] + np.einsum("nij,kj->nki", turn, half)


@given(pose, pose)
def test_steps_lead_from_pose_to_pose(before, after):
    reached = compose(before, steps_between(before, after))
    np.testing.assert_allclose(reached, after, atol=1e-9)
    moved = steps_between(compose(before, after), compose(before, before))
    np.testing.assert_allclose(moved, steps_between(after, before), atol=1e-9)


@given(pose, pose, pose)
def test_corner_distance_is_a_distance_that_no_frame_changes(a, b, frame):
    gap = float(corner_distance(a, b, BOX))
    moved = corner_distance(compose(frame, a), compose(frame, b), BOX)
    np.testing.assert_allclose(moved, gap, atol=1e-9)
    assert float(corner_distance(a, a, BOX)) == 0
    assert gap <= float(corner_distance(a, frame, BOX) + corner_distance(frame, b, BOX)) + 1e-9


@given(st.integers(0, 1000), st.floats(0.05, 2.0))
def test_templates_are_apart_and_cover_every_step(seed, radius):
    random = np.random.default_rng(seed)
    steps = random.normal(size=(40, 3)) * (1, 0.1, 0.05)
    kept = k_disks(steps, random.permutation(40), radius, BOX)
    places = corners(steps)
    gaps = np.linalg.norm(places[:, None] - places[kept], axis=-1).mean(axis=-1)
    assert np.all(gaps.min(axis=1) <= radius)
    among = gaps[kept] + np.where(np.eye(len(kept)) > 0, np.inf, 0)
    assert len(kept) == 1 or among.min() > radius
    few = k_disks(steps, np.arange(40), radius, BOX, size=3)
    assert np.array_equal(few, k_disks(steps, np.arange(40), radius, BOX)[:3])


def test_motion_made_of_templates_is_found_again():
    random = np.random.default_rng(0)
    templates = random.normal(size=(12, 3)) * (1, 0.3, 0.3)
    tokens = random.integers(0, 12, STEPS)
    start = np.array([3.0, -2.0, 3.0])
    poses = np.asarray(_detokenize(tokens, templates, start))
    ours = _tokenize(jnp.asarray(np.concatenate([start[None], poses])), templates, BOX)
    assert ours.tokens.tolist() == tokens.tolist()
    np.testing.assert_allclose(ours.poses, poses, atol=1e-12)
    np.testing.assert_allclose(ours.error, 0, atol=1e-12)


def test_errors_of_tokens_do_not_add_up():
    # Steps of 1.03 m in a vocabulary of whole and 1.2 m steps: the second one catches up.
    truth = np.zeros((2 * STEPS + 1, 3))
    truth[:, 0] = 1.03 * np.arange(len(truth))
    templates = np.array([[1.0, 0, 0], [1.2, 0, 0]])
    ours = _tokenize(truth, templates, BOX)
    assert np.max(ours.error) <= 0.1 + 1e-9
    assert 0 < int(np.sum(ours.tokens)) < STEPS


@given(st.integers(0, 1000), st.sampled_from([0.3, 0.9, 1.0]))
def test_the_nucleus_is_the_smallest_set_of_enough_mass(seed, mass):
    logits = np.random.default_rng(seed).normal(size=30) * 2
    ours = _nucleus(jnp.asarray(logits), mass)
    probs = np.exp(logits) / np.exp(logits).sum()
    keep = np.asarray(ours.keep)
    assert probs[keep].sum() >= mass - 1e-9
    assert mass == 1 or probs[keep].sum() - probs[keep].min() < mass
    assert keep.all() or probs[keep].min() >= probs[~keep].max()
    np.testing.assert_allclose(np.sum(ours.probs), 1)


def test_of_equal_tokens_the_first_are_kept():
    keep = _nucleus(jnp.zeros(4), 0.6).keep
    assert keep.tolist() == [True, True, True, False]
    certain = _nucleus(jnp.array([0.0, 800.0, 0.0]), 0.5)
    assert certain.keep.tolist() == [False, True, False]


@pytest.mark.parametrize("order", ["token", "probability"])
def test_draws_follow_the_probabilities_and_never_leave_them(order):
    probs = jnp.array([0.0, 0.25, 0.0, 0.75, 0.0])
    uniform = (jnp.arange(400) + 0.5) / 400
    drawn = np.asarray(_draw(jnp.broadcast_to(probs, (400, 5)), uniform, order=order))
    assert np.bincount(drawn, minlength=5).tolist() == [0, 100, 0, 300, 0]
    # Sums of float32 may end below the largest number that is drawn.
    short = jnp.asarray([0.3, 0.3, 0.3999, 0.0], jnp.float32)[None]
    assert int(_draw(short, jnp.asarray([0.99999], jnp.float32), order=order)[0]) in (0, 1, 2)


def test_errors_say_what_is_expected():
    with pytest.raises(ValueError, match=r"expected \[N, 3\]"):
        k_disks(np.zeros((3, 2)), np.arange(3), 0.1, BOX)
    with pytest.raises(ValueError, match="not finite"):
        k_disks(np.full((3, 3), np.nan), np.arange(3), 0.1, BOX)
    with pytest.raises(ValueError, match="beyond the 3 steps"):
        k_disks(np.zeros((3, 3)), np.arange(4), 0.1, BOX)
    with pytest.raises(ValueError, match="mass is 0"):
        nucleus(jnp.zeros(3), 0)
