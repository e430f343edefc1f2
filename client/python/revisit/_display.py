"""Columns of arrays as tables for a notebook and for pandas."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_AXES = {6: ("x", "y", "h"), 10: ("x", "y", "z", "h")}
#: Rows that are shown at either end.
_SHOWN_ROWS = 5


def spread(name: str, column: Array) -> dict[str, Array]:
    """A column of one number per row for each number of a wider one."""
    if column.ndim == 1:
        return {name: column}
    width = column.shape[1]
    if "covariance" in name and width in _AXES:
        axes = _AXES[width]
        ends = [first + second for row, first in enumerate(axes)
                for second in axes[row:]]
    elif name == "quaternion":
        ends = ["x", "y", "z", "w"]
    else:
        ends = [str(index) for index in range(width)]
    return {f"{name}_{end}": column[:, index] for index, end in enumerate(ends)}


def _cell(value: Any) -> str:
    if isinstance(value, np.datetime64):
        return "" if np.isnat(value) else f"{value.astype('datetime64[ms]')}Z"
    if isinstance(value, np.floating):
        return "" if np.isnan(value) else f"{value:.6g}"
    if isinstance(value, np.ndarray):
        return " ".join(_cell(one) for one in value)
    return html.escape(str(value))


def html_table(columns: Mapping[str, Array], caption: str) -> str:
    """The first and the last rows of a table."""
    count = len(next(iter(columns.values())))
    rows = list(range(count))
    gap = count > 2 * _SHOWN_ROWS
    if gap:
        rows = [*rows[:_SHOWN_ROWS], *rows[-_SHOWN_ROWS:]]
    names = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    lines = ["<tr>" + "".join(f"<td>{_cell(column[row])}</td>"
                              for column in columns.values()) + "</tr>"
             for row in rows]
    if gap:
        lines.insert(_SHOWN_ROWS, f'<tr><td colspan="{len(columns)}">\u2026</td></tr>')
    return (f"<table><caption>{html.escape(caption)}</caption><thead><tr>{names}</tr>"
            f"</thead><tbody>{''.join(lines)}</tbody></table>")
