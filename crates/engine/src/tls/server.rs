//! The server's side: who it is, which clients it trusts, and what role each of them has.
//!
//! Mutual authentication is not optional, as MB-TCP-Security has it. Sessions are never resumed: the
//! certificate of a client, and its dates, are judged at every connection.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::{CryptoProvider, ring, verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{NoServerSessionStorage, VerifierBuilderError, WebPkiClientVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, RootCertStore, ServerConfig,
    ServerConnection, SignatureScheme,
};

use super::Channel;
use super::certificate::Parsed;
use super::pem::{File, FileError};

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
    /// # Errors
    /// [`FileError`] names the file that can't be used.
    pub fn load(files: &ServerFiles) -> Result<ServerTls, FileError> {
        let cert_file = File { role: "cert_file", path: &files.cert_file };
        let key_file = File { role: "key_file", path: &files.key_file };
        let provider = Arc::new(ring::default_provider());
        let (chain, key) = (cert_file.certificates()?, key_file.key()?);
        let signer = provider.key_provider.load_private_key(key.clone_key()).map_err(|_| {
            let allowed = "allowed: RSA of 2048 bits or more, ECDSA P-256 or P-384, Ed25519";
            key_file.error(format!("found a key of another kind, {allowed}"))
        })?;
        drop(signer);
        let clients = Arc::new(Clients::load(files, &provider)?);
        let config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| cert_file.error(error.to_string()))?;
        let config = config.with_client_cert_verifier(clients).with_single_cert(chain, key);
        let mut config = config.map_err(|error| match error {
            Error::InconsistentKeys(_) => {
                let allowed = "allowed: the key of its first certificate";
                key_file.error(format!("found a key that does not fit cert_file, {allowed}"))
            }
            error => cert_file.error(error.to_string()),
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

/// Why a connection failed, in a word.
pub(crate) fn reason(error: &Error) -> &'static str {
    use CertificateError::{
        BadEncoding, Expired, ExpiredContext, InvalidPurpose, InvalidPurposeContext, NotValidYet,
        NotValidYetContext, Revoked, UnhandledCriticalExtension, UnknownIssuer,
        UnknownRevocationStatus,
    };
    match error {
        Error::NoCertificatesPresented => "no_certificate",
        Error::InvalidCertificate(error) => match error {
            UnknownIssuer => "unknown_authority",
            Expired | ExpiredContext { .. } => "expired",
            NotValidYet | NotValidYetContext { .. } => "not_valid_yet",
            Revoked => "revoked",
            UnknownRevocationStatus => "unknown_revocation",
            InvalidPurpose | InvalidPurposeContext { .. } => "wrong_purpose",
            UnhandledCriticalExtension => "unknown_extension",
            BadEncoding => "bad_certificate",
            _ => "untrusted_certificate",
        },
        Error::AlertReceived(_) => "refused_by_peer",
        Error::PeerIncompatible(_) => "incompatible",
        Error::InvalidMessage(_) => "not_tls",
        Error::DecryptError => "decrypt_error",
        _ => "protocol_error",
    }
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
        let ca_file = File { role: "ca_file", path: &files.ca_file };
        let (mut roots, mut pinned) = (RootCertStore::empty(), Vec::new());
        let mut subjects = Vec::new();
        for (index, certificate) in ca_file.certificates()?.into_iter().enumerate() {
            let found = |what: String| ca_file.error(format!("certificate {}: {what}", index + 1));
            let parsed =
                Parsed::new(&certificate).map_err(|_| found("not an X.509 certificate".into()))?;
            // One that is no authority must vouch for nobody but itself.
            let (is_authority, is_self_signed) = (parsed.is_authority(), parsed.is_self_signed());
            if is_authority {
                roots.add(certificate.clone()).map_err(|error| found(error.to_string()))?;
            } else if !is_self_signed {
                let allowed = "allowed: authorities (CA:TRUE) and self-signed certificates";
                return Err(found(format!("neither of both, {allowed}")));
            }
            if is_self_signed {
                pinned.push(certificate);
            }
            subjects.extend(parsed.subject());
        }
        let signed = match (roots.is_empty(), &files.crl_file) {
            (false, _) => Some(authorities(roots, files, provider)?),
            (true, None) => None,
            (true, Some(path)) => {
                let reason = "found beside a ca_file without authorities, allowed: beside some";
                return Err(File { role: "crl_file", path }.error(reason));
            }
        };
        Ok(Clients { signed, pinned, subjects, provider: Arc::clone(provider) })
    }
}

/// What judges certificates that are signed by authorities.
fn authorities(
    roots: RootCertStore,
    files: &ServerFiles,
    provider: &Arc<CryptoProvider>,
) -> Result<Arc<dyn ClientCertVerifier>, FileError> {
    let (roots, provider) = (Arc::new(roots), Arc::clone(provider));
    let mut builder = WebPkiClientVerifier::builder_with_provider(roots, provider);
    let crl_file = files.crl_file.as_deref().map(|path| File { role: "crl_file", path });
    if let Some(file) = &crl_file {
        builder = builder.with_crls(file.revocations()?);
    }
    builder.build().map_err(|error| {
        let file = crl_file.unwrap_or(File { role: "ca_file", path: &files.ca_file });
        file.error(match error {
            VerifierBuilderError::InvalidCrl(error) => format!("can't be used: {error:?}"),
            error => error.to_string(),
        })
    })
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
        if self.pinned.contains(end_entity) {
            parsed.is_valid_at(now)?;
        } else {
            let signed = self.signed.as_ref().ok_or(CertificateError::UnknownIssuer)?;
            signed.verify_client_cert(end_entity, intermediates, now)?;
        }
        parsed.role()?;
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
