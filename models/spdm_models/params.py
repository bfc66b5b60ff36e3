"""Modules as pure functions: variables as nested dicts, bound to a module inside a traced call."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from flax import nnx
from jax.core import Tracer

# Nested dict of arrays; the keys along a path, joined by dots, are a torch state dict's name.
Params = dict[Any, Any]
ModuleT = TypeVar("ModuleT", bound=nnx.Module)
Build = Callable[[nnx.Rngs], ModuleT]


def init_params(build: Build[ModuleT], key: jax.Array) -> Params:
    """Returns the variables of a new module, drawn on the host.

    Args:
      build: makes the module.
      key: typed random key.

    Raises:
      ValueError: the key is traced.
    """
    if isinstance(key, Tracer):
        raise ValueError("the key of init is traced: call init outside jit and vmap")
    with jax.ensure_compile_time_eval():
        state = nnx.state(build(nnx.Rngs(params=key)))
    return jax.device_put(nnx.to_pure_dict(state))


def abstract_params(build: Build[ModuleT]) -> Params:
    """Returns the shapes and dtypes of a module's variables, without making any."""
    return nnx.to_pure_dict(nnx.split(_abstract(build))[1])


def bind(build: Build[ModuleT], params: Params) -> ModuleT:
    """Returns a module that holds the given variables; free inside a traced call.

    Args:
      build: makes a module of the same structure.
      params: its variables, by `init_params` or a checkpoint.
    """
    graph, state = nnx.split(_abstract(build))
    nnx.replace_by_pure_dict(state, params)
    return nnx.merge(graph, state)


def _abstract(build: Build[ModuleT]) -> ModuleT:
    return nnx.eval_shape(lambda: build(nnx.Rngs(params=0)))
