"""Run folders of `spdm sweep` and `spdm simulate` as numbers: means, intervals, differences.

Failed scenarios are counted and never averaged in. Everything is deterministic for a seed.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars

from spdm_experiments.report_grid import frozen, varied
from spdm_experiments.report_terms import Terms, needed, terms_of

RESAMPLES: Final = 2000
TIE: Final = 1e-4
"""Totals of one scenario that differ by less count as equal: float32 on two devices does."""
_BLOCK = 4_000_000  # numbers of one block of resamples
_FORMAT = 1


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
      folder: where it lies.
      about: run.json.
      rows: one row per (scenario, grid point), ordered by point and token.
      stages: times of stages per number of proposals, or None.
    """

    folder: Path
    about: Mapping[str, Any]
    rows: polars.DataFrame
    stages: polars.DataFrame | None

    @property
    def points(self) -> list[dict[str, Any]]:
        """Grid points; the place of one is its number in the rows."""
        return self.about["points"]

    @property
    def terms(self) -> Terms:
        """Scores that its rows hold."""
        return terms_of(self.about)

    @property
    def missing(self) -> int:
        """Scenarios that lack rows still, at all grid points or at some."""
        rows = self.rows.group_by("token").len()
        whole = int((rows["len"] == len(self.points)).sum())
        return max(0, self.about["num_scenarios"] - whole)

    def usable(self, point: int) -> polars.DataFrame:
        """Rows of a grid point that have scores, ordered by token."""
        return self.rows.filter((polars.col("point") == point) & (polars.col("status") == "ok"))


@dataclass(frozen=True)
class PointSummary:
    """One grid point over all its scenarios.

    Attributes:
      point: number of the grid point.
      scenarios: scenarios with scores.
      failed: scenarios without.
      means: of every term and of the progress in metres; NaN without any scenario.
      intervals: 95 % bootstrap intervals of those means; NaN below two scenarios.
      braking: share of scenarios with an emergency brake.
      ms: mean run time per scenario, compilation apart.
    """

    point: int
    scenarios: int
    failed: int
    means: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    braking: float
    ms: float


@dataclass(frozen=True)
class PairedDifference:
    """Total scores of one grid point in two runs, first minus second, scenario by scenario.

    Attributes:
      points: number of the grid point in each run.
      scenarios: scenarios that have scores in both.
      mean: mean difference.
      interval: its 95 % bootstrap interval.
      wins: scenarios in which the first run is better; `losses`: worse; `ties`: equal.
    """

    points: tuple[int, int]
    scenarios: int
    mean: float
    interval: tuple[float, float]
    wins: int
    ties: int
    losses: int


def load_run(folder: Path) -> Run:
    """Reads a run folder, finished or not.

    Args:
      folder: written by `spdm sweep` or `spdm simulate`.

    Raises:
      ValueError: it is no such folder, has no rows yet, or holds a scenario twice.
    """
    about = _read_about(folder)
    terms = terms_of(about)
    parts = sorted((folder / "rows").glob("part-*.parquet"))
    if not parts:
        raise ValueError(
            f"{folder}: no rows/part-*.parquet yet, so there is nothing to report; run the same "
            f"spdm {terms.command} command until its first chunk is finished"
        )
    # A drive's score is called so in its rows; the page knows the total by one name.
    frames = [_read_parquet(path).rename({"score": "total"}, strict=False) for path in parts]
    for path, frame in zip(parts, frames, strict=True):
        if lacking := [name for name in needed(terms) if name not in frame.columns]:
            raise ValueError(
                f"{path}: no column {lacking[0]!r}; the file is of another program or version, "
                f"{terms.command} into another folder"
            )
    rows = polars.concat(frames, how="diagonal_relaxed").sort("point", "token")
    twice = rows.filter(polars.struct("point", "token").is_duplicated())
    if len(twice):
        raise ValueError(
            f"{folder}: scenario {twice['token'][0]!r} occurs twice at grid point "
            f"{twice['point'][0]}; two runs wrote into one folder, {terms.command} into another one"
        )
    stages = folder / "stages.parquet"
    return Run(folder, about, rows, _read_parquet(stages) if stages.exists() else None)


