"""DTPP's network: neighbours' futures under each branch of the ego's tree, and the branches' costs.

Source: DTPP (public code) classes Encoder, Decoder and Scorer; submodules carry their names, so
that its checkpoints load. Shapes below leave out leading batch axes; functions take any number of
them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from spdm_models import params as module_params
from spdm_models.dtpp_scorer import BranchScores, Scorer
from spdm_models.layers import Dropout, Embedding, Linear, Sequential
from spdm_models.params import Params
from spdm_models.scene_encoder import (
    CrossTransformer,
    EncoderConfig,
    SceneEncoder,
    SceneEncoding,
    SceneFeatures,
)
from spdm_models.state_dict import Extras

STATE_FEATURES = 6
"""x, y, heading, speed, acceleration, curvature of a branch's state."""
POSE_FEATURES = 3
STEPS_PER_TOKEN = 10
"""A token of a branch stands for one second."""
_MASKED = -1e9

# Branches for which the reference's buffers are laid out.
_BUFFERED_BRANCHES = 30


@dataclass(frozen=True)
class DTPPConfig:
    """Static settings.

    Attributes:
      encoder: sizes of the scene encoder; its width is that of all tokens.
      neighbors: agents whose futures are predicted, nearest first.
      seconds: length of a full branch, s.
      variable_cost: cost weights depend on the scene; else they are one learned vector.
      reference_mask_order: gives the samples of a batch each other's attention masks, as the
        reference does for more than one sample (heads and samples are interleaved the wrong way
        round). Only to reproduce its training; needs exactly one batch axis.
    """

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    neighbors: int = 10
    seconds: int = 8
    variable_cost: bool = False
    reference_mask_order: bool = False


class StageOutput(struct.PyTreeNode, kw_only=True):
    """What the network says about the branches of one stage; N branches, A neighbours.

    Attributes:
      futures: `[N, A, T, 3]` x, y, heading of the neighbours under each branch, ego frame, first
        at 0.1 s; filler beyond the stage's steps and where the branch is padding.
      scoring: scores of the branches and what they are made of.
      ego_future: `[T, 3]` the ego's pose as the scene alone suggests it (a training target only).
    """

    futures: jax.Array
    scoring: BranchScores
    ego_future: jax.Array


