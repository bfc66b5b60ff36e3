"""Layers: torch's own as the reference, and what masks and dropout promise."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from spdm_models import layers
from spdm_models.layers import LSTM, Dropout, MultiheadAttention, TransformerEncoder
from spdm_models.params import abstract_params, bind, init_params
from spdm_models.state_dict import flatten, from_state_dict, to_state_dict, trainable

WIDTH, HEADS = 8, 2
KEY = jax.random.key(0)
QUIET = Dropout()


def samples(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def attention(rngs: nnx.Rngs) -> MultiheadAttention:
    return MultiheadAttention(WIDTH, HEADS, rngs)


def encoder(rngs: nnx.Rngs) -> TransformerEncoder:
    return TransformerEncoder(2, WIDTH, HEADS, 16, rngs)


def lstm(rngs: nnx.Rngs) -> LSTM:
    return LSTM(3, WIDTH, 2, rngs)


@jax.jit
def run_all(attention_params, encoder_params, lstm_params, x, valid):
    """One program for all layers: most of the time of these tests is compilation."""
    return (
        bind(attention, attention_params)(x[:, :3], x, x, QUIET, valid[:, None]),
        bind(encoder, encoder_params)(x, valid, QUIET),
        bind(lstm, lstm_params)(x[..., :3]),
    )


def test_layers_equal_torchs():
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    double = {"dtype": torch.float64, "batch_first": True}
    theirs = {
        attention: torch.nn.MultiheadAttention(WIDTH, HEADS, **double),
        encoder: torch.nn.TransformerEncoder(
            torch.nn.TransformerEncoderLayer(WIDTH, HEADS, 16, activation="gelu", **double),
            2,
            enable_nested_tensor=False,
        ),
        lstm: torch.nn.LSTM(3, WIDTH, 2, **double),
    }
    x, valid = samples(0, 2, 5, WIDTH), np.array([[1, 1, 0, 1, 0], [1, 0, 1, 1, 1]], bool)
    tensor = lambda v: torch.tensor(np.asarray(v))
    missing = tensor(~valid)
    reference = {
        attention: lambda m: m(tensor(x[:, :3]), tensor(x), tensor(x), key_padding_mask=missing)[0],
        encoder: lambda m: m(tensor(x), src_key_padding_mask=missing),
        lstm: lambda m: m(tensor(x[..., :3]))[0],
    }
    variables = {}
    for build, module in theirs.items():
        module.eval()
        state = {name: value.numpy() for name, value in module.state_dict().items()}
        variables[build] = from_state_dict(state, abstract_params(build), dtype=np.float64)
        assert to_state_dict(variables[build]).keys() == state.keys()
    ours = run_all(*variables.values(), x, jnp.asarray(valid))
    for (build, module), value in zip(theirs.items(), ours, strict=True):
        expected = reference[build](module).detach().numpy()
        np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("build", [attention, encoder, lstm])
def test_start_is_torchs(build):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    theirs = {
        attention: torch.nn.MultiheadAttention(WIDTH, HEADS),
        encoder: torch.nn.TransformerEncoderLayer(WIDTH, HEADS, 16),
        lstm: torch.nn.LSTM(3, WIDTH, 2),
    }[build]
    ours = flatten(init_params(build, KEY))
    prefix = "layers.1." if build is encoder else ""
    for name, value in theirs.state_dict().items():
        mine, value = np.asarray(ours[prefix + name]), value.numpy()
        assert mine.shape == value.shape and mine.dtype == np.float32
        # Even draws: a dozen and more of them come near the bound and never pass it.
        near = np.abs(value).max()
        assert np.abs(mine).max() <= 1.5 * near and np.abs(value).max() <= 1.5 * np.abs(mine).max()
        assert np.array_equal(mine.std() == 0, value.std() == 0)


@jax.jit
@partial(jax.value_and_grad, has_aux=True)
def attend(x, valid):
    module = bind(attention, init_params(attention, KEY))
    value = module(x[:1], x, x, QUIET, valid[None])
    return value.sum(), value


def test_masked_keys_do_not_count():
    x, valid = samples(1, 4, WIDTH), jnp.array([True, False, True, False])
    (_, masked), _ = attend(x, valid)
    # Whatever stands there, values and gradients stay.
    wild = jnp.where(valid[:, None], x, 1e30)
    (_, same), slope = attend(wild, valid)
    np.testing.assert_array_equal(same, masked)
    assert np.isfinite(slope).all() and not slope[1].any() and not slope[3].any()
    assert slope[0].any() and slope[2].any()
    (_, without), _ = attend(x[::2], valid[::2])
    np.testing.assert_allclose(masked, without, atol=1e-12)


def test_query_without_keys_is_finite():
    (total, _), slope = attend(samples(2, 4, WIDTH), jnp.zeros(4, bool))
    # Only the output bias is left, and it starts at zero.
    assert total == 0 and not slope.any()


def test_dropout_differs_by_place_and_repeats_by_key():
    x = jnp.ones(400)
    dropout = Dropout(KEY)
    first, second = dropout(x), dropout(x)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, Dropout(KEY)(x))
    np.testing.assert_array_equal(Dropout()(x), x)
    kept = np.asarray(first)
    np.testing.assert_allclose(np.unique(kept), [0, 1 / 0.9], rtol=1e-6)
    assert 0.02 < np.mean(kept == 0) < 0.2


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_follows_the_input(dtype):
    shapes = [abstract_params(build) for build in (attention, encoder, lstm)]
    variables = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape, dtype), shapes)
    x = jax.ShapeDtypeStruct((2, 5, WIDTH), dtype)
    results = jax.eval_shape(run_all, *variables, x, jax.ShapeDtypeStruct((2, 5), bool))
    assert [value.dtype for value in results] == [dtype] * 3


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="3 heads do not divide a width of 8"):
        init_params(partial(MultiheadAttention, WIDTH, 3), KEY)


def test_buffers_are_not_trainable():
    params = {"position_encode": {"pe": jnp.zeros(1)}, "0": {"weight": jnp.zeros(1)}}
    assert trainable(params) == {"position_encode": {"pe": False}, "0": {"weight": True}}
    assert layers.Buffer is not nnx.Param
