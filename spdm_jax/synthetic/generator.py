"""Plays a named scene and hands it over as a `RawScenario`, alone or through a `Reader`."""

import inspect
import zlib
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spdm_jax.io.raw import RawArea, RawMap, RawScenario, RawTracks, ScenarioError
from spdm_jax.synthetic import junctions, scenes
from spdm_jax.synthetic.roundabout import roundabout
from spdm_jax.synthetic.stage import Stage
from spdm_jax.synthetic.traffic import NUM_HISTORY, NUM_ITERATIONS, NUM_STEPS, simulate

ORIGIN = (3.3e5, 4.69e6)
"""Where scenes lie: the size of coordinates in a UTM zone, m."""
START_TIME_US = 1_600_000_000_000_000
"""Time stamp of iteration 0."""
STEP_US = 100_000

SCENES: dict[str, Callable[..., Stage]] = {
    scene.__name__: scene
    for scene in (
        scenes.open_road,
        scenes.straight,
        scenes.curve,
        scenes.parked_car,
        scenes.lane_ends,
        scenes.jaywalker,
        scenes.oncoming,
        scenes.platoon,
        junctions.intersection,
        junctions.red_light,
        junctions.tight_turn,
        roundabout,
    )
}
"""Scene functions by name; their keyword arguments are the options of `make_scene`."""


def scene_names() -> tuple[str, ...]:
    """Returns the names that `make_scene` knows."""
    return tuple(SCENES)


def make_scene(name: str, seed: int = 0, **options: object) -> RawScenario:
    """Returns a scene; equal arguments give equal bytes.

    Args:
      name: one of `scene_names()`.
      seed: varies geometry, actors, speeds, and the place and direction of the whole scene.
      **options: keyword arguments of the scene function, such as `gap` of "parked_car".

    Raises:
      ValueError: unknown name or option, a negative seed, or an option out of range.
    """
    if name not in SCENES:
        raise ValueError(f"scene {name!r} is unknown; choose one of {', '.join(SCENES)}")
    if seed < 0:
        raise ValueError(f"seed is {seed}; it must be >= 0")
    known = [p for p in inspect.signature(SCENES[name]).parameters if p != "rng"]
    for option in options:
        if option not in known:
            raise ValueError(f"scene {name!r} has no option {option!r}; it has {', '.join(known)}")
    return play(name, seed, partial(SCENES[name], **options))


