//! Which certificates are trusted, for servers and clients alike.
//!
//! * A listed certificate is trusted, regardless of its `CA` flag and `keyUsage`, unless it is revoked.
//! * A listed authority ([`Parsed::is_authority`]) can issue certificates within its own dates.
//! * A presented certificate with `CA:TRUE` is trusted only if it is listed itself.
//! * Dates and purpose of the presented certificate are always checked.
//! * The key of a client must be for signing. Devices with other `keyUsage` are common.
//!
//! webpki checks signatures, and the constraints along a path. [`Lists`] judges revocation. Dates are checked when a certificate
//! is used, not when its file is read: the clock of a machine may be wrong just after power-on.

use std::hash::{Hash, Hasher};
use std::path;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, Der, TrustAnchor, UnixTime};
use rustls::{CertificateError, Error, OtherError};
use webpki::{EndEntityCert, ExtendedKeyUsageValidator, KeyPurposeIdIter, VerifiedPath};
use x509_cert::der::asn1::ObjectIdentifier;
use x509_cert::der::{Reader, SliceReader};

use super::certificate::{Parsed, Purpose};
use super::failure::{TlsFailure, between};
use super::files::{FileError, certificates};
use super::provider::ALGORITHMS;
use super::revocation::Lists;
use super::supported_keys::check_key;

/// A trusted certificate.
#[derive(Debug)]
pub(super) struct Listed {
    certificate: CertificateDer<'static>,
    pub(super) parsed: Parsed,
    /// The name and key of an authority.
    anchor: Option<TrustAnchor<'static>>,
}

impl Listed {
    /// # Errors
    /// The certificate cannot be parsed.
    pub(super) fn new(certificate: CertificateDer<'static>) -> Result<Listed, CertificateError> {
        let parsed = Parsed::new(&certificate)?;
        let anchor = match parsed.is_authority() {
            true => {
                let anchor = webpki::anchor_from_trusted_cert(&certificate);
                Some(anchor.map_err(|_| CertificateError::BadEncoding)?.to_owned())
            }
            false => None,
        };
        Ok(Listed { certificate, parsed, anchor })
    }

    /// Reads all certificates of a file, at least one.
    ///
    /// # Errors
    /// [`FileError`]
    pub(super) fn of_file(file: &path::Path) -> Result<Arc<[Listed]>, FileError> {
        let numbered = certificates(file)?.into_iter().enumerate();
        let listed = numbered.map(|(index, certificate)| {
            let flaw = || format!("certificate {} can't be read", index + 1);
            Listed::new(certificate).map_err(|_| FileError::content(file, flaw()))
        });
        listed.collect()
    }

    pub(super) fn is_authority(&self) -> bool {
        self.anchor.is_some()
    }
}

impl PartialEq for Listed {
    fn eq(&self, other: &Listed) -> bool {
        self.certificate == other.certificate
    }
}

impl Eq for Listed {}

impl Hash for Listed {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.certificate.hash(state);
    }
}

/// The trusted certificates.
#[derive(Debug)]
pub(super) struct Trust {
    pub(super) listed: Arc<[Listed]>,
    pub(super) lists: Lists,
    /// Those of the listed certificates that are revoked.
    revoked: Vec<CertificateDer<'static>>,
}

impl Trust {
    pub(super) fn new(listed: Arc<[Listed]>, lists: Lists) -> Trust {
        let mut trust = Trust { listed, lists, revoked: Vec::new() };
        let mut found = trust.listed_that(|each| trust.is_revoked_by_list(each));
        // So are those below, as on a presented path.
        while !found.is_empty() {
            trust.revoked.append(&mut found);
            found = trust
                .listed_that(|each| !trust.is_revoked(each) && trust.is_below_revoked_ones(each));
        }
        trust
    }

