"""The extras of an interPlan scenario as the arrays that its simulation reads (host)."""

import zlib
from collections.abc import Sequence

import numpy as np

from spdm_jax.interplan.extras import InterplanExtras
from spdm_jax.simulation.script import AgentPolicy, Script


def script_of(
    extras: InterplanExtras,
    track_ids: Sequence[str],
    origin: np.ndarray,
    *,
    num_tracks: int,
    num_pedestrians: int,
    num_points: int,
) -> Script:
    """Lays a scenario's extras out as arrays of fixed size (host, float64).

    Args:
      extras: of the scenario.
      track_ids: source ids of the scenario's tracks, row by row.
      origin: `[2]` map coordinates of the local frame's origin.
      num_tracks: A of the padded scenario.
      num_pedestrians: P.
      num_points: M.

    Raises:
      ValueError: something does not fit, or a track is not in the scenario.
    """
    waiting = [who for who in extras.pedestrians if who.begins_at is None]
    for name, count, room in (
        ("tracks", len(track_ids), num_tracks),
        ("pedestrians", len(waiting), num_pedestrians),
        ("points of the course", len(extras.course), num_points),
    ):
        if count > room:
            raise ValueError(f"scenario {extras.name}: {count} {name} do not fit into {room}")
    row_of = {track: row for row, track in enumerate(track_ids)}

    def flags(tracks: tuple[str, ...]) -> np.ndarray:
        flagged = np.zeros(num_tracks, bool)
        flagged[[row_of[track] for track in tracks]] = True
        return flagged

    def local(points: list[tuple[float, float]], room: int) -> np.ndarray:
        found = np.array(points, float).reshape(-1, 2) - origin
        return np.pad(
            found, ((0, room - len(found)), (0, 0)), mode="edge" if len(found) else "constant"
        )

    named = {who.track for who in waiting} | {*extras.stopped, *extras.cautious}
    if missing := named - set(row_of):
        raise ValueError(f"scenario {extras.name} has no track {sorted(missing)}")
    track = np.full(num_pedestrians, -1, np.int32)
    track[: len(waiting)] = [row_of[who.track] for who in waiting]
    return Script(
        policy=np.array(AgentPolicy[extras.policy.name], np.int32),
        seed=np.array(zlib.crc32(extras.name.encode()), np.uint32),
        stopped=flags(extras.stopped),
        cautious=flags(extras.cautious),
        track=track,
        start=local([who.start for who in waiting], num_pedestrians),
        stop=local([who.end for who in waiting], num_pedestrians),
        course=local(list(extras.course), num_points),
        end=np.array(extras.end),
    )
