"""`soft_score` as a user trains with it: convergence, gradients, descent, errors."""

import copy
import pickle
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax import monitoring
from jax.core import Tracer

from spdm_jax import PlannerConfig, PlannerParams, ScenarioSet, from_raw, functional, score
from spdm_jax import soft_score as public_soft_score
from spdm_jax.api import fit_config
from spdm_jax.decision import poses_only
from spdm_jax.padding import to_device
from spdm_jax.soft import SoftScores, soft_score
from spdm_jax.synthetic import make_scene

SCENES = ("platoon", "parked_car", "curve", "oncoming")
MORE_SCENES = ("straight", "open_road", "jaywalker", "lane_ends")
TERMS = (
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "time_to_collision",
    "comfort",
    "progress",
    "progress_raw",
    "total",
)
COUNT = 8


def arcs(speed: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """Constant speeds and curvatures, ego frame, `[P, 41, 3]`."""
    way = speed[:, None] * np.arange(41) * 0.1
    turn = bend[:, None] * way
    safe = np.where(bend == 0, 1, bend)[:, None]
    x = np.where(bend[:, None] == 0, way, np.sin(turn) / safe)
    y = np.where(bend[:, None] == 0, 0, (1 - np.cos(turn)) / safe)
    return np.stack([x, y, turn], axis=-1)


FAN = arcs(
    np.array([0.0, 3.1, 6.2, 9.3, 12.4, 13.5, 8.6, 10.7]),
    np.array([0.0, 0.002, -0.003, 0.0007, 0.0015, -0.0011, 0.021, -0.013]),
)


@pytest.fixture(scope="module")
def scenes() -> ScenarioSet:
    return from_raw(make_scene(name) for name in SCENES)


@pytest.fixture(scope="module")
def poses() -> jax.Array:
    """`[8, 8, 41, 3]`: the fan, a little different in every scene."""
    rng = np.random.default_rng(0)
    scale = rng.uniform(0.95, 1.05, (len(SCENES), COUNT, 1, 1))
    return jnp.asarray(FAN * np.concatenate([scale, scale, np.ones_like(scale)], axis=-1))


@pytest.fixture(scope="module")
def evaluate(scenes: ScenarioSet) -> Any:
    """Compiled once for all tests: scores, and the gradient of a weighted sum of the terms."""

    def weighted(poses, weights, valid, temperature):
        scores = soft_score(scenes, poses, valid=valid, temperature=temperature)
        return weights @ jnp.stack([getattr(scores, name).sum() for name in TERMS]), scores

    graded = jax.jit(jax.grad(weighted, has_aux=True))
    everyone = jnp.ones((len(SCENES), COUNT), bool)

    def run(poses, name="total", temperature=0.1, valid=everyone):
        weights = jnp.asarray([float(term == name) for term in TERMS])
        gradient, scores = graded(poses, weights, valid, jnp.asarray(temperature))
        return scores, np.asarray(gradient)

    return run


@pytest.fixture(scope="module")
def hard(scenes: ScenarioSet, poses: jax.Array) -> Any:
    return score(scenes, np.asarray(poses), precision="f64")


@pytest.mark.slow
def test_every_term_converges_to_the_score(evaluate: Any, poses: jax.Array, hard: Any):
    converges([evaluate(poses, temperature=t)[0] for t in LADDER], hard)


@pytest.mark.slow
def test_every_term_converges_in_more_scenes(poses: jax.Array):
    scenes = from_raw(make_scene(name) for name in MORE_SCENES)
    hard = score(scenes, np.asarray(poses), precision="f64")
    converges([soft_score(scenes, poses, temperature=t) for t in LADDER], hard)


LADDER = (1.0, 0.1, 1e-3)


def converges(scores: list[SoftScores], hard: Any) -> None:
    for name in TERMS:
        wanted = getattr(hard, name)
        gap = np.stack([np.abs(getattr(s, name) - wanted) for s in scores])
        assert wanted.std() > 0, name
        # At 1e-3 a margin of 7 mm (7 per mille of a bound) decides. One of 32 may be closer.
        assert (gap[-1] > 1e-3).sum() <= 1, name
        assert (np.diff(gap.mean((1, 2))) <= 1e-12).all(), name


@pytest.mark.parametrize("name", TERMS)
def test_gradient_equals_finite_differences(name: str, evaluate: Any, poses: jax.Array):
    """Along random smooth directions, at a temperature at which the terms are neither 0 nor 1."""
    time = np.arange(41) * 0.1
    rng = np.random.default_rng(1)
    shape = (len(SCENES), COUNT, 1, 3)
    waves = [np.sin(k * time[:, None] + rng.uniform(0, 6, shape)) for k in (0.3, 0.8)]
    way = sum(rng.normal(0, 1, shape) * wave for wave in waves) * np.array([1.0, 1.0, 0.1])
    # The others turn in place at standstill, where the tracker's fit is all but singular.
    way[:, 0] = 0
    _, gradient = evaluate(poses, name, 0.5)
    assert np.isfinite(gradient).all()
    step = 1e-6
    ends = [getattr(evaluate(poses + s * step * way, name, 0.5)[0], name) for s in (1, -1)]
    # Per scene: proposals of one scene share their progress.
    slope = np.asarray(ends[0] - ends[1]).sum(1) / (2 * step)
    along = (gradient * way).sum((1, 2, 3))
    assert np.abs(slope).max() > 1e-2
    np.testing.assert_allclose(along, slope, rtol=2e-4, atol=2e-5)


def test_standing_ego_has_a_finite_gradient(evaluate: Any, poses: jax.Array):
    for name in TERMS:
        scores, gradient = evaluate(jnp.zeros_like(poses), name)
        assert np.isfinite(gradient).all()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(scores))


