"""Reads interPlan's modification files as people have them."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spdm_jax.interplan.config import (
    SPECIAL_TYPES,
    ExtraAgent,
    Goal,
    InterplanConfig,
    ObstacleKind,
    PedestrianPath,
    SpecialScenario,
    TokenChanges,
    parse_code,
)
from spdm_jax.interplan.fields import (
    boolean,
    entry_list,
    is_null,
    mapping_of,
    number,
    numbers,
    unknown_fields,
)
from spdm_jax.io.nuplan_filter import base_token
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.yaml_file import read_fields

_DETAILS = "modification_details_dictionary"
_EXTRA_AGENTS = ("extra_agents_to_spawn", "extra_agents_spawn_locations")
_SPAWN_ROADBLOCKS = "roadblock_locations_to_spawn_agents"
# The published code reads `spawn_in_intersection` nowhere.
_TOKEN_FIELDS = (
    *("goal", "special_scenario", "spawn_in_intersection"),
    *(*_EXTRA_AGENTS, _SPAWN_ROADBLOCKS),
)
_SPECIAL_FIELDS = (
    *("type", "config", "stopped_vehicle", "stopped_bus", "cones", "pedestrian"),
    _SPAWN_ROADBLOCKS,
)


def read_modifications(path: Path | str) -> InterplanConfig:
    """Reads a modification file.

    Raises:
      ScenarioError: not YAML, or a field of the wrong form; names file, token and field.
      ImportError: PyYAML is not installed.
    """
    entries = read_fields(path, "modification", "interPlan's modifications")
    return modifications_from(entries, str(path))


def modifications_from(
    entries: Mapping[str, Any], source: str = "modifications"
) -> InterplanConfig:
    """Takes the fields of a modification file (text as in YAML, or plain values).

    Args:
      entries: the file's top level.
      source: what errors name as the origin.

    Raises:
      ScenarioError: a field is missing, unknown or of the wrong form; names token, field and value.
    """
    if _DETAILS not in entries:
        raise ScenarioError(f"{source}: has no {_DETAILS}; it has {sorted(entries)}")
    known = (_DETAILS, "accel_max", "decel_max", "scenario_specifics")
    unknown_fields(entries, known, source)
    notes: list[str] = []
    if not is_null(entries.get("scenario_specifics")):
        notes.append("scenario_specifics is not followed: name scenarios as <token>-<code>")
    limits = {}
    for key in ("accel_max", "decel_max"):
        value = entries.get(key)
        if isinstance(value, str) and "${" in value:
            continue  # refers to the traffic's settings, whose published values are the defaults
        if not is_null(value):
            limits[key] = number(value, f"{source}: {key}")
    tokens = {}
    for token, value in mapping_of(entries[_DETAILS], f"{source}: {_DETAILS}").items():
        if base_token(token) != token:
            raise ScenarioError(f"{source}: {_DETAILS} has {token!r}; expected tokens without code")
        tokens[token] = _read_token(value, f"{source}: {token}")
    return InterplanConfig(tokens=tokens, source=source, notes=tuple(notes), **limits)


def _read_token(value: Any, where: str) -> TokenChanges:
    entries = mapping_of(value, where)
    unknown_fields(entries, _TOKEN_FIELDS, where)
    goals = {}
    for command, place in mapping_of(entries.get("goal"), f"{where}.goal").items():
        if command not in list(Goal):
            raise ScenarioError(f"{where}.goal has {command!r}; expected one of {list(Goal)}")
        if not is_null(place):
            parts = place.split(",") if isinstance(place, str) else place
            x, y = numbers(parts, 2, f"{where}.goal.{command}")
            goals[Goal(command)] = (x, y)
    agents: list[ExtraAgent] = []
    for key in _EXTRA_AGENTS:
        for i, agent in enumerate(entry_list(entries.get(key), f"{where}.{key}")):
            agents.append(_read_agent(agent, f"{where}.{key}[{i}]"))
    special = {}
    name = f"{where}.special_scenario"
    for key, content in mapping_of(entries.get("special_scenario"), name).items():
        if not re.fullmatch(r"\d{1,2}", str(key)):
            raise ScenarioError(f"{name} has {key!r}; expected numbers of at most two digits")
        special[int(key)] = _read_special(content, f"{name}[{key}]")
    return TokenChanges(
        goals=goals,
        extra_agents=tuple(agents),
        spawn_roadblocks=_points(entries, _SPAWN_ROADBLOCKS, where),
        special=special,
    )


def _read_special(value: Any, where: str) -> SpecialScenario:
    entries = mapping_of(value, where)
    unknown_fields(entries, _SPECIAL_FIELDS, where)
    kind = str(entries.get("type"))
    if kind not in SPECIAL_TYPES:
        raise ScenarioError(f"{where}.type is {kind!r}; expected one of {sorted(SPECIAL_TYPES)}")
    code = entries.get("config")
    code = "" if is_null(code) else str(code)
    if code and parse_code(code, f"{where}.config").special is not None:
        raise ScenarioError(f"{where}.config is {code!r}; it must not name a special scenario")
    walks = []
    for i, way in enumerate(entry_list(entries.get("pedestrian"), f"{where}.pedestrian")):
        walks.append(_read_pedestrian(way, f"{where}.pedestrian[{i}]"))
    obstacles = {ObstacleKind.CONES: ("cones",), ObstacleKind.PEDESTRIANS: ("pedestrian",)}
    needed = obstacles.get(SPECIAL_TYPES[kind], ("stopped_vehicle", "stopped_bus"))
    if not any(entry_list(entries.get(key), f"{where}.{key}") for key in needed):
        raise ScenarioError(f"{where} is of type {kind} but has no {' or '.join(needed)}")
    return SpecialScenario(
        type=kind,
        config=code,
        stopped_vehicles=_points(entries, "stopped_vehicle", where, 3),
        stopped_buses=_points(entries, "stopped_bus", where, 3),
        cones=_points(entries, "cones", where),
        pedestrians=tuple(walks),
        spawn_roadblocks=_points(entries, _SPAWN_ROADBLOCKS, where)
        if _SPAWN_ROADBLOCKS in entries
        else None,
    )


def _points(
    entries: Mapping[str, Any], key: str, where: str, size: int = 2
) -> tuple[tuple[float, ...], ...]:
    found = entry_list(entries.get(key), f"{where}.{key}")
    return tuple(numbers(point, size, f"{where}.{key}[{i}]") for i, point in enumerate(found))


def _read_agent(value: Any, where: str) -> ExtraAgent:
    items = entry_list(value, where)
    options: Mapping[str, Any] = {}
    if len(items) == 4:
        options = mapping_of(items[3], f"{where}[3]")
        unknown_fields(options, ("behavior", "snap"), f"{where}[3]")
    x, y, speed = numbers(items[:3] if options else items, 3, where)
    behavior = options.get("behavior", "cautious")
    if behavior not in ("cautious", "default"):
        raise ScenarioError(f"{where}[3].behavior is {behavior!r}; expected cautious or default")
    snap = boolean(options.get("snap", False), f"{where}[3].snap")
    return ExtraAgent(x, y, speed, behavior == "cautious", snap)


def _read_pedestrian(value: Any, where: str) -> PedestrianPath:
    items = entry_list(value, where)
    if len(items) != 5:
        raise ScenarioError(
            f"{where} is {value!r}; expected [x0, y0, x1, y1, start iteration or null]"
        )
    x0, y0, x1, y1 = numbers(items[:4], 4, where)
    begin = None if is_null(items[4]) else number(items[4], f"{where}[4]")
    if begin is not None and (begin < 0 or begin != int(begin)):
        raise ScenarioError(f"{where}[4] is {items[4]!r}; expected an iteration or null")
    # As published, iteration 0 counts as "not given".
    return PedestrianPath((x0, y0), (x1, y1), int(begin) if begin else None)