class AgentTrajectoryDecoder(nnx.Module):
    """Ten poses from each second's token."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.traj_decoder = Sequential(
            Linear(2 * width, width // 2, rngs),
            jax.nn.elu,
            Linear(width // 2, STEPS_PER_TOKEN * POSE_FEATURES, rngs),
        )

    def __call__(self, tokens: jax.Array) -> jax.Array:
        """Maps `[..., S, 2 D]` to `[..., 10 S, 3]`."""
        poses = self.traj_decoder(tokens)
        return poses.reshape(*poses.shape[:-2], -1, POSE_FEATURES)


class Decoder(nnx.Module):
    """Branches and scene to futures and scores."""

    def __init__(self, config: DTPPConfig, rngs: nnx.Rngs):
        self._config = config
        width, heads = config.encoder.width, config.encoder.heads
        self.environment_decoder = CrossTransformer(width, heads, rngs)
        self.ego_condition_decoder = CrossTransformer(width, heads, rngs)
        self.time_embed = Embedding(config.seconds, width, rngs)
        self.ego_traj_encoder = Sequential(
            Linear(STATE_FEATURES, width // 4, rngs),
            jax.nn.relu,
            Linear(width // 4, width, rngs),
        )
        self.agent_traj_decoder = AgentTrajectoryDecoder(width, rngs)
        self.ego_traj_decoder = Sequential(
            Linear(width, width, rngs),
            jax.nn.elu,
            Linear(width, config.seconds * STEPS_PER_TOKEN * POSE_FEATURES, rngs),
        )
        self.scorer = Scorer(width, config.variable_cost, rngs)

    def predict(
        self,
        encoding: SceneEncoding,
        neighbors: jax.Array,
        branches: jax.Array,
        steps: int,
        dropout: Dropout,
    ) -> jax.Array:
        """Predicts the neighbours' futures under each branch, `[N, A, T, 3]`.

        Args:
          encoding: tokens of the scene.
          neighbors: `[A, 11]` their current features.
          branches: `[N, T, 6]`.
          steps: real steps of the branches.
          dropout: of the attention blocks.
        """
        *lead, num, _, _ = branches.shape
        encoded = self.ego_traj_encoder(branches)
        seconds = encoded.reshape(*lead, num, -1, STEPS_PER_TOKEN, encoded.shape[-1])
        ego_tokens = jnp.max(seconds, axis=-2)
        tree = self.time_embed.weight[...] + encoded[..., steps - 1, None, :]
        agents = neighbors.shape[-2]
        tokens = encoding.tokens[..., 1 : agents + 1, :]
        query = tokens[..., None, None, :] + tree[..., None, :, :, :]
        attend = self._attend_mixed if self._config.reference_mask_order else self._attend
        environment, condition = attend(encoding, query, ego_tokens, branches, dropout)
        offsets = self.agent_traj_decoder(jnp.concatenate([environment, condition], axis=-1))
        offsets = jnp.moveaxis(offsets, -4, -3)
        return offsets + neighbors[..., None, :, None, :POSE_FEATURES]

    def _attend(self, encoding, query, ego_tokens, branches, dropout):
        """Attention to the scene, and to the own branch's seconds up to the query's.

        Args:
          encoding: tokens of the scene.
          query: `[A, N, S, D]`.
          ego_tokens: `[N, S, D]`.
          branches: not used.
          dropout: of the attention blocks.
        """
        *lead, agents, num, seconds, width = query.shape
        # One row of queries: the keys are the same for all.
        flat = query.reshape(*lead, agents * num * seconds, width)
        scene, valid = encoding.tokens, encoding.valid[..., None, :]
        environment = self.environment_decoder(flat, scene, scene, dropout, valid)
        own = ego_tokens[..., None, :, :, :]
        past = jnp.tri(seconds, dtype=bool)
        condition = self.ego_condition_decoder(query, own, own, dropout, past)
        return environment.reshape(query.shape), condition

    def _attend_mixed(self, encoding, query, ego_tokens, branches, dropout):
        """As `_attend`, with the masks that the reference uses for a batch of B samples."""
        if query.ndim != 5:
            raise ValueError(
                "DTPPConfig.reference_mask_order reproduces a batch; features need exactly one "
                f"leading axis, and there are {query.ndim - 4}"
            )
        batch, agents, num, seconds, width = query.shape
        heads = self._config.encoder.heads
        begun = jnp.sum(branches[..., ::STEPS_PER_TOKEN, :], axis=-1) != 0
        real = begun.reshape(batch, num * seconds, 1)
        branch, second = jnp.divmod(jnp.arange(num * seconds), seconds)
        past = (branch[:, None] == branch) & (second[:, None] >= second)
        # Head h of sample b gets the mask that belongs to the (b heads + h)-th of the tiled list.
        source = jnp.arange(batch * heads).reshape(batch, heads) % batch

        def bias(mask):
            return jnp.where(mask, 0, jnp.asarray(_MASKED, query.dtype))[source][:, None]

        flat = query.reshape(batch, agents, num * seconds, width)
        scene = encoding.tokens[:, None]
        environment = self.environment_decoder(
            flat, scene, scene, dropout, bias=bias(real & encoding.valid[:, None, :])
        )
        own = ego_tokens.reshape(batch, 1, num * seconds, width)
        condition = self.ego_condition_decoder(flat, own, own, dropout, bias=bias(real & past))
        return environment.reshape(query.shape), condition.reshape(query.shape)

    def __call__(
        self,
        encoding: SceneEncoding,
        features: SceneFeatures,
        branches: jax.Array,
        steps: int,
        dropout: Dropout,
        branch_valid: jax.Array | None = None,
        futures: jax.Array | None = None,
        neighbor_valid: jax.Array | None = None,
    ) -> StageOutput:
        """Predicts and scores; arguments as those of `decode`."""
        count = self._config.neighbors
        neighbors = features.neighbors_past[..., :count, -1, :]
        if branch_valid is None:
            branch_valid = jnp.sum(branches, axis=(-2, -1)) != 0
        if neighbor_valid is None:
            neighbor_valid = jnp.sum(neighbors, axis=-1) != 0
        ego = encoding.tokens[..., 0, :]
        if futures is None:
            futures = self.predict(encoding, neighbors, branches, steps, dropout)
        elif futures.ndim == branches.ndim:
            shape = (*branches.shape[:-2], *futures.shape[-3:])
            futures = jnp.broadcast_to(futures[..., None, :, :, :], shape)
        scoring = self.scorer(
            ego,
            neighbors,
            neighbor_valid,
            branches[..., :steps, :],
            branch_valid,
            futures[..., :steps, :],
        )
        ego_future = self.ego_traj_decoder(ego)
        ego_future = ego_future.reshape(*ego_future.shape[:-1], -1, POSE_FEATURES)
        return StageOutput(futures=futures, scoring=scoring, ego_future=ego_future)


class DTPP(nnx.Module):
    """Encoder and decoder; the prefixes `encoder.` and `decoder.` lead to torch's names."""

    def __init__(self, config: DTPPConfig, rngs: nnx.Rngs):
        self.encoder = SceneEncoder(config.encoder, rngs)
        self.decoder = Decoder(config, rngs)


