//! The server side: its certificate, and the channels of its connections.
//!
//! For Modbus, mutual authentication is mandatory, as MB-TCP-Security requires; for HTTP, it is a
//! setting. The certificate of a client and its dates are checked for every connection, also if it
//! resumes a session. Everything else is the same for both protocols.

use std::fmt;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::sign::SingleCertAndKey;
use rustls::time_provider::{DefaultTimeProvider, TimeProvider};
use rustls::{AlertDescription, Error, ProtocolVersion, ServerConfig, ServerConnection};

use super::certificate::Parsed;
use super::client_verifier::Clients;
use super::file_warnings::FileWarnings;
use super::files::FileError;
use super::handshake_notes::Notes;
use super::hello::{Hello, LENGTHS, RECORD_HEADER_LEN};
use super::own_certificate::own;
use super::provider::provider;
pub use super::server_files::{Protocol, ServerFiles};
use super::sessions::Sessions;
use super::{Channel, TlsFailure};

/// The TLS configuration of a server.
pub struct ServerTls {
    protocol: Protocol,
    configs: Arc<Configs>,
    /// `None`: clients need no certificate.
    clients: Option<Arc<Clients>>,
    sessions: Arc<Sessions>,
    warnings: Vec<String>,
}

/// The configurations of rustls. A ClientHello decides between them.
struct Configs {
    protocol: Protocol,
    usual: ByLength,
    /// For clients that offer other protocols only: without an answer to their offer.
    silent: ByLength,
}

/// The same configuration for fragments of any length, and for clients that ask for shorter ones.
struct ByLength {
    any: Arc<ServerConfig>,
    short: [Arc<ServerConfig>; LENGTHS.len()],
}

impl Configs {
    fn new(protocol: Protocol, mut config: ServerConfig) -> Configs {
        let silent = ByLength::new(config.clone());
        config.alpn_protocols = protocol.alpn().into_iter().map(<[u8]>::to_vec).collect();
        Configs { protocol, usual: ByLength::new(config), silent }
    }

    /// The configuration for a client.
    fn of(&self, hello: &Hello) -> &Arc<ServerConfig> {
        let is_other = self.protocol.alpn().is_some_and(|alpn| hello.offers_others_than(alpn));
        let configs = if is_other { &self.silent } else { &self.usual };
        hello.fragment_length().map_or(&configs.any, |index| &configs.short[index])
    }
}

