//! Reads the properties of an X.509 certificate that trust and roles depend on.

use rustls::pki_types::{CertificateDer, SignatureVerificationAlgorithm, UnixTime};
use rustls::{CertificateError, ExtendedKeyPurpose};
use webpki::KeyPurposeId;
use x509_cert::certificate::{CertificateInner, Profile};
use x509_cert::der::asn1::{AnyRef, BitString, ObjectIdentifier, OctetString, Utf8StringRef};
use x509_cert::der::{self, Decode, Encode, Reader, SliceReader};
use x509_cert::ext::pkix::{
    AuthorityKeyIdentifier, BasicConstraints, CrlDistributionPoints, ExtendedKeyUsage, KeyUsage,
    SubjectKeyIdentifier,
};
use x509_cert::name::Name;
use x509_cert::serial_number::SerialNumber;
use x509_cert::spki::{AlgorithmIdentifierOwned, SubjectPublicKeyInfoOwned};

use super::failure::TlsFailure;
use super::provider::ALGORITHMS;
use super::rsa_pss;
use super::supported_keys::{algorithm_content, check_key};

/// The extension that holds the role (MB-TCP-Security, 8.4).
const ROLE: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.4.1.50316.802.1");

const SERVER_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.1");
const CLIENT_AUTH: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.6.1.5.5.7.3.2");
const ANY_PURPOSE: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.37.0");

/// The most characters of a name and bytes of a serial number in a log.
const MAX_SUBJECT_LEN: usize = 256;
const MAX_SERIAL_LEN: usize = 32;

/// The most bytes of a role. No rule has a longer one, and the audit log repeats it for every write.
const MAX_ROLE_LEN: usize = 255;

/// The side that a peer is on. Its certificate must allow it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    Server,
    Client,
}

impl Purpose {
    /// Whether the purposes in a certificate include this one. A certificate without purposes is
    /// for all.
    ///
    /// RFC 5280 lets applications decide whether `anyExtendedKeyUsage` suffices. Here it does.
    pub(super) fn is_among<'n>(self, named: impl IntoIterator<Item = KeyPurposeId<'n>>) -> bool {
        let oid = match self {
            Purpose::Server => SERVER_AUTH,
            Purpose::Client => CLIENT_AUTH,
        };
        let suffices = [oid, ANY_PURPOSE];
        let mut named = named.into_iter().peekable();
        named.peek().is_none()
            || named.any(|named| suffices.iter().any(|oid| named == purpose_id(oid)))
    }

    /// The error for a certificate that does not allow it.
    pub(super) fn missing(self) -> CertificateError {
        let required = match self {
            Purpose::Server => ExtendedKeyPurpose::ServerAuth,
            Purpose::Client => ExtendedKeyPurpose::ClientAuth,
        };
        CertificateError::InvalidPurposeContext { required, presented: Vec::new() }
    }
}

fn purpose_id(oid: &ObjectIdentifier) -> KeyPurposeId<'_> {
    KeyPurposeId::new(oid.as_bytes())
}

/// Accepts serial numbers of any length: nothing depends on them, and some devices use long ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(super) struct AnySerial;

impl Profile for AnySerial {
    fn check_serial_number(_: &SerialNumber<AnySerial>) -> der::Result<()> {
        Ok(())
    }
}

/// A parsed certificate.
#[derive(Debug)]
pub(super) struct Parsed {
    certificate: CertificateInner<AnySerial>,
    /// What is signed, as received: encoded again, it may be other bytes.
    signed: Vec<u8>,
}

impl Parsed {
    /// # Errors
    /// [`CertificateError::BadEncoding`] when it is not an X.509 certificate.
    pub(super) fn new(certificate: &CertificateDer<'_>) -> Result<Parsed, CertificateError> {
        let read = || {
            let whole = AnyRef::from_der(certificate)?;
            let signed = SliceReader::new(whole.value())?.tlv_bytes()?.to_vec();
            Ok(Parsed { certificate: CertificateInner::from_der(certificate)?, signed })
        };
        read().map_err(|_: der::Error| CertificateError::BadEncoding)
    }

    /// The role in the certificate; empty, the null role, when there is none.
    ///
    /// # Errors
    /// [`TlsFailure::TwoRoles`], [`TlsFailure::RoleType`], or [`TlsFailure::UnsupportedExtension`] if
    /// the extension is critical. Software that does not know a critical extension must refuse the
    /// certificate, and the verifier does not know roles.
    pub(super) fn role(&self) -> Result<String, TlsFailure> {
        let extensions =
            self.certificate.tbs_certificate().extensions().map_or(&[][..], Vec::as_slice);
        let mut named = extensions.iter().filter(|extension| extension.extn_id == ROLE);
        let role = match (named.next(), named.next()) {
            (None, _) => return Ok(String::new()),
            (Some(extension), None) if extension.critical => {
                return Err(TlsFailure::UnsupportedExtension);
            }
            (Some(extension), None) => Utf8StringRef::from_der(extension.extn_value.as_bytes()),
            (Some(_), Some(_)) => return Err(TlsFailure::TwoRoles),
        };
        match role {
            Ok(role) if role.as_str().len() <= MAX_ROLE_LEN => Ok(role.to_string()),
            _ => Err(TlsFailure::RoleType),
        }
    }

