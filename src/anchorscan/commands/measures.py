"""``bench`` and all other commands that measure: how well, how fast, for how long."""

from __future__ import annotations

import json
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import AnchorscanError
from .console import progress, say
from .logs import records_of
from .options import (
    DrivesArgument,
    FieldOfViewOption,
    LogArgument,
    LogOptions,
    PresetsOption,
    RangeMaxOption,
    SetArgument,
    SettingsOptions,
    SharingOptions,
    SweptCandidatesOption,
    TopicOption,
    UpsideDownOption,
)

if TYPE_CHECKING:
    from ..benchmark import Task
    from ..record import Record
    from ..settings import Settings

__all__ = [
    "ablate",
    "bench",
    "bench_fleet",
    "bench_service",
    "bench_wrong",
    "calibrate",
    "change",
    "check_map",
    "compare_sensors",
    "endure",
    "scale",
]


class Endurance(str, Enum):
    """What is to be endured."""

    day = "day"
    load = "load"
    repeat = "repeat"


def bench(
    logs: DrivesArgument = None,
    presets: PresetsOption = None,
    protocols: Annotated[
        list[str] | None,
        typer.Option(
            "--protocol", metavar="P1..P5", help="Again for more; P1 to P4 if none is named."
        ),
    ] = None,
    candidates: SweptCandidatesOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and pictures."),
    ] = None,
    queries: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="At most so many queries of each split; starts of each drive."
        ),
    ] = None,
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline",
            metavar="NAME",
            help="exhaustive, karto, or none; for P5 amcl, window; all but window.",
        ),
    ] = None,
    baseline_queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="The same for the baselines, which are slow.")
    ] = 136,
    seed: Annotated[int, typer.Option(help="Chooses the queries, where not all are asked.")] = 0,
    range_max: RangeMaxOption = None,
    *,
    sharing: SharingOptions,
) -> None:
    """Measure how well and how fast scans are located, by fixed protocols.

    Logs of one building, given one after the other as BUILDING=LOG, are two sessions. P5, a lost
    robot on the move, runs on its own.
    """
    from ..benchmark import BASELINES, PROTOCOLS, run

    for protocol in protocols or ():
        if protocol not in (*PROTOCOLS, "P5"):
            listed = ", ".join((*PROTOCOLS, "P5"))
            raise AnchorscanError(f"unknown protocol {protocol!r}: there are {listed}")
    if protocols and "P5" in protocols:
        _bench_lost_robot(logs, baselines, queries, baseline_queries, seed, output, range_max)
        protocols = [protocol for protocol in protocols if protocol != "P5"]
        if not protocols:
            return
        if baselines is not None:
            baselines = [n for n in baselines if n not in ("amcl", "window")] or ["none"]
    with sharing.cluster() as spread:
        run(
            logs or (),
            presets=presets or ("default",),
            protocols=protocols or PROTOCOLS,
            candidates=candidates or (None, 1, 5, "all"),
            output_folder=output,
            queries=queries,
            seed=seed,
            baselines=() if baselines == ["none"] else baselines or BASELINES,
            baseline_queries=baseline_queries,
            say=typer.echo,
            progress=progress,
            spread=spread,
            range_max=range_max,
        )


def _bench_lost_robot(
    logs: list[str] | None,
    baselines: list[str] | None,
    starts: int | None,
    baseline_starts: int,
    seed: int,
    output: Path | None,
    range_max: float | None,
) -> None:
    """Measure P5 on the logs that were named, else on those with odometry and on Killian Court."""
    from ..benchmark import default_drives, read_drives
    from ..lost_robot import run

    paths = logs or default_drives(typer.echo)
    others = [name for name in ("window", "amcl") if name in (baselines or ["amcl"])]
    run(
        read_drives(progress(paths, "reading", len(paths)), range_max),
        ("anchorscan", *others),
        starts=starts,
        baseline_starts=baseline_starts,
        seed=seed,
        output_folder=output,
        say=typer.echo,
        progress=progress,
    )


