"""What a right model gains on a record: a small Gaussian likelihood of drift laws with columns. Knows no selfcal.

A reading is a constant, a drift, white noise and columns times coefficients. The drift is a random walk or a
Gauss-Markov process on a grid; the white noise's variance and the coefficients take their best value at each node.
The constant is integrated under a flat prior, so that both laws have the same measure.

Gain: the best node with the columns less the best node without them, less half of ln n for each coefficient and less a
price for places and shapes searched. That is the logarithm of a Bayes factor to about a nat or two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpttrf, dpttrs

Array = NDArray[Any]

#: Walk: K/N, 1/s. A constant comes before them.
WALKS = np.geomspace(3e-4, 0.3, 22)
#: K/N times the record's length that is as good as none: the walk's sd at its end, in sd of the mean.
NO_WALK = 0.01
#: Gauss-Markov: sigma/N, 1/sqrt(s), and time constant, s.
SIGMAS = np.geomspace(0.04, 5.0, 10)
TAUS = np.geomspace(8.0, 2500.0, 9)


@dataclass(frozen=True)
class Node:
    """One drift law on n samples: `quadratic` is scaled by the white noise's variance, `constant` holds the rest."""

    n: int
    constant: float
    quadratic: Array

    def log_likelihood(self, y: Array, columns: Sequence[int]) -> float:
        """Of the combination `y` [p] of the vectors, with those of the index list `columns` fitted."""
        inner = self.quadratic
        residual = float(y @ inner @ y)
        if columns:
            chosen = list(columns)
            side = inner[chosen] @ y
            residual -= float(side @ np.linalg.lstsq(inner[np.ix_(chosen, chosen)], side, rcond=1e-10)[0])
        free = self.n - 1
        return float(-0.5 * free * (np.log(2.0 * np.pi * max(residual, 1e-300) / free) + 1.0) + self.constant)


def walk_node(vectors: Array, dt: float, ratio: float) -> Node:
    """`vectors` [n, p] every `dt` s under a random walk of K/N = `ratio`."""
    n = len(vectors)
    k = (ratio * dt) ** 2
    diagonal = np.full(n, 2.0 / k + 1.0)
    diagonal[[0, -1]] = 1.0 / k + 1.0
    quadratic, log_determinant = _inner(vectors, diagonal, np.full(n - 1, -1.0 / k))
    return Node(n, -0.5 * ((n - 1) * np.log(k) + log_determinant), quadratic)


def markov_node(vectors: Array, dt: float, sigma: float, tau: float) -> Node:
    """`vectors` [n, p] every `dt` s under a Gauss-Markov process of sigma/N = `sigma` and time constant `tau`."""
    n = len(vectors)
    kappa, phi = sigma**2 * dt, np.exp(-dt / tau)
    scale = 1.0 / (kappa * (1.0 - phi**2))
    diagonal = np.full(n, (1.0 + phi**2) * scale + 1.0)
    diagonal[[0, -1]] = scale + 1.0
    inner, log_determinant = _inner(np.column_stack([vectors, np.ones(n)]), diagonal, np.full(n - 1, -phi * scale))
    ones, side = inner[-1, -1], inner[-1, :-1]
    log_determinant += n * np.log(kappa) + (n - 1) * np.log(1.0 - phi**2)
    return Node(n, -0.5 * (log_determinant + np.log(ones)), inner[:-1, :-1] - np.outer(side, side) / ones)


def _inner(vectors: Array, diagonal: Array, off: Array) -> tuple[Array, float]:
    """V'(1 - M^-1)V and ln|M| of the symmetric tridiagonal M."""
    factor, lower, failed = dpttrf(diagonal, off)
    if failed:
        raise RuntimeError("a drift's precision is not positive definite")
    solved, _ = dpttrs(factor, lower, np.asfortranarray(vectors))
    return vectors.T @ (vectors - solved.reshape(vectors.shape)), float(np.log(factor).sum())


def nodes(vectors: Array, dt: float) -> list[Node]:
    """Of both laws, over the grid."""
    centred = vectors - vectors.mean(axis=0)
    made = [walk_node(centred, dt, float(ratio)) for ratio in (NO_WALK / (len(vectors) * dt), *WALKS)]
    return made + [markov_node(centred, dt, sigma, tau) for sigma in SIGMAS for tau in TAUS]


def base_log_likelihood(y: Array, dt: float) -> float:
    """Of the best drift law for `y` [n] alone."""
    return max(node.log_likelihood(np.ones(1), ()) for node in nodes(y[:, None], dt))


