"""Layers as torch defines them: Flax NNX modules whose attribute paths and shapes are torch's.

The path of a variable in a module is its name in a torch state dict (`point_net.0.weight`), and
weights keep torch's shapes (`[out, in]`), so that checkpoints map one to one. Modules hold
variables only and are used through `params.bind`. All calls work on arrays with any leading axes.

Masks are True where a key is real, the opposite of torch's `key_padding_mask`.
"""

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.core import Tracer

LAYER_NORM_EPSILON = 1e-5
DROPOUT_RATE = 0.1


def gelu(x: jax.Array) -> jax.Array:
    """Returns x Phi(x), exactly: torch's default, not Flax's, and by erf as torch does."""
    return 0.5 * x * (1 + jax.lax.erf(x * math.sqrt(0.5)))


class Buffer(nnx.Variable):
    """An array that a checkpoint stores beside the weights and training leaves alone."""


class Dropout:
    """Zeroes elements at random, with one key for a whole forward pass.

    Each call folds the number of calls before it into the key. Inside `jax.vmap` every element
    would draw the same mask unless the key is mapped too: the layers here take leading axes.
    """

    def __init__(self, key: jax.Array | None = None, rate: float = DROPOUT_RATE):
        """Keeps the key; without one, calls return their input (inference).

        Args:
          key: typed random key, or None.
          rate: share of elements that become zero; the others grow by 1 / (1 - rate).
        """
        self._key, self._rate, self._calls = key, rate, 0

    def __call__(self, x: jax.Array) -> jax.Array:
        """Returns an array like `x`."""
        if self._key is None or self._rate == 0:
            return x
        key = jax.random.fold_in(self._key, self._calls)
        self._calls += 1
        keep = jax.random.bernoulli(key, 1 - self._rate, x.shape)
        return jnp.where(keep, x / (1 - self._rate), 0)


class Drop:
    """The place of a dropout layer in a `Sequential`."""


def uniform_param(rngs: nnx.Rngs, shape: tuple[int, ...], bound: float) -> nnx.Param:
    """Returns a variable drawn evenly from [-bound, bound]."""
    return _drawn(rngs, shape, lambda generator: generator.uniform(-bound, bound, shape))


def constant_param(value: float, *shape: int) -> nnx.Param:
    """Returns a variable of equal values."""
    return nnx.Param(np.full(shape, value, np.float32))


def _drawn(
    rngs: nnx.Rngs, shape: tuple[int, ...], draw: Callable[[np.random.Generator], np.ndarray]
) -> nnx.Param:
    """Draws on the host: hundreds of draws in one program take XLA half a minute to compile."""
    key = rngs.params()
    if isinstance(key, Tracer):
        return nnx.Param(np.zeros(shape, np.float32))  # only the shape is asked for
    generator = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    return nnx.Param(draw(generator).astype(np.float32))


