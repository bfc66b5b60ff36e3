"""Which rules make up a score: static profiles of the one scorer.

Every profile is a choice among the same sub-scores; the numbers they share (thresholds, angles,
comfort bounds) stay in `ScoringParams`.
"""

from dataclasses import dataclass, replace
from typing import Literal

from spdm_jax.config import NUM_STATES

Term = Literal[
    "no_at_fault_collision",
    "drivable_area",
    "driving_direction",
    "traffic_light",
    "progress",
    "time_to_collision",
    "lane_keeping",
    "comfort",
    "extended_comfort",
]
"""Sub-scores, each in [0, 1]."""


@dataclass(frozen=True)
class Profile:
    """Rules of one published score.

    Attributes:
      name: how users ask for it.
      multipliers: sub-scores whose product multiplies the rest.
      weights: sub-scores of the weighted mean, with their weights. For "tuplan" the traced weights
        of `ScoringParams` take their place.
      observation: "forecast" is the planner's own forecast, "replay" the recorded objects.
      samples_every: scored steps per sample of the objects' future (0.2 s or 0.1 s samples).
      replay_samples: samples of the replay, 0.1 s apart.
      drops_touching: objects that touch the ego at the start are left out; otherwise a replay
        counts them as collisions, and a forecast ignores them.
      areas: "lanes" means that lanes and car parks are drivable, "blocks" that road blocks,
        intersections and car parks are.
      ttc_steps: time indices at which time to collision is judged.
      direction_window: steps over which the way against traffic is summed; None takes whole runs.
      crossings_excuse_direction: inside an intersection no way counts as against traffic.
      progress_norm: progress is relative to the best of the whole "set", or of each trajectory and
        the reference alone ("pair").
      progress_threshold: m; up to it nobody made progress.
      progress_multiplied: relative progress carries the trajectory's own multiplier; otherwise it
        is the raw one over the best, at most 1.
      comfort: "horizon" looks at the scored states, "history" at the recorded past as well.
      human_filter: a sub-score that the human failed (0) is not held against a trajectory.
    """

    name: str
    multipliers: tuple[Term, ...]
    weights: tuple[tuple[Term, float], ...]
    observation: Literal["forecast", "replay"]
    samples_every: int
    replay_samples: int
    drops_touching: bool
    areas: Literal["lanes", "blocks"]
    ttc_steps: int
    direction_window: int | None
    crossings_excuse_direction: bool
    progress_norm: Literal["set", "pair"]
    progress_threshold: float
    progress_multiplied: bool
    comfort: Literal["horizon", "history"]
    human_filter: bool

    def judges(self, term: Term) -> bool:
        """Whether a sub-score has a part in the total."""
        return term in self.multipliers or any(term == name for name, _ in self.weights)


TUPLAN = Profile(
    name="tuplan",
    multipliers=("no_at_fault_collision", "drivable_area", "driving_direction"),
    weights=(("progress", 5.0), ("time_to_collision", 5.0), ("comfort", 2.0)),
    observation="forecast",
    samples_every=2,
    replay_samples=0,
    drops_touching=False,
    areas="lanes",
    ttc_steps=NUM_STATES,
    direction_window=None,
    crossings_excuse_direction=False,
    progress_norm="set",
    progress_threshold=0.1,
    progress_multiplied=True,
    comfort="horizon",
    human_filter=False,
)
"""tuplan_garage `PDMScorer`: what PDM-Closed and SPDM choose by."""

NAVSIM1 = Profile(
    name="navsim1",
    multipliers=("no_at_fault_collision", "drivable_area"),
    weights=(("progress", 5.0), ("time_to_collision", 5.0), ("comfort", 2.0)),
    observation="replay",
    samples_every=1,
    replay_samples=51,
    drops_touching=False,
    areas="blocks",
    ttc_steps=NUM_STATES,
    direction_window=11,
    crossings_excuse_direction=False,
    progress_norm="pair",
    progress_threshold=5.0,
    progress_multiplied=True,
    comfort="horizon",
    human_filter=False,
)
"""NAVSIM v1.1: PDMS."""

NAVSIM2 = Profile(
    name="navsim2",
    multipliers=("no_at_fault_collision", "drivable_area", "driving_direction", "traffic_light"),
    weights=(
        ("progress", 5.0),
        ("time_to_collision", 5.0),
        ("lane_keeping", 2.0),
        ("comfort", 2.0),
        ("extended_comfort", 2.0),
    ),
    observation="replay",
    samples_every=1,
    replay_samples=41,
    drops_touching=True,
    areas="blocks",
    # The replay ends at 4.0 s, the last projection looks 0.9 s ahead.
    ttc_steps=32,
    direction_window=11,
    crossings_excuse_direction=True,
    progress_norm="pair",
    progress_threshold=5.0,
    progress_multiplied=False,
    comfort="history",
    human_filter=True,
)
"""NAVSIM v2.2, one stage with recorded traffic: EPDMS."""

NAVSIM2_UNFILTERED = replace(NAVSIM2, name="navsim2_unfiltered", human_filter=False)
"""EPDMS without the human filter: the total that NAVSIM v2.0 to v2.1.2 reported."""

PROFILES = {p.name: p for p in (TUPLAN, NAVSIM1, NAVSIM2, NAVSIM2_UNFILTERED)}


def profile_named(name: str) -> Profile:
    """Returns the profile of that name.

    Raises:
      ValueError: there is none.
    """
    if name not in PROFILES:
        raise ValueError(f"profile is {name!r}; it must be one of {', '.join(PROFILES)}")
    return PROFILES[name]
