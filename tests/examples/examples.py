"""Runs the examples of client/examples: tests/examples/run --help."""

import contextlib
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

from cut_proxy import CutProxy
from revisit_server import Server, clean_environment, wait_until
from stubs import ROOT, api
from watch_service import CURSORS, LINES, WatchService, serving
from wire import BOREAS, as_bytes, boreas, get, list_poses

BUILD = ROOT / "build/examples"
# The address, the drive and the vehicle in the commands of the READMEs.
ARGUMENTS = "127.0.0.1:50051", BOREAS.name, "shuttle-1"
# Where the server is killed. The whole drive takes some 180 kB as columns.
BYTES_BEFORE_KILL = 100_000
BUILD_SECONDS = 900
RUN_SECONDS = 120

# Programs that each language needs, and the oldest version that will do.
TOOLS = {
    "python": {"python3": "3.9"},
    "go": {"go": "1.24", "protoc": "3.15"},
    "typescript": {"node": "18", "npm": "8", "protoc": "3.15"},
    "java": {"javac": "17", "mvn": "3.8"},
    "rust": {"cargo": "1.88", "protoc": "3.15"},
}
STAMP = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z"


class Failure(Exception):
    """An example did not do what it should."""


def expect(condition, what, *shown):
    if not condition:
        raise Failure("\n".join([what, *map(str, shown)]))


def numbers(version):
    return [int(part) for part in version.split(".")]


def missing_tool(language):
    """Why the language cannot be built here, or None."""
    for tool, oldest in TOOLS[language].items():
        if shutil.which(tool) is None:
            return f"there is no {tool} here"
        flag = "version" if tool == "go" else "--version"
        said = subprocess.run([tool, flag], capture_output=True, text=True,
                              timeout=60, check=False)
        version = re.search(r"\d+(\.\d+)+", said.stdout)
        if version is None or numbers(version.group()) < numbers(oldest):
            found = version.group() if version else said.stderr.strip()
            return f"{tool} {oldest} or newer is needed, here is {found}"
    return None


def commands(language, marker):
    """The commands between two markers of the README of the language."""
    text = (ROOT / "client/examples" / language / "README.md").read_text()
    return re.search(rf"<!-- {marker} -->\n```sh\n(.*?)```\n<!-- /{marker} -->",
                     text, re.DOTALL).group(1)


def copy(language):
    """A copy of the example below build, beside what it finds by its relative
    place in the tree."""
    folder = BUILD / "client/examples" / language
    shutil.copytree(ROOT / "client/examples" / language, folder,
                    dirs_exist_ok=True)
    for name in ("proto", "tests"):
        with contextlib.suppress(FileExistsError):
            (BUILD / name).symlink_to(ROOT / name)
    return folder


def shell(lines, folder, seconds, log):
    """Runs lines of bash; their output goes to a log."""
    with open(log, "w") as output:
        return subprocess.Popen(
            ["timeout", "--kill-after=5", str(seconds), "bash", "-euc", lines],
            cwd=folder, env=clean_environment(), stdin=subprocess.DEVNULL,
            stdout=output, stderr=subprocess.STDOUT)


def build(language, folder):
    log = BUILD / f"{language}-build.log"
    code = shell(commands(language, "build"), folder, BUILD_SECONDS, log).wait()
    expect(code == 0, f"its build ends with {code}:", log.read_text()[-4000:])


class MortalServer:
    """A server behind a proxy, which can be killed in the middle of a drive."""

    def __init__(self, store):
        self._store = store
        self._server = Server(store)
        self._proxy = CutProxy(self._server.port, BYTES_BEFORE_KILL)
        self.address = self._proxy.address

    def stub(self):
        return self._server.stub()

    def reached_the_middle(self):
        return self._proxy.held.is_set()

    def kill_and_restart(self, vehicle):
        """Kills the server once it has stored something."""
        wait_until(lambda: get(self.stub(), vehicle).durable_sequence,
                   "durable pose")
        self._server.kill()
        self._proxy.lose_server()
        self._server = Server(self._store)
        self._proxy.find_server(self._server.port)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._proxy.close()
        self._server.close()


def run_command(language, address, vehicle_id):
    command = commands(language, "run")
    for old, new in zip(ARGUMENTS, (address, BOREAS.name, vehicle_id)):
        expect(old in command, f"its README runs nothing with {old}")
        command = command.replace(old, new)
    return command


def run_killed(language, folder, server, vehicle):
    """The output of the example while the server is killed in the middle."""
    log = BUILD / f"{language}.log"
    command = run_command(language, server.address, vehicle.split("/")[1])
    process = shell(command, folder, RUN_SECONDS, log)
    try:
        wait_until(lambda: server.reached_the_middle()
                   or process.poll() is not None, "drive", RUN_SECONDS)
        if server.reached_the_middle():
            server.kill_and_restart(vehicle)
        code = process.wait()
    finally:
        process.terminate()
        process.wait()
    expect(code == 0, f"it ends with {code}:", log.read_text()[-4000:])
    return log.read_text()


def check_stream(output, last):
    opened = [int(found) for found in re.findall(
        r"^stream: open, durable up to (\d+)$", output, re.MULTILINE)]
    expect(len(opened) > 1 and opened[0] == 0 and 0 < opened[1] < last,
           f"it should open the stream at 0, then resume, but: {opened}", output)
    expect(re.search(r"^stream: lost at \d+ .*, again in ", output, re.MULTILINE),
           "it does not say that the stream was lost:", output)
    expect(f"durable: all {last} poses\n" in output,
           "it does not say that all is durable:", output)


