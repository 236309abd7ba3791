"""The command line: what to read and where to write; the work is done elsewhere.

Results go to stdout or to a file, messages and progress to stderr.  The exit code is 0, 1 for
an error that is known (one line says what to do), 2 for a command that makes no sense; what is
not known ends in a traceback, because it is our mistake.  Every heavy module is imported by the
command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from . import __version__
from .commands import answers, build, measures, pictures, servers, sets
from .commands.console import guarded, open_closed_streams
from .commands.options import spelled_out

__all__ = ["app", "main"]

app = typer.Typer(
    name="anchorscan",
    help="Where a robot is, from one 2D laser scan and no prior guess.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

# In the order in which help and documentation list them.
_COMMANDS: tuple[Callable[..., None], ...] = (
    build.build,
    build.add,
    answers.locate,
    answers.which,
    servers.serve,
    answers.track,
    pictures.explain,
    pictures.report,
    pictures.view,
    sets.info,
    sets.index,
    sets.check,
    sets.remove,
    measures.bench,
    measures.scale,
    measures.bench_fleet,
    measures.bench_service,
    measures.calibrate,
    measures.ablate,
    measures.bench_wrong,
    measures.change,
    measures.endure,
    measures.check_map,
    measures.compare_sensors,
    servers.ros,
    pictures.demo,
)
# What these get is passed on as it is.
_CONTEXTS: dict[Callable[..., None], dict[str, bool]] = {
    servers.ros: {"allow_extra_args": True, "ignore_unknown_options": True}
}

for _command in _COMMANDS:
    app.command(context_settings=_CONTEXTS.get(_command))(spelled_out(guarded(_command)))


def main() -> None:
    """Run the command line (the entry point of ``anchorscan``)."""
    open_closed_streams()
    app()


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"anchorscan {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Where a robot is, from one 2D laser scan and no prior guess."""
