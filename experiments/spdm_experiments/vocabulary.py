"""`spdm vocab build`: a k-means vocabulary from recorded drives or from proposals."""

import io
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct

from spdm_experiments.chunks import scenario_files, suite_name
from spdm_experiments.inventory import UNREADABLE, Entry, Inventory, split, take_inventory
from spdm_experiments.label_folder import digest
from spdm_experiments.loading import Loader
from spdm_experiments.options import Vocab
from spdm_experiments.record import REASONS
from spdm_experiments.runtime import configure_jax, now, provenance
from spdm_experiments.sweep_scene import UNREAD
from spdm_experiments.terminal import print_files, progress_line, reasons
from spdm_jax import planner, spdm
from spdm_jax.batching import SceneRunner, group_by_shape, padded_bytes, prefetch
from spdm_jax.config import NUM_STATES, PlannerConfig, PlannerParams
from spdm_jax.io.archive import METADATA, members_of, stored_array, unpack
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.scenario_file import write_atomically
from spdm_jax.padding import PATH_ROOM, bucket
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import Array, EgoState, Scenario
from spdm_jax.vocabulary import Vocabulary, build_vocabulary, ego_futures, in_ego_frame

MEMORY = 128 * 2**20
"""Bytes that the scenes of one call may take; three such sets are in memory at a time."""


def run_build(options: Vocab) -> bool:
    """Builds a vocabulary; returns False if a scenario could not be used.

    Raises:
      ValueError: options or files are of no use, or there are too few different trajectories.
    """
    if options.destination.suffix != ".npy":
        raise ValueError(f"{options.destination}: the file to write must end in .npy")
    if not 1 <= options.size <= options.sample:
        raise ValueError(
            f"--size is {options.size}; it must be from 1 to --sample, which is {options.sample}"
        )
    inventory = take_inventory(scenario_files(options.source, options.limit))
    if not inventory.entries:
        raise ScenarioError(f"{options.source}: no usable scenario: {inventory.failures[0].reason}")
    configure_jax(options)
    started = time.perf_counter()
    failed = {failure.token: failure.reason for failure in inventory.failures}
    if options.origin == "logs":
        source = _futures(inventory, failed)
    else:
        source = _proposals(options, inventory, failed)
    pool: list[np.ndarray] = []
    with progress_line("reading", len(inventory.entries)) as advance:
        for trajectories in source:
            pool.append(trajectories.astype(np.float32))
            advance(len(pool))
    every = np.concatenate(pool)
    collected = len(every)
    if collected > options.sample:
        drawn = np.random.default_rng(options.seed).permutation(collected)[: options.sample]
        every = every[np.sort(drawn)]
    gathered = time.perf_counter()
    found = _cluster(every, options)
    about = {
        "command": "vocab build",
        "suite": suite_name(options.source, sorted({entry.source for entry in inventory.entries})),
        "scenes": str(options.source),
        "num_scenarios": len(inventory),
        "input_hash": inventory.digest,
        "from": options.origin,
        **({"num_proposals": options.num_proposals} if options.origin == "proposals" else {}),
        "size": options.size,
        "seed": options.seed,
        "sample": options.sample,
        "num_collected": collected,
        "num_clustered": found.num_trajectories,
        "num_distinct": found.num_distinct,
        "iterations": found.iterations,
        "converged": found.converged,
        "inertia": found.inertia,
        "rms_distance": found.inertia**0.5,
        "largest_distance": found.largest,
        "sizes": found.sizes.tolist(),
        "hash": digest(found.trajectories),
        "gather_s": round(gathered - started, 3),
        "cluster_s": round(time.perf_counter() - gathered, 3),
        "failures": failed,
        **provenance(),
        "created": now(),
    }
    written = _write(options, found, about)
    usable = len(inventory) - len(failed)
    print(
        f"{options.size} clusters of {found.num_trajectories} trajectories "
        f"({collected} in {usable} scenarios, {found.num_distinct} different ones clustered)"
    )
    print(
        f"distance to the centre: {found.inertia**0.5:.3f} m (root mean square), worst trajectory "
        f"{found.largest:.2f} m; inertia {found.inertia:.5f} m^2 after {found.iterations} rounds"
    )
    print(
        f"cluster sizes: {found.sizes[0]} to {found.sizes[-1]}, median "
        f"{int(np.median(found.sizes))}"
    )
    for reason in reasons(failed, written[1]):
        print(reason)
    print_files(written)
    return not failed


