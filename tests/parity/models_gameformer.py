"""`models/gameformer` goldens of the network: outputs, losses, gradients, optimiser steps."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from spdm_models import gameformer
from spdm_models.gameformer import GameFormerConfig, GameFormerOutput
from spdm_models.gameformer_losses import Targets, losses, metrics
from spdm_models.optimizers import adamw
from spdm_models.params import Params
from spdm_models.scene_encoder import EncoderConfig, SceneFeatures
from spdm_models.state_dict import flatten, unflatten

from .models_common import (
    EXACT_TOLERANCE,
    GRADIENT_TOLERANCE,
    LOSS_TOLERANCE,
    check_named,
    check_recipe,
    close_gradients,
    close_parameters,
    close_relative,
    formula_weights,
    load_weights,
)

SMALL = EncoderConfig(width=32)
FULL = GameFormerConfig()
# What two float32 implementations differ by; ours may differ twice (float64) and ten times as much.
ENCODING, FIRST_LEVEL, LEVEL, SCORES, CONTENT, PLAN = 2e-6, 2e-5, 4e-4, 2e-5, 2e-5, 7e-5
# The reference's own rounding in the full-size network, whose weights are larger.
FULL_ENCODING = 5e-5
MARGIN = {"f64": 2, "f32": 10}
TRAIN_LOSS_TOLERANCE = 1e-4
TRAIN_RATE, TRAIN_LIMIT = 1e-4, 5.0
NO_WEIGHTS = "{} is not beside it"


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=True)
def _everything(params, config, features, targets):
    output = gameformer.apply(params, config, features)
    parts = losses(output, targets)
    return parts.total, (parts, metrics(output, targets), output)


@partial(jax.jit, static_argnums=1)
def _replaced(params, config, features, neighbors):
    output = gameformer.apply(params, config, features, neighbors)
    return output.levels, output.plan


def _features(data, dtype) -> SceneFeatures:
    read = lambda name: jnp.asarray(data[f"in/{name}"], dtype)
    return SceneFeatures(
        ego_past=read("ego_agent_past"),
        neighbors_past=read("neighbor_agents_past"),
        lanes=read("map_lanes"),
        crosswalks=read("map_crosswalks"),
        route_lanes=read("route_lanes"),
    )


def _targets(data, dtype) -> Targets:
    read = lambda name: jnp.asarray(data[f"in/{name}"], dtype)
    return Targets(ego=read("ego_agent_future"), neighbors=read("neighbor_agents_future"))


def _weights(path: Path, config: GameFormerConfig, dtype) -> Params:
    return load_weights(path, gameformer.abstract(config), gameformer.extras(config), dtype)


def _config(levels: str, modes: str) -> GameFormerConfig:
    return GameFormerConfig(encoder=SMALL, levels=int(levels), modes=int(modes))


def _mode_margin(output: GameFormerOutput, data) -> float:
    """The smallest gap between the best and the second-best mode of an agent with a future, m."""
    ego, others = data["in/ego_agent_future"], data["in/neighbor_agents_future"]
    truth = np.concatenate([ego[:, None], others], axis=1)[..., None, :, :2]
    seen = truth[..., :1] != 0
    seen[:, 0] = True
    gaps = []
    for level in output.levels:
        offset = np.asarray(level.gaussians)[..., :2] * seen - truth
        miss = np.sort(np.linalg.norm(offset, axis=-1).mean(axis=-1), axis=-1)
        gaps.append((miss[..., 1] - miss[..., 0])[seen.any(axis=(2, 3, 4))].min())
    return min(gaps)


def _close_levels(report, name, prefix, levels, data) -> None:
    margin = MARGIN[report.precision]
    for k, level in enumerate(levels):
        bound = (FIRST_LEVEL if k == 0 else LEVEL) * margin
        key = f"{prefix}level_{k}_interactions"
        report.close(name, key, level.gaussians, data[key], bound)
        key = f"{prefix}level_{k}_scores"
        report.close(name, key, level.scores, data[key], SCORES * margin)


def _close_outputs(
    report, name, output: GameFormerOutput, data, encoding_bound: float = ENCODING
) -> None:
    margin = MARGIN[report.precision]
    encoding = output.encoding
    key = "out/encoder/encoding"
    report.close(name, key, encoding.tokens, data[key], encoding_bound * margin)
    # The reference's mask is True where something is missing.
    report.equal(name, "out/encoder/mask", ~encoding.valid, data["out/encoder/mask"])
    report.close(name, "out/encoder/actors", encoding.actors, data["out/encoder/actors"], 0.0)
    _close_levels(report, name, "out/decoder/", output.levels, data)
    content = output.levels[-1].content[..., 0, :, :]
    key = "out/decoder/env_encoding"
    report.close(name, key, content, data[key], CONTENT * margin)
    report.close(
        name, "out/planner/ego_plan", output.plan, data["out/planner/ego_plan"], PLAN * margin
    )


def _small(match: re.Match, path: Path, report, dtype) -> None:
    """Outputs, loss, metrics and gradients; then with other predictions of the neighbours."""
    weights = path.with_name(f"{path.stem}_params.npz")
    if not weights.is_file():
        report.not_compared(path.name, "all", NO_WEIGHTS.format(weights.name))
        return
    config, data, name = _config(match[1], match[2]), np.load(path), path.name
    params = _weights(weights, config, dtype)
    features, targets = _features(data, dtype), _targets(data, dtype)
    (total, (parts, measured, output)), gradients = _everything(params, config, features, targets)
    _close_outputs(report, name, output, data)
    ours = {"level_k": parts.level_k, "planning": parts.planning, "total": total}
    for key, value in ours.items():
        close_relative(report, name, f"loss/{key}", value, data[f"loss/{key}"], LOSS_TOLERANCE)
    values = np.array(jax.tree.leaves(measured))
    close_relative(report, name, "loss/metrics", values, data["loss/metrics"], LOSS_TOLERANCE)
    key = "loss/best_mode_margin_m"
    report.close(name, key, _mode_margin(output, data), data[key], LEVEL * MARGIN[report.precision])
    close_gradients(report, name, "grad/", "gradnorm/", gradients, data, GRADIENT_TOLERANCE)
    if report.precision == "f32":
        report.not_compared(name, "f64/*", "float64 arrays")
    elif "f64/loss/total" in data.files:
        for key, value in ours.items():
            reference = data[f"f64/loss/{key}"]
            close_relative(report, name, f"f64/loss/{key}", value, reference, EXACT_TOLERANCE)
        report.close(name, "f64/ego_plan", output.plan, data["f64/ego_plan"], EXACT_TOLERANCE)
        for k, level in enumerate(output.levels):
            key = f"f64/decoder/level_{k}_scores"
            report.close(name, key, level.scores, data[key], EXACT_TOLERANCE)
        close_gradients(
            report, name, "f64/grad/", "f64/gradnorm/", gradients, data, EXACT_TOLERANCE
        )
    others = {"perfect": targets.neighbors[..., :2], "none": 0 * targets.neighbors[..., :2]}
    for kind, neighbors in others.items():
        prefix = f"replaced_{kind}/"
        if f"{prefix}ego_plan" in data.files:
            levels, plan = _replaced(params, config, features, neighbors)
            _close_levels(report, name, prefix, levels, data)
            bound = PLAN * MARGIN[report.precision]
            report.close(name, f"{prefix}ego_plan", plan, data[f"{prefix}ego_plan"], bound)


def _full(match: re.Match, path: Path, report, dtype) -> None:
    """The full-size network with weights from the recipe."""
    config = GameFormerConfig(levels=int(match[1]), modes=int(match[2]))
    template, data = gameformer.abstract(config), np.load(path)
    flat = flatten(gameformer.init(config, jax.random.key(0)))
    # The recipe draws trainable arrays only; position tables stay.
    drawn = formula_weights(template, int(match[3]))
    drawn = {name: value for name, value in drawn.items() if not name.endswith(".pe")}
    check_recipe(report, path.name, drawn, data)
    params = unflatten({k: jnp.asarray(v, dtype) for k, v in (flat | drawn).items()}, template)
    output = jax.jit(gameformer.apply, static_argnums=1)(params, config, _features(data, dtype))
    _close_outputs(report, path.name, output, data, FULL_ENCODING)


def _edge(match: re.Match, path: Path, report, dtype) -> None:
    """An ego at rest, with and without neighbours; the reference gives NaN without."""
    found = sorted(path.parent.glob("small_L3m6_seed*_params.npz"))
    if not found:
        report.not_compared(path.name, "all", NO_WEIGHTS.format("small_L3m6_seed0_params.npz"))
        return
    config, data, name = _config("3", "6"), np.load(path), path.name
    params = _weights(found[0], config, dtype)
    _, (_, _, output) = _everything(params, config, _features(data, dtype), _targets(data, dtype))[
        0
    ]
    first = jax.tree.map(lambda v: v[:1], output)
    _close_outputs(report, name, first, data)
    finite = all(bool(jnp.all(jnp.isfinite(v))) for v in jax.tree.leaves(output))
    report.equal(name, "everything is finite", finite, True)
    flags = data["nan_flags"][:, 1]
    listed = ", ".join(str(v) for v in data["nan_names"][flags])
    report.not_compared(name, "sample 1", f"the reference gives NaN for {listed}")


@jax.jit
def _update(params, state, gradients):
    optimizer = adamw(TRAIN_RATE, params, TRAIN_LIMIT)
    updates, state = optimizer.update(gradients, state, params)
    return optax.apply_updates(params, updates), state, optax.tree.norm(gradients)


def _train(match: re.Match, path: Path, report, dtype) -> None:
    """Five optimiser steps on the batch of the small network."""
    stem = f"small_L{match[1]}m{match[2]}_seed{match[3]}"
    inputs, weights = (path.with_name(f"{stem}{end}.npz") for end in ("", "_params"))
    if not (inputs.is_file() and weights.is_file()):
        report.not_compared(path.name, "all", NO_WEIGHTS.format(f"{inputs.name} or its weights"))
        return
    config, source, data, name = (
        _config(match[1], match[2]),
        np.load(inputs),
        np.load(path),
        path.name,
    )
    params = _weights(weights, config, dtype)
    features, targets = _features(source, dtype), _targets(source, dtype)
    state = adamw(TRAIN_RATE, params, TRAIN_LIMIT).init(params)
    totals, norms = [], []
    for _ in data["losses"]:
        (total, _), gradients = _everything(params, config, features, targets)
        params, state, norm = _update(params, state, gradients)
        totals.append(float(total))
        norms.append(float(norm))
    end = "_f64" if report.precision == "f64" and "losses_f64" in data.files else ""
    bound = 1e-7 if end else TRAIN_LOSS_TOLERANCE
    close_relative(report, name, f"losses{end}", totals, data[f"losses{end}"], bound)
    key = f"grad_norms_before_clip{end}"
    close_relative(report, name, key, norms, data[key], 1e-6 if end else GRADIENT_TOLERANCE)
    close_parameters(report, name, flatten(params), data, TRAIN_RATE)


CHECKS = {
    r"small_L(\d+)m(\d+)_seed\d+": _small,
    r"full_L(\d+)m(\d+)_formula_seed(\d+)": _full,
    r"edge_ego_at_rest": _edge,
    r"train5_L(\d+)m(\d+)_seed(\d+)": _train,
}


def check_gameformer(path: Path, report, dtype) -> bool:
    """Runs the check that the file's name asks for; False if it is no golden of the network."""
    if path.parent.name != "gameformer":
        return False
    if re.fullmatch(r"small_L\d+m\d+_seed\d+_params", path.stem):
        return True  # read with the file that it belongs to
    return check_named(CHECKS, path, report, dtype)
