"""Resource names, of ids too, and where searches look by them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Optional, Union

from revisit import v1
from revisit._arguments import instance, message, text

#: By id or resource name; None for all.
Vehicles = Union[str, Iterable[str], None]


def vehicle_name(vehicle: str) -> str:
    """The resource name: "vehicles/shuttle-7", also of the id "shuttle-7"."""
    text("vehicle", vehicle, "the id or the resource name of a vehicle")
    return vehicle if "/" in vehicle else f"vehicles/{vehicle}"


def vehicle_names(vehicles: Vehicles) -> list[str]:
    if isinstance(vehicles, str):
        vehicles = (vehicles,)
    instance("vehicles", vehicles, (Iterable, type(None)),
             "ids or resource names of vehicles")
    return [vehicle_name(vehicle) for vehicle in vehicles or ()]


def group_name(group: str) -> str:
    """The resource name: "groups/depot", also of the id "depot"."""
    text("group", group, "the id or the resource name of a group")
    return group if "/" in group else f"groups/{group}"


def search_scope(group: str, vehicles: Vehicles, exclude_own: bool,
                 allow_partial: bool) -> Optional[v1.SearchScope]:
    """Where else than in its own history a search of a vehicle looks; None without a
    group. TypeError for what only a group has."""
    if not group:
        if vehicles is not None or exclude_own or allow_partial:
            raise TypeError("group is missing: vehicles, exclude_own and allow_partial "
                            "are those of a search in a group")
        return None
    return message(v1.SearchScope, group=group_name(group),
                   vehicles=vehicle_names(vehicles), exclude_own=exclude_own,
                   allow_partial=allow_partial)
