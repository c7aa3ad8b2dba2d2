//! The server side: its certificate, the clients that it trusts, and their roles.
//!
//! Mutual authentication is mandatory, as MB-TCP-Security requires. The certificate of a client and its
//! dates are checked for every connection, also if it resumes a session.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::sign::SingleCertAndKey;
use rustls::time_provider::{DefaultTimeProvider, TimeProvider};
use rustls::{
    AlertDescription, CertificateError, DigitallySignedStruct, DistinguishedName, Error,
    OtherError, ProtocolVersion, ServerConfig, ServerConnection, SignatureScheme,
};

use super::certificate::{Parsed, Purpose};
use super::doubts::Doubts;
use super::files::FileError;
use super::notes::{Chain, Notes, noted};
use super::own::own;
use super::provider::{ALGORITHMS, provider, verify_tls12, verify_tls13};
use super::revocation::List;
use super::sessions::Sessions;
use super::trust::{Listed, Trust};
use super::{Channel, TlsFailure};

/// The PEM files of a server.
#[derive(Debug, Clone)]
pub struct ServerFiles {
    /// The certificate of the server, with its intermediates.
    pub cert_file: PathBuf,
    /// The key of the certificate, without a passphrase.
    pub key_file: PathBuf,
    /// Authorities of clients, and self-signed certificates of clients.
    pub ca_file: PathBuf,
    /// Revocation lists. If given, every authority above a client requires a list.
    pub crl_file: Option<PathBuf>,
    pub expired_lists: ExpiredLists,
}

/// What happens to clients of an authority whose revocation list is past its `nextUpdate`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExpiredLists {
    /// They are refused.
    Refuse,
    /// The list counts as it is.
    Accept,
}

/// The TLS configuration of a server.
pub struct ServerTls {
    config: Arc<ServerConfig>,
    clients: Arc<Clients>,
    sessions: Arc<Sessions>,
    warnings: Vec<String>,
}

