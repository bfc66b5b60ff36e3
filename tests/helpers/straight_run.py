"""Hand-made closed-loop runs on the straight roads of `small_road`, ready for the metrics."""

from collections.abc import Sequence
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from small_road import EGO_X, LANE_WIDTH, Thing, moved, road, scene_of
from spdm_jax.metrics import ClosedLoopMetrics, Expert, MetricParams, closed_loop
from spdm_jax.simulation.history import History, Snapshot
from spdm_jax.types import EgoState, ObjectType, ScenarioMap

STEPS, ROOM, OBJECTS = 50, 64, 4
"""Samples of a run, and the room that all runs are padded to."""
Y = -LANE_WIDTH
"""Centre line of the lane that the ego drives in, m."""
SHIFT = 1.461
"""Rear axle to box centre, m."""

evaluate = jax.jit(closed_loop, static_argnames="config")
evaluate_many = jax.jit(jax.vmap(closed_loop, in_axes=(0, None, 0)))
STRAIGHT = road()


@lru_cache(maxsize=8)
def straight_map(limit: float | None = 13.4, dtype: str = "float64") -> ScenarioMap:
    """The two-lane road in map coordinates; the ego's lane is on the right."""
    raw = road(limit=limit)
    return local_map(scene_of(raw, jnp.dtype(dtype)).map, raw)


def local_map(scene_map: ScenarioMap, raw) -> ScenarioMap:
    """Undoes the shift to the ego's rear axle: tests think in the road's own coordinates."""
    back = np.round(raw.ego[raw.num_history, :2])

    def shifted(path, leaf):
        name = path[-1].name
        if name in ("xy", "next_xy"):
            return leaf + jnp.asarray(back, leaf.dtype)
        if name == "points":
            return leaf.at[:, :2].add(jnp.asarray(back, leaf.dtype))
        if name == "origin":
            return leaf + jnp.asarray(back, leaf.dtype)
        return leaf

    return jax.tree_util.tree_map_with_path(shifted, scene_map)


def drive(
    speed: npt.ArrayLike = 10.0,
    *,
    x: float = EGO_X,
    y: npt.ArrayLike = Y,
    heading: npt.ArrayLike = 0.0,
    steps: int = STEPS,
    **columns: npt.ArrayLike,
) -> dict[str, np.ndarray]:
    """Columns of an ego that drives along x with given speeds, 0.1 s apart.

    Args:
      speed: m/s, one per sample or constant; it moves the rear axle to the next sample.
      x: first rear axle, m.
      y: m, one per sample or constant.
      heading: rad, likewise; it turns the box alone.
      steps: samples.
      **columns: further columns of the ego.
    """
    flat = lambda v: np.broadcast_to(np.asarray(v, float), steps).copy()
    v = flat(speed)
    ego = {name: np.zeros(steps) for name in EgoState.__dataclass_fields__}
    ego |= {"x": x + 0.1 * np.concatenate([[0], np.cumsum(v)[:-1]]), "y": flat(y)}
    ego |= {"heading": flat(heading), "vx": v}
    return ego | {name: flat(value) for name, value in columns.items()}


def _state(ego: dict[str, np.ndarray], room: int, dtype) -> EgoState:
    grow = lambda v: jnp.asarray(np.pad(v, (0, room - len(v)), mode="edge"), dtype)
    return EgoState(**{name: grow(column) for name, column in ego.items()})


def history_of(
    ego: dict[str, np.ndarray],
    things: Sequence[Thing] = (),
    *,
    time: np.ndarray | None = None,
    room: int = ROOM,
    objects: int = OBJECTS,
    dtype=jnp.float64,
) -> History:
    """Puts an ego and objects that keep their velocity into a history."""
    steps = len(ego["x"])
    time = 0.1 * np.arange(steps) if time is None else np.asarray(time, float)
    table = {name: np.zeros((room, objects)) for name in ("x", "y", "heading", "vx", "vy")}
    table |= {name: np.ones((room, objects)) for name in ("length", "width")}
    valid, kind = np.zeros((room, objects), bool), np.zeros(objects, np.int32)
    clock = np.pad(time, (0, room - steps), mode="edge")
    for i, thing in enumerate(things):
        vx, vy = thing.speed * np.cos(thing.heading), thing.speed * np.sin(thing.heading)
        static = thing.type > ObjectType.BICYCLE
        table["x"][:, i], table["y"][:, i] = thing.x + vx * clock, thing.y + vy * clock
        table["heading"][:, i] = thing.heading
        table["vx"][:, i], table["vy"][:, i] = (0, 0) if static else (vx, vy)
        table["length"][:, i], table["width"][:, i] = thing.length, thing.width
        valid[:, i], kind[i] = np.arange(room) <= thing.until, thing.type
    return History(
        time=jnp.asarray(clock, dtype),
        ego=_state(ego, room, dtype),
        valid=jnp.arange(room) < steps,
        objects=Snapshot(
            **{name: jnp.asarray(v, dtype) for name, v in table.items()},
            type=jnp.asarray(kind),
            valid=jnp.asarray(valid),
        ),
        lights=jnp.zeros((room, 16), jnp.int8),
    )


def expert_of(ego: dict[str, np.ndarray], room: int = ROOM, dtype=jnp.float64) -> Expert:
    """Puts a recorded drive into an expert."""
    return Expert(_state(ego, room, dtype), jnp.arange(room) < len(ego["x"]))


def judge(
    ego: dict[str, np.ndarray],
    things: Sequence[Thing] = (),
    *,
    expert: dict[str, np.ndarray] | None = None,
    limit: float | None = 13.4,
    time: np.ndarray | None = None,
    params: MetricParams | None = None,
) -> ClosedLoopMetrics:
    """Metrics of a run, as NumPy arrays; the expert drives 10 m/s for one sample more."""
    goal = drive(steps=STEPS + 1) if expert is None else expert
    history = history_of(ego, things, time=time)
    params = MetricParams() if params is None else params
    metrics = evaluate(history, straight_map(limit), expert_of(goal), params)
    return jax.tree.map(np.asarray, metrics)


def judge_moved(ego: dict[str, np.ndarray], things: Sequence[Thing], angle: float, shift):
    """Metrics of the same run with the whole world turned and shifted."""
    raw = moved(STRAIGHT, angle, shift)
    cos, sin = np.cos(angle), np.sin(angle)

    def turned(columns):
        x, y = columns["x"], columns["y"]
        return columns | {
            "x": cos * x - sin * y + shift[0],
            "y": sin * x + cos * y + shift[1],
            "heading": columns["heading"] + angle,
        }

    history = history_of(ego, things)
    objects = history.objects
    points = turned({"x": objects.x, "y": objects.y, "heading": objects.heading})
    moving = {"vx": cos * objects.vx - sin * objects.vy, "vy": sin * objects.vx + cos * objects.vy}
    history = history.replace(
        ego=_state(turned(ego), ROOM, jnp.float64), objects=objects.replace(**points, **moving)
    )
    scene_map = local_map(scene_of(raw).map, raw)
    expert = expert_of(turned(drive(steps=STEPS + 1)))
    return jax.tree.map(np.asarray, evaluate(history, scene_map, expert, MetricParams()))