    fn listed_that(&self, is: impl Fn(&Listed) -> bool) -> Vec<CertificateDer<'static>> {
        self.listed.iter().filter(|each| is(each)).map(|each| each.certificate.clone()).collect()
    }

    pub(super) fn authorities(&self) -> Vec<&Parsed> {
        let authorities = self.listed.iter().filter(|each| each.is_authority());
        authorities.map(|each| &each.parsed).collect()
    }

    fn is_revoked_by_list(&self, listed: &Listed) -> bool {
        let certificate = EndEntityCert::try_from(&listed.certificate);
        // One that webpki can't read is no authority, and is refused when it is presented.
        certificate.is_ok_and(|certificate| {
            self.lists.judge_listed(&certificate, &listed.parsed, &self.authorities()).is_err()
        })
    }

    /// Whether a listed authority that may have issued a listed certificate is revoked. Of several with the
    /// same name and key, one may be valid.
    fn is_below_revoked_ones(&self, listed: &Listed) -> bool {
        let authorities = self.authorities();
        let may_have_issued = |each: &&Listed| {
            each.is_authority() && listed.parsed.may_be_of(&each.parsed, &authorities)
        };
        let issuers: Vec<_> = self.listed.iter().filter(may_have_issued).collect();
        issuers.iter().any(|issuer| {
            let mut of_its_key =
                issuers.iter().filter(|each| each.parsed.key() == issuer.parsed.key());
            of_its_key.all(|each| self.is_revoked(each))
        })
    }

    /// Whether a listed certificate is revoked: by a list, or since those above it are.
    pub(super) fn is_revoked(&self, listed: &Listed) -> bool {
        self.revoked.contains(&listed.certificate)
    }

    /// Verifies the certificate of a peer, for its purpose. Does not check the name.
    ///
    /// # Errors
    /// Why the certificate is not trusted. [`TlsFailure`] distinguishes the causes.
    pub(super) fn judge(
        &self,
        presented: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        purpose: Purpose,
        now: UnixTime,
    ) -> Result<(), Error> {
        let parsed = Parsed::new(presented)?;
        let end_entity = EndEntityCert::try_from(presented).map_err(refused)?;
        check_key(parsed.key()).map_err(wrapped)?;
        parsed.check_dates(now)?;
        parsed.check_purpose(purpose)?;
        if let Some(listed) = self.listed.iter().find(|listed| listed.certificate == *presented) {
            return match self.is_revoked(listed) {
                true => Err(CertificateError::Revoked.into()),
                false => Ok(()),
            };
        }
        // An authority is not a device: its own certificate must be listed to be accepted as one.
        if parsed.has_ca_flag() {
            return Err(wrapped(TlsFailure::CaAsEndEntity));
        }
        // Only for clients: the `keyUsage` of many devices lacks digitalSignature.
        if purpose == Purpose::Client && !parsed.may_sign_handshakes() {
            return Err(wrapped(TlsFailure::WrongKeyUsage));
        }
        self.find_issuer(&Path { end_entity: &end_entity, intermediates, purpose, now })
    }

    /// Looks for an authority that issued the certificate.
    fn find_issuer(&self, path: &Path<'_>) -> Result<(), Error> {
        let authorities = self.listed.iter().filter(|listed| listed.is_authority());
        let (valid, outdated): (Vec<_>, Vec<_>) =
            authorities.partition(|listed| listed.parsed.check_dates(path.now).is_ok());
        match self.find_path(path, &valid) {
            // Look for a path to an expired authority, only to report that as the cause.
            Err(webpki::Error::UnknownIssuer) => {
                let due = outdated.iter().find(|each| self.find_path(path, &[**each]).is_ok());
                let due = due.map_or(Ok(()), |due| due.parsed.check_dates(path.now));
                due.map_err(|flaw| wrapped(issuer_failure(flaw)))?;
                Err(CertificateError::UnknownIssuer.into())
            }
            found => found.map_err(refused),
        }
    }

    /// Looks for a path to one of the authorities.
    fn find_path(&self, path: &Path<'_>, authorities: &[&Listed]) -> Result<(), webpki::Error> {
        let anchors = authorities.iter().filter_map(|listed| listed.anchor.as_ref());
        let anchors: Vec<TrustAnchor<'_>> = anchors.map(borrow_anchor).collect();
        let check = |verified: &VerifiedPath<'_>| {
            let allowed = allowed(verified, authorities)?;
            // Of two certificates with the same name and key, it may be that only one is revoked.
            let valid = allowed.into_iter().find(|listed| !self.is_revoked(listed));
            let authority = valid.ok_or(webpki::Error::CertRevoked)?;
            self.lists.judge(verified, &authority.parsed, &self.authorities(), path.now)
        };
        path.end_entity.verify_for_usage(
            ALGORITHMS.all,
            &anchors,
            path.intermediates,
            path.now,
            path.purpose,
            None,
            Some(&check),
        )?;
        Ok(())
    }
}

/// A presented certificate, and what is needed to find a path to an authority.
struct Path<'p> {
    end_entity: &'p EndEntityCert<'p>,
    intermediates: &'p [CertificateDer<'p>],
    purpose: Purpose,
    now: UnixTime,
}

