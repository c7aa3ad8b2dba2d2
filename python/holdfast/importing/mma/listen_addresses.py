"""Converts listen addresses of the source."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import Bind, parse_bind

if TYPE_CHECKING:
    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.key_reader import Section
    from holdfast.importing.notes import Choices, Desk

FORM = "a port, :port or address:port with an IP address"


class Binds:
    """Reads listen addresses, and refuses two that can't be open at once."""

    def __init__(self, desk: Desk, choices: Choices) -> None:
        self._desk = desk
        self._choices = choices
        self._taken: list[tuple[KeyPath, Bind]] = []

    def at(self, parent: Section, key: str, *, required: bool = False) -> Bind | None:
        """The address and port at a key; `None` if there is none."""
        value = parent.get(key)
        if value is not None:
            return self.read(parent.at(key), value)
        if required:
            self._desk.problem_of_key(parent.at(key), "missing, allowed: :port or address:port")
        return None

    def read(self, path: KeyPath, value: object, *, of_key: bool = False) -> Bind | None:
        """The address and port of `value`; `None`, and a problem, if it is not valid."""
        bind = self._parsed(path, value, of_key)
        if bind is None:
            return None
        for other_path, other in self._taken:
            if bind.overlaps(other):
                spelled = self._desk.document.spell(other_path)
                message = f"found {show(value)}, which {spelled} uses"
                self._desk.problem(path, f"{message}, allowed: another port", of_key=of_key)
                return None
        self._taken.append((path, bind))
        return bind

    def _parsed(self, path: KeyPath, value: object, of_key: bool) -> Bind | None:
        text = str(value) if type(value) is int else value
        host, _, port = text.strip().rpartition(":") if isinstance(text, str) else ("", "", "")
        numeric = {"": "[::]", "*": "[::]", "localhost": "127.0.0.1"}.get(host.lower(), host)
        try:
            bind = parse_bind(f"{numeric}:{port}")
        except ValueError:
            bind = None
        if bind is None or bind.port == 0:
            self._desk.problem(path, f"found {show(value)}, allowed: {FORM}", of_key=of_key)
            return None
        if host in ("", "*"):
            other = f"without IPv6 on the machine, write 0.0.0.0:{port}"
            self._desk.check(path, f"listens on all addresses, {bind}; {other}")
        elif host == "0.0.0.0":
            ran, meant = f"IPv4 and IPv6, [::]:{port}", "IPv4 only"
            self._choices.note(self._desk, path, ran=ran, meant=meant)
            return bind if self._choices.as_meant else parse_bind(f"[::]:{port}")
        elif host != numeric:
            self._desk.changed(path, f"listens on {bind}: host names are not allowed")
        return bind
