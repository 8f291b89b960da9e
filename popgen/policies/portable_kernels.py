"""Arithmetic of portable policies: float64, each sum in the order of its terms, nothing but + - * / and square roots.

These are rounded alike everywhere, so that the same steps in another language (`popgen/study/assets/ego_network.js`)
give the same bits. Products with 0 are left out. All kernels are in this one file because numba's cache looks only at
the file of the compiled function.
"""

from __future__ import annotations

import numpy as np

from popgen.envs.overcooked.compiled_kernel import compile_helper, compile_kernel

LEAST_EXPONENT = -700.0
"""Below, `exp` is 0."""

POWERS = np.cumprod(np.concatenate([[1.0], np.full(1020, 0.5)]))
"""2 ** -k at k."""

FACTORS = np.array([1.0 / float(np.prod(np.arange(1, n + 1, dtype=np.float64))) for n in range(14)])
"""1 / n!"""

LOG2_E, LN2_HIGH, LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
LEAK = 0.009999999776482582
"""Slope of leaky ReLU below 0, 0.01 in float32."""


@compile_helper
def _take_exp(x):
    """e to the power of x <= 0: a polynomial of what is left of x after whole powers of 2."""
    if not x > LEAST_EXPONENT:
        return 0.0
    power = np.floor(x * LOG2_E + 0.5)
    rest = (x - power * LN2_HIGH) - power * LN2_LOW
    total = FACTORS[13]
    for n in range(12, -1, -1):
        total = total * rest + FACTORS[n]
    return total * POWERS[int(-power)] if power < 0.0 else total


@compile_helper
def _take_sigmoid(x):
    if x >= 0.0:
        return 1.0 / (1.0 + _take_exp(-x))
    share = _take_exp(x)
    return share / (1.0 + share)


@compile_helper
def _take_tanh(x):
    share = _take_exp(-2.0 * abs(x))
    value = (1.0 - share) / (1.0 + share)
    return value if x >= 0.0 else -value


@compile_kernel
def apply_linear(weight, bias, values, out):
    """out (O,) = bias (O,) + values (I,) @ weight (I, O)."""
    for o in range(out.shape[0]):
        out[o] = bias[o]
    for i in range(values.shape[0]):
        value = values[i]
        if value != 0.0:
            for o in range(out.shape[0]):
                out[o] += weight[i, o] * value


@compile_kernel
def apply_norm(weight, bias, eps, values):
    """Layer norm of values (N,) in place."""
    count, total, squares = values.shape[0], 0.0, 0.0
    for i in range(count):
        total += values[i]
    mean = total / count
    for i in range(count):
        squares += (values[i] - mean) * (values[i] - mean)
    deviation = np.sqrt(squares / count + eps)
    for i in range(count):
        values[i] = (values[i] - mean) / deviation * weight[i] + bias[i]


@compile_kernel
def apply_activation(kind, values):
    """0 tanh, 1 leaky ReLU, 2 SiLU of values (N,) in place."""
    for i in range(values.shape[0]):
        x = values[i]
        if kind == 0:
            values[i] = _take_tanh(x)
        elif kind == 1:
            values[i] = x if x >= 0.0 else x * LEAK
        else:
            values[i] = x * _take_sigmoid(x)


@compile_kernel
def advance_gru(inputs, recurrent, memory):
    """PyTorch's GRU from the gates (3 U) of input and memory; memory (U,) in place."""
    units = memory.shape[0]
    for u in range(units):
        reset = _take_sigmoid(inputs[u] + recurrent[u])
        update = _take_sigmoid(inputs[units + u] + recurrent[units + u])
        candidate = _take_tanh(inputs[2 * units + u] + reset * recurrent[2 * units + u])
        memory[u] = candidate + update * (memory[u] - candidate)


@compile_kernel
def advance_norm_gru(gates, memory):
    """`popgen.nets.blocks.NormGRUCell` from its normalised gates (3 U); memory (U,) in place."""
    units = memory.shape[0]
    for u in range(units):
        candidate = _take_tanh(_take_sigmoid(gates[u]) * gates[units + u])
        update = _take_sigmoid(gates[2 * units + u] - 1.0)
        memory[u] = memory[u] + update * (candidate - memory[u])


@compile_kernel
def mark_modes(logits, classes, out):
    """One-hot of each group's likeliest class, the first of equals: logits and out (classes * groups,)."""
    groups = out.shape[0] // classes
    for i in range(out.shape[0]):
        out[i] = 0.0
    for g in range(groups):
        best = 0
        for c in range(1, classes):
            if logits[c * groups + g] > logits[best * groups + g]:
                best = c
        out[best * groups + g] = 1.0


@compile_kernel
def fill_probabilities(logits, uniform_share, out):
    """Softmax of logits (A,), mixed with a uniform share, into out (A,)."""
    count, most, total = logits.shape[0], logits[0], 0.0
    for a in range(1, count):
        most = max(most, logits[a])
    for a in range(count):
        out[a] = _take_exp(logits[a] - most)
        total += out[a]
    for a in range(count):
        out[a] = out[a] / total * (1.0 - uniform_share) + uniform_share / count


@compile_kernel
def invert_distribution(probabilities, uniform):
    """The entry at which the sum of probabilities (A,) passes `uniform` of all of it; the last one that is not 0 where
    rounding leaves none."""
    total, last = 0.0, 0
    for a in range(probabilities.shape[0]):
        total += probabilities[a]
        if probabilities[a] > 0.0:
            last = a
    wanted, passed = uniform * total, 0.0
    for a in range(probabilities.shape[0]):
        passed += probabilities[a]
        if wanted < passed:
            return a
    return last
