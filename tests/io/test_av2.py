import json

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from spdm_jax.io import av2_log
from spdm_jax.io.av2 import AV2Reader
from spdm_jax.io.raw import ScenarioError, iter_scenarios
from spdm_jax.types import ObjectType

START_NS = 315_966_000_000_000_000
ORIGIN = np.array([5000.0, 2000.0, 60.0])
SPEED, ACCEL = 6.0, 0.3  # of the ego, along x
ROLL, PITCH, YAW = 0.03, -0.05, 0.0


def rotation(roll, pitch, yaw):
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    return (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )


def table(rows):
    """`rows`: (time_ns, rotation, translation, further columns)."""
    time_ns, turns, shifts, more = zip(*rows, strict=True)
    quaternions = Rotation.from_matrix(np.array(turns)).as_quat()[:, [3, 0, 1, 2]]
    pose = dict(zip(("qw", "qx", "qy", "qz"), quaternions.T, strict=True))
    pose |= dict(zip(("tx_m", "ty_m", "tz_m"), np.array(shifts, float).T, strict=True))
    return pl.DataFrame({"timestamp_ns": np.array(time_ns), **pose}).with_columns(
        pl.Series(name, [m[name] for m in more]) for name in more[0]
    )


def straight_ego(t):
    """City frame rotation and position at time t (s after the first sweep)."""
    x = SPEED * t + 0.5 * ACCEL * t * t
    return rotation(ROLL, PITCH, YAW), ORIGIN + np.array([x, 0.0, 0.0])


def circling_ego(t):
    """A left-hand circle of radius 20 m at 8 m/s."""
    angle = 0.4 * t
    return rotation(0, 0, angle + np.pi / 2), ORIGIN + np.array(
        [20 * np.cos(angle), 20 * np.sin(angle), 0]
    )


def oncoming(t):
    return ("oncoming", "REGULAR_VEHICLE", np.pi, [80 - 9.0 * t, 5.0, 0.7], (4.6, 1.9))


def actors(t, rng):
    """Track, category, heading, position relative to ORIGIN, size; of what is seen at time t."""
    jitter = rng.uniform(-0.02, 0.02, 3)
    yield oncoming(t)
    yield ("parked", "TRUCK", 0.4, jitter + np.array([30.0, -9.0, 1.0]), (9.0, 2.5))
    yield ("cone", "CONSTRUCTION_CONE", 0.0, jitter * 20 + [40.0, -6.0, 0.3], (0.4, 0.4))
    yield ("robot", "DELIVERY_ROBOT", 0.0, [20.0, -6.0, 0.3], (0.7, 0.5))
    if 0.45 < t < 1.05:
        yield ("walker", "PEDESTRIAN", 1.5, [25.0, 1.4 * t, 0.9], (0.6, 0.6))
    if abs(t - 1.5) < 0.05:
        yield ("glimpse", "BICYCLIST", 0.0, [25.0, 9.0, 0.9], (1.8, 0.6))


def write_log(folder, num_sweeps=101, ego=straight_ego, actors=actors):
    """A log whose sweeps are off the 0.1 s grid by up to 2 ms, as real ones are."""
    rng = np.random.default_rng(3)
    folder.mkdir(parents=True)
    jitter = rng.integers(-2_000_000, 2_000_000, num_sweeps)
    jitter[[0, -1]] = 0
    sweeps = np.arange(num_sweeps) * 100_000_000 + jitter
    end = sweeps[-1]
    clock = np.unique(np.concatenate([sweeps, np.arange(-50_000_000, end + 50_000_000, 5_000_000)]))
    table((START_NS + ns, *ego(ns / 1e9), {}) for ns in clock).write_ipc(
        folder / "city_SE3_egovehicle.feather"
    )
    rows = []
    for ns in sweeps:
        turn, shift = ego(ns / 1e9)
        more = {"track_uuid": "ego", "category": "EGO_VEHICLE", "length_m": 4.9, "width_m": 2.0}
        rows.append((START_NS + ns, np.eye(3), np.zeros(3), more))
        for name, category, heading, xyz, (length, width) in actors(ns / 1e9, rng):
            more = {
                "track_uuid": name,
                "category": category,
                "length_m": length,
                "width_m": width,
            }
            rows.append(
                (
                    START_NS + ns,
                    turn.T @ rotation(0, 0, heading),
                    turn.T @ (ORIGIN + xyz - shift),
                    more,
                )
            )
    table(rows).write_ipc(folder / "annotations_with_ego.feather")
    return folder


