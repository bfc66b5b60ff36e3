"""Ego futures, k-means over trajectories, and `spdm vocab build`."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from spdm_experiments import cli
from spdm_experiments import vocabulary as building
from spdm_jax import load, plan, spdm, vocabulary
from spdm_jax.config import NUM_STATES
from spdm_jax.io.scenario_file import read_scenario, write_scenario
from spdm_jax.trajectories import STATE_COLUMNS
from spdm_jax.types import EgoState
from spdm_jax.vocabulary import build_vocabulary, ego_futures, in_ego_frame

SCENES = "curve,roundabout"


def drive(steps: int, speed: float = 8.0, yaw_rate: float = 0.4, heading: float = 2.5) -> EgoState:
    """A recorded circle; headings wrap on the way."""
    turn = yaw_rate * 0.1 * np.arange(steps)
    radius = speed / yaw_rate
    rest = {name: np.zeros(steps) for name in STATE_COLUMNS}
    x = 100 + radius * (np.sin(heading + turn) - np.sin(heading))
    y = -40 - radius * (np.cos(heading + turn) - np.cos(heading))
    wrapped = np.angle(np.exp(1j * (heading + turn)))
    return EgoState(**{**rest, "x": x, "y": y, "heading": wrapped})


def arcs(count: int, seed: int = 0, steps: int = NUM_STATES) -> np.ndarray:
    """Circles of random speed and curvature from the origin, `[count, steps, 3]`."""
    generator = np.random.default_rng(seed)
    speed = generator.uniform(0.5, 15, (count, 1))
    bend = generator.normal(0, 0.03, (count, 1))
    way = speed * 0.1 * np.arange(steps)
    return np.stack([np.sin(bend * way) / bend, (1 - np.cos(bend * way)) / bend, bend * way], -1)


def test_futures_of_a_circle_are_one_arc():
    futures, steps = ego_futures(drive(100), np.ones(100, bool))
    assert futures.shape == (60, NUM_STATES, 3) and steps.tolist() == list(range(60))
    turn = 0.04 * np.arange(NUM_STATES)
    arc = np.stack([20 * np.sin(turn), 20 * (1 - np.cos(turn)), turn], -1)
    np.testing.assert_allclose(futures, np.broadcast_to(arc, futures.shape), atol=1e-9)
    np.testing.assert_array_equal(futures[:, 0], 0)


@pytest.mark.parametrize(
    "steps, gap, expected", [(41, None, [0]), (40, None, []), (90, 45, [*range(5), 46, 47, 48, 49])]
)
def test_futures_need_four_valid_seconds(steps: int, gap: int | None, expected: list[int]):
    valid = np.ones(steps, bool)
    if gap is not None:
        valid[gap] = False
    futures, found = ego_futures(drive(steps), valid)
    assert found.tolist() == expected and futures.shape == (len(expected), NUM_STATES, 3)


def test_ego_frame_is_where_a_trajectory_starts():
    moved = arcs(20)
    cos, sin = np.cos(2.0), np.sin(2.0)
    world = np.stack(
        [
            5 + cos * moved[..., 0] - sin * moved[..., 1],
            -7 + sin * moved[..., 0] + cos * moved[..., 1],
            np.angle(np.exp(1j * (moved[..., 2] + 2.0))),
        ],
        axis=-1,
    )
    np.testing.assert_allclose(in_ego_frame(world), moved, atol=1e-12)


def test_separate_bundles_are_found():
    middle = arcs(6, seed=3) * np.array([1.0, 1.0, 1.0])
    assert np.abs(middle[:, None, -1, :2] - middle[:, -1, :2]).sum(-1)[~np.eye(6, dtype=bool)].min()
    counts = [5, 40, 10, 30, 20, 3]
    generator = np.random.default_rng(1)
    rows = np.repeat(np.arange(6), counts)
    noise = generator.normal(0, 0.02, (len(rows), NUM_STATES, 3))
    given = middle[rows] + noise
    found = build_vocabulary(given[generator.permutation(len(rows))], 6, seed=5)
    assert found.sizes.tolist() == sorted(counts, reverse=True)
    assert found.trajectories.dtype == np.float32 and found.converged
    for centre, size in zip(found.trajectories, found.sizes, strict=True):
        bundle = given[rows == counts.index(size)]
        np.testing.assert_allclose(centre, bundle.mean(axis=0), atol=1e-5)
    assert found.inertia == pytest.approx(2 * 0.02**2, rel=0.1)


def brute_force(values: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Mean squared distance of every trajectory to every centre, `[N, V]`."""
    away = values[:, None, :, :2] - centers[None, :, :, :2]
    return np.mean(np.sum(away**2, axis=-1), axis=-1)