def play(name: str, seed: int, scene: Callable[[np.random.Generator], Stage]) -> RawScenario:
    """Plays a stage and puts it down somewhere; equal arguments give equal bytes.

    Args:
      name: becomes the scenario's type and, with the seed, its token.
      seed: of `scene`, of the drivers, and of the place and direction of the whole scene.
      scene: makes the stage.
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return record(scene, rng, token=f"{name}-{seed}", scenario_type=name)


def record(
    scene: Callable[[np.random.Generator], Stage],
    rng: np.random.Generator,
    *,
    token: str,
    scenario_type: str,
    log_name: str = "synthetic",
    num_iterations: int = NUM_ITERATIONS,
    num_steps: int = NUM_STEPS,
    remember_static: bool = False,
) -> RawScenario:
    """Draws place and direction of a scene, sets its stage and records what happens on it.

    Args:
      scene: sets the stage.
      rng: source of all variety.
      token: as in `RawScenario`.
      scenario_type: likewise.
      log_name: likewise.
      num_iterations: likewise.
      num_steps: recorded steps in all.
      remember_static: see `simulate`.
    """
    angle = rng.uniform(-np.pi, np.pi)
    origin = np.array(ORIGIN) + np.round(rng.uniform(-2000.0, 2000.0, 2), 1)
    stage = scene(rng)
    ego, tracks = simulate(
        stage.ego,
        stage.followers,
        stage.scripted,
        stage.lights,
        rng,
        num_steps,
        remember_static,
    )
    goal = stage.builder.lanes[stage.route[-1]].centerline[-1]

    frame = _Frame(float(angle), origin)
    roadblocks = [stage.builder.lanes[lane].roadblock for lane in stage.route]
    # Lines at which only the recorded ego waits are no lights.
    lights = {i: status for i, status in stage.lights.items() if i in stage.builder.lanes}
    return RawScenario(
        token=token,
        log_name=log_name,
        scenario_type=scenario_type,
        source="synthetic",
        map=frame.map(stage.builder.build()),
        time_us=START_TIME_US + STEP_US * (np.arange(num_steps, dtype=np.int64) - NUM_HISTORY),
        num_history=NUM_HISTORY,
        num_iterations=num_iterations,
        ego=np.column_stack([frame.poses(ego[:, :3]), ego[:, 3:]]),
        ego_valid=np.ones(num_steps, dtype=bool),
        tracks=frame.tracks(tracks),
        lights=[{i: int(s[k]) for i, s in lights.items()} for k in range(num_steps)],
        route_roadblocks=list(dict.fromkeys(roadblocks)),
        mission_goal=frame.poses(goal),
    )


class SyntheticReader:
    """Offers scenes as a data set: every name with every seed, with default options."""

    def __init__(self, names: Sequence[str] | None = None, seeds: Sequence[int] = (0,)):
        """Selects the scenes.

        Args:
          names: scene names; all if None.
          seeds: seeds of each scene.

        Raises:
          ValueError: unknown name or negative seed.
        """
        names = scene_names() if names is None else tuple(names)
        if unknown := [n for n in names if n not in SCENES]:
            raise ValueError(f"names has {unknown}; choose from {', '.join(SCENES)}")
        if negative := [s for s in seeds if s < 0]:
            raise ValueError(f"seeds has {negative}; they must be >= 0")
        self._scenes = {f"{n}-{s}": (n, s) for n in names for s in seeds}

    def tokens(self) -> Sequence[str]:
        """Returns the tokens, "name-seed"."""
        return tuple(self._scenes)

    def read(self, token: str) -> RawScenario:
        """Returns one scene.

        Raises:
          ScenarioError: the token is not among `tokens()`.
        """
        if token not in self._scenes:
            raise ScenarioError(
                f"synthetic: token {token!r} is not selected; it must be name-seed with the names "
                f"and seeds this reader was made with (such as {next(iter(self._scenes), None)!r})"
            )
        name, seed = self._scenes[token]
        return make_scene(name, seed)


class _Frame:
    """Moves a scene from its own frame to map coordinates: rotation, then translation."""

    def __init__(self, angle: float, origin: np.ndarray):
        self.angle = angle
        self.origin = origin

    def vectors(self, xy: np.ndarray) -> np.ndarray:
        """Rotates `[..., 2]` vectors."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        x, y = xy[..., 0], xy[..., 1]
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)

    def points(self, xy: np.ndarray) -> np.ndarray:
        """Moves `[..., 2]` points."""
        return self.vectors(xy) + self.origin

    def poses(self, pose: np.ndarray) -> np.ndarray:
        """Moves `[..., 3]` poses; headings come out in [-pi, pi)."""
        heading = (pose[..., 2] + self.angle + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([self.points(pose[..., :2]), heading[..., None]], axis=-1)

    def geometry(self, shape: BaseGeometry) -> BaseGeometry:
        """Moves a geometry."""
        return shapely.transform(shape, self.points)

    def tracks(self, tracks: RawTracks) -> RawTracks:
        """Moves tracks; unobserved entries stay zero."""
        mask = tracks.valid[..., None]
        return RawTracks(
            ids=tracks.ids,
            type=tracks.type,
            pose=np.where(mask, self.poses(tracks.pose), 0.0),
            velocity=self.vectors(tracks.velocity),
            size=tracks.size,
            valid=tracks.valid,
        )

    def map(self, raw: RawMap) -> RawMap:
        """Moves a map, in place of the old one."""
        for lane in raw.lanes.values():
            lane.centerline = self.poses(lane.centerline)
            lane.left_boundary = self.points(lane.left_boundary)
            lane.right_boundary = self.points(lane.right_boundary)
            lane.polygon = self.points(lane.polygon)
        for block in raw.roadblocks.values():
            block.polygon = self.geometry(block.polygon)
        for layer in (
            "intersections",
            "car_parks",
            "drivable",
            "crosswalks",
            "walkways",
            "stop_lines",
        ):
            areas: list[RawArea] = getattr(raw, layer)
            setattr(raw, layer, [RawArea(a.id, self.geometry(a.polygon), a.kind) for a in areas])
        return raw
