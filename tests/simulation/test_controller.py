"""The two-stage controller against its definition, written out as matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spdm_jax.config import DT, TrackerParams, VehicleParams
from spdm_jax.simulation.controller import (
    Plan,
    perfect_step,
    plan_profiles,
    pose_at,
    track_command,
    track_step,
)
from spdm_jax.types import EgoState

VEHICLE, PARAMS = VehicleParams(), TrackerParams()
_step = jax.jit(track_step)
_command = jax.jit(track_command)
_profiles = jax.jit(plan_profiles, static_argnums=1)


def ego_at(dtype=jnp.float64, **values: float) -> EgoState:
    fields = {name: jnp.asarray(0.0, dtype) for name in EgoState.__dataclass_fields__}
    return EgoState(**fields | {k: jnp.asarray(v, dtype) for k, v in values.items()})


def curve(speed: float, accel: float, yaw_rate: float, dtype=jnp.float64, spacing=DT) -> Plan:
    """A plan of 8 s that starts at the origin along +x at time 3."""
    time = np.arange(0, 8 + 1e-9, spacing)
    fine = np.arange(0, 8 + 1e-9, 1e-3)
    velocity = np.maximum(speed + accel * fine, 0)
    heading = yaw_rate * fine
    x = np.cumsum(velocity * np.cos(heading)) * 1e-3
    y = np.cumsum(velocity * np.sin(heading)) * 1e-3
    pick = np.round(time * 1000).astype(int)
    values = (x[pick] - x[0], y[pick], heading[pick], time)
    names = ("x", "y", "heading", "time")
    arrays = {k: jnp.asarray(v, dtype) for k, v in zip(names, values, strict=True)}
    return Plan(**arrays, start=jnp.asarray(3.0, dtype))


def written_out(ego: EgoState, plan: Plan, offset: float) -> tuple[float, float]:
    """Commands by the matrices of the definition."""
    speed, curvature = (np.asarray(v) for v in _profiles(plan, 80))
    grid = np.arange(80) * DT
    target = np.interp(offset + 1.0, grid, speed)
    kappa = np.interp(offset + DT * np.arange(10), grid, curvature)
    v = float(ego.vx)
    if target <= 0.2 and v <= 0.2:
        return -0.5 * (v - target), 0.0
    accel = -(1.0 * 10.0 * (v - target)) / (1.0 * 10.0 * 1.0 + 1.0)
    x, y, heading = (float(p) for p in pose_at(plan, jnp.asarray(offset)))
    dx, dy = float(ego.x) - x, float(ego.y) - y
    wrap = lambda a: (a + np.pi) % (2 * np.pi) - np.pi
    state = np.array(
        [
            -dx * np.sin(heading) + dy * np.cos(heading),
            wrap(float(ego.heading) - heading),
            float(ego.steering),
        ]
    )
    a, b, g = np.eye(3), np.zeros(3), np.zeros(3)
    for k in range(10):
        vk = v + k * DT * accel
        step = np.eye(3)
        step[0, 1] = vk * DT
        step[1, 2] = vk * DT / 3.089
        a, b, g = step @ a, step @ b + [0, 0, DT], step @ g + [0, -vk * kappa[k] * DT, 0]
    error = a @ state + g
    error[1:] = wrap(error[1:])
    q = np.array([1.0, 10.0, 0.0])
    return accel, -float(b * q @ error) / float(b * q @ b + 1.0)


@pytest.mark.parametrize(
    "plan_args, ego_values, offset",
    [
        ((8.0, 0.5, 0.1), {"vx": 8.0}, 0.0),
        ((8.0, -1.0, -0.2), {"vx": 9.0, "y": 0.4, "heading": 0.1, "steering": -0.05}, 0.1),
        ((3.0, 0.0, 0.0), {"vx": 0.0, "x": -0.3}, 0.0),
        ((0.0, 0.0, 0.0), {"vx": 0.15, "steering": 0.2, "heading": 0.3}, 0.0),
        ((12.0, 0.0, 0.3), {"vx": 12.0, "heading": 3.1}, 7.5),
    ],
)
def test_commands_follow_the_definition(plan_args, ego_values, offset: float):
    plan, ego = curve(*plan_args), ego_at(**ego_values)
    command = _command(ego, plan, plan.start + offset, VEHICLE, PARAMS)
    np.testing.assert_allclose(command, written_out(ego, plan, offset), atol=1e-9)


def test_bicycle_lags_and_uses_the_old_state():
    plan, ego = curve(8.0, 1.0, 0.1), ego_at(vx=8.0, ax=0.3, steering=0.1, heading=0.2)
    accel, rate = (float(v) for v in _command(ego, plan, plan.start, VEHICLE, PARAMS))
    dt = 0.0985
    after = _step(ego, plan, plan.start, plan.start + dt, VEHICLE, PARAMS)
    lagged = 0.3 + dt / (dt + 0.2) * (accel - 0.3)
    steering = 0.1 + dt / (dt + 0.05) * dt * rate
    yaw_rate = (8.0 + lagged * dt) * np.tan(steering) / 3.089
    expected = {
        "x": 8.0 * np.cos(0.2) * dt,
        "y": 8.0 * np.sin(0.2) * dt,
        "heading": 0.2 + 8.0 * np.tan(0.1) / 3.089 * dt,
        "vx": 8.0 + lagged * dt,
        "vy": 0.0,
        "ax": lagged,
        "ay": 0.0,
        "steering": steering,
        "steering_rate": (steering - 0.1) / dt,
        "yaw_rate": yaw_rate,
        "yaw_acceleration": yaw_rate / dt,
    }
    for name, value in expected.items():
        assert float(getattr(after, name)) == pytest.approx(value, abs=1e-9), name


def test_coarse_plans_are_resampled():
    fine, coarse = curve(8.0, 0.0, 0.0), curve(8.0, 0.0, 0.0, spacing=0.5)
    ego = ego_at(vx=8.0, y=0.2)
    commands = [_command(ego, p, p.start, VEHICLE, PARAMS) for p in (fine, coarse)]
    np.testing.assert_allclose(*commands, atol=1e-9)


def test_heading_is_interpolated_across_the_turn():
    plan = curve(5.0, 0.0, 0.0)
    heading = plan.heading.at[:].set(jnp.where(plan.time < 0.05, 3.1, -3.1))
    _, _, at = pose_at(plan.replace(heading=heading), jnp.asarray(0.05))
    assert abs(abs(float(at)) - np.pi) < 1e-9


def test_perfect_tracking_lands_on_the_plan():
    plan, ego = curve(8.0, 0.5, 0.1), ego_at(vx=8.0)
    after = perfect_step(ego, plan, plan.start, plan.start + DT)
    for name in ("x", "y", "heading"):
        assert float(getattr(after, name)) == pytest.approx(float(getattr(plan, name)[1]))
    assert float(after.vx) == pytest.approx(8.0, abs=0.1)
    assert float(after.yaw_rate) == pytest.approx(0.1, abs=1e-6)


def test_single_precision_stays_single():
    given = [(8.0, 0.5, 0.1, t) for t in (jnp.float32, jnp.float64)]
    single, double = (
        _step(ego_at(p[3], vx=7.0, y=0.1), plan, plan.start, plan.start + DT, VEHICLE, PARAMS)
        for p, plan in ((p, curve(*p)) for p in given)
    )
    for name in EgoState.__dataclass_fields__:
        value = getattr(single, name)
        assert value.dtype == jnp.float32, name
        assert float(value) == pytest.approx(float(getattr(double, name)), abs=2e-4), name
