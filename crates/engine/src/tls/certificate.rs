//! What is read of an X.509 certificate beyond what verifying it asks for: the role of its owner, and
//! what it may be trusted as.

use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::{CertificateError, DistinguishedName};
use x509_cert::Certificate;
use x509_cert::der::asn1::{ObjectIdentifier, Utf8StringRef};
use x509_cert::der::{Decode, Encode};
use x509_cert::ext::pkix::{BasicConstraints, KeyUsage};

/// The extension that holds the role (MB-TCP-Security, 8.4).
const ROLE: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.4.1.50316.802.1");

/// A certificate that was read.
#[derive(Debug)]
pub(super) struct Parsed(Certificate);

impl Parsed {
    /// # Errors
    /// It is no X.509 certificate.
    pub(super) fn new(certificate: &CertificateDer<'_>) -> Result<Parsed, CertificateError> {
        let parsed =
            Certificate::from_der(certificate).map_err(|_| CertificateError::BadEncoding)?;
        Ok(Parsed(parsed))
    }

    /// The role of its owner; empty, the null role, when it names none.
    ///
    /// # Errors
    /// It names a role twice, or one that is no UTF8String.
    pub(super) fn role(&self) -> Result<String, CertificateError> {
        let extensions = self.0.tbs_certificate().extensions().map_or(&[][..], Vec::as_slice);
        let mut named = extensions.iter().filter(|extension| extension.extn_id == ROLE);
        let role = match (named.next(), named.next()) {
            (None, _) => return Ok(String::new()),
            (Some(extension), None) => Utf8StringRef::from_der(extension.extn_value.as_bytes()),
            (Some(_), Some(_)) => return Err(CertificateError::BadEncoding),
        };
        role.map(|role| role.to_string()).map_err(|_| CertificateError::BadEncoding)
    }

    /// Whether it may sign other certificates.
    pub(super) fn is_authority(&self) -> bool {
        let certificate = self.0.tbs_certificate();
        let constraints = certificate.get_extension::<BasicConstraints>();
        let usage = certificate.get_extension::<KeyUsage>();
        matches!(constraints, Ok(Some((_, BasicConstraints { ca: true, .. }))))
            && usage.is_ok_and(|usage| usage.is_none_or(|(_, usage)| usage.key_cert_sign()))
    }

    /// Whether it names itself as who signed it.
    pub(super) fn is_self_signed(&self) -> bool {
        self.0.tbs_certificate().issuer() == self.0.tbs_certificate().subject()
    }

    /// # Errors
    /// `now` is not within its dates.
    pub(super) fn is_valid_at(&self, now: UnixTime) -> Result<(), CertificateError> {
        let validity = self.0.tbs_certificate().validity();
        let now = now.as_secs();
        if now < validity.not_before.to_unix_duration().as_secs() {
            return Err(CertificateError::NotValidYet);
        }
        if now > validity.not_after.to_unix_duration().as_secs() {
            return Err(CertificateError::Expired);
        }
        Ok(())
    }

    /// The name of its owner, as clients are told which certificates are wanted.
    pub(super) fn subject(&self) -> Option<DistinguishedName> {
        self.0.tbs_certificate().subject().to_der().ok().map(DistinguishedName::from)
    }
}
