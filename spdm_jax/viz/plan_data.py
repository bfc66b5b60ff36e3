"""What a picture shows of one plan: real proposals, scores, reasons, and where a rule is broken."""

from dataclasses import dataclass

import jax
import numpy as np
import shapely

from spdm_jax.config import DT, NUM_STATES, VehicleParams
from spdm_jax.results import Explanation, PlanSet, ScenarioSet, ScoreSet
from spdm_jax.scoring.collision import LOOK_AHEAD
from spdm_jax.viz.scene_data import ObjectsView, box_corners, ego_center
from spdm_jax.viz.style import RULES, TERMS

_SAMPLES = (NUM_STATES + LOOK_AHEAD[-1] + 1) // 2  # forecast samples that the score looks at


@dataclass(frozen=True)
class Moment:
    """The moment at which a proposal breaks a rule.

    Attributes:
      rule: term of the score, one of `RULES`.
      step: index of the proposal's state, 0.1 s apart.
      label: rule and time in words.
      ego: `[3]` box centre of the ego.
      ahead: `[3]` box centre of the ego moved on to the predicted contact, or None.
      object: row in `ObjectsView`, -1 if no object is to blame.
      object_pose: `[3]` box centre of the object as the score saw it, or None.
    """

    rule: str
    step: int
    label: str
    ego: np.ndarray
    ahead: np.ndarray | None
    object: int
    object_pose: np.ndarray | None


@dataclass(frozen=True)
class PlanView:
    """The real proposals of one scene, `[P]`, and the objects' forecast.

    Attributes:
      name: planner.
      status: see `ScoreSet.status`.
      braking: the plan is the emergency brake's instead of a proposal.
      row: `[P]` row among all proposals, padding included.
      best: index of the chosen proposal (the first with the highest score).
      states: `[P, 41, 4]` rear-axle x, y, heading and speed.
      scores: per term of `TERMS`, `[P]`; and `progress_raw` (m).
      explanations: one per proposal.
      moments: where a proposal first breaks a rule, None if it breaks none at one moment.
      stage, path: `[P]`, -1 where unknown.
      target_speed: `[P]` m/s, NaN where unknown.
      lane: id of the lane a stage-2 proposal merges onto, else "".
      forecast: `[N, 25, 3]` box centres every 0.2 s of the rows of `ObjectsView`, NaN if unseen.
      ignored: `[N]` bool, objects that cannot cost points.
    """

    name: str
    status: str
    braking: bool
    row: np.ndarray
    best: int
    states: np.ndarray
    scores: dict[str, np.ndarray]
    explanations: list[Explanation]
    moments: list[Moment | None]
    stage: np.ndarray
    path: np.ndarray
    target_speed: np.ndarray
    lane: list[str]
    forecast: np.ndarray
    ignored: np.ndarray


def check_plans(scenes: ScenarioSet, plans: ScoreSet) -> None:
    """Checks that plans (or scores) belong to a set of scenes.

    Raises:
      ValueError: they were made for other scenes.
    """
    wanted = [info.token for info in scenes.infos]
    given = [info.token for info in plans.infos]
    if wanted != given:
        at = next(
            (i for i, (a, b) in enumerate(zip(wanted, given, strict=False)) if a != b),
            min(len(wanted), len(given)),
        )
        name = lambda tokens: repr(tokens[at]) if at < len(tokens) else "missing"
        raise ValueError(
            f"plans.infos[{at}] is {name(given)}, but that scene is {name(wanted)}; pass the very "
            "scenes that the plans were made from"
        )


def read_plan(
    plans: ScoreSet, index: int, objects: ObjectsView, vehicle: VehicleParams
) -> PlanView:
    """Returns the real proposals of one scene.

    Args:
      plans: plans, or scores of given trajectories.
      index: row of the scene.
      objects: objects at iteration 0, which the forecast is matched with.
      vehicle: ego dimensions.

    Raises:
      ValueError: the scene has no real proposal.
    """
    valid = np.asarray(plans.scores.valid)[index]
    row = np.flatnonzero(valid)
    if not len(row):
        raise ValueError(f"scene {plans.infos[index].token}: no real proposal to draw")
    of = lambda values: np.asarray(values)[index][row]
    tracked = plans.tracked
    pose = [of(tracked.x), of(tracked.y), of(tracked.heading)]
    states = np.stack([*pose, np.hypot(of(tracked.vx), of(tracked.vy))], -1).astype(float)
    scores = {name: of(getattr(plans.scores, name)).astype(float) for name in TERMS}
    scores["progress_raw"] = of(plans.scores.progress_raw).astype(float)
    forecast, ignored = _match_forecast(plans, index, objects)
    explanations = [plans.explain(index, int(r)) for r in row]
    unknown = np.full(len(row), -1)
    stage, path, speed, lane, braking = unknown, unknown, np.full(len(row), np.nan), unknown, False
    best = int(np.argmax(np.where(np.isnan(scores["total"]), -1, scores["total"])))
    if isinstance(plans, PlanSet):
        proposals, result = plans.plans.proposals, plans.plans
        stage, path, lane = of(proposals.stage), of(proposals.path), of(proposals.lane)
        speed = np.asarray(result.target_speed)[index][of(proposals.policy)].astype(float)
        best = int(np.searchsorted(row, plans.best[index]))
        braking = bool(np.asarray(result.emergency_brake)[index])
    lane_ids = plans.infos[index].lane_ids
    view = PlanView(
        name=plans.name if isinstance(plans, PlanSet) else "given trajectories",
        status=plans.status[index],
        braking=braking,
        row=row,
        best=best,
        states=states,
        scores=scores,
        explanations=explanations,
        moments=[],
        stage=stage,
        path=path,
        target_speed=speed,
        lane=[lane_ids[i] if i >= 0 else "" for i in lane],
        forecast=forecast,
        ignored=ignored,
    )
    blamed = {
        "no_at_fault_collision": of(plans.scores.collision_object),
        "time_to_collision": of(plans.scores.ttc_object),
    }
    rows = np.asarray(plans.forecast.track)[index]
    for i, told in enumerate(explanations):
        column = blamed.get(told.rule or "")
        track = -1 if column is None or column[i] < 0 else int(rows[column[i]])
        view.moments.append(_moment(told, states[i], track, objects, forecast, vehicle))
    return view


