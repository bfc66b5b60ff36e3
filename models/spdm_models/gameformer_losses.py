"""GameFormer's training loss and metrics.

Source: GameFormer-Planner, `train_predictor.py` and `train_utils.py` (level_k_loss, planning_loss,
motion_metrics).
"""

import jax
import jax.numpy as jnp
import optax
from flax import struct

from spdm_jax.types import Array

from .gameformer import GameFormerConfig, GameFormerOutput, LevelOutput, apply
from .params import Params
from .scene_encoder import SceneFeatures

LABEL_SMOOTHING = 0.2
MAX_LOG_SIGMA = 2.0


class Targets(struct.PyTreeNode, kw_only=True):
    """What happened; `B` leading axes in all fields.

    Attributes:
      ego: `[B, T, 3]` x, y, heading.
      neighbors: `[B, N, T, 3]` of the predicted neighbours, zero where there is no sample.
    """

    ego: Array
    neighbors: Array


class Losses(struct.PyTreeNode, kw_only=True):
    """Scalars; `total` is the sum of the others.

    Attributes:
      level_k: likelihood of the best modes and their scores, over all levels.
      planning: of the ego's plan.
    """

    level_k: jax.Array
    planning: jax.Array

    @property
    def total(self) -> jax.Array:
        """What training minimises."""
        return self.level_k + self.planning


class MotionMetrics(struct.PyTreeNode, kw_only=True):
    """Scalars, m and rad; predictions are NaN where no neighbour has a future.

    Attributes:
      plan_ade: mean distance of the plan to the driven path.
      plan_fde: at the end.
      heading_ade: mean heading error of the plan.
      heading_fde: at the end.
      prediction_ade: mean distance of the best modes of the last level.
      prediction_fde: at the end.
    """

    plan_ade: jax.Array
    plan_fde: jax.Array
    heading_ade: jax.Array
    heading_fde: jax.Array
    prediction_ade: jax.Array
    prediction_fde: jax.Array


def loss(
    params: Params,
    config: GameFormerConfig,
    features: SceneFeatures,
    targets: Targets,
    key: jax.Array | None = None,
) -> jax.Array:
    """Returns the training loss of a batch (leading axis in all fields)."""
    output = apply(params, config, features, key=key)
    return losses(output, targets).total


def losses(output: GameFormerOutput, targets: Targets) -> Losses:
    """Returns the parts of the training loss of a batch."""
    level_k = jnp.sum(jnp.stack([_level_loss(level, targets) for level in output.levels]))
    huber = lambda plan, truth: jnp.mean(optax.losses.huber_loss(plan, truth))
    planning = huber(output.plan, targets.ego)
    planning += huber(output.plan[..., -1, :], targets.ego[..., -1, :])
    return Losses(level_k=level_k, planning=planning)


def metrics(output: GameFormerOutput, targets: Targets) -> MotionMetrics:
    """Returns how far plan and predictions of a batch are from what happened."""
    offset = output.plan - targets.ego
    distance = jnp.hypot(offset[..., 0], offset[..., 1])
    turned = jnp.abs(jnp.fmod(offset[..., 2] + jnp.pi, 2 * jnp.pi) - jnp.pi)
    truth = _truth(targets)
    best = _best(_masked(output.levels[-1].gaussians, targets), truth)[0][..., 1:, :, :2]
    missed = jnp.linalg.norm(best - truth[..., 1:, :, :], axis=-1)
    # The reference counts a neighbour that leaves early as on the spot at the end.
    present = _seen(targets)[..., 0]
    return MotionMetrics(
        plan_ade=jnp.mean(distance),
        plan_fde=jnp.mean(distance[..., -1]),
        heading_ade=jnp.mean(turned),
        heading_fde=jnp.mean(turned[..., -1]),
        prediction_ade=jnp.mean(jnp.mean(missed, axis=-1), where=present),
        prediction_fde=jnp.mean(missed[..., -1], where=present),
    )


def _truth(targets: Targets) -> jax.Array:
    """Positions `[B, A, T, 2]` of ego and neighbours."""
    return jnp.concatenate([targets.ego[..., None, :, :2], targets.neighbors[..., :2]], axis=-3)


def _seen(targets: Targets) -> jax.Array:
    """`[B, N, T]` True where a neighbour's x is not exactly zero."""
    return targets.neighbors[..., 0] != 0


def _masked(gaussians: jax.Array, targets: Targets) -> jax.Array:
    """Sets the neighbours' predictions to zero where there is no truth; the ego's stay."""
    seen = _seen(targets)[..., None, :, None]
    return jnp.concatenate([gaussians[..., :1, :, :, :], gaussians[..., 1:, :, :, :] * seen], -4)


def _miss(gaussians: jax.Array, truth: jax.Array) -> jax.Array:
    """Mean distance `[B, A, M]` over all samples, missing ones included as zeros."""
    offset = jax.lax.stop_gradient(gaussians[..., :2]) - truth[..., None, :, :]
    return jnp.mean(jnp.linalg.norm(offset, axis=-1), axis=-1)


def _best(gaussians: jax.Array, truth: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The nearest mode of each agent: `[B, A, T, 4]` and its index `[B, A]`."""
    index = jnp.argmin(_miss(gaussians, truth), axis=-1)
    chosen = jnp.take_along_axis(gaussians, index[..., None, None, None], axis=-3)
    return chosen[..., 0, :, :], index


def _level_loss(level: LevelOutput, targets: Targets) -> jax.Array:
    truth = _truth(targets)
    best, index = _best(_masked(level.gaussians, targets), truth)
    log_sigma = jnp.clip(best[..., 2:], -MAX_LOG_SIGMA, MAX_LOG_SIGMA)
    scaled = (truth - best[..., :2]) * jnp.exp(-log_sigma)
    likelihood = jnp.sum(log_sigma + 0.5 * jnp.square(scaled), axis=-1)
    modes = level.scores.shape[-1]
    wanted = optax.smooth_labels(jax.nn.one_hot(index, modes, dtype=scaled.dtype), LABEL_SMOOTHING)
    score = optax.safe_softmax_cross_entropy(level.scores, wanted)
    present = truth[..., 0, 0] != 0
    return jnp.mean(likelihood) + jnp.mean(jnp.where(present, score, 0))
