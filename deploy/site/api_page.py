"""The API as a page, from the protos and their comments."""

import pathlib
import re
import subprocess
import tempfile

from google.protobuf import descriptor_pb2

Field = descriptor_pb2.FieldDescriptorProto
SCALARS = {number: name.removeprefix("TYPE_").lower()
           for name, number in Field.Type.items()}

# Numbers of the fields of descriptors, of which the paths to comments are made.
FILE_MESSAGE, FILE_ENUM, FILE_SERVICE, FILE_SYNTAX = 4, 5, 6, 12
MESSAGE_FIELD, MESSAGE_NESTED, MESSAGE_ENUM, MESSAGE_ONEOF = 2, 3, 4, 8
ENUM_VALUE = 2
SERVICE_METHOD = 2


def _escaped(text):
    """Text whose characters mean nothing to Markdown, but for `code`."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        # Code that goes on in the next line.
        return re.sub(r"([*_<>\[\]|\\`])", r"\\\1", text)
    return "`".join(part if i % 2 else
                    re.sub(r"([*_<>\[\]|\\])", r"\\\1", part)
                    for i, part in enumerate(parts))


def _paragraphs(comment):
    """A comment as Markdown: paragraphs, and lists whose lines begin with a star or a
    dash."""
    blocks, block = [], []
    for line in comment.split("\n"):
        item = re.match(r"\s*[*-] (.*)", line)
        if not line.strip() or item:
            blocks.append(block)
            block = []
        block.append(("- " + _escaped(item[1])) if item else _escaped(line.strip()))
    blocks.append(block)
    texts = [" ".join(block).strip() for block in blocks]
    return "\n\n".join(text for text in texts if text)


def _in_a_row(comment):
    return re.sub(r"\s*\n\s*", " ", _paragraphs(comment)).strip()


class _File:
    def __init__(self, proto):
        self.proto = proto
        self._comments = {tuple(location.path): location
                          for location in proto.source_code_info.location}

    def comment(self, *path):
        location = self._comments.get(path)
        return location.leading_comments if location else ""

    def head(self):
        """The comments before everything else."""
        location = self._comments.get((FILE_SYNTAX,))
        return "" if location is None else location.leading_comments


def _type(field, own):
    """The type of a field, with a link if it is one of the package."""
    if field.type_name:
        name = field.type_name.removeprefix(".")
        short = name.removeprefix(own + ".")
        shown = (f"[{short}](#{short.lower().replace('.', '')})"
                 if name.startswith(own + ".") else f"`{name}`")
    else:
        shown = f"`{SCALARS[field.type]}`"
    if field.label == Field.LABEL_REPEATED:
        return f"repeated {shown}"
    return f"optional {shown}" if field.proto3_optional else shown


def _enum(file, enum, path, name):
    yield f"### {name}"
    yield _paragraphs(file.comment(*path))
    rows = ["| value | |", "|---|---|"]
    for i, value in enumerate(enum.value):
        rows.append(f"| `{value.name}` | "
                    f"{_in_a_row(file.comment(*path, ENUM_VALUE, i))} |")
    yield "\n".join(rows)


def _message(file, message, path, name):
    yield f"### {name}"
    yield _paragraphs(file.comment(*path))
    rows = ["| field | type | |", "|---|---|---|"]
    for i, field in enumerate(message.field):
        text = _in_a_row(file.comment(*path, MESSAGE_FIELD, i))
        if field.HasField("oneof_index") and not field.proto3_optional:
            one = message.oneof_decl[field.oneof_index].name
            text = f"One of `{one}`. {text}"
        rows.append(f"| `{field.name}` | {_type(field, file.proto.package)} | "
                    f"{text} |")
    yield "\n".join(rows) if message.field else "No fields."
    for i, nested in enumerate(message.nested_type):
        if not nested.options.map_entry:
            yield from _message(file, nested, (*path, MESSAGE_NESTED, i),
                                f"{name}.{nested.name}")
    for i, enum in enumerate(message.enum_type):
        yield from _enum(file, enum, (*path, MESSAGE_ENUM, i),
                         f"{name}.{enum.name}")


def _service(file, service, path):
    yield f"## {service.name}"
    yield _paragraphs(file.comment(*path))
    for i, method in enumerate(service.method):
        own = file.proto.package
        parts = []
        for name, streams in ((method.input_type, method.client_streaming),
                              (method.output_type, method.server_streaming)):
            short = name.removeprefix(f".{own}.")
            parts.append(f"{'stream of ' if streams else ''}"
                         f"[{short}](#{short.lower()})")
        yield f"### {method.name}"
        yield f"{parts[0]} → {parts[1]}"
        yield _paragraphs(file.comment(*path, SERVICE_METHOD, i))


def _parts(files):
    yield "# API"
    yield ("`revisit.v1`: one service, and what goes to it and comes from it. The text "
           "is that of the protos, which are installed in `share/revisit/proto`.")
    for file in files:
        for i, service in enumerate(file.proto.service):
            yield from _service(file, service, (FILE_SERVICE, i))
    for file in files:
        title = pathlib.Path(file.proto.name).stem.replace("_", " ")
        yield f"## Messages: {title}"
        yield _paragraphs(file.head())
        for i, message in enumerate(file.proto.message_type):
            yield from _message(file, message, (FILE_MESSAGE, i), message.name)
        for i, enum in enumerate(file.proto.enum_type):
            yield from _enum(file, enum, (FILE_ENUM, i), enum.name)


def write(protos):
    """The page of the package whose protos lie there; needs protoc."""
    with tempfile.TemporaryDirectory() as directory:
        described = pathlib.Path(directory) / "described"
        names = sorted(path.relative_to(protos)
                       for path in pathlib.Path(protos).rglob("*.proto"))
        subprocess.run(
            ["protoc", "-I", protos, "--include_source_info",
             f"--descriptor_set_out={described}", *names], check=True)
        everything = descriptor_pb2.FileDescriptorSet.FromString(
            described.read_bytes())
    return "\n\n".join(part for part in _parts(
        [_File(proto) for proto in everything.file]) if part) + "\n"
