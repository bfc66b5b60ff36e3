"""Seeded traffic on given paths: IDM drivers, scripted objects, lights, and the recorded ego.

Every driver follows a path by the intelligent driver model behind the nearest box on that path,
slows down for bends, stops at red lights and gives way to scripted walkers, whose future is known.
Drivers with a give-way line wait there for crossing traffic. Before iteration 0 everything moves
at constant speed, so that a scene's state at iteration 0 is exactly the one asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spdm_jax.config import DT, VehicleParams
from spdm_jax.io.raw import RawTracks
from spdm_jax.synthetic.network import PathNetwork, View
from spdm_jax.synthetic.paths import Path
from spdm_jax.types import LightStatus, ObjectType

NUM_HISTORY = 22
"""Recorded steps before iteration 0."""
NUM_ITERATIONS = 150
"""Steps of the scenario's own window."""
NUM_STEPS = NUM_HISTORY + NUM_ITERATIONS + 80
"""Recorded steps of a scene: history, window and 8 s beyond it."""
MAX_STEPS = NUM_HISTORY + 300 + 80
"""Recorded steps of the longest scenes."""

EGO = VehicleParams()
EGO_FRONT = float(EGO.rear_axle_to_center) + float(EGO.length) / 2
"""Distance from the ego's rear axle to its front bumper, m."""

MIN_GAP = 2.0  # m, IDM s0
HEADWAY_TIME = 1.2  # s, IDM T
ACCEL_MAX = 1.5  # m/s^2, IDM a
DECEL_COMFORT = 2.0  # m/s^2, IDM b
DECEL_LIMIT = 6.0  # m/s^2, tyres
SIDE_CLEARANCE = 0.2  # m, boxes closer than this sideways are followed
FIRM_DECEL = 3.0  # m/s^2, yellow lights and give-way lines are passed if stopping needs more
LOOKAHEAD = np.arange(0.5, 7.01, 0.5)  # s, samples of the future that is given way to
LOOKAHEAD_STEPS = np.rint(LOOKAHEAD / DT).astype(int)
ARRIVAL_MARGIN = 2.0  # m, boxes expected closer than this along the path conflict
ARRIVAL_SLACK = 1.5  # s, uncertainty of the arrival
YIELD_GAP = 2.0  # m, where a yielding driver stops before the conflict
GIVE_WAY_RANGE = 40.0  # m, from there on a driver watches the crossing traffic
CROSSING_ANGLE = 0.3  # rad, traffic at a smaller angle is followed, not given way to
OBSERVED_RANGE = 120.0  # m, objects further from the ego are not recorded
_YELLOW, _RED = int(LightStatus.YELLOW), int(LightStatus.RED)  # plain numbers compare faster


@dataclass(frozen=True)
class Follower:
    """A vehicle (or bicycle) that drives along a path.

    Attributes:
      path: track of the box centre (of the rear axle for the ego).
      station: where it is at iteration 0, m.
      speed: at iteration 0 and before, m/s.
      desired_speed: m/s; 0 stands for ever (a parked car).
      size: length, width, m.
      type: class.
      gates: (station, connector) pairs of the stop lines of lights.
      give_way: station of the line at which to give way to crossing traffic, m.
      rank: of two drivers who both wait at such lines, the one with the lower rank goes first.
      jerk_limit: bound on the change of acceleration, m/s^3.
    """

    path: Path
    station: float
    speed: float
    desired_speed: float
    size: tuple[float, float] = (4.6, 1.9)
    type: ObjectType = ObjectType.VEHICLE
    gates: tuple[tuple[float, str], ...] = ()
    give_way: float | None = None
    rank: int = 1
    jerk_limit: float = np.inf


