"""Which scenarios of a set of nuPlan logs are wanted, and how much of a log each one takes."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spdm_jax.io.nuplan_log import UNTAGGED, Candidate
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.yaml_file import read_fields


@dataclass(frozen=True)
class Window:
    """The part of a log that makes a scenario.

    Attributes:
      duration: s.
      offset: start relative to the tagged sweep, s.
    """

    duration: float
    offset: float


TAGGED_WINDOW = Window(duration=15.0, offset=-3.0)
"""nuPlan's window of the types in `TAGGED_TYPES`."""
OTHER_WINDOW = Window(duration=20.0, offset=0.0)
"""nuPlan's window of every other type, untagged sweeps included."""

TAGGED_TYPES = frozenset(
    f"{group}_{name}" if name else group
    for group, names in {
        "accelerating_at": "crosswalk stop_sign stop_sign_no_crosswalk traffic_light "
        "traffic_light_with_lead traffic_light_without_lead",
        "behind": "bike long_vehicle pedestrian_on_driveable pedestrian_on_pickup_dropoff",
        "changing_lane": "",
        "changing_lane_to": "left right",
        "changing_lane_with": "lead trail",
        "crossed_by": "bike vehicle",
        "following_lane": "with_lead with_slow_lead without_lead",
        "high": "lateral_acceleration magnitude_jerk magnitude_speed",
        "low_magnitude": "speed",
        "medium_magnitude": "speed",
        "near": "barrier_on_driveable construction_zone_sign high_speed_vehicle long_vehicle "
        "multiple_bikes multiple_pedestrians multiple_vehicles pedestrian_at_pickup_dropoff "
        "pedestrian_on_crosswalk pedestrian_on_crosswalk_with_ego trafficcone_on_driveable",
        "on": "all_way_stop_intersection carpark intersection pickup_dropoff "
        "stopline_crosswalk stopline_stop_sign stopline_traffic_light traffic_light_intersection",
        "starting": "high_speed_turn left_turn low_speed_turn protected_cross_turn "
        "protected_noncross_turn right_turn straight_stop_sign_intersection_traversal "
        "straight_traffic_light_intersection_traversal u_turn unprotected_cross_turn "
        "unprotected_noncross_turn",
        "stationary": "",
        "stationary_at": "crosswalk traffic_light_with_lead traffic_light_without_lead",
        "stationary_in": "traffic",
        "stopping_at": "crosswalk stop_sign_no_crosswalk stop_sign_with_lead "
        "stop_sign_without_lead traffic_light_with_lead traffic_light_without_lead",
        "stopping_with": "lead",
        "traversing": "crosswalk intersection narrow_lane pickup_dropoff "
        "traffic_light_intersection",
        "waiting_for": "pedestrian_to_cross",
    }.items()
    for name in (names.split() or [""])
)
"""Scenario types that nuPlan's default mapping lists."""
SUFFIX_NOTE = "tokens carry a suffix"
"""Part of the note that a benchmark's variants are read unmodified."""

_LISTS = ("scenario_types", "scenario_tokens", "log_names", "map_names")
_NUMBERS = ("num_scenarios_per_type", "limit_total_scenarios", "timestamp_threshold_s")
# Fields that change the selection in ways this reader does not follow: they must be off.
_UNSUPPORTED = (
    "ego_displacement_minimum_m",
    "ego_start_speed_threshold",
    "ego_stop_speed_threshold",
    "token_set_path",
    "fraction_in_token_set_threshold",
    "ego_route_radius",
    "expand_scenarios",
    "shuffle",
)
# Without effect here: only read together with an unsupported field, or meant for the file's loader.
_IGNORED = ("speed_noise_tolerance", "defaults", "modifications")


