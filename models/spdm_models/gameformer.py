"""GameFormer: interaction levels over a scene encoding, and the ego's plan.

Source: GameFormer-Planner (classes GameFormer, Encoder, Decoder, NeuralPlanner). Differs: where
neither the ego (exactly at rest) nor a neighbour counts as present, the reference gives NaN from
level 1 on; here the ego then attends to itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from .layers import Drop, Dropout, Embedding, LayerNorm, Linear, MultiheadAttention, Sequential
from .params import Params, abstract_params, bind, init_params
from .scene_encoder import (
    ACTOR_FEATURES,
    LANE_POINTS,
    POLYLINE_FEATURES,
    CrossTransformer,
    EncoderConfig,
    SceneEncoder,
    SceneEncoding,
    SceneFeatures,
    VectorMapEncoder,
    feedforward,
)
from .state_dict import Extras

DT = 0.1
# Bounds of the planned acceleration, m/s^2, and curvature, 1/m.
MAX_ACCEL = 5.0
MAX_CURVATURE = 0.5
# Forward part of a step below which the reference takes the heading as sideways, m.
MIN_FORWARD_STEP = 1e-6
# mu_x, mu_y, log_sigma_x, log_sigma_y
GAUSSIAN = 4


@dataclass(frozen=True)
class GameFormerConfig:
    """Sizes of the network.

    Attributes:
      encoder: of the scene encoder.
      levels: interaction levels above the first prediction (N_l).
      modes: futures per agent (M).
      neighbors: predicted neighbours; the ego comes before them.
      steps: future samples of 0.1 s.
    """

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    levels: int = 3
    modes: int = 6
    neighbors: int = 10
    steps: int = 80


class LevelOutput(struct.PyTreeNode, kw_only=True):
    """What one decoder says; A = 1 + neighbours, the ego first.

    Attributes:
      content: `[A, M, D]` query content, the input of the next level.
      gaussians: `[A, M, T, 4]` mean x, y (m, ego frame), log of the standard deviations.
      scores: `[A, M]` logits of the modes.
    """

    content: jax.Array
    gaussians: jax.Array
    scores: jax.Array


class GameFormerOutput(struct.PyTreeNode, kw_only=True):
    """Result for one scene.

    Attributes:
      encoding: of the scene.
      levels: one per decoder, from level 0 to N_l.
      plan: `[T, 3]` x, y, heading of the ego, first sample one step ahead.
    """

    encoding: SceneEncoding
    levels: tuple[LevelOutput, ...]
    plan: jax.Array


class GaussianHead(nnx.Module):
    """Futures and scores from query content."""

    def __init__(self, config: GameFormerConfig, rngs: nnx.Rngs):
        width, self._steps = config.encoder.width, config.steps
        self.gaussian = Sequential(
            Linear(width, 2 * width, rngs),
            jax.nn.elu,
            Drop(),
            Linear(2 * width, config.steps * GAUSSIAN, rngs),
        )
        self.score = Sequential(
            Linear(width, width // 4, rngs), jax.nn.elu, Linear(width // 4, 1, rngs)
        )

    def __call__(self, content: jax.Array, current: jax.Array, dropout: Dropout) -> LevelOutput:
        """Decodes content `[..., A, M, D]`; means are offsets to `current` `[..., A, 5]`."""
        raw = self.gaussian(content, dropout)
        raw = raw.reshape(*raw.shape[:-1], self._steps, GAUSSIAN)
        here = current[..., None, None, :2]
        gaussians = jnp.concatenate([raw[..., :2] + here, raw[..., 2:]], axis=-1)
        scores = self.score(content)[..., 0]
        return LevelOutput(content=content, gaussians=gaussians, scores=scores)


class InitialPredictor(nnx.Module):
    """Level 0: modes of each agent ask the scene."""

    def __init__(self, config: GameFormerConfig, rngs: nnx.Rngs):
        width, heads = config.encoder.width, config.encoder.heads
        self.multi_modal_query_embedding = Embedding(config.modes, width, rngs)
        self.agent_query_embedding = Embedding(config.neighbors + 1, width, rngs)
        self.query_encoder = CrossTransformer(width, heads, rngs)
        self.predictor = GaussianHead(config, rngs)

    def __call__(self, encoding: SceneEncoding, dropout: Dropout) -> LevelOutput:
        """Predicts the first agents of an encoding."""
        modes = self.multi_modal_query_embedding.weight[...]
        agents = self.agent_query_embedding.weight[...]
        count, tokens = len(agents), encoding.tokens
        query = tokens[..., :count, None, :] + modes + agents[:, None]
        content = self.query_encoder(
            _merged(query), tokens, tokens, dropout, encoding.valid[..., None, :]
        ).reshape(query.shape)
        return self.predictor(content, encoding.actors[..., :count, -1, :], dropout)


class FutureEncoder(nnx.Module):
    """Point network over predicted futures; one for all levels."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.mlp = Sequential(
            Linear(ACTOR_FEATURES, width // 4, rngs), jax.nn.relu, Linear(width // 4, width, rngs)
        )

    def __call__(self, futures: jax.Array, current: jax.Array) -> jax.Array:
        """Maps futures `[..., A, M, T, 2]` of agents at `[..., A, 5]` to `[..., A, M, D]`."""
        here = jnp.broadcast_to(current[..., None, None, :2], (*futures.shape[:-2], 1, 2))
        step = jnp.diff(jnp.concatenate([here, futures], axis=-2), axis=-2)
        # The clamp is the reference's: agents that move backwards in x get a wrong heading.
        heading = jnp.arctan2(step[..., 1], jnp.maximum(step[..., 0], MIN_FORWARD_STEP))
        features = jnp.concatenate([futures, heading[..., None], step / DT], axis=-1)
        return jnp.max(self.mlp(jax.lax.stop_gradient(features)), axis=-2)


