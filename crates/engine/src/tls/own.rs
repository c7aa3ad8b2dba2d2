//! The certificate that this side shows, and its key.

use std::path::Path;
use std::sync::Arc;

use rustls::sign::CertifiedKey;
use rustls::{Error, InconsistentKeys};

use super::files::{FileError, certificates, key};
use super::provider::{KEYS, provider};

/// Reads a certificate, with those between it and the root, and its key.
///
/// # Errors
/// [`FileError`] for a file that can't be used, or a key that is not the certificate's.
pub(super) fn own(cert_file: &Path, key_file: &Path) -> Result<Arc<CertifiedKey>, FileError> {
    let (chain, key) = (certificates(cert_file)?, key(key_file)?);
    let wrong = |flaw: String| FileError::content(key_file, flaw);
    let key = provider().key_provider.load_private_key(key);
    let key = key.map_err(|_| wrong(format!("found a key of another kind, allowed: {KEYS}")))?;
    let own = CertifiedKey::new(chain, key);
    match own.keys_match() {
        Ok(()) => Ok(Arc::new(own)),
        Err(Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            Err(wrong(format!("it is not the key of the certificate in {}", cert_file.display())))
        }
        Err(error) => Err(wrong(error.to_string())),
    }
}
