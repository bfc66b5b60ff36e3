"""A run in a process of its own that stops at a chosen moment, so that it can be killed there.

    python sweep_child.py MOMENT COUNT ARGUMENTS...

MOMENT is where to stop ("run" for nowhere, else see `stop_at`) at the COUNT-th time. The process
then says "stopped" and waits. What is computed in a scene is cheap and names the scene.
"""

import sys
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp

from spdm_experiments import cli, grid_run, run_folder, simulate_work, sweep_work
from spdm_experiments.sweep_scene import Poses, Reading
from spdm_jax.results import SCORE_COLUMNS


def cheap_read(scene: Any, mine: None, shared: Any, static: Any) -> Reading:
    """Stands in for the planner: sums of a few arrays and settings, in the same form."""
    counts = shared.num_proposals
    speed = scene.ego.vx[scene.num_history]
    value = 0.01 * speed + shared.params.idm.headway_time + 0 * counts.astype(speed.dtype)
    whole, flag = counts // 2, counts > 0
    poses = None
    if static.poses:
        local = jnp.zeros((len(counts), 41, 3), speed.dtype) + speed
        poses = Poses(reference=local, tracked=2 * local)
    return Reading(
        best=whole,
        stage=whole,
        path=whole,
        policy=whole,
        target_speed=value,
        scores={name: value + i for i, name in enumerate(SCORE_COLUMNS)},
        progress_centerline=value,
        progress_goal=value,
        collision_track=0 * whole,
        ttc_track=0 * whole - 1,
        emergency_brake=flag,
        num_valid=counts,
        mean_total=value,
        finite=flag,
        overflow=speed < 0,
        moved=speed < 0,
        poses=poses,
    )


def stop_at(moment: str, count: int) -> None:
    """Makes this process wait at a moment of its `count`-th chunk (or file)."""
    seen = 0

    def hold(*, half: Path | None = None, content: bytes = b"") -> None:
        nonlocal seen
        seen += 1
        if seen == count:
            if half is not None:
                half.write_bytes(content[: len(content) // 2])
            print("stopped", flush=True)
            sys.stdin.readline()

    folder, local = cast(Any, run_folder), cast(Any, grid_run)
    write, load = folder.write_atomically, local.load_chunk

    def writing(path: Path, content: bytes) -> None:
        if path.suffix == ".parquet" and moment == "half a part":
            hold(half=path.with_name(f".{path.name}.1234.tmp"), content=content)
        if path.suffix == ".parquet" and moment == "trajectories without rows":
            hold()
        write(path, content)
        if path.suffix == ".parquet" and moment == "part without progress":
            hold()

    def loading(*given: Any) -> Any:
        if moment == "load":
            hold()
        return load(*given)

    def held(process: Any) -> Any:
        def processing(self: Any, loaded: Any) -> Any:
            if moment == "compute":
                hold()
            return process(self, loaded)

        return processing

    folder.write_atomically = writing
    local.load_chunk = loading
    for engine in (sweep_work.SweepEngine, simulate_work.SimulateEngine):
        engine.process = held(engine.process)


def main() -> int:
    moment, count, *arguments = sys.argv[1:]
    cast(Any, sweep_work).read_scene = cheap_read
    stop_at(moment, int(count))
    return cli.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