def scale(
    logs: DrivesArgument = None,
    sizes: Annotated[
        list[int] | None,
        typer.Option(
            "--references", min=1, metavar="N", help="Again for more; 100 to 1,000,000 if none."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and a picture."),
    ] = None,
    queries: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the distractors, and of the queries.")] = 0,
    *,
    settings: SettingsOptions,
) -> None:
    """Measure how the search for candidates grows with the number of references.

    Real queries (P1 and P3) are asked for the references of their place among references of
    other places, made from real and simulated scans. A million need 3 GB of memory.
    """
    from ..growth import SIZES, Place, measure

    places = [
        Place(
            f"{task.protocol} {task.place}",
            task.known.building,
            task.references,
            tuple((scan, pose) for scan, pose in task.queries if pose is not None),
            tuple(record.scan for record in task.known.records if record.scan is not None),
            task.split.spacing,
            task.split.heading,
        )
        for task in _tasks(logs, "P1", "P3")
    ]
    growth = measure(
        places,
        settings.chosen(),
        sizes=sorted(set(sizes or SIZES)),
        queries=queries,
        seed=seed,
        say=say,
    )
    for line in growth.lines():
        typer.echo(line)
    if output is not None:
        for path in growth.write(output):
            typer.echo(str(path))
        growth.draw(output / "growth.png")
        typer.echo(str(output / "growth.png"))


def bench_fleet(
    logs: DrivesArgument = None,
    sizes: Annotated[
        list[int] | None,
        typer.Option("--sets", min=1, metavar="N", help="Again for more; 1, 10, 100 and 1000."),
    ] = None,
    also: Annotated[
        list[Path] | None,
        typer.Option("--also", metavar="SET", help="A set that is asked, too; again for more."),
    ] = None,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each building.")
    ] = 20,
    simulated: Annotated[
        int, typer.Option(min=0, max=10, metavar="N", help="Simulated buildings with queries.")
    ] = 10,
    seed: Annotated[int, typer.Option(help="Of the simulated buildings.")] = 0,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder", help="Write all sets here, and ask them as one fleet: time and memory."
        ),
    ] = None,
    *,
    settings: SettingsOptions,
) -> None:
    """Measure how surely a scan names its building, and its place there, among many sets.

    Every log gives a set and queries; simulated buildings fill up to the number of sets.
    """
    from .. import fleet_benchmark
    from ..reference_set import ReferenceSet

    chosen = settings.chosen()
    fleet_benchmark.run(
        _tasks(logs, "P1", "P3"),
        [(path.stem, ReferenceSet.open(path, settings=chosen)) for path in also or ()],
        chosen,
        sorted(set(sizes or (1, 10, 100, 1000))),
        queries,
        simulated,
        seed,
        folder,
        say=typer.echo,
        progress=progress,
    )


def bench_service(
    set_file: SetArgument,
    log: LogArgument,
    workers: Annotated[
        int, typer.Option(min=1, metavar="N", help="Worker processes of the service.")
    ] = 1,
    clients: Annotated[
        int, typer.Option(min=1, max=64, metavar="N", help="Clients that ask at once.")
    ] = 2,
    queries: Annotated[
        int, typer.Option(min=1, max=1_000_000, metavar="N", help="Questions of each, at most.")
    ] = 2000,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, metavar="S", help="To go on for, at most.")
    ] = 20.0,
    batch: Annotated[
        int, typer.Option(min=1, max=1000, metavar="N", help="Scans in a question.")
    ] = 1,
    field_of_view: FieldOfViewOption = None,
) -> None:
    """Load a service of this machine with the scans of a log, beside the same calls in process."""
    from ..service_benchmark import run

    opened = LogOptions(field_of_view).open(log)
    scans = [record.scan for record in records_of(opened) if record.scan is not None]
    for line in run(set_file, scans, workers, clients, queries, seconds, batch):
        typer.echo(line)


