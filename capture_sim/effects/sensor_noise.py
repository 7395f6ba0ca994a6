r"""Photon and read noise of a linear sensor.

Radiance :math:`L` gives :math:`e = g L` expected electrons; the photograph
holds :math:`(\mathrm{Poisson}(e) + \mathcal N(0, \sigma_r^2)) / g`. Values may
become negative, as in real dark-subtracted photographs. Each photograph draws
from its own generator, so the result does not depend on the order of work.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capture_sim.effects import Cost, Workload
from capture_sim.scene import NoiseOptions, Scene

NAME = "sensor noise"


def needed(scene: Scene) -> tuple[bool, str]:
    """Tell whether the scene asks for noise.

    Parameters
    ----------
    scene : Scene
        What is to be simulated.

    Returns
    -------
    simulated : bool
    reason : str
    """
    noise = scene.effects.sensor_noise
    if noise is None:
        return False, "the scene has no [effects.sensor_noise]"
    return True, (
        f"{noise.electrons_per_radiance:g} electrons per unit of radiance, "
        f"read noise {noise.read_noise:g} electrons"
    )


def cost(scene: Scene, work: Workload) -> Cost:
    """Two random numbers for each channel of each pixel."""
    per_light = 6 * work.n_pixels if needed(scene)[0] else 0
    return Cost(operations=per_light * work.n_lights)


def add_noise(
    radiance: NDArray[np.float32], noise: NoiseOptions, seed: tuple[int, int, int]
) -> NDArray[np.float32]:
    """Photograph a noise-free image with a real sensor.

    Parameters
    ----------
    radiance : (h, w, 3) float32
        Linear, not negative.
    noise : NoiseOptions
        Gain and read noise.
    seed : tuple of int
        Seed of the scene, index of the camera, index of the light.

    Returns
    -------
    (h, w, 3) float32

    Examples
    --------
    >>> noise = NoiseOptions(electrons_per_radiance=1e4, read_noise=0.0)
    >>> noisy = add_noise(np.ones((100, 100, 3), np.float32), noise, (1, 0, 0))
    >>> bool(abs(noisy.std() - 0.01) < 1e-3)  # 1 / sqrt(1e4)
    True
    """
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(radiance.astype(np.float64) * noise.electrons_per_radiance)
    read = rng.normal(0.0, noise.read_noise, radiance.shape)
    return ((electrons + read) / noise.electrons_per_radiance).astype(np.float32)
