"""Local frames from reflectance: correlation over SO(3), clusters, refinement, normal maps."""

from reflfield.alignment.aligning import Alignment, align
from reflfield.alignment.alignment_samples import SampleSource
from reflfield.alignment.normal_maps import local_map, world_map
from reflfield.alignment.refinement import RefinementOptions
from reflfield.alignment.rotation_search import SearchResult, search

__all__ = [
    "Alignment",
    "RefinementOptions",
    "SampleSource",
    "SearchResult",
    "align",
    "local_map",
    "search",
    "world_map",
]
