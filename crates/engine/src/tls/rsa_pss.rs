//! Keys for RSASSA-PSS alone (id-RSASSA-PSS, RFC 4055). rustls supports PSS signatures only with
//! ordinary RSA keys.
//!
//! Such a key may name its hash. RFC 8446 requires the same hash in the mask, and a salt as long as
//! the hash. The keys require TLS 1.3: rustls drops their schemes in TLS 1.2.

use std::fmt;
use std::sync::Arc;

use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::signature::{
    self, KeyPair, RsaEncoding, RsaKeyPair, RsaParameters, UnparsedPublicKey,
};
use rustls::pki_types::{
    AlgorithmIdentifier, InvalidSignature, PrivateKeyDer, SignatureVerificationAlgorithm,
    SubjectPublicKeyInfoDer, alg_id,
};
use rustls::sign::{Signer, SigningKey, public_key_to_spki};
use rustls::{Error, SignatureAlgorithm, SignatureScheme};
use x509_cert::der::asn1::{AnyRef, ObjectIdentifier, OctetStringRef};
use x509_cert::der::{Decode, Reader, SliceReader};

pub(super) const ID_RSASSA_PSS: ObjectIdentifier =
    ObjectIdentifier::new_unwrap("1.2.840.113549.1.1.10");

pub(super) const SCHEME_SHA256: SignatureScheme = SignatureScheme::Unknown(0x0809);
pub(super) const SCHEME_SHA384: SignatureScheme = SignatureScheme::Unknown(0x080a);
pub(super) const SCHEME_SHA512: SignatureScheme = SignatureScheme::Unknown(0x080b);

/// The verifiers of signatures with a hash, one for each encoding of the key parameters.
macro_rules! verifiers {
    ($any_salt:ident, $signature:ident, $verify:ident) => {{
        const VERIFY: &RsaParameters = &signature::$verify;
        const SIGNATURE: AlgorithmIdentifier = alg_id::$signature;
        [
            &Verify { key: ANY_HASH, signature: SIGNATURE, verify: VERIFY },
            &Verify { key: $any_salt, signature: SIGNATURE, verify: VERIFY },
            &Verify { key: SIGNATURE, signature: SIGNATURE, verify: VERIFY },
        ]
    }};
}

pub(super) const SHA256: [&dyn SignatureVerificationAlgorithm; 3] =
    verifiers!(ANY_SALT_SHA256, RSA_PSS_SHA256, RSA_PSS_2048_8192_SHA256);
pub(super) const SHA384: [&dyn SignatureVerificationAlgorithm; 3] =
    verifiers!(ANY_SALT_SHA384, RSA_PSS_SHA384, RSA_PSS_2048_8192_SHA384);
pub(super) const SHA512: [&dyn SignatureVerificationAlgorithm; 3] =
    verifiers!(ANY_SALT_SHA512, RSA_PSS_SHA512, RSA_PSS_2048_8192_SHA512);

/// A key without parameters: any hash.
const ANY_HASH: AlgorithmIdentifier =
    AlgorithmIdentifier::from_slice(b"\x06\x09\x2a\x86\x48\x86\xf7\x0d\x01\x01\x0a");

/// Keys that name a hash, with the default minimum salt length, 20.
const ANY_SALT_SHA256: AlgorithmIdentifier = AlgorithmIdentifier::from_slice(&any_salt(1));
const ANY_SALT_SHA384: AlgorithmIdentifier = AlgorithmIdentifier::from_slice(&any_salt(2));
const ANY_SALT_SHA512: AlgorithmIdentifier = AlgorithmIdentifier::from_slice(&any_salt(3));

/// `hash` is the last number of the object identifier of a hash, which occurs twice.
const fn any_salt(hash: u8) -> [u8; 60] {
    let mut der = *b"\
        \x06\x09\x2a\x86\x48\x86\xf7\x0d\x01\x01\x0a\x30\x2f\
        \xa0\x0f\x30\x0d\x06\x09\x60\x86\x48\x01\x65\x03\x04\x02\x01\x05\x00\
        \xa1\x1c\x30\x1a\x06\x09\x2a\x86\x48\x86\xf7\x0d\x01\x01\x08\
        \x30\x0d\x06\x09\x60\x86\x48\x01\x65\x03\x04\x02\x01\x05\x00";
    der[27] = hash;
    der[57] = hash;
    der
}

/// The verifiers of a scheme, if it is an RSASSA-PSS scheme.
pub(super) fn of_scheme(
    scheme: SignatureScheme,
) -> Option<&'static [&'static dyn SignatureVerificationAlgorithm]> {
    match scheme {
        SCHEME_SHA256 => Some(&SHA256),
        SCHEME_SHA384 => Some(&SHA384),
        SCHEME_SHA512 => Some(&SHA512),
        _ => None,
    }
}

/// Whether the parameters of a key are supported: none, or those of RFC 8446.
pub(super) fn is_supported(key: &[u8]) -> bool {
    schemes_of(key).is_some()
}

