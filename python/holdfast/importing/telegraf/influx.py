"""Imports `outputs.influxdb_v2`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from holdfast.config.text.messages import shape
from holdfast.config.values.scalars import MIN_TIME
from holdfast.config.values.urls import parse_http
from holdfast.importing.telegraf.durations import seconds
from holdfast.importing.telegraf.fields import word
from holdfast.importing.telegraf.reasons import FILTERS, NO_COUNTERPART
from holdfast.net.addresses import joined

if TYPE_CHECKING:
    from holdfast.importing.key_reader import Section

INFLUX_URL = "http://localhost:8086"
TOKEN_FILE = "token.txt"

_OUTPUT_REASONS = {
    **FILTERS,
    "bucket_tag": "all values go to one bucket",
    "insecure_skip_verify": "certificates are always verified; see tls.ca_file",
    "metric_buffer_limit": "see buffer, which counts values",
    "influx_uint_support": "unsigned integers are written as integers, those of 64 bits as floats",
}


@dataclass
class Influx:
    """Reads an output for InfluxDB 2."""

    output: Section

    SHOWN = (
        *("urls", "organization", "bucket", "timeout", "content_encoding"),
        *("tls_ca", "tls_cert", "tls_key"),
    )
    """The keys whose values are converted."""

    def read(self) -> dict[str, Any] | None:
        """The output; `None` if it can't be converted."""
        out = self.output
        org, bucket = out.text("organization"), out.text("bucket")
        made: dict[str, Any] = {"type": "influx", "publish": "scan"}
        address = self._address(org, bucket)
        has_token = out.secret("token") is not None
        if has_token:
            made["token_file"] = TOKEN_FILE
        if word(out, "content_encoding", ("gzip", "identity")) == "identity":
            made["gzip"] = False
        timeout = seconds(out, "timeout")
        if timeout is not None:
            made["timeout"] = max(timeout, MIN_TIME)
        files = {"ca_file": out.text("tls_ca")}
        files |= {"cert_file": out.text("tls_cert"), "key_file": out.text("tls_key")}
        for key in ("insecure_skip_verify", "influx_uint_support", "exclude_bucket_tag"):
            if out.data.get(key) is False:
                out.get(key)
        out.close({**dict.fromkeys(out.data, NO_COUNTERPART), **_OUTPUT_REASONS})
        if address is None:
            return None
        if has_token:
            out.check("token", f"put the token into {TOKEN_FILE}, next to the new configuration")
        return {**made, **address, **self._tls(files, address["url"])}

    def _tls(self, files: dict[str, str | None], url: str) -> dict[str, Any]:
        given = {key: value for key, value in files.items() if value is not None}
        if given and not url.startswith("https:"):
            self.output.left_out("urls", "TLS files without https://")
            return {}
        return {"tls": given} if given else {}

    def _address(self, org: str | None, bucket: str | None) -> dict[str, Any] | None:
        """URL, bucket and organization."""
        out = self.output
        given = out.get("urls")
        if not isinstance(given, list | None):
            out.problem("urls", f"found {shape(given)}, allowed: a list of URLs")
            return None
        urls = given or [INFLUX_URL]
        if len(urls) > 1:
            out.changed("urls", "only the first URL is used")
        if bucket is None:
            out.desk.left_out(out.path, "it has no bucket")
            return None
        try:
            target = parse_http(urls[0])
        except ValueError as error:
            out.desk.left_out(out.path, str(error))  # The message does not repeat the URL.
            return None
        query = {**({"org": org} if org else {}), "bucket": bucket}
        if target.path in ("", "/"):
            return {"url": urls[0].rstrip("/"), **query}
        path, _, own = target.path.partition("?")
        base = f"{'https' if target.secure else 'http'}://{joined(target.host, target.port)}"
        whole = urlencode({**query, "precision": "ns"})
        before = f"{own}&" if own else ""
        return {"url": f"{base}{path.rstrip('/')}/api/v2/write?{before}{whole}"}
