"""Generates revisit.v1 from the protos when the package is built.

The protos, the licence and the shipped drive lie elsewhere in the repository, outside
of this project. A source distribution takes them along, so that a wheel can be built
from either.
"""

from __future__ import annotations

import builtins
import pathlib
import re
import shutil
import tempfile
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

HEADER = '"""Messages and enums of the API, generated from its protos."""\n'
#: Messages whose fields are keywords of the client, and the names of their types.
KEYWORDS = {"VehicleSettings": "SettingsKeywords",
            "CandidateOptions": "CandidateKeywords",
            "GroupSettings": "GroupKeywords"}
#: The shipped drive, with whose it is.
DRIVE = ("tests/data/boreas/boreas_glen_shields.csv", "tests/data/boreas/NOTICE")
KEYWORDS_HEADER = '''\
"""Types of settings that are given as keywords, generated from the protos: an enum is
also the words of its values, a message also a mapping."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Optional, TypedDict, Union

from revisit import v1
'''
#: The types of Python in which fields of these types are given.
NUMBERS = {"TYPE_DOUBLE": "float", "TYPE_INT32": "int", "TYPE_INT64": "int",
           "TYPE_UINT64": "int", "TYPE_BOOL": "bool", "TYPE_STRING": "str"}


def _find(root: pathlib.Path, name: str) -> pathlib.Path:
    """A file or folder of the repository, or the copy of it in a source
    distribution."""
    for place in (root, root.parent.parent):
        if (place / name).exists():
            return place / name
    raise FileNotFoundError(
        f"there is no {name} beside {root} nor two folders above it: the package is "
        "built in a checkout of the repository or from a source distribution")


class Comments:
    """The comments of the protos, by the full names of what they stand at."""

    def __init__(self, files: Any) -> None:
        self._texts: dict[str, str] = {}
        for file in files:
            for location in file.source_code_info.location:
                name = self._name(file, list(location.path))
                text = location.leading_comments.strip()
                if name and text:
                    self._texts[f"{file.package}.{name}"] = "\n".join(
                        line.removeprefix(" ") for line in text.splitlines())

    @staticmethod
    def _name(file: Any, path: list[int]) -> str:
        """The name of what lies at this path of numbers of fields and of places in
        them; empty for what has none."""
        names, here = [], file
        while len(path) > 1:
            field = here.DESCRIPTOR.fields_by_number[path[0]]
            if field.message_type is None:
                return ""
            here = getattr(here, field.name)
            if isinstance(here, type(file.options)):
                return ""
            here, path = here[path[1]], path[2:]
            if "name" not in here.DESCRIPTOR.fields_by_name:
                return ""
            names.append(here.name)
        return "" if path else ".".join(names)

    def __call__(self, name: str) -> str:
        return self._texts.get(name, "")


def _docstring(text: str, indent: str) -> str:
    """The lines of a string that stands where a description belongs."""
    quoted = text.replace("\\", "\\\\").replace('"', '\\"')
    return "\n".join(line and indent + line
                     for line in f'"""{quoted}"""'.splitlines())


def _described(stub: str, package: str, comments: Comments) -> str:
    """A generated .pyi with the comments of the protos: below each class, and below
    each field and value."""
    lines: list[str] = []
    scope = ""
    for line in stub.splitlines():
        lines.append(line)
        began = re.match(r"class (\w+)\(", line)
        member = re.match(r"(    )?(\w+): (\w+)", line)
        name = indent = ""
        if began:
            scope = began[1]
            name, indent = scope, "    "
        elif member and member[1]:
            name, indent = f"{scope}.{member[2]}", member[1]
        elif member:
            # A value of an enum stands in the module too.
            name = f"{member[3]}.{member[2]}"
        text = comments(f"{package}.{name}")
        if text:
            lines.append(_docstring(text, indent))
    return "\n".join(lines) + "\n"


def _unambiguous(stub: str) -> str:
    """A generated .pyi in which a message is not taken for the builtin of its name, as
    mypy takes it where it stands before its class."""
    for name in re.findall(r"^class (\w+)\(", stub, re.MULTILINE):
        if hasattr(builtins, name):
            stub = re.sub(rf"\b{name}([\],])", rf"_{name}\1", stub)
            stub += f"_{name} = {name}\n"
    return stub