    /// Whether it is an authority: it has `CA:TRUE`, and its `keyUsage`, if any, has `keyCertSign`.
    pub(super) fn is_authority(&self) -> bool {
        let usage = self.certificate.tbs_certificate().get_extension::<KeyUsage>();
        self.has_ca_flag()
            && usage.is_ok_and(|usage| usage.is_none_or(|(_, usage)| usage.key_cert_sign()))
    }

    /// Whether it has `CA:TRUE`, even if it is not an authority.
    pub(super) fn has_ca_flag(&self) -> bool {
        self.constraints().is_some_and(|constraints| constraints.ca)
    }

    /// The `pathLenConstraint`: the most authorities between it and an end entity.
    pub(super) fn max_intermediates(&self) -> Option<u8> {
        self.constraints()?.path_len_constraint
    }

    fn constraints(&self) -> Option<BasicConstraints> {
        let found = self.certificate.tbs_certificate().get_extension();
        found.ok().flatten().map(|(_, constraints)| constraints)
    }

    /// Whether its issuer is its own subject. Its signature may be that of another key.
    pub(super) fn is_self_issued(&self) -> bool {
        self.certificate.tbs_certificate().issuer() == self.certificate.tbs_certificate().subject()
    }

    /// Its first and last second.
    pub(super) fn validity(&self) -> (UnixTime, UnixTime) {
        let validity = self.certificate.tbs_certificate().validity();
        let [first, last] = [&validity.not_before, &validity.not_after]
            .map(|time| UnixTime::since_unix_epoch(time.to_unix_duration()));
        (first, last)
    }

    /// # Errors
    /// `now` is outside its dates.
    pub(super) fn check_dates(&self, now: UnixTime) -> Result<(), CertificateError> {
        let (not_before, not_after) = self.validity();
        if now < not_before {
            return Err(CertificateError::NotValidYetContext { time: now, not_before });
        }
        if now > not_after {
            return Err(CertificateError::ExpiredContext { time: now, not_after });
        }
        Ok(())
    }

    /// # Errors
    /// Its `extendedKeyUsage` lacks the purpose.
    pub(super) fn check_purpose(&self, purpose: Purpose) -> Result<(), CertificateError> {
        let named = self.certificate.tbs_certificate().get_extension::<ExtendedKeyUsage>();
        match named.map_err(|_| CertificateError::BadEncoding)? {
            Some((_, ExtendedKeyUsage(named))) => {
                let is_for = !named.is_empty() && purpose.is_among(named.iter().map(purpose_id));
                if is_for { Ok(()) } else { Err(purpose.missing()) }
            }
            None => Ok(()),
        }
    }

    /// The content of the algorithm identifier of an RSA-PSS key; `None` for another kind of key.
    pub(super) fn pss_algorithm(&self) -> Option<Vec<u8>> {
        let is_pss = self.key().algorithm.oid == rsa_pss::ID_RSASSA_PSS;
        self.key_algorithm().filter(|_| is_pss)
    }

    pub(super) fn key(&self) -> &SubjectPublicKeyInfoOwned {
        self.certificate.tbs_certificate().subject_public_key_info()
    }

    /// What it calls its key.
    pub(super) fn own_key(&self) -> Option<OctetString> {
        let found = self.certificate.tbs_certificate().get_extension::<SubjectKeyIdentifier>();
        found.ok().flatten().map(|(_, id)| id.0)
    }

    /// What it calls the key of its authority.
    pub(super) fn authority_key(&self) -> Option<OctetString> {
        let found = self.certificate.tbs_certificate().get_extension::<AuthorityKeyIdentifier>();
        found.ok().flatten()?.1.key_identifier
    }

    fn key_algorithm(&self) -> Option<Vec<u8>> {
        algorithm_content(&self.key().algorithm)
    }

    /// Whether its issuer is the subject of another certificate.
    pub(super) fn is_issued_by(&self, other: &Parsed) -> bool {
        other.has_subject(self.certificate.tbs_certificate().issuer())
    }

    /// Whether another certificate is its issuer, and has the key that signed it.
    pub(super) fn is_signed_by(&self, other: &Parsed) -> bool {
        self.is_issued_by(other) && self.has_signature_of(other) == Some(true)
    }

