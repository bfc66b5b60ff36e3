"""Settings. `*Config` is static and hashable, `*Params` is a traced pytree.

A sweep over values (target speeds, offsets, IDM constants, weights, thresholds) changes `*Params`
and never compiles again; only a new count (of policies, offsets, route paths) or switch does.
Defaults are the published code's (tuplan_garage, nuPlan) and the paper's.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from flax import struct

Scalar: TypeAlias = Any
"""A float, or an array where the field says so; traced inside `jit`."""

Tracker = Literal["reference", "corrected"]
ForecastMode = Literal["constant_velocity", "perfect", "reactive", "none"]
ProgressReference = Literal["auto", "centerline", "goal"]

DT = 0.1
"""Planning and scoring interval, s (nuPlan's simulation step)."""
NUM_STATES = 41
"""States of a scored proposal: 0 ... 4.0 s (tuplan_garage)."""
NUM_TRAJECTORY_STATES = 81
"""States of the returned trajectory: 0 ... 8.0 s."""
FORECAST_DT = 0.2
"""Spacing of the forecast occupancy maps, s."""
NUM_FORECAST = 41
"""Forecast samples: 0 ... 8.0 s."""


class VehicleParams(struct.PyTreeNode, kw_only=True):
    """Ego dimensions, m (nuPlan's Pacifica)."""

    width: Scalar = 2.297
    length: Scalar = 5.176
    wheel_base: Scalar = 3.089
    rear_axle_to_center: Scalar = 1.461


class IDMParams(struct.PyTreeNode, kw_only=True):
    """Intelligent driver model (Treiber 2000); scalars or one value per policy `[K]`.

    Attributes:
      min_gap: s0, m.
      headway_time: T, s.
      accel_max: a, m/s^2.
      decel_max: b, m/s^2.
      fallback_speed: speed limit where the map knows none, m/s.
    """

    min_gap: Scalar = 1.0
    headway_time: Scalar = 1.5
    accel_max: Scalar = 1.5
    decel_max: Scalar = 3.0
    fallback_speed: Scalar = 15.0


class SplineParams(struct.PyTreeNode, kw_only=True):
    """Stage 2 of SPDM: connecting curve and cubic speed profile.

    Attributes:
      merge_times: `[D]` s, merge distance = time x max(v0, merge_min_speed); outermost in the
        order of the paths.
      merge_min_speed: m/s.
      merge_min_distance: lower clip, m.
      merge_max_distance: upper clip, m.
      horizon: T_f of the cubic, s.
    """

    merge_times: Scalar = struct.field(default_factory=lambda: np.array([4.0, 2.0, 6.0]))
    merge_min_speed: Scalar = 5.0
    merge_min_distance: Scalar = 10.0
    merge_max_distance: Scalar = 80.0
    horizon: Scalar = 8.0


class ScoringParams(struct.PyTreeNode, kw_only=True):
    """Weights and thresholds of the PDM score (tuplan_garage `PDMScorer`, nuPlan comfort)."""

    progress_weight: Scalar = 5.0
    ttc_weight: Scalar = 5.0
    comfort_weight: Scalar = 2.0
    progress_threshold: Scalar = 0.1  # m, below it nobody made progress
    stopped_speed: Scalar = 0.05  # m/s, collision classes
    ttc_stopped_speed: Scalar = 0.005  # m/s
    driving_direction_compliant: Scalar = 2.0  # m
    driving_direction_violation: Scalar = 6.0  # m
    ahead_angle: Scalar = 30.0 * np.pi / 180
    behind_angle: Scalar = 150.0 * np.pi / 180
    lon_accel_min: Scalar = -4.05
    lon_accel_max: Scalar = 2.40
    lat_accel_max: Scalar = 4.89
    jerk_max: Scalar = 8.37
    lon_jerk_max: Scalar = 4.13
    yaw_accel_max: Scalar = 1.93
    yaw_rate_max: Scalar = 0.95


class TrackerParams(struct.PyTreeNode, kw_only=True):
    """Batch LQR tracker and the actuator lags of the bicycle (tuplan_garage)."""

    q_longitudinal: Scalar = 10.0
    r_longitudinal: Scalar = 1.0
    q_lateral_error: Scalar = 1.0
    q_heading_error: Scalar = 10.0
    q_steering: Scalar = 0.0
    r_lateral: Scalar = 1.0
    stopping_gain: Scalar = 0.5
    stopping_speed: Scalar = 0.2
    wheel_base: Scalar = 3.089  # the tracker keeps its own, whatever the ego's
    accel_time_constant: Scalar = 0.2  # s
    steering_time_constant: Scalar = 0.05  # s
    max_steering: Scalar = np.pi / 3


class BrakeParams(struct.PyTreeNode, kw_only=True):
    """Emergency brake (tuplan_garage `PDMEmergencyBrake`)."""

    time_threshold: Scalar = 2.0  # s to an at-fault collision
    speed_threshold: Scalar = 5.0  # m/s
    max_accel: Scalar = 2.40
    max_decel: Scalar = 4.05


class PlannerParams(struct.PyTreeNode, kw_only=True):
    """All traced settings of PDM-Closed and SPDM.

    Attributes:
      speed_fractions: `[K]` target speeds as fractions of the speed limit.
      lateral_offsets: `[L]` m, left positive; the first must be 0 (the centreline).
      map_radius: half side of the drivable square and object radius, m.
    """

    speed_fractions: Scalar = struct.field(
        default_factory=lambda: np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    )
    lateral_offsets: Scalar = struct.field(default_factory=lambda: np.array([0.0, -1.0, 1.0]))
    map_radius: Scalar = 50.0
    vehicle: VehicleParams = struct.field(default_factory=VehicleParams)
    idm: IDMParams = struct.field(default_factory=IDMParams)
    spline: SplineParams = struct.field(default_factory=SplineParams)
    tracker: TrackerParams = struct.field(default_factory=TrackerParams)
    scoring: ScoringParams = struct.field(default_factory=ScoringParams)
    brake: BrakeParams = struct.field(default_factory=BrakeParams)


@dataclass(frozen=True)
class PlannerConfig:
    """All static settings of PDM-Closed and SPDM.

    Attributes:
      num_route_paths: K, paths of stage 2; 0 is PDM-Closed.
      tracker: "reference" runs what the published code runs, "corrected" repairs the difference
        matrix of the velocity fit.
      forecast: where the agents' future comes from. "reactive" asks a simulation whose traffic
        reacts how it would beside each proposal; anywhere else it is "perfect".
      progress_reference: "auto" is the centreline for K = 0 and the goal path otherwise.
      borrow_oncoming: whether stage 2 may pass a standing obstacle through the oncoming lane, an
        extension of ours (see `spdm_jax.proposals.borrow`); does nothing for K = 0.
      max_vehicles: nearest vehicles kept per step; likewise the three fields that follow.
      max_pedestrians: see above.
      max_bicycles: see above.
      max_static: see above.
      max_path_points: room for the points of a path; too little is reported as overflow.
      max_red_lights: room for red connectors on the route.
      max_red_edges: room for their edges.
    """

    num_route_paths: int = 0
    tracker: Tracker = "reference"
    forecast: ForecastMode = "constant_velocity"
    progress_reference: ProgressReference = "auto"
    borrow_oncoming: bool = False
    max_vehicles: int = 50
    max_pedestrians: int = 25
    max_bicycles: int = 10
    max_static: int = 50
    max_path_points: int = 1024
    max_red_lights: int = 16
    max_red_edges: int = 2048

    def __post_init__(self):
        if self.num_route_paths < 0:
            raise ValueError(f"num_route_paths is {self.num_route_paths}; it must be >= 0")
        for name, value, allowed in (
            ("tracker", self.tracker, ("reference", "corrected")),
            ("forecast", self.forecast, ("constant_velocity", "perfect", "reactive", "none")),
            ("progress_reference", self.progress_reference, ("auto", "centerline", "goal")),
        ):
            if value not in allowed:
                raise ValueError(f"{name} is {value!r}; it must be one of {allowed}")

    @property
    def borrows(self) -> bool:
        """Whether there are paths through the oncoming lane."""
        return self.borrow_oncoming and self.num_route_paths > 0

    @property
    def max_objects(self) -> int:
        """Objects kept per step over all classes."""
        return self.max_vehicles + self.max_pedestrians + self.max_bicycles + self.max_static


@dataclass(frozen=True)
class PlannerSpec:
    """A planner ready to run: static config, traced params, and a name for tables."""

    name: str
    config: PlannerConfig
    params: PlannerParams

    # Parameters are arrays, so the generated __eq__/__hash__ would not do: compare by identity.
    __eq__ = object.__eq__
    __hash__ = object.__hash__


# PDM-Closed grids of the paper's saturation figure: lateral offsets, number of even fractions.
_PDM_GRIDS: dict[int, tuple[tuple[float, ...], tuple[float, ...]]] = {
    1: ((0.0,), (1.0,)),
    3: ((0.0, -1.0, 1.0), (1.0,)),
    6: ((0.0, -1.0, 1.0), (0.5, 1.0)),
    15: ((0.0, -1.0, 1.0), tuple((i + 1) / 5 for i in range(5))),
    30: ((0.0, -1.0, 1.0), tuple((i + 1) / 10 for i in range(10))),
    60: ((0.0, -1.0, 1.0, -2.0, 2.0), tuple((i + 1) / 12 for i in range(12))),
}


def pdm_closed(
    num_proposals: int = 15,
    *,
    speed_fractions: tuple[float, ...] | None = None,
    lateral_offsets: tuple[float, ...] | None = None,
    config: PlannerConfig | None = None,
) -> PlannerSpec:
    """Returns PDM-Closed on one of the paper's grids, or on any grid of offsets x fractions.

    Args:
      num_proposals: 1, 3, 6, 15, 30 or 60; ignored where both grids are given.
      speed_fractions: fractions of the speed limit.
      lateral_offsets: m, left positive, the first must be 0.
      config: further switches.

    Raises:
      ValueError: an unknown grid, or one that does not start at the centreline.
    """
    if speed_fractions is None or lateral_offsets is None:
        if num_proposals not in _PDM_GRIDS:
            raise ValueError(
                f"num_proposals is {num_proposals}; PDM-Closed has grids for "
                f"{sorted(_PDM_GRIDS)}. Pass speed_fractions and lateral_offsets for another one."
            )
        offsets, fractions = _PDM_GRIDS[num_proposals]
        speed_fractions = fractions if speed_fractions is None else speed_fractions
        lateral_offsets = offsets if lateral_offsets is None else lateral_offsets
    return _spec("PDM-Closed", speed_fractions, lateral_offsets, config or PlannerConfig())


def spdm(
    num_proposals: int = 60,
    *,
    speed_fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0),
    lateral_offsets: tuple[float, ...] = (0.0, -1.0, 1.0),
    config: PlannerConfig | None = None,
) -> PlannerSpec:
    """Returns SPDM: the stage-1 grid plus as many route-lane paths as `num_proposals` has room for.

    Args:
      num_proposals: N_p; the paper's grid is 15, 20, 25, 30, 45, 60.
      speed_fractions: fractions of the speed limit, both stages.
      lateral_offsets: stage 1 offsets, m.
      config: further switches (its `num_route_paths` is overwritten).

    Raises:
      ValueError: N_p minus stage 1 is negative or no multiple of the number of fractions.
    """
    stage1 = len(speed_fractions) * len(lateral_offsets)
    paths, rest = divmod(num_proposals - stage1, len(speed_fractions))
    if rest or paths < 0:
        raise ValueError(
            f"num_proposals is {num_proposals}; it must be {stage1} + K x {len(speed_fractions)} "
            "(stage 1 plus K route-lane paths at every speed)"
        )
    base = config or PlannerConfig()
    return _spec(
        "SPDM", speed_fractions, lateral_offsets, dataclasses.replace(base, num_route_paths=paths)
    )


def _spec(
    name: str,
    fractions: tuple[float, ...],
    offsets: tuple[float, ...],
    config: PlannerConfig,
) -> PlannerSpec:
    if not fractions or not all(f > 0 for f in fractions):
        raise ValueError(f"speed_fractions is {fractions}; it needs positive numbers")
    if not offsets or offsets[0] != 0:
        raise ValueError(f"lateral_offsets is {offsets}; the first must be 0 (the centreline)")
    params = PlannerParams(
        speed_fractions=np.asarray(fractions, float), lateral_offsets=np.asarray(offsets, float)
    )
    return PlannerSpec(name, config, params)
