"""The page of metrics as tests read it."""

import dataclasses
import math
import re
import urllib.error
import urllib.request

SAMPLE = re.compile(r"([a-z_]+)(?:\{(.*)\})? (\S+)")
LABEL = re.compile(r'([a-z_]+)="((?:[^"\\]|\\.)*)"(?:,|$)')


def get(address, path, timeout=30):
    """(status, body, content type) of what the admin port answers."""
    try:
        with urllib.request.urlopen(
                f"http://{address}{path}", timeout=timeout) as answer:
            return (answer.status, answer.read().decode(),
                    answer.headers["Content-Type"])
    except urllib.error.HTTPError as error:
        with error:
            return (error.code, error.read().decode(),
                    error.headers["Content-Type"])


@dataclasses.dataclass
class Page:
    """Samples by name and labels, and what is said of each metric."""

    text: str
    samples: dict
    kinds: dict
    helps: dict

    def value(self, name, **labels):
        """One sample; 0 if it is not there."""
        return self.samples.get((name, frozenset(labels.items())), 0.0)

    def series(self, name):
        """Values of all samples of a name, by their labels."""
        return {labels: value for (sample, labels), value
                in self.samples.items() if sample == name}

    def total(self, name):
        return sum(self.series(name).values())


def parse(text):
    page = Page(text, {}, {}, {})
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            _, _, name, kind = line.split(" ")
            assert name not in page.kinds, line
            page.kinds[name] = kind
        elif line.startswith("# HELP "):
            _, _, name, words = line.split(" ", 3)
            page.helps[name] = words
        else:
            found = SAMPLE.fullmatch(line)
            assert found, line
            name, labels, value = found.groups()
            key = name, frozenset(LABEL.findall(labels or ""))
            assert key not in page.samples, line
            page.samples[key] = float(value)
            assert not math.isnan(page.samples[key]), line
    return page


def scrape(server):
    status, text, kind = get(server.admin, "/metrics")
    assert status == 200, text
    assert kind == "text/plain; version=0.0.4; charset=utf-8"
    return parse(text)
