"""Options of the whole pipeline: one frozen dataclass for each stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from reflfield.errors import InputError
from reflfield.field.clustered_pca import CLUSTERED, HALF_VECTOR, CompressionOptions
from reflfield.geometry.occlusion import VisibilityOptions
from reflfield.geometry.uv_atlas import LARGEST_TEXTURE, AtlasOptions
from reflfield.geometry.visual_hull import HullOptions
from reflfield.observations.resampling_options import (
    ResamplingOptions,
)
from reflfield.render.renderer import RenderOptions
from reflfield.util.validation import check_ranges

# Side of the smallest texture that is chosen, texels.
SMALLEST_TEXTURE = 64
_ALIGNMENT_RANGES = {
    "band_limit": (1, 64),
    "iterations": (1, 1000),
    "n_clusters": (1, 65_536),
    "least_margin": (0, 2),
}


@dataclass(frozen=True)
class TextureOptions:
    """Density of the texels.

    Parameters
    ----------
    texels_per_pixel : float
        Texels along a pixel's footprint on the surface, where `atlas.resolution` is 0.
    largest : int
        Largest side of a texture chosen so.
    """

    texels_per_pixel: float = 1.6
    largest: int = 512

    def __post_init__(self) -> None:
        largest = (SMALLEST_TEXTURE, LARGEST_TEXTURE)
        check_ranges(self, {"texels_per_pixel": (1e-3, 1e3), "largest": largest})


@dataclass(frozen=True)
class CompletionOptions:
    """How missing samples are filled before alignment.

    Parameters
    ----------
    rank : int
        Of the matrix of resampled texels.
    passes : int
        Over the training texels.
    method : {"map", "brand"}
        Block recursive least squares with a Gaussian prior, or Brand's online SVD with
        imputation as in the paper.
    training_texels : int
        Texels, drawn at random, that shape the basis; all are completed in it.
    """

    rank: int = 12
    passes: int = 4
    method: Literal["map", "brand"] = "map"
    training_texels: int = 8192

    def __post_init__(self) -> None:
        for name, most in (("rank", 1024), ("passes", 1000), ("training_texels", 1 << 24)):
            if not 1 <= getattr(self, name) <= most:
                raise InputError(
                    f"{name}: expected at least 1 and at most {most}, "
                    f"received {getattr(self, name)}"
                )
        if self.method not in ("map", "brand"):
            raise InputError(f"method: expected 'map' or 'brand', received {self.method!r}")


@dataclass(frozen=True)
class AlignmentOptions:
    """How local frames are found.

    Parameters
    ----------
    enabled : bool
        False keeps the base frames: what the paper compares with.
    band_limit : int
        Degrees below it are correlated; lowered to what the grids support.
    iterations : int
        Rounds of expectation maximisation.
    n_clusters : int
        Materials told apart, on the raw samples; by the orientation-invariant distance of the
        completed ones alone where `refine` is False, which on sparse captures costs more than
        one target for all.
    refine : bool
        Refine the frames on the raw samples after the harmonic search on completed ones.
    spread_deg : float
        Standard deviation about each axis that the harmonic frames are taken to have: how
        far the raw samples may move them.
    max_tilt_deg : float
        Largest tilt of a normal from the base surface's.
    least_margin : float
        Texels whose rotation is less determined than this keep their base frame: 0 to 2, a
        difference of correlations.
    """

    enabled: bool = True
    band_limit: int = 8
    iterations: int = 4
    n_clusters: int = 1
    refine: bool = True
    spread_deg: float = 1.0
    max_tilt_deg: float = 45.0
    least_margin: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(self, _ALIGNMENT_RANGES)
        if not 0 < self.max_tilt_deg <= 180:
            raise InputError(f"max_tilt_deg: expected (0, 180], received {self.max_tilt_deg}")
        if not 0 < self.spread_deg <= 180:
            raise InputError(f"spread_deg: expected (0, 180], received {self.spread_deg}")


@dataclass(frozen=True)
class IndirectOptions:
    """What texels show in traced shadows, where the object shines into itself.

    Parameters
    ----------
    n_components : int
        Functions of the light's direction beside their mean.
    enabled : bool
        False leaves traced shadows black.
    training_texels : int
        Texels, drawn at random, that shape the functions; all get coefficients.
    bounce : bool
        Trace what lit parts of the surface send into its shadows, where the photographs show
        such light; the functions hold what it leaves.
    """

    n_components: int = 8
    enabled: bool = True
    training_texels: int = 4096
    bounce: bool = True

    def __post_init__(self) -> None:
        check_ranges(self, {"n_components": (0, 1024), "training_texels": (1, 1 << 24)})


@dataclass(frozen=True)
class ComparisonOptions:
    """What the field is compared with, besides photographs.

    Parameters
    ----------
    without_alignment : bool
        Make a second field in the base frames, with as many clusters, components and bits,
        and report the error of both: what alignment brings. Takes as long again as the
        compression.
    rate_distortion : bool
        Quantise the fitted models more and more coarsely, relight the held-out photographs from
        each, and draw quality against size. Always done where a size or quality is asked for.
    """

    without_alignment: bool = False
    rate_distortion: bool = False


@dataclass(frozen=True)
class PipelineOptions:
    """Options of all stages; see each dataclass.

    Parameters
    ----------
    seed : int
        Of every random choice.
    """

    hull: HullOptions = field(default_factory=HullOptions)
    texture: TextureOptions = field(default_factory=TextureOptions)
    atlas: AtlasOptions = field(default_factory=lambda: AtlasOptions(resolution=0))
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    resampling: ResamplingOptions = field(default_factory=ResamplingOptions)
    indirect: IndirectOptions = field(default_factory=IndirectOptions)
    completion: CompletionOptions = field(default_factory=CompletionOptions)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    compression: CompressionOptions = field(default_factory=CompressionOptions)
    relighting: RenderOptions = field(default_factory=RenderOptions)
    comparison: ComparisonOptions = field(default_factory=ComparisonOptions)
    seed: int = 0

    @property
    def aligns(self) -> bool:
        """Whether texels are completed and aligned: what a clustered field is made of."""
        return self.compression.model != HALF_VECTOR

    @property
    def refines_surface(self) -> bool:
        """Whether the hull is moved to the normals that are fitted."""
        return not self.aligns and self.compression.half_vector.moves_surface

    @property
    def wants_clusters(self) -> bool:
        """Whether something is asked for that only clustered fields have."""
        return self.comparison.without_alignment or self.compression.fit != "auto"

    @property
    def compares_without_alignment(self) -> bool:
        """Whether a second field, in the base frames, is made to compare with."""
        return self.comparison.without_alignment and self.alignment.enabled

    @property
    def shows_rate_distortion(self) -> bool:
        """Whether quality is drawn against size."""
        asked = self.compression.size > 0 or self.compression.psnr > 0
        return self.comparison.rate_distortion or asked

    def __post_init__(self) -> None:
        if self.comparison.without_alignment and not self.aligns:
            raise InputError(
                f"comparison.without_alignment: expected compression.model = {CLUSTERED!r}, "
                f"whose frames are aligned, received {self.compression.model!r}"
            )
        if self.seed < 0:
            raise InputError(f"seed: expected 0 or more, received {self.seed}")
