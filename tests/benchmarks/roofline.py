"""What a kernel could do at most: arithmetic and memory of this machine, and its own needs.

S. Williams, A. Waterman, D. Patterson, "Roofline: an insightful visual performance model for
multicore architectures", CACM 52, 2009: a kernel of so many operations a byte reaches at most
the lesser of the peak of arithmetic and of bandwidth times that intensity.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np
from benchmarks.measuring import measured

# Operations that are counted: an addition, subtraction, multiplication, least or greatest of
# two as 1 (a fused multiply-add so as 2), and, as in F. McMahon, "The Livermore Fortran
# kernels", 1986, a division or root as 4 and any other function as 8. A division by a constant
# is a multiplication. Not counted: indices, comparisons, conversions, calls.
DIVISION, ROOT, FUNCTION = 4, 4, 8
# Multiply-adds to each number that the loop of the peak reads, and numbers: 8 kB or 16 kB.
CHAIN, IN_CACHE, ROUNDS = 16, 2048, 4000
# Numbers of each of the triad's three arrays, 64 MB, and rows of BLAS's matrices.
IN_MEMORY, ROWS = 8_000_000, 1024


@dataclass(frozen=True)
class Kernel:
    """A kernel with its input.

    Parameters
    ----------
    item : str
        What is counted.
    precision : {"float32", "float64"}
        Of most of its arithmetic.
    n_items : int
    operations : float
        For each item.
    bytes_read, bytes_written : int
        By one call: each array once for every pass that the source makes over all of it.
    work : callable
        Call the kernel; its answers, a tuple of arrays.
    reference : callable
        The same answers by NumPy in double precision.
    """

    item: str
    precision: str
    n_items: int
    operations: float
    bytes_read: int
    bytes_written: int
    work: Callable
    reference: Callable

    @property
    def intensity(self):
        """Operations a byte."""
        return self.operations * self.n_items / (self.bytes_read + self.bytes_written)

    def error(self):
        """Largest difference from the reference over its largest value, of all answers."""
        pairs = zip(self.work(), self.reference(), strict=True)
        return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def size(*arrays):
    """Bytes of arrays, also in tuples."""
    return sum(size(*each) if isinstance(each, tuple) else each.nbytes for each in arrays)


# --- rates ----------------------------------------------------------------------------------


def on_threads(prepare, n_threads):
    """Measure pieces of work side by side, one a thread, each with an input of its own.

    Returns
    -------
    cost : measuring.Measured
    factor : int
        What the amount of one piece over `cost.cpu_seconds` is multiplied by for the rate of
        all: as many pieces, each in its thread's share of that time, which is the wall time
        where nothing else runs.
    """
    # What was freed before goes back, so that the peak is this measurement's own.
    ctypes.CDLL(None).malloc_trim(0)
    with ThreadPoolExecutor(n_threads) as pool:
        cost = measured(
            lambda: [prepare(seed) for seed in range(n_threads)],
            lambda works: list(pool.map(lambda work: work(), works)),
        )
    return cost, n_threads**2


def rate(prepare, amount, n_threads):
    """Amount a second, in units of 1e9, that threads do together."""
    cost, factor = on_threads(prepare, n_threads)
    return 1e-9 * amount * factor / cost.cpu_seconds


# Only fused: the compiler may not sum a chain up beforehand.
@numba.njit(nogil=True, fastmath={"contract"})
def fused_chains(values, factor, term, rounds):
    """Independent chains of multiply-adds, which become vector instructions."""
    for _ in range(rounds):
        for i in range(len(values)):
            value = values[i]
            for _ in range(CHAIN):
                value = value * factor + term
            values[i] = value


@numba.njit(nogil=True, fastmath={"contract"})
def triad(out, a, b, factor):
    """J. McCalpin's: two numbers read and one written for two operations."""
    for i in range(len(out)):
        out[i] = a[i] + factor * b[i]


def chains(dtype, _seed):
    """Work of `fused_chains`."""
    half, values = np.dtype(dtype).type(0.5), np.ones(IN_CACHE, dtype)
    return partial(fused_chains, values, half, half, ROUNDS)


def triads(_seed):
    """Work of `triad`."""
    out, a, b = (np.full(IN_MEMORY, value) for value in (0.0, 1.0, 2.0))
    return partial(triad, out, a, b, 0.5)


def products(dtype, seed):
    """Work of BLAS, on one thread."""
    a, b = np.random.default_rng(seed).random((2, ROWS, ROWS)).astype(dtype)
    out = np.zeros_like(a)
    return lambda: np.matmul(a, b, out=out)


@dataclass(frozen=True)
class Limits:
    """Of so many threads together.

    Parameters
    ----------
    peak, blas : dict
        1e9 operations a second, by precision.
    bandwidth : float
        1e9 bytes a second.
    """

    peak: dict
    blas: dict
    bandwidth: float

    @classmethod
    def of(cls, n_threads):
        """Measure."""
        kinds = ("float32", "float64")
        in_chains, in_product = 2 * CHAIN * IN_CACHE * ROUNDS, 2 * ROWS**3
        return cls(
            {kind: rate(partial(chains, kind), in_chains, n_threads) for kind in kinds},
            {kind: rate(partial(products, kind), in_product, n_threads) for kind in kinds},
            rate(triads, 3 * 8 * IN_MEMORY, n_threads),
        )

    def of_kernel(self, kernel):
        """Most that a kernel could do, 1e9 operations a second, and what limits it."""
        by_memory = self.bandwidth * kernel.intensity
        peak = self.peak[kernel.precision]
        return min((peak, "arithmetic"), (by_memory, "memory"))
