"""interPlan's scenario codes, and what a modification file says.

A scenario is named `<nuPlan token>-<code>`; the code says what is changed, and the file says how,
by token. Positions are map coordinates, m.
"""

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from spdm_jax.io.nuplan_filter import base_token
from spdm_jax.io.raw import ScenarioError


class Density(StrEnum):
    """How many vehicles are spawned."""

    LOW = "low"
    MEDIUM = "medium"
    HIGH = "high"


class Goal(StrEnum):
    """Where the ego shall go."""

    LEFT = "left"
    RIGHT = "right"
    STRAIGHT = "straight"


class Policy(StrEnum):
    """How all agents together treat an ego that moves into their lane."""

    ASSERTIVE = "assertive"
    MIXED = "mixed"
    CAUTIOUS = "cautious"


class ObstacleKind(StrEnum):
    """What the ego has to get past, by nuPlan-style metric name."""

    CONES = "ego_sorts_construction_zone"
    STOPPED_VEHICLES = "ego_sorts_stopped_vehicle"
    PEDESTRIANS = "ego_sorts_jaywalking_pedestrian"


SPECIAL_TYPES: Mapping[str, ObstacleKind] = MappingProxyType(
    {
        "approaching_construction_zone": ObstacleKind.CONES,
        "avoid_crashed_cars": ObstacleKind.STOPPED_VEHICLES,
        "jaywalking_pedestrian": ObstacleKind.PEDESTRIANS,
        "nudge_around_parked_vehicle": ObstacleKind.STOPPED_VEHICLES,
        "overtake_parked_vehicle": ObstacleKind.STOPPED_VEHICLES,
    }
)
"""Types of special scenarios, and what decides whether the ego has sorted them."""

_OTHER_TYPE = "standard_modified_nuplan_scenario"
_CODE_PART = re.compile(r"d[lmh]|g[lrs]|o[amc]|a[01]|s\d{1,2}")


@dataclass(frozen=True)
class Code:
    """What a scenario code asks for.

    Attributes:
      density: spawn vehicles anew, or None.
      goal: change the goal, or None.
      policy: of all agents.
      keep_vehicles: False removes all recorded vehicles, True keeps them, None says nothing.
      special: number of a special scenario of the token, or None.
    """

    density: Density | None = None
    goal: Goal | None = None
    policy: Policy = Policy.ASSERTIVE
    keep_vehicles: bool | None = None
    special: int | None = None

    @property
    def changes_objects(self) -> bool:
        """Whether recorded objects give way to scripted ones."""
        return (self.density, self.keep_vehicles, self.special) != (None, None, None)


def parse_code(code: str, where: str) -> Code:
    """Reads a scenario code such as `dhgloa`.

    Args:
      code: letter and value pairs: d(l|m|h), g(l|r|s), o(a|m|c), a(0|1), s(number).
      where: what errors name as the place of the code.

    Raises:
      ScenarioError: an unknown letter or value, one letter twice, or density together with kept
        vehicles.
    """
    parts: dict[str, str] = {}
    rest = code
    while rest:
        found = _CODE_PART.match(rest)
        if found is None or rest[0] in parts:
            reason = "repeats a letter" if found else "is none of d(l|m|h) g(l|r|s) o(a|m|c) a(0|1)"
            raise ScenarioError(
                f"{where}: code {code!r}: {rest!r} {reason}{'' if found else ' s(number)'}"
            )
        parts[rest[0]] = found[0][1:]
        rest = rest[found.end() :]
    if not parts:
        raise ScenarioError(f"{where}: the code is empty; expected one such as 'dhgloa' or 's0'")
    if "a" in parts and "d" in parts:
        raise ScenarioError(
            f"{where}: code {code!r} has both a density (d) and a share of the recorded vehicles "
            "(a); density replaces them all, drop one"
        )
    first = lambda kinds: {kind.value[0]: kind for kind in kinds}
    return Code(
        density=first(Density)[parts["d"]] if "d" in parts else None,
        goal=first(Goal)[parts["g"]] if "g" in parts else None,
        policy=first(Policy)[parts.get("o", "a")],
        keep_vehicles=parts["a"] == "1" if "a" in parts else None,
        special=int(parts["s"]) if "s" in parts else None,
    )