impl ExtendedKeyUsageValidator for Purpose {
    fn validate(&self, named: KeyPurposeIdIter<'_, '_>) -> Result<(), webpki::Error> {
        let named: Vec<_> = named.collect::<Result<_, _>>()?;
        match self.is_among(named) {
            true => Ok(()),
            false => Err(webpki::Error::ExtensionValueInvalid),
        }
    }
}

fn borrow_anchor<'a>(anchor: &'a TrustAnchor<'static>) -> TrustAnchor<'a> {
    TrustAnchor {
        subject: Der::from_slice(&anchor.subject),
        subject_public_key_info: Der::from_slice(&anchor.subject_public_key_info),
        name_constraints: anchor.name_constraints.as_deref().map(Der::from_slice),
    }
}

/// The rules along a path that webpki does not check: which certificates are authorities, and the
/// `pathLenConstraint` of a listed one. Returns the listed authorities at the end of the path, which
/// have the same name and key.
fn allowed<'l>(
    path: &VerifiedPath<'_>,
    authorities: &[&'l Listed],
) -> Result<Vec<&'l Listed>, webpki::Error> {
    let mut len = 0;
    for intermediate in path.intermediate_certificates() {
        let parsed = Parsed::new(&intermediate.der()).map_err(|_| webpki::Error::BadDer)?;
        if !parsed.is_authority() {
            return Err(webpki::Error::EndEntityUsedAsCa);
        }
        // Self-issued certificates do not count (RFC 5280, 4.2.1.9).
        len += usize::from(!parsed.is_self_issued());
    }
    let (name, key) = (&path.anchor().subject, &path.anchor().subject_public_key_info);
    let is_anchor = |listed: &&&Listed| {
        let anchor = listed.anchor.as_ref();
        anchor
            .is_some_and(|anchor| anchor.subject == *name && anchor.subject_public_key_info == *key)
    };
    let fits = |listed: &&Listed| {
        listed.parsed.max_intermediates().is_none_or(|most| len <= usize::from(most))
    };
    let found: Vec<_> = authorities.iter().filter(is_anchor).copied().filter(fits).collect();
    match found.is_empty() {
        true => Err(webpki::Error::PathLenConstraintViolated),
        false => Ok(found),
    }
}

/// Converts an error of webpki. The presented certificate has already passed the checks of its
/// dates and purpose, so these errors concern a certificate above it.
fn refused(error: webpki::Error) -> Error {
    use webpki::Error as Found;
    match error {
        Found::UnknownIssuer => CertificateError::UnknownIssuer.into(),
        Found::CertRevoked => CertificateError::Revoked.into(),
        Found::CrlExpired { time, next_update } => {
            wrapped(TlsFailure::ExpiredRevocationList { ago: between(next_update, time) })
        }
        Found::UnknownRevocationStatus | Found::IssuerNotCrlSigner => {
            CertificateError::UnknownRevocationStatus.into()
        }
        Found::InvalidSignatureForPublicKey => CertificateError::BadSignature.into(),
        Found::BadDer | Found::BadDerTime | Found::TrailingData(_) => {
            CertificateError::BadEncoding.into()
        }
        Found::UnsupportedCriticalExtension => CertificateError::UnhandledCriticalExtension.into(),
        Found::CertExpired { time, not_after } => {
            wrapped(issuer_failure(CertificateError::ExpiredContext { time, not_after }))
        }
        Found::CertNotValidYet { time, not_before } => {
            wrapped(issuer_failure(CertificateError::NotValidYetContext { time, not_before }))
        }
        Found::UnsupportedSignatureAlgorithmContext(context) => {
            wrapped(unsupported_signature(&context.signature_algorithm_id))
        }
        Found::UnsupportedSignatureAlgorithmForPublicKeyContext(context) => {
            wrapped(unsupported_signature(&context.signature_algorithm_id))
        }
        Found::UnsupportedCertVersion => {
            let flaw = "found X.509 version 1 or 2, allowed: version 3".into();
            wrapped(TlsFailure::UnsupportedCertificate { flaw })
        }
        Found::EndEntityUsedAsCa => wrapped(TlsFailure::IssuerNotAuthority),
        Found::PathLenConstraintViolated => constraint_violated("pathLenConstraint"),
        Found::NameConstraintViolation => constraint_violated("nameConstraints"),
        Found::ExtensionValueInvalid | Found::EmptyEkuExtension => {
            constraint_violated("extendedKeyUsage")
        }
        other => {
            let flaw = other.to_string();
            wrapped(TlsFailure::UntrustedCertificate { flaw })
        }
    }
}

