"""The usual sections of a report, from plain arrays and counts.

Every builder returns a `Section`; the pipeline composes them in its order and
leaves out those whose input a run does not have.
"""

from reflfield.report.sections.alignment_gain import FieldVariant, ablation_section
from reflfield.report.sections.base_surface import (
    SilhouetteView,
    atlas_section,
    coverage_section,
    normals_section,
    silhouettes_section,
)
from reflfield.report.sections.baseline_images import (
    AnalysedImage,
    AnalysedImages,
    analysis_lines,
    analysis_sections,
)
from reflfield.report.sections.candidate_runs import (
    CandidateRun,
    candidate_runs_section,
    rules_section,
)
from reflfield.report.sections.held_out_images import (
    alignment_section,
    comparisons_table,
    held_out_section,
    measured_lines,
    metrics_table,
)
from reflfield.report.sections.run_summary import (
    StageSummary,
    compression_section,
    key_numbers,
    run_section,
    stages_section,
)
from reflfield.report.sections.sample_counts import CountedItems, bookkeeping_section
from reflfield.report.sections.size_and_quality import (
    RatePoint,
    rate_distortion_section,
)
from reflfield.report.sections.surface_views import SurfaceView, surface_section
from reflfield.report.sections.truth_scores import truth_section

__all__ = [
    "AnalysedImage",
    "AnalysedImages",
    "CandidateRun",
    "CountedItems",
    "FieldVariant",
    "RatePoint",
    "SilhouetteView",
    "StageSummary",
    "SurfaceView",
    "ablation_section",
    "alignment_section",
    "analysis_lines",
    "analysis_sections",
    "atlas_section",
    "bookkeeping_section",
    "candidate_runs_section",
    "comparisons_table",
    "compression_section",
    "coverage_section",
    "held_out_section",
    "key_numbers",
    "measured_lines",
    "metrics_table",
    "normals_section",
    "rate_distortion_section",
    "rules_section",
    "run_section",
    "silhouettes_section",
    "stages_section",
    "surface_section",
    "truth_section",
]
