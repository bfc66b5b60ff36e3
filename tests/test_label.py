"""`spdm label` and the reader of its folder.

A cheap function stands in for the scorer where the bookkeeping is under test; what it returns names
scene, trajectory and component. One set of scenes is scored for real.
"""

import json
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import polars
import pytest

import sweep_pack
from spdm_experiments import cli, label_work
from spdm_experiments.label import parse_components, read_vocabulary
from spdm_experiments.label_scene import COMPONENTS, Part, Scored
from spdm_jax import labels, load, scene_score, score
from spdm_jax.config import PlannerConfig
from spdm_jax.labels import Labels, open_labels

COUNT = 6
TOKENS = [f"scene-{i:02d}" for i in range(COUNT)]
SIZE = 5
SLOW = 10.6  # m/s, some scenes' egos are faster


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pack")
    assert sweep_pack.write_pack(folder, COUNT) == TOKENS
    return folder


@pytest.fixture
def bad_pack(pack: Path, tmp_path: Path) -> Path:
    """The pack with a file that is no scenario, and scenes whose ego drives backwards."""
    folder = tmp_path / "pack"
    sweep_pack.write_pack(folder, COUNT, slow=2)
    (folder / "broken.npz").write_bytes(b"PK not a zip archive")
    return folder


def fan(count: int) -> np.ndarray:
    """Trajectories `[count, 41, 3]` straight ahead, at 1, 2, ... m/s and a little to the left."""
    poses = np.zeros((count, 41, 3))
    poses[..., 0] = (1.0 + np.arange(count))[:, None] * 0.1 * np.arange(41)
    poses[..., 1] = 0.02 * np.arange(41)
    return poses


@pytest.fixture(scope="module")
def vocabulary(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vocabulary") / "v.npy"
    np.save(path, fan(SIZE))
    return path


def cheap_score(scene: Any, part: Part, params: Any, static: Any) -> Scored:
    """Stands in for the scorer: 0.25 x speed + metres driven + 100 x number of the component."""
    speed = scene.ego.vx[scene.num_history]
    here = jnp.stack([scene.ego.x[scene.num_history], scene.ego.y[scene.num_history]])
    way = jnp.linalg.norm(part.states[:, -1, :2] - here, axis=-1) + 0.25 * speed
    scores = {name: way + 100 * i for i, name in enumerate(COMPONENTS)}
    return Scored(scores=scores, overflow=speed < 0)


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_work, "score_part", cheap_score)


def run(pack: Path, vocabulary: Path, out: Path, *more: str) -> int:
    return cli.main(["label", str(pack), str(vocabulary), "--out", str(out), *more])


def speed_of(pack: Path, token: str) -> float:
    ego = load(pack / f"{token}.npz").batch
    return float(ego.ego.vx[0, ego.num_history[0]])


def check(found: Labels, pack: Path, tokens: list[str], tolerance: float) -> None:
    """Every scene has the labels that `cheap_score` gives it."""
    assert sorted(found.tokens) == tokens
    for token in tokens:
        way = np.hypot(*fan(SIZE)[:, -1, :2].T) + 0.25 * speed_of(pack, token)
        wanted = way[:, None] + 100.0 * np.arange(len(COMPONENTS))
        np.testing.assert_allclose(found[token], wanted, rtol=tolerance)


@pytest.mark.parametrize("dtype, tolerance", [("f32", 1e-6), ("f16", 2**-11)])
def test_every_scene_has_its_labels(
    dtype: str, tolerance: float, pack: Path, vocabulary: Path, tmp_path: Path, cheap: None
):
    out = tmp_path / "labels"
    assert run(pack, vocabulary, out, "--dtype", dtype, "--chunk", "4") == 0
    found = open_labels(out)
    check(found, pack, TOKENS, tolerance)
    assert found.components == COMPONENTS and found.shape == (SIZE, len(COMPONENTS))
    assert found.dtype == {"f16": np.float16, "f32": np.float32}[dtype] and not found.failures
    np.testing.assert_array_equal(found.vocabulary(), fan(SIZE))
    shards = [np.load(path, mmap_mode="r") for path in sorted((out / "shards").iterdir())]
    assert sorted(len(shard) for shard in shards) == [2, 4]
    index = polars.read_parquet(out / "index" / "part-*.parquet").sort("token")
    assert index["token"].to_list() == TOKENS and set(index["status"]) == {"ok"}
    assert set(index["map_name"]) == {"synthetic"}
    about = json.loads((out / "label.json").read_text())
    assert about["vocabulary"]["shape"] == [SIZE, 41, 3] and len(about["vocabulary"]["hash"]) == 64
    assert about["config"]["tracker"] == "reference" and about["versions"]["jax"]
    progress = json.loads((out / "progress-all.json").read_text())
    assert progress["finished"] and progress["done"] == COUNT
    assert not list(out.rglob("*.tmp"))


