"""`models/dtpp` goldens: network, losses, gradients, optimiser steps, tree planner."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from spdm_models import dtpp
from spdm_models.dtpp import DTPPConfig
from spdm_models.dtpp_losses import DTPPTargets, loss, metrics, optimizer
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
from .models_dtpp_tree import check_tree

SMALL = EncoderConfig(width=32)
STAGES = (("first", 30), ("second", 80))
LEARNING_RATE = 2e-4
# Twice (float64) and ten times what two float32 implementations differ by.
TOKEN_TOLERANCE = {"f64": 4e-6, "f32": 2e-5}
FUTURE_TOLERANCE = {"f64": 4e-6, "f32": 2e-5}
WEIGHT_TOLERANCE = {"f64": 2e-7, "f32": 1e-6}
FEATURE_TOLERANCE = {"f64": 1e-5, "f32": 2e-5}
# At full size the reference's float32 arrays themselves are off by 5e-5 (tokens), 1e-5 (futures).
FULL_TOKEN_TOLERANCE = 2e-4
FULL_TOLERANCE = 5e-5


def score_tolerance(precision: str, reference: np.ndarray) -> float:
    """Grows with the scores, which are sums over agents and steps: 4e-5 or 2e-4 at 200."""
    finite = np.abs(reference[np.isfinite(reference)])
    largest = float(finite.max()) if finite.size else 0.0
    return {"f64": 4e-5, "f32": 2e-4}[precision] * max(1.0, largest / 200)


def features_of(data, dtype, sample: slice = slice(None)) -> SceneFeatures:
    """Inputs of the network."""
    given = {
        "ego_past": "ego_agent_past",
        "neighbors_past": "neighbor_agents_past",
        "lanes": "map_lanes",
        "crosswalks": "map_crosswalks",
        "route_lanes": "route_lanes",
    }
    return SceneFeatures(
        **{field: jnp.asarray(data[f"in/{key}"][sample], dtype) for field, key in given.items()}
    )


def _branches(data, dtype, sample: slice) -> tuple[jax.Array, jax.Array]:
    first, second = (
        jnp.asarray(data[f"in/{stage}_stage_ego_trajectory"][sample], dtype) for stage, _ in STAGES
    )
    return first, second


def _targets(data, dtype, sample: slice) -> DTPPTargets:
    return DTPPTargets(
        ego_future=jnp.asarray(data["in/ego_agent_future"][sample], dtype),
        neighbors_future=jnp.asarray(data["in/neighbor_agents_future"][sample], dtype),
    )


def _evaluate(params, config, features, branches, targets):
    encoding = dtpp.encode(params, config, features)
    first, second = (
        dtpp.decode(params, config, encoding, features, given, steps)
        for given, (_, steps) in zip(branches, STAGES, strict=True)
    )
    parts = loss(first, second, branches[0], branches[1], targets)
    moved = metrics(second, branches[1], targets)
    return parts.total, (parts, encoding, (first, second), moved)


_forward = jax.jit(_evaluate, static_argnums=1)
_with_gradients = jax.jit(jax.value_and_grad(_evaluate, has_aux=True), static_argnums=1)


@partial(jax.jit, static_argnums=(1, 5))
def _score_given(params, config, encoding, features, branches, steps, futures, neighbor_valid):
    output = dtpp.decode(
        params,
        config,
        encoding,
        features,
        branches,
        steps,
        futures=futures,
        neighbor_valid=neighbor_valid,
    )
    return output.scoring.scores


def _small(match: re.Match, path: Path, report, dtype) -> None:
    """Both samples alone, and together as the reference masks them."""
    weights = path.with_name(f"{path.stem}_params.npz")
    if not weights.is_file():
        report.not_compared(path.name, "all", f"{weights.name} is not beside it")
        return
    config = DTPPConfig(encoder=SMALL, variable_cost="variable" in path.stem)
    params = load_weights(weights, dtpp.abstract(config), dtpp.extras(config), dtype)
    data, name = np.load(path), path.name
    for i in range(len(data["in/n_first"])):
        prefix, sample = f"b1_{i}/", slice(i, i + 1)
        if f"{prefix}loss/total" not in data.files:
            continue
        given = features_of(data, dtype, sample), _branches(data, dtype, sample)
        targets = _targets(data, dtype, sample)
        (_, aux), gradients = _with_gradients(params, config, *given, targets)
        _encoding(report, name, prefix, aux[1], data)
        _compare(report, name, prefix, sample, aux, data)
        _replaced(report, name, prefix, params, config, aux[1], given, targets, data)
        if i == 0:
            _gradients(report, name, gradients, data)
        if report.precision == "f64" and f"f64/{prefix}loss/total" in data.files:
            _exact(report, name, prefix, sample, aux, data)
    if "b2/loss/total" in data.files:
        _mixed_batch(report, name, params, config, data, dtype)


def _mixed_batch(report, name, params, config, data, dtype) -> None:
    if report.precision == "f64":
        why = "queries whose mask hides every key depend on how float32 rounds -1e9"
        report.not_compared(name, "b2/*", why)
        return
    mixed = DTPPConfig(SMALL, variable_cost=config.variable_cost, reference_mask_order=True)
    both = slice(None)
    given = features_of(data, dtype), _branches(data, dtype, both)
    _, aux = _forward(params, mixed, *given, _targets(data, dtype, both))
    _compare(report, name, "b2/", both, aux, data)


def _encoding(report, name, prefix, encoding, data, tolerance=None) -> None:
    tol = tolerance or TOKEN_TOLERANCE[report.precision]
    array = f"{prefix}encoder/encoding"
    if array in data.files:
        report.close(name, array, encoding.tokens, data[array], tol)
    array = f"{prefix}encoder/mask"
    if array in data.files:
        report.equal(name, array, ~encoding.valid, data[array])


def _real(data, stage: str, sample: slice, num: int) -> np.ndarray:
    """`[B, N]` which branches are no filler."""
    key = f"in/n_{stage}" if f"in/n_{stage}" in data.files else f"n_{stage}"
    return np.arange(num) < data[key][sample, None]


def _compare(report, name, prefix, sample, aux, data) -> None:
    """Outputs of both stages, losses and metrics."""
    parts, _, outputs, moved = aux
    for (stage, steps), output in zip(STAGES, outputs, strict=True):
        scoring = output.scoring
        real = _real(data, stage, sample, scoring.scores.shape[-1])
        key = f"{prefix}{stage}/"
        _stage(report, name, key, output, steps, real, data)
        for array, value, tol in (
            ("features_hardcoded", scoring.driving, FEATURE_TOLERANCE),
            ("features_latent", scoring.latent, FEATURE_TOLERANCE),
            ("collision", scoring.collision, FEATURE_TOLERANCE),
        ):
            if key + array in data.files:
                mask = real if array == "collision" else real[..., None]
                given = data[key + array]
                report.close(name, key + array, value, given, tol[report.precision], mask)
    ours = {"stage1": parts.first, "stage2": parts.second}
    for stage, part in ours.items():
        array = f"{prefix}loss/{stage}"
        close_relative(report, name, array, part.total, data[array], LOSS_TOLERANCE)
        array = f"{prefix}loss/parts_{stage}"
        values = np.array([part.prediction, part.choice, part.ego, part.weights])
        relative = values - data[array]
        relative = relative / np.maximum(np.abs(data[array]), 1e-6)
        report.close(name, array, relative, np.zeros(4), LOSS_TOLERANCE)
    array = f"{prefix}loss/total"
    close_relative(report, name, array, parts.total, data[array], LOSS_TOLERANCE)
    array = f"{prefix}loss/metrics"
    close_relative(report, name, array, jax.tree.leaves(moved), data[array], LOSS_TOLERANCE)


def _stage(report, name, key, output, steps, real, data, tolerance=None) -> None:
    """What the network says about the branches of one stage."""
    precision = report.precision
    tol = tolerance or FUTURE_TOLERANCE[precision]
    futures = np.asarray(output.futures)[..., :steps, :]
    given = data[f"{key}agents_trajectories"][..., :steps, :]
    mask = real[..., None, None, None]
    array = f"{key}agents_trajectories"
    report.close(name, array, futures, given, tol, mask)
    array = f"{key}scores"
    bound = score_tolerance(precision, data[array])
    report.close(name, array, output.scoring.scores, data[array], bound)
    array = f"{key}weights"
    bound = WEIGHT_TOLERANCE[precision]
    report.close(name, array, output.scoring.weights, data[array], bound)
    array = f"{key}ego_regularization"
    if array in data.files:
        report.close(name, array, output.ego_future, data[array], tol)


def _replaced(report, name, prefix, params, config, encoding, given, targets, data) -> None:
    """Scores under recorded and under no futures."""
    features, branches = given
    truth = targets.neighbors_future
    there = jnp.sum(features.neighbors_past[:, : truth.shape[1], -1], axis=-1) != 0
    nobody = jnp.zeros_like(there)
    modes = {
        "perfect": (truth, there),
        "none_zeros": (jnp.zeros_like(truth), there),
        "none_masked": (jnp.zeros_like(truth), nobody),
    }
    for (stage, steps), driven in zip(STAGES, branches, strict=True):
        for mode, (futures, neighbor_valid) in modes.items():
            array = f"{prefix}{stage}/scores_{mode}"
            if array in data.files:
                scores = _score_given(
                    params, config, encoding, features, driven, steps, futures, neighbor_valid
                )
                # Ten neighbours in one place: twice the rounding of the sum.
                tol = 2 * score_tolerance(report.precision, data[array])
                report.close(name, array, scores, data[array], tol)


def _gradients(report, name, gradients, data) -> None:
    close_gradients(report, name, "grad/", "gradnorm/", gradients, data, GRADIENT_TOLERANCE)
    if report.precision == "f64":
        given = "f64/grad/", "f64/gradnorm/"
        close_gradients(report, name, *given, gradients, data, EXACT_TOLERANCE)


def _exact(report, name, prefix, sample, aux, data) -> None:
    """The same weights and inputs in float64."""
    parts, _, outputs, _ = aux
    for (stage, _), output in zip(STAGES, outputs, strict=True):
        array = f"f64/{prefix}{stage}/scores"
        real = _real(data, stage, sample, output.scoring.scores.shape[-1])
        close_relative(
            report, name, array, output.scoring.scores, data[array], EXACT_TOLERANCE, real
        )
    totals = {"stage1": parts.first, "stage2": parts.second, "total": parts}
    for key, part in totals.items():
        array = f"f64/{prefix}loss/{key}"
        close_relative(report, name, array, part.total, data[array], EXACT_TOLERANCE)


def _full(match: re.Match, path: Path, report, dtype) -> None:
    """The full-size network with weights from the recipe."""
    config = DTPPConfig()
    template = dtpp.abstract(config)
    data, name = np.load(path), path.name
    # Position tables have no recipe; they are what the network is made with.
    tables = {k: v for k, v in flatten(_initial()).items() if k.endswith(".pe")}
    flat = formula_weights(template, int(path.stem.removeprefix("full_formula_seed")))
    check_recipe(report, name, {k: v for k, v in flat.items() if k not in tables}, data)
    leaves = {k: jnp.asarray(v, dtype) for k, v in {**flat, **tables}.items()}
    sample = slice(None)
    _, (parts, encoding, outputs, _) = _forward(
        unflatten(leaves, template),
        config,
        features_of(data, dtype),
        _branches(data, dtype, sample),
        _targets(data, dtype, sample),
    )
    _encoding(report, name, "out/", encoding, data, FULL_TOKEN_TOLERANCE)
    for (stage, steps), output in zip(STAGES, outputs, strict=True):
        real = _real(data, stage, sample, output.scoring.scores.shape[-1])
        _stage(report, name, f"out/{stage}/", output, steps, real, data, FULL_TOLERANCE)
    ours = [parts.first.total, parts.second.total, parts.total]
    close_relative(report, name, "losses", ours, data["losses"], LOSS_TOLERANCE)


def _initial():
    return dtpp.init(DTPPConfig(), jax.random.key(0))


_OPTIMIZER = optimizer(LEARNING_RATE)


@jax.jit
def _update(params, state, gradients):
    updates, state = _OPTIMIZER.update(gradients, state, params)
    norms = jnp.stack([optax.tree.norm(gradients[part]) for part in ("encoder", "decoder")])
    return optax.apply_updates(params, updates), state, norms


def _train(match: re.Match, path: Path, report, dtype) -> None:
    """Five optimiser steps on one sample of the small network."""
    kind, index, seed = match.groups()
    inputs, weights = (
        path.with_name(f"small_{kind}_seed{seed}{end}.npz") for end in ("", "_params")
    )
    if not (inputs.is_file() and weights.is_file()):
        report.not_compared(path.name, "all", f"{inputs.name} or its weights are not beside it")
        return
    config = DTPPConfig(encoder=SMALL, variable_cost=kind == "variablecost")
    params = load_weights(weights, dtpp.abstract(config), dtpp.extras(config), dtype)
    source, data, name = np.load(inputs), np.load(path), path.name
    sample = slice(int(index), int(index) + 1)
    given = features_of(source, dtype, sample), _branches(source, dtype, sample)
    targets = _targets(source, dtype, sample)
    state = _OPTIMIZER.init(params)
    losses, norms = [], []
    for _ in data["losses"]:
        (total, _), gradients = _with_gradients(params, config, *given, targets)
        params, state, norm = _update(params, state, gradients)
        losses.append(float(total))
        norms.append(np.asarray(norm))
    report.close(name, "losses", losses / data["losses"], np.ones(len(losses)), 1e-4)
    reference = data["grad_norms_before_clip"]
    report.close(name, "grad_norms_before_clip", norms / reference, np.ones_like(reference), 1e-3)
    close_parameters(report, name, flatten(params), data, LEARNING_RATE)


CHECKS = {
    r"small_(constant|variable)cost_seed\d+": _small,
    r"full_formula_seed\d+": _full,
    r"train5_((?:constant|variable)cost)_b1_(\d+)_seed(\d+)": _train,
    r"tree_seed\d+": check_tree,
}


def check_dtpp(path: Path, report, dtype) -> bool:
    """Runs the check that the file's name asks for; False if it is no golden of DTPP."""
    if path.parent.name != "dtpp":
        return False
    if path.stem.endswith("_params"):
        return True  # read with the file that it belongs to
    return check_named(CHECKS, path, report, dtype)
