"""Writes the benchmark's page: the table of marks, all rows, two curves, and what people add."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spdm_experiments.markdown import kept_part, markdown_table

Row = Mapping[str, Any]

NAVSIM_MS = {"navsim1": 250.0, "navsim2": 300.0}
"""4,096 trajectories in one frame."""
MARKS_MS = {
    "PDM-Closed 15": ("one PDM-Closed step, N_p = 15, scene on the device", 4.0),
    "PDM-Closed 15, host to host": ("the same, from host to host", 4.0),
    "SPDM 60": ("one SPDM step, N_p = 60, scene on the device", 8.0),
    "SPDM 60, host to host": ("the same, from host to host", 8.0),
    "track + score 4096": ("track + score 4,096 trajectories, one scene", 100.0),
    "navsim1 4096": (
        "NAVSIM v1: track + score 4,096 trajectories, one frame",
        NAVSIM_MS["navsim1"],
    ),
    "navsim2 4096": ("NAVSIM v2: the same, each with a previous plan", NAVSIM_MS["navsim2"]),
    "64 scenes x 60": ("64 scenarios x N_p = 60, one batch, from host to host", 200.0),
    "64 scenes x 60, placed": ("the same, scenes on the device", 200.0),
    "64 mixed scenes x 60": ("64 built-in scenes x N_p = 60, from host to host", 200.0),
}
"""Workload -> words and the median to reach, ms."""
QUOTED = {
    "PDM-Closed 15": "200-265 ms",
    "PDM-Closed 15, host to host": "200-265 ms",
    "PDM-Closed 30": "220-275 ms",
    "PDM-Closed 60": "400-440 ms",
    "SPDM 60": "400-440 ms (PDM-Closed grid of 60)",
    "SPDM 60, host to host": "400-440 ms (PDM-Closed grid of 60)",
    "track + score 4096": "24 s",
    "64 scenes x 60": "27 s",
    "64 scenes x 60, placed": "27 s",
}
"""The published reference on one thread of this class of machine, when the yardstick took 29 ms:
quoted, not measured here."""
TORCH_YARDSTICKS = {
    "GameFormer": {1: 12, 32: 174},
    "DTPP": {1: 9, 32: 316},
    "DIPP": {1: 13, 32: 258},
}
"""Network -> scenes -> a forward pass of the public torch code on two cores, in yardsticks: quoted,
not measured here."""
DRIVE_S, DRIVE_COLD_S, DRIVE_WARM_S = 1.0, 30.0, 2.0
"""What a drive is to take per scenario, and the first one with an empty and a filled cache."""
SWEEP_RATIO, COLD_S, WARM_S, PEAK_MB, FLAT = 1.5, 6.0, 0.5, 1000.0, 1.1
"""What the rows of processes of their own are to reach; the last is peak memory over that of the
fewest scenes."""
SHORT = {
    "no_at_fault_collision": "NC",
    "drivable_area": "DAC",
    "driving_direction": "DDC",
    "time_to_collision": "TTC",
    "comfort": "C",
}
KEPT = "## What bounds the rows"
"""Written by people; a new run keeps it."""


def write_page(page: Path, about: Row, rows: Sequence[Row], apart: Mapping[str, Row]) -> list[Path]:
    """Writes the page and its curves.

    Args:
      page: Markdown file.
      about: command, commit, date, suite, seed, machine, device, cores, versions.
      rows: of all children.
      apart: what was measured in processes of its own, by unit.

    Returns:
      The files written.
    """
    kept = kept_part(page, KEPT)
    main = main_rows(rows)
    figure = page.with_name(f"{page.stem}_curves.svg")
    page.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(figure, main, about)
    parts = [
        "# Performance\n",
        _about(about, main),
        _marks(main, apart),
        _drives(main, apart),
        _navsim(main),
        _learned(main),
        "## Other precision, other cores\n\nMedian / minimum, ms.\n",
        _columns(rows),
        "## Cost over trajectories and over scenes\n",
        f"![Cost over trajectories and over scenes]({figure.name})\n",
        "The dashed lines run through the origin and the last point. Small sets pay what a scene "
        "costs by itself: looking up lanes, selecting and forecasting objects.\n",
        "## Stages of one step\n\nEach compiled alone and fed by the one before; median, ms.\n",
        _stages(main),
        "## All rows\n\n"
        "CPU is the processor time of all threads of the process in one call. A first call "
        "compiles, or loads what an earlier run has compiled. The last columns are shares of "
        "trajectories that fail a metric (at-fault collision, drivable area, driving direction, "
        "time to collision, comfort).\n",
        _every(rows),
        kept,
    ]
    page.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
    return [page, figure]


def main_rows(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows in float32 on all cores."""
    cores = max(row["cores"] for row in rows)
    return [row for row in rows if row["precision"] == "f32" and row["cores"] == cores]