fn constraint_violated(constraint: &'static str) -> Error {
    wrapped(TlsFailure::ConstraintViolated { constraint })
}

/// Converts an error of dates that concerns an issuer.
fn issuer_failure(flaw: CertificateError) -> TlsFailure {
    match flaw {
        CertificateError::ExpiredContext { time, not_after } => {
            TlsFailure::IssuerExpired { ago: between(not_after, time) }
        }
        CertificateError::NotValidYetContext { time, not_before } => {
            TlsFailure::IssuerNotYetValid { begins_in: between(time, not_before) }
        }
        other => TlsFailure::from(&Error::from(other)),
    }
}

/// The failure for a signature with an unsupported algorithm.
fn unsupported_signature(algorithm: &[u8]) -> TlsFailure {
    let oid = SliceReader::new(algorithm).and_then(|mut reader| reader.decode());
    let found = match oid.map(|oid: ObjectIdentifier| oid.to_string()).as_deref() {
        Ok("1.2.840.113549.1.1.10") => "RSASSA-PSS with other parameters".into(),
        Ok("1.2.840.113549.1.1.4") => "MD5 with RSA".into(),
        Ok("1.2.840.113549.1.1.5") => "SHA-1 with RSA".into(),
        Ok("1.2.840.10045.4.1") => "SHA-1 with ECDSA".into(),
        Ok(other) => format!("algorithm {other}"),
        Err(_) => return TlsFailure::BadCertificate,
    };
    let flaw = format!(
        "found a signature by {found}, allowed: SHA-256, SHA-384 or SHA-512; for RSASSA-PSS the \
         same hash in the mask, and a salt as long as the hash"
    );
    TlsFailure::UnsupportedCertificate { flaw }
}

