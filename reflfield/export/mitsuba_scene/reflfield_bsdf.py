"""Reflectance of a half-vector field as a BSDF of Mitsuba 3 (scalar and LLVM, RGB).

Written by ``reflfield export FIELD --to mitsuba``; needs Mitsuba and NumPy alone. Set the
variant, then import this module: it registers the plug-in "reflfield". Its parameters are
"model", the path of the field's arrays, and "blend", the width over which neighbouring texels
blend, 1 for that of a texel, less where a pixel is not much smaller than a texel::

    import mitsuba as mi
    mi.set_variant("llvm_ad_rgb")
    import reflfield_bsdf
    bsdf = mi.load_dict({"type": "reflfield", "model": "model.npz"})

For view v and light l in the frame of a texel, h their half vector, the value is ::

    s(l_z) * (diffuse * B(l_z, v_z, 1 - cos d)
              + V * sum_k weight_k * T_k(h, d) * (1 + K_k(r, d) cos 2a))

with tables B, T and K, multilinear, d the angle between h and l, r that between h and the
normal, a the azimuth between the two planes of these angles, s the cosine rounded at the
horizon, and V = 1 / (l_z + v_z - l_z v_z). The four texels around a point are blended.
Directions are sampled by the cosine, or by half vectors from the tables, as the nearest texel
says.
"""

# Types differ from one variant of Mitsuba to the other.
# mypy: ignore-errors

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

KNEE = float(np.radians(4.0))
REACH = float(np.arcsinh(np.pi / 2 / KNEE))
LEAST_COSINE, HORIZON = 0.05, 0.08
LEAST_SHARE = 0.02  # of each way of sampling


def solid_angle(radius: Any) -> Any:
    """Solid angle of half vectors per area of the tables' square."""
    angle = np.minimum(KNEE * np.sinh(radius * REACH), np.pi / 2)
    ratio = np.where(radius > 1e-6, np.sin(angle) / np.maximum(radius, 1e-6), KNEE * REACH)
    return ratio * KNEE * REACH * np.cosh(radius * REACH)


