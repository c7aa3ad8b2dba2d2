"""Time-series databases, as processes, for tests. They listen only on the loopback interface."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode
from urllib.request import Request, urlopen

from support import wire
from support.brokers import Broker
from support.machine import tool

if TYPE_CHECKING:
    from pathlib import Path


class Database(Broker):
    """A database with an HTTP interface."""

    @property
    def url(self) -> str:
        return f"http://{self.host}:{self.port}"

    def get(self, path: str, **query: str) -> str:
        """Returns the answer to a request."""
        return self._asked(Request(f"{self.url}{path}?{urlencode(query)}"))

    def post(self, path: str, **query: str) -> str:
        """Returns the answer to a request that changes something."""
        return self._asked(Request(f"{self.url}{path}?{urlencode(query)}", method="POST"))

    @staticmethod
    def _asked(request: Request) -> str:
        with urlopen(request, timeout=wire.DEADLINE) as answer:
            text: str = answer.read().decode()
        return text


class InfluxDb(Database):
    """InfluxDB 1.x, which takes the same lines as the later versions."""

    name = "influxd"

    def command(self) -> list[str]:
        file = self._folder / "influxd.conf"
        places = {each: self._folder / f"influx-{each}" for each in ("meta", "data", "wal")}
        file.write_text(
            'reporting-disabled = true\nbind-address = "127.0.0.1:0"\n'
            f'[meta]\ndir = "{places["meta"]}"\n'
            f'[data]\ndir = "{places["data"]}"\nwal-dir = "{places["wal"]}"\n'
            f'[http]\nbind-address = "{self.host}:{self.port}"\n'
            "[monitor]\nstore-enabled = false\n"
        )
        return [tool("influxd"), "-config", str(file)]

    def rows(self, query: str) -> list[dict[str, Any]]:
        """The rows of the answer to a query, with epoch times in nanoseconds."""
        answer = json.loads(self.get("/query", db="plant", epoch="ns", q=query))
        return [
            dict(zip(series["columns"], values, strict=True)) | series.get("tags", {})
            for result in answer["results"]
            for series in result.get("series", ())
            for values in series["values"]
        ]


class VictoriaMetrics(Database):
    """VictoriaMetrics, as one process."""

    name = "victoria-metrics"

    def command(self) -> list[str]:
        return [
            tool("victoria-metrics"),
            f"-httpListenAddr={self.host}:{self.port}",
            f"-storageDataPath={self._folder / 'victoria'}",
        ]

    def values(self, name: str) -> list[float]:
        """All values of a series, in the order of their times."""
        self.get("/internal/force_flush")
        lines = self.get("/api/v1/export", **{"match[]": name}).splitlines()
        return [value for line in lines for value in json.loads(line)["values"]]


class Prometheus(Database):
    """Prometheus, which scrapes one address, and evaluates a file of rules every second."""

    name = "prometheus"
    target: tuple[str, int] = ("127.0.0.1", 9)
    rules: Path | None = None
    interval = 10
    """Seconds between scrapes, and the timeout of each: a loaded machine needs some of them."""

    def command(self) -> list[str]:
        file = self._folder / "prometheus.yml"
        host, port = self.target
        file.write_text(
            f"global: {{scrape_interval: {self.interval}s, scrape_timeout: {self.interval}s, "
            "evaluation_interval: 1s}\n"
            f"rule_files: {json.dumps([] if self.rules is None else [str(self.rules)])}\n"
            "scrape_configs:\n"
            f"  - {{job_name: holdfast, static_configs: [{{targets: ['{host}:{port}']}}]}}\n"
        )
        return [
            tool("prometheus"),
            f"--config.file={file}",
            f"--storage.tsdb.path={self._folder / 'prometheus'}",
            f"--web.listen-address={self.host}:{self.port}",
        ]

    def _listens(self) -> bool:
        try:
            return bool(super()._listens() and self.get("/-/ready"))
        except OSError:
            return False

    def samples(self, query: str) -> dict[tuple[str, ...], float]:
        """The current values of a query, by device and tag."""
        found = json.loads(self.get("/api/v1/query", query=query))["data"]["result"]
        return {
            (each["metric"]["device"], each["metric"]["tag"]): float(each["value"][1])
            for each in found
        }
