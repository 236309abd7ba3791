"""The parameters of a robot's node: names, defaults, meanings, and what makes sense.

Those that mean the same as in nav2_amcl have its names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from .errors import SettingsError
from .settings import Settings

__all__ = ["RobotParameters"]


def _parameter(default: Any, meaning: str) -> Any:
    return field(default=default, metadata={"meaning": meaning})


@dataclass(frozen=True)
class RobotParameters:
    """All parameters; the meaning of each is in the metadata of its field.

    Raises:
        SettingsError: A value is impossible.
    """

    autostart: bool = _parameter(False, "configure and activate without being told to")
    global_frame_id: str = _parameter("map", "frame of the map and of all answers")
    odom_frame_id: str = _parameter("odom", "frame of odometry; other odometry is not used")
    base_frame_id: str = _parameter("base_link", "frame of the robot's base, whose pose is told")
    scan_topic: str = _parameter("scan", "sensor_msgs/LaserScan, best effort")
    odom_topic: str = _parameter("odom", "nav_msgs/Odometry, best effort; may be absent")
    map_topic: str = _parameter("map", "nav_msgs/OccupancyGrid, latched; not used with set_file")
    initial_pose_topic: str = _parameter("initialpose", "where the pose is told")
    set_file: str = _parameter("", "reference set to locate in, instead of a map")
    first_map_only: bool = _parameter(False, "ignore all maps but the first")
    preset: str = _parameter("default", "settings of the matcher: default, paper or thorough")
    settings_file: str = _parameter("", "settings of the matcher (JSON), instead of a preset")
    laser_pose: Sequence[float] | None = _parameter(
        None, "x, y (metres), yaw (radians) of the laser on the base, where tf2 does not tell"
    )
    laser_is_upside_down: bool = _parameter(
        False, "the laser's z axis points down, where tf2 does not tell"
    )
    laser_min_range: float = _parameter(
        -1.0, "shortest range that counts, metres; -1: as the scan says"
    )
    laser_max_range: float = _parameter(
        -1.0, "no return from this range on, metres; -1: as the scan says"
    )
    map_spacing: float = _parameter(1.5, "metres between the reference scans taken in a map")
    robot_radius: float = _parameter(0.2, "metres that the robot keeps from walls, for the same")
    continuous: bool = _parameter(False, "go on after the pose was told, and publish ~/pose")
    tf_broadcast: bool = _parameter(
        False, "publish the transform from map to odom; needs tf2 and continuous"
    )
    transform_tolerance: float = _parameter(1.0, "seconds for which that transform is dated ahead")
    queue_size: int = _parameter(2, "scans that may wait; the oldest falls out")
    scan_timeout: float = _parameter(2.0, "seconds without a scan until diagnostics complain")
    diagnostics_period: float = _parameter(1.0, "seconds between diagnostics")

    def __post_init__(self) -> None:
        for name in ("global_frame_id", "odom_frame_id", "base_frame_id"):
            if not getattr(self, name).strip("/ "):
                raise SettingsError(f"{name} must not be empty")
        for name in ("scan_topic", "odom_topic", "map_topic", "initial_pose_topic"):
            if not getattr(self, name):
                raise SettingsError(f"{name} must not be empty")
        if self.laser_pose is not None:
            pose = list(self.laser_pose)
            if len(pose) != 3 or not all(map(math.isfinite, pose)):
                raise SettingsError(f"laser_pose must be x, y, yaw, not {pose}")
        for name in ("map_spacing", "scan_timeout", "diagnostics_period"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise SettingsError(f"{name} must be positive, not {getattr(self, name)}")
        for name in ("robot_radius", "transform_tolerance"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise SettingsError(f"{name} must not be negative, not {getattr(self, name)}")
        if self.queue_size < 1:
            raise SettingsError(f"queue_size must be at least 1, not {self.queue_size}")
        if self.tf_broadcast and not self.continuous:
            raise SettingsError("tf_broadcast needs continuous: a transform is told all the time")

    @classmethod
    def meanings(cls) -> Mapping[str, tuple[Any, str]]:
        """Return default and meaning of every parameter, in order."""
        return {each.name: (each.default, each.metadata["meaning"]) for each in fields(cls)}

    def settings(self) -> Settings | None:
        """Return the settings of the matcher; None for those of the set, or the defaults.

        Raises:
            SettingsError: There is no such preset, or the file holds no settings.
        """
        if self.settings_file:
            try:
                return Settings.from_json(Path(self.settings_file).read_text(encoding="utf-8"))
            except (OSError, UnicodeDecodeError, SettingsError) as error:
                raise SettingsError(f"{self.settings_file}: {error}") from None
        return None if self.preset == "default" else Settings.preset(self.preset)
