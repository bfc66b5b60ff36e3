"""Straight roads with hand-placed objects: every number of a scene is known to the test.

The road runs along +x from 0. Lane k's centre line is at y = -3.5 k, so that lane 0 is the leftmost
and lane 1 lies to its right.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax import api, functional
from spdm_jax.config import (
    NUM_STATES,
    PlannerConfig,
    PlannerParams,
    PlannerSpec,
    pdm_closed,
    spdm,
)
from spdm_jax.io.raw import RawArea, RawLane, RawMap, RawRoadblock, RawScenario, RawTracks
from spdm_jax.padding import PaddingConfig
from spdm_jax.planner import PlannerState, PlanResult, StepInput
from spdm_jax.types import EgoState, LightStatus, ObjectType, Scenario

LANE_WIDTH = 3.5
LIMIT = 13.4
EGO_X = 60.0
"""Station of the ego's rear axle at iteration 0, m."""
FRONT = 4.049
"""Rear axle to front bumper, m."""
NUM_HISTORY, NUM_ITERATIONS, NUM_STEPS = 2, 20, 102

PADDING = PaddingConfig(
    lanes=(16,),
    centerline_points=(2048,),
    left_boundary_points=(2048,),
    right_boundary_points=(2048,),
    lane_edges=(4096,),
    roadblocks=(16,),
    grid_cells=(262144,),
    grid_rows=(8192,),
    grid_edges=(65536,),
    tracks=(16,),
    time=(128,),
)
"""One bucket for every scene of this module, so that all share one compiled program."""

CONFIG = PlannerConfig(max_path_points=512)
PDM = pdm_closed(15, config=CONFIG)
SPDM = spdm(60, config=CONFIG)


@dataclass(frozen=True)
class Thing:
    """An object at iteration 0 that keeps its velocity.

    Attributes:
      x, y: box centre, m.
      speed: along the heading, m/s (negative: backwards).
      heading: rad.
      type: `ObjectType`.
      length, width: m.
      id: track id; numbered if empty.
      until: steps after iteration 0 for which it is recorded.
    """

    x: float
    y: float
    speed: float = 0.0
    heading: float = 0.0
    type: int = int(ObjectType.VEHICLE)
    length: float = 4.6
    width: float = 1.9
    id: str = ""
    until: int = NUM_STEPS


def parked(gap: float, lane: int = 1, ego_x: float = EGO_X) -> Thing:
    """A parked car whose rear bumper is `gap` m ahead of the ego's front bumper."""
    return Thing(ego_x + FRONT + gap + 2.3, -LANE_WIDTH * lane, id="parked")


def road(
    *,
    speed: float = 10.0,
    accel: float = 0.0,
    ego_x: float = EGO_X,
    ego_y: float | None = None,
    ego_heading: float = 0.0,
    ego_lane: int = 1,
    blocks: Sequence[Sequence[int]] = ((0, 1), (0, 1)),
    cuts: Sequence[float] = (200.0, 460.0),
    things: Sequence[Thing] = (),
    limit: float | None = LIMIT,
    red: Sequence[int] = (),
    token: str = "road",
) -> RawScenario:
    """Returns a straight road in blocks that 6 m of connectors join, all of them on the route.

    Args:
      speed: of the ego, m/s.
      accel: of the ego at iteration 0, m/s^2.
      ego_x: rear axle, m.
      ego_y: rear axle; the centre of `ego_lane` if None.
      ego_heading: rad.
      ego_lane: lane the ego is in.
      blocks: lane numbers of each block; a number that the next block lacks is a lane that ends.
      cuts: station of the end of each block, m.
      things: other objects.
      limit: speed limit of all lanes, m/s.
      red: lane numbers whose first connector shows red.
      token: of the scenario.
    """
    raw_map = RawMap(name="straight", lanes={}, roadblocks={})
    start = 0.0
    for i, (numbers, end) in enumerate(zip(blocks, cuts, strict=True)):
        _add_block(raw_map, f"b{i}", numbers, start, end, limit, None)
        if i + 1 < len(blocks):
            common = sorted(set(numbers) & set(blocks[i + 1]))
            crossing = _strip(end, end + 6.0, common)
            raw_map.intersections.append(RawArea(f"x{i}", crossing))
            _add_block(raw_map, f"c{i}", common, end, end + 6.0, limit, f"x{i}")
        start = end + 6.0
    for i in range(len(blocks) - 1):
        for k in sorted(set(blocks[i]) & set(blocks[i + 1])):
            _link(raw_map, f"b{i}/{k}", f"c{i}/{k}", f"b{i + 1}/{k}")
    time = np.arange(NUM_STEPS) - NUM_HISTORY
    ego = np.zeros((NUM_STEPS, 11))
    ego[:, 0] = ego_x + speed * np.cos(ego_heading) * 0.1 * time
    ego[:, 1] = -LANE_WIDTH * ego_lane if ego_y is None else ego_y
    ego[:, 1] += speed * np.sin(ego_heading) * 0.1 * time
    ego[:, 2], ego[:, 3], ego[:, 5] = ego_heading, speed, accel
    return RawScenario(
        token=token,
        log_name="made",
        scenario_type="straight",
        source="test",
        map=raw_map,
        time_us=1_000_000_000 + 100_000 * (time.astype(np.int64)),
        num_history=NUM_HISTORY,
        num_iterations=NUM_ITERATIONS,
        ego=ego,
        ego_valid=np.ones(NUM_STEPS, bool),
        tracks=_tracks(things, time),
        lights=[{f"c0/{k}": int(LightStatus.RED) for k in red} for _ in time],
        route_roadblocks=list(raw_map.roadblocks),
    )