class SelfTransformer(nnx.Module):
    """Self-attention and feed-forward over agents, each followed by add and norm."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs):
        self.self_attention = MultiheadAttention(width, heads, rngs)
        self.norm_1 = LayerNorm(width)
        self.norm_2 = LayerNorm(width)
        self.ffn = feedforward(width, rngs)

    def __call__(self, x: jax.Array, valid: jax.Array, dropout: Dropout) -> jax.Array:
        """Maps `[..., A, D]` to the same shape; `valid` `[..., A]` marks present agents."""
        attended = self.self_attention(x, x, x, dropout, valid[..., None, :])
        attended = self.norm_1(attended + x)
        return self.norm_2(self.ffn(attended, dropout) + attended)


class InteractionDecoder(nnx.Module):
    """Level k: each agent sees the scene and the others' futures of level k - 1."""

    def __init__(self, future_encoder: FutureEncoder, config: GameFormerConfig, rngs: nnx.Rngs):
        width, heads = config.encoder.width, config.encoder.heads
        self.interaction_encoder = SelfTransformer(width, heads, rngs)
        self.query_encoder = CrossTransformer(width, heads, rngs)
        self.future_encoder = future_encoder
        self.decoder = GaussianHead(config, rngs)

    def __call__(
        self, encoding: SceneEncoding, before: LevelOutput, dropout: Dropout
    ) -> LevelOutput:
        """Predicts the agents of `before` once more."""
        count = before.scores.shape[-2]
        current = encoding.actors[..., :count, -1, :]
        futures = self.future_encoder(before.gaussians[..., :2], current)
        share = jax.nn.softmax(before.scores)[..., None]
        present = encoding.valid[..., :count]
        interaction = self.interaction_encoder(
            jnp.mean(share * futures, axis=-2), _with_ego(present), dropout
        )
        tokens = jnp.concatenate([interaction, encoding.tokens], axis=-2)
        others = present[..., None, :] & ~np.eye(count, dtype=bool)
        scene = jnp.broadcast_to(
            encoding.valid[..., None, :], (*others.shape[:-1], encoding.valid.shape[-1])
        )
        valid = jnp.concatenate([others, scene], axis=-1)
        query = before.content + futures
        content = self.query_encoder(
            _merged(query), tokens, tokens, dropout, jnp.repeat(valid, query.shape[-2], axis=-2)
        ).reshape(query.shape)
        return self.decoder(content, current, dropout)


