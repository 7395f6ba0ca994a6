"""A ColorChecker found in a photograph, and the matrix that gives its patches their colours."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reflfield.capture.encoding import encode_srgb
from reflfield.errors import InputError

Array = NDArray[np.float64]

# Colours of the patches of charts made since November 2014, under D50.
CHART = "ColorChecker24 - After November 2014"
ROWS, COLUMNS = 4, 6
N_PATCHES, NEUTRAL = ROWS * COLUMNS, slice(18, 24)
# Share of a patch's side that is sampled, with so many samples a side: frames between patches
# are a tenth of it, and the chart is found to a few hundredths.
SAMPLED_SIDE, SAMPLES_PER_SIDE = 0.5, 12
# Charts that are told apart in a photograph; more than one is refused.
MOST_CHARTS = 4
# Share of the largest value of the photograph from which on a patch may be clipped, and patches
# and grey ones that tell a matrix.
CLIPPED, FEWEST_PATCHES, FEWEST_GREYS = 0.95, 12, 2
# Ratio of greys from which on a photograph is plainly not linear.
LINEAR_GREYS = 1.25
# File beside the corrected capture, in the form that `encoding` takes.
GREYS = "chart_greys.csv"
_WORDS = {
    "matrix": "a matrix",
    "white balance": "the white balance alone, no matrix is better",
    "none": "nothing, no correction is better",
}


@dataclass(frozen=True, eq=False)
class ColorCorrection:
    """A matrix for linear photographs, and what it gains.

    Parameters
    ----------
    matrix : (3, 3) float64
        From linear photographs to linear values in Rec.709's primaries; it leaves the luminance
        of greys as it is. Of the whole matrix, the white balance alone and no correction the
        one of the least error.
    kind : {"matrix", "white balance", "none"}
        Which that is.
    white_balance : (3,) float64
        Factors of red, green and blue that give greys their colours, of green 1.
    n_used : int
        Patches that are not clipped.
    grey_scatter : float
        Largest ratio of brightness to reflectance of greys over the least one: 1 where the
        photograph is linear and the chart evenly lit.
    curve : tuple of (float, float)
        Where the greys are plainly not linear, and the stored codes are known: pairs of code (a
        share of the largest) and reflectance, of greys that are not clipped. Else empty.
    error_before, error_balanced, error_after : float
        Mean difference (CIE DE2000) of these patches, at the best common brightness: as
        photographed, with the white balance alone, and with matrices fitted without the patch.
    """

    matrix: Array
    kind: str
    white_balance: Array
    n_used: int
    grey_scatter: float
    curve: tuple[tuple[float, float], ...]
    error_before: float
    error_balanced: float
    error_after: float

    def lines(self) -> list[str]:
        """What was found, in words."""
        gains = ", ".join(f"{gain:.3f}" for gain in self.white_balance)
        lines = [
            f"colour: corrected by {_WORDS[self.kind]}; white balance {gains}, "
            f"{self.n_used} of {N_PATCHES} patches used",
            f"difference of the patches (CIE DE2000): {self.error_before:.1f} -> "
            f"{self.error_balanced:.1f} balanced -> {self.error_after:.1f} by the matrix (each "
            "patch left out in turn)",
        ]
        if self.grey_scatter > LINEAR_GREYS:
            lines.append(
                f"the greys are off by {self.grey_scatter:.1f} times among each other: the "
                "photograph is not linear, or the chart not evenly lit; develop photographs "
                "without a tone curve, or state their encoding"
                + (f": {GREYS} has the curve of the greys" if self.curve else "")
            )
        return lines

    def entry(self) -> dict[str, Any]:
        """The same for a JSON file."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }


