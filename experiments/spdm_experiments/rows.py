"""Rows of a run folder: one per scenario and point, always of the same columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars

from spdm_experiments.inventory import Entry
from spdm_experiments.sweep_grid import varying
from spdm_jax import Failure

TEXT, WHOLE, REAL = polars.String, polars.Int32, polars.Float32
IDENTITY = {"token": TEXT, "log_name": TEXT, "map_name": TEXT, "scenario_type": TEXT}
POINT = {"point": WHOLE, "planner": TEXT, "num_proposals": WHOLE}
OUTCOME = {"status": TEXT, "reason": TEXT}


@dataclass(frozen=True)
class Layout:
    """Columns of a run's rows.

    Attributes:
      points: the points as run.json holds them.
      names: settings that differ between them; each is a column.
      fixed: columns of a point that are always there, and their types.
      values: columns that are null where a scenario failed, and their types.
    """

    points: Sequence[Mapping[str, Any]]
    names: Sequence[str]
    fixed: Mapping[str, Any]
    values: Mapping[str, Any]

    @staticmethod
    def of(
        points: Sequence[Mapping[str, Any]],
        values: Mapping[str, Any],
        fixed: Mapping[str, Any] = POINT,
    ) -> "Layout":
        """Returns the layout for the entry "points" of run.json."""
        return Layout(points, [n for n in varying(points) if n not in fixed], fixed, values)

    @property
    def schema(self) -> dict[str, Any]:
        """Column -> type."""
        text = lambda name: any(isinstance(point[name], str | list) for point in self.points)
        settings = {name: TEXT if text(name) else polars.Float64 for name in self.names}
        return {**IDENTITY, **self.fixed, **settings, **self.values, **OUTCOME}

    def point(self, number: int) -> dict[str, Any]:
        """Returns what all rows of a point have in common."""
        entry = self.points[number]
        plain = lambda v: ",".join(f"{x:g}" for x in v) if isinstance(v, list) else v
        return {name: plain(entry[name]) for name in (*self.fixed, *self.names)}

    def frame(self, rows: Sequence[Mapping[str, Any]]) -> polars.DataFrame:
        """Returns rows as a table; what a row lacks is null."""
        schema = self.schema
        columns = {name: [row.get(name) for row in rows] for name in schema}
        return polars.DataFrame(columns, schema=schema)


def identity(entry: Entry) -> dict[str, Any]:
    """Returns the columns that say which scenario a row is of."""
    return {name: getattr(entry, name) for name in IDENTITY}


def failed_rows(layout: Layout, failures: Sequence[tuple[Failure, Entry | None]]) -> list[dict]:
    """Returns a row per point for scenarios that could not be computed.

    Args:
      layout: columns.
      failures: with what is known of the scenario.
    """
    return [
        {
            "token": failure.token,
            **(identity(entry) if entry else {}),
            **layout.point(number),
            "status": "failed",
            "reason": failure.reason,
        }
        for failure, entry in failures
        for number in range(len(layout.points))
    ]