def _package_of_all(package: str, files: Any, comments: Comments) -> str:
    """The text of a module that has every message and enum by its bare name, and gives
    the messages their descriptions."""
    lines = [HEADER]
    names = []
    for file in files:
        module = file.name[:-len(".proto")].replace("/", ".") + "_pb2"
        found = [message.name for message in file.message_type]
        for enum in file.enum_type:
            found += [enum.name, *(value.name for value in enum.value)]
        if found:
            lines.append(f"from {module} import (")
            lines += [f"    {name}," for name in found]
            lines.append(")")
        names += found
    lines.append("")
    lines += [f"{made.name}.__doc__ = {comments(f'{package}.{made.name}')!r}"
              for file in files for made in (*file.message_type, *file.enum_type)]
    lines += ["", "__all__ = [", *(f'    "{name}",' for name in names), "]", ""]
    return "\n".join(lines)


def _type_of(field: Any) -> str:
    kind = field.Type.Name(field.type)
    name = field.type_name.rsplit(".", 1)[-1]
    if kind == "TYPE_ENUM":
        return f"Union[v1.{name}, str, None]"
    if kind == "TYPE_MESSAGE":
        return f"Union[v1.{name}, Mapping[str, Any], None]"
    return f"Optional[{NUMBERS[kind]}]"


def _keywords(package: str, files: Any, comments: Comments) -> str:
    """The text of a module with the types of what the client takes as keywords."""
    lines = [KEYWORDS_HEADER]
    for file in files:
        for message in file.message_type:
            if message.name not in KEYWORDS:
                continue
            lines += ["", f"class {KEYWORDS[message.name]}(TypedDict, total=False):",
                      f'    """Fields of v1.{message.name}."""', ""]
            for field in message.field:
                lines.append(f"    {field.name}: {_type_of(field)}")
                lines.append(_docstring(
                    comments(f"{package}.{message.name}.{field.name}"), "    "))
            lines.append("")
    return "\n".join(lines)


def generate(protos: pathlib.Path, output: pathlib.Path) -> None:
    """Writes modules, their types and the package's own `__init__.py`."""
    import grpc_tools
    from google.protobuf import descriptor_pb2
    from grpc_tools import protoc

    well_known = pathlib.Path(grpc_tools.__file__).parent / "_proto"
    files = sorted(str(path.relative_to(protos))
                   for path in protos.rglob("*.proto"))
    descriptors = output / "descriptors.binpb"
    code = protoc.main([
        "protoc", f"-I{protos}", f"-I{well_known}", f"--python_out={output}",
        f"--pyi_out={output}", f"--grpc_python_out={output}",
        "--include_source_info", f"--descriptor_set_out={descriptors}", *files])
    if code != 0:
        raise RuntimeError(f"protoc failed with {code} on the protos in {protos}")
    package = "revisit.v1"
    made = [file for file in descriptor_pb2.FileDescriptorSet.FromString(
        descriptors.read_bytes()).file if file.package == package]
    descriptors.unlink()
    comments = Comments(made)
    place = output / package.replace(".", "/")
    (place / "__init__.py").write_text(_package_of_all(package, made, comments),
                                       encoding="utf-8")
    (place / "keywords.py").write_text(_keywords(package, made, comments),
                                       encoding="utf-8")
    for stub in place.glob("*.pyi"):
        text = _unambiguous(stub.read_text(encoding="utf-8"))
        stub.write_text(_described(text, package, comments), encoding="utf-8")


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds what lies outside of the project to what is built."""

    _output: pathlib.Path | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        root = pathlib.Path(self.root)
        protos = _find(root, "proto/revisit").parent
        licence = _find(root, "LICENSE")
        drive = {name: str(_find(root, name)) for name in DRIVE}
        include = build_data["force_include"]
        if self.target_name == "sdist":
            include[str(protos / "revisit")] = "proto/revisit"
            include[str(licence)] = "LICENSE"
            include.update({path: name for name, path in drive.items()})
            return
        if version == "editable":
            raise RuntimeError(
                "an editable install has no place for the generated code: "
                "install without --editable")
        self._output = pathlib.Path(tempfile.mkdtemp(prefix="revisit-stubs-"))
        generate(protos, self._output)
        include[str(self._output / "revisit/v1")] = "revisit/v1"
        include[str(licence)] = "revisit/LICENSE"
        for path in drive.values():
            include[path] = f"revisit/drives/{pathlib.Path(path).name}"

    def finalize(self, version: str, build_data: dict[str, Any],
                 artifact_path: str) -> None:
        if self._output is not None:
            shutil.rmtree(self._output, ignore_errors=True)
