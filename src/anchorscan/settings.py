"""All settings: one section per stage, and the presets.

``paper`` does what the paper says and nothing more, so that its figures stay reproducible.
Where the paper names no figure, the field's description in the section says what it is for,
and the value is the one that did best on the logs named in the module that uses it.
"""

from __future__ import annotations

import difflib
import functools
import json
import math
import types
from collections.abc import Mapping
from typing import Any, Literal, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic.functional_validators import ModelWrapValidatorHandler

from .alignment import AlignmentSettings
from .anchors import AnchorSettings
from .belief import BeliefSettings
from .database import DatabaseSettings
from .decision import DecisionSettings
from .errors import SettingsError
from .evaluation import AcceptanceSettings, EvaluationSettings
from .field import FieldSettings
from .graph import GraphSettings
from .proposal import ProposalSettings
from .verification import VerificationSettings

__all__ = ["PRESETS", "Settings"]

# False anchor points cost little where every proposal is checked, so extraction is generous.
_MAP: Mapping[str, Any] = {
    "anchors": {
        "angle_function": {"baseline": 0.3, "fitted": True},
        "segments": {"smallest_extent": 0.2},
        "smallest_rim_angle": math.radians(8.0),
        "smallest_turn": math.radians(25.0),
        "arm": 0.3,
        "shortest_arm": 0.12,
        "smallest_wall": 0.5,
        "most_walls": 6,
        "facing": True,
        "most_main_angles": 1,
    },
    "acceptance": {"hypotheses": 3},
}

# The paper's method with its five candidates.  The figures that it does not name were chosen on
# freiburg-079, csail and Killian Court; intel, freiburg-101 and wean had no part in that.
_PAPER: Mapping[str, Any] = {
    "method": "references",
    "anchors": {
        "finest_increment": 0.0,
        "smallest_wall": 0.5,
        "smallest_turn": math.radians(30.0),
    },
    "database": {
        "relation": "length",
        "length_tolerance": 0.06,
        "count_once": True,
        "candidates": 5,
    },
    "alignment": {"length_tolerance": 0.07, "matrix_peaks": 2},
}

_LONGEST_SHOWN = 60
_LARGEST = float(1 << 24)

# What a preset says differently from the defaults of the sections.
PRESETS: Mapping[str, Mapping[str, Any]] = types.MappingProxyType(
    {
        "paper": _PAPER,
        "default": _MAP,
        "thorough": {
            **_MAP,
            "proposal": {"enough": 1 << 16, "most": 600},
            "verification": {
                "second_readings": 60,
                "third_readings": 180,
                "third_poses": 200,
                "fits": 20,
                "fit_readings": 360,
                "iterations": 12,
                "follow_iterations": 12,
                "last_readings": 360,
                "rays": 180,
            },
            "decision": {
                "constant": -5.10,
                "log_margin": 1.20,
                "explained": 1.04,
                "through": -3.65,
                "heading": 0.80,
                "anchors": 0.71,
                "readings_alike": 3.0,
            },
        },
    }
)


class Settings(BaseModel):
    """Settings of every stage, from scan to decision."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    method: Literal["map", "references"] = Field(
        "map", description="search all references as one map, or one by one as the paper does"
    )
    anchors: AnchorSettings = AnchorSettings()
    graph: GraphSettings = GraphSettings()
    database: DatabaseSettings = DatabaseSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    acceptance: AcceptanceSettings = AcceptanceSettings()
    field: FieldSettings = FieldSettings()
    proposal: ProposalSettings = ProposalSettings()
    verification: VerificationSettings = VerificationSettings()
    decision: DecisionSettings = DecisionSettings()
    belief: BeliefSettings = BeliefSettings()

    @classmethod
    def preset(cls, name: str = "default") -> Settings:
        """Return a preset: ``default``, ``paper`` or ``thorough``.

        Raises:
            SettingsError: There is no preset of that name.
        """
        if name not in PRESETS:
            raise SettingsError(f"unknown preset {name!r}{_nearest(name, PRESETS)}")
        return _preset(name)

    @classmethod
    def from_json(cls, text: str | bytes) -> Settings:
        """Read settings from JSON; what is left out is as in the default preset.

        Raises:
            SettingsError: The text is no JSON, a name is unknown or a value impossible.
        """
        try:
            changes = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SettingsError(f"settings are not JSON: {error}") from None
        if not isinstance(changes, dict):
            raise SettingsError("settings are a JSON object with a section per stage")
        return cls.preset().changed(changes)

    def to_json(self) -> str:
        """Write all settings as JSON."""
        return self.model_dump_json(indent=2)

    def changed(self, changes: Mapping[str, Any]) -> Settings:
        """Return a copy with some values replaced.

        Args:
            changes: Nested as the sections are, ``{"database": {"candidates": 10}}``.

        Raises:
            SettingsError: A name is unknown or a value impossible.
        """
        return type(self).model_validate(_merged(self.model_dump(), changes))

    @model_validator(mode="wrap")
    @classmethod
    def _explain(cls, values: Any, handler: ModelWrapValidatorHandler[Settings]) -> Settings:
        try:
            settings = handler(values)
        except ValidationError as error:
            raise SettingsError(_explanation(cls, error)) from None
        if name := _immense(settings):
            raise SettingsError(f"{name}: is too large a number to be meant")
        return settings


@functools.cache
def _preset(name: str) -> Settings:
    return Settings.model_validate(PRESETS[name])


def _immense(model: BaseModel, path: str = "") -> str:
    """Return the name of the first number that no stage can work with, "" where there is none."""
    for name, value in model:
        if isinstance(value, BaseModel):
            if found := _immense(value, f"{path}{name}."):
                return found
        elif isinstance(value, int | float) and abs(value) > _LARGEST:
            return path + name
    return ""


def _merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(values)
    for name, change in changes.items():
        old = merged.get(name)
        both = isinstance(old, Mapping) and isinstance(change, Mapping)
        merged[name] = _merged(old, change) if both else change  # type: ignore[arg-type]
    return merged


def _explanation(model: type[BaseModel], error: ValidationError) -> str:
    """Say in one line what is wrong with the first setting that is."""
    first = error.errors(include_url=False)[0]
    path = [str(part) for part in first["loc"]]
    where = ".".join(path) or "settings"
    if first["type"] != "extra_forbidden":
        return f"{where}: {first['msg']}"
    section: type[BaseModel] = model
    for part in path[:-1]:
        section = _section(section, part)
    name = path[-1][:_LONGEST_SHOWN]
    where = ".".join([*path[:-1], name])
    return f"unknown setting {where!r}{_nearest(name, section.model_fields, path[:-1])}"


def _section(model: type[BaseModel], name: str) -> type[BaseModel]:
    """Return the model of a section."""
    annotation = model.model_fields[name].annotation
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return model


def _nearest(name: str, known: Mapping[str, Any], path: list[str] | None = None) -> str:
    """Suggest the known name that looks most like an unknown one, or list them all."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    prefix = "".join(f"{part}." for part in path or ())
    return f"; did you mean {prefix + close[0]!r}?" if close else ""
