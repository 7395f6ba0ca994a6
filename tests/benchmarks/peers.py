"""Correlators that install by pip, driven as well as their interfaces allow.

Each class evaluates correlations of real functions on its own grid over SO(3) and says which
rotations that grid has, so that its values can be checked.
"""

from __future__ import annotations

import importlib.util

import numpy as np

from reflfield.reproduction.paper_forms import both_signs, complex_coefficients, rotations_zyz


def missing(name):
    """Reason why a peer cannot take part, or None."""
    if importlib.util.find_spec(name) is not None:
        return None
    hint = "; a source distribution that needs gfortran and FFTW" if name == "pysofft" else ""
    return f"{name} is not installed (pip install {name}{hint})"


class S2fft:
    """s2fft: precomputed kernel, compiled by JAX, batched by vmap; double precision only.

    M. A. Price, J. D. McEwen, "Differentiable and accelerated spherical harmonic and Wigner
    transforms", Journal of Computational Physics 2024. Its grid (McEwen and Wiaux) has
    L (2L-1)^2 rotations, less than half of the paper's.
    """

    def __init__(self, band_limit):
        import jax
        from s2fft.precompute_transforms import construct, wigner
        from s2fft.sampling import s2_samples

        jax.config.update("jax_enable_x64", True)
        self.jax, self.band_limit = jax, band_limit
        self.kernel = construct.wigner_kernel_jax(band_limit, band_limit, reality=True)
        scale = 8 * np.pi**2 / (2 * np.arange(band_limit) + 1)

        def one(a, b):
            # [n, ell, m]: a is (ell, m), b is (ell, n).
            flmn = (scale[:, None] * a)[None] * b.T[:, :, None].conj()
            options = (band_limit, band_limit, "mw", True, None)
            return wigner.inverse_transform_jax(flmn, self.kernel, *options).ravel()

        self.one = one
        self.pairs = jax.jit(jax.vmap(one))
        beta = s2_samples.thetas(band_limit, "mw")
        alpha = 2 * np.pi * np.arange(2 * band_limit - 1) / (2 * band_limit - 1)
        c, b, a = np.meshgrid(alpha, beta, alpha, indexing="ij")
        self.rotations = rotations_zyz(a, b, c)

    def coefficients(self, real):
        """The library's form of real functions (..., L^2): complex, [ell, m]."""
        return both_signs(complex_coefficients(np.asarray(real, np.float64)))

    def correlations(self, a, b):
        """(n, rotations) of pairs of functions in the library's form."""
        return np.asarray(self.pairs(a, b).block_until_ready())

    def maxima(self, target, batch):
        """Function from factors (n, K, ell, m) of both directions to the highest rotation.

        All of Eq. 11 is compiled as one: 2 K^2 transforms, products, sum, argmax.
        """
        jax = self.jax
        b_view, b_light = target
        of_factors = jax.vmap(jax.vmap(self.one, (None, 0)), (0, None))

        def highest(view, light):
            product = of_factors(view, b_view) * of_factors(light, b_light)
            return product.sum((0, 1)).argmax()

        compiled = jax.jit(jax.vmap(highest))

        def run(factors):
            view, light = factors
            parts = [
                compiled(view[k : k + batch], light[k : k + batch])
                for k in range(0, len(view), batch)
            ]
            return np.concatenate([np.asarray(part) for part in parts])

        return run


class Pysofft:
    """pysofft: a Fortran rewrite of SOFT, Wigner-d precomputed, FFTW plans measured.

    T. Berberich, https://pypi.org/project/pysofft. Its grid is the paper's, (2L)^3.
    """

    def __init__(self, band_limit, n_threads=1):
        from pysofft import Soft, omp

        # Threads are the process's: one peer with them and one without stand side by side.
        omp.set_num_threads(max(n_threads, omp.get_max_threads()))
        self.parallel = n_threads > 1
        self.band_limit = band_limit
        self.soft = Soft(band_limit, precompute_wigners=True, init_ffts=True)
        self.cube = self.soft.get_so3func(real=True)
        angles = self.soft.euler_angles
        axes = angles["gamma"], angles["alpha"], angles["beta"]
        c, a, b = np.meshgrid(*axes, indexing="ij")
        # Its cross-correlation turns the other way round than ours.
        self.rotations = rotations_zyz(-a, -b, -c)

    def coefficients(self, real):
        """The library's form of real functions (..., L^2): complex, m >= 0, m slowest."""
        half = complex_coefficients(np.asarray(real, np.float64))
        order = [(ell, m) for m in range(self.band_limit) for ell in range(m, self.band_limit)]
        ell, m = np.array(order).T
        return np.ascontiguousarray(half[..., ell, m])

    def correlation(self, a, b):
        """The cube of one pair; the same memory each time."""
        return self.soft.cross_correlation_ylm_real(a, b, self.cube, self.parallel)

    def correlations(self, a, b):
        """(n, rotations) of pairs of functions in the library's form."""
        pairs = zip(a, b, strict=True)
        return np.stack([self.correlation(*pair).flatten() for pair in pairs])

    def maxima(self, target):
        """Function from factors (n, K, ...) of both directions to the highest rotation.

        The library transforms one pair at a time (its batches do not correlate), so the
        loop over the 2 K^2 pairs is Python's; a call costs microseconds.
        """
        b_view, b_light = target
        product, total = np.zeros_like(self.cube), np.zeros_like(self.cube)

        def highest(view, light):
            total[...] = 0.0
            for a1, a2 in zip(view, light, strict=True):
                for b1, b2 in zip(b_view, b_light, strict=True):
                    product[...] = self.correlation(a1, b1)
                    np.multiply(product, self.correlation(a2, b2), out=product)
                    np.add(total, product, out=total)
            return total.argmax()

        return lambda factors: np.array([highest(*pair) for pair in zip(*factors, strict=True)])