impl ServerTls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`FileError`] for an unusable file.
    pub fn load(files: &ServerFiles) -> Result<ServerTls, FileError> {
        ServerTls::with_clock(files, Arc::new(DefaultTimeProvider))
    }

    fn with_clock(
        files: &ServerFiles,
        clock: Arc<dyn TimeProvider>,
    ) -> Result<ServerTls, FileError> {
        let own = own(&files.cert_file, &files.key_file)?;
        let mut doubts = Doubts::new(files, clock.current_time().unwrap_or(UnixTime::now()));
        doubts.of_own(&own.cert);
        let clients = Arc::new(Clients::load(files, &mut doubts)?);
        let sessions = Arc::new(Sessions::new(Arc::clone(&clients), Arc::clone(&clock)));
        let config = ServerConfig::builder_with_details(provider(), clock)
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let mut config = config
            .with_client_cert_verifier(Arc::clone(&clients) as Arc<dyn ClientCertVerifier>)
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(own)));
        config.session_storage = Arc::clone(&sessions) as _;
        config.send_tls13_tickets = 1;
        let (config, warnings) = (Arc::new(config), doubts.found());
        Ok(ServerTls { config, clients, sessions, warnings })
    }

    /// Judges the certificate of an open session again, as a handshake would now.
    pub(crate) fn judge(&self, certificate: &PeerCertificate) -> Result<(), TlsFailure> {
        self.clients.judge(&certificate.chain, UnixTime::now())
    }

    /// What is doubtful about the files: certificates outside their dates, revocation lists that are
    /// missing, expired or of others.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Creates the channel of an accepted connection.
    pub(crate) fn channel(&self) -> Result<ServerChannel, Error> {
        let channel = Channel::new(ServerConnection::new(Arc::clone(&self.config))?);
        Ok(ServerChannel { channel, notes: Notes::default(), sessions: Arc::clone(&self.sessions) })
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

/// The channel of an accepted connection.
pub(crate) struct ServerChannel {
    channel: Channel,
    notes: Notes,
    sessions: Arc<Sessions>,
}

impl ServerChannel {
    /// Processes received bytes, see [`Channel::receive`].
    ///
    /// # Errors
    /// TLS failed: send `out`, then close the connection. Its session cannot be resumed.
    pub(crate) fn receive(
        &mut self,
        bytes: &[u8],
        plain: &mut Vec<u8>,
        out: &mut Vec<u8>,
    ) -> Result<(), TlsFailure> {
        let channel = &mut self.channel;
        let received = if channel.is_handshaking() {
            let received = self.notes.lend(|| channel.receive(bytes, plain, out));
            if received.is_ok() && !channel.is_handshaking() {
                // Only the session is still of use.
                self.notes.chain = None;
            }
            received
        } else {
            channel.receive(bytes, plain, out)
        };
        received.map_err(|error| {
            if let Some(session) = &self.notes.session {
                self.sessions.forget(session);
            }
            let failure = self.notes.failure.take().unwrap_or_else(|| TlsFailure::from(error));
            if failure == TlsFailure::NoCertificate && self.is_tls12() {
                replace_certificate_required(out);
            }
            failure
        })
    }

    pub(crate) fn send(&mut self, plain: &[u8], out: &mut Vec<u8>) {
        self.channel.send(plain, out);
    }

    pub(crate) fn end(&mut self, out: &mut Vec<u8>) {
        self.channel.end(out);
    }

    pub(crate) fn is_handshaking(&self) -> bool {
        self.channel.is_handshaking()
    }

    fn is_tls12(&self) -> bool {
        self.channel.0.protocol_version() == Some(ProtocolVersion::TLSv1_2)
    }

    /// The subject of the certificate that the peer has presented, during the handshake and after it
    /// has failed.
    pub(crate) fn presented_subject(&self) -> Option<String> {
        let presented = self.notes.chain.as_ref()?.first()?;
        Parsed::new(presented).ok().map(|parsed| parsed.subject_text())
    }

    pub(crate) fn has_ended(&mut self) -> bool {
        self.channel.has_ended()
    }

    /// The certificate of the peer, after the handshake.
    pub(crate) fn peer_certificate(&self) -> Result<PeerCertificate, TlsFailure> {
        let chain = self.channel.0.peer_certificates().unwrap_or_default();
        let presented = chain.first().ok_or(TlsFailure::NoCertificate)?;
        let parsed = Parsed::new(presented).map_err(Error::from)?;
        Ok(PeerCertificate {
            role: parsed.role()?,
            subject: parsed.subject_text(),
            serial: parsed.serial_text(),
            chain: chain.iter().cloned().map(CertificateDer::into_owned).collect(),
        })
    }
}

/// Over TLS 1.2, replaces the alert `certificate_required` at the end of `out` by
/// `handshake_failure`: the former exists in TLS 1.3 only (RFC 5246, 7.4.6). There is no encryption yet.
fn replace_certificate_required(out: &mut [u8]) {
    const ALERT: u8 = 21;
    const FATAL: u8 = 2;
    if let [.., ALERT, 3, 3, 0, 2, FATAL, alert] = out
        && *alert == u8::from(AlertDescription::CertificateRequired)
    {
        *alert = u8::from(AlertDescription::HandshakeFailure);
    }
}

/// The error with which rustls sends the alert for a failure (RFC 8446, 6.2).
fn refused(failure: &TlsFailure) -> Error {
    let error = match failure {
        TlsFailure::Expired { .. }
        | TlsFailure::NotYetValid { .. }
        | TlsFailure::IssuerExpired { .. }
        | TlsFailure::IssuerNotYetValid { .. } => CertificateError::Expired,
        TlsFailure::Revoked => CertificateError::Revoked,
        TlsFailure::UnknownIssuer
        | TlsFailure::UnknownRevocation
        | TlsFailure::ExpiredRevocationList { .. } => CertificateError::UnknownIssuer,
        TlsFailure::WrongPurpose { .. }
        | TlsFailure::WrongKeyUsage
        | TlsFailure::UnsupportedCertificate { .. } => CertificateError::InvalidPurpose,
        TlsFailure::BadCertificate
        | TlsFailure::BadSignature
        | TlsFailure::TwoRoles
        | TlsFailure::RoleType
        | TlsFailure::UnsupportedExtension => CertificateError::BadEncoding,
        other => return CertificateError::Other(OtherError(Arc::new(other.clone()))).into(),
    };
    error.into()
}

/// Verifies the certificates of clients.
#[derive(Debug)]
pub(super) struct Clients {
    trust: Trust,
    subjects: Vec<DistinguishedName>,
}

impl Clients {
    fn load(files: &ServerFiles, doubts: &mut Doubts<'_>) -> Result<Clients, FileError> {
        let listed = listed(&files.ca_file)?;
        let subjects = listed.iter().filter_map(Listed::subject).collect();
        doubts.of_listed(&listed);
        let revoked = match &files.crl_file {
            Some(file) if !listed.iter().any(Listed::is_authority) => {
                let flaw = "crl_file requires an authority (CA:TRUE) in ca_file";
                return Err(FileError::content(file, flaw));
            }
            Some(file) => {
                let lists = List::of_file(file)?;
                doubts.of_lists(file, &lists, &listed);
                lists.into_iter().map(List::into_usable).collect()
            }
            None => Vec::new(),
        };
        let trust = Trust::new(listed, revoked);
        let trust = match files.expired_lists {
            ExpiredLists::Refuse => trust,
            ExpiredLists::Accept => trust.accepting_expired_lists(),
        };
        Ok(Clients { trust, subjects })
    }

    /// Verifies the certificate of a client, its own first, and its role.
    pub(super) fn judge(
        &self,
        chain: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<(), TlsFailure> {
        let (own, intermediates) = chain.split_first().ok_or(TlsFailure::NoCertificate)?;
        self.trust.judge(own, intermediates, Purpose::Client, now)?;
        Parsed::new(own).map_err(Error::from)?.role()?;
        Ok(())
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
        let chain = std::iter::once(end_entity).chain(intermediates);
        let chain: Chain = chain.map(|each| each.clone().into_owned()).collect();
        noted(|notes| {
            notes.chain = Some(Arc::clone(&chain));
            notes.proved = Some(now);
        });
        self.judge(&chain, now).map_err(|failure| {
            let refused = refused(&failure);
            noted(|notes| notes.failure = Some(failure));
            refused
        })?;
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::time::Duration;

    use rcgen::{
        CertificateRevocationListParams, CustomExtension, KeyIdMethod, RevokedCertParams,
        date_time_ymd,
    };
    use rustls::HandshakeKind::{Full as FULL, Resumed as RESUMED};
    use rustls::version::{TLS12, TLS13};
    use rustls::{ClientConfig, HandshakeKind, SupportedProtocolVersion};

    use super::*;
    use crate::tls::test_party::{Party, ROLE_ARCS, connection, role};

    const DAY: u64 = 24 * 60 * 60;
    const VERSIONS: [&SupportedProtocolVersion; 2] = [&TLS12, &TLS13];

    /// A clock that tests set, in seconds since 1970.
    #[derive(Debug)]
    struct Clock(AtomicU64);

    impl Clock {
        fn new() -> Arc<Clock> {
            Arc::new(Clock(AtomicU64::new(UnixTime::now().as_secs())))
        }

        fn pass(&self, seconds: u64) {
            self.0.fetch_add(seconds, Ordering::Relaxed);
        }
    }

    impl TimeProvider for Clock {
        fn current_time(&self) -> Option<UnixTime> {
            Some(UnixTime::since_unix_epoch(Duration::from_secs(self.0.load(Ordering::Relaxed))))
        }
    }

    /// How a handshake succeeds, or why it fails.
    fn shake(tls: &ServerTls, client: &Arc<ClientConfig>) -> Result<HandshakeKind, &'static str> {
        let mut server = tls.channel().unwrap();
        talk(&mut server, client, b"").map_err(|failure| failure.reason())?;
        assert_eq!(server.peer_certificate().unwrap().role, "operator");
        Ok(server.channel.0.handshake_kind().unwrap())
    }

    /// Performs a handshake byte by byte, and then sends `then` as it is.
    fn talk(
        server: &mut ServerChannel,
        client: &Arc<ClientConfig>,
        then: &[u8],
    ) -> Result<(), TlsFailure> {
        let mut client = connection(client);
        let (mut plain, mut to_server, mut to_client) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..6 {
            while client.wants_write() {
                client.write_tls(&mut to_server).unwrap();
            }
            for byte in std::mem::take(&mut to_server) {
                server.receive(&[byte], &mut plain, &mut to_client)?;
            }
            let mut bytes = &std::mem::take(&mut to_client)[..];
            while !bytes.is_empty() {
                client.read_tls(&mut bytes).unwrap();
                client.process_new_packets().unwrap();
            }
        }
        assert!(!server.is_handshaking() && !client.is_handshaking());
        server.receive(then, &mut plain, &mut to_client)
    }

    #[test]
    fn a_session_is_resumed_with_its_role_for_one_day_after_the_full_handshake() {
        let party = Party::new();
        for version in VERSIONS {
            let clock = Clock::new();
            let tls = ServerTls::with_clock(&party.files(), Arc::clone(&clock) as _).unwrap();
            let client = party.client(version);
            assert_eq!(shake(&tls, &client), Ok(FULL));
            assert_eq!(shake(&tls, &client), Ok(RESUMED));
            clock.pass(DAY / 2);
            assert_eq!(shake(&tls, &client), Ok(RESUMED));
            clock.pass(DAY / 2 + 1);
            assert_eq!(shake(&tls, &client), Ok(FULL), "{version:?}");
            assert_eq!(shake(&tls, &client), Ok(RESUMED));
        }
    }

    #[test]
    fn a_session_is_not_resumed_when_the_certificate_has_expired_since() {
        let party = Party::with_client(|params| params.not_after = date_time_ymd(2040, 1, 1));
        let last = 2_208_988_800;
        for version in VERSIONS {
            let clock = Arc::new(Clock(AtomicU64::new(last - 10)));
            let tls = ServerTls::with_clock(&party.files(), Arc::clone(&clock) as _).unwrap();
            let client = party.client(version);
            assert_eq!(shake(&tls, &client), Ok(FULL));
            assert_eq!(shake(&tls, &client), Ok(RESUMED));
            clock.pass(11);
            assert_eq!(shake(&tls, &client), Err("expired"), "{version:?}");
        }
    }

    #[test]
    fn a_session_is_not_resumed_when_the_certificate_was_revoked_since() {
        let party = Party::new();
        let revoked = RevokedCertParams {
            serial_number: party.client.params.serial_number.clone().unwrap(),
            revocation_time: date_time_ymd(2026, 1, 1),
            reason_code: None,
            invalidity_date: None,
        };
        let list = CertificateRevocationListParams {
            this_update: date_time_ymd(2026, 1, 1),
            next_update: date_time_ymd(2090, 1, 1),
            crl_number: 1.into(),
            issuing_distribution_point: None,
            revoked_certs: vec![revoked],
            key_identifier_method: KeyIdMethod::Sha256,
        };
        let list = list.signed_by(&party.authority.issuer()).unwrap().pem().unwrap();
        let crl_file = Some(party.folder.write("crl.pem", &list));
        for version in VERSIONS {
            let client = party.client(version);
            let before = ServerTls::load(&party.files()).unwrap();
            let after =
                ServerTls::load(&ServerFiles { crl_file: crl_file.clone(), ..party.files() });
            assert_eq!(shake(&before, &client), Ok(FULL));
            assert_eq!(shake(&before, &client), Ok(RESUMED));
            assert_eq!(shake(&after.unwrap(), &client), Err("revoked"), "{version:?}");
        }
    }

    #[test]
    fn a_session_is_not_resumed_after_its_connection_has_failed() {
        let party = Party::new();
        for version in VERSIONS {
            let tls = ServerTls::load(&party.files()).unwrap();
            let client = party.client(version);
            for expected in [FULL, FULL] {
                assert_eq!(shake(&tls, &client), Ok(expected), "{version:?}");
                assert_eq!(shake(&tls, &client), Ok(RESUMED));
                let altered = [&[23, 3, 3, 0, 40][..], &[7; 40]].concat();
                let failed = talk(&mut tls.channel().unwrap(), &client, &altered);
                assert_eq!(failed, Err(TlsFailure::BadRecord));
            }
        }
    }

    #[test]
    fn a_client_without_exactly_one_role_is_refused() {
        let wrong_type = CustomExtension::from_oid_content(&ROLE_ARCS, vec![19, 1, 65]);
        let two = vec![role("operator"), role("engineer")];
        for (roles, reason) in [(two, "two_roles"), (vec![wrong_type], "role_type")] {
            let party = Party::with_client(|params| params.custom_extensions = roles.clone());
            let tls = ServerTls::load(&party.files()).unwrap();
            for version in VERSIONS {
                let mut server = tls.channel().unwrap();
                let refused = talk(&mut server, &party.client(version), b"").unwrap_err();
                assert_eq!(refused.reason(), reason);
                assert_eq!(server.presented_subject().as_deref(), Some("CN=panel 7"));
            }
        }
    }

    #[test]
    fn the_oldest_of_too_many_sessions_is_forgotten() {
        let party = Party::new();
        for version in VERSIONS {
            let tls = ServerTls::load(&party.files()).unwrap();
            let client = party.client(version);
            assert_eq!(shake(&tls, &client), Ok(FULL));
            tls.sessions.fill();
            assert_eq!(shake(&tls, &client), Ok(FULL), "{version:?}");
        }
    }
}
