"""Rows of the comparison between the nuPlan reader and recorded answers."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

TOLERANCE = 1e-6
"""m, rad, m/s: both sides compute in float64 from the same files."""


@dataclass
class Row:
    """One compared quantity.

    Attributes:
      name: the recording's name of it.
      deviation: largest absolute difference of its numbers.
      mismatches: discrete differences: ids, texts, counts, shapes.
      tolerance: bound on `deviation`.
      count: values compared.
    """

    name: str
    tolerance: float
    deviation: float = 0.0
    mismatches: int = 0
    count: int = 0

    @property
    def ok(self) -> bool:
        """Whether numbers are within the tolerance and nothing discrete differs."""
        return self.deviation <= self.tolerance and not self.mismatches and self.count > 0


@dataclass
class Table:
    """Rows by name."""

    rows: dict[str, Row] = field(default_factory=dict)

    def _row(self, name: str, tolerance: float) -> Row:
        return self.rows.setdefault(name, Row(name, tolerance))

    def equal(self, name: str, ours: Any, theirs: Any) -> None:
        """Compares something discrete."""
        row = self._row(name, 0.0)
        row.count += 1
        row.mismatches += ours != theirs

    def close(self, name: str, ours: Any, theirs: Any, tolerance: float = TOLERANCE) -> None:
        """Compares numbers; None equals None, a difference of shape is a mismatch."""
        row = self._row(name, tolerance)
        row.count += 1
        if ours is None or theirs is None:
            row.mismatches += ours is not theirs
            return
        a, b = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
        if a.shape != b.shape or not np.isfinite(a).all() or not np.isfinite(b).all():
            row.mismatches += 1
        elif a.size:
            row.deviation = max(row.deviation, float(np.abs(a - b).max()))

    def poses(self, name: str, ours: Any, theirs: Any) -> None:
        """Compares `[..., 3]` poses, headings modulo a full turn."""
        if ours is None or theirs is None or np.shape(ours) != np.shape(theirs):
            return self.close(name, ours, theirs)
        a, b = np.asarray(ours, np.float64), np.array(theirs, np.float64)
        b[..., 2] += 2 * np.pi * np.round((a[..., 2] - b[..., 2]) / (2 * np.pi))
        return self.close(name, a, b)

    def same_keys(self, name: str, ours: Iterable[str], theirs: Iterable[str]) -> None:
        """Compares two sets of ids and counts the ids that only one side has."""
        row = self._row(name, 0.0)
        row.count += 1
        row.mismatches += len(set(ours) ^ set(theirs))
