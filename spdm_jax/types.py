"""Typed pytrees: one driving scenario, as every part of the library sees it.

Conventions, valid everywhere:

- Metres, seconds, radians; right-handed x-y plane, headings counter-clockwise from +x.
- Local frame: a float64 `origin` has been subtracted on the host (translation only, no rotation).
- Poses are the rear axle for the ego and the box centre for everything else.
- Masks are `bool`, True marks a real entry. Padded entries are finite. NaN has one meaning: the
  speed limit of a lane is unknown.
- Index fields hold -1 for "none".
- Leaves are NumPy arrays on the host (as read from a file) or JAX arrays on the device; a
  `ScenarioBatch` is a `Scenario` whose leaves carry a leading axis `B`.

Axes: `L` lanes and lane connectors, `R` roadblocks and roadblock connectors, `N` flat polyline
points, `V` flat polygon edges, `A` tracks, `T` time, `S` lanes in a sequence.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

from flax import struct

Array: TypeAlias = Any
"""A `numpy.ndarray` on the host, a `jax.Array` on the device: no type checker follows a pytree from
one to the other, so fields are named for people and left open for the checker."""

SCHEMA_VERSION = 2
"""Version of the scenario file layout; raised whenever a stored field changes its meaning."""


class ObjectType(IntEnum):
    """Tracked-object classes, numbered as in nuPlan."""

    VEHICLE = 0
    PEDESTRIAN = 1
    BICYCLE = 2
    TRAFFIC_CONE = 3
    BARRIER = 4
    CZONE_SIGN = 5
    GENERIC_OBJECT = 6


class LightStatus(IntEnum):
    """Traffic-light state of a lane connector at one time step."""

    UNKNOWN = 0
    GREEN = 1
    YELLOW = 2
    RED = 3


class DrivableKind(IntEnum):
    """Source layer of a drivable polygon."""

    ROAD_SEGMENT = 0
    INTERSECTION = 1
    GENERIC = 2
    CAR_PARK = 3


class Polylines(struct.PyTreeNode, kw_only=True):
    """Polylines of different length, stored back to back.

    Attributes:
      points: `[N, 3]` x, y, heading. Heading is the one the source gives at that point.
      row: `[N]` int32, the polyline a point belongs to.
      valid: `[N]` bool.
      start: `[L]` int32, index of the first point of each polyline.
      count: `[L]` int32, number of points of each polyline (0 for padding).
    """

    points: Array
    row: Array
    valid: Array
    start: Array
    count: Array


class Polygons(struct.PyTreeNode, kw_only=True):
    """Polygons of different size (several rings allowed: parts or holes), stored as edges.

    Attributes:
      xy: `[V, 2]` start point of each edge.
      next_xy: `[V, 2]` end point of each edge; rings are closed.
      row: `[V]` int32, the polygon an edge belongs to.
      valid: `[V]` bool.
      start: `[R]` int32, first edge of each polygon.
      count: `[R]` int32, number of edges of each polygon (0 for padding).
    """

    xy: Array
    next_xy: Array
    row: Array
    valid: Array
    start: Array
    count: Array


class PolygonGrid(struct.PyTreeNode, kw_only=True):
    """Uniform grid that answers "which polygons contain this point" exactly, without a search.

    A point is in polygon j iff the cell centre is, flipped once for every edge of j that the
    segment from the cell centre to the point crosses. Built by `spdm_jax.io.grid.build_grid`.
    The polygons are, in this order: the lanes `[0, L)`, then car parks, then intersections.

    Attributes:
      origin: `[2]` lower left corner of cell (0, 0).
      cell_size: `[]` m.
      shape: `[2]` int32, number of cells in x and y; cell (i, j) is stored at `i * ny + j`.
      cell_row: `[C]` int32, row of each cell; cells without edges and with one mask share a row.
      row_mask: `[K]` int32, row of `masks` for the cell's centre.
      edge_start: `[K]` int32, first edge of the row's cell.
      edge_count: `[K]` int32, number of its edges; row 0 has none.
      masks: `[U, W]` uint32, bit sets of polygons.
      edges: `[E, 4]` x0, y0, x1, y1 relative to the cell's centre, row after row.
      edge_polygon: `[E]` int32, polygon of each edge, -1 for padding.
    """

    origin: Array
    cell_size: Array
    shape: Array
    cell_row: Array
    row_mask: Array
    edge_start: Array
    edge_count: Array
    masks: Array
    edges: Array
    edge_polygon: Array


class Lanes(struct.PyTreeNode, kw_only=True):
    """Lanes and lane connectors, in one table.

    Attributes:
      valid: `[L]` bool.
      is_connector: `[L]` bool, True for a lane connector.
      centerline: discrete baseline path (nuPlan's points, heading per point).
      left_boundary: left edge of the lane.
      right_boundary: right edge of the lane.
      polygon: lane area, row = lane.
      length: `[L]` arc length of the baseline, m.
      successors: `[L, S]` int32 lane indices.
      predecessors: `[L, S]` int32 lane indices.
      left_neighbor: `[L]` int32, the lane to the left in the same roadblock.
      right_neighbor: `[L]` int32.
      roadblock: `[L]` int32, index into `Roadblocks`.
      intersection: `[L]` int32, index into `ScenarioMap.intersections`.
      speed_limit: `[L]` m/s, NaN where unknown.
      has_traffic_light: `[L]` bool, a connector governed by a light.
      stop_line: `[L]` int32, index into `ScenarioMap.stop_lines`.
    """

    valid: Array
    is_connector: Array
    centerline: Polylines
    left_boundary: Polylines
    right_boundary: Polylines
    polygon: Polygons
    length: Array
    successors: Array
    predecessors: Array
    left_neighbor: Array
    right_neighbor: Array
    roadblock: Array
    intersection: Array
    speed_limit: Array
    has_traffic_light: Array
    stop_line: Array


class Roadblocks(struct.PyTreeNode, kw_only=True):
    """Roadblocks (lane groups) and roadblock connectors, in one table.

    Attributes:
      valid: `[R]` bool.
      is_connector: `[R]` bool.
      polygon: area, row = roadblock.
      successors: `[R, S]` int32 roadblock indices.
      predecessors: `[R, S]` int32 roadblock indices.
    """

    valid: Array
    is_connector: Array
    polygon: Polygons
    successors: Array
    predecessors: Array


class ScenarioMap(struct.PyTreeNode, kw_only=True):
    """The static world within reach of one scenario.

    Attributes:
      lanes: lanes and lane connectors.
      roadblocks: their groups.
      intersections: intersection areas.
      intersection_type: `[I]` int32, nuPlan's numbers (0 default, 1 light, 2 stop sign, ...).
      car_parks: car-park areas.
      drivable: all drivable polygons (road segments, intersections, generic areas, car parks).
      drivable_kind: `[D]` int32, `DrivableKind`.
      crosswalks: pedestrian crossings.
      walkways: pavements.
      stop_lines: stop polygons.
      stop_line_type: `[Q]` int32, nuPlan's numbers (0 crossing, 1 stop sign, 2 light, ...).
      grid: point-in-polygon index over lanes, car parks and intersections.
    """

    lanes: Lanes
    roadblocks: Roadblocks
    intersections: Polygons
    intersection_type: Array
    car_parks: Polygons
    drivable: Polygons
    drivable_kind: Array
    crosswalks: Polygons
    walkways: Polygons
    stop_lines: Polygons
    stop_line_type: Array
    grid: PolygonGrid


class Route(struct.PyTreeNode, kw_only=True):
    """The corrected route and what follows from it for each lane one may start on.

    `slots` are the route lanes; slot order is the order of lanes within the route's blocks.

    Attributes:
      roadblocks: `[Q]` int32, corrected route, -1 padded.
      given_roadblocks: `[Q]` int32, route as the source gives it, -1 padded.
      lane_on_route: `[L]` bool.
      slot_of_lane: `[L]` int32, slot of a route lane, else -1.
      start_lane: `[J]` int32, the lane of each slot, -1 padded.
      centerline_lanes: `[J, S]` int32, PDM's centreline from that lane: shortest route-lane path
        to the last block (window 30), -1 padded.
      reaches_goal: `[J]` bool, whether that path ends in the route's last block.
      goal_lanes: `[J, S]` int32, lane sequence that reaches the last block with the fewest lane
        changes (one lane per block; a change happens between two entries), -1 padded.
      branch_lanes: `[M, S]` int32, route-lane sequences for SPDM: one per start lane and distinct
        on-route branch within the next 100 m, -1 padded.
      branch_start: `[M]` int32, first lane of each branch, -1 padded.
      mission_goal: `[3]` x, y, heading of the mission goal (zeros if there is none).
      has_mission_goal: `[]` bool.
    """

    roadblocks: Array
    given_roadblocks: Array
    lane_on_route: Array
    slot_of_lane: Array
    start_lane: Array
    centerline_lanes: Array
    reaches_goal: Array
    goal_lanes: Array
    branch_lanes: Array
    branch_start: Array
    mission_goal: Array
    has_mission_goal: Array


class EgoState(struct.PyTreeNode, kw_only=True):
    """Ego state(s) at the rear axle; every field has the same shape `[...]`.

    Attributes:
      x, y: position, m.
      heading: rad.
      vx, vy: velocity in the body frame, m/s.
      ax, ay: acceleration in the body frame, m/s^2.
      steering: tire steering angle, rad.
      steering_rate: rad/s.
      yaw_rate: rad/s.
      yaw_acceleration: rad/s^2.
    """

    x: Array
    y: Array
    heading: Array
    vx: Array
    vy: Array
    ax: Array
    ay: Array
    steering: Array
    steering_rate: Array
    yaw_rate: Array
    yaw_acceleration: Array


class Tracks(struct.PyTreeNode, kw_only=True):
    """Recorded objects: history, the scenario's own window and 8 s beyond its end.

    Row order is the source's order of first appearance.

    Attributes:
      x, y: `[A, T]` box centre.
      heading: `[A, T]` box heading.
      vx, vy: `[A, T]` velocity along the map's x and y axes, m/s (0 for static objects).
      length, width: `[A, T]` box size, m.
      valid: `[A, T]` bool, observed at that step.
      type: `[A]` int32, `ObjectType`.
    """

    x: Array
    y: Array
    heading: Array
    vx: Array
    vy: Array
    length: Array
    width: Array
    valid: Array
    type: Array


class Scenario(struct.PyTreeNode, kw_only=True):
    """One scenario in its local frame.

    The time axis `T` runs at a nominal 0.1 s: `num_history` steps before iteration 0, the
    scenario's own iterations, and up to 8 s after its last one.

    Attributes:
      map: static world.
      route: corrected route and lane sequences.
      ego: `[T]` recorded ego.
      ego_valid: `[T]` bool.
      tracks: recorded objects.
      lights: `[T, L]` int8 `LightStatus` of each lane connector.
      time: `[T]` float64 seconds relative to iteration 0 (source time stamps, not multiples of dt).
      num_history: `[]` int32, index of iteration 0 on the time axis.
      num_iterations: `[]` int32, length of the scenario's own window.
      origin: `[2]` float64, map coordinates of the local frame's origin (host only; never cast).
    """

    map: ScenarioMap
    route: Route
    ego: EgoState
    ego_valid: Array
    tracks: Tracks
    lights: Array
    time: Array
    num_history: Array
    num_iterations: Array
    origin: Array


ScenarioBatch = Scenario
"""A `Scenario` whose leaves carry a leading axis `B`."""


@dataclass(frozen=True)
class ScenarioInfo:
    """What a scenario file says in words; stays on the host.

    Attributes:
      token: identifier, unique within a pack.
      log_name: source log.
      map_name: source map.
      scenario_type: tag.
      source: name of the reader ("nuplan", "av2", "synthetic").
      iteration0_time_us: time stamp of iteration 0 in the source's clock.
      lane_ids: source identifiers in row order, like the three fields that follow.
      roadblock_ids: see above.
      intersection_ids: see above.
      track_ids: see above.
      notes: remarks of the reader (repairs, guesses).
    """

    token: str
    log_name: str
    map_name: str
    scenario_type: str
    source: str
    iteration0_time_us: int
    lane_ids: tuple[str, ...]
    roadblock_ids: tuple[str, ...]
    intersection_ids: tuple[str, ...]
    track_ids: tuple[str, ...]
    notes: tuple[str, ...] = ()


class AgentForecast(struct.PyTreeNode, kw_only=True):
    """Selected objects of one step and where they will be, sampled every 0.2 s (S = 41).

    Row order: static objects, vehicles, pedestrians, bicycles, each nearest first.

    Attributes:
      x, y, heading: `[A, S]` forecast box centre.
      sample_valid: `[A, S]` bool, the object exists at that sample.
      length, width: `[A]` m.
      type: `[A]` int32, `ObjectType`.
      is_agent: `[A]` bool, vehicle, pedestrian or bicycle.
      speed: `[A]` current speed, m/s.
      current_heading: `[A]` current box heading.
      track: `[A]` int32, row in `Tracks`.
      valid: `[A]` bool.
      ignored: `[A]` bool, in contact with the ego now or earlier: no leader, no collision, no TTC.
    """

    x: Array
    y: Array
    heading: Array
    sample_valid: Array
    length: Array
    width: Array
    type: Array
    is_agent: Array
    speed: Array
    current_heading: Array
    track: Array
    valid: Array
    ignored: Array


class ProposalSet(struct.PyTreeNode, kw_only=True):
    """Ego candidates of one scenario: reference poses before tracking.

    Attributes:
      x, y, heading: `[P, T]` rear-axle poses, 0.1 s apart.
      valid: `[P]` bool.
      path: `[P]` int32: stage-1 paths first, then route-lane paths.
      policy: `[P]` int32, target speed.
      stage: `[P]` int32, 1 (IDM on the centreline and its parallels) or 2 (route lanes).
      lane: `[P]` int32, lane that a stage-2 proposal merges onto, else -1.
    """

    x: Array
    y: Array
    heading: Array
    valid: Array
    path: Array
    policy: Array
    stage: Array
    lane: Array


class SubScores(struct.PyTreeNode, kw_only=True):
    """The PDM score and all it is made of; padded proposals score 0.

    Attributes:
      total: `[P]` final score in [0, 1].
      no_at_fault_collision: `[P]` 0, 0.5 or 1.
      drivable_area: `[P]` 0 or 1.
      driving_direction: `[P]` 0, 0.5 or 1.
      progress: `[P]` normalised over the set.
      time_to_collision: `[P]` 0 or 1.
      comfort: `[P]` 0 or 1.
      progress_raw: `[P]` m along the progress reference.
      comfort_flags: `[P, 6]` bool: lon. acceleration, lat. acceleration, jerk, lon. jerk, yaw
        acceleration, yaw rate.
      collision_time: `[P]` s to the first at-fault collision, inf if none.
      collision_object: `[P]` int32, forecast row of that object, -1 if none.
      collision_kind: `[P]` int32, `CollisionKind` of that contact, -1 if none.
      ttc_time: `[P]` s of the first TTC violation, inf if none.
      ttc_object: `[P]` int32, forecast row, -1 if none.
      multiple_lanes, non_drivable, oncoming: `[P, T]` bool ego areas.
      valid: `[P]` bool.
    """

    total: Array
    no_at_fault_collision: Array
    drivable_area: Array
    driving_direction: Array
    progress: Array
    time_to_collision: Array
    comfort: Array
    progress_raw: Array
    comfort_flags: Array
    collision_time: Array
    collision_object: Array
    collision_kind: Array
    ttc_time: Array
    ttc_object: Array
    multiple_lanes: Array
    non_drivable: Array
    oncoming: Array
    valid: Array


class CollisionKind(IntEnum):
    """How the ego and an object met (nuPlan `CollisionType`)."""

    STOPPED_EGO = 0
    STOPPED_TRACK = 1
    ACTIVE_FRONT = 2
    ACTIVE_REAR = 3
    ACTIVE_LATERAL = 4
