//! Reads revocation lists.

use std::path::Path;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateRevocationListDer, UnixTime};
use webpki::{CertRevocationList, OwnedCertRevocationList};
use x509_cert::crl::CertificateList;
use x509_cert::der::{Decode, Encode};
use x509_cert::name::Name;
use x509_cert::time::Time;

use super::certificate::{AnySerial, Parsed, algorithm_content};
use super::files::FileError;
use super::provider::ALGORITHMS;

/// A revocation list.
#[derive(Debug)]
pub(super) struct List {
    /// Its place in the file, from 1.
    pub(super) number: usize,
    parsed: CertificateList<AnySerial>,
    usable: CertRevocationList<'static>,
}

impl List {
    /// Reads all lists of a file, at least one. The newest come first: among several lists of one
    /// authority, the first counts.
    ///
    /// # Errors
    /// [`FileError`]
    pub(super) fn of_file(file: &Path) -> Result<Vec<List>, FileError> {
        let text = std::fs::read(file)
            .map_err(|error| FileError::Unreadable { file: file.display().to_string(), error })?;
        let found: Result<Vec<_>, _> =
            CertificateRevocationListDer::pem_slice_iter(&text).collect();
        let found = found.map_err(|error| FileError::content(file, error.to_string()))?;
        if found.is_empty() {
            let flaw = "found no revocation list, allowed: X509 CRL in PEM";
            return Err(FileError::content(file, flaw));
        }
        let numbered = found.iter().zip(1..);
        let lists = numbered.map(|(der, number)| {
            let unreadable = |why: String| {
                FileError::content(file, format!("revocation list {number} can't be read: {why}"))
            };
            let usable = OwnedCertRevocationList::from_der(der);
            let usable = usable.map_err(|error| unreadable(error.to_string()))?.into();
            let parsed = CertificateList::from_der(der);
            let parsed = parsed.map_err(|error| unreadable(error.to_string()))?;
            Ok(List { number, parsed, usable })
        });
        let mut lists = lists.collect::<Result<Vec<_>, FileError>>()?;
        lists.sort_by_key(|list| std::cmp::Reverse(list.begins()));
        Ok(lists)
    }

    pub(super) fn into_usable(self) -> CertRevocationList<'static> {
        self.usable
    }

    pub(super) fn issuer(&self) -> &Name {
        &self.parsed.tbs_cert_list.issuer
    }

    pub(super) fn begins(&self) -> UnixTime {
        moment(&self.parsed.tbs_cert_list.this_update)
    }

    /// When the next list was due.
    pub(super) fn ends(&self) -> Option<UnixTime> {
        self.parsed.tbs_cert_list.next_update.as_ref().map(moment)
    }

    /// Whether an authority has signed it.
    pub(super) fn is_signed_by(&self, authority: &Parsed) -> bool {
        let Ok(signed) = self.parsed.tbs_cert_list.to_der() else { return false };
        let with = algorithm_content(&self.parsed.signature_algorithm);
        let of = algorithm_content(&authority.key().algorithm);
        let key = authority.key().subject_public_key.raw_bytes();
        let signature = self.parsed.signature.raw_bytes();
        ALGORITHMS.all.iter().any(|algorithm| {
            with.as_deref() == Some(algorithm.signature_alg_id().as_ref())
                && of.as_deref() == Some(algorithm.public_key_alg_id().as_ref())
                && algorithm.verify_signature(key, &signed, signature).is_ok()
        })
    }
}

fn moment(time: &Time) -> UnixTime {
    UnixTime::since_unix_epoch(time.to_unix_duration())
}
