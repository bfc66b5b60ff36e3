"""Many scenes through one program: chunks, threads, devices, groups, stored programs."""

import dataclasses
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import batching_child
from spdm_jax import ScenarioSet, batching, from_raw
from spdm_jax.batching import (
    MAX_GROUPS,
    BatchConfig,
    SceneRunner,
    group_by_shape,
    padded_bytes,
    prefetch,
)
from spdm_jax.compile_cache import ENVIRONMENT_VARIABLE
from spdm_jax.padding import PaddingConfig, sizes_of
from spdm_jax.programs import program
from spdm_jax.schema import LEAVES
from spdm_jax.synthetic import make_scene

CHILD = Path(batching_child.__file__)


@pytest.fixture(scope="module")
def scenes() -> ScenarioSet:
    return from_raw(make_scene(name) for name in ("straight", "curve", "open_road"))


def describe(scene, mine, shared, static):
    """Something of the scene, of the entry, of the settings; cheap to compile."""
    way = jnp.cumsum(jnp.hypot(jnp.diff(scene.ego.x), jnp.diff(scene.ego.y)))
    factor = 1.0 if mine is None else mine["factor"]
    return {"way": way * factor + shared["offset"] * static, "tracks": jnp.sum(scene.tracks.valid)}


OFFSET = {"offset": 2.0}


def expected(scenes: ScenarioSet, row: int, factor: float, static: float) -> np.ndarray:
    x, y = (np.asarray(v)[row] for v in (scenes.batch.ego.x, scenes.batch.ego.y))
    return np.cumsum(np.hypot(np.diff(x), np.diff(y))) * factor + 2.0 * static


def test_runs_every_scene(scenes: ScenarioSet):
    mine = {"factor": np.array([1.0, 2.0, 3.0])}
    found = SceneRunner(describe, 3.0, precision="f64")(scenes.batch, mine, OFFSET)
    for row in range(3):
        np.testing.assert_allclose(found["way"][row], expected(scenes, row, row + 1.0, 3.0))
    np.testing.assert_array_equal(found["tracks"], scenes.batch.tracks.valid.sum(axis=(1, 2)))
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("precision, dtype", [("f32", np.float32), ("f64", np.float64)])
def test_precision_is_that_of_the_runner(scenes: ScenarioSet, precision: Any, dtype: type):
    found = SceneRunner(describe, 1.0, precision=precision)(scenes.batch, None, OFFSET)
    assert found["way"].dtype == dtype


def test_threads_and_company_change_no_bit(scenes: ScenarioSet):
    runs = [
        SceneRunner(describe, 1.0, config=BatchConfig(threads=n))(scenes.batch, None, OFFSET)["way"]
        for n in (1, 2, 3)
    ]
    alone = jax.tree.map(lambda leaf: leaf[1:2], scenes.batch)
    one = SceneRunner(describe, 1.0)(alone, None, OFFSET)["way"]
    for run in runs:
        assert run.tobytes() == runs[0].tobytes()
        assert run[1].tobytes() == one[0].tobytes()


def test_several_entries_of_one_scene(scenes: ScenarioSet):
    scene_of = np.array([2, 0, 2, 2])
    mine = {"factor": np.arange(4.0)}
    run = SceneRunner(describe, 0.0, precision="f64")
    found = run(scenes.batch, mine, OFFSET, scene_of=scene_of)["way"]
    for row, scene in enumerate(scene_of):
        np.testing.assert_allclose(found[row], expected(scenes, scene, float(row), 0.0), atol=1e-12)


def test_programs_are_made_once_and_counted(scenes: ScenarioSet):
    run = SceneRunner(describe, 7.0)
    run(scenes.batch, None, OFFSET)
    assert (run.stats.programs, run.stats.scenes) == (1, 3)
    assert run.stats.compile_s > 0 and run.stats.run_s > 0
    run(scenes.batch, None, {"offset": 5.0})
    run(jax.tree.map(lambda leaf: leaf[:2], scenes.batch), None, OFFSET)
    assert (run.stats.programs, run.stats.scenes) == (1, 8)
    again = SceneRunner(describe, 7.0)
    again(scenes.batch, None, OFFSET)
    assert again.stats.programs == 0
    other = SceneRunner(describe, 8.0)
    other(scenes.batch, None, OFFSET)
    assert other.stats.programs == 1


