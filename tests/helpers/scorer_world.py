"""A small road with random proposals and objects for the scorers, without a scenario around it."""

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from spdm_jax.geometry import make_path
from spdm_jax.io.grid import build_grid
from spdm_jax.scoring.areas import AreaMasks, pack_bits
from spdm_jax.scoring.score import World
from spdm_jax.types import AgentForecast, EgoState

FIELDS = tuple(EgoState.__dataclass_fields__)
NUM_OBJECTS, NUM_PROPOSALS = 6, 8

# Two route lanes, an oncoming lane, a connector across the first two, a car park with a hole, and
# an intersection over the lanes.
DRIVABLE = [
    shapely.box(-40, -1.75, 60, 1.75),
    shapely.box(-40, -5.25, 60, -1.75),
    shapely.box(-40, 1.75, 60, 5.25),
    shapely.box(-10, -4.5, 8, 2.5),
    shapely.box(5, -15, 25, -5.25).difference(shapely.box(12, -12, 16, -8)),
]
ON_ROUTE = np.array([True, True, False, True, False])
INTERSECTIONS = [shapely.box(15, -6, 25, 6)]
PATH = np.array([[-40.0, 0.0], [10.0, 0.5], [60.0, 0.0]])


def grid_world(forecast: AgentForecast, dtype=jnp.float64) -> World:
    grid = build_grid([*DRIVABLE, *INTERSECTIONS])
    cast = lambda v: jnp.asarray(v, dtype if np.asarray(v).dtype.kind == "f" else None)
    flags = lambda *rows: pack_bits(jnp.asarray(rows), 1)
    masks = AreaMasks(
        drivable=flags(*[True] * len(DRIVABLE), False),
        on_route=flags(*ON_ROUTE.tolist(), False),
        intersection=flags(*[False] * len(DRIVABLE), True),
    )
    x, y = jnp.asarray(PATH, dtype).T
    line = make_path(x, y, jnp.zeros(3, dtype), jnp.asarray(3, jnp.int32))
    return World(jax.tree.map(cast, grid), masks, forecast, line)


def random_states(rng: np.random.Generator, num: int = NUM_PROPOSALS) -> np.ndarray:
    """`[P, 41, 11]` unicycle motion, some standing or creeping, some with slip and noise."""
    speed = np.maximum(
        rng.uniform(0, 14, (num, 1)) + rng.uniform(-4, 3, (num, 1)) * 0.1 * np.arange(41), 0
    )
    speed[: num // 4] *= rng.choice([0, 0.0003, 0.004, 0.2], (num // 4, 1))
    heading = rng.normal(0, 0.2, (num, 1)) + np.cumsum(
        0.1 * rng.normal(0, 0.4, (num, 1)) + 0 * speed, 1
    )
    heading[num // 2 :: 4] += np.pi
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    states = np.zeros((num, 41, 11))
    states[..., 0] = rng.uniform(-20, 15, (num, 1)) + np.cumsum(0.1 * speed * np.cos(heading), 1)
    states[..., 1] = rng.uniform(-4.5, 3.5, (num, 1)) + np.cumsum(0.1 * speed * np.sin(heading), 1)
    states[..., 2], states[..., 3] = heading, speed
    states[..., 4] = rng.normal(0, 0.02, (num, 1)) * (rng.random((num, 1)) < 0.3)
    states[..., 5] = np.gradient(speed, axis=1) / 0.1 + rng.normal(0, 0.3, (num, 41))
    states[..., 6] = rng.normal(0, 0.5, (num, 1))
    return states


def random_objects(rng: np.random.Generator, states: np.ndarray, num: int = NUM_OBJECTS) -> dict:
    """Objects that cross the trajectories: placed where some proposal is at some time."""
    row, at = rng.integers(len(states), size=num), rng.integers(5, 41, num)
    speed = rng.uniform(0, 8, num) * (rng.random(num) < 0.7)
    heading = rng.uniform(-np.pi, np.pi, num)
    time = 0.2 * (np.arange(41) - at[:, None] / 2)
    agent = rng.random(num) < 0.7
    speed *= agent
    return {
        "x": states[row, at, 0, None]
        + rng.normal(0, 2, (num, 1))
        + speed[:, None] * np.cos(heading)[:, None] * time,
        "y": states[row, at, 1, None]
        + rng.normal(0, 2, (num, 1))
        + speed[:, None] * np.sin(heading)[:, None] * time,
        "heading": np.broadcast_to(heading[:, None], (num, 41)).copy(),
        "valid": rng.random((num, 41)) < rng.choice([1.0, 0.8], (num, 1)),
        "length": rng.uniform(0.4, 6, num),
        "width": rng.uniform(0.4, 2.5, num),
        "agent": agent,
        "speed": speed,
        "present": rng.random(num) < 0.9,
        "ignored": rng.random(num) < 0.1,
    }


def forecast_of(objects: dict, dtype=jnp.float64) -> AgentForecast:
    number = lambda name: jnp.asarray(objects[name], dtype)
    count = len(objects["agent"])
    return AgentForecast(
        x=number("x"),
        y=number("y"),
        heading=number("heading"),
        sample_valid=jnp.asarray(objects["valid"]),
        length=number("length"),
        width=number("width"),
        type=jnp.where(jnp.asarray(objects["agent"], bool), 0, 4).astype(jnp.int32),
        is_agent=jnp.asarray(objects["agent"], bool),
        speed=number("speed"),
        current_heading=number("heading")[:, 0],
        track=jnp.arange(count, dtype=jnp.int32),
        valid=jnp.asarray(objects["present"], bool),
        ignored=jnp.asarray(objects["ignored"] & objects["present"], bool),
    )


def state_of(array: np.ndarray, dtype=jnp.float64) -> EgoState:
    return EgoState(**{name: jnp.asarray(array[..., i], dtype) for i, name in enumerate(FIELDS)})