def test_far_from_everything(evaluate: Any, poses: jax.Array):
    scores, gradient = evaluate(poses.at[..., 1].add(jnp.linspace(0, 2000, 41)))
    assert np.isfinite(gradient).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(scores))


def test_padded_proposals_change_nothing(evaluate: Any, poses: jax.Array):
    valid = jnp.ones((len(SCENES), COUNT), bool).at[:, 5:].set(False)
    scores, gradient = evaluate(poses, valid=valid)
    # Rows that repeat valid ones change no maximum either.
    repeated, _ = evaluate(poses.at[:, 5:].set(poses[:, :1]))
    for name in TERMS:
        np.testing.assert_allclose(
            getattr(scores, name)[:, :5], getattr(repeated, name)[:, :5], atol=1e-12
        )
    assert not scores.total[:, 5:].any() and not gradient[:, 5:].any()
    assert np.abs(gradient[:, :5]).max() > 0
    _, gradient = evaluate(poses, valid=jnp.zeros_like(valid))
    assert not gradient.any()


@pytest.mark.slow
def test_ascent_leaves_a_collision(scenes: ScenarioSet, evaluate: Any, poses: jax.Array):
    """From straight into the parked car to a drive that the score itself likes."""
    row = SCENES.index("parked_car")
    start = jnp.asarray(arcs(np.full(COUNT, 10.0), np.zeros(COUNT)))
    start = start.at[:, :, 0].multiply(jnp.linspace(0.97, 1.03, COUNT)[:, None])
    before = score(scenes, np.asarray(start), precision="f64").total[row]
    assert before.max() < 0.1
    time = jnp.asarray(np.arange(41) * 0.1)
    basis = jnp.stack([time**2 / 16, time**3 / 64], axis=-1)  # the start stays as it is

    def drive(knobs):
        along, across = jnp.moveaxis(jnp.einsum("tk,pkc->ptc", basis, knobs), -1, 0)
        return jnp.stack([start[..., 0] + along, start[..., 1] + across, start[..., 2]], axis=-1)

    knobs = jnp.zeros((COUNT, 2, 2))
    optimiser = optax.adam(1.0)
    state = optimiser.init(knobs)
    full = lambda own: poses.at[row].set(own)
    for temperature in np.geomspace(3.0, 0.2, 25):
        own, back = jax.vjp(drive, knobs)
        scores, gradient = evaluate(full(own), temperature=float(temperature))
        # The logarithm pulls hardest at those that are worst off.
        pull = gradient[row] / np.maximum(np.asarray(scores.total)[row, :, None, None], 1e-3)
        (slope,) = back(jnp.asarray(-pull))
        change, state = optimiser.update(slope, state)
        knobs = jnp.asarray(optax.apply_updates(knobs, change))
    after = score(scenes, np.asarray(drive(knobs)), precision="f64").total[row]
    assert (after > 0.5).sum() >= COUNT // 2, after


