"""What a field holds, for people: options, counts, sizes, ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reflfield.field.file import StoredArrays, schema_of
from reflfield.field.reflectance_field import ReflectanceField


@dataclass(frozen=True)
class FieldDescription:
    """What a field holds, for people.

    Parameters
    ----------
    options : dict
        Domain, visibility, light model.
    counts : dict of str to int
        Vertices, faces, texels, clusters, components, grid sides, texture size.
    memory_bytes, stored_bytes : dict of str to int
        Size of each array in memory and, for a field opened from a file, in
        the file.
    ranges : dict of str to (float, float)
        Smallest and largest decoded value of each part.
    metadata : dict
        As in the field.
    """

    options: dict[str, str]
    counts: dict[str, int]
    memory_bytes: dict[str, int]
    stored_bytes: dict[str, int]
    ranges: dict[str, tuple[float, float]]
    metadata: dict[str, Any]

    def lines(self) -> list[str]:
        """Return the description as lines of text."""
        said = [f"{name}: {value}" for name, value in self.options.items()]
        said += [f"{name}: {value:,}" for name, value in self.counts.items()]
        said += [f"{n}: {low:.4g} to {high:.4g}" for n, (low, high) in self.ranges.items()]
        said += [self._size_line(name) for name in self.memory_bytes]
        said.append(f"total: {_total(self.memory_bytes, self.stored_bytes)}")
        said += [f"metadata.{name}: {value}" for name, value in self.metadata.items()]
        return said

    def _size_line(self, name: str) -> str:
        parts = (
            {name: d[name]} if name in d else {} for d in (self.memory_bytes, self.stored_bytes)
        )
        return f"{name}: {_total(*parts)}"


def describe(reflectance_field: ReflectanceField) -> FieldDescription:
    """Counts, sizes, ranges and options of a field.

    Parameters
    ----------
    reflectance_field : ReflectanceField
        Built or opened. All of its arrays are read, so a damaged file shows.

    Returns
    -------
    FieldDescription

    Raises
    ------
    FieldFileError
        If an array of the file is damaged.
    """
    f = reflectance_field
    stored = f.arrays.stored_bytes if isinstance(f.arrays, StoredArrays) else {}
    height, width = f.texel_of_pixel.shape
    parts: dict[str, NDArray[np.floating]] = {
        "positions": f.positions,
        **f.parts,
        "indirect_functions": f.indirect.functions,
    }
    return FieldDescription(
        options={
            "model": f.model,
            "domain": f.domain,
            "visibility": f.visibility,
            "light_model": f.light_model,
            "bounced_light": "traced" if f.indirect.is_traced else "not traced",
        },
        counts={
            "vertices": len(f.positions),
            "faces": len(f.faces),
            "texels": f.n_texels,
            "texture_height": height,
            "texture_width": width,
            **f.counts,
            "indirect_components": f.indirect.coefficients.shape[1],
        },
        memory_bytes={name: f.arrays[name].nbytes for name in schema_of(f)},
        stored_bytes=stored,
        ranges={n: (float(a.min()), float(a.max())) for n, a in parts.items() if a.size},
        metadata=dict(f.metadata),
    )


def _total(memory: Mapping[str, int], stored: Mapping[str, int]) -> str:
    text = f"{sum(memory.values()):,} bytes"
    return text + (f", {sum(stored.values()):,} in the file" if stored else "")
