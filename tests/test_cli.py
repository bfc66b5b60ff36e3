"""The `spdm` command: options, exit codes, error texts, and `pack` and `doctor` at work.

`plan`, `score`, `show` and `demo` have their tests in test_runs.py.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from spdm_experiments import cli, commands, doctor, sources
from spdm_experiments.options import Pack
from spdm_experiments.terminal import MAX_REASONS
from spdm_jax.io.raw import RawScenario, ScenarioError
from spdm_jax.io.scenario_file import read_scenario
from spdm_jax.synthetic import SyntheticReader

VERBS = (
    "convert",
    "demo",
    "doctor",
    "label",
    "pack",
    "plan",
    "report",
    "score",
    "show",
    "simulate",
    "sweep",
    "vocab",
)


class BrokenReader:
    """A reader whose scenarios named `bad...` cannot be read."""

    def __init__(self, tokens: Sequence[str]):
        self._tokens = tokens
        self._good = SyntheticReader(["open_road"], [0])

    def tokens(self) -> Sequence[str]:
        return self._tokens

    def read(self, token: str) -> RawScenario:
        if token.startswith("bad"):
            raise ScenarioError(f"log.db: field speed of {token} is -1")
        return self._good.read(token)


def pack_options(**changes) -> Pack:
    return Pack(**{"source": "all", "destination": Path("unused"), **changes})


@pytest.mark.parametrize("arguments", [["--help"], ["pack", "--help"]], ids=["spdm", "pack"])
def test_help_needs_no_jax(arguments: list[str]):
    code = (
        "import sys\n"
        "from spdm_experiments.cli import main\n"
        "try:\n"
        f"    main({arguments!r})\n"
        "except SystemExit as stop:\n"
        "    assert not stop.code, stop.code\n"
        "heavy = {'jax', 'flax', 'numpy', 'shapely', 'polars', 'matplotlib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    run = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env={**os.environ, "LC_ALL": "C"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-1000:]
    assert all(word in run.stdout for word in (VERBS if len(arguments) == 1 else ("--overwrite",)))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_its_options(verb: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        cli.main([verb, "--help"])
    assert not stop.value.code
    assert "Show the traceback of an error." in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["pack"], ["pack", "all", "out", "--format", "csv"], ["plan"]]
)
def test_wrong_options_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_options_reach_the_verb(monkeypatch: pytest.MonkeyPatch):
    seen: list[Pack] = []
    monkeypatch.setattr(commands, "pack", lambda options: seen.append(options) or True)
    arguments = "pack logs out --format nuplan --filter val14.yaml --token a b --type x --limit 3"
    assert cli.main(arguments.split()) == 0
    assert seen == [
        Pack(
            source="logs",
            destination=Path("out"),
            format="nuplan",
            filter=Path("val14.yaml"),
            token=("a", "b"),
            type=("x",),
            limit=3,
        )
    ]


@pytest.mark.parametrize("result, code", [(True, 0), (False, 1)])
def test_outcome_is_the_exit_code(result: bool, code: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(commands, "doctor", lambda options: result)
    assert cli.main(["doctor"]) == code


@pytest.mark.parametrize(
    "error, text",
    [
        (ScenarioError("a.npz: field x\nis 3"), "spdm: a.npz: field x is 3\n"),
        (ValueError("bad grid"), "spdm: bad grid\n"),
        (FileNotFoundError(2, "No such file", "x.npz"), "spdm: x.npz: No such file\n"),
        (ValueError(), "spdm: ValueError\n"),
    ],
)
def test_errors_take_one_line(
    error: Exception,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    def fail(options: object) -> bool:
        raise error

    monkeypatch.setattr(commands, "doctor", fail)
    assert cli.main(["doctor"]) == 2
    assert capsys.readouterr().err == text
    assert cli.main(["doctor", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_missing_extra_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(options: object) -> bool:
        raise ModuleNotFoundError("No module named 'polars'")

    monkeypatch.setattr(commands, "pack", fail)
    assert cli.main(["pack", "logs", "out"]) == 2
    assert 'pip install "spdm-jax[data,plot]"' in capsys.readouterr().err


def test_defects_keep_their_traceback(monkeypatch: pytest.MonkeyPatch):
    def fail(options: object) -> bool:
        raise KeyError("a defect of the program")

    monkeypatch.setattr(commands, "doctor", fail)
    with pytest.raises(KeyError):
        cli.main(["doctor"])


def test_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def interrupt(options: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "pack", interrupt)
    assert cli.main(["pack", "all", "out"]) == 130
    assert "goes on where it stopped" in capsys.readouterr().err
    assert cli.main(["pack", "all", "out", "--overwrite"]) == 130
    assert "goes on where it stopped" not in capsys.readouterr().err


def test_pack_writes_resumes_and_overwrites(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ["pack", "open_road", str(tmp_path / "pack"), "--seeds", "0", "1"]
    assert cli.main([*command, "--limit", "1"]) == 0
    (first,) = tmp_path.glob("pack/*.npz")
    scenario, info = read_scenario(first)
    assert (info.source, info.token) == ("synthetic", first.stem)
    assert np.asarray(scenario.num_iterations) > 0
    assert "1 scenarios, 1 written, 0 there already, 0 failed" in capsys.readouterr().out
    assert cli.main(command) == 0
    assert "2 scenarios, 1 written, 1 there already, 0 failed" in capsys.readouterr().out
    assert cli.main([*command, "--overwrite"]) == 0
    assert "2 scenarios, 2 written, 0 there already, 0 failed" in capsys.readouterr().out


def test_pack_lists_failed_scenarios(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    bad = [f"bad{i}" for i in range(MAX_REASONS + 2)]
    reader = BrokenReader(["open_road-0", *bad])
    monkeypatch.setattr(sources, "open_source", lambda options: (reader, ["half a remark"]))
    assert cli.main(["pack", "logs", str(tmp_path / "pack")]) == 1
    printed = capsys.readouterr()
    assert f"1 written, 0 there already, {len(bad)} failed" in printed.out
    assert printed.out.count("field speed of bad") == MAX_REASONS
    assert "2 more in" in printed.out
    assert "note: half a remark" in printed.err
    assert [path.name for path in tmp_path.glob("pack/*.npz")] == ["open_road-0.npz"]


def make_source(folder: Path, layout: str) -> Path:
    for name in layout.split():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    "layout, kind",
    [
        ("nuplan-v1.1/splits/mini/a.db", "nuplan"),
        ("city_SE3_egovehicle.feather map/log_map_archive_x.json", "av2"),
        ("log1/city_SE3_egovehicle.feather log2/city_SE3_egovehicle.feather", "av2"),
    ],
)
def test_format_is_told_by_the_files(layout: str, kind: str, tmp_path: Path):
    assert sources.detect_format(str(make_source(tmp_path, layout))) == kind


def test_format_of_a_single_log_and_of_scene_names(tmp_path: Path):
    assert sources.detect_format(str(make_source(tmp_path, "a.db") / "a.db")) == "nuplan"
    assert sources.detect_format("all") == "synthetic"
    assert sources.detect_format("open_road, parked_car") == "synthetic"


@pytest.mark.parametrize(
    "layout, name, text",
    [
        ("notes.txt", ".", "no nuPlan log"),
        ("notes.txt", "notes.txt", "not a nuPlan log"),
        ("notes.txt", "gone", "no such file or folder, and no built-in scene"),
    ],
)
def test_unknown_source_is_named(layout: str, name: str, text: str, tmp_path: Path):
    source = str(make_source(tmp_path, layout) / name)
    with pytest.raises(ValueError, match=text) as error:
        sources.detect_format(source)
    assert source in str(error.value)


def test_unknown_scene_in_a_list_is_named():
    with pytest.raises(ValueError, match=r"no scene 'moon'; the scenes are .*open_road"):
        sources.open_source(pack_options(source="open_road,moon"))


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"filter": Path("val14.yaml")}, "--filter applies to nuplan sources"),
        ({"log": ("a",)}, "--log applies to nuplan sources"),
        ({"stride": 1.0}, "--stride applies to av2 sources"),
        ({"token": ("moon-0",)}, "--token moon-0: not in the source"),
        ({"limit": 0}, "--limit is 0"),
    ],
)
def test_options_that_cannot_apply_are_refused(changes: dict, text: str):
    with pytest.raises(ValueError, match=text):
        sources.open_source(pack_options(**changes))


def test_selection_keeps_the_order_of_the_source():
    reader = BrokenReader(["c", "a", "b", "d"])
    assert sources.Selection(reader, [], None).tokens() == ["c", "a", "b", "d"]
    assert sources.Selection(reader, ["b", "c", "a"], 2).tokens() == ["c", "a"]
    with pytest.raises(ValueError, match="no scenario"):
        sources.Selection(BrokenReader([]), [], None)


def test_recorded_sources_open(shared: Path):
    av2 = pack_options(source=str(shared / "data" / "av2_sensor"), limit=2)
    assert len(sources.open_source(av2)[0].tokens()) == 2
    folders = sorted((shared / "data" / "nuplan_format").glob("pit_*"))
    everything, _ = sources.open_source(pack_options(source=str(folders[0])))
    chosen = everything.tokens()[:2]
    nuplan = pack_options(source=str(folders[0]), token=tuple(chosen))
    assert list(sources.open_source(nuplan)[0].tokens()) == list(chosen)


def test_doctor_finds_this_machine_sound(capsys: pytest.CaptureFixture[str]):
    assert cli.main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for word in ("python", "jax", "device", "cache", "float32", "float64"):
        assert word in printed
    assert "FAILED" not in printed


@pytest.mark.parametrize("deviation", [0.01, float("nan")])
def test_doctor_reports_wrong_numbers(
    deviation: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(doctor, "_least_squares", lambda dtype: deviation)
    assert cli.main(["doctor"]) == 1
    assert "FAILED      least squares (float32)" in capsys.readouterr().out


def test_doctor_notices_a_wrong_score(monkeypatch: pytest.MonkeyPatch):
    moved = doctor.stored_trajectories()
    moved[1, :, 1] += 2.0  # braking in the next lane scores otherwise than braking in the own
    monkeypatch.setattr(doctor, "stored_trajectories", lambda: moved)
    assert not doctor.run_checks()[-1].passed


def test_doctor_without_cache(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(doctor, "run_checks", list)
    assert cli.main(["doctor", "--no-compile-cache"]) == 0
    assert "cache       off" in capsys.readouterr().out


def test_missing_package_is_named():
    assert "not installed" in doctor.version("no-such-package-of-this-name")
