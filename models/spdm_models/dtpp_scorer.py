"""DTPP's cost of a branch: eight weighted features and closeness to the neighbours.

Shapes leave out leading batch axes.

Source: DTPP, class Scorer.
"""

import jax
import jax.numpy as jnp
from flax import nnx, struct

from spdm_jax.config import DT
from spdm_models.layers import Linear, Sequential

# Upper ends of the driving features, by which they are divided, and the sign of each cost.
MAX_SPEED = 15.0
MAX_ACCELERATION = 4.0
MAX_JERK = 6.0
MAX_LATERAL_ACCELERATION = 5.0
COLLISION_WEIGHT = 10.0
COLLISION_DECAY = 0.2
"""Closeness falls by exp(-0.2 d^2), d in m."""
INTERACTION_FEATURES = 10
FIRST_ATTRIBUTE = 6
"""Columns of a neighbour from here on are length, width and type."""
LATENT_FEATURES = 4
COST_FEATURES = 8


class BranchScores(struct.PyTreeNode, kw_only=True):
    """Scores of N branches and what they are made of.

    Attributes:
      scores: `[N]` minus the cost, -inf for padded branches.
      weights: `[8]` of the features: speed, acceleration, jerk, lateral acceleration, 4 latent.
      driving: `[N, 4]` features of the ego's motion, each in [0, 1] but the speed's in [-1, 0].
      latent: `[N, 4]` learned features of the interaction, in (0, 1).
      collision: `[N]` closeness to the neighbours, summed over them and over time.
    """

    scores: jax.Array
    weights: jax.Array
    driving: jax.Array
    latent: jax.Array
    collision: jax.Array


class Scorer(nnx.Module):
    """Cost features, their weights and the score."""

    def __init__(self, width: int, variable_cost: bool, rngs: nnx.Rngs):
        self._variable_cost = variable_cost
        self.interaction_feature_encoder = Sequential(
            Linear(INTERACTION_FEATURES, width // 4, rngs),
            jax.nn.relu,
            Linear(width // 4, width, rngs),
        )
        self.interaction_feature_decoder = Sequential(
            Linear(width, width // 4, rngs),
            jax.nn.elu,
            Linear(width // 4, LATENT_FEATURES, rngs),
            jax.nn.sigmoid,
        )
        self.weights_decoder = Sequential(
            Linear(width, width // 4, rngs),
            jax.nn.elu,
            Linear(width // 4, COST_FEATURES, rngs),
            jax.nn.softplus,
        )

    def __call__(
        self,
        ego_token: jax.Array,
        neighbors: jax.Array,
        neighbor_valid: jax.Array,
        branches: jax.Array,
        branch_valid: jax.Array,
        futures: jax.Array,
    ) -> BranchScores:
        """Scores branches.

        Args:
          ego_token: `[D]`; only its shape counts unless costs are variable.
          neighbors: `[A, 11]` their current features.
          neighbor_valid: `[A]` bool.
          branches: `[N, T, 6]`.
          branch_valid: `[N]` bool.
          futures: `[N, A, T, 3]`.
        """
        context = ego_token if self._variable_cost else jnp.ones_like(ego_token)
        weights = self.weights_decoder(context)
        driving = driving_features(branches)
        pairs = interaction_features(neighbors, neighbor_valid, branches, futures)
        # Absent neighbours take part in the maximum, with what the biases make of zeros.
        strongest = jnp.max(self.interaction_feature_encoder(pairs), axis=-3)
        latent = self.interaction_feature_decoder(jnp.mean(strongest, axis=-2))
        offset = futures[..., :2] - branches[..., None, :, :2]
        square = jnp.sum(jnp.square(offset), axis=-1)
        close = jnp.exp(-COLLISION_DECAY * square)
        collision = jnp.sum(jnp.where(neighbor_valid[..., None, :, None], close, 0), (-2, -1))
        features = jnp.concatenate([driving, latent], axis=-1)
        cost = jnp.sum(weights[..., None, :] * features, axis=-1) + COLLISION_WEIGHT * collision
        return BranchScores(
            scores=jnp.where(branch_valid, -cost, -jnp.inf),
            weights=weights,
            driving=driving,
            latent=latent,
            collision=collision,
        )


def driving_features(branches: jax.Array) -> jax.Array:
    """Speed, acceleration, jerk and lateral acceleration of `[N, T, 6]` branches, `[N, 4]`."""
    speed, acceleration, curvature = branches[..., 3], branches[..., 4], branches[..., 5]
    jerk = jnp.diff(acceleration) / DT
    jerk = jnp.concatenate([jerk[..., :1], jerk], axis=-1)
    lateral = jnp.square(speed) * curvature

    def share(values, most):
        return jnp.clip(jnp.mean(values, axis=-1), 0, most) / most

    return jnp.stack(
        [
            -share(speed, MAX_SPEED),
            share(jnp.abs(acceleration), MAX_ACCELERATION),
            share(jnp.abs(jerk), MAX_JERK),
            share(jnp.abs(lateral), MAX_LATERAL_ACCELERATION),
        ],
        axis=-1,
    )


def interaction_features(
    neighbors: jax.Array, neighbor_valid: jax.Array, branches: jax.Array, futures: jax.Array
) -> jax.Array:
    """How each neighbour moves relative to the ego; zero for absent ones.

    Relative position and velocity are scaled by cosine and sine of the relative heading, not
    turned by it, as in the reference.

    Args:
      neighbors: `[A, 11]`.
      neighbor_valid: `[A]` bool.
      branches: `[N, T, 6]`.
      futures: `[N, A, T, 3]`.

    Returns:
      `[N, A, T, 10]` position, heading, velocity, then length, width and type of the neighbour.
    """
    ego = branches[..., None, :, :]
    turn = futures[..., 2] - ego[..., 2]
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    velocity = jnp.diff(futures[..., :2], axis=-2) / DT
    velocity = jnp.concatenate([velocity[..., :1, :], velocity], axis=-2)
    motion = jnp.stack(
        [
            (futures[..., 0] - ego[..., 0]) * cos,
            (futures[..., 1] - ego[..., 1]) * sin,
            jnp.arctan2(sin, cos),
            (velocity[..., 0] - ego[..., 3] * jnp.cos(ego[..., 2])) * cos,
            (velocity[..., 1] - ego[..., 3] * jnp.sin(ego[..., 2])) * sin,
        ],
        axis=-1,
    )
    attributes = neighbors[..., None, :, None, FIRST_ATTRIBUTE:]
    attributes = jnp.broadcast_to(attributes, (*motion.shape[:-1], attributes.shape[-1]))
    pairs = jnp.concatenate([motion, attributes], axis=-1)
    return jnp.where(neighbor_valid[..., None, :, None, None], pairs, 0)