def write_map(folder):
    def lane(key, x0, x1, **fields):
        line = lambda y: [{"x": ORIGIN[0] + x, "y": ORIGIN[1] + y} for x in (x0, x1)]
        return {
            "id": key,
            "is_intersection": False,
            "lane_type": "VEHICLE",
            "left_lane_boundary": line(2.0),
            "right_lane_boundary": line(-2.0),
            "successors": [],
            "predecessors": [],
            "left_neighbor_id": None,
            "right_neighbor_id": None,
            **fields,
        }

    lanes = [lane(1, -20, 40, successors=[2]), lane(2, 40, 90, successors=[3]), lane(3, 90, 250)]
    (folder / "map").mkdir()
    (folder / "map" / "log_map_archive_x____PIT_city_1.json").write_text(
        json.dumps(
            {
                "lane_segments": {str(row["id"]): row for row in lanes},
                "drivable_areas": {},
                "pedestrian_crossings": {},
            }
        )
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = write_log(tmp_path_factory.mktemp("av2") / "0a1b2c3d-4e5f")
    write_map(folder)
    return folder


@pytest.fixture(scope="module")
def motion(log):
    return av2_log.read_motion(log, wheel_base=3.0)


def row_of(tracks, name):
    return tracks.ids.index(name)


def test_grid_is_exact_and_starts_at_the_first_sweep(motion):
    np.testing.assert_array_equal(motion.time_ns - START_NS, np.arange(101) * 100_000_000)


def test_ego_on_a_straight(motion):
    t = (motion.time_ns - START_NS) / 1e9
    expected = np.zeros((len(t), 11))
    expected[:, 0] = ORIGIN[0] + SPEED * t + 0.5 * ACCEL * t * t
    expected[:, 1] = ORIGIN[1]
    expected[:, 3], expected[:, 5] = SPEED + ACCEL * t, ACCEL
    np.testing.assert_allclose(motion.ego, expected, atol=1e-5)


def test_ego_on_a_circle(tmp_path):
    ego = av2_log.read_motion(write_log(tmp_path / "log", 30, ego=circling_ego), wheel_base=3.0).ego
    angle = 0.4 * np.arange(30) * 0.1
    np.testing.assert_allclose(ego[:, 0], ORIGIN[0] + 20 * np.cos(angle), atol=1e-3)
    heading = (angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(ego[:, 2], heading, atol=1e-6)
    # vx, vy, ax, ay (centripetal) in the body frame; the fit is quadratic, the path is not.
    np.testing.assert_allclose(ego[:, 3:7] - [8, 0, 0, 3.2], 0, atol=0.35)
    np.testing.assert_allclose(ego[5:-5, 3:7] - [8, 0, 0, 3.2], 0, atol=0.02)
    np.testing.assert_allclose(ego[:, 7], np.arctan(3.0 * 0.4 / 8), atol=2e-3)
    np.testing.assert_allclose(ego[:, 9:], [[0.4, 0.0]] * 30, atol=1e-5)


def test_standing_ego_is_exactly_still(tmp_path):
    noise = np.random.default_rng(0)
    still = lambda t: (np.eye(3), ORIGIN + noise.uniform(-1e-3, 1e-3, 3))
    ego = av2_log.read_motion(write_log(tmp_path / "log", 20, ego=still), wheel_base=3.0).ego
    assert (ego[:, 3:] == 0).all()


def test_boxes_are_moved_to_the_city_frame(motion):
    tracks, t = motion.tracks, (motion.time_ns - START_NS) / 1e9
    i = row_of(tracks, "oncoming")
    assert tracks.valid[i].all()
    np.testing.assert_allclose(tracks.pose[i, :, 0], ORIGIN[0] + 80 - 9 * t, atol=1e-6)
    np.testing.assert_allclose(tracks.pose[i, :, 1], ORIGIN[1] + 5, atol=1e-6)
    np.testing.assert_allclose(np.abs(tracks.pose[i, :, 2]), np.pi, atol=1e-6)
    np.testing.assert_allclose(tracks.velocity[i], [[-9.0, 0.0]] * 101, atol=1e-5)
    np.testing.assert_allclose(tracks.size[i], [[4.6, 1.9]] * 101)


def test_classes_and_unknown_category(motion):
    tracks = motion.tracks
    assert dict(zip(tracks.ids, tracks.type.tolist(), strict=True)) == {
        "oncoming": ObjectType.VEHICLE,
        "parked": ObjectType.VEHICLE,
        "cone": ObjectType.TRAFFIC_CONE,
        "robot": ObjectType.GENERIC_OBJECT,
        "walker": ObjectType.PEDESTRIAN,
        "glimpse": ObjectType.BICYCLE,
    }  # the ego's own box is none of them
    assert motion.notes == ("categories DELIVERY_ROBOT are unknown: taken as generic objects",)


def test_jitter_is_no_motion(motion):
    tracks = motion.tracks
    for name in ("parked", "cone"):
        assert (tracks.velocity[row_of(tracks, name)] == 0).all()


def test_objects_are_valid_while_seen(motion):
    tracks = motion.tracks
    walker, glimpse = row_of(tracks, "walker"), row_of(tracks, "glimpse")
    assert np.flatnonzero(tracks.valid[walker]).tolist() == [5, 6, 7, 8, 9, 10]
    np.testing.assert_allclose(tracks.velocity[walker, 5:11], [[0, 1.4]] * 6, atol=1e-5)
    y = tracks.pose[walker, 5:11, 1] - ORIGIN[1]
    np.testing.assert_allclose(y, 1.4 * np.arange(5, 11) * 0.1, atol=1e-6)
    assert (tracks.velocity[walker][~tracks.valid[walker]] == 0).all()
    assert np.flatnonzero(tracks.valid[glimpse]).tolist() == [15]
    assert (tracks.velocity[glimpse] == 0).all()  # one box says nothing about motion
    assert np.isfinite(tracks.pose).all()


def test_gap_in_a_track_is_kept(tmp_path):
    def gapped(t, rng):
        if not 0.95 < t < 1.45:
            yield oncoming(t)

    tracks = av2_log.read_motion(
        write_log(tmp_path / "log", 30, actors=gapped), wheel_base=3.0
    ).tracks
    assert np.flatnonzero(~tracks.valid[0]).tolist() == [10, 11, 12, 13, 14]
    assert (tracks.velocity[0, 10:15] == 0).all()


def test_log_without_objects(tmp_path):
    folder = write_log(tmp_path / "log", 10, actors=lambda t, rng: ())
    assert av2_log.read_motion(folder, wheel_base=3.0).tracks.pose.shape == (0, 10, 3)


def test_derivatives_of_a_polynomial_are_exact():
    t = np.sort(np.random.default_rng(1).uniform(0, 2, 60))
    value = np.column_stack([3 - 2 * t + 0.5 * t * t, t])
    at = np.array([0.0, 0.7, 2.0])
    first, second = av2_log.local_derivatives(t, value, at, 0.4, 2)
    np.testing.assert_allclose(first, np.column_stack([-2 + at, np.ones(3)]), atol=1e-9)
    np.testing.assert_allclose(second, [[1.0, 0.0]] * 3, atol=1e-7)
    assert (av2_log.local_derivatives(t, value, np.array([9.0]), 0.4, 2) == 0).all()


def edit(log, name, change):
    path = log / name
    change(pl.read_ipc(path)).write_ipc(path)


POSES, BOXES = "city_SE3_egovehicle.feather", "annotations_with_ego.feather"


def spoil(column, row, value):
    at_row = pl.int_range(pl.len()) == row
    return lambda f: f.with_columns(pl.when(at_row).then(value).otherwise(1.0).alias(column))


def between_sweeps(f):
    return f.filter((pl.col("timestamp_ns") - START_NS - 250_000_000).abs() > 80_000_000)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        (POSES, lambda f: f.drop("qx"), "column qx is missing"),
        (BOXES, lambda f: f.drop("track_uuid"), "column track_uuid is missing"),
        (BOXES, lambda f: f.clear(), "the table has no row"),
        (POSES, spoil("ty_m", 4, None), "column ty_m, row 4 is None"),
        (BOXES, spoil("length_m", 2, np.nan), "column length_m, row 2 is nan"),
        (POSES, between_sweeps, "has no pose"),
        (
            POSES,
            lambda f: f.with_columns(pl.col("timestamp_ns") + 10**12),
            "no timestamp_ns within those of",
        ),
        (BOXES, lambda f: pl.concat([f, f[-1:]]), "occurs twice"),
    ],
)
def test_malformed_table_is_refused_by_name(tmp_path, name, change, words):
    folder = write_log(tmp_path / "log", 8)
    edit(folder, name, change)
    with pytest.raises(ScenarioError) as error:
        av2_log.read_motion(folder, wheel_base=3.0)
    assert words in str(error.value) and str(folder) in str(error.value)


