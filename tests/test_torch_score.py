"""The score inside a PyTorch training loop."""

import copy
import gc
import pickle
import subprocess
import sys
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from jax import monitoring

from spdm_jax import PlannerConfig, PlannerParams, ScenarioSet, from_raw, score
from spdm_jax.synthetic import make_scene
from spdm_jax.torch_bridge import COMPONENTS, TorchScorer, UnusableScene, torch_score
from spdm_jax.torch_bridge import scorer as scorers
from spdm_jax.torch_bridge.held import held_scenes
from spdm_jax.torch_bridge.scorer import from_torch, to_torch
from spdm_jax.torch_bridge.task import Task, differentiated, place
from spdm_jax.trajectories import STATE_COLUMNS, resample, to_ego, to_local, untracked_states
from spdm_jax.types import EgoState

torch = pytest.importorskip("torch", reason="PyTorch is not installed")

SCENES = ("curve", "parked_car", "straight")
TOKENS = [f"{name}-0" for name in SCENES]
COUNT = 16


@pytest.fixture(scope="module")
def scenes() -> ScenarioSet:
    return from_raw(make_scene(name) for name in SCENES)


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    """Four speeds x four curvatures, ego frame, `[16, 41, 3]`."""
    speed = np.repeat([2.0, 6.0, 10.0, 14.0], 4)[:, None]
    bend = np.tile([-0.02, 0.0, 0.01, 0.03], 4)[:, None]
    way = speed * np.arange(41) * 0.1
    safe = np.where(bend == 0, 1, bend)
    x = np.where(bend == 0, way, np.sin(safe * way) / safe)
    y = np.where(bend == 0, 0, (1 - np.cos(safe * way)) / safe)
    return np.stack([x, y, bend * way], axis=-1)


@pytest.fixture(scope="module")
def tensor(poses: np.ndarray) -> Any:
    """`[3, 16, 41, 3]`, other trajectories in every scene."""
    rows = np.stack([poses, poses[::-1], np.roll(poses, 5, axis=0)])
    return torch.from_numpy(rows.astype(np.float32))


@pytest.fixture(scope="module")
def scorer(scenes: ScenarioSet) -> TorchScorer:
    return TorchScorer(scenes, threads=2)


@pytest.fixture(scope="module")
def found(scorer: TorchScorer, tensor: Any) -> dict[str, Any]:
    return scorer(tensor)


@pytest.fixture(scope="module")
def expected(scenes: ScenarioSet, tensor: Any) -> Any:
    return score(scenes, tensor.numpy())


@pytest.mark.parametrize("name", COMPONENTS)
def test_equal_to_score(name: str, found: dict[str, Any], expected: Any):
    values, wanted = found[name], getattr(expected, name)
    assert isinstance(values, torch.Tensor) and values.shape == (3, COUNT)
    assert values.dtype == torch.float32 and values.device.type == "cpu"
    # Poses are placed in float32 here and in float64 there.
    np.testing.assert_allclose(values.numpy(), wanted, rtol=1e-4, atol=2e-4)


def test_scores_differ_between_trajectories(found: dict[str, Any]):
    assert len(found["total"].unique()) > 10
    assert (found["no_at_fault_collision"] == 0).any()


def test_tokens_pick_the_scenes(scorer: TorchScorer, tensor: Any, found: dict[str, Any]):
    order = [2, 0, 2, 1, 0]
    picked = scorer(tensor[order], [TOKENS[i] for i in order])
    for name in COMPONENTS:
        assert torch.equal(picked[name], found[name][order])


def test_result_does_not_depend_on_the_batch(
    scorer: TorchScorer, tensor: Any, found: dict[str, Any]
):
    alone = scorer(tensor[1:2], TOKENS[1:2])
    assert torch.equal(alone["total"], found["total"][1:2])


def test_one_component_is_a_tensor(scenes: ScenarioSet, tensor: Any, found: dict[str, Any]):
    comfort = torch_score(scenes, tensor, component="comfort")
    assert torch.equal(comfort, found["comfort"])
    assert torch.equal(torch_score(scenes, tensor), found["total"])
    some = torch_score(scenes, tensor, TOKENS, component=("progress", "total"))
    assert list(some) == ["progress", "total"]
    assert torch.equal(some["progress"], found["progress"])


@pytest.fixture
def compiled() -> Any:
    """Names of what JAX traces or compiles, as it happens."""
    events: list[str] = []

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event.startswith("/jax/core/compile/"):
            events.append(event)

    monitoring.register_event_duration_secs_listener(listen)
    yield events
    monitoring.unregister_event_duration_listener(listen)


