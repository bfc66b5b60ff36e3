"""`models/dipp` goldens: network, losses, gradients, optimiser steps, planner solves."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from spdm_models import dipp
from spdm_models.dipp import DIPPConfig, DIPPFeatures
from spdm_models.dipp_losses import (
    future_loss,
    motion_metrics,
    pick,
    plan_trajectories,
    planner_loss,
)
from spdm_models.optimizers import clip_by_norm
from spdm_models.state_dict import flatten, unflatten

from .models_common import (
    EXACT_TOLERANCE,
    GRADIENT_TOLERANCE,
    LOSS_TOLERANCE,
    arrays,
    check_named,
    check_recipe,
    close_gradients,
    close_parameters,
    close_relative,
    formula_weights,
    load_weights,
)
from .models_dipp_planner import (
    EXACT_SOLVE_TOLERANCE,
    PLANNER,
    SOLVE_TOLERANCE,
    check_solves,
    close_planned,
)

SMALL = DIPPConfig(width=32)
SMALL_ZEROED = DIPPConfig(width=32, padded_agents="zeroed")
FULL = DIPPConfig()
INPUTS = ("ego", "neighbors", "map_lanes", "map_crosswalks")
TYPE_TABLES = ("self_type", "left_type", "right_type", "traffic_light_type")
ZERO_ROWS = tuple(f"lane_net.{name}.weight" for name in TYPE_TABLES)
# Twice (float64) and ten times the 2e-6 that two float32 implementations differ by.
OUTPUT_TOLERANCE = {"f64": 4e-6, "f32": 2e-5}


def _features(data, dtype, sample: slice = slice(None)) -> DIPPFeatures:
    return DIPPFeatures(**{k: v[sample] for k, v in arrays(data, "in/", INPUTS, dtype).items()})


_apply = jax.jit(dipp.apply, static_argnums=1)


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=True)
def _future_loss(params, config, features, truth):
    output = dipp.apply(params, config, features)
    plans = jax.vmap(plan_trajectories)(output.controls, features.ego[:, -1])
    loss = future_loss(plans, output.predictions, output.scores, truth)
    chosen = pick(plans, loss.best_mode), pick(output.predictions, loss.best_mode)
    return loss.total, (loss, plans, motion_metrics(*chosen, truth))


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=True)
def _planner_loss(params, config, features, ref_line, truth):
    output = dipp.apply(params, config, features)
    now = features.ego[:, -1], features.neighbors[:, :, -1]
    loss = planner_loss(output, *now, ref_line, truth, PLANNER)
    return loss.total, (loss, output)


def _exact(report) -> float | None:
    """Tolerance against float64 arrays; None in a float32 run."""
    return EXACT_TOLERANCE if report.precision == "f64" else None


def _small(match: re.Match, path: Path, report, dtype) -> None:
    """Encoders, outputs, loss and gradients of a batch; one planner step per sample."""
    weights = path.with_name(f"{path.stem}_params.npz")
    if not weights.is_file():
        report.not_compared(path.name, "all", f"{weights.name} is not beside it")
        return
    params = load_weights(weights, dipp.abstract_params(SMALL), dipp.EXTRAS, dtype)
    data, name = np.load(path), path.name
    features = _features(data, dtype)
    output = _apply(params, SMALL, features)
    _outputs(report, name, "out/", output, data)
    _encoding(report, name, output.encoding, data)
    _lanes(report, name, params, features, data)
    zeroed = _apply(params, SMALL_ZEROED, features)
    _outputs(report, name, "fastpath/", zeroed, data)
    tol = OUTPUT_TOLERANCE[report.precision]
    report.close(
        name,
        "fastpath/agent_agent",
        zeroed.encoding.agent_agent,
        data["fastpath/agent_agent"],
        tol,
    )
    truth = jnp.asarray(data["in/gt_future_states"], dtype)
    (total, (loss, plans, metrics)), gradients = _future_loss(params, SMALL, features, truth)
    report.close(name, "out/plan_trajectories", plans, data["out/plan_trajectories"], 10 * tol)
    close_relative(report, name, "loss/mfma", total, data["loss/mfma"], LOSS_TOLERANCE)
    report.equal(name, "loss/best_mode", loss.best_mode, data["loss/best_mode"])
    close_relative(report, name, "loss/metrics", metrics, data["loss/metrics"], LOSS_TOLERANCE)
    close_gradients(
        report, name, "grad_mfma/", "gradnorm_mfma/", gradients, data, GRADIENT_TOLERANCE
    )
    exact = _exact(report)
    if "f64/loss/mfma" in data.files and exact is not None:
        close_relative(report, name, "f64/loss/mfma", total, data["f64/loss/mfma"], exact)
        close_gradients(report, name, "f64/grad_mfma/", "f64/none/", gradients, data, exact)
    ref_line = jnp.asarray(data["in/ref_line"], dtype)
    for i in range(len(truth)):
        one = slice(i, i + 1)
        if f"plan{i}/train/u0" not in data.files:
            report.not_compared(name, f"plan{i}", "not in the file")
            continue
        sample = DIPPFeatures(**{key: getattr(features, key)[one] for key in INPUTS})
        (_, (loss, output)), gradients = _planner_loss(
            params, SMALL, sample, ref_line[one], truth[one]
        )
        close_planned(report, name, f"plan{i}/", loss, output, sample, ref_line[i], data)
        close_gradients(
            report,
            name,
            f"plan{i}/train/grad/",
            f"plan{i}/train/gradnorm/",
            gradients,
            data,
            SOLVE_TOLERANCE,
        )


def _outputs(report, name, prefix, output, data) -> None:
    tol = OUTPUT_TOLERANCE[report.precision]
    for key, value in (
        ("plans", output.controls),
        ("predictions", output.predictions),
        ("scores", output.scores),
        ("cost_weights", output.cost_weights[None]),
    ):
        if prefix + key in data.files:
            # Beyond 10 m, as some predictions, in parts of that: float32 spacing grows with it.
            scale = max(1.0, float(np.abs(data[prefix + key]).max()) / 10)
            report.close(name, prefix + key, value, data[prefix + key], tol * scale)


def _encoding(report, name, encoding, data) -> None:
    tol = OUTPUT_TOLERANCE[report.precision]
    for key in ("actors", "agent_agent", "map_feature", "agent_map"):
        report.close(name, f"enc/{key}", getattr(encoding, key), data[f"enc/{key}"], tol)
    # The reference's masks are True where something is missing.
    report.equal(name, "enc/actor_mask", ~encoding.actor_valid, data["enc/actor_mask"])
    report.equal(name, "enc/map_mask", ~encoding.map_valid, data["enc/map_mask"])


@jax.jit
def _point_features(params, lanes, crosswalks):
    network = dipp.bind(params, SMALL)
    return network.lane_net(lanes), network.crosswalk_net(crosswalks)


def _lanes(report, name, params, features, data) -> None:
    tol = OUTPUT_TOLERANCE[report.precision]
    lanes, crosswalks = _point_features(
        params, features.map_lanes[:, 0], features.map_crosswalks[:, 0]
    )
    # Up to 22, so in parts of the largest entry.
    for key, value in (("lane", lanes), ("crosswalk", crosswalks)):
        key = f"enc/{key}_feature_ego"
        close_relative(report, name, key, value, data[key], tol)


def _planner_gradients(match: re.Match, path: Path, report, dtype) -> None:
    """Loss and gradients through the two-step solve in float64, one sample."""
    if report.precision == "f32":
        report.not_compared(path.name, "all", "float64 arrays; small_seed* has the float32 ones")
        return
    seed, index = match.groups()
    inputs, weights = (path.with_name(f"small_seed{seed}{end}.npz") for end in ("", "_params"))
    if not (inputs.is_file() and weights.is_file()):
        report.not_compared(path.name, "all", f"{inputs.name} or its weights are not beside it")
        return
    params = load_weights(weights, dipp.abstract_params(SMALL), dipp.EXTRAS, dtype)
    source, data, name = np.load(inputs), np.load(path), path.name
    one = slice(int(index), int(index) + 1)
    features = _features(source, dtype, one)
    ref_line, truth = (
        jnp.asarray(source[f"in/{key}"][one], dtype) for key in ("ref_line", "gt_future_states")
    )
    (total, (loss, output)), gradients = _planner_loss(params, SMALL, features, ref_line, truth)
    for key, value in (
        ("loss_total", total),
        ("loss_mfma", loss.futures.total),
        ("plan_cost", loss.plan_cost),
    ):
        close_relative(report, name, key, value, data[key], EXACT_SOLVE_TOLERANCE)
    chosen = pick(output.controls, loss.futures.best_mode)
    report.close(name, "u0", chosen, data["u0"], EXACT_TOLERANCE)
    refined = loss.controls.reshape(1, -1)
    report.close(name, "u_final", refined, data["u_final"], EXACT_SOLVE_TOLERANCE)
    close_gradients(report, name, "grad/", "gradnorm/", gradients, data, EXACT_SOLVE_TOLERANCE)


def _full(match: re.Match, path: Path, report, dtype) -> None:
    """The full-size network with weights from the recipe, on sample 0 of the small one."""
    seed = match[1]
    inputs = path.with_name(f"small_seed{seed}.npz")
    if not inputs.is_file():
        report.not_compared(path.name, "all", f"{inputs.name} is not beside it")
        return
    template = dipp.abstract_params(FULL)
    flat = formula_weights(template, int(seed), ZERO_ROWS)
    data = np.load(path)
    check_recipe(report, path.name, flat, data)
    params = unflatten({k: jnp.asarray(v, dtype) for k, v in flat.items()}, template)
    output = _apply(params, FULL, _features(np.load(inputs), dtype, slice(0, 1)))
    _outputs(report, path.name, "out/", output, data)


_OPTIMIZER = optax.chain(clip_by_norm(5.0), optax.adam(2e-4))


@jax.jit
def _train_step(params, state, features, truth):
    (loss, _), gradients = _future_loss(params, SMALL, features, truth)
    updates, state = _OPTIMIZER.update(gradients, state, params)
    return optax.apply_updates(params, updates), state, loss, optax.tree.norm(gradients)


def _train(match: re.Match, path: Path, report, dtype) -> None:
    """Five optimiser steps on the batch of the small network."""
    seed = match[1]
    inputs, weights = (path.with_name(f"small_seed{seed}{end}.npz") for end in ("", "_params"))
    if not (inputs.is_file() and weights.is_file()):
        report.not_compared(path.name, "all", f"{inputs.name} or its weights are not beside it")
        return
    params = load_weights(weights, dipp.abstract_params(SMALL), dipp.EXTRAS, dtype)
    source, data, name = np.load(inputs), np.load(path), path.name
    features = _features(source, dtype)
    truth = jnp.asarray(source["in/gt_future_states"], dtype)
    state = _OPTIMIZER.init(params)
    losses, norms = [], []
    for _ in data["losses"]:
        params, state, loss, norm = _train_step(params, state, features, truth)
        losses.append(float(loss))
        norms.append(float(norm))
    report.close(name, "losses", losses / data["losses"], np.ones(len(losses)), 1e-4)
    close_relative(
        report, name, "grad_norms_before_clip", norms, data["grad_norms_before_clip"], 1e-3
    )
    close_parameters(report, name, flatten(params), data, 2e-4)


CHECKS = {
    r"small_seed\d+": _small,
    r"planner_f64_seed\d+": check_solves,
    r"planner_grad_f64_seed(\d+)_sample(\d+)": _planner_gradients,
    r"full_formula_seed(\d+)": _full,
    r"train5_mfma_seed(\d+)": _train,
}


def check_dipp(path: Path, report, dtype) -> bool:
    """Runs the check that the file's name asks for; False if it is no golden of DIPP."""
    if re.fullmatch(r"small_seed\d+_params", path.stem):
        return True  # read with the file that it belongs to
    if path.stem.startswith("full_formula") and "out/plans" not in np.load(path).files:
        return False  # DTPP's file of the same name
    return check_named(CHECKS, path, report, dtype)
