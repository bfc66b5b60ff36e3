"""`python -m tests.parity --golden DIR [--precision f64|f32]`: compare everything found in DIR."""

import argparse
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from spdm_jax.compile_cache import enable_compile_cache  # noqa: E402

from .closed_loop import replay  # noqa: E402
from .loader import check_loader_golden  # noqa: E402
from .logged_run import check_logged_run  # noqa: E402
from .metrics import check_metrics  # noqa: E402
from .models_dipp import check_dipp  # noqa: E402
from .models_dtpp import check_dtpp  # noqa: E402
from .models_gameformer import check_gameformer  # noqa: E402
from .models_gameformer_planner import check_gameformer_planner  # noqa: E402
from .navsim import check_navsim  # noqa: E402
from .pdm import check_scene, check_scorer  # noqa: E402
from .planning import check_planning  # noqa: E402
from .report import Report  # noqa: E402
from .simulation import check_simulation  # noqa: E402
from .units import check_unit  # noqa: E402


def main(argv: list[str] | None = None) -> int:
    """Runs every check that DIR holds files for; 1 beyond the tolerances."""
    parser = argparse.ArgumentParser(prog="python -m tests.parity", description=__doc__)
    parser.add_argument("--golden", type=Path, required=True, help="folder, searched recursively")
    parser.add_argument("--precision", choices=("f64", "f32"), default="f64")
    parser.add_argument("--only", default="", help="only files whose name contains this")
    parser.add_argument("--brief", action="store_true", help="only rows that are not clean")
    args = parser.parse_args(argv)
    if not args.golden.is_dir():
        parser.error(f"{args.golden} is no folder")
    enable_compile_cache()
    report = run(args.golden, args.precision, args.only)
    rows = report.rows
    if args.brief:
        report.rows = [r for r in rows if r.mismatches or not r.ok]
    print(report.table())
    report.rows = rows
    failures = report.failures()
    for line in failures:
        print(f"FAILED {line}")
    print(f"{len(rows)} arrays compared in {args.precision}, {len(failures)} failed")
    return 1 if failures or not rows else 0


def run(folder: Path, precision: str, only: str = "") -> Report:
    """Checks every known file under a folder; unknown ones are listed and ignored."""
    report = Report(precision)
    dtype = jnp.float64 if precision == "f64" else jnp.float32
    by_prefix = {
        "scene_": check_scene,
        "scorer_": check_scorer,
        "closedloop_": replay,
        "pdm_": check_planning,
        "golden_closed_loop_reactive": check_logged_run,
    }
    # Told apart by the description beside the arrays; several may look at one file.
    by_description = (check_metrics, check_simulation)
    by_model = (check_dipp, check_dtpp, check_gameformer, check_gameformer_planner)
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or only not in path.name:
            continue
        started, before = time.time(), len(report.rows)
        if path.name in ("expected.json", "golden_devkit.json"):
            # The readers work in float64 whatever the device does.
            if precision == "f64":
                for row in check_loader_golden(path.parent):
                    report.add_loader_row(f"{path.parent.name}/{path.name}", row)
        elif path.suffix != ".npz":
            continue
        elif check_navsim(path, report, dtype):
            pass
        elif path.name.startswith("unit_") and check_unit(path, report, dtype):
            pass
        elif any([check(path, report, dtype) for check in by_description]):
            pass
        elif any(check(path, report, dtype) for check in by_model):
            pass
        else:
            check = next((c for p, c in by_prefix.items() if path.name.startswith(p)), None)
            if check is None:
                print(f"ignored {path}", file=sys.stderr)
                continue
            check(path, report, dtype)
        rows = report.rows[before:]
        clean = all(row.ok and not row.mismatches for row in rows)
        print(
            f"{path.parent.name}/{path.name}: {'clean' if clean else 'NOT CLEAN'}, {len(rows)} "
            f"arrays, {time.time() - started:.1f} s",
            file=sys.stderr,
        )
    return report


if __name__ == "__main__":
    sys.exit(main())
