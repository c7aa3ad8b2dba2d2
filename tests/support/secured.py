"""TLS devices: a relay that adds TLS to any port, and certificates of every kind."""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import threading
from typing import TYPE_CHECKING, Any

from support import wire
from support.certificates import PAST, Certificates, openssl

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self

VERSIONS = {"TLS 1.2": ssl.TLSVersion.TLSv1_2, "TLS 1.3": ssl.TLSVersion.TLSv1_3}

Owner = tuple["Path", "Path"]
"""A certificate and its key."""

EC = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")


class Authority(Certificates):
    """A CA, and certificates that it and others issue."""

    def issue_expired(self, name: str, alternative: str) -> Owner:
        """Issues a certificate that has expired."""
        return self.issue(name, alternative, dates=PAST)

    def self_signed(self, name: str, alternative: str, *, ca: bool) -> Owner:
        """Creates a self-signed certificate, as a device would."""
        certificate, key = self._files(name, "pem", "key")
        told = str(ca).upper()
        openssl(
            *("req", "-x509", *EC, "-keyout", key, "-out", certificate, "-days", "2"),
            *("-subj", f"/CN={name}", "-addext", f"subjectAltName={alternative}"),
            *("-addext", f"basicConstraints=critical,CA:{told}"),
        )
        return certificate, key

    def issue_by(self, owner: Owner, name: str, alternative: str) -> Owner:
        """Issues a certificate that is signed by any certificate, even one that is not a CA."""
        certificate, key, request, extensions = self._files(name, "pem", "key", "csr", "ext")
        extensions.write_text(f"subjectAltName={alternative}\n")
        openssl("req", *EC, "-keyout", key, "-out", request, "-subj", f"/CN={name}")
        openssl(
            *("x509", "-req", "-in", request, "-CA", owner[0], "-CAkey", owner[1]),
            *("-CAcreateserial", "-days", "2", "-extfile", extensions, "-out", certificate),
        )
        return certificate, key

    def rsa(self, name: str) -> Owner:
        """Issues a certificate with an RSA key in PKCS#1."""
        certificate, key, modern, request, extensions = self._files(
            name, "pem", "key", "pk8", "csr", "ext"
        )
        extensions.write_text("basicConstraints=CA:FALSE\n")
        openssl(
            *("req", "-newkey", "rsa:2048", "-nodes", "-keyout", modern),
            *("-out", request, "-subj", f"/CN={name}"),
        )
        openssl("rsa", "-traditional", "-in", modern, "-out", key)
        openssl(
            *("x509", "-req", "-in", request, "-CA", self.ca, "-CAkey", self.key),
            *("-CAcreateserial", "-days", "2", "-extfile", extensions, "-out", certificate),
        )
        return certificate, key

    def sec1(self, key: Path) -> Path:
        """Converts an EC key to SEC1."""
        file = key.with_suffix(".sec1")
        openssl("ec", "-in", key, "-out", file)
        return file

    def locked(self, key: Path, *, traditional: bool) -> Path:
        """Encrypts a key with a passphrase."""
        file = key.with_suffix(".locked")
        form = ("-traditional",) if traditional else ()
        options = ("-aes128", "-passout", "pass:secret")
        openssl("pkey", "-in", key, "-out", file, *options, *form)
        return file

    def _files(self, name: str, *ends: str) -> list[Path]:
        return [self._folder / f"{self._name}-{name}.{end}" for end in ends]


def context(
    owner: Owner, version: str = "TLS 1.3", asks: Path | None = None, *, weak: bool = False
) -> ssl.SSLContext:
    """Returns a server's TLS context for one version; requests certificates of the CA `asks`.

    With `weak` it presents certificates that OpenSSL would refuse by default.
    """
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    if weak:
        made.set_ciphers("DEFAULT:@SECLEVEL=0")
    made.load_cert_chain(*owner)
    made.minimum_version = made.maximum_version = VERSIONS[version]
    if asks is not None:
        made.load_verify_locations(asks)
        made.verify_mode = ssl.CERT_REQUIRED
    return made


class Relay:
    """Removes TLS with a context, and forwards the bytes to a port.

    With `piece`, bytes are sent in pieces of that size. With `most`, each connection ends after
    that many bytes to the client.
    """

    def __init__(
        self,
        to: tuple[str, int],
        context: ssl.SSLContext | None = None,
        *,
        piece: int = 65536,
        most: int | None = None,
    ) -> None:
        self._to = to
        self._context = context
        self._piece = piece
        self.most = most
        self.connections = 0
        self.agreed = 0
        """The number of successful handshakes."""
        self.ends: list[str] = []
        """How clients ended their connections: cleanly, or with an error."""
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._accept, name="relay")]
        self._threads[0].start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._threads[0].join()
        self.cut()
        for thread in self._threads:
            thread.join()
        self._listening.close()

    @property
    def has_ended(self) -> bool:
        """Whether there were connections, and all have ended."""
        with self._lock:
            return self.connections > 0 and not self._open

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._listening.getsockname()
        return host, port

    def url(self, host: str = "127.0.0.1", **options: Any) -> str:
        """Returns the URL for a client."""
        query = "&".join(f"{key}={value}" for key, value in options.items())
        return f"tls://{host}:{self.address[1]}?{query}"

    def cut(self) -> None:
        """Closes every connection without close_notify."""
        with self._lock:
            for end in self._open:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                self.connections += 1
                try:
                    far = socket.create_connection(self._to)
                except OSError:
                    near.close()
                    raise
                for end in (near, far):
                    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                # Closing a connection from another thread must not interfere with its TLS state.
                ends = {near.dup(), far.dup()}
                with self._lock:
                    self._open |= ends
                thread = threading.Thread(target=self._serve, args=(near, far, ends), name="relay")
                self._threads.append(thread)
                thread.start()

    def _serve(self, near: socket.socket, far: socket.socket, ends: set[socket.socket]) -> None:
        try:
            with contextlib.suppress(OSError):
                near = self._secured(near)
                self._pass_on(near, far)
        finally:
            with self._lock:
                self._open -= ends
            for each in (near, far, *ends):
                each.close()

    def _secured(self, near: socket.socket) -> socket.socket:
        near.settimeout(wire.DEADLINE)
        if self._context is None:
            return near
        secured = self._context.wrap_socket(near, server_side=True, suppress_ragged_eofs=False)
        self.agreed += 1
        return secured

    def _pass_on(self, near: socket.socket, far: socket.socket) -> None:
        left = self.most
        while True:
            waiting = isinstance(near, ssl.SSLSocket) and near.pending()
            ready = [near] if waiting else select.select([near, far], [], [])[0]
            if near in ready:
                data = self._received(near)
                if not data:
                    return
                self._send(far, data)
            if far in ready:
                data = far.recv(65536)
                self._send(near, data[:left])
                left = None if left is None else left - len(data)
                if not data or (left is not None and left <= 0):
                    return

    def _received(self, near: socket.socket) -> bytes:
        try:
            data = near.recv(65536)
        except OSError as error:
            self.ends.append(type(error).__name__)
            raise
        if not data:
            self.ends.append("in order")
        return data

    def _send(self, to: socket.socket, data: bytes) -> None:
        for at in range(0, len(data), self._piece):
            to.sendall(data[at : at + self._piece])
