"""GameFormer's speed refinement: Gauss-Newton on the speeds along a reference path.

Source: GameFormer-Planner, `TrajectoryPlanner`, `RefinementPlanner` and `occupancy_adpter`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.arrays import prefix_sum
from spdm_jax.config import DT
from spdm_jax.types import Array

from .gameformer_paths import ReferencePath
from .gauss_newton import GaussNewtonConfig, GaussNewtonSolution, gauss_newton
from .lattice import EGO_HALF_WIDTH
from .path_frame import PATH_STEP, nearest_point, signed_distance

ROWS_PER_CELL = 10
"""Rows of 0.1 m in a cell of the occupancy grid."""
LATERAL_GAP = 0.3
"""An agent occupies the path if the boxes are closer than this in lateral direction, m."""
GAP_BEHIND = 3.0
"""Kept free behind an agent, m."""
EGO_FRONT = 4.049
"""From the rear axle to the front, m (nuPlan's Pacifica)."""
SAFETY_STEPS = (1, 3, 6, 9, 14, 19, 24, 29)
"""Steps whose occupied cells count."""
ACCELERATION_RANGE = (-4.0, 2.4)
"""m/s^2; beyond it acceleration is priced again."""
END_SLACK = 3.0
"""The end of the plan may move that far for free, m."""
SOLVER = GaussNewtonConfig(iterations=20, step_size=0.3, relative_tolerance=1e-3, result="best")
WEIGHTS = {
    "negative_speed": 100.0,
    "acceleration": 0.1,
    "speed": 0.3,
    "acceleration_limit": 10.0,
    "jerk": 1.0,
    "safety": 100.0,
    "end": 3.0,
}
"""Factors of the residuals, in their order."""


class PlanOnPath(struct.PyTreeNode, kw_only=True):
    """A plan by the nearest rows of a path.

    Attributes:
      row: `[T]` int32 row of the path at each step.
      speed: `[T]` m/s, in steps of 1 m/s because of the rows' distance.
    """

    row: Array
    speed: Array


class Refined(struct.PyTreeNode, kw_only=True):
    """Outcome of the refinement.

    Attributes:
      poses: `[T, 3]` x, y, heading in the ego frame; the plan itself without a reference path.
      arc: `[T]` arc length driven, m.
      speed: `[T]` m/s.
      solution: of the solver.
    """

    poses: Array
    arc: Array
    speed: Array
    solution: GaussNewtonSolution


def plan_on_path(plan: jax.Array, path: jax.Array) -> PlanOnPath:
    """Moves a plan `[T, >= 2]` onto a path `[P, 3]`."""
    row = nearest_point(plan[:, :2], path)
    steps = jnp.diff(row, prepend=0)
    return PlanOnPath(row=row, speed=steps.astype(plan.dtype) * (PATH_STEP / DT))


def occupancy(
    predictions: jax.Array,
    scores: jax.Array,
    neighbors: jax.Array,
    reference: ReferencePath,
) -> jax.Array:
    """Cells of the path that agents or red lights occupy.

    Args:
      predictions: `[A, M, T, >= 2]` x, y in the ego frame.
      scores: `[A, M]`; the best mode of each agent counts.
      neighbors: `[A, 11]` current features: x (0 where missing), ..., length (6), width (7).
      reference: of the ego.

    Returns:
      `[T, P / 10]` bool, cells of 1 m. An agent beside the path's first row at the start of its
      prediction does not count, and all-zero predictions neither.
    """
    best = jnp.argmax(scores, axis=1)[:, None, None, None]
    xy = jnp.take_along_axis(predictions, best, axis=1)[:, 0, :, :2]
    row = nearest_point(xy, reference.path)
    beside = jnp.abs(signed_distance(xy, reference.path, row))
    length, width = neighbors[:, 6, None], neighbors[:, 7, None]
    counts = (neighbors[:, :1] != 0) & (row[:, :1] > 0) & (row > 0)
    counts = counts & (beside < 0.5 * width + EGO_HALF_WIDTH + LATERAL_GAP)
    size = reference.path.shape[0]
    start = jnp.clip(row - _rows_up(0.5 * length + GAP_BEHIND), 0, size)
    end = jnp.clip(row - _rows_up(-0.5 * length), 0, size)
    # A cell counts if any of its rows lies in [start, end).
    cell = jnp.arange(size // ROWS_PER_CELL) * ROWS_PER_CELL
    covers = (start[..., None] < cell + ROWS_PER_CELL) & (end[..., None] > cell)
    covers = covers & (end > start)[..., None] & counts[..., None]
    red = jnp.any(reference.red_light.reshape(-1, ROWS_PER_CELL), axis=1)
    return jnp.any(covers, axis=0) | red


def _rows_up(metres: jax.Array) -> jax.Array:
    """Smallest number of rows of 0.1 m that cover a distance, int32.

    Lengths are multiples of 0.1 m but for rounding, so the product with 10 has to be exact: the
    reference rounds the distance to float32 and multiplies in float64.
    """
    metres = metres.astype(jnp.float32)
    whole = jnp.round(metres * ROWS_PER_CELL)
    rest = (8 * metres - whole) + 2 * metres
    return whole.astype(jnp.int32) + (rest > 0)


def refinement_residuals(
    speed: jax.Array,
    ego_speed: jax.Array,
    ego_acceleration: jax.Array,
    rows: jax.Array,
    occupied: jax.Array,
    speed_limit: jax.Array,
) -> dict[str, jax.Array]:
    """Returns the residuals without their weights, by the names of `WEIGHTS`.

    Args:
      speed: `[T]` the variables, m/s.
      ego_speed: `[]` longitudinal speed now, m/s.
      ego_acceleration: `[]` now, m/s^2.
      rows: `[T]` path rows of the plan that is refined.
      occupied: `[T, C]` bool cells.
      speed_limit: `[P]` along the path, m/s.
    """
    arc = prefix_sum(speed * DT)
    acceleration = jnp.diff(speed, prepend=ego_speed[None]) / DT
    jerk = jnp.diff(acceleration, prepend=ego_acceleration[None]) / DT
    low, high = ACCELERATION_RANGE
    beyond = (acceleration < low) | (acceleration > high)
    end_error = arc[-1] - PATH_STEP * rows[-1].astype(speed.dtype)
    steps = jnp.asarray(SAFETY_STEPS)
    cell = jnp.arange(occupied.shape[1])
    # Cells that the network's own plan has passed by then are free.
    ahead = occupied[steps] & (ROWS_PER_CELL * cell > rows[steps, None])
    intrusion = arc[steps, None] + EGO_FRONT - cell.astype(speed.dtype)
    intrusion = jnp.where(ahead & (intrusion > 0), intrusion, 0)
    return {
        "negative_speed": jnp.where(speed < 0, speed, 0),
        "acceleration": acceleration,
        "speed": speed - speed_limit[jnp.minimum(rows, speed_limit.shape[0] - 1)],
        "acceleration_limit": jnp.where(beyond, acceleration, 0),
        "jerk": jerk,
        "safety": jnp.sum(intrusion, axis=1),
        "end": jnp.where(jnp.abs(end_error) > END_SLACK, end_error, 0)[None],
    }


def refine(
    plan: jax.Array,
    ego_speed: jax.Array,
    ego_acceleration: jax.Array,
    reference: ReferencePath,
    occupied: jax.Array,
    solver: GaussNewtonConfig = SOLVER,
) -> Refined:
    """Drives a plan's speeds along the reference path, changed where that costs less.

    Args:
      plan: `[T, 3]` x, y, heading in the ego frame, first at 0.1 s.
      ego_speed: `[]` longitudinal speed now, m/s.
      ego_acceleration: `[]` now, m/s^2.
      reference: path, limits, lights.
      occupied: `[T, C]` bool, of `occupancy`.
      solver: static settings.

    Raises:
      ValueError: the plan has fewer steps than the safety term looks at.
    """
    if plan.shape[0] <= max(SAFETY_STEPS):
        raise ValueError(
            f"the plan has {plan.shape[0]} steps; the refinement needs {max(SAFETY_STEPS) + 1}"
        )
    start = plan_on_path(plan, reference.path)

    def weighted(speed):
        parts = refinement_residuals(
            speed, ego_speed, ego_acceleration, start.row, occupied, reference.speed_limit
        )
        return jnp.concatenate([WEIGHTS[name] * parts[name] for name in WEIGHTS])

    solution = gauss_newton(weighted, jnp.maximum(start.speed, 0), solver)
    speed = jnp.maximum(solution.values, 0)
    arc = prefix_sum(speed * DT)
    row = jnp.clip((arc * ROWS_PER_CELL).astype(jnp.int32), 0, reference.path.shape[0] - 1)
    poses = jnp.where(reference.valid, reference.path[row], plan[:, :3])
    return Refined(poses=poses, arc=arc, speed=speed, solution=solution)
