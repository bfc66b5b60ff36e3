"""The reader on a small written log and map: windows, tracks, lights, maps and every error."""

import json
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import nuplan_fixture as fixture
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.types import DrivableKind, LightStatus, ObjectType

pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
from spdm_jax.io.nuplan import NuPlanReader
from spdm_jax.io.nuplan_filter import ScenarioFilter, Window
from spdm_jax.io.nuplan_log import UNTAGGED, NuPlanLog
from spdm_jax.io.nuplan_map import read_map

TAGGED = ScenarioFilter(scenario_types=(fixture.TAG,))
EGO = (10.0, -1.75, 0.0)


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Two lanes that fork into two roads."""
    roads = {
        "A": fixture.Road((0, 0), (50, 0), lanes=2),
        "B": fixture.Road((70, 0), (120, 0), lanes=1),
        "C": fixture.Road((70, -20), (120, -20), lanes=1),
    }
    links = [("A", "B", [(0, 0)]), ("A", "C", [(1, 0)])]
    raw_map = fixture.road_map(roads, links)
    root = tmp_path_factory.mktemp("nuplan")
    return root, fixture.write_nuplan(root, raw_map, ["A", "A-B", "B"], EGO)


@pytest.fixture
def data(template: tuple[Path, dict[str, str]], tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(template[0], tmp_path / "data"))


@pytest.fixture
def fid(template: tuple[Path, dict[str, str]]) -> dict[str, str]:
    return template[1]


def database(data: Path) -> Path:
    return next(data.rglob("*.db"))


def package(data: Path) -> Path:
    return next(data.rglob("map.gpkg"))


def change(path: Path, *statements: str, rows: Sequence[tuple] = ()) -> None:
    """Runs SQL on a file; the last statement gets `rows`."""
    with closing(sqlite3.connect(path)) as db, db:
        for statement in statements[: len(statements) - bool(rows)]:
            db.execute(statement)
        if rows:
            db.executemany(statements[-1], rows)


def sweeps(data: Path) -> list[tuple[bytes, int]]:
    with closing(sqlite3.connect(database(data))) as db:
        return db.execute("SELECT token, timestamp FROM lidar_pc ORDER BY timestamp").fetchall()


def read(data: Path, **options) -> RawScenario:
    reader = NuPlanReader(data, None, TAGGED, **options)
    return reader.read(reader.tokens()[0])


def test_default_window_with_history_and_future(data: Path):
    scenario = read(data)
    times = [time for _, time in sweeps(data)]
    first = round((fixture.TAG_TIME - 3.0) / 0.05)
    assert (scenario.num_history, scenario.num_iterations) == (22, 151)
    assert scenario.time_us.tolist() == times[first - 44 :: 2]
    assert len(scenario.time_us) == 22 + 151 + 59
    assert any("59 of 80" in note for note in scenario.notes)
    assert scenario.scenario_type == fixture.TAG
    assert scenario.log_name == fixture.LOG_NAME
    assert scenario.map.name == fixture.LOCATION


def test_no_note_when_the_log_covers_everything(data: Path):
    assert read(data, window=Window(8.0, 0.0)).notes == []


def test_jittered_sweeps_are_taken_by_rank(data: Path):
    rows = sweeps(data)
    jitter = np.random.default_rng(0).integers(-20_000, 20_000, len(rows))
    change(
        database(data),
        "UPDATE lidar_pc SET timestamp = ? WHERE token = ?",
        rows=[(time + int(j), token) for (token, time), j in zip(rows, jitter, strict=True)],
    )
    scenario, times = read(data, window=Window(8.0, -1.0)), [time for _, time in sweeps(data)]
    tag = times[round(fixture.TAG_TIME / 0.05)]
    own = [i for i, time in enumerate(times) if tag - 1_000_000 <= time <= tag + 7_000_000][::2]
    assert scenario.num_iterations == len(own)
    assert scenario.time_us.tolist() == times[own[0] - 44 : own[-1] + 161 : 2]


def test_ego_columns(data: Path):
    change(
        database(data),
        # Half angle 0.3 about z; vx ... ay are in the body frame.
        f"UPDATE ego_pose SET qw = {2 * np.cos(0.3)}, qz = {2 * np.sin(0.3)}, vx = 3, vy = -1, "
        "acceleration_x = 0.5, acceleration_y = -0.25, angular_rate_z = 7",
    )
    scenario = read(data)
    assert scenario.ego_valid.all()
    columns = [0.6, 3.0, -1.0, 0.5, -0.25, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(scenario.ego[:, 2:], [columns] * len(scenario.ego), atol=1e-12)
    start = scenario.ego[scenario.num_history, :2]
    np.testing.assert_allclose(start, fixture.MAP_ORIGIN + EGO[:2], atol=1e-9)


def test_tracks(data: Path):
    rows = sweeps(data)
    start = round((fixture.TAG_TIME - 3.0) / 0.05)
    cone, walker = bytes([9] * 8), bytes([8] * 8)
    change(
        database(data),
        "INSERT INTO category VALUES (x'01', 'traffic_cone', '')",
        "INSERT INTO category VALUES (x'02', 'pedestrian', '')",
        "INSERT INTO track (token, category_token) VALUES (x'0909090909090909', x'01')",
        "INSERT INTO track (token, category_token) VALUES (x'0808080808080808', x'02')",
        "INSERT INTO lidar_box (lidar_pc_token, track_token, x, y, yaw, vx, vy, length, width) "
        "VALUES (?, ?, ?, 2, 0.5, ?, ?, ?, 0.25)",
        rows=[
            (rows[start][0], cone, 1.0, 5.0, 5.0, 0.5),
            (rows[start + 4][0], walker, 2.0, None, 1.0, 0.75),
            (rows[start + 6][0], walker, 3.0, 1.0, -1.0, 1.5),
            (rows[start + 7][0], walker, 4.0, 1.0, -1.0, 1.5),
        ],
    )
    scenario = read(data)
    tracks, first = scenario.tracks, scenario.num_history
    assert tracks.ids[1:] == [cone.hex(), walker.hex()]
    assert tracks.type.tolist() == [
        *(ObjectType.VEHICLE, ObjectType.TRAFFIC_CONE, ObjectType.PEDESTRIAN)
    ]
    assert tracks.valid[0].all()
    assert np.flatnonzero(tracks.valid[1]).tolist() == [first]
    assert np.flatnonzero(tracks.valid[2]).tolist() == [first + 2, first + 3]
    assert tracks.pose[1, first].tolist() == [1.0, 2.0, 0.5]
    assert tracks.size[2, first + 2 : first + 4].tolist() == [[0.75, 0.25], [1.5, 0.25]]
    # A static object never moves; an unknown velocity counts as none, and a note says so.
    assert tracks.velocity[1, first].tolist() == [0.0, 0.0]
    assert tracks.velocity[2, first + 2 : first + 4].tolist() == [[0.0, 0.0], [1.0, -1.0]]
    assert any("1 boxes have no velocity" in note for note in scenario.notes)


def test_lights(data: Path):
    rows, start = sweeps(data), round((fixture.TAG_TIME - 3.0) / 0.05)
    states = {11: "green", 12: "yellow", 13: "red", 14: "flashing"}
    change(
        database(data),
        "INSERT INTO traffic_light_status VALUES (NULL, ?, ?, ?)",
        rows=[(rows[start + 2][0], i, state) for i, state in states.items()],
    )
    scenario = read(data)
    assert scenario.lights[scenario.num_history + 1] == {
        "11": LightStatus.GREEN,
        "12": LightStatus.YELLOW,
        "13": LightStatus.RED,
        "14": LightStatus.UNKNOWN,
    }
    assert scenario.lights[scenario.num_history] == {}
    assert len(scenario.lights) == len(scenario.time_us)


def test_route_and_goal(data: Path, fid: dict[str, str]):
    change(database(data), "UPDATE scene SET roadblock_ids = replace(roadblock_ids, ' ', ', ')")
    scenario = read(data)
    assert scenario.route_roadblocks == [fid["A"], fid["A-B"], fid["B"]]
    assert scenario.mission_goal is not None
    np.testing.assert_allclose(
        scenario.mission_goal, [*(fixture.MAP_ORIGIN + EGO[:2] + [20.95, 0]), 0.0], atol=1e-9
    )
    change(database(data), "UPDATE scene SET goal_ego_pose_token = NULL, roadblock_ids = NULL")
    scenario = read(data)
    assert scenario.mission_goal is None
    assert scenario.route_roadblocks == []
    assert any("no route" in note for note in scenario.notes)


def test_route_derived_from_the_drive(data: Path, fid: dict[str, str]):
    reader = NuPlanReader(data, None, TAGGED)
    assert reader.expert_route(reader.tokens()[0]) == [fid["A"]]
    change(database(data), "UPDATE ego_pose SET x = x + 25")
    assert reader.expert_route(reader.tokens()[0]) == [fid["A"], fid["A-C"]]


def test_candidates_leave_out_two_scenes_at_both_ends(data: Path):
    reader = NuPlanReader(data)
    times = [time for _, time in sweeps(data)]
    found = sorted(reader.candidate(token).time_us for token in reader.tokens())
    # Ten scenes of 3 s each.
    assert found == times[120:480]
    kinds = [reader.candidate(token).scenario_type for token in reader.tokens()]
    assert sorted(set(kinds)) == [fixture.TAG, UNTAGGED]
    assert kinds.count(fixture.TAG) == 1
    assert list(reader.tokens()) == sorted(reader.tokens())


def test_last_of_several_tags_counts(data: Path):
    change(
        database(data),
        "INSERT INTO scenario_tag SELECT x'07', lidar_pc_token, 'near_x', NULL FROM scenario_tag",
    )
    token = NuPlanReader(data, None, TAGGED).tokens()[0]
    both = ScenarioFilter(scenario_tokens=(token,))
    assert NuPlanReader(data, None, both).candidate(token).scenario_type == "near_x"
    assert NuPlanReader(data, None, TAGGED).candidate(token).scenario_type == fixture.TAG


def test_filter_by_goal_log_and_map(data: Path):
    for accepted in (
        ScenarioFilter(remove_invalid_goals=True),
        ScenarioFilter(log_names=(fixture.LOG_NAME,)),
        ScenarioFilter(map_names=(fixture.LOCATION,)),
    ):
        assert len(NuPlanReader(data, None, accepted).tokens()) == 360
    change(database(data), "UPDATE scene SET goal_ego_pose_token = NULL WHERE name = 'scene-004'")
    kept = NuPlanReader(data, None, ScenarioFilter(remove_invalid_goals=True)).tokens()
    assert len(kept) == 300


def test_one_file_as_data_root_and_one_map_object(data: Path):
    reader = NuPlanReader(database(data), window=Window(1.0, 0.0))
    first, last = (reader.read(token) for token in (reader.tokens()[0], reader.tokens()[-1]))
    assert first.map is last.map


def test_linked_folders_are_searched_once(data: Path, tmp_path: Path):
    place = tmp_path / "elsewhere"
    place.mkdir()
    (place / "logs").symlink_to(database(data).parent)
    (place / "logs" / "loop").symlink_to(place)
    assert len(NuPlanReader(place, data / "maps", TAGGED).tokens()) == 1


def test_suffixed_token_reads_the_recorded_scenario(data: Path):
    token = NuPlanReader(data, None, TAGGED).tokens()[0]
    reader = NuPlanReader(data, None, ScenarioFilter(scenario_tokens=(f"{token}-s1",)))
    assert list(reader.tokens()) == [token]
    assert reader.read(f"{token}-s1").token == token


def test_missing_tokens_are_noted(data: Path):
    token = NuPlanReader(data, None, TAGGED).tokens()[0]
    wanted = ScenarioFilter(scenario_tokens=(token, "f" * 16))
    reader = NuPlanReader(data, None, wanted)
    assert list(reader.tokens()) == [token]
    assert any("1 of 2" in note and "f" * 16 in note for note in reader.notes)


def test_map(data: Path, fid: dict[str, str]):
    raw_map, notes = read_map(package(data), "somewhere")
    assert notes == []
    lanes, blocks = raw_map.lanes, raw_map.roadblocks
    left, right = lanes[fid["A.0"]], lanes[fid["A.1"]]
    turn = lanes[fid["A.1-C.0"]]
    assert (left.left_neighbor, left.right_neighbor) == (None, right.id)
    assert (right.left_neighbor, right.right_neighbor) == (left.id, None)
    assert list(right.successors) == [turn.id]
    assert list(lanes[fid["C.0"]].predecessors) == [turn.id]
    # One exits A and enters C: the lane exited comes before the connector.
    assert list(turn.predecessors) == [right.id]
    assert list(turn.successors) == [fid["C.0"]]
    assert turn.is_connector and not right.is_connector
    assert list(blocks[fid["A"]].lanes) == [left.id, right.id]
    assert set(blocks[fid["A"]].successors) == {fid["A-B"], fid["A-C"]}
    assert list(blocks[fid["A-C"]].predecessors) == [fid["A"]]
    assert blocks[fid["A-C"]].is_connector
    assert turn.roadblock == fid["A-C"]
    np.testing.assert_allclose(
        right.centerline[[0, -1]] - [*fixture.MAP_ORIGIN, 0.0],
        [[0, -1.75, 0], [50, -1.75, 0]],
        atol=1e-6,
    )
    np.testing.assert_allclose(turn.centerline[0, :2], right.centerline[-1, :2], atol=1e-6)
    assert {area.kind for area in raw_map.drivable} <= set(DrivableKind)


def test_speed_limits(data: Path, fid: dict[str, str]):
    change(package(data), "UPDATE lanes_polygons SET speed_limit_mps = NULL")
    change(package(data), "UPDATE lane_connectors SET speed_limit_mps = 4.5")
    lanes = read_map(package(data), "somewhere")[0].lanes
    assert lanes[fid["A.0"]].speed_limit is None
    assert lanes[fid["A.1-C.0"]].speed_limit == 4.5


def test_a_lane_without_baseline_is_left_out(data: Path, fid: dict[str, str]):
    change(package(data), f"DELETE FROM baseline_paths WHERE lane_fid = {fid['B.0']}")
    raw_map, notes = read_map(package(data), "somewhere")
    assert fid["B.0"] not in raw_map.lanes
    assert list(raw_map.roadblocks[fid["B"]].lanes) == []
    assert len(notes) == 1
    assert fid["B.0"] in notes[0]


def test_projection_is_the_maps_own(data: Path, fid: dict[str, str]):
    change(package(data), "UPDATE meta SET value = 'EPSG:32618'")
    moved = read_map(package(data), "somewhere")[0].lanes[fid["A.0"]]
    # The zone to the west: half a million metres of easting away.
    assert abs(moved.centerline[0, 0] - fixture.MAP_ORIGIN[0]) > 4e5


def errors(data: Path, *words: str, **options) -> None:
    with pytest.raises(ScenarioError) as raised:
        reader = NuPlanReader(data, **options)
        reader.read(reader.tokens()[0])
    assert all(word in str(raised.value) for word in words), raised.value


@pytest.mark.parametrize(
    "table",
    (
        *("log", "lidar", "lidar_pc", "ego_pose", "lidar_box", "track", "category", "scene"),
        *("scenario_tag", "traffic_light_status"),
    ),
)
def test_missing_table(data: Path, table: str):
    change(database(data), f"DROP TABLE {table}")
    errors(data, str(database(data)), repr(table), "missing")


def test_missing_column(data: Path):
    change(database(data), "ALTER TABLE lidar_box RENAME COLUMN yaw TO heading")
    errors(data, database(data).name, "lidar_box", "yaw")


def test_truncated_log(data: Path):
    path = database(data)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    errors(data, path.name, "truncated")


def test_log_that_is_no_database(data: Path):
    database(data).write_text("not a database " * 100)
    errors(data, database(data).name, "SQLite")


def test_empty_log_file(data: Path):
    database(data).write_bytes(b"")
    errors(data, database(data).name, "missing")


def test_truncated_map(data: Path):
    path = package(data)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    errors(data, str(path), "GeoPackage")


@pytest.mark.parametrize("layer", ["walkways", "boundaries", "lane_group_connectors"])
def test_missing_layer(data: Path, layer: str):
    change(package(data), f"DROP TABLE {layer}")
    errors(data, str(package(data)), repr(layer))


def test_missing_map_column(data: Path):
    change(package(data), "ALTER TABLE lane_connectors RENAME COLUMN exit_lane_fid TO exits")
    errors(data, "lane_connectors", "exit_lane_fid")


@pytest.mark.parametrize("value", ["NULL", "'nonsense'"])
def test_unusable_projection(data: Path, value: str):
    change(package(data), f"UPDATE meta SET value = {value}")
    errors(data, str(package(data)), "projectedCoordSystem")


def test_broken_geometry(data: Path):
    change(package(data), "UPDATE boundaries SET geom = x'00112233'")
    errors(data, str(package(data)), "boundaries", "geometry")


def test_unknown_location(data: Path):
    change(database(data), "UPDATE log SET map_version = 'us-xx-nowhere'")
    errors(data, "nuplan-maps-v1.0.json", "us-xx-nowhere", fixture.LOCATION)


def test_unknown_version(data: Path):
    index = {fixture.LOCATION: {"version": "1.2.3"}}
    (data / "maps" / "nuplan-maps-v1.0.json").write_text(json.dumps(index))
    errors(data, "1.2.3", "map.gpkg")


def test_no_maps(data: Path):
    shutil.rmtree(data / "maps")
    errors(data, "maps", "map_root")
    errors(data, "nuplan-maps-v1.0.json", map_root=data)


def test_log_without_location(data: Path):
    change(database(data), "UPDATE log SET map_version = NULL")
    errors(data, database(data).name, "map_version")


def test_unknown_category(data: Path):
    change(database(data), "UPDATE category SET name = 'spaceship'")
    errors(data, database(data).name, "spaceship", "vehicle")


def test_missing_ego_pose(data: Path):
    change(database(data), "DELETE FROM ego_pose WHERE rowid = 251")
    errors(data, database(data).name, "ego_pose", scenario_filter=TAGGED)


def test_nothing_at_the_data_root(tmp_path: Path, data: Path):
    errors(tmp_path / "nowhere", "nowhere", "no such")
    (tmp_path / "empty").mkdir()
    errors(tmp_path / "empty", ".db", map_root=data / "maps")


@pytest.mark.parametrize(
    "wanted",
    [
        ScenarioFilter(scenario_types=("no_such_type",)),
        ScenarioFilter(scenario_tokens=("0" * 16,)),
        ScenarioFilter(map_names=("elsewhere",)),
        ScenarioFilter(log_names=("another_log",)),
    ],
)
def test_empty_selection(data: Path, wanted: ScenarioFilter):
    errors(data, str(data), scenario_filter=wanted)


def test_empty_selection_names_the_fields_that_are_set(data: Path):
    wanted = ScenarioFilter(scenario_types=("x",), scenario_tokens=[f"{i:016x}" for i in range(9)])  # type: ignore[arg-type]
    errors(data, "scenario_types: ('x',)", "scenario_tokens: 9 entries", scenario_filter=wanted)


def test_unknown_tokens_say_why(data: Path):
    reader = NuPlanReader(data, None, TAGGED)
    with pytest.raises(ScenarioError, match="none of the 1 logs"):
        reader.read("f" * 16)
    with pytest.raises(ScenarioError, match="excludes it"):
        reader.read(sweeps(data)[5][0].hex())
    with pytest.raises(ScenarioError, match="16 lower-case hex"):
        reader.read("token")


def test_token_in_two_logs(data: Path):
    shutil.copy(database(data), data / "copy.db")
    errors(data, "copy.db", fixture.LOG_NAME, "keep one copy")


def test_window_outside_the_log(data: Path):
    errors(data, "Window", window=Window(1.0, 500.0))


def test_files_stay_untouched(data: Path):
    before = database(data).read_bytes()
    database(data).chmod(0o444)
    read(data)
    assert database(data).read_bytes() == before
    assert sorted(p.name for p in database(data).parent.iterdir()) == [f"{fixture.LOG_NAME}.db"]


def test_log_name_and_tokens(data: Path):
    log = NuPlanLog(database(data))
    assert log.name == fixture.LOG_NAME
    assert log.tokens == [token.hex() for token, _ in sweeps(data)]
