//! Revocation lists: reads them, and judges certificates by them.
//!
//! webpki checks the form of a list, and finds certificates in it. It refuses lists without
//! extensions, which OpenSSL writes unless its configuration names some, so the rest is done here, for
//! lists of every form.

use std::path::Path;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateRevocationListDer, UnixTime};
use webpki::{Cert, CertRevocationList, OwnedCertRevocationList, VerifiedPath};
use x509_cert::certificate::Version;
use x509_cert::crl::{CertificateList, TbsCertList};
use x509_cert::der::asn1::{ContextSpecific, ObjectIdentifier, OctetString, Uint};
use x509_cert::der::{self, Decode, Encode, Reader, SliceReader, TagNumber};
use x509_cert::ext::Extension;
use x509_cert::ext::pkix::name::{DistributionPointName, GeneralName};
use x509_cert::ext::pkix::{AuthorityKeyIdentifier, IssuingDistributionPoint};
use x509_cert::name::Name;
use x509_cert::time::Time;

use super::certificate::{AnySerial, Parsed};
use super::files::FileError;

/// The extensions that RFC 5280, 5.2 requires of every list. No judgement depends on them.
const REQUIRED: [(ObjectIdentifier, &str); 2] =
    [(AUTHORITY_KEY, "authority key identifier"), (CRL_NUMBER, "CRL number")];
const AUTHORITY_KEY: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.35");
const CRL_NUMBER: ObjectIdentifier = ObjectIdentifier::new_unwrap("2.5.29.20");

/// A revocation list.
#[derive(Debug)]
pub(super) struct List {
    /// Its place in the file, from 1.
    pub(super) number: usize,
    /// What is signed.
    signed: Vec<u8>,
    parsed: CertificateList<AnySerial>,
    usable: CertRevocationList<'static>,
    /// The certificates that the list is for; `None` for all of its issuer.
    scope: Option<IssuingDistributionPoint>,
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
        let found = found.map_err(|error| FileError::not_pem(file, &error))?;
        if found.is_empty() {
            let flaw = "found no revocation list, allowed: X509 CRL in PEM";
            return Err(FileError::content(file, flaw));
        }
        let numbered = found.iter().zip(1..);
        let lists = numbered.map(|(der, number)| {
            List::new(der, number).map_err(|why| {
                FileError::content(file, format!("revocation list {number} can't be read: {why}"))
            })
        });
        let mut lists = lists.collect::<Result<Vec<_>, FileError>>()?;
        lists.sort_by_key(|list| std::cmp::Reverse((list.begins(), list.crl_number())));
        Ok(lists)
    }

    /// # Errors
    /// Why the list can't be used.
    fn new(der: &[u8], number: usize) -> Result<List, String> {
        let (signed, mut parsed) = read(der).map_err(|error| error.to_string())?;
        let usable = match &parsed.tbs_cert_list.crl_extensions {
            Some(_) => OwnedCertRevocationList::from_der(der),
            None => {
                let complete = with_extensions(&parsed).map_err(|error| error.to_string())?;
                OwnedCertRevocationList::from_der(&complete)
            }
        };
        let usable = CertRevocationList::from(usable.map_err(|error| error.to_string())?);
        let scope = usable.issuing_distribution_point().map(IssuingDistributionPoint::from_der);
        let scope = scope.transpose().map_err(|error| error.to_string())?;
        // They are in `usable`.
        parsed.tbs_cert_list.revoked_certificates = None;
        Ok(List { number, signed: signed.to_vec(), parsed, usable, scope })
    }

    pub(super) fn issuer(&self) -> &Name {
        &self.parsed.tbs_cert_list.issuer
    }

    pub(super) fn begins(&self) -> UnixTime {
        unix_time(&self.parsed.tbs_cert_list.this_update)
    }

    /// The `nextUpdate`: when the list expires. `None` if it never does.
    pub(super) fn ends(&self) -> Option<UnixTime> {
        self.parsed.tbs_cert_list.next_update.as_ref().map(unix_time)
    }

    /// A later list of the same authority has a higher one.
    fn crl_number(&self) -> Option<Uint> {
        Uint::from_der(self.extension(CRL_NUMBER)?.extn_value.as_bytes()).ok()
    }

    /// What it calls the key of its authority.
    fn authority_key(&self) -> Option<OctetString> {
        let found = self.extension(AUTHORITY_KEY)?.extn_value.as_bytes();
        AuthorityKeyIdentifier::from_der(found).ok()?.key_identifier
    }

    /// The required extensions that it lacks, in words.
    pub(super) fn missing(&self) -> Vec<&'static str> {
        let lacks = |(id, _): &(ObjectIdentifier, _)| self.extension(*id).is_none();
        REQUIRED.into_iter().filter(lacks).map(|(_, name)| name).collect()
    }

    fn extension(&self, id: ObjectIdentifier) -> Option<&Extension> {
        let found = self.parsed.tbs_cert_list.crl_extensions.as_deref().unwrap_or_default();
        found.iter().find(|each| each.extn_id == id)
    }

    /// Whether an authority is its issuer, and has the key that signed it.
    pub(super) fn is_signed_by(&self, authority: &Parsed) -> bool {
        let CertificateList { signature_algorithm, signature, .. } = &self.parsed;
        authority.has_subject(self.issuer())
            && authority.has_signed(&self.signed, signature_algorithm, signature) == Some(true)
    }

    /// Whether a list that an issuer has not signed is provably of another authority of the same name:
    /// it names another key, or another listed authority has signed it. Otherwise it may be a damaged
    /// one of the issuer, or have an unsupported signature.
    pub(super) fn is_of_another(
        &self,
        issuer_key: Option<&OctetString>,
        others: &[&Parsed],
    ) -> bool {
        let names_another = match (self.authority_key(), issuer_key) {
            (Some(named), Some(key)) => named != *key,
            _ => false,
        };
        names_another || others.iter().any(|each| self.is_signed_by(each))
    }

    /// Whether the list is for a certificate: it has the same issuer, and the certificate is within its
    /// scope (RFC 5280, 6.3.3).
    fn is_for(&self, certificate: &Cert<'_>, parsed: &Parsed, is_end_entity: bool) -> bool {
        if self.usable.issuer() != certificate.issuer() {
            return false;
        }
        // Without an issuing distribution point, a list is for all certificates of its issuer.
        let Some(scope) = &self.scope else { return true };
        let is_out_of_scope = match is_end_entity {
            true => scope.only_contains_ca_certs,
            false => scope.only_contains_user_certs,
        };
        if is_out_of_scope {
            return false;
        }
        let own = scope.distribution_point.as_ref();
        let own: Vec<&str> = own.into_iter().flat_map(uris).collect();
        match parsed.distribution_points() {
            Ok(None) => true,
            Ok(Some(points)) => points
                .0
                .iter()
                // Indirect lists and lists for some reasons only are not supported.
                .filter(|point| point.crl_issuer.is_none() && point.reasons.is_none())
                .filter_map(|point| point.distribution_point.as_ref())
                .flat_map(uris)
                .any(|uri| own.contains(&uri)),
            Err(_) => false,
        }
    }

    /// # Errors
    /// A certificate of its issuer is revoked.
    fn check(&self, certificate: &Cert<'_>) -> Result<(), webpki::Error> {
        match self.usable.find_serial(certificate.serial())? {
            Some(_) => Err(webpki::Error::CertRevoked),
            None => Ok(()),
        }
    }
}

