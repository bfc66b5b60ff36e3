"""Bad input at the public functions: the message names file, field and value."""

import dataclasses
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import pytest
import shapely

import small_road as roads
import spdm_jax
from spdm_jax.io.build import build_scenario
from spdm_jax.io.raw import RawArea, RawScenario, ScenarioError
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.results import ScenarioSet

GOOD = "good"


def road(token: str, **options) -> RawScenario:
    return roads.road(token=token, things=[roads.parked(30.0)], **options)


def nan_ego(raw: RawScenario) -> None:
    raw.ego[raw.num_history, 1] = np.nan


def infinite_ego(raw: RawScenario) -> None:
    raw.ego[5, 0] = np.inf


def nan_track(raw: RawScenario) -> None:
    raw.tracks.pose[0, 3, 2] = np.nan


def flat_track(raw: RawScenario) -> None:
    raw.tracks.size[0, 3] = [4.5, 0.0]


def no_route(raw: RawScenario) -> None:
    raw.route_roadblocks = []


def unknown_route(raw: RawScenario) -> None:
    raw.route_roadblocks = ["nowhere", "elsewhere"]


def no_route_lanes(raw: RawScenario) -> None:
    for key in ("b0", "c0", "b1"):
        raw.map.roadblocks[key].lanes = ()
        raw.map.lanes = {k: v for k, v in raw.map.lanes.items() if v.roadblock != key}
    far = roads.road(token="x").map.lanes["b0/0"]
    raw.map.roadblocks["other"] = dataclasses.replace(
        raw.map.roadblocks["b0"], id="other", lanes=("other/0",), successors=(), predecessors=()
    )
    raw.map.lanes["other/0"] = dataclasses.replace(
        far, id="other/0", roadblock="other", successors=(), predecessors=()
    )


def two_points(raw: RawScenario) -> None:
    lane = raw.map.lanes["b0/1"]
    lane.polygon = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 0.0]])


def nan_polygon(raw: RawScenario) -> None:
    raw.map.lanes["b0/1"].centerline[2, 0] = np.nan


def empty_area(raw: RawScenario) -> None:
    raw.map.car_parks.append(RawArea("park", shapely.Polygon()))
    raw.map.car_parks[-1] = RawArea("park", shapely.LineString([(60, 0), (70, 0)]))


def outside(raw: RawScenario) -> None:
    raw.ego[:, 1] += 500.0


def same_track_twice(raw: RawScenario) -> None:
    tracks = raw.tracks
    rows = [0, 0]
    raw.tracks = dataclasses.replace(
        tracks,
        ids=["parked", "parked"],
        **{n: getattr(tracks, n)[rows] for n in ("type", "pose", "velocity", "size", "valid")},
    )


def unknown_type(raw: RawScenario) -> None:
    raw.tracks.type[0] = 17


def wrong_light(raw: RawScenario) -> None:
    raw.lights[2]["c0/0"] = 9


def too_many_agents(raw: RawScenario) -> None:
    raw.tracks = roads.road(
        things=[roads.Thing(10.0 * i, 40.0) for i in range(roads.PADDING.tracks[-1] + 1)]
    ).tracks


BAD: dict[Callable[[RawScenario], None], str] = {
    nan_ego: r"scenario bad: ego\[2, 1\] = nan is not finite",
    infinite_ego: r"scenario bad: ego\[5, 0\] = inf is not finite",
    nan_track: r"scenario bad: tracks.pose\[0, 3, 2\] = nan is not finite",
    flat_track: r"scenario bad: tracks.size\[0, 3\] = \[4.5, 0.0\] \(track 'parked'\)",
    no_route: r"scenario bad: route_roadblocks is empty",
    unknown_route: r"scenario bad: none of the 2 route_roadblocks \(first 'nowhere'\) is in map",
    no_route_lanes: r"bad.*roadblocks.lanes names no lane of the map for the route \['b0'",
    two_points: r"scenario bad: lanes\['b0/1'\].polygon: a ring has 2 distinct points",
    nan_polygon: r"scenario bad: lanes\['b0/1'\].centerline\[2, 0\] = nan is not finite",
    empty_area: r"scenario bad: car_parks\['park'\].polygon is LINESTRING",
    outside: r"scenario bad: the ego is outside map straight: ego\[2\] = \(60.000, 496.500\)",
    same_track_twice: r"scenario bad: tracks.ids\[1\] = 'parked' repeats tracks.ids\[0\]",
    unknown_type: r"scenario bad: tracks.type\[0\] = 17 \(track 'parked'\)",
    wrong_light: r"scenario bad: lights\[2\]\['c0/0'\] = 9 is not a LightStatus",
    too_many_agents: r"scene bad: 17 tracks, largest bucket 16. Raise PaddingConfig.tracks",
}


