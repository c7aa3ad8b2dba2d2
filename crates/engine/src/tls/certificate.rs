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
    /// It names a role twice, or one that is no UTF8String, or calls the extension critical: whoever
    /// does not know a critical one must refuse, and those who verify know no roles.
    pub(super) fn role(&self) -> Result<String, CertificateError> {
        let extensions = self.0.tbs_certificate().extensions().map_or(&[][..], Vec::as_slice);
        let mut named = extensions.iter().filter(|extension| extension.extn_id == ROLE);
        let role = match (named.next(), named.next()) {
            (None, _) => return Ok(String::new()),
            (Some(extension), None) if extension.critical => {
                return Err(CertificateError::UnhandledCriticalExtension);
            }
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

    fn role(extensions: &[CustomExtension]) -> Result<String, CertificateError> {
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
        let long = [&[12, 0x82, 1, 0][..], &[b'x'; 256]].concat();
        assert_eq!(role(&[extension(&long)]), Ok("x".repeat(256)));
    }

    #[test]
    fn anything_else_is_no_role() {
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
            assert_eq!(role(&[extension(content)]), Err(CertificateError::BadEncoding));
        }
        let twice = [extension(b"\x0c\x01a"), extension(b"\x0c\x01a")];
        assert_eq!(role(&twice), Err(CertificateError::BadEncoding));
        let mut critical = extension(b"\x0c\x01a");
        critical.set_criticality(true);
        assert_eq!(role(&[critical]), Err(CertificateError::UnhandledCriticalExtension));
    }

    #[test]
    fn an_authority_is_one_that_says_so_and_may_sign() {
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
        assert_eq!(certificate.is_valid_at(at(first - 1)), Err(CertificateError::NotValidYet));
        assert_eq!(certificate.is_valid_at(at(first)), Ok(()));
        assert_eq!(certificate.is_valid_at(at(last)), Ok(()));
        assert_eq!(certificate.is_valid_at(at(last + 1)), Err(CertificateError::Expired));
    }

    #[test]
    fn bytes_that_are_no_certificate_are_told() {
        let good = parsed(|_| {}).0.to_der().unwrap();
        for len in 0..good.len() {
            assert!(Parsed::new(&CertificateDer::from(&good[..len])).is_err(), "{len} bytes");
        }
        let longer = [&good[..], &[0]].concat();
        assert!(Parsed::new(&CertificateDer::from(longer)).is_err());
    }
}
