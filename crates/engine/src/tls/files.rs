//! Reads certificates and keys from PEM files.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use rustls::pki_types::pem::{self, PemObject, SectionKind};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::ParsedCertificate;
use thiserror::Error;

/// The size limit of a file, in bytes.
const MAX_FILE_BYTES: u64 = 4 << 20;

/// The first byte of a certificate or key in DER.
const SEQUENCE: u8 = 0x30;

/// An unusable file.
#[derive(Debug, Error)]
pub enum FileError {
    #[error("{file}: {error}")]
    Unreadable { file: String, error: io::Error },
    /// The content is invalid.
    #[error("{file}: {flaw}")]
    Content { file: String, flaw: String },
}

impl FileError {
    pub(super) fn content(file: &Path, flaw: impl Into<String>) -> FileError {
        FileError::Content { file: file.display().to_string(), flaw: flaw.into() }
    }

    /// Shows no part of the file, as the messages of `error` do: a line can have a whole key.
    pub(super) fn not_pem(file: &Path, error: &pem::Error) -> FileError {
        let flaw = match error {
            pem::Error::MissingSectionEnd { end_marker } => {
                match SectionKind::try_from(end_marker.as_slice()) {
                    Ok(_) => &format!("it ends inside a {}", end_marker.escape_ascii()),
                    Err(()) => "it ends inside a block, allowed: PEM, in lines",
                }
            }
            pem::Error::IllegalSectionStart { .. } => {
                "a line that begins with -----BEGIN does not end with -----"
            }
            pem::Error::Base64Decode(_) => "a block is not base64",
            _ => "it is not PEM",
        };
        FileError::content(file, flaw)
    }
}

/// Reads all certificates of a file, in order; at least one.
///
/// # Errors
/// [`FileError`]
pub(super) fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, FileError> {
    let text = read(file)?;
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    let found = found.map_err(|error| FileError::not_pem(file, &error))?;
    if found.is_empty() {
        return Err(FileError::content(file, missing(&text, "certificate")));
    }
    for (index, certificate) in found.iter().enumerate() {
        if ParsedCertificate::try_from(certificate).is_err() {
            let number = index + 1;
            let flaw = format!("certificate {number} can't be read, allowed: X.509 version 3");
            return Err(FileError::content(file, flaw));
        }
    }
    Ok(found)
}

/// Reads the first key of a file: PKCS#8, PKCS#1 or SEC1.
///
/// # Errors
/// [`FileError`]
pub(super) fn key(file: &Path) -> Result<PrivateKeyDer<'static>, FileError> {
    key_of(file, &read(file)?)
}

/// Reads the first key of a text, which is the content of `file`.
///
/// # Errors
/// [`FileError`]
pub(super) fn key_of(file: &Path, text: &[u8]) -> Result<PrivateKeyDer<'static>, FileError> {
    if text.windows(9).any(|word| word == b"ENCRYPTED") {
        let flaw = "the key is encrypted; use a key without a passphrase";
        return Err(FileError::content(file, flaw));
    }
    match PrivateKeyDer::pem_slice_iter(text).next() {
        Some(found) => found.map_err(|error| FileError::not_pem(file, &error)),
        None => Err(FileError::content(file, missing(text, "key"))),
    }
}

fn read(file: &Path) -> Result<Vec<u8>, FileError> {
    let unreadable = |error| FileError::Unreadable { file: file.display().to_string(), error };
    let mut text = Vec::new();
    File::open(file)
        .and_then(|opened| opened.take(MAX_FILE_BYTES + 1).read_to_end(&mut text))
        .map_err(unreadable)?;
    if text.len() as u64 > MAX_FILE_BYTES {
        let flaw =
            format!("more than {MAX_FILE_BYTES} bytes, allowed: certificates or a key in PEM");
        return Err(FileError::content(file, flaw));
    }
    Ok(text)
}

fn missing(text: &[u8], what: &str) -> String {
    let found = if text.first() == Some(&SEQUENCE) { "DER" } else { &format!("no {what}") };
    format!("found {found}, allowed: a {what} in PEM")
}
