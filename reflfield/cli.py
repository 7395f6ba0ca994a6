"""The command ``reflfield``: parse, call the library, say what was made."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from reflfield import __version__
from reflfield.cli_check import check
from reflfield.cli_lights import lights
from reflfield.cli_messages import say_metrics, say_results
from reflfield.cli_options import (
    EncodingOption,
    FollowLinks,
    Format,
    LayerOption,
    MaxMemory,
    Out,
    RaysPerPixel,
    Workers,
)
from reflfield.errors import InputError, ReflfieldError
from reflfield.flags import FLAGS, current_flags, with_flags
from reflfield.util.interrupts import ending_on_signals
from reflfield.util.terminal import say, say_error, showing_progress, system_words

# The libraries that do the work take seconds to import: commands import what they need,
# so that --help and wrong arguments answer at once.

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Dome photographs to relightable objects.",
)
LONGEST_MESSAGE = 1600
FORMAT_NAMES = "html|gltf|blender|materialx|mitsuba|rti|exr|btf"
NOTHING_LEFT = "nothing half-written is left"
GOES_ON = "the same command goes on where it stopped"
app.command()(check)
app.command()(lights)


def main() -> None:
    """Entry point: input that cannot be used ends with one message and status 2."""
    notes, handler = logging.getLogger("reflfield"), Notes()
    notes.addHandler(handler)
    notes.propagate = False
    try:
        with ending_on_signals():
            app(args=list(current_flags(sys.argv[1:], say_error)))
    except ReflfieldError as error:
        fail(with_flags(str(error)), error)
    except OSError as error:  # a folder that cannot be written, a full disk
        fail(system_words(error), error)
    finally:
        notes.removeHandler(handler)
        notes.propagate = True


class Notes(logging.Handler):
    """Says what the library notes on the way, such as what it does not use of an input."""

    def emit(self, record: logging.LogRecord) -> None:
        """Say one note."""
        say_error(f"reflfield: note: {with_flags(record.getMessage())}")


def fail(message: str, error: Exception) -> NoReturn:
    """Say what is wrong, and what was noted on the error, and end with status 2."""
    notes = getattr(error, "__notes__", ())
    whole = "; ".join([message, *notes])
    if len(whole) > LONGEST_MESSAGE:  # arguments and names are quoted in it
        whole = f"{whole[: LONGEST_MESSAGE // 2]} ... {whole[-LONGEST_MESSAGE // 4 :]}"
    say_error(f"reflfield: error: {whole}")
    sys.exit(2)


@app.callback(invoke_without_command=True)
def version_option(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Dome photographs to relightable objects."""
    if version:
        say(f"reflfield {__version__}")
        raise typer.Exit


@app.command()
def demo(
    out: Out = Path("demo"),
    workers: Workers = 0,
) -> None:
    """Simulate a small dome of a vase, process it, and compare with held-out photographs."""
    from reflfield.demo import run_demo

    started = time.perf_counter()
    with working(GOES_ON):
        result = run_demo(out, n_workers(workers))
    say_results(result, started)


