"""Converts the writers other than Modbus: REST, MQTT and Raw Ingest."""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.config.values.topics import parse_topic_filter
from holdfast.config.values.urls import parse_broker
from holdfast.importing.key_reader import seconds, section
from holdfast.importing.mma.address_filters import ALL, written
from holdfast.importing.mma.draft import ADMISSION, INGESTED, Reader
from holdfast.importing.names import free_name, unique_names
from holdfast.net.addresses import LOOPBACK
from holdfast.protocol import MAX_WORD
from holdfast.runtime.text import all_of, listing

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.config.values.ip_addresses import Bind
    from holdfast.importing.key_reader import Section
    from holdfast.types import Area

MIN_TOKEN_CHARS = 16
"""Shorter tokens can be guessed."""

MAX_TIMEOUT_MS = 366 * 24 * 60 * 60 * 1000
"""The longest timeout that is converted: 366 days, in milliseconds."""

PASSWORD_FILE = "mqtt.password"
CLIENT_ID = "holdfast"
QOS = 0
_SCHEMES = {"tcp": "mqtt", "mqtt": "mqtt", "ssl": "mqtts", "tls": "mqtts", "mqtts": "mqtts"}
_BROKER = re.compile(
    r"((?P<scheme>[A-Za-z]{1,8})://)?(?P<user>.*@)?(?P<host>[^/?#@]+)(?P<more>([/?#].*)?)"
)

INGEST_TOKEN = "INGEST_ONLY_TOKEN"
"""The only token that the source accepted, whatever its configuration says."""

PUBLISHED = (INGEST_TOKEN, "CHANGE_ME_LONG_RANDOM")
"""Tokens in the documentation of the source."""