/// Wraps a failure, so that rustls carries it through.
fn wrapped(failure: TlsFailure) -> Error {
    CertificateError::Other(OtherError(Arc::new(failure))).into()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rcgen::{
        BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, KeyPair,
        KeyUsagePurpose, date_time_ymd,
    };

    use super::*;
    use crate::tls::test_party::Owner;

    const CA: IsCa = IsCa::Ca(BasicConstraints::Unconstrained);
    const YEAR: u64 = 31_557_600;

    fn trust(listed: &[&Owner]) -> Trust {
        let listed = listed.iter().map(|owner| Listed::new(owner.certificate.der().clone()));
        Trust::new(listed.collect::<Result<_, _>>().unwrap(), Lists::default())
    }

    /// The reason why the first certificate of a chain is not trusted in that year; empty when it
    /// is.
    fn judged(trust: &Trust, chain: &[&Owner], purpose: Purpose, year: u64) -> &'static str {
        let ders: Vec<_> = chain.iter().map(|owner| owner.certificate.der().clone()).collect();
        let now = UnixTime::since_unix_epoch(Duration::from_secs((year - 1970) * YEAR + YEAR / 2));
        match trust.judge(&ders[0], &ders[1..], purpose, now) {
            Ok(()) => "",
            Err(error) => TlsFailure::from(error).reason(),
        }
    }

    #[test]
    fn dates_of_every_certificate_of_a_path_are_checked() {
        let valid = |from, to| {
            move |params: &mut CertificateParams| {
                params.is_ca = CA;
                (params.not_before, params.not_after) =
                    (date_time_ymd(from, 1, 1), date_time_ymd(to, 1, 1));
            }
        };
        let root = Owner::new("root", None, valid(2010, 2050));
        let between = Owner::new("between", Some(&root), valid(2020, 2040));
        let leaf = Owner::new("leaf", Some(&between), |_| {});
        let trust = trust(&[&root]);
        let outcome = |year| judged(&trust, &[&leaf, &between], Purpose::Server, year);
        assert_eq!(outcome(1999), "not_yet_valid");
        assert_eq!(outcome(2005), "issuer_not_yet_valid");
        assert_eq!(outcome(2015), "issuer_not_yet_valid");
        assert_eq!(outcome(2030), "");
        assert_eq!(outcome(2045), "issuer_expired");
        assert_eq!(outcome(2055), "issuer_expired");
        assert_eq!(outcome(2100), "expired");
    }

    #[test]
    fn an_expired_authority_does_not_affect_the_certificates_of_others() {
        let former = Owner::new("root", None, |params| {
            params.is_ca = CA;
            params.not_after = date_time_ymd(2020, 1, 1);
        });
        // Renewed with the same name and key.
        let params = Owner::authority("root", None).params;
        let key = KeyPair::from_pem(&former.key.serialize_pem()).unwrap();
        let renewed = Owner { certificate: params.self_signed(&key).unwrap(), params, key };
        let leaf = Owner::new("leaf", Some(&former), |_| {});
        for listed in [[&former, &renewed], [&renewed, &former]] {
            assert_eq!(judged(&trust(&listed), &[&leaf], Purpose::Server, 2026), "");
        }
        assert_eq!(judged(&trust(&[&former]), &[&leaf], Purpose::Server, 2026), "issuer_expired");
        let stranger = Owner::new("leaf", Some(&Owner::authority("other", None)), |_| {});
        let outcome = judged(&trust(&[&former]), &[&stranger], Purpose::Server, 2026);
        assert_eq!(outcome, "unknown_issuer");
    }

    #[test]
    fn the_same_checks_apply_to_servers_and_clients() {
        let root = Owner::authority("root", None);
        let server = [ExtendedKeyUsagePurpose::ServerAuth];
        let any = [ExtendedKeyUsagePurpose::Any];
        let others = [ExtendedKeyUsagePurpose::CodeSigning, ExtendedKeyUsagePurpose::ServerAuth];
        for (named, is_client) in [(&server[..], false), (&any[..], true), (&others[..], false)] {
            for by in [None, Some(&root)] {
                let leaf = Owner::new("leaf", by, |params| {
                    params.is_ca = IsCa::ExplicitNoCa;
                    params.extended_key_usages = named.to_vec();
                });
                let trust = trust(&[&root, &leaf]);
                assert_eq!(judged(&trust, &[&leaf], Purpose::Server, 2026), "");
                let as_client = if is_client { "" } else { "wrong_purpose" };
                assert_eq!(judged(&trust, &[&leaf], Purpose::Client, 2026), as_client);
            }
        }
    }

    #[test]
    fn an_issuer_without_key_cert_sign_is_not_an_authority() {
        let root = Owner::authority("root", None);
        let no_signer = |params: &mut CertificateParams| {
            params.is_ca = CA;
            params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        };
        let between = Owner::new("between", Some(&root), no_signer);
        let leaf = Owner::new("leaf", Some(&between), |_| {});
        let outcome = |listed: &[&Owner], chain: &[&Owner]| {
            [Purpose::Server, Purpose::Client]
                .map(|purpose| judged(&trust(listed), chain, purpose, 2026))
        };
        assert_eq!(outcome(&[&root], &[&leaf, &between]), ["issuer_not_authority"; 2]);
        assert_eq!(outcome(&[&between], &[&leaf]), ["unknown_issuer"; 2]);
        assert_eq!(outcome(&[&between], &[&between]), [""; 2]);
        assert_eq!(outcome(&[&root], &[&between]), ["ca_as_end_entity"; 2]);
    }

    #[test]
    fn the_path_length_of_a_listed_authority_is_limited() {
        let root = Owner::new("root", None, |params| {
            params.is_ca = IsCa::Ca(BasicConstraints::Constrained(1));
        });
        let one = Owner::authority("one", Some(&root));
        let two = Owner::authority("two", Some(&one));
        let below_one = Owner::new("leaf", Some(&one), |_| {});
        let below_two = Owner::new("leaf", Some(&two), |_| {});
        let trust = trust(&[&root]);
        assert_eq!(judged(&trust, &[&below_one, &one], Purpose::Server, 2026), "");
        let outcome = judged(&trust, &[&below_two, &two, &one], Purpose::Server, 2026);
        assert_eq!(outcome, "constraint_violated");
    }

    #[test]
    fn a_modified_certificate_is_refused() {
        let root = Owner::authority("root", None);
        let leaf = Owner::new("leaf", Some(&root), |_| {});
        let (trust, good) = (trust(&[&root]), leaf.certificate.der().to_vec());
        let now = UnixTime::since_unix_epoch(Duration::from_secs(50 * YEAR));
        let judge = |der: &[u8]| {
            let der = CertificateDer::from_slice(der);
            trust.judge(&der, &[], Purpose::Server, now).is_ok()
        };
        assert!(judge(&good));
        for at in 0..good.len() {
            assert!(!judge(&good[..at]), "the first {at} bytes");
            for bit in [0x01, 0x80] {
                let mut changed = good.clone();
                changed[at] ^= bit;
                assert!(!judge(&changed), "byte {at} with bit {bit:#x}");
            }
        }
    }
}
