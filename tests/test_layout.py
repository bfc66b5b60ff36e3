"""The shape of the code base: who may import whom, and what an import costs."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import spdm_experiments
import spdm_jax
import spdm_models

PACKAGES = {
    module.__name__: Path(str(module.__file__)).parent
    for module in (spdm_jax, spdm_models, spdm_experiments)
}
MAX_LINES = 550

# Each part of the library with the parts that it may import besides itself. A part that is not
# listed here fails the test below, so that a new one gets its place in the order.
BASE = {"types", "config", "schema", "arrays", "geometry", "padding"}
STAGES = BASE | {"map_rows", "proposals", "tracking", "agents", "scoring"}
ALLOWED = {
    "types": set[str](),
    "config": {"types"},
    "schema": {"types", "config"},
    "arrays": set[str](),
    "geometry": {"types", "config", "arrays"},
    "padding": {"types", "config", "schema", "geometry"},
    "map_rows": {"types", "arrays", "geometry"},
    "compile_cache": set[str](),
    "programs": set[str](),
    "batching": {"types", "schema", "padding", "programs"},
    "io": BASE,
    "synthetic": BASE | {"io"},
    "proposals": STAGES,
    "tracking": STAGES,
    "agents": STAGES,
    "scoring": STAGES,
    "decision": STAGES,
    "planner": STAGES | {"decision"},
    "trajectories": {"types", "config"},
    "results": {"types", "config", "planner"},
    "nested": STAGES | {"decision", "planner"},
    "scene_score": STAGES | {"decision", "planner", "batching", "results"},
    "vocabulary": {"types", "config", "trajectories"},
    "labels": set[str](),
    "viz": STAGES | {"io", "planner", "results"},
    "simulation": STAGES | {"planner"},
    "metrics": STAGES | {"planner", "simulation"},
    "interplan": {"io", *BASE, "scoring", "metrics", "simulation"},
    "navsim": STAGES | {"io", "decision", "planner", "trajectories", "batching", "results"},
}
# Faces of the library: they may use every part, and no part may use them.
FACES = {"__init__", "api", "functional", "testing", "torch_bridge", "soft"}
NO_JAX = ("io", "synthetic")
LAZY = ("matplotlib", "polars", "pyproj", "ray", "torch", "yaml", "tyro")


def modules() -> Iterator[tuple[str, str, Path]]:
    """Yields package, part (first name below the package) and path of every module."""
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            inner = path.relative_to(folder)
            yield package, inner.parts[0].removesuffix(".py"), path


def imported(path: Path, package: str) -> set[str]:
    """Returns the absolute dotted names of all imports of a file, those in functions included.

    `from a.b import c` counts as `a.b.c`: c may be a module.
    """
    names: set[str] = set()
    folder = PACKAGES[package]
    inside = (package, *path.relative_to(folder).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = [node.module] if node.module else []
            if node.level:
                origin = [*inside[: len(inside) - node.level + 1], *origin]
            names.update(".".join([*origin, alias.name]) for alias in node.names)
    return names


def roots(names: set[str]) -> set[str]:
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize(
    "source, expected",
    [
        ("import jax.numpy as jnp", {"jax.numpy"}),
        ("from spdm_jax.io import raw, pack", {"spdm_jax.io.raw", "spdm_jax.io.pack"}),
        ("from . import raw", {"spdm_jax.io.raw"}),
        ("from ..planner import step", {"spdm_jax.planner.step"}),
        ("def f():\n    import yaml", {"yaml"}),
    ],
)
def test_imports_are_found(source: str, expected: set[str], monkeypatch: pytest.MonkeyPatch):
    path = PACKAGES["spdm_jax"] / "io" / "sample.py"
    monkeypatch.setattr(Path, "read_text", lambda self, encoding: source)
    assert imported(path, "spdm_jax") == expected


def test_library_imports_go_one_way():
    wrong: list[str] = []
    for package, part, path in modules():
        if package != "spdm_jax" or part in FACES:
            continue
        assert part in ALLOWED, f"{path}: give spdm_jax.{part} a place in ALLOWED"
        for name in imported(path, package):
            parts = name.split(".")
            # A bare `from spdm_jax import __version__` reaches no part.
            if parts[0] != "spdm_jax" or len(parts) < 2 or parts[1].startswith("__"):
                continue
            if parts[1] != part and parts[1] not in ALLOWED[part]:
                wrong.append(f"{path}: spdm_jax.{part} imports {name}")
    assert not wrong, "\n".join(wrong)


def test_packages_import_in_one_direction():
    forbidden = {
        "spdm_jax": {"spdm_models", "spdm_experiments"},
        "spdm_models": {"spdm_experiments"},
        "spdm_experiments": set[str](),
    }
    wrong = [
        f"{path}: {package} imports {name}"
        for package, _, path in modules()
        for name in sorted(roots(imported(path, package)))
        if name in forbidden[package] | {"tests", "models", "experiments", "conftest"}
    ]
    assert not wrong, "\n".join(wrong)


def test_host_code_does_not_import_jax():
    wrong = [
        f"{path}: imports {name}"
        for package, part, path in modules()
        if package == "spdm_jax" and part in NO_JAX
        for name in sorted(roots(imported(path, package)) & {"jax", "jaxlib", "flax", "chex"})
    ]
    assert not wrong, "\n".join(wrong)


def test_modules_are_short():
    long = [
        f"{path}: {count} lines, split it"
        for _, _, path in modules()
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > MAX_LINES
    ]
    assert not long, "\n".join(long)


def test_every_folder_with_modules_is_a_package():
    missing = {
        path.parent for _, _, path in modules() if not (path.parent / "__init__.py").is_file()
    }
    assert not missing


def loaded_by(statement: str) -> set[str]:
    """Returns the top-level modules that a fresh interpreter holds after a statement."""
    code = f"{statement}\nimport sys\nprint(*sorted(sys.modules))"
    run = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-1000:]
    return roots(set(run.stdout.split()))


# Whatever JAX and Flax pull in themselves (Flax: yaml) is not the library's doing.
@pytest.mark.parametrize("submodules", [False, True], ids=["package", "all parts"])
def test_imports_stay_light(submodules: bool):
    names = ["spdm_jax"]
    if submodules:
        names += sorted(
            f"spdm_jax.{part}"
            for package, part, _ in modules()
            if package == "spdm_jax" and part in ALLOWED
        )
        assert "spdm_jax.config" in names
    loaded = loaded_by(f"import {', '.join(names)}") - loaded_by("import jax, flax.struct")
    assert "spdm_jax" in loaded
    assert not loaded & {*LAZY, "spdm_models", "spdm_experiments"}