def column_gain(
    quiet: Array, shape: Array, dt: float, columns: Array | None = None, price: float = 0.0
) -> Callable[[float], float]:
    """Gain as a function of the amount A, for the record `quiet` + A * `shape` (both [n], every `dt` s).

    `columns` [n, p]: those of the right model; default: the shape itself. `price`: nats for places and shapes.
    """
    own = shape[:, None] if columns is None else columns
    scaled = own / np.maximum(own.std(axis=0), 1e-300)
    grid = nodes(np.column_stack([quiet, shape, scaled]), dt)
    fitted = tuple(range(2, 2 + scaled.shape[1]))
    price += 0.5 * len(fitted) * np.log(len(quiet))

    def gain(amount: float) -> float:
        y = np.zeros(2 + len(fitted))
        y[:2] = 1.0, amount
        with_columns = max(node.log_likelihood(y, fitted) for node in grid)
        return float(with_columns - max(node.log_likelihood(y, ()) for node in grid) - price)

    return gain


def dense_log_likelihood(y: Array, covariance: Array, constants: Array) -> float:
    """Of `y` [n] with this covariance [n, n] and flat priors on the coefficients of `constants` [n, p]."""
    factor = cholesky(covariance, lower=True)
    solved = cho_solve((factor, True), np.column_stack([y, constants]))
    inner = constants.T @ solved[:, 1:]
    side = constants.T @ solved[:, 0]
    residual = float(y @ solved[:, 0] - side @ np.linalg.solve(inner, side))
    free = len(y) - constants.shape[1]
    log_determinant = 2.0 * float(np.log(np.diag(factor)).sum()) + float(np.linalg.slogdet(inner)[1])
    return float(-0.5 * (free * np.log(2.0 * np.pi) + log_determinant + residual))


def drift_covariance(t: Array, law: str, size: float, tau: float) -> Array:
    """[n, n]: a random walk of K = `size` at the even times `t` from t[0], or means of Gauss-Markov of sigma = `size`.

    Means of blocks around `t`, as long as they are apart: of exp(-|lag|/tau), integrated.
    """
    if law == "random_walk":
        return np.asarray(size**2 * np.minimum.outer(t - t[0], t - t[0]))
    d = float(t[1] - t[0]) / tau
    covariance = np.exp(-np.abs(np.subtract.outer(t, t)) / tau) * (np.sinh(0.5 * d) / (0.5 * d)) ** 2
    np.fill_diagonal(covariance, 2.0 * (d - 1.0 + np.exp(-d)) / d**2)
    return np.asarray(size**2 * covariance)


def scale_gain(noise: Array, sd: Array) -> float:
    """Of white `noise` [n] whose standard deviation goes as `sd` [n], over one that stays."""
    n = len(noise)
    scaled = noise / sd
    steady = -0.5 * n * np.log(float(np.mean(noise**2)))
    return float(-0.5 * n * np.log(float(np.mean(scaled**2))) - np.log(sd).sum() - steady)


def correlation_gain(one: Array, other: Array) -> float:
    """Of two white series [n] that correlate, over two that do not."""
    rho = float(np.corrcoef(one, other)[0, 1])
    return float(-0.5 * len(one) * np.log1p(-(rho**2)) - 0.5 * np.log(len(one)))


def band_gain(one: Array, other: Array, own: tuple[Array, Array], shared: Array, sign: float) -> float:
    """Of two series [n] that share a stationary part, over two with the same spectra that share nothing.

    `own`: each one's whole spectrum, `shared`: the cross spectrum's size, at the frequencies of rfft without the first.
    """
    n = len(one)
    a, b = (np.fft.rfft(each - each.mean())[1:] / np.sqrt(n) for each in (one, other))
    coherence = shared**2 / (own[0] * own[1])
    alone = np.abs(a) ** 2 / own[0] + np.abs(b) ** 2 / own[1]
    cross = 2.0 * sign * shared * (a * b.conj()).real / (own[0] * own[1])
    joint = (alone - cross) / (1.0 - coherence)
    return float((alone - joint - np.log1p(-coherence)).sum() - 0.5 * np.log(n))


def solve(gain: Callable[[float], float], target: float, low: float, high: float, steps: int = 40) -> float:
    """The least amount between `low` and `high` where the gain reaches `target`; RuntimeError where none does."""
    reached = -np.inf
    for upper in np.geomspace(low, high, 1 + int(np.ceil(4.0 * np.log10(high / low)))):
        reached = max(reached, value := gain(float(upper)))
        if value >= target:
            break
        low = float(upper)
    else:
        raise RuntimeError(f"{reached:.0f} nats at most, {target:.0f} wanted")
    high = float(upper)
    for _ in range(steps):
        middle = float(np.sqrt(low * high))
        value = gain(middle)
        if abs(value - target) < 0.01 * target:
            return middle
        low, high = (low, middle) if value > target else (middle, high)
    return high