@pytest.fixture
def compiled() -> Any:
    """Names of what JAX traces or compiles, as it happens."""
    events: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event.startswith("/jax/core/compile/"):
            events.append(event)

    monitoring.register_event_duration_secs_listener(listen)
    yield events
    monitoring.unregister_event_duration_listener(listen)


def test_other_values_compile_nothing(scenes: ScenarioSet, compiled: list[str]):
    """Outside `jit`; scores are those of the compiled loss, and float32 stays float32."""
    fan = FAN.astype(np.float32)
    params = PlannerParams()
    first = public_soft_score(scenes, fan, temperature=0.2, params=params)
    assert isinstance(first, SoftScores) and first.total.shape == (len(SCENES), COUNT)
    assert {leaf.dtype for leaf in jax.tree.leaves(first)} == {np.dtype(np.float32)}
    assert compiled
    other = params.replace(scoring=params.scoring.replace(progress_weight=4.0))
    soft_score(scenes, fan * np.float32(0.99), temperature=0.2, params=params)
    compiled.clear()
    moved = soft_score(scenes, fan * np.float32(0.9), temperature=0.3, params=other)
    assert not compiled
    assert not np.array_equal(moved.total, first.total)


def test_float32_agrees_with_float64(scenes: ScenarioSet, evaluate: Any, poses: jax.Array):
    single = soft_score(scenes, np.asarray(poses, np.float32), temperature=0.3)
    double, _ = evaluate(poses, temperature=0.3)
    for name in TERMS:
        # The discrete part may differ where float32 rounds over a threshold.
        gap = np.abs(getattr(single, name) - getattr(double, name))
        assert np.quantile(gap, 0.95) < 2e-3, name


@pytest.mark.slow
def test_pure_function_in_the_users_own_vmap(scenes: ScenarioSet, evaluate: Any, poses: jax.Array):
    config, params = fit_config(scenes, PlannerConfig()), PlannerParams()
    placed = to_device(scenes.batch, np.float64)
    placed = placed.replace(origin=jnp.asarray(placed.origin))

    def one(scene, own):
        now = jax.tree.map(lambda leaf: leaf[scene.num_history], scene.ego)
        cos, sin = jnp.cos(now.heading), jnp.sin(now.heading)
        x = now.x + cos * own[..., 0] - sin * own[..., 1]
        y = now.y + sin * own[..., 0] + cos * own[..., 1]
        states = poses_only(x, y, now.heading + own[..., 2])
        total = functional.soft_score_scene(scene, states, params, config, 0.1, tracker=True).total
        return total.sum(), total

    many = jax.jit(jax.vmap(jax.grad(one, argnums=1, has_aux=True)))
    gradient, totals = many(placed, poses)
    scores, wanted = evaluate(poses)
    np.testing.assert_allclose(totals, scores.total, atol=1e-9)
    np.testing.assert_allclose(gradient, wanted, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["none", "corrected"])
