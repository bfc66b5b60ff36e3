"""Thresholds and weights of nuPlan's metrics; the defaults are the official ones."""

from dataclasses import dataclass

import numpy as np
from flax import struct

from spdm_jax.config import Scalar, VehicleParams


class ScoreWeights(struct.PyTreeNode, kw_only=True):
    """Weights of the averaged terms of the closed-loop score; the other four multiply."""

    progress: Scalar = 5.0
    time_to_collision: Scalar = 5.0
    speed_limit: Scalar = 4.0
    comfort: Scalar = 2.0


class OpenLoopWeights(struct.PyTreeNode, kw_only=True):
    """Weights of the averaged terms of the open-loop score; the miss rate multiplies."""

    average_displacement: Scalar = 1.0
    final_displacement: Scalar = 1.0
    average_heading: Scalar = 2.0
    final_heading: Scalar = 2.0


class MetricParams(struct.PyTreeNode, kw_only=True):
    """Thresholds of the closed-loop metrics.

    Attributes:
      vehicle: ego dimensions.
      lon_accel_min, lon_accel_max: m/s^2, centre of the box; likewise the other comfort bounds.
      lat_accel_max: m/s^2.
      jerk_max: m/s^3, of the magnitude of the rear axle's acceleration.
      lon_jerk_max: m/s^3.
      yaw_rate_max: rad/s.
      yaw_accel_max: rad/s^2.
      stopped_speed: m/s, below it an ego or object stands when they meet.
      ahead_angle: rad, an object within it of the ego's heading is ahead.
      behind_angle: rad, an object beyond it is behind.
      collisions_allowed: `[3]` at-fault collisions with VRUs, vehicles and objects that do not yet
        make the score 0.
      ttc_stopped_speed: m/s, below it the ego has no time to collision.
      least_ttc: s, the time to collision must stay above it.
      max_outside: m, a corner may leave the drivable area by less.
      direction_horizon: s, window of the driving-direction sum.
      direction_compliant: m against the traffic within that window that are free.
      direction_violation: m from which the score is 0.
      progress_threshold: m, progress counts as at least this much.
      min_progress_ratio: share of the expert's progress that counts as making progress.
      max_overspeed: m/s, scale of the speed score.
      lane_change_fail_rate: share of failed lane changes that is still fine.
      near_connector: m, a centre this near to its connector stays on it.
      heading_weight: m/rad, weight of the heading in the expert error with yaw.
      weights: of the score.
    """

    vehicle: VehicleParams = struct.field(default_factory=VehicleParams)
    lon_accel_min: Scalar = -4.05
    lon_accel_max: Scalar = 2.40
    lat_accel_max: Scalar = 4.89
    jerk_max: Scalar = 8.37
    lon_jerk_max: Scalar = 4.13
    yaw_rate_max: Scalar = 0.95
    yaw_accel_max: Scalar = 1.93
    stopped_speed: Scalar = 0.05
    ahead_angle: Scalar = 30.0 * np.pi / 180
    behind_angle: Scalar = 150.0 * np.pi / 180
    collisions_allowed: Scalar = struct.field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    ttc_stopped_speed: Scalar = 0.005
    least_ttc: Scalar = 0.95
    max_outside: Scalar = 0.3
    direction_horizon: Scalar = 1.0
    direction_compliant: Scalar = 2.0
    direction_violation: Scalar = 6.0
    progress_threshold: Scalar = 2.0
    min_progress_ratio: Scalar = 0.2
    max_overspeed: Scalar = 2.23
    lane_change_fail_rate: Scalar = 0.3
    near_connector: Scalar = 5.0
    heading_weight: Scalar = 2.5
    weights: ScoreWeights = struct.field(default_factory=ScoreWeights)


class OpenLoopParams(struct.PyTreeNode, kw_only=True):
    """Thresholds of the open-loop metrics.

    Attributes:
      vehicle: ego dimensions.
      max_displacement: m, average or final displacement error that makes the score 0.
      max_heading: rad, likewise for headings.
      max_miss: `[H]` m, a larger error within a horizon is a miss.
      max_miss_rate: share of misses that still scores 1.
      weights: of the score.
    """

    vehicle: VehicleParams = struct.field(default_factory=VehicleParams)
    max_displacement: Scalar = 8.0
    max_heading: Scalar = 0.8
    max_miss: Scalar = struct.field(default_factory=lambda: np.array([6.0, 8.0, 16.0]))
    max_miss_rate: Scalar = 0.3
    weights: OpenLoopWeights = struct.field(default_factory=OpenLoopWeights)


@dataclass(frozen=True)
class MetricConfig:
    """Static settings.

    Attributes:
      ttc_step: s between projected positions of the time to collision.
      ttc_horizon: s, positions before it are checked.
      comparison_horizons: s, open-loop horizons, ascending.
    """

    ttc_step: float = 0.1
    ttc_horizon: float = 3.0
    comparison_horizons: tuple[int, ...] = (3, 5, 8)

    @property
    def ttc_times(self) -> np.ndarray:
        """Seconds ahead that are checked, ascending; the present is not."""
        return np.arange(self.ttc_step, self.ttc_horizon, self.ttc_step)
