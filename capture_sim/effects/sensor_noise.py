r"""Photon and read noise of a linear sensor.

Radiance :math:`L` gives :math:`e = g L` expected electrons; the photograph
holds :math:`(\mathrm{Poisson}(e) + \mathcal N(0, \sigma_r^2)) / g`. Values may
become negative, as in real dark-subtracted photographs. Each photograph draws
from its own generator, so the result does not depend on the order of work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Decision, Photograph, Stage, Workload
from capture_sim.model import Scene
from capture_sim.tables import bounded

NAME = "sensor_noise"
STAGE = Stage.SENSOR

# Values farther out than this many standard deviations do not count in the bound.
SIGMAS = 5.0


@dataclass(frozen=True)
class Options:
    """Noise of the sensor.

    Attributes
    ----------
    electrons_per_radiance : float
        Expected electrons for radiance 1.
    read_noise : float
        Standard deviation in electrons.
    """

    electrons_per_radiance: float = bounded(1e4, low=1e-12)
    read_noise: float = bounded(5.0, low=0.0)


def needed(scene: Scene) -> Decision:
    """Bound the noise of the brightest value, five standard deviations."""
    options = scene.effects.declared(Options)
    if options is None:
        return Decision("a perfect sensor: no [effects.sensor_noise]", 0.0)
    typical = scene.brightness.percentile99
    brightest = standard_deviation(options, typical * scene.brightness.headroom)
    gain, read = options.electrons_per_radiance, options.read_noise
    return Decision(
        f"{gain:g} electrons per unit of radiance, read noise {read:g} electrons",
        SIGMAS * brightest / typical,
    )


def cost(scene: Scene, work: Workload) -> Cost:
    """Two random numbers for each channel of each pixel."""
    del scene
    return Cost(operations=2 * work.n_values)


def standard_deviation(options: Options, radiance: float) -> float:
    """Standard deviation of a value of this expected radiance.

    Parameters
    ----------
    options : Options
    radiance : float
        Not negative.

    Returns
    -------
    float
        In units of radiance.

    Examples
    --------
    >>> standard_deviation(Options(electrons_per_radiance=1e4, read_noise=0.0), 1.0)
    0.01
    """
    gain = options.electrons_per_radiance
    return float(np.sqrt(radiance * gain + options.read_noise**2) / gain)


def apply(
    values: NDArray[np.float32], scene: Scene, photograph: Photograph
) -> NDArray[np.float32]:
    """Photograph a noise-free image with a real sensor.

    References
    ----------
    EMVA Standard 1288, "Standard for characterization of image sensors and
    cameras", release 4.0, 2021: shot noise is Poisson, dark noise normal.
    """
    return with_noise(values, scene.effects.get(Options), photograph.rng(scene, NAME))


def with_noise(
    values: NDArray[np.float32], options: Options, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Draw photons and the noise of reading.

    Parameters
    ----------
    values : (...) float32
        Linear, not negative.
    options : Options
    rng : numpy.random.Generator

    Returns
    -------
    (...) float32

    Examples
    --------
    >>> options = Options(electrons_per_radiance=1e4, read_noise=0.0)
    >>> noisy = with_noise(np.ones((99, 99), np.float32), options, np.random.default_rng(1))
    >>> bool(abs(noisy.std() - 0.01) < 1e-3)  # 1 / sqrt(1e4)
    True
    """
    electrons = rng.poisson(values.astype(np.float64) * options.electrons_per_radiance)
    read = rng.normal(0.0, options.read_noise, values.shape)
    return ((electrons + read) / options.electrons_per_radiance).astype(np.float32)
