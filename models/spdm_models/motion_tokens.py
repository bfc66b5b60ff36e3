"""Motion as tokens: a vocabulary of short SE(2) steps, tokenising trajectories, nucleus sampling.

Poses are x, y, heading of a box's centre. A step is given in the frame of the pose before it.

Source: k-disks vocabulary and closed-loop tokenisation after Trajeglish (Philion et al. 2024);
nucleus sampling after Holtzman et al. 2020. No public code is followed.
"""

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_jax.geometry import wrap
from spdm_jax.types import Array

DrawOrder = Literal["token", "probability"]
"""How tokens line up for an inverse-CDF draw: by index, or most probable first."""


@dataclass(frozen=True)
class TokenBox:
    """The box whose corners measure how far apart two poses are.

    Attributes:
      length: m.
      width: m.
    """

    length: float = 1.0
    width: float = 1.0


class Tokenized(struct.PyTreeNode, kw_only=True):
    """A trajectory as tokens.

    Attributes:
      tokens: `[T]` int32.
      poses: `[T, 3]` where the tokens lead, heading in [-pi, pi].
      error: `[T]` mean corner distance to the true pose, m.
    """

    tokens: Array
    poses: Array
    error: Array


class Nucleus(struct.PyTreeNode, kw_only=True):
    """The most probable tokens.

    Attributes:
      keep: `[..., V]` bool.
      probs: `[..., V]` renormalised over the kept ones, 0 elsewhere.
    """

    keep: Array
    probs: Array


def steps_between(before: jax.Array, after: jax.Array) -> jax.Array:
    """Returns the steps `[..., 3]` that lead from poses to poses, both `[..., 3]`."""
    cos, sin = jnp.cos(before[..., 2]), jnp.sin(before[..., 2])
    dx, dy = after[..., 0] - before[..., 0], after[..., 1] - before[..., 1]
    turn = wrap(after[..., 2] - before[..., 2])
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=-1)


def compose(pose: jax.Array, step: jax.Array) -> jax.Array:
    """Returns the poses `[..., 3]` that steps `[..., 3]` lead to."""
    cos, sin = jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2])
    return jnp.stack(
        [
            pose[..., 0] + cos * step[..., 0] - sin * step[..., 1],
            pose[..., 1] + sin * step[..., 0] + cos * step[..., 1],
            wrap(pose[..., 2] + step[..., 2]),
        ],
        axis=-1,
    )


def corner_distance(a: jax.Array, b: jax.Array, box: TokenBox) -> jax.Array:
    """Mean distance of the corners of the box at two poses, m; poses `[..., 3]` broadcast."""
    return _mean_corner_gap(jnp, a, b, box)


def _mean_corner_gap(numerics, a, b, box: TokenBox) -> Any:
    cos = numerics.cos(a[..., 2]) - numerics.cos(b[..., 2])
    sin = numerics.sin(a[..., 2]) - numerics.sin(b[..., 2])
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    total = 0.0
    for front, left in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        x, y = 0.5 * front * box.length, 0.5 * left * box.width
        total = total + numerics.hypot(dx + x * cos - y * sin, dy + x * sin + y * cos)
    return total / 4


def k_disks(
    steps: np.ndarray,
    order: np.ndarray,
    radius: float,
    box: TokenBox,
    size: int | None = None,
) -> np.ndarray:
    """Picks steps that are more than a radius apart (host, NumPy).

    Args:
      steps: `[N, 3]` observed steps.
      order: `[N]` the order in which they are visited; a random one draws them evenly.
      radius: mean corner distance, m; steps within it of a kept one are covered by it.
      box: whose corners are meant.
      size: at most so many are kept.

    Returns:
      `[V]` int64 indices into `steps`, in the order of visit: the templates of the vocabulary.

    Raises:
      ValueError: a wrong shape, a value that is not finite, or an index out of range.
    """
    steps, order = np.asarray(steps), np.asarray(order)
    if steps.ndim != 2 or steps.shape[1] != 3:
        raise ValueError(f"steps has shape {steps.shape}; expected [N, 3]: x, y, heading")
    if not np.isfinite(steps).all():
        raise ValueError("steps has values that are not finite; leave these rows out")
    if order.size and (order.min() < 0 or order.max() >= len(steps)):
        raise ValueError(f"order names rows beyond the {len(steps)} steps")
    left, kept = order.astype(np.int64), []
    while left.size and (size is None or len(kept) < size):
        kept.append(left[0])
        left = left[_mean_corner_gap(np, steps[left], steps[left[0]], box) > radius]
    return np.array(kept, np.int64)


