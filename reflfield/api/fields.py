"""A reflectance field, ready to be evaluated, rendered and taken apart."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reflfield.capture.lights import UNKNOWN, Light
from reflfield.errors import InputError
from reflfield.field.description import describe
from reflfield.field.evaluation import evaluate
from reflfield.field.file import MAX_BYTES, write_field
from reflfield.field.file import open_field as open_stored
from reflfield.field.reflectance_field import ClusteredField, ReflectanceField
from reflfield.sphere.hemisphere import HemisphereGrid
from reflfield.util.late_import import LateImport

if TYPE_CHECKING:
    import trimesh

    from reflfield.capture.cameras import Camera
    from reflfield.geometry import textured_mesh
    from reflfield.render import draped_field as draped
    from reflfield.render import renderer
    from reflfield.render.environment_map import EnvironmentMap
    from reflfield.render.renderer import Lighting, Renderer, RenderOptions
else:  # opening and evaluating a field needs neither
    renderer, trimesh = LateImport("reflfield.render.renderer"), LateImport("trimesh")
    textured_mesh = LateImport("reflfield.geometry.textured_mesh")
    draped = LateImport("reflfield.render.draped_field")


class Field:
    """A relightable object: a base mesh whose texels answer to any view and any light.

    Made by `reconstruct` and `open_field`.

    Parameters
    ----------
    stored : ReflectanceField
        The stored arrays and how they are decoded.

    Examples
    --------
    A white square: reflectance 1 / pi, times the cosine of the light.

    >>> import reflfield as rf
    >>> field = rf.example_field()
    >>> field.n_texels
    64
    >>> up = np.array([0.0, 0.0, 1.0])
    >>> field.evaluate([0], up, up).round(2)
    array([[0.32, 0.32, 0.32]], dtype=float32)
    """

    def __init__(self, stored: ReflectanceField) -> None:
        self.stored = stored
        self._renderer: Renderer | None = None

    def __repr__(self) -> str:
        """Model and size."""
        counts = ", ".join(f"{count} {name}" for name, count in self.stored.counts.items())
        return f"Field({self.stored.model}: {self.n_texels} texels, {counts})"

    @property
    def n_texels(self) -> int:
        """Number of texels."""
        return self.stored.n_texels

    @property
    def metadata(self) -> dict[str, Any]:
        """Options, versions and counts of the run that made the field."""
        return self.stored.metadata

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit world direction that is up."""
        return self.stored.up

    @property
    def normals(self) -> NDArray[np.float32]:
        """(n_texels, 3) float32 unit normals of the texels' local frames, world."""
        return self.stored.local_from_world[:, 2]

    @property
    def tangents(self) -> NDArray[np.float32]:
        """(n_texels, 3) float32 unit tangents of the texels' local frames, world."""
        return self.stored.local_from_world[:, 0]

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Base mesh with texture coordinates, a `trimesh.Trimesh`; metres, v up."""
        return trimesh.Trimesh(
            vertices=self.stored.positions,
            faces=self.stored.faces,
            visual=trimesh.visual.TextureVisuals(uv=self.stored.uv),
            process=False,
        )

    def evaluate(
        self, texels: ArrayLike, views_world: ArrayLike, lights_world: ArrayLike
    ) -> NDArray[np.float32]:
        """Return the apparent BRDF of texels for pairs of directions.

        Parameters
        ----------
        texels : (n,) int
            Numbers of texels; -1 gives zero.
        views_world, lights_world : (n, 3) or (3,) float
            Unit vectors to the viewer and to the light, world. One serves all texels.

        Returns
        -------
        (n, 3) float32
            Radiance divided by the irradiance of a surface that faces the light, 1/sr: the
            BRDF times the light's cosine.

        Raises
        ------
        ShapeError
            If the shapes differ.
        InputError
            If a texel does not exist, or a direction is no unit vector.
        """
        index = np.asarray(texels)
        views, lights = (
            np.broadcast_to(v, (*index.shape, 3)) if np.ndim(v) == 1 and np.size(v) == 3 else v
            for v in (views_world, lights_world)
        )
        return evaluate(self.stored, index, views, lights)

    def render(
        self,
        camera: Camera,
        lights: Lighting | None = None,
        *,
        environment: EnvironmentMap | None = None,
        options: RenderOptions | None = None,
        alpha: bool = False,
    ) -> NDArray[np.float32]:
        """Render an image of the object alone, over black.

        Parameters
        ----------
        camera : Camera
            See `Camera.look_at`.
        lights : Light or sequence of Light, optional
            What they give adds up. A field of unknown lighting shows that lighting, whatever
            is asked for.
        environment : EnvironmentMap, optional
            Adds to the lights.
        options : RenderOptions, optional
        alpha : bool
            Add a fourth channel: the share of each pixel that the object covers.

        Returns
        -------
        (height, width, 3) float32, or 4 with `alpha`
            Linear radiance times coverage.

        Raises
        ------
        InputError
            If there is neither a light nor a map, or a light of unknown direction.
        """
        sources = self._sources(lights, environment)
        wanted = options or renderer.RenderOptions()
        if self._renderer is None or self._renderer.options != wanted:
            self._renderer = renderer.Renderer(self.stored, wanted)
        rendering = self._renderer.render(camera, sources)
        if alpha:
            return np.concatenate([rendering.image, rendering.coverage[..., None]], axis=2)
        return rendering.image

    def _sources(
        self, lights: Lighting | None, environment: EnvironmentMap | None
    ) -> list[Light | EnvironmentMap]:
        if self.stored.light_model == "unknown":
            return [Light("of the field", UNKNOWN)]
        sources: list[Light | EnvironmentMap] = []
        if lights is not None:
            sources += lights if isinstance(lights, list | tuple) else [lights]  # type: ignore[list-item]
        if environment is not None:
            sources.append(environment)
        if not sources:
            raise InputError(
                "lights, environment: expected lights or a map, received neither; pass "
                "lights=[PointLight(...)] or environment=EnvironmentMap.open(...)"
            )
        return sources

    def on_mesh(self, mesh: Path | str, tiles: float = 1.0) -> Field:
        """Return this flat field as the material of another mesh; see `render.draped_field`.

        Parameters
        ----------
        mesh : Path or str
            OBJ or GLB file with texture coordinates.
        tiles : float
            How often the field is repeated along each of them.

        Returns
        -------
        Field
            With the mesh as its surface, whose shadows are traced.

        Raises
        ------
        InputError
            If this field is not flat, its light is unknown, or the mesh cannot be used.
        """
        read = textured_mesh.read_textured_mesh(mesh)
        return Field(draped.draped_field(self.stored, read, tiles))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything that a renderer of one's own needs, decoded.

        Returns
        -------
        dict of str to ndarray
            ``positions`` (n_vertices, 3), ``faces`` (n_faces, 3), ``uv`` (n_vertices, 2),
            ``texel_of_pixel`` (height, width), -1 where none, row 0 at v = 1,
            ``local_from_world`` (n_texels, 3, 3), and the parts of the model: of a clustered
            field ``cluster`` and ``coefficients`` of each texel, ``mean`` and ``basis`` of each
            cluster in the field's domain, at the local directions ``view_nodes`` and
            ``light_nodes``; of a half-vector field ``diffuse`` and ``weights`` of each texel,
            and ``lobes``.
        """
        stored = self.stored
        names = ("positions", "faces", "uv", "texel_of_pixel", "local_from_world")
        arrays = {name: np.array(getattr(stored, name)) for name in names}
        arrays |= {name: np.array(part) for name, part in stored.parts.items()}
        if isinstance(stored, ClusteredField):
            arrays["cluster"] = np.array(stored.cluster)
            arrays["view_nodes"] = HemisphereGrid(stored.view_side).directions
            arrays["light_nodes"] = HemisphereGrid(stored.light_side).directions
        return arrays

    def save(self, path: Path | str) -> None:
        """Write the field to a file that `open_field` reads; it appears when it is whole."""
        write_field(path, self.stored)

    def describe(self) -> list[str]:
        """Return lines on counts, sizes, ranges and options; reads all arrays."""
        return describe(self.stored).lines()


def open_field(path: Path | str, *, max_memory: int = MAX_BYTES) -> Field:
    """Open a field file; its arrays are read when they are first used.

    Parameters
    ----------
    path : Path or str
        A ``field.rfld``.
    max_memory : int
        Refuse a field that would take more bytes than this, by estimate.

    Returns
    -------
    Field

    Raises
    ------
    FieldFileError
        If the file is missing, no field, damaged, of a newer version, or too large.

    Examples
    --------
    >>> import tempfile
    >>> import reflfield as rf
    >>> path = Path(tempfile.mkdtemp()) / "field.rfld"
    >>> rf.example_field().save(path)
    >>> rf.open_field(path)
    Field(clustered: 64 texels, 1 clusters, 0 components, 9 view_side, 9 light_side)
    """
    return Field(open_stored(path, max_bytes=max_memory))