/// The algorithm identifier of a key, and the schemes that it signs with.
fn schemes_of(key: &[u8]) -> Option<(AlgorithmIdentifier, &'static [SignatureScheme])> {
    const KEYS: [(AlgorithmIdentifier, &[SignatureScheme]); 7] = [
        (ANY_HASH, &[SCHEME_SHA512, SCHEME_SHA384, SCHEME_SHA256]),
        (ANY_SALT_SHA256, &[SCHEME_SHA256]),
        (ANY_SALT_SHA384, &[SCHEME_SHA384]),
        (ANY_SALT_SHA512, &[SCHEME_SHA512]),
        (alg_id::RSA_PSS_SHA256, &[SCHEME_SHA256]),
        (alg_id::RSA_PSS_SHA384, &[SCHEME_SHA384]),
        (alg_id::RSA_PSS_SHA512, &[SCHEME_SHA512]),
    ];
    KEYS.into_iter().find(|(known, _)| known.as_ref() == key)
}

/// A verifier: the algorithms of key and signature, and the implementation.
struct Verify {
    key: AlgorithmIdentifier,
    signature: AlgorithmIdentifier,
    verify: &'static RsaParameters,
}

impl SignatureVerificationAlgorithm for Verify {
    fn verify_signature(
        &self,
        public_key: &[u8],
        message: &[u8],
        signature: &[u8],
    ) -> Result<(), InvalidSignature> {
        let key = UnparsedPublicKey::new(self.verify, public_key);
        key.verify(message, signature).map_err(|_| InvalidSignature)
    }

    fn public_key_alg_id(&self) -> AlgorithmIdentifier {
        self.key
    }

    fn signature_alg_id(&self) -> AlgorithmIdentifier {
        self.signature
    }
}

impl fmt::Debug for Verify {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Verify").field("key", &self.key).finish_non_exhaustive()
    }
}

/// The key of this side.
pub(super) struct PssKey {
    pair: Arc<RsaKeyPair>,
    algorithm: AlgorithmIdentifier,
    schemes: &'static [SignatureScheme],
}

impl PssKey {
    /// The key of a certificate with this algorithm identifier; `None` for another kind of key.
    pub(super) fn new(key: &PrivateKeyDer<'_>, algorithm: &[u8]) -> Option<PssKey> {
        let (algorithm, schemes) = schemes_of(algorithm)?;
        let pair = match key {
            PrivateKeyDer::Pkcs1(key) => RsaKeyPair::from_der(key.secret_pkcs1_der()),
            PrivateKeyDer::Pkcs8(key) => RsaKeyPair::from_der(inner(key.secret_pkcs8_der())?),
            _ => return None,
        };
        Some(PssKey { pair: Arc::new(pair.ok()?), algorithm, schemes })
    }
}

/// The PKCS#1 key inside a PKCS#8 key.
fn inner(pkcs8: &[u8]) -> Option<&[u8]> {
    let whole = AnyRef::from_der(pkcs8).ok()?;
    let mut reader = SliceReader::new(whole.value()).ok()?;
    let _version: u8 = reader.decode().ok()?;
    let _algorithm: AnyRef<'_> = reader.decode().ok()?;
    let key: &OctetStringRef = reader.decode().ok()?;
    Some(key.as_bytes())
}

impl SigningKey for PssKey {
    fn choose_scheme(&self, offered: &[SignatureScheme]) -> Option<Box<dyn Signer>> {
        let scheme = *self.schemes.iter().find(|scheme| offered.contains(scheme))?;
        let encoding: &'static dyn RsaEncoding = match scheme {
            SCHEME_SHA256 => &signature::RSA_PSS_SHA256,
            SCHEME_SHA384 => &signature::RSA_PSS_SHA384,
            _ => &signature::RSA_PSS_SHA512,
        };
        Some(Box::new(PssSigner { pair: Arc::clone(&self.pair), scheme, encoding }))
    }

    fn public_key(&self) -> Option<SubjectPublicKeyInfoDer<'_>> {
        Some(public_key_to_spki(&self.algorithm, self.pair.public_key()))
    }

    fn algorithm(&self) -> SignatureAlgorithm {
        // An algorithm that no TLS 1.2 cipher suite has.
        SignatureAlgorithm::Unknown(9)
    }
}

impl fmt::Debug for PssKey {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("PssKey").finish_non_exhaustive()
    }
}

struct PssSigner {
    pair: Arc<RsaKeyPair>,
    scheme: SignatureScheme,
    encoding: &'static dyn RsaEncoding,
}

impl Signer for PssSigner {
    fn sign(&self, message: &[u8]) -> Result<Vec<u8>, Error> {
        let mut signed = vec![0; self.pair.public_modulus_len()];
        let done = self.pair.sign(self.encoding, &SystemRandom::new(), message, &mut signed);
        done.map_err(|_| Error::General("can't sign with the RSA-PSS key".into()))?;
        Ok(signed)
    }

    fn scheme(&self) -> SignatureScheme {
        self.scheme
    }
}

impl fmt::Debug for PssSigner {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = &self.scheme;
        formatter.debug_struct("PssSigner").field("scheme", scheme).finish_non_exhaustive()
    }
}
