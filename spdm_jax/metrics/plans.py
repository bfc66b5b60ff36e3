"""Open-loop metrics: plans against what the expert did next."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.geometry import principal, unwrap_masked
from spdm_jax.metrics.params import MetricConfig, OpenLoopParams
from spdm_jax.metrics.score import open_loop_score
from spdm_jax.simulation.controller import Plan, pose_at
from spdm_jax.types import Array

MEASURES = (
    "average_displacement",
    "final_displacement",
    "average_heading",
    "final_heading",
    "maximum_displacement",
)
"""Errors of a plan within a horizon, in order; m and rad."""


class ExpertPoses(NamedTuple):
    """The expert's rear-axle poses at the comparison times, 1 s apart, `[E]`.

    Attributes:
      x, y, heading: local frame.
      time: s.
    """

    x: Array
    y: Array
    heading: Array
    time: Array


class OpenLoopMetrics(struct.PyTreeNode, kw_only=True):
    """The open-loop metrics of one scenario, H horizons and F compared samples.

    Attributes:
      scores: `[5]` in the order of `metrics.OPEN_LOOP_SCORED`; NaN where a plan is too short.
      final: `[]` weighted score.
      errors: `[5, H, F]` in the order of `MEASURES`.
      by_horizon: `[5, H]` their means over the samples.
      mean: `[5]` their means over samples and horizons.
      by_sample: `[5, F]` their means over the horizons.
      miss_rate: `[H]` share of samples whose maximum error is too large.
    """

    scores: Array
    final: Array
    errors: Array
    by_horizon: Array
    mean: Array
    by_sample: Array
    miss_rate: Array


def comparison_indices(
    num_iterations: int, num_samples: int, step: int = 10, seconds: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Which samples are compared, and which recorded states they are compared with (host).

    Args:
      num_iterations: N, length of the scenario's window.
      num_samples: length of the run.
      step: samples per second.
      seconds: longest horizon.

    Returns:
      `[F]` samples of the run, and `[E]` recorded states, counted from iteration 0. The extension
      beyond the window starts from the last compared sample and not from the window's end, so one
      state may stand there twice (N = 151): the last horizons then are a second short, as in the
      reference.

    Source: nuPlan `planner_expert_average_l2_error_within_bound`.
    """
    samples = np.arange(0, num_samples, step)
    beyond = samples[-1] + step * np.arange(1, seconds + 1)
    return samples, np.concatenate([np.arange(0, num_iterations, step), beyond])


def _center(x, y, heading, shift) -> tuple[jax.Array, jax.Array]:
    return x + shift * jnp.cos(heading), y + shift * jnp.sin(heading)


def _expert_at(expert: ExpertPoses, time: jax.Array) -> tuple[jax.Array, ...]:
    """The expert's pose between its states; of repeated states the first."""
    right = jnp.searchsorted(expert.time, time, side="left", method="compare_all")
    right = jnp.clip(right, 1, expert.time.shape[0] - 1)
    before, after = expert.time[right - 1], expert.time[right]
    share = jnp.where(
        after > before, (time - before) / jnp.where(after > before, after - before, 1), 0
    )
    heading = unwrap_masked(expert.heading, jnp.ones(expert.heading.shape, bool))
    mix = lambda v: v[right - 1] + share * (v[right] - v[right - 1])
    return mix(expert.x), mix(expert.y), principal(mix(heading))


def _plan_errors(
    plan: Plan, sample: jax.Array, expert: ExpertPoses, shift: jax.Array, seconds: int
) -> tuple[jax.Array, jax.Array]:
    """Displacement and heading errors `[seconds]` of one plan; NaN beyond its end."""
    index = sample + 1 + jnp.arange(seconds)
    there = index < expert.time.shape[0]
    index = jnp.minimum(index, expert.time.shape[0] - 1)
    end = plan.start + plan.time[-1]
    covered = there & (expert.time[index] <= end)
    number = jnp.sum(covered)
    # A plan that ends within the last second is compared there once more, at its own end.
    slot = jnp.arange(seconds)
    at_end = (slot == number) & (number == seconds - 1) & there
    moment = jnp.where(at_end, end, expert.time[index])
    x, y, heading = pose_at(plan, moment - plan.start)
    goal = _expert_at(expert, end)
    goal_x, goal_y, goal_heading = (
        jnp.where(at_end, last, v[index])
        for last, v in zip(goal, (expert.x, expert.y, expert.heading), strict=True)
    )
    cx, cy = _center(x, y, heading, shift)
    gx, gy = _center(goal_x, goal_y, goal_heading, shift)
    known = covered | at_end
    distance = jnp.where(known, jnp.hypot(cx - gx, cy - gy), jnp.nan)
    turn = jnp.where(known, jnp.abs(principal(heading - goal_heading)), jnp.nan)
    return distance, turn


def open_loop(
    plans: Plan,
    expert: ExpertPoses,
    params: OpenLoopParams | None = None,
    config: MetricConfig | None = None,
) -> OpenLoopMetrics:
    """Computes nuPlan's open-loop metrics for the plans of one scenario.

    Args:
      plans: `[F]` plans of M poses, one per compared sample; see `comparison_indices`.
      expert: `[E]` recorded poses; the plan of sample f is compared with f + 1 ... f + 8.
      params: thresholds and weights; the official ones if None.
      config: horizons.

    Source: nuPlan `planner_expert_average_l2_error_within_bound` and its siblings.
    """
    params = OpenLoopParams() if params is None else params
    config = MetricConfig() if config is None else config
    horizons = config.comparison_horizons
    shift = jnp.asarray(params.vehicle.rear_axle_to_center, plans.x.dtype)
    samples = jnp.arange(plans.x.shape[0])
    distance, turn = jax.vmap(_plan_errors, in_axes=(0, 0, None, None, None))(
        plans, samples, expert, shift, horizons[-1]
    )
    errors = jnp.stack(
        [
            jnp.stack([jnp.mean(distance[:, :h], axis=1) for h in horizons]),
            jnp.stack([distance[:, h - 1] for h in horizons]),
            jnp.stack([jnp.mean(turn[:, :h], axis=1) for h in horizons]),
            jnp.stack([turn[:, h - 1] for h in horizons]),
            jnp.stack([jnp.max(distance[:, :h], axis=1) for h in horizons]),
        ]
    )
    mean = jnp.mean(errors, axis=(1, 2))
    worst = errors[-1]
    limit = jnp.asarray(params.max_miss, worst.dtype)[:, None]
    missed = (worst > limit).astype(worst.dtype)
    miss_rate = jnp.mean(jnp.where(jnp.isnan(worst), jnp.nan, missed), axis=1)
    few = jnp.where(
        jnp.any(jnp.isnan(miss_rate)), jnp.nan, jnp.all(miss_rate <= params.max_miss_rate)
    )
    bounds = (params.max_displacement, params.max_displacement)
    bounds += (params.max_heading, params.max_heading)
    terms = [jnp.maximum(1 - mean[i] / bound, 0) for i, bound in enumerate(bounds)]
    scores = jnp.stack([few.astype(mean.dtype), *terms])
    return OpenLoopMetrics(
        scores=scores,
        final=open_loop_score(scores, params.weights),
        errors=errors,
        by_horizon=jnp.mean(errors, axis=2),
        mean=mean,
        by_sample=jnp.mean(errors, axis=1),
        miss_rate=miss_rate,
    )
