"""DIPP's motion planner: nine weighted costs of a control sequence, minimised by Gauss-Newton."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum
from spdm_jax.config import DT
from spdm_jax.types import Array

from .gauss_newton import (
    GaussNewtonConfig,
    GaussNewtonSolution,
    gauss_newton,
)
from .path_frame import PATH_STEP, nearest_point, signed_distance

WHEELBASE = 3.089
"""m; nuPlan's Pacifica, as in the reference's bicycle model."""
MAX_ACCELERATION = 5.0
"""m/s^2; the bicycle model clips controls to it."""
PATH_NOW = 200
"""Index of the path's point beside the ego at the start."""
STOP_GAP = 3.0
"""The ego is to stop this far before a red light, m."""
LATERAL_GAP = 0.5
"""An agent is in the way if the boxes are closer than this in lateral direction, m."""
SAFE_GAP = 5.0
"""Distance to keep between box ends, m."""
FAR = 1e4
"""Stands for the distance of an agent that is not in the way, m."""

TRAIN_SOLVER = GaussNewtonConfig(iterations=2, step_size=0.4)
"""Two unrolled steps, differentiable."""
TEST_SOLVER = GaussNewtonConfig(
    iterations=50, step_size=0.2, absolute_tolerance=1e-2, relative_tolerance=1e-5, result="best"
)
"""What the reference solves at test time."""


@dataclass(frozen=True)
class DIPPPlannerConfig:
    """Static settings of the problem.

    Attributes:
      horizon: T, steps of the controls.
      lane_stride: the path is followed at steps lane_stride - 1, 2 lane_stride - 1, ...
      safety_steps: steps whose distance to the agents counts.
      max_steering: limit of the steering angle inside the costs, rad.
    """

    horizon: int = 50
    lane_stride: int = 2
    safety_steps: tuple[int, ...] = (0, 2, 5, 9, 14, 19, 24, 29, 39, 49)
    max_steering: float = 0.5

    def __post_init__(self):
        if not self.safety_steps or max(self.safety_steps) >= self.horizon:
            raise ValueError(
                f"safety_steps {self.safety_steps} do not fit a horizon of {self.horizon} steps"
            )

    @property
    def num_residuals(self) -> int:
        """Length of the weighted residual vector (383 at the reference's settings)."""
        lane = self.horizon // self.lane_stride
        return 6 * self.horizon - 2 + 3 * lane + len(self.safety_steps)


class DIPPProblem(struct.PyTreeNode, kw_only=True):
    """What one solve is about, in the ego frame of now.

    Attributes:
      x, y, heading, speed: scalars, the ego now.
      length, width: scalars, the ego's box, m.
      agents_xy: `[A, T, 2]` predicted centres, m; the first is 0.1 s ahead.
      agent_length, agent_width: `[A]` m.
      agent_valid: `[A]` bool.
      path: `[P, 3]` x, y, heading every 0.1 m; row 200 lies beside the ego.
      path_info: `[P]` speed limit in m/s; 0 where a red light is, 1 on a crosswalk.
      weights: `[9]` in the order of `DIPPResiduals`.
    """

    x: Array
    y: Array
    heading: Array
    speed: Array
    length: Array
    width: Array
    agents_xy: Array
    agent_length: Array
    agent_width: Array
    agent_valid: Array
    path: Array
    path_info: Array
    weights: Array


