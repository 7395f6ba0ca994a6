"""Tables 1 and 2 of the paper: times of correlations, in its forms and in ours.

All on one core, in CPU time. The ABRDFs are those of the paper's synthetic scene (section
5.1) on 151 x 151 directions; the target is the same material in its own frame. As in the paper,
projection and factorisation are not in the times.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reflfield.alignment.rotation_search import search
from reflfield.report.page import Cell, Note, Section, Table
from reflfield.reproduction import paper_forms
from reflfield.reproduction.paper_scene import (
    RINGS_151,
    dome_directions,
    relief_frames,
    sample_texels,
)
from reflfield.sphere.coupling import couple
from reflfield.sphere.harmonic_projection import Projector, direction_operator, solid_angles
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.util.blas_threads import one_core_blas
from reflfield.util.progress import report

Array = NDArray[np.float64]

BAND_LIMITS = (4, 8, 16)
# Of the nodes that sums over samples are interpolated between.
SIDE = 25
# ABRDFs, or pairs of functions, that one timed run works on, by band limit.
MANY = {4: 64, 8: 32, 16: 8}
# Direct sums that would take minutes are timed on this share of the grid's rotations.
SHARE = {4: 1, 8: 4, 16: 64}
# A form is run again until so many seconds or runs are together; the fastest counts.
ENOUGH_SECONDS, ENOUGH_RUNS = 0.3, 5

# Milliseconds on an AMD Athlon 3200+, by band limit; None where the paper gives a bound only.
PAPER_1 = {
    "Eq. 5, 151 directions": (0.325, 1.873, 15.144),
    "Eq. 8, direct": (0.685, 27.673, ">1000"),
    "Eq. 8, FFT": (0.029, 0.336, 5.326),
}
PAPER_2 = {
    "Eq. 3, 151 x 151 samples": (291.2, ">1500", "N.N."),
    "Eq. 10, direct": (26.86, ">3500", "N.N."),
    "Eq. 11, K = 4": (1.145, 10.683, 195.937),
    "Eq. 11, K = 6": (2.591, 23.803, 445.118),
}
SEARCH = "exact, searched, to the peak (ours)"
PRODUCT = "one target, product (ours)"


class Problem(NamedTuple):
    """What the forms work on at one band limit."""

    band_limit: int
    directions: Array
    samples: NDArray[np.float32]
    abrdfs: NDArray[Any]
    target: NDArray[Any]
    functions: NDArray[Any]
    function: NDArray[Any]
    weighted: NDArray[Any]
    nodes: NDArray[np.float32]
    function_nodes: Array

    @property
    def rotations(self) -> Array:
        """The paper's grid."""
        return paper_forms.paper_grid(self.band_limit)

    @property
    def some(self) -> Array:
        """Rotations that direct sums are timed on."""
        return np.ascontiguousarray(self.rotations[:: SHARE[self.band_limit]])


def problem(band_limit: int) -> Problem:
    """ABRDFs of the synthetic scene with 2 % noise, and functions of the view alone."""
    rng = np.random.default_rng(1)
    directions, n = dome_directions(RINGS_151), MANY[band_limit]
    frames = relief_frames()
    frames = frames[np.sort(rng.choice(len(frames), n, replace=False))]
    projector = Projector(directions, directions, (band_limit, band_limit))
    samples = sample_texels(frames, directions, directions)
    samples += 0.02 * samples.std() * rng.standard_normal(samples.shape, np.float32)
    upright = sample_texels(np.eye(3)[None], directions, directions)
    zenith = int(np.argmax(directions[:, 2]))
    analysis = direction_operator("views", directions, band_limit).analysis
    grid = HemisphereGrid(SIDE).directions
    at_zenith = sample_texels(np.eye(3)[None], grid, directions[zenith : zenith + 1])
    return Problem(
        band_limit,
        directions,
        samples,
        projector.project(samples),
        projector.project(upright)[0],
        samples[:, :, zenith] @ analysis.T,
        analysis @ upright[0, :, zenith],
        samples[0, :, zenith] * solid_angles(directions),
        sample_texels(np.eye(3)[None], grid, grid)[0],
        at_zenith[0, :, 0].astype(np.float64),
    )


def milliseconds(work: Callable[[], object], count: float) -> float:
    """CPU time of one of `count` pieces of work; a first run, which compiles, is not timed."""
    work()
    times: list[float] = []
    while sum(times) < ENOUGH_SECONDS and len(times) < ENOUGH_RUNS:
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return 1e3 * min(times) / count


