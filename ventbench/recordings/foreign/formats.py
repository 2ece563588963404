"""Tables of numbers from files of every kind: recognised by their first bytes, read by a library.

Parquet (pyarrow), JSON, NumPy, MATLAB (scipy), EDF and BDF (pyedflib), WFDB (wfdb), MCAP (mcap)
and bags of ROS (rosbags). Nothing is resampled.
"""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Columns, Texts
from ventbench.base.errors import InputError, require
from ventbench.base.text import few
from ventbench.recordings.foreign import sizes
from ventbench.recordings.foreign.tables import (
    Table,
    clock_seconds,
    decoded,
    listed,
    named,
    rate_of,
    read_spreadsheet,
    read_text,
    readable,
)
from ventbench.recordings.headers import is_unit, read_header
from ventbench.recordings.sources import first_bytes


def read_table(
    path: str | Path, *, separator: str | None = None, decimal: str | None = None
) -> Table:
    """Read a table; the separator and the decimal mark of text are found out if None.

    The file is text (also gzipped), a spreadsheet (.xlsx), Parquet, NumPy, MATLAB, EDF, BDF, or the
    header (.hea) of a WFDB record.

    Raises:
        InputError: if the file cannot be read, or holds no table of numbers.
    """
    file, path = str(path), Path(path)
    if (path / "metadata.yaml").is_file():
        return _rosbag(file)
    first = first_bytes(path)
    if first.startswith(b"\x1f\x8b"):
        first = decoded(file)[0][:128]
    for beginnings, read in _readers().items():
        if first.startswith(beginnings):
            return read(file)
    if path.suffix == ".hea":
        return _wfdb(file)
    begins = first.lstrip(b"\xef\xbb\xbf \r\n\t")[:1]
    if begins in (b"{", b"["):
        content = _json(file)
        if content is not None:
            return content
    if first.startswith(b"PK\x03\x04"):
        if b".npy" in first:
            return _numpy(file)
        return read_spreadsheet(file)
    return read_text(file, separator, decimal)


def _readers() -> dict[tuple[bytes, ...], Callable[[str], Table]]:
    """What reads a file, by its first bytes."""
    return {
        (b"PAR1",): _parquet,
        (b"MATLAB 5.0",): _matlab,
        (b"\x93NUMPY",): _numpy,
        (b"0       ", b"\xffBIOSEMI"): _edf,
        (b"\x89MCAP",): _mcap,
        (b"#ROSBAG", b"SQLite format 3"): _rosbag,
    }


def _parquet(file: str) -> Table:
    from pyarrow import parquet

    with readable(file, "Parquet"):
        sizes.check_parquet(file)
        frame = parquet.read_table(file).to_pandas()
    if frame.index.dtype.kind in "Mf":
        frame = frame.rename_axis(index=frame.index.name or "time").reset_index()
    if frame.empty:
        raise InputError(f"{file} holds no rows")
    return _of_values(file, {str(header): frame[header] for header in frame}, "Parquet")


def _matlab(file: str) -> Table:
    from scipy.io import loadmat

    with readable(file, "a MATLAB file"):
        sizes.check_matlab(file)
        content = loadmat(file, simplify_cells=True)
    variables = {name: x for name, x in content.items() if not name.startswith("__")}
    return _of_document(file, variables, "MATLAB file")


def _numpy(file: str) -> Table:
    """The arrays of a ``.npz`` by name, the fields of a structured one, or columns by number."""
    with readable(file, "NumPy", "; save arrays of numbers by np.save or np.savez"):
        sizes.check_numpy(file)
        loaded = np.load(file, allow_pickle=False)
        arrays = loaded if isinstance(loaded, np.ndarray) else dict(loaded)
    return _of_document(file, arrays, "NumPy file")


def _json(file: str) -> Table | None:
    """Rows of a JSON document, or of a line each; None if the text is no JSON."""
    text = decoded(file)[0]
    try:
        content = json.loads(text)
    except json.JSONDecodeError:
        try:
            content = [json.loads(line) for line in text.splitlines() if line.strip()]
        except json.JSONDecodeError:
            return None
    return _of_document(file, content, "JSON")


