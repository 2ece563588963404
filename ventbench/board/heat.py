"""Heat maps of an entry page: errors of lungs by PIPs, and their difference to the PID."""

from __future__ import annotations

from typing import Any

import numpy as np

from ventbench.board.record import Record
from ventbench.text import number

#: Limits between the shades, cmH2O: the same for all entries, so that maps can be compared.
ERRORS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)
DIFFERENCES = (0.02, 0.2, 0.7, 2.0)


def errors(record: Record) -> list[dict[str, Any]]:
    """Rows of the map of mean errors over draws; the nominal error beside each."""
    cells = record.drawn.mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {
                    "text": number(value),
                    "small": number(nominal),
                    "shade": f"h{np.searchsorted(ERRORS, value)}" if np.isfinite(value) else "hx",
                }
                for value, nominal in zip(cells[i], record.nominal[i], strict=True)
            ],
            "mean": number(float(cells[i].mean())),
        }
        for i, lung in enumerate(record.lungs)
    ]


def differences(record: Record, other: Record) -> list[dict[str, Any]]:
    """Rows of the map of differences to another record, mean over draws; below zero is better."""
    cells = record.drawn.mean(axis=0) - other.drawn.mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [{"text": _signed(value), "shade": _shade(value)} for value in cells[i]],
            "mean": _signed(float(cells[i].mean())),
        }
        for i, lung in enumerate(record.lungs)
    ]


def _signed(value: float) -> str:
    return number(value, sign=True) if np.isfinite(value) else "–"


def _shade(value: float) -> str:
    if not np.isfinite(value):
        return "hx"
    level = int(np.searchsorted(DIFFERENCES, abs(value)))
    return f"{'b' if value < 0 else 'w'}{level}" if level else "h0"
