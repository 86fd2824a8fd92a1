"""``glintrack report``, ``view`` and ``video``: show a result as a page, in the browser or as a film."""

from pathlib import Path
from typing import Annotated

from glintrack.cli import options as cli
from glintrack.io import atomic
from glintrack.report import Composite, build_page, serve_result, write_video
from glintrack.report.study_page import RUN_PAGE, build_study_page, is_study
from glintrack.results.read import read_result

app, view_app, video_app = cli.command_app(), cli.command_app(), cli.command_app()


@app.command()
def report(
    results: Annotated[
        list[Path], cli.argument("Folder that `glintrack run` or `glintrack study` wrote", metavar="RESULT")
    ],
    output: Annotated[Path, cli.option("HTML file to write", "-o", "--output")] = Path("report.html"),
    base: cli.BaseOption = None,
    runs: Annotated[bool, cli.option("For a study: write the page of every run too", "--runs")] = False,
) -> None:
    """Write one HTML page about a run or a study; it opens without a network."""
    cli.check_output(output, ".html", ".htm")
    if len(results) > 1:
        raise ValueError(
            f"`report` must get one result; got {len(results)}. Two designs are compared, with intervals, by "
            "`glintrack study`: docs/guide/study.md."
        )
    (result,), console = results, cli.open_console()
    if is_study(result):
        cases = sorted(p for p in (result / "cases").glob("[!.]*") if (p / "result.nc").is_file())
        with cli.Bar(console) as bar:
            for case in bar.track(cases, description="pages of runs") if runs else ():
                atomic.write_text(case / RUN_PAGE, build_page(read_result(case), base))
        atomic.write_text(output, build_study_page(result, output.parent))
        console.print(f"wrote {output}: links lead to {result / 'cases'}")
        return
    found = read_result(result)
    if found.tree is None:
        raise ValueError(
            f"`result` must be a finished result; got {result}: {found.notes[0]} `glintrack view` shows its "
            "other parts."
        )
    text = build_page(found, base)
    atomic.write_text(output, text)
    cli.print_notes(console, found.notes)
    console.print(f"wrote {output}: {len(text.encode()) / 1e6:.1f} MB")


@view_app.command()
def view(
    result: cli.ResultArgument,
    port: Annotated[int, cli.option("Port; 0 for any free one", min=0, max=65535)] = 8765,
    host: Annotated[str, cli.option("Address to listen on; others than loopback are public")] = "127.0.0.1",
    base: cli.BaseOption = None,
) -> None:
    """Show a result in the browser; images are sent as they are needed. Ctrl-C ends it."""
    found, console = read_result(result), cli.open_console()
    server = serve_result(found, host, port, base)
    cli.print_notes(console, found.notes)
    if not server.on_loopback:
        console.print(f"note: everybody who reaches {host} can see this result")
    console.print(f"http://{server.server_address[0]}:{server.server_address[1]}/  (Ctrl-C ends)")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        server.server_close()


@video_app.command()
def video(
    result: cli.ResultArgument,
    output: Annotated[Path, cli.option("File to write: .mp4 or .gif", "-o", "--output")],
    pictures: Annotated[str | None, cli.option("Images as rgb,pan,dolp,aop [default: all]")] = None,
    channel: Annotated[str | None, cli.option("Channel of the tracks [default: the first]")] = None,
    width: Annotated[int, cli.option("Width of the video [pixel]", min=160, max=3840)] = 1280,
    speed: Annotated[float, cli.option("Speed relative to real time", min=0.05, max=100)] = 1.0,
) -> None:
    """Write the film of a simulation with its tracks as MP4 (extra `video`) or GIF."""
    cli.check_output(output)
    found, console = read_result(result), cli.open_console()
    film = Composite.of(found, tuple(pictures.split(",")) if pictures is not None else (), channel, width)
    cli.print_notes(console, found.notes)
    with cli.Bar(console) as bar:
        pictures_drawn = map(film.draw, bar.track(range(len(film)), description="drawing"))
        write_video(output, pictures_drawn, film.rate_hz * speed)
    console.print(f"wrote {output}: {len(film)} frame{'s' if len(film) > 1 else ''}")
