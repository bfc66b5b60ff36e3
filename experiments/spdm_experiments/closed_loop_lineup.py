"""Who drives on the closed-loop page, in which suites, and what was published of it."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from spdm_experiments.inventory import Inventory
from spdm_experiments.options import Simulate
from spdm_experiments.simulate_points import Point, make_points
from spdm_experiments.simulate_scenes import Scenes, find_scenes
from spdm_jax.synthetic.suites import SUITES as BUILT_IN

LINEUP: Final[tuple[Mapping[str, Any], ...]] = (
    {"planner": ("pdm-closed",), "num_proposals": (1, 3, 6, 15, 30, 60)},
    {"planner": ("spdm",), "num_proposals": (15, 20, 25, 30, 45, 60)},
    {"planner": ("spdm",), "num_proposals": (30, 60), "progress": ("centerline",)},
    {"planner": ("idm", "idm-mobil", "constant-velocity", "log-replay")},
)
"""Options of `spdm simulate`, one entry per product of planners and settings."""
BORROWING: Final[Mapping[str, Any]] = {
    "planner": ("spdm",),
    "num_proposals": (60,),
    "borrow_oncoming": ("yes",),
}
"""An extension of SPDM, driven where a lane may be blocked."""
WORDS: Final = {
    ("progress_reference", "centerline"): "progress along the centreline",
    ("borrow_oncoming", "yes"): "may borrow the oncoming lane",
}
"""What the name of a row says of a setting, for settings that are not the planner's own."""


@dataclass(frozen=True)
class Suite:
    """Scenarios and who drives in them.

    Attributes:
      name: of the run folder.
      scenes: built-in suite or folder of scenario files.
      traffic: kinds of traffic; an entry of the line-up may name others.
      lineup: as `LINEUP`.
    """

    name: str
    scenes: Path
    traffic: tuple[Any, ...]
    lineup: tuple[Mapping[str, Any], ...] = LINEUP

    def points(self) -> list[Point]:
        """Returns who drives, in the order of the tables, every point once."""
        points: dict[str, Point] = {}
        for choice in self.lineup:
            options = Simulate(**{"scenes": self.scenes, "traffic": self.traffic, **choice})
            for point in make_points(options):
                points.setdefault(repr(point.entry(0)), point)
        return list(points.values())

    def find(self, options: Simulate, limit: int | None) -> Scenes:
        """Returns the scenarios.

        Args:
          options: where to compute; those that select scenarios do not count.
          limit: scenarios of each type at most; all if None.

        Raises:
          ValueError: there is no such suite or folder, or `limit` is no count.
        """
        everything = replace(options, scenes=self.scenes, types=(), limit=None)
        if limit is None:
            return find_scenes(everything)
        types = BUILT_IN.get(str(self.scenes))
        if types is None:
            found = find_scenes(everything).inventory.entries
            types = sorted({entry.scenario_type for entry in found})
        # Type by type, so that scenarios which nobody asks for are not generated.
        each = [find_scenes(replace(everything, types=(kind,), limit=limit)) for kind in types]
        parts = [scenes.inventory for scenes in each]
        entries = [entry for part in parts for entry in part.entries]
        failures = [failure for part in parts for failure in part.failures]
        # That of a folder is one of all its files, whatever types are taken.
        facts = [*(part.digest for part in parts), *(entry.token for entry in entries)]
        digest = hashlib.sha256(repr(facts).encode()).hexdigest()
        extras = {token: one for scenes in each for token, one in scenes.extras.items()}
        return replace(each[0], inventory=Inventory(entries, failures, digest), extras=extras)


SUITES: Final = (
    Suite("common-14", Path("common-14"), ("replay", "reactive")),
    Suite("interactive-8", Path("interactive-8"), ("reactive",), (*LINEUP, BORROWING)),
)
"""What the page shows, in its order."""
PRECISION_LINEUP: Final[tuple[Mapping[str, Any], ...]] = (
    {"planner": ("pdm-closed",), "num_proposals": (15,)},
    {"planner": ("spdm",), "num_proposals": (60,)},
)
"""Who drives in float64 as well."""
COMPARED: Final = ("SPDM 60", "PDM-Closed 15")
"""Two rows whose difference the page shows type by type, first minus second."""


def name_of(point: Mapping[str, Any]) -> str:
    """Returns how tables call a point of run.json: "SPDM 60, progress along the centreline"."""
    count = point["num_proposals"]
    name = point["planner"] if count is None else f"{point['planner']} {count}"
    words = [text for (key, value), text in WORDS.items() if point.get(key) == value]
    return ", ".join([name, *words])


SOURCES: Final = {
    1: "A. Distelzweig et al., Perfect Prediction or Plenty of Proposals? What Matters Most in "
    "Planning for Autonomous Driving, 2025",
    2: "D. Dauner et al., Parting with Misconceptions about Learning-based Vehicle Motion "
    "Planning, CoRL 2023 (Val14)",
    3: "M. Hallgarten et al., Can Vehicle Motion Planning Generalize to Realistic Long-tail "
    "Scenarios?, IROS 2024 (interPlan; its Val14 column is taken for reactive, as its IDM row is)",
}
QUOTED_AS: Final = {
    ("common-14", "replay"): "Val14 NR",
    ("common-14", "reactive"): "Val14 R",
    ("interactive-8", "reactive"): "interPlan R",
}
"""Published benchmark beside which a suite and its traffic are shown."""
_PAPER: Final = {
    "PDM-Closed 15": ("92.84", "92.28", "41.88"),
    "PDM-Closed 60": ("91.21", "91.26", "42.96"),
    "SPDM 15": ("92.84", "92.28", "42.00"),
    "SPDM 20": ("92.73", "92.21", "49.72"),
    "SPDM 25": ("92.45", "92.04", "52.77"),
    "SPDM 30": ("92.11", "91.91", "59.07"),
    "SPDM 45": ("91.75", "91.85", "62.37"),
    "SPDM 60": ("91.49", "91.60", "63.66"),
}
PUBLISHED: Final[Mapping[str, Mapping[str, tuple[str, int]]]] = {
    **{
        name: {bench: (score, 1) for bench, score in zip(QUOTED_AS.values(), scores, strict=True)}
        for name, scores in _PAPER.items()
    },
    "IDM": {"Val14 NR": ("76", 2), "Val14 R": ("77", 2), "interPlan R": ("31", 3)},
    "IDM + MOBIL": {"Val14 R": ("75", 3), "interPlan R": ("31", 3)},
    "Log replay": {"Val14 NR": ("94", 2), "Val14 R": ("80", 2)},
}
"""Row -> benchmark -> score from 0 to 100, as published, and key of `SOURCES`."""
