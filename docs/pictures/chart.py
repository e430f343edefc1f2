"""Curves over two axes, as a part of a picture."""

import math

# A chart's axes begin and end so far from the top, in pixels, and the names of its
# series begin there, each so far from the one before.
TOP, BOTTOM = 52, 242
LEGEND, LEGEND_STEP = BOTTOM + 66, 19


def words_of(value):
    """A number as ticks and tables show it: three digits that count, no power."""
    if value >= 999.5e3:
        return f"{float(f'{value / 1e6:.3g}'):g} M"
    if value >= 99.5:
        return f"{int(float(f'{value:.3g}')):,}"
    return f"{float(f'{value:.3g}'):g}" if value >= 0.01 else f"{value:.1g}"


class Logarithmic:
    """Whole decades around all values, of which those that are not positive do not
    count."""

    def __init__(self, values):
        exponents = [math.log10(value) for value in values if value > 0]
        self.low = math.floor(min(exponents) + 1e-9)
        self.high = max(math.ceil(max(exponents) - 1e-9), self.low + 1)

    def share(self, value):
        return (math.log10(value) - self.low) / (self.high - self.low)

    def ticks(self):
        return [10.0 ** exponent for exponent in range(self.low, self.high + 1)]


class Linear:
    """From 0 to beyond the greatest value, by steps of 1, 2 or 5 times a power."""

    def __init__(self, values):
        most = max(values)
        decade = 10.0 ** math.floor(math.log10(most))
        self.step = next(step * decade / 10 for step in (2, 5, 10, 20)
                         if most / (step * decade / 10) <= 6)
        self.high = self.step * math.ceil(most / self.step)

    def share(self, value):
        return value / self.high

    def ticks(self):
        return [self.step * i for i in range(round(self.high / self.step) + 1)]


class Series:
    """Points (x, y) in the order of x, and how they are drawn and called."""

    def __init__(self, words, classes, points):
        self.words, self.classes = words, classes
        self.points = [(x, y) for x, y in points if y is not None and y > 0]


def draw(picture, left, right, title, x_words, series, y_axis=Logarithmic):
    """Draws series over a logarithmic axis of x between these borders, from the top
    of the picture down, with their names below."""
    drawn = [one for one in series if one.points]
    x_axis = Logarithmic([x for one in drawn for x, _ in one.points])
    y_axis = y_axis([y for one in drawn for _, y in one.points])

    def at(x, y):
        return (left + x_axis.share(x) * (right - left),
                BOTTOM - y_axis.share(y) * (BOTTOM - TOP))

    picture.text((left, 30), title, "bold")
    for tick in y_axis.ticks():
        y = BOTTOM - y_axis.share(tick) * (BOTTOM - TOP)
        picture.path([(left, y), (right, y)], "line thin")
        picture.text((left - 6, y + 4), words_of(tick), "soft small", "end")
    for tick in x_axis.ticks():
        x = left + x_axis.share(tick) * (right - left)
        picture.path([(x, BOTTOM), (x, BOTTOM + 4)], "line")
        picture.text((x, BOTTOM + 18), words_of(tick), "soft small", "middle")
    picture.text(((left + right) / 2, BOTTOM + 38), x_words, "soft", "middle")
    for row, one in enumerate(drawn):
        points = [at(*point) for point in one.points]
        colour = one.classes.split()[0]
        picture.path(points, one.classes)
        for point in points:
            picture.dot(point, 2.6, colour)
        y = LEGEND + LEGEND_STEP * row
        picture.path([(left, y - 4), (left + 28, y - 4)], one.classes)
        picture.text((left + 36, y), one.words, colour)


def height_of(rows):
    """How high a picture is whose charts have at most so many series."""
    return LEGEND + LEGEND_STEP * rows
