"""`spdm simulate` with learned planners: points, weights, rows; small untrained networks."""

from pathlib import Path
from typing import Any, get_args

import jax
import polars
import pytest

import small_road as roads
from small_road import Thing
from spdm_experiments import cli, simulate_options
from spdm_experiments.options import Simulate
from spdm_experiments.simulate_points import NAMES, entries_of, make_points, weights_file
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_models import drivers, dtpp, gameformer
from spdm_models.checkpoint import read_metadata
from spdm_models.dtpp import DTPPConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.weights import SMALL_WEIGHTS, save_weights

ENCODER = EncoderConfig(width=16, heads=8, layers=1)
NETWORK = GameFormerConfig(ENCODER, levels=1, modes=2, neighbors=3)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    params = gameformer.init(NETWORK, jax.random.key(0))
    for name in ("gameformer", "dipp"):
        save_weights(folder / f"{name}.safetensors", "gameformer", NETWORK, params)
    tree = DTPPConfig(ENCODER)
    save_weights(folder / "dtpp.safetensors", "dtpp", tree, dtpp.init(tree, jax.random.key(0)))
    return folder


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    lead = Thing(roads.EGO_X + 20, -3.5, speed=8.0)
    for token, things in (("clear", []), ("lead", [lead])):
        raw = roads.road(token=token, things=things)
        write_scenario(folder / f"{token}.npz", *build_scenario(raw))
    return folder


def points(weights: Path, **options: Any) -> list[dict[str, Any]]:
    return entries_of(make_points(Simulate(scenes=Path("packed"), weights=weights, **options)))


def test_command_line_and_library_know_the_same_planners():
    assert get_args(simulate_options.LearnedName) == get_args(drivers.LearnedName)
    assert get_args(simulate_options.LearnedName) == tuple(drivers.TITLES) == tuple(drivers.MODELS)
    assert set(NAMES) >= set(get_args(simulate_options.LearnedName))


def test_points_of_learned_planners(weights: Path):
    found = points(
        weights,
        planner=("pdm-closed", "gameformer", "dtpp"),
        prediction=("learned", "none"),
        traffic=("replay",),
    )
    names = [(p["planner"], p["prediction"]) for p in found]
    assert names == [
        ("PDM-Closed", None),
        ("GameFormer", "learned"),
        ("GameFormer", "none"),
        ("DTPP", "learned"),
        ("DTPP", "none"),
    ]
    assert found[1]["weights"].startswith("gameformer ") and found[0]["weights"] is None
    assert found[1]["weights"] == found[2]["weights"] != found[3]["weights"]
    assert len({tuple(point) for point in found}) == 1
    # Runs without learned planners are described as they always were.
    plain = entries_of(make_points(Simulate(scenes=Path("packed"), planner=("pdm-closed",))))
    assert "prediction" not in plain[0] and "weights" not in plain[0]


def test_a_folder_of_weights_is_one_of_files_or_of_trainings(weights: Path, tmp_path: Path):
    file = weights / "dtpp.safetensors"
    assert weights_file(file, "dtpp") == weights_file(weights, "dtpp") == file
    assert weights_file(weights, "gameformer-path") == weights / "gameformer.safetensors"
    trained = tmp_path / "dtpp" / "weights.safetensors"
    trained.parent.mkdir()
    trained.write_bytes(file.read_bytes())
    assert weights_file(tmp_path, "dtpp") == trained
    for planner in ("gameformer-path", "gameformer-dipp"):
        assert weights_file(weights, planner) == weights / "gameformer.safetensors"
    own = tmp_path / "gameformer-dipp.safetensors"
    own.touch()
    assert weights_file(tmp_path, "gameformer-dipp") == own


def test_small_weights_come_with_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    files = sorted(SMALL_WEIGHTS.glob("*.safetensors"))
    assert sum(path.stat().st_size for path in files) < 10e6
    found = points(Path("small"), planner=("gameformer", "gameformer-dipp", "dipp", "dtpp"))
    assert [point["weights"].split()[0] for point in found] == [*["gameformer"] * 3, "dtpp"]
    recipe = (SMALL_WEIGHTS / "README.md").read_text(encoding="utf-8")
    for path in files:
        training = read_metadata(path)["training"]
        assert f"spdm train {training['task']} " in recipe and training["seed"] == 0
        assert f"| {training['validation']['planADE']:.2f} |" in recipe
    # A folder of that name goes before.
    (tmp_path / "small").mkdir()
    with pytest.raises(ValueError, match="no such file of weights for dtpp"):
        points(Path("small"), planner=("dtpp",))


@pytest.mark.parametrize(
    "options, said",
    [
        ({"planner": ("gameformer",), "weights": None}, "gameformer needs --weights"),
        ({"planner": ("spdm",)}, "--weights is for learned planners"),
        (
            {"planner": ("spdm",), "weights": None, "prediction": ("none",)},
            "--prediction is for learned planners",
        ),
        ({"planner": ("dtpp",), "replan_every": 2}, "leave --replan-every out"),
        ({"planner": ("dipp",), "weights": Path("none")}, "no such file of weights for dipp"),
        (
            {"planner": ("gameformer",), "weights": Path("dtpp.safetensors")},
            "holds weights of dtpp; gameformer takes",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused(weights: Path, options: dict[str, Any], said: str):
    given = {"weights": weights, **options}
    if given["weights"] == Path("dtpp.safetensors"):
        given["weights"] = weights / "dtpp.safetensors"
    with pytest.raises(ValueError, match=said):
        make_points(Simulate(scenes=Path("packed"), **given))


@pytest.mark.slow
def test_a_run_with_weights(
    weights: Path, pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, file = tmp_path / "run", tmp_path / "some.safetensors"
    file.write_bytes((weights / "gameformer.safetensors").read_bytes())
    command = ["simulate", str(pack), "--out", str(out), "--traffic", "replay"]
    command += ["--planner", "gameformer", "--prediction", "perfect"]
    command += ["--weights", str(file)]
    assert cli.main(command) == 0
    rows = polars.read_parquet(out / "rows" / "part-*.parquet").sort("token", "point")
    assert rows.height == 2 and set(rows["status"]) == {"ok"}
    assert set(rows["planner"]) == {"GameFormer"}
    # Other weights are another run, though the program is the same.
    other = gameformer.init(NETWORK, jax.random.key(1))
    save_weights(file, "gameformer", NETWORK, other)
    assert cli.main(command) == 2
    assert "points" in capsys.readouterr().err
    again = [*command, "--out", str(tmp_path / "other")]
    assert cli.main(again) == 0
    moved = polars.read_parquet(tmp_path / "other" / "rows" / "part-*.parquet")
    assert moved.sort("token", "point")["mean_speed"].to_list() != rows["mean_speed"].to_list()
    assert cli.main([*command, "--weights", str(weights / "dtpp.safetensors")]) == 2
    assert "holds weights of dtpp" in capsys.readouterr().err