def _about(about: Row, rows: Sequence[Row]) -> str:
    versions = ", ".join(f"{name} {text}" for name, text in about["versions"].items())
    scene = next(row for row in rows if "objects" in row)
    facts = [
        ("command", f"`{about['command']}`"),
        ("commit", about["commit"]),
        ("date", about["date"]),
        ("machine", f"{about['machine']}, {about['cores']} core(s) in use"),
        ("device", about["device"]),
        ("suite", about["suite"]),
        ("seed", about["seed"]),
        ("versions", f"Python {about['python']}, {versions}"),
    ]
    text = (
        f"The scene is a generated crossing with {scene['objects']} objects, all within reach of "
        f"the ego, and {scene['polygons']} drivable polygons with {scene['edges']} edges; a batch "
        "has as many of different seeds. Before a row is timed its results are compared: scenes "
        "alone and in a batch, blocks of trajectories and smaller sets bit by bit, differently "
        f"compiled programs up to rounding. Medians of {scene['repetitions']} runs, warm, in "
        "float32 unless said otherwise, each next to a run of the yardstick (a 1,024 x 1,024 "
        "float32 product of NumPy on one thread), which empties the caches in between. The "
        "published reference is quoted: one thread of a machine of this class, where the "
        "yardstick took 29 ms.\n"
    )
    return (
        markdown_table(["", "this page"], [[name, str(value)] for name, value in facts])
        + "\n"
        + text
    )


def _marks(rows: Sequence[Row], apart: Mapping[str, Row]) -> str:
    found = {row["workload"]: row for row in rows}
    body = []
    for workload, (words, mark) in MARKS_MS.items():
        if row := found.get(workload):
            body.append(
                [
                    words,
                    QUOTED.get(workload, ""),
                    f"{mark:g} ms",
                    f"{row['median_ms']:.1f} / {row['min_ms']:.1f} ms",
                    f"{row['yardstick_ms']:.1f} ms",
                    f"{row['median_ms'] / row['yardstick_ms']:.2f}",
                    _reached(row["median_ms"], mark),
                ]
            )
    for words, mark, text, reached in _apart(apart):
        body.append([words, "", mark, text, "", "", reached])
    head = ["workload", "published reference", "to reach", "median / min"]
    return markdown_table([*head, "yardstick", "yardsticks", "reached"], body)


def _reached(value: float, mark: float) -> str:
    return "yes" if value <= mark else "no"


def _apart(apart: Mapping[str, Row]) -> list[tuple[str, str, str, str]]:
    """Words, mark, text and whether it is reached, of every row of a process of its own."""
    lines = []
    if sweep := apart.get("sweep"):
        text = (
            f"{sweep['ratio']:.2f} ({sweep['end_to_end_ms']:.1f} over {sweep['kernel_ms']:.1f} ms "
            f"per scenario; yardstick {sweep['yardstick_ms']:.1f} ms)"
        )
        words = f"`spdm sweep` of {sweep['scenes']} packed scenarios, end to end over kernels"
        lines.append((words, f"{SWEEP_RATIO:g}", text, _reached(sweep["ratio"], SWEEP_RATIO)))
    for unit, call in apart.items():
        if unit.startswith("first call"):
            for kind, mark in (("cold", COLD_S), ("warm", WARM_S)):
                seconds = call[f"{kind}_s"]
                words = f"{unit}, {kind} cache"
                lines.append((words, f"{mark:g} s", f"{seconds:.2f} s", _reached(seconds, mark)))
    memory = {unit: row for unit, row in apart.items() if unit.startswith("memory")}
    for unit, row in memory.items():
        words = f"peak {unit}" + (" x 60, `spdm sweep`" if unit.endswith("scenes") else "")
        text = f"{row['peak_mb']:.0f} MB ({row['before_mb']:.0f} MB before)"
        lines.append((words, f"{PEAK_MB:,.0f} MB", text, _reached(row["peak_mb"], PEAK_MB)))
    over_scenes = [row["peak_mb"] for unit, row in memory.items() if unit.endswith("scenes")]
    if len(over_scenes) > 1:
        ratio = over_scenes[-1] / over_scenes[0]
        words = "peak memory of the most scenes over that of the fewest"
        lines.append((words, f"{FLAT:g}", f"{ratio:.2f}", _reached(ratio, FLAT)))
    return lines


