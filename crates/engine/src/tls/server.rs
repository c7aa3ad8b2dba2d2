//! The server side: its certificate, and the channels of its connections.
//!
//! Mutual authentication is mandatory, as MB-TCP-Security requires. The certificate of a client and its
//! dates are checked for every connection, also if it resumes a session.

use std::fmt;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::sign::SingleCertAndKey;
use rustls::time_provider::{DefaultTimeProvider, TimeProvider};
use rustls::{AlertDescription, Error, ProtocolVersion, ServerConfig, ServerConnection};

use super::certificate::Parsed;
use super::clients::Clients;
use super::doubts::Doubts;
use super::files::FileError;
use super::fragment::{Asked, LENGTHS, RECORD_HEADER_LEN, asked};
use super::notes::Notes;
use super::own::own;
use super::provider::provider;
pub use super::server_files::{ExpiredLists, ServerFiles};
use super::sessions::Sessions;
use super::{Channel, TlsFailure};

/// The TLS configuration of a server.
pub struct ServerTls {
    config: Arc<ServerConfig>,
    /// The same for clients that ask for shorter fragments.
    short: Arc<[Arc<ServerConfig>; LENGTHS.len()]>,
    clients: Arc<Clients>,
    sessions: Arc<Sessions>,
    warnings: Vec<String>,
}

impl ServerTls {
    /// Reads the files. `key` is the content of `key_file` without its passphrase, if it has one.
    ///
    /// # Errors
    /// [`FileError`] for an unusable file.
    pub fn load(files: &ServerFiles, key: Option<&[u8]>) -> Result<ServerTls, FileError> {
        ServerTls::with_clock(files, key, Arc::new(DefaultTimeProvider))
    }

