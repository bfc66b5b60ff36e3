"""Settings of the whole test run: precision, compile cache, hypothesis, reference data.

The library computes in the precision of the arrays it is given. With 64-bit types enabled, one
process tests both: a test passes float32 or float64 arrays, and a function that drops or raises
the precision on its way shows it in the dtype of its result.
"""

import importlib.metadata
import importlib.util
import os
from pathlib import Path

import hypothesis
import jax
import pytest

from spdm_jax.compile_cache import ENVIRONMENT_VARIABLE, enable_compile_cache

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"

# Commands that tests start in a process of their own use the same folder.
os.environ.setdefault(ENVIRONMENT_VARIABLE, str(ROOT / ".pytest_cache" / "compile"))
jax.config.update("jax_enable_x64", True)
CACHE = enable_compile_cache()

hypothesis.settings.register_profile(
    "fast", deadline=None, derandomize=True, max_examples=25, database=None
)
hypothesis.settings.register_profile("thorough", deadline=None, max_examples=1000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))


def pytest_report_header() -> list[str]:
    """Says which versions are under test, and from where."""
    names = ("spdm-jax", "jax", "jaxlib", "flax", "numpy")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    package = importlib.util.find_spec("spdm_jax")
    origin = package.origin if package and package.origin else "nowhere"
    return [f"versions: {versions}", f"package: {Path(origin).parent}", f"compile cache: {CACHE}"]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the checkout; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("reference data not at hand")
    return SHARED