def _drives(rows: Sequence[Row], apart: Mapping[str, Row]) -> str:
    """The section on whole drives; empty where none were measured."""
    body = []
    found = [row for row in rows if "drives" in row]
    for row in found:
        median, least = (row[name] / (1e3 * row["drives"]) for name in ("median_ms", "min_ms"))
        sticks = f"{row['median_ms'] / row['drives'] / row['yardstick_ms']:.0f}"
        text = f"{median:.2f} / {least:.2f} s"
        mark, reached = f"{DRIVE_S:g} s", _reached(median, DRIVE_S)
        body.append([row["traffic"], str(row["drives"]), mark, text, sticks, reached])
    for unit, call in apart.items():
        if unit.startswith("first drive"):
            for kind, mark in (("cold", DRIVE_COLD_S), ("warm", DRIVE_WARM_S)):
                seconds, traffic = call[f"{kind}_s"], unit.partition(", ")[2]
                cells = [f"{mark:g} s", f"{seconds:.2f} s", "", _reached(seconds, mark)]
                body.append([traffic, f"first drive, {kind} cache", *cells])
    if not body:
        return ""
    text = ""
    if found:
        text = (
            f"SPDM {found[0]['num_proposals']} through {found[0]['seconds']:g} s of traffic, as "
            f"`spdm simulate` does, metrics included; scenarios of {found[0]['suite']}, as many of "
            f"each of {found[0]['kinds']} types in every batch. Seconds per scenario, median / "
            f"minimum of {found[0]['repetitions']} runs. The first scenario of a batch has the row "
            "that it has alone, bit by bit.\n\n"
        )
    head = ["traffic", "scenarios", "to reach", "per scenario", "yardsticks", "reached"]
    return f"## Closed loop\n\n{text}{markdown_table(head, body)}"


def _navsim(rows: Sequence[Row]) -> str:
    """The section on NAVSIM's scores; empty where none were measured."""
    body = []
    for row in (row for row in rows if "frames" in row):
        profile = row["workload"].partition(" ")[0]
        scored = row["frames"] * row["num_proposals"]
        mark = NAVSIM_MS[profile] if row["frames"] == 1 and row["num_proposals"] == 4096 else None
        body.append(
            [
                profile,
                "recorded" if row.get("recorded") else "generated",
                f"{row['objects']} / {row['polygons']}",
                f"{row['frames']} x {row['num_proposals']:,}",
                f"{mark:g} ms" if mark else "",
                f"{row['median_ms']:.1f} / {row['min_ms']:.1f} ms",
                f"{row['median_ms'] / row['yardstick_ms']:.2f}",
                f"{1e3 * scored / row['median_ms']:,.0f}",
                _reached(row["median_ms"], mark) if mark else "",
            ]
        )
    if not body:
        return ""
    head = ["profile", "frames", "objects / polygons", "frames x trajectories", "to reach"]
    head += ["median / min", "yardsticks", "trajectories per second", "reached"]
    return (
        "## NAVSIM\n\nFrom poses on the host to scores on the host: interpolation, tracking, the "
        "replay of the log and all terms. One frame: each trajectory with a previous plan of its "
        "own in v2.\n\n" + markdown_table(head, body)
    )


def _learned(rows: Sequence[Row]) -> str:
    """The section on learned planners; empty where none were measured."""
    passes = [row for row in rows if "network" in row]
    if not passes:
        return ""
    body = []
    for row in passes:
        sticks = f"{row['median_ms'] / row['yardstick_ms']:.1f}"
        quoted = TORCH_YARDSTICKS[row["network"]].get(row["batch"], "")
        ms = f"{row['median_ms']:.1f} / {row['min_ms']:.1f}"
        body.append([row["network"], str(row["batch"]), ms, sticks, str(quoted)])
    head = ["forward pass", "scenes", "median / min, ms", "yardsticks", "torch, yardsticks"]
    text = (
        "Networks of the published sizes with random weights, batches on a processor in blocks of "
        "a few scenes (`jax.lax.map` with a `batch_size`); what the public torch code takes on two "
        "cores is quoted.\n\n" + markdown_table(head, body)
    )
    if drives := [row for row in rows if row["workload"].endswith(", one drive")]:
        lines = [
            [row["planner"], f"{1e-3 * row['median_ms']:.1f}", f"{row['first_call_s']:.0f}"]
            for row in drives
        ]
        text += (
            f"\nOne scenario of {drives[0]['suite']}, {drives[0]['seconds']:g} s, non-reactive, as "
            "`spdm simulate` drives it, own predictions.\n\n"
            + markdown_table(["planner", "drive, s", "first one, compilation included, s"], lines)
        )
    return f"## Learned planners\n\n{text}"


