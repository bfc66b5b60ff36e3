"""What a reader hands over: one scenario in the source's own coordinates, float64, ragged.

A reader for a new data set fills a `RawScenario`; `spdm_jax.io.build.build_scenario` does the
rest (local frame, cropping, route, grid). Nothing here is padded or indexed: elements refer to
each other by the source's identifiers (strings).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from shapely.geometry.base import BaseGeometry


@dataclass
class RawLane:
    """A lane or lane connector.

    Attributes:
      id: identifier, unique among lanes and connectors.
      is_connector: True for a lane connector.
      roadblock: id of the roadblock (or roadblock connector) it belongs to.
      centerline: `[H, 3]` x, y, heading of the discrete baseline.
      left_boundary, right_boundary: `[H, 2]`.
      polygon: `[V, 2]` ring (closing point optional).
      successors, predecessors: lane ids; unknown ids are dropped by the builder.
      left_neighbor, right_neighbor: same-direction neighbours within the roadblock, or None.
      speed_limit: m/s, None if unknown.
      intersection: id of the intersection it lies in, or None.
      has_traffic_light: governed by a light.
      stop_line: id of its stop polygon, or None.
    """

    id: str
    is_connector: bool
    roadblock: str
    centerline: np.ndarray
    left_boundary: np.ndarray
    right_boundary: np.ndarray
    polygon: np.ndarray
    successors: Sequence[str] = ()
    predecessors: Sequence[str] = ()
    left_neighbor: str | None = None
    right_neighbor: str | None = None
    speed_limit: float | None = None
    intersection: str | None = None
    has_traffic_light: bool = False
    stop_line: str | None = None


@dataclass
class RawRoadblock:
    """A roadblock or roadblock connector: `lanes` lists its interior from left to right."""

    id: str
    is_connector: bool
    polygon: BaseGeometry
    lanes: Sequence[str] = ()
    successors: Sequence[str] = ()
    predecessors: Sequence[str] = ()


@dataclass
class RawArea:
    """Any other polygon of the map; `kind` is the layer's own number for its type."""

    id: str
    polygon: BaseGeometry
    kind: int = 0


@dataclass
class RawMap:
    """A whole map (or the part a log covers) in map coordinates."""

    name: str
    lanes: dict[str, RawLane]
    roadblocks: dict[str, RawRoadblock]
    intersections: list[RawArea] = field(default_factory=list)
    car_parks: list[RawArea] = field(default_factory=list)
    drivable: list[RawArea] = field(default_factory=list)  # kind: DrivableKind
    crosswalks: list[RawArea] = field(default_factory=list)
    walkways: list[RawArea] = field(default_factory=list)
    stop_lines: list[RawArea] = field(default_factory=list)


@dataclass
class RawTracks:
    """Objects over the packed time axis; see `spdm_jax.types.Tracks` for the meaning.

    Attributes:
      ids: track identifiers, order of first appearance.
      type: `[A]` int, `ObjectType`.
      pose: `[A, T, 3]` centre x, y, heading.
      velocity: `[A, T, 2]` along the map axes.
      size: `[A, T, 2]` length, width.
      valid: `[A, T]` bool.
    """

    ids: list[str]
    type: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    size: np.ndarray
    valid: np.ndarray


@dataclass
class RawScenario:
    """One scenario as read.

    Attributes:
      token, log_name, scenario_type, source: see `spdm_jax.types.ScenarioInfo`.
      map: the map it lives in (shared between the scenarios of a log).
      time_us: `[T]` int64 time stamps of the packed steps (nominal 0.1 s).
      num_history: index of iteration 0 in `time_us`.
      num_iterations: length of the scenario's own window.
      ego: `[T, 11]` rear-axle states in nuPlan's column order (x, y, heading, vx, vy, ax, ay,
        steering angle, steering rate, yaw rate, yaw acceleration); velocities in the body frame.
      ego_valid: `[T]` bool.
      tracks: objects.
      lights: per step, lane id -> `LightStatus` (absent = unknown).
      route_roadblocks: route as the source gives it.
      mission_goal: `[3]` or None.
      notes: remarks for the user (repairs, guesses).
    """

    token: str
    log_name: str
    scenario_type: str
    source: str
    map: RawMap
    time_us: np.ndarray
    num_history: int
    num_iterations: int
    ego: np.ndarray
    ego_valid: np.ndarray
    tracks: RawTracks
    lights: list[dict[str, int]]
    route_roadblocks: list[str]
    mission_goal: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)


class Reader(Protocol):
    """A data set on disk, or a generator: what `spdm pack` iterates over."""

    def tokens(self) -> Sequence[str]:
        """Returns the tokens that the source (and its filter) selects, in a stable order."""
        ...

    def read(self, token: str) -> RawScenario:
        """Reads one scenario.

        Raises:
          ScenarioError: the source cannot give this scenario; names file, field and value.
        """
        ...


class ScenarioError(ValueError):
    """A scenario (or its file) cannot be used; the text names file, field and value."""


def iter_scenarios(reader: Reader) -> Iterator[RawScenario]:
    """Yields every scenario of a reader; the first error ends the iteration."""
    for token in reader.tokens():
        yield reader.read(token)