def test_warmup_leaves_nothing_to_compile(scenes: ScenarioSet):
    run = SceneRunner(describe, 9.0)
    assert run.warmup(scenes.batch, None, OFFSET) > 0
    assert (run.stats.programs, run.stats.scenes, run.stats.run_s) == (1, 0, 0.0)
    run(scenes.batch, None, OFFSET)
    assert run.stats.programs == 1
    assert run.warmup(scenes.batch, None, OFFSET) == 0


def fails(scene, mine, shared, static):
    raise ValueError(f"no {static}")


def test_errors_of_the_function_come_through(scenes: ScenarioSet):
    with pytest.raises(ValueError, match="no luck"):
        SceneRunner(fails, "luck")(scenes.batch)


@pytest.mark.parametrize("field", ["chunk", "memory", "devices", "threads"])
def test_senseless_settings_are_refused(field: str):
    with pytest.raises(ValueError, match=f"{field} is 0; it must be at least 1"):
        BatchConfig(**{field: 0})
    with pytest.raises(ValueError, match="precision is 'f16'"):
        SceneRunner(describe, precision="f16")  # type: ignore[arg-type]


def child(mode: str, devices: int, cache: Path | str, *arguments: str) -> dict[str, Any]:
    """Runs `batching_child.py` in a process of its own and returns what it prints."""
    environment = {
        **os.environ,
        "JAX_NUM_CPU_DEVICES": str(devices),
        "JAX_ENABLE_X64": "0",
        ENVIRONMENT_VARIABLE: str(cache),
    }
    run = subprocess.run(
        [sys.executable, str(CHILD), mode, *arguments],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("what", ["length", pytest.param("score", marks=pytest.mark.slow)])
def test_two_devices_give_the_results_of_one(what: str):
    found = child("devices", 2, os.environ[ENVIRONMENT_VARIABLE], what)
    assert found["devices"] == 2
    assert found["arrangement"] == "2 devices, each its share as one loop"
    # On the same devices nothing depends on the chunk.
    assert found["chunks_equal"]
    assert found["discrete_equal"]
    assert found["largest_difference"] < 1e-4  # m; programs of other shape round differently


def test_out_of_memory_halves_the_chunk():
    found = child("memory", 2, "off")
    assert found["messages"] == [
        "out of device memory with 8 scenes per call; continuing with 4",
        "out of device memory with 4 scenes per call; continuing with 2",
    ]
    assert found["equal"] and found["chunk"] == 2


def test_double_precision_needs_no_setting():
    """Elsewhere in these tests 64-bit types are on for the whole process."""
    found = child("double", 1, "off")
    assert found["types"] == ["float64", "float64"]
    assert found["digits"] < 1e-9


def test_stored_programs_start_a_new_process(tmp_path: Path):
    first = child("stored", 1, tmp_path)
    assert not first["stored"]
    second = child("stored", 1, tmp_path)
    assert second["stored"]
    assert second["result"] == first["result"]
    names = list(tmp_path.rglob("programs/*"))
    assert len(names) == 2 and names[0].samefile(names[1])  # by its source, and by its text
    by_source = next(name for name in names if "-" not in name.name)
    by_source.unlink()
    edited = child("stored", 1, tmp_path)  # as after a change of the source
    assert edited["stored"] and edited["result"] == first["result"]
    by_source.write_bytes(by_source.read_bytes()[:1000])
    third = child("stored", 1, tmp_path)  # a damaged program is made anew
    assert not third["stored"] and third["result"] == first["result"]
    other = child("stored", 1, tmp_path, "2.5")  # another setting is another program
    assert not other["stored"] and other["result"] != first["result"]


def thrice(values):
    return 3 * values["read"]


def test_stored_program_is_not_taken_for_one_with_other_arguments():
    """What a function does not read is not in its text, but counts where it is called."""
    make, device = lambda: jax.jit(thrice), jax.devices()[:1]
    before, after = {"also": np.zeros(3)}, {"unread": np.zeros(4)}
    for values in ({**before, "read": np.ones(2)}, {"read": np.ones(2), **after}):
        made, _ = program("twins", thrice, make, (values,), device)
        np.testing.assert_array_equal(made.call(values), 3 * values["read"])


def own_sizes(scenes: ScenarioSet) -> list[dict[str, int]]:
    rows = range(len(scenes))
    return [sizes_of(jax.tree.map(lambda leaf, i=i: leaf[i], scenes.batch)) for i in rows]


def test_padded_bytes_are_those_of_the_arrays(scenes: ScenarioSet):
    one = jax.tree.map(lambda leaf: leaf[0], scenes.batch)
    assert padded_bytes(sizes_of(one)) == sum(np.asarray(v).nbytes for v in jax.tree.leaves(one))


def test_scenes_of_one_size_make_one_group(scenes: ScenarioSet):
    (group,) = group_by_shape(own_sizes(scenes))
    assert group.rows == [0, 1, 2]


@given(st.lists(st.floats(1, 400), min_size=1, max_size=20))
def test_groups_hold_everybody_and_are_few(factors: list[float]):
    axes = {axis for leaf in LEAVES.values() for axis in leaf.axes if isinstance(axis, str)}
    largest = {axis: max(sizes) for axis, sizes in dataclasses.asdict(PaddingConfig()).items()}
    sizes = [{axis: min(int(n * 40), largest.get(axis, 10**9)) for axis in axes} for n in factors]
    groups = group_by_shape(sizes)
    assert 1 <= len(groups) <= MAX_GROUPS
    assert sorted(i for group in groups for i in group.rows) == list(range(len(sizes)))
    for group in groups:
        assert group.rows == sorted(group.rows)
        for axis, (size,) in dataclasses.asdict(group.padding).items():
            assert size >= max(sizes[i][axis] for i in group.rows)


def test_a_large_scene_does_not_blow_up_the_small_ones(scenes: ScenarioSet):
    small = own_sizes(scenes)
    large = {**small[0], "grid_cells": 8_000_000, "grid_rows": 400_000, "grid_edges": 900_000}
    groups = group_by_shape([*small, large])
    assert [group.rows for group in groups] == [[0, 1, 2], [3]]
    (together,) = group_by_shape([*small, large], waste=1e6)
    assert together.rows == [0, 1, 2, 3]


def test_prefetch_keeps_the_order_and_works_ahead():
    started: list[int] = []
    first_may_end = threading.Event()

    def make(item: int) -> int:
        started.append(item)
        if item == 0:
            assert first_may_end.wait(10)
        return -item

    ahead = prefetch(make, range(6), threads=2)
    threading.Timer(0.2, first_may_end.set).start()
    assert next(ahead) == 0  # though the second one was ready before
    assert sorted(started)[:2] == [0, 1] and len(started) <= 3
    assert list(ahead) == [-1, -2, -3, -4, -5]


def test_prefetch_raises_what_a_thread_raises():
    ahead = prefetch(lambda item: 1 // item, [1, 0, 1])
    assert next(ahead) == 1
    with pytest.raises(ZeroDivisionError):
        next(ahead)


def test_prefetch_ends_its_threads_when_left():
    before, made = threading.active_count(), []
    for item in prefetch(lambda item: made.append(item) or item, range(100)):
        if item == 2:
            break
    assert threading.active_count() == before and len(made) < 10


def test_cores_are_those_of_the_process():
    assert 1 <= batching.usable_cores() <= (os.cpu_count() or 1)
