"""Tables of numbers from files of every kind: recognised by their first bytes, read by a library.

Parquet (pyarrow), MATLAB (scipy), EDF and BDF (pyedflib), and WFDB (wfdb). Nothing is resampled.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputError, require
from ventbench.recordings.foreign.layouts import USUAL, spelled, stem, unit_of
from ventbench.recordings.foreign.tables import RATES, Table, read_spreadsheet, read_text


def read_table(
    path: str | Path, *, separator: str | None = None, decimal: str | None = None
) -> Table:
    """Read a table; the separator and the decimal mark of text are found out if None.

    The file is text (also gzipped), a spreadsheet (.xlsx), Parquet, MATLAB, EDF, BDF, or the header
    (.hea) of a WFDB record.

    Raises:
        InputError: if the file cannot be read, or holds no table of numbers.
    """
    file, path = str(path), Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{file} {what}; name a CSV, Parquet or .mat file")
    with open(path, "rb") as stream:
        first = stream.read(128)
    if not first:
        raise InputError(f"{file} is empty")
    if first.startswith(b"PAR1"):
        return _parquet(file)
    if first.startswith(b"MATLAB 5.0"):
        return _matlab(file)
    if first.startswith((b"MATLAB 7.3", b"\x89HDF")):
        raise InputError(
            f"{file} is HDF5 (MATLAB 7.3, a log of PyTables?); save it with `save(..., '-v7')` in "
            "MATLAB, or export the table as CSV"
        )
    if first.startswith((b"0       ", b"\xffBIOSEMI")):
        return _edf(file)
    if path.suffix == ".hea":
        return _wfdb(file)
    if first.startswith(b"PK\x03\x04"):
        return read_spreadsheet(file)
    return read_text(file, separator, decimal)


def _parquet(file: str) -> Table:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        frame = parquet.read_table(file).to_pandas()
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{file} cannot be read ({str(error).splitlines()[0]})") from None
    columns, units = {}, {}
    for header in frame.columns:
        name, unit = unit_of(str(header))
        values = frame[header]
        kind = values.dtype.kind
        if kind == "M":
            columns[name] = values.to_numpy("datetime64[ns]").astype(np.int64) * 1e-9
        elif kind in "iufb":
            columns[name] = values.to_numpy(float)
        else:
            columns[name] = values.astype(str).to_numpy(str)
        if unit:
            units[name] = unit
    if not columns or len(frame) == 0:
        raise InputError(f"{file} holds no rows")
    return Table(file, columns, units, None, None, ("Parquet.",))


def _matlab(file: str) -> Table:
    from scipy.io import loadmat

    try:
        content = loadmat(file, simplify_cells=True)
    except (ValueError, NotImplementedError, OSError, TypeError) as error:
        raise InputError(f"{file} cannot be read as a MATLAB file ({error})") from None
    return _variables(file, content)


def _variables(file: str, content: dict[str, Any]) -> Table:
    """The columns among a MATLAB file's variables."""
    flat: dict[str, NDArray[Any]] = {}
    scalars: dict[str, float] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, flat, scalars)
    if not flat:
        raise InputError(
            f"{file} holds no column of numbers (variables: "
            f"{', '.join(n for n in content if not n.startswith('__')) or 'none'}); a MATLAB table "
            "object must be saved as a struct or as columns"
        )
    length = Counter(len(v) for v in flat.values()).most_common(1)[0][0]
    longest = max(len(v) for v in flat.values())
    same = [name for name, v in flat.items() if len(v) == longest]
    length = longest if len(same) > 1 else length
    columns = {name: v for name, v in flat.items() if len(v) == length}
    # Short names, where they are unique: `data.Paw` is `Paw`.
    last = Counter(name.rpartition(".")[2] for name in columns)
    columns = {
        name.rpartition(".")[2] if last[name.rpartition(".")[2]] == 1 else name: v
        for name, v in columns.items()
    }
    others = [name for name, v in flat.items() if len(v) != length]
    notes = [f"MATLAB file with {len(columns)} columns of {length} rows."]
    if others:
        notes.append(f"Columns of other lengths were left out ({', '.join(others[:5])}).")
    named = {re.sub(r"[^a-z]", "", n.rpartition(".")[2].lower()): v for n, v in scalars.items()}
    rate = next((named[name] for name in RATES if named.get(name, 0.0) > 0.0), None)
    units = {name: unit for name in columns if (unit := unit_of(name)[1])}
    return Table(file, columns, units, None, rate, tuple(notes))


