"""DIPP's network: motion of agents and map elements to joint futures, scores and cost weights.

Source: DIPP `Predictor` (public code); submodules carry its names, so that its checkpoints load.
Shapes below leave out leading batch axes; every function takes any number of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx, struct

from spdm_jax.types import Array

from . import params as module_params
from .dipp_encoders import (
    Agent2Agent,
    Agent2Map,
    AgentEncoder,
    CrosswalkEncoder,
    LaneEncoder,
)
from .layers import Drop, Dropout, Linear, Sequential
from .params import Params
from .state_dict import Extras

HEIGHT = 7
"""Column that is 0 where an agent is missing."""
PEDESTRIAN, CYCLIST = 2, 3
"""Values of a neighbour's type column; everything else is a vehicle."""
WEIGHT_SCALE = (1, 1, 1, 1, 1, 10, 100)
"""Factors of the learned weights of the planner's costs."""
FIXED_WEIGHTS = (10, 10)
"""Weights of the last costs, which are not learned."""
NUM_WEIGHTS = len(WEIGHT_SCALE) + len(FIXED_WEIGHTS)
EXTRAS = Extras(
    constants={
        "plan.scale": np.asarray(WEIGHT_SCALE),
        "plan.constraint": np.asarray([FIXED_WEIGHTS]),
    }
)
"""What a checkpoint of the reference holds beside the weights."""

PaddedAgents = Literal["computed", "zeroed"]


@dataclass(frozen=True)
class DIPPConfig:
    """Static settings.

    Attributes:
      width: D, size of a token; all hidden sizes are multiples or parts of it.
      modes: M, joint futures.
      horizon: T, steps of 0.1 s.
      padded_agents: what missing agents carry past the encoder, as the scores see them too:
        "computed" is torch in training (and with gradients on), "zeroed" torch at inference.
    """

    width: int = 256
    modes: int = 3
    horizon: int = 50
    padded_agents: PaddedAgents = "computed"

    def __post_init__(self):
        if self.width % 8:
            raise ValueError(f"width is {self.width}; choose a multiple of the 8 heads")


class DIPPFeatures(struct.PyTreeNode, kw_only=True):
    """Inputs in the ego frame of now: metres, radians, m/s; history oldest first, last row now.

    Attributes:
      ego: `[H, 8]` x, y, heading, vx, vy, length, width, height.
      neighbors: `[A, H, 9]` the same and the type (1 vehicle, 2 pedestrian, 3 cyclist); missing
        ones are all zero.
      map_lanes: `[1 + A, L, P, 17]` lanes near each actor: x, y, heading of the centre, of the left
        and of the right line, speed limit, types of lane, left and right line, light, and whether
        the point is a stop point, interpolated, at a stop sign; missing ones are all zero.
      map_crosswalks: `[1 + A, C, P, 3]` x, y, heading; missing ones are all zero.
    """

    ego: Array
    neighbors: Array
    map_lanes: Array
    map_crosswalks: Array


class DIPPEncoding(struct.PyTreeNode, kw_only=True):
    """What the encoders hand to the heads; N = 1 + A actors, ego first.

    Attributes:
      actors: `[N, D]` motion of each actor.
      actor_valid: `[N]` bool.
      agent_agent: `[N, D]` after attention among actors.
      map_feature: `[N, L + C, D]` each map element as its actor sees it.
      map_valid: `[N, L + C]` bool; the first element always counts.
      agent_map: `[M, N, D]` all elements together.
    """

    actors: Array
    actor_valid: Array
    agent_agent: Array
    map_feature: Array
    map_valid: Array
    agent_map: Array


class DIPPOutput(struct.PyTreeNode, kw_only=True):
    """What the network says.

    Attributes:
      controls: `[M, T, 2]` of the ego: acceleration in m/s^2, steering angle in rad.
      predictions: `[M, A, T, 3]` x, y, heading of the neighbours.
      scores: `[M]` logits of the joint futures.
      cost_weights: `[9]` of the planner, the same for every scene.
      encoding: what led there.
    """

    controls: Array
    predictions: Array
    scores: Array
    cost_weights: Array
    encoding: DIPPEncoding


