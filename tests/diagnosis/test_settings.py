"""The settings of a diagnosis."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re

import pytest

from ventbench.diagnosis.settings import DEFAULT, VERSION, SelectionConfig


def test_settings_are_frozen_versioned_json_values():
    values = json.loads(json.dumps(dataclasses.asdict(DEFAULT)))
    assert values["version"] == VERSION
    assert values["held_out_test"]["threshold"] == 4.6
    assert set(values) == {field.name for field in dataclasses.fields(SelectionConfig)}
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT.fit.tolerance = 1.0  # type: ignore[misc]


def test_every_setting_is_described_in_its_group():
    for field in dataclasses.fields(SelectionConfig):
        group = getattr(DEFAULT, field.name)
        if not dataclasses.is_dataclass(group):
            continue
        source = inspect.getsource(type(group))
        for setting in dataclasses.fields(group):
            lines = rf"(#: [^\n]+\n    {setting.name}: |\n    {setting.name}: [^\n]+  #: \w)"
            assert re.search(lines, source), f"{field.name}.{setting.name}"
