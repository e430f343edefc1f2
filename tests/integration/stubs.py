"""Python stubs, made anew from proto/ in each session, as a caller would."""

import atexit
import importlib
import pathlib
import shutil
import sys
import tempfile

import grpc_tools
from grpc_tools import protoc

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROTO = ROOT / "proto"


def generate(directory):
    files = sorted(str(path.relative_to(PROTO))
                   for path in (PROTO / "revisit").rglob("*.proto"))
    well_known = pathlib.Path(grpc_tools.__file__).parent / "_proto"
    code = protoc.main([
        "protoc", f"-I{PROTO}", f"-I{well_known}",
        f"--python_out={directory}", f"--grpc_python_out={directory}", *files])
    if code != 0:
        raise RuntimeError(f"protoc failed with {code}")


_directory = tempfile.mkdtemp(prefix="revisit-stubs-")
atexit.register(shutil.rmtree, _directory, ignore_errors=True)
generate(_directory)
sys.path.insert(0, _directory)


class Messages:
    """Every message and enum of the package revisit.v1 by its bare name."""

    def __init__(self, *modules):
        for name in modules:
            module = importlib.import_module(f"revisit.v1.{name}_pb2")
            for symbol in vars(module):
                if not symbol.startswith("_"):
                    setattr(self, symbol, getattr(module, symbol))


api = Messages("geometry", "pose_columns", "vehicle", "recording", "candidate",
               "check", "loop_closure", "group",
               "error_reason", "pose_graph_service")
PoseGraphServiceStub = importlib.import_module(
    "revisit.v1.pose_graph_service_pb2_grpc").PoseGraphServiceStub
