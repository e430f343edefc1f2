"""Generates revisit.v1 from the protos when the package is built.

The protos and the licence lie at the top of the repository, outside of this
project. A source distribution takes them along, so that a wheel can be built
from either.
"""

from __future__ import annotations

import pathlib
import shutil
import tempfile
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

HEADER = '"""Messages and enums of the API, generated from its protos."""\n'


def _find(root: pathlib.Path, name: str) -> pathlib.Path:
    """A file or folder of the repository, or the copy of it in a source
    distribution."""
    for place in (root, root.parent.parent):
        if (place / name).exists():
            return place / name
    raise FileNotFoundError(
        f"there is no {name} beside {root} nor two folders above it: the package is "
        "built in a checkout of the repository or from a source distribution")


def _package_of_all(descriptors: bytes, package: str) -> str:
    """The text of a module that has every message and enum by its bare name."""
    from google.protobuf import descriptor_pb2

    lines = [HEADER]
    names = []
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        if file.package != package:
            continue
        module = file.name[:-len(".proto")].replace("/", ".") + "_pb2"
        found = [message.name for message in file.message_type]
        for enum in file.enum_type:
            found += [enum.name, *(value.name for value in enum.value)]
        if found:
            lines.append(f"from {module} import (")
            lines += [f"    {name}," for name in found]
            lines.append(")")
        names += found
    lines += ["", "__all__ = [", *(f'    "{name}",' for name in names), "]", ""]
    return "\n".join(lines)


def generate(protos: pathlib.Path, output: pathlib.Path) -> None:
    """Writes modules, their types and the package's own `__init__.py`."""
    import grpc_tools
    from grpc_tools import protoc

    well_known = pathlib.Path(grpc_tools.__file__).parent / "_proto"
    files = sorted(str(path.relative_to(protos))
                   for path in protos.rglob("*.proto"))
    descriptors = output / "descriptors.binpb"
    code = protoc.main([
        "protoc", f"-I{protos}", f"-I{well_known}", f"--python_out={output}",
        f"--pyi_out={output}", f"--grpc_python_out={output}",
        f"--descriptor_set_out={descriptors}", *files])
    if code != 0:
        raise RuntimeError(f"protoc failed with {code} on the protos in {protos}")
    (output / "revisit/v1/__init__.py").write_text(
        _package_of_all(descriptors.read_bytes(), "revisit.v1"))
    descriptors.unlink()


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds what lies outside of the project to what is built."""

    _output: pathlib.Path | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = pathlib.Path(self.root)
        protos = _find(root, "proto/revisit").parent
        licence = _find(root, "LICENSE")
        include = build_data["force_include"]
        if self.target_name == "sdist":
            include[str(protos / "revisit")] = "proto/revisit"
            include[str(licence)] = "LICENSE"
            return
        if version == "editable":
            raise RuntimeError(
                "an editable install has no place for the generated code: "
                "install without --editable")
        self._output = pathlib.Path(tempfile.mkdtemp(prefix="revisit-stubs-"))
        generate(protos, self._output)
        include[str(self._output / "revisit/v1")] = "revisit/v1"
        include[str(licence)] = "revisit/LICENSE"

    def finalize(self, version: str, build_data: dict[str, Any],
                 artifact_path: str) -> None:
        if self._output is not None:
            shutil.rmtree(self._output, ignore_errors=True)
