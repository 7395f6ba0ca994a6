"""Local frames from reflectance: correlation over SO(3), clusters, refinement, normal maps."""

from reflfield.alignment.aligning import Alignment, SampleSource, align
from reflfield.alignment.searching import SearchResult, search

__all__ = ["Alignment", "SampleSource", "SearchResult", "align", "search"]
