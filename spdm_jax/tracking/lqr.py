"""Batch LQR tracker and kinematic bicycle: proposals become drivable trajectories."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.config import DT, Scalar, Tracker, TrackerParams, VehicleParams
from spdm_jax.geometry import principal, wrap
from spdm_jax.tracking.profiles import curvature_profile, speed_profile
from spdm_jax.types import EgoState

HORIZON = 10
"""Steps of the lateral controller's look-ahead."""
_CARRIED = ("x", "y", "heading", "vx", "ax", "steering", "steering_rate")

# Sums over the look-ahead steps i = 0..9 at speeds v + b i (b = dt x acceleration). T_i = dt (v +
# b i) is the distance of step i; see `lateral_command`.
_I = np.arange(HORIZON)
_PREFIX = np.concatenate([[0.0], np.cumsum(_I)[:-1]])  # sum of i over the earlier steps
_PREFIX_SQ = np.concatenate([[0.0], np.cumsum(_I**2)[:-1]])
_SUFFIX = _I.sum() - np.cumsum(_I)  # sum of n over the later steps
_SUM_I = float(_I.sum())
_SUM_II = float((_I**2).sum())
# sum_n T_n sum_{i<n} T_i = dt^2 (v^2, v b, b^2) . _PAIRS
_PAIRS = (float(_I.sum()), float((_PREFIX + _I * _I).sum()), float((_I * _PREFIX).sum()))
# sum_n T_n sum_{i<n} i T_i = dt^2 (v^2, v b, b^2) . _PAIRS_I
_PAIRS_I = (
    float(_PREFIX.sum()),
    float((_PREFIX_SQ + _I * _PREFIX).sum()),
    float((_I * _PREFIX_SQ).sum()),
)
LOOKAHEAD_MOMENTS = np.stack(
    [
        np.ones(HORIZON),
        _I.astype(float),
        (HORIZON - 1.0) - _I,
        _SUFFIX + _I * ((HORIZON - 1.0) - _I),
        _I * _SUFFIX,
    ]
)
"""`[5, 10]`: sums over the look-ahead's curvatures that `lateral_command` reads."""


@lru_cache(maxsize=8)
def _window_matrix(num_steps: int) -> np.ndarray:
    """Returns `[5, N, N]`: moments of the curvatures seen from each step.

    The window of step k holds curvatures k ... r - 1 with r = min(k + 10, N - 1); what is missing
    to ten is filled with curvature r.
    """
    matrix = np.zeros((len(LOOKAHEAD_MOMENTS), num_steps, num_steps))
    for k in range(num_steps):
        last = min(k + HORIZON, num_steps - 1)
        for i in range(HORIZON):
            matrix[:, k, min(k + i, last)] += LOOKAHEAD_MOMENTS[:, i]
    return matrix


def _polynomial(coefficients, v, b):
    c0, c1, c2 = coefficients
    return c0 * v * v + c1 * v * b + c2 * b * b


def lateral_command(e, psi, delta, v, accel, moments, params: TrackerParams):
    """Steering rate from the ten-step look-ahead, in closed form.

    Euler steps e += T_i psi, psi += T_i (delta / L - kappa_i), delta += dt u (old values on the
    right) are summed: with speeds v + b i every product is a polynomial in (v, b).
    """
    b = DT * accel
    wheel_base = params.wheel_base
    distance = DT * (HORIZON * v + _SUM_I * b)
    distance_i = DT * (_SUM_I * v + _SUM_II * b)
    pairs = DT**2 * _polynomial(_PAIRS, v, b)
    pairs_i = DT**2 * _polynomial(_PAIRS_I, v, b)
    m0, m1, m2, m3, m4 = moments
    turn = DT * (v * m0 + b * m1)
    offset = DT**2 * (v * v * m2 + v * b * m3 + b * b * m4)
    z_e = e + psi * distance + delta / wheel_base * pairs - offset
    z_psi = wrap(psi + delta / wheel_base * distance - turn)
    z_delta = wrap(delta)
    b_e = DT * pairs_i / wheel_base
    b_psi = DT * distance_i / wheel_base
    b_delta = DT * HORIZON
    qe, qp, qd = params.q_lateral_error, params.q_heading_error, params.q_steering
    gain = qe * b_e * b_e + qp * b_psi * b_psi + qd * b_delta * b_delta + params.r_lateral
    return -(qe * b_e * z_e + qp * b_psi * z_psi + qd * b_delta * z_delta) / gain


def _command(state, reference, params: TrackerParams, axis: int = 0):
    """Acceleration and steering-rate command, `[P]` each; `axis` is that of the moments."""
    v, v_ref = state.vx, reference["speed"]
    error = v - v_ref
    horizon = DT * HORIZON
    q, r = params.q_longitudinal, params.r_longitudinal
    accel = -(horizon * q) * error / (horizon * q * horizon + r)
    dx, dy = state.x - reference["x"], state.y - reference["y"]
    e = -dx * reference["sin"] + dy * reference["cos"]
    psi = wrap(state.heading - reference["heading"])
    moments = [jnp.take(reference["moments"], i, axis=axis) for i in range(len(LOOKAHEAD_MOMENTS))]
    rate = lateral_command(e, psi, state.steering, v, accel, moments, params)
    stopping = (v_ref <= params.stopping_speed) & (v <= params.stopping_speed)
    accel = jnp.where(stopping, -params.stopping_gain * error, accel)
    return accel, jnp.where(stopping, 0, rate)