@dataclass(frozen=True)
class ScenarioFilter:
    """nuPlan's scenario filter; every field is off by default (all sweeps of all logs).

    Attributes:
      scenario_types: accepted tags.
      scenario_tokens: accepted tokens. A token may carry a benchmark's suffix ("-s1"): the recorded
        scenario before the dash is selected.
      log_names: accepted logs.
      map_names: accepted locations.
      num_scenarios_per_type: at most so many of a type, taken at equal steps.
      limit_total_scenarios: at most so many (int) or such a share (float), untagged go first.
      timestamp_threshold_s: least time between the tagged sweeps of one type, s.
      remove_invalid_goals: only scenes that have a mission goal.
      notes: what of a filter file could not be followed.
    """

    scenario_types: tuple[str, ...] | None = None
    scenario_tokens: tuple[str, ...] | None = None
    log_names: tuple[str, ...] | None = None
    map_names: tuple[str, ...] | None = None
    num_scenarios_per_type: int | None = None
    limit_total_scenarios: int | float | None = None
    timestamp_threshold_s: float | None = None
    remove_invalid_goals: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Accepts any sequence for the lists and checks values.

        Raises:
          ScenarioError: a token that is no token, or a count or share out of range.
        """
        for name in _LISTS:
            values = getattr(self, name)
            if isinstance(values, str):
                raise ScenarioError(f"{name} is {values!r}; give a list of names")
            if values is not None:
                object.__setattr__(self, name, tuple(values))
        for token in self.scenario_tokens or ():
            base_token(token)
        if self.num_scenarios_per_type is not None and self.num_scenarios_per_type < 1:
            raise ScenarioError(
                f"num_scenarios_per_type is {self.num_scenarios_per_type}; it must be positive"
            )
        limit = self.limit_total_scenarios
        if limit is not None and (limit <= 0 or (isinstance(limit, float) and limit > 1)):
            raise ScenarioError(
                f"limit_total_scenarios is {limit}; give a positive int or a share in (0, 1]"
            )

    @property
    def base_tokens(self) -> tuple[str, ...] | None:
        """The recorded scenarios behind `scenario_tokens`, without repetition."""
        if self.scenario_tokens is None:
            return None
        return tuple(dict.fromkeys(base_token(token) for token in self.scenario_tokens))

    @property
    def has_variants(self) -> bool:
        """Whether tokens carry a benchmark's suffix."""
        return any("-" in token for token in self.scenario_tokens or ())

    def summary(self) -> str:
        """Says which fields are set; long lists by their length."""
        parts = []
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.name != "notes" and value not in (None, False):
                many = isinstance(value, tuple) and len(value) > 5
                parts.append(f"{entry.name}: {f'{len(value)} entries' if many else value}")
        return ", ".join(parts) or "all off"

    @classmethod
    def from_yaml(cls, path: Path | str) -> "ScenarioFilter":
        """Reads one of nuPlan's scenario-filter files as people have them.

        References to other configuration files (`${...}`) cannot be resolved: such a field is off,
        and `notes` says so.

        Raises:
          ScenarioError: not YAML, an unknown field, or a field that is set but not supported.
          ImportError: PyYAML is not installed.
        """
        entries = read_fields(path, "filter", "nuPlan's scenario filter")
        return cls.from_mapping(entries, str(path))

    @classmethod
    def from_mapping(cls, entries: Mapping[str, Any], source: str = "filter") -> "ScenarioFilter":
        """Builds a filter from nuPlan's field names and values (text as in YAML, or plain values).

        Args:
          entries: field -> value; None, "" and "null" mean off.
          source: what errors name as the origin.

        Raises:
          ScenarioError: an unknown field, or one that is set but not supported.
        """
        return _from_entries(entries, source)


def base_token(token: str) -> str:
    """Returns the recorded scenario's token (16 hex digits) of a token with or without suffix."""
    base = token.partition("-")[0]
    if len(base) != 16 or any(c not in "0123456789abcdef" for c in base):
        raise ScenarioError(f"scenario token is {token!r}; expected 16 lower-case hex digits")
    return base


def window_of(
    scenario_type: str, window: Window | None, windows: Mapping[str, Window] | None
) -> Window:
    """Returns a type's window: `windows[type]`, else `window`, else nuPlan's."""
    if windows and scenario_type in windows:
        return windows[scenario_type]
    return window or (TAGGED_WINDOW if scenario_type in TAGGED_TYPES else OTHER_WINDOW)


def apply_filter(
    candidates: Sequence[Candidate], scenario_filter: ScenarioFilter
) -> list[Candidate]:
    """Applies the counting fields, in nuPlan's order; returns the rest sorted by token.

    Args:
      candidates: sweeps that pass the fields about tokens, types, logs, maps and goals; log by log,
        each in time order.
      scenario_filter: the filter.
    """
    by_type: dict[str, list[Candidate]] = {}
    for candidate in candidates:
        by_type.setdefault(candidate.scenario_type, []).append(candidate)
    # A benchmark counts its variants by its own types, so the recorded ones must all stay.
    if (count := scenario_filter.num_scenarios_per_type) and not scenario_filter.has_variants:
        by_type = {kind: _spread(found, count) for kind, found in by_type.items()}
    if (limit := scenario_filter.limit_total_scenarios) is not None:
        by_type = _limit(by_type, limit)
    if (threshold := scenario_filter.timestamp_threshold_s) is not None:
        by_type = {kind: _apart(found, threshold) for kind, found in by_type.items()}
    return _flat(by_type)


