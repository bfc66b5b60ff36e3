"""The scene encoder that GameFormer and DTPP share: actors and map pieces as tokens.

Source: classes Encoder, VectorMapEncoder and CrossTransformer of GameFormer-Planner, and their
copies in DTPP (names and dropout places differ, the arithmetic does not).
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from spdm_jax.types import Array

from .layers import (
    LSTM,
    Buffer,
    Drop,
    Dropout,
    LayerNorm,
    Linear,
    MultiheadAttention,
    Sequential,
    TransformerEncoder,
    gelu,
)

EGO_FEATURES = 7
AGENT_FEATURES = 11
LANE_FEATURES = 7
POLYLINE_FEATURES = 3
# What both kinds of actor have in common: x, y, heading, vx, vy.
ACTOR_FEATURES = 5
LANE_POINTS = 50
CROSSWALK_POINTS = 30
# Neighbouring points that make one token.
SEGMENT_POINTS = 10
POSITION_BASE = 10000.0


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of the scene encoder.

    Attributes:
      width: of a token; the point networks use a quarter and a half of it, feed-forward layers
        four times as much.
      heads: of every attention.
      layers: transformer layers.
    """

    width: int = 256
    heads: int = 8
    layers: int = 3


class SceneFeatures(struct.PyTreeNode, kw_only=True):
    """Inputs of one scene, m, rad, s in the frame of the ego's rear axle now; padding is zero.

    All fields may have the same leading axes. H = 21 samples at 10 Hz, oldest first, the last is
    now.

    Attributes:
      ego_past: `[H, 7]` x, y, heading; vx, vy, ax, ay in the body frame of each sample.
      neighbors_past: `[N, H, 11]` x, y, heading, vx, vy, yaw rate, length, width, and one-hot
        vehicle, pedestrian, bicycle; nearest first.
      lanes: `[L, 50, 7]` x, y, heading and one-hot light green, yellow, red, unknown.
      crosswalks: `[C, 30, 3]` x, y, heading along the outline.
      route_lanes: `[R, 50, 3]` x, y, heading.
    """

    ego_past: Array
    neighbors_past: Array
    lanes: Array
    crosswalks: Array
    route_lanes: Array

    def validate(self) -> None:
        """Checks that the shapes fit together.

        Raises:
          ValueError: a field has a wrong rank or width.
        """
        lead = self.ego_past.shape[:-2]
        history = self.ego_past.shape[-2] if self.ego_past.ndim >= 2 else None
        expected = {
            "ego_past": (history, EGO_FEATURES),
            "neighbors_past": (None, history, AGENT_FEATURES),
            "lanes": (None, LANE_POINTS, LANE_FEATURES),
            "crosswalks": (None, CROSSWALK_POINTS, POLYLINE_FEATURES),
            "route_lanes": (None, LANE_POINTS, POLYLINE_FEATURES),
        }
        for name, shape in expected.items():
            wanted = (*lead, *shape)
            given = getattr(self, name).shape
            fits = len(given) == len(wanted) and all(
                w is None or g == w for g, w in zip(given, wanted, strict=True)
            )
            if not fits:
                text = ", ".join("any" if w is None else str(w) for w in wanted)
                raise ValueError(f"features.{name} has shape {given}, expected ({text})")


class SceneEncoding(struct.PyTreeNode, kw_only=True):
    """Tokens of one scene: ego, N neighbours, lane segments, crosswalk segments.

    Attributes:
      tokens: `[K, D]`.
      valid: `[K]` bool, True where the token stands for something. An ego that stands exactly
        still counts as absent, as in the reference.
      actors: `[1 + N, H, 5]` x, y, heading, vx, vy.
    """

    tokens: jax.Array
    valid: jax.Array
    actors: jax.Array


def position_table(points: int, width: int) -> np.ndarray:
    """Returns the `[1, points, width]` float32 sinusoidal code, rounded where torch rounds."""
    single = np.float32
    exponent = (np.arange(0, width, 2) * single(-math.log(POSITION_BASE) / width)).astype(single)
    rate = np.exp(exponent.astype(float)).astype(single)
    angle = (np.arange(points, dtype=single)[:, None] * rate).astype(float)
    table = np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(1, points, width)
    return table.astype(single)


class PositionalEncoding(nnx.Module):
    """Adds a code of the point index, then dropout."""

    def __init__(self, points: int, width: int):
        self.pe = Buffer(position_table(points, width))

    def __call__(self, x: jax.Array, dropout: Dropout) -> jax.Array:
        """Maps `[..., points, width]` to the same shape."""
        return dropout(x + jax.lax.stop_gradient(self.pe[...][0]))


