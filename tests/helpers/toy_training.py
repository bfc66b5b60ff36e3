"""A training that compiles in no time: a linear map to the ego's pose, with noise for dropout.

As a program: `toy_training.py FOLDER STEPS [KILLED_AT]` trains in a folder and, if asked to, ends
itself by SIGKILL after that many steps.
"""

import os
import signal
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from spdm_models.gameformer import GameFormerConfig
from spdm_models.optimizers import adamw
from spdm_models.train_data import SampleConfig, TrainSample
from spdm_models.train_loop import FitConfig, Fitted, fit
from spdm_models.train_tasks import Recipe, Task

RECIPE = Recipe(epochs=4, batch=6, rate=0.05, halved_after=(2,), planner_after=1)
WIDTH = 4
ABOUT = {"what": "a toy"}


def samples(total: int = 32, seed: int = 0) -> TrainSample:
    """Poses that are a linear map of the features."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(total, WIDTH)).astype(np.float32)
    truth = features @ np.arange(3 * WIDTH, dtype=np.float32).reshape(WIDTH, 3)
    neighbors = np.zeros((total, 1, 1, 3), np.float32)
    return TrainSample(features=features, ego=truth[:, None], neighbors=neighbors)


def _predicted(params, batch):
    return batch.features @ params["layer"]["weight"]


def _loss(params, batch, key, planner):
    offset = _predicted(params, batch) - batch.ego[:, 0]
    total = jnp.mean(jnp.square(offset))
    if key is not None:
        total = total * (1 + 0.1 * jax.random.uniform(key, (), total.dtype))
    extra = jnp.mean(jnp.abs(offset)) if planner else jnp.zeros_like(total)
    return total + extra, {"extra": extra}


def _metrics(params, batch):
    missed = jnp.linalg.norm(_predicted(params, batch) - batch.ego[:, 0], axis=-1)
    # As for a sample without neighbours.
    return {"ADE": missed, "some": jnp.where(batch.features[:, 0] > 0, missed, jnp.nan)}


def _init(key):
    weight = jax.random.normal(key, (WIDTH, 3), jnp.float32)
    return {"layer": {"weight": weight}}


TASK = Task(
    name="gameformer",
    model="gameformer",
    config=GameFormerConfig(),
    recipe=RECIPE,
    sample=SampleConfig("gameformer"),
    init=_init,
    loss=_loss,
    metrics=_metrics,
    optimizer=lambda rate, params: optax.chain(adamw(rate, params, 100.0)),
)


def train(folder: Path, config: FitConfig, task: Task = TASK, **settings) -> Fitted:
    """Trains the toy in a folder."""
    return fit(task, samples(), samples(10, 1), config, folder, ABOUT, **settings)


def main() -> None:
    """Trains; see above."""
    folder, steps, *killed_at = sys.argv[1:]

    def kill(done, log):
        if killed_at and done >= int(killed_at[0]):
            os.kill(os.getpid(), signal.SIGKILL)

    config = FitConfig(steps=int(steps), batch=6, every=4)
    fitted = train(Path(folder), config, progress=kill)
    np.save(Path(folder) / "weights.npy", np.asarray(fitted.params["layer"]["weight"]))


if __name__ == "__main__":
    main()