def times_of_functions(one: Problem) -> dict[str, float]:
    """Table 1: one correlation of two functions of direction on the grid."""
    a, b = one.functions[0], one.function
    some, share = one.some, 1 / SHARE[one.band_limit]
    kernel = paper_forms.separation_kernel(one.band_limit)
    singles = one.functions.astype(np.float32)
    pairs = np.broadcast_to(b.astype(np.float32), singles.shape)
    turned = paper_forms.turned(b[:, None], one.rotations, "float32")[:, :, 0].T.copy()
    sums = paper_forms.sampled_correlations
    forms: dict[str, tuple[Callable[[], object], float]] = {
        "Eq. 5, 151 directions": (
            lambda: sums(one.weighted, one.directions, one.function_nodes, SIDE, some),
            share,
        ),
        "Eq. 8, direct": (lambda: paper_forms.direct_correlations(a, b, some), share),
        "Eq. 8, FFT": (
            lambda: paper_forms.separated_correlations(singles, pairs, kernel),
            len(singles),
        ),
        PRODUCT: (lambda: singles @ turned, len(singles)),
    }
    return _timed(forms, f"Table 1, L = {one.band_limit}")


def times_of_abrdfs(one: Problem) -> dict[str, float]:
    """Table 2: one ABRDF against the target on the grid, and by our search."""
    some, share = one.some, 1 / SHARE[one.band_limit]
    singles, target = one.abrdfs.astype(np.float32), one.target.astype(np.float32)
    source, aim = couple(singles), couple(target[None])
    sums = paper_forms.sampled_abrdf_correlations
    direct = paper_forms.direct_abrdf_correlations
    forms: dict[str, tuple[Callable[[], object], float]] = {
        "Eq. 3, 151 x 151 samples": (
            lambda: sums(one.samples[0], one.directions, one.nodes, SIDE, some),
            share,
        ),
        "Eq. 10, direct": (lambda: direct(singles[0], target, some), share),
    }
    for rank in (4, 6):
        view, light = paper_forms.factors(singles, rank)
        turned = paper_forms.turn_target(target, rank, one.rotations)
        forms[f"Eq. 11, K = {rank}"] = (
            lambda v=view, w=light, t=turned: paper_forms.factored_maxima(v, w, t),  # type: ignore[misc]
            len(singles),
        )
    if one.band_limit <= 8:
        # Beyond, the matrices of a grid that nothing amortises take minutes.
        forms["exact, on the grid (ours)"] = (
            lambda: paper_forms.exact_maxima(source, aim, some),
            len(singles) * share,
        )
    forms[SEARCH] = (lambda: search(source, aim, margins=False), len(singles))
    return _timed(forms, f"Table 2, L = {one.band_limit}")


def _timed(
    forms: dict[str, tuple[Callable[[], object], float]], description: str
) -> dict[str, float]:
    """Milliseconds of every form, on one core."""
    times = {}
    with one_core_blas():
        for done, (name, (work, count)) in enumerate(forms.items()):
            report(description, done, len(forms))
            times[name] = milliseconds(work, count)
    report(description, len(forms), len(forms))
    return times


def table_1() -> Section:
    """Section of the page with Table 1."""
    times = {limit: times_of_functions(problem(limit)) for limit in BAND_LIMITS}
    return _section(
        "Table 1: spherical correlation",
        "Correlation of two functions of direction on a grid of (2L)^3 rotations, "
        "milliseconds: the paper's on an AMD Athlon 3200+ beside ours in CPU time of one core.",
        PAPER_1,
        times,
    )


def table_2() -> Section:
    """Section of the page with Table 2."""
    times = {limit: times_of_abrdfs(problem(limit)) for limit in BAND_LIMITS}
    return _section(
        "Table 2: correlation of ABRDFs",
        "Correlation of one ABRDF with the target over all rotations, milliseconds. Eq. 10 "
        'has no fast form in the paper ("we currently have not found a way to exploit" '
        "that both directions turn alike); coupled harmonics are one, exact and for any K.",
        PAPER_2,
        times,
    )


def _section(
    title: str,
    intro: str,
    paper: dict[str, tuple[Any, ...]],
    times: dict[int, dict[str, float]],
) -> Section:
    """Rows of all forms: for each band limit what the paper measured and what we did."""
    names = list(dict.fromkeys([*paper, *(name for one in times.values() for name in one)]))
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        row: list[Cell] = [name]
        for place, limit in enumerate(BAND_LIMITS):
            row += [paper[name][place] if name in paper else None, times[limit].get(name)]
        rows.append(tuple(row))
    header = ["form"]
    for limit in BAND_LIMITS:
        header += [f"L = {limit}, paper", f"L = {limit}, here"]
    emphasised = tuple(i for i, name in enumerate(names) if name not in paper)
    note = (
        "Direct sums are timed on every 4th rotation at L = 8 and every 64th at L = 16, and "
        "multiplied; an entry is the fastest of up to 5 runs."
    )
    return Section(
        title, intro, (Table(tuple(header), tuple(rows), "ms", emphasised), Note(note))
    )