def lane_end(*, speed: float = 10.0, length: float = 90.0, token: str = "lane-end") -> RawScenario:
    """The ego's lane 1 ends `length` m ahead of its rear axle; the goal is on lane 0 beside it."""
    return road(
        speed=speed,
        blocks=((0, 1), (0,)),
        cuts=(EGO_X + length, EGO_X + 400.0),
        token=token,
    )


def moved(raw: RawScenario, angle: float, shift: Sequence[float]) -> RawScenario:
    """Returns the whole scene rotated about the origin, then shifted."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])
    points = lambda xy: np.asarray(xy) @ turn + np.asarray(shift, float)
    poses = lambda pose: np.concatenate([points(pose[..., :2]), pose[..., 2:] + angle], -1)
    area = lambda a: RawArea(a.id, shapely.transform(a.polygon, points), a.kind)
    lanes = {
        key: dataclasses.replace(
            lane,
            centerline=poses(lane.centerline),
            left_boundary=points(lane.left_boundary),
            right_boundary=points(lane.right_boundary),
            polygon=points(lane.polygon),
        )
        for key, lane in raw.map.lanes.items()
    }
    blocks = {
        key: dataclasses.replace(block, polygon=shapely.transform(block.polygon, points))
        for key, block in raw.map.roadblocks.items()
    }
    layers = {"intersections", "car_parks", "drivable", "crosswalks", "walkways", "stop_lines"}
    areas = {layer: [area(a) for a in getattr(raw.map, layer)] for layer in layers}
    return dataclasses.replace(
        raw,
        map=RawMap(name=raw.map.name, lanes=lanes, roadblocks=blocks, **areas),
        ego=np.concatenate([poses(raw.ego[:, :3]), raw.ego[:, 3:]], -1),
        tracks=dataclasses.replace(
            raw.tracks, pose=poses(raw.tracks.pose), velocity=raw.tracks.velocity @ turn
        ),
    )


def reordered(raw: RawScenario, seed: int) -> tuple[RawScenario, np.ndarray]:
    """Returns the scene with tracks, lanes and blocks in another order, and the order of tracks."""
    rng = np.random.default_rng(seed)
    mix = lambda table: {key: table[key] for key in rng.permutation(list(table)).tolist()}
    order = rng.permutation(len(raw.tracks.ids))
    tracks = raw.tracks
    return dataclasses.replace(
        raw,
        map=dataclasses.replace(
            raw.map, lanes=mix(raw.map.lanes), roadblocks=mix(raw.map.roadblocks)
        ),
        tracks=RawTracks(
            ids=[tracks.ids[i] for i in order],
            type=tracks.type[order],
            pose=tracks.pose[order],
            velocity=tracks.velocity[order],
            size=tracks.size[order],
            valid=tracks.valid[order],
        ),
    ), order


def scene_of(raw: RawScenario, dtype=jnp.float64) -> Scenario:
    """Returns one padded scene on the device."""
    batch = functional.to_device(api.from_raw([raw], padding=PADDING).batch, dtype)
    scene = jax.tree.map(lambda v: v[0], batch)
    return scene.replace(origin=jnp.zeros(2, dtype))


init = jax.jit(functional.init, static_argnames="config")
observe = jax.jit(functional.observe)


@partial(jax.jit, static_argnames="config")
def advance(
    scene: Scenario,
    given: StepInput,
    state: PlannerState,
    params: PlannerParams,
    config: PlannerConfig,
) -> tuple[PlanResult, PlannerState, EgoState]:
    """One step, and the ego 0.1 s later if it tracks the plan."""
    result, following = functional.step(scene, given, state, params, config)
    x, y, heading = (
        getattr(result.trajectory, name)[None, :NUM_STATES] for name in ("x", "y", "heading")
    )
    states, _ = functional.track(x, y, heading, given.ego, params.vehicle, params.tracker)
    return result, following, jax.tree.map(lambda v: v[0, 1], states)


def plan(raw: RawScenario, planner: PlannerSpec) -> PlanResult:
    """Plans once at iteration 0, in float64."""
    scene = scene_of(raw)
    state = init(scene, planner.params, config=planner.config)
    result, _, _ = advance(scene, observe(scene, 0), state, planner.params, config=planner.config)
    return jax.tree.map(np.asarray, result)


def drive(
    raw: RawScenario, planner: PlannerSpec, steps: int
) -> tuple[np.ndarray, list[PlanResult]]:
    """Closed loop in which the ego tracks its plan and the observation stays as at iteration 0.

    Returns:
      Ego poses `[steps + 1, 4]` x, y, heading, speed in map coordinates, and every plan.
    """
    scene = scene_of(raw)
    origin = np.round(raw.ego[raw.num_history, :2])
    state = init(scene, planner.params, config=planner.config)
    given = observe(scene, 0)
    poses, results = [], []
    for _ in range(steps):
        poses.append([float(getattr(given.ego, n)) for n in ("x", "y", "heading", "vx")])
        result, state, ego = advance(scene, given, state, planner.params, config=planner.config)
        results.append(result)
        given = given.replace(ego=ego)
    poses.append([float(getattr(given.ego, n)) for n in ("x", "y", "heading", "vx")])
    return np.array(poses) + np.append(origin, [0, 0]), results


def _strip(start: float, end: float, numbers: Sequence[int]) -> shapely.Polygon:
    top, bottom = 0.5 - min(numbers), -0.5 - max(numbers)
    return shapely.box(start, bottom * LANE_WIDTH, end, top * LANE_WIDTH)


def _add_block(raw_map, block, numbers, start, end, limit, intersection) -> None:
    # Odd steps of 5/3 m: vertices never fall together with an object's projection.
    x = np.linspace(start, end, max(2, int((end - start) * 0.6)))
    for k in numbers:
        y = np.full_like(x, -LANE_WIDTH * k)
        left = np.stack([x, y + LANE_WIDTH / 2], 1)
        right = np.stack([x, y - LANE_WIDTH / 2], 1)
        raw_map.lanes[f"{block}/{k}"] = RawLane(
            id=f"{block}/{k}",
            is_connector=intersection is not None,
            roadblock=block,
            centerline=np.stack([x, y, np.zeros_like(x)], 1),
            left_boundary=left,
            right_boundary=right,
            polygon=np.concatenate([left, right[::-1]]),
            left_neighbor=f"{block}/{k - 1}" if k - 1 in numbers else None,
            right_neighbor=f"{block}/{k + 1}" if k + 1 in numbers else None,
            speed_limit=limit,
            intersection=intersection,
        )
    raw_map.roadblocks[block] = RawRoadblock(
        id=block,
        is_connector=intersection is not None,
        polygon=_strip(start, end, numbers),
        lanes=[f"{block}/{k}" for k in sorted(numbers)],
    )
    raw_map.drivable.append(RawArea(block, _strip(start, end, numbers)))


def _link(raw_map: RawMap, *chain: str) -> None:
    for before, after in itertools.pairwise(chain):
        a, b = raw_map.lanes[before], raw_map.lanes[after]
        a.successors, b.predecessors = (*a.successors, after), (*b.predecessors, before)
        first, second = raw_map.roadblocks[a.roadblock], raw_map.roadblocks[b.roadblock]
        first.successors = tuple(dict.fromkeys((*first.successors, second.id)))
        second.predecessors = tuple(dict.fromkeys((*second.predecessors, first.id)))


def _tracks(things: Sequence[Thing], time: np.ndarray) -> RawTracks:
    shape = (len(things), len(time))
    pose, velocity, size = np.zeros((*shape, 3)), np.zeros((*shape, 2)), np.zeros((*shape, 2))
    for row, thing in enumerate(things):
        direction = np.array([np.cos(thing.heading), np.sin(thing.heading)])
        velocity[row] = thing.speed * direction
        pose[row, :, :2] = [thing.x, thing.y] + 0.1 * time[:, None] * velocity[row]
        pose[row, :, 2] = thing.heading
        size[row] = thing.length, thing.width
    until = np.array([thing.until for thing in things], int).reshape(-1, 1)
    return RawTracks(
        ids=[thing.id or f"thing-{i}" for i, thing in enumerate(things)],
        type=np.array([int(thing.type) for thing in things], int),
        pose=pose,
        velocity=velocity,
        size=size,
        valid=np.broadcast_to(time <= until, shape).copy(),
    )
