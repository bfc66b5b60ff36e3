"""The closed-loop page: line-up, numbers, tables, figures, precision; rows are made up."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest

import small_road as roads
from spdm_experiments import (
    closed_loop,
    closed_loop_data,
    closed_loop_figures,
    closed_loop_page,
    closed_loop_precision,
)
from spdm_experiments.closed_loop_lineup import (
    COMPARED,
    PRECISION_LINEUP,
    PUBLISHED,
    SUITES,
    Suite,
    name_of,
)
from spdm_experiments.closed_loop_precision import Pair, first_other_choice
from spdm_experiments.closed_loop_trace import Trace
from spdm_experiments.options import Simulate
from spdm_experiments.report_data import Run, load_run
from spdm_experiments.simulate_terms import CLOSED
from spdm_jax.io.build import build_scenario
from spdm_jax.io.scenario_file import write_scenario

ABOUT = {
    "command": "python -m spdm_experiments.closed_loop",
    "machines": ["Some Processor, 2 core(s), Python 3.11.1"],
}
KINDS = ("turning_left", "waiting")
TOKENS = [f"{kind}-{number:02d}" for kind in KINDS for number in range(3)]
Scores = Mapping[tuple[str, str], Sequence[float]]


def write_run(
    folder: Path,
    suite: Suite,
    scores: Scores,
    *,
    failed: tuple[str, ...] = (),
    run_ms: float = 100.0,
    **about: Any,
) -> Run:
    """Writes a run folder of a suite.

    Args:
      folder: made if absent.
      suite: gives the points.
      scores: row name and traffic -> score of each of `TOKENS`; 0.5 where left out.
      failed: tokens that SPDM 60 failed in.
      run_ms: of a drive, without what its proposals add.
      about: entries of run.json that differ from the usual.
    """
    points = [point.entry(number) for number, point in enumerate(suite.points())]
    rows = []
    for point in points:
        name = name_of(point)
        mine = scores.get((name, point["traffic"]), [0.5] * len(TOKENS))
        for token, score in zip(TOKENS, mine, strict=True):
            row: dict[str, Any] = {
                **{key: point[key] for key in ("point", "planner", "num_proposals", "traffic")},
                "token": token,
                "scenario_type": token[:-3],
                "status": "ok",
                "reason": "",
                "score": score,
                **dict.fromkeys(CLOSED, 1.0),
                "no_ego_at_fault_collisions": float(score > 0),
                "progress_m": 30.0,
                "samples": 10,
                "run_ms": run_ms + (point["num_proposals"] or 0),
            }
            if name == "SPDM 60" and token in failed:
                row |= {"status": "failed", "reason": "no reason", "score": None}
            rows.append(row)
    (folder / "rows").mkdir(parents=True)
    polars.DataFrame(rows, infer_schema_length=None).write_parquet(folder / "rows/part-0.parquet")
    described = {
        "format": 1,
        "command": "simulate",
        "suite": suite.name,
        "scenes": "suite",
        "num_scenarios": len(TOKENS),
        "input_hash": "0" * 16,
        "seed": 0,
        "precision": "f32",
        "points": points,
        "versions": {"spdm-jax": "0.1.0", "jax": "0.10.2"},
        "commit": "0123456789ab",
        "device": "cpu (cpu)",
        "created": "2026-11-25T10:00:00+00:00",
        **about,
    }
    (folder / "run.json").write_text(json.dumps(described), encoding="utf-8")
    sessions = [{"ended": "2026-11-25T11:00:00+00:00", "commit": "0123456789ab", "device": "cpu"}]
    (folder / "progress-all.json").write_text(json.dumps({"sessions": sessions}), encoding="utf-8")
    return load_run(folder)


SPDM_60 = [0.75, 0.75, 0.75, 0.25, 0.25, 0.25]
"""Better than the usual 0.5 in the first type, worse in the second."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    folder = tmp_path_factory.mktemp("runs")
    scores: list[Scores] = [
        {("SPDM 60", "reactive"): SPDM_60, ("IDM", "replay"): [0.0] * 3 + [1.0] * 3},
        {("SPDM 60", "reactive"): SPDM_60},
    ]
    return [
        write_run(folder / suite.name, suite, mine, failed=lost)
        for suite, mine, lost in zip(SUITES, scores, ((), (TOKENS[0],)), strict=True)
    ]


