"""``serve`` and ``ros``: answers for others, until told to stop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import say

__all__ = ["ros", "serve"]


def serve(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="NAME.apr in it is the set NAME.")
    ],
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; others need tokens.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, metavar="PORT", help="Port.")] = 8000,
    workers: Annotated[
        int, typer.Option(min=1, metavar="N", help="Processes, each with all sets in memory.")
    ] = 1,
    tokens: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Lines 'read TOKEN' or 'write TOKEN'; else the variable ANCHORSCAN_TOKENS.",
        ),
    ] = None,
    largest_request: Annotated[
        int, typer.Option(min=1, metavar="MB", help="Largest request, megabytes.")
    ] = 64,
    seconds: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Longest time for a request.")
    ] = 30.0,
    most_scans: Annotated[
        int, typer.Option(min=1, metavar="N", help="Most scans or references in a request.")
    ] = 1000,
) -> None:
    """Serve the reference sets of a folder over HTTP, until told to stop.

    The page /docs says what can be asked. Without tokens only this machine is answered.
    """
    from ..service import ServiceOptions, read_tokens
    from ..service import serve as listen

    options = ServiceOptions(
        folder,
        read_tokens(tokens),
        largest_request=largest_request << 20,
        seconds=seconds,
        most_scans=most_scans,
    )
    listen(options, host, port, workers, say=say)


def ros(context: typer.Context) -> None:
    """Run the ROS 2 node: tell a robot where it is, as soon as it is known.

    All words are passed on to ROS: anchorscan ros --ros-args -p base_frame_id:=base_link
    """
    from ..ros_node import main

    main(context.args, autostart=True)