def test_other_trackers_and_intervals(scenes: ScenarioSet, tracker: Any):
    """Eight poses at 0.5 s, in map coordinates; the first scene alone."""
    one = ScenarioSet(jax.tree.map(lambda v: v[:1], scenes.batch), scenes.infos[:1], [])
    own = FAN[:, 5::5][None]
    hard = score(one, own, dt=0.5, tracker=tracker, precision="f64")
    soft = soft_score(one, own, dt=0.5, tracker=tracker, temperature=1e-4)
    for name in TERMS:
        gap = np.abs(getattr(soft, name) - getattr(hard, name))
        assert (gap > 1e-3).sum() <= 1, name
    now = jax.tree.map(lambda v: v[0, int(one.batch.num_history[0])], one.batch.ego)
    cos, sin = np.cos(now.heading), np.sin(now.heading)
    x = now.x + cos * own[..., 0] - sin * own[..., 1] + one.batch.origin[0, 0]
    y = now.y + sin * own[..., 0] + cos * own[..., 1] + one.batch.origin[0, 1]
    there = np.stack([x, y, now.heading + own[..., 2]], axis=-1)
    again = soft_score(one, there, dt=0.5, tracker=tracker, temperature=0.1, frame="global")
    wanted = soft_score(one, own, dt=0.5, tracker=tracker, temperature=0.1)
    np.testing.assert_allclose(again.total, wanted.total, atol=1e-6)
    grad = jax.grad(lambda p: soft_score(one, p, dt=0.5, tracker=tracker).total.sum())
    assert np.isfinite(grad(jnp.asarray(own * [[[[0.0]]]]))).all()


def test_what_is_kept_on_the_device_is_not_copied(scenes: ScenarioSet):
    mine = copy.copy(scenes)
    jax.eval_shape(lambda p: soft_score(mine, p).total, jnp.zeros((COUNT, 41, 3)))
    kept = vars(mine)["_placed"]
    assert kept and not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(dict(kept)))
    assert not vars(pickle.loads(pickle.dumps(mine)))["_placed"]


GOOD = np.zeros((COUNT, 41, 3))
NAN = GOOD.copy()
NAN[1, 2, 0] = np.nan


@pytest.mark.parametrize(
    "trajectories, settings, message",
    [
        (NAN, {}, r"trajectories\[0, 1, 2, 0\] is nan"),
        (GOOD[..., :2], {}, r"trajectories has shape \(\d+, 8, 41, 2\)"),
        (GOOD[None, None], {}, r"trajectories has shape \(1, 1, 8, 41, 3\)"),
        (GOOD[:0], {}, r"trajectories has shape"),
        (np.stack([GOOD] * 3), {}, "trajectories holds 3 scenes"),
        (GOOD.astype(int), {}, "trajectories is int64"),
        (GOOD[:, :20], {}, "trajectories has 20 steps at 0.1 s"),
        (GOOD, {"dt": 0.0}, "dt is 0.0"),
        (GOOD, {"temperature": 0.0}, "temperature is 0.0"),
        (GOOD, {"temperature": -1.0}, "temperature is -1.0"),
        (GOOD, {"temperature": np.nan}, "temperature is nan"),
        (GOOD, {"temperature": np.ones(2)}, r"temperature is \[1. 1.\]"),
        (GOOD, {"tracker": "mpc"}, "tracker is 'mpc'"),
        (GOOD, {"frame": "utm"}, "frame is 'utm'"),
        (GOOD.astype(np.float32), {"frame": "global"}, "map coordinates are float32"),
        (GOOD, {"valid": np.ones(3, bool)}, r"valid has shape \(3,\); expected \(4, 8\)"),
    ],
)
def test_bad_input_is_named(
    scenes: ScenarioSet, trajectories: np.ndarray, settings: dict[str, Any], message: str
):
    with pytest.raises(ValueError, match=message):
        soft_score(scenes, trajectories, **settings)