class VectorMapEncoder(nnx.Module):
    """A point network over polylines; every 10 points make one token."""

    def __init__(self, inputs: int, points: int, width: int, rngs: nnx.Rngs):
        self.point_net = Sequential(
            Linear(inputs, width // 4, rngs),
            jax.nn.relu,
            Linear(width // 4, width // 2, rngs),
            jax.nn.relu,
            Linear(width // 2, width, rngs),
        )
        self.position_encode = PositionalEncoding(points, width)

    def __call__(self, lines: jax.Array, dropout: Dropout) -> tuple[jax.Array, jax.Array]:
        """Encodes polylines.

        Args:
          lines: `[..., L, P, inputs]`, padded with zeros.
          dropout: after the position code.

        Returns:
          tokens `[..., L * P / 10, D]`, and `[..., L * P / 10]` True where no point of the
          segment has an x of exactly zero.
        """
        *lead, count, points, _ = lines.shape
        segments = (*lead, count * points // SEGMENT_POINTS, SEGMENT_POINTS)
        encoded = self.position_encode(self.point_net(lines), dropout)
        tokens = jnp.max(encoded.reshape(*segments, -1), axis=-2)
        return tokens, jnp.all(lines[..., 0].reshape(segments) != 0, axis=-1)


class AgentEncoder(nnx.Module):
    """Two LSTM layers over a history; the state after the last sample."""

    def __init__(self, inputs: int, width: int, rngs: nnx.Rngs):
        self.motion = LSTM(inputs, width, 2, rngs)

    def __call__(self, history: jax.Array) -> jax.Array:
        """Maps `[..., H, inputs]` to `[..., width]`."""
        return self.motion(history)[..., -1, :]


class SceneEncoder(nnx.Module):
    """Histories and polylines to tokens that have seen each other."""

    def __init__(self, config: EncoderConfig, rngs: nnx.Rngs):
        width = config.width
        self.agent_encoder = AgentEncoder(AGENT_FEATURES, width, rngs)
        self.ego_encoder = AgentEncoder(EGO_FEATURES, width, rngs)
        self.lane_encoder = VectorMapEncoder(LANE_FEATURES, LANE_POINTS, width, rngs)
        self.crosswalk_encoder = VectorMapEncoder(POLYLINE_FEATURES, CROSSWALK_POINTS, width, rngs)
        self.fusion_encoder = TransformerEncoder(
            config.layers, width, config.heads, 4 * width, rngs
        )

    def __call__(self, features: SceneFeatures, dropout: Dropout) -> SceneEncoding:
        """Encodes a scene; every field of `features` may have the same leading axes."""
        ego, neighbors = features.ego_past, features.neighbors_past
        actors = jnp.concatenate(
            [ego[..., None, :, :ACTOR_FEATURES], neighbors[..., :ACTOR_FEATURES]], axis=-3
        )
        lanes, lanes_valid = self.lane_encoder(features.lanes, dropout)
        crosswalks, crosswalks_valid = self.crosswalk_encoder(features.crosswalks, dropout)
        ego_token = self.ego_encoder(ego)[..., None, :]
        tokens = jnp.concatenate(
            [ego_token, self.agent_encoder(neighbors), lanes, crosswalks], axis=-2
        )
        actors_valid = jnp.sum(actors[..., -1, :], axis=-1) != 0
        valid = jnp.concatenate([actors_valid, lanes_valid, crosswalks_valid], axis=-1)
        return SceneEncoding(
            tokens=self.fusion_encoder(tokens, valid, dropout), valid=valid, actors=actors
        )


class CrossTransformer(nnx.Module):
    """Attention without a residual of the query, then a feed-forward block with one."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs):
        self.cross_attention = MultiheadAttention(width, heads, rngs)
        self.norm_1 = LayerNorm(width)
        self.norm_2 = LayerNorm(width)
        self.ffn = feedforward(width, rngs)

    def __call__(
        self,
        query: jax.Array,
        key: jax.Array,
        value: jax.Array,
        dropout: Dropout,
        valid: jax.Array | None = None,
        bias: jax.Array | None = None,
    ) -> jax.Array:
        """Attends as `MultiheadAttention` does, whose arguments these are."""
        attended = self.norm_1(self.cross_attention(query, key, value, dropout, valid, bias))
        return self.norm_2(attended + self.ffn(attended, dropout))


def feedforward(width: int, rngs: nnx.Rngs) -> Sequential:
    """Returns the block that follows an attention: four times as wide inside, dropout twice."""
    return Sequential(
        Linear(width, 4 * width, rngs), gelu, Drop(), Linear(4 * width, width, rngs), Drop()
    )