class Adapters(Reader):
    """Reads `rest`, `mqtt` and `raw_ingest` into a draft that already has the memories."""

    def read(self, root: Section) -> None:
        """Reads the sections that exist and are enabled."""
        rest, mqtt = self._enabled(root, "rest"), self._enabled(root, "mqtt")
        raw = self._enabled(root, "raw_ingest")
        if raw is not None:
            self._raw_ingest(raw)
        if rest is not None:
            self._rest(rest)
        if mqtt is not None:
            self._mqtt(mqtt)
        for name, path in self.draft.seals.items():
            self._note_sealed(name, path)

    def _enabled(self, root: Section, key: str) -> Section | None:
        found = root.mapping(key)
        if found is None or found.flag("enabled"):
            return found
        self.desk.left_out(found.path, "not enabled")
        return None

    def _note_sealed(self, name: str, path: KeyPath) -> None:
        if self.draft.rest or self.draft.mqtt or self.draft.raw_ingest_may_open(name):
            return
        message = f"nothing can open {name}: REST, MQTT and Raw Ingest write gate bits"
        self.desk.check(path, f"{message}, and none of them can access it")

    def _rest(self, rest: Section) -> None:
        bind = self.binds.at(rest, "address")
        tokens = self._tokens(rest)
        rest.close()
        if rest.get("address") is None:
            self.desk.left_out(rest.path, "REST is left out: it has no address")
        if bind is None:
            return
        self._rest_at(rest, bind, tokens)
        if self.draft.rest is None:
            self.desk.withdraw(rest.at("address"))

    def _rest_at(self, rest: Section, bind: Bind, tokens: list[dict[str, Any]] | None) -> None:
        if tokens is None:
            return
        sources = self._rest_sources(rest, bind)
        if not tokens and not bind.address.is_loopback:
            message = "REST is left out: without auth it requires a loopback address; bind it to"
            text = f"{message} 127.0.0.1 with tokens: none, or create tokens with `holdfast token`"
            self.desk.left_out(rest.path, text)
        elif sources:
            if not tokens:
                message = "without tokens, every client on this machine may write all areas"
                self.desk.check(rest.path, message)
            found = {"bind": str(bind), "sources": sources, "tokens": tokens or "none"}
            self.draft.rest = found

    def _rest_sources(self, rest: Section, bind: Bind) -> list[str]:
        if bind.address.is_loopback:
            return [written(network) for network in LOOPBACK]
        return self._sources(rest, "REST")

    def _sources(self, parent: Section, what: str) -> list[str]:
        """The sources that the file's filter admits, although it did not apply here before."""
        if self.admitted is None:
            message = "sources are all addresses; list only the networks that need it"
            self.desk.check(parent.path, message)
            return ALL.written()
        if not self.admitted:
            self.desk.left_out(parent.path, f"{what} is left out: ip_filter admits nobody")
            return []
        self.desk.check(parent.path, "sources are from ip_filter, which did not apply here before")
        return self.admitted.written()

    def _tokens(self, rest: Section) -> list[dict[str, Any]] | None:
        """The tokens; empty without authentication, `None` if no client could have access."""
        auth = rest.mapping("auth")
        if auth is None:
            return self._published(rest)
        enabled = auth.flag("enabled")
        auth.word("type", ["bearer"], required=bool(enabled))
        bearer = auth.mapping("bearer", required=bool(enabled))
        entries = [] if bearer is None else bearer.entries("tokens", required=bool(enabled)) or []
        if bearer is not None:
            bearer.close()
        auth.close()
        if not enabled:
            self.desk.left_out(auth.path, "not enabled")
            return self._published(rest)
        tokens = self._token_list(rest, entries)
        if not tokens:
            self.desk.left_out(rest.path, "REST is left out: it has no usable token")
            return None
        self._note_grant(auth.path)
        ran = "these tokens had no effect: one published token wrote, and reads failed"
        self.desk.check(auth.path, f"as it ran: {ran}; as it was meant: each has access")
        return tokens

    def _published(self, rest: Section) -> list[dict[str, Any]]:
        """The only token that the source accepted, if it is to be kept."""
        tokens = self._token_list(rest, []) if self._keeps_ingest_token else []
        if tokens:
            self._note_grant(rest.path)
        return tokens

    def _note_grant(self, path: KeyPath) -> None:
        if grant := self.draft.ingest_grant(self.choices.grant_rest):
            text = f"each token {_written('rest', grant['areas'])}. To read other areas,"
            self.desk.check(path, f"{text} create another token with `holdfast token`")
        else:
            message = "no memory has discrete inputs or input registers, so each token only reads"
            self.desk.check(path, message)

    @property
    def _keeps_ingest_token(self) -> bool:
        return self.choices.keep_published_tokens and not self.choices.as_meant

    def _token_list(
        self, rest: Section, entries: list[tuple[KeyPath, Any]]
    ) -> list[dict[str, Any]]:
        found: dict[str, tuple[KeyPath, str]] = {}
        for path, value in entries:
            token = section(self.desk, path, value)
            if token is None:
                continue
            name, secret = token.name("name"), (token.secret("token") or "").strip()
            token.close()
            digest = hashlib.sha256(secret.encode()).hexdigest()
            if not secret:
                self.desk.left_out(path, "the token is empty")
            elif secret in PUBLISHED and not self.choices.keep_published_tokens:
                message = "everybody knows this token from the documentation of the source;"
                self.desk.left_out(path, f"{message} --keep-published-tokens keeps it")
            elif digest in found:
                self.desk.left_out(path, "the token repeats an earlier one")
            else:
                found[digest] = (token.at("name"), name or f"token-{len(found) + 1}")
                if len(secret) < MIN_TOKEN_CHARS:
                    message = f"the token has fewer than {MIN_TOKEN_CHARS} characters and can be"
                    text = f"{message} guessed; create one with `holdfast token`"
                    token.check("token", text)
        digest = hashlib.sha256(INGEST_TOKEN.encode()).hexdigest()
        if self._keeps_ingest_token and digest not in found:
            found[digest] = (rest.path, "published")
            message = "the token of the documentation that the source always accepted is kept"
            self.desk.check(rest.path, f"{message}, as published; everybody knows it")
        names = unique_names(self.desk, list(found.values()), ("-",))
        grant: dict[str, Any] = {
            **self.draft.ingest_grant(self.choices.grant_rest),
            "access": "read-write",
        }
        if "memories" not in grant:
            grant = {**self.draft.grant(list(self.draft.memories)), "access": "read-only"}
        return [
            {"name": name, "sha256": digest, **grant}
            for digest, name in zip(found, names, strict=True)
        ]

    def _mqtt(self, mqtt: Section) -> None:
        url = self._broker(mqtt)
        topic = mqtt.text("topic")
        client_id, username = mqtt.text("client_id"), mqtt.text("username")
        password = mqtt.secret("password")
        mqtt.close()
        if topic is None:
            self.desk.left_out(mqtt.path, "MQTT is left out: it has no topic")
        if url is None or topic is None or not self._is_topic(mqtt.at("topic"), topic):
            return
        found: dict[str, Any] = {"url": url, "version": "3.1.1"}
        if username is not None:
            found["username"] = username
        if password is not None:
            found |= self._password(mqtt, username)
        if client_id is None:
            message = f"no client_id: set to {CLIENT_ID}, which must be unique at the broker"
            self.desk.changed(mqtt.path, message)
        found["client_id"] = client_id or CLIENT_ID
        grant = self.draft.ingest_grant(self.choices.grant_mqtt)
        if not grant:
            message = "MQTT is left out: no memory has discrete inputs or input registers, and"
            self.desk.left_out(mqtt.path, f"{message} it could write nothing else")
            return
        if restored := self.draft.restored(grant["areas"]):
            grant["while_sealed"] = restored
            text = f"as it ran, messages may also write {_areas(restored)} while their memory"
            mqtt.check("topic", f"{text} is sealed, to restore it: while_sealed")
        found["subscriptions"] = [{"topic": topic, "qos": QOS, **grant}]
        mqtt.check("topic", f"the topic {_written('mqtt', grant['areas'])}")
        self.draft.mqtt = found

    def _is_topic(self, path: KeyPath, topic: str) -> bool:
        try:
            parse_topic_filter(topic)
        except ValueError as error:
            self.desk.problem(path, str(error))
            return False
        return True

    def _password(self, mqtt: Section, username: str | None) -> dict[str, Any]:
        path = mqtt.at("password")
        if username is None:
            self.desk.left_out(path, "no username: the source did not send the password")
            return {}
        message = f"write the password into the file {PASSWORD_FILE} next to the configuration"
        self.desk.check(path, f"{message}, and let nobody else read it")
        return {"password_file": PASSWORD_FILE}

    def _broker(self, mqtt: Section) -> str | None:
        """The URL of the broker; messages never show a user or password."""
        path, text = mqtt.at("broker"), mqtt.text("broker")
        if text is None:
            self.desk.left_out(mqtt.path, "MQTT is left out: it has no broker")
            return None
        match = _BROKER.fullmatch(text)
        scheme = (match["scheme"] or "tcp").lower() if match else ""
        if match and scheme not in _SCHEMES:
            message = f"MQTT is left out: {show(scheme)} is not supported, only {listing(_SCHEMES)}"
            self.desk.left_out(path, message)
            return None
        url = f"{_SCHEMES[scheme]}://{match['host']}" if match else ""
        try:
            parse_broker(url)
        except ValueError:
            self.desk.problem(path, "not a broker URL (value hidden), allowed: tcp://host:port")
            return None
        if match and match["user"]:
            self.desk.left_out(path, "user and password in the URL: set username and password_file")
        if match and match["more"].strip("/"):
            self.desk.left_out(path, "everything after host and port")
        return url

    def _raw_ingest(self, raw: Section) -> None:
        bind = self.binds.at(raw, "listen", required=True)
        timeout = raw.integer("read_timeout_ms", 1, MAX_TIMEOUT_MS)
        raw.close({"max_packet_bytes": "a packet is as long as its count says, up to a whole area"})
        memories = self.draft.written_by_raw_ingest()
        for name in self.draft.memories:
            if name not in memories:
                message = f"could not write {name}, whose name is not a memory id"
                self.desk.check(raw.path, f"{message}; give it an id to allow that")
        if not memories:
            message = f"Raw Ingest is left out: no memory has a number from 0 to {MAX_WORD} as name"
            self.desk.left_out(raw.path, message)
            return
        sources = self._sources(raw, "Raw Ingest")
        if bind is None or not sources:
            return
        listener: dict[str, Any] = {"type": "raw-ingest", "bind": str(bind), "format": "crc"}
        listener["compat"] = {"crc": "none", "flags": "ignore", "packets": "many"}
        listener |= ADMISSION
        if timeout is not None:
            listener |= {"request_timeout": seconds(timeout), "idle_timeout": seconds(timeout)}
        listener["rules"] = [{"sources": sources, **self.draft.grant(memories)}]
        self.draft.listeners[free_name("raw-ingest", set(self.draft.listeners))] = listener


def _areas(areas: Iterable[str]) -> str:
    return all_of(area.replace("_", " ") for area in areas)


def _written(adapter: str, granted: Sequence[Area]) -> str:
    """What an adapter may write, for a note."""
    option = f"--grant-{adapter}"
    message = "may write discrete inputs and input registers of all memories, as it ran"
    beyond = [area for area in granted if area not in INGESTED]
    more = f", and {_areas(beyond)}, by {option}" if beyond else ""
    example = f"as holding_registers in the example of its README: {option} AREA[,AREA]"
    other = "" if beyond else f". To grant other areas, {example}"
    return f"{message}{more}; list only those that it needs{other}"
