//! The files of a server.

use std::path::PathBuf;

/// The PEM files of a server.
#[derive(Debug, Clone)]
pub struct ServerFiles {
    pub protocol: Protocol,
    /// The certificate of the server, with its intermediates.
    pub cert_file: PathBuf,
    /// The key of the certificate, without a passphrase.
    pub key_file: PathBuf,
    /// Authorities of clients, and clients' own certificates. `None`, only with HTTP:
    /// clients need no certificate.
    pub ca_file: Option<PathBuf>,
    /// Revocation lists. If given, every authority above a client requires a list.
    pub crl_file: Option<PathBuf>,
    /// The allowed roles of clients, "" is the null role; `None` is any role. For Modbus, the rules
    /// of a listener decide instead.
    pub roles: Option<Vec<String>>,
}

/// The protocol inside TLS.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Protocol {
    /// Modbus, or packets of Raw Ingest. Clients need a certificate, as MB-TCP-Security requires.
    Modbus,
    /// HTTP/1.1.
    Http,
}

impl Protocol {
    /// Its name in a ClientHello, if it has one (RFC 7301).
    pub(super) fn alpn(self) -> Option<&'static [u8]> {
        match self {
            Protocol::Modbus => None,
            Protocol::Http => Some(b"http/1.1"),
        }
    }

    /// The name of [`ServerFiles::ca_file`] in settings.
    pub(super) fn ca_key(self) -> &'static str {
        match self {
            Protocol::Modbus => "ca_file",
            Protocol::Http => "client_ca_file",
        }
    }
}