class ReflectanceFieldBSDF(mi.BSDF):
    """The plug-in."""

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.blend = max(float(props.get("blend", 1.0)), 1e-6)
        with np.load(props["model"], allow_pickle=False) as arrays:
            self._load({name: arrays[name] for name in arrays.files})
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        self.m_components, self.m_flags = [flags], flags

    def _load(self, arrays: dict[str, Any]) -> None:
        self.height, self.width = arrays["texel_of_pixel"].shape
        self.n_lobes, self.layers, self.side = arrays["lobes"].shape[:3]
        self.nodes = arrays["diffuse_table"].shape
        self.texels = _buffer(arrays["texel_of_pixel"] + 0.25)
        self.frames, self.diffuse = _buffer(arrays["frames"]), _buffer(arrays["diffuse"])
        self.weights, self.table = _buffer(arrays["weights"]), _buffer(arrays["diffuse_table"])
        self.lobes, self.skews = _buffer(arrays["lobes"]), _buffer(arrays["skews"])
        self.rings = arrays["skews"].shape[2]
        axis = np.linspace(-1.0, 1.0, self.side)
        radius = np.hypot(axis[:, None], axis)
        angle = np.minimum(KNEE * np.sinh(radius * REACH), np.pi / 2)
        # What half vectors near the table's node contribute, of all difference angles.
        of_angle = np.where(radius <= 1.0, solid_angle(radius) * np.cos(angle), 0.0)
        density = arrays["lobes"].mean(axis=(1, 4)) * of_angle
        cell = (2.0 / (self.side - 1)) ** 2
        self.albedos = [float(one.sum() * cell * 4.0) for one in density]
        floor = 1e-4 * density.max(axis=(1, 2), keepdims=True) * of_angle + 1e-12
        self.directions = [mi.MarginalContinuous2D0(np.float32(one)) for one in density + floor]

    # --- the model ---------------------------------------------------------------------

    def _texel(self, column: Any, row: Any, active: Any) -> Any:
        """Number of the texel of a pixel, below zero where there is none."""
        number = _read(self.texels, mi.UInt32(row * self.width + column), active)
        return mi.Int32(dr.floor(number))

    def _taps(self, uv: Any, active: Any) -> list[tuple[Any, Any]]:
        """The four texels around a point, and their shares."""
        x = dr.clip(uv.x * self.width - 0.5, 0.0, self.width - 1.0)
        y = dr.clip((1.0 - uv.y) * self.height - 0.5, 0.0, self.height - 1.0)
        column = mi.Int32(dr.clip(dr.floor(x), 0.0, max(self.width - 2.0, 0.0)))
        row = mi.Int32(dr.clip(dr.floor(y), 0.0, max(self.height - 2.0, 0.0)))
        fx, fy = (
            dr.clip((place - mi.Float(lower) - 0.5) / self.blend + 0.5, 0.0, 1.0)
            for place, lower in ((x, column), (y, row))
        )
        taps = []
        for i in range(4):
            right, below = min(i & 1, self.width - 1), min(i >> 1, self.height - 1)
            texel = self._texel(column + right, row + below, active)
            share = (fx if i & 1 else 1.0 - fx) * (fy if i >> 1 else 1.0 - fy)
            taps.append((texel, dr.select(texel >= 0, share, 0.0)))
        return taps

    def _frame(self, texel: Any, active: Any) -> list[Any]:
        """Rows tangent, binormal and normal of a texel, in the world."""
        first = mi.UInt32(dr.maximum(texel, 0)) * 9
        read = [_read(self.frames, first + i, active) for i in range(9)]
        return [mi.Vector3f(*read[i : i + 3]) for i in (0, 3, 6)]

    def _interpolated(self, table: Any, places: list[Any], shape: list[int], active: Any,
                      width: int, offset: int) -> list[Any]:  # fmt: skip
        """Multilinear values of a table (..., width), the last axis of `places` fastest."""
        cells, shares = [], []
        for place, n in zip(places, shape, strict=True):
            cell = dr.clip(dr.floor(place), 0.0, n - 2.0)
            cells.append(mi.UInt32(cell))
            shares.append(dr.clip(place - cell, 0.0, 1.0))
        total = [mi.Float(0.0)] * width
        for corner in range(1 << len(places)):
            weight, index = mi.Float(1.0), mi.UInt32(0)
            for i, n in enumerate(shape):
                up = corner >> i & 1
                weight = weight * (shares[i] if up else 1.0 - shares[i])
                index = index * n + cells[i] + up
            for c in range(width):
                at = index * width + (c + offset)
                total[c] = total[c] + weight * _read(table, at, active)
        return total

    def _value(self, texel: Any, view: Any, light: Any, active: Any) -> Any:
        """Sample of a texel for directions in the world."""
        active = active & (texel >= 0)
        frame = self._frame(texel, active)
        v, l = (mi.Vector3f(*(dr.dot(row, d) for row in frame)) for d in (view, light))  # noqa: E741
        h = _half(v, l)
        cos_d = dr.clip(dr.dot(l, h), 0.0, 1.0)
        at = self._square(mi.Vector3f(h.x, h.y, dr.maximum(h.z, 0.0)))
        cos_l = dr.clip(l.z, 0.0, 1.0)
        cos_v = dr.clip(v.z, LEAST_COSINE, 1.0)
        base = self._interpolated(
            self.table,
            [(1.0 - cos_d) * (self.nodes[0] - 1), cos_v * (self.nodes[1] - 1),
             cos_l * (self.nodes[2] - 1)],
            list(self.nodes), active, 1, 0,
        )[0]  # fmt: skip
        scale = 0.5 * (self.side - 1)
        layer = dr.acos(cos_d) * ((self.layers - 1) / (np.pi / 2))
        places = [layer, (at.y + 1.0) * scale, (at.x + 1.0) * scale]
        shape = [self.layers, self.side, self.side]
        ring = dr.sqrt(at.x * at.x + at.y * at.y) * (self.rings - 1)
        # l_z - v_z is 2 sin(r) sin(d) cos(a).
        sines = (h.x * h.x + h.y * h.y) * (1.0 - cos_d * cos_d)
        turn = dr.minimum(dr.square(l.z - v.z) / (2.0 * sines + 1e-12) - 1.0, 1.0)
        raised = dr.maximum(cos_l, LEAST_COSINE)
        spread = dr.rcp(raised + cos_v - raised * cos_v)
        first = mi.UInt32(dr.maximum(texel, 0))
        value = base * mi.Color3f(
            *(_read(self.diffuse, first * 3 + c, active) for c in range(3))
        )
        per_lobe = 3 * self.layers * self.side * self.side
        for k in range(self.n_lobes):
            weight = _read(self.weights, first * self.n_lobes + k, active)
            lobe = self._interpolated(self.lobes, places, shape, active, 3, k * per_lobe)
            skew = self._interpolated(
                self.skews, [layer, ring], [self.layers, self.rings], active, 3,
                k * 3 * self.layers * self.rings,
            )  # fmt: skip
            value += weight * spread * mi.Color3f(*lobe) * (1.0 + turn * mi.Color3f(*skew))
        foot = dr.clip(l.z, -HORIZON, HORIZON) + HORIZON
        cosine = dr.select(l.z >= HORIZON, l.z, foot * foot / (4.0 * HORIZON))
        return dr.select(active, value * cosine, 0.0)

    def _square(self, h: Any) -> Any:
        """Place of a half vector on the tables' square."""
        across = dr.sqrt(h.x * h.x + h.y * h.y)
        angle = dr.atan2(across, h.z)
        radius = dr.asinh(angle / KNEE) / REACH
        scale = radius / dr.maximum(across, 1e-9)
        return mi.Point2f(h.x * scale, h.y * scale)

    # --- sampling ------------------------------------------------------------------------

    def _shares(self, texel: Any, active: Any) -> list[Any]:
        """Probability of each way of sampling: by the cosine, then by each lobe."""
        first = mi.UInt32(dr.maximum(texel, 0))
        parts = [_read(self.diffuse, first * 3 + c, active) for c in range(3)]
        energies = [np.pi / 3.0 * (parts[0] + parts[1] + parts[2])]
        for k, albedo in enumerate(self.albedos):
            weight = _read(self.weights, first * self.n_lobes + k, active)
            energies.append(albedo * weight)
        total = sum(energies[1:], energies[0]) + 1e-9
        raised = [energy / total + LEAST_SHARE for energy in energies]
        return [one / (1.0 + LEAST_SHARE * len(raised)) for one in raised]

    def _nearest(self, taps: list[tuple[Any, Any]]) -> Any:
        texel, most = taps[0]
        for other, share in taps[1:]:
            texel = dr.select(share > most, other, texel)
            most = dr.maximum(share, most)
        return texel

    def _density(self, texel: Any, view: Any, light: Any, active: Any) -> Any:
        """Density of sampling a direction, 1/sr."""
        frame = self._frame(texel, active)
        half = _half(view, light)
        h = mi.Vector3f(*(dr.dot(row, half) for row in frame))
        shares = self._shares(texel, active)
        density = shares[0] * dr.maximum(dr.dot(frame[2], light), 0.0) * dr.inv_pi
        at = self._square(mi.Vector3f(h.x, h.y, dr.maximum(h.z, 0.0)))
        per_area = self._per_area(at)
        cosine = dr.maximum(dr.dot(view, half), 1e-4)
        place = mi.Point2f(0.5 * (at.x + 1.0), 0.5 * (at.y + 1.0))
        for share, directions in zip(shares[1:], self.directions, strict=True):
            lobe = directions.eval(place, active=active) / (4.0 * per_area)
            density += dr.select(h.z > 0.0, share * lobe / (4.0 * cosine), 0.0)
        return density

    def _per_area(self, at: Any) -> Any:
        """Solid angle per area of the square, at a place of it."""
        radius = dr.minimum(dr.sqrt(at.x * at.x + at.y * at.y), 1.0)
        angle = KNEE * dr.sinh(radius * REACH)
        ratio = dr.select(radius > 1e-4, dr.sin(angle) / dr.maximum(radius, 1e-4), KNEE * REACH)
        return ratio * KNEE * REACH * dr.cosh(radius * REACH)

    def _direction(self, texel: Any, view: Any, pick: Any, two: Any, active: Any) -> Any:
        """A direction to the light, in the world."""
        frame = self._frame(texel, active)
        shares = self._shares(texel, active)
        local = mi.warp.square_to_cosine_hemisphere(two)
        light = frame[0] * local.x + frame[1] * local.y + frame[2] * local.z
        before = shares[0]
        for share, directions in zip(shares[1:], self.directions, strict=True):
            place, _ = directions.sample(two, active=active)
            x, y = 2.0 * place.x - 1.0, 2.0 * place.y - 1.0
            radius = dr.sqrt(x * x + y * y)
            angle = dr.minimum(KNEE * dr.sinh(radius * REACH), np.pi / 2)
            scale = dr.sin(angle) / dr.maximum(radius, 1e-9)
            half = frame[0] * (x * scale) + frame[1] * (y * scale) + frame[2] * dr.cos(angle)
            mirrored = 2.0 * dr.dot(view, half) * half - view
            light = dr.select((pick >= before) & (radius <= 1.0), mirrored, light)
            before = before + share
        return dr.normalize(light)

    # --- what Mitsuba calls ----------------------------------------------------------------

    def _both(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """View and light in the world, the taps, and where they are on the outside."""
        view, light = si.to_world(si.wi), si.to_world(wo)
        outside = (dr.dot(si.n, view) > 0.0) & (dr.dot(si.n, light) > 0.0)
        return view, light, self._taps(si.uv, active), active & outside

    def sample(
        self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """Sample a direction."""
        texel = self._nearest(self._taps(si.uv, active))
        active = active & (texel >= 0)
        light = self._direction(texel, si.to_world(si.wi), sample1, sample2, active)
        sampled = mi.BSDFSample3f()
        sampled.wo = si.to_local(light)
        value, density = self.eval_pdf(ctx, si, sampled.wo, active)
        sampled.pdf, sampled.eta = density, 1.0
        sampled.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        sampled.sampled_component = mi.UInt32(0)
        active = active & (density > 0.0)
        return sampled, dr.select(active, value / dr.maximum(density, 1e-12), 0.0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Value, with the cosine."""
        view, light, taps, active = self._both(si, wo, active)
        total, shares = mi.Color3f(0.0), mi.Float(0.0)
        for texel, share in taps:
            total += share * self._value(texel, view, light, active)
            shares += share
        return dr.select(active, total / dr.maximum(shares, 1e-9), 0.0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Density of `sample`."""
        view, light, taps, active = self._both(si, wo, active)
        texel = self._nearest(taps)
        active = active & (texel >= 0)
        return dr.select(active, self._density(texel, view, light, active), 0.0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """Both."""
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def to_string(self) -> str:
        """Name and size."""
        return (
            f"ReflectanceFieldBSDF[{self.width} x {self.height} texels, {self.n_lobes} lobes]"
        )


IS_SCALAR = mi.Float is float


def _half(view: Any, light: Any) -> Any:
    """Half vector; null for opposite directions."""
    both = view + light
    return both * dr.rsqrt(dr.squared_norm(both) + 1e-12)


def _buffer(array: Any) -> Any:
    """Numbers that can be read by index, single precision."""
    flat = np.ascontiguousarray(array, np.float32).reshape(-1)
    return flat if IS_SCALAR else mi.TensorXf(flat).array


def _read(array: Any, index: Any, active: Any) -> Any:
    """Numbers by index; 0 where not active."""
    if IS_SCALAR:
        return float(array[int(index)]) if active else 0.0
    return dr.gather(mi.Float, array, index, active)


mi.register_bsdf("reflfield", ReflectanceFieldBSDF)
