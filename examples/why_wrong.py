"""Why a lost robot was wrong: what its scans say where the log has it, and where it believed to be.

    python examples/why_wrong.py LOG [--starts N] [--condition NAME] [--seed N]

Protocol P5 on one drive.  For every journey that reported a confident wrong pose, the largest
error that it reported, and of all scans within 2 m of driving around that report the share of
readings that the map explains and the mean log odds of the belief: at the logged poses, and at
the same poses carried as far off as the report.  Where scan after scan fits better off the logged
poses, by less than two metres, two passes of the log disagree there; where the map explains
nothing at the logged poses, it does not show the place.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from anchorscan import LaserScan, Localizer, Matcher, Pose2D, Record
from anchorscan.belief import log_odds
from anchorscan.benchmark import read_drives
from anchorscan.journey import metres_driven
from anchorscan.lost_robot import Course, Departure, departures, follow
from anchorscan.protocol import Answer

_AROUND = 2.0
# So firmly a pose is held that refining it moves it by centimetres at most.
_FIRM = 1e3 * np.eye(3)


def main() -> None:
    """Print a line for every journey that was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("--starts", type=int, help="at most so many")
    parser.add_argument("--condition", default="noise")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    (drive,) = read_drives([arguments.log])
    course = Course(drive.name, drive, drive)
    count = 0
    print("start  confident and wrong at  metres off  at logged poses        so far off")
    print("                                             share   odds       share   odds")
    for departure in departures(course, arguments.condition, arguments.starts, seed=arguments.seed):
        if departure is not None:
            count += 1
            told(drive.records, departure)
    print(f"{count} journeys")


def told(records: Sequence[Record], departure: Departure) -> None:
    """Follow one journey and print a line if it was wrong."""
    journey, matcher = departure.journey, Matcher(departure.references)
    answers = follow(records, journey, departure.odometry, Localizer(matcher))
    begin = journey.jump or 0
    along = metres_driven(records, journey)
    way = [metres - along[begin] for metres in along[begin:]]
    least = -1.0 if journey.jump is None else 2.0
    wrong = [
        n
        for n, answer in enumerate(answers[begin:])
        if answer.accepted and not answer.is_correct and way[n] > least
    ]
    if not wrong:
        return
    worst = max(wrong, key=lambda n: answers[begin + n].position_error)
    off = error(answers[begin + worst])
    here = range(len(way))
    near = [n for n in here if abs(way[n] - way[worst]) <= _AROUND]
    logged = [answers[begin + n].truth for n in near]
    scans = [records[answers[begin + n].query].scan for n in near]
    at_log = np.mean([fit(matcher, *each) for each in zip(scans, logged, strict=True)], axis=0)
    carried = [off @ pose for pose in logged]
    beside = np.mean([fit(matcher, *each) for each in zip(scans, carried, strict=True)], axis=0)
    metres = answers[begin + worst].position_error
    print(
        f"{departure.number:>5} {way[wrong[0]]:>20.1f} m {metres:>10.2f}"
        f" {at_log[0]:>11.2f} {at_log[1]:>6.1f} {beside[0]:>14.2f} {beside[1]:>6.1f}"
    )


def error(answer: Answer) -> Pose2D:
    """What carries logged poses, in the frame of the map, to where the report has them."""
    return answer.pose @ answer.truth.inverse()


def fit(matcher: Matcher, scan: LaserScan, pose: Pose2D) -> tuple[float, float]:
    """Share of the readings that the map explains at a pose, and the log odds of the belief."""
    fits = matcher.follow(scan, np.array([pose.to_array()]), _FIRM[None])
    share = max(float(fits.features[0, 0]), 0.0)
    return share, float(log_odds(fits, matcher.settings.belief)[0])


if __name__ == "__main__":
    main()
