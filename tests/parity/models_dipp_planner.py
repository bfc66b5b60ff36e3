"""`models/dipp` goldens of the planner: residuals, single solves."""

import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from spdm_models.dipp_losses import plan_trajectories
from spdm_models.dipp_planner import (
    TEST_SOLVER,
    TRAIN_SOLVER,
    DIPPPlannerConfig,
    bicycle,
    frenet,
    problem_from_features,
    residuals,
    solve,
)

from .models_common import EXACT_TOLERANCE, LOSS_TOLERANCE, close_relative

PLANNER = DIPPPlannerConfig()
# Float32 normal equations, in the reference too: 5e-3 seen. Float64 files hold the exact values.
SOLVE_TOLERANCE = 3e-2
SOLVE_PATH_TOLERANCE = 0.1
SOLVE_LOSS_TOLERANCE = 2e-2
EXACT_SOLVE_TOLERANCE = 1e-7
# After 50 float32 steps controls may sit in another basin; the best objective has to be as good.
BEST_OBJECTIVE_TOLERANCE = 0.05
PREDICTIONS = ("constant_velocity", "perfect", "none")


@partial(jax.jit, static_argnames=("config",))
def _at_start(controls, problem, config=PLANNER):
    agents = frenet(problem.agents_xy, problem.path)
    now = problem.x, problem.y, problem.heading, problem.speed
    motion = bicycle(controls, *now, max_steering=config.max_steering)
    states = jnp.stack([motion.x, motion.y, motion.heading, motion.speed], axis=-1)
    return residuals(controls, problem, agents, config), agents, states


def _close_residuals(report, name, prefix, ours, reference, tolerance) -> None:
    for key in ours.__dataclass_fields__:
        value = reference[f"{prefix}{key}"].reshape(-1)
        close_relative(report, name, f"{prefix}{key}", getattr(ours, key), value, tolerance)


def _close_frenet(report, name, key, ours, reference) -> None:
    """Points between two path points may fall to either in float32: 0.1 m along the path."""
    ours, reference = np.asarray(ours, float), np.asarray(reference, float)
    same = np.abs(ours[..., 0] - reference[..., 0]) < 0.05
    note = "" if same.all() else f"{np.sum(~same)} points one row apart, left out"
    report.equal(name, f"{key} rows apart", np.mean(~same) > 0.01, False)
    report.close(name, key, ours, reference, 1e-4, same[..., None], note=note)


def close_planned(report, name, prefix, loss, output, sample, ref_line, data) -> None:
    """One sample's two-step plan; the golden's arrays are float32."""
    ego, neighbors = sample.ego[0, -1], sample.neighbors[0, :, -1]
    given = {
        key: jnp.asarray(data[f"{prefix}train/{key}"][0], ego.dtype) for key in ("u0", "prediction")
    }
    weights = output.cost_weights
    problem = problem_from_features(ego, neighbors, given["prediction"], ref_line, weights)
    parts, agents, states = _at_start(given["u0"], problem)
    _close_residuals(report, name, f"{prefix}residual_u0/", parts, data, 1e-5)
    _close_frenet(report, name, f"{prefix}frenet_pred", agents, data[f"{prefix}frenet_pred"][0])
    report.close(name, f"{prefix}bicycle_u0", states, data[f"{prefix}bicycle_u0"][0], 1e-4)
    final = jnp.asarray(data[f"{prefix}train/u_final"].reshape(-1, 2), ego.dtype)
    parts, _, _ = _at_start(final, problem)
    _close_residuals(report, name, f"{prefix}residual_train_final/", parts, data, 1e-5)
    key = f"{prefix}train/"
    report.close(name, f"{key}u_final", loss.controls[0], final, SOLVE_TOLERANCE)
    driven = _drive(final, ego)
    report.close(name, f"{key}traj of u_final", driven, data[f"{key}traj"][0], 1e-4)
    report.close(name, f"{key}traj", loss.trajectory, data[f"{key}traj"], SOLVE_PATH_TOLERANCE)
    for field, value in (
        ("loss_mfma", loss.futures.total),
        ("loss_plan", loss.plan),
        ("loss_plan_cost", loss.plan_cost),
        ("loss_total", loss.total),
        ("objective_theseus", loss.plan_cost * PLANNER.num_residuals / 2),
    ):
        tol = LOSS_TOLERANCE if field == "loss_mfma" else SOLVE_LOSS_TOLERANCE
        close_relative(report, name, key + field, value, data[key + field], tol)
    report.equal(
        name, f"{prefix}objective_dim", PLANNER.num_residuals, int(data[f"{prefix}objective_dim"])
    )
    objectives = _solve(given["u0"], problem, TRAIN_SOLVER).objectives
    close_relative(
        report,
        name,
        f"{key}gn_own_objectives",
        objectives,
        data[f"{key}gn_own_objectives"],
        SOLVE_LOSS_TOLERANCE,
    )


