"""Settings: presets, JSON, and errors that name the nearest key."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from anchorscan import Settings, SettingsError
from anchorscan.settings import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_json(name):
    preset = Settings.preset(name)
    assert Settings.from_json(preset.to_json()) == preset


def test_what_is_left_out_is_as_in_the_default_preset():
    default = Settings.preset("default")
    assert Settings.from_json("{}") == default
    changes = {"database": {"candidates": 9}}
    assert Settings.from_json('{"database": {"candidates": 9}}') == default.changed(changes)


@pytest.mark.parametrize(
    ("changes", "nearest"),
    [
        ({"databse": {}}, "database"),
        ({"database": {"candidate": 3}}, "database.candidates"),
        ({"alignment": {"lenght_tolerance": 0.1}}, "alignment.length_tolerance"),
        (
            {"anchors": {"angle_function": {"base_line": 0.3}}},
            "anchors.angle_function.baseline",
        ),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(changes, nearest):
    with pytest.raises(SettingsError, match=f"unknown setting .*did you mean '{nearest}'"):
        Settings().changed(changes)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('{"database": {"candidates": 0}}', "database.candidates"),
        ('{"evaluation": {"tolerance": "wide"}}', "evaluation.tolerance"),
        ("{", "JSON"),
        ("[]", "settings"),
    ],
)
def test_impossible_values_are_one_clear_line(text, word):
    with pytest.raises(SettingsError, match=word) as caught:
        Settings.from_json(text)
    assert "\n" not in str(caught.value)


def test_an_unknown_preset_is_answered_with_the_nearest():
    with pytest.raises(SettingsError, match="did you mean 'paper'"):
        Settings.preset("papers")


def test_settings_do_not_change():
    with pytest.raises(ValidationError, match="frozen"):
        Settings().graph = None
