"""Settings and options that are given as keywords."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Optional, TypeVar, Union

from revisit import v1
from revisit._arguments import did_you_mean, instance, message, refuse

_T = TypeVar("_T", v1.VehicleSettings, v1.CandidateOptions, v1.GroupSettings)


def number_of(enum: Any, name: str, word: Union[str, int]) -> Any:
    """The value of an enum by its name without what all of them begin with, in the
    letters of the API or of the command line: "DEAD_RECKONING", "dead-reckoning"."""
    if isinstance(word, int):
        return word
    names = [value.name for value in enum.values]
    prefix = names[0].removesuffix("UNSPECIFIED")
    allowed = "one of " + ", ".join(one.removeprefix(prefix) for one in names[1:])
    if not isinstance(word, str):
        refuse(name, word, allowed)
    wanted = word.upper().replace("-", "_").removeprefix(prefix)
    if prefix + wanted not in names or wanted == "UNSPECIFIED":
        raise ValueError(f"{name} is {word!r}: expected {allowed}")
    return enum.values_by_name[prefix + wanted].number


def merged(kind: type[_T], base: Optional[_T],
           keywords: Mapping[str, Any]) -> Optional[_T]:
    """The message `base` with the fields that the keywords name; a mapping for `base`
    is as good as more keywords. TypeError for a name that it does not have, ValueError
    for a word that an enum does not have."""
    if isinstance(base, Mapping):
        base, keywords = None, {**base, **keywords}
    instance("options" if kind is v1.CandidateOptions else "settings", base,
             (kind, type(None)),
             f"a v1.{kind.DESCRIPTOR.name}; its fields are keywords too")
    if not keywords:
        return base
    fields = kind.DESCRIPTOR.fields_by_name
    values: dict[str, Any] = {}
    for name, value in keywords.items():
        if name not in fields:
            raise TypeError(f"there is no setting {name}{did_you_mean(name, fields)}")
        if fields[name].enum_type is not None and value is not None:
            value = number_of(fields[name].enum_type, name, value)
        # None is no value: it leaves the field out.
        values[name] = value
    made = kind()
    if base is not None:
        made.CopyFrom(base)
        for name in keywords:
            made.ClearField(name)
    made.MergeFrom(message(kind, **values))
    return made
