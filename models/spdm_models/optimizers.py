"""Torch's optimisers in Optax: the same steps from the same gradients."""

import jax.numpy as jnp
import optax
from optax import tree_utils

from .params import Params
from .state_dict import trainable

# Torch's defaults where Optax has others.
WEIGHT_DECAY = 0.01
NORM_EPSILON = 1e-6


def clip_by_norm(limit: float) -> optax.GradientTransformation:
    """Scales all gradients down to a common norm; torch's `clip_grad_norm_`."""

    def update(updates: optax.Updates, state: optax.OptState, params: optax.Params | None = None):
        del params
        norm = tree_utils.tree_norm(updates)
        scale = jnp.minimum(limit / (norm + NORM_EPSILON), 1)
        return tree_utils.tree_scale(scale, updates), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def adamw(
    rate: optax.ScalarOrSchedule, params: Params, limit: float
) -> optax.GradientTransformation:
    """Returns torch's AdamW behind `clip_by_norm`; buffers of `params` do not decay."""
    decay = optax.adamw(rate, weight_decay=WEIGHT_DECAY, mask=trainable(params))
    return optax.chain(clip_by_norm(limit), decay)