@pytest.fixture(scope="module")
def page(runs: list[Run], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "closed_loop.md"
    closed_loop_page.write_page(path, runs, ABOUT)
    return path


def table(text: str, heading: str) -> dict[str, list[str]]:
    """Returns the rows of the first table after a heading, by their first cell."""
    after = text[text.index(heading) :].splitlines()
    start = next(i for i, line in enumerate(after) if line.startswith("|"))
    found = {}
    for line in after[start:]:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip("|").split("|"))
        found[first] = rest
    return found


# --- line-up


@pytest.mark.parametrize("suite", SUITES, ids=lambda suite: suite.name)
def test_every_suite_has_the_planners_of_the_tables(suite: Suite):
    points = [point.entry(number) for number, point in enumerate(suite.points())]
    assert len({(name_of(point), point["traffic"]) for point in points}) == len(points)
    names = {name_of(point) for point in points}
    assert names >= PUBLISHED.keys() | set(COMPARED)
    assert names >= {f"PDM-Closed {count}" for count in (1, 3, 6, 15, 30, 60)}
    assert "SPDM 30, progress along the centreline" in names and "Constant velocity" in names
    borrows = "SPDM 60, may borrow the oncoming lane"
    assert (borrows in names) == (suite.name == "interactive-8")
    for traffic in suite.traffic:
        assert {name_of(p) for p in points if p["traffic"] == traffic} == names
    again = dataclasses.replace(suite, lineup=PRECISION_LINEUP).points()
    assert {name_of(point.entry(0)) for point in again} == set(COMPARED)


def tiny_pack(folder: Path) -> Path:
    folder.mkdir()
    for token in ("a-00", "a-01", "b-00", "b-01"):
        raw = roads.road(token=token, speed=8.0 + 2 * (token[-1] == "1"))
        raw = dataclasses.replace(raw, scenario_type=token[0])
        write_scenario(folder / f"{token}.npz", *build_scenario(raw))
    return folder


def test_limit_is_one_of_each_type(tmp_path: Path):
    suite = Suite("tiny", tiny_pack(tmp_path / "pack"), ("replay",))
    options = Simulate(scenes=Path())
    tokens = lambda limit: [e.token for e in suite.find(options, limit).inventory.entries]
    assert tokens(1) == ["a-00", "b-00"] and tokens(None) == ["a-00", "a-01", "b-00", "b-01"]
    digests = {suite.find(options, limit).inventory.digest for limit in (1, 2)}
    assert len(digests) == 2


# --- numbers


def test_differences_are_of_the_same_scenarios(runs: list[Run]):
    panels = closed_loop_data.panels_of(runs)
    assert [panel.title for panel in panels] == [
        "common-14, non-reactive",
        "common-14, reactive",
        "interactive-8, reactive",
    ]
    found = [closed_loop_data.differences(panel, *COMPARED) for panel in panels]
    assert [(d.kind, d.scenarios, d.mean) for d in found[0]] == [(kind, 3, 0.0) for kind in KINDS]
    assert [(d.mean, d.low, d.high) for d in found[1]] == [(25, 25, 25), (-25, -25, -25)]
    assert [d.scenarios for d in found[2]] == [2, 3]  # one failed
    assert closed_loop_data.differences(panels[0], "SPDM 60", "nobody") == []


def test_step_time_is_that_of_a_drive_over_its_steps(runs: list[Run]):
    (panel, *_) = closed_loop_data.panels_of(runs)
    assert panel.step_ms["SPDM 60"] == pytest.approx(16.0)
    assert panel.step_ms["IDM"] == pytest.approx(10.0)
    counts = [count for count, _ in closed_loop_data.curve(panel, "SPDM")]
    assert counts == [15, 20, 25, 30, 45, 60]
    assert all("," not in name for _, name in closed_loop_data.curve(panel, "SPDM"))


# --- page