/// The lists that certificates are judged by, the newest first. If there are any, every authority
/// requires one.
#[derive(Debug, Default)]
pub(super) struct Lists {
    pub(super) lists: Vec<List>,
}

impl Lists {
    /// Judges every certificate of a path to an authority, one of the `listed` ones.
    ///
    /// # Errors
    /// One is revoked, or no list tells that it is not.
    pub(super) fn judge(
        &self,
        path: &VerifiedPath<'_>,
        authority: &Parsed,
        listed: &[&Parsed],
        now: UnixTime,
    ) -> Result<(), webpki::Error> {
        if self.lists.is_empty() {
            return Ok(());
        }
        let parsed = |each: &Cert<'_>| Parsed::new(&each.der()).map_err(|_| webpki::Error::BadDer);
        let mut presented = None;
        for each in path.intermediate_certificates().rev() {
            let own = parsed(each)?;
            let issuer = presented.as_ref().unwrap_or(authority);
            let list = self.find_list(each, &own, false, issuer, listed)?;
            self.check_certificate(each, list, presented.as_ref(), now)?;
            presented = Some(own);
        }
        let end_entity: &Cert<'_> = path.end_entity();
        let issuer = presented.as_ref().unwrap_or(authority);
        let list = self.find_list(end_entity, &parsed(end_entity)?, true, issuer, listed)?;
        self.check_certificate(end_entity, list, presented.as_ref(), now)
    }

