"""Persistent compile cache: compiled programs survive the process that compiled them.

A planner takes seconds to compile and milliseconds to load from the cache. Cached entries are
executable code built for one kind of processor, so the folder is private to the user and named
after processor and JAX version. Nothing here runs on import; a program calls
`enable_compile_cache` once, before it compiles.
"""

import hashlib
import os
import platform
import stat
import warnings
from pathlib import Path

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

ENVIRONMENT_VARIABLE = "SPDM_COMPILE_CACHE"
"""Environment variable: `off`, or the folder to use instead of the default one."""


def enable_compile_cache(folder: Path | None = None) -> Path | None:
    """Keeps compiled programs in a private folder of this user and kind of machine.

    The folder holds one sub-folder per processor type and JAX version; both are created with mode
    0700. Where they cannot be used (not writable, owned by someone else, open to others) JAX works
    without a cache and one warning says why. A cache folder already set through JAX's own settings
    stays in force unless a folder is named here or in the environment.

    Args:
      folder: where to keep the cache; by default the folder named by `SPDM_COMPILE_CACHE`, else
        `$XDG_CACHE_HOME/spdm-jax`, else `~/.cache/spdm-jax`. `SPDM_COMPILE_CACHE=off` wins over
        everything.

    Returns:
      The folder in use, or None where there is no cache.
    """
    setting = os.environ.get(ENVIRONMENT_VARIABLE, "").strip()
    if setting.lower() == "off":
        return None
    current: str | None = jax.config.values["jax_compilation_cache_dir"]
    if folder is None and not setting and current:
        return Path(current)
    try:
        base = folder or (Path(setting).expanduser() if setting else default_folder())
        target = base.absolute() / machine_fingerprint()
        _make_private(target)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder known
        warnings.warn(
            f"No compile cache, programs compile anew in every process: {error}. Set "
            f"{ENVIRONMENT_VARIABLE} to a private folder, or to 'off' to silence this.",
            stacklevel=2,
        )
        return None
    if current and current != str(target):
        reset_cache()  # JAX opens the folder once and would keep writing to the former one
    jax.config.update("jax_compilation_cache_dir", str(target))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return target


def default_folder() -> Path:
    """Returns the folder used when none is named; creates nothing.

    Raises:
      RuntimeError: the user has no home folder.
    """
    # The XDG specification says that a relative value is to be ignored.
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = configured if configured.is_absolute() else Path.home() / ".cache"
    return base / "spdm-jax"


def machine_fingerprint() -> str:
    """Returns a name for what a cached program depends on: processor, JAX and package version."""
    # A new version of this package starts anew: see `spdm_jax.programs`, which cannot store what
    # JAX finds in its cache.
    from spdm_jax import __version__

    features = [platform.machine(), platform.processor(), __version__]
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        wanted = ("model name", "flags", "Features", "CPU implementer", "CPU part")
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        features += sorted({line for line in lines if line.startswith(wanted)})
    digest = hashlib.sha256("\n".join(features).encode()).hexdigest()[:12]
    return f"{platform.machine() or 'unknown'}-{digest}-jax{jax.__version__}"


def _make_private(target: Path) -> None:
    """Creates `target` and its parent with mode 0700 where missing, and checks both.

    Raises:
      PermissionError: a folder belongs to someone else, lets others write, or is not writable.
      OSError: a folder cannot be created.
    """
    base = target.parent
    base.parent.mkdir(parents=True, exist_ok=True)
    for path in (base, target):
        path.mkdir(mode=0o700, exist_ok=True)
        info = path.stat()
        if hasattr(os, "getuid") and info.st_uid != os.getuid():
            raise PermissionError(f"{path} belongs to user {info.st_uid}, not to you")
        if path == base and info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise PermissionError(f"others may write to {path} (mode {info.st_mode & 0o777:o})")
    if stat.S_IMODE(target.stat().st_mode) != 0o700:
        target.chmod(0o700)
    if not os.access(target, os.W_OK | os.X_OK):
        raise PermissionError(f"{target} is not writable")