@pytest.mark.parametrize("spoil", BAD, ids=lambda f: f.__name__)
def test_bad_scene_in_a_batch_is_reported_and_the_others_go_on(spoil):
    bad = road("bad")
    spoil(bad)
    scenes = spdm_jax.from_raw([road(GOOD), bad, road("also-good")], padding=roads.PADDING)
    assert [info.token for info in scenes.infos] == [GOOD, "also-good"]
    assert [failure.token for failure in scenes.failures] == ["bad"]
    assert re.search(BAD[spoil], scenes.failures[0].reason), scenes.failures[0].reason
    assert "1 failed" in repr(scenes)


def test_bad_scene_alone_is_an_error():
    bad = road("bad")
    nan_ego(bad)
    with pytest.raises(ScenarioError, match=r"no usable scenario: bad: scenario bad: ego\[2, 1\]"):
        spdm_jax.from_raw([bad])
    with pytest.raises(ScenarioError, match="no usable scenario"):
        spdm_jax.from_raw([])


def test_failures_reach_the_results_and_their_tables():
    bad = road("bad")
    nan_ego(bad)
    scenes = spdm_jax.from_raw([road(GOOD), bad, road("fine")], padding=roads.PADDING)
    rows = np.zeros((8, 41, 3))
    rows[..., 0] = 0.9 * np.arange(41)
    result = spdm_jax.score(scenes, rows, precision="f64")
    assert result.failures == scenes.failures and result.status == ["ok", "ok"]
    table = result.to_table()
    assert table.height == 17
    last = table.tail(1).to_dicts()[0]
    assert last["token"] == "bad" and last["status"] == "failed" and last["total"] is None
    assert "ego[2, 1] = nan" in last["reason"]


@pytest.mark.parametrize("layer", ["intersections", "car_parks"])
def test_areas_that_touch_themselves_are_accepted(layer: str):
    raw = road("odd")
    ring = [(60, 0), (64, 0), (64, 4), (68, 4), (68, 8), (64, 8), (64, 4), (60, 4)]
    getattr(raw.map, layer).append(RawArea("odd", shapely.Polygon(ring)))
    scenes = spdm_jax.from_raw([raw], padding=roads.PADDING)
    assert not scenes.failures


@pytest.mark.parametrize("layer", ["intersections", "car_parks", "drivable", "walkways"])
def test_parts_of_areas_are_checked_as_well(layer: str):
    raw = road("bad")
    with np.errstate(invalid="ignore"):
        broken = shapely.Polygon([(70, 0), (80, np.nan), (80, 4)])
    parts = [shapely.box(60, 0, 70, 4), broken]
    getattr(raw.map, layer).append(RawArea("two", shapely.MultiPolygon(parts)))
    with pytest.raises(ScenarioError, match=rf"{layer}\['two'\].*nan is not finite"):
        spdm_jax.from_raw([raw], padding=roads.PADDING)


def test_no_agents_are_fine():
    scenes = spdm_jax.from_raw([roads.road(token="empty"), road(GOOD)], padding=roads.PADDING)
    assert not scenes.failures
    assert not scenes.batch.tracks.valid[0].any()


def test_tokens_must_differ():
    with pytest.raises(ScenarioError, match="token 'good' occurs twice; tokens must differ"):
        spdm_jax.from_raw([road(GOOD), road(GOOD)], padding=roads.PADDING)


@pytest.fixture
def folder(tmp_path: FilePath) -> FilePath:
    for token in ("a", "b", "c"):
        write_scenario(tmp_path / f"{token}.npz", *build_scenario(road(token)))
    return tmp_path


def truncate(path: FilePath) -> None:
    path.write_bytes(path.read_bytes()[:-2000])


def empty(path: FilePath) -> None:
    path.write_bytes(b"")


def later_schema(path: FilePath) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if name.endswith(".json"):
                content = json.dumps(json.loads(content) | {"schema_version": 999}).encode()
            archive.writestr(name, content)


def drop_field(path: FilePath) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if "tracks.vx" not in name:
                archive.writestr(name, content)