def test_scores_stand_beside_published_ones(page: Path):
    text = page.read_text(encoding="utf-8")
    found = table(text, "## Scores")
    assert found["planner"][::2] == [
        "common-14, non-reactive",
        "common-14, reactive",
        "interactive-8, reactive",
    ]
    assert found["planner"][1::2] == [
        f"*{name}, published*" for name in ("Val14 NR", "Val14 R", "interPlan R")
    ]
    assert found["SPDM 60"][0] == "50.00 (50.0 – 50.0)"
    assert found["SPDM 60"][1] == "*91.49* [1]" and found["SPDM 60"][5] == "*63.66* [1]"
    assert found["SPDM 60"][2].startswith("50.00 (") and "(50.0" not in found["SPDM 60"][2]
    assert found["SPDM 60"][4].startswith("45.00 (") and found["SPDM 60"][4].endswith("(1 failed)")
    assert found["PDM-Closed 6"][1::2] == ["", "", ""]
    assert found["IDM + MOBIL"][1::2] == ["", "*75* [3]", "*31* [3]"]
    assert found["SPDM 15"][5] == "*42.00* [1]"
    for source in (1, 2, 3):
        assert f"\n[{source}] " in text


def test_tables_by_type_and_by_metric(page: Path):
    text = page.read_text(encoding="utf-8")
    found = table(text, "### interactive-8, reactive")
    assert found["planner"] == ["turning left (3)", "waiting (3)"]
    assert found["SPDM 60"] == ["75.0", "25.0"]
    folded = text[text.index("<details><summary>common-14, reactive") :]
    assert table(folded, "summary>common-14, reactive")["SPDM 60"] == ["75.0", "25.0"]
    assert text.count("<details>") == text.count("</details>") == 2
    metrics = table(text, "### Metrics: common-14, non-reactive")
    assert metrics["planner"][:3] == ["score", "NC", "DAC"]
    assert metrics["IDM"][:3] == ["50.0", "50.0", "100.0"]
    assert table(text, "## Run time")["SPDM 60"] == ["16.00", "16.00", "16.00"]


def test_page_says_where_it_comes_from(page: Path):
    head = table(page.read_text(encoding="utf-8"), "# Closed loop")
    assert head[""] == ["common-14", "interactive-8"]
    assert head["scenarios"] == ["6", "6"] and head["precision"] == ["f32", "f32"]
    assert head["commit"] == ["0123456789ab"] * 2
    assert head["ended"] == ["2026-11-25T11:00:00+00:00"] * 2
    text = page.read_text(encoding="utf-8")
    assert f"`{ABOUT['command']}`" in text and ABOUT["machines"][0] in text and "seed 0" in text


def test_unfinished_runs_say_so(tmp_path: Path):
    run = write_run(tmp_path / "run", SUITES[1], {}, num_scenarios=80)
    closed_loop_page.write_page(tmp_path / "page.md", [run], ABOUT)
    found = table((tmp_path / "page.md").read_text(encoding="utf-8"), "# Closed loop")
    assert found["scenarios"] == ["6 of 80: the run goes on"]


def test_run_times_can_be_those_of_another_run(runs: list[Run], tmp_path: Path):
    quiet = [write_run(tmp_path / s.name, s, {}, run_ms=40.0) for s in SUITES]
    closed_loop_page.write_page(tmp_path / "page.md", runs, ABOUT, timed=quiet)
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert table(text, "## Run time")["SPDM 60"] == ["10.00", "10.00", "10.00"]
    assert table(text, "### interactive-8, reactive")["SPDM 60"] == ["75.0", "25.0"]
    other = dataclasses.replace(SUITES[1], lineup=SUITES[1].lineup[:1])
    wrong = [quiet[0], write_run(tmp_path / "other", other, {})]
    for timed in (quiet[:1], wrong):
        with pytest.raises(ValueError, match="interactive-8: the timed run is missing or of other"):
            closed_loop_page.write_page(tmp_path / "page.md", runs, ABOUT, timed=timed)


