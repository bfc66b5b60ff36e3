"""`TorchScorer` and `torch_score`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, overload

import jax
import numpy as np

from spdm_jax.api import refuse_foreign, scenarios_only, to_navsim
from spdm_jax.batching import Precision, usable_cores, x64
from spdm_jax.config import DT, PlannerConfig, PlannerParams, Tracker
from spdm_jax.navsim.evaluate import pose_interval
from spdm_jax.navsim.frames import NavsimSet
from spdm_jax.programs import Program, program
from spdm_jax.results import ScenarioSet
from spdm_jax.scoring.profile import TUPLAN, Profile, profile_named
from spdm_jax.torch_bridge.held import UnusableScene, held_scenes
from spdm_jax.torch_bridge.task import (
    AnyTask,
    NavsimTask,
    Task,
    components_of,
    score_batch,
    score_rows,
)
from spdm_jax.trajectories import Frame, resample

if TYPE_CHECKING:
    from torch import Tensor  # pyright: ignore[reportMissingImports]


class TorchScorer:
    """Scores torch trajectories in scenes that stay on the device. Several threads may call it.

    A scenario goes to the device when it is first asked for. Programs are compiled per shape: once
    for `[P, T]` on a CPU, where scenes run on all cores, once for `[B, P, T]` on an accelerator.

    Args:
      scenes: from `spdm_jax.load` or `from_raw`; for NAVSIM's profiles also from `load_navsim`.
      dt: interval of the poses, s; resampled as `spdm_jax.score` does, which also says what None
        stands for.
      frame: "ego" (x forward from the current rear axle), "local" (the scene's own) or "global"
        (map coordinates; float64 tensors only).
      tracker: "reference", "corrected", or "none" to differentiate the poses instead.
      config: forecast mode, progress reference and caps.
      params: weights, thresholds, vehicle.
      precision: "f32" or "f64"; also the type of the result.
      device: JAX device to compute on; the first one if None.
      threads: scenes at a time on a CPU, None for one per core.
      profile: whose rules; see `spdm_jax.score`. NAVSIM's leave extended comfort out.

    Attributes:
      components: names of the scores.
      programs: programs made or loaded from disk so far.
      compile_s: seconds that took.
    """

    def __init__(
        self,
        scenes: ScenarioSet | NavsimSet,
        *,
        dt: float | None = None,
        frame: Frame = "ego",
        tracker: Tracker | Literal["none"] = "reference",
        config: PlannerConfig | None = None,
        params: PlannerParams | None = None,
        precision: Precision = "f32",
        device: Any = None,
        threads: int | None = None,
        profile: str = "tuplan",
    ):
        _check_settings(frame, tracker, precision)
        rules = profile_named(profile)
        scenes = _scenes_for(scenes, rules, precision, tracker, config)
        self._held = held_scenes(scenes, precision, device or jax.local_devices()[0])
        # Map coordinates become local ones before they are rounded to float32.
        inner: Frame = "local" if frame == "global" else frame
        step = DT if dt is None else float(dt)
        if rules is TUPLAN:
            config = config or PlannerConfig()
            if tracker != "none":
                config = replace(config, tracker=tracker)
            config = replace(config, max_path_points=self._held.path_room)
            self._task: AnyTask = Task(config, tracker != "none", inner, step)
        else:
            self._task = NavsimTask(rules, inner, step)
        self._says_dt = dt is not None
        self.components = components_of(self._task)
        self._global = frame == "global"
        self._params = self._held.params(params)
        self._threads = threads or usable_cores()
        self.programs, self.compile_s = 0, 0.0

    def __call__(
        self, trajectories: Tensor, tokens: Sequence[str] | None = None
    ) -> dict[str, Tensor]:
        """Scores trajectories.

        Args:
          trajectories: `[B, P, T, 3]` rear-axle poses x, y, heading; any floating type.
          tokens: B scenes, in any order, repeated or not; all scenes in their order if None.

        Returns:
          `[B, P]` for every name of `components`, on the device of `trajectories`. The work is
          finished when it returns.

        Raises:
          ValueError: shape, type, tokens or values are of no use, the tensor requires a gradient,
            or a scene cannot be scored.
        """
        import torch  # pyright: ignore[reportMissingImports]

        task = self._task_for(trajectories)
        _check_tensor(trajectories, task.dt)
        rows = self._held.rows(tokens, len(trajectories))
        with torch.no_grad():
            if self._global:
                trajectories = self._held.from_global(trajectories, rows)
            wanted = torch.float64 if self._held.precision == "f64" else torch.float32
            trajectories = trajectories.to(wanted).contiguous()
            if self._held.device.platform == "cpu":
                scores, problems = self._scene_by_scene(task, trajectories, rows)
            else:
                scores, problems = self._at_once(task, trajectories, rows)
        self._held.refuse(rows, problems)
        return dict(zip(self.components, scores, strict=True))

    def _task_for(self, trajectories: Tensor) -> AnyTask:
        """NAVSIM's own eight poses are 0.5 s apart, unless the user says otherwise."""
        if self._says_dt or not isinstance(self._task, NavsimTask):
            return self._task
        shape = tuple(getattr(trajectories, "shape", ()))
        return replace(self._task, dt=pose_interval(shape, None))

    def _scene_by_scene(
        self, task: AnyTask, trajectories: Tensor, rows: np.ndarray
    ) -> tuple[Tensor, np.ndarray]:
        import torch  # pyright: ignore[reportMissingImports]

        held, device = self._held, trajectories.device
        if device.type != "cpu":
            trajectories = trajectories.cpu()
        with x64(held.precision):
            shape = jax.ShapeDtypeStruct(tuple(trajectories.shape[1:]), held.dtype)
            name = ("torch one scene", task, held.precision)
            make = lambda: jax.jit(partial(score_rows, task))
            made = self._program(name, make, (held.shape(), shape, self._params))
        count = trajectories.shape[:2]
        scores = torch.empty((len(self.components), *count), dtype=trajectories.dtype)
        problems, into = np.zeros(count[0], np.int32), scores.numpy()

        def run(row: int) -> None:
            with x64(held.precision):  # a setting of the thread
                poses = from_torch(trajectories[row], held.device)
                found = made.call(held.scene(int(rows[row]), made), poses, self._params)
                into[:, row] = np.asarray(found.scores)
                problems[row] = np.asarray(found.problem)

        if self._threads == 1 or count[0] == 1:
            for row in range(count[0]):
                run(row)
        else:
            list(held.pool(self._threads).map(run, range(count[0])))
        return scores.to(device), problems

    def _at_once(
        self, task: AnyTask, trajectories: Tensor, rows: np.ndarray
    ) -> tuple[Tensor, np.ndarray]:
        held = self._held
        with x64(held.precision):
            poses = from_torch(trajectories, held.device)
            index = jax.device_put(rows.astype(np.int32), held.device)
            name = ("torch batch", task, held.precision)
            make = lambda: jax.jit(partial(score_batch, task))
            made = self._program(name, make, (held.shape(len(held)), index, poses, self._params))
            found = made.call(held.stacked(made), index, poses, self._params)
            # Reading one result waits for all: nobody may change the tensor before.
            problems = np.asarray(found.problem)
            return to_torch(found.scores, trajectories.device), problems

    def _program(self, name: Any, make: Any, args: Any) -> Program:
        made, new = program(name, score_rows, make, args, [self._held.device])
        if new:
            self.programs += 1
            self.compile_s += made.seconds
        return made

    def unusable(self, trajectories: Tensor) -> dict[str, str]:
        """Scores the same trajectories in every scene and says which scenes cannot be scored.

        Also compiles for this shape (on a CPU), and moves all scenes to the device.

        Args:
          trajectories: `[P, T, 3]` on the device of the training, such as zeros.

        Returns:
          Token -> reason.
        """
        found: dict[str, str] = {}
        for token in self._held.tokens:
            try:
                self(trajectories[None], [token])
            except UnusableScene as error:
                found[token] = str(error)
        return found


@overload
def torch_score(
    scenes: ScenarioSet | NavsimSet,
    trajectories: Tensor,
    tokens: Sequence[str] | None = None,
    *,
    component: str = "total",
    dt: float | None = None,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    profile: str = "tuplan",
) -> Tensor: ...
@overload
def torch_score(
    scenes: ScenarioSet | NavsimSet,
    trajectories: Tensor,
    tokens: Sequence[str] | None = None,
    *,
    component: tuple[str, ...] | list[str],
    dt: float | None = None,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    profile: str = "tuplan",
) -> dict[str, Tensor]: ...
def torch_score(
    scenes: ScenarioSet | NavsimSet,
    trajectories: Tensor,
    tokens: Sequence[str] | None = None,
    *,
    component: str | Sequence[str] = "total",
    dt: float | None = None,
    frame: Frame = "ego",
    tracker: Tracker | Literal["none"] = "reference",
    config: PlannerConfig | None = None,
    params: PlannerParams | None = None,
    precision: Precision = "f32",
    profile: str = "tuplan",
) -> Tensor | dict[str, Tensor]:
    """Scores torch trajectories with the PDM score; see `TorchScorer` for settings and errors.

    The scenes stay on the device between calls, for as long as the set lives. The score is
    piecewise constant and has no gradient: a tensor that requires one is refused. Use it as a
    reward: pass `trajectories.detach()`.

    Args:
      scenes: from `spdm_jax.load` or `from_raw`.
      trajectories: `[B, P, T, 3]` rear-axle poses x, y, heading; any floating type.
      tokens: B scenes, in any order, repeated or not; all scenes in their order if None.
      component: a name of `COMPONENTS` (of `navsim.results.COMPONENTS` for NAVSIM's profiles), or
        several.
      dt: see `TorchScorer`, like what follows.
      frame: see above.
      tracker: see above.
      config: see above.
      params: see above; None is fastest, others go to the device at every call.
      precision: see above.
      profile: see above.

    Returns:
      `[B, P]` on the device of `trajectories`, or component -> `[B, P]` where several are asked
      for.
    """
    names = (component,) if isinstance(component, str) else tuple(component)
    scorer = TorchScorer(
        scenes,
        dt=dt,
        frame=frame,
        tracker=tracker,
        config=config,
        params=params,
        precision=precision,
        profile=profile,
    )
    if unknown := [name for name in names if name not in scorer.components]:
        known = ", ".join(scorer.components)
        raise ValueError(f"no component {unknown[0]!r}; there are {known}")
    found = scorer(trajectories, tokens)
    return found[component] if isinstance(component, str) else {name: found[name] for name in names}


def from_torch(tensor: Tensor, device: Any) -> jax.Array:
    """Hands a contiguous tensor to JAX, without a copy where it lies on the device already."""
    if (tensor.device.type == "cpu") == (device.platform == "cpu"):
        array = jax.dlpack.from_dlpack(tensor)
        return array if device in array.devices() else jax.device_put(array, device)
    return jax.device_put(tensor.cpu().numpy(), device)


def to_torch(array: jax.Array, device: Any) -> Tensor:
    """Hands an array to torch, without a copy where it lies on the torch device already."""
    import torch  # pyright: ignore[reportMissingImports]

    (place,) = array.devices()
    if (device.type == "cpu") == (place.platform == "cpu"):
        return torch.from_dlpack(array).to(device)
    return torch.from_numpy(np.array(array)).to(device)


def _scenes_for(
    scenes: ScenarioSet | NavsimSet,
    rules: Profile,
    precision: Precision,
    tracker: str,
    config: PlannerConfig | None,
) -> ScenarioSet | NavsimSet:
    """Returns what a profile is scored in.

    Raises:
      ValueError: scenes or settings do not go with the profile.
    """
    if rules is TUPLAN:
        return scenarios_only(scenes)
    refuse_foreign(tracker=tracker, config=config)
    frames = to_navsim(scenes, precision=precision)
    frames.require(rules)
    return frames


def _check_settings(frame: str, tracker: str, precision: str) -> None:
    for name, value, allowed in (
        ("frame", frame, ("ego", "local", "global")),
        ("tracker", tracker, ("reference", "corrected", "none")),
        ("precision", precision, ("f32", "f64")),
    ):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}; it must be one of {allowed}")