def color_correction(
    photograph: NDArray[np.floating], name: str, codes: NDArray[np.floating] | None = None
) -> ColorCorrection:
    """Find a ColorChecker Classic in a photograph and fit a matrix to it.

    Parameters
    ----------
    photograph : (height, width, 3) float
        Linear.
    name : str
        Quoted in messages.
    codes : (height, width, 3) float, optional
        The same as stored, as shares of the largest code: tells the curve of greys.

    Raises
    ------
    InputError
        If colour-science is not installed, no chart is found, or too much of it is clipped.

    Notes
    -----
    The white balance is the mean ratio of the greys; the matrix is of least squares. [1]_

    References
    ----------
    .. [1] V. Cheung et al., "A comparative study of the characterisation of colour cameras by
       means of neural networks and polynomial transforms", Coloration Technology 120, 2004.
    """
    check_installed()
    image = np.asarray(photograph, np.float64)
    corners = _chart(image / max(float(image.max()), 1e-9), name)
    patches = _sampled(image / max(float(image.max()), 1e-9), corners)
    stored = None if codes is None else _sampled(np.asarray(codes, np.float64), corners)
    with _library() as colour:
        truth = _reference(colour)
        used: NDArray[np.bool_] = np.all((patches < CLIPPED) & (patches > 0), axis=1)
        greys = np.zeros(N_PATCHES, bool)
        greys[NEUTRAL] = True
        greys &= used
        if used.sum() < FEWEST_PATCHES or greys.sum() < FEWEST_GREYS:
            raise InputError(
                f"{name}: expected at least {FEWEST_PATCHES} patches of the ColorChecker, and "
                f"{FEWEST_GREYS} of its greys, below the upper limit of the photograph, "
                f"received {used.sum()} and {greys.sum()}; expose it for less time"
            )
        correction = _fitted(colour, patches, truth, used, greys)
    if stored is None or correction.grey_scatter <= LINEAR_GREYS:
        return correction
    return replace(correction, curve=_curve(stored[greys], truth[greys]))


def check_installed() -> None:
    """Demand the package of the extra ``color``.

    Raises
    ------
    InputError
    """
    if not find_spec("colour"):
        raise InputError(
            "color_checker: expected the package that knows the colours of a chart, found no "
            'colour-science; install it with: pip install "reflfield[color]"'
        )


@contextmanager
def _library() -> Iterator[Any]:
    """colour-science, imported when it is used; what it lacks itself is not warned of.

    It changes how NumPy prints arrays: that is undone.
    """
    with warnings.catch_warnings(), np.printoptions():
        warnings.simplefilter("ignore")
        yield import_module("colour")


def _chart(image: Array, name: str) -> NDArray[np.float32]:
    """Corners of the one chart in a photograph in [0, 1]."""
    # Its edges are sought in what is as bright as on a screen, then in what is linear.
    charts = _corners(np.asarray(encode_srgb(np.clip(image, 0, 1))))
    charts = charts or _corners(np.clip(image, 0, 1))
    if len(charts) != 1:
        raise InputError(
            f"{name}: expected one ColorChecker Classic of {N_PATCHES} patches, found "
            f"{len(charts)}; choose a photograph in which it is large, sharp and evenly lit"
        )
    return charts[0]


def _corners(shown: Array) -> list[NDArray[np.float32]]:
    """Corners (4, 2) of the charts in a picture in [0, 1], from that of the first patch on."""
    detector = cv2.mcc.CCheckerDetector.create()
    picture = np.ascontiguousarray(np.rint(shown[..., ::-1] * 255).astype(np.uint8))
    sought: tuple[Any, ...] = (picture, cv2.mcc.MCC24, MOST_CHARTS)
    if hasattr(detector, "setColorChartType"):  # since OpenCV 5
        detector.setColorChartType(cv2.mcc.MCC24)
        sought = (picture, MOST_CHARTS)
    charts = detector.getListColorChecker() if detector.process(*sought) else ()
    return [np.asarray(chart.getBox(), np.float32).reshape(4, 2) for chart in charts]


