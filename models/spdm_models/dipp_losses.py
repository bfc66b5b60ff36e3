"""DIPP's training losses and metrics, and the choice of the joint future that is refined."""

import jax
import jax.numpy as jnp
import optax
from flax import struct

from spdm_jax.types import Array

from .dipp import DIPPOutput
from .dipp_planner import (
    TRAIN_SOLVER,
    DIPPPlannerConfig,
    bicycle,
    problem_from_features,
    solve,
)

MATCHED_STRIDE = 10
"""The best future is found at every tenth step (1 s), the last one included."""
PLAN_COST_FACTOR = 1e-3
"""Factor of the planner's objective in the loss."""


class FutureLoss(struct.PyTreeNode, kw_only=True):
    """Loss of joint futures.

    Attributes:
      total: scalar.
      best_mode: `[B]` int32 index of the future that is nearest to the truth.
    """

    total: Array
    best_mode: Array


class PlannerLoss(struct.PyTreeNode, kw_only=True):
    """Loss with the planner in the loop.

    Attributes:
      total: futures.total + plan + 1e-3 plan_cost.
      futures: loss of the joint futures; the best one is refined.
      plan: loss of the refined plan.
      plan_cost: mean squared weighted residual of the refined plan.
      controls: `[B, T, 2]` refined controls.
      trajectory: `[B, T, 3]` x, y, heading along them.
    """

    total: Array
    futures: FutureLoss
    plan: Array
    plan_cost: Array
    controls: Array
    trajectory: Array


def plan_trajectories(controls: jax.Array, ego: jax.Array) -> jax.Array:
    """Drives controls from where the ego is.

    Args:
      controls: `[..., T, 2]` acceleration in m/s^2, steering angle in rad (clipped to 0.6).
      ego: `[8]` the ego now, DIPP's columns.

    Returns:
      `[..., T, 3]` x, y, heading.
    """

    def drive(one):
        motion = bicycle(one, ego[0], ego[1], ego[2], jnp.hypot(ego[3], ego[4]))
        return jnp.stack([motion.x, motion.y, motion.heading], axis=-1)

    flat = controls.reshape(-1, *controls.shape[-2:])
    return jax.vmap(drive)(flat).reshape(*controls.shape[:-1], 3)


def future_loss(
    plans: jax.Array, predictions: jax.Array, scores: jax.Array, truth: jax.Array
) -> FutureLoss:
    """Fits the best joint future to the truth, and the scores to the best future.

    Args:
      plans: `[B, M, T, 3]` the ego's trajectories.
      predictions: `[B, M, A, T, 3]` those of the neighbours.
      scores: `[B, M]` logits.
      truth: `[B, 1 + A, T, >= 3]` x, y, heading, ego first; zero where a neighbour is not seen.

    Source: DIPP `MFMA_loss`.
    """
    truth = truth[..., :3]
    futures = jnp.concatenate([plans[:, :, None], _seen(predictions, truth)], axis=2)
    matched = slice(MATCHED_STRIDE - 1, None, MATCHED_STRIDE)
    offset = futures[..., matched, :2] - truth[:, None, :, matched, :2]
    distance = jnp.sum(jnp.mean(jnp.linalg.norm(offset, axis=-1), axis=-1), axis=-1)
    best = jnp.argmin(jax.lax.stop_gradient(distance), axis=-1)
    chosen = pick(futures, best)
    agents = truth.shape[1]
    motion = _mean_huber(chosen, truth) + _mean_huber(chosen[:, :, -1], truth[:, :, -1])
    picked = jnp.take_along_axis(jax.nn.log_softmax(scores), best[:, None], axis=1)
    return FutureLoss(total=0.5 * agents * motion - jnp.mean(picked), best_mode=best)


def pick(values: jax.Array, mode: jax.Array) -> jax.Array:
    """Returns `[B, ...]`, of each sample of `[B, M, ...]` its mode `[B]`."""
    index = mode.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def planner_loss(
    output: DIPPOutput,
    ego: jax.Array,
    neighbors: jax.Array,
    ref_line: jax.Array,
    truth: jax.Array,
    config: DIPPPlannerConfig,
) -> PlannerLoss:
    """Loss of the joint futures and of the best one's plan after two unrolled planner steps.

    Args:
      output: of the network, batch `B`.
      ego: `[B, 8]` the ego now.
      neighbors: `[B, A, 9]` the neighbours now.
      ref_line: `[B, P, 5]` x, y, heading, curvature, info every 0.1 m.
      truth: `[B, 1 + A, T, >= 3]`.
      config: of the planner.

    Source: DIPP's training script with planning; differs: each sample's planner sees only that
    sample.
    """
    driven = jax.vmap(plan_trajectories)(output.controls, ego)
    futures = future_loss(driven, output.predictions, output.scores, truth)
    controls = pick(output.controls, futures.best_mode)
    predictions = pick(output.predictions, futures.best_mode)

    def refine(controls, ego, neighbors, predictions, ref_line):
        problem = problem_from_features(ego, neighbors, predictions, ref_line, output.cost_weights)
        solution = solve(controls, problem, TRAIN_SOLVER, config)
        refined = solution.values.reshape(controls.shape)
        return refined, plan_trajectories(refined, ego), solution.objective

    refined, trajectory, objective = jax.vmap(refine)(
        controls, ego, neighbors, predictions, ref_line
    )
    plan = _mean_huber(trajectory, truth[:, 0, :, :3])
    plan = plan + _mean_huber(trajectory[:, -1], truth[:, 0, -1, :3])
    cost = 2 * jnp.mean(objective) / config.num_residuals
    return PlannerLoss(
        total=futures.total + plan + PLAN_COST_FACTOR * cost,
        futures=futures,
        plan=plan,
        plan_cost=cost,
        controls=refined,
        trajectory=trajectory,
    )


def motion_metrics(plan: jax.Array, predictions: jax.Array, truth: jax.Array) -> jax.Array:
    """Mean and last distance of the plan to the truth, then of the predictions.

    Args:
      plan: `[B, T, >= 2]` of the ego.
      predictions: `[B, A, T, >= 3]` of the neighbours.
      truth: `[B, 1 + A, T, >= 3]`; a neighbour counts if its first x is not zero.

    Returns:
      `[4]` m; the last two are NaN without any neighbour.
    """
    truth = truth[..., :3]
    planned = jnp.linalg.norm(plan[..., :2] - truth[:, 0, :, :2], axis=-1)
    offset = _seen(predictions[..., :3], truth)[..., :2] - truth[:, 1:, :, :2]
    predicted = jnp.linalg.norm(offset, axis=-1)
    counts = truth[:, 1:, 0, 0] != 0
    number = jnp.sum(counts)
    mean = jnp.sum(jnp.where(counts, jnp.mean(predicted, axis=-1), 0)) / number
    last = jnp.sum(jnp.where(counts, predicted[..., -1], 0)) / number
    return jnp.stack([jnp.mean(planned), jnp.mean(planned[:, -1]), mean, last])


def _mean_huber(value: jax.Array, target: jax.Array) -> jax.Array:
    return jnp.mean(optax.losses.huber_loss(value, target))


def _seen(predictions: jax.Array, truth: jax.Array) -> jax.Array:
    """Zeroes `[B, (M,) A, T, 3]` where the truth `[B, 1 + A, T, 3]` is zero."""
    seen = truth[:, 1:] != 0
    if predictions.ndim == 5:
        seen = seen[:, None]
    return predictions * seen