def test_training_steps_compile_nothing(
    scenes: ScenarioSet, tensor: Any, found: dict[str, Any], compiled: list[str]
):
    mine = TorchScorer(scenes)
    totals, step = [], 0
    for step in range(4):
        order = [step % 3, (step + 1) % 3]
        moved = tensor[order] + 0.01 * step
        tokens = [TOKENS[i] for i in order]
        totals.append(mine(moved, tokens)["total"])
        torch_score(scenes, moved, tokens, component=("comfort", "progress"))
    assert not compiled
    assert mine.programs == 0  # those of the other scorers serve
    assert len({float(total.sum()) for total in totals}) == 4
    jax.jit(lambda x: x + step)(1.0)
    assert compiled  # else the test shows nothing


def test_values_of_parameters_compile_nothing(
    scenes: ScenarioSet, tensor: Any, found: dict[str, Any], compiled: list[str]
):
    params = PlannerParams()
    lazy = params.replace(scoring=params.scoring.replace(progress_weight=0.0))
    totals = torch_score(scenes, tensor, params=lazy)
    wanted = (5 * found["time_to_collision"] + 2 * found["comfort"]) / 7
    for name in ("no_at_fault_collision", "drivable_area", "driving_direction"):
        wanted = wanted * found[name]
    torch.testing.assert_close(totals, wanted)
    assert not compiled