class Decoder(nnx.Module):
    """All levels."""

    def __init__(self, config: GameFormerConfig, rngs: nnx.Rngs):
        self.initial_predictor = InitialPredictor(config, rngs)
        future_encoder = FutureEncoder(config.encoder.width, rngs)
        self.interaction_stage = nnx.List(
            InteractionDecoder(future_encoder, config, rngs) for _ in range(config.levels)
        )

    def __call__(
        self, encoding: SceneEncoding, neighbors: jax.Array | None, dropout: Dropout
    ) -> tuple[LevelOutput, ...]:
        """Decodes level after level; `neighbors` replaces means, see `apply`."""
        level = _replaced(self.initial_predictor(encoding, dropout), neighbors)
        levels = [level]
        for stage in self.interaction_stage:
            level = _replaced(stage(encoding, level, dropout), neighbors)
            levels.append(level)
        return tuple(levels)


class NeuralPlanner(nnx.Module):
    """The ego's plan from its last content and the route."""

    def __init__(self, config: GameFormerConfig, rngs: nnx.Rngs):
        width, heads = config.encoder.width, config.encoder.heads
        self.route_fusion = CrossTransformer(width, heads, rngs)
        self.plan_decoder = Sequential(
            Linear(2 * width, width, rngs),
            jax.nn.elu,
            Drop(),
            Linear(width, 2 * config.steps, rngs),
        )
        self.route_encoder = VectorMapEncoder(POLYLINE_FEATURES, LANE_POINTS, width, rngs)

    def __call__(self, ego: jax.Array, features: SceneFeatures, dropout: Dropout) -> jax.Array:
        """Maps the ego's content `[..., M, D]` to a plan `[..., T, 3]`."""
        route, valid = self.route_encoder(features.route_lanes, dropout)
        valid = valid.at[..., 0].set(True)
        fused = self.route_fusion(ego, route, route, dropout, valid[..., None, :])
        joined = jnp.max(jnp.concatenate([ego, fused], axis=-1), axis=-2)
        controls = self.plan_decoder(joined, dropout)
        controls = controls.reshape(*controls.shape[:-1], -1, 2)
        return rollout(features.ego_past[..., -1, :], controls)


class GameFormer(nnx.Module):
    """Encoder, decoders, planner."""

    def __init__(self, config: GameFormerConfig, rngs: nnx.Rngs):
        self.encoder = SceneEncoder(config.encoder, rngs)
        self.decoder = Decoder(config, rngs)
        self.planner = NeuralPlanner(config, rngs)

    def __call__(
        self, features: SceneFeatures, neighbors: jax.Array | None, dropout: Dropout
    ) -> GameFormerOutput:
        """Runs the network, see `apply`."""
        encoding = self.encoder(features, dropout)
        levels = self.decoder(encoding, neighbors, dropout)
        plan = self.planner(levels[-1].content[..., 0, :, :], features, dropout)
        return GameFormerOutput(encoding=encoding, levels=levels, plan=plan)


def init(config: GameFormerConfig, key: jax.Array) -> Params:
    """Returns the variables of a new network."""
    return init_params(_build(config), key)


def abstract(config: GameFormerConfig) -> Params:
    """Returns the shapes of the network's variables."""
    return abstract_params(_build(config))


def apply(
    params: Params,
    config: GameFormerConfig,
    features: SceneFeatures,
    neighbors: jax.Array | None = None,
    key: jax.Array | None = None,
) -> GameFormerOutput:
    """Predicts neighbours and ego, and plans.

    Args:
      params: variables, by `init` or a checkpoint.
      config: sizes.
      features: inputs; fields, and then all results, may have the same leading axes.
      neighbors: `[neighbors, T, 2]` positions that take the place of the neighbours' predicted
        means after every decoder (perfect predictions, or zeros for none); None keeps the
        network's own.
      key: random key of dropout; None for inference.

    Raises:
      ValueError: a shape does not fit.
    """
    features.validate()
    given = features.neighbors_past.shape[-3]
    if given < config.neighbors:
        raise ValueError(
            f"features.neighbors_past holds {given} neighbours, fewer than the "
            f"{config.neighbors} that the network predicts; pad with zeros"
        )
    return bind(_build(config), params)(features, neighbors, Dropout(key))