def _flat(by_type: Mapping[str, Sequence[Candidate]]) -> list[Candidate]:
    return sorted((c for found in by_type.values() for c in found), key=lambda c: c.token)


def _spread(found: Sequence[Candidate], count: int) -> list[Candidate]:
    """Takes `count` entries at equal steps."""
    return list(found[:: max(len(found) // count, 1)][:count])


def _apart(found: Sequence[Candidate], threshold: float) -> list[Candidate]:
    """Keeps entries that start at least `threshold` s after the last one kept."""
    kept: list[Candidate] = []
    for candidate in sorted(found, key=lambda c: c.time_us):
        # Seconds in floating point, as nuPlan compares them.
        if not kept or candidate.time_us * 1e-6 >= kept[-1].time_us * 1e-6 + threshold:
            kept.append(candidate)
    return kept


def _limit(by_type: dict[str, list[Candidate]], limit: int | float) -> dict[str, list[Candidate]]:
    """Thins the whole selection; untagged sweeps go before any tagged one."""
    total = sum(len(found) for found in by_type.values())
    wanted = math.ceil(limit * total) if isinstance(limit, float) else limit
    if wanted >= total:
        return by_type
    untagged = by_type.get(UNTAGGED, [])
    surplus = total - wanted
    if surplus < len(untagged):
        return {**by_type, UNTAGGED: _spread(untagged, len(untagged) - surplus)}
    tagged = {kind: found for kind, found in by_type.items() if kind != UNTAGGED}
    thinned: dict[str, list[Candidate]] = {}
    for candidate in _spread(_flat(tagged), wanted):
        thinned.setdefault(candidate.scenario_type, []).append(candidate)
    return thinned


def _from_entries(entries: Mapping[str, Any], source: str) -> ScenarioFilter:
    known = (*_LISTS, *_NUMBERS, *_UNSUPPORTED, *_IGNORED, "remove_invalid_goals")
    fields: dict[str, Any] = {}
    notes: list[str] = []
    for key, value in entries.items():
        if key.startswith("_") or value is None or value in ("", "null", "~", "Null", "NULL"):
            continue
        if key not in known:
            raise ScenarioError(
                f"{source}: field {key!r} is unknown; a scenario filter has {sorted(known)}"
            )
        if isinstance(value, str) and "${" in value:
            notes.append(f"{key} refers to {value}, which only its own program can resolve: unset")
        elif key in _LISTS:
            fields[key] = _names(value, key, source)
        elif key in _NUMBERS:
            fields[key] = _number(value, key, source)
        elif key == "remove_invalid_goals":
            fields[key] = _flag(value, key, source)
        elif key in _UNSUPPORTED and str(value).lower() != "false":
            raise ScenarioError(
                f"{source}: {key} is {value}; this reader needs it off (null, false)"
            )
    result = ScenarioFilter(**fields)
    if result.has_variants:
        notes.append(
            f"{len(result.scenario_tokens or ())} {SUFFIX_NOTE}: the "
            f"{len(result.base_tokens or ())} recorded scenarios are selected, unmodified, and "
            "num_scenarios_per_type is not applied"
        )
    return dataclasses.replace(result, notes=tuple(notes))


def _names(value: Any, key: str, source: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ScenarioError(f"{source}: {key} is {value!r}; expected a list of names or null")
    return tuple(value)


def _number(value: Any, key: str, source: str) -> int | float:
    for convert in (int,) if key == "num_scenarios_per_type" else (int, float):
        try:
            return convert(str(value))
        except ValueError:
            continue
    raise ScenarioError(f"{source}: {key} is {value!r}; expected a number or null")


def _flag(value: Any, key: str, source: str) -> bool:
    if str(value).lower() not in ("true", "false"):
        raise ScenarioError(f"{source}: {key} is {value!r}; expected true or false")
    return str(value).lower() == "true"
