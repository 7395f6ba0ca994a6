"""Whether the lights are as strong as described, by what the surface shows under each.

Divided by a light's intensity, the surface is about as bright under one light as under another.
Where it is more alike without that division, intensities belong to other lights, or are in
another order or unit each.
"""

from __future__ import annotations

import math

import numpy as np

from reflfield.capture.lights import Light
from reflfield.observations.light_agreement import FEWEST_POINTS, Look, as_described, cosines

# Standard deviation of the logarithms of gains above which something may be wrong, and the
# share of it that is left with equal lights if it is. Materials and shadows alone scatter
# gains, but lights that are described rightly scatter less than equal ones; of intensities in
# a random order seven tenths are left on average.
LEAST_SCATTER, SHARE_LEFT = 0.4, 0.8
FEWEST_LIGHTS = 4


def other_intensities(looks: list[Look]) -> str:
    """Words on the intensities of the lights, if equal ones explain the photographs better.

    Parameters
    ----------
    looks : list of Look
        Of photographs under different lights.

    Returns
    -------
    str
        Empty where the intensities fit, are all alike, or nothing tells.
    """
    gains: dict[str, tuple[Light, list[float]]] = {}
    for look in looks:
        gain = _gain(look)
        if gain is not None:
            gains.setdefault(look.light.id, (look.light, []))[1].append(math.log(gain))
    if len(gains) < FEWEST_LIGHTS:
        return ""
    described = np.array([np.mean(of_light) for _, of_light in gains.values()])
    strength = [np.log(float(light.intensity.mean())) for light, _ in gains.values()]
    scatter, of_equal = float(described.std()), float((described + strength).std())
    if scatter < LEAST_SCATTER or of_equal > SHARE_LEFT * scatter:
        return ""
    away = described - np.median(described)
    worst = int(np.argmax(np.abs(away)))
    times = np.exp(np.abs(away[worst]))
    return (
        "lights and photographs do not fit: divided by the intensities described, the surface "
        f"is {np.exp(scatter):.1f} times as bright under one light as under another on "
        f"average, and {np.exp(of_equal):.1f} times if all are taken for equal; check which "
        f"intensity belongs to which light (most off: {list(gains)[worst]!r}, "
        f"{times:.1f} times too {'weak' if away[worst] > 0 else 'strong'})"
    )


def _gain(look: Look) -> float | None:
    """Brightness over cosine; None where nothing tells."""
    cosine = cosines(look, as_described)
    if cosine is None or not look.light.intensity.mean() > 0:
        return None
    lit = np.isfinite(look.brightness) & (cosine > 0)
    if lit.sum() < FEWEST_POINTS:
        return None
    gain = float(look.brightness[lit] @ cosine[lit] / (cosine[lit] @ cosine[lit]))
    return gain if gain > 0 else None