@app.command()
def run(
    capture: Annotated[Path, typer.Argument(help="Folder or description file of a capture.")],
    out: Out,
    config: Annotated[Path | None, typer.Option(help="Options in TOML.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="stage.option=value", help="One option; repeatable."),
    ] = None,
    hold_out: Annotated[
        str,
        typer.Option(
            metavar="views=K,lights=K",
            help="Kept for comparison; or views=K,light-cone=25deg, or photographs=K, or test: "
            "the capture's test split.",
        ),
    ] = "",
    size: Annotated[
        str, typer.Option(metavar="2MB", help="Of the field; the best field of that size.")
    ] = "",
    psnr: Annotated[
        float | None,
        typer.Option(
            metavar="DB",
            help="Of the field; the smallest that is as good. Status 3 if none is.",
        ),
    ] = None,
    from_: Annotated[
        str | None, typer.Option("--from", metavar="STAGE", help="Compute again from here.")
    ] = None,
    until: Annotated[str, typer.Option(metavar="STAGE", help="Stop after this.")] = "report",
    workers: Workers = 0,
    max_memory: MaxMemory = "4GB",
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Of a dask cluster that computes the blocks."),
    ] = None,
    store: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Folder or fsspec URL for the texels' samples."),
    ] = None,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Make a relightable field of a capture, with a report.

    Status 0: done. 2: input cannot be used. 3: done, but --psnr is not reached. 130: Ctrl-C.
    """
    from reflfield.api.captures import open_capture
    from reflfield.api.reconstruction import read_options, reconstruct
    from reflfield.options import parse_hold_out, size_settings

    started = time.perf_counter()
    options = read_options(config, [*(set_ or []), *size_settings(size, psnr)])
    resources = limits(workers, max_memory, scheduler, store)
    held = parse_hold_out(hold_out)
    if scheduler is not None:  # whose workers run in folders of their own
        capture = capture.resolve()
    photographed = open_capture(
        *(capture, format),
        encoding=encoding,
        layer=layer,
        follow_links=follow_links,
        test_split=held.test,
    )
    asked: dict[str, Any] = {"options": options, "hold_out": held, "resources": resources}
    with working(GOES_ON):
        result = reconstruct(photographed, out, **asked, from_stage=from_, until=until)
    say_results(result, started)


@app.command()
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
    from reflfield.api.captures import open_capture
    from reflfield.api.fields import open_field
    from reflfield.api.images import relight as relight_capture
    from reflfield.api.images import render_turntable

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
    opened = open_field(field, max_memory=resources.max_memory)
    with working():
        if on is not None:
            opened = opened.on_mesh(on, 1.0 if tile is None else tile)
        if capture is not None:
            wanted = open_capture(
                capture, format, follow_links=follow_links, require_photographs=False
            )
            made = relight_capture(opened, wanted, out, **made_with)
        else:
            asked: dict[str, Any] = of_orbit | of_map | {"n_frames": orbit}
            stated = {name: value for name, value in asked.items() if value is not None}
            made = render_turntable(opened, out, **stated, **made_with)
    for path in made:
        say(str(path))


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


@app.command()
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


@app.command()
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


@app.command()
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


@app.command()
def inspect(
    path: Annotated[Path, typer.Argument(help="A capture or a field.rfld.")],
    max_memory: MaxMemory = "4GB",
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Say what a capture or a field holds."""
    from reflfield.options import parse_bytes

    most_bytes = parse_bytes(max_memory)
    if path.suffix.lower() == ".rfld":
        from reflfield.api.fields import open_field

        lines = open_field(path, max_memory=most_bytes).describe()
    else:
        from reflfield.api.captures import describe_capture, open_capture

        opened = open_capture(
            path, format, encoding=encoding, layer=layer, follow_links=follow_links
        )
        lines = describe_capture(opened)
    for line in lines:
        say(line)


@app.command()
def convert(
    capture: Annotated[Path, typer.Argument(help="Folder or description file of a capture.")],
    out: Out,
    to: Annotated[
        str, typer.Option(metavar="native|transforms|colmap", help="Format to write.")
    ] = "native",
    link: Annotated[
        bool, typer.Option("--link", help="Link the photographs instead of copying them.")
    ] = False,
    format: Format = None,
    follow_links: FollowLinks = False,
    encoding: EncodingOption = None,
    layer: LayerOption = None,
) -> None:
    """Write a capture, or a .btf, in another format; what that cannot say is refused."""
    from reflfield.api.captures import convert_btf, convert_capture, open_capture
    from reflfield.capture.btf_means import holds_btf

    if to == "native" and holds_btf(capture):
        with working():
            say(f"{convert_btf(capture, out)} images in {out}")
        return
    opened = open_capture(
        capture, format, encoding=encoding, layer=layer, follow_links=follow_links
    )
    written = convert_capture(opened, out, to, link=link)
    say(f"{len(opened.photographs)} photographs, {len(written)} files in {out}")


# --- helpers ------------------------------------------------------------------------------


@contextmanager
def working(if_interrupted: str = NOTHING_LEFT) -> Iterator[None]:
    """Show progress, and leave work in order on Ctrl-C; libraries are imported before."""
    from reflfield.geometry.open3d_library import load_open3d

    load_open3d()
    with showing_progress(if_interrupted):
        yield


def limits(
    workers: int, max_memory: str, scheduler: str | None = None, store: str | None = None
) -> Any:
    """What a command may use."""
    from reflfield.options import Resources, parse_bytes

    return Resources(n_workers(workers), parse_bytes(max_memory), scheduler, store)


def n_workers(wanted: int) -> int:
    """Threads to use; 0 takes one per core that this process may use."""
    from reflfield.options import MOST_WORKERS, available_cores

    if not 0 <= wanted <= MOST_WORKERS:
        raise InputError(
            f"--workers: expected 1 to {MOST_WORKERS}, or 0 for one per core, received {wanted}"
        )
    return wanted or available_cores()


if __name__ == "__main__":
    main()
