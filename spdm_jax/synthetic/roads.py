"""Procedural road networks as `RawMap`: corridors, crossings and what stands beside them.

Right-hand traffic. Coordinates are local to the scene (see `spdm_jax.synthetic.scenes` for the
placement in map coordinates). As in nuPlan, lanes alternate with lane connectors, and every
connector lies in an intersection, even where a straight road only changes its block.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from shapely.geometry import MultiPoint, Polygon
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock
from spdm_jax.synthetic.paths import Path, connect
from spdm_jax.types import DrivableKind

LANE_WIDTH = 3.5
"""Width of every lane, m."""
MARGIN = 0.5
"""Drivable surface beyond the outermost lanes, m."""
INTERSECTION_PLAIN, INTERSECTION_LIGHT, INTERSECTION_PASS_THROUGH = 0, 1, 5
"""nuPlan's numbers of the intersection types used here."""
STOP_LINE_LIGHT = 2
"""nuPlan's number of a stop polygon that belongs to a light."""


@dataclass(frozen=True)
class LaneShape:
    """Centre line and edges of one lane, each `[H, 2]`, in driving direction."""

    center: np.ndarray
    left: np.ndarray
    right: np.ndarray


def lane_along(path: Path, start: float, end: float, left: float) -> LaneShape:
    """Returns the lane whose centre runs `left` m beside `path` between two stations."""
    stations = np.linspace(start, end, max(round(end - start), 2) + 1)
    half = LANE_WIDTH / 2
    return LaneShape(*(path.offset(stations, left + d) for d in (0.0, half, -half)))


def lane_between(start: np.ndarray, end: np.ndarray) -> LaneShape:
    """Returns a turning lane from one pose `[3]` to another."""
    points = connect(start, end)
    tangent = np.gradient(points, axis=0)
    heading = np.arctan2(tangent[:, 1], tangent[:, 0])
    heading[[0, -1]] = start[2], end[2]
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    half = LANE_WIDTH / 2
    return LaneShape(points, points + half * normal, points - half * normal)


def strip(path: Path, start: float, end: float, right: float, left: float) -> Polygon:
    """Returns the band between two lateral offsets (left positive) and two stations."""
    stations = np.linspace(start, end, max(round(end - start), 1) + 1)
    edges = path.offset(stations, left), path.offset(stations, right)[::-1]
    return Polygon(np.concatenate(edges))