def test_missing_and_broken_tables(tmp_path):
    folder = write_log(tmp_path / "log", 8)
    (folder / POSES).write_text("timestamp_ns,qw")
    with pytest.raises(ScenarioError, match="not a feather file"):
        av2_log.read_motion(folder, wheel_base=3.0)
    (folder / POSES).unlink()
    with pytest.raises(ScenarioError, match="no such file"):
        av2_log.read_motion(folder, wheel_base=3.0)
    (folder / BOXES).unlink()
    with pytest.raises(ScenarioError, match=r"neither annotations\.feather nor"):
        av2_log.read_motion(folder, wheel_base=3.0)


def test_reader_cuts_scenarios_out_of_a_log(log, motion):
    reader = AV2Reader(
        log, starts=(0.0, 3.0, 6.0), duration_s=4.0, min_duration_s=2.0, future_s=2.0
    )
    assert reader.tokens() == ["0a1b2c3d_000", "0a1b2c3d_001", "0a1b2c3d_002"]
    scenarios = list(iter_scenarios(reader))
    shape = [(s.num_history, s.num_iterations, len(s.time_us)) for s in scenarios]
    assert shape == [(0, 40, 60), (22, 40, 82), (22, 40, 63)]
    assert "history has 0 of 22 steps: the log has no more" in scenarios[0].notes
    assert "future has 1 of 20 steps: the log has no more" in scenarios[2].notes
    middle = scenarios[1]
    assert not [note for note in middle.notes if "the log has no more" in note]
    assert middle.time_us[22] == START_NS // 1000 + 3_000_000
    assert (np.diff(middle.time_us) == 100_000).all()
    np.testing.assert_array_equal(middle.ego, motion.ego[8:90])
    assert middle.ego_valid.all() and len(middle.lights) == 82 and not any(middle.lights)
    assert (middle.log_name, middle.source) == ("0a1b2c3d-4e5f", "av2")
    assert middle.map is scenarios[0].map and middle.map.name == "PIT_city_1"
    # The walker is seen until step 10, the glimpse at step 15: both within the history.
    assert middle.tracks.ids == ["oncoming", "parked", "cone", "robot", "walker", "glimpse"]
    assert scenarios[2].tracks.ids == ["oncoming", "parked", "cone", "robot"]
    assert middle.tracks.valid[4].sum() == 3
    i = row_of(motion.tracks, "oncoming")
    np.testing.assert_array_equal(middle.tracks.pose[0], motion.tracks.pose[i, 8:90])


