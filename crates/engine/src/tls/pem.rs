//! Files of certificates and keys, in PEM.

use std::path::{Path, PathBuf};

use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use thiserror::Error;

/// What a key says that needs a passphrase.
const ENCRYPTED: &[u8] = b"ENCRYPTED";

/// A file that can't be used: which, where, and why.
#[derive(Debug, Error)]
#[error("{role} {}: {reason}", file.display())]
pub struct FileError {
    /// What the file is for, as `cert_file`.
    pub role: &'static str,
    pub file: PathBuf,
    pub reason: String,
}

/// A file and what it is for.
#[derive(Debug, Clone, Copy)]
pub(super) struct File<'p> {
    pub(super) role: &'static str,
    pub(super) path: &'p Path,
}

impl File<'_> {
    pub(super) fn error(&self, reason: impl Into<String>) -> FileError {
        FileError { role: self.role, file: self.path.to_owned(), reason: reason.into() }
    }

    /// All certificates, at least one.
    pub(super) fn certificates(&self) -> Result<Vec<CertificateDer<'static>>, FileError> {
        self.all("certificate", "CERTIFICATE")
    }

    /// All lists of revoked certificates, at least one.
    pub(super) fn revocations(
        &self,
    ) -> Result<Vec<CertificateRevocationListDer<'static>>, FileError> {
        self.all("list of revoked certificates", "X509 CRL")
    }

    /// The first key.
    pub(super) fn key(&self) -> Result<PrivateKeyDer<'static>, FileError> {
        let bytes = self.read()?;
        if bytes.windows(ENCRYPTED.len()).any(|window| window == ENCRYPTED) {
            return Err(self.error("found an encrypted key, allowed: a key without a passphrase"));
        }
        PrivateKeyDer::from_pem_slice(&bytes).map_err(|error| match error {
            pem::Error::NoItemsFound => self.error("found no key, allowed: a private key in PEM"),
            error => self.error(format!("not PEM: {error}")),
        })
    }

    fn all<T: PemObject>(&self, what: &str, label: &str) -> Result<Vec<T>, FileError> {
        let items: Result<Vec<T>, _> = T::pem_slice_iter(&self.read()?).collect();
        match items {
            Ok(items) if items.is_empty() => {
                let allowed = format!("allowed: PEM with BEGIN {label}");
                Err(self.error(format!("found no {what}, {allowed}")))
            }
            items => items.map_err(|error| self.error(format!("not PEM: {error}"))),
        }
    }

    fn read(&self) -> Result<Vec<u8>, FileError> {
        std::fs::read(self.path).map_err(|error| self.error(format!("can't be read: {error}")))
    }
}