def tokenize(trajectory: jax.Array, templates: jax.Array, box: TokenBox) -> Tokenized:
    """Follows a trajectory with tokens, each chosen from where the tokens before it lead.

    Args:
      trajectory: `[T + 1, 3]` true poses, the first is where the tokens start.
      templates: `[V, 3]` steps of the vocabulary.
      box: whose corners measure the distance.
    """

    def follow(pose, truth):
        distance = corner_distance(templates, steps_between(pose, truth), box)
        token = jnp.argmin(distance)
        reached = compose(pose, templates[token])
        return reached, (token.astype(jnp.int32), reached, distance[token])

    _, (tokens, poses, error) = jax.lax.scan(follow, trajectory[0], trajectory[1:])
    return Tokenized(tokens=tokens, poses=poses, error=error)


def detokenize(tokens: jax.Array, templates: jax.Array, start: jax.Array) -> jax.Array:
    """Returns the poses `[T, 3]` that tokens `[T]` lead to from a pose `[3]`."""

    def follow(pose, token):
        reached = compose(pose, templates[token])
        return reached, reached

    return jax.lax.scan(follow, start, tokens)[1]


def nucleus(logits: jax.Array, mass: float) -> Nucleus:
    """Keeps the fewest tokens whose probabilities reach a mass.

    Args:
      logits: `[..., V]`.
      mass: 0 < mass <= 1; the token that reaches it is kept. Of equal ones the first come first.

    Raises:
      ValueError: the mass is out of range.
    """
    if not 0 < mass <= 1:
        raise ValueError(f"mass is {mass}; expected a number in (0, 1]")
    probs = jax.nn.softmax(logits)
    order = jnp.argsort(-probs, axis=-1, stable=True)
    ranked = jnp.take_along_axis(probs, order, axis=-1)
    before = jnp.cumsum(ranked, axis=-1) - ranked
    rank = jnp.argsort(order, axis=-1)
    # Rounding must not drop a token where all are wanted.
    keep = jnp.take_along_axis(before, rank, axis=-1) < mass if mass < 1 else probs >= 0
    probs = jnp.where(keep, probs, 0)
    return Nucleus(keep=keep, probs=probs / jnp.sum(probs, axis=-1, keepdims=True))


def draw(probs: jax.Array, uniform: jax.Array, order: DrawOrder = "token") -> jax.Array:
    """Draws tokens by the inverse of their cumulative probabilities.

    Args:
      probs: `[..., V]`, of `nucleus`.
      uniform: `[...]` numbers in [0, 1).
      order: in which the probabilities are summed.

    Returns:
      `[...]` int32, never a token of probability 0.
    """
    rows = jnp.arange(probs.shape[-1])
    if order == "probability":
        rows = jnp.argsort(-probs, axis=-1, stable=True)
        probs = jnp.take_along_axis(probs, rows, axis=-1)
    cumulative = jnp.cumsum(probs, axis=-1)
    place = jnp.sum(cumulative <= uniform[..., None], axis=-1)
    # Sums that end below 1 by rounding must not run off the last token with any probability.
    last = probs.shape[-1] - 1 - jnp.argmax(probs[..., ::-1] > 0, axis=-1)
    place = jnp.minimum(place, last)[..., None]
    rows = jnp.broadcast_to(rows, probs.shape)
    return jnp.take_along_axis(rows, place, axis=-1)[..., 0].astype(jnp.int32)
