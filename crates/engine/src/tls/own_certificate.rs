//! The certificate of this side, and its key.

use std::path::Path;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::{CertifiedKey, SigningKey};
use rustls::{Error, InconsistentKeys};

use super::certificate::Parsed;
use super::files::{FileError, certificates, key, key_of};
use super::provider::provider;
use super::rsa_pss::PssKey;
use super::supported_keys::KEYS;

/// Reads a certificate, with its intermediates, and its key. With `decrypted_key`, that is the
/// content of the key's file.
///
/// # Errors
/// [`FileError`] for an unusable file, or a key that does not belong to the certificate.
pub(super) fn own(
    cert_file: &Path,
    key_file: &Path,
    decrypted_key: Option<&[u8]>,
) -> Result<Arc<CertifiedKey>, FileError> {
    let chain = certificates(cert_file)?;
    let key = match decrypted_key {
        Some(text) => key_of(key_file, text)?,
        None => key(key_file)?,
    };
    let wrong = |flaw: String| FileError::content(key_file, flaw);
    let [end_entity, ..] = chain.as_slice() else {
        return Err(FileError::content(cert_file, "found no certificate"));
    };
    check_order(&chain).map_err(|flaw| FileError::content(cert_file, flaw))?;
    let parsed = Parsed::new(end_entity)
        .map_err(|_| FileError::content(cert_file, "certificate 1 can't be read"))?;
    let key = signing_key(key, &parsed)
        .ok_or_else(|| wrong(format!("found a key of another kind, allowed: {KEYS}")))?;
    let own = CertifiedKey::new(chain, key);
    match own.keys_match() {
        Ok(()) => Ok(Arc::new(own)),
        Err(Error::InconsistentKeys(InconsistentKeys::KeyMismatch)) => {
            Err(wrong(format!("it is not the key of the certificate in {}", cert_file.display())))
        }
        Err(error) => Err(wrong(error.to_string())),
    }
}

/// # Errors
/// A certificate is not the issuer of the one before it.
fn check_order(chain: &[CertificateDer<'_>]) -> Result<(), String> {
    for (pair, number) in chain.windows(2).zip(2..) {
        let [below, above] = [&pair[0], &pair[1]].map(|der| Parsed::new(der));
        if let (Ok(below), Ok(above)) = (below, above)
            && !below.is_issued_by(&above)
        {
            return Err(format!(
                "certificate {number}: found {}, allowed: {}, the issuer of certificate {}",
                above.subject_text(),
                below.issuer_text(),
                number - 1
            ));
        }
    }
    Ok(())
}

/// `None` for an unsupported kind of key.
fn signing_key(key: PrivateKeyDer<'static>, of: &Parsed) -> Option<Arc<dyn SigningKey>> {
    // The certificate says whether an RSA key is for RSASSA-PSS alone.
    match of.pss_algorithm() {
        Some(algorithm) => Some(Arc::new(PssKey::new(&key, &algorithm)?)),
        None => provider().key_provider.load_private_key(key).ok(),
    }
}
