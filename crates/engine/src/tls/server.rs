//! The server's side: who it is, which clients it trusts, and what role each of them has.
//!
//! Mutual authentication is not optional, as MB-TCP-Security has it. Sessions are never resumed: the
//! certificate of a client, and its dates, are judged at every connection.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::{CryptoProvider, verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{NoServerSessionStorage, VerifierBuilderError, WebPkiClientVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, RootCertStore, ServerConfig,
    ServerConnection, SignatureScheme,
};

use super::Channel;
use super::certificate::Parsed;
use super::files::{FileError, certificates, key};
use super::provider::provider;

/// The files of a server, in PEM.
#[derive(Debug, Clone)]
pub struct ServerFiles {
    /// The certificate that clients are shown, and those between it and its authority.
    pub cert_file: PathBuf,
    /// The key of that certificate, without a passphrase.
    pub key_file: PathBuf,
    /// The authorities that vouch for clients, and clients' self-signed certificates.
    pub ca_file: PathBuf,
    /// Certificates that the authorities have revoked. Where it is given, there is a list of each
    /// authority above a client.
    pub crl_file: Option<PathBuf>,
}

/// What a server needs to speak TLS with its clients.
pub struct ServerTls(Arc<ServerConfig>);

impl ServerTls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`FileError`] for one that can't be used.
    pub fn load(files: &ServerFiles) -> Result<ServerTls, FileError> {
        let provider = provider();
        let (chain, key) = (certificates(&files.cert_file)?, key(&files.key_file)?);
        let clients = Arc::new(Clients::load(files, &provider)?);
        let config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let config = config.with_client_cert_verifier(clients).with_single_cert(chain, key);
        let mut config = config.map_err(|error| {
            let flaw = match error {
                Error::InconsistentKeys(_) => {
                    let certificate = files.cert_file.display();
                    format!("it is not the key of the certificate in {certificate}")
                }
                _ => {
                    "found a key of another kind, allowed: RSA, P-256, P-384, P-521, Ed25519".into()
                }
            };
            FileError::content(&files.key_file, flaw)
        })?;
        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(ServerTls(Arc::new(config)))
    }

    /// The channel of a connection that was accepted.
    pub(crate) fn channel(&self) -> Result<Channel, Error> {
        Ok(Channel::new(ServerConnection::new(Arc::clone(&self.0))?))
    }
}

impl fmt::Debug for ServerTls {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("ServerTls").finish_non_exhaustive()
    }
}

/// The role of the peer, which has shown its certificate; empty for the null role.
pub(crate) fn role(channel: &Channel) -> Result<String, Error> {
    let certificate = channel.0.peer_certificates().and_then(<[_]>::first);
    let certificate = certificate.ok_or(Error::NoCertificatesPresented)?;
    Ok(Parsed::new(certificate)?.role()?)
}

/// Judges the certificates of clients.
#[derive(Debug)]
struct Clients {
    /// By the authorities, where there are any.
    signed: Option<Arc<dyn ClientCertVerifier>>,
    /// Self-signed certificates that are trusted as they are.
    pinned: Vec<CertificateDer<'static>>,
    subjects: Vec<DistinguishedName>,
    provider: Arc<CryptoProvider>,
}

impl Clients {
    fn load(files: &ServerFiles, provider: &Arc<CryptoProvider>) -> Result<Clients, FileError> {
        let (mut roots, mut pinned) = (RootCertStore::empty(), Vec::new());
        let mut subjects = Vec::new();
        for (index, certificate) in certificates(&files.ca_file)?.into_iter().enumerate() {
            let wrong = |what: String| {
                FileError::content(&files.ca_file, format!("certificate {}: {what}", index + 1))
            };
            let parsed = Parsed::new(&certificate).map_err(|error| wrong(error.to_string()))?;
            // One that is no authority vouches for nobody but itself.
            let (is_authority, is_self_signed) = (parsed.is_authority(), parsed.is_self_signed());
            if is_authority {
                roots.add(certificate.clone()).map_err(|error| wrong(error.to_string()))?;
            } else if !is_self_signed {
                let allowed = "allowed: authorities (CA:TRUE) and self-signed certificates";
                return Err(wrong(format!("found neither of both, {allowed}")));
            }
            if is_self_signed {
                pinned.push(certificate);
            }
            subjects.extend(parsed.subject());
        }
        let crl_file = files.crl_file.as_deref();
        let signed = match crl_file {
            Some(file) if roots.is_empty() => {
                let flaw = "found beside a ca_file without authorities, allowed: beside some";
                return Err(FileError::content(file, flaw));
            }
            None if roots.is_empty() => None,
            _ => Some(authorities(roots, crl_file, provider)?),
        };
        Ok(Clients { signed, pinned, subjects, provider: Arc::clone(provider) })
    }
}

/// What judges certificates that authorities have signed.
fn authorities(
    roots: RootCertStore,
    crl_file: Option<&Path>,
    provider: &Arc<CryptoProvider>,
) -> Result<Arc<dyn ClientCertVerifier>, FileError> {
    let builder =
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(provider));
    let file = crl_file.unwrap_or(Path::new(""));
    let builder = match crl_file {
        Some(file) => builder.with_crls(revocations(file)?),
        None => builder,
    };
    builder.build().map_err(|error| {
        let flaw = match error {
            VerifierBuilderError::InvalidCrl(error) => format!("{error:?}"),
            error => error.to_string(),
        };
        FileError::content(file, format!("a list can't be read: {flaw}"))
    })
}

/// All lists of revoked certificates of a file, at least one.
fn revocations(file: &Path) -> Result<Vec<CertificateRevocationListDer<'static>>, FileError> {
    let text = std::fs::read(file)
        .map_err(|error| FileError::Unreadable { file: file.display().to_string(), error })?;
    let found: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&text).collect();
    let found = found.map_err(|error| FileError::content(file, error.to_string()))?;
    if found.is_empty() {
        let flaw = "found no list of revoked certificates, allowed: X509 CRL in PEM";
        return Err(FileError::content(file, flaw));
    }
    Ok(found)
}

impl ClientCertVerifier for Clients {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &self.subjects
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        let parsed = Parsed::new(end_entity)?;
        parsed.role()?;
        if self.pinned.contains(end_entity) {
            parsed.is_valid_at(now)?;
        } else {
            let signed = self.signed.as_ref().ok_or(CertificateError::UnknownIssuer)?;
            signed.verify_client_cert(end_entity, intermediates, now)?;
        }
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls12_signature(message, certificate, signature, algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls13_signature(message, certificate, signature, algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}
