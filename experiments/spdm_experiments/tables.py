"""What the verbs print: one line per scene."""

import numpy as np
from rich.console import Console
from rich.table import Table

from spdm_jax import PlannerSpec, PlanSet, ScoreSet

_SUBSCORES = {
    "no_at_fault_collision": "NC",
    "drivable_area": "DAC",
    "driving_direction": "DDC",
    "time_to_collision": "TTC",
    "comfort": "C",
    "progress": "EP",
}
_LEGEND = (
    "NC no at-fault collision, DAC drivable area, DDC driving direction, TTC time to collision, "
    "C comfort,\nEP progress relative to the best of the scene's rows"
)


_PLAN_LEGEND = (
    _LEGEND + ", per planner; N_p real proposals, st stage;\n"
    "m centre, m goal: metres in 4 s along the centreline and along the way to the goal"
)


def console() -> Console:
    """Returns where tables go; wide enough for them where the output is no terminal."""
    found = Console(highlight=False)
    return found if found.is_terminal else Console(highlight=False, width=140)


def plan_table(title: str) -> Table:
    """Returns an empty table of plans."""
    table = _table(title, _PLAN_LEGEND, ("scene", "planner"), ("N_p", "st"))
    table.add_column("path")
    table.add_column("m/s", justify="right")
    for name in ("score", *_SUBSCORES.values(), "m centre", "m goal"):
        table.add_column(name, justify="right")
    table.add_column("brake")
    return table


def add_plans(table: Table, result: PlanSet, planner: PlannerSpec, rows: range) -> None:
    """Adds the chosen proposals of some scenes; a scene without usable scores says so."""
    status = result.status
    for i in rows:
        token = result.infos[i].token
        if status[i] != "ok":
            table.add_row(token, result.name, status[i])
            continue
        best = int(result.best[i])
        proposals = result.plans.proposals
        speed = np.asarray(result.plans.target_speed)[i, np.asarray(proposals.policy)[i, best]]
        table.add_row(
            token,
            result.name,
            str(result.num_proposals[i]),
            str(np.asarray(proposals.stage)[i, best]),
            path_name(result, planner, i, best),
            f"{speed:.1f}",
            *_scores(result, i, best),
            f"{np.asarray(result.plans.progress_centerline)[i, best]:.1f}",
            f"{np.asarray(result.plans.progress_goal)[i, best]:.1f}",
            "yes" if np.asarray(result.plans.emergency_brake)[i] else "",
        )


def path_name(result: PlanSet, planner: PlannerSpec, scene: int, proposal: int) -> str:
    """Names the path of a proposal: by its offset from the centreline, or the lane it goes to."""
    proposals = result.plans.proposals
    if int(np.asarray(proposals.stage)[scene, proposal]) == 2:
        lane = int(np.asarray(proposals.lane)[scene, proposal])
        return f"lane {result.infos[scene].lane_ids[lane]}"
    path = int(np.asarray(proposals.path)[scene, proposal])
    offset = float(np.asarray(planner.params.lateral_offsets)[path])
    return f"{offset:+.1f} m" if offset else "centreline"


def score_table(title: str) -> Table:
    """Returns an empty table of given trajectories."""
    table = _table(title, _LEGEND, ("scene",), ("rows", "mean", "best"))
    for name in ("score", *_SUBSCORES.values(), "m"):
        table.add_column(name, justify="right")
    table.add_column("costs most")
    return table


def add_scores(table: Table, result: ScoreSet, rows: range) -> None:
    """Adds the best trajectories of some scenes, and what they lost most points for."""
    status = result.status
    for i in rows:
        token = result.infos[i].token
        if status[i] != "ok":
            table.add_row(token, status[i])
            continue
        total = np.asarray(result.scores.total)[i]
        best = int(np.argmax(total))
        table.add_row(
            token,
            str(len(total)),
            f"{total.mean():.3f}",
            str(best),
            *_scores(result, i, best),
            f"{np.asarray(result.scores.progress_raw)[i, best]:.1f}",
            result.explain(i, best).rule or "",
        )


def _table(title: str, legend: str, texts: tuple[str, ...], numbers: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", caption=legend, caption_justify="left")
    for name in texts:
        table.add_column(name, no_wrap=True)
    for name in numbers:
        table.add_column(name, justify="right")
    return table


def _scores(result: ScoreSet, scene: int, row: int) -> list[str]:
    at = lambda name: float(np.asarray(getattr(result.scores, name))[scene, row])
    return [
        f"{at('total'):.3f}",
        *(f"{at(name):.2f}".rstrip("0").rstrip(".") for name in _SUBSCORES),
    ]
