"""core/ is mathematics: everything else comes in as an argument."""

import re

import pytest

from stubs import ROOT

SOURCES = sorted(path for suffix in ("*.h", "*.cc")
                 for path in (ROOT / "core").rglob(suffix))

# Matched in code and in includes, not in comments.
FORBIDDEN = {
    "gRPC": r"grpc",
    "protobuf": r"protobuf|\.pb\.h|revisit::v1",
    "other layers": r'#include "(server|client|tests)/',
    "threads": r"std::(this_)?thread|<thread>|pthread|std::async|<future>"
               r"|std::atomic|<atomic>|thread_local",
    "locks": r"[Mm]utex|condition_variable",
    "clocks": r"_clock\b|<chrono>|<ctime>|absl::Now|\btime\(",
    "files": r"fstream|<filesystem>|\bfopen\b",
    "output": r"iostream|std::cout|std::cerr|\bf?printf\b|spdlog",
    "environment": r"\bgetenv\b|absl/flags",
    "randomness": r"<random>|\bs?rand\(|absl/random|random_device",
}


def without_comments(text):
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return re.sub(r"//.*", "", text)


def test_there_are_sources():
    assert len(SOURCES) > 10


@pytest.mark.parametrize("what", FORBIDDEN)
def test_core_has_no(what):
    pattern = re.compile(FORBIDDEN[what])
    found = [f"{path.relative_to(ROOT)}: {line.strip()}"
             for path in SOURCES
             for line in without_comments(path.read_text()).splitlines()
             if pattern.search(line)]
    assert found == []


def test_core_links_neither_grpc_nor_protobuf_nor_threads():
    text = "\n".join(path.read_text()
                     for path in (ROOT / "core").rglob("CMakeLists.txt"))
    text = re.sub(r"#.*", "", text)
    assert re.findall(r"(?i)grpc|proto|threads|sqlite|spdlog", text) == []
