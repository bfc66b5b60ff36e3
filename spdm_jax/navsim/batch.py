"""Static shapes of NAVSIM's frames: padding to few sizes, stacking, the device.

Padding changes no score: masks are False, counts leave it out.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from spdm_jax.geometry import PADDED_PROGRESS
from spdm_jax.navsim.types import NavsimScene
from spdm_jax.padding import leaves_to_device

LEAST_ROOM = {
    "centerline": 256,
    "cells": 32768,
    "grid_masks": 256,
    "grid_words": 1,
    "grid_rows": 2048,
    "grid_edges": 8192,
    "objects": 16,
    "red": 4,
    "red_edges": 64,
    "past": 16,
}
"""Smallest size of each axis; larger ones are doubled until they hold the frame."""

# Axes of the leaves with a free length, from the first one on; all other leaves have fixed shapes.
_AXES: dict[str, tuple[str, ...]] = {
    "centerline.x": ("centerline",),
    "centerline.y": ("centerline",),
    "centerline.heading": ("centerline",),
    "centerline.progress": ("centerline",),
    "grid.cell_row": ("cells",),
    "grid.row_mask": ("grid_rows",),
    "grid.edge_start": ("grid_rows",),
    "grid.edge_count": ("grid_rows",),
    "grid.masks": ("grid_masks", "grid_words"),
    "grid.edges": ("grid_edges",),
    "grid.edge_polygon": ("grid_edges",),
    **{f"masks.{name}": ("grid_words",) for name in ("drivable", "on_route", "intersection")},
    "masks.lanes": ("grid_words",),
    **{f"objects.{name}": ("objects",) for name in ("x", "y", "heading", "vx", "vy", "valid")},
    **{f"objects.{name}": ("objects",) for name in ("length", "width", "type")},
    "red.edges": ("red_edges",),
    "red.start": ("red",),
    "red.count": ("red",),
    "red.red": ("red",),
    # At the front: the latest sample stays last.
    **{f"past.{name}": ("past",) for name in ("heading", "ax", "ay")},
}
_FILL = {"grid.edge_polygon": -1, "centerline.progress": PADDED_PROGRESS}
_REPEATS_LAST = ("centerline.x", "centerline.y", "centerline.heading")
_HOST_ONLY = ("origin", "start_time_us")


def room(axis: str, count: int) -> int:
    """Returns the size that an axis of `count` entries is padded to."""
    size = LEAST_ROOM[axis]
    while size < count:
        size *= 2
    return size


def _paths(scene: NavsimScene) -> tuple[list[tuple[str, Any]], Any]:
    leaves, tree = jax.tree_util.tree_flatten_with_path(scene)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), v) for path, v in leaves], tree


def _padded(path: str, leaf: np.ndarray, sizes: dict[str, int]) -> np.ndarray:
    widths = [(0, 0)] * leaf.ndim
    for axis, name in enumerate(_AXES.get(path, ())):
        spare = sizes[name] - leaf.shape[axis]
        widths[axis] = (spare, 0) if name == "past" else (0, spare)
    if not any(before or after for before, after in widths):
        return leaf
    if path in _REPEATS_LAST or path == "past.heading":
        return np.pad(leaf, widths, mode="edge") if leaf.size else np.pad(leaf, widths)
    return np.pad(leaf, widths, constant_values=_FILL.get(path, 0))


def pad(*scenes: NavsimScene) -> list[NavsimScene]:
    """Pads frames on the host to common sizes, the smallest ones that hold all of them."""
    flat = [_paths(scene) for scene in scenes]
    sizes = dict(LEAST_ROOM)
    for leaves, _ in flat:
        for path, leaf in leaves:
            for axis, name in enumerate(_AXES.get(path, ())):
                sizes[name] = max(sizes[name], room(name, np.shape(leaf)[axis]))
    return [
        jax.tree_util.tree_unflatten(
            tree, [_padded(path, np.asarray(leaf), sizes) for path, leaf in leaves]
        )
        for leaves, tree in flat
    ]


def stack(scenes: Sequence[NavsimScene]) -> NavsimScene:
    """Stacks frames on the host into one with a leading axis, for `jax.vmap`.

    Raises:
      ValueError: no frames, or their previous plans differ in number.
    """
    if not scenes:
        raise ValueError("no frames to stack; pass at least one")
    plans = sorted({np.shape(scene.previous.poses)[0] for scene in scenes})
    if len(plans) > 1:
        raise ValueError(f"frames hold {plans} previous plans; stack frames with equally many")
    return jax.tree.map(lambda *leaves: np.stack(leaves), *pad(*scenes))


def to_device(scene: NavsimScene, dtype: DTypeLike = jnp.float32) -> NavsimScene:
    """Moves a frame or a stack of them to the default device.

    Args:
      scene: NumPy leaves.
      dtype: floating type of all floating leaves.

    Returns:
      The same with JAX leaves; `origin` and `start_time_us` alone stay on the host: float32 cannot
      hold them.

    Raises:
      ValueError: `dtype` is not a floating type, or is 64 bit while JAX runs with 32.
    """
    host = {name: getattr(scene, name) for name in _HOST_ONLY}
    # In place of what stays: a jitted function would otherwise bring it to the device.
    light = scene.replace(**{name: np.zeros((), np.int32) for name in host})
    return leaves_to_device(light, dtype).replace(**host)
