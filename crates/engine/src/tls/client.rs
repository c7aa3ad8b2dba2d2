//! The client's side: whom it trusts, and what it shows of itself.
//!
//! Each connection checks the certificate of the peer anew; nothing is resumed. Whether a certificate
//! is valid now is asked when it is used, never when its file is read: the clock of a machine that
//! has just been switched on may be wrong.

use std::hash::{Hash, Hasher};
use std::io;
use std::path::Path;
use std::sync::Arc;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::{Resumption, verify_server_cert_signed_by_trust_anchor, verify_server_name};
use rustls::crypto::{
    CryptoProvider, WebPkiSupportedAlgorithms, ring, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::{
    CertificateError, ClientConfig, ClientConnection, DigitallySignedStruct, Error, OtherError,
    RootCertStore, SignatureScheme,
};
use thiserror::Error as ThisError;

use super::files::{FileError, certificates, key};
use super::{Channel, words};

/// What a client's TLS is made from.
#[derive(Debug, Clone, Copy)]
pub struct ClientSettings<'s> {
    /// The certificates that are trusted: of authorities, or of the device itself. The system's
    /// authorities when it is left out.
    pub ca: Option<&'s Path>,
    /// The certificate that is shown to the peer, with those between it and the root; and its key.
    pub own: Option<(&'s Path, &'s Path)>,
    /// The name or address that the certificate of the peer has.
    pub name: &'s str,
}

/// Settings that can't be used.
#[derive(Debug, ThisError)]
pub enum TlsError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{0}")]
    Other(String),
}

/// TLS to one peer. Two are equal when they trust, show and ask for the same.
#[derive(Debug)]
pub struct ClientTls {
    config: Arc<ClientConfig>,
    trusted: Arc<Trusted>,
    own: Vec<CertificateDer<'static>>,
    name: ServerName<'static>,
}

impl ClientTls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`TlsError`] for files and names that can't be used.
    pub fn new(settings: ClientSettings<'_>) -> Result<ClientTls, TlsError> {
        let name = ServerName::try_from(settings.name.to_owned()).map_err(|_| {
            let found = format!("found {:?} as the name of a certificate", settings.name);
            TlsError::Other(format!("{found}, allowed: a host name or an IP address"))
        })?;
        let provider = Arc::new(ring::default_provider());
        let trusted = Arc::new(Trusted {
            certificates: settings.ca.map_or_else(of_system, |file| Ok(certificates(file)?))?,
            of_system: settings.ca.is_none(),
            algorithms: provider.signature_verification_algorithms,
        });
        let (config, own) = config(&provider, &trusted, settings.own)?;
        Ok(ClientTls { config: Arc::new(config), trusted, own, name })
    }

    /// The TLS of a new connection.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn channel(&self) -> Result<Channel, Error> {
        ClientConnection::new(Arc::clone(&self.config), self.name.clone()).map(Channel::new)
    }

    fn identity(
        &self,
    ) -> (&[CertificateDer<'static>], &[CertificateDer<'static>], &ServerName<'_>) {
        (&self.trusted.certificates, &self.own, &self.name)
    }
}

impl PartialEq for ClientTls {
    fn eq(&self, other: &ClientTls) -> bool {
        self.identity() == other.identity()
    }
}

impl Eq for ClientTls {}

impl Hash for ClientTls {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.identity().hash(state);
    }
}

/// The certificates that the system trusts.
fn of_system() -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let found = rustls_native_certs::load_native_certs();
    if found.certs.is_empty() {
        let why = found.errors.first().map(|error| format!(": {error}")).unwrap_or_default();
        let text = format!("the system has no authorities{why}; ca has to say who is trusted");
        return Err(TlsError::Other(text));
    }
    Ok(found.certs)
}

fn config(
    provider: &Arc<CryptoProvider>,
    trusted: &Arc<Trusted>,
    own: Option<(&Path, &Path)>,
) -> Result<(ClientConfig, Vec<CertificateDer<'static>>), TlsError> {
    let builder = ClientConfig::builder_with_provider(Arc::clone(provider))
        .with_safe_default_protocol_versions()
        .map_err(|error| TlsError::Other(words(&error)))?
        .dangerous()
        .with_custom_certificate_verifier(Arc::clone(trusted) as Arc<dyn ServerCertVerifier>);
    let (mut config, own) = match own {
        None => (builder.with_no_client_auth(), Vec::new()),
        Some((file, key_file)) => {
            let (chain, key) = (certificates(file)?, key(key_file)?);
            let config = builder.with_client_auth_cert(chain.clone(), key).map_err(|error| {
                let flaw = match error {
                    Error::InconsistentKeys(_) => {
                        format!("it is not the key of the certificate in {}", file.display())
                    }
                    _ => "found a key of another kind, allowed: RSA, P-256, P-384, Ed25519".into(),
                };
                FileError::content(key_file, flaw)
            })?;
            (config, chain)
        }
    };
    config.resumption = Resumption::disabled();
    Ok((config, own))
}

/// Judges the certificate of a peer.
#[derive(Debug)]
struct Trusted {
    certificates: Vec<CertificateDer<'static>>,
    of_system: bool,
    algorithms: WebPkiSupportedAlgorithms,
}

impl Trusted {
    /// Whether a certificate, looked at by itself, is one of an authority.
    ///
    /// # Errors
    /// It is not valid now, or not for servers.
    fn is_authority(&self, of: &CertificateDer<'_>, now: UnixTime) -> Result<bool, Error> {
        let parsed = ParsedCertificate::try_from(of)?;
        let nobody = RootCertStore::empty();
        let all = self.algorithms.all;
        match verify_server_cert_signed_by_trust_anchor(&parsed, &nobody, &[], now, all) {
            Err(Error::InvalidCertificate(CertificateError::UnknownIssuer)) => Ok(false),
            Err(Error::InvalidCertificate(CertificateError::Other(OtherError(why))))
                if why.downcast_ref() == Some(&webpki::Error::CaUsedAsEndEntity) =>
            {
                Ok(true)
            }
            other => other.map(|()| false),
        }
    }

    /// Looks for an authority that vouches for a certificate. One that is trusted for itself is not
    /// one, whatever its key has signed.
    fn vouch(
        &self,
        parsed: &ParsedCertificate<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<(), Error> {
        let mut authorities = RootCertStore::empty();
        let mut lapsed = None;
        for each in &self.certificates {
            match self.is_authority(each, now) {
                Ok(true) => authorities.add(each.clone())?,
                Ok(false) => {}
                Err(error) => lapsed = lapsed.or(Some(error)),
            }
        }
        let all = self.algorithms.all;
        let found = verify_server_cert_signed_by_trust_anchor(
            parsed,
            &authorities,
            intermediates,
            now,
            all,
        );
        match (found, lapsed) {
            (Err(Error::InvalidCertificate(CertificateError::UnknownIssuer)), Some(lapsed))
                if !self.of_system =>
            {
                let why = words(&lapsed);
                let text = format!("its issuer is unknown; of those that are trusted, one: {why}");
                let cause = OtherError(Arc::new(io::Error::other(text)));
                Err(CertificateError::Other(cause).into())
            }
            (found, _) => found,
        }
    }
}

impl ServerCertVerifier for Trusted {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let parsed = ParsedCertificate::try_from(end_entity)?;
        if self.certificates.contains(end_entity) {
            self.is_authority(end_entity, now)?;
        } else {
            self.vouch(&parsed, intermediates, now)?;
        }
        verify_server_name(&parsed, server_name)?;
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12_signature(message, certificate, signed, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signed, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}
