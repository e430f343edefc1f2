"""Pictures of the documents as SVG.

Each has a ground of its own, so it can be read on light and on dark pages, and
follows the reader's colour scheme where a browser tells it."""

import math
from xml.sax.saxutils import escape

STYLE = """
svg { --ground: #ffffff; --ink: #1f2933; --soft: #5b6875; --line: #c3ccd6;
      --blue: #1f6feb; --orange: #b85c00; --green: #1a7f4b; --red: #c9372c;
      font: 13px system-ui, sans-serif; }
@media (prefers-color-scheme: dark) {
  svg { --ground: #16202a; --ink: #e6edf3; --soft: #a3b0bd; --line: #46555f;
        --blue: #6cb0ff; --orange: #f0a860; --green: #4cc38a; --red: #ff8577; } }
.ground { fill: var(--ground); stroke: var(--line); }
text { fill: var(--ink); } .bold { font-weight: 600; } .small { font-size: 12px; }
.soft { --c: var(--soft); } .line { --c: var(--line); } .ink { --c: var(--ink); }
.blue { --c: var(--blue); } .orange { --c: var(--orange); }
.green { --c: var(--green); } .red { --c: var(--red); }
text.soft, text.blue, text.orange, text.green, text.red { fill: var(--c); }
path { fill: none; stroke: var(--c); stroke-width: 1.5; stroke-linejoin: round; }
.thin { stroke-width: 0.8; } .thick { stroke-width: 4; stroke-linecap: round; }
.dashed { stroke-dasharray: 5 4; } .filled { fill: var(--c); stroke: none; }
.pale { fill: var(--c); fill-opacity: 0.14; } .hollow { fill: var(--ground); }
circle { fill: var(--c); stroke: none; }
circle.hollow { fill: var(--ground); stroke: var(--c); stroke-width: 1.5; }
""".strip()


class Picture:
    """An SVG that grows part by part; `title` says what it shows."""

    def __init__(self, width, height, title):
        self.width, self.height = width, height
        self._parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'width="{width}" height="{height}" role="img">',
            f"<title>{escape(title)}</title>", f"<style>\n{STYLE}\n</style>",
            f'<rect class="ground" x="0.5" y="0.5" width="{width - 1}" '
            f'height="{height - 1}" rx="6"/>']

    def path(self, points, classes, closed=False):
        steps = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._parts.append(
            f'<path class="{classes}" d="M{steps}{"z" if closed else ""}"/>')

    def dot(self, at, radius, classes):
        self._parts.append(f'<circle class="{classes}" cx="{at[0]:.1f}" '
                           f'cy="{at[1]:.1f}" r="{radius}"/>')

    def text(self, at, words, classes="", anchor="start"):
        self._parts.append(
            f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}"'
            f'{f" class={classes!r}" if classes else ""}>{escape(words)}</text>')

    def arrow(self, start, end, classes):
        angle = math.atan2(end[1] - start[1], end[0] - start[0])
        back = (end[0] - 7 * math.cos(angle), end[1] - 7 * math.sin(angle))
        self.path([start, back], classes)
        self.path([end, *((end[0] - 9 * math.cos(angle + turn),
                           end[1] - 9 * math.sin(angle + turn))
                          for turn in (-0.4, 0.4))],
                  f"{classes.split()[0]} filled", closed=True)

    def box(self, x, y, width, height, classes):
        self.path([(x, y), (x + width, y), (x + width, y + height),
                   (x, y + height)], classes, closed=True)

    def ellipse(self, at, axes, turn, classes):
        self.path([(at[0] + axes[0] * math.cos(a) * math.cos(turn)
                    - axes[1] * math.sin(a) * math.sin(turn),
                    at[1] + axes[0] * math.cos(a) * math.sin(turn)
                    + axes[1] * math.sin(a) * math.cos(turn))
                   for a in (2 * math.pi * i / 72 for i in range(72))],
                  classes, closed=True)

    def svg(self):
        return "\n".join([*self._parts, "</svg>", ""])
