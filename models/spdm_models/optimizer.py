"""Optimisers as torch's training scripts use them: Adam or AdamW after clipping by global norm."""

import jax
import jax.numpy as jnp
import optax

CLIP_NORM = 5.0
"""Largest global gradient norm in the reference's scripts."""


def clip_by_global_norm(max_norm: float) -> optax.GradientTransformation:
    """Scales gradients by max_norm / (norm + 1e-6) where that is below 1.

    Source: torch `clip_grad_norm_`; optax's has no small constant.
    """

    def update(updates, state, params=None):
        del params
        norm = optax.tree.norm(updates)
        scale = jnp.minimum(1, max_norm / (norm + 1e-6))
        return jax.tree.map(lambda g: g * scale.astype(g.dtype), updates), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def adam(learning_rate: float, *, clip: float = CLIP_NORM) -> optax.GradientTransformation:
    """Returns torch's `Adam` with its default moments, after clipping."""
    return optax.chain(clip_by_global_norm(clip), optax.adam(learning_rate))


def adamw(
    learning_rate: float, *, clip: float = CLIP_NORM, weight_decay: float = 0.01, mask=None
) -> optax.GradientTransformation:
    """Returns torch's `AdamW` with its default moments, after clipping.

    Args:
      learning_rate: may be a schedule.
      clip: largest global norm.
      weight_decay: decay per step and learning rate, of all parameters (torch's default).
      mask: tree of bools, False for arrays that do not decay (`state_dict.trainable`).
    """
    decayed = optax.adamw(learning_rate, weight_decay=weight_decay, mask=mask)
    return optax.chain(clip_by_global_norm(clip), decayed)
