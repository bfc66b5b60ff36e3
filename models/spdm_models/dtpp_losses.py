"""DTPP's training: losses of both stages, metrics, optimiser.

Everything takes a batch: leading axes are averaged over as the reference's script does, that is
prediction and regulariser by the number of real steps in the whole batch.

Source: DTPP, `train.py` and `train_utils.py`.
"""

import jax
import jax.numpy as jnp
import optax
from flax import struct

from spdm_jax.types import Array
from spdm_models.dtpp import StageOutput
from spdm_models.optimizers import WEIGHT_DECAY, clip_by_norm
from spdm_models.state_dict import trainable

EGO_WEIGHT = 0.1
COST_WEIGHT = 0.01
SECOND_STAGE_WEIGHT = 0.2
CLIP_NORM = 5.0
"""Largest norm of the encoder's gradients, and of the decoder's."""


class DTPPTargets(struct.PyTreeNode, kw_only=True):
    """Recorded futures in the ego frame, first at 0.1 s.

    Attributes:
      ego_future: `[..., T, 3]` x, y, heading.
      neighbors_future: `[..., A, T, 3]` x, y, heading; zero where there is no track.
    """

    ego_future: Array
    neighbors_future: Array


class StageLoss(struct.PyTreeNode, kw_only=True):
    """Loss of one stage, all `[]`.

    Attributes:
      prediction: smooth L1 of the neighbours under branch 0, the one nearest to the expert's.
      choice: cross-entropy of the scores with branch 0 as the choice (maximum-entropy IRL).
      ego: smooth L1 of the ego's regularising future.
      weights: mean square of the cost weights.
    """

    prediction: jax.Array
    choice: jax.Array
    ego: jax.Array
    weights: jax.Array

    @property
    def total(self) -> jax.Array:
        """Weighted sum, `[]`."""
        return self.prediction + self.choice + EGO_WEIGHT * self.ego + COST_WEIGHT * self.weights


class DTPPLoss(struct.PyTreeNode, kw_only=True):
    """Losses of both stages.

    Attributes:
      first: of the first stage.
      second: of the second stage.
    """

    first: StageLoss
    second: StageLoss

    @property
    def total(self) -> jax.Array:
        """What training minimises, `[]`."""
        return self.first.total + SECOND_STAGE_WEIGHT * self.second.total


class DTPPMetrics(struct.PyTreeNode, kw_only=True):
    """Displacement of the best-scored branch and of the futures under it, m, all `[]`.

    Attributes:
      plan_ade: mean distance to the expert.
      plan_fde: distance at the end.
      prediction_ade: mean distance to the neighbours' tracks; NaN without any.
      prediction_fde: distance at the end; NaN without any.
    """

    plan_ade: jax.Array
    plan_fde: jax.Array
    prediction_ade: jax.Array
    prediction_fde: jax.Array


def smooth_l1(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Elementwise Huber loss with its bend at 1."""
    gap = jnp.abs(prediction - target)
    return jnp.where(gap < 1, 0.5 * gap**2, gap - 0.5)


def stage_loss(output: StageOutput, branches: jax.Array, targets: DTPPTargets) -> StageLoss:
    """Loss of one stage.

    Samples without any branch take no part.

    Args:
      output: of the network.
      branches: `[..., N, T, 6]`, padded with zeros; sorted, the one nearest to the expert first.
      targets: recorded futures.
    """
    driven = jnp.sum(branches[..., 0, :, :], axis=-1) != 0
    steps = jnp.maximum(jnp.sum(driven), 1)
    # Coordinate by coordinate, as in the reference: an exact zero counts as missing.
    known = targets.neighbors_future != 0
    futures = jnp.where(known, output.futures[..., 0, :, :, :], 0)
    prediction = smooth_l1(futures, targets.neighbors_future)
    prediction = jnp.where(driven[..., None, :, None], prediction, 0)
    ego = jnp.where(driven[..., None], smooth_l1(output.ego_future, targets.ego_future), 0)
    scores = output.scoring.scores
    real = jnp.isfinite(scores[..., 0])
    # Without -inf in the way of gradients.
    lowest = jnp.finfo(scores.dtype).min
    choice = -jax.nn.log_softmax(jnp.where(jnp.isfinite(scores), scores, lowest))[..., 0]
    choice = jnp.sum(jnp.where(real, choice, 0)) / jnp.maximum(jnp.sum(real), 1)
    return StageLoss(
        prediction=jnp.sum(prediction) / steps,
        choice=choice,
        ego=jnp.sum(ego) / steps,
        weights=jnp.mean(jnp.square(output.scoring.weights)),
    )


def loss(
    first: StageOutput,
    second: StageOutput,
    first_branches: jax.Array,
    second_branches: jax.Array,
    targets: DTPPTargets,
) -> DTPPLoss:
    """Losses of both stages; arguments as those of `stage_loss`."""
    return DTPPLoss(
        first=stage_loss(first, first_branches, targets),
        second=stage_loss(second, second_branches, targets),
    )


def metrics(output: StageOutput, branches: jax.Array, targets: DTPPTargets) -> DTPPMetrics:
    """Displacements of the second stage's best-scored branch.

    Args:
      output: of the second stage.
      branches: `[..., N, T, 6]`.
      targets: recorded futures.
    """
    best = jnp.argmax(output.scoring.scores, axis=-1)
    plan = jnp.take_along_axis(branches, best[..., None, None, None], axis=-3)[..., 0, :, :2]
    futures = jnp.take_along_axis(output.futures, best[..., None, None, None, None], axis=-4)
    known = targets.neighbors_future != 0
    futures = jnp.where(known, futures[..., 0, :, :, :], 0)
    planned = _distance(plan, targets.ego_future[..., :2])
    predicted = _distance(futures[..., :2], targets.neighbors_future[..., :2])
    present = known[..., 0, 0]
    over_tracks = lambda values: jnp.sum(jnp.where(present, values, 0)) / jnp.sum(present)
    return DTPPMetrics(
        plan_ade=jnp.mean(planned),
        plan_fde=jnp.mean(planned[..., -1]),
        prediction_ade=over_tracks(jnp.mean(predicted, axis=-1)),
        prediction_fde=over_tracks(predicted[..., -1]),
    )


def _distance(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(a - b), axis=-1))


def optimizer(learning_rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    """AdamW as in the reference's script, encoder and decoder clipped separately.

    Args:
      learning_rate: the script's is 2e-4, halved every 5 epochs.
    """
    parts = ("encoder", "decoder")
    clip = optax.partition({part: clip_by_norm(CLIP_NORM) for part in parts}, {p: p for p in parts})
    return optax.chain(clip, optax.adamw(learning_rate, weight_decay=WEIGHT_DECAY, mask=trainable))
