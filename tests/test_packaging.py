"""What gets installed: version, licence, commands, extras, declared dependencies."""

import ast
import importlib
import importlib.metadata
import pkgutil
import re
import sys
import tomllib
from pathlib import Path

import pytest

import spdm_experiments
import spdm_jax
import spdm_models

PYPROJECT = tomllib.loads(
    (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text(encoding="utf-8")
)
PACKAGES = (spdm_jax, spdm_models, spdm_experiments)
DISTRIBUTION = importlib.metadata.distribution("spdm-jax")
# Import names that differ from the name of their distribution.
IMPORT_NAMES = {"pyyaml": "yaml"}


def folder(package) -> Path:
    return Path(package.__file__).parent


def declared(requirements: list[str]) -> set[str]:
    """Returns the import names of a list of requirements."""
    names = {re.split(r"[^A-Za-z0-9_-]", line, maxsplit=1)[0].lower() for line in requirements}
    return {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}


def imports_of(package) -> dict[str, set[Path]]:
    """Returns the top-level names that a package imports anywhere, with the files that do."""
    found: dict[str, set[Path]] = {}
    for path in folder(package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for name in names:
                found.setdefault(name.split(".")[0], set()).add(path)
    return found


def test_version_has_one_source():
    assert DISTRIBUTION.version == spdm_jax.__version__
    assert "version" in PYPROJECT["project"]["dynamic"]


def test_licence_is_shipped():
    assert DISTRIBUTION.metadata["License-Expression"] == "Apache-2.0"
    files = [file for file in DISTRIBUTION.files or () if file.name == "LICENSE"]
    assert files and "Apache License" in files[0].read_text()


def test_command_is_installed():
    scripts = [entry for entry in DISTRIBUTION.entry_points if entry.group == "console_scripts"]
    assert [entry.name for entry in scripts] == ["spdm"]
    assert callable(scripts[0].load())


def test_extras_are_published():
    extras = set(DISTRIBUTION.metadata.get_all("Provides-Extra") or ())
    assert extras == set(PYPROJECT["project"]["optional-dependencies"])


def test_installed_interpreter_is_supported():
    assert PYPROJECT["project"]["requires-python"] == ">=3.11"
    assert sys.version_info >= (3, 11)


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_package_is_typed(package):
    assert (folder(package) / "py.typed").is_file()


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_every_module_imports(package):
    names = [
        module.name for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    sources = {path for path in folder(package).rglob("*.py") if path.name != "__init__.py"}
    assert len(names) >= len(sources)
    for name in names:
        importlib.import_module(name)


def test_no_other_top_level_name_is_installed():
    # `models` or `tests` at the top level would collide with a user's own folders. An editable
    # install lists a path file in place of the packages.
    names = {
        file.parts[0]
        for file in DISTRIBUTION.files or ()
        if file.suffix == ".py" and len(file.parts) > 1 and file.parts[0] != ".."
    }
    assert names <= {package.__name__ for package in PACKAGES}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_imports_are_declared(package):
    project = PYPROJECT["project"]
    extras = project["optional-dependencies"]
    allowed = declared(
        [*project["dependencies"], *extras["data"], *extras["plot"], *extras["cluster"]]
    )
    allowed |= set(sys.stdlib_module_names) | {package.__name__ for package in PACKAGES}
    # Present wherever a notebook asks for an inline picture, a training step for scores, or a user
    # of NAVSIM for an export.
    allowed |= {"IPython", "torch", "navsim"}
    undeclared = {
        name: sorted(map(str, paths))
        for name, paths in imports_of(package).items()
        if name not in allowed
    }
    assert not undeclared


def test_base_dependencies_are_used():
    used = set().union(*(imports_of(package) for package in PACKAGES))
    wanted = declared(PYPROJECT["project"]["dependencies"])
    # jaxlib is pinned together with jax; optax and chex serve models and tests.
    assert wanted - used <= {"jaxlib", "optax", "chex"}