_solve = jax.jit(solve, static_argnums=2)
_drive = jax.jit(plan_trajectories)


def check_solves(match: re.Match, path: Path, report, dtype) -> None:
    """Solves from given controls, weights and predictions, stored in float64."""
    data, name = np.load(path), path.name
    exact = report.precision == "f64"
    samples = sorted({key.split("/")[0] for key in data.files if "/in/" in key})
    for sample in samples:
        current = jnp.asarray(data[f"{sample}/in/current_state"][0], dtype)
        ref_line = jnp.asarray(data[f"{sample}/in/ref_line"], dtype)
        weights = jnp.asarray(data["cost_weights"][0], dtype)
        start = jnp.asarray(data[f"{sample}/in/u0"], dtype)
        for mode in PREDICTIONS:
            key = f"{sample}/{mode}/"
            prediction = jnp.asarray(data[f"{key}prediction"][0], dtype)
            problem = problem_from_features(current[0], current[1:], prediction, ref_line, weights)
            parts, agents, states = _at_start(start, problem)
            tol = EXACT_TOLERANCE if exact else 1e-5
            _close_residuals(report, name, f"{key}residual_u0/", parts, data, tol)
            _close_frenet(report, name, f"{key}frenet", agents, data[f"{key}frenet"][0])
            if mode == PREDICTIONS[0]:
                tol = EXACT_TOLERANCE if exact else 1e-4
                array = f"{sample}/bicycle_u0"
                report.close(name, array, states, data[array][0], tol)
            train = _solve(start, problem, TRAIN_SOLVER)
            tol = EXACT_SOLVE_TOLERANCE if exact else SOLVE_TOLERANCE
            report.close(
                name,
                f"{key}train2it/u",
                train.values.reshape(-1, 2),
                data[f"{key}train2it/u"],
                tol,
            )
            reference = data[f"{key}train2it/objective"]
            relative = train.objectives / reference
            report.close(name, f"{key}train2it/objective", relative, np.ones_like(reference), tol)
            _test_solve(report, name, key, _solve(start, problem, TEST_SOLVER), problem, data)


def _test_solve(report, name, key, solution, problem, data) -> None:
    best = float(data[f"{key}test50it/best_err"][0])
    ours = float(solution.objective)
    if report.precision == "f32":
        worse = max(0.0, ours / best - 1)
        tol = BEST_OBJECTIVE_TOLERANCE
        report.close(name, f"{key}test50it/best_err", worse, 0.0, tol, note="not worse by more")
        why = "50 float32 steps may end in another basin"
        report.not_compared(name, f"{key}test50it/u_best, err_history, traj", why)
        return
    tol = EXACT_SOLVE_TOLERANCE
    report.close(name, f"{key}test50it/best_err", ours / best, 1.0, tol)
    controls = solution.values.reshape(-1, 2)
    report.close(name, f"{key}test50it/u_best", controls, data[f"{key}test50it/u_best"], tol)
    for array in ("test50it/err_history", "test50it/gn_own_objectives"):
        if key + array in data.files:
            reference = data[key + array]
            # A reference that met its tolerance leaves the rest of its history empty.
            filled = np.isfinite(reference)
            relative = np.where(filled, solution.objectives / np.where(filled, reference, 1), 1)
            report.close(name, key + array, relative, np.ones_like(reference), tol)
    _, _, states = _at_start(controls, problem)
    report.close(name, f"{key}test50it/traj", states, data[f"{key}test50it/traj"][0], tol)