@dataclass
class MapBuilder:
    """Collects the elements of one map and keeps their references to each other consistent."""

    name: str
    lanes: dict[str, RawLane] = field(default_factory=dict)
    roadblocks: dict[str, RawRoadblock] = field(default_factory=dict)
    intersections: list[RawArea] = field(default_factory=list)
    car_parks: list[RawArea] = field(default_factory=list)
    drivable: list[RawArea] = field(default_factory=list)
    crosswalks: list[RawArea] = field(default_factory=list)
    walkways: list[RawArea] = field(default_factory=list)
    stop_lines: list[RawArea] = field(default_factory=list)

    def add_block(
        self,
        block: str,
        shapes: Mapping[int, LaneShape],
        *,
        speed_limit: float | None,
        intersection: str | None = None,
        light: bool = False,
        stop_line: str | None = None,
    ) -> None:
        """Adds a roadblock, or a roadblock connector where `intersection` is given.

        Args:
          block: id of the roadblock; lane `k` gets the id `f"{block}/{k}"`.
          shapes: lanes by number, left to right.
          speed_limit: of all its lanes, m/s.
          intersection: the intersection that the connectors cross.
          light: the connectors obey a traffic light.
          stop_line: their stop polygon.
        """
        connector = intersection is not None
        ids = [f"{block}/{k}" for k in shapes]
        for i, (lane, shape) in enumerate(zip(ids, shapes.values(), strict=True)):
            segments = np.diff(shape.center, axis=0)
            heading = np.arctan2(segments[:, 1], segments[:, 0])
            self.lanes[lane] = RawLane(
                id=lane,
                is_connector=connector,
                roadblock=block,
                centerline=np.column_stack([shape.center, np.append(heading, heading[-1])]),
                left_boundary=shape.left,
                right_boundary=shape.right,
                polygon=np.concatenate([shape.left, shape.right[::-1]]),
                left_neighbor=ids[i - 1] if i > 0 and not connector else None,
                right_neighbor=ids[i + 1] if i + 1 < len(ids) and not connector else None,
                speed_limit=speed_limit,
                intersection=intersection,
                has_traffic_light=light,
                stop_line=stop_line,
            )
        outer = list(shapes.values())
        ring = np.concatenate([outer[0].left, outer[-1].right[::-1]])
        self.roadblocks[block] = RawRoadblock(block, connector, Polygon(ring), tuple(ids))

    def link(self, lane: str, successor: str) -> None:
        """Makes `successor` follow `lane`, and its block follow that of `lane`."""
        before, after = self.lanes[lane], self.lanes[successor]
        before.successors = (*before.successors, successor)
        after.predecessors = (*after.predecessors, lane)
        source, target = self.roadblocks[before.roadblock], self.roadblocks[after.roadblock]
        if target.id not in source.successors:
            source.successors = (*source.successors, target.id)
            target.predecessors = (*target.predecessors, source.id)

    def add_road_surface(self, name: str, polygon: Polygon) -> None:
        """Adds a road segment."""
        self.drivable.append(RawArea(name, polygon, DrivableKind.ROAD_SEGMENT))

    def add_intersection(self, name: str, polygon: BaseGeometry, kind: int) -> None:
        """Adds an intersection, which is drivable; `kind` is nuPlan's number."""
        self.intersections.append(RawArea(name, polygon, kind))
        self.drivable.append(RawArea(name, polygon, DrivableKind.INTERSECTION))

    def add_car_park(self, name: str, polygon: Polygon) -> None:
        """Adds a car park, which is drivable."""
        self.car_parks.append(RawArea(name, polygon))
        self.drivable.append(RawArea(name, polygon, DrivableKind.CAR_PARK))

    def path(self, lanes: Sequence[str]) -> Path:
        """Returns the centre line of successive lanes as one curve."""
        return Path.from_points(np.concatenate([self.lanes[i].centerline[:, :2] for i in lanes]))

    def follow(self, lane: str, turns: Sequence[str] = ()) -> list[str]:
        """Returns the lanes from `lane` to the end of the road.

        Args:
          lane: first lane.
          turns: connectors to take where the road forks; otherwise the first successor is taken.
        """
        lanes = [lane]
        while successors := self.lanes[lanes[-1]].successors:
            wanted = [i for i in successors if i in turns]
            lanes.append((wanted or list(successors))[0])
        return lanes

    def build(self) -> RawMap:
        """Returns the map."""
        return RawMap(
            name=self.name,
            lanes=self.lanes,
            roadblocks=self.roadblocks,
            intersections=self.intersections,
            car_parks=self.car_parks,
            drivable=self.drivable,
            crosswalks=self.crosswalks,
            walkways=self.walkways,
            stop_lines=self.stop_lines,
        )


def add_corridor(
    builder: MapBuilder,
    name: str,
    path: Path,
    cuts: Sequence[tuple[float, float]],
    *,
    forward: Sequence[Sequence[int]],
    backward: int = 0,
    speed_limit: float | None = 13.4,
    connector_limit: float | None = None,
) -> None:
    """Adds a road along `path`, cut into blocks that short connectors join.

    `path` is the line between the two directions. Forward blocks are called `f"{name}:{i}"`, the
    connectors between them `f"{name}:{i}>{i + 1}"`; the other direction has `~` after the name
    and counts its own blocks in its own driving direction.

    Args:
      builder: receives the elements.
      name: prefix of all identifiers.
      path: reference line.
      cuts: (start, end) station of each block, m.
      forward: lane numbers of each forward block, 0 is the leftmost; a number that the next block
        lacks is a lane that ends.
      backward: number of oncoming lanes.
      speed_limit: of the lanes, m/s.
      connector_limit: of the connectors, m/s.
    """
    lanes = [tuple(numbers) for numbers in forward]
    _add_direction(builder, name, path, cuts, lanes, speed_limit, connector_limit)
    if backward:
        length = path.length
        mirrored = [(length - end, length - start) for start, end in reversed(cuts)]
        lanes_back = [tuple(range(backward))] * len(cuts)
        _add_direction(
            builder, f"{name}~", path.reversed(), mirrored, lanes_back, speed_limit, connector_limit
        )

    for i, (start, end) in enumerate(cuts):
        right, left = _extent(lanes[i], backward)
        builder.add_road_surface(f"{name}:{i}", strip(path, start, end, right, left))
        if i + 1 < len(cuts):
            right, left = _extent(sorted({*lanes[i]} & {*lanes[i + 1]}), backward)
            area = strip(path, end, cuts[i + 1][0], right, left)
            builder.add_intersection(f"{name}:{i}>{i + 1}", area, INTERSECTION_PASS_THROUGH)


def _extent(lanes: Sequence[int], backward: int) -> tuple[float, float]:
    """Returns the right and left edge of the surface as offsets from the reference line, m."""
    left = backward * LANE_WIDTH if backward else -lanes[0] * LANE_WIDTH
    return -(lanes[-1] + 1) * LANE_WIDTH - MARGIN, left + MARGIN


