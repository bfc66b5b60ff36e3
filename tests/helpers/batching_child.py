"""What `test_batching.py` runs in processes of its own: several devices, stored programs."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax import batching, from_raw, score
from spdm_jax.batching import BatchConfig, SceneRunner
from spdm_jax.compile_cache import enable_compile_cache
from spdm_jax.synthetic import make_scene


def length(scene, mine, shared, static):
    return jnp.sum(jnp.hypot(jnp.diff(scene.ego.x), jnp.diff(scene.ego.y))) * static


def fan() -> np.ndarray:
    speed, way = np.linspace(0, 16, 12)[:, None], np.arange(41) * 0.1
    turn = np.linspace(-0.02, 0.02, 12)[:, None] * speed * way
    return np.stack([speed * way, 0.5 * speed * way * turn, turn], axis=-1)


def of_length(scenes, config: BatchConfig):
    return SceneRunner(length, 1.0, config=config)(scenes.batch)


def of_score(scenes, config: BatchConfig):
    found = score(scenes, fan(), batching=config)
    return found.scores, found.tracked


def devices(what: str) -> dict:
    """The same on two devices, in two chunk sizes, and on one."""
    scenes = from_raw(make_scene(name) for name in ("parked_car", "jaywalker", "straight"))
    run = {"length": of_length, "score": of_score}[what]
    on = lambda **settings: jax.tree.leaves(run(scenes, BatchConfig(**settings)))
    both, small, one = on(chunk=4), on(chunk=2), on(devices=1)
    real = lambda leaves: [np.nan_to_num(v, posinf=1e6) for v in leaves if v.dtype.kind == "f"]
    discrete = lambda leaves: [v for v in leaves if v.dtype.kind != "f"]
    pairs = lambda pick: zip(pick(both), pick(one), strict=True)
    runner = SceneRunner(length, 1.0)
    runner(scenes.batch)
    return {
        "devices": len(jax.devices()),
        "arrangement": runner.stats.arrangement,
        "chunks_equal": all(a.tobytes() == b.tobytes() for a, b in zip(both, small, strict=True)),
        "discrete_equal": all(np.array_equal(a, b) for a, b in pairs(discrete)),
        "largest_difference": max(float(np.max(np.abs(a - b))) for a, b in pairs(real)),
    }


def scaled(scene, mine, shared, static):
    return mine["factor"] * scene.ego.x, shared["offset"] + scene.ego.y


def double() -> dict:
    """Double precision in a process that computes with single precision otherwise."""
    scenes = from_raw([make_scene("straight"), make_scene("curve")])
    mine, shared = {"factor": np.array([1 / 3, 1 / 7])}, {"offset": 1 / 9}
    x, y = SceneRunner(scaled, precision="f64")(scenes.batch, mine, shared)
    wanted = mine["factor"][:, None] * scenes.batch.ego.x, shared["offset"] + scenes.batch.ego.y
    return {
        "types": [str(x.dtype), str(y.dtype)],
        "digits": max(float(np.abs(a - b).max()) for a, b in zip((x, y), wanted, strict=True)),
    }


def memory() -> dict:
    """Eight scenes on devices whose memory holds two at a time."""
    scenes = from_raw(make_scene("straight", seed) for seed in range(8))
    expected = SceneRunner(length, 1.0, config=BatchConfig(devices=1))(scenes.batch)
    real = batching.program

    def limited(name, source, make, args, devices):
        made, new = real(name, source, make, args, devices)
        size = jax.tree.leaves(args)[0].shape[0]

        def call(*values):
            if size > 2:
                raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 3 GiB")
            return made.call(*values)

        return made.__class__(call, made.used, made.seconds, made.stored), new

    batching.program = limited
    run = SceneRunner(length, 1.0, config=BatchConfig(chunk=8))
    found = run(scenes.batch)
    return {
        "messages": run.stats.messages,
        "equal": bool(np.allclose(found, expected)),
        "chunk": run.stats.chunk,
    }


def stored(static: str = "1.5") -> dict:
    """A program, and whether it was found on disk."""
    scenes = from_raw([make_scene("straight")])
    found: list[bool] = []
    real = batching.program

    def watched(*arguments):
        made, new = real(*arguments)
        found.append(made.stored)
        return made, new

    batching.program = watched
    result = SceneRunner(length, float(static))(scenes.batch)
    return {"stored": found[0], "result": result.tolist()}


MODES = {"devices": devices, "double": double, "memory": memory, "stored": stored}

if __name__ == "__main__":
    enable_compile_cache()
    mode, *arguments = sys.argv[1:]
    print(json.dumps(MODES[mode](*arguments)))