def test_result_is_a_fixed_point_and_counts_are_right():
    values = arcs(400)
    found = build_vocabulary(values, 12, seed=2, max_iterations=500)
    square = brute_force(values, found.trajectories.astype(float))
    nearest = square.argmin(axis=1)
    assert np.bincount(nearest, minlength=12).sum() == found.sizes.sum() == 400
    # Another round hardly moves anything.
    assert np.abs(np.bincount(nearest, minlength=12) - found.sizes).sum() <= 8
    assert found.inertia == pytest.approx(square.min(axis=1).mean(), rel=1e-2)
    assert found.largest**2 == pytest.approx(square.min(axis=1).max(), rel=0.05)
    more = build_vocabulary(values, 48, seed=2)
    assert more.inertia < found.inertia / 3


def test_same_seed_gives_the_same_bytes():
    values = arcs(300)
    first, again, other = (build_vocabulary(values, 32, seed=s) for s in (7, 7, 8))
    assert first.trajectories.tobytes() == again.trajectories.tobytes()
    assert first.trajectories.tobytes() != other.trajectories.tobytes()


def test_first_centres_are_those_of_plain_kmeans_plus_plus():
    points = arcs(200)[..., :2].reshape(200, -1).astype(np.float32)
    weights = np.random.default_rng(4).integers(1, 5, 200).astype(float)
    # The triangle inequality only saves work: the same draws pick the same rows.
    chosen = vocabulary._first_centers(
        points, weights, 40, np.random.default_rng(9), lambda *_: None
    )
    draws = np.random.default_rng(9).random(40)
    expected: list[int] = []
    for draw in draws:
        closest = np.ones(200)
        if expected:
            away = points[:, None].astype(float) - points[expected]
            closest = np.min(np.sum(away**2, axis=-1), axis=1)
        mass = np.cumsum(weights * closest)
        expected.append(int(np.searchsorted(mass, draw * mass[-1], side="right")))
    assert chosen.tolist() == expected
    assert len(set(expected)) == 40


def test_every_different_trajectory_can_have_its_own_cluster():
    values = np.repeat(arcs(30), [1 + i % 3 for i in range(30)], axis=0)
    found = build_vocabulary(values, 30)
    assert found.num_trajectories == len(values) == 60 and found.num_distinct == 30
    assert found.inertia < 1e-10
    assert sorted(found.sizes.tolist()) == sorted(1 + i % 3 for i in range(30))


def test_too_few_different_trajectories_are_named():
    values = np.concatenate([arcs(10)] * 5)
    with pytest.raises(ValueError, match=r"50 trajectories, 10 of them different .* 11 clusters"):
        build_vocabulary(values, 11)


@pytest.mark.parametrize(
    "values, size, text",
    [
        (np.zeros((4, 41)), 2, r"shape \(4, 41\); expected \[N, T, 3\]"),
        (np.full((4, 41, 3), np.nan), 2, "not finite"),
        (np.zeros((4, 41, 3)), 0, "size is 0"),
        (np.zeros((0, 41, 3)), 1, "0 trajectories, 0 of them different"),
    ],
)
def test_bad_trajectories(values: np.ndarray, size: int, text: str):
    with pytest.raises(ValueError, match=text):
        build_vocabulary(values, size)


def test_empty_clusters_are_filled_again():
    points = np.arange(10.0)[:, None]
    label = np.zeros(10, np.int64)
    label[5:] = 2
    square = np.array([0.0, 1, 2, 3, 4, 0, 1, 2, 3, 9])
    centers = vocabulary._means(points, np.ones(10), label, square, 4)
    assert centers[:, 0].tolist() == [2.0, 9.0, 7.0, 4.0]


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert cli.main(["pack", SCENES, str(folder)]) == 0
    return folder


def build(pack: Path, out: Path, *more: str) -> int:
    return cli.main(["vocab", "build", str(pack), str(out), *more])


