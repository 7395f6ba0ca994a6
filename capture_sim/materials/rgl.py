"""Measured materials of the RGL database (RGB tensor files)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture_sim.errors import scene_error
from capture_sim.materials.base import Array, Material, half_vectors
from capture_sim.materials.tensor_file import read_tensor_file
from capture_sim.materials.warp import BilinearTable, Slices, Warp

RANKS = {"phi_i": 1, "theta_i": 1, "jacobian": 1, "sigma": 2, "ndf": 2, "vndf": 4, "rgb": 5}
ONE_SLICE = [np.zeros(1)]


@dataclass(frozen=True, eq=False)
class MeasuredRGL(Material):
    r"""Measured BRDF of the RGL database.

    The value, cosine of the light included, is
    :math:`\frac{D(h)}{4\,\sigma(v)}\,M(u)`, where the table :math:`M` is stored
    on the unit square that importance sampling of visible normals maps to half
    vectors; `u` is found by inverting that warp. Isotropic files have one azimuth;
    others may hold a half or a quarter of the azimuths and be completed by symmetry.

    Parameters
    ----------
    description : str
        The file's own words.
    phi, theta : (n,) float64
        Azimuths and inclinations of the measured directions, radians.
    density, projected_area : BilinearTable
        Microfacet density D and projected area sigma.
    visible : Warp
        Density of visible normals per measured direction.
    rgb : tuple of three BilinearTable
        The table M per channel.
    jacobian : bool
        True where values must be scaled by D / (4 sigma); False in files that
        store values as they are.

    References
    ----------
    J. Dupuy and W. Jakob, "An adaptive parameterization for efficient material
    acquisition and rendering", ACM TOG 37(6), 2018.
    """

    description: str
    phi: Array
    theta: Array
    density: BilinearTable
    projected_area: BilinearTable
    visible: Warp
    rgb: tuple[BilinearTable, BilinearTable, BilinearTable]
    jacobian: bool

    @property
    def isotropic(self) -> bool:
        """True if the material looks the same turned about its normal."""
        return len(self.phi) <= 2

    def lobe(self, uv: Array) -> Array:
        """Roughness whose GGX density has the measured height at the normal.

        Isotropic, and at least a hundredth: the peaks of the tables are one cell wide.
        """
        peak = float(self.density.values[0, :, 0].max())
        return np.full((len(uv), 2), np.clip((np.pi * peak) ** -0.5, 0.01, 1.0))

    def _reflect(self, views: Array, lights: Array, uv: Array) -> Array:
        views, lights = self._first_sector(views, lights)
        halves, _ = half_vectors(views, lights)
        theta_view, phi_view = _spherical(views)
        theta_half, phi_half = _spherical(halves)
        turned = phi_half - phi_view if self.isotropic else phi_half
        at_view, at_half = _square(theta_view, phi_view), _square(theta_half, turned)
        at_half[:, 1] -= np.floor(at_half[:, 1])
        slices = Slices.between([self.phi, self.theta], [phi_view, theta_view])
        samples = self.visible.invert(at_half, slices)
        values = np.stack([table.evaluate(samples, slices) for table in self.rgb], axis=1)
        if self.jacobian:
            values *= self._scale(at_view, at_half)[:, None]
        # The table holds the cosine of the light, which `evaluate` leaves out.
        return np.maximum(values, 0.0) / lights[:, 2:]

    def _scale(self, at_view: Array, at_half: Array) -> Array:
        """``D(h) / (4 sigma(v))``, (n,)."""
        only = Slices.between(ONE_SLICE, [np.zeros(len(at_view))])
        area = self.projected_area.evaluate(at_view, only)
        return self.density.evaluate(at_half, only) / (4.0 * np.maximum(area, 1e-12))

    def _first_sector(self, views: Array, lights: Array) -> tuple[Array, Array]:
        """Directions mirrored into the azimuths that were measured."""
        if self.isotropic:
            return views, lights
        n_sectors = sector_count(self.phi)
        if n_sectors == 1:
            return views, lights
        flip_y = np.where(views[:, 1] < 0.0, 1.0, -1.0)
        flip_x = np.where(views[:, 0] < 0.0, 1.0, -1.0) if n_sectors == 4 else flip_y
        signs = np.stack([flip_x, flip_y, np.ones_like(flip_x)], axis=1)
        return views * signs, lights * signs


def sector_count(phi: Array) -> int:
    """How often the measured azimuths must be repeated to go round: 1, 2 or 4.

    Examples
    --------
    >>> sector_count(np.linspace(-np.pi, 0.0, 8))
    2
    """
    return round(2.0 * np.pi / float(phi[-1] - phi[0]))


@lru_cache(maxsize=16)
def read_rgl(path: Path) -> MeasuredRGL:
    """Read a measured material.

    Parameters
    ----------
    path : Path
        RGB tensor file (``*_rgb.bsdf``).

    Returns
    -------
    MeasuredRGL

    Raises
    ------
    SceneError
        If the file is damaged, spectral, or its tables do not fit together.
    """
    fields = read_tensor_file(path)
    missing = [name for name in RANKS if name not in fields]
    if missing:
        raise scene_error(str(path), "an RGB material", f"no {missing}", "use *_rgb.bsdf")
    _check_tables(path, fields)
    tables = {name: fields[name].astype(np.float64) for name in RANKS}
    n_slices = len(tables["phi_i"]) * len(tables["theta_i"])
    red, green, blue = (
        BilinearTable(tables["rgb"][:, :, channel].reshape(n_slices, *tables["rgb"].shape[3:]))
        for channel in range(3)
    )
    return MeasuredRGL(
        description=_text(fields.get("description")),
        phi=tables["phi_i"],
        theta=tables["theta_i"],
        density=BilinearTable(tables["ndf"][None]),
        projected_area=BilinearTable(tables["sigma"][None]),
        visible=Warp.of(tables["vndf"].reshape(n_slices, *tables["vndf"].shape[2:])),
        rgb=(red, green, blue),
        jacobian=bool(fields["jacobian"].ravel()[0]),
    )


def _check_tables(path: Path, fields: dict[str, NDArray[Any]]) -> None:
    """Demand tables whose shapes belong together and whose values can be a BRDF."""
    for name, rank in RANKS.items():
        _check_shape(path, fields, name, rank)
        if not np.isfinite(fields[name]).all():
            raise scene_error(f"{path}: field {name!r}", "finite values", "NaN or infinity")
    for name in ("phi_i", "theta_i"):
        if (np.diff(fields[name]) <= 0.0).any():
            raise scene_error(f"{path}: field {name!r}", "increasing angles", "others")
    if (fields["vndf"] < 0.0).any() or (fields["vndf"].sum(axis=(2, 3)) <= 0.0).any():
        raise scene_error(f"{path}: field 'vndf'", "a density", "negative values or none")
    phi = fields["phi_i"]
    if len(phi) > 2 and sector_count(phi) not in (1, 2, 4):
        raise scene_error(f"{path}: field 'phi_i'", "1, 1/2 or 1/4 of the circle", phi)


def _check_shape(path: Path, fields: dict[str, NDArray[Any]], name: str, rank: int) -> None:
    shape, measured = fields[name].shape, (fields["phi_i"].size, fields["theta_i"].size)
    fits = len(shape) == rank and all(shape)
    if fits and rank >= 2:
        fits = min(shape[-2:]) >= 2  # bilinear cells need two nodes
    if fits and rank >= 4:
        fits = shape[:2] == measured
    if fits and rank == 5:
        fits = shape[2] == 3
    if not fits:
        raise scene_error(f"{path}: field {name!r}", "a shape like its fellows", shape)


def _text(field: NDArray[Any] | None) -> str:
    return "" if field is None else field.tobytes().decode("utf-8", errors="replace")


def _spherical(directions: Array) -> tuple[Array, Array]:
    """Inclination, accurate at the pole too, and azimuth, each (n,)."""
    sine = np.hypot(directions[:, 0], directions[:, 1])
    return (
        np.arctan2(sine, directions[:, 2]),
        np.arctan2(directions[:, 1], directions[:, 0]),
    )


def _square(theta: Array, phi: Array) -> Array:
    """Place on the unit square: sqrt(2 theta / pi) and (phi + pi) / (2 pi)."""
    return np.stack([np.sqrt(theta * (2.0 / np.pi)), (phi + np.pi) / (2.0 * np.pi)], axis=1)