def test_objects_are_listed_by_first_appearance_in_the_scenario(log):
    scenario = AV2Reader(log, starts=(0.0,), min_duration_s=2.0).read("0a1b2c3d_000")
    assert scenario.tracks.ids[-2:] == ["walker", "glimpse"]
    first = scenario.tracks.valid.argmax(1)
    assert (np.diff(first) >= 0).all()


def test_route_starts_where_the_ego_is(log):
    reader = AV2Reader(log, starts=(0.0, 6.0), min_duration_s=2.0)
    first, second = (reader.read(token) for token in reader.tokens())
    assert first.route_roadblocks == ["rb_1", "rb_2", "rb_3"]
    assert second.route_roadblocks == ["rb_2", "rb_3"]  # x = 41.4 m
    assert first.mission_goal == pytest.approx([ORIGIN[0] + 250, ORIGIN[1], 0.0])


def test_starts_follow_the_stride_while_the_window_lasts(log):
    reader = AV2Reader(log, stride_s=0.5, min_duration_s=6.0)
    tokens = reader.tokens()
    assert len(tokens) == 9  # 0, 0.5 ... 4.0 of 10.1 s
    last = reader.read(tokens[-1])
    assert last.num_iterations == 61
    assert "window has 61 of 150 steps: the log has no more" in last.notes


