//! The server's side: who it is, which clients it trusts, and what role each of them has.
//!
//! Mutual authentication is not optional, as MB-TCP-Security has it. Sessions are never resumed: the
//! certificate of a client, and its dates, are judged at every connection.

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
        let own = own(&files.cert_file, &files.key_file)?;
        let clients = Arc::new(Clients::load(files)?);
        let config = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let mut config = config
            .with_client_cert_verifier(clients)
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(own)));
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
    trust: Trust,
    subjects: Vec<DistinguishedName>,
}

impl Clients {
    fn load(files: &ServerFiles) -> Result<Clients, FileError> {
        let listed = listed(&files.ca_file)?;
        let subjects = listed.iter().filter_map(Listed::subject).collect();
        let revoked = match &files.crl_file {
            Some(file) if !listed.iter().any(Listed::is_authority) => {
                let flaw = "found beside a ca_file without authorities, allowed: beside some";
                return Err(FileError::content(file, flaw));
            }
            Some(file) => revocations(file)?,
            None => Vec::new(),
        };
        Ok(Clients { trust: Trust::new(listed, revoked), subjects })
    }
}

/// Authorities and self-signed certificates: any other is in the file by mistake.
fn listed(file: &Path) -> Result<Arc<[Listed]>, FileError> {
    let listed = Listed::of_file(file)?;
    let is_mistake = |listed: &Listed| !listed.is_authority() && !listed.is_self_signed();
    if let Some(index) = listed.iter().position(is_mistake) {
        let allowed = "allowed: authorities (CA:TRUE) and self-signed certificates";
        let flaw = format!("certificate {}: found neither of both, {allowed}", index + 1);
        return Err(FileError::content(file, flaw));
    }
    Ok(listed)
}

/// All lists of revoked certificates of a file, at least one.
fn revocations(file: &Path) -> Result<Vec<CertRevocationList<'static>>, FileError> {
    let text = std::fs::read(file)
        .map_err(|error| FileError::Unreadable { file: file.display().to_string(), error })?;
    let found: Result<Vec<_>, _> = CertificateRevocationListDer::pem_slice_iter(&text).collect();
    let found = found.map_err(|error| FileError::content(file, error.to_string()))?;
    if found.is_empty() {
        let flaw = "found no list of revoked certificates, allowed: X509 CRL in PEM";
        return Err(FileError::content(file, flaw));
    }
    let read = found.iter().map(|list| OwnedCertRevocationList::from_der(list).map(Into::into));
    let read: Result<Vec<_>, _> = read.collect();
    read.map_err(|error| FileError::content(file, format!("a list can't be read: {error}")))
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
        Parsed::new(end_entity)?.role()?;
        self.trust.judge(end_entity, intermediates, Purpose::Client, now)?;
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
