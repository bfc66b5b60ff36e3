"""Array tools."""

import jax
import jax.numpy as jnp
import numpy as np

from spdm_jax.arrays import when

TABLE = np.arange(7.0, dtype=np.float32)


def _moved(wanted, at, state):
    """Reads a table that all rows share."""
    change = lambda state: {"x": state["x"] + jnp.asarray(TABLE)[at], "n": state["n"] + 1}
    return when(wanted, change, state)


def test_when_is_a_choice():
    state = {"x": jnp.float32(1.5), "n": jnp.int32(4)}
    changed = _moved(jnp.bool_(True), 3, state)
    assert float(changed["x"]) == 4.5 and int(changed["n"]) == 5
    assert _moved(jnp.bool_(False), 3, state) == state


def test_when_under_vmap_changes_the_wanted_rows_and_shares_what_it_reads():
    wanted, at = jnp.array([True, False, True]), jnp.array([0, 3, 6])
    state = {"x": jnp.array([1.0, 2.0, 3.0]), "n": jnp.zeros(3, jnp.int32)}
    changed = jax.vmap(_moved)(wanted, at, state)
    np.testing.assert_array_equal(changed["x"], [1.0, 2.0, 9.0])
    np.testing.assert_array_equal(changed["n"], [1, 0, 1])
    # `lax.cond` would make a copy of the table for each row.
    assert "3,7]" not in str(jax.make_jaxpr(jax.vmap(_moved))(wanted, at, state))
