//! The files of a server.

use std::path::PathBuf;

/// The PEM files of a server.
#[derive(Debug, Clone)]
pub struct ServerFiles {
    /// The certificate of the server, with its intermediates.
    pub cert_file: PathBuf,
    /// The key of the certificate, without a passphrase.
    pub key_file: PathBuf,
    /// Authorities of clients, and self-signed certificates of clients.
    pub ca_file: PathBuf,
    /// Revocation lists. If given, every authority above a client requires a list.
    pub crl_file: Option<PathBuf>,
    pub expired_lists: ExpiredLists,
}

/// What happens to clients of an authority whose revocation list is past its `nextUpdate`.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub enum ExpiredLists {
    /// They are refused.
    #[default]
    Refuse,
    /// The list counts as it is.
    Accept,
}