class Linear(nnx.Module):
    """`y = x W^T + b`, with torch's start: uniform in ±1/sqrt(inputs)."""

    def __init__(self, inputs: int, outputs: int, rngs: nnx.Rngs):
        bound = 1 / math.sqrt(inputs)
        self.weight = uniform_param(rngs, (outputs, inputs), bound)
        self.bias = uniform_param(rngs, (outputs,), bound)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[..., inputs]` to `[..., outputs]`."""
        return x @ self.weight[...].T + self.bias[...]


class LayerNorm(nnx.Module):
    """Normalises the last axis; the variance is taken in a second pass, as torch does."""

    def __init__(self, width: int):
        self.weight = constant_param(1, width)
        self.bias = constant_param(0, width)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[..., width]` to the same shape."""
        centred = x - jnp.mean(x, axis=-1, keepdims=True)
        variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
        scaled = centred * jax.lax.rsqrt(variance + LAYER_NORM_EPSILON)
        return scaled * self.weight[...] + self.bias[...]


class Embedding(nnx.Module):
    """One row per index, drawn from N(0, 1)."""

    def __init__(self, rows: int, width: int, rngs: nnx.Rngs):
        self.weight = _drawn(
            rngs, (rows, width), lambda generator: generator.normal(size=(rows, width))
        )

    def __call__(self, index: jax.Array) -> jax.Array:
        """Maps integers `[...]` to `[..., width]`."""
        return self.weight[...][index]


class Sequential(nnx.Module):
    """Layers one after another, each under its index, as torch names them.

    Functions (activations) and `Drop` hold no variables but count.
    """

    def __init__(self, *layers: nnx.Module | Callable[[jax.Array], jax.Array] | Drop):
        self._count = len(layers)
        for i, layer in enumerate(layers):
            setattr(self, str(i), layer)

    def __call__(self, x: jax.Array, dropout: Dropout | None = None) -> jax.Array:
        """Applies all layers; without `dropout` those places pass values through."""
        for i in range(self._count):
            layer = getattr(self, str(i))
            if not isinstance(layer, Drop):
                x = layer(x)
            elif dropout is not None:
                x = dropout(x)
        return x


class MultiheadAttention(nnx.Module):
    """Scaled dot-product attention; query, key and value share one packed projection.

    Source: torch `MultiheadAttention`; differs: a query none of whose keys is valid attends to
    nothing (zeros before the output projection), where torch gives NaN or zeros by its code path.
    """

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs):
        if width % heads:
            raise ValueError(f"{heads} heads do not divide a width of {width}; choose a multiple")
        self._heads = heads
        xavier = math.sqrt(6 / (4 * width))
        self.in_proj_weight = uniform_param(rngs, (3 * width, width), xavier)
        self.in_proj_bias = constant_param(0, 3 * width)
        self.out_proj = Linear(width, width, rngs)
        self.out_proj.bias = constant_param(0, width)

    def __call__(
        self,
        query: jax.Array,
        key: jax.Array,
        value: jax.Array,
        dropout: Dropout,
        valid: jax.Array | None = None,
        bias: jax.Array | None = None,
    ) -> jax.Array:
        """Attends from queries to keys.

        Args:
          query: `[..., Q, D]`.
          key: `[..., K, D]`.
          value: `[..., K, D]`.
          dropout: applied to the attention weights.
          valid: broadcastable to `[..., Q, K]`, True where the query may use the key.
          bias: broadcastable to `[..., heads, Q, K]`, added to the logits.

        Returns:
          `[..., Q, D]`.
        """
        weights = jnp.split(self.in_proj_weight[...], 3)
        biases = jnp.split(self.in_proj_bias[...], 3)
        q, k, v = (
            (x @ w.T + b).reshape(*x.shape[:-1], self._heads, -1)
            for x, w, b in zip((query, key, value), weights, biases, strict=True)
        )
        logits = jnp.einsum("...qhd,...khd->...hqk", q / math.sqrt(q.shape[-1]), k)
        if bias is not None:
            logits = logits + bias
        if valid is None:
            attention = jax.nn.softmax(logits)
        else:
            valid = valid[..., None, :, :]
            # Finite, so that a query without keys has clean gradients.
            logits = jnp.where(valid, logits, jnp.finfo(logits.dtype).min)
            attention = jnp.where(valid, jax.nn.softmax(logits), 0)
        mixed = jnp.einsum("...hqk,...khd->...qhd", dropout(attention), v)
        return self.out_proj(mixed.reshape(*mixed.shape[:-2], -1))


class TransformerEncoderLayer(nnx.Module):
    """Self-attention and feed-forward, each followed by add and norm.

    Source: torch `TransformerEncoderLayer` with `norm_first=False`.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        feedforward: int,
        rngs: nnx.Rngs,
        activation: Callable[[jax.Array], jax.Array] = gelu,
    ):
        self._activation = activation
        self.self_attn = MultiheadAttention(width, heads, rngs)
        self.linear1 = Linear(width, feedforward, rngs)
        self.linear2 = Linear(feedforward, width, rngs)
        self.norm1 = LayerNorm(width)
        self.norm2 = LayerNorm(width)

    def __call__(self, x: jax.Array, valid: jax.Array, dropout: Dropout) -> jax.Array:
        """Maps `[..., N, D]` to the same shape; `valid` `[..., N]` marks real tokens."""
        attended = self.self_attn(x, x, x, dropout, valid[..., None, :])
        x = self.norm1(x + dropout(attended))
        hidden = dropout(self._activation(self.linear1(x)))
        return self.norm2(x + dropout(self.linear2(hidden)))


class TransformerEncoder(nnx.Module):
    """Encoder layers in a row, without a final norm."""

    def __init__(
        self,
        depth: int,
        width: int,
        heads: int,
        feedforward: int,
        rngs: nnx.Rngs,
        activation: Callable[[jax.Array], jax.Array] = gelu,
    ):
        self.layers = nnx.List(
            TransformerEncoderLayer(width, heads, feedforward, rngs, activation)
            for _ in range(depth)
        )

    def __call__(self, x: jax.Array, valid: jax.Array, dropout: Dropout) -> jax.Array:
        """Maps `[..., N, D]` to the same shape; `valid` `[..., N]` marks real tokens."""
        for layer in self.layers:
            x = layer(x, valid, dropout)
        return x


class LSTM(nnx.Module):
    """Stacked LSTM; gates in torch's order: input, forget, cell, output."""

    def __init__(self, inputs: int, width: int, depth: int, rngs: nnx.Rngs):
        self._depth = depth
        bound = 1 / math.sqrt(width)
        for i in range(depth):
            here = inputs if i == 0 else width
            setattr(self, f"weight_ih_l{i}", uniform_param(rngs, (4 * width, here), bound))
            setattr(self, f"weight_hh_l{i}", uniform_param(rngs, (4 * width, width), bound))
            setattr(self, f"bias_ih_l{i}", uniform_param(rngs, (4 * width,), bound))
            setattr(self, f"bias_hh_l{i}", uniform_param(rngs, (4 * width,), bound))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[..., T, inputs]` to the top layer's outputs `[..., T, width]`."""
        sequence = jnp.moveaxis(x, -2, 0)
        for i in range(self._depth):
            w_in, w_hidden, b_in, b_hidden = (
                getattr(self, f"{name}_l{i}")[...]
                for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
            )
            driven = sequence @ w_in.T + (b_in + b_hidden)
            zero = jnp.zeros((*driven.shape[1:-1], w_hidden.shape[1]), driven.dtype)
            step = partial(_lstm_step, w_hidden)
            _, sequence = jax.lax.scan(step, (zero, zero), driven)
        return jnp.moveaxis(sequence, 0, -2)


def _lstm_step(
    w_hidden: jax.Array, carry: tuple[jax.Array, jax.Array], driven: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    hidden, cell = carry
    gates = driven + hidden @ w_hidden.T
    enter, forget, candidate, leave = jnp.split(gates, 4, axis=-1)
    cell = jax.nn.sigmoid(forget) * cell + jax.nn.sigmoid(enter) * jnp.tanh(candidate)
    hidden = jax.nn.sigmoid(leave) * jnp.tanh(cell)
    return (hidden, cell), hidden
