"""Encoders of DIPP's network: agents, lanes, crosswalks, and attention among them.

Source: DIPP `Predictor` (public code); submodules carry its names, so that its checkpoints load.
Shapes leave out leading batch axes; every call takes any number of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from .layers import (
    LSTM,
    Drop,
    Dropout,
    Embedding,
    LayerNorm,
    Linear,
    MultiheadAttention,
    Sequential,
    TransformerEncoder,
)

STATE_FEATURES = 8
"""Columns of an agent's state: x, y, heading, vx, vy, length, width, height."""
LANE_TYPES, LINE_TYPES, LIGHT_TYPES = 4, 11, 9
"""Numbers of types of lanes, of lines beside them and of lights; type 0 means none."""


class PaddedEmbedding(Embedding):
    """An embedding whose row 0 stands for "none": zero at the start, and no gradient."""

    def __init__(self, rows: int, width: int, rngs: nnx.Rngs):
        super().__init__(rows, width, rngs)
        drawn = np.array(self.weight[...])
        drawn[0] = 0
        self.weight = nnx.Param(drawn)

    def __call__(self, index: jax.Array) -> jax.Array:
        """Maps integers `[...]` to `[..., width]`."""
        rows = super().__call__(index)
        return jnp.where((index == 0)[..., None], jax.lax.stop_gradient(rows), rows)


class AgentEncoder(nnx.Module):
    """Last output of a two-layer LSTM over the history."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.motion = LSTM(STATE_FEATURES, width, 2, rngs)

    def __call__(self, history: jax.Array) -> jax.Array:
        """Maps `[..., H, >= 8]` to `[..., D]`."""
        return self.motion(history[..., :STATE_FEATURES])[..., -1, :]


class LaneEncoder(nnx.Module):
    """Points of lanes, one by one."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        half, quarter = width // 2, width // 4
        self.self_line = Linear(3, half, rngs)
        self.left_line = Linear(3, half, rngs)
        self.right_line = Linear(3, half, rngs)
        self.speed_limit = Linear(1, quarter, rngs)
        self.self_type = PaddedEmbedding(LANE_TYPES, quarter, rngs)
        self.left_type = PaddedEmbedding(LINE_TYPES, quarter, rngs)
        self.right_type = PaddedEmbedding(LINE_TYPES, quarter, rngs)
        self.traffic_light_type = PaddedEmbedding(LIGHT_TYPES, quarter, rngs)
        self.interpolating = Embedding(2, quarter, rngs)
        self.stop_sign = Embedding(2, quarter, rngs)
        self.stop_point = Embedding(2, quarter, rngs)
        self.pointnet = Sequential(
            Linear(2 * width, 3 * half, rngs),
            jax.nn.relu,
            Linear(3 * half, width, rngs),
            jax.nn.relu,
        )

    def __call__(self, points: jax.Array) -> jax.Array:
        """Maps `[..., 17]` to `[..., D]`."""
        kinds = points[..., 10:17].astype(jnp.int32)
        attributes = (
            self.self_type(kinds[..., 0])
            + self.left_type(kinds[..., 1])
            + self.right_type(kinds[..., 2])
            + self.traffic_light_type(kinds[..., 3])
            + self.stop_point(kinds[..., 4])
            + self.interpolating(kinds[..., 5])
            + self.stop_sign(kinds[..., 6])
        )
        parts = (
            self.self_line(points[..., :3]),
            self.left_line(points[..., 3:6]),
            self.right_line(points[..., 6:9]),
            self.speed_limit(points[..., 9:10]),
            attributes,
        )
        return self.pointnet(jnp.concatenate(parts, axis=-1))


class CrosswalkEncoder(nnx.Module):
    """Points of crosswalk outlines, one by one."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        half, quarter = width // 2, width // 4
        self.point_net = Sequential(
            Linear(3, quarter, rngs),
            jax.nn.relu,
            Linear(quarter, half, rngs),
            jax.nn.relu,
            Linear(half, width, rngs),
            jax.nn.relu,
        )

    def __call__(self, points: jax.Array) -> jax.Array:
        """Maps `[..., 3]` to `[..., D]`."""
        return self.point_net(points)


def _feedforward(width: int, rngs: nnx.Rngs) -> Sequential:
    return Sequential(
        LayerNorm(width),
        Linear(width, 4 * width, rngs),
        jax.nn.relu,
        Drop(),
        Linear(4 * width, width, rngs),
        LayerNorm(width),
    )


class CrossTransformer(nnx.Module):
    """Attention and a feed-forward net between two norms, without residuals."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.cross_attention = MultiheadAttention(width, 8, rngs)
        self.transformer = _feedforward(width, rngs)

    def __call__(self, query: jax.Array, key: jax.Array, dropout: Dropout) -> jax.Array:
        """Maps `[..., Q, D]` and `[..., K, D]` to `[..., Q, D]`."""
        return self.transformer(self.cross_attention(query, key, key, dropout), dropout)


class MultiModalTransformer(nnx.Module):
    """One attention per mode, then a feed-forward net that they share."""

    def __init__(self, width: int, modes: int, rngs: nnx.Rngs):
        self.attention = nnx.List(MultiheadAttention(width, 4, rngs) for _ in range(modes))
        self.ffn = _feedforward(width, rngs)

    def __call__(
        self, query: jax.Array, key: jax.Array, valid: jax.Array, dropout: Dropout
    ) -> jax.Array:
        """Maps `[..., 1, D]`, keys `[..., K, D]` and their mask `[..., K]` to `[..., M, D]`."""
        attended = [a(query, key, key, dropout, valid[..., None, :]) for a in self.attention]
        return self.ffn(jnp.concatenate(attended, axis=-2), dropout)


class Agent2Agent(nnx.Module):
    """Attention among actors."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.interaction_net = TransformerEncoder(2, width, 8, 4 * width, rngs, jax.nn.relu)


class Agent2Map(nnx.Module):
    """Attention of each actor to the points of its map elements, then to the elements."""

    def __init__(self, width: int, modes: int, rngs: nnx.Rngs):
        self.lane_attention = CrossTransformer(width, rngs)
        self.crosswalk_attention = CrossTransformer(width, rngs)
        self.map_attention = MultiModalTransformer(width, modes, rngs)

    def __call__(
        self,
        actors: jax.Array,
        lanes: jax.Array,
        crosswalks: jax.Array,
        valid: jax.Array,
        dropout: Dropout,
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the elements `[..., L + C, D]` and the modes `[..., M, D]` of actors `[..., D]`.

        Args:
          actors: `[..., D]`.
          lanes: `[..., L, P, D]`.
          crosswalks: `[..., C, P, D]`.
          valid: `[..., L + C]`.
          dropout: for all parts.
        """
        query = actors[..., None, :]
        elements = []
        for attend, points in (
            (self.lane_attention, lanes),
            (self.crosswalk_attention, crosswalks),
        ):
            shape = (*points.shape[:-2], 1, points.shape[-1])
            repeated = jnp.broadcast_to(query[..., None, :, :], shape)
            elements.append(attend(repeated, points, dropout)[..., 0, :])
        both = jnp.concatenate(elements, axis=-2)
        return both, self.map_attention(query, both, valid, dropout)
