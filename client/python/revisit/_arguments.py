"""Errors for arguments that cannot be: they name the argument, what it is, and what is
expected, where protobuf and gRPC say only that some type is wrong."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable
from typing import Any, NoReturn, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from numpy.typing import ArrayLike, NDArray

from revisit import v1

_T = TypeVar("_T")
#: What protobuf raises for a field's value, by its type, its range, or its form.
_WRONG = (TypeError, ValueError, AttributeError)

_INTEGERS = {
    FieldDescriptor.CPPTYPE_INT32: "an integer in [-2^31, 2^31 - 1]",
    FieldDescriptor.CPPTYPE_INT64: "an integer in [-2^63, 2^63 - 1]",
    FieldDescriptor.CPPTYPE_UINT32: "an integer in [0, 2^32 - 1]",
    FieldDescriptor.CPPTYPE_UINT64: "an integer in [0, 2^64 - 1]",
}
_OTHERS = {
    FieldDescriptor.CPPTYPE_DOUBLE: "a number",
    FieldDescriptor.CPPTYPE_FLOAT: "a number",
    FieldDescriptor.CPPTYPE_BOOL: "True or False",
    FieldDescriptor.CPPTYPE_ENUM: "a value of its enum",
    FieldDescriptor.CPPTYPE_STRING: "a string",
}


def _shown(value: object) -> str:
    """The value in a line."""
    if isinstance(value, Message):
        return f"a {value.DESCRIPTOR.name}"
    return reprlib.repr(value)


def refuse(name: str, value: object, expected: str) -> NoReturn:
    """Raises the TypeError."""
    raise TypeError(f"{name} is {_shown(value)}: expected {expected}") from None


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """The end of a message about a word that is none of those allowed; empty if none of
    them is like it."""
    near = difflib.get_close_matches(word, list(allowed), 1)
    return f"; did you mean {near[0]}?" if near else ""


def text(name: str, value: object, expected: str = "a string") -> str:
    if not isinstance(value, str):
        refuse(name, value, expected)
    return value


def instance(name: str, value: object, kinds: Any, expected: str) -> None:
    """Refuses what is none of these types."""
    if not isinstance(value, kinds):
        refuse(name, value, expected)


def seconds(name: str, value: object) -> None:
    """Refuses all but a time that something may take."""
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, bool) or not isinstance(value, kinds):
        refuse(name, value, "seconds")
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(f"{name} is {value} s: it is positive and finite")


def at_least(name: str, value: object, least: int) -> None:
    """Refuses all but an integer of at least so much."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        refuse(name, value, f"an integer of at least {least}")
    if value < least:
        raise ValueError(f"{name} is {value}: it is at least {least}")


def numbers(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """An array of any shape."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        refuse(name, value, f"numbers, {error}")


def _expected(field: FieldDescriptor, sample: Any) -> str:
    """The form of a field's value; `sample` is any message that has the field."""
    if field.message_type is not None:
        if field.message_type.GetOptions().map_entry:
            return "a mapping of strings"
        what = f"a v1.{field.message_type.name}"
    else:
        what = {**_INTEGERS, **_OTHERS}.get(field.cpp_type, "another value")
    # There is no other way to ask in all versions of protobuf.
    if hasattr(getattr(sample, field.name), "extend"):
        return f"a list, of which each is {what}"
    return what


def message(kind: type[_T], **fields: Any) -> _T:
    """A message with these fields. TypeError or ValueError that names the one it cannot
    have."""
    try:
        return kind(**fields)
    except _WRONG:
        for name, value in fields.items():
            try:
                kind(**{name: value})
            except _WRONG:
                sample: Any = kind()
                field = sample.DESCRIPTOR.fields_by_name[name]
                expected = _expected(field, sample)
                if isinstance(value, int) and field.cpp_type in _INTEGERS:
                    raise ValueError(f"{name} is {value}: expected {expected}"
                                     ) from None
                refuse(name, value, expected)
        raise


def check_call(method: str, request: object) -> None:
    """ValueError for a name that is no unary method of the service, TypeError for a
    request that is of another one."""
    service = v1.GetVehicleRequest.DESCRIPTOR.file.services_by_name["PoseGraphService"]
    unary = [one.name for one in service.methods
             if not (one.client_streaming or one.server_streaming)]
    if text("method", method) not in unary:
        raise ValueError(f"there is no unary method {method}"
                         f"{did_you_mean(method, unary)}")
    wanted = service.methods_by_name[method].input_type
    if getattr(request, "DESCRIPTOR", None) is not wanted:
        refuse("request", request, f"a v1.{wanted.name}")