def init(config: DTPPConfig, key: jax.Array) -> Params:
    """Returns new weights, drawn as torch draws them.

    Args:
      config: static settings.
      key: typed random key.
    """
    return module_params.init_params(partial(DTPP, config), key)


def abstract(config: DTPPConfig) -> Params:
    """Returns the shapes of the network's variables."""
    return module_params.abstract_params(partial(DTPP, config))


def extras(config: DTPPConfig) -> Extras:
    """Returns what a torch state dict of this network holds beside its variables."""
    past = np.tri(config.seconds, dtype=np.float32)
    seconds = np.arange(config.seconds)
    return Extras(
        constants={
            "decoder.casual_mask": np.kron(np.eye(_BUFFERED_BRANCHES, dtype=np.float32), past),
            "decoder.time_index": np.tile(seconds, (_BUFFERED_BRANCHES, 1)),
        }
    )


def config_of(state: Mapping[str, np.ndarray], variable_cost: bool = False) -> DTPPConfig:
    """Returns the sizes of the network whose torch state dict this is; the heads are eight.

    Args:
      state: arrays by torch's names.
      variable_cost: how the network was trained; its arrays do not tell.

    Raises:
      ValueError: a name that tells a size is missing.
    """
    time_embedding = "decoder.time_embed.weight"
    if time_embedding not in state:
        raise ValueError(
            f"{time_embedding} is missing: this is no state dict of DTPP. Keys must begin with "
            "'encoder.' or 'decoder.'."
        )
    seconds, width = state[time_embedding].shape
    layer = "encoder.fusion_encoder.layers.{}.norm1.weight".format
    layers = sum(layer(i) in state for i in range(len(state)))
    return DTPPConfig(
        encoder=EncoderConfig(width=width, layers=layers),
        seconds=seconds,
        variable_cost=variable_cost,
    )


def encode(
    params: Params,
    config: DTPPConfig,
    features: SceneFeatures,
    dropout_key: jax.Array | None = None,
) -> SceneEncoding:
    """Encodes the scene, once for all stages.

    Args:
      params: weights of `init` or of a checkpoint.
      config: the settings that they belong to.
      features: inputs with any leading axes.
      dropout_key: typed random key for training; None switches dropout off.

    Raises:
      ValueError: the shapes of the features do not fit together.
    """
    features.validate()
    network = module_params.bind(partial(DTPP, config), params)
    return network.encoder(features, Dropout(dropout_key))


def decode(
    params: Params,
    config: DTPPConfig,
    encoding: SceneEncoding,
    features: SceneFeatures,
    branches: jax.Array,
    steps: int,
    dropout_key: jax.Array | None = None,
    *,
    branch_valid: jax.Array | None = None,
    futures: jax.Array | None = None,
    neighbor_valid: jax.Array | None = None,
) -> StageOutput:
    """Predicts the neighbours under the branches of a stage and scores the branches.

    Args:
      params: weights of `init` or of a checkpoint.
      config: the settings that they belong to.
      encoding: of `encode`.
      features: what was encoded.
      branches: `[N, 80, 6]` x, y, heading, speed, acceleration, curvature; zero beyond `steps` and
        in padded branches.
      steps: real steps of the stage's branches (30, 80).
      dropout_key: typed random key for training; None switches dropout off.
      branch_valid: `[N]` bool; None takes branches that are all zero for padding.
      futures: `[A, 80, 3]` replaces the predictions of every branch, `[N, A, T, 3]` those of each
        (T at least `steps`).
      neighbor_valid: `[A]` bool which neighbours the scores look at; None takes those that are
        there now.

    Raises:
      ValueError: the branches have a wrong shape, or too many steps are asked for.
    """
    length = config.seconds * STEPS_PER_TOKEN
    if branches.ndim < 3 or branches.shape[-2:] != (length, STATE_FEATURES):
        raise ValueError(
            f"branches has shape {branches.shape}; expected [..., N, {length}, {STATE_FEATURES}], "
            "shorter branches padded with zeros"
        )
    if not 1 < steps <= length:
        raise ValueError(f"steps is {steps}; a stage has 2 to {length} steps of 0.1 s")
    network = module_params.bind(partial(DTPP, config), params)
    return network.decoder(
        encoding,
        features,
        branches,
        steps,
        Dropout(dropout_key),
        branch_valid,
        futures,
        neighbor_valid,
    )