@pytest.mark.parametrize(
    "spoil, text",
    [
        (truncate, "b.npz: damaged scenario file"),
        (empty, "b.npz: damaged scenario file"),
        (later_schema, "b.npz: schema_version is 999, this library reads 2"),
        (drop_field, r"b.npz: missing fields \['tracks.vx.npy'\]"),
    ],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_bad_file_in_a_folder_is_reported(folder: FilePath, spoil, text: str):
    spoil(folder / "b.npz")
    scenes = spdm_jax.load(folder, padding=roads.PADDING)
    assert [info.token for info in scenes.infos] == ["a", "c"]
    assert [failure.token for failure in scenes.failures] == ["b"]
    assert re.search(text, scenes.failures[0].reason), scenes.failures[0].reason


def test_nothing_to_load(tmp_path: FilePath, folder: FilePath):
    (tmp_path / "none").mkdir()
    with pytest.raises(
        ScenarioError, match=r"none: no \.npz scenario files; write them with `spdm"
    ):
        spdm_jax.load(tmp_path / "none")
    with pytest.raises(ScenarioError, match="missing: no such file or folder"):
        spdm_jax.load(tmp_path / "missing")
    with pytest.raises(ScenarioError, match="no scenario file for token 'd'"):
        spdm_jax.load(folder, tokens=["a", "d"])
    truncate(folder / "a.npz")
    with pytest.raises(ScenarioError, match=r"no usable scenario: a: .*a\.npz: damaged"):
        spdm_jax.load(folder / "a.npz")


def test_iteration_beyond_the_window_is_reported(folder: FilePath):
    with pytest.raises(ScenarioError, match="iteration 99 is outside its window of 20 iterations"):
        spdm_jax.load(folder, iteration=99)


@pytest.fixture(scope="module")
def scenes() -> ScenarioSet:
    return spdm_jax.from_raw([road("one"), road("two")], padding=roads.PADDING)


def poses(*shape: int) -> np.ndarray:
    return np.zeros((*shape, 3))


def spoiled(value: float) -> np.ndarray:
    out = poses(2, 4, 41)
    out[1, 2, 7, 0] = value
    return out


@pytest.mark.parametrize(
    "trajectories, options, text",
    [
        (poses(4, 40), {}, r"40 steps at 0.1 s; scoring needs 41 at 0.1 s"),
        (poses(4, 8), {}, r"8 steps at 0.1 s.*Pass dt=... if they are not 0.1 s apart"),
        (poses(4, 7), {"dt": 0.5}, r"7 steps at 0.5 s"),
        (poses(4, 41), {"dt": 0.0}, r"dt is 0.0; it must be a positive"),
        (poses(4, 41), {"dt": -0.1}, r"dt is -0.1; it must be a positive"),
        (poses(4, 41), {"dt": float("nan")}, r"dt is nan"),
        (poses(41), {}, r"trajectories has shape \(41, 3\)"),
        (poses(3, 4, 41), {}, r"trajectories.*3.*2|trajectories has shape \(3, 4, 41, 3\)"),
        (np.zeros((4, 41, 5)), {}, r"shape \(2, 4, 41, 5\); expected"),
        (poses(0, 41), {}, r"holds no proposals"),
        (spoiled(np.nan), {}, r"trajectories\[1, 2, 7, 0\] is nan; all poses must be finite"),
        (spoiled(np.inf), {}, r"trajectories\[1, 2, 7, 0\] is inf"),
        (poses(4, 41), {"frame": "world"}, r"frame is 'world'; it must be 'ego', 'local' or"),
        (poses(4, 41), {"tracker": "exact"}, r"tracker is 'exact'; it must be 'reference'"),
        (poses(4, 41), {"precision": "f16"}, r"precision is 'f16'; it must be 'f32' or 'f64'"),
        (
            poses(4, 41),
            {"forecast": np.zeros((2, 16, 41, 2))},
            r"forecast has shape \(2, 16, 41, 2\), expected \(2, 16, 41, 3\)",
        ),
    ],
)
def test_bad_arguments_of_score(scenes: ScenarioSet, trajectories, options: dict, text: str):
    with pytest.raises(ValueError, match=text):
        spdm_jax.score(scenes, trajectories, **options)


def test_bad_arguments_of_plan(scenes: ScenarioSet):
    with pytest.raises(ValueError, match="precision is 'double'"):
        spdm_jax.plan(scenes, precision="double")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"forecast has shape \(2, 3\)"):
        spdm_jax.plan(scenes, forecast=np.zeros((2, 3)))
