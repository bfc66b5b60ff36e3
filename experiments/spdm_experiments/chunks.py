"""Goes through a folder of scenario files in chunks of one shape, so that one program serves all.

A nuPlan scene takes some 100 MB of host memory once it is padded: a benchmark does not fit. The
files are read twice, once for their sizes and once, chunk by chunk, to compute.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

from spdm_jax import Failure, PlanSet, ScenarioSet, ScoreSet, load
from spdm_jax.io.raw import ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.padding import PaddingConfig, bucket, sizes_of
from spdm_jax.types import Scenario

Scored = TypeVar("Scored", bound=ScoreSet)


@dataclass(frozen=True)
class Survey:
    """What a first look at the files of a run found.

    Attributes:
      paths: files that can be used, in the order of their names.
      tokens: their scenarios.
      places: their places among all files, those that failed included.
      num_files: all files.
      sources: data sets that the scenarios come from.
      padding: one size per axis, which holds every scenario.
      longest: the file with the longest route, as an index into `paths`.
      failures: files that cannot be used, and why.
    """

    paths: list[Path]
    tokens: list[str]
    places: list[int]
    num_files: int
    sources: list[str]
    padding: PaddingConfig
    longest: int
    failures: list[Failure]


def scenario_files(source: Path, limit: int | None = None) -> list[Path]:
    """Lists scenario files.

    Args:
      source: a folder, or one file.
      limit: at most so many; None for all.

    Raises:
      ValueError: there is none, or `limit` is no count.
    """
    if limit is not None and limit < 1:
        raise ValueError(f"--limit is {limit}; it must be at least 1")
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise ValueError(f"{source}: no such file or folder")
    files = sorted(source.glob("*.npz"))
    if not files:
        raise ValueError(f"{source}: no .npz scenario files; write them with: spdm pack SRC DST")
    return files[:limit]


def survey(files: Sequence[Path], allowed: PaddingConfig | None = None) -> Survey:
    """Reads every file once for its sizes.

    Args:
      files: scenario files.
      allowed: bucket sizes; the defaults if None.

    Raises:
      ScenarioError: no file can be used, or two hold the same scenario.
    """
    paths, tokens, places, points, failures = [], [], [], [], []
    sources: set[str] = set()
    buckets = dataclasses.asdict(allowed or PaddingConfig())
    common = dict.fromkeys(buckets, 0)
    for place, path in enumerate(files):
        try:
            scenario, info = read_scenario(path)
            fitting = _buckets_of(scenario, buckets)
        except (ValueError, OSError) as error:
            failures.append(Failure(path.stem, str(error)))
            continue
        if info.token in tokens:
            other = paths[tokens.index(info.token)]
            raise ScenarioError(f"{path}: holds scenario {info.token!r}, and so does {other}")
        common = {axis: max(common[axis], fitting[axis]) for axis in common}
        paths.append(path)
        tokens.append(info.token)
        places.append(place)
        points.append(_longest_route(scenario))
        sources.add(info.source)
    if not paths:
        raise ScenarioError(f"{files[0]}: no usable scenario: {failures[0].reason}")
    return Survey(
        paths=paths,
        tokens=tokens,
        places=places,
        num_files=len(files),
        sources=sorted(sources),
        padding=PaddingConfig(**{axis: (size,) for axis, size in common.items()}),
        longest=int(np.argmax(points)),
        failures=failures,
    )


def _buckets_of(scenario: Scenario, buckets: dict[str, tuple[int, ...]]) -> dict[str, int]:
    sizes = sizes_of(scenario)
    for axis, allowed in buckets.items():
        if sizes[axis] > max(allowed):
            raise ScenarioError(
                f"{sizes[axis]} {axis}, the library's largest bucket is {max(allowed)}. Use the "
                f"Python API with a larger PaddingConfig.{axis}; nothing was truncated."
            )
    return {axis: bucket(sizes[axis], allowed) for axis, allowed in buckets.items()}


def _longest_route(scenario: Scenario) -> int:
    """Points of the longest lane sequence that a plan may follow."""
    count = np.append(scenario.map.lanes.centerline.count, 0)  # the appended entry serves -1
    route = scenario.route
    sequences = (route.centerline_lanes, route.goal_lanes, route.branch_lanes)
    return max((int(count[s].sum(axis=1).max()) for s in sequences if len(s)), default=0)


def suite_name(source: Path, readers: Sequence[str]) -> str:
    """Names the scenes of a run by what they are, so that no folder's name passes for a suite."""
    kinds = {"synthetic": "built-in scenes", "nuplan": "nuPlan format", "av2": "Argoverse 2"}
    return f"{source} ({', '.join(kinds.get(reader, reader) for reader in readers)})"


def num_chunks(count: int, size: int) -> int:
    """Returns how many chunks `count` scenarios make.

    Raises:
      ValueError: `size` is too small.
    """
    if size < 2:
        raise ValueError(f"--chunk is {size}; it must be at least 2")
    # A chunk of many keeps one row for the longest route.
    return 1 if count <= size else -(-count // (size - 1))


def chunks(found: Survey, size: int) -> Iterator[tuple[list[int], ScenarioSet]]:
    """Reads the scenarios chunk by chunk, all chunks of one shape.

    Plans size their path buffers by the longest route of the set they are given. So that all
    chunks get buffers of one size, each holds the scenario with the longest route; copies of it
    also fill the last chunk up.

    Args:
      found: files, from `survey`.
      size: scenarios per chunk at most.

    Yields:
      Indices into `found.paths`, and a set whose first rows are those scenarios; rows beyond are
      to be dropped (`keep`).

    Raises:
      ScenarioError: a file changed since the survey.
    """
    count = len(found.paths)
    parts = np.array_split(np.arange(count), num_chunks(count, size))
    rows_per_chunk = count if len(parts) == 1 else len(parts[0]) + 1
    for part in parts:
        wanted = part.tolist()
        if found.longest not in wanted:
            wanted.append(found.longest)
        scenes = load([found.paths[i] for i in wanted], padding=found.padding)
        if scenes.failures:
            changed = scenes.failures[0]
            raise ScenarioError(f"{changed.token}: changed while it was in use: {changed.reason}")
        filler = wanted.index(found.longest)
        rows = [*range(len(part)), *[filler] * (rows_per_chunk - len(part))]
        yield part.tolist(), _take_scenes(scenes, rows)


def _take_scenes(scenes: ScenarioSet, rows: list[int]) -> ScenarioSet:
    if rows == list(range(len(scenes))):
        return scenes
    batch = jax.tree.map(lambda leaf: leaf[np.array(rows)], scenes.batch)
    return ScenarioSet(batch, [scenes.infos[i] for i in rows])


def head(scenes: ScenarioSet, count: int) -> ScenarioSet:
    """Returns the first scenarios of a set."""
    return _take_scenes(scenes, list(range(count)))


def keep(result: Scored, count: int) -> Scored:
    """Returns the first scenarios of a result."""
    changes = {
        name: jax.tree.map(lambda leaf: leaf[:count], getattr(result, name))
        for name in ("scores", "tracked", "forecast", "overflow")
    }
    if isinstance(result, PlanSet):
        changes["plans"] = jax.tree.map(lambda leaf: leaf[:count], result.plans)
    return dataclasses.replace(result, infos=result.infos[:count], failures=[], **changes)