class AVDecoder(nnx.Module):
    """Controls of the ego, and the planner's weights from a constant input."""

    def __init__(self, width: int, horizon: int, rngs: nnx.Rngs):
        self.control = _head(2 * width, width, 2 * horizon, rngs)
        self.cost = Sequential(
            Linear(1, width // 2, rngs),
            jax.nn.relu,
            Linear(width // 2, NUM_WEIGHTS, rngs),
            jax.nn.softmax,
        )

    def cost_weights(self) -> jax.Array:
        """Returns `[9]`: seven learned weights, two fixed ones."""
        weight = self.cost(jnp.ones((1,), getattr(self.cost, "0").weight.dtype))
        learned = weight[: len(WEIGHT_SCALE)] * jnp.asarray(WEIGHT_SCALE, weight.dtype)
        return jnp.concatenate([learned, jnp.asarray(FIXED_WEIGHTS, weight.dtype)])


class AgentDecoder(nnx.Module):
    """Futures of the neighbours, as offsets from where they are."""

    def __init__(self, width: int, horizon: int, rngs: nnx.Rngs):
        self.decode = _head(2 * width, width, 3 * horizon, rngs)


class Score(nnx.Module):
    """Logits of the modes; no gradient reaches the encoders."""

    def __init__(self, width: int, rngs: nnx.Rngs):
        self.reduce = Sequential(Drop(), Linear(2 * width, width, rngs), jax.nn.elu)
        self.decode = _head(2 * width, width // 2, 1, rngs)

    def __call__(self, encoding: DIPPEncoding, dropout: Dropout) -> jax.Array:
        """Returns `[..., M]`."""
        encoding = jax.lax.stop_gradient(encoding)
        # Padded elements and agents count, as in the reference: its weights were trained that way.
        pooled = (
            jnp.max(encoding.map_feature, axis=(-3, -2)),
            jnp.max(encoding.agent_agent, axis=-2),
        )
        scene = self.reduce(jnp.concatenate(pooled, axis=-1), dropout)
        modes = jnp.max(encoding.agent_map, axis=-2)
        scene = jnp.broadcast_to(scene[..., None, :], modes.shape)
        return self.decode(jnp.concatenate([scene, modes], axis=-1), dropout)[..., 0]


def _head(inputs: int, hidden: int, outputs: int, rngs: nnx.Rngs) -> Sequential:
    return Sequential(
        Drop(), Linear(inputs, hidden, rngs), jax.nn.elu, Linear(hidden, outputs, rngs)
    )


class Predictor(nnx.Module):
    """The whole network; attribute names are those of the reference's checkpoints."""

    def __init__(self, config: DIPPConfig, rngs: nnx.Rngs):
        self._config = config
        width = config.width
        self.vehicle_net = AgentEncoder(width, rngs)
        self.pedestrian_net = AgentEncoder(width, rngs)
        self.cyclist_net = AgentEncoder(width, rngs)
        self.lane_net = LaneEncoder(width, rngs)
        self.crosswalk_net = CrosswalkEncoder(width, rngs)
        self.agent_map = Agent2Map(width, config.modes, rngs)
        self.agent_agent = Agent2Agent(width, rngs)
        self.plan = AVDecoder(width, config.horizon, rngs)
        self.predict = AgentDecoder(width, config.horizon, rngs)
        self.score = Score(width, rngs)

    def encode(self, features: DIPPFeatures, dropout: Dropout) -> DIPPEncoding:
        """Runs all encoders."""
        ego, neighbors = features.ego[..., None, :, :], features.neighbors
        kind = neighbors[..., -1, -1:]
        others = self.vehicle_net(neighbors)
        others = jnp.where(kind == PEDESTRIAN, self.pedestrian_net(neighbors), others)
        others = jnp.where(kind == CYCLIST, self.cyclist_net(neighbors), others)
        actors = jnp.concatenate([self.vehicle_net(ego), others], axis=-2)
        heights = jnp.concatenate([ego[..., -1, HEIGHT], neighbors[..., -1, HEIGHT]], axis=-1)
        actor_valid = heights != 0
        agent_agent = self.agent_agent.interaction_net(actors, actor_valid, dropout)
        if self._config.padded_agents == "zeroed":
            agent_agent = jnp.where(actor_valid[..., None], agent_agent, 0)
        elements = (features.map_lanes, features.map_crosswalks)
        map_valid = jnp.concatenate([e[..., 0, 0] != 0 for e in elements], axis=-1)
        # An actor without any element attends to the first one.
        map_valid = map_valid.at[..., 0].set(True)
        map_feature, agent_map = self.agent_map(
            agent_agent,
            self.lane_net(features.map_lanes),
            self.crosswalk_net(features.map_crosswalks),
            map_valid,
            dropout,
        )
        return DIPPEncoding(
            actors=actors,
            actor_valid=actor_valid,
            agent_agent=agent_agent,
            map_feature=map_feature,
            map_valid=map_valid,
            agent_map=jnp.swapaxes(agent_map, -3, -2),
        )

    def __call__(self, features: DIPPFeatures, dropout: Dropout) -> DIPPOutput:
        """Runs encoders and heads."""
        encoding = self.encode(features, dropout)
        modes = encoding.agent_map
        agents = jnp.broadcast_to(encoding.agent_agent[..., None, :, :], modes.shape)
        both = jnp.concatenate([modes, agents], axis=-1)
        horizon = self._config.horizon
        controls = self.plan.control(both[..., 0, :], dropout)
        offsets = self.predict.decode(both[..., 1:, :], dropout)
        offsets = offsets.reshape(*offsets.shape[:-1], horizon, 3)
        now = features.neighbors[..., -1, :3][..., None, :, None, :]
        return DIPPOutput(
            controls=controls.reshape(*controls.shape[:-1], horizon, 2),
            predictions=offsets + now,
            scores=self.score(encoding, dropout),
            cost_weights=self.plan.cost_weights(),
            encoding=encoding,
        )


def init(config: DIPPConfig, key: jax.Array) -> Params:
    """Returns new weights, drawn as torch draws them.

    Args:
      config: static settings.
      key: typed random key.
    """
    return module_params.init_params(lambda rngs: Predictor(config, rngs), key)


def abstract_params(config: DIPPConfig) -> Params:
    """Returns shapes and dtypes of the weights, without making any."""
    return module_params.abstract_params(lambda rngs: Predictor(config, rngs))


def config_of(state: Mapping[str, np.ndarray]) -> DIPPConfig:
    """Returns the sizes of the network whose torch state dict this is.

    Raises:
      ValueError: a name that tells a size is missing.
    """
    try:
        width = len(state["plan.control.1.bias"])
        horizon = len(state["plan.control.3.bias"]) // 2
    except KeyError as error:
        raise ValueError(f"{error} is missing: this is no state dict of DIPP") from None
    mode = "agent_map.map_attention.attention.{}.in_proj_bias".format
    modes = sum(mode(i) in state for i in range(len(state)))
    return DIPPConfig(width=width, modes=modes, horizon=horizon)


def apply(
    params: Params,
    config: DIPPConfig,
    features: DIPPFeatures,
    dropout_key: jax.Array | None = None,
) -> DIPPOutput:
    """Runs the network.

    Args:
      params: weights of `init` or of a checkpoint.
      config: the settings that they belong to.
      features: inputs with any leading axes.
      dropout_key: typed random key for training; None switches dropout off.

    Raises:
      ValueError: inputs disagree in their number of actors or in a feature axis.
    """
    _check(features)
    return bind(params, config)(features, Dropout(dropout_key))


def bind(params: Params, config: DIPPConfig) -> Predictor:
    """Returns the network with its weights, to use inside one traced call."""
    return module_params.bind(lambda rngs: Predictor(config, rngs), params)


def _check(features: DIPPFeatures) -> None:
    actors = 1 + features.neighbors.shape[-3]
    columns = {"ego": 8, "neighbors": 9, "map_lanes": 17, "map_crosswalks": 3}
    for name, count in columns.items():
        shape = getattr(features, name).shape
        if shape[-1] != count:
            raise ValueError(f"{name} has shape {shape}; its last axis holds {count} features")
        if name.startswith("map_") and shape[-4] != actors:
            raise ValueError(
                f"{name} has shape {shape}, but there are {actors} actors: the ego and "
                f"{actors - 1} neighbors; give each its own map elements"
            )
