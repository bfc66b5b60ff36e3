"""Built-in suites: fixed, seeded collections of scenes with an expert's record.

`common-14` has fourteen everyday situations, `interactive-8` eight in which following a lane does
not do. Every scene covers a closed-loop run of 15 s in `common-14` and of 30 s in `interactive-8`,
as in the benchmarks whose situations they take up: 2.2 s of history, 151 or 301 iterations, and 8 s
beyond each iteration at which a planner is asked. In 30 s, standing before what blocks the lane
costs the progress that nuPlan's score demands.

The record is an expert's by hindsight: a scene is drawn anew, with the next of its seeds, until
the recorded ego drives faultlessly (`spdm_jax.synthetic.hindsight`).
"""

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.synthetic.generator import record
from spdm_jax.synthetic.hindsight import faults
from spdm_jax.synthetic.stage import Stage
from spdm_jax.synthetic.suite_common import COMMON
from spdm_jax.synthetic.suite_interactive import INTERACTIVE
from spdm_jax.synthetic.traffic import NUM_HISTORY

NUM_ITERATIONS = {"common-14": 151, "interactive-8": 301}
"""Iterations of a scene of each suite: 15 and 30 s with both ends."""
NUM_BEYOND = 80
"""Recorded steps beyond the last iteration at which a planner is asked: 8 s."""
SCENES_PER_TYPE = 10
MAX_DRAWS = 40
"""A scene type that needs more draws for a faultless record is broken."""

SUITES: dict[str, dict[str, Callable[[np.random.Generator], Stage]]] = {
    "common-14": COMMON,
    "interactive-8": INTERACTIVE,
}
"""Scene functions by scenario type, for each suite."""


def suite_names() -> tuple[str, ...]:
    """Returns the names that `SuiteReader` knows."""
    return tuple(SUITES)


class SuiteReader:
    """Offers a suite as a data set; tokens are "type-number", such as "changing_lane-07"."""

    def __init__(self, suite: str, numbers: Sequence[int] = range(SCENES_PER_TYPE)):
        """Selects a suite.

        Args:
          suite: one of `suite_names()`.
          numbers: scenes of each type; the suite proper is 0 ... 9, others are further scenes of
            the same kind, for instance to train on.

        Raises:
          ValueError: unknown suite or negative number.
        """
        if suite not in SUITES:
            raise ValueError(f"suite {suite!r} is unknown; choose one of {', '.join(SUITES)}")
        if negative := [n for n in numbers if n < 0]:
            raise ValueError(f"numbers has {negative}; they must be >= 0")
        self._suite = suite
        self._scenes = {f"{t}-{n:02d}": (t, n) for t in SUITES[suite] for n in numbers}

    def tokens(self) -> Sequence[str]:
        """Returns the tokens, grouped by type."""
        return tuple(self._scenes)

    def read(self, token: str) -> RawScenario:
        """Returns one scene; equal tokens give equal bytes.

        Raises:
          ScenarioError: the token is not among `tokens()`.
        """
        if token not in self._scenes:
            raise ScenarioError(
                f"suite {self._suite}: token {token!r} is not selected; it must be type-number "
                f"with a type of the suite (such as {next(iter(self._scenes), None)!r})"
            )
        scenario_type, number = self._scenes[token]
        num_iterations = NUM_ITERATIONS[self._suite]
        key = zlib.crc32(f"{self._suite}/{scenario_type}".encode())
        for draw in range(MAX_DRAWS):
            raw = record(
                SUITES[self._suite][scenario_type],
                np.random.default_rng([draw, number, key]),
                token=token,
                scenario_type=scenario_type,
                log_name=self._suite,
                num_iterations=num_iterations,
                num_steps=NUM_HISTORY + num_iterations - 1 + NUM_BEYOND,
                # What blocks the way of an ego that waits must not vanish with the recorded one.
                remember_static=True,
            )
            if not faults(raw):
                return raw
        raise RuntimeError(
            f"suite {self._suite}: no faultless record of {token} in {MAX_DRAWS} draws"
        )
