"""What must not change a result: the frame, the order, the padding, the company, the transform."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import small_road as roads
import spdm_jax
from spdm_jax import functional
from spdm_jax.config import PlannerConfig, PlannerParams
from spdm_jax.io.raw import RawScenario
from spdm_jax.padding import PaddingConfig
from spdm_jax.planner import PlanResult
from spdm_jax.scene_score import score_scene
from spdm_jax.synthetic import make_scene
from spdm_jax.types import EgoState, ObjectType, SubScores

NUM = 8
CONFIG = PlannerConfig(max_path_points=512)


def busy(token: str = "busy", shift: float = 0.0) -> RawScenario:
    """Traffic of all classes around the ego, nothing symmetric."""
    x = roads.EGO_X + shift
    kind = ObjectType
    things = [
        roads.Thing(x + 31.3, -3.4, speed=4.1, heading=0.02, id="leader"),
        roads.Thing(x + 55.9, -3.7, speed=6.3, heading=-0.01, id="second"),
        roads.Thing(x - 19.1, 0.2, speed=11.2, heading=0.03, id="overtaker"),
        roads.Thing(x + 24.7, 4.9, speed=1.3, heading=-1.5, type=int(kind.PEDESTRIAN), id="walker"),
        roads.Thing(
            x + 15.2, -6.1, speed=3.2, heading=0.1, type=int(kind.BICYCLE), width=0.7, id="bike"
        ),
        roads.Thing(x + 44.4, 1.1, type=int(kind.TRAFFIC_CONE), length=0.4, width=0.4, id="cone"),
    ]
    return roads.road(
        speed=9.3, accel=0.4, ego_y=-3.31, ego_heading=0.013, things=things, token=token
    )


def assert_same_plan(one: PlanResult, other: PlanResult, tolerance: float = 1e-9) -> None:
    """Everything that does not depend on the frame."""
    assert int(one.best) == int(other.best)
    assert bool(one.emergency_brake) == bool(other.emergency_brake)
    np.testing.assert_array_equal(one.proposals.valid, other.proposals.valid)
    valid = one.proposals.valid
    for name in SubScores.__dataclass_fields__:
        a, b = np.asarray(getattr(one.scores, name)), np.asarray(getattr(other.scores, name))
        if a.dtype.kind == "f":
            np.testing.assert_allclose(a[valid], b[valid], atol=tolerance, err_msg=name)
        elif name not in ("collision_object", "ttc_object"):
            np.testing.assert_array_equal(a[valid], b[valid], err_msg=name)
    for name in ("vx", "ax", "steering", "yaw_rate"):
        a, b = getattr(one.tracked, name), getattr(other.tracked, name)
        np.testing.assert_allclose(a[valid], b[valid], atol=10 * tolerance, err_msg=name)


def in_map(raw: RawScenario, state: EgoState) -> np.ndarray:
    """Poses `[..., 3]` in map coordinates."""
    origin = np.round(raw.ego[raw.num_history, :2])
    return np.stack([state.x + origin[0], state.y + origin[1], state.heading], -1)


@pytest.mark.parametrize("planner", ["PDM", pytest.param("SPDM", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "angle, shift", [(0.0, (12.34, -56.78)), (np.pi / 2, (0.0, 0.0)), (2.1, (3.3e5, 4.7e6))]
)
def test_rotation_and_translation(planner: str, angle: float, shift: tuple[float, float]):
    raw = busy()
    turned = roads.moved(raw, angle, shift)
    one, other = (roads.plan(scene, getattr(roads, planner)) for scene in (raw, turned))
    # Map coordinates of millions of metres hold 1e-9 m.
    assert_same_plan(one, other, 1e-9 if max(np.abs(shift)) < 1e5 else 1e-6)
    here, there = in_map(raw, one.trajectory), in_map(turned, other.trajectory)
    cos, sin = np.cos(angle), np.sin(angle)
    expected = here[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + shift
    np.testing.assert_allclose(there[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(np.cos(there[:, 2] - here[:, 2] - angle), 1, atol=1e-9)


@pytest.mark.parametrize("planner", ["PDM", pytest.param("SPDM", marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [0, 1])
def test_order_of_tracks_lanes_and_blocks(planner: str, seed: int):
    raw = busy()
    mixed, order = roads.reordered(raw, seed)
    assert order.tolist() != sorted(order.tolist())
    one, other = (roads.plan(scene, getattr(roads, planner)) for scene in (raw, mixed))
    assert_same_plan(one, other)
    np.testing.assert_allclose(one.trajectory.x, other.trajectory.x, atol=1e-9)
    np.testing.assert_allclose(one.trajectory.y, other.trajectory.y, atol=1e-9)
    # Objects are listed by class and distance, whatever their row was.
    valid = one.forecast.valid
    np.testing.assert_array_equal(order[other.forecast.track[valid]], one.forecast.track[valid])
    np.testing.assert_array_equal(one.scores.collision_object, other.scores.collision_object)


@pytest.mark.parametrize("planner", ["PDM", pytest.param("SPDM", marks=pytest.mark.slow)])
def test_equal_input_gives_equal_bytes(planner: str):
    one, other = (roads.plan(busy(), getattr(roads, planner)) for _ in range(2))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.tobytes() == b.tobytes()


def test_seeds_decide_scenes_to_the_byte():
    sets = [spdm_jax.from_raw([make_scene("parked_car", seed)]).batch for seed in (3, 3, 4)]
    same, other = (
        [a.tobytes() == b.tobytes() for a, b in zip(*map(jax.tree.leaves, pair), strict=True)]
        for pair in (sets[:2], (sets[0], sets[2]))
    )
    assert all(same) and not all(other)


def trajectories(num: int = NUM) -> np.ndarray:
    """`[P, 41, 3]` in the ego frame: straight and bent, slow and fast."""
    t = np.arange(41) * 0.1
    speed, turn = np.linspace(0, 14, num)[:, None], np.linspace(-0.1, 0.12, num)[:, None]
    heading = turn * t
    x = np.concatenate([np.zeros((num, 1)), np.cumsum(0.1 * speed * np.cos(heading), 1)[:, :-1]], 1)
    y = np.concatenate([np.zeros((num, 1)), np.cumsum(0.1 * speed * np.sin(heading), 1)[:, :-1]], 1)
    return np.stack([x, y, heading], -1)


RAW = [busy("one"), busy("two", 7.0), roads.road(things=[roads.parked(25.0)], token="three")]


def score(raws: list[RawScenario], rows: np.ndarray, padding: PaddingConfig = roads.PADDING):
    scenes = spdm_jax.from_raw(raws, padding=padding)
    result = spdm_jax.score(scenes, rows, precision="f64")
    return result.scores, result.tracked


def test_company_in_a_batch_does_not_matter():
    """Bit for bit: two scenes at once, and each alone."""
    rows = trajectories()
    whole = score(RAW[1:], rows)
    for i, raw in enumerate(RAW[1:]):
        alone = score([raw], rows)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(whole), strict=True):
            np.testing.assert_array_equal(a[0], b[i])


@pytest.mark.slow
def test_bigger_buckets_do_not_matter():
    rows = trajectories()
    sizes = {f.name: getattr(roads.PADDING, f.name)[0] for f in dataclasses.fields(PaddingConfig)}
    words = ("lanes", "tracks", "time", "roadblocks", "sequence", "slots", "branches", "grid_rows")
    bigger = PaddingConfig(**{name: (sizes[name] * (3 if name in words else 2),) for name in sizes})
    for a, b in zip(
        jax.tree.leaves(score(RAW[:1], rows)),
        jax.tree.leaves(score(RAW[:1], rows, bigger)),
        strict=True,
    ):
        np.testing.assert_allclose(np.float64(a), np.float64(b), atol=1e-9)


def test_order_of_trajectories_does_not_matter():
    rows = trajectories()
    order = np.random.default_rng(0).permutation(NUM)
    one, other = score(RAW[:1], rows), score(RAW[:1], rows[order])
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a[:, order], b)


def stacked(raws: list[RawScenario]) -> Any:
    batch = spdm_jax.from_raw(raws, padding=roads.PADDING).batch
    device = functional.to_device(batch, jnp.float64)
    return device.replace(origin=jnp.zeros((len(raws), 2)))


def assert_close(one: Any, other: Any, tolerance: float = 1e-9) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if np.asarray(a).dtype.kind == "f":
            np.testing.assert_allclose(a, b, atol=tolerance)
        else:
            np.testing.assert_array_equal(a, b)


def check_transforms(function: Any, batch: Any) -> None:
    """jit = vmap = loop = eager, for a function of one scene."""
    rows = [jax.tree.map(lambda v, i=i: v[i], batch) for i in range(2)]
    compiled = jax.jit(function)
    single = [compiled(row) for row in rows]
    together = jax.tree.map(lambda *v: jnp.stack(v), *single)
    assert_close(jax.jit(jax.vmap(function))(batch), together)
    assert_close(jax.jit(partial(jax.lax.map, function))(batch), together)
    assert_close(function(rows[0]), single[0])


@pytest.mark.slow
def test_scoring_under_every_transform():
    batch = stacked(RAW[:2])
    pose = trajectories()
    x, y, heading = np.moveaxis(pose, -1, 0)
    zero = np.zeros_like(x)
    fields = dict.fromkeys(EgoState.__dataclass_fields__, jnp.asarray(zero))
    given = {"x": jnp.asarray(x), "y": jnp.asarray(y), "heading": jnp.asarray(heading)}
    states = EgoState(**fields | given)
    check_transforms(
        lambda scene: score_scene(scene, states, PlannerParams(), CONFIG, tracker=True)[:2], batch
    )


@pytest.mark.slow
@pytest.mark.parametrize("planner", ["PDM", "SPDM"])
def test_planning_under_every_transform(planner: str):
    chosen = getattr(roads, planner)
    batch = stacked(RAW[:2])
    check_transforms(lambda scene: functional.plan(scene, chosen.params, chosen.config), batch)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_company_in_a_planned_batch_does_not_matter(precision):
    whole = spdm_jax.plan(
        spdm_jax.from_raw(RAW, padding=roads.PADDING), roads.SPDM, precision=precision
    )
    for i, raw in enumerate(RAW):
        alone = spdm_jax.plan(
            spdm_jax.from_raw([raw], padding=roads.PADDING), roads.SPDM, precision=precision
        )
        for a, b in zip(jax.tree.leaves(alone.plans), jax.tree.leaves(whole.plans), strict=True):
            np.testing.assert_array_equal(a[0], b[i])


@pytest.mark.slow
def test_bigger_buckets_do_not_matter_to_a_plan():
    small, default = (
        spdm_jax.plan(spdm_jax.from_raw(RAW[:1], padding=padding), roads.SPDM, precision="f64")
        for padding in (roads.PADDING, None)
    )
    np.testing.assert_array_equal(small.best, default.best)
    assert_close(
        small.scores,
        default.scores.replace(
            collision_object=small.scores.collision_object, ttc_object=small.scores.ttc_object
        ),
    )
    assert_close(small.trajectory, default.trajectory)
