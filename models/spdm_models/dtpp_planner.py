"""DTPP as a planner: reference paths of a scene, the tree search with the network, training trees.

Source: DTPP, `TreePlanner` and `data_process.py`.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.agents.observation import Observation, is_agent
from spdm_jax.arrays import order_of
from spdm_jax.geometry import box_at
from spdm_jax.types import Array, EgoState, ObjectType, Route, ScenarioMap

from . import dtpp
from .dtpp import STEPS_PER_TOKEN, DTPPConfig
from .dtpp_paths import ReferencePaths, is_obstacle, reference_paths
from .dtpp_tree import Branches, TreeConfig, TreePlan, expand, first_stage, plan_tree
from .params import Params
from .predictions import Futures
from .route_lines import RouteLineConfig, first_speed_limit, route_lines
from .scene_encoder import SceneFeatures

UNKNOWN_LIMIT = 13.0
"""Speed limit where the map has none, m/s; 15 for training trees."""
TRAINING_LIMIT = 15.0
MAX_END_ERRORS = (1.5, 4.0)
"""A training tree that ends farther than this from the expert, in both stages, is useless, m."""


@dataclass(frozen=True)
class DTPPPlannerConfig:
    """Static settings.

    Attributes:
      network: sizes of the network.
      tree: of the search.
      lines: of the candidate lanes.
    """

    network: DTPPConfig = field(default_factory=DTPPConfig)
    tree: TreeConfig = field(default_factory=TreeConfig)
    lines: RouteLineConfig = field(default_factory=RouteLineConfig)


class ScenePaths(struct.PyTreeNode, kw_only=True):
    """What a scene offers the tree.

    Attributes:
      paths: reference paths in the ego frame.
      limit: `[]` speed limit, m/s.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    paths: ReferencePaths
    limit: Array
    overflow: Array


class TrainingTree(struct.PyTreeNode, kw_only=True):
    """Candidates of one training sample, nearest to the expert first.

    Attributes:
      first: `[N, 80, 6]` first-stage branches, zero beyond their steps.
      second: `[N, 80, 6]` branches of both stages.
      first_error: `[]` smallest end error of the first stage, m.
      second_error: `[]` smallest end error of the second stage, m.
      useful: `[]` bool, the tree comes close enough to the expert to learn from.
    """

    first: Array
    second: Array
    first_error: Array
    second_error: Array
    useful: Array


def scene_paths(
    scene: ScenarioMap,
    route: Route,
    ego: EgoState,
    observation: Observation,
    config: DTPPPlannerConfig,
    unknown_limit: float = UNKNOWN_LIMIT,
) -> ScenePaths:
    """Builds the reference paths of one step.

    Args:
      scene: the map.
      route: the corrected route.
      ego: current state, scalars.
      observation: objects of this step.
      config: static settings.
      unknown_limit: speed limit where the map has none, m/s.
    """
    lines = route_lines(scene, route, ego, config.lines)
    boxes = box_at(
        observation.x,
        observation.y,
        observation.heading,
        0.5 * observation.length,
        0.5 * observation.width,
    )
    blocks = is_obstacle(
        observation.type == ObjectType.VEHICLE,
        ~is_agent(observation.type),
        jnp.hypot(observation.vx, observation.vy),
    )
    paths = reference_paths(
        lines.line,
        lines.valid,
        (ego.x, ego.y, ego.heading),
        boxes,
        blocks & observation.valid,
        config.tree.num_paths,
    )
    limit = first_speed_limit(scene, route, lines, unknown_limit)
    return ScenePaths(paths=paths, limit=limit.astype(ego.x.dtype), overflow=lines.overflow)


def pad_branches(states: jax.Array, config: DTPPConfig) -> jax.Array:
    """Fills branches `[N, T, 6]` with zeros to the network's length."""
    length = config.seconds * STEPS_PER_TOKEN
    return jnp.pad(states, ((0, 0), (0, length - states.shape[1]), (0, 0)))


def plan(
    params: Params,
    features: SceneFeatures,
    paths: ReferencePaths,
    speed: jax.Array,
    acceleration: jax.Array,
    limit: jax.Array,
    config: DTPPPlannerConfig,
    key: jax.Array | None = None,
    futures: Futures | None = None,
) -> TreePlan:
    """Searches the tree with the network's scores; the scene is encoded once.

    Args:
      params: weights of the network.
      features: of one scene.
      paths: in the ego frame.
      speed: `[]` of the ego, m/s.
      acceleration: `[]` m/s^2.
      limit: `[]` speed limit, m/s.
      config: static settings.
      key: typed random key, see `dtpp_tree.second_stage`.
      futures: gives what takes the place of the predictions under the branches of a stage; None
        keeps the network's own.
    """
    network = config.network
    encoding = dtpp.encode(params, network, features)

    def score(branches: Branches) -> jax.Array:
        output = dtpp.decode(
            params,
            network,
            encoding,
            features,
            pad_branches(branches.states, network),
            branches.states.shape[1],
            branch_valid=branches.valid,
            futures=None if futures is None else futures(branches.states[..., :3]),
        )
        return output.scoring.scores

    return plan_tree(paths, speed, acceleration, limit, score, config.tree, key)


def training_tree(
    paths: ReferencePaths,
    speed: jax.Array,
    acceleration: jax.Array,
    limit: jax.Array,
    expert: jax.Array,
    config: DTPPPlannerConfig,
) -> TrainingTree:
    """Expands every leaf and sorts the branches by their distance to the expert at their ends.

    Args:
      paths: in the ego frame.
      speed: `[]` of the ego, m/s.
      acceleration: `[]` m/s^2.
      limit: `[]` speed limit, m/s.
      expert: `[80, 3]` recorded future of the ego, ego frame.
      config: static settings.
    """
    tree = config.tree
    first = first_stage(paths, speed, acceleration, limit, tree)
    grow = jax.vmap(lambda start: expand(start, paths.course, paths.valid, limit, False, tree))
    states, kept = grow(first.states[:, -1])
    kept = (kept & first.valid[:, None]).reshape(-1)
    states = states.reshape(kept.shape[0], *states.shape[2:])
    trunk = jnp.repeat(first.states, kept.shape[0] // first.valid.shape[0], axis=0)
    second = jnp.concatenate([trunk, states], axis=1)

    def nearest(states, valid):
        goal = expert[states.shape[1] - 1, :2]
        error = jnp.hypot(*jnp.moveaxis(states[:, -1, :2] - goal, -1, 0))
        error = jnp.where(valid, error, jnp.inf)
        order = order_of(error)[: tree.num_branches]
        chosen = jnp.where(valid[order, None, None], states[order], 0)
        return pad_branches(chosen, config.network), jnp.min(error)

    first_branches, first_error = nearest(first.states, first.valid)
    second_branches, second_error = nearest(second, kept)
    useless = (first_error > MAX_END_ERRORS[0]) & (second_error > MAX_END_ERRORS[1])
    return TrainingTree(
        first=first_branches,
        second=second_branches,
        first_error=first_error,
        second_error=second_error,
        useful=~useless & jnp.isfinite(second_error),
    )
