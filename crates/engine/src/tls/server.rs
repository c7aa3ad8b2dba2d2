//! The server side: its certificate, the clients that it trusts, and their roles.
//!
//! Mutual authentication is mandatory, as MB-TCP-Security requires. Sessions are never resumed: the
//! certificate of a client and its dates are checked for every connection.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, UnixTime};
use rustls::server::NoServerSessionStorage;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::sign::SingleCertAndKey;
use rustls::{
    DigitallySignedStruct, DistinguishedName, Error, ServerConfig, ServerConnection,
    SignatureScheme,
};
use webpki::{CertRevocationList, OwnedCertRevocationList};

use super::Channel;
use super::certificate::{Parsed, Purpose};
use super::files::FileError;
use super::own::own;
use super::provider::{ALGORITHMS, provider, verify_tls12, verify_tls13};
use super::trust::{Listed, Trust};

/// The PEM files of a server.
#[derive(Debug, Clone)]
pub struct ServerFiles {
    /// The certificate of the server, with its intermediates.
    pub cert_file: PathBuf,
    /// The key of the certificate.
    pub key_file: PathBuf,
    /// Authorities of clients, and self-signed certificates of clients.
    pub ca_file: PathBuf,
    /// Revocation lists. If given, every authority above a client requires a list.
    pub crl_file: Option<PathBuf>,
}

/// The TLS configuration of a server.
pub struct ServerTls {
    config: Arc<ServerConfig>,
    clients: Arc<Clients>,
}

impl ServerTls {
    /// Reads the files. `key` is the content of `key_file` without its passphrase, if it has one.
    ///
    /// # Errors
    /// [`FileError`] for an unusable file.
    pub fn load(files: &ServerFiles, key: Option<&[u8]>) -> Result<ServerTls, FileError> {
        let own = own(&files.cert_file, &files.key_file, key)?;
        let clients = Arc::new(Clients::load(files)?);
        let config = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let mut config = config
            .with_client_cert_verifier(Arc::clone(&clients) as Arc<dyn ClientCertVerifier>)
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(own)));
        config.session_storage = Arc::new(NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(ServerTls { config: Arc::new(config), clients })
    }

    /// Judges the certificate of an open session again, as a handshake would now.
    pub(crate) fn judge(&self, certificate: &PeerCertificate) -> Result<(), Error> {
        let (presented, intermediates) =
            certificate.chain.split_first().ok_or(Error::NoCertificatesPresented)?;
        self.clients.judge(presented, intermediates, UnixTime::now())
    }

    /// Creates the channel of an accepted connection.
    pub(crate) fn channel(&self) -> Result<Channel, Error> {
        Ok(Channel::new(ServerConnection::new(Arc::clone(&self.config))?))
    }
}

impl fmt::Debug for ServerTls {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("ServerTls").finish_non_exhaustive()
    }
}

/// The certificate of a client, which it has proved to own.
#[derive(Debug, PartialEq, Eq)]
pub struct PeerCertificate {
    /// The role of MB-TCP-Security; empty for the null role.
    pub role: String,
    /// The distinguished name, as RFC 4514 writes it.
    pub subject: String,
    /// The serial number, in hexadecimal digits.
    pub serial: String,
    /// The certificate and its intermediates, as the peer sent them.
    pub(crate) chain: Vec<CertificateDer<'static>>,
}

/// The certificate of the peer, after the handshake.
pub(crate) fn peer_certificate(channel: &Channel) -> Result<PeerCertificate, Error> {
    let chain = channel.0.peer_certificates().unwrap_or_default();
    let parsed = Parsed::new(chain.first().ok_or(Error::NoCertificatesPresented)?)?;
    Ok(PeerCertificate {
        role: parsed.role()?,
        subject: parsed.subject_text(),
        serial: parsed.serial_text(),
        chain: chain.iter().cloned().map(CertificateDer::into_owned).collect(),
    })
}

/// Verifies the certificates of clients.
#[derive(Debug)]
struct Clients {
    trust: Trust,
    subjects: Vec<DistinguishedName>,
}

impl Clients {
    fn load(files: &ServerFiles) -> Result<Clients, FileError> {
        let listed = listed(&files.ca_file)?;
        let subjects = listed.iter().filter_map(Listed::subject).collect();
        let revoked = match &files.crl_file {
            Some(file) if !listed.iter().any(Listed::is_authority) => {
                let flaw = "crl_file requires an authority (CA:TRUE) in ca_file";
                return Err(FileError::content(file, flaw));
            }
            Some(file) => revocations(file)?,
            None => Vec::new(),
        };
        Ok(Clients { trust: Trust::new(listed, revoked), subjects })
    }

    fn judge(
        &self,
        presented: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<(), Error> {
        Parsed::new(presented)?.role()?;
        self.trust.judge(presented, intermediates, Purpose::Client, now)
    }
}

/// Reads authorities and self-signed certificates. Any other certificate is a mistake.
fn listed(file: &Path) -> Result<Arc<[Listed]>, FileError> {
    let listed = Listed::of_file(file)?;
    let is_mistake = |listed: &Listed| !listed.is_authority() && !listed.is_self_signed();
    if let Some(index) = listed.iter().position(is_mistake) {
        let flaw =
            format!("certificate {}: neither an authority (CA:TRUE) nor self-signed", index + 1);
        return Err(FileError::content(file, flaw));
    }
    Ok(listed)
}

/// Reads all revocation lists of a file, at least one.
fn revocations(file: &Path) -> Result<Vec<CertRevocationList<'static>>, FileError> {
    let text = std::fs::read(file)
        .map_err(|error| FileError::Unreadable { file: file.display().to_string(), error })?;
    let found: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&text).collect();
    let found = found.map_err(|error| FileError::content(file, error.to_string()))?;
    if found.is_empty() {
        let flaw = "found no revocation list, allowed: X509 CRL in PEM";
        return Err(FileError::content(file, flaw));
    }
    let read = found.iter().map(|list| OwnedCertRevocationList::from_der(list).map(Into::into));
    let read: Result<Vec<_>, _> = read.collect();
    read.map_err(|error| {
        FileError::content(file, format!("a revocation list can't be read: {error}"))
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
        self.judge(end_entity, intermediates, now)?;
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12(message, certificate, signed)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        ALGORITHMS.supported_schemes()
    }
}