def test_folder_of_logs_keeps_tokens_apart(tmp_path):
    for name in ("0a1b2c3d-aa", "0a1b2c3d-ab", "ffffffff-00"):
        write_map(write_log(tmp_path / name, 30))
    (tmp_path / "notes").mkdir()
    reader = AV2Reader(tmp_path, starts=(0.0, 0.5), min_duration_s=1.0)
    assert len(set(reader.tokens())) == 6
    names = [s.log_name for s in iter_scenarios(reader)]
    assert names == [n for n in ("0a1b2c3d-aa", "0a1b2c3d-ab", "ffffffff-00") for _ in range(2)]


def test_too_short_logs_and_late_starts(log, tmp_path):
    short = write_log(tmp_path / "log", 20)
    with pytest.raises(ScenarioError, match=r"20 steps of 0.1 s, min_duration_s asks for 60"):
        AV2Reader(short).tokens()
    with pytest.raises(ScenarioError, match=r"start 9.0 s leaves 11 steps"):
        AV2Reader(log, starts=(9.0,)).read("0a1b2c3d_000")
    with pytest.raises(ScenarioError, match=r"start 20.0 s leaves 0 steps"):
        AV2Reader(log, starts=(20.0,)).read("0a1b2c3d_000")


def test_ego_off_the_lanes_at_the_start_is_noted(tmp_path):
    def swerve(t):
        turn, shift = straight_ego(t)
        return turn, shift + np.array([0, 30.0 * (t < 0.55), 0])

    write_map(write_log(tmp_path / "log", 30, ego=swerve))
    reader = AV2Reader(tmp_path / "log", starts=(0.0, 1.0), min_duration_s=1.0)
    off, on = (reader.read(token) for token in reader.tokens())
    assert any("on no lane at iteration 0" in note for note in off.notes)
    assert not any("on no lane at iteration 0" in note for note in on.notes)
    assert off.route_roadblocks[0] == "rb_1"


@pytest.mark.parametrize("token", ["0a1b2c3d", "0a1b2c3d_x", "other_000", ""])
def test_unknown_token(log, token):
    with pytest.raises(ScenarioError, match="is of none of the logs 0a1b2c3d"):
        AV2Reader(log).read(token)


def test_index_beyond_the_starts(log):
    with pytest.raises(ScenarioError, match="has 9 start times"):
        AV2Reader(log).read("0a1b2c3d_009")


def test_log_without_map(tmp_path):
    write_log(tmp_path / "log", 30)
    with pytest.raises(ScenarioError, match="0 files log_map_archive"):
        AV2Reader(tmp_path / "log", starts=(0.0,), min_duration_s=1.0).read("log_000")


def test_root_without_logs(tmp_path):
    with pytest.raises(ScenarioError, match=r"neither this folder nor one inside it"):
        AV2Reader(tmp_path)


@pytest.mark.parametrize(
    "setting",
    [
        {"stride_s": 0.0},
        {"min_duration_s": 0.0},
        {"duration_s": 1.0, "min_duration_s": 2.0},
        {"num_history": -1},
        {"future_s": float("nan")},
        {"starts": (1.0, -0.1)},
    ],
)
def test_settings_out_of_range(log, setting):
    with pytest.raises(ValueError, match="must be at least"):
        AV2Reader(log, **setting)
