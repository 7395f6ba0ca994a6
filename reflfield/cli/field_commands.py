"""The commands that use a field: ``relight``, ``compare``, ``view`` and ``export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from reflfield.cli.limits import limits, working
from reflfield.cli.messages import say_metrics
from reflfield.cli.shared_options import (
    EncodingOption,
    FollowLinks,
    Format,
    LayerOption,
    MaxMemory,
    Out,
    RaysPerPixel,
    Workers,
)
from reflfield.errors import InputError
from reflfield.flags import FLAGS
from reflfield.util.terminal import say, say_error, showing_progress

FORMAT_NAMES = "html|gltf|blender|materialx|mitsuba|rti|exr|btf"


def relight(
    field: Annotated[Path, typer.Argument(help="A field.rfld.")],
    out: Out,
    capture: Annotated[
        Path | None, typer.Option(help="Whose cameras and lights the images have.")
    ] = None,
    orbit: Annotated[int | None, typer.Option(help="Images of a turntable.")] = None,
    environment: Annotated[
        Path | None, typer.Option(help="Latitude-longitude map for the turntable.")
    ] = None,
    convention: Annotated[
        str | None, typer.Option(help="Of the map: openexr (default), mitsuba or blender.")
    ] = None,
    environment_up: Annotated[
        str | None,
        typer.Option(
            metavar="AXIS",
            help="World direction of the map's zenith: X, -Y, ... or x,y,z; the field's up.",
        ),
    ] = None,
    environment_rotation: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES",
            help="Of the map about its zenith, to the left from above.",
        ),
    ] = None,
    light: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Direction to a distant light.")
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option(metavar="MESH", help="OBJ or GLB with UVs that a flat field covers."),
    ] = None,
    tile: Annotated[
        float | None, typer.Option(help="Repetitions of the field along the UVs of MESH; 1.")
    ] = None,
    rays_per_pixel: RaysPerPixel = 16,
    size: Annotated[
        int | None, typer.Option(help="Side of the turntable's images, pixels; 400.")
    ] = None,
    elevation: Annotated[
        float | None, typer.Option(help="Of the turntable's camera, degrees; 20.")
    ] = None,
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
) -> None:
    """Render what a capture's photographs would show, or a turntable."""
    if (capture is None) == (orbit is None):
        raise InputError("relight: expected either --capture CAPTURE or --orbit N, one of them")
    of_map = {"convention": convention, "environment_up": environment_up,
              "environment_rotation": environment_rotation}  # fmt: skip
    of_orbit = {"environment": environment, "light": light, "size": size,
                "elevation_deg": elevation}  # fmt: skip
    refuse_without("--orbit; a capture brings its own cameras and lights", orbit, of_orbit)
    refuse_without("--environment MAP", environment, of_map)
    refuse_without("--on MESH", on, {"tiles": tile})
    resources = limits(workers, max_memory)
    made_with = image_options(rays_per_pixel, resources)
    with working():
        opened = opened_on(field, on, tile, resources)
        if capture is not None:
            made = relit_capture(opened, capture, out, format, follow_links, made_with)
        else:
            asked: dict[str, Any] = of_orbit | of_map | {"n_images": orbit}
            stated = {name: value for name, value in asked.items() if value is not None}
            made = turntable(opened, out, stated | made_with)
    for path in made:
        say(str(path))


def opened_on(field: Path, mesh: Path | None, tile: float | None, resources: Any) -> Any:
    """The field, as the material of a mesh if there is one."""
    from reflfield.api.fields import open_field

    opened = open_field(field, max_memory=resources.max_memory)
    return opened if mesh is None else opened.on_mesh(mesh, 1.0 if tile is None else tile)


def relit_capture(
    field: Any, capture: Path, out: Path, format: str | None, links: bool, made_with: Any
) -> list[Path]:
    """Images of a field from the cameras and under the lights of a capture."""
    from reflfield.api.captures import open_capture
    from reflfield.api.images import relight

    wanted = open_capture(capture, format, follow_links=links, require_photographs=False)
    return relight(field, wanted, out, **made_with)


