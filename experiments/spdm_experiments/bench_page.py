"""Writes the benchmark's page: the table of marks, two curves, and what a run adds to them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MARKS_MS = {
    "PDM-Closed 15": ("one PDM-Closed step, N_p = 15, warm", 4.0),
    "SPDM 60": ("one SPDM step, N_p = 60, warm", 8.0),
    "track + score 4096": ("track + score 4,096 trajectories, one scene", 100.0),
    "64 scenes x 60": ("64 scenarios x N_p = 60, one batch", 200.0),
}
"""Workload -> words and the median to reach, ms."""
KEPT = "## What bounds the rows"
"""Written by people; a new run keeps it."""


def write_page(
    page: Path,
    about: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    apart: Mapping[str, Any],
) -> list[Path]:
    """Writes the page and its curves.

    Args:
      page: Markdown file.
      about: machine, versions, date.
      rows: of all children.
      apart: what `bench.processes` found.
    """
    kept = f"{KEPT}\n"
    if page.is_file() and KEPT in (before := page.read_text(encoding="utf-8")):
        kept = before[before.index(KEPT) :]
    cores = max(row["cores"] for row in rows)
    main = [row for row in rows if row["precision"] == "f32" and row["cores"] == cores]
    figure = page.with_name(f"{page.stem}_curves.svg")
    _curves(figure, main, about)
    parts = [
        "# Performance\n",
        f"`python -m spdm_experiments.bench --page {page}` measured this page on "
        f"{about['date'][:10]}: {about['machine']}, {cores} cores, no GPU, Python "
        f"{about['python']}, jax {about['jax']}, commit {about['commit']}. Built-in scenes "
        f"(synthetic), single-scene rows on `{about['scene']}`: {main[0]['objects']} objects, "
        f"{main[0]['polygons']} lanes with {main[0]['edges']} edges. Medians of 15 runs, warm, "
        "each next to a run of the yardstick (a 1,024 x 1,024 float32 product of NumPy on one "
        "thread), which empties the caches in between. The published reference is quoted: one "
        "thread of a machine of this class, where the yardstick took 29 ms.\n",
        _marks(main, apart),
        "## Other precision, other cores\n\nMedian / minimum, ms.\n",
        _columns(rows),
        "## Cost over proposals and over scenes\n",
        f"![Cost over trajectories and over scenes]({figure.name})\n",
        "The dashed lines run through the origin and the last point. Small sets pay what a scene "
        "costs by itself: looking up lanes, selecting and forecasting objects.\n",
        "## Stages of one step\n\nEach compiled alone and fed by the one before; median, ms.\n",
        _stages(main),
        kept,
    ]
    page.write_text("\n".join(parts).rstrip() + "\n", encoding="utf-8")
    return [page, figure]


def _table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _marks(rows: Sequence[Mapping[str, Any]], apart: Mapping[str, Any]) -> str:
    from spdm_experiments.bench import QUOTED

    body = []
    for row in rows:
        if row["workload"] in MARKS_MS:
            words, mark = MARKS_MS[row["workload"]]
            median = row["median_ms"]
            body.append(
                [
                    words,
                    QUOTED.get(row["workload"], ""),
                    f"{mark:g} ms",
                    f"{median:.1f} / {row['min_ms']:.1f} ms",
                    f"{median / row['yardstick_ms']:.2f}",
                    "yes" if median <= mark else "no",
                ]
            )
    if apart:
        sweep = apart["sweep"]
        ratio = sweep["end_to_end_ms"] / sweep["kernel_ms"]
        body.append(
            [
                f"`sweep` of {sweep['scenes']} packed scenarios, end to end over kernels",
                "",
                "1.5",
                f"{sweep['end_to_end_ms']:.1f} / {sweep['kernel_ms']:.1f} ms = {ratio:.2f}",
                "",
                "yes" if ratio <= 1.5 else "no",
            ]
        )
        for name, call in apart["first_call"].items():
            for kind, mark in (("cold", 6.0), ("warm", 0.5)):
                seconds = call[f"{kind}_s"]
                reached = "yes" if seconds <= mark else "no"
                words = f"first call, {name}, {kind} cache"
                body.append([words, "", f"{mark:g} s", f"{seconds:.2f} s", "", reached])
        for name, size in apart["memory"].items():
            reached = "yes" if size["peak_mb"] < 1000 else "no"
            words = f"peak memory, {name}" + ("" if "traj" in name else " x 60")
            text = f"{size['peak_mb']:.0f} MB ({size['before_mb']:.0f} before)"
            body.append([words, "", "1,000 MB", text, "", reached])
    head = ["workload", "published reference", "to reach", "median / min", "yardsticks", "reached"]
    return _table(head, body)


def _columns(rows: Sequence[Mapping[str, Any]]) -> str:
    cases = list(dict.fromkeys((row["precision"], row["cores"]) for row in rows))
    found = {(row["workload"], row["precision"], row["cores"]): row for row in rows}
    body = []
    for workload, (words, _) in MARKS_MS.items():
        cells = [found.get((workload, *case)) for case in cases]
        if any(cells):
            texts = [f"{c['median_ms']:.1f} / {c['min_ms']:.1f}" if c else "" for c in cells]
            body.append([words, *texts])
    head = ["workload", *(f"{precision}, {cores} core(s)" for precision, cores in cases)]
    return _table(head, body)


def _stages(rows: Sequence[Mapping[str, Any]]) -> str:
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
    return _table(["stage", *planners], body)


def _curves(path: Path, rows: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fans = [(r["num_proposals"], r) for r in rows if r["workload"].startswith("track + score ")]
    batches = [(r["scenes"], r) for r in rows if "scenes" in r]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for axis, points, label in (
        (axes[0], fans, "trajectories, one scene"),
        (axes[1], batches, "scenes with 60 proposals each"),
    ):
        x = [0, *(n for n, _ in points)]
        median = [row["median_ms"] for _, row in points]
        axis.plot([0, x[-1]], [0, median[-1]], "--", color="0.6", lw=1)
        axis.plot(x[1:], median, "o-", color="#0072b2", label="median")
        axis.plot(x[1:], [r["min_ms"] for _, r in points], ".:", color="#d55e00", label="minimum")
        axis.set(xlabel=label, ylabel="ms", xlim=(0, None), ylim=(0, None))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False)
    where = f"built-in scenes, {about['machine']}, {about['date'][:10]}, commit {about['commit']}"
    figure.supxlabel(where, fontsize=7, color="0.4")
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
