"""``glintrack view``: a result in the browser."""

from typing import Annotated

import typer
from rich.console import Console

from glintrack.cli.options import BaseOption, ResultArgument, command_app, print_notes
from glintrack.report import serve_result
from glintrack.results.read import read_result

app = command_app()


@app.command()
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
    print_notes(console, found.notes)
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
