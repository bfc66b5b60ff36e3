"""interPlan's scenarios in a simulation: their extras, the scripts of a chunk, and the verdicts."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from spdm_experiments.inventory import Entry, Inventory
from spdm_experiments.loading import LoadedScenes
from spdm_experiments.simulate_points import Point
from spdm_experiments.simulate_scene import Result
from spdm_jax import Failure
from spdm_jax.interplan.extras import (
    EXTRAS_SUFFIX,
    InterplanExtras,
    extras_path,
    has_code,
    read_extras,
)
from spdm_jax.interplan.score import InterplanMetrics, judge
from spdm_jax.interplan.script import script_of
from spdm_jax.io.archive import METADATA, members_of, unpack
from spdm_jax.io.raw import ScenarioError
from spdm_jax.metrics import Expert
from spdm_jax.simulation.script import Script

Extras = Mapping[str, InterplanExtras]
"""Of the scenarios that have them, by token."""


@dataclass(frozen=True)
class ScriptRoom:
    """Sizes of the arrays of a script.

    Attributes:
      pedestrians: that wait for the ego.
      points: of the course.
    """

    pedestrians: int
    points: int


def find_extras(inventory: Inventory) -> tuple[Inventory, Extras]:
    """Reads what lies beside the scenario files.

    Returns:
      The inventory, whose digest knows of the extras and whose failures name scenarios that lack
      theirs or do not fit them; and the extras.
    """
    found: dict[str, InterplanExtras] = {}
    failures = list(inventory.failures)
    digest = hashlib.sha256(inventory.digest.encode())
    entries = []
    for entry in inventory.entries:
        path = extras_path(entry.path)
        try:
            if path.exists():
                digest.update(path.name.encode() + b"\0" + path.read_bytes())
                found[entry.token] = _read(entry)
            elif has_code(entry.token):
                raise ScenarioError(
                    f"{entry.path}: an interPlan scenario without {path.name} beside it; pack it "
                    "again with --interplan"
                )
        except (ScenarioError, OSError) as error:
            failures.append(Failure(entry.token, str(error)))
        else:
            entries.append(entry)
    if not found and len(entries) == len(inventory.entries):
        return inventory, {}
    changed = dataclasses.replace(
        inventory, entries=entries, failures=failures, digest=digest.hexdigest()
    )
    return changed, found


def _read(entry: Entry) -> InterplanExtras:
    """Reads one scenario's extras.

    Raises:
      ScenarioError: they are damaged, or of another scenario.
    """
    path = extras_path(entry.path)
    extras = read_extras(path)
    with open(entry.path, "rb") as file:
        tracks = json.loads(unpack(file, members_of(file)[METADATA]))["info"]["track_ids"]
    named = {*extras.stopped, *extras.cautious, *(who.track for who in extras.pedestrians)}
    if extras.name != entry.token or not named <= {*tracks}:
        raise ScenarioError(
            f"{path}: is of scenario {extras.name!r} and does not fit {entry.path.name}; pack both "
            "again with --interplan"
        )
    return extras


def check_points(extras: Extras, points: Sequence[Point]) -> None:
    """Refuses simulations that make no sense of changed scenarios.

    Raises:
      ValueError: the record is to be repeated, but their vehicles are in none.
    """
    if not extras:
        return
    for point in points:
        wish = (
            "--mode open"
            if point.mode == "open"
            else "--traffic replay"
            if point.traffic == "replay"
            else "--forecast perfect"
            if point.settings.get("forecast") == "perfect"
            else None
        )
        if wish:
            raise ValueError(
                f"{wish} repeats the record, and the vehicles that interPlan adds have none after "
                f"iteration 0; {len(extras)} scenarios have a *{EXTRAS_SUFFIX} file beside them, "
                f"the first is {next(iter(extras))}. Leave the option out, or simulate them in a "
                "folder of their own"
            )


def room_of(extras: Sequence[InterplanExtras]) -> ScriptRoom:
    """Returns room for the scripts of scenarios that share a program; sizes are powers of 2."""
    waiting = (sum(who.begins_at is None for who in one.pedestrians) for one in extras)
    points = (len(one.course) for one in extras)
    room = lambda count, least: max(least, 1 << (count - 1).bit_length())
    return ScriptRoom(room(max(waiting), 4), room(max(points), 512))


def scripts_of(extras: Extras, scenes: LoadedScenes, room: ScriptRoom) -> Script:
    """Returns the scripts of loaded scenes, all of which have extras; leaves `[B, ...]`."""
    assert scenes.batch is not None
    scripts = [
        script_of(
            extras[entry.token],
            track_ids,
            origin,
            num_tracks=scenes.batch.tracks.type.shape[1],
            num_pedestrians=room.pedestrians,
            num_points=room.points,
        )
        for entry, track_ids, origin in zip(
            scenes.entries, scenes.track_ids, scenes.origins, strict=True
        )
    ]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scripts)


def verdicts_of(extras: Extras, scenes: LoadedScenes, result: Result) -> list[InterplanMetrics]:
    """Returns interPlan's verdict on the runs of loaded scenes.

    Args:
      extras: of all of them.
      scenes: `[B]`, as they were simulated.
      result: NumPy leaves `[B, ...]`.
    """
    assert scenes.batch is not None and result.expert_lanes is not None
    verdicts = []
    for i, entry in enumerate(scenes.entries):
        pick: Any = lambda tree, i=i: jax.tree.map(lambda leaf: leaf[i], tree)
        scene = pick(scenes.batch)
        window = slice(int(scene.num_history), int(scene.num_history) + entry.num_iterations)
        expert = Expert(
            jax.tree.map(lambda values, at=window: values[at], scene.ego), scene.ego_valid[window]
        )
        verdicts.append(
            judge(
                pick(result.metrics),
                result.expert_lanes[i],
                expert,
                scene.map.lanes,
                scenes.origins[i],
                extras[entry.token],
            )
        )
    return verdicts
