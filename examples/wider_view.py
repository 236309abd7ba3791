"""What a window of scans brings where a robot comes back from the other side.

    python examples/wider_view.py LOG [--length M]

Queries by protocol P1, and those of the second half of the drive among references of the first
half (1 m and 60 degrees; queries each 0.5 m and 30 degrees, with a reference within 2 m), each of
them as a single scan and as the scans of the latest metres joined into a view all around.  The
log's odometry is used where it has one, else the poses with 2 % of noise.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

from anchorscan import LaserScan, Matcher, Record, Reference, joined_scan, open_log
from anchorscan.journey import Journey, odometry
from anchorscan.protocol import (
    Answer,
    choose_references,
    recall_at_precision,
    revisit,
)

View = Callable[[int], LaserScan]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("--length", type=float, default=5.0, help="metres that are joined")
    arguments = parser.parse_args()
    records = with_odometry([r for r in open_log(arguments.log) if r.scan and r.pose])

    def one(index: int) -> LaserScan:
        scan = records[index].scan
        assert scan is not None
        return scan

    def joined(index: int) -> LaserScan:
        return joined_scan(records[max(0, index - 100) : index + 1], arguments.length)

    views: dict[str, View] = {"single scan": one, "window": joined}
    print(
        "split   references   queries      number  top-1  accepted  of them wrong  recall at 100 %"
    )
    for split, (known, asked) in splits(records).items():
        for (references, shown), (queries, seen) in product(views.items(), repeat=2):
            answers = located(records, known, asked, shown, seen)
            right = sum(answer.is_correct for answer in answers)
            taken = [answer for answer in answers if answer.accepted]
            wrong = sum(not answer.is_correct for answer in taken)
            recall, _ = recall_at_precision(
                [answer.probability for answer in answers],
                [answer.is_correct for answer in answers],
            )
            print(
                f"{split:<7} {references:<12} {queries:<12} {len(answers):>6} "
                f"{right:>6} {len(taken):>9} {wrong:>14} {recall:>16.2f}"
            )


def with_odometry(records: list[Record]) -> list[Record]:
    """Return records that all have odometry."""
    if all(record.odometry is not None for record in records):
        return records
    told = odometry(records, Journey(tuple(range(len(records)))), 0.02)
    return [replace(r, odometry=pose) for r, pose in zip(records, told, strict=True)]


def splits(records: Sequence[Record]) -> dict[str, tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return positions of references and queries by the name of the split."""
    half = len(records) // 2
    known = choose_references(records[:half], 1.0, math.radians(60.0))
    later = choose_references(records[half:], 0.5, math.radians(30.0))
    asked = tuple(half + n for n in later if is_near(records, known, half + n))
    p1 = revisit(records)
    return {"P1": (p1.references, p1.queries), "halves": (known, asked)}


def is_near(records: Sequence[Record], known: Sequence[int], index: int) -> bool:
    """Whether a reference lies within 2 m of a record."""
    pose = records[index].pose
    return any(records[k].pose.distance(pose) <= 2.0 for k in known)


def located(
    records: Sequence[Record],
    known: Sequence[int],
    asked: Sequence[int],
    references: View,
    queries: View,
) -> list[Answer]:
    """Locate all queries."""
    matcher = Matcher(Reference(k, references(k), records[k].pose) for k in known)
    answers = []
    for index in asked:
        found = matcher.locate(queries(index))
        pose = found[0].pose if found else None
        probability = found[0].probability if found else math.nan
        accepted = bool(found) and found[0].accepted
        answers.append(Answer(index, pose, records[index].pose, probability, accepted, 0.0))
    return answers


if __name__ == "__main__":
    main()
