"""Plane curves with a station axis: the reference lines of roads and the tracks of traffic."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STEP = 0.5
"""Sampling interval of a reference line, m."""
SMOOTHING = 12.0
"""Length over which a jump of curvature is spread (the clothoid of a real road), m."""


@dataclass(frozen=True)
class Path:
    """A curve sampled at a uniform interval and extended straight beyond both ends.

    Attributes:
      xy: `[H, 2]` points, m.
      heading: `[H]` tangent angle, unwrapped, rad.
      step: interval of the samples, m.
    """

    xy: np.ndarray
    heading: np.ndarray
    step: float

    @classmethod
    def from_curvature(
        cls,
        segments: Sequence[tuple[float, float]],
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "Path":
        """Builds a curve from (length in m, curvature in 1/m) pieces, smoothed at the joints.

        Args:
          segments: pieces in driving order, left turns positive.
          start: x, y, heading of the first point.

        Raises:
          ValueError: a piece has no positive length.
        """
        lengths = np.array([length for length, _ in segments], dtype=float)
        if not lengths.size or not np.all(lengths > 0):
            raise ValueError(f"segments is {segments}; give at least one, each longer than 0 m")
        num = round(float(lengths.sum()) / STEP) + 1
        step = float(lengths.sum()) / (num - 1)
        station = step * np.arange(num)
        piece = np.searchsorted(np.cumsum(lengths), station[:-1] + step / 2)
        curvature = np.array([value for _, value in segments], dtype=float)[piece]
        window = 2 * round(SMOOTHING / step / 2) + 1
        padded = np.pad(curvature, window // 2, mode="edge")
        curvature = np.convolve(padded, np.full(window, 1.0 / window), mode="valid")
        x, y, heading = start
        angles = heading + np.concatenate([[0.0], np.cumsum(curvature * step)])
        middle = (angles[1:] + angles[:-1]) / 2
        steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        moved = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        xy = np.array([x, y]) + moved
        return cls(xy, angles, step)

    @classmethod
    def from_points(cls, points: np.ndarray) -> "Path":
        """Resamples a polyline `[K, 2]` (repeated points allowed) at about 1 m."""
        keep = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
        points = points[np.concatenate([[True], keep])]
        station = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
        )
        num = max(round(station[-1]), 2) + 1
        samples = np.linspace(0.0, station[-1], num)
        xy = np.stack([np.interp(samples, station, points[:, i]) for i in range(2)], axis=1)
        tangent = np.gradient(xy, axis=0)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        return cls(xy, heading, float(samples[1]))

    @property
    def length(self) -> float:
        """Arc length, m."""
        return self.step * (len(self.xy) - 1)

    @property
    def stations(self) -> np.ndarray:
        """`[H]` arc length of each sample, m."""
        return self.step * np.arange(len(self.xy))

    @property
    def curvature(self) -> np.ndarray:
        """`[H]` change of heading per metre, 1/m."""
        return np.gradient(self.heading, self.step)

    def pose(self, station: np.ndarray | float) -> np.ndarray:
        """Returns `[..., 3]` x, y, heading at `station` `[...]`, m."""
        s = np.asarray(station, dtype=float) / self.step
        low = np.clip(np.floor(s).astype(int), 0, len(self.xy) - 2)
        t = s - low
        # Beyond the ends the position runs on straight; the heading stays that of the end.
        xy = self.xy[low] + t[..., None] * (self.xy[low + 1] - self.xy[low])
        turn = np.clip(t, 0.0, 1.0) * (self.heading[low + 1] - self.heading[low])
        return np.concatenate([xy, (self.heading[low] + turn)[..., None]], axis=-1)

    def offset(self, station: np.ndarray | float, left: np.ndarray | float) -> np.ndarray:
        """Returns `[..., 2]` the points `left` m to the left of the curve at `station`."""
        pose = self.pose(station)
        normal = np.stack([-np.sin(pose[..., 2]), np.cos(pose[..., 2])], axis=-1)
        return pose[..., :2] + np.asarray(left, dtype=float)[..., None] * normal

    def reversed(self) -> "Path":
        """Returns the same curve in the other direction."""
        return Path(self.xy[::-1].copy(), self.heading[::-1] + np.pi, self.step)

    def shifted(self, start: float, end: float, left: float) -> "Path":
        """Returns a curve that moves `left` m to the left between two stations and stays there.

        The transition is the quintic with zero slope and curvature at both ends. Stations of the
        result differ from the old ones by the length that the sideways motion adds.
        """
        t = np.clip((self.stations - start) / (end - start), 0.0, 1.0)
        profile = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
        return Path.from_points(self.offset(self.stations, left * profile))

    def smoothed(self, reach: float) -> "Path":
        """Returns the curve averaged with a Gaussian of standard deviation `reach`, m.

        Jumps of curvature are spread over a few `reach`; a bend of radius r moves inwards by
        about `reach`^2 / 2r.
        """
        half = int(np.ceil(3.0 * reach / self.step))
        weights = np.exp(-0.5 * (np.arange(-half, half + 1) * self.step / reach) ** 2)
        weights /= weights.sum()
        # Straight on beyond the ends, so that both stay where they are.
        wider = self.pose(self.step * np.arange(-half, len(self.xy) + half))[:, :2]
        columns = [np.convolve(wider[:, i], weights, mode="valid") for i in range(2)]
        return Path.from_points(np.stack(columns, axis=1))

    def parallel(self, left: float) -> "Path":
        """Returns the parallel curve `left` m to the left."""
        return Path.from_points(self.offset(self.stations, left))

    def station_of(self, point: np.ndarray) -> float:
        """Returns the station of the curve's point nearest to `point` `[2]`, m."""
        nearest = int(np.argmin(np.sum((self.xy - point) ** 2, axis=1)))
        angle = self.heading[nearest]
        along = (point - self.xy[nearest]) @ np.array([np.cos(angle), np.sin(angle)])
        return nearest * self.step + float(along)


def connect(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the `[H, 2]` points (about 1 m apart) of a cubic Bezier curve between two poses.

    Args:
      start: `[3]` x, y, heading where the curve begins.
      end: `[3]` where it ends; both end points are met exactly.
    """
    chord = float(np.linalg.norm(end[:2] - start[:2]))
    turn = abs(float(np.arctan2(np.sin(end[2] - start[2]), np.cos(end[2] - start[2]))))
    # The handle that lets a cubic follow the arc of this angle over this chord.
    arc = 4.0 / 3.0 * np.tan(turn / 4.0) / (2.0 * np.sin(turn / 2.0)) if turn > 1e-3 else 1.0 / 3.0
    handle = arc * chord
    control = np.stack(
        [
            start[:2],
            start[:2] + handle * np.array([np.cos(start[2]), np.sin(start[2])]),
            end[:2] - handle * np.array([np.cos(end[2]), np.sin(end[2])]),
            end[:2],
        ]
    )
    t = np.linspace(0.0, 1.0, 201)[:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    dense = weights @ control
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    samples = np.linspace(0.0, station[-1], max(round(station[-1]), 2) + 1)
    points = np.stack([np.interp(samples, station, dense[:, i]) for i in range(2)], axis=1)
    points[0], points[-1] = start[:2], end[:2]
    return points