@dataclass(frozen=True)
class Scripted:
    """An object whose motion is known beforehand: a straight walk, or no motion at all.

    Attributes:
      start: x, y, heading before it sets out.
      size: length, width, m.
      type: class.
      speed: along the heading while it moves, m/s.
      begin: s relative to iteration 0.
      distance: m, after which it stands still.
    """

    start: tuple[float, float, float]
    size: tuple[float, float]
    type: ObjectType
    speed: float = 0.0
    begin: float = -100.0
    distance: float = 0.0

    def poses(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns `[T, 3]` poses and `[T]` speeds at `time` `[T]`, s."""
        travelled = np.clip((time - self.begin) * self.speed, 0.0, self.distance)
        moving = (travelled > 0.0) & (travelled < self.distance)
        x, y, heading = self.start
        poses = np.stack(
            [
                x + travelled * np.cos(heading),
                y + travelled * np.sin(heading),
                np.full(time.shape, heading),
            ],
            axis=-1,
        )
        return poses, np.where(moving, self.speed, 0.0)


def simulate(
    ego: Follower,
    followers: Sequence[Follower],
    scripted: Sequence[Scripted],
    lights: dict[str, np.ndarray],
    rng: np.random.Generator,
    num_steps: int = NUM_STEPS,
    remember_static: bool = False,
) -> tuple[np.ndarray, RawTracks]:
    """Runs the traffic of one scene.

    Args:
      ego: the recorded ego; `path` and all stations are those of its rear axle, its size is the
        library's.
      followers: vehicles and bicycles.
      scripted: pedestrians and static objects.
      lights: connector -> `[T]` `LightStatus`, at least as long as the run.
      rng: source of the drivers' imperfection.
      num_steps: T, recorded steps.
      remember_static: whether an object that is no agent stays on record once the ego has seen it.

    Returns:
      The ego's `[T, 11]` states in nuPlan's column order, and the tracks (order of first
      appearance; objects never within range of the ego are left out).
    """
    traffic = _Traffic(ego, followers, scripted, lights, num_steps)
    noise = np.zeros(len(traffic.drivers))
    for step in range(NUM_HISTORY, num_steps):
        # The drivers' attention drifts; the recorded ego's does not.
        noise = 0.9 * noise + 0.05 * rng.standard_normal(len(noise))
        noise[0] = 0.0
        traffic.advance(step, noise)
    return traffic.ego_states(), traffic.tracks(remember_static)


class _Traffic:
    """State of all drivers over the whole time axis; the ego is driver 0."""

    def __init__(
        self,
        ego: Follower,
        followers: Sequence[Follower],
        scripted: Sequence[Scripted],
        lights: dict[str, np.ndarray],
        num_steps: int,
    ):
        self.num_steps = num_steps
        self.drivers = [ego, *followers]
        self.lights = lights
        self.network = PathNetwork([d.path for d in self.drivers])
        self.types = np.array([*(d.type for d in followers), *(s.type for s in scripted)], int)
        sizes = [(float(EGO.length), float(EGO.width)), *(d.size for d in followers)]
        self.half = np.array(sizes) / 2
        self.desired = np.array([d.desired_speed for d in self.drivers])
        self.change = np.array([d.jerk_limit for d in self.drivers]) * DT
        lines = [-np.inf if d.give_way is None else d.give_way for d in self.drivers]
        self.lines, self.rank = np.array(lines), np.array([d.rank for d in self.drivers])
        # The ego's station is its rear axle's; all other boxes are centred on theirs.
        self.to_center = np.zeros(len(self.drivers))
        self.to_center[0] = float(EGO.rear_axle_to_center)

        time = (np.arange(num_steps) - NUM_HISTORY) * DT
        walks = [s.poses(time) for s in scripted]
        self.script_pose = np.array([p for p, _ in walks]).reshape(-1, num_steps, 3)
        self.script_speed = np.array([v for _, v in walks]).reshape(-1, num_steps)
        self.script_half = np.array([s.size for s in scripted]).reshape(-1, 2) / 2
        seen = self.network.view(
            self.script_pose.reshape(-1, 3), np.repeat(self.script_half, num_steps, axis=0)
        )
        self.script_view = seen.reshape(len(self.network.length), len(scripted), num_steps)

        self.station = np.zeros((len(self.drivers), num_steps))
        self.speed, self.accel = np.zeros_like(self.station), np.zeros_like(self.station)
        past = slice(0, NUM_HISTORY + 1)
        self.speed[:, past] = np.array([[d.speed] for d in self.drivers])
        start = np.array([[d.station] for d in self.drivers])
        self.station[:, past] = start + self.speed[:, past] * time[past]

    def advance(self, step: int, noise: np.ndarray) -> None:
        """Decides all accelerations at `step` and moves the drivers to the next one."""
        index = self.network.index
        station, speed = self.station[:, step], self.speed[:, step]
        pressure = np.maximum(self._following(step), self._walkers(step))
        for i, gap in self._lines(step):
            pressure[i] = max(pressure[i], _interaction(gap, speed[i], 0.0))
        target = np.minimum(self.desired, self.network.speed_limit(index, station))
        free = 1.0 - (speed / np.maximum(target, 0.1)) ** 4
        accel = np.clip(ACCEL_MAX * (free - pressure) + noise, -DECEL_LIMIT, ACCEL_MAX)
        accel[self.desired == 0.0] = -DECEL_LIMIT
        before = self.accel[:, step - 1]
        accel = np.clip(accel, before - self.change, before + self.change)
        # Nobody rolls backwards: the last braking step ends at speed zero.
        accel = np.maximum(accel, -speed / DT)
        self.accel[:, step] = accel
        if step + 1 < self.num_steps:
            self.station[:, step + 1] = station + DT * speed + 0.5 * DT**2 * accel
            self.speed[:, step + 1] = np.maximum(speed + DT * accel, 0.0)

    def centers(self, who: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Returns `[..., 3]` box centres of drivers `who` at `station`, both `[...]`."""
        pose = self.network.pose(self.network.index[who], station)
        pose[..., 0] += self.to_center[who] * np.cos(pose[..., 2])
        pose[..., 1] += self.to_center[who] * np.sin(pose[..., 2])
        return pose

    def _gone(self, step: int) -> np.ndarray:
        """Returns `[F]` whether a driver has left the road."""
        return self.station[:, step] > self.network.length[self.network.index]

    def _following(self, step: int) -> np.ndarray:
        """Returns `[F]` the interaction with the boxes that are on the paths now."""
        num = len(self.drivers)
        who = np.arange(num)
        pose = self.centers(who, self.station[:, step])
        boxes = self.network.view(pose, self.half)
        seen = boxes.joined(self.script_view.at((..., step))).at(self.network.index)
        center = (self.station[:, step] + self.to_center)[:, None]
        ahead = seen.station - center
        on_path = np.abs(seen.lateral) < seen.across + self.half[:, 1:] + SIDE_CLEARANCE
        on_path &= ahead > 0.1
        on_path[:, :num] &= ~self._gone(step)
        gap = ahead - seen.along - self.half[:, :1]
        speeds = np.concatenate([self.speed[:, step], self.script_speed[:, step]])
        lead_speed = speeds * np.cos(seen.turn)
        term = _interaction(gap, self.speed[:, step, None], lead_speed)
        return np.where(on_path, term, 0.0).max(axis=1)

    def _walkers(self, step: int) -> np.ndarray:
        """Returns `[F]` the interaction with scripted walkers who will be in the way.

        Drivers who can no longer stop before the conflict drive on.
        """
        later = np.minimum(step + LOOKAHEAD_STEPS, self.num_steps - 1)
        moving = np.flatnonzero(np.any(self.script_speed[:, later] > 0.0, axis=1))
        if not moving.size:
            return np.zeros(len(self.drivers))
        index = (self.network.index[:, None, None], moving[:, None], later)
        seen = self.script_view.at(index)
        speed, half = self.speed[:, step], self.half[:, :, None, None]
        ahead = seen.station - (self.station[:, step] + self.to_center)[:, None, None]
        gap = ahead - seen.along - half[:, 0] - YIELD_GAP
        who = np.arange(len(self.drivers))
        conflict = self._meets(seen, who, step) & (
            gap > speed[:, None, None] ** 2 / (2.0 * DECEL_LIMIT)
        )
        term = np.where(conflict, _interaction(gap, speed[:, None, None], 0.0), 0.0)
        return term.max(axis=(1, 2))

    def _lines(self, step: int) -> list[tuple[int, float]]:
        """Returns (driver, gap in m) for each line at which a driver should stop now."""
        stops, first = [], {}
        for i, driver in enumerate(self.drivers):
            front = self.station[i, step] + self.to_center[i] + self.half[i, 0]
            for gate, connector in driver.gates:
                gap = gate - front
                status = self.lights[connector][step]
                if gap > -0.5 and _must_stop(status, gap, self.speed[i, step]):
                    stops.append((i, gap))
            if driver.give_way is None:
                continue
            # Who waits does so at MIN_GAP; who is nearer has set off and does not stop again.
            gap = driver.give_way - front
            if 0.9 * MIN_GAP < gap < GIVE_WAY_RANGE:
                row = self.network.index[i]
                first[row] = min(first.get(row, (np.inf, -1)), (gap, i))
        # Only the first of a queue decides; the others are behind it anyway.
        for gap, i in first.values():
            can_stop = self.speed[i, step] ** 2 < 2.0 * FIRM_DECEL * gap
            if can_stop and self._crossing(i, step):
                stops.append((i, gap))
        return stops

    def _crossing(self, driver: int, step: int) -> bool:
        """Returns whether another driver will cross the path of `driver`.

        The others are expected to keep their speed. Of those before a give-way line of their own
        only lower ranks count, and these are expected to set off.
        """
        fronts = self.station[:, step] + self.to_center + self.half[:, 0]
        waiting = fronts < self.lines
        others = np.where(waiting, self.rank < self.rank[driver], self.speed[:, step] > 0.0)
        others &= ~self._gone(step)
        others[driver] = False
        who = np.flatnonzero(others)
        if not who.size:
            return False
        keep = self.speed[who, step, None] * LOOKAHEAD
        way = np.where(waiting[who, None], self._way(who, step, LOOKAHEAD), keep)
        future = self.station[who, step, None] + way
        pose = self.centers(who[:, None], future).reshape(-1, 3)
        half = np.repeat(self.half[who], len(LOOKAHEAD), axis=0)
        seen = self.network.view(pose, half, self.network.index[[driver]])
        seen = seen.reshape(1, *future.shape)
        crossing = np.abs(np.sin(seen.turn)) > np.sin(CROSSING_ANGLE)
        return bool(np.any(crossing & self._meets(seen, np.array([driver]), step)))

    def _meets(self, seen: View, who: np.ndarray, step: int) -> np.ndarray:
        """Returns `[F', J, K]` whether drivers meet boxes that they see at the times `LOOKAHEAD`.

        They are expected to speed up to their desired speed, give or take `ARRIVAL_SLACK`.
        """
        half = self.half[who][:, :, None, None]
        center = (self.station[who, step] + self.to_center[who])[:, None, None]
        ahead, reach = seen.station - center, seen.along + half[:, 0] + ARRIVAL_MARGIN
        early, late = (
            self._way(who, step, np.maximum(LOOKAHEAD + slack, 0.0))[:, None]
            for slack in (-ARRIVAL_SLACK, ARRIVAL_SLACK)
        )
        on_path = np.abs(seen.lateral) < seen.across + half[:, 1] + SIDE_CLEARANCE
        return on_path & (ahead > early - reach) & (ahead < late + reach)

    def _way(self, who: np.ndarray, step: int, time: np.ndarray) -> np.ndarray:
        """Returns `[F', K]` how far drivers get in `time` `[K]` if they speed up."""
        speed = self.speed[who, step, None]
        top = np.maximum(speed, self.desired[who, None])
        return np.minimum(speed * time + 0.5 * ACCEL_MAX * time**2, top * time)

    def ego_states(self) -> np.ndarray:
        """Returns `[T, 11]` states of the ego, whose steering follows from its path."""
        station, speed = self.station[0], self.speed[0]
        row = np.zeros(self.num_steps, dtype=int)
        pose = self.network.pose(row, station)
        # Curvature from the heading over one metre of the path, defined at standstill too.
        ahead = self.network.pose(row, station + 0.5)[:, 2]
        behind = self.network.pose(row, station - 0.5)[:, 2]
        curvature = ahead - behind
        yaw_rate = speed * curvature
        steering = np.arctan(float(EGO.wheel_base) * curvature)
        columns = [
            pose,
            speed,
            np.zeros_like(speed),
            self.accel[0],
            speed * yaw_rate,
            steering,
            np.gradient(steering, DT),
            yaw_rate,
            np.gradient(yaw_rate, DT),
        ]
        return np.column_stack(columns)

    def tracks(self, remember_static: bool) -> RawTracks:
        """Returns what the ego observes, in order of first appearance; other entries are zero."""
        rows = self.network.index[1:, None]
        everyone = np.broadcast_to(np.arange(len(self.drivers))[:, None], self.station.shape)
        center = self.centers(everyone, self.station)
        pose = np.concatenate([center[1:], self.script_pose])
        speed = np.concatenate([self.speed[1:], self.script_speed])
        size = 2.0 * np.concatenate([self.half[1:], self.script_half])
        valid = np.linalg.norm(pose[..., :2] - center[0, :, :2], axis=-1) < OBSERVED_RANGE
        valid[: len(rows)] &= self.station[1:] <= self.network.length[rows]
        if remember_static:
            static = self.types > ObjectType.BICYCLE
            valid[static] = np.logical_or.accumulate(valid[static], axis=1)

        seen = np.flatnonzero(valid.any(axis=1))
        order = seen[np.argsort(valid[seen].argmax(axis=1), kind="stable")]
        pose, speed, valid = pose[order], speed[order], valid[order]
        mask = valid[..., None]
        direction = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
        return RawTracks(
            ids=[f"track-{i}" for i in order],
            type=self.types[order],
            pose=np.where(mask, pose, 0.0),
            velocity=np.where(mask, speed[..., None] * direction, 0.0),
            size=np.where(mask, size[order][:, None], 0.0),
            valid=valid,
        )


def _interaction(
    gap: np.ndarray | float, speed: np.ndarray | float, lead_speed: np.ndarray | float
) -> np.ndarray:
    """Returns IDM's interaction term (s*/s)^2."""
    closing = speed * (speed - lead_speed) / (2.0 * np.sqrt(ACCEL_MAX * DECEL_COMFORT))
    wanted = MIN_GAP + np.maximum(speed * HEADWAY_TIME + closing, 0.0)
    return (wanted / np.maximum(gap, 0.1)) ** 2


def _must_stop(status: int, gap: float, speed: float) -> bool:
    """Returns whether a light at `gap` m stops a vehicle."""
    if status == _YELLOW:
        return speed**2 < 2.0 * FIRM_DECEL * gap
    return status == _RED