    /// Judges a listed certificate, which needs no list: the operator vouches for it. The newest list
    /// that its authority has signed counts, if a listed one has provably signed the certificate. Before
    /// it, and if none has, nobody knows whose lists those of its name are: the newest of each key counts,
    /// except those that are provably of another authority.
    ///
    /// # Errors
    /// It is revoked.
    pub(super) fn judge_listed(
        &self,
        certificate: &Cert<'_>,
        parsed: &Parsed,
        listed: &[&Parsed],
    ) -> Result<(), webpki::Error> {
        let is_for = |list: &&List| list.is_for(certificate, parsed, !parsed.has_ca_flag());
        let lists = || self.lists.iter().filter(is_for);
        // Nearly always: no signature is checked.
        if lists().all(|list| list.check(certificate).is_ok()) {
            return Ok(());
        }
        let issuer = listed.iter().find(|each| parsed.is_signed_by(each));
        let key = issuer.map_or_else(|| parsed.authority_key(), |issuer| issuer.own_key());
        let others = listed.iter().copied().filter(|each| !parsed.may_be_of(each, listed));
        let others: Vec<_> = others.collect();
        let mut judged = Vec::new();
        for list in lists() {
            if issuer.is_some_and(|issuer| list.is_signed_by(issuer)) {
                return list.check(certificate);
            }
            // Lists that name no key may be of several authorities.
            let of_key = match list.authority_key() {
                None => (None, listed.iter().position(|each| list.is_signed_by(each))),
                named => (named, None),
            };
            if !judged.contains(&of_key) && !list.is_of_another(key.as_ref(), &others) {
                list.check(certificate)?;
                judged.push(of_key);
            }
        }
        Ok(())
    }

    /// The newest list of the issuer of a certificate. Another authority may have the same name: an
    /// earlier or later one, with another key.
    fn find_list(
        &self,
        certificate: &Cert<'_>,
        parsed: &Parsed,
        is_end_entity: bool,
        issuer: &Parsed,
        listed: &[&Parsed],
    ) -> Result<&List, webpki::Error> {
        for list in self.lists.iter().filter(|each| each.is_for(certificate, parsed, is_end_entity))
        {
            if list.is_signed_by(issuer) {
                return Ok(list);
            }
            // If it is of the issuer, an older one knows less.
            if !list.is_of_another(issuer.own_key().as_ref(), listed) {
                break;
            }
        }
        Err(webpki::Error::UnknownRevocationStatus)
    }

    /// Judges a certificate by its list. Its issuer was presented, or is the listed authority, whose
    /// `keyUsage` does not matter.
    fn check_certificate(
        &self,
        certificate: &Cert<'_>,
        list: &List,
        presented: Option<&Parsed>,
        now: UnixTime,
    ) -> Result<(), webpki::Error> {
        if let Some(next_update) = list.ends().filter(|ends| now >= *ends) {
            return Err(webpki::Error::CrlExpired { time: now, next_update });
        }
        if presented.is_some_and(|issuer| !issuer.may_sign_lists()) {
            return Err(webpki::Error::IssuerNotCrlSigner);
        }
        list.check(certificate)
    }
}

/// Reads a list: what is signed, and all of it. [`CertificateList`] can't read version 1, which has
/// no number of its version.
fn read(der: &[u8]) -> der::Result<(&[u8], CertificateList<AnySerial>)> {
    let mut reader = SliceReader::new(der)?;
    let (signed, signature_algorithm, signature) = reader.sequence(|list| {
        Ok::<_, der::Error>((list.tlv_bytes()?, list.decode()?, list.decode()?))
    })?;
    reader.finish()?;
    let tbs_cert_list = SliceReader::new(signed)?.sequence(|list| {
        let version = match list.decode()? {
            None => Version::V1,
            Some(Version::V2) => Version::V2,
            Some(_) => return Err(der::Tag::Integer.value_error().into()),
        };
        Ok::<_, der::Error>(TbsCertList {
            version,
            signature: list.decode()?,
            issuer: list.decode()?,
            this_update: list.decode()?,
            next_update: list.decode()?,
            revoked_certificates: list.decode()?,
            crl_extensions: ContextSpecific::decode_explicit(list, TagNumber(0))?
                .map(|field| field.value),
        })
    })?;
    Ok((signed, CertificateList { tbs_cert_list, signature_algorithm, signature }))
}

/// A list without extensions as webpki requires it: of version 2, and with an extension that does
/// not change its meaning.
fn with_extensions(list: &CertificateList<AnySerial>) -> der::Result<Vec<u8>> {
    let mut list = list.clone();
    list.tbs_cert_list.version = Version::V2;
    let number = OctetString::new(0u8.to_der()?)?;
    list.tbs_cert_list.crl_extensions =
        Some(vec![Extension { extn_id: CRL_NUMBER, critical: false, extn_value: number }]);
    list.to_der()
}

/// The URIs of a distribution point.
fn uris(name: &DistributionPointName) -> Vec<&str> {
    let DistributionPointName::FullName(names) = name else { return Vec::new() };
    let found = names.iter().map(|name| match name {
        GeneralName::UniformResourceIdentifier(uri) => Some(uri.as_str()),
        _ => None,
    });
    found.flatten().collect()
}