    fn with_clock(
        files: &ServerFiles,
        key: Option<&[u8]>,
        clock: Arc<dyn TimeProvider>,
    ) -> Result<ServerTls, FileError> {
        let own = own(&files.cert_file, &files.key_file, key)?;
        let mut doubts = Doubts::new(files, clock.current_time().unwrap_or(UnixTime::now()));
        doubts.of_own(&own.cert);
        let clients = Arc::new(Clients::load(files, &mut doubts)?);
        let sessions = Arc::new(Sessions::new(Arc::clone(&clients), Arc::clone(&clock)));
        let config = ServerConfig::builder_with_details(provider(), clock)
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let mut config = config
            .with_client_cert_verifier(Arc::clone(&clients) as _)
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(own)));
        config.session_storage = Arc::clone(&sessions) as _;
        config.send_tls13_tickets = 1;
        let short = LENGTHS.map(|len| {
            let mut short = config.clone();
            short.max_fragment_size = Some(len + RECORD_HEADER_LEN);
            Arc::new(short)
        });
        let (config, short, warnings) = (Arc::new(config), Arc::new(short), doubts.found());
        Ok(ServerTls { config, short, clients, sessions, warnings })
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
        Ok(ServerChannel {
            channel,
            first: Some(Vec::new()),
            short: Arc::clone(&self.short),
            notes: Notes::default(),
            sessions: Arc::clone(&self.sessions),
        })
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
    /// The first bytes of the client, until they tell how long fragments may be.
    first: Option<Vec<u8>>,
    short: Arc<[Arc<ServerConfig>; LENGTHS.len()]>,
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
        let Some(mut first) = self.first.take() else {
            return self.process(bytes, plain, out);
        };
        first.extend_from_slice(bytes);
        match asked(&first) {
            Asked::Unknown => {
                self.first = Some(first);
                return Ok(());
            }
            Asked::Length(index) => {
                let connection = ServerConnection::new(Arc::clone(&self.short[index]))?;
                self.channel = Channel::new(connection);
            }
            Asked::Nothing => {}
        }
        self.process(&first, plain, out)
    }

    fn process(
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
            let tls = ServerTls::with_clock(&party.files(), None, Arc::clone(&clock) as _).unwrap();
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
            let tls = ServerTls::with_clock(&party.files(), None, Arc::clone(&clock) as _).unwrap();
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
            let before = ServerTls::load(&party.files(), None).unwrap();
            let after =
                ServerTls::load(&ServerFiles { crl_file: crl_file.clone(), ..party.files() }, None);
            assert_eq!(shake(&before, &client), Ok(FULL));
            assert_eq!(shake(&before, &client), Ok(RESUMED));
            assert_eq!(shake(&after.unwrap(), &client), Err("revoked"), "{version:?}");
        }
    }

    #[test]
    fn a_session_is_not_resumed_after_its_connection_has_failed() {
        let party = Party::new();
        for version in VERSIONS {
            let tls = ServerTls::load(&party.files(), None).unwrap();
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
    fn a_client_gets_no_longer_fragments_than_it_asks_for() {
        let party = Party::new();
        let tls = ServerTls::load(&party.files(), None).unwrap();
        for version in VERSIONS {
            for (code, len) in LENGTHS.iter().zip(1..).map(|(len, code)| (code, *len)) {
                let mut server = tls.channel().unwrap();
                let (mut hello, mut sent) = (Vec::new(), Vec::new());
                connection(&party.client(version)).write_tls(&mut hello).unwrap();
                with_extension(&mut hello, &[0, 1, 0, 1, code]);
                let cut = hello.len() - 1;
                for part in [&hello[..cut], &hello[cut..]] {
                    assert!(sent.is_empty());
                    server.receive(part, &mut Vec::new(), &mut sent).unwrap();
                }
                server.send(&[7; 10_000], &mut sent);
                let longest = lengths(&sent).into_iter().max().unwrap();
                // The certificate of the server is longer than the shortest fragment.
                let overhead = if version == &TLS13 { 1 + 16 } else { 0 };
                assert!(longest <= len + overhead, "{longest} of {len} over {version:?}");
                assert!(len > 512 || longest == len + overhead, "{longest}");
            }
        }
    }

    /// Inserts an extension as the first of a ClientHello in one record.
    fn with_extension(hello: &mut Vec<u8>, extension: &[u8]) {
        let session_id = 5 + 4 + 2 + 32;
        let suites = session_id + 1 + usize::from(hello[session_id]);
        let suites_len = usize::from(u16::from_be_bytes([hello[suites], hello[suites + 1]]));
        let compressions = suites + 2 + suites_len;
        let extensions = compressions + 1 + usize::from(hello[compressions]);
        for at in [3, 7, extensions] {
            let len = u16::from_be_bytes([hello[at], hello[at + 1]]) + extension.len() as u16;
            hello[at..at + 2].copy_from_slice(&len.to_be_bytes());
        }
        hello.splice(extensions + 2..extensions + 2, extension.iter().copied());
    }

    /// The lengths of records.
    fn lengths(mut records: &[u8]) -> Vec<usize> {
        let mut found = Vec::new();
        while let [_, _, _, high, low, rest @ ..] = records {
            let len = usize::from(u16::from_be_bytes([*high, *low]));
            found.push(len);
            records = &rest[len..];
        }
        found
    }

    #[test]
    fn a_client_without_exactly_one_role_is_refused() {
        let wrong_type = CustomExtension::from_oid_content(&ROLE_ARCS, vec![19, 1, 65]);
        let two = vec![role("operator"), role("engineer")];
        for (roles, reason) in [(two, "two_roles"), (vec![wrong_type], "role_type")] {
            let party = Party::with_client(|params| params.custom_extensions = roles.clone());
            let tls = ServerTls::load(&party.files(), None).unwrap();
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
            let tls = ServerTls::load(&party.files(), None).unwrap();
            let client = party.client(version);
            assert_eq!(shake(&tls, &client), Ok(FULL));
            tls.sessions.fill();
            assert_eq!(shake(&tls, &client), Ok(FULL), "{version:?}");
        }
    }
}