@dataclass(frozen=True)
class ExtraAgent:
    """A vehicle added wherever a density is spawned.

    Attributes:
      x, y: m, box centre.
      speed: m/s. (The published documentation calls it a yaw; its code reads a speed.)
      cautious: it treats the ego as standing.
      snap: put it on the baseline of the lane there; else it heads along +x until it is.
    """

    x: float
    y: float
    speed: float
    cautious: bool = True
    snap: bool = False


@dataclass(frozen=True)
class PedestrianPath:
    """A pedestrian's straight way.

    Attributes:
      start, end: x, y, m.
      begins_at: iteration at which it starts to walk; None: when the ego is near.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    begins_at: int | None


@dataclass(frozen=True)
class SpecialScenario:
    """One special scenario of a token.

    Attributes:
      type: one of `SPECIAL_TYPES`.
      config: code that replaces the rest of the scenario's code, "" if there is none.
      stopped_vehicles, stopped_buses: x, y, heading of each box centre.
      cones: x, y.
      pedestrians: ways.
      spawn_roadblocks: points in further roadblocks that a density fills; None: those of the token.
    """

    type: str
    config: str = ""
    stopped_vehicles: tuple[tuple[float, ...], ...] = ()
    stopped_buses: tuple[tuple[float, ...], ...] = ()
    cones: tuple[tuple[float, ...], ...] = ()
    pedestrians: tuple[PedestrianPath, ...] = ()
    spawn_roadblocks: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class TokenChanges:
    """What a modification file says about one token.

    Attributes:
      goals: goal position per command; a command without one is followed at every intersection.
      extra_agents: added with any density.
      spawn_roadblocks: points in further roadblocks that a density fills.
      special: special scenarios by number.
    """

    goals: Mapping[Goal, tuple[float, float]] = field(default_factory=dict)
    extra_agents: tuple[ExtraAgent, ...] = ()
    spawn_roadblocks: tuple[tuple[float, ...], ...] = ()
    special: Mapping[int, SpecialScenario] = field(default_factory=dict)


@dataclass(frozen=True)
class ScenarioChanges:
    """Everything that is changed in one scenario, code and file taken together.

    Attributes:
      name: `<token>-<code>`.
      base_token: the recorded scenario.
      code: what applies (the special scenario's own code, if it has one).
      token_changes: of the base token.
      special: the special scenario, or None.
      accel_max, decel_max: comfort limits that the spawned queue assumes, m/s^2.
    """

    name: str
    base_token: str
    code: Code
    token_changes: TokenChanges
    special: SpecialScenario | None
    accel_max: float
    decel_max: float

    @property
    def scenario_type(self) -> str:
        """interPlan's name of the type."""
        if self.special is not None:
            return self.special.type
        return f"{self.code.density}_traffic_density" if self.code.density else _OTHER_TYPE

    @property
    def spawn_roadblocks(self) -> tuple[tuple[float, ...], ...]:
        """Points in further roadblocks that a density fills."""
        own = self.special.spawn_roadblocks if self.special is not None else None
        return self.token_changes.spawn_roadblocks if own is None else own


@dataclass(frozen=True)
class InterplanConfig:
    """A modification file, as `read_modifications` returns it.

    Attributes:
      tokens: changes per recorded token.
      accel_max, decel_max: m/s^2, see `ScenarioChanges`.
      source: what errors name as the origin.
      notes: what of the file could not be followed.
    """

    tokens: Mapping[str, TokenChanges]
    accel_max: float = 1.0
    decel_max: float = 2.0
    source: str = "modifications"
    notes: tuple[str, ...] = ()

    def changes(self, name: str) -> ScenarioChanges:
        """Returns what is changed in the scenario `<token>-<code>`.

        A token that the file lacks has no goal positions and no added agents of its own.

        Raises:
          ScenarioError: no token or code, or a special scenario that the file lacks.
        """
        where = f"{self.source}: scenario {name!r}"
        base = base_token(name)
        code = parse_code(name[len(base) + 1 :], where)
        of_token = self.tokens.get(base, TokenChanges())
        special = None
        if code.special is not None:
            special = of_token.special.get(code.special)
            if special is None:
                known = f"has {sorted(of_token.special)}" if base in self.tokens else "is not there"
                raise ScenarioError(f"{where}: no special_scenario {code.special}; token {known}")
            if special.config:
                own = parse_code(special.config, f"{where}: config")
                code = dataclasses.replace(own, special=code.special)
        return ScenarioChanges(
            name=name,
            base_token=base,
            code=code,
            token_changes=of_token,
            special=special,
            accel_max=self.accel_max,
            decel_max=self.decel_max,
        )
