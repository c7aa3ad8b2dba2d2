"""Checks rules between keys of tags, and the tags and profiles of devices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from holdfast.config.lenient import fitting, mapping
from holdfast.config.tags import TagConfig
from holdfast.config.words import guess, listing, show
from holdfast.tags import TagError

if TYPE_CHECKING:
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

_TAG: TypeAdapter[TagConfig] = TypeAdapter(TagConfig)


@dataclass
class TagChecks:
    """Checks the tags of one file."""

    report: Report

    def profiles(self, profiles: object) -> None:
        """Reports what is wrong in profiles."""
        for name, profile in mapping(profiles).items():
            self.tags(("profiles", name), mapping(profile))

    def devices(self, devices: object, profiles: dict[Any, Any]) -> None:
        """Reports what is wrong in the tags of devices."""
        for name, device in mapping(devices).items():
            if not isinstance(device, dict):
                continue
            path: KeyPath = ("devices", name)
            profile = device.get("profile")
            if isinstance(profile, str) and profile not in profiles:
                known = listing(profiles) or "none, there are no profiles"
                message = f"found {show(profile)}, allowed: {known}{guess(profile, profiles)}"
                self.report.add((*path, "profile"), message)
            of_profile = profiles.get(profile) if isinstance(profile, str) else None
            order = mapping(of_profile).get("order")
            self.tags(path, {"order": order, "tags": device.get("tags")})

    def tags(self, path: KeyPath, of: dict[Any, Any]) -> None:
        """Reports tags that can't be. `of` has the tags and their default order."""
        order = of.get("order")
        for name, given in mapping(of.get("tags")).items():
            settings = fitting(_TAG, given)
            if settings is None:
                continue
            try:
                settings.tag(str(name), order if isinstance(order, str) else "ABCD")
            except TagError as error:
                at = (*path, "tags", name, error.key)
                if error.key == "order" and "order" not in mapping(given):
                    at = (*path, "order") if "order" in of else at
                self.report.add(at, str(error))
