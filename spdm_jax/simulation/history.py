"""What a closed-loop run leaves behind: the input of every metric."""

from flax import struct

from spdm_jax.types import Array, EgoState


class Snapshot(struct.PyTreeNode, kw_only=True):
    """Objects as the run saw them, `[A]` at one step or `[T, A]` over a run.

    Attributes:
      x, y: box centre, local frame, m.
      heading: box heading, rad.
      vx, vy: velocity along the map's x and y axes, m/s (0 for static objects).
      length, width: box size, m.
      type: int32, `ObjectType`.
      valid: bool, present at that step.
    """

    x: Array
    y: Array
    heading: Array
    vx: Array
    vy: Array
    length: Array
    width: Array
    type: Array
    valid: Array


class History(struct.PyTreeNode, kw_only=True):
    """One run, sample by sample.

    A scenario of N iterations leaves at most N - 1 samples: the last clock tick ends the run
    before the ego is moved again.

    Attributes:
      time: `[T]` s relative to iteration 0.
      ego: `[T]` rear-axle states.
      valid: `[T]` bool, False after the run's end; those samples repeat the last real one.
      objects: `Snapshot` `[T, A]`; its `type` is `[A]`.
      lights: `[T, L]` int8 `LightStatus` of each lane connector.
    """

    time: Array
    ego: EgoState
    valid: Array
    objects: Snapshot
    lights: Array
