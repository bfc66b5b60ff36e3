"""Typed pytrees of NAVSIM's score: one frame with its log, and the scores of trajectories in it.

Conventions of `spdm_jax.types`. Axes besides: `F` = 11 log frames at 2 Hz (0 ... 5.0 s), `T` = 41
scored states at 10 Hz.
"""

from flax import struct

from spdm_jax.config import VehicleParams
from spdm_jax.geometry import Path
from spdm_jax.scoring.areas import AreaMasks
from spdm_jax.scoring.history_comfort import EgoPast
from spdm_jax.scoring.lights import RedConnectors
from spdm_jax.types import Array, EgoState, PolygonGrid

NUM_POSES = 8
"""Poses of a predicted trajectory: 0.5 ... 4.0 s."""
NUM_FRAMES = 11
"""Frames of the log: 0 ... 5.0 s at 2 Hz."""

__all__ = [
    "NUM_FRAMES",
    "NUM_POSES",
    "EgoPast",
    "LoggedObjects",
    "NavsimScene",
    "NavsimScores",
    "PreviousPlan",
    "RedConnectors",
    "Sampling",
    "Terms",
]


class LoggedObjects(struct.PyTreeNode, kw_only=True):
    """Recorded objects at 2 Hz.

    Attributes:
      x, y, heading: `[A, F]` box centre.
      vx, vy: `[A, F]` velocity along the map axes, m/s (0 for static kinds).
      valid: `[A, F]` bool, recorded in that frame.
      length, width: `[A]` m.
      type: `[A]` int32, `ObjectType`.
    """

    x: Array
    y: Array
    heading: Array
    vx: Array
    vy: Array
    valid: Array
    length: Array
    width: Array
    type: Array


class Sampling(struct.PyTreeNode, kw_only=True):
    """How the 41 samples lie among the current pose and the eight predicted ones.

    NAVSIM truncates times to whole microseconds, so that a sample may lie one microsecond early.

    Attributes:
      left: `[T]` int32 node before each sample (0 is the current pose).
      share: `[T]` share of the node after it.
    """

    left: Array
    share: Array


class PreviousPlan(struct.PyTreeNode, kw_only=True):
    """What was planned one frame earlier, for extended comfort.

    Attributes:
      ego: `[]` state at that frame.
      poses: `[Q, 8, 3]` in the ego frame of that state; Q is 1 (one plan for all trajectories) or
        the number of trajectories.
      sampling: of that frame.
      steps: `[]` int32, samples of 0.1 s between that frame and this one.
      present: `[]` bool.
    """

    ego: EgoState
    poses: Array
    sampling: Sampling
    steps: Array
    present: Array


class NavsimScene(struct.PyTreeNode, kw_only=True):
    """One frame with all that NAVSIM's score reads, built by `spdm_jax.navsim.build.from_arrays`.

    Attributes:
      ego: `[]` current rear-axle state.
      vehicle: ego dimensions.
      centerline: where progress and lane keeping are measured.
      grid: point-in-polygon index; its bits are those of `masks`, not the map's polygons.
      masks: which bits are drivable, on the route, intersections and lanes.
      objects: recorded objects.
      red: red connectors on the route.
      past: recorded ego past.
      reference: `[T, 3]` trajectory of PDM-Closed, local frame, 0.1 s apart.
      human_poses: `[8, 3]` human future in the ego frame.
      has_human: `[]` bool.
      previous: plan of the previous frame.
      sampling: how predicted poses become samples.
      origin: `[2]` float64, map coordinates of the local frame's origin (host only; never cast).
      start_time_us: `[]` int64, time stamp of the frame (host only; never cast).
    """

    ego: EgoState
    vehicle: VehicleParams
    centerline: Path
    grid: PolygonGrid
    masks: AreaMasks
    objects: LoggedObjects
    red: RedConnectors
    past: EgoPast
    reference: Array
    human_poses: Array
    has_human: Array
    previous: PreviousPlan
    sampling: Sampling
    origin: Array
    start_time_us: Array


class Terms(struct.PyTreeNode, kw_only=True):
    """Sub-scores `[N]`; one that the profile does not know is 1.

    Attributes:
      no_at_fault_collision: NC, 0, 0.5 or 1.
      drivable_area: DAC, 0 or 1.
      driving_direction: DDC, 0, 0.5 or 1 (navsim1 computes it and gives it no weight).
      traffic_light: TLC, 0 or 1.
      progress: EP, relative to the better of the trajectory and the reference.
      time_to_collision: TTC, 0 or 1.
      lane_keeping: LK, 0 or 1.
      comfort: C or HC, 0 or 1.
      extended_comfort: EC, 0 or 1; 1 where there is no previous plan.
    """

    no_at_fault_collision: Array
    drivable_area: Array
    driving_direction: Array
    traffic_light: Array
    progress: Array
    time_to_collision: Array
    lane_keeping: Array
    comfort: Array
    extended_comfort: Array


class NavsimScores(struct.PyTreeNode, kw_only=True):
    """Scores of trajectories `[N]` in one frame. A trajectory that is not finite scores 0.

    Attributes:
      total: PDMS or EPDMS; without extended comfort where there is no previous plan.
      total_without_extended_comfort: its weight left out of the mean.
      total_unfiltered: `total` without the human filter.
      raw: sub-scores before the human filter.
      filtered: sub-scores after it; the raw ones where there is no filter or no human.
      human: sub-scores `[]` of the human's own future; 1 where there is none.
      progress_raw: m along the centreline, not negative.
      comfort_flags: `[N, 6]` bool: lon. acceleration, lat. acceleration, jerk, lon. jerk, yaw
        acceleration, yaw rate.
      collision_index: int32 time index of the first at-fault collision, T if none.
      ttc_index: int32 time index of the first violation, T if none.
      red_light_index: int32 first time index on an active red connector, T if none.
      multiple_lanes, non_drivable, oncoming: `[N, T]` bool ego areas.
      has_extended_comfort: `[]` bool, there is a previous plan and the profile looks at it.
      valid: `[N]` bool, the trajectory is finite.
    """

    total: Array
    total_without_extended_comfort: Array
    total_unfiltered: Array
    raw: Terms
    filtered: Terms
    human: Terms
    progress_raw: Array
    comfort_flags: Array
    collision_index: Array
    ttc_index: Array
    red_light_index: Array
    multiple_lanes: Array
    non_drivable: Array
    oncoming: Array
    has_extended_comfort: Array
    valid: Array