fn unix_time(time: &Time) -> UnixTime {
    UnixTime::since_unix_epoch(time.to_unix_duration())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use rcgen::{CertificateParams, CrlDistributionPoint, CrlScope, KeyUsagePurpose, SigningKey};
    use rustls::pki_types::CertificateDer;
    use x509_cert::certificate::CertificateInner;
    use x509_cert::der::asn1::{AnyRef, BitString};
    use x509_cert::spki::AlgorithmIdentifierOwned;

    use super::*;
    use crate::tls::TlsFailure;
    use crate::tls::certificate::Purpose;
    use crate::tls::test_party::{Folder, Owner, revocations};
    use crate::tls::trust::{Listed, Trust};

    /// Within the dates of every certificate and list.
    const NOW: UnixTime = UnixTime::since_unix_epoch(Duration::from_secs(1_800_000_000));

    fn numbered(number: u8) -> impl Fn(&mut CertificateParams) {
        move |params| params.serial_number = Some(rcgen::SerialNumber::from(vec![number]))
    }

    fn intermediate(by: &Owner, usages: &[KeyUsagePurpose]) -> Owner {
        Owner::new("between", Some(by), |params| {
            numbered(3)(params);
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
            params.key_usages = usages.to_vec();
        })
    }

    /// The list of an authority, as DER.
    fn list(by: &Owner, revoked: &[&Owner], scope: Option<(CrlScope, &str)>) -> Vec<u8> {
        revocations(by, revoked, scope).der().to_vec()
    }

    /// The same list in version 1, as OpenSSL writes it.
    fn version_1(by: &Owner, revoked: &[&Owner]) -> Vec<u8> {
        let (_, mut list) = read(&list(by, revoked, None)).unwrap();
        list.tbs_cert_list.crl_extensions = None;
        let version_2 = list.tbs_cert_list.to_der().unwrap();
        // Without the version, which is the first field.
        let content = AnyRef::from_der(&version_2).unwrap().value()[3..].to_vec();
        signed(by, &content, &list.signature_algorithm)
    }

    /// Signs a list or a certificate with this content.
    fn signed(by: &Owner, content: &[u8], algorithm: &AlgorithmIdentifierOwned) -> Vec<u8> {
        let sequence =
            |content: &[u8]| AnyRef::new(der::Tag::Sequence, content).unwrap().to_der().unwrap();
        let signed = sequence(content);
        let signature = BitString::from_bytes(&by.key.sign(&signed).unwrap()).unwrap();
        let parts = [signed, algorithm.to_der().unwrap(), signature.to_der().unwrap()];
        sequence(&parts.concat())
    }

    /// A certificate as if signed with SHA-224, which is not supported.
    fn with_unsupported_signature(owner: &Owner) -> Vec<u8> {
        let mut der = owner.certificate.der().to_vec();
        let sha256 = b"\x2a\x86\x48\xce\x3d\x04\x03\x02";
        for at in 0..der.len() - sha256.len() {
            if der[at..].starts_with(sha256) {
                der[at + sha256.len() - 1] = 1;
            }
        }
        der
    }

    /// A certificate whose first extension has its default written out: not as DER requires.
    fn with_written_default(owner: &Owner, by: &Owner) -> Vec<u8> {
        let der = owner.certificate.der();
        let whole = CertificateInner::<AnySerial>::from_der(der).unwrap();
        let content = whole.tbs_certificate().to_der().unwrap();
        let mut content = AnyRef::from_der(&content).unwrap().value().to_vec();
        let alternative_name = b"\x06\x03\x55\x1d\x11";
        let at = content.windows(5).position(|found| found == alternative_name).unwrap();
        for len in [at - 5, at - 3, at - 1] {
            content[len] += 3;
        }
        content.splice(at + 5..at + 5, *b"\x01\x01\x00");
        signed(by, &content, whole.signature_algorithm())
    }

    /// The reason why a client is not trusted; empty if it is.
    fn judged(listed: &Owner, lists: &[Vec<u8>], chain: &[&Owner]) -> &'static str {
        judged_by(&[listed], lists, chain)
    }

    fn judged_by(listed: &[&Owner], lists: &[Vec<u8>], chain: &[&Owner]) -> &'static str {
        let [listed, chain] = [listed, chain]
            .map(|owners| owners.iter().map(|owner| &owner.certificate.der()[..]).collect());
        judged_as_der(listed, lists, chain)
    }

    fn judged_as_der(listed: Vec<&[u8]>, lists: &[Vec<u8>], chain: Vec<&[u8]>) -> &'static str {
        let lists = lists.iter().map(|der| List::new(der, 1).unwrap()).collect();
        let listed = listed.iter().map(|der| Listed::new(CertificateDer::from(der.to_vec())));
        let lists = Lists { lists };
        let trust = Trust::new(listed.collect::<Result<_, _>>().unwrap(), lists);
        let chain: Vec<_> = chain.into_iter().map(CertificateDer::from).collect();
        match trust.judge(&chain[0], &chain[1..], Purpose::Client, NOW) {
            Ok(()) => "",
            Err(error) => TlsFailure::from(error).reason(),
        }
    }

    #[test]
    fn every_certificate_of_a_path_is_judged_by_a_list_of_its_issuer() {
        let root = Owner::authority("root", None);
        let signs = [KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let between = intermediate(&root, &signs);
        let leaf = Owner::new("leaf", Some(&between), numbered(4));
        let chain = [&leaf, &between];
        for write in [version_1, |by: &Owner, revoked: &[&Owner]| list(by, revoked, None)] {
            let (root_has, between_has) = (write(&root, &[]), write(&between, &[]));
            let revoked = [write(&root, &[&between]), write(&between, &[&leaf])];
            let reason = |lists: &[Vec<u8>]| judged(&root, lists, &chain);
            assert_eq!(reason(&[]), "");
            assert_eq!(reason(&[root_has.clone(), between_has.clone()]), "");
            assert_eq!(reason(std::slice::from_ref(&root_has)), "unknown_revocation");
            assert_eq!(reason(std::slice::from_ref(&between_has)), "unknown_revocation");
            assert_eq!(reason(&[revoked[0].clone(), between_has]), "revoked");
            assert_eq!(reason(&[root_has, revoked[1].clone()]), "revoked");
        }
    }

    #[test]
    fn of_lists_from_the_same_second_the_higher_number_counts() {
        let root = Owner::authority("root", None);
        let numbered = |number: u64| {
            let list = rcgen::CertificateRevocationListParams {
                this_update: rcgen::date_time_ymd(2026, 1, 1),
                next_update: rcgen::date_time_ymd(2090, 1, 1),
                crl_number: number.into(),
                issuing_distribution_point: None,
                revoked_certs: Vec::new(),
                key_identifier_method: rcgen::KeyIdMethod::Sha256,
            };
            list.signed_by(&root.issuer()).unwrap().pem().unwrap()
        };
        let folder = Folder::new();
        for (numbers, newest) in [([255, 256], 2), ([256, 255], 1), ([9, 127], 2)] {
            let file = folder.write("lists.pem", &numbers.map(numbered).concat());
            assert_eq!(List::of_file(&file).unwrap()[0].number, newest);
        }
    }

    #[test]
    fn an_intermediate_that_may_not_sign_lists_is_not_believed() {
        let root = Owner::authority("root", None);
        let between = intermediate(&root, &[KeyUsagePurpose::KeyCertSign]);
        let leaf = Owner::new("leaf", Some(&between), numbered(4));
        for write in [version_1, |by: &Owner, revoked: &[&Owner]| list(by, revoked, None)] {
            let lists = [write(&root, &[]), write(&between, &[])];
            assert_eq!(judged(&root, &lists, &[&leaf, &between]), "unknown_revocation");
        }
    }

    #[test]
    fn a_list_is_only_for_certificates_within_its_scope() {
        let root = Owner::authority("root", None);
        let leaf = |points: &[&str]| {
            let points = points.iter().map(|uri| (*uri).to_owned()).collect::<Vec<_>>();
            Owner::new("leaf", Some(&root), move |params| {
                numbered(4)(params);
                if !points.is_empty() {
                    let uris = points.clone();
                    params.crl_distribution_points = vec![CrlDistributionPoint { uris }];
                }
            })
        };
        let reason = |points: &[&str], scope, uri| {
            let leaf = leaf(points);
            let lists = [list(&root, &[&leaf], Some((scope, uri)))];
            judged(&root, &lists, &[&leaf])
        };
        assert_eq!(reason(&[], CrlScope::UserCertsOnly, "http://a"), "revoked");
        assert_eq!(reason(&["http://a"], CrlScope::UserCertsOnly, "http://a"), "revoked");
        assert_eq!(
            reason(&["http://b", "http://a"], CrlScope::UserCertsOnly, "http://a"),
            "revoked"
        );
        let unknown = "unknown_revocation";
        assert_eq!(reason(&["http://b"], CrlScope::UserCertsOnly, "http://a"), unknown);
        assert_eq!(reason(&[], CrlScope::CaCertsOnly, "http://a"), unknown);
    }

    #[test]
    fn a_listed_certificate_needs_no_list_but_can_be_revoked() {
        let (root, other) = (Owner::authority("root", None), Owner::authority("other", None));
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        let reason = |lists: &[Vec<u8>]| judged(&leaf, lists, &[&leaf]);
        assert_eq!(reason(&[]), "");
        assert_eq!(reason(&[version_1(&other, &[&leaf])]), "");
        assert_eq!(reason(&[version_1(&root, &[])]), "");
        assert_eq!(reason(&[version_1(&root, &[&leaf])]), "revoked");
    }

    #[test]
    fn an_older_list_does_not_count_after_one_whose_signature_can_not_be_verified() {
        let [root, twin] = [0; 2].map(|_| Owner::authority("root", None));
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        let between = intermediate(&root, &[]);
        let below = Owner::new("below", Some(&between), numbered(6));
        let older = list(&root, &[], None);
        let damaged = |mut list: Vec<u8>| {
            *list.last_mut().unwrap() ^= 1;
            list
        };
        for newer in [list(&root, &[&leaf, &between], None), version_1(&root, &[&leaf, &between])] {
            let lists = [damaged(newer), older.clone(), version_1(&between, &[])];
            assert_eq!(judged(&root, &lists, &[&leaf]), "unknown_revocation");
            assert_eq!(judged_by(&[&root, &leaf], &lists, &[&leaf]), "revoked");
            assert_eq!(judged_by(&[&root, &between], &lists, &[&below]), "revoked");
        }
        // A list that names another key is not one of this authority.
        let lists = [list(&twin, &[&leaf], None), older.clone()];
        assert_eq!(judged(&root, &lists, &[&leaf]), "");
        let lists = [version_1(&twin, &[&leaf]), older];
        assert_eq!(judged(&root, &lists, &[&leaf]), "unknown_revocation");
        assert_eq!(judged_by(&[&root, &twin], &lists, &[&leaf]), "");
    }

    #[test]
    fn without_the_authority_of_a_listed_certificate_the_newest_list_of_its_key_counts() {
        let [root, twin] = [0; 2].map(|_| Owner::authority("root", None));
        let between = Owner::new("between", Some(&root), |params| {
            numbered(3)(params);
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
            params.use_authority_key_identifier_extension = true;
        });
        let leaf = Owner::new("leaf", Some(&between), numbered(4));
        let reason = |lists: [Vec<u8>; 2]| {
            let lists = [&lists[..], &[version_1(&between, &[])]].concat();
            judged(&between, &lists, &[&leaf])
        };
        let revokes = |by: &Owner| list(by, &[&between], None);
        let revokes_none = |by: &Owner| list(by, &[], None);
        assert_eq!(reason([revokes(&twin), revokes_none(&root)]), "");
        assert_eq!(reason([revokes_none(&twin), revokes(&root)]), "revoked");
        assert_eq!(reason([revokes_none(&root), revokes(&root)]), "");
        assert_eq!(reason([revokes(&root), revokes_none(&root)]), "revoked");
        assert_eq!(reason([version_1(&twin, &[]), revokes(&root)]), "revoked");
    }

    #[test]
    fn a_listed_certificate_is_judged_by_the_list_that_its_listed_authority_has_signed() {
        let (root, twin) = (Owner::authority("root", None), Owner::authority("root", None));
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        let reason = |lists: &[Vec<u8>]| judged_by(&[&leaf, &root], lists, &[&leaf]);
        let revokes = |by| version_1(by, &[&leaf]);
        let revokes_none = |by| version_1(by, &[]);
        assert_eq!(reason(&[list(&twin, &[&leaf], None), revokes_none(&root)]), "");
        assert_eq!(reason(&[revokes_none(&root), revokes(&twin)]), "");
        assert_eq!(reason(&[revokes_none(&twin), revokes(&root)]), "revoked");
        // Nobody knows whose list it is: a client that may be revoked is refused.
        assert_eq!(reason(&[revokes(&twin)]), "revoked");
    }

    #[test]
    fn clients_of_a_listed_authority_that_is_revoked_are_refused() {
        let (root, other) = (Owner::authority("root", None), Owner::authority("other", None));
        let between = intermediate(&root, &[]);
        let leaf = Owner::new("leaf", Some(&between), numbered(4));
        let own = version_1(&between, &[]);
        let outcome = |listed: &[&Owner], revoked: Vec<u8>| {
            let lists = [own.clone(), revoked];
            [&[&leaf][..], &[&leaf, &between]].map(|chain| judged_by(listed, &lists, chain))
        };
        for listed in [&[&root, &between][..], &[&between]] {
            assert_eq!(outcome(listed, version_1(&root, &[&between])), ["revoked"; 2]);
            assert_eq!(outcome(listed, version_1(&root, &[])), [""; 2]);
            assert_eq!(outcome(listed, version_1(&other, &[&between])), [""; 2]);
        }
        // The list of the authority does not matter, and neither does the order of the files.
        let revoked = [version_1(&root, &[&between])];
        assert_eq!(judged_by(&[&between, &root], &revoked, &[&leaf]), "revoked");
        // A root that has revoked itself.
        let root = Owner::new("root", None, |params| {
            numbered(1)(params);
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        });
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        assert_eq!(judged(&root, &[version_1(&root, &[&root])], &[&leaf]), "revoked");
    }

    #[test]
    fn whoever_is_below_a_revoked_authority_is_refused_through_all_that_are_listed() {
        let root = Owner::authority("root", None);
        let first = intermediate(&root, &[]);
        let second = Owner::authority("second", Some(&first));
        let leaf = Owner::new("leaf", Some(&second), numbered(4));
        let lists = |revoked: &[&Owner]| {
            [version_1(&root, revoked), version_1(&first, &[]), version_1(&second, &[])]
        };
        let listed = [&leaf, &second, &first, &root];
        for from in [0, 1] {
            for chain in [&[&leaf][..], &[&leaf, &second, &first]] {
                assert_eq!(judged_by(&listed[from..], &lists(&[]), chain), "");
                assert_eq!(judged_by(&listed[from..], &lists(&[&first]), chain), "revoked");
            }
        }
    }

    #[test]
    fn an_authority_that_was_renewed_with_its_key_outlives_the_revoked_certificate() {
        let root = Owner::authority("root", None);
        let former = intermediate(&root, &[]);
        let mut params = former.params.clone();
        numbered(5)(&mut params);
        let key = rcgen::KeyPair::from_pem(&former.key.serialize_pem()).unwrap();
        let certificate = params.signed_by(&key, &root.issuer()).unwrap();
        let renewed = Owner { certificate, params, key };
        let leaf = Owner::new("leaf", Some(&former), numbered(4));
        let lists = [version_1(&root, &[&former]), version_1(&renewed, &[])];
        assert_eq!(judged_by(&[&former, &renewed], &lists, &[&leaf]), "");
        assert_eq!(judged_by(&[&renewed, &former], &lists, &[&leaf]), "");
        assert_eq!(judged_by(&[&former], &lists, &[&leaf]), "revoked");
    }

    #[test]
    fn whoever_may_be_below_a_revoked_authority_is_refused() {
        let root = Owner::authority("root", None);
        // With the same name, and keys of their own.
        let [revoked, valid] = [3, 5].map(|number| {
            Owner::new("between", Some(&root), |params| {
                numbered(number)(params);
                params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
            })
        });
        let lists = [version_1(&root, &[&revoked]), version_1(&valid, &[])];
        let named = |params: &mut CertificateParams| {
            params.use_authority_key_identifier_extension = true;
        };
        let of_each = |der: &dyn Fn(&Owner) -> Vec<u8>| {
            [&revoked, &valid].map(der).map(|leaf| {
                [&[&revoked][..], &[&revoked, &valid], &[&valid, &revoked]].map(|authorities| {
                    let authorities = [&[&root], authorities].concat();
                    let authorities = authorities.iter().map(|each| &each.certificate.der()[..]);
                    judged_as_der(authorities.chain([&leaf[..]]).collect(), &lists, vec![&leaf])
                })
            })
        };
        let told_apart = [["revoked"; 3], [""; 3]];
        let leaf = |by: &Owner| Owner::new("leaf", Some(by), |_| {});
        assert_eq!(of_each(&|by| leaf(by).certificate.der().to_vec()), told_apart);
        assert_eq!(of_each(&|by| with_written_default(&leaf(by), by)), told_apart);
        let names_key = |by: &Owner| Owner::new("leaf", Some(by), named);
        assert_eq!(of_each(&|by| with_unsupported_signature(&names_key(by))), told_apart);
        assert_eq!(of_each(&|by| with_unsupported_signature(&leaf(by))), [["revoked"; 3]; 2]);
        // One with a key of another kind is not the issuer if another listed one has signed.
        let params = revoked.params.clone();
        let key = rcgen::KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap();
        let certificate = params.signed_by(&key, &root.issuer()).unwrap();
        let other = Owner { certificate, params, key };
        let served = leaf(&valid);
        assert_eq!(judged_by(&[&root, &other, &valid, &served], &lists, &[&served]), "");
        // An authority is refused with all its clients.
        let below = Owner::authority("below", Some(&revoked));
        let leaf = Owner::new("leaf", Some(&below), numbered(4));
        let listed = [&root, &revoked].map(|each| &each.certificate.der()[..]);
        let lists = [&lists[..], &[version_1(&below, &[])]].concat();
        for below in [with_unsupported_signature(&below), with_written_default(&below, &revoked)] {
            let listed = [&listed[..], &[&below]].concat();
            assert_eq!(judged_as_der(listed, &lists, vec![leaf.certificate.der()]), "revoked");
        }
    }

    #[test]
    fn a_root_is_not_below_a_revoked_authority_of_its_name() {
        let [plant, root] = ["plant", "root"].map(|name| Owner::authority(name, None));
        let cross = Owner::new("root", Some(&plant), |params| {
            numbered(3)(params);
            params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        });
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        let lists = [version_1(&plant, &[&cross]), version_1(&root, &[])];
        let with_root = |root: &[u8]| {
            let listed = [plant.certificate.der(), root, cross.certificate.der()].to_vec();
            judged_as_der(listed, &lists, vec![leaf.certificate.der()])
        };
        assert_eq!(with_root(root.certificate.der()), "");
        assert_eq!(with_root(&with_unsupported_signature(&root)), "");
    }

    #[test]
    fn the_newest_list_of_every_authority_counts_that_may_have_issued_a_listed_certificate() {
        let [root, twin] = [0; 2].map(|_| Owner::authority("root", None));
        let reason = |names_key, lists: [&Vec<u8>; 2]| {
            let leaf = Owner::new("leaf", Some(&root), |params| {
                numbered(4)(params);
                params.use_authority_key_identifier_extension = names_key;
            });
            let leaf = with_unsupported_signature(&leaf);
            let listed = vec![&leaf[..], root.certificate.der(), twin.certificate.der()];
            judged_as_der(listed, &lists.map(Clone::clone), vec![&leaf])
        };
        let revoked = Owner::new("leaf", Some(&root), numbered(4));
        let (by_root, by_twin) = (version_1(&root, &[&revoked]), version_1(&twin, &[&revoked]));
        let (none_by_root, none_by_twin) = (version_1(&root, &[]), version_1(&twin, &[]));
        for [names_key, by_twin_counts] in [[true, false], [false, true]] {
            assert_eq!(reason(names_key, [&none_by_twin, &by_root]), "revoked");
            assert_eq!(reason(names_key, [&by_root, &none_by_twin]), "revoked");
            let of_twin = if by_twin_counts { "revoked" } else { "" };
            assert_eq!(reason(names_key, [&by_twin, &none_by_root]), of_twin);
            assert_eq!(reason(names_key, [&none_by_root, &by_twin]), of_twin);
        }
    }

    #[test]
    fn authorities_of_the_same_name_have_lists_of_their_own() {
        let authorities = [0; 2].map(|_| Owner::authority("root", None));
        let [former, renewed] = &authorities;
        let clients = authorities.each_ref().map(|by| Owner::new("leaf", Some(by), numbered(4)));
        let listed: Vec<_> = authorities.iter().chain(&clients).collect();
        let between = intermediate(former, &[]);
        let below = Owner::new("below", Some(&between), numbered(6));
        for write in [version_1, |by: &Owner, revoked: &[&Owner]| list(by, revoked, None)] {
            let lists = [write(former, &[&clients[0]]), write(renewed, &[])];
            let others = [write(former, &[]), write(renewed, &[&between])];
            for order in [[0, 1], [1, 0]] {
                let lists = order.map(|at| lists[at].clone());
                for listed in [&listed[..2], &listed[..]] {
                    let outcome = clients.each_ref().map(|each| judged_by(listed, &lists, &[each]));
                    assert_eq!(outcome, ["revoked", ""]);
                }
                let mut lists = order.map(|at| others[at].clone()).to_vec();
                lists.push(write(&between, &[]));
                assert_eq!(judged_by(&[former, renewed, &between], &lists, &[&below]), "");
            }
            let outcome =
                clients.each_ref().map(|each| judged_by(&listed[..2], &lists[..1], &[each]));
            assert_eq!(outcome, ["revoked", "unknown_revocation"]);
        }
    }

    #[test]
    fn a_modified_list_is_unusable_or_not_believed() {
        let root = Owner::authority("root", None);
        let leaf = Owner::new("leaf", Some(&root), numbered(4));
        let good = version_1(&root, &[&leaf]);
        let listed = Arc::new([Listed::new(root.certificate.der().clone()).unwrap()]);
        let der = leaf.certificate.der();
        let trusts = |bytes: &[u8]| {
            let Ok(list) = List::new(bytes, 1) else { return false };
            let lists = Lists { lists: vec![list] };
            let trust = Trust::new(Arc::clone(&listed) as _, lists);
            trust.judge(der, &[], Purpose::Client, NOW).is_ok()
        };
        for at in 0..good.len() {
            assert!(List::new(&good[..at], 1).is_err(), "the first {at} bytes");
            for bit in [0x01, 0x80] {
                let mut changed = good.clone();
                changed[at] ^= bit;
                assert!(!trusts(&changed), "byte {at} with bit {bit:#x}");
            }
        }
    }

    #[test]
    fn what_a_list_lacks_is_found() {
        let root = Owner::authority("root", None);
        let missing = |der: &[u8]| List::new(der, 1).unwrap().missing();
        assert_eq!(missing(&list(&root, &[], None)), [""; 0]);
        let both = ["authority key identifier", "CRL number"];
        assert_eq!(missing(&version_1(&root, &[])), both);
    }
}