def _flatten(
    name: str, value: Any, flat: dict[str, NDArray[Any]], scalars: dict[str, float]
) -> None:
    """Collect the columns and single numbers of a MATLAB variable."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(f"{name}.{key}", inner, flat, scalars)
        return
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        for key in value[0]:  # an array of records
            _flatten(f"{name}.{key}", [row.get(key) for row in value], flat, scalars)
        return
    try:
        array = np.squeeze(np.asarray(value, float))
    except (TypeError, ValueError):
        return
    if array.ndim == 0:
        scalars[name] = float(array)
    elif array.ndim == 1 and len(array) > 1:
        flat[name] = array
    elif array.ndim == 2:
        rows = array if array.shape[0] >= array.shape[1] else array.T
        for k in range(rows.shape[1]):
            flat[f"{name}.{k + 1}"] = rows[:, k]


def _channels(
    file: str,
    kind: str,
    names: Sequence[str],
    units: Sequence[str],
    rates: Sequence[float],
    values: Sequence[NDArray[Any]],
) -> Table:
    """The channels that share the pressure's rate, or else the commonest."""
    rate = next(
        (r for name, r in zip(names, rates, strict=True) if USUAL.get(stem(name)) == "pressure"),
        Counter(rates).most_common(1)[0][0] if rates else 0.0,
    )
    columns: dict[str, NDArray[Any]] = {}
    spelt: dict[str, str] = {}
    for name, unit, signal_rate, signal in zip(names, units, rates, values, strict=True):
        if signal_rate != rate:
            continue
        while name in columns:
            name += "_"
        columns[name] = np.asarray(signal, float)
        if unit and unit != "NU":  # WFDB's "no units"
            spelt[name] = spelled(unit)
    if not columns or not len(next(iter(columns.values()))):
        raise InputError(f"{file} holds no signal; name the file of the waveforms")
    notes = [f"{kind} with {len(columns)} signals at {rate:g} Hz."]
    left = [f"{n} ({r:g} Hz)" for n, r in zip(names, rates, strict=True) if r != rate]
    if left:
        notes.append(f"Signals of other rates were left out ({', '.join(left)}).")
    return Table(file, columns, spelt, None, float(rate), tuple(notes))


def _edf(file: str) -> Table:
    require("pyedflib", extra="formats", what="EDF files")
    from pyedflib import highlevel

    try:
        signals, headers, _ = highlevel.read_edf(file)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{file} cannot be read as EDF ({error}); it must be continuous (EDF, EDF+C or BDF)"
        ) from None
    names, units, rates = (
        [header[key] for header in headers] for key in ("label", "dimension", "sample_frequency")
    )
    return _channels(file, "EDF", names, units, rates, list(signals))


def _wfdb(file: str) -> Table:
    with warnings.catch_warnings():  # of pandas, about what wfdb does with its tables
        warnings.simplefilter("ignore", DeprecationWarning)
        require("wfdb", extra="formats", what="WFDB records")
        import wfdb

        try:
            record = wfdb.rdrecord(file.removesuffix(".hea"), smooth_frames=False)
        except (OSError, ValueError, IndexError) as error:
            raise InputError(
                f"{file} cannot be read as a WFDB record ({error}); its signal files "
                "must lie beside it"
            ) from None
    if not isinstance(record, wfdb.Record):
        raise InputError(f"{file} is a record of segments; name the header of one of them")
    rates = [record.fs * samples for samples in record.samps_per_frame or ()]
    return _channels(
        file, "WFDB", record.sig_name or (), record.units or (), rates, record.e_p_signal or ()
    )
