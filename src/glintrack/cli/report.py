"""``glintrack report``, ``view`` and ``video``: look at a result."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track as progress

from glintrack.io import files
from glintrack.report import Composite, build_page, serve_result, write_video
from glintrack.report.study_page import RUN_PAGE, build_study_page, is_study
from glintrack.results.read import Result, read_result

ResultArgument = Annotated[Path, typer.Argument(help="A folder that `glintrack run` wrote")]
AnyArgument = Annotated[Path, typer.Argument(help="A folder that `glintrack run` or `glintrack study` wrote")]
BaseOption = Annotated[
    str | None,
    typer.Option(
        help="Case to compare the design with [default: the packaged case of that name, or defaults]"
    ),
]


def report(
    result: AnyArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="HTML file to write")] = Path("report.html"),
    base: BaseOption = None,
    runs: Annotated[
        bool, typer.Option("--runs", help="Of a study: write the page of every finished run too, and link it")
    ] = False,
) -> None:
    """Write one page that shows a run or a study and opens anywhere, without a network."""
    if output.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"`output` must end in .html, got {output.name!r}")
    _check_place(output)
    console = Console(soft_wrap=True)
    if is_study(result):
        if runs:
            _write_runs(result, base)
        files.write_text(output, build_study_page(result, output.parent))
        console.print(f"wrote {output}: links lead to {result / 'cases'}", markup=False)
        return
    found = read_result(result)
    text = build_page(found, base)
    files.write_text(output, text)
    _say(console, found)
    console.print(f"wrote {output}: {len(text.encode()) / 1e6:.1f} MB", markup=False)


def _check_place(output: Path) -> None:
    """Refuse a file that cannot be put in its place before anything is made."""
    if output.is_dir() or not output.parent.is_dir():
        raise ValueError(f"`output` must be a file in an existing folder, got {output}")


def _say(console: Console, result: Result) -> None:
    """What is missing or odd about a result."""
    for note in result.notes:
        console.print(f"note: {note}", markup=False)


def _write_runs(study: Path, base: str | None) -> None:
    """The page of each finished case, beside its result."""
    cases = sorted(p for p in (study / "cases").glob("*") if (p / "result.nc").is_file())
    for case in progress([c for c in cases if not c.name.startswith(".")], "pages of runs"):
        files.write_text(case / RUN_PAGE, build_page(read_result(case), base))


def view(
    result: ResultArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 for any that is free")] = 8765,
    host: Annotated[
        str, typer.Option(help="Address to listen on; anything but loopback shows the result to others")
    ] = "127.0.0.1",
    base: BaseOption = None,
) -> None:
    """Show a result in the browser; pictures are sent as they are needed. Ctrl-C ends it."""
    found, console = read_result(result), Console(soft_wrap=True)
    server = serve_result(found, host, port, base)
    _say(console, found)
    if not server.on_loopback:
        console.print(f"note: everybody who reaches {host} can see this result")
    console.print(
        f"http://{server.server_address[0]}:{server.server_address[1]}/  (Ctrl-C ends)", markup=False
    )
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        server.server_close()


def video(
    result: ResultArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write: .mp4 or .gif")],
    pictures: Annotated[
        str, typer.Option(help="Which pictures side by side, with commas: rgb, pan, dolp, aop")
    ] = "rgb,pan,dolp,aop",
    channel: Annotated[
        str | None, typer.Option(help="Whose tracks are drawn: pan, dolp [default: the first]")
    ] = None,
    width: Annotated[int, typer.Option(min=160, max=3840, help="Of the video [pixel]")] = 1280,
    speed: Annotated[float, typer.Option(min=0.05, max=100, help="Times as fast as the flight")] = 1.0,
) -> None:
    """Write the film of a flight with its tracks as MP4 (extra `video`) or GIF."""
    _check_place(output)
    found, console = read_result(result), Console(soft_wrap=True)
    film = Composite.of(found, tuple(pictures.split(",")), channel, width)
    _say(console, found)
    write_video(output, (film.draw(k) for k in progress(range(len(film)), "drawing")), film.rate_hz * speed)
    console.print(f"wrote {output}: {len(film)} frames", markup=False)