def test_vocabulary_of_logs(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in ("a", "b"):
        assert build(pack, tmp_path / "out" / f"{name}.npy", "--size", "32") == 0
    first, second = ((tmp_path / "out" / f"{name}.npy").read_bytes() for name in "ab")
    assert first == second
    values = np.load(tmp_path / "out" / "a.npy")
    assert values.shape == (32, NUM_STATES, 3)
    np.testing.assert_array_equal(values[:, 0], 0)
    about = json.loads((tmp_path / "out" / "a.json").read_text())
    valid = load(pack).batch.ego_valid.sum(axis=1)
    assert about["num_collected"] == sum(int(n) - 40 for n in valid)  # every step, not only one
    assert about["sizes"] == sorted(about["sizes"], reverse=True)
    assert sum(about["sizes"]) == about["num_clustered"] == about["num_collected"]
    assert (about["from"], about["seed"], about["failures"]) == ("logs", 0, {})
    assert about["versions"]["numpy"] and about["num_scenarios"] == 2
    printed = capsys.readouterr().out
    assert f"32 clusters of {about['num_clustered']} trajectories" in printed
    assert f"inertia {about['inertia']:.5f}" in printed
    # What comes out is among what went in, roughly.
    ego = [ego_futures(read_scenario(p)[0].ego, np.ones(252, bool))[0] for p in pack.glob("*.npz")]
    square = brute_force(values.astype(float), np.concatenate(ego))
    assert np.sqrt(square.min(axis=1).max()) < about["largest_distance"] + 1e-6
    assert about["rms_distance"] < about["largest_distance"] < 2


def test_steps_that_scenarios_share_count_once(pack: Path, tmp_path: Path):
    scenario, info = read_scenario(pack / "curve-0.npz")
    fields = {**vars(info), "source": "nuplan", "log_name": "log"}
    late = int(info.iteration0_time_us) + 5_000_000  # 50 steps further on in the same drive
    for token, began in (("a", info.iteration0_time_us), ("b", late)):
        entry = type(info)(**{**fields, "token": token, "iteration0_time_us": began})
        write_scenario(tmp_path / f"{token}.npz", scenario, entry)
    assert build(tmp_path, tmp_path / "out" / "v.npy", "--size", "8") == 0
    about = json.loads((tmp_path / "out" / "v.json").read_text())
    assert about["num_collected"] == 252 - 40 + 50


def test_sample_is_drawn_from_all(pack: Path, tmp_path: Path):
    for seed in (0, 1):
        more = ("--size", "20", "--sample", "20", "--seed", str(seed))
        assert build(pack, tmp_path / f"{seed}.npy", *more) == 0
    about = json.loads((tmp_path / "0.json").read_text())
    assert about["num_clustered"] == 20 < about["num_collected"]
    rows = [{row.tobytes() for row in np.load(tmp_path / f"{s}.npy")} for s in (0, 1)]
    assert len(rows[0] & rows[1]) < 10


def test_broken_file_is_listed(pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "broken.npz").write_bytes(b"PK")
    (tmp_path / "curve-0.npz").write_bytes((pack / "curve-0.npz").read_bytes())
    assert build(tmp_path, tmp_path / "v.npy", "--size", "4") == 1
    assert "broken: " in capsys.readouterr().out
    assert list(json.loads((tmp_path / "v.json").read_text())["failures"]) == ["broken"]


@pytest.mark.parametrize(
    "out, more, text",
    [
        ("v.npz", (), "must end in .npy"),
        ("v.npy", ("--size", "0"), "--size is 0"),
        ("v.npy", ("--size", "9", "--sample", "8"), "--size is 9; it must be from 1 to --sample"),
        ("v.npy", ("--size", "8192"), "fewer than the 8192 clusters"),
        ("v.npy", ("--from", "proposals", "--num-proposals", "17"), "num_proposals is 17"),
    ],
)
def test_wrong_options(
    out: str, more: Any, text: str, pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert build(pack, tmp_path / out, *more) == 2
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def cheap_proposals(scene: Any, mine: None, params: Any, config: Any) -> building.Tracked:
    """Stands in for the planner: three drives, the last one not valid."""
    x = scene.ego.x[scene.num_history] + jnp.outer(jnp.array([1.0, 2.0, 9.0]), jnp.arange(41.0))
    poses = jnp.stack([x, 0 * x + 3, 0 * x], axis=-1)
    return building.Tracked(
        poses=poses, valid=jnp.array([True, True, False]), overflow=scene.ego.x[0] != scene.ego.x[0]
    )


def test_vocabulary_of_valid_proposals(pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(building, "track_proposals", cheap_proposals)
    assert build(pack, tmp_path / "v.npy", "--size", "2", "--from", "proposals") == 0
    values = np.load(tmp_path / "v.npy")
    assert sorted(values[:, -1, 0].tolist()) == pytest.approx([40.0, 80.0], abs=1e-4)
    np.testing.assert_allclose(values[..., 1:], 0, atol=1e-4)
    about = json.loads((tmp_path / "v.json").read_text())
    assert (about["num_collected"], about["num_proposals"]) == (4, 60)


@pytest.mark.slow
def test_proposals_are_those_of_the_planner(pack: Path, tmp_path: Path):
    given = ("--from", "proposals", "--num-proposals", "15")
    assert build(pack, tmp_path / "v.npy", "--size", "8", *given) == 0
    plans = plan(load(pack), spdm(15))
    poses = np.stack([plans.tracked.x, plans.tracked.y, plans.tracked.heading], -1)
    wanted = in_ego_frame(poses[plans.scores.valid].astype(float))
    found = json.loads((tmp_path / "v.json").read_text())
    assert found["num_collected"] == len(wanted)
    assert found["inertia"] == pytest.approx(build_vocabulary(wanted, 8).inertia, rel=1e-3)