def check_candidates(output, stub, vehicle):
    """Candidates have stamps, and one of them is confirmed and stored."""
    candidates = re.findall(
        rf"^candidate: (\d+) at {STAMP} is (\d+) at {STAMP}, "
        r"probability [01]\.\d{3}$", output, re.MULTILINE)
    # Some of 160 are lost with the stream.
    expect(len(candidates) > 50, f"only {len(candidates)} candidates:", output)
    confirmed = re.findall(r"^confirmed: (\S+)$", output, re.MULTILINE)
    stored = stub.ListLoopClosures(
        api.ListLoopClosuresRequest(parent=vehicle)).loop_closures
    expect([closure.name for closure in stored] == confirmed
           and len(confirmed) == 1, "one closure should be confirmed:",
           stored, output)
    pair = str(stored[0].query_sequence), str(stored[0].matched_sequence)
    expect(pair in candidates, f"{pair} was no candidate:", output)


def check_error(output):
    expect(re.search(
        r"^refused: INVALID_ARGUMENT, reason COVARIANCE_NOT_POSITIVE_DEFINITE of "
        r"revisit, request [0-9a-f]+: .*the variance of x is -1.*\n"
        r"  poses\[0\]\.covariance\.values: the variance of x is -1",
        output, re.MULTILINE), "it does not show the error:", output)


def check_stored(stub, vehicle):
    """The poses of the file are stored, to the last bit of their numbers."""
    stored = list_poses(stub, vehicle)
    stamps = [pose.stamp.ToNanoseconds() for pose in stored]
    expect(stamps == drive_stamps(), "stamps differ from those of the file")
    for pose in stored:
        pose.ClearField("stamp")
    expect(as_bytes(stored) == as_bytes(boreas()[0]),
           "poses differ from those of the file")


def drive_stamps():
    """Stamps of the drive in nanoseconds; its file has three decimals."""
    rows = BOREAS.read_text().splitlines()[1:]
    return [int(row.split(",")[1].replace(".", "")) * 10**6 for row in rows]


def check_again(language, folder, server, vehicle_id, last):
    """The second time all poses are durable, and there is nothing to send."""
    log = BUILD / f"{language}-again.log"
    code = shell(run_command(language, server.address, vehicle_id), folder,
                 RUN_SECONDS, log).wait()
    output = log.read_text()
    expect(code == 0 and f"stream: open, durable up to {last}\n" in output
           and "candidate: " not in output, f"again, it ends with {code}:", output)


def kept_cursor(folder):
    """The cursor that a watch keeps; None where it has none, or has just dropped it."""
    try:
        return (folder / "watch.cursor").read_text()
    except FileNotFoundError:
        return None


def check_watch(language, folder):
    """The watch goes on where it was after whatever breaks it."""
    (folder / "watch.cursor").unlink(missing_ok=True)
    fake = WatchService()
    log = BUILD / f"{language}-watch.log"
    with serving(fake) as address:
        command = commands(language, "watch").replace(ARGUMENTS[0], address)
        process = shell(command, folder, RUN_SECONDS, log)
        try:
            wait_until(lambda: kept_cursor(folder) == "after-6"
                       or process.poll() is not None, "last event", RUN_SECONDS)
        finally:
            process.terminate()
            process.wait()
    lines = log.read_text().splitlines()
    expect(len(lines) == len(LINES) and all(map(str.startswith, lines, LINES)),
           "its watch should print:", *LINES, "but printed:", *lines)
    expect(fake.cursors == CURSORS, "its watch goes on from", fake.cursors)


def try_example(language):
    folder = copy(language)
    begin = time.monotonic()
    build(language, folder)
    built = time.monotonic()
    vehicle_id = f"example-{language}"
    vehicle = f"vehicles/{vehicle_id}"
    last = len(drive_stamps())
    with tempfile.TemporaryDirectory(prefix="revisit-examples-") as temporary, \
            MortalServer(pathlib.Path(temporary) / "store") as server:
        output = run_killed(language, folder, server, vehicle)
        check_stored(server.stub(), vehicle)
        check_stream(output, last)
        check_candidates(output, server.stub(), vehicle)
        check_error(output)
        check_again(language, folder, server, vehicle_id, last)
    check_watch(language, folder)
    return built - begin, time.monotonic() - built


def main(languages):
    BUILD.mkdir(parents=True, exist_ok=True)
    counts = {"passed": 0, "failed": 0, "skipped": 0}
    for language in languages:
        missing = missing_tool(language)
        if missing:
            counts["skipped"] += 1
            print(f"examples: {language}: skipped: {missing}", flush=True)
            continue
        try:
            built, ran = try_example(language)
            counts["passed"] += 1
            print(f"examples: {language}: passed (built in {built:.0f} s, "
                  f"ran {ran:.0f} s)", flush=True)
        except (Failure, AssertionError) as failure:
            counts["failed"] += 1
            print(f"examples: {language}: FAILED: {failure}", flush=True)
    print("examples: " + ", ".join(f"{count} {what}"
                                   for what, count in counts.items()))
    if counts["failed"]:
        return 1
    return 0 if counts["passed"] else 77


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or list(TOOLS)))
