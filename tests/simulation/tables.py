"""A table of results, and quantiles over seeds."""

import dataclasses
import statistics


@dataclasses.dataclass
class Table:
    """`rows` are dicts by column; numbers of several seeds are lists, printed as the
    median and, where they differ, the range."""

    title: str
    columns: tuple
    rows: list = dataclasses.field(default_factory=list)
    note: str = ""

    def add(self, **row):
        assert set(row) <= set(self.columns), set(row) - set(self.columns)
        self.rows.append(row)

    def text(self):
        cells = [list(self.columns)]
        cells += [[_text(row.get(column, "")) for column in self.columns]
                  for row in self.rows]
        widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
        lines = [self.title, ""]
        for line in cells:
            lines.append("  ".join(
                cell.ljust(width) if i == 0 else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(line, widths))).rstrip())
        if self.note:
            lines += ["", self.note]
        return "\n".join(lines) + "\n"


def number(value):
    if value == float("inf"):
        return "-"
    if value == int(value) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:,.{3 if abs(value) < 0.1 else 2 if abs(value) < 1 else 1}f}"


def _text(value):
    if isinstance(value, str):
        return value
    if not isinstance(value, (list, tuple)):
        return number(value)
    low, high = min(value), max(value)
    middle = number(statistics.median(value))
    # Ranges only where they say something.
    if high - low <= 0.05 * abs(high):
        return middle
    return f"{middle} ({number(low)}-{number(high)})"


def over(seeds, measure):
    """Runs `measure(seed)`, which answers with a dict, for each seed; lists by key."""
    results = [measure(seed) for seed in seeds]
    return {key: [result[key] for result in results] for key in results[0]}