def _columns(rows: Sequence[Row]) -> str:
    cases = list(dict.fromkeys((row["precision"], row["cores"]) for row in rows))
    found = {(row["workload"], row["precision"], row["cores"]): row for row in rows}
    body = []
    for workload, (words, _) in MARKS_MS.items():
        cells = [found.get((workload, *case)) for case in cases]
        if any(cells):
            texts = [f"{c['median_ms']:.1f} / {c['min_ms']:.1f}" if c else "" for c in cells]
            body.append([words, *texts])
    head = ["workload", *(f"{precision}, {cores} core(s)" for precision, cores in cases)]
    return markdown_table(head, body)


def _stages(rows: Sequence[Row]) -> str:
    times: dict[str, dict[str, float]] = {}
    for row in rows:
        planner, colon, stage = row["workload"].partition(": ")
        if colon:
            times.setdefault(stage, {})[planner] = row["median_ms"]
    planners = list(dict.fromkeys(name for stage in times.values() for name in stage))
    body = [
        [stage, *(f"{each[p]:.2f}" if p in each else "" for p in planners)]
        for stage, each in times.items()
    ]
    return markdown_table(["stage", *planners], body)


def _every(rows: Sequence[Row]) -> str:
    body = []
    for row in rows:
        if ": " not in row["workload"]:
            failing = row.get("failing", {})
            body.append(
                [
                    row["workload"],
                    f"{row['precision']}, {row['cores']}",
                    f"{row['median_ms']:.2f}",
                    f"{row['min_ms']:.2f}",
                    f"{row['cpu_ms']:.1f}",
                    f"{row['yardstick_ms']:.1f}",
                    f"{row['first_call_s']:.2f}",
                    *(f"{failing[name]:.3f}" if name in failing else "" for name in SHORT),
                ]
            )
    head = ["workload", "type, cores", "median ms", "min ms", "CPU ms", "yardstick ms", "first s"]
    return markdown_table([*head, *SHORT.values()], body)


def table(rows: Sequence[Row]) -> str:
    """Returns all rows as plain text."""
    head = (
        f"{'workload':<36} {'dtype':>5} {'cores':>5} {'median ms':>10} {'min ms':>9} {'CPU ms':>9} "
        f"{'first s':>8} {'yardstick':>9} {'ratio':>7}  reference (quoted)"
    )
    lines = [head]
    for row in rows:
        first = f"{row['first_call_s']:.1f}" if "first_call_s" in row else ""
        lines.append(
            f"{row['workload']:<36} {row['precision']:>5} {row['cores']:>5} "
            f"{row['median_ms']:>10.2f} {row['min_ms']:>9.2f} {row['cpu_ms']:>9.1f} {first:>8} "
            f"{row['yardstick_ms']:>9.1f} {row['median_ms'] / row['yardstick_ms']:>7.2f}  "
            f"{QUOTED.get(row['workload'], '')}"
        )
    return "\n".join(lines)


def draw_curves(path: Path, rows: Sequence[Row], about: Row) -> None:
    """Draws the cost over trajectories and over scenes.

    Args:
      path: SVG file to write; equal rows give equal bytes.
      rows: those with a `curve` are drawn, at their `x`.
      about: see `write_page`.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    each = {row["num_proposals"] for row in rows if row.get("curve") == "scenes"}
    numbers = ", ".join(map(str, sorted(each)))
    labels = {
        "trajectories": "trajectories, one scene",
        "scenes": f"scenes with {numbers} proposals each",
    }
    with plt.rc_context({"svg.hashsalt": "bench", "font.size": 9}):
        figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
        for axis, (curve, label) in zip(axes, labels.items(), strict=True):
            points = sorted(
                (row["x"], row["median_ms"], row["min_ms"])
                for row in rows
                if row.get("curve") == curve
            )
            if points:
                x, median, least = zip(*points, strict=True)
                axis.plot([0, x[-1]], [0, median[-1]], "--", color="0.6", lw=1)
                axis.plot(x, median, "o-", color="#0072b2", ms=4, label="median")
                axis.plot(x, least, "s:", color="#d55e00", ms=3, label="minimum")
                axis.set_title(f"{median[-1] / x[-1]:.3g} ms each at {x[-1]:,}", fontsize=9)
                axis.set_xticks([n for n in x if n >= x[-1] / 8])
            axis.set(xlabel=label, ylabel="ms", xlim=(0, None), ylim=(0, None))
            axis.grid(color="0.9", lw=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].legend(frameon=False)
        where = f"{about['suite']}, {about['device']}, {about['machine']}, {about['cores']} core(s)"
        when = f"{about['date'][:10]}, commit {about['commit']}"
        figure.supxlabel(f"{where}, {when}", fontsize=7, color="0.4")
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)
