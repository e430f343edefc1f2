"""The examples of the package run as they stand: the notebook on the shipped drive,
and the lines of its README."""

import json
import re
import shutil
import subprocess
import sys
import textwrap

import nbclient
import nbformat
import numpy as np
import pytest

import revisit
from conftest import BOREAS, LONG, ROOT
from documents import commands, is_shown

PACKAGE = ROOT / "client/python"
NOTEBOOK = PACKAGE / "examples/boreas.ipynb"


def outputs_of(cells, kind):
    return [output["data"][kind] for cell in cells for output in cell.get("outputs", [])
            if kind in output.get("data", {})]


def test_the_notebook_is_stored_without_outputs():
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert len(cells) > 5
    for cell in cells:
        assert not cell.get("outputs") and not cell.get("execution_count")


def test_the_notebook_runs_on_a_server(server, client, monkeypatch):
    monkeypatch.setenv("REVISIT_ADDRESS", server.address)
    monkeypatch.setenv("REVISIT_DRIVE", str(BOREAS))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    pictures = outputs_of(notebook.cells, "image/png")
    assert len(pictures) == 2
    executed = ROOT / "build/python-client/boreas.ipynb"
    if executed.parent.is_dir():
        nbformat.write(notebook, executed)
    vehicles = [one.name for one in client.list_vehicles()]
    [vehicle] = [name for name in vehicles if name.startswith("vehicles/boreas")]
    assert client.get_vehicle(vehicle).durable_sequence == 2076
    text = "".join(output.get("text", "") for cell in notebook.cells
                   for output in cell.get("outputs", []))
    right, accepted = map(int, re.search(
        r"(\d+) of (\d+) accepted candidates", text).groups())
    assert accepted > 140 and right > 0.95 * accepted


def blocks(path):
    """Lines of Python, and what they print or log where the document shows it."""
    return re.findall(r"^```python\n(.*?)^```\n(?:\n```\n(.*?)^```\n)?",
                      path.read_text(), re.DOTALL | re.MULTILINE)


def test_the_first_lines_of_the_package_need_nothing_else(tmp_path):
    block, shown = blocks(PACKAGE / "README.md")[0]
    ran = subprocess.run([sys.executable, "-c", block], cwd=tmp_path, timeout=LONG,
                         capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == shown


@pytest.mark.parametrize("document", ["client/python/README.md", "docs/integrate.md",
                                      "docs/verifier.md"])
def test_the_lines_of_documents_run(document, server, client, boreas, tmp_path,
                                    monkeypatch, capsys, caplog):
    poses, columns = boreas
    found = blocks(ROOT / document)
    assert found
    monkeypatch.chdir(tmp_path)
    for number, (block, shown) in enumerate(found):
        vehicle = f"readme-{ROOT.joinpath(document).stem.lower()}-{number}"
        block = block.replace("127.0.0.1:50051", server.address).replace(
            "shuttle-7", vehicle)
        names = {
            "revisit": revisit, "client": client, "np": np, "x": columns["est_x"],
            "y": columns["est_y"], "heading": columns["est_yaw"],
            "covariance": poses.covariance, "stamps": columns["t_s"], "poses": poses}
        if "revisit.serve(" in block:
            exec(compile(block, f"{document}:{number}", "exec"), names)
            continue
        if "create_vehicle" not in block:
            client.create_vehicle(vehicle)
        if "read_recording" in block:
            shutil.copy(BOREAS, tmp_path / "drive.csv")
        if "rosbag" in block:
            from test_rosbag import odometry_bag
            odometry_bag(tmp_path / "drive")
        capsys.readouterr()
        caplog.clear()
        exec(compile(block, f"{document}:{number}", "exec"), names)
        if shown:
            said = capsys.readouterr().out + "".join(
                f"{record.getMessage()}\n" for record in caplog.records)
            assert said.replace(vehicle, "shuttle-7") == shown
        assert client.get_vehicle(vehicle).durable_sequence > 0


def test_the_verifiers_are_those_that_their_document_shows():
    shown = re.findall(r"^```py\n(.*?)^```", (ROOT / "docs/verifier.md").read_text(),
                       re.DOTALL | re.MULTILINE)
    text = "".join((PACKAGE / "examples" / name).read_text()
                   for name in ("verifier.py", "scan_verifier.py"))
    found = [block for block in shown
             if block in text or textwrap.indent(block, "    ") in text]
    # One changes a setting.
    assert [block for block in shown if block not in found] == [
        'client.update_vehicle("shuttle-7", checks="stored")\n']
    assert len(found) == 4


def test_the_verifier_prints_what_its_document_shows(server, client):
    [command] = [command for command in commands(ROOT / "docs/verifier.md")
                 if command.marker == "verifier"]
    program, script, *words = command.text.split()
    assert program == "python3"
    ran = subprocess.run(
        [sys.executable, ROOT / script,
         *(word.replace("127.0.0.1:50051", server.address) for word in words)],
        capture_output=True, text=True, timeout=LONG, check=False)
    assert ran.returncode == 0, ran.stderr
    assert is_shown(command.shown, ran.stdout), ran.stdout
    vehicle = words[-1]
    confirmed = list(client.list_loop_closures(vehicle))
    assert all(closure.HasField("measurement") for closure in confirmed)
    assert len(confirmed) > 100
    assert len(list(client.list_rejected_candidates(vehicle))) > 0
