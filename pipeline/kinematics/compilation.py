"""Compilation of numeric kernels to machine code, once, kept on disk beside the source.

No fast mathematics: sums stay in the order they are written, so a pose does not depend on the processor. Kernels let go
of the interpreter, so that threads can run them side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """The function in machine code: same signature, arrays and named tuples of arrays as arguments, never raises."""
    kernel: F = njit(cache=True, nogil=True, error_model="numpy")(function)
    return kernel


def inlined(function: F) -> F:
    """The same for a small function that is called in innermost loops: its body takes the place of each call.

    A call counts references to every array that it is given, which costs more than a few sums.
    """
    kernel: F = njit(cache=True, nogil=True, error_model="numpy", inline="always")(function)
    return kernel