def turntable(field: Any, out: Path, options: dict[str, Any]) -> list[Path]:
    """Images of a turntable of a field."""
    from reflfield.api.images import render_turntable

    return render_turntable(field, out, **options)


def image_options(rays_per_pixel: int, resources: Any) -> dict[str, Any]:
    """How images are rendered, and with what."""
    from reflfield.render.renderer import RenderOptions

    options = RenderOptions(samples_per_pixel=rays_per_pixel, workers=resources.workers)
    return {"options": options, "resources": resources}


def refuse_without(needed: str, value: Any, options: dict[str, Any]) -> None:
    """Refuse options that say nothing without another one."""
    stated = [FLAGS[name] for name, option in options.items() if option is not None]
    if value is None and stated:
        raise InputError(f"{', '.join(stated)}: expected with {needed}")


def compare(
    field: Annotated[Path, typer.Argument(help="A field.rfld.")],
    capture: Annotated[Path, typer.Argument(help="Photographs to compare with.")],
    out: Out,
    photographs: Annotated[
        Path | None,
        typer.Option(
            metavar="CAPTURE",
            help="Photographs that made the field; the nearest one is a baseline.",
        ),
    ] = None,
    rays_per_pixel: RaysPerPixel = 16,
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Render what the photographs of a capture show, and measure the difference."""
    from reflfield.api.captures import open_capture
    from reflfield.api.fields import open_field
    from reflfield.api.images import compare as compare_with

    resources = limits(workers, max_memory)
    made_with = image_options(rays_per_pixel, resources)
    opened = open_field(field, max_memory=resources.max_memory)
    with working():
        photographed = open_capture(
            capture, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
        if photographs is not None:
            made_with["field_photographs"] = open_capture(
                photographs, follow_links=follow_links
            )
        metrics = compare_with(opened, photographed, out, **made_with)
    say_metrics(metrics)
    say(f"metrics   {out / 'metrics.json'}")
    say(f"report    {out / 'report' / 'index.html'}")


def view(
    field: Annotated[Path, typer.Argument(help="A field.rfld.")],
    port: Annotated[int, typer.Option(help="Of this machine; 0 takes a free one.")] = 0,
    open_: Annotated[
        bool,
        typer.Option("--open/--no-open", help="Open the browser, or only say the address."),
    ] = True,
    max_memory: MaxMemory = "4GB",
) -> None:
    """Show a field in the browser: turn it, move the light. Ctrl-C ends.

    The page is served to this machine alone.
    """
    import webbrowser

    from reflfield.api.fields import open_field
    from reflfield.options import parse_bytes
    from reflfield.viewer.object_page import object_page
    from reflfield.viewer.page_server import PageServer

    most_bytes = parse_bytes(max_memory)
    stored = open_field(field, max_memory=most_bytes).stored
    page = object_page(stored, most_bytes=most_bytes).encode()
    with PageServer(page, port) as server, showing_progress("the page is no longer served"):
        say(server.url)
        if open_ and not webbrowser.open(server.url):
            say_error("reflfield: note: no browser found; open the address in one")
        server.serve_forever()


def export(
    field: Annotated[Path, typer.Argument(help="A field.rfld.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="Such as OBJECT.html.")
    ],
    to: Annotated[str, typer.Option(metavar=FORMAT_NAMES, help="Format.")] = "html",
    view: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Direction to the viewer, of rti.")
    ] = None,
    max_memory: MaxMemory = "4GB",
) -> None:
    """Write a field in the format of other software; FILE is a folder for some."""
    from reflfield.api.fields import open_field
    from reflfield.api.images import direction_of
    from reflfield.export.formats import export_field
    from reflfield.options import parse_bytes

    stored = open_field(field, max_memory=parse_bytes(max_memory)).stored
    with working():
        seen_from = None if view is None else direction_of("view", view)
        lines = export_field(stored, out, to, seen_from)
    for line in [*lines, str(out)]:
        say(line)
