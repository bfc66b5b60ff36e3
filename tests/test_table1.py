"""The table of predictions: line-up, numbers, page; rows are made up, but for one slow run."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import polars
import pytest

import small_road as roads
from spdm_experiments import table1
from spdm_experiments.report_data import Run, load_run
from spdm_experiments.simulate_points import entries_of
from spdm_experiments.simulate_terms import CLOSED
from spdm_experiments.table1_data import cells_of, frame_of, pairs_of
from spdm_experiments.table1_lineup import (
    COLUMNS,
    KINDS,
    PLANNERS,
    Column,
    published,
    row_of,
    suite_of,
)
from spdm_experiments.table1_page import score_table, write_page
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario
from spdm_jax.metrics import OPEN_LOOP_SCORED
from spdm_models import dipp, dtpp, gameformer
from spdm_models.dipp import DIPPConfig
from spdm_models.dtpp import DTPPConfig
from spdm_models.gameformer import GameFormerConfig
from spdm_models.scene_encoder import EncoderConfig
from spdm_models.weights import save_weights

ENCODER = EncoderConfig(width=16, heads=8, layers=1)
TOKENS = ("a-00", "a-01", "b-00", "b-01")
BY_KEY = {column.key: column for column in COLUMNS}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, key = tmp_path_factory.mktemp("weights"), jax.random.key(0)
    network = GameFormerConfig(ENCODER, levels=1, modes=2, neighbors=3)
    training = {"task": "gameformer", "steps": 7, "scenes": ["common-14"]}
    params = gameformer.init(network, key)
    for name in ("gameformer", "gameformer-dipp"):
        save_weights(folder / f"{name}.safetensors", "gameformer", network, params, training)
    tree, own = DTPPConfig(ENCODER), DIPPConfig(width=16)
    save_weights(folder / "dtpp.safetensors", "dtpp", tree, dtpp.init(tree, key))
    save_weights(folder / "dipp.safetensors", "dipp", own, dipp.init(own, key))
    return folder


def made_up(folder: Path, column: Column, weights: Path) -> Run:
    """Writes a run folder whose scores say which planner and kind of prediction they are of."""
    points = entries_of(suite_of(column, PLANNERS, weights).points())
    rows = []
    for point in points:
        planner, kind = row_of(point)
        score = 0.1 * PLANNERS.index(planner) + 0.03 * KINDS.index(kind)
        metrics = CLOSED if column.mode == "closed" else OPEN_LOOP_SCORED
        for number, token in enumerate(TOKENS):
            lost = planner == "dipp" and number == 0
            row: dict[str, Any] = {
                **{key: point[key] for key in ("point", "planner", "num_proposals")},
                **{key: point[key] for key in ("traffic", "mode")},
                "token": token,
                "scenario_type": token[:1],
                "status": "failed" if lost else "ok",
                "reason": "no reason" if lost else "",
                "score": None if lost else score,
                **dict.fromkeys((*CLOSED, *OPEN_LOOP_SCORED), None),
                **dict.fromkeys(() if lost else metrics, 0.5 + score / 10),
                "progress_m": 30.0,
                "samples": 10,
                "run_ms": 100.0,
            }
            rows.append(row)
    target = folder / column.folder
    (target / "rows").mkdir(parents=True)
    frame = polars.DataFrame(rows, infer_schema_length=None)
    frame.write_parquet(target / "rows" / "part-0.parquet")
    about = {
        "format": 1,
        "command": "simulate",
        "suite": column.suite,
        "scenes": column.suite,
        "num_scenarios": len(TOKENS),
        "input_hash": "0" * 16,
        "seed": 0,
        "precision": "f32",
        "points": points,
        "versions": {"spdm-jax": "0.1.0"},
        "commit": "0123456789ab",
        "device": "cpu (cpu)",
        "created": "2026-11-25T10:00:00+00:00",
    }
    (target / "run.json").write_text(json.dumps(about), encoding="utf-8")
    return load_run(target)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, weights: Path) -> list[Run]:
    folder = tmp_path_factory.mktemp("runs")
    return [made_up(folder, column, weights) for column in COLUMNS]


# --- line-up


@pytest.mark.parametrize("column", COLUMNS, ids=lambda column: column.key)
def test_every_cell_of_the_paper_is_driven(column: Column, weights: Path):
    points = suite_of(column, PLANNERS, weights).points()
    assert {(p.traffic, p.mode) for p in points} == {(column.traffic, column.mode)}
    rows = [row_of(entry) for entry in entries_of(points)]
    assert len(set(rows)) == len(rows)
    wanted = [(p, k) for p in PLANNERS for k in KINDS if published(p, k, column) is not None]
    assert sorted(rows) == sorted(wanted)


def test_columns_have_names_of_their_own():
    names = [column.folder for column in COLUMNS]
    assert names == [
        "common-14-non-reactive",
        "common-14-reactive",
        "common-14-open-loop",
        "interactive-8-reactive",
    ]
    assert [column.title for column in COLUMNS][2:] == [
        "common-14, open loop",
        "interactive-8, reactive",
    ]


def test_published_scores_are_those_of_the_paper():
    assert published("dtpp", "perfect", BY_KEY["ol"]) == 32.52
    assert published("pdm-closed", "perfect", BY_KEY["r"]) is None
    assert published("dipp", "none", BY_KEY["interplan"]) == 13.07


# --- numbers


def test_cells_are_means_of_their_rows(runs: list[Run]):
    cells = cells_of(runs)
    assert len(cells) == 4 * 15 - 2
    for cell in cells:
        score = 10 * PLANNERS.index(cell.planner) + 3 * KINDS.index(cell.kind)
        assert cell.mean == pytest.approx(score, abs=1e-4)
        assert (cell.scenarios, cell.failed) == ((3, 1) if cell.planner == "dipp" else (4, 0))
    frame = frame_of(cells)
    assert frame.height == len(cells)
    (row,) = frame.filter(
        (polars.col("planner") == "dtpp")
        & (polars.col("prediction") == "none")
        & (polars.col("mode") == "open")
    ).iter_rows(named=True)
    assert row["published"] == 56.49 and row["no_ego_at_fault_collisions"] is None


def test_pairs_are_of_learned_planners(runs: list[Run]):
    pairs = pairs_of(cells_of(runs), BY_KEY["interplan"])
    assert {pair.planner for pair in pairs} == set(PLANNERS) - {"pdm-closed"}
    assert {pair.metric for pair in pairs} == set(CLOSED)
    for pair in pairs:
        assert pair.perfect - pair.learned == pytest.approx(0.3, abs=1e-3)


# --- page


def test_page_shows_scores_weights_and_a_figure(runs: list[Run], tmp_path: Path):
    page = tmp_path / "table1.md"
    page.write_text("old\n\n## What the runs show\n\nA thought.\n", encoding="utf-8")
    facts = {"file": "dtpp.safetensors", "digest": "abc", "model": "dtpp", "sizes": "width 16"}
    about = {
        "commands": ["python -m spdm_experiments.table1 run"],
        "machines": ["Some Processor"],
        "weights": {
            "dtpp": {**facts, "training": {}},
            "dipp": {**facts, "training": {"steps": 7, "cost_weights": [1.0] * 9}},
        },
    }
    cells = cells_of(runs)
    written = write_page(page, cells, runs, about)
    assert [path.suffix for path in written] == [".md", ".svg", ".png"]
    assert all(path.stat().st_size for path in written)
    text = page.read_text(encoding="utf-8")
    assert score_table(cells) in text and text.endswith("A thought.\n")
    assert "nothing is known" in text and "steps 7" in text and "cost_weights" not in text
    lines = [line for line in text.splitlines() if line.startswith("| DTPP | none")]
    cells_of_line = [cell.strip() for cell in lines[0].strip("|").split("|")]
    assert cells_of_line[2].startswith("16.00") and cells_of_line[3] == "*51.09*"
    (perfect,) = [line for line in text.splitlines() if line.startswith("| PDM-Closed | perfect")]
    assert perfect.count("*N/A*") == 2


def test_planners_driven_apart_share_a_page(weights: Path, tmp_path: Path, capsys):
    outs = (tmp_path / "first", tmp_path / "second")
    for number, (out, column) in enumerate(zip(outs, COLUMNS, strict=False)):
        made_up(out, column, weights)
        about = {"command": f"command {number}", "machines": ["Some Processor"]}
        (out / "about.json").write_text(json.dumps(about), encoding="utf-8")
        (out / "weights.json").write_text("{}", encoding="utf-8")
    page = tmp_path / "table1.md"
    command = ["page", "--out", str(outs[0]), "--also", str(outs[1]), "--page", str(page)]
    assert table1.main(command) == 0
    frame = polars.read_parquet(outs[0] / "table1.parquet")
    assert set(frame["traffic"]) == {"replay", "reactive"} and frame.height == 15 + 14
    text = page.read_text(encoding="utf-8")
    assert "Written by `command 0` and `command 1`. Machine: Some Processor." in text
    assert str(outs[1] / "table1.parquet") not in capsys.readouterr().out


def test_command_refuses_what_cannot_be(weights: Path, tmp_path: Path, capsys):
    run = ["run", "--out", str(tmp_path / "out")]
    for more, said in (
        ([], "--weights is missing"),
        (["--weights", str(tmp_path / "nowhere")], "no such folder"),
        (["--weights", str(tmp_path)], "no such file of weights for gameformer"),
    ):
        assert table1.main([*run, *more]) == 2
        assert said in capsys.readouterr().err
    assert table1.main(["page", "--out", str(tmp_path), "--page", str(tmp_path / "p.md")]) == 2
    assert "no rows yet" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        table1.main([*run, "--limit", "0"])


@pytest.mark.slow
def test_command_drives_prints_and_goes_on(weights: Path, tmp_path: Path, capsys):
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    for token in TOKENS:
        raw = dataclasses.replace(roads.road(token=token), scenario_type=token[:1])
        write_scenario(scenes / f"{token}.npz", *build_scenario(raw))
    out, page = tmp_path / "out", tmp_path / "table1.md"
    command = ["run", "--weights", str(weights), "--out", str(out), "--page", str(page)]
    command += ["--planner", "gameformer", "--column", "nr", "--limit", "1"]
    assert table1.main(command, scenes) == 0
    frame = polars.read_parquet(out / "table1.parquet")
    assert frame["prediction"].to_list() == list(KINDS) and set(frame["scenarios"]) == {2}
    assert frame["score"].is_finite().all()
    assert "34.99" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert "steps 7" in text and "--limit 1" in text
    assert table1.main(command, scenes) == 0
    assert "were done already" in capsys.readouterr().out
