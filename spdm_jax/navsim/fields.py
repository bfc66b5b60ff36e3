"""Reads arrays by name and says what is wrong with them (host)."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

Shape = tuple[int | None, ...]
"""Expected shape; None stands for any length."""


class Fields:
    """Named arrays of one frame.

    Args:
      arrays: by field name.
      name: of the frame, for error texts.
    """

    def __init__(self, arrays: Mapping[str, Any], name: str):
        self._arrays, self._name = arrays, name

    def error(self, field: str, trouble: str) -> ValueError:
        """Returns the error that names frame and field."""
        return ValueError(f"{self._name}: {field} {trouble}")

    def has(self, field: str) -> bool:
        """Whether the field is there."""
        return field in self._arrays

    def _get(self, field: str, shape: Shape | None) -> np.ndarray:
        if field not in self._arrays:
            raise self.error(field, f"is missing; there are {', '.join(sorted(self._arrays))}")
        values = np.asarray(self._arrays[field])
        if shape is not None and (
            values.ndim != len(shape)
            or any(want not in (None, have) for want, have in zip(shape, values.shape, strict=True))
        ):
            wanted = "[" + ", ".join("any" if n is None else str(n) for n in shape) + "]"
            raise self.error(field, f"has shape {list(values.shape)}; expected {wanted}")
        return values

    def numbers(
        self, field: str, shape: Shape | None, counts: np.ndarray | None = None
    ) -> np.ndarray:
        """Finite numbers, float64.

        Args:
          field: name.
          shape: expected.
          counts: entries along the first axes that must be finite; all if None.

        Raises:
          ValueError: missing, of another shape or type, or not finite.
        """
        values = self._get(field, shape)
        if values.dtype.kind not in "fiu":
            raise self.error(field, f"is {values.dtype}; expected numbers")
        values = values.astype(float)
        bad = ~np.isfinite(values)
        if counts is not None:
            bad &= counts.reshape(*counts.shape, *(1,) * (values.ndim - counts.ndim))
        if bad.any():
            at = tuple(int(i) for i in np.argwhere(bad)[0])
            raise self.error(
                f"{field}{list(at) if at else ''}",
                f"is {values[at]}; it must be finite ({int(bad.sum())} values are not)",
            )
        return values

    def integers(self, field: str, shape: Shape) -> np.ndarray:
        """Whole numbers, int64.

        Raises:
          ValueError: missing, of another shape, or not whole.
        """
        values = self._get(field, shape)
        if values.dtype.kind not in "iu":
            raise self.error(field, f"is {values.dtype}; expected integers")
        return values.astype(np.int64)

    def flags(self, field: str, shape: Shape) -> np.ndarray:
        """Booleans.

        Raises:
          ValueError: missing, or of another shape or type.
        """
        values = self._get(field, shape)
        if values.dtype != bool:
            raise self.error(field, f"is {values.dtype}; expected bool")
        return values

    def within(self, field: str, values: np.ndarray, low: int, high: int) -> None:
        """Refuses values beyond the bounds.

        Raises:
          ValueError: names the first one.
        """
        bad = np.flatnonzero((values < low) | (values > high))
        if len(bad):
            row = int(bad[0])
            raise self.error(f"{field}[{row}]", f"is {values[row]}; it must be {low} to {high}")

    def rings(self, prefix: str) -> list[np.ndarray]:
        """Closed rings `[k, 2]` of `{prefix}_offsets` and `{prefix}_xy`.

        Raises:
          ValueError: offsets do not fit the points, or a ring has fewer than three corners.
        """
        points = self.numbers(f"{prefix}_xy", (None, 2))
        offsets = self.integers(f"{prefix}_offsets", (None,))
        if (
            not len(offsets)
            or offsets[0] != 0
            or offsets[-1] != len(points)
            or (np.diff(offsets) < 0).any()
        ):
            raise self.error(
                f"{prefix}_offsets", f"must rise from 0 to {len(points)}, the length of {prefix}_xy"
            )
        rings = []
        for row, (begin, end) in enumerate(itertools.pairwise(offsets)):
            ring = points[begin:end]
            corners = len(np.unique(ring, axis=0))
            if corners < 3:
                raise self.error(
                    f"{prefix}_xy", f"gives ring {row} {corners} corners; a polygon needs three"
                )
            rings.append(
                ring if np.array_equal(ring[0], ring[-1]) else np.append(ring, ring[:1], 0)
            )
        return rings
