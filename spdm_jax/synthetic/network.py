"""Many paths at once: where boxes are as seen along each of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spdm_jax.synthetic.paths import Path

LATERAL_ACCEL = 2.0
"""Lateral acceleration at which bends are taken, m/s^2."""
BEND_DECEL = 2.0
"""Deceleration before bends, m/s^2."""
SEARCH_STRIDE = 6
"""Samples per step of the first search for the nearest one."""


@dataclass(frozen=True)
class View:
    """Boxes as seen from paths; all `[G, ...]`, G paths.

    Attributes:
      station: of the box centre along the path, m.
      lateral: offset of the centre to the left, m.
      along: half extent of the box along the path, m.
      across: half extent across it, m.
      turn: heading of the box relative to the path, rad.
    """

    station: np.ndarray
    lateral: np.ndarray
    along: np.ndarray
    across: np.ndarray
    turn: np.ndarray

    def fields(self) -> tuple[np.ndarray, ...]:
        """Returns the arrays, in the order in which the constructor takes them."""
        return self.station, self.lateral, self.along, self.across, self.turn

    def at(self, index: Any) -> "View":
        """Returns the entries `index` (anything that indexes an array)."""
        return View(*(v[index] for v in self.fields()))

    def reshape(self, *shape: int) -> "View":
        """Returns the same boxes in another shape."""
        return View(*(v.reshape(shape) for v in self.fields()))

    def joined(self, other: "View") -> "View":
        """Returns the boxes of both, along the last axis."""
        pairs = zip(self.fields(), other.fields(), strict=True)
        return View(*(np.concatenate(pair, axis=-1) for pair in pairs))


class PathNetwork:
    """The paths of all drivers, stacked; drivers with the same path share a row.

    Attributes:
      index: `[F]` row of each driver's path.
      length: `[G]` of each path, m.
    """

    def __init__(self, paths: Sequence[Path]):
        unique = list({id(p): p for p in paths}.values())
        rows = {id(p): i for i, p in enumerate(unique)}
        self.index = np.array([rows[id(p)] for p in paths])
        self.length = np.array([p.length for p in unique])
        self._step = np.array([p.step for p in unique])
        self._count = np.array([len(p.xy) for p in unique])
        # Rows of different length are filled up with their last entry.
        size = max(len(p.xy) for p in unique)
        self._xy = _stack([p.xy for p in unique], size)
        self._heading = _stack([p.heading for p in unique], size)
        self._limit = _stack([_bend_speed(p) for p in unique], size)
        self._coarse = np.ascontiguousarray(self._xy[:, ::SEARCH_STRIDE].transpose(0, 2, 1))
        self._coarse_norm = np.sum(self._coarse**2, axis=1)[:, None]

    def pose(self, row: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Returns `[..., 3]` poses at `station` of the paths `row`, straight on beyond the ends."""
        s = station / self._step[row]
        low = np.clip(np.floor(s).astype(int), 0, self._count[row] - 2)
        t = (s - low)[..., None]
        a, b = self._xy[row, low], self._xy[row, low + 1]
        part = np.clip(t[..., 0], 0.0, 1.0)
        heading = self._heading[row, low] * (1.0 - part) + self._heading[row, low + 1] * part
        return np.concatenate([a + t * (b - a), heading[..., None]], axis=-1)

    def speed_limit(self, row: np.ndarray, station: np.ndarray) -> np.ndarray:
        """Returns the speed that the bends ahead allow, m/s."""
        low = np.clip((station / self._step[row]).astype(int), 0, self._count[row] - 1)
        return self._limit[row, low]

    def view(self, pose: np.ndarray, half: np.ndarray, rows: np.ndarray | None = None) -> View:
        """Returns boxes as seen from paths.

        Args:
          pose: `[J, 3]` centres and headings.
          half: `[J, 2]` half length and half width, m.
          rows: `[G]` paths; all if None.
        """
        rows = np.arange(len(self._count)) if rows is None else rows
        points = pose[:, :2]
        # The squared distance without the part that is the same for all samples.
        distance = self._coarse_norm[rows] - 2.0 * points @ self._coarse[rows]
        nearest = SEARCH_STRIDE * np.argmin(distance, axis=2)
        row, last = rows[:, None], self._count[rows][:, None] - 1
        # The coarse search may be some samples off; one step along the tangent finds the nearest.
        offset = points - self._xy[row, nearest]
        ahead = _along(offset, self._heading[row, nearest])
        nearest = np.clip(nearest + np.rint(ahead / self._step[row]).astype(int), 0, last)
        offset, heading = points - self._xy[row, nearest], self._heading[row, nearest]
        turn = pose[:, 2] - heading
        cos_turn, sin_turn = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        return View(
            station=nearest * self._step[row] + _along(offset, heading),
            lateral=_along(offset, heading + np.pi / 2),
            along=cos_turn * half[:, 0] + sin_turn * half[:, 1],
            across=sin_turn * half[:, 0] + cos_turn * half[:, 1],
            turn=turn,
        )


def _along(offset: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Returns the component of `[..., 2]` vectors along directions `[...]`."""
    return offset[..., 0] * np.cos(heading) + offset[..., 1] * np.sin(heading)


def _stack(rows: Sequence[np.ndarray], size: int) -> np.ndarray:
    """Stacks arrays of different length, repeating the last entry of each."""
    index = np.minimum(np.arange(size), np.array([[len(r) - 1] for r in rows]))
    return np.stack([row[i] for row, i in zip(rows, index, strict=True)])


def _bend_speed(path: Path) -> np.ndarray:
    """Returns `[H]` the speed from which all bends ahead can be taken, m/s."""
    square = LATERAL_ACCEL / np.maximum(np.abs(path.curvature), 1e-3)
    reach = square + 2.0 * BEND_DECEL * path.stations
    ahead = np.minimum.accumulate(reach[::-1])[::-1]
    return np.sqrt(np.maximum(ahead - 2.0 * BEND_DECEL * path.stations, 0.0))
