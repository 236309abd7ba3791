"""anchorscan: where a robot is, from one 2D laser scan and no prior guess.

Public names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; a test holds it equal to _HOMES
    from .building import random_building as random_building
    from .client import RemoteSet as RemoteSet
    from .errors import AnchorscanError as AnchorscanError
    from .errors import LogError as LogError
    from .errors import MissingExtraError as MissingExtraError
    from .errors import ReferenceSetError as ReferenceSetError
    from .errors import ScanError as ScanError
    from .errors import ServiceError as ServiceError
    from .errors import SettingsError as SettingsError
    from .fleet import BuildingHypothesis as BuildingHypothesis
    from .fleet import Fleet as Fleet
    from .hypothesis import Hypothesis as Hypothesis
    from .hypothesis import state_of as state_of
    from .io import Log as Log
    from .io import Problem as Problem
    from .io import open_log as open_log
    from .io import write_tum as write_tum
    from .localizer import Belief as Belief
    from .localizer import Localizer as Localizer
    from .map_file import load_map as load_map
    from .map_file import write_map as write_map
    from .matcher import Matcher as Matcher
    from .matcher import Trace as Trace
    from .matcher import match as match
    from .occupancy import OccupancyGrid as OccupancyGrid
    from .occupancy import reference_scans as reference_scans
    from .occupancy import stitch as stitch
    from .pose import Pose2D as Pose2D
    from .record import Record as Record
    from .reference import Reference as Reference
    from .reference_set import ReferenceSet as ReferenceSet
    from .scan import LaserScan as LaserScan
    from .sensor import SensorModel as SensorModel
    from .settings import Settings as Settings
    from .simulator import drive as drive
    from .simulator import simulate as simulate
    from .topological_localizer import TopologicalLocalizer as TopologicalLocalizer
    from .window import joined_scan as joined_scan
    from .world import World as World

__version__ = "0.1.0"

# The public names and the module that holds each: the one list behind __all__.
_HOMES = {
    "AnchorscanError": "errors",
    "Belief": "localizer",
    "BuildingHypothesis": "fleet",
    "Fleet": "fleet",
    "Hypothesis": "hypothesis",
    "LaserScan": "scan",
    "Localizer": "localizer",
    "Log": "io",
    "LogError": "errors",
    "Matcher": "matcher",
    "MissingExtraError": "errors",
    "OccupancyGrid": "occupancy",
    "Pose2D": "pose",
    "Problem": "io",
    "Record": "record",
    "Reference": "reference",
    "ReferenceSet": "reference_set",
    "ReferenceSetError": "errors",
    "RemoteSet": "client",
    "ScanError": "errors",
    "SensorModel": "sensor",
    "ServiceError": "errors",
    "Settings": "settings",
    "SettingsError": "errors",
    "TopologicalLocalizer": "topological_localizer",
    "Trace": "matcher",
    "World": "world",
    "drive": "simulator",
    "joined_scan": "window",
    "load_map": "map_file",
    "match": "matcher",
    "open_log": "io",
    "random_building": "building",
    "reference_scans": "occupancy",
    "simulate": "simulator",
    "state_of": "hypothesis",
    "stitch": "occupancy",
    "write_map": "map_file",
    "write_tum": "io",
}

__all__ = sorted([*_HOMES, "__version__"])  # noqa: PLE0605 - the list is one with _HOMES


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
