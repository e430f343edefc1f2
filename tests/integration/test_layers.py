"""Data flows from the client over proto/ and the server to core/: no layer
includes one above it, the client none below proto/, and core/ is mathematics,
to which everything else comes in as an argument."""

import re

import pytest

from stubs import ROOT

# The files that server and client have in common, and their targets. Core keeps
# them and does not use them.
SHARED = {ROOT / "core/base" / name
          for name in ("command_words.cc", "command_words.h", "mutex.h",
                       "openssl_pointers.h", "suggestion.cc", "suggestion.h",
                       "CMakeLists.txt")}


def sources(layer):
    return sorted(path for suffix in ("*.h", "*.cc")
                  for path in (ROOT / layer).rglob(suffix)
                  if path not in SHARED)


def lists(layer):
    return sorted(path for path in (ROOT / layer).rglob("CMakeLists.txt")
                  if path not in SHARED)


# Each is matched in code and in includes, not in comments.
FORBIDDEN_IN_CORE = {
    "gRPC": r"grpc",
    "protobuf": r"protobuf|\.pb\.h|revisit::v1",
    "other layers": r'#include "(server|client|tests)/',
    "shared headers": r'#include "core/base/'
                      r'(command_words|mutex|openssl_pointers|suggestion)\.h"',
    "threads": r"std::(this_)?thread|<thread>|pthread|std::async|<future>"
               r"|std::atomic|<atomic>|thread_local",
    "locks": r"[Mm]utex|condition_variable",
    "clocks": r"_clock\b|<chrono>|<ctime>|absl::Now|\btime\(",
    "files": r"fstream|<filesystem>|\bfopen\b",
    "output": r"iostream|std::cout|std::cerr|\bf?printf\b|spdlog",
    "environment": r"\bgetenv\b|absl/flags",
    "randomness": r"<random>|\bs?rand\(|absl/random|random_device",
    "cryptography": r"openssl",
}

# The standard library and POSIX are included in angle brackets.
ALLOWED_IN_CLIENT = re.compile(
    r'"(client/|core/base/|revisit/v1/'
    r"|absl/|google/|grpc/|grpcpp/|nlohmann/)")
# It takes ten seconds to compile, for each file that includes it.
CLI11 = '"CLI/CLI.hpp"'
ONLY_USER_OF_CLI11 = ROOT / "client/cli/flags.cc"


def code_lines(path):
    text = re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
    return re.sub(r"//.*", "", text).splitlines()


def lines_with(pattern, paths):
    return [f"{path.relative_to(ROOT)}: {line.strip()}"
            for path in paths
            for line in code_lines(path)
            if re.search(pattern, line)]


def includes(path):
    return [line.split(maxsplit=1)[1] for line in code_lines(path)
            if line.startswith("#include ")]


def words_of_lists(pattern, layer):
    text = "\n".join(re.sub(r"#.*", "", path.read_text())
                     for path in lists(layer))
    return re.findall(pattern, text)


@pytest.mark.parametrize("layer", ["core", "server", "client"])
def test_there_are_sources(layer):
    assert len(sources(layer)) > 10


def test_shared_files_are_there():
    assert all(path.exists() for path in SHARED)


@pytest.mark.parametrize("what", FORBIDDEN_IN_CORE)
def test_core_has_no(what):
    assert lines_with(FORBIDDEN_IN_CORE[what], sources("core")) == []


def test_core_links_neither_grpc_nor_protobuf_nor_threads():
    assert words_of_lists(
        r"(?i)grpc|proto|threads|sqlite|spdlog|openssl|mutex", "core") == []


def test_server_includes_nothing_of_the_client():
    assert lines_with(r'#include "(client|tests)/', sources("server")) == []


@pytest.mark.parametrize("folder", ["fields", "groups", "records",
                                    "sessions", "storage"])
def test_what_is_stored_names_no_message_of_the_api(folder):
    assert lines_with(r"revisit/v1/|\bv1::",
                      sources(f"server/{folder}")) == []


def test_records_alone_name_the_messages_of_the_store():
    others = [path for path in sources("server")
              if ROOT / "server/records" not in path.parents]
    assert lines_with(r"stored_records\.pb\.h|\bstored::[A-Z]", others) == []


def test_client_includes_the_proto_and_shared_headers_only():
    found = [f"{path.relative_to(ROOT)}: {name}"
             for path in sources("client") for name in includes(path)
             if name.startswith('"') and not ALLOWED_IN_CLIENT.match(name)
             and (path, name) != (ONLY_USER_OF_CLI11, CLI11)]
    assert found == []


def test_client_links_nothing_of_the_server_or_of_core():
    assert words_of_lists(r"revisit_(?:server|core)\w*", "client") == []


# Each of these includes of the client itself, those that stand before it and
# revisit/ alone; the command line comes last.
CLIENT = ["formats", "terminal", "answers", "trajectory", "map", "evaluation"]


@pytest.mark.parametrize("layer", ["revisit", *CLIENT])
def test_folder_of_the_client_includes_none_above_it(layer):
    above = CLIENT[CLIENT.index(layer) + 1:] if layer in CLIENT else CLIENT
    assert lines_with(rf'#include "client/({"|".join([*above, "cli"])})/',
                      sources(f"client/{layer}")) == []
