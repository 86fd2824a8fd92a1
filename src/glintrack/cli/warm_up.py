"""``glintrack warm-up``: compile all kernels of a simulation."""

from rich.console import Console
from rich.progress import BarColumn, TextColumn

from glintrack.cli.options import command_app
from glintrack.cli.progress import WIDTH, Bar
from glintrack.core.numba_cache import mark_complete
from glintrack.core.parallel import compilation
from glintrack.results.epoch import Epoch
from glintrack.results.run import WARM_UP_STEPS, compile_kernels

app = command_app()


@app.command()
def warm_up() -> None:
    """Compile all kernels of a simulation, once after an installation."""
    console = Console()
    show_warm_up(console)
    console.print(f"{compilation.kernels} kernels compiled in {compilation.seconds:.0f} s", highlight=False)


def show_warm_up(console: Console) -> None:
    """Compile all kernels with a progress bar, and note that they are compiled."""
    columns = TextColumn("{task.description}"), BarColumn(WIDTH), TextColumn("{task.fields[kernels]} kernels")
    with Bar(console, *columns) as progress:
        task = progress.add_task(
            "compiling kernels, once after an installation", total=WARM_UP_STEPS, kernels=0
        )

        def advance(epoch: Epoch) -> None:
            progress.update(task, advance=1, kernels=compilation.kernels)

        compile_kernels(advance)
    mark_complete()