def rollout(ego: jax.Array, controls: jax.Array) -> jax.Array:
    """Integrates accelerations and curvatures from the ego's state.

    Args:
      ego: `[..., 7]` x, y, heading, vx, vy, ax, ay now.
      controls: `[..., T, 2]` acceleration, m/s^2, and curvature, 1/m.

    Returns:
      `[..., T, 3]` x, y, heading. As in the reference the speed is cut off at zero after the
      accelerations are summed up, and x, y start at zero whatever the ego's are.
    """
    accel = jnp.clip(controls[..., 0], -MAX_ACCEL, MAX_ACCEL)
    curvature = jnp.clip(controls[..., 1], -MAX_CURVATURE, MAX_CURVATURE)
    start = jnp.hypot(ego[..., 3], ego[..., 4])[..., None]
    speed = jnp.maximum(start + jnp.cumsum(accel * DT, axis=-1), 0)
    turned = jnp.cumsum(curvature * speed * DT, axis=-1)
    heading = jnp.fmod(ego[..., 2, None] + turned, 2 * jnp.pi)
    x = jnp.cumsum(speed * jnp.cos(heading) * DT, axis=-1)
    y = jnp.cumsum(speed * jnp.sin(heading) * DT, axis=-1)
    return jnp.stack([x, y, heading], axis=-1)


def extras(config: GameFormerConfig) -> Extras:
    """Returns what a torch state dict of this network holds beside its variables."""
    owner = "decoder.interaction_stage.{}.future_encoder".format
    predictor = "decoder.initial_predictor"
    return Extras(
        aliases={owner(i): owner(0) for i in range(1, config.levels)},
        constants={
            f"{predictor}.modal": np.arange(config.modes),
            f"{predictor}.agent": np.arange(config.neighbors + 1),
        },
    )


def config_of(state: Mapping[str, np.ndarray]) -> GameFormerConfig:
    """Returns the sizes of the network whose torch state dict this is; the heads are eight.

    Raises:
      ValueError: a name that tells a size is missing.
    """
    try:
        modes, width = state["decoder.initial_predictor.multi_modal_query_embedding.weight"].shape
        agents = len(state["decoder.initial_predictor.agent_query_embedding.weight"])
        steps = len(state["decoder.initial_predictor.predictor.gaussian.3.bias"]) // GAUSSIAN
    except KeyError as error:
        raise ValueError(f"no state dict of GameFormer: {error} is missing") from None
    numbered = lambda prefix: len(
        {name.removeprefix(prefix).split(".")[0] for name in state if name.startswith(prefix)}
    )
    return GameFormerConfig(
        encoder=EncoderConfig(width=width, layers=numbered("encoder.fusion_encoder.layers.")),
        levels=numbered("decoder.interaction_stage."),
        modes=modes,
        neighbors=agents - 1,
        steps=steps,
    )


def _build(config: GameFormerConfig) -> partial[GameFormer]:
    return partial(GameFormer, config)


def _merged(query: jax.Array) -> jax.Array:
    """`[..., A, M, D]` to `[..., A * M, D]`: all agents ask at once."""
    return query.reshape(*query.shape[:-3], -1, query.shape[-1])


def _with_ego(present: jax.Array) -> jax.Array:
    """Makes the ego present where nobody is."""
    alone = ~jnp.any(present, axis=-1)
    return present.at[..., 0].set(present[..., 0] | alone)


def _replaced(level: LevelOutput, neighbors: jax.Array | None) -> LevelOutput:
    """Puts the given positions in the place of the neighbours' means."""
    if neighbors is None:
        return level
    own = level.gaussians
    given = jnp.broadcast_to(neighbors[..., None, :, :], own[..., 1:, :, :, :2].shape)
    return level.replace(gaussians=own.at[..., 1:, :, :, :2].set(given))
