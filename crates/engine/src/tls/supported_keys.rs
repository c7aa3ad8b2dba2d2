//! Which keys of certificates are supported. A presented certificate needs one; those of its issuers are limited
//! by [`ALGORITHMS`](super::provider::ALGORITHMS).

use x509_cert::der::asn1::{AnyRef, ObjectIdentifier, UintRef};
use x509_cert::der::{Decode, Encode, Reader, SliceReader};
use x509_cert::spki::{AlgorithmIdentifierOwned, SubjectPublicKeyInfoOwned};

use super::failure::TlsFailure;
use super::rsa_pss;

/// The supported keys of certificates.
pub(super) const KEYS: &str = "RSA or RSA-PSS of 2048 to 8192 bits, P-256, P-384, P-521, Ed25519";

const RSA: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.1");
const ELLIPTIC_CURVE: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.2.840.10045.2.1");
const ED25519: ObjectIdentifier = ObjectIdentifier::new_unwrap("1.3.101.112");

const CURVES: [ObjectIdentifier; 3] = [
    ObjectIdentifier::new_unwrap("1.2.840.10045.3.1.7"),
    ObjectIdentifier::new_unwrap("1.3.132.0.34"),
    ObjectIdentifier::new_unwrap("1.3.132.0.35"),
];

/// The allowed sizes of an RSA key, in bits.
const MIN_RSA_BITS: usize = 2048;
const MAX_RSA_BITS: usize = 8192;

/// # Errors
/// [`TlsFailure::UnsupportedCertificate`] for an unsupported key.
pub(super) fn check_key(key: &SubjectPublicKeyInfoOwned) -> Result<(), TlsFailure> {
    let unsupported = |found: String| {
        let flaw = format!("found {found}, allowed: {KEYS}");
        Err(TlsFailure::UnsupportedCertificate { flaw })
    };
    let algorithm = &key.algorithm;
    let is_pss = algorithm.oid == rsa_pss::ID_RSASSA_PSS;
    if algorithm.oid == RSA || is_pss {
        let bits = rsa_bits(key.subject_public_key.raw_bytes());
        let bits = bits.ok_or(TlsFailure::BadCertificate)?;
        if !(MIN_RSA_BITS..=MAX_RSA_BITS).contains(&bits) {
            return unsupported(format!("an RSA key of {bits} bits"));
        }
        if is_pss && !algorithm_content(algorithm).is_some_and(|der| rsa_pss::is_supported(&der)) {
            let found = "an RSA-PSS key with other parameters than SHA-256, SHA-384 or SHA-512 \
                         for hash and mask";
            return unsupported(found.into());
        }
        return Ok(());
    }
    if algorithm.oid == ELLIPTIC_CURVE {
        let curve = algorithm.parameters.as_ref().and_then(|any| any.decode_as().ok());
        return match curve {
            Some(curve) if CURVES.contains(&curve) => Ok(()),
            Some(curve) => unsupported(format!("a key on the curve {curve}")),
            None => unsupported("a key on a curve without a name".into()),
        };
    }
    if algorithm.oid == ED25519 {
        return Ok(());
    }
    unsupported(format!("a key of the kind {}", algorithm.oid))
}

/// The content of an algorithm identifier.
pub(super) fn algorithm_content(algorithm: &AlgorithmIdentifierOwned) -> Option<Vec<u8>> {
    let der = algorithm.to_der().ok()?;
    AnyRef::from_der(&der).ok().map(|sequence| sequence.value().to_vec())
}

/// The size of the modulus of an RSA key in PKCS#1, in bits.
fn rsa_bits(key: &[u8]) -> Option<usize> {
    let whole = AnyRef::from_der(key).ok()?;
    let modulus: UintRef<'_> = SliceReader::new(whole.value()).ok()?.decode().ok()?;
    let first = modulus.as_bytes().first()?;
    Some(modulus.as_bytes().len() * 8 - first.leading_zeros() as usize)
}
