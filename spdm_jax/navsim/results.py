"""What a NAVSIM profile gives for a set of frames: NumPy scores with names and reasons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from spdm_jax.config import DT
from spdm_jax.navsim.frames import NavsimInfo
from spdm_jax.navsim.types import NavsimScores
from spdm_jax.results import COMFORT_NAMES, Explanation, Failure
from spdm_jax.scoring.profile import Profile, Term

if TYPE_CHECKING:
    import polars

TERMS: tuple[Term, ...] = get_args(Term)
COMPONENTS = ("total", *TERMS, "progress_raw", "total_without_extended_comfort", "total_unfiltered")
"""One number per trajectory: the score, its terms as they entered it, and other readings of it."""


def component(scores: NavsimScores, name: str) -> Any:
    """Returns a component of scores, on the host or the device."""
    return getattr(scores.filtered if name in TERMS else scores, name)


@dataclass
class NavsimScoreSet:
    """Scores of trajectories in several frames.

    A component is an attribute, `[B, P]`: `total` (PDMS or EPDMS), the terms as they entered it
    (after the human filter, where the profile has one), `progress_raw` in m,
    `total_without_extended_comfort` and `total_unfiltered`.

    Attributes:
      scores: `NavsimScores` with NumPy leaves `[B, P]`; terms before the filter are in `raw`.
      infos: one per frame.
      profile: what the scores were made by.
      failures: frames left out on the way in.
    """

    scores: NavsimScores
    infos: list[NavsimInfo]
    profile: Profile
    failures: list[Failure] = field(default_factory=list)

    def __getattr__(self, name: str) -> Any:
        if name in COMPONENTS:
            return component(self.scores, name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __len__(self) -> int:
        return len(self.infos)

    @property
    def status(self) -> list[str]:
        """Per frame: "ok", or "failed" where a score is not finite."""
        finite = np.isfinite(self.scores.total).all(axis=1)
        return ["ok" if row else "failed" for row in finite]

    def explain(self, scene: int, proposal: int) -> Explanation:
        """Says in words what a trajectory lost points for.

        Args:
          scene: row of the frame.
          proposal: row of the trajectory.
        """
        return _Account(self, scene, proposal).explanation()

    def to_table(self) -> polars.DataFrame:
        """One row per trajectory (and one per failed frame, scores null).

        Raises:
          ImportError: polars is not installed (`pip install "spdm-jax[data]"`).
        """
        import polars

        shape = np.shape(self.scores.total)
        scene, proposal = (index.ravel() for index in np.indices(shape))
        table = polars.DataFrame(
            {
                "token": np.array([info.token for info in self.infos])[scene],
                "proposal": proposal,
                **{name: np.asarray(component(self.scores, name)).ravel() for name in COMPONENTS},
                **{
                    name.replace("index", "time"): self._seconds(name).ravel()
                    for name in ("collision_index", "ttc_index", "red_light_index")
                },
                "profile": [self.profile.name] * len(scene),
                "status": np.array(self.status)[scene],
            }
        ).with_columns(polars.lit("").alias("reason"))
        if self.failures:
            failed = polars.DataFrame(
                {
                    "token": [failure.token for failure in self.failures],
                    "status": ["failed"] * len(self.failures),
                    "reason": [failure.reason for failure in self.failures],
                }
            )
            table = polars.concat([table, failed], how="diagonal_relaxed")
        return table

    def _seconds(self, name: str) -> np.ndarray:
        """Time of an index, s; inf where it never happens."""
        index = np.asarray(getattr(self.scores, name))
        steps = np.shape(self.scores.oncoming)[-1]
        return np.where(index < steps, index * DT, np.inf)


class _Account:
    """Goes through the terms of one trajectory."""

    def __init__(self, result: NavsimScoreSet, scene: int, proposal: int):
        self._result, self._row = result, (scene, proposal)
        self._lost: list[str] = []
        self._rule: str | None = None
        self._step: int | None = None

    def _at(self, name: str) -> Any:
        return np.asarray(getattr(self._result.scores, name))[self._row]

    def _blame(self, term: Term, text: str, step: int | None = None) -> None:
        """Notes a lost term; one that the human lost as well costs nothing."""
        result = self._result
        raw, counts = (
            float(getattr(terms, term)[self._row])
            for terms in (result.scores.raw, result.scores.filtered)
        )
        if not result.profile.judges(term):
            return
        if raw < 1 <= counts:
            self._lost.append(f"{text}; the human failed here too, so it costs nothing")
        elif counts < 1:
            self._lost.append(f"{text}: {term} {counts:g}")
            if self._rule is None:
                self._rule, self._step = term, step

    def explanation(self) -> Explanation:
        """Returns what was lost."""
        total = float(self._at("total"))
        info = self._result.infos[self._row[0]]
        if not self._at("valid"):
            self._lost.append("a pose is not a finite number: score 0")
        else:
            self._multipliers()
            self._weighted()
        return Explanation(
            info.token, self._row[1], total, tuple(self._lost), None, self._step, self._rule
        )

    def _multipliers(self) -> None:
        at = self._at
        index = int(at("collision_index"))
        self._blame("no_at_fault_collision", f"at-fault collision at {index * DT:.1f} s", index)
        index = int(np.argmax(at("non_drivable")))
        text = f"a corner leaves the drivable area at {index * DT:.1f} s"
        self._blame("drivable_area", text, index)
        index = int(np.argmax(at("oncoming")))
        text = f"drives off the route's lanes or against traffic from {index * DT:.1f} s on"
        self._blame("driving_direction", text, index)
        index = int(at("red_light_index"))
        self._blame("traffic_light", f"on a red connector at {index * DT:.1f} s", index)

    def _weighted(self) -> None:
        at = self._at
        index = int(at("ttc_index"))
        text = f"less than 1 s to a collision at {index * DT:.1f} s"
        self._blame("time_to_collision", text, index)
        self._blame("lane_keeping", "more than 0.5 m beside the centreline for 2 s")
        flags = np.asarray(at("comfort_flags"))
        names = [name for name, ok in zip(COMFORT_NAMES, flags, strict=True) if not ok]
        self._blame("comfort", f"uncomfortable: {', '.join(names)}")
        self._blame("extended_comfort", "differs from the plan of the frame before")
        progress = float(self._result.scores.filtered.progress[self._row])
        if progress < 1 - 1e-6:
            way = f"{at('progress_raw'):.1f} m of progress, {100 * progress:.1f} %"
            self._blame("progress", f"{way} of the better of this and the reference")
