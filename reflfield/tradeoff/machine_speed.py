"""How fast this machine is: a few seconds of the kinds of work that stages do."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median

import numpy as np

from reflfield.field.half_vector_evaluation import evaluate_half_vector
from reflfield.fitting.texel_sample_fit import start_model
from reflfield.util.progress import track

# Times that each kind of work is done; the median counts, whatever else the machine does.
REPEATS = 3
# Samples that are evaluated, side of a product of matrices, numbers that are transformed.
SAMPLES, SIDE, NUMBERS = 500_000, 1200, 16_000_000


def machine_seconds() -> dict[str, float]:
    """Measure the CPU time of some work of each kind, in a few seconds.

    Returns
    -------
    dict of str to float
        CPU seconds: of evaluating a half-vector model, as its fits do, which waits for memory
        in no order; of a product of matrices; of transforming numbers in their order.
    """
    rng = np.random.default_rng(0)
    work = {
        "model": _evaluation(rng),
        "matrices": _product(rng),
        "numbers": _transform(rng),
    }
    for repeatable in work.values():  # compiled, and its memory touched
        repeatable()
    rounds = [
        {name: _cpu_seconds(repeatable) for name, repeatable in work.items()}
        for _ in track(range(REPEATS), REPEATS, "speed of this machine")
    ]
    return {name: median(times[name] for times in rounds) for name in work}


def slowness(here: Mapping[str, float], reference: Mapping[str, float]) -> float:
    """Geometric mean of how much longer the work takes here than on another machine.

    Examples
    --------
    >>> slowness({"model": 2.0, "matrices": 1.0}, {"model": 1.0, "matrices": 0.5})
    2.0
    """
    ratios = [here[name] / reference[name] for name in reference if name in here]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0


def _evaluation(rng: np.random.Generator) -> Callable[[], None]:
    n_texels = 20_000
    frames = np.tile(np.eye(3, dtype=np.float32), (n_texels, 1, 1))
    model = start_model(frames, 2)
    texels = rng.integers(0, n_texels, SAMPLES, np.int32)
    views, lights = (_upper_directions(rng) for _ in range(2))
    out = np.zeros((SAMPLES, 3), np.float32)
    return lambda: evaluate_half_vector(*model.arrays, texels, views, lights, out)


def _upper_directions(rng: np.random.Generator) -> np.ndarray:
    directions = rng.normal(size=(SAMPLES, 3)).astype(np.float32)
    directions[:, 2] = np.abs(directions[:, 2]) + 0.1
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions


def _product(rng: np.random.Generator) -> Callable[[], None]:
    matrix = rng.random((SIDE, SIDE), np.float32)
    out = np.zeros_like(matrix)

    def multiply() -> None:
        np.matmul(matrix, matrix, out=out)

    return multiply


def _transform(rng: np.random.Generator) -> Callable[[], None]:
    numbers = rng.random(NUMBERS, np.float32)
    out = np.zeros_like(numbers)

    def transform() -> None:
        np.cbrt(numbers, out=out)

    return transform


def _cpu_seconds(work: Callable[[], None]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started