def _of_document(file: str, content: Any, kind: str) -> Table:
    """The table in records, lists and arrays: their longest columns."""
    columns, beside = Columns(), dict[str, Any]()
    for path, value in _leaves(content).items():
        array = np.squeeze(value if isinstance(value, np.ndarray) else np.array(value, object))
        if array.ndim == 0:
            beside[path.rpartition(".")[2]] = array.item()
        elif array.ndim == 1:
            columns[path] = array
        elif array.ndim == 2:
            rows = array if array.shape[0] >= array.shape[1] else array.T
            columns |= {f"{path}.{k}".lstrip("."): x for k, x in enumerate(rows.T, 1)}
    counts = Counter(map(len, columns.values()))
    longest = max(counts, default=0)
    length = longest if counts[longest] > 1 else max(counts, key=lambda n: counts[n], default=0)
    used = {path: x for path, x in columns.items() if len(x) == length > 1}
    if len(used) < 2:
        raise InputError(
            f"{file} is {kind} without a table (it has {few([*columns, *beside], 5) or 'nothing'})"
            ": a list of records, columns of equal length by name, or rows beside a list of their "
            "names are wanted; a MATLAB table object must be saved as a struct or as columns"
        )
    omitted = [path for path in columns if path not in used]
    while len({path.partition(".")[:2] for path in used}) == 1 and "." in next(iter(used)):
        used = {path.partition(".")[2]: x for path, x in used.items()}  # all of `data.Paw`
    table = _of_values(file, used, kind)
    if omitted:
        table = table.noted(f"Columns of other lengths were left out ({few(omitted, 5)}).")
    stated = ((n, str(beside.get(key))) for n in table.columns for key in (n, f"{n}_unit"))
    units = {name: unit for name, unit in stated if is_unit(unit)}
    rates = (rate_of(name, number) for name, number in beside.items())
    rate = next((rate for rate in rates if rate is not None), None)
    return replace(table, rate=rate, units=table.units | units)