def _match_forecast(
    plans: ScoreSet, index: int, objects: ObjectsView
) -> tuple[np.ndarray, np.ndarray]:
    """Puts the forecast into the order of the objects."""
    seen = jax.tree.map(lambda values: np.asarray(values)[index], plans.forecast)
    poses = np.stack([seen.x, seen.y, seen.heading], -1)[:, :_SAMPLES].astype(float)
    poses[~np.asarray(seen.sample_valid)[:, :_SAMPLES]] = np.nan
    row_of = {int(t): i for i, t in enumerate(seen.track) if seen.valid[i]}
    forecast = np.full((len(objects.track), _SAMPLES, 3), np.nan)
    ignored = np.zeros(len(objects.track), bool)
    for i, track in enumerate(objects.track):
        if (row := row_of.get(int(track))) is not None:
            forecast[i], ignored[i] = poses[row], seen.ignored[row]
    return forecast, ignored


def _moment(
    told: Explanation,
    states: np.ndarray,
    track: int,
    objects: ObjectsView,
    forecast: np.ndarray,
    vehicle: VehicleParams,
) -> Moment | None:
    """Finds where ego and object stand when a proposal first breaks a rule."""
    if told.rule not in RULES or told.step is None:
        return None
    step = min(told.step, NUM_STATES - 1)
    ego = ego_center(states[step, :3], vehicle)
    label = f"{RULES[told.rule]}, t = {DT * step:.1f} s"
    found = np.flatnonzero(objects.track == track)
    if not len(found):
        return Moment(told.rule, step, label, ego, None, -1, None)
    who = int(found[0])
    # Like the score: the forecast holds for two steps, and TTC moves the ego on at constant speed.
    pose, ahead = forecast[who, step // 2], None
    if told.rule == "time_to_collision":
        sides = float(vehicle.length), float(vehicle.width)
        for steps in LOOK_AHEAD:
            way = DT * steps * states[step, 3]
            later = ego + way * np.array([np.cos(ego[2]), np.sin(ego[2]), 0.0])
            there = forecast[who, min((step + steps) // 2, _SAMPLES - 1)]
            if _touch(box_corners(later, *sides), box_corners(there, *objects.size[who])):
                pose, ahead = there, later
                break
    return Moment(told.rule, step, label, ego, ahead, who, pose)


def _touch(a: np.ndarray, b: np.ndarray) -> bool:
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    return bool(shapely.intersects(shapely.Polygon(a), shapely.Polygon(b)))


def telling_proposal(view: PlanView) -> int | None:
    """Returns the proposal whose broken rule is worth showing.

    The chosen one if it breaks a rule, else the best of those that do (of equals one that an
    object stops), else None.
    """
    if view.moments[view.best] is not None:
        return view.best
    failing = [i for i, moment in enumerate(view.moments) if moment is not None]

    def worth(i: int) -> tuple[float, bool]:
        moment = view.moments[i]
        return float(
            np.nan_to_num(view.scores["total"][i])
        ), moment is not None and moment.object >= 0

    return max(failing, key=worth, default=None)


def object_poses(objects: ObjectsView, forecast: np.ndarray, step: int) -> np.ndarray:
    """Returns box centres `[N, 3]` at a step, between forecast samples halfway.

    Args:
      objects: objects at iteration 0.
      forecast: `[N, 25, 3]`.
      step: 0.1 s each; at 0 unforecast objects stand where observed, later they are NaN.
    """
    low = step // 2
    high = min(low + step % 2, _SAMPLES - 1)
    before, after = forecast[:, low], forecast[:, high]
    turn = np.angle(np.exp(1j * (after[:, 2] - before[:, 2])))
    change = np.concatenate([after[:, :2] - before[:, :2], turn[:, None]], axis=1)
    poses = before + 0.5 * change
    return np.where(np.isnan(poses), objects.pose, poses) if step == 0 else poses