    /// Whether an authority may have issued it. Its signature tells, unless it can't be verified with the key of
    /// that authority. Then every one of the name may, unless the certificate names another key, or another
    /// `listed` one has signed it. A self-signed one need not name its key (RFC 5280, 4.2.1.1).
    pub(super) fn may_be_of(&self, authority: &Parsed, listed: &[&Parsed]) -> bool {
        self.is_issued_by(authority)
            && self.has_signature_of(authority).unwrap_or_else(|| {
                let named = self.authority_key();
                if self.is_self_issued() && (named.is_none() || named == self.own_key()) {
                    return self.key() == authority.key();
                }
                let keys = named.zip(authority.own_key());
                keys.is_none_or(|(named, key)| named == key)
                    && !listed.iter().any(|each| self.is_signed_by(each))
            })
    }

    fn has_signature_of(&self, other: &Parsed) -> Option<bool> {
        let (by, signature) =
            (self.certificate.signature_algorithm(), self.certificate.signature());
        other.has_signed(&self.signed, by, signature)
    }

    /// Whether a signature is one of its key; `None` if that can't be verified: the algorithm or the key is not
    /// supported.
    pub(super) fn has_signed(
        &self,
        content: &[u8],
        by: &AlgorithmIdentifierOwned,
        signature: &BitString,
    ) -> Option<bool> {
        check_key(self.key()).ok()?;
        let (with, of) = (algorithm_content(by), self.key_algorithm());
        let key = self.key().subject_public_key.raw_bytes();
        let fits = |algorithm: &&&dyn SignatureVerificationAlgorithm| {
            with.as_deref() == Some(algorithm.signature_alg_id().as_ref())
                && of.as_deref() == Some(algorithm.public_key_alg_id().as_ref())
        };
        let mut fitting = ALGORITHMS.all.iter().filter(fits).peekable();
        fitting.peek()?;
        Some(fitting.any(|algorithm| {
            algorithm.verify_signature(key, content, signature.raw_bytes()).is_ok()
        }))
    }

    pub(super) fn has_subject(&self, name: &Name) -> bool {
        self.certificate.tbs_certificate().subject() == name
    }

    pub(super) fn has_issuer(&self, name: &Name) -> bool {
        self.certificate.tbs_certificate().issuer() == name
    }

    /// The subject for a log, as RFC 4514 writes it. Control characters are replaced.
    pub(super) fn subject_text(&self) -> String {
        name_text(self.certificate.tbs_certificate().subject())
    }

    /// The issuer, as [`Parsed::subject_text`].
    pub(super) fn issuer_text(&self) -> String {
        name_text(self.certificate.tbs_certificate().issuer())
    }

    /// The serial number for a log, in hexadecimal digits.
    pub(super) fn serial_text(&self) -> String {
        let number = self.certificate.tbs_certificate().serial_number().as_bytes().iter();
        number.take(MAX_SERIAL_LEN).map(|byte| format!("{byte:02x}")).collect()
    }

    /// Whether its key may sign a handshake: `keyUsage`, if any, has `digitalSignature`.
    pub(super) fn may_sign_handshakes(&self) -> bool {
        let usage = self.certificate.tbs_certificate().get_extension::<KeyUsage>();
        usage.is_ok_and(|usage| usage.is_none_or(|(_, usage)| usage.digital_signature()))
    }

    /// Whether its key may sign revocation lists: `keyUsage`, if any, has `cRLSign`.
    pub(super) fn may_sign_lists(&self) -> bool {
        let usage = self.certificate.tbs_certificate().get_extension::<KeyUsage>();
        usage.is_ok_and(|usage| usage.is_none_or(|(_, usage)| usage.crl_sign()))
    }

    /// Where its authority publishes revocation lists.
    pub(super) fn distribution_points(&self) -> der::Result<Option<CrlDistributionPoints>> {
        let found = self.certificate.tbs_certificate().get_extension();
        found.map(|found| found.map(|(_, points)| points))
    }

    /// The issuer by which a client finds that a server that lists this certificate accepts its own: an
    /// authority itself, and the issuer of any other certificate. A distinguished name as DER.
    pub(super) fn accepted_issuer(&self) -> Option<Vec<u8>> {
        let certificate = self.certificate.tbs_certificate();
        let name = if self.is_authority() { certificate.subject() } else { certificate.issuer() };
        name.to_der().ok()
    }
}

/// A name for a log, as RFC 4514 writes it. Control characters are replaced.
pub(super) fn name_text(name: &Name) -> String {
    let shown = |found: char| if found.is_control() { char::REPLACEMENT_CHARACTER } else { found };
    name.to_string().chars().take(MAX_SUBJECT_LEN).map(shown).collect()
}

#[cfg(test)]
mod tests {
    use rcgen::{
        BasicConstraints as Constraints, CertificateParams, CustomExtension, IsCa, KeyPair,
        KeyUsagePurpose,
    };

    use super::*;