def _sampled(image: Array, corners: NDArray[np.float32]) -> Array:
    """Mean colours (24, 3) of the middles of the patches between four corners."""
    chart = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], np.float32)
    image_from_chart = cv2.getPerspectiveTransform(chart, corners)
    steps = 0.5 + SAMPLED_SIDE * ((np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE - 0.5)
    x = (np.arange(COLUMNS)[:, None] + steps).ravel()
    y = (np.arange(ROWS)[:, None] + steps).ravel()
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    in_image = cv2.perspectiveTransform(places, image_from_chart).reshape(len(y), len(x), 2)
    u, v = np.moveaxis(in_image.astype(np.float32), 2, 0)
    values = cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR)
    sides = (ROWS, SAMPLES_PER_SIDE, COLUMNS, SAMPLES_PER_SIDE, 3)
    return values.reshape(sides).mean(axis=(1, 3)).reshape(N_PATCHES, 3).astype(np.float64)


def _reference(colour: Any) -> Array:
    """Linear colours (24, 3) of the patches in Rec.709's primaries, adapted to D65."""
    chart = colour.CCS_COLOURCHECKERS[CHART]
    tristimulus = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
    linear: Array = colour.XYZ_to_sRGB(
        tristimulus, illuminant=chart.illuminant, apply_cctf_encoding=False
    )
    return linear


def _fitted(
    colour: Any, patches: Array, truth: Array, used: NDArray[np.bool_], greys: NDArray[np.bool_]
) -> ColorCorrection:
    ratios = (truth[greys] / patches[greys]).mean(axis=0)
    balance = ratios / ratios[1]
    balanced, wanted = (balance * patches)[used], truth[used]
    scale = _scale(balanced, wanted)
    fit = colour.characterisation.matrix_colour_correction_Cheung2004
    matrix = np.asarray(fit(scale * balanced, wanted), np.float64)
    left_out = np.array(
        [
            np.asarray(fit(np.delete(scale * balanced, i, 0), np.delete(wanted, i, 0)))
            @ (scale * balanced[i])
            for i in range(len(wanted))
        ]
    )
    errors = {
        "none": _difference(colour, _scale(patches[used], wanted) * patches[used], wanted),
        "white balance": _difference(colour, scale * balanced, wanted),
        "matrix": _difference(colour, left_out, wanted),
    }
    kind = min(errors, key=errors.__getitem__)
    whole = {"none": np.eye(3), "white balance": np.diag(balance), "matrix": matrix * balance}
    luminance = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ[1]
    grey = patches[greys].mean(axis=0)
    return ColorCorrection(
        matrix=whole[kind] * (luminance @ grey) / (luminance @ (whole[kind] @ grey)),
        kind=kind,
        white_balance=balance,
        n_used=int(used.sum()),
        grey_scatter=_grey_scatter(patches[greys], truth[greys]),
        curve=(),
        error_before=errors["none"],
        error_balanced=errors["white balance"],
        error_after=errors["matrix"],
    )


def _grey_scatter(greys: Array, truth: Array) -> float:
    ratios = greys.mean(axis=1) / truth.mean(axis=1)
    return float(ratios.max() / ratios.min())


def _curve(codes: Array, truth: Array) -> tuple[tuple[float, float], ...]:
    """Rising pairs of code and reflectance of greys, where the codes rise with these."""
    pairs = sorted(zip(truth.mean(axis=1).tolist(), codes.mean(axis=1).tolist(), strict=True))
    rises = all(b[1] > a[1] > 0 for a, b in pairwise(pairs))
    return tuple((round(code, 5), round(grey, 5)) for grey, code in pairs) if rises else ()


def _scale(values: Array, wanted: Array) -> float:
    """Common factor by which values come nearest to others."""
    return float((values * wanted).sum() / np.square(values).sum())


def _difference(colour: Any, first: Array, second: Array) -> float:
    """Mean CIE DE2000 of linear colours."""
    labs = [
        colour.XYZ_to_Lab(colour.sRGB_to_XYZ(np.clip(c, 0, None), apply_cctf_decoding=False))
        for c in (first, second)
    ]
    return float(np.mean(colour.delta_E(*labs, method="CIE 2000")))
