"""Prints the oldest version of each package that pyproject.toml declares, as constraints for pip."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

_FLOOR = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)>=(?P<version>[0-9.]+)$")


def oldest(text: str) -> list[str]:
    """Return 'name==version' for each requirement 'name>=version' of the project and of its tests, in the order of the file."""
    project = tomllib.loads(text)["project"]
    requirements = [*project["dependencies"], *project["optional-dependencies"]["test"]]
    floors = {m["name"]: m["version"] for r in requirements if (m := _FLOOR.match(r))}
    missing = [r for r in requirements if not _FLOOR.match(r)]
    if missing:
        raise ValueError(
            f"pyproject.toml: {', '.join(missing)}: expected 'name>=version', the oldest version that works"
        )
    return [f"{name}=={version}" for name, version in floors.items()]


if __name__ == "__main__":
    print("\n".join(oldest(Path(__file__).with_name("..").resolve().joinpath("pyproject.toml").read_text())))