class DIPPResiduals(struct.PyTreeNode, kw_only=True):
    """Residuals without their weights, in the order of the weights.

    Attributes:
      speed: `[T]` excess over the highest limit along the path, m/s.
      acceleration: `[T]` m/s^2.
      jerk: `[T - 1]` m/s^3.
      steering: `[T]` rad.
      steering_change: `[T - 1]` rad/s.
      lane_xy: `[2 K]` x, then y offset to the nearest path point, m.
      lane_theta: `[K]` heading offset to it, rad, not wrapped.
      red_light_violation: `[T]` distance driven past the stop point, m.
      safety: `[S]` shortfall of the distance to the nearest agent ahead, m.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    steering: Array
    steering_change: Array
    lane_xy: Array
    lane_theta: Array
    red_light_violation: Array
    safety: Array

    def weighted(self, weights: jax.Array) -> jax.Array:
        """Returns `[R]` residuals times the weight `[9]` of their kind."""
        names = self.__dataclass_fields__
        return jnp.concatenate([getattr(self, n) * weights[i] for i, n in enumerate(names)])


class Motion(struct.PyTreeNode, kw_only=True):
    """Rear-axle states along a control sequence, all `[T]`; the first is 0.1 s ahead.

    Attributes:
      x, y: m.
      heading: rad.
      speed: m/s, not negative.
    """

    x: Array
    y: Array
    heading: Array
    speed: Array


def clamp(value: jax.Array, low=None, high=None) -> jax.Array:
    """Clips; the gradient passes at the bounds, as in torch (`jnp.clip` halves it there)."""
    if low is not None:
        value = jnp.where(value < low, jnp.asarray(low, value.dtype), value)
    if high is not None:
        value = jnp.where(value > high, jnp.asarray(high, value.dtype), value)
    return value


def bicycle(
    controls: jax.Array,
    x: jax.Array,
    y: jax.Array,
    heading: jax.Array,
    speed: jax.Array,
    *,
    max_steering: float = 0.6,
) -> Motion:
    """Drives a kinematic bicycle from a state.

    Args:
      controls: `[T, 2]` acceleration in m/s^2 (clipped to 5) and steering angle in rad.
      x: scalar, where it starts, m.
      y: scalar, m.
      heading: scalar, rad.
      speed: scalar, m/s.
      max_steering: limit of the steering angle, rad.

    Source: DIPP `bicycle_model` of its training script: the yaw rate is v delta / L, the speed is
    clipped at 0 after the whole sum, positions use the updated speed and heading. (Its test script
    drives with tan(delta).)
    """
    acceleration = clamp(controls[:, 0], -MAX_ACCELERATION, MAX_ACCELERATION)
    steering = clamp(controls[:, 1], -max_steering, max_steering)
    speed = clamp(speed + prefix_sum(acceleration * DT), 0)
    heading = jnp.fmod(heading + prefix_sum(speed * steering / WHEELBASE * DT), 2 * jnp.pi)
    return Motion(
        x=x + prefix_sum(speed * jnp.cos(heading) * DT),
        y=y + prefix_sum(speed * jnp.sin(heading) * DT),
        heading=heading,
        speed=speed,
    )


def frenet(xy: jax.Array, path: jax.Array) -> jax.Array:
    """Projects points onto a path by its nearest point; no gradient passes.

    Args:
      xy: `[..., 2]` m.
      path: `[P, 3]` x, y, heading every 0.1 m.

    Returns:
      `[..., 2]` arc length from row 200 on, and signed distance, left positive, m.

    Source: DIPP `project_to_frenet_frame`.
    """
    index = nearest_point(xy, path)
    along = PATH_STEP * (index - PATH_NOW).astype(xy.dtype)
    return jnp.stack([along, signed_distance(xy, path, index)], axis=-1)


def residuals(
    controls: jax.Array, problem: DIPPProblem, agents_frenet: jax.Array, config: DIPPPlannerConfig
) -> DIPPResiduals:
    """Returns the unweighted residuals of controls.

    Args:
      controls: `[T, 2]` acceleration and steering angle.
      problem: one problem.
      agents_frenet: `[A, T, 2]`, `frenet` of the predictions.
      config: static settings.

    Source: DIPP `motion_planner`, cost functions; differs: the nearest agent's length is that of
    the sample itself (the reference takes the first sample's choice for the whole batch).
    """
    acceleration, steering = controls[:, 0], controls[:, 1]
    unclipped = clamp(problem.speed + prefix_sum(acceleration * DT), 0)
    motion = bicycle(
        controls,
        problem.x,
        problem.y,
        problem.heading,
        problem.speed,
        max_steering=config.max_steering,
    )
    xy = jnp.stack([motion.x, motion.y], axis=-1)
    followed = slice(config.lane_stride - 1, None, config.lane_stride)
    point = problem.path[nearest_point(xy[followed], problem.path)]
    return DIPPResiduals(
        speed=unclipped - jnp.max(problem.path_info),
        acceleration=acceleration,
        jerk=jnp.diff(acceleration) / DT,
        steering=steering,
        steering_change=jnp.diff(steering) / DT,
        lane_xy=(xy[followed] - point[:, :2]).T.ravel(),
        lane_theta=motion.heading[followed] - point[:, 2],
        red_light_violation=_red_light_violation(unclipped, problem.path_info),
        safety=_safety(xy, problem, agents_frenet, config),
    )


def _red_light_violation(speed: jax.Array, path_info: jax.Array) -> jax.Array:
    red = path_info[PATH_NOW:] == 0
    first = jnp.argmax(red)
    stop = PATH_STEP * first.astype(speed.dtype) - STOP_GAP
    driven = prefix_sum(speed * DT)
    # A light at the very first point counts as none, as does no light at all.
    return jnp.where((driven > stop) & (first > 0), driven - stop, 0)


def _safety(
    xy: jax.Array, problem: DIPPProblem, agents_frenet: jax.Array, config: DIPPPlannerConfig
) -> jax.Array:
    steps = jnp.asarray(config.safety_steps)
    ego_sl = frenet(xy[steps], problem.path)
    ahead = agents_frenet[:, steps, 0] > ego_sl[:, 0]
    lateral = jnp.abs(agents_frenet[:, steps, 1] - ego_sl[:, 1])
    clear = (problem.width + problem.agent_width) / 2 + LATERAL_GAP
    in_way = ahead & (lateral < clear[:, None]) & problem.agent_valid[:, None]
    offset = xy[steps] - problem.agents_xy[:, steps]
    square = jnp.sum(offset**2, axis=-1)
    # The root of 0 has no finite slope.
    distance = jnp.where(in_way & (square > 0), jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    distance = jnp.where(in_way, distance, FAR)
    nearest = jnp.argmin(distance, axis=0)
    distance = jnp.take_along_axis(distance, nearest[None], axis=0)[0]
    keep = (problem.length + problem.agent_length[nearest]) / 2 + SAFE_GAP
    return jnp.where(distance < keep, keep - distance, 0)


@partial(jax.named_call, name="dipp_solve")
def solve(
    controls: jax.Array,
    problem: DIPPProblem,
    solver: GaussNewtonConfig = TEST_SOLVER,
    config: DIPPPlannerConfig = DIPPPlannerConfig(),
) -> GaussNewtonSolution:
    """Refines a control sequence; `vmap` over problems.

    Args:
      controls: `[T, 2]` first guess: acceleration in m/s^2, steering angle in rad.
      problem: one problem.
      solver: static settings of the solve; gradients pass with `TRAIN_SOLVER`.
      config: static settings of the problem.

    Returns:
      The solution; `values` is `[2 T]`, `reshape(T, 2)` gives controls.

    Raises:
      ValueError: horizons differ.
    """
    if controls.shape != (config.horizon, 2) or problem.agents_xy.shape[1] != config.horizon:
        raise ValueError(
            f"controls have shape {controls.shape} and predictions {problem.agents_xy.shape}, "
            f"but the planner's horizon is {config.horizon} steps"
        )
    agents_frenet = frenet(problem.agents_xy, problem.path)

    def weighted(values):
        parts = residuals(values.reshape(-1, 2), problem, agents_frenet, config)
        return parts.weighted(problem.weights)

    return gauss_newton(weighted, controls.reshape(-1), solver)


def problem_from_features(
    ego: jax.Array,
    neighbors: jax.Array,
    predictions: jax.Array,
    ref_line: jax.Array,
    weights: jax.Array,
) -> DIPPProblem:
    """Takes a problem from the network's own inputs and outputs, as DIPP does.

    Args:
      ego: `[8]` the ego now: x, y, heading, vx, vy, length, width, height.
      neighbors: `[A, >= 8]` the same of the agents; height 0 marks a missing one.
      predictions: `[A, T, >= 2]` x, y, ...
      ref_line: `[P, 5]` x, y, heading, curvature, info.
      weights: `[9]`.
    """
    return DIPPProblem(
        x=ego[0],
        y=ego[1],
        heading=ego[2],
        speed=jnp.hypot(ego[3], ego[4]),
        length=ego[5],
        width=ego[6],
        agents_xy=predictions[..., :2],
        agent_length=neighbors[:, 5],
        agent_width=neighbors[:, 6],
        agent_valid=neighbors[:, 7] != 0,
        path=ref_line[:, :3],
        path_info=ref_line[:, 4],
        weights=weights,
    )
