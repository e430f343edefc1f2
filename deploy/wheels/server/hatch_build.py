"""Tags the wheel with the platform that its programs are for."""

from __future__ import annotations

import os
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Takes the platform from deploy/wheels/build, since that knows for which the
    programs were compiled."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        platform = os.environ.get("REVISIT_WHEEL_PLATFORM")
        if not platform:
            raise RuntimeError("the programs are not here: deploy/wheels/build makes "
                               "this wheel")
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"
