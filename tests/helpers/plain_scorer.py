"""The PDM scorer once more, as a plain walk through time with shapely (test reference)."""

from typing import Any

import numpy as np
import shapely

LENGTH, WIDTH, REACH = 5.176, 2.297, 1.461
AHEAD, BEHIND = np.deg2rad(30), np.deg2rad(150)
STOPPED_EGO, STOPPED_TRACK, FRONT, REAR, LATERAL = range(5)


def corners(x, y, heading, length, width) -> np.ndarray:
    """`[..., 4, 2]` front left, rear left, rear right, front right of boxes by their centre."""
    cos, sin = np.cos(heading), np.sin(heading)
    out = []
    for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        a, b = 0.5 * i * length, 0.5 * j * width
        out.append(np.stack([x + a * cos - b * sin, y + a * sin + b * cos], -1))
    return np.stack(out, -2)


def angle_to(state, point) -> float:
    """Angle between the ego's heading and the direction from its rear axle to a point."""
    x, y, heading = state[:3]
    direction = np.array([point[0] - x, point[1] - y])
    norm = np.linalg.norm(direction)
    with np.errstate(invalid="ignore"):
        return float(np.arccos(np.dot([np.cos(heading), np.sin(heading)], direction / norm)))


class PlainScorer:
    """Scores one trajectory at a time.

    Attributes:
      objects: dict of `x, y, heading, valid` `[A, S]` and `length, width, agent, speed, present,
        ignored` `[A]`.
      drivable: polygons of the drivable map.
      on_route: `[D]` bool.
      intersections: polygons.
      path: `LineString` along which progress is measured.
    """

    def __init__(self, objects, drivable, on_route, intersections, path):
        self.objects, self.path = objects, path
        self.drivable, self.on_route, self.intersections = drivable, on_route, intersections
        o = objects
        size = [o[name][:, None] for name in ("length", "width")]
        self.shapes = np.asarray(shapely.polygons(corners(o["x"], o["y"], o["heading"], *size)))

    def areas(self, state) -> tuple[bool, bool, bool]:
        """Multiple lanes, non-drivable, oncoming."""
        box = self.ego(state)
        count = [sum(shapely.contains_xy(p, *c) for c in box) for p in self.drivable]
        multiple = sum(c > 0 for c in count) > 1 and 4 not in count
        covered = [any(shapely.contains_xy(p, *c) for p in self.drivable) for c in box]
        center = box.mean(axis=0)
        routed = [p for p, on in zip(self.drivable, self.on_route, strict=True) if on]
        oncoming = not any(shapely.contains_xy(p, *center) for p in routed)
        return multiple, not all(covered), oncoming

    def ego(self, state, shift: float = 0.0) -> np.ndarray:
        """Corners of the ego, moved ahead along its heading."""
        x, y, heading = state[:3]
        reach = REACH + shift
        return corners(
            x + reach * np.cos(heading), y + reach * np.sin(heading), heading, LENGTH, WIDTH
        )

    def score(self, states: np.ndarray) -> dict:
        """All terms of one trajectory `[41, 11]`."""
        areas = [self.areas(state) for state in states]
        result: dict[str, Any] = {"areas": np.array(areas)}
        result |= self.collisions(states, areas)
        result |= self.time_to_collision(states, areas)
        centers = np.array([self.ego(state).mean(axis=0) for state in states])
        result["driving_direction"] = direction(centers, [a[2] for a in areas])
        result["drivable_area"] = float(not any(a[1] for a in areas))
        start, end = (self.path.project(shapely.Point(centers[i])) for i in (0, 40))
        result["progress_raw"] = max(end - start, 0.0)
        result["comfort_flags"] = comfort(states)
        return result

    def met(self, shape, sample: int, ignored: set) -> list[int]:
        """Objects that share a point with a shape at a forecast sample."""
        o = self.objects
        shapely.prepare(shape)
        return [
            j
            for j in range(len(self.shapes))
            if o["present"][j]
            and o["valid"][j, sample]
            and j not in ignored
            and shape.intersects(self.shapes[j, sample])
        ]

    def start_list(self) -> set:
        return set(np.flatnonzero(self.objects["ignored"]).tolist())

    def collisions(self, states, areas) -> dict:
        """At-fault collisions, in the order of time, with the list of tracks already met."""
        o = self.objects
        ignored = self.start_list()
        score, when, who, kinds = 1.0, np.inf, set(), set()
        for t, state in enumerate(states):
            box = self.ego(state)
            for j in self.met(shapely.Polygon(box), t // 2, ignored):
                center = [o["x"][j, t // 2], o["y"][j, t // 2]]
                bumper = shapely.LineString([box[0], box[3]])
                if np.hypot(state[3], state[4]) <= 0.05:
                    kind = STOPPED_EGO
                elif not o["agent"][j] or o["speed"][j] <= 0.05:
                    kind = STOPPED_TRACK
                elif angle_to(state, center) > BEHIND:
                    kind = REAR
                elif bumper.intersects(self.shapes[j, t // 2]):
                    kind = FRONT
                else:
                    kind = LATERAL
                exposed = areas[t][0] or areas[t][1]
                if kind in (STOPPED_TRACK, FRONT) or (kind == LATERAL and exposed):
                    score = min(score, 0.0 if o["agent"][j] else 0.5)
                    if t < when:
                        when = t
                    if t == when:
                        who.add(j)
                        kinds.add(kind)
                else:
                    ignored.add(j)
        return {
            "no_at_fault_collision": score,
            "collision_index": when,
            "collision_objects": who,
            "collision_kinds": kinds,
        }

    def time_to_collision(self, states, areas) -> dict:
        """TTC in the order of time and look-ahead, with a list of its own."""
        o = self.objects
        ignored = self.start_list()
        when, who = np.inf, set()
        for t, state in enumerate(states):
            speed = np.hypot(state[3], state[4])
            if speed < 0.005:
                continue
            rear = shapely.Point(state[:2])
            exposed = (
                areas[t][0] or areas[t][1] or any(p.contains(rear) for p in self.intersections)
            )
            for f in (0, 3, 6, 9):
                sample = (t + f) // 2
                shape = shapely.Polygon(self.ego(state, 0.1 * f * speed))
                for j in self.met(shape, sample, ignored):
                    angle = angle_to(state, [o["x"][j, sample], o["y"][j, sample]])
                    if angle < AHEAD or (exposed and not angle > BEHIND):
                        when = min(when, t)
                        if when == t:
                            who.add(j)
                    else:
                        ignored.add(j)
        return {"time_to_collision": float(when == np.inf), "ttc_index": when, "ttc_objects": who}


def direction(centers: np.ndarray, oncoming: list[bool]) -> float:
    """Longest way in one run of oncoming states."""
    longest = run = 0.0
    for t, against in enumerate(oncoming):
        step = np.linalg.norm(centers[t] - centers[t - 1]) if t else 0.0
        run = run + step if against else 0.0
        longest = max(longest, run)
    return 1.0 if longest < 2 else 0.5 if longest < 6 else 0.0


def smooth(signal: np.ndarray, window: int, order: int, derivative: int = 0) -> np.ndarray:
    """Windowed polynomial fits, evaluated at the window's centre; edges by the outermost fits."""
    size, half = len(signal), window // 2
    out = np.empty(size)
    for i in range(size):
        if i < half:
            first, at = 0, float(i)
        elif i >= size - half:
            first, at = size - window, float(i - size + window)
        else:
            first, at = i - (window - 1) // 2, (window - 1) / 2
        position = np.arange(window) - at
        fit = np.polynomial.polynomial.polyfit(position, signal[first : first + window], order)
        out[i] = fit[derivative] * (1, 1, 2)[derivative] / 0.1**derivative
    return out


def comfort_signals(states: np.ndarray) -> np.ndarray:
    """`[6, 41]` filtered signals of one trajectory."""
    heading, ax, ay = states[:, 2], states[:, 5], states[:, 6]
    turns = np.cumsum(np.round(np.diff(heading) / (2 * np.pi)))
    heading = np.concatenate([[heading[0]], heading[1:] - 2 * np.pi * turns])
    jerk = lambda signal: smooth(np.round(smooth(signal, 8, 2), 8), 41, 2, 1)
    signals = [
        smooth(ax, 41, 2),
        smooth(ay, 41, 2),
        jerk(np.hypot(ax, ay)),
        jerk(ax),
        smooth(heading, 5, 3, 2),
        smooth(heading, 5, 2, 1),
    ]
    return np.round(signals, 8)


def comfort(states: np.ndarray) -> np.ndarray:
    """The six flags of one trajectory."""
    low = np.array([-4.05, -4.89, -8.37, -4.13, -1.93, -0.95])[:, None]
    high = np.array([2.40, 4.89, 8.37, 4.13, 1.93, 0.95])[:, None]
    signals = comfort_signals(states)
    return np.all((signals > low) & (signals < high), axis=1)


def totals(rows: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Normalised progress and final score of a set."""
    get = lambda name: np.array([row[name] for row in rows])
    m = get("no_at_fault_collision") * get("drivable_area") * get("driving_direction")
    raw = get("progress_raw") * m
    progress = raw / raw.max() if raw.max() > 0.1 else np.where(m != 0, 1.0, 0.0)
    comfortable = get("comfort_flags").all(axis=1)
    return progress, m * (5 * progress + 5 * get("time_to_collision") + 2 * comfortable) / 12
