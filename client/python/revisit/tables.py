"""Answers of the service as columns of numpy arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, KeysView, Mapping
from typing import TYPE_CHECKING, Any, Callable, Optional

import numpy as np
from numpy.typing import NDArray

from revisit import v1
from revisit._display import html_table, spread

if TYPE_CHECKING:
    import pandas

Array = NDArray[Any]

_NO_STAMP = np.datetime64("NaT", "ns")


class Table:
    """Columns of equal length by name, as in a DataFrame: `table["x"]` is a column,
    iterating goes over the names, and `len(table)` is the number of rows. A column may
    have rows of several numbers, such as covariances."""

    def __init__(self, columns: Mapping[str, Array]) -> None:
        self._columns = dict(columns)

    def __getitem__(self, name: str) -> Array:
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self._columns.values())))

    def keys(self) -> KeysView[str]:
        """The names of the columns: `dict(table)` has them."""
        return self._columns.keys()

    def __repr__(self) -> str:
        return f"<Table of {len(self)} rows: {', '.join(self)}>"

    def _repr_html_(self) -> str:
        """The first and last rows, for a notebook."""
        return html_table(self._columns, f"{len(self)} rows")

    def where(self, mask: Array) -> Table:
        """The rows for which the mask is true, or that a list of numbers names."""
        return Table({name: column[mask] for name, column in self._columns.items()})

    def to_pandas(self) -> pandas.DataFrame:
        """The same as a DataFrame, its stamps with the time zone UTC; rows of several
        numbers become columns of their own, covariances as `covariance_xx`,
        `covariance_xy` and so on. Needs pandas."""
        import pandas

        columns: dict[str, Any] = {}
        for name, column in self._columns.items():
            if column.dtype.kind == "M":
                columns[name] = pandas.DatetimeIndex(column, tz="UTC")
            else:
                columns.update(spread(name, column))
        return pandas.DataFrame(columns)


def _name_of(enum: Any, value: int, prefix: str) -> str:
    """The name of a value without what all names of the enum begin with, as the
    number if it is newer than this package."""
    try:
        return str(enum.Name(value)).removeprefix(prefix)
    except ValueError:
        return str(value)


def _numbers(rows: list[Any], value: Callable[[Any], float],
             kind: Any = np.float64) -> Array:
    return np.array([value(row) for row in rows], dtype=kind)


def _optional(rows: list[Any], field: str) -> Array:
    """A number per row, NaN where it is absent."""
    return _numbers(rows, lambda row: (getattr(row, field) if row.HasField(field)
                                       else np.nan))


def _part(rows: list[Any], part: str, field: str) -> Array:
    """A number per row, out of a message in it; NaN where that is absent."""
    return _numbers(rows, lambda row: (getattr(getattr(row, part), field)
                                       if row.HasField(part) else np.nan))


def _names(rows: list[Any], value: Callable[[Any], int], enum: Any,
           prefix: str) -> Array:
    return np.array([_name_of(enum, value(row), prefix) for row in rows], dtype=np.str_)


def _covariances(rows: list[v1.Covariance]) -> Array:
    """(N, 6) or (N, 10) by the state space, NaN where absent."""
    width = max((len(row.values) for row in rows), default=0) or 6
    made = np.full((len(rows), width), np.nan)
    for index, row in enumerate(rows):
        made[index, :len(row.values)] = row.values
    return made


def _node_columns(nodes: list[v1.Node], prefix: str = "") -> dict[str, Array]:
    stamps = np.full(len(nodes), _NO_STAMP)
    for row, node in enumerate(nodes):
        if node.HasField("stamp"):
            stamps[row] = np.datetime64(
                node.stamp.seconds * 1_000_000_000 + node.stamp.nanos, "ns")
    columns = {
        "index": _numbers(nodes, lambda node: node.index, np.int64),
        "sequence": _numbers(nodes, lambda node: node.sequence, np.uint64),
        "fraction": _numbers(nodes, lambda node: node.fraction),
        "stamp": stamps,
        "travelled": _numbers(nodes, lambda node: node.travelled_meters),
        "x": _numbers(nodes, lambda node: node.pose.x_meters),
        "y": _numbers(nodes, lambda node: node.pose.y_meters),
        "z": _numbers(nodes, lambda node: node.pose.z_meters),
        "heading": _numbers(nodes, lambda node: node.pose.heading_radians),
    }
    return {prefix + name: column for name, column in columns.items()}


def node_table(nodes: Iterable[v1.Node]) -> Table:
    """A row per node: `index`, `sequence`, `fraction`, `stamp` (NaT where absent),
    `travelled`, `x`, `y`, `z`, `heading` in metres and radians, and `covariance`
    (N, 6) or (N, 10)."""
    rows = list(nodes)
    columns = _node_columns(rows)
    columns["covariance"] = _covariances([row.covariance for row in rows])
    return Table(columns)


def edge_table(edges: Iterable[v1.Edge]) -> Table:
    """A row per edge: `from_index`, `to_index`, `kind` ("CONSECUTIVE" or
    "LOOP_CLOSURE")."""
    rows = list(edges)
    return Table({
        "from_index": _numbers(rows, lambda row: row.from_index, np.int64),
        "to_index": _numbers(rows, lambda row: row.to_index, np.int64),
        "kind": _names(rows, lambda row: row.kind, v1.EdgeKind, "EDGE_KIND_")})


def recording_table(recordings: Iterable[v1.Recording]) -> Table:
    """A row per recording, as `client.list_recordings()` lists them: `name`, `label`,
    `first_sequence`, `last_sequence`, `relation` ("after", "datum", "unknown", or "" of
    a first one that was not told of any), `frame_state` ("SAME", "AFTER", "DATUM",
    "PROVISIONAL", "KNOWN", "NONE"), and the pose of its frame in that of the last one:
    `frame_x`, `frame_y`, `frame_z`, `frame_heading`, with `frame_covariance` at the
    place `reference_x`, `reference_y` of its own frame (NaN where absent)."""
    rows = list(recordings)

    def relation(row: v1.Recording) -> str:
        if not row.HasField("start"):
            return ""
        return row.start.WhichOneof("relation") or "after"

    columns: dict[str, Array] = {
        "name": np.array([row.name for row in rows], dtype=np.str_),
        "label": np.array([row.label for row in rows], dtype=np.str_),
        "first_sequence": _numbers(rows, lambda row: row.first_sequence, np.uint64),
        "last_sequence": _numbers(rows, lambda row: row.last_sequence, np.uint64),
        "relation": np.array([relation(row) for row in rows], dtype=np.str_),
        "frame_state": _names(rows, lambda row: row.frame_state, v1.FrameState,
                              "FRAME_STATE_")}
    for name, field in (("x", "x_meters"), ("y", "y_meters"), ("z", "z_meters"),
                        ("heading", "heading_radians")):
        columns[f"frame_{name}"] = _part(rows, "frame_pose", field)
    columns["frame_covariance"] = _covariances([row.frame_covariance for row in rows])
    for name, field in (("x", "x_meters"), ("y", "y_meters")):
        columns[f"reference_{name}"] = _part(rows, "frame_reference", field)
    return Table(columns)


def check_table(answers: Iterable[v1.CandidateSet]) -> Table:
    """A row per check: the query node as `query_index`, `query_x` and so on,
    `revision`, `candidates` (how many), `empty_reason` ("" if there are any),
    `new_place_probability` and `scale_estimate`, `scale_low`, `scale_high` (NaN where
    absent), `nodes_considered`, `nodes_pruned`, `search_seconds`; of a search in a
    group, `searched` and `unsearched` (how many other vehicles) and `group_revision` (0
    of others)."""
    rows = list(answers)
    columns = _node_columns([row.query for row in rows], "query_")
    columns.update({
        "revision": _numbers(rows, lambda row: row.revision, np.uint64),
        "candidates": _numbers(rows, lambda row: len(row.candidates), np.int64),
        "empty_reason": np.array(
            ["" if row.empty_reason == 0 else
             _name_of(v1.EmptyReason, row.empty_reason, "EMPTY_REASON_")
             for row in rows], dtype=np.str_),
        "new_place_probability": _optional(rows, "new_place_probability"),
        "scale_estimate": _part(rows, "scale_estimate", "scale"),
        "scale_low": _part(rows, "scale_estimate", "low"),
        "scale_high": _part(rows, "scale_estimate", "high"),
        "nodes_considered": _numbers(rows, lambda row: row.nodes_considered, np.int64),
        "nodes_pruned": _numbers(rows, lambda row: row.nodes_pruned, np.int64),
        "search_seconds": _numbers(
            rows, lambda row: (row.search_duration.seconds
                               + row.search_duration.nanos * 1e-9)),
        "searched": _numbers(rows, lambda row: len(row.searched), np.int64),
        "unsearched": _numbers(rows, lambda row: len(row.unsearched), np.int64),
        "group_revision": _numbers(rows, lambda row: row.group_revision, np.uint64)})
    return Table(columns)


def _gate_columns(gates: list[Optional[Any]], prefix: str) -> dict[str, Array]:
    def number(field: str) -> Array:
        return _numbers(gates, lambda gate: (np.nan if gate is None
                                             else getattr(gate, field)))

    columns = {
        "squared_distance": number("squared_mahalanobis_distance"),
        "degrees_of_freedom": number("degrees_of_freedom"),
        "threshold": number("threshold"), "p_value": number("p_value"),
        "verdict": _names(gates, lambda gate: gate.verdict if gate is not None else 0,
                          v1.GateVerdict, "GATE_VERDICT_")}
    return {prefix + name: column for name, column in columns.items()}


def candidate_table(answers: Iterable[v1.CandidateSet]) -> Table:
    """A row per candidate, in the order of the answers and their ranks.

    `check` is the number of the answer, from 0. `rank`, `score`, `probability`,
    `odds_to_runner_up`, `meters_before` and `meters_after` of the place interval (NaN
    where absent), `verdict` ("ACCEPTED", "REJECTED_BY_SHAPE", ...) and `direction`
    ("SAME", "OPPOSITE") as in candidate.proto. `query_...` and `matched_...` are the
    nodes: `index`, `sequence`, `fraction`, `stamp`, `travelled`, `x`, `y`, `z`,
    `heading`.
    `matched_vehicle` is the vehicle of the matched node ("" where it is the one that
    asked), `recording_of_match` the name of its recording, and `frame_state`
    ("SAME", "AFTER", "DATUM", ...) how its frame is tied to that of the query.
    `difference_x`, `_y`, `_z`, `_heading`, `_covariance` say where a verifier
    should search. `gate_...` and `path_gate_...`: `squared_distance`,
    `degrees_of_freedom`, `threshold`, `p_value`, `verdict`; then `overlap` and
    `log_likelihood_ratio` of the shape (NaN or "UNSPECIFIED" where absent: difference
    and gate are where nothing ties the frames). Metres and radians."""
    checks, rows = [], []
    for number, answer in enumerate(answers):
        checks += [number] * len(answer.candidates)
        rows += list(answer.candidates)
    columns: dict[str, Array] = {
        "check": np.array(checks, dtype=np.int64),
        "rank": _numbers(rows, lambda row: row.rank, np.int64),
        "score": _numbers(rows, lambda row: row.score),
        "verdict": _names(rows, lambda row: row.verdict, v1.Verdict, "VERDICT_"),
        "direction": _names(rows, lambda row: row.direction, v1.Direction,
                            "DIRECTION_"),
        "probability": _optional(rows, "probability"),
        "odds_to_runner_up": _optional(rows, "odds_to_runner_up"),
        "meters_before": _part(rows, "place_interval", "meters_before"),
        "meters_after": _part(rows, "place_interval", "meters_after")}
    columns["matched_vehicle"] = np.array(
        [row.matched_vehicle for row in rows], dtype=np.str_)
    columns["recording_of_match"] = np.array(
        [row.recording_of_match for row in rows], dtype=np.str_)
    columns["frame_state"] = _names(rows, lambda row: row.frame_state, v1.FrameState,
                                    "FRAME_STATE_")
    columns.update(_node_columns([row.query for row in rows], "query_"))
    columns.update(_node_columns([row.matched for row in rows], "matched_"))
    for name, field in (("x", "x_meters"), ("y", "y_meters"), ("z", "z_meters"),
                        ("heading", "heading_radians")):
        columns[f"difference_{name}"] = _part(rows, "difference", field)
    columns["difference_covariance"] = _covariances(
        [row.difference.covariance for row in rows])
    columns.update(_gate_columns(
        [row.gate if row.HasField("gate") else None for row in rows], "gate_"))
    columns.update(_gate_columns(
        [row.path_gate if row.HasField("path_gate") else None for row in rows],
        "path_gate_"))
    for name, field in (("overlap", "overlap_meters"),
                        ("log_likelihood_ratio", "log_likelihood_ratio")):
        columns[name] = _part(rows, "shape", field)
    return Table(columns)


@dataclasses.dataclass(frozen=True)
class PoseGraph:
    """A vehicle's graph at one revision."""

    vehicle: v1.Vehicle
    #: The columns are those of `node_table()`.
    nodes: Table
    #: The columns are those of `edge_table()`.
    edges: Table

    def plot(self, axes: Any = None) -> Any:
        """Draws the trajectory and the loop closures in metres; returns the axes of
        matplotlib, which it needs: `axes`, or those of a new figure."""
        from matplotlib import pyplot

        if axes is None:
            axes = pyplot.subplots()[1]
        x, y = self.nodes["x"], self.nodes["y"]
        closures = self.edges.where(self.edges["kind"] == "LOOP_CLOSURE")
        # A jump is no road: nodes that no edge joins are not joined here either.
        consecutive = self.edges.where(self.edges["kind"] == "CONSECUTIVE")
        joined = np.zeros(len(self.nodes), dtype=bool)
        joined[consecutive["from_index"]] = True
        breaks = np.flatnonzero(~joined[:-1]) + 1
        axes.plot(np.insert(x, breaks, np.nan), np.insert(y, breaks, np.nan),
                  color="0.4", linewidth=1, label="trajectory")
        ends = np.stack([closures["from_index"], closures["to_index"]])
        if len(closures):
            axes.plot(x[ends], y[ends], color="#0a8f6a", linewidth=1.5,
                      label=["loop closures"] + ["_"] * (len(closures) - 1))
        axes.set_aspect("equal")
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        axes.legend()
        return axes