def _cluster(trajectories: np.ndarray, options: Vocab) -> Vocabulary:
    shown = time.perf_counter()

    def tell(stage: str, done: int, most: int) -> None:
        nonlocal shown
        if time.perf_counter() - shown > 10:
            shown = time.perf_counter()
            what = {"seeding": "first centres", "rounds": "rounds of at most"}[stage]
            print(f"clustering {len(trajectories)}: {done} {what} {most}", file=sys.stderr)

    return build_vocabulary(trajectories, options.size, options.seed, progress=tell)


def _futures(inventory: Inventory, failed: dict[str, str]) -> Iterator[np.ndarray]:
    """Yields the futures of every step of each scenario file; steps that overlap count once."""
    seen: dict[str, set[int]] = {}
    for entry in inventory.entries:
        try:
            ego, valid, time_us = _read_ego(entry)
        except UNREADABLE as error:
            failed[entry.token] = f"{entry.path}: damaged scenario file ({error}); pack it again"
            yield np.zeros((0, NUM_STATES, 3))
            continue
        futures, steps = ego_futures(ego, valid)
        # Generated scenes share one log name and clock.
        log = entry.token if entry.source == "synthetic" else entry.log_name
        known = seen.setdefault(log, set())
        new = [step for step in steps.tolist() if int(time_us[step]) not in known]
        known.update(time_us[new].tolist())
        yield futures[np.isin(steps, new)]


def _read_ego(entry: Entry) -> tuple[EgoState, np.ndarray, np.ndarray]:
    """Returns the recorded ego, its validity and the source's clock in microseconds."""
    file = io.BytesIO(entry.path.read_bytes())
    members = members_of(file)
    read = lambda name: stored_array(file, members[f"{name}.npy"])
    ego = EgoState(**{name: read(f"ego.{name}") for name in STATE_COLUMNS})
    began = json.loads(unpack(file, members[METADATA]))["info"]["iteration0_time_us"]
    time_us = began + np.rint(1e6 * read("time")).astype(np.int64)
    return ego, read("ego_valid"), time_us


class Tracked(struct.PyTreeNode, kw_only=True):
    """Proposals of one scene as they are driven.

    Attributes:
      poses: `[P, 41, 3]`, local frame.
      valid: `[P]` bool.
      overflow: `[]` bool, a fixed buffer was too small.
    """

    poses: Array
    valid: Array
    overflow: Array


def track_proposals(
    scene: Scenario, mine: None, params: PlannerParams, config: PlannerConfig
) -> Tracked:
    """Plans once at iteration 0 (pure)."""
    found = planner.plan(scene, params, config)
    driven = found.tracked
    return Tracked(
        poses=jnp.stack([driven.x, driven.y, driven.heading], axis=-1),
        valid=found.proposals.valid,
        overflow=found.overflow,
    )


def _proposals(
    options: Vocab, inventory: Inventory, failed: dict[str, str]
) -> Iterator[np.ndarray]:
    """Yields the tracked proposals of scenario after scenario."""
    spec = spdm(options.num_proposals)
    for group in group_by_shape([entry.sizes for entry in inventory.entries]):
        entries = [inventory.entries[row] for row in group.rows]
        room = bucket(max(entry.route_points for entry in entries), PATH_ROOM)
        config = replace(spec.config, max_path_points=room)
        run = SceneRunner(track_proposals, config, precision=options.precision)
        each = padded_bytes({axis: sizes[0] for axis, sizes in vars(group.padding).items()})
        runs = split(len(entries), max(1, MEMORY // each))
        loader, padding = Loader(unread=UNREAD), group.padding
        parts = [[entries[i] for i in rows] for rows in runs]
        for scenes in prefetch(partial(loader.load, padding=padding), parts):
            for failure, _ in scenes.failures:
                failed[failure.token] = failure.reason
                yield np.zeros((0, NUM_STATES, 3))
            if scenes.batch is None:
                continue
            found = run(scenes.batch, None, spec.params)
            scenes.release()
            for row, entry in enumerate(scenes.entries):
                poses = found.poses[row][found.valid[row]]
                finite = np.isfinite(poses).all()
                if found.overflow[row] or not finite:
                    failed[entry.token] = REASONS["failed" if not finite else "overflow"]
                    poses = poses[:0]
                yield in_ego_frame(poses.astype(np.float64))


def _write(options: Vocab, found: Vocabulary, about: dict[str, Any]) -> list[Path]:
    """Writes the vocabulary and what is to be said of it."""
    target = options.destination
    target.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.save(buffer, found.trajectories)
    write_atomically(target, buffer.getvalue())
    beside = target.with_suffix(".json")
    write_atomically(beside, (json.dumps(about, indent=1) + "\n").encode())
    return [target, beside]
