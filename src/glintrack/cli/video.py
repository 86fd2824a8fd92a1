"""``glintrack video``: the film of a flight."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track as progress

from glintrack.cli.options import ResultArgument, check_file, command_app, print_notes
from glintrack.report import Composite, write_video
from glintrack.results.read import read_result

app = command_app()


@app.command()
def video(
    result: ResultArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write: .mp4 or .gif")],
    pictures: Annotated[
        str | None,
        typer.Option(
            help="Which pictures side by side, with commas: rgb, pan, dolp, aop [default: all there are]"
        ),
    ] = None,
    channel: Annotated[
        str | None, typer.Option(help="Whose tracks are drawn: pan, dolp [default: the first]")
    ] = None,
    width: Annotated[int, typer.Option(min=160, max=3840, help="Of the video [pixel]")] = 1280,
    speed: Annotated[float, typer.Option(min=0.05, max=100, help="Times as fast as the flight")] = 1.0,
) -> None:
    """Write the film of a flight with its tracks as MP4 (extra `video`) or GIF."""
    check_file(output)
    found, console = read_result(result), Console(soft_wrap=True)
    film = Composite.of(found, tuple(pictures.split(",")) if pictures is not None else (), channel, width)
    print_notes(console, found.notes)
    write_video(output, (film.draw(k) for k in progress(range(len(film)), "drawing")), film.rate_hz * speed)
    frames = f"{len(film)} frame{'s' if len(film) > 1 else ''}"
    console.print(f"wrote {output}: {frames}", markup=False)