def calibrate(
    logs: DrivesArgument = None,
    *,
    settings: SettingsOptions,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = 200,
    belief: Annotated[
        bool,
        typer.Option(
            "--belief", help="What an answer tells the belief on the move; after the decision."
        ),
    ] = False,
) -> None:
    """Fit what an answer's evidence is worth, each building scored by the others.

    Prints the coefficients for the settings file's section "decision", or "belief".
    """
    from .. import calibration

    chosen = settings.chosen()
    if belief:
        _calibrate_belief(logs, chosen, queries)
        return
    cases = _tasks(logs)
    samples = calibration.gather(cases, chosen, queries, say)
    typer.echo("scored by the fit to the other buildings:")
    scored = calibration.rotate(samples, chosen.decision.threshold)
    for fit in (fit for fit in scored if fit.protocol != "P4"):
        typer.echo(
            f"{fit.protocol} {fit.place}, {fit.crowd:.0%} occluded: {fit.queries} queries, "
            f"recall {fit.recall:.3f} at 100 % and {fit.recall_99:.3f} at 99 % precision, "
            f"calibration error "
            f"{fit.calibration_error:.3f}, {fit.accepted_wrong} of {fit.accepted} answers wrong"
        )
    unknown = [fit for fit in scored if fit.protocol == "P4"]
    for crowd in sorted({fit.crowd for fit in unknown}):
        pairs = [fit for fit in unknown if fit.crowd == crowd]
        typer.echo(
            f"P4, {len(pairs)} pairs of buildings, {crowd:.0%} occluded: "
            f"{sum(fit.accepted for fit in pairs)} of {sum(fit.queries for fit in pairs)} answered"
        )
    typer.echo(json.dumps({"decision": calibration.weigh(samples)}, indent=2))


def _calibrate_belief(logs: list[str] | None, chosen: Settings, queries: int) -> None:
    from .. import answer_odds

    cases = _tasks(logs, "P1", "P3", "P4")
    drives = {case.asked.name: case.asked for case in cases if case.protocol != "P4"}
    samples = answer_odds.gather(cases, drives.values(), chosen, queries, say)
    for fit in (answer_odds.fit(samples), *answer_odds.rotate(samples)):
        typer.echo(
            f"{f'without {fit.without}' if fit.without else 'all'}: {fit.constant:.2f} + "
            f"{fit.weight:.2f} * log odds; above 20 to 1: {fit.right:.3f} of the right answers, "
            f"{fit.elsewhere:.3f} in other buildings, {fit.unmapped:.3f} where the map has ended"
        )
    whole = answer_odds.fit(samples)
    found = {"answer_constant": whole.constant, "answer_weight": whole.weight}
    typer.echo(json.dumps({"belief": found}, indent=2))


def ablate(
    logs: DrivesArgument = None,
    *,
    settings: SettingsOptions,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = 100,
    changes: Annotated[
        list[str] | None,
        typer.Option("--change", metavar="NAME", help="Again for more; all if none is named."),
    ] = None,
) -> None:
    """Change one thing at a time, and say what each is worth: a table in Markdown."""
    from .. import ablation

    tried = ablation.changes_named(changes or ())
    chosen = settings.chosen()
    cases = _tasks(logs, "P1", "P2", "P3")
    ablation.run(cases, chosen, queries, typer.echo, tried)


def bench_wrong(
    logs: DrivesArgument = None,
    *,
    settings: SettingsOptions,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = 150,
    seed: Annotated[int, typer.Option(help="Chooses queries and misplaced references.")] = 1,
) -> None:
    """Say what happens with wrong data of right syntax: a table in Markdown.

    Accepted and correct answers with the laser upside down, with a twentieth of the references
    misplaced, and in maps of the wrong scale; and whether it was noticed.
    """
    from .. import wrong_data

    chosen = settings.chosen()
    cases = _tasks(logs, "P1", "P3")
    wrong_data.run(cases, chosen, queries, seed, typer.echo, progress)


def change(
    logs: DrivesArgument = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and curves."),
    ] = None,
    *,
    settings: SettingsOptions,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each place.")
    ] = 100,
    buildings: Annotated[
        int, typer.Option(min=0, metavar="N", help="Simulated buildings that are changed.")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Of buildings and changes.")] = 0,
) -> None:
    """Change the world after the references were taken, and say what becomes of the answers.

    People before the laser in recorded drives; people, furniture, doors and walls in simulated
    buildings; from nothing to 60 %.
    """
    from .. import changed_world

    chosen = settings.chosen()
    cases = [case for case in _tasks(logs, "P1", "P3") if not case.looks_alike]
    changed_world.run(
        cases,
        chosen,
        queries,
        buildings,
        seed,
        output,
        say=typer.echo,
        progress=progress,
    )