def _check_tensor(trajectories: Tensor, dt: float) -> None:
    import torch  # pyright: ignore[reportMissingImports]

    if not isinstance(trajectories, torch.Tensor):
        raise ValueError(
            f"trajectories is a {type(trajectories).__name__}; pass a torch tensor here, NumPy and "
            "JAX arrays to spdm_jax.score"
        )
    shape = tuple(trajectories.shape)
    if len(shape) != 4 or shape[-1] != 3 or 0 in shape:
        raise ValueError(f"trajectories has shape {shape}; expected [B, P, T, 3]")
    if not trajectories.is_floating_point():
        raise ValueError(f"trajectories is {trajectories.dtype}; pass a floating type")
    if trajectories.requires_grad:
        raise ValueError(
            "trajectories requires a gradient, but the score is piecewise constant and has none. "
            "Pass trajectories.detach() to use it as a reward"
        )
    if not dt > 0:
        raise ValueError(f"dt is {dt}; it must be a positive number of seconds")
    resample(np.zeros((1, 1, shape[2], 3)), dt)  # raises what is wrong with the steps
    finite = torch.isfinite(trajectories)
    if not finite.all():
        at = tuple(torch.nonzero(~finite)[0].tolist())
        raise ValueError(
            f"trajectories{list(at)} is {trajectories[at].item()}; all poses must be finite "
            f"({int((~finite).sum())} values are not)"
        )