def _read_about(folder: Path) -> dict[str, Any]:
    path = folder / "run.json"
    verbs = "spdm sweep or spdm simulate"
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; name one that {verbs} has written")
    if not path.is_file():
        raise ValueError(f"{folder}: no run.json, so no run folder; name one of {verbs}")
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not valid JSON ({error}); sweep again") from error
    command = about.get("command") if isinstance(about, dict) else None
    if command not in ("sweep", "simulate"):
        raise ValueError(
            f"{path}: written by spdm {command}; spdm report reads what {verbs} has written"
            if command
            else f"{path}: does not say that {verbs} wrote it; name a folder of those"
        )
    if about.get("format") != _FORMAT:
        raise ValueError(
            f"{path}: format is {about.get('format')!r}, this version reads {_FORMAT}; report with "
            f"the version that wrote it, or {command} again"
        )
    for name in ("points", "num_scenarios"):
        if name not in about:
            raise ValueError(f"{path}: no field {name!r}; {command} again")
    return about


def _read_parquet(path: Path) -> polars.DataFrame:
    try:
        return polars.read_parquet(path)
    except polars.exceptions.PolarsError as error:
        raise ValueError(f"{path}: damaged ({error}); delete it and sweep again") from error


def common_terms(runs: Sequence[Run]) -> Terms:
    """Returns what the page shows of all runs; a score that one of them lacks is left out.

    Raises:
      ValueError: the runs are of different verbs.
    """
    first, *rest = (run.terms for run in runs)
    for other in rest:
        if other.command != first.command:
            raise ValueError(
                f"{runs[0].folder} was written by spdm {first.command} and {runs[1].folder} by "
                f"spdm {other.command}; their scores are not comparable"
            )
        titles = {name: title for name, title in first.titles.items() if name in other.titles}
        first = dataclasses.replace(first, titles=titles)
    return first


# ---- means and intervals ----


