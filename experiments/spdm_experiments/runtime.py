"""Sets JAX up for one run of a verb: device, precision, compile cache."""

from pathlib import Path

from spdm_experiments.options import OnDevice


def configure_jax(options: OnDevice, *, x64: bool) -> Path | None:
    """Applies the options to JAX; to be called before anything is computed.

    Args:
      options: device and compile cache.
      x64: whether 64-bit types are available (arrays keep the type they are given).

    Returns:
      The folder of the compile cache, or None where there is none.

    Raises:
      ValueError: there is no device of the wanted kind.
    """
    import jax

    from spdm_jax.compile_cache import enable_compile_cache

    jax.config.update("jax_enable_x64", x64)
    if options.device != "auto":
        jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[options.device])
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # JAX asserts where a platform has no plugin
        raise ValueError(
            f"--device {options.device}: JAX finds no such device. Use --device cpu, or install "
            'the GPU build: pip install "jax[cuda12]"'
        ) from error
    return enable_compile_cache() if options.compile_cache else None
