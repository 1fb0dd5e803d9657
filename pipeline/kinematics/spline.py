"""The cubic spline through the entries of the table, with not-a-knot ends (de Boor, *A Practical Guide to Splines*).

The same curve as ``scipy.interpolate.CubicSpline`` with its default ends, in numpy alone, so that playback needs no
more than numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def interval_polynomials(x: Float, y: Float) -> Float:
    """Coefficients of the not-a-knot cubic through samples, one polynomial for each interval.

    Parameters
    ----------
    x : (N,) float64
        Strictly increasing, N >= 2. Two samples give a line, three a parabola.
    y : (N, K) float64
        K curves.

    Returns
    -------
    (N - 1, 4, K) float64
        Highest power first: in interval i the curve is c0 t^3 + c1 t^2 + c2 t + c3 with t = x - x[i].

    Raises
    ------
    ValueError
        For fewer than two samples or ``x`` not increasing.
    """
    if len(x) < 2 or not np.all(np.diff(x) > 0):
        raise ValueError(f"a spline needs two or more samples at increasing places, got {len(x)}")
    width = np.diff(x)[:, None]
    chord = np.diff(y, axis=0) / width
    slope = _slopes(x, chord)
    bend = (slope[:-1] + slope[1:] - 2.0 * chord) / width
    return np.stack([bend / width, (chord - slope[:-1]) / width - bend, slope[:-1], y[:-1]], axis=1)


def _slopes(x: Float, chord: Float) -> Float:
    """(N, K) first derivatives at the samples.

    The second derivative is continuous everywhere, the third also at the second sample and at the last but one.
    """
    if len(x) == 2:
        return np.repeat(chord, 2, axis=0)
    width = np.diff(x)
    matrix = np.zeros((len(x), len(x)))
    right = np.zeros((len(x), chord.shape[1]))
    inner = np.arange(1, len(x) - 1)
    matrix[inner, inner - 1] = width[1:]
    matrix[inner, inner] = 2.0 * (width[:-1] + width[1:])
    matrix[inner, inner + 1] = width[:-1]
    right[inner] = 3.0 * (width[1:, None] * chord[:-1] + width[:-1, None] * chord[1:])
    matrix[0, :2], right[0] = _end(width, chord)
    matrix[-1, :-3:-1], right[-1] = _end(width[::-1], chord[::-1])
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def _end(width: Float, chord: Float) -> tuple[Float, Float]:
    """Equation of the end sample: weights of its slope and its neighbour's, and the (K,) right-hand side."""
    if len(width) == 2:  # a parabola: the slopes at both ends of an interval average to its chord
        return np.ones(2), 2.0 * chord[0]
    first, second = float(width[0]), float(width[1])
    both = first + second
    near, far = (first + 2.0 * both) * second / both, first * first / both
    return np.array([second, both]), near * chord[0] + far * chord[1]
