"""Dome photographs to relightable objects: 6D reflectance fields.

A capture (photographs with calibrated cameras and known lights) becomes a field: a small file
from which the object is rendered from any side under any light.

>>> import numpy as np
>>> import reflfield as rf
>>> capture = rf.open_capture("capture")  # doctest: +SKIP
>>> result = rf.reconstruct(  # doctest: +SKIP
...     capture, "out", hold_out=rf.HoldOut(views=1, lights=1)
... )
>>> result.metrics["mean"]["psnr_ldr"]  # doctest: +SKIP
27.2
>>> field = rf.open_field("out/field.rfld")  # doctest: +SKIP

A field is rendered and evaluated; here one of known reflectance, a white square:

>>> field = rf.example_field()
>>> camera = rf.Camera.look_at([0.0, -1.0, 2.0], width=64, height=48)
>>> image = field.render(camera, lights=[rf.PointLight([0.0, 0.0, 2.0], intensity=4.0)])
>>> image.shape, round(float(image.max()), 2)
((48, 64, 3), 0.32)
>>> sky = rf.EnvironmentMap(np.ones((8, 16, 3), np.float32))
>>> image = field.render(camera, environment=sky)
>>> up = np.array([0.0, 0.0, 1.0])
>>> values = field.evaluate([0, 1], up, up)  # apparent BRDF, 1/sr

Samples from elsewhere, a measured BTF for example, are completed (`complete`) and given local
frames (`align`) without a capture.

Names are imported when they are first used. See Müller, Sarlette and Klein, "Data-driven Local
Coordinate Systems for Image-Based Rendering", Eurographics 2006, for the method that this
package implements and extends.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from reflfield.alignment.align_texels import Alignment, align
    from reflfield.alignment.refinement import RefinementOptions
    from reflfield.api.capture_calibration import Calibration, calibrate
    from reflfield.api.captures import describe_capture, open_capture
    from reflfield.api.example import example_field
    from reflfield.api.fields import Field, open_field
    from reflfield.api.images import compare, relight, render_turntable
    from reflfield.api.reconstruction import Result, read_options, reconstruct
    from reflfield.api.tradeoffs import measure_tradeoff, options_within, plan
    from reflfield.capture.cameras import Camera
    from reflfield.capture.capture import Capture
    from reflfield.capture.conversion import convert_btf, convert_capture
    from reflfield.capture.lights import DirectionalLight, Light, PointLight
    from reflfield.errors import (
        CaptureError,
        FieldFileError,
        GeometryError,
        InputError,
        NumericalError,
        ReflfieldError,
        ShapeError,
    )
    from reflfield.factorization.svd_completion import Completion, complete
    from reflfield.field.clustered_pca import CompressionOptions
    from reflfield.field.half_vector import HalfVectorOptions
    from reflfield.field.sample_fit import SampleFitOptions
    from reflfield.geometry.occlusion import VisibilityOptions
    from reflfield.geometry.uv_atlas import AtlasOptions
    from reflfield.geometry.visual_hull import HullOptions
    from reflfield.observations.resampling_options import (
        ResamplingOptions,
    )
    from reflfield.options import HoldOut, Resources
    from reflfield.pipeline.pipeline_options import (
        AlignmentOptions,
        ComparisonOptions,
        CompletionOptions,
        IndirectOptions,
        PipelineOptions,
        TextureOptions,
    )
    from reflfield.render.environment_map import EnvironmentMap
    from reflfield.render.renderer import RenderOptions

__version__ = "0.1.0"

# What is promised: names, and their arguments (`tests/data/public_api.txt`).
__all__ = [
    "Alignment",
    "AlignmentOptions",
    "AtlasOptions",
    "Calibration",
    "Camera",
    "Capture",
    "CaptureError",
    "ComparisonOptions",
    "Completion",
    "CompletionOptions",
    "CompressionOptions",
    "DirectionalLight",
    "EnvironmentMap",
    "Field",
    "FieldFileError",
    "GeometryError",
    "HalfVectorOptions",
    "HoldOut",
    "HullOptions",
    "IndirectOptions",
    "InputError",
    "Light",
    "NumericalError",
    "PipelineOptions",
    "PointLight",
    "RefinementOptions",
    "ReflfieldError",
    "RenderOptions",
    "ResamplingOptions",
    "Resources",
    "Result",
    "SampleFitOptions",
    "ShapeError",
    "TextureOptions",
    "VisibilityOptions",
    "align",
    "calibrate",
    "compare",
    "complete",
    "convert_btf",
    "convert_capture",
    "describe_capture",
    "example_field",
    "measure_tradeoff",
    "open_capture",
    "open_field",
    "options_within",
    "plan",
    "read_options",
    "reconstruct",
    "relight",
    "render_turntable",
]

# Module of each name; type checkers see the imports above.
_MODULES = {
    "reflfield.capture.conversion": ("convert_btf", "convert_capture"),
    "reflfield.alignment.align_texels": ("Alignment", "align"),
    "reflfield.alignment.refinement": ("RefinementOptions",),
    "reflfield.api.capture_calibration": ("Calibration", "calibrate"),
    "reflfield.api.captures": ("describe_capture", "open_capture"),
    "reflfield.api.example": ("example_field",),
    "reflfield.api.fields": ("Field", "open_field"),
    "reflfield.api.images": ("compare", "relight", "render_turntable"),
    "reflfield.api.reconstruction": ("Result", "read_options", "reconstruct"),
    "reflfield.api.tradeoffs": ("measure_tradeoff", "options_within", "plan"),
    "reflfield.capture.cameras": ("Camera",),
    "reflfield.capture.capture": ("Capture",),
    "reflfield.capture.lights": ("DirectionalLight", "Light", "PointLight"),
    "reflfield.errors": (
        *("CaptureError", "FieldFileError", "GeometryError"),
        *("InputError", "NumericalError", "ReflfieldError", "ShapeError"),
    ),
    "reflfield.factorization.svd_completion": ("Completion", "complete"),
    "reflfield.options": ("HoldOut", "Resources"),
    "reflfield.pipeline.pipeline_options": (
        *("AlignmentOptions", "AtlasOptions", "ComparisonOptions", "CompletionOptions"),
        *("CompressionOptions", "HullOptions", "IndirectOptions", "PipelineOptions"),
        *("ResamplingOptions", "TextureOptions", "VisibilityOptions"),
    ),
    "reflfield.field.half_vector": ("HalfVectorOptions",),
    "reflfield.field.sample_fit": ("SampleFitOptions",),
    "reflfield.render.environment_map": ("EnvironmentMap",),
    "reflfield.render.renderer": ("RenderOptions",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> _Any:
    """Import a public name when it is first used, so that importing the package is quick."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
