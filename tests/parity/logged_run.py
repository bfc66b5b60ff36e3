"""`golden_closed_loop_reactive.npz`: PDM-Closed among reactive agents on a nuPlan-format log."""

from pathlib import Path

import jax
import numpy as np

from spdm_jax.config import PlannerParams, pdm_closed
from spdm_jax.io.build import build_scenario
from spdm_jax.io.nuplan import NuPlanReader
from spdm_jax.io.nuplan_filter import ScenarioFilter, Window
from spdm_jax.padding import PaddingConfig, batch, to_device
from spdm_jax.simulation.agent_state import AgentSizes
from spdm_jax.simulation.drivers import planner_driver
from spdm_jax.simulation.loop import SimulationConfig, SimulationParams, simulate
from spdm_jax.types import Scenario

SPEC = pdm_closed(15)
SECONDS = 8.0
CONFIG = SimulationConfig(
    num_samples=80,
    traffic="reactive",
    sizes=AgentSizes(agents=64, replayed=64, path_points=513, footprint_points=65),
)
# Metres, over 8 s; in float32 PDM-Closed may choose another proposal on the way.
TOLERANCE = {"f64": 1e-2, "f32": 5e-2}
EGO_FIELDS = ("heading", "vx", "vy", "ax", "ay", "steering", "yaw_rate")


@jax.jit
def _run(scene: Scenario, params: PlannerParams):
    driver = planner_driver(SPEC.name, params, SPEC.config)
    return simulate(scene, driver, SimulationParams(), CONFIG)


def check_logged_run(path: Path, report, dtype) -> None:
    """Reads the log with our reader, runs, and compares the ego and every object."""
    data, name, root = np.load(path), f"{path.parent.name}/{path.name}", path.parent
    token = str(data["token"])
    chosen = ScenarioFilter(scenario_tokens=(token,))
    reader = NuPlanReader(root / "nuplan-v1.1", root / "maps", chosen, window=Window(SECONDS, 0.0))
    scenario, info = build_scenario(reader.read(token))
    scene = jax.tree.map(lambda v: v[0], to_device(batch([scenario], PaddingConfig()), dtype))
    run = jax.tree.map(np.asarray, _run(scene, SPEC.params))
    history, origin = run.history, np.asarray(scenario.origin)
    report.equal(name, "overflow or failed", bool(run.overflow | run.failed), False)
    report.equal(name, "samples", int(np.sum(history.valid)), len(data["ego"]))
    tol = TOLERANCE[report.precision]
    xy = np.stack([history.ego.x, history.ego.y], -1) + origin
    report.close(name, "ego xy", xy, data["ego"][:, 1:3], tol)
    for i, field in enumerate(EGO_FIELDS):
        ours, theirs = getattr(history.ego, field), data["ego"][:, 3 + i]
        report.close(name, f"ego {field}", ours, theirs, 5 * tol, angle=field == "heading")
    row_of = {key: i for i, key in enumerate(info.track_ids)}
    objects, agents = history.objects, data["agents"]
    shape = objects.valid.shape
    present, stored = np.zeros(shape, bool), np.zeros((*shape, 6))
    for values, key in zip(agents, data["agent_tokens"], strict=True):
        step, row = int(values[0]), row_of[str(key)]
        present[step, row] = True
        stored[step, row] = values[[2, 3, 4, 5, 7, 8]]
    report.equal(name, "objects present", objects.valid, present)
    both = present & objects.valid
    xy = np.stack([objects.x, objects.y], -1) + origin
    report.close(name, "objects xy", xy, stored[..., :2], tol, both[..., None])
    report.close(name, "objects heading", objects.heading, stored[..., 2], tol, both, True)
    report.close(name, "objects length", objects.length, stored[..., 3], tol, both)
    speed = np.stack([objects.vx, objects.vy], -1)
    report.close(name, "objects velocity", speed, stored[..., 4:], 5 * tol, both[..., None])
