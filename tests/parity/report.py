"""Rows of the parity report and the tolerances they are held to."""

from dataclasses import dataclass, field

import numpy as np

# States, metres and radians. Float64: rounding only (UTM-sized coordinates keep 1e-9 of 4e6 m).
# Float32: single stages 2e-4, a whole chain of stages 2e-3.
STATE_TOLERANCE = {"f64": 1e-6, "f32": 2e-4}
CHAIN_TOLERANCE = {"f64": 1e-6, "f32": 2e-3}
FAR_TOLERANCE = 1e-5
SCORE_TOLERANCE = {"f64": 1e-9, "f32": 1e-4}
# Discrete outputs: none may differ in float64, one in a thousand of the robust rows in float32.
DISCRETE_SHARE = {"f64": 0.0, "f32": 1e-3}


@dataclass
class Row:
    """One array of one file.

    Attributes:
      file: golden file.
      array: what was compared.
      deviation: largest absolute deviation (continuous arrays).
      mismatches: number of unequal entries (discrete arrays).
      compared: entries compared.
      tolerance: bound on the deviation; None for discrete arrays.
      note: exceptions, in words.
    """

    file: str
    array: str
    deviation: float = 0.0
    mismatches: int = 0
    compared: int = 0
    tolerance: float | None = None
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether a continuous array is within its tolerance (discrete ones are judged pooled)."""
        return self.tolerance is None or self.deviation <= self.tolerance


@dataclass
class Report:
    """Collects rows; `f64` or `f32` sets the tolerances."""

    precision: str
    rows: list[Row] = field(default_factory=list)

    def close(self, file, array, ours, reference, tolerance, mask=None, angle=False, note=""):
        """Records the largest deviation; NaN or inf must sit in the same places."""
        ours, reference = np.asarray(ours, float), np.asarray(reference, float)
        with np.errstate(invalid="ignore"):  # equal infinities
            difference = np.abs(ours - reference)
        if angle:
            difference = np.abs(np.arctan2(np.sin(ours - reference), np.cos(ours - reference)))
        same = (ours == reference) | (np.isnan(ours) & np.isnan(reference))
        difference = np.where(same, 0, np.where(np.isnan(difference), np.inf, difference))
        if mask is not None:
            difference = difference[np.broadcast_to(mask, difference.shape)]
        worst = float(difference.max()) if difference.size else 0.0
        self.rows.append(Row(file, array, worst, 0, int(difference.size), tolerance, note))

    def equal(self, file, array, ours, reference, mask=None, note=""):
        """Records how many entries differ."""
        ours, reference = np.asarray(ours), np.asarray(reference)
        different = ~((ours == reference) | ((ours != ours) & (reference != reference)))
        if mask is not None:
            different = different[np.broadcast_to(mask, different.shape)]
        where = np.argwhere(different)
        if len(where) and not note:
            note = "at " + ", ".join(str(tuple(map(int, i))) for i in where[:4])
        self.rows.append(
            Row(file, array, 0.0, int(different.sum()), int(different.size), None, note)
        )

    def not_compared(self, file, array, reason):
        """Records that an array was left out, and why."""
        self.rows.append(Row(file, array, note=f"not compared: {reason}"))

    def add_loader_row(self, file, row):
        """Takes over a row of the readers' own table; their discrete outputs must all agree."""
        tolerance = row.tolerance if not row.mismatches else -1.0
        note = f"{row.mismatches} discrete differences" if row.mismatches else ""
        self.rows.append(
            Row(file, row.name, row.deviation, row.mismatches, row.count, tolerance, note)
        )

    def failures(self) -> list[str]:
        """Continuous rows out of tolerance, and discrete arrays whose pooled share is too large."""
        failed = [
            f"{row.file}: {row.array} deviates by {row.deviation:.3g} (tolerance {row.tolerance:g})"
            for row in self.rows
            if not row.ok
        ]
        pooled: dict[str, list[int]] = {}
        for row in self.rows:
            if row.tolerance is None:
                total = pooled.setdefault(row.array, [0, 0])
                total[0] += row.mismatches
                total[1] += row.compared
        for array, (mismatches, compared) in pooled.items():
            if mismatches > DISCRETE_SHARE[self.precision] * compared:
                failed.append(f"{array}: {mismatches} of {compared} entries differ (pooled)")
        return failed

    def table(self) -> str:
        """One line per file and array."""
        lines = [
            f"{'file':<44} {'array':<34} {'deviation':>11} {'differ':>7} {'compared':>9}  note"
        ]
        for row in self.rows:
            deviation = f"{row.deviation:.2e}" if row.tolerance is not None else "-"
            differ = "-" if row.tolerance is not None else str(row.mismatches)
            flag = "" if row.ok else " FAILED"
            lines.append(
                f"{row.file:<44} {row.array:<34} {deviation:>11} {differ:>7} {row.compared:>9} "
                f"{flag}{row.note}"
            )
        return "\n".join(lines)
