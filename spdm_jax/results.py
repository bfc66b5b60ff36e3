"""What `plan` and `score` return: NumPy results with names, reasons and tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from spdm_jax.config import DT
from spdm_jax.planner import PlanResult
from spdm_jax.types import (
    AgentForecast,
    CollisionKind,
    EgoState,
    ObjectType,
    ScenarioBatch,
    ScenarioInfo,
    SubScores,
)

if TYPE_CHECKING:
    import polars

COMFORT_NAMES = (
    "longitudinal acceleration",
    "lateral acceleration",
    "jerk",
    "longitudinal jerk",
    "yaw acceleration",
    "yaw rate",
)

SCORE_COLUMNS = (
    "total",
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "progress",
    "time_to_collision",
    "comfort",
    "progress_raw",
    "collision_time",
    "ttc_time",
)
"""Fields of `SubScores` that tables hold, one number per proposal."""


@dataclass(frozen=True)
class Failure:
    """A scenario that could not be used, and why."""

    token: str
    reason: str


@dataclass(frozen=True)
class Explanation:
    """Why one proposal scored what it scored.

    Attributes:
      token: scenario.
      proposal: row.
      total: final score.
      lost: one sentence per term that cost points.
      agent: source id of the object of the first at-fault collision or TTC violation, or None.
      step: its time index (0.1 s), or None.
      rule: name of the first term that cost points, in the order collision, area, direction, TTC,
        comfort, progress; or None.
    """

    token: str
    proposal: int
    total: float
    lost: tuple[str, ...]
    agent: str | None
    step: int | None
    rule: str | None

    def __str__(self) -> str:
        head = f"scene {self.token}, proposal {self.proposal}: {self.total:.3f}"
        return "\n".join([head, *(f"  - {line}" for line in self.lost or ("nothing lost",))])


@dataclass
class ScoreSet:
    """Scores of proposals in several scenes.

    Attributes:
      scores: `SubScores` with NumPy leaves `[B, P]`.
      tracked: driven states `[B, P, 41]`, local frame.
      forecast: objects seen, `[B, A, S]`.
      infos: one per scene.
      failures: scenes left out on the way in.
      overflow: `[B]` bool, a fixed buffer was too small; status says so.
    """

    scores: SubScores
    tracked: EgoState
    forecast: AgentForecast
    infos: list[ScenarioInfo]
    failures: list[Failure] = field(default_factory=list)
    overflow: np.ndarray | None = None

    def __getattr__(self, name: str) -> Any:
        if name != "scores" and name in SubScores.__dataclass_fields__:
            return getattr(self.scores, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __len__(self) -> int:
        return len(self.infos)

    @property
    def status(self) -> list[str]:
        """Per scene: "ok", "overflow" (a buffer was too small) or "failed" (not finite)."""
        total = np.where(self.scores.valid, self.scores.total, 0)
        finite = np.atleast_1d(np.all(np.isfinite(total), axis=1))
        over = np.zeros(len(self), bool) if self.overflow is None else self.overflow
        return [
            "overflow" if o else "ok" if f else "failed" for o, f in zip(over, finite, strict=True)
        ]

    def explain(self, scene: int, proposal: int) -> Explanation:
        """Says in words what a proposal lost points for.

        Args:
          scene: row of the scene.
          proposal: row of the proposal.
        """
        at = lambda name: np.asarray(getattr(self.scores, name))[scene, proposal]
        info = self.infos[scene]
        lost: list[str] = []
        agent: str | None = None
        step: int | None = None
        rule: str | None = None

        def blame(name: str, index: float | None, who: str | None = None):
            nonlocal agent, step, rule
            if rule is None:
                rule, agent = name, who
                step = None if index is None else int(index)

        if not at("valid"):
            lost.append("the proposal is padding: fewer real proposals were available")
        if at("no_at_fault_collision") < 1:
            time = float(at("collision_time"))
            who, kind = self._object(scene, int(at("collision_object")))
            contact = CollisionKind(int(at("collision_kind"))).name.lower().replace("_", " ")
            lost.append(
                f"at-fault collision ({contact}) with {kind} {who} at {time:.1f} s: "
                f"no_at_fault_collision {at('no_at_fault_collision'):g}"
            )
            blame("no_at_fault_collision", round(time / DT), who)
        if at("drivable_area") < 1:
            first = int(np.argmax(at("non_drivable")))
            lost.append(f"a corner leaves the drivable area at {first * DT:.1f} s: score 0")
            blame("drivable_area", first)
        if at("driving_direction") < 1:
            first = int(np.argmax(at("oncoming")))
            lost.append(
                f"drives off the route's lanes or against traffic from {first * DT:.1f} s on: "
                f"driving_direction {at('driving_direction'):g}"
            )
            blame("driving_direction", first)
        if at("time_to_collision") < 1:
            time = float(at("ttc_time"))
            who, kind = self._object(scene, int(at("ttc_object")))
            lost.append(f"less than 1 s to a collision with {kind} {who} at {time:.1f} s")
            blame("time_to_collision", round(time / DT), who)
        if at("comfort") < 1:
            flags = np.asarray(at("comfort_flags"))
            names = [n for n, ok in zip(COMFORT_NAMES, flags, strict=True) if not ok]
            lost.append(f"uncomfortable: {', '.join(names)}")
            blame("comfort", None)
        # The best proposal's own ratio may be 1 less a rounding.
        if at("progress") < 1 - 1e-6:
            lost.append(
                f"progress {at('progress_raw'):.1f} m, {100 * at('progress'):.1f} % of the best "
                "admissible proposal"
            )
            blame("progress", None)
        return Explanation(info.token, proposal, float(at("total")), tuple(lost), agent, step, rule)

    def _object(self, scene: int, row: int) -> tuple[str, str]:
        track = int(np.asarray(self.forecast.track)[scene, row])
        kind = ObjectType(int(np.asarray(self.forecast.type)[scene, row])).name.lower()
        return self.infos[scene].track_ids[track], kind

    def to_table(self) -> polars.DataFrame:
        """One row per real proposal (and one per failed scene, scores null).

        Raises:
          ImportError: polars is not installed (`pip install "spdm-jax[data]"`).
        """
        import polars

        valid = np.asarray(self.scores.valid)
        scene, proposal = np.nonzero(valid)
        tokens = np.array([info.token for info in self.infos])
        columns: dict[str, Any] = {
            "token": tokens[scene],
            "proposal": proposal,
            **{n: np.asarray(getattr(self.scores, n))[valid] for n in SCORE_COLUMNS},
            "status": np.array(self.status)[scene],
        }
        table = polars.DataFrame(columns).with_columns(polars.lit("").alias("reason"))
        if self.failures:
            failed = polars.DataFrame(
                {
                    "token": [f.token for f in self.failures],
                    "status": ["failed"] * len(self.failures),
                    "reason": [f.reason for f in self.failures],
                }
            )
            table = polars.concat([table, failed], how="diagonal_relaxed")
        return table


@dataclass
class PlanSet(ScoreSet):
    """Plans of several scenes; the scores are those of each scene's proposals.

    Attributes:
      plans: `PlanResult` with NumPy leaves `[B, ...]`.
      name: planner.
    """

    plans: PlanResult = field(kw_only=True)
    name: str = field(kw_only=True)

    @property
    def best(self) -> np.ndarray:
        """`[B]` chosen proposals."""
        return np.asarray(self.plans.best)

    @property
    def trajectory(self) -> EgoState:
        """`[B, 81]` plans, local frame, 0.1 s apart."""
        return self.plans.trajectory

    @property
    def num_proposals(self) -> np.ndarray:
        """`[B]` real proposals."""
        return np.asarray(self.scores.valid).sum(axis=1)

    def to_table(self) -> polars.DataFrame:
        """As for scores, with stage, path, policy and whether the proposal was chosen."""
        import polars

        table = super().to_table()
        valid = np.asarray(self.scores.valid)
        proposals = self.plans.proposals
        chosen = np.zeros(valid.shape, bool)
        chosen[np.arange(len(self)), self.best] = True
        extra = polars.DataFrame(
            {
                "planner": [self.name] * int(valid.sum()),
                "stage": np.asarray(proposals.stage)[valid],
                "path": np.asarray(proposals.path)[valid],
                "policy": np.asarray(proposals.policy)[valid],
                "chosen": chosen[valid],
            }
        )
        real = polars.concat([table.head(extra.height), extra], how="horizontal")
        return polars.concat(
            [real, table.tail(table.height - extra.height)], how="diagonal_relaxed"
        )


@dataclass
class ScenarioSet:
    """Scenarios ready to be planned or scored in one batch.

    Attributes:
      batch: padded scenarios, NumPy float64 leaves `[B, ...]`.
      infos: one per scenario.
      failures: scenarios that could not be loaded.
    """

    batch: ScenarioBatch
    infos: list[ScenarioInfo]
    failures: list[Failure] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.infos)

    def __repr__(self) -> str:
        types = sorted({info.scenario_type for info in self.infos})
        shown = ", ".join(types[:4]) + (", ..." if len(types) > 4 else "")
        tracks = self.batch.tracks.valid.shape[1]
        lanes = self.batch.map.lanes.valid.shape[1]
        text = (
            f"ScenarioSet({len(self)} scenarios: {shown}; padded to {tracks} tracks, {lanes} lanes"
        )
        if self.failures:
            text += f"; {len(self.failures)} failed, see .failures"
        return text + ")"
