"""interPlan scenarios from nuPlan logs."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from spdm_jax.interplan.config import InterplanConfig
from spdm_jax.interplan.extras import InterplanExtras
from spdm_jax.interplan.modify import modify
from spdm_jax.io.map_query import MapQuery
from spdm_jax.io.nuplan import NuPlanReader
from spdm_jax.io.nuplan_filter import SUFFIX_NOTE, ScenarioFilter, Window, base_token
from spdm_jax.io.raw import RawScenario, ScenarioError

INTERPLAN_WINDOW = Window(duration=30.0, offset=0.0)
"""interPlan's scenarios start at their token, whatever its tag, and last twice as long."""


class InterplanReader:
    """Reads changed scenarios; implements `spdm_jax.io.raw.Reader`.

    Args:
      data_root: nuPlan logs, as for `NuPlanReader`.
      config: the modification file.
      scenario_filter: which scenarios: its tokens carry codes (`<token>-<code>`).
      map_root: folder with `nuplan-maps-v1.0.json`; by default beside or above the data.
      window: part of the log a scenario takes.

    Attributes:
      notes: remarks about the selection.

    Raises:
      ScenarioError: the filter names no changed scenario, a code does not fit the file, or the logs
        cannot be read.
    """

    def __init__(
        self,
        data_root: Path | str,
        config: InterplanConfig,
        scenario_filter: ScenarioFilter,
        map_root: Path | str | None = None,
        *,
        window: Window = INTERPLAN_WINDOW,
    ) -> None:
        given = scenario_filter.scenario_tokens or ()
        names = [name for name in given if "-" in name]
        if not names:
            raise ScenarioError(
                "the filter names no changed scenario; give scenario_tokens as <token>-<code>"
            )
        self._changes = {name: config.changes(name) for name in names}
        self._reader = NuPlanReader(data_root, map_root, scenario_filter, window=window)
        found = set(self._reader.tokens())
        self._names = [name for name in self._changes if base_token(name) in found]
        self._queries: list[MapQuery] = []
        # The reader below takes the suffixes for something that nobody follows.
        recorded = [note for note in self._reader.notes if SUFFIX_NOTE not in note]
        self.notes = [*config.notes, *recorded, *_left_out(given, self._names, config)]
        if count := scenario_filter.num_scenarios_per_type:
            types = Counter(self._changes[name].scenario_type for name in self._names)
            self.notes += [
                f"num_scenarios_per_type is {count} and not applied: {number} scenarios are of "
                f"type {kind}"
                for kind, number in types.items()
                if number > count
            ]

    def tokens(self) -> Sequence[str]:
        """Returns the names of the scenarios that the logs hold, in the filter's order."""
        return list(self._names)

    def read(self, token: str) -> RawScenario:
        """Reads one scenario, changed.

        Raises:
          ScenarioError: not selected, or the changes do not fit.
        """
        return self.read_with_extras(token)[0]

    def read_with_extras(self, token: str) -> tuple[RawScenario, InterplanExtras]:
        """Reads one scenario, changed, and what its simulation needs besides.

        Raises:
          ScenarioError: not selected, or the changes do not fit.
        """
        if token not in self._changes:
            raise ScenarioError(f"scenario {token!r} is not selected; see tokens()")
        changes = self._changes[token]
        raw = self._reader.read(changes.base_token)
        seed = self._reader.step_tokens(changes.base_token)[0]
        return modify(raw, changes, seed=seed, query=self._query(raw))

    def _query(self, raw: RawScenario) -> MapQuery:
        query = next((query for query in self._queries if query.map is raw.map), None)
        if query is None:
            query = MapQuery(raw.map)
            self._queries.append(query)
        return query


def _left_out(given: Sequence[str], found: Sequence[str], config: InterplanConfig) -> list[str]:
    """Says which scenarios are not what their names might promise."""
    notes = []
    if plain := [name for name in given if "-" not in name]:
        notes.append(
            f"{len(plain)} of {len(given)} scenario_tokens have no code and are left out, the "
            f"first is {plain[0]}"
        )
    strange = [name for name in found if base_token(name) not in config.tokens]
    if strange:
        notes.append(
            f"{config.source} says nothing about the tokens of {len(strange)} scenarios, the first "
            f"is {strange[0]}: no goal positions and no added agents of their own"
        )
    return notes
