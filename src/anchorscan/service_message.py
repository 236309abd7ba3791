"""What requests to the service hold and what its answers hold, checked and described."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, FailFast, Field

from .pose import Pose2D
from .scan import LaserScan
from .scan_message import MOST_READINGS, scan_of
from .set_file import Place

__all__ = [
    "AddedOut",
    "AnswerOut",
    "BatchIn",
    "BatchOut",
    "BuildingHypothesisOut",
    "ErrorOut",
    "HealthOut",
    "HypothesisOut",
    "LocatedOut",
    "PoseIn",
    "PoseOut",
    "ReferenceIn",
    "ReferencesIn",
    "ScanIn",
    "SetOut",
    "SetsOut",
    "WhichOut",
]

Value = TypeVar("Value")
# Of a list in which all is wrong, the first is told: to collect the errors takes far more memory
# than the request.
_Values = Annotated[list[Value], FailFast()]

# What requests hold.  Strict: "1" is no number.


class ScanIn(BaseModel):
    """A scan, with the fields of sensor_msgs/LaserScan; metres, radians.

    A range may be null or "nan" (no information), "inf" (nothing within reach), "-inf" (too close).
    """

    model_config = ConfigDict(strict=True, extra="forbid", title="LaserScan")

    angle_min: float
    angle_increment: float
    ranges: _Values[float | Literal["inf", "-inf", "nan"] | None] = Field(max_length=MOST_READINGS)
    range_min: float = 0.0
    range_max: float | Literal["inf"] = 80.0
    header: dict[str, Any] | None = Field(None, description="passed over, as all below")
    angle_max: float | None = None
    time_increment: float | None = None
    scan_time: float | None = None
    intensities: list[Any] | None = None

    def scan(self) -> LaserScan:
        """Return what it stands for."""
        return scan_of({name: getattr(self, name) for name in _SCAN_FIELDS})


_SCAN_FIELDS = ("angle_min", "angle_increment", "ranges", "range_min", "range_max")


class BatchIn(BaseModel):
    """Scans, each located by itself in one version of the set."""

    model_config = ConfigDict(strict=True, extra="forbid")

    scans: _Values[ScanIn] = Field(min_length=1)


class PoseIn(BaseModel):
    """A pose of the laser in the frame of the set; metres, radians."""

    model_config = ConfigDict(strict=True, extra="forbid")

    x: float
    y: float
    theta: float


class ReferenceIn(BaseModel):
    """A reference to be."""

    model_config = ConfigDict(strict=True, extra="forbid")

    scan: ScanIn
    pose: PoseIn | None = None
    name: str = Field("", max_length=1000)

    def place(self) -> Place:
        """Return what it stands for."""
        pose = None if self.pose is None else Pose2D(self.pose.x, self.pose.y, self.pose.theta)
        return Place(self.scan.scan(), pose, self.name)


class ReferencesIn(BaseModel):
    """References, all or none of which are added."""

    model_config = ConfigDict(strict=True, extra="forbid")

    references: _Values[ReferenceIn] = Field(min_length=1)


# What answers hold.


class ErrorOut(BaseModel):
    """What is wrong, in one line."""

    error: str


class HealthOut(BaseModel):
    """The service can answer."""

    status: Literal["ok"]
    sets: int
    version: str


class SetOut(BaseModel):
    """A set."""

    name: str
    version: str
    references: int
    with_pose: int
    bytes: int | None


class SetsOut(BaseModel):
    """The sets of the folder; those that cannot be read, with the reason."""

    sets: list[SetOut]
    unreadable: dict[str, str]


class PoseOut(BaseModel):
    """A pose; nulls where the set has no common frame."""

    x: float | None
    y: float | None
    theta: float | None


class HypothesisOut(PoseOut):
    """One possible place, as in the lines of ``anchorscan locate``."""

    reference: int
    pose_in_reference: PoseOut
    covariance: list[list[float]]
    evaluation: float | None
    quality: float | None
    score: float | None
    probability: float
    accepted: bool
    ambiguous: bool


class AnswerOut(BaseModel):
    """What is said to one scan; hypotheses best first."""

    accepted: bool
    state: str
    seconds: float
    hypotheses: list[HypothesisOut]


class LocatedOut(AnswerOut):
    """The answer, and the version of the set that it is of."""

    version: str


class BatchOut(BaseModel):
    """The answers in the order of the scans, all of one version of the set."""

    version: str
    answers: list[AnswerOut]


class BuildingHypothesisOut(HypothesisOut):
    """One possible place among all sets."""

    building: str
    version: str


class WhichOut(BaseModel):
    """What is said to one scan; probabilities know of all sets."""

    accepted: bool
    state: str
    seconds: float
    sets: int
    hypotheses: list[BuildingHypothesisOut]


class AddedOut(BaseModel):
    """Identifiers of the new references, and the version of the set with them."""

    version: str
    identifiers: list[int]