def test_components_are_picked_by_name(pack: Path, vocabulary: Path, tmp_path: Path, cheap: None):
    more = ("--components", "comfort, total", "--limit", "2", "--dtype", "f32")
    assert run(pack, vocabulary, tmp_path / "some", *more) == 0
    found = open_labels(tmp_path / "some")
    assert found.components == ("comfort", "total") and found.column("total") == 1
    assert found.shape == (SIZE, 2) and len(found) == 2
    np.testing.assert_allclose(found[TOKENS[0]][:, 0] - found[TOKENS[0]][:, 1], 500)
    with pytest.raises(KeyError, match="no component 'progress'; there are comfort, total"):
        found.column("progress")


@pytest.mark.parametrize(
    "text, error", [("total,nc", "no component 'nc'"), ("total,total", "each one once")]
)
def test_wrong_components_are_refused(text: str, error: str):
    with pytest.raises(ValueError, match=error):
        parse_components(text)


def contents(out: Path) -> dict[str, bytes]:
    return {token: row.tobytes() for token, row in rows_of(open_labels(out)).items()}


def rows_of(found: Labels) -> dict[str, np.ndarray]:
    return {token: np.array(found[token]) for token in found}


def test_labels_do_not_depend_on_chunks(
    pack: Path, vocabulary: Path, tmp_path: Path, cheap: None, monkeypatch: pytest.MonkeyPatch
):
    assert run(pack, vocabulary, tmp_path / "one") == 0
    assert run(pack, vocabulary, tmp_path / "three", "--chunk", "3") == 0
    monkeypatch.setattr("spdm_experiments.label.MEMORY", 1)  # scene by scene through memory
    assert run(pack, vocabulary, tmp_path / "pieces", "--chunk", "5") == 0
    assert len(list((tmp_path / "pieces" / "shards").iterdir())) == 2
    one = contents(tmp_path / "one")
    assert one == contents(tmp_path / "three") == contents(tmp_path / "pieces")
    assert len(set(one.values())) == COUNT


def test_interrupt_ends_the_chunk_and_the_command_goes_on(
    pack: Path,
    vocabulary: Path,
    tmp_path: Path,
    cheap: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    assert run(pack, vocabulary, tmp_path / "whole") == 0
    out = tmp_path / "labels"
    scored: list[int] = []
    original = label_work.Labeller.score

    def once(self: Any, piece: Any) -> Any:
        if not scored:
            signal.raise_signal(signal.SIGINT)
        scored.append(len(piece.scenes.entries))
        return original(self, piece)

    monkeypatch.setattr(label_work.Labeller, "score", once)
    assert run(pack, vocabulary, out, "--chunk", "2") == 130
    printed = capsys.readouterr()
    assert "2 of 6 scenarios done, 0 failed" in printed.out
    command = ["label", str(pack), str(vocabulary), "--out", str(out), "--chunk", "2"]
    assert f"interrupted; go on with: spdm {shlex.join(command)}" in printed.err
    assert len(open_labels(out)) == 2  # a folder may be read before it is finished
    scored[:] = [0]
    assert run(pack, vocabulary, out, "--chunk", "3") == 0
    assert sum(scored) == 4  # what was done is not done again
    assert contents(out) == contents(tmp_path / "whole")
    scored[:] = [0]
    assert run(pack, vocabulary, out) == 0
    assert scored == [0] and "all 6 scenarios were done already" in capsys.readouterr().out


CHILD = """
import os, signal, sys
sys.path[:0] = {paths!r}
import test_label
from spdm_experiments import cli, label_folder, label_work
label_work.score_part = test_label.cheap_score
write, seen = label_folder.write_atomically, 0
def dying(path, content):
    global seen
    seen += path.suffix == {suffix!r}
    if seen == 2:
        path.with_name(f".{{path.name}}.1.tmp").write_bytes(content[:len(content) // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    write(path, content)
label_folder.write_atomically = dying
sys.exit(cli.main({arguments!r}))
"""


@pytest.mark.parametrize("suffix", [".parquet", pytest.param(".npy", marks=pytest.mark.slow)])
def test_killed_it_goes_on(suffix: str, pack: Path, vocabulary: Path, tmp_path: Path, cheap: None):
    out = tmp_path / "labels"
    arguments = ["label", str(pack), str(vocabulary), "--out", str(out), "--chunk", "2"]
    here = Path(__file__).parent
    paths = [str(here), str(here / "helpers")]
    code = CHILD.format(paths=paths, suffix=suffix, arguments=arguments)
    # The vocabulary is the first .npy file, so one more write comes before the end.
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ)
    )
    assert child.returncode == -signal.SIGKILL, child.stderr
    whole = len(open_labels(out))
    assert whole == (2 if suffix == ".parquet" else 0)
    assert list(out.rglob("*.tmp"))
    if suffix == ".parquet":
        assert len(list((out / "shards").glob("part-*.npy"))) == 2  # one has no index
    assert cli.main(arguments) == 0
    check(open_labels(out), pack, TOKENS, 2**-11)
    assert not list(out.rglob("*.tmp"))
    assert len(list((out / "shards").iterdir())) == len(list((out / "index").iterdir())) == 3