    const ROLE_ARCS: [u64; 10] = [1, 3, 6, 1, 4, 1, 50316, 802, 1, 0];

    fn parsed(with: impl Fn(&mut CertificateParams)) -> Parsed {
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        with(&mut params);
        let certificate = params.self_signed(&KeyPair::generate().unwrap()).unwrap();
        Parsed::new(certificate.der()).unwrap()
    }

    fn extension(content: &[u8]) -> CustomExtension {
        CustomExtension::from_oid_content(&ROLE_ARCS[..9], content.to_vec())
    }

    fn role(extensions: &[CustomExtension]) -> Result<String, TlsFailure> {
        parsed(|params| params.custom_extensions = extensions.to_vec()).role()
    }

    #[test]
    fn a_role_is_one_utf8_string() {
        assert_eq!(role(&[]), Ok(String::new()));
        assert_eq!(role(&[extension(&[12, 0])]), Ok(String::new()));
        assert_eq!(role(&[extension(b"\x0c\x03abc")]), Ok("abc".into()));
        assert_eq!(role(&[extension("\x0c\x03é!".as_bytes())]), Ok("é!".into()));
        let other = CustomExtension::from_oid_content(&ROLE_ARCS, vec![12, 1, 65]);
        assert_eq!(role(&[other]), Ok(String::new()));
        let longest = [&[12, 0x81, 255][..], &[b'x'; 255]].concat();
        assert_eq!(role(&[extension(&longest)]), Ok("x".repeat(255)));
    }

    #[test]
    fn any_other_content_is_not_a_role() {
        let malformed: [&[u8]; 10] = [
            b"",
            b"abc",
            b"\x0c",
            b"\x0c\x04abc",
            b"\x0c\x02abc",
            b"\x0c\x02\xc3\x28",
            b"\x13\x03abc",
            b"\x04\x03abc",
            b"\x0c\x80abc\x00\x00",
            b"\x2c\x05\x0c\x03abc",
        ];
        for content in malformed {
            assert_eq!(role(&[extension(content)]), Err(TlsFailure::RoleType));
        }
        let too_long = [&[12, 0x82, 1, 0][..], &[b'x'; 256]].concat();
        assert_eq!(role(&[extension(&too_long)]), Err(TlsFailure::RoleType));
        let twice = [extension(b"\x0c\x01a"), extension(b"\x0c\x01a")];
        assert_eq!(role(&twice), Err(TlsFailure::TwoRoles));
        let mut critical = extension(b"\x0c\x01a");
        critical.set_criticality(true);
        assert_eq!(role(&[critical]), Err(TlsFailure::UnsupportedExtension));
    }

    #[test]
    fn an_authority_has_the_ca_flag_and_may_sign() {
        let ca = IsCa::Ca(Constraints::Unconstrained);
        assert!(!parsed(|_| {}).is_authority());
        assert!(!parsed(|params| params.is_ca = IsCa::ExplicitNoCa).is_authority());
        assert!(parsed(|params| params.is_ca = ca).is_authority());
        for (usage, is_authority) in
            [(KeyUsagePurpose::KeyCertSign, true), (KeyUsagePurpose::DigitalSignature, false)]
        {
            let with_usage = |params: &mut CertificateParams| {
                params.is_ca = ca;
                params.key_usages = vec![usage];
            };
            assert_eq!(parsed(with_usage).is_authority(), is_authority);
        }
    }

    #[test]
    fn a_certificate_is_valid_from_its_first_second_to_its_last() {
        let certificate = parsed(|params| {
            params.not_before = rcgen::date_time_ymd(2020, 1, 1);
            params.not_after = rcgen::date_time_ymd(2060, 1, 1);
        });
        let at = |seconds: u64| UnixTime::since_unix_epoch(std::time::Duration::from_secs(seconds));
        let (first, last) = (1_577_836_800, 2_840_140_800);
        let early =
            CertificateError::NotValidYetContext { time: at(first - 1), not_before: at(first) };
        let late = CertificateError::ExpiredContext { time: at(last + 1), not_after: at(last) };
        assert_eq!(certificate.check_dates(at(first - 1)), Err(early));
        assert_eq!(certificate.check_dates(at(first)), Ok(()));
        assert_eq!(certificate.check_dates(at(last)), Ok(()));
        assert_eq!(certificate.check_dates(at(last + 1)), Err(late));
    }

    #[test]
    fn bytes_that_are_not_a_certificate_are_an_error() {
        let good = parsed(|_| {}).certificate.to_der().unwrap();
        for len in 0..good.len() {
            assert!(Parsed::new(&CertificateDer::from(&good[..len])).is_err(), "{len} bytes");
        }
        let longer = [&good[..], &[0]].concat();
        assert!(Parsed::new(&CertificateDer::from(longer)).is_err());
    }
}