def test_page_is_repeatable_and_keeps_what_people_wrote(
    page: Path, runs: list[Run], tmp_path: Path
):
    assert page.read_text(encoding="utf-8").rstrip().endswith(closed_loop_page.KEPT)
    again = tmp_path / page.name
    words = f"{closed_loop_page.KEPT}\n\nMore proposals help.\n\n## More\n\nx\n"
    again.write_text(f"# Old\n\n{words}", encoding="utf-8")
    closed_loop_page.write_page(again, runs, ABOUT)
    written = closed_loop_page.write_page(again, runs, ABOUT)
    text = again.read_text(encoding="utf-8")
    assert (
        text[: -len(words)] == page.read_text(encoding="utf-8")[: -len(closed_loop_page.KEPT) - 1]
    )
    figures = [path for path in written if path.suffix != ".md"]
    assert len(figures) == 6
    for path in figures:
        assert path.read_bytes() == page.with_name(path.name).read_bytes(), path.name
        assert path.suffix == ".png" or path.name in text


def test_figures_have_published_scores_as_hollow_marks(runs: list[Run]):
    panels = closed_loop_data.panels_of(runs)
    faster = [dataclasses.replace(panels[0], step_ms={n: 1.0 for n in panels[0].points})]
    times = closed_loop_figures.plot_runtime([*faster, *panels[1:]]).axes
    assert times[0].get_ylim()[0] == 0 and times[0].get_ylim()[1] >= 16.0
    axes = closed_loop_figures.plot_score(panels).axes
    assert len(axes) == 3
    lines = {str(line.get_label()): line for line in axes[2].get_lines()}
    ours, theirs = lines["SPDM"], lines["SPDM, published"]
    assert np.asarray(ours.get_xdata()).tolist() == [15, 20, 25, 30, 45, 60]
    assert np.asarray(theirs.get_ydata()).tolist() == [42.0, 49.72, 52.77, 59.07, 62.37, 63.66]
    assert theirs.get_markerfacecolor() == "none"
    assert np.asarray(lines["PDM-Closed, published"].get_xdata()).tolist() == [15, 60]
    left, right = closed_loop_figures.plot_difference(panels).axes
    means = [np.asarray(line.get_xdata()).tolist() for line in left.get_lines()[:2]]
    assert means == [[0, 0], [25, -25]]
    assert [label.get_text() for label in right.get_yticklabels()] == ["turning left", "waiting"]


# --- precision


def trace(best: Sequence[int], brake: Sequence[bool], scores: Sequence[Sequence[float]]) -> Trace:
    count = len(best)
    return Trace(
        valid=np.arange(count) < count - 1,
        time=0.1 * np.arange(count),
        x=np.arange(count, dtype=float),
        y=np.zeros(count),
        scores=np.array(scores),
        best=np.array(best),
        brake=np.array(brake),
        score=np.array(0.5),
    )


FLAT = [[0.5, 0.25]] * 4


def test_first_other_choice_of_two_drives():
    double = trace([0, 0, 1, 1], [False] * 4, [[0.5, 0.25], [0.5, 0.25], [0.5, 0.5625], [0, 1]])
    single = trace([0, 0, 0, 0], [False] * 4, FLAT)
    single = single.replace(x=np.asarray(single.x) + 0.002)
    found = first_other_choice(single, double)
    assert found is not None
    assert found["time"] == pytest.approx(0.2) and (found["f32"], found["f64"]) == (0, 1)
    assert found["margin"] == 0.0625 and found["apart"] == pytest.approx(0.002)
    assert found["brake"] == ""
    assert first_other_choice(double, double) is None


def test_brakes_are_choices_and_padding_is_not():
    still = trace([0, 0, 0, 0], [False] * 4, FLAT)
    braking = trace([0, 1, 0, 0], [False, True, False, False], FLAT)
    found = first_other_choice(braking, still)
    assert found is not None and found["brake"] == "float32"
    found = first_other_choice(still, braking)
    assert found is not None and found["brake"] == "float64"
    both = trace([0, 0, 0, 0], [False, True, False, False], FLAT)
    assert first_other_choice(both, braking) is None  # whatever was best, both brake
    late = trace([0, 0, 0, 1], [False] * 4, FLAT)
    assert first_other_choice(still, late) is None  # the last sample is padding


