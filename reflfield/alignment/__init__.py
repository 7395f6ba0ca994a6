"""Local frames from reflectance: correlation over SO(3), EM, materials, refinement."""

from reflfield.alignment.align_texels import Alignment, align
from reflfield.alignment.refinement import RefinementOptions
from reflfield.alignment.rotation_search import SearchResult, search
from reflfield.alignment.sample_sources import SampleSet, SampleSource, ScatteredSource

__all__ = [
    "Alignment",
    "RefinementOptions",
    "SampleSet",
    "SampleSource",
    "ScatteredSource",
    "SearchResult",
    "align",
    "search",
]