def endure(
    what: Annotated[
        Endurance,
        typer.Argument(
            metavar="day|load|repeat",
            help="day: a day of a robot, and what grows; load: several processes on one set; "
            "repeat: the same questions under other circumstances.",
        ),
    ],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG...]",
            help="Logs with poses in one frame, the first for the references; a simulated "
            "drive if none.",
        ),
    ] = None,
    hours: Annotated[float, typer.Option(min=0.0, metavar="H", help="Of the robot's day.")] = 24.0,
    rate: Annotated[float, typer.Option(min=0.1, metavar="HZ", help="Its scans a second.")] = 6.0,
    seconds: Annotated[
        float, typer.Option(min=0.0, metavar="S", help="How long each load lasts.")
    ] = 20.0,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="Scans that load and repeat ask.")
    ] = 100,
    pythons: Annotated[
        list[Path] | None,
        typer.Option(
            "--python",
            metavar="PYTHON",
            help="Other interpreters with anchorscan's dependencies, for repeat; again for more.",
        ),
    ] = None,
    *,
    settings: SettingsOptions,
) -> None:
    """Let it run for long, under load, and again: what grows, what waits, what differs."""
    from tempfile import TemporaryDirectory

    from .. import endurance, load, repetition
    from ..protocol import thin
    from ..reference_set import ReferenceSet

    drives = _drives(logs or ())
    chosen = settings.read()
    with TemporaryDirectory() as folder:
        set_file = Path(folder) / "set.apr"
        with ReferenceSet.build(drives[0], settings=chosen, path=set_file) as places:
            if what is Endurance.day:
                endurance.run(places, drives, hours, rate, typer.echo, progress)
        usable = [record.scan for drive in drives for record in drive if record.scan is not None]
        scans = [usable[index] for index in thin(range(len(usable)), queries)]
        if what is Endurance.load:
            load.run(set_file, scans, seconds, typer.echo)
        if what is Endurance.repeat:
            asked = ReferenceSet(path=Path(folder) / "scans.apr")
            asked.add_batch(scans)
            asked.close()
            others = [
                repetition.Circumstance(str(path), {}, python=str(path), exact=False)
                for path in pythons or ()
            ]
            repetition.run(
                set_file,
                Path(folder) / "scans.apr",
                typer.echo,
                (*repetition.CIRCUMSTANCES, *others),
            )


def _drives(logs: Sequence[Path]) -> list[list[Record]]:
    """Read logs, or simulate two drives in a building."""
    if logs:
        return [list(records_of(LogOptions().open(path))) for path in logs]
    from ..building import random_building
    from ..simulator import drive

    world = random_building(0)
    return [drive(world, seed=seed, length=100.0) for seed in (0, 1)]


def check_map(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="YAML file of a map.")],
    log: LogArgument,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for a picture.")
    ] = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    range_max: RangeMaxOption = None,
    *,
    settings: SettingsOptions,
) -> None:
    """Say how well the scans of a drive are located in a map, without any truth.

    Answers that are right move as the odometry of the log does.
    """
    from ..map_check import run

    chosen = settings.read()
    opened = LogOptions(None, range_max, topic, upside_down).open(log)
    run(map_file, opened, output, chosen, say=typer.echo, progress=progress)


def compare_sensors(
    buildings: Annotated[
        int, typer.Option(min=1, metavar="N", help="How many simulated offices.")
    ] = 4,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries in each.")
    ] = 60,
    *,
    settings: SettingsOptions,
) -> None:
    """Locate the scans of one laser among references of another, for every pair of three.

    Prints a table in Markdown: the share whose best hypothesis is right, and in brackets how many
    were answered rightly, wrongly and not at all.
    """
    from ..sensor_pairs import run

    chosen = settings.chosen()
    run(buildings, queries, chosen, say=typer.echo, progress=progress)


def _tasks(logs: list[str] | None, *protocols: str) -> list[Task]:
    """Split the logs that were named, or those there are; by all protocols if none is named."""
    from ..benchmark import PROTOCOLS, default_logs, read_drives, tasks

    return tasks(read_drives(logs or default_logs(say)), protocols or PROTOCOLS)