def _add_direction(
    builder: MapBuilder,
    name: str,
    path: Path,
    cuts: Sequence[tuple[float, float]],
    lanes: Sequence[tuple[int, ...]],
    speed_limit: float | None,
    connector_limit: float | None,
) -> None:
    """Adds the blocks of one driving direction; the lanes lie to the right of `path`."""

    def shapes(numbers: Sequence[int], start: float, end: float) -> dict[int, LaneShape]:
        return {k: lane_along(path, start, end, -(k + 0.5) * LANE_WIDTH) for k in numbers}

    for i, (start, end) in enumerate(cuts):
        builder.add_block(f"{name}:{i}", shapes(lanes[i], start, end), speed_limit=speed_limit)
    for i in range(len(cuts) - 1):
        block = f"{name}:{i}>{i + 1}"
        common = sorted({*lanes[i]} & {*lanes[i + 1]})
        # Both directions share one intersection, which bears the forward name.
        shared = block
        if name.endswith("~"):
            last = len(cuts) - 1
            shared = f"{name[:-1]}:{last - i - 1}>{last - i}"
        builder.add_block(
            block,
            shapes(common, cuts[i][1], cuts[i + 1][0]),
            speed_limit=connector_limit,
            intersection=shared,
        )
        for k in common:
            builder.link(f"{name}:{i}/{k}", f"{block}/{k}")
            builder.link(f"{block}/{k}", f"{name}:{i + 1}/{k}")


def add_crossing(
    builder: MapBuilder,
    name: str,
    arms: Mapping[str, Path],
    *,
    lanes: int,
    num_blocks: int,
    light: bool = False,
    turn_limit: float | None = None,
) -> None:
    """Joins the inner ends of corridors (arms) by connectors within one intersection.

    Each arm is a corridor with `lanes` lanes per direction whose path leads outwards. Straight
    movements keep their lane; left turns use the leftmost lane, right turns the rightmost. The
    roadblock connector from arm a to arm b is called `f"{a}>{b}"`.

    Args:
      builder: receives the elements; it must have the arms already.
      name: of the intersection.
      arms: arm name -> outward path, counter-clockwise.
      lanes: lanes per direction.
      num_blocks: blocks of each arm.
      light: the crossing has traffic lights.
      turn_limit: speed limit of the connectors, m/s.
    """
    half = lanes * LANE_WIDTH + MARGIN
    ends = np.concatenate(
        [path.offset(np.zeros(2), np.array([-half, half])) for path in arms.values()]
    )
    kind = INTERSECTION_LIGHT if light else INTERSECTION_PLAIN
    hull = MultiPoint([tuple(p) for p in ends]).convex_hull
    builder.add_intersection(name, hull, kind)
    for arm, path in arms.items():
        # The crossing's own side of the arm has negative stations.
        builder.crosswalks.append(RawArea(f"{arm}.crosswalk", strip(path, -4.5, -1.5, -half, half)))
        if light:
            area = strip(path, -0.5, 0.5, 0.0, half)
            builder.stop_lines.append(RawArea(f"{arm}.stop", area, STOP_LINE_LIGHT))

    names = list(arms)
    for i, source in enumerate(names):
        for step in range(1, len(names)):
            target = names[(i + step) % len(names)]
            turn = _turn(arms[source], arms[target])
            numbers = {"left": [0], "right": [lanes - 1]}.get(turn, list(range(lanes)))
            entries = {k: f"{source}~:{num_blocks - 1}/{k}" for k in numbers}
            exits = {k: f"{target}:0/{k}" for k in numbers}
            shapes = {}
            for k in numbers:
                left = -(k + 0.5) * LANE_WIDTH
                start, end = arms[source].pose(0.0), arms[target].pose(0.0)
                start[:2] = builder.lanes[entries[k]].centerline[-1, :2]
                start[2] += np.pi
                end[:2] = arms[target].offset(0.0, left)
                shapes[k] = lane_between(start, end)
            block = f"{source}>{target}"
            builder.add_block(
                block,
                shapes,
                speed_limit=turn_limit,
                intersection=name,
                light=light,
                stop_line=f"{source}.stop" if light else None,
            )
            for k in numbers:
                builder.link(entries[k], f"{block}/{k}")
                builder.link(f"{block}/{k}", exits[k])


def _turn(source: Path, target: Path) -> str:
    """Returns "left", "right" or "straight" for the movement between two arms."""
    turn = target.heading[0] - (source.heading[0] + np.pi)
    turn = float(np.arctan2(np.sin(turn), np.cos(turn)))
    if abs(turn) < np.pi / 4:
        return "straight"
    return "left" if turn > 0 else "right"