def _leaves(value: Any, path: str = "") -> dict[str, Any]:
    """Columns and single values of a document by their paths, whose parts are joined by points."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        value = {name: value[name] for name in value.dtype.names}
    if isinstance(value, list) and value and isinstance(value[0], list):
        first = next(iter(value[0]), None)
        if isinstance(first, dict | list):  # parts of one table
            return _leaves(list(chain.from_iterable(value)), path)
        if isinstance(first, str):
            return _leaves(_by_name({"names": value[0], path: value[1:]}))
    if isinstance(value, list) and value and all(isinstance(x, dict) for x in value):
        from pandas import json_normalize

        frame = json_normalize(list(map(_by_name, value)))
        for key, cell in frame.iloc[0].items():
            if isinstance(cell, list) and cell and isinstance(cell[0], dict):
                frame = frame.explode(key, ignore_index=True).dropna(subset=[key])
                frame = json_normalize(list(frame[key])).join(frame.drop(columns=key))
        return {f"{path}.{key}".lstrip("."): frame[key].to_numpy() for key in frame}
    if not isinstance(value, dict):
        return {path: value}
    unit, lists = value.get("unit"), [x for x in value.values() if isinstance(x, list)]
    if path and is_unit(str(unit)) and len(lists) == 1:
        return {f"{path} [{unit}]": lists[0]}
    leaves: dict[str, Any] = {}
    for name, inner in _by_name(value).items():
        leaves |= _leaves(inner, f"{path}.{name}".lstrip("."))
    return leaves


def _by_name(content: dict[str, Any]) -> dict[str, Any]:
    """A record with lists by name where it holds rows beside their names, or columns by row."""
    inner = [
        tuple(x) if isinstance(x, dict) and not any(isinstance(y, list) for y in x.values()) else ()
        for x in content.values()
    ]
    if len(inner) > 1 and len(inner[0]) > 1 and len(set(inner)) == 1:  # as pandas writes them
        if len(inner[0]) < len(content):
            return {"": list(content.values())}
        return {name: list(x.values()) for name, x in content.items()}
    lists = {name: x for name, x in content.items() if isinstance(x, list) and x}
    for name, rows in lists.items():
        widths = {len(row) if isinstance(row, list) else 0 for row in rows}
        titles = (n for n, x in lists.items() if {len(x)} == widths and isinstance(x[0], str))
        if (title := next(titles, None)) is not None:
            values = map(list, zip(*rows, strict=True))
            rest = {n: x for n, x in content.items() if n not in (name, title)}
            return rest | {name: dict(zip(map(str, lists[title]), values, strict=True))}
    return content


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
        (r for name, r in zip(names, rates, strict=True) if read_header(name).role == "pressure"),
        Counter(rates).most_common(1)[0][0] if rates else 0.0,
    )
    chosen = [k for k, each in enumerate(rates) if each == rate]
    headers = named([names[k] for k in chosen])
    pairs = list(zip(headers, chosen, strict=True))
    columns = {name: np.asarray(values[k], float) for name, k in pairs}
    spelt = {name: units[k] for name, k in pairs if units[k] != "NU"}  # WFDB's "no units"
    if not columns or not len(next(iter(columns.values()))):
        raise InputError(f"{file} holds no signal; name the file of the waveforms")
    notes = [f"{kind} with {len(columns)} signals at {rate:g} Hz."]
    omitted = [f"{n} ({r:g} Hz)" for n, r in zip(names, rates, strict=True) if r != rate]
    if omitted:
        notes.append(f"Signals of other rates were left out ({', '.join(omitted)}).")
    return Table(file, columns, spelt, None, float(rate), tuple(notes), headers)


def _edf(file: str) -> Table:
    require(
        "pyedflib",
        extra="formats",
        what="EDF files (from Python 3.13 on, `pip install pyedflib` first, with a C compiler)",
    )
    from pyedflib import highlevel

    with readable(file, "EDF", "; it must be continuous (EDF, EDF+C or BDF)"):
        sizes.refuse(file, 4.0 * Path(file).stat().st_size, "its samples")  # of 2 bytes, then 8
        signals, headers, _ = highlevel.read_edf(file)
    names, units, rates = (
        [header[key] for header in headers] for key in ("label", "dimension", "sample_frequency")
    )
    return _channels(file, "EDF", names, units, rates, list(signals))


def _wfdb(file: str) -> Table:
    with warnings.catch_warnings():  # of pandas, about what wfdb does with its tables
        warnings.simplefilter("ignore", DeprecationWarning)
        require("wfdb", extra="formats", what="WFDB records")
        import wfdb

        with readable(file, "a WFDB record", "; its signal files must lie beside it"):
            sizes.check_wfdb(file)
            record = wfdb.rdrecord(file.removesuffix(".hea"), smooth_frames=False)
    if not isinstance(record, wfdb.Record):
        raise InputError(f"{file} is a record of segments; name the header of one of them")
    rates = [record.fs * samples for samples in record.samps_per_frame or ()]
    return _channels(
        file, "WFDB", record.sig_name or (), record.units or (), rates, record.e_p_signal or ()
    )


def _of_values(file: str, columns: Mapping[str, Any], kind: str) -> Table:
    """Columns of any values: numbers where they are, words elsewhere."""
    from pandas import Series

    names, units = named(list(columns)), Texts()
    arrays: Columns = {}
    for name, header in names.items():
        values = Series(columns[header])
        if values.dtype.kind == "M":
            arrays[name] = values.to_numpy("datetime64[ns]").astype(np.int64) * 1e-9
            continue
        try:
            arrays[name] = values.where(values != "").to_numpy(float, na_value=np.nan)
        except (TypeError, ValueError):
            lists = listed(list(values))
            words = values.fillna("").astype(str)
            clock = clock_seconds(words) if lists is None else None
            units |= {name: "s"} if clock is not None else {}
            arrays[name] = next(x for x in (lists, clock, words.to_numpy(str)) if x is not None)
    note = f"{kind} with {len(arrays)} columns of {len(next(iter(arrays.values())))} rows."
    return Table(file, arrays, units, notes=(note,), headers=names)


def _mcap(file: str) -> Table:
    """Messages in JSON of the topic with most of them; their times are those of the log."""
    require("mcap", extra="mcap", what="MCAP files")
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    topics: dict[str, list[dict[str, Any]]] = {}
    with readable(file, "MCAP", also=McapError), open(file, "rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.message_encoding != "json":
                return _rosbag(file)
            record = {"time": 1e-9 * message.log_time} | json.loads(message.data)
            topics.setdefault(channel.topic, []).append(record)
    return _of_topics(file, topics, "MCAP")


def _rosbag(file: str) -> Table:
    """Messages of the topic with most of them; the times are those at which they were recorded."""
    require("rosbags", extra="ros", what="bags of ROS")
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    topics: dict[str, list[dict[str, Any]]] = {}
    path = Path(file)
    store = get_typestore(Stores.LATEST)
    folder = path if path.is_dir() or path.suffix == ".bag" else path.parent
    with (
        readable(file, "a bag of ROS", "; export another database as CSV", AnyReaderError),
        AnyReader([folder], default_typestore=store) as bag,
    ):
        for connection, at, data in bag.messages():
            message = bag.deserialize(data, connection.msgtype)
            topics.setdefault(connection.topic, []).append({"time": 1e-9 * at} | _fields(message))
    return _of_topics(file, topics, "ROS bag")


def _fields(message: Any) -> dict[str, Any]:
    """Numbers and words of a message, and of those within it but their headers."""
    return {
        name: _fields(value) if hasattr(value, "__dict__") else value
        for name, value in vars(message).items()
        if name not in ("header", "__msgtype__") and not isinstance(value, np.ndarray | list)
    }


def _of_topics(file: str, topics: dict[str, list[dict[str, Any]]], kind: str) -> Table:
    """The topics of the most messages as one table: a row a time, the last value of each."""
    from pandas import concat, json_normalize

    if not topics:
        raise InputError(f"{file} holds no messages")
    most = max(map(len, topics.values()))
    frames = {
        topic: json_normalize(messages).set_index("time")
        for topic, messages in topics.items()
        if 2 * len(messages) >= most
    }
    names = Counter(name for frame in frames.values() for name in frame)
    if max(names.values()) > 1:
        frames = {topic: frame.add_prefix(f"{topic}/") for topic, frame in frames.items()}
    merged = concat(frames.values()).groupby(level="time").last().reset_index()
    table = _of_values(file, {str(key): x for key, x in merged.items()}, kind)
    if not (omitted := [topic for topic in topics if topic not in frames]):
        return table
    return table.noted(f"Topics of fewer messages were left out ({', '.join(omitted)}).")