def bicycle_step(
    state: EgoState,
    accel: jax.Array,
    steering_rate: jax.Array,
    vehicle: VehicleParams,
    params: TrackerParams,
    dt: Scalar = DT,
) -> EgoState:
    """Advances ego states by `dt` seconds under commanded acceleration and steering rate.

    Source: tuplan_garage `BatchKinematicBicycleModel` (first-order lags, explicit Euler with the
    old speed, heading and steering angle).
    """
    accel = state.ax + dt / (dt + params.accel_time_constant) * (accel - state.ax)
    lag = dt / (dt + params.steering_time_constant)
    ideal = state.steering + dt * steering_rate
    rate = (state.steering + lag * (ideal - state.steering) - state.steering) / dt
    turn = dt * state.vx * jnp.tan(state.steering) / vehicle.wheel_base
    speed = state.vx + dt * accel
    steering = jnp.clip(state.steering + dt * rate, -params.max_steering, params.max_steering)
    yaw_rate = speed * jnp.tan(steering) / vehicle.wheel_base
    zero = jnp.zeros_like(speed)
    return EgoState(
        x=state.x + dt * state.vx * jnp.cos(state.heading),
        y=state.y + dt * state.vx * jnp.sin(state.heading),
        heading=principal(state.heading + turn),
        vx=speed,
        vy=zero,
        ax=accel,
        ay=zero,
        steering=steering,
        steering_rate=rate,
        yaw_rate=yaw_rate,
        yaw_acceleration=(yaw_rate - state.yaw_rate) / dt,
    )


def reference_profiles(
    x: jax.Array, y: jax.Array, heading: jax.Array, tracker: Tracker
) -> tuple[jax.Array, jax.Array]:
    """Fitted speeds and curvatures, `[P, N]` each, of reference poses `[P, N + 1]`."""
    speed = speed_profile(x, y, heading, tracker)
    return speed, curvature_profile(heading, speed)


def reference_at(
    x: jax.Array, y: jax.Array, heading: jax.Array, tracker: Tracker
) -> dict[str, jax.Array]:
    """What the controller reads at each step, time first: `[T - 1, P]`, moments `[T - 1, 5, P]`."""
    speed, curvature = reference_profiles(x, y, heading, tracker)
    steps = speed.shape[-1]
    windows = np.swapaxes(_window_matrix(steps), 0, 1).reshape(-1, steps).astype(x.dtype)
    moments = jnp.matmul(windows, curvature.T, precision=jax.lax.Precision.HIGHEST)
    moments = moments.reshape(steps, len(LOOKAHEAD_MOMENTS), -1)
    x, y, heading, speed = x.T[:-1], y.T[:-1], heading.T[:-1], speed.T
    target = np.minimum(np.arange(steps) + HORIZON, steps - 1)
    return {
        "x": x,
        "y": y,
        "heading": heading,
        "cos": jnp.cos(heading),
        "sin": jnp.sin(heading),
        "speed": speed[target],
        "moments": moments,
    }


def track(
    x: jax.Array,
    y: jax.Array,
    heading: jax.Array,
    initial: EgoState,
    vehicle: VehicleParams,
    params: TrackerParams,
    tracker: Tracker = "reference",
) -> tuple[EgoState, jax.Array]:
    """Tracks reference poses with the LQR and propagates the bicycle.

    Args:
      x: `[P, T]` reference poses of the rear axle, local frame, 0.1 s apart.
      y: `[P, T]`.
      heading: `[P, T]`.
      initial: ego state, scalars or `[P]`.
      vehicle: ego dimensions.
      params: gains, lags and limits.
      tracker: which difference matrix the speed fit uses.

    Returns:
      `EgoState` `[P, T]` with the initial state at index 0, and commands `[P, T - 1, 2]`
      (acceleration m/s^2, steering rate rad/s).

    Source: tuplan_garage `PDMSimulator`, `BatchLQRTracker`, `BatchKinematicBicycleModel`.
    """
    num = x.shape[0]
    reference = reference_at(x, y, heading, tracker)
    start = jax.tree.map(lambda v: jnp.broadcast_to(jnp.asarray(v, x.dtype), (num,)), initial)

    # What follows from other fields is left to the end: a scan pays for every array it carries.
    def step(state, ref):
        now = start.replace(**state)
        accel, rate = _command(now, ref, params)
        following = bicycle_step(now, accel, rate, vehicle, params)
        after = {name: getattr(following, name) for name in _CARRIED}
        return after, after

    _, after = jax.lax.scan(step, {name: getattr(start, name) for name in _CARRIED}, reference)
    yaw_rate = after["vx"] * jnp.tan(after["steering"]) / vehicle.wheel_base
    before = jnp.concatenate([start.yaw_rate[None], yaw_rate[:-1]])
    zero = jnp.zeros_like(yaw_rate)
    after = EgoState(
        **after,
        vy=zero,
        ay=zero,
        yaw_rate=yaw_rate,
        yaw_acceleration=(yaw_rate - before) / DT,
    )
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)
    commands = _command(jax.tree.map(lambda v: v[:-1], states), reference, params, axis=1)
    return jax.tree.map(jnp.transpose, states), jnp.stack([c.T for c in commands], -1)