def test_threads_get_equal_results(scenes: ScenarioSet, tensor: Any, found: dict[str, Any]):
    orders = [[i % 3, (i // 3) % 3] for i in range(12)]
    fresh = copy.copy(scenes)
    vars(fresh).pop("_on_devices", None)  # so that the threads also place the scenes

    def work(order: list[int]) -> Any:
        return torch_score(fresh, tensor[order], [TOKENS[i] for i in order])

    with ThreadPoolExecutor(6) as pool:
        results = list(pool.map(work, orders))
    for order, total in zip(orders, results, strict=True):
        assert torch.equal(total, found["total"][order])


def test_scenes_go_to_the_device_once(
    scenes: ScenarioSet, tensor: Any, found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    fresh = copy.copy(scenes)
    vars(fresh).pop("_on_devices", None)
    moved: list[int] = []
    put, size = jax.device_put, lambda tree: sum(np.size(v) for v in jax.tree.leaves(tree))
    monkeypatch.setattr(jax, "device_put", lambda v, *a: moved.append(size(v)) or put(v, *a))
    torch_score(fresh, tensor[:1], TOKENS[:1])
    first = sum(moved)
    torch_score(fresh, tensor[:1], TOKENS[:1])
    torch_score(fresh, tensor[:1], TOKENS[:1], component="comfort")
    assert sum(moved) == first > 10_000
    torch_score(fresh, tensor[1:2], TOKENS[1:2])
    assert sum(moved) > first + 10_000


def test_no_copy_on_the_way_in(scorer: TorchScorer, tensor: Any, monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[int, int]] = []
    original = scorers.from_torch

    def spy(rows: Any, device: Any) -> Any:
        array = original(rows, device)
        seen.append((rows.data_ptr(), array.unsafe_buffer_pointer()))
        return array

    monkeypatch.setattr(scorers, "from_torch", spy)
    given = tensor.clone()
    scorer(given)
    row = given[0].numel() * given.element_size()
    assert row % 64 == 0  # so every row begins where JAX can use it
    assert sorted(seen) == [(given.data_ptr() + i * row,) * 2 for i in range(3)]


def test_arrays_share_memory_both_ways():
    device = jax.local_devices()[0]
    tensor = torch.arange(32.0).reshape(2, 16)
    array = from_torch(tensor, device)
    back = to_torch(array, tensor.device)
    assert tensor.data_ptr() == array.unsafe_buffer_pointer() == back.data_ptr()
    assert torch.equal(tensor, back)


def test_rows_that_are_not_aligned_are_copied():
    tensor = torch.arange(33.0)[1:]
    assert np.array_equal(from_torch(tensor, jax.local_devices()[0]), tensor)


@pytest.mark.parametrize("kind", ["bfloat16", "float16", "float64"])
def test_other_floating_types_are_cast(
    kind: str, scorer: TorchScorer, tensor: Any, found: dict[str, Any]
):
    given = tensor.to(getattr(torch, kind))
    same = scorer(given.to(torch.float32))
    cast = scorer(given)
    assert cast["total"].dtype == torch.float32
    assert torch.equal(cast["progress_raw"], same["progress_raw"])


def test_import_leaves_torch_alone():
    code = "import sys, spdm_jax.torch_bridge; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_tensor_may_be_a_view(scorer: TorchScorer, tensor: Any, found: dict[str, Any]):
    turned = tensor.permute(3, 0, 1, 2).contiguous().permute(1, 2, 3, 0)
    assert not turned.is_contiguous()
    assert torch.equal(scorer(turned)["total"], found["total"])


def test_result_is_a_tensor_like_any_other(scorer: TorchScorer, tensor: Any):
    logits = torch.zeros(3, COUNT, requires_grad=True)
    reward = scorer(tensor)["total"]
    assert not reward.requires_grad
    loss = -(torch.softmax(logits, dim=1) * reward).sum()
    loss.backward()
    assert logits.grad is not None and logits.grad.abs().max() > 0
    reward.mul_(2)  # its memory is the caller's
    assert torch.equal(scorer(tensor)["total"] * 2, reward)


def with_nan(tensor: Any) -> Any:
    bad = tensor.clone()
    bad[1, 2, 3, 0] = float("nan")
    bad[2, 0, 0, 1] = float("inf")
    return bad


BAD: list[tuple[Callable[[Any], Any], dict[str, Any], str]] = [
    (with_nan, {}, r"trajectories\[1, 2, 3, 0\] is nan; .* \(2 values are not\)"),
    (lambda t: t.clone().requires_grad_(), {}, "has none. Pass trajectories.detach"),
    (lambda t: t[0], {}, r"shape \(16, 41, 3\); expected \[B, P, T, 3\]"),
    (lambda t: t[:, :0], {}, "expected"),
    (lambda t: t[:, :, :30], {}, "30 steps at 0.1 s"),
    (lambda t: t.int(), {}, "int32; pass a floating type"),
    (lambda t: t.numpy(), {}, "is a ndarray; pass a torch tensor"),
    (lambda t: t[:2], {}, "holds 2 scenes, the scenario set 3"),
    (lambda t: t, {"tokens": TOKENS[:2]}, "must name 3 scenes"),
    (lambda t: t[:1], {"tokens": ["gone"]}, "'gone' is not in the scenario set"),
    (lambda t: t, {"component": "nc"}, "no component 'nc'; there are total"),
    (lambda t: t, {"frame": "map"}, "frame is 'map'"),
    (lambda t: t, {"tracker": "lqr"}, "tracker is 'lqr'"),
    (lambda t: t, {"precision": "f16"}, "precision is 'f16'"),
    (lambda t: t, {"dt": 0.0}, "dt is 0.0"),
    (lambda t: t, {"frame": "global"}, "float32; pass float64"),
]


@pytest.mark.parametrize("change, settings, text", BAD)
def test_bad_input_is_named_before_any_work(
    change: Any,
    settings: dict[str, Any],
    text: str,
    scenes: ScenarioSet,
    tensor: Any,
    monkeypatch: pytest.MonkeyPatch,
):
    def never(*_: Any) -> Any:
        raise AssertionError("work was done")

    monkeypatch.setattr(scorers, "program", never)
    with pytest.raises(ValueError, match=text):
        torch_score(scenes, change(tensor), **settings)


def test_scene_without_room_is_named(scenes: ScenarioSet, tensor: Any):
    narrow = copy.copy(scenes)
    vars(narrow).pop("_on_devices", None)
    held = held_scenes(narrow, "f32", jax.local_devices()[0])
    # A route off the lanes: no starting lane is found there.
    held._batch = jax.tree.map(np.copy, held._batch)
    held._batch.map.lanes.valid[1] = False
    held._batch.route.lane_on_route[1] = False
    held._batch.route.slot_of_lane[1] = -1
    with pytest.raises(UnusableScene, match=r"scene 'parked_car-0': .*leave the scene out"):
        torch_score(narrow, tensor)
    assert list(TorchScorer(narrow).unusable(tensor[0])) == ["parked_car-0"]
    assert torch_score(narrow, tensor[::2], TOKENS[::2]).shape == (2, COUNT)


def test_set_keeps_its_scenes_as_long_as_it_lives(scenes: ScenarioSet, tensor: Any):
    fresh = ScenarioSet(scenes.batch, scenes.infos)
    torch_score(fresh, tensor[:1], TOKENS[:1])
    held = weakref.ref(held_scenes(fresh, "f32", jax.local_devices()[0]))
    again = pickle.loads(pickle.dumps(fresh))
    assert len(again) == 3 and not vars(again)["_on_devices"]
    assert held() is not None
    del fresh
    gc.collect()
    assert held() is None


FRAMES = [
    ("ego", 0.1, 41),
    ("local", 0.1, 50),
    ("ego", 0.5, 8),
    ("local", 0.5, 9),
    ("ego", 0.2, 21),
]


@pytest.mark.parametrize("frame, dt, steps", FRAMES)
def test_poses_are_placed_as_on_the_host(frame: Any, dt: float, steps: int):
    generator = np.random.default_rng(0)
    here = np.array([[3.0, -4.0, 2.9]])
    time = dt * (np.arange(steps) + (steps == 8))
    ego = np.stack([6 * time, 0.3 * time**2, 0.8 * time], -1) * generator.uniform(0, 1, (5, 1, 3))
    origin = np.zeros((1, 2))
    given = to_local(ego[None], "ego", here, origin) if frame == "local" else ego[None]
    if frame == "local":
        given[..., 2] = np.angle(np.exp(1j * given[..., 2]))  # headings wrap on the way
    wanted = to_local(resample(to_ego(given, frame, here, origin), dt), "ego", here, origin)[0]
    rest = dict.fromkeys(STATE_COLUMNS, np.array(0.0))
    now = EgoState(**{**rest, "x": here[0, 0], "y": here[0, 1], "heading": here[0, 2]})
    task = Task(PlannerConfig(), True, frame, dt)
    placed = jax.jit(lambda v: place(v, now, task))(given[0])
    np.testing.assert_allclose(placed[..., :2], wanted[..., :2], atol=1e-12)
    turn = np.asarray(placed[..., 2] - wanted[..., 2])
    np.testing.assert_allclose(np.exp(1j * turn), 1, atol=1e-12)
    assert np.ptp(turn, axis=1).max() < 1e-12 or dt == 0.1


def test_states_without_a_tracker_are_those_of_the_host(poses: np.ndarray):
    values = dict.fromkeys(STATE_COLUMNS, np.array(0.0)) | {
        "vx": np.array(7.0),
        "ax": np.array(0.5),
    }
    now = EgoState(**values)
    wanted = untracked_states(poses[None], jax.tree.map(lambda v: v[None], now))[0]
    rest = np.zeros(poses.shape[:2])
    given = {name: poses[..., i] for i, name in enumerate(("x", "y", "heading"))}
    states = EgoState(**{name: given.get(name, rest) for name in STATE_COLUMNS})
    result = jax.jit(differentiated)(states, now)
    for i, name in enumerate(STATE_COLUMNS):
        np.testing.assert_allclose(getattr(result, name), wanted[..., i], atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_map_coordinates_without_a_tracker(scenes: ScenarioSet, tensor: Any):
    rows = np.arange(3)
    now = np.asarray(scenes.batch.num_history)
    pose = np.stack([np.asarray(scenes.batch.ego.x), scenes.batch.ego.y, scenes.batch.ego.heading])
    world = to_local(tensor.numpy().astype(float), "ego", pose[:, rows, now].T, np.zeros((3, 2)))
    world[..., :2] += np.asarray(scenes.batch.origin)[:, None, None]
    settings: dict[str, Any] = {"frame": "global", "dt": 0.5, "tracker": "none"}
    sparse = world[:, :, 5::5]
    wanted = score(scenes, sparse, **settings)
    mine = torch_score(scenes, torch.from_numpy(sparse), component=COMPONENTS, **settings)
    for name in COMPONENTS:
        np.testing.assert_allclose(mine[name].numpy(), getattr(wanted, name), rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_program_for_accelerators_gives_the_same(
    scorer: TorchScorer, tensor: Any, found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    device = jax.local_devices()[0]
    held: Any = scorer._held
    stand_in = SimpleNamespace(platform="accelerator")
    program, put = scorers.program, jax.device_put
    monkeypatch.setattr(held, "device", stand_in)
    monkeypatch.setattr(jax, "device_put", lambda v, _: put(v, device))
    monkeypatch.setattr(scorers, "from_torch", lambda t, _: from_torch(t, device))
    monkeypatch.setattr(scorers, "program", lambda a, b, c, d, _: program(a, b, c, d, [device]))
    order = [2, 0, 2]
    picked = scorer(tensor[order], [TOKENS[i] for i in order])
    for name in COMPONENTS:
        assert picked[name].is_contiguous()
        torch.testing.assert_close(picked[name], found[name][order], rtol=1e-5, atol=1e-5)
