"""The reader against recorded answers of nuPlan's own classes."""

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("pyproj", reason="nuPlan files need pyproj")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch):
    """The comparison that the parity report uses."""
    monkeypatch.syspath_prepend(str(ROOT))
    from tests.parity.loader import check_loader_golden

    return check_loader_golden


@pytest.mark.parametrize("place", ["golden/nuplan_loader", "data/nuplan_format"])
def test_everything_recorded_agrees(shared: Path, check, place: str):
    if not (shared / place).is_dir():
        pytest.skip("reference data not at hand")
    rows = check(shared / place)
    assert len(rows) > 90
    assert [row for row in rows if not row.ok] == []


def test_comparison_sees_differences(shared: Path, check, tmp_path: Path):
    source = shared / "golden" / "nuplan_loader"
    if not source.is_dir():
        pytest.skip("reference data not at hand")
    for name in ("maps", "nuplan-v1.1"):
        (tmp_path / name).symlink_to(source / name)
    shutil.copy(source / "expected_map.json", tmp_path)
    golden = json.loads((source / "expected.json").read_text())
    golden["queries"][0]["result"].pop()
    record = golden["scenarios"][0]
    record["route_roadblock_ids"].reverse()
    record["tracks_iter0"][0]["pose"][0] += 1e-3
    record["ego_future_8s_16"][2][5] += 1e-3
    record["a_new_field"] = 1
    (tmp_path / "expected.json").write_text(json.dumps(golden))
    failed = {row.name.partition("/")[2] for row in check(tmp_path) if not row.ok}
    assert failed == {
        *("queries", "route_roadblock_ids", "tracks pose", "ego_future_8s_16"),
        "a_new_field (no check)",
    }


def test_folder_without_recordings(check, tmp_path: Path):
    with pytest.raises(ValueError, match="no expected"):
        check(tmp_path)