def test_damaged_parts_are_done_again(
    pack: Path,
    vocabulary: Path,
    tmp_path: Path,
    cheap: None,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "labels"
    assert run(pack, vocabulary, out, "--chunk", "2") == 0
    before = contents(out)
    first, second, _ = sorted((out / "index").iterdir())
    first.write_bytes(b"no table")
    shard = out / "shards" / f"{second.stem}.npy"
    shard.write_bytes(shard.read_bytes()[:200])
    assert run(pack, vocabulary, out, "--chunk", "2") == 0
    errors = capsys.readouterr().err
    assert f"{first}: not usable" in errors and f"{second}: not usable" in errors
    assert contents(out) == before
    assert len(list((out / "index").glob("*.damaged"))) == 2


CHANGES = [
    (["--dtype", "f32"], "dtype = 'float16', this command says 'float32'"),
    (["--components", "total"], "number of components = 8, this command says 1"),
    (["--tracker", "none"], "config.tracker = 'reference', this command says 'none'"),
    (["--forecast", "perfect"], "config.forecast = 'constant_velocity', this .* 'perfect'"),
    (["--progress-reference", "goal"], "config.progress_reference = 'auto', this .* 'goal'"),
    (["--precision", "f64"], "precision = 'f32', this command says 'f64'"),
    (["--limit", "3"], "num_scenarios = 2, this command says 3"),
    (["other"], "vocabulary.hash = '"),
]


def test_other_settings_are_refused(
    pack: Path,
    vocabulary: Path,
    tmp_path: Path,
    cheap: None,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "labels"
    assert run(pack, vocabulary, out, "--limit", "2") == 0
    before = contents(out)
    np.save(tmp_path / "other.npy", fan(SIZE) + 0.001)
    for more, text in CHANGES:
        given = tmp_path / "other.npy" if more == ["other"] else vocabulary
        more = ["--limit", "2", *(m for m in more if m != "other")]
        assert run(pack, given, out, *more) == 2
        error = capsys.readouterr().err
        assert "label.json was made with" in error and "Use another --out" in error
        with pytest.raises(AssertionError, match=text):
            raise AssertionError(error)
    shutil.copy(vocabulary, tmp_path / "same.npy")  # the same trajectories in another file
    assert run(pack, tmp_path / "same.npy", out, "--limit", "2", "--chunk", "1") == 0
    assert contents(out) == before


def test_failed_scenes_have_no_labels_and_a_reason(
    bad_pack: Path,
    vocabulary: Path,
    tmp_path: Path,
    cheap: None,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "labels"
    assert run(bad_pack, vocabulary, out, "--chunk", "4") == 1
    assert "7 of 7 scenarios done, 3 failed" in capsys.readouterr().out
    found = open_labels(out)
    check(found, bad_pack, TOKENS[2:], 2**-11)
    assert set(found.failures) == {"broken", *TOKENS[:2]} and "3 failed" in repr(found)
    with pytest.raises(KeyError, match=r"'broken' has no labels: failed: .*damaged scenario file"):
        found["broken"]
    with pytest.raises(KeyError, match="'scene-00' has no labels: overflow: more path points"):
        found.batch([TOKENS[3], TOKENS[0]])
    with pytest.raises(KeyError, match="'gone' is not in"):
        found["gone"]
    index = polars.read_parquet(out / "index" / "part-*.parquet")
    status = dict(zip(index["token"], index["status"], strict=True))
    assert status["broken"] == "failed" and status[TOKENS[1]] == "overflow"
    assert index.filter(polars.col("status") != "ok")["shard"].null_count() == 3
    assert run(bad_pack, vocabulary, out) == 1  # still


def nan_score(scene: Any, part: Part, params: Any, static: Any) -> Scored:
    found = cheap_score(scene, part, params, static)
    total = jnp.where(scene.ego.vx[scene.num_history] > SLOW, jnp.nan, found.scores["total"])
    return found.replace(scores={**found.scores, "total": total})


def test_score_that_is_no_number_fails_the_scene(
    pack: Path, vocabulary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    fast = [token for token in TOKENS if speed_of(pack, token) > SLOW]
    assert 0 < len(fast) < COUNT
    monkeypatch.setattr(label_work, "score_part", nan_score)
    assert run(pack, vocabulary, tmp_path / "labels", "--components", "comfort") == 1
    found = open_labels(tmp_path / "labels")
    assert sorted(found.failures) == fast
    assert "not a finite number" in found.failures[fast[0]]


def test_shards_share_a_folder_or_not(pack: Path, vocabulary: Path, tmp_path: Path, cheap: None):
    assert run(pack, vocabulary, tmp_path / "whole") == 0
    for i in (1, 2):
        assert run(pack, vocabulary, tmp_path / "shared", "--shard", f"{i}/2") == 0
        assert run(pack, vocabulary, tmp_path / f"own{i}", "--shard", f"{i}/2") == 0
    own = [tmp_path / "own1", tmp_path / "own2"]
    parts = [len(open_labels(folder)) for folder in own]
    assert sum(parts) == COUNT and all(parts)
    whole = contents(tmp_path / "whole")
    assert contents(tmp_path / "shared") == whole
    together = open_labels(own)
    assert {token: row.tobytes() for token, row in rows_of(together).items()} == whole
    with pytest.raises(ValueError, match="occurs twice"):
        open_labels([own[0], own[0]])
    assert run(pack, vocabulary, tmp_path / "f32", "--dtype", "f32") == 0
    with pytest.raises(ValueError, match="dtype is float32, but float16"):
        open_labels([own[0], tmp_path / "f32"])


@pytest.fixture
def found(pack: Path, vocabulary: Path, tmp_path: Path, cheap: None) -> Labels:
    assert run(pack, vocabulary, tmp_path / "labels", "--chunk", "1") == 0
    return open_labels(tmp_path / "labels")


def test_rows_are_mapped_not_read(found: Labels):
    row = found[TOKENS[1]]
    assert isinstance(row, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        row[0, 0] = 1


def test_batch_gathers_rows_and_components(found: Labels):
    order = [TOKENS[3], TOKENS[0], TOKENS[3]]
    whole = found.batch(order)
    assert whole.shape == (3, SIZE, 8) and whole.dtype == np.float16
    for row, token in zip(whole, order, strict=True):
        np.testing.assert_array_equal(row, found[token])
    some = found.batch(order, ["comfort", "total"])
    np.testing.assert_array_equal(some, whole[..., [5, 0]])


def test_few_shards_are_open_at_a_time(found: Labels, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(labels, "_MAX_OPEN", 2)
    wanted = rows_of(open_labels(found._folder))
    opened: list[Path] = []
    original = np.load
    monkeypatch.setattr(np, "load", lambda p, **k: opened.append(p) or original(p, **k))
    for token in TOKENS * 2:
        np.testing.assert_array_equal(found[token], wanted[token])
        assert len(found._maps) <= 2
    assert len(opened) == 12
    found.batch([TOKENS[-1], TOKENS[-2]] * 5)
    assert len(opened) == 12  # the ones used last are still there


def test_labels_go_to_other_processes_and_threads(found: Labels):
    wanted = rows_of(found)
    sent = pickle.loads(pickle.dumps(found))
    assert len(pickle.dumps(found)) < 20_000  # no labels in it
    with ThreadPoolExecutor(4) as pool:
        batches = list(pool.map(lambda token: sent.batch([token])[0], TOKENS * 8))
    for token, row in zip(TOKENS * 8, batches, strict=True):
        np.testing.assert_array_equal(row, wanted[token])


def test_shard_of_another_form_is_named(found: Labels):
    place = found._places[TOKENS[0]]
    path = place.folder / "shards" / place.shard
    np.save(path, np.zeros((1, SIZE, 3), np.float16))
    with pytest.raises(ValueError, match=rf"{path.name}: float16 \(1, 5, 3\), .*label its scenes"):
        found[TOKENS[0]]


@pytest.mark.parametrize(
    "content, text",
    [
        (None, "was not written by spdm label"),
        ("{", "not readable"),
        ('{"command": "sweep"}', "does not describe labels"),
        ('{"command": "label", "format": 2}', "format is 2, this library reads 1"),
    ],
)
def test_folder_that_holds_no_labels(content: str | None, text: str, tmp_path: Path):
    if content is not None:
        (tmp_path / "label.json").write_text(content)
    with pytest.raises(ValueError, match=text):
        open_labels(tmp_path)


@pytest.mark.parametrize(
    "array, dt, text",
    [
        (fan(2)[:, :30], 0.1, "30 steps at 0.1 s"),
        (fan(2)[None], 0.1, r"\(1, 2, 41, 3\); a vocabulary is \[V, T, 3\]"),
        (fan(2)[..., :2], 0.1, "a vocabulary is"),
        (fan(2).astype(int), 0.1, "int64"),
        (fan(2) * np.nan, 0.1, "must be finite"),
        (fan(2), -1.0, "dt is -1.0"),
    ],
)
def test_file_that_is_no_vocabulary(array: np.ndarray, dt: float, text: str, tmp_path: Path):
    np.save(tmp_path / "v.npy", array)
    with pytest.raises(ValueError, match=rf"v\.npy: .*{text}"):
        read_vocabulary(tmp_path / "v.npy", dt)


def test_vocabulary_is_resampled(tmp_path: Path):
    np.savez(tmp_path / "v.npz", trajectories=fan(3)[:, 5::5].astype(np.float32))
    read = read_vocabulary(tmp_path / "v.npz", 0.5)  # 8 poses, the current one left out
    np.testing.assert_allclose(read, fan(3), atol=1e-5)


@pytest.fixture(scope="module")
def real(pack: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Labels of two scenes, scored for real, the vocabulary in two blocks of 16."""
    folder = tmp_path_factory.mktemp("real")
    np.save(folder / "v.npy", fan(24))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_work, "BLOCK_SIZES", (16,))
        for dtype in ("f32", "f16"):
            more = ("--dtype", dtype, "--limit", "2")
            assert run(pack, folder / "v.npy", folder / dtype, *more) == 0
    return {dtype: folder / dtype for dtype in ("f32", "f16")}


def test_labels_are_the_scores(real: dict[str, Path], pack: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scene_score, "BLOCK_SIZES", (16,))
    wanted = score(load(pack, limit=2), fan(24))
    found = open_labels(real["f32"])
    rows = found.batch(TOKENS[:2])
    for i, name in enumerate(COMPONENTS):
        np.testing.assert_array_equal(rows[..., i], getattr(wanted, name), err_msg=name)
    total = rows[..., found.column("total")]
    assert 0 < total.max() <= 1 and len(np.unique(total)) > 10
    half = open_labels(real["f16"]).batch(TOKENS[:2])
    np.testing.assert_array_equal(half, rows.astype(np.float16))


@pytest.mark.slow
def test_labels_without_a_tracker_are_the_scores(pack: Path, tmp_path: Path):
    np.save(tmp_path / "v.npy", fan(12))
    more = ("--dtype", "f32", "--limit", "2", "--tracker", "none", "--progress-reference", "goal")
    assert run(pack, tmp_path / "v.npy", tmp_path / "labels", *more) == 0
    config = PlannerConfig(progress_reference="goal")
    wanted = score(load(pack, limit=2), fan(12), tracker="none", config=config)
    rows = open_labels(tmp_path / "labels").batch(TOKENS[:2])
    for i, name in enumerate(COMPONENTS):
        np.testing.assert_array_equal(rows[..., i], getattr(wanted, name), err_msg=name)