def test_precision_is_a_section_of_the_page(
    runs: list[Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    own = dataclasses.replace(SUITES[1], lineup=PRECISION_LINEUP)
    changed = [0.75, 0.75 + 0.009, *SPDM_60[2:5], 1.0]
    double = write_run(tmp_path / "f64", own, {("SPDM 60", "reactive"): changed}, precision="f64")
    asked = []

    def made_up(entries: Any, point: Any, precision: str) -> dict[str, Trace]:
        asked.append((point.planner, precision))
        best = [0, 0, 0, 0] if precision == "f32" else [0, 1, 1, 1]
        score = 0.25 if precision == "f32" else 1.0
        found = trace(best, [False] * 4, [[0.5, 0.5 + 2**-20]] * 4)
        return {TOKENS[5]: found.replace(score=np.array(score))}

    monkeypatch.setattr(closed_loop_precision, "trace_drives", made_up)
    found = closed_loop_precision.compare([Pair(runs[1], double, own.points(), [])])
    assert asked == [("spdm", "f32"), ("spdm", "f64")]
    closed_loop_page.write_page(tmp_path / "page.md", [runs[1]], ABOUT, found)
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    shares = table(text, "## Single and double precision")
    assert shares["PDM-Closed 15"][:4] == ["interactive-8, reactive", "6", "6", "100.0%"]
    # One of the scenarios has no score in float32.
    assert shares["SPDM 60"][:4] == ["interactive-8, reactive", "5", "4", "80.0%"]
    other = table(text, "The others, driven once more")[TOKENS[5]]
    assert other[:4] == ["SPDM 60", "reactive", "0.2500", "1.0000"]
    assert other[4:] == ["0.1 s", "proposal 1 in float64, 0 in float32", "9.5e-07", "0 mm"]
    assert "again in 1 of 1" in text
    elsewhere = dataclasses.replace(double, about={**double.about, "input_hash": "1" * 16})
    with pytest.raises(ValueError, match=r"input_hash is '1+'"):
        closed_loop_precision.compare([Pair(runs[1], elsewhere, own.points(), [])])


# --- the command


@pytest.mark.parametrize(
    "given, words",
    [
        (["--limit", "0"], "--limit is 0"),
        (["--chunk", "0"], "--chunk is 0"),
        (["--page", "page.txt"], "must end in .md"),
        (["page"], "needs --page"),
    ],
)
def test_useless_options_are_refused(given: list[str], words: str, capsys):
    with pytest.raises(SystemExit) as stopped:
        closed_loop.main(given)
    assert stopped.value.code == 2 and words in capsys.readouterr().err


def test_page_and_precision_need_rows(tmp_path: Path, capsys):
    given = ["--out", str(tmp_path), "--page", str(tmp_path / "page.md")]
    assert closed_loop.main(["page", *given]) == 2
    assert "no rows yet; run first" in capsys.readouterr().err
    assert closed_loop.main(["precision", *given]) == 2
    assert "no such folder" in capsys.readouterr().err


def test_stopped_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    def stopped(*_: Any) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(closed_loop, "drive", stopped)
    assert closed_loop.main(["--out", str(tmp_path)]) == 130
    assert "the same command goes on" in capsys.readouterr().err


@pytest.mark.slow
def test_small_suite_from_drives_to_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """Every scenario counts as one that differs, so that both precisions are recorded."""
    lineup = ({"planner": ("pdm-closed",), "num_proposals": (3,)}, {"planner": ("log-replay",)})
    suites = (Suite("tiny", tiny_pack(tmp_path / "pack"), ("replay",), lineup),)
    monkeypatch.setattr(closed_loop, "PRECISION_LINEUP", lineup[:1])
    monkeypatch.setattr(closed_loop_precision, "WITHIN", -1.0)
    page = tmp_path / "page.md"
    given = ["--out", str(tmp_path / "out"), "--page", str(page), "--limit", "1"]
    assert closed_loop.main(given, suites) == 0
    assert set(table(page.read_text(encoding="utf-8"), "## Scores")) >= {
        "PDM-Closed 3",
        "Log replay",
    }
    capsys.readouterr()
    assert closed_loop.main(given, suites) == 0
    assert "all 2 scenarios were done already" in capsys.readouterr().out
    assert closed_loop.main(["precision", *given], suites) == 0
    (row,) = json.loads((tmp_path / "out/precision.json").read_text(encoding="utf-8"))["rows"]
    assert [other["token"] for other in row["others"]] == ["a-00", "b-00"]
    assert all(abs(other["f32"] - other["f64"]) < 0.01 for other in row["others"])
    assert "## Single and double precision" in page.read_text(encoding="utf-8")