def bootstrap(values: np.ndarray, seed: int) -> np.ndarray:
    """Returns 95 % intervals of the means over rows: percentiles of means of resampled rows.

    All columns see the same resamples. NaN is no value: a column's mean is over its others.

    Args:
      values: `[N, K]`.
      seed: of the resamples.

    Returns:
      `[2, K]` lower and upper ends; NaN if N < 2, which tells nothing of the spread.
    """
    count, columns = values.shape
    if count < 2:
        return np.full((2, columns), np.nan)
    generator = np.random.default_rng(seed)
    known = np.isfinite(values)
    filled = np.where(known, values, 0)
    means = np.empty((RESAMPLES, columns))
    step = max(1, _BLOCK // count)
    for start in range(0, RESAMPLES, step):
        size = min(step, RESAMPLES - start)
        picked = generator.integers(0, count, (size, count))
        picked += count * np.arange(size)[:, None]
        # How often each row was drawn, so that a matrix product gives all columns' means.
        drawn = np.bincount(picked.ravel(), minlength=size * count).reshape(size, count)
        with np.errstate(invalid="ignore"):  # a resample may miss all values of a rare column
            means[start : start + size] = drawn @ filled / (drawn @ known)
    if known.all():
        return np.quantile(means, (0.025, 0.975), axis=0)
    return _quantiles(means, known.sum(axis=0))


def _quantiles(means: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Intervals of columns `[R, K]` that lack values; NaN where fewer than two are known `[K]`."""
    ends = np.full((2, len(known)), np.nan)
    for column in np.flatnonzero(known >= 2):
        ends[:, column] = np.nanquantile(means[:, column], (0.025, 0.975))
    return ends


def known_means(values: np.ndarray) -> list[float]:
    """Returns the mean of each column of `[N, K]`; NaN is no value, and the mean of none is NaN."""
    columns = (column[np.isfinite(column)] for column in values.T)
    return [float(column.mean()) if len(column) else np.nan for column in columns]


def summarise(run: Run, seed: int = 0) -> list[PointSummary]:
    """Returns one summary per grid point; scenarios that failed are counted only."""
    names = run.terms.columns()
    found = []
    for point in range(len(run.points)):
        good = run.usable(point)
        values = good.select(polars.col(names).cast(polars.Float64)).to_numpy()
        ends = [(low, high) for low, high in bootstrap(values, seed).T.tolist()]
        means = known_means(values)
        found.append(
            PointSummary(
                point=point,
                scenarios=len(good),
                failed=len(run.rows.filter(polars.col("point") == point)) - len(good),
                means=dict(zip(names, means, strict=True)),
                intervals=dict(zip(names, ends, strict=True)),
                braking=_mean(good, "emergency_brake"),
                ms=_mean(good, "run_ms"),
            )
        )
    return found


def by_type(run: Run) -> dict[str, tuple[int, list[float]]]:
    """Returns scenarios and mean score at every grid point, by the type of the scenarios.

    A mean is NaN where no scenario of the type has a score; types are in alphabetical order.
    """
    good = run.rows.filter(polars.col("status") == "ok")
    if "scenario_type" not in good.columns:
        return {}
    found: dict[str, tuple[int, list[float]]] = {}
    for (kind,), mine in good.group_by("scenario_type"):
        means = dict(mine.group_by("point").agg(polars.col("total").mean()).iter_rows())
        scores = [float(means.get(point, np.nan)) for point in range(len(run.points))]
        found[str(kind or "")] = (mine["token"].n_unique(), scores)
    return dict(sorted(found.items()))


def _mean(frame: polars.DataFrame, column: str) -> float:
    """Mean of a column, NaN where there is none."""
    if column not in frame.columns:
        return float("nan")
    value = frame[column].cast(polars.Float64).mean()
    return float("nan") if value is None else float(value)  # pyright: ignore[reportArgumentType]


def common_points(first: Run, second: Run) -> list[tuple[int, int]]:
    """Returns the grid points that two runs share, as pairs of numbers.

    Planner, number of proposals and what either run varies must agree. A setting that each run
    holds fixed may differ: it is then what the runs compare.
    """
    keys = {"planner", "num_proposals", *varied(first.points), *varied(second.points)}
    identity = lambda point: tuple(frozen(point.get(key)) for key in sorted(keys))
    places = {identity(point): number for number, point in enumerate(second.points)}
    return [
        (number, places[identity(point)])
        for number, point in enumerate(first.points)
        if identity(point) in places
    ]


def pair_up(first: Run, second: Run, points: tuple[int, int]) -> polars.DataFrame:
    """Returns the scenarios with scores in both runs: token, total, other, difference."""
    left, right = first.usable(points[0]), second.usable(points[1])
    total = polars.col("total").cast(polars.Float64)
    return (
        left.with_columns(total)
        .join(right.select("token", other=total), on="token")
        .with_columns(difference=polars.col("total") - polars.col("other"))
        .sort("token")
    )


def paired_difference(
    first: Run, second: Run, points: tuple[int, int], seed: int = 0
) -> PairedDifference:
    """Compares one grid point of two runs over the scenarios that both have scores of."""
    change = pair_up(first, second, points)["difference"].to_numpy()
    low, high = bootstrap(change[:, None], seed)[:, 0].tolist()
    wins, losses = int((change > TIE).sum()), int((change < -TIE).sum())
    return PairedDifference(
        points=points,
        scenarios=len(change),
        mean=float(change.mean()) if len(change) else float("nan"),
        interval=(low, high),
        wins=wins,
        ties=len(change) - wins - losses,
        losses=losses,
    )


# ---- single scenes ----


def worst(run: Run, point: int, count: int) -> polars.DataFrame:
    """Returns the rows of the lowest totals of a grid point, lowest first."""
    return run.usable(point).sort("total", "token").head(count)


def largest_losses(
    first: Run, second: Run, points: tuple[int, int], count: int
) -> polars.DataFrame:
    """Returns the rows in which the first run falls furthest behind the second, worst first."""
    found = pair_up(first, second, points).filter(polars.col("difference") < -TIE)
    return found.sort("difference", "token").head(count)


def failures(run: Run) -> list[dict[str, Any]]:
    """Returns the failed scenarios: token, status, reason, and at how many grid points."""
    bad = run.rows.filter(polars.col("status") != "ok")
    return (
        bad.group_by("token", "status", "reason")
        .agg(points=polars.len())
        .sort("token", "status", "reason")
        .to_dicts()
    )
