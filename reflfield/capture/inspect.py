"""What a capture holds, at a glance."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reflfield.capture.cameras import ORTHOGRAPHIC
from reflfield.capture.capture import PLANE, Capture
from reflfield.capture.lights import DIRECTIONAL, POINT, SPOT
from reflfield.util.progress import track
from reflfield.util.quoting import printable

Range = tuple[float, float]

DEFAULT_SAMPLE = 12  # photographs read for value ranges


@dataclass(frozen=True)
class CaptureSummary:
    """Counts, sizes, ranges and coverage of a capture.

    Parameters
    ----------
    name, format, base_geometry : str
        As in the capture.
    n_views, n_lights, n_photographs : int
        Counts.
    n_missing_pairs : int
        Pairs of camera and light without a photograph.
    light_kinds : dict of str to int
        Number of lights of each kind.
    image_sizes : dict of (width, height) to int
        Number of cameras of each size.
    n_photographs_read : int
        Size of the sample behind the values below.
    values : (3,) float
        Smallest value, 99th percentile and largest value of the sampled photographs.
    n_negative : int
        Negative values in the sample.
    silhouettes_given : int
        Views that come with a silhouette file.
    silhouettes_else : str
        Where the first view without one has its silhouette from: "alpha", "image" (the whole
        of it) or "photographs"; empty if all views have a file.
    silhouette_coverage : (low, high) float or None
        Share of the image that the object covers, least and most among the sampled views.
    camera_distances, light_distances : (low, high) float or None
        Distances from `object_centre`, metres; None for far ones.
    camera_spread, light_spread : float or None
        Largest angle between a direction on the sphere within the used hemisphere and its
        nearest camera (light): the size of the largest gap, radians.
    object_centre : (3,) float64
        The point nearest to all optical axes.
    details : tuple of str
        How the description was read.
    """

    name: str
    format: str
    base_geometry: str
    n_views: int
    n_lights: int
    n_photographs: int
    n_missing_pairs: int
    light_kinds: dict[str, int]
    image_sizes: dict[tuple[int, int], int]
    n_photographs_read: int
    values: tuple[float, float, float]
    n_negative: int
    silhouettes_given: int
    silhouettes_else: str
    silhouette_coverage: Range | None
    camera_distances: Range | None
    light_distances: Range | None
    camera_spread: float | None
    light_spread: float | None
    object_centre: NDArray[np.float64]
    details: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """The summary as text, one fact a line."""
        sizes = ", ".join(f"{w} x {h} ({n})" for (w, h), n in self.image_sizes.items())
        kinds = ", ".join(f"{n} {kind}" for kind, n in self.light_kinds.items())
        low, high, top = self.values
        return [
            f"capture       {self.name} ({self.format}, base geometry {self.base_geometry})",
            f"views         {self.n_views}{_distance(self.camera_distances)}"
            f"{_gap(self.camera_spread)}",
            f"lights        {kinds}{_distance(self.light_distances)}{_gap(self.light_spread)}",
            f"photographs   {self.n_photographs}, {self.n_missing_pairs} pairs missing",
            f"image sizes   {sizes}",
            f"values        {low:.4g} .. {top:.4g}, 99th percentile {high:.4g}, "
            f"{self.n_negative} negative (in {self.n_photographs_read} photographs)",
            f"silhouettes   {self.silhouettes_given} of {self.n_views} given{_coverage(self)}",
            *(f"read as       {printable(detail)}" for detail in self.details),
        ]


def describe(capture: Capture, *, sample: int = DEFAULT_SAMPLE) -> CaptureSummary:
    """Summarise a capture.

    Parameters
    ----------
    capture : Capture
        Its photographs must exist.
    sample : int
        Photographs and silhouettes read, spread evenly.

    Returns
    -------
    CaptureSummary

    Raises
    ------
    CaptureError
        If a sampled file cannot be used.
    """
    values, n_negative, n_read = _value_ranges(capture, sample)
    centre = object_centre(capture)
    positions = [camera.centre for camera in capture.cameras if camera.kind != ORTHOGRAPHIC]
    near = [light.position for light in capture.lights if light.kind in (POINT, SPOT)]
    far = [light.direction for light in capture.lights if light.kind == DIRECTIONAL]
    views = np.concatenate([c.view_directions(centre[None]) for c in capture.cameras])
    # A flat sample is seen and lit from the camera's side, whatever is up in the image.
    pole = -capture.cameras[0].forward if capture.base_geometry == PLANE else capture.up
    lights = [(p - centre) / max(float(np.linalg.norm(p - centre)), 1e-12) for p in near] + far
    return CaptureSummary(
        name=capture.name,
        format=capture.format,
        base_geometry=capture.base_geometry,
        n_views=capture.n_views,
        n_lights=capture.n_lights,
        n_photographs=len(capture.photographs),
        n_missing_pairs=int((capture.photograph_index < 0).sum()),
        light_kinds=dict(Counter(light.kind for light in capture.lights)),
        image_sizes=dict(Counter((c.width, c.height) for c in capture.cameras)),
        n_photographs_read=n_read,
        values=values,
        n_negative=n_negative,
        silhouettes_given=sum(path is not None for path in capture.silhouettes),
        silhouettes_else=_silhouettes_else(capture),
        silhouette_coverage=_silhouette_coverage(capture, sample),
        camera_distances=_distances(positions, centre),
        light_distances=_distances(near, centre),
        camera_spread=largest_gap(views, pole),
        light_spread=largest_gap(np.reshape(lights, (-1, 3)), pole),
        object_centre=centre,
        details=(*capture.details, *_dark_details(capture), *_gain_details(capture)),
    )


def _dark_details(capture: Capture) -> tuple[str, ...]:
    dark = {p.dark.path for p in capture.photographs if p.dark is not None}
    n = sum(p.dark is not None for p in capture.photographs)
    words = f"{len(dark)} dark frame{'s' * (len(dark) != 1)}, subtracted from {n} photographs"
    return (words,) if dark else ()


def _gain_details(capture: Capture) -> tuple[str, ...]:
    n = sum(p.gain is not None for p in capture.photographs)
    return (f"gains, which {n} photographs are multiplied by",) if n else ()


def object_centre(capture: Capture) -> NDArray[np.float64]:
    r"""The point nearest to the optical axes of all cameras, (3,) float64, world.

    Minimises :math:`\sum_i |(I - f_i f_i^\top)(x - c_i)|^2` over cameras at :math:`c_i`
    looking along :math:`f_i`. Where the axes are parallel the origin breaks the tie.
    """
    system, right = 1e-9 * np.eye(3), np.zeros(3)
    for camera in capture.cameras:
        across = np.eye(3) - np.outer(camera.forward, camera.forward)
        system += across
        right += across @ camera.centre
    return np.asarray(np.linalg.solve(system, right), dtype=np.float64)


def largest_gap(
    directions: NDArray[np.float64], up: NDArray[np.float64], n_probes: int = 2000
) -> float | None:
    """Largest angle from a direction of the used hemisphere to the nearest given one.

    Parameters
    ----------
    directions : (n, 3) float64
        Unit directions.
    up : (3,) float64
        Pole of the hemisphere; the whole sphere counts if a third of them lies below it.
    n_probes : int
        Directions tried on the sphere.

    Returns
    -------
    float or None
        Radians; None for fewer than two directions.

    Examples
    --------
    From the pole alone, and its like, the horizon is a quarter turn away:

    >>> pole = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    >>> bool(abs(largest_gap(pole, pole[0]) - np.pi / 2) < 0.05)
    True
    """
    if len(directions) < 2:
        return None
    index = np.arange(n_probes) + 0.5
    height = 1 - 2 * index / n_probes
    azimuth = np.pi * (1 + 5**0.5) * index  # golden-angle spiral
    radius = np.sqrt(1 - height**2)
    probes = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    if np.mean(directions @ up < -1e-6) < 1 / 3:
        probes = probes[probes @ up > 0]
    nearest = (probes @ directions.T).max(axis=1)
    return float(np.arccos(np.clip(nearest.min(), -1, 1)))


def _value_ranges(capture: Capture, sample: int) -> tuple[tuple[float, float, float], int, int]:
    """(smallest, 99th percentile, largest), negative values, photographs read."""
    chosen = spread_evenly(len(capture.photographs), sample)
    lows, highs, tops, n_negative = [], [], [], 0
    for index in track(chosen, len(chosen), "reading photographs"):
        image = capture.read_photograph(index)
        lows.append(float(image.min()))
        highs.append(float(np.quantile(image, 0.99)))
        tops.append(float(image.max()))
        n_negative += int((image < 0).sum())
    if not chosen:
        return (0.0, 0.0, 0.0), 0, 0
    return (min(lows), float(np.mean(highs)), max(tops)), n_negative, len(chosen)


def _silhouettes_else(capture: Capture) -> str:
    others = [view for view, path in enumerate(capture.silhouettes) if path is None]
    return capture.silhouette_origin(others[0]) if others else ""


def _silhouette_coverage(capture: Capture, sample: int) -> Range | None:
    shown = spread_evenly(capture.n_views, sample)
    chosen = [i for i in shown if capture.silhouettes[i] is not None]
    if not chosen:
        return None
    shares = [float(capture.read_silhouette(view).mean()) for view in chosen]
    return min(shares), max(shares)


def spread_evenly(count: int, sample: int) -> list[int]:
    """At most `sample` of `count` indices, evenly spread."""
    n = min(count, sample)
    return [round(i * (count - 1) / max(n - 1, 1)) for i in range(n)]


def _distances(
    positions: list[NDArray[np.float64]], centre: NDArray[np.float64]
) -> Range | None:
    if not positions:
        return None
    distances = np.linalg.norm(np.array(positions) - centre, axis=1)
    return float(distances.min()), float(distances.max())


def _distance(distances: Range | None) -> str:
    return f", {distances[0]:.4g} .. {distances[1]:.4g} m away" if distances else ""


def _gap(spread: float | None) -> str:
    return f", largest gap {np.degrees(spread):.0f} degrees" if spread is not None else ""


def _coverage(summary: CaptureSummary) -> str:
    origin = {
        "alpha": ", others are the photographs' alpha",
        "image": ", others are the whole image",
        "photographs": ", others made from the photographs",
    }.get(summary.silhouettes_else, "")
    coverage = summary.silhouette_coverage
    if coverage is None:
        return origin
    low, high = (100 * share for share in coverage)
    return f", covering {low:.1f} .. {high:.1f} % of the image{origin}"
