"""A process whose only program calls LAPACK: `python lapack_child.py CACHE`."""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax import programs


def lower_root(x: jax.Array) -> jax.Array:
    return jnp.linalg.cholesky(x)


if __name__ == "__main__":
    jax.config.update("jax_compilation_cache_dir", sys.argv[1])
    args = (jax.ShapeDtypeStruct((2, 2), np.float32),)
    make = lambda: jax.jit(lower_root)
    found, _ = programs.program("root", lower_root, make, args, jax.devices()[:1])
    print(found.stored, np.asarray(found.call(np.diag([4, 9]).astype(np.float32))).tolist())