impl ByLength {
    fn new(config: ServerConfig) -> ByLength {
        let short = LENGTHS.map(|len| {
            let mut short = config.clone();
            short.max_fragment_size = Some(len + RECORD_HEADER_LEN);
            Arc::new(short)
        });
        ByLength { any: Arc::new(config), short }
    }
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
        let mut warnings =
            FileWarnings::new(files, clock.current_time().unwrap_or(UnixTime::now()));
        warnings.of_own(&own.cert);
        let clients = Clients::load(files, &mut warnings)?.map(Arc::new);
        let sessions = Arc::new(Sessions::new(clients.clone(), Arc::clone(&clock)));
        let config = ServerConfig::builder_with_details(provider(), clock)
            .with_safe_default_protocol_versions()
            .map_err(|error| FileError::content(&files.cert_file, error.to_string()))?;
        let config = match &clients {
            Some(clients) => config.with_client_cert_verifier(Arc::clone(clients) as _),
            None => config.with_no_client_auth(),
        };
        let mut config = config.with_cert_resolver(Arc::new(SingleCertAndKey::from(own)));
        config.session_storage = Arc::clone(&sessions) as _;
        config.send_tls13_tickets = 1;
        Ok(ServerTls {
            protocol: files.protocol,
            configs: Arc::new(Configs::new(files.protocol, config)),
            clients,
            sessions,
            warnings: warnings.found(),
        })
    }

    /// The protocol that it is for.
    pub fn protocol(&self) -> Protocol {
        self.protocol
    }

    /// Whether clients need a certificate.
    pub fn requires_certificate(&self) -> bool {
        self.clients.is_some()
    }

    /// Judges the certificate of an open session again, as a handshake would now.
    pub(crate) fn judge(&self, certificate: &PeerCertificate) -> Result<(), TlsFailure> {
        let clients = self.clients.as_ref();
        clients.map_or(Ok(()), |clients| clients.judge(&certificate.chain, UnixTime::now()))
    }

    /// What is doubtful about the files: certificates outside their dates, revocation lists that are
    /// missing, expired or of others.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Creates the channel of an accepted connection.
    pub(crate) fn channel(&self) -> Result<ServerChannel, Error> {
        let channel = Channel::new(ServerConnection::new(Arc::clone(&self.configs.usual.any))?);
        Ok(ServerChannel {
            channel,
            first: Some(Vec::new()),
            configs: Arc::clone(&self.configs),
            requires_certificate: self.requires_certificate(),
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
    /// The first bytes of the client, until they are a whole ClientHello.
    first: Option<Vec<u8>>,
    configs: Arc<Configs>,
    requires_certificate: bool,
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
        let Some(hello) = Hello::of(&first) else {
            self.first = Some(first);
            return Ok(());
        };
        let config = self.configs.of(&hello);
        if !Arc::ptr_eq(config, &self.configs.usual.any) {
            self.channel = Channel::new(ServerConnection::new(Arc::clone(config))?);
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

    /// Whether the client has said what it supports.
    pub(crate) fn has_begun(&self) -> bool {
        self.first.is_none()
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

    /// The certificate of the peer, after the handshake; `None` if clients need none.
    pub(crate) fn peer_certificate(&self) -> Result<Option<PeerCertificate>, TlsFailure> {
        let chain = self.channel.0.peer_certificates().unwrap_or_default();
        let Some(presented) = chain.first() else {
            let is_required = self.requires_certificate;
            return if is_required { Err(TlsFailure::NoCertificate) } else { Ok(None) };
        };
        let parsed = Parsed::new(presented).map_err(Error::from)?;
        Ok(Some(PeerCertificate {
            role: parsed.role()?,
            subject: parsed.subject_text(),
            serial: parsed.serial_text(),
            chain: chain.iter().cloned().map(CertificateDer::into_owned).collect(),
        }))
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

    use rcgen::{CustomExtension, date_time_ymd};
    use rustls::HandshakeKind::{Full as FULL, Resumed as RESUMED};
    use rustls::version::{TLS12, TLS13};
    use rustls::{ClientConfig, HandshakeKind, SupportedProtocolVersion};

    use super::*;
    use crate::tls::test_party::{Party, ROLE_ARCS, connection, revocations, role};

    const DAY: u64 = 24 * 60 * 60;
    const VERSIONS: [&SupportedProtocolVersion; 2] = [&TLS12, &TLS13];
    const PROTOCOLS: [Protocol; 2] = [Protocol::Modbus, Protocol::Http];

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
        let certificate = server.peer_certificate().unwrap();
        assert_eq!(certificate.is_some(), tls.requires_certificate());
        assert!(certificate.is_none_or(|certificate| certificate.role == "operator"));
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
            resumes_for_one_day(&party.files(), &party.client(version));
        }
    }

    fn resumes_for_one_day(files: &ServerFiles, client: &Arc<ClientConfig>) {
        let clock = Clock::new();
        let tls = ServerTls::with_clock(files, None, Arc::clone(&clock) as _).unwrap();
        assert_eq!(shake(&tls, client), Ok(FULL));
        assert_eq!(shake(&tls, client), Ok(RESUMED));
        clock.pass(DAY / 2);
        assert_eq!(shake(&tls, client), Ok(RESUMED));
        clock.pass(DAY / 2 + 1);
        assert_eq!(shake(&tls, client), Ok(FULL));
        assert_eq!(shake(&tls, client), Ok(RESUMED));
    }

    #[test]
    fn a_session_is_not_resumed_when_the_certificate_has_expired_since() {
        let party = Party::with_client(|params| params.not_after = date_time_ymd(2040, 1, 1));
        let last = 2_208_988_800;
        let cases = PROTOCOLS.map(|protocol| VERSIONS.map(|version| (protocol, version)));
        for (protocol, version) in cases.into_iter().flatten() {
            let clock = Arc::new(Clock(AtomicU64::new(last - 10)));
            let files = ServerFiles { protocol, ..party.files() };
            let tls = ServerTls::with_clock(&files, None, Arc::clone(&clock) as _).unwrap();
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
        let list = revocations(&party.authority, &[&party.client], None);
        let crl_file = Some(party.folder.write("crl.pem", &list.pem().unwrap()));
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
        for (protocol, offered) in
            [(Protocol::Modbus, "h2"), (Protocol::Http, "h2"), (Protocol::Http, "http/1.1")]
        {
            let tls = ServerTls::load(&ServerFiles { protocol, ..party.files() }, None).unwrap();
            for (version, (code, len)) in
                VERSIONS.into_iter().flat_map(|each| (1..).zip(LENGTHS).map(move |len| (each, len)))
            {
                let mut client = ClientConfig::clone(&party.client(version));
                client.alpn_protocols = vec![offered.into()];
                let longest = longest_fragment(&tls, &Arc::new(client), code);
                // The certificate of the server is longer than the shortest fragment.
                let overhead = if version == &TLS13 { 1 + 16 } else { 0 };
                assert!(longest <= len + overhead, "{longest} of {len} over {version:?}");
                assert!(len > 512 || longest == len + overhead, "{longest}");
            }
        }
    }

    /// The length of the longest fragment for a client that asks for the length with that code.
    fn longest_fragment(tls: &ServerTls, client: &Arc<ClientConfig>, code: u8) -> usize {
        let mut server = tls.channel().unwrap();
        let (mut hello, mut sent) = (Vec::new(), Vec::new());
        connection(client).write_tls(&mut hello).unwrap();
        with_extension(&mut hello, &[0, 1, 0, 1, code]);
        let cut = hello.len() - 1;
        for part in [&hello[..cut], &hello[cut..]] {
            assert!(sent.is_empty());
            server.receive(part, &mut Vec::new(), &mut sent).unwrap();
        }
        server.send(&[7; 10_000], &mut sent);
        lengths(&sent).into_iter().max().unwrap()
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
            for protocol in PROTOCOLS {
                let tls = ServerTls::load(&ServerFiles { protocol, ..party.files() }, None);
                for version in VERSIONS {
                    refuses(tls.as_ref().unwrap(), &party.client(version), reason);
                }
            }
        }
    }

    /// Asserts why a client is refused, and that its subject is known.
    fn refuses(tls: &ServerTls, client: &Arc<ClientConfig>, reason: &str) {
        let mut server = tls.channel().unwrap();
        assert_eq!(talk(&mut server, client, b"").unwrap_err().reason(), reason);
        assert_eq!(server.presented_subject().as_deref(), Some("CN=panel 7"));
    }

    fn http(party: &Party) -> ServerFiles {
        ServerFiles { protocol: Protocol::Http, ..party.files() }
    }

    fn open(party: &Party) -> ServerFiles {
        ServerFiles { ca_file: None, ..http(party) }
    }

    #[test]
    fn http_clients_need_no_certificate_without_authorities_and_resume_sessions() {
        let party = Party::new();
        assert!(!ServerTls::load(&open(&party), None).unwrap().requires_certificate());
        for version in VERSIONS {
            resumes_for_one_day(&open(&party), &party.anonymous(version));
        }
    }

    #[test]
    fn http_clients_need_a_certificate_with_authorities() {
        let party = Party::new();
        let tls = ServerTls::load(&http(&party), None).unwrap();
        for version in VERSIONS {
            assert_eq!(shake(&tls, &party.client(version)), Ok(FULL));
            assert_eq!(shake(&tls, &party.anonymous(version)), Err("no_certificate"));
        }
    }

    #[test]
    fn what_requires_authorities_is_refused_without_them() {
        let party = Party::new();
        let crl_file = Some(party.folder.write("crl.pem", ""));
        let roles = Some(vec!["operator".to_owned()]);
        for (files, expected) in [
            (
                ServerFiles { ca_file: None, ..party.files() },
                "server.pem: found without ca_file, which Modbus/TCP Security requires",
            ),
            (
                ServerFiles { crl_file, ..open(&party) },
                "crl.pem: found without client_ca_file, allowed: only with it",
            ),
            (
                ServerFiles { roles, ..open(&party) },
                "server.pem: found with roles and without client_ca_file, allowed: roles only \
                 with it",
            ),
        ] {
            let refused = ServerTls::load(&files, None).unwrap_err().to_string();
            assert!(refused.ends_with(expected), "{refused}");
        }
    }

    #[test]
    fn only_clients_with_an_allowed_role_are_served() {
        let party = Party::new();
        for version in VERSIONS {
            let tls = |role: &str| {
                let files = ServerFiles { roles: Some(vec![role.to_owned()]), ..http(&party) };
                ServerTls::load(&files, None).unwrap()
            };
            let client = party.client(version);
            assert_eq!(shake(&tls("operator"), &client), Ok(FULL));
            for other in ["engineer", ""] {
                refuses(&tls(other), &client, "wrong_role");
            }
        }
    }

    #[test]
    fn http_is_chosen_among_the_protocols_that_a_client_offers() {
        const H1: &[u8] = b"http/1.1";
        let party = Party::new();
        for (files, offered, chosen) in [
            (open(&party), &[&b"h2"[..], H1][..], Some(H1)),
            (http(&party), &[H1], Some(H1)),
            (open(&party), &[b"h2"], None),
            (http(&party), &[b"h2"], None),
            (open(&party), &[], None),
            (party.files(), &[H1], None),
        ] {
            let tls = ServerTls::load(&files, None).unwrap();
            for version in VERSIONS {
                let mut client = ClientConfig::clone(&party.client(version));
                client.alpn_protocols = offered.iter().map(|name| name.to_vec()).collect();
                let mut server = tls.channel().unwrap();
                talk(&mut server, &Arc::new(client), b"").unwrap();
                assert_eq!(server.channel.0.alpn_protocol(), chosen, "{offered:?}");
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
