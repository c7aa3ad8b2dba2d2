//! The client side: the servers that it trusts, and its own certificate.
//!
//! The certificate of the peer is checked for every connection; sessions are never resumed. Dates
//! are checked when a certificate is used, not when its file is read: the clock of a machine may be
//! wrong just after power-on.

use std::ffi::OsString;
use std::path::Path;
use std::sync::{Arc, Mutex};

use holdfast_runtime::lock;
use rustls::client::danger::{ServerCertVerified, ServerCertVerifier};
use rustls::client::{Resumption, verify_server_name};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::sign::SingleCertAndKey;
use rustls::{ClientConfig, ClientConnection, Error};
use thiserror::Error as ThisError;

use super::certificate::Purpose;
use super::files::FileError;
use super::own_certificate::own;
use super::provider::{handshake_signatures, provider};
use super::revocation::Lists;
use super::trust::{Listed, Trust};
use super::{Channel, TlsFailure};

/// The TLS settings of a client.
#[derive(Debug, Clone, Copy)]
pub struct ClientSettings<'s> {
    /// Trusted certificates: of authorities, or of the device itself. Default: the authorities of
    /// the system.
    pub ca: Option<&'s Path>,
    /// The certificate of the client, with its intermediates; and its key.
    pub own: Option<(&'s Path, &'s Path)>,
    /// The content of the key's file without its passphrase, if it has one.
    pub decrypted_key: Option<&'s [u8]>,
    /// The name or address that the certificate of the peer must have.
    pub name: &'s str,
}

/// Unusable settings.
#[derive(Debug, ThisError)]
pub enum TlsError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{0}")]
    Other(String),
}

/// TLS to one peer. Two values are equal when they trust and present the same certificates, and
/// expect the same name.
#[derive(Debug)]
pub struct ClientTls {
    config: Arc<ClientConfig>,
    identity: Arc<Identity>,
}

/// What two values are compared by.
#[derive(Debug, PartialEq, Eq, Hash)]
pub struct Identity {
    trusted: Arc<[Listed]>,
    own: Vec<CertificateDer<'static>>,
    name: ServerName<'static>,
}

impl ClientTls {
    /// Reads the files.
    ///
    /// # Errors
    /// [`TlsError`] for unusable files or names.
    pub fn new(settings: ClientSettings<'_>) -> Result<ClientTls, TlsError> {
        let name = ServerName::try_from(settings.name.to_owned()).map_err(|_| {
            let found = format!("found {:?} as the name in a certificate", settings.name);
            TlsError::Other(format!("{found}, allowed: a host name or an IP address"))
        })?;
        let trusted = match settings.ca {
            Some(file) => Listed::of_file(file)?,
            None => system_authorities()?,
        };
        let own = settings
            .own
            .map(|(file, key_file)| own(file, key_file, settings.decrypted_key))
            .transpose()?;
        let own_chain = own.as_ref().map_or_else(Vec::new, |own| own.cert.clone());
        let verifier = Arc::new(ServerVerifier(Trust::new(Arc::clone(&trusted), Lists::default())));
        let builder = ClientConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| TlsError::Other(TlsFailure::from(error).to_string()))?
            .dangerous()
            .with_custom_certificate_verifier(verifier);
        let mut config = match own {
            None => builder.with_no_client_auth(),
            Some(own) => builder.with_client_cert_resolver(Arc::new(SingleCertAndKey::from(own))),
        };
        // A resumed session would skip the check of the certificate.
        config.resumption = Resumption::disabled();
        let identity = Arc::new(Identity { trusted, own: own_chain, name });
        Ok(ClientTls { config: Arc::new(config), identity })
    }

    /// Creates the channel of a new connection.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn channel(&self) -> Result<Channel, Error> {
        let name = self.identity.name.clone();
        ClientConnection::new(Arc::clone(&self.config), name).map(Channel::new)
    }

    pub fn identity(&self) -> &Arc<Identity> {
        &self.identity
    }
}

impl PartialEq for ClientTls {
    fn eq(&self, other: &ClientTls) -> bool {
        self.identity == other.identity
    }
}

impl Eq for ClientTls {}

/// The authorities of the system. They are read once, and again when one of the environment
/// variables that name them changes.
fn system_authorities() -> Result<Arc<[Listed]>, TlsError> {
    type Variables = [Option<OsString>; 2];
    static CACHE: Mutex<Option<(Variables, Arc<[Listed]>)>> = Mutex::new(None);
    let variables = ["SSL_CERT_FILE", "SSL_CERT_DIR"].map(std::env::var_os);
    let mut known = lock(&CACHE);
    if let Some((of, found)) = &*known
        && *of == variables
    {
        return Ok(Arc::clone(found));
    }
    let found = rustls_native_certs::load_native_certs();
    if found.certs.is_empty() {
        let why = found.errors.first().map(|error| format!(": {error}")).unwrap_or_default();
        let text = format!("the system has no trusted authorities{why}; set ca");
        return Err(TlsError::Other(text));
    }
    // An authority that cannot be parsed cannot verify anything here.
    let listed: Arc<[Listed]> =
        found.certs.into_iter().filter_map(|each| Listed::new(each).ok()).collect();
    *known = Some((variables, Arc::clone(&listed)));
    Ok(listed)
}

/// Verifies the certificates of servers.
#[derive(Debug)]
struct ServerVerifier(Trust);

impl ServerCertVerifier for ServerVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.0.judge(end_entity, intermediates, Purpose::Server, now)?;
        verify_server_name(&ParsedCertificate::try_from(end_entity)?, server_name)?;
        Ok(ServerCertVerified::assertion())
    }

    handshake_signatures!();
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;
    use std::sync::atomic::{AtomicU32, Ordering};

    use rcgen::{
        BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, date_time_ymd,
    };
    use rustls::RootCertStore;
    use rustls::pki_types::PrivateKeyDer;
    use rustls::server::WebPkiClientVerifier;
    use rustls::version::{TLS12, TLS13};
    use rustls::{ServerConfig, ServerConnection, SupportedProtocolVersion};

    use super::*;
    use crate::tls::test_party::Owner;

    const CA: IsCa = IsCa::Ca(BasicConstraints::Unconstrained);
    const VERSIONS: [&SupportedProtocolVersion; 2] = [&TLS12, &TLS13];

    /// A temporary file, removed on drop.
    struct File(PathBuf);

    impl File {
        fn new(content: impl AsRef<[u8]>) -> File {
            static NUMBER: AtomicU32 = AtomicU32::new(0);
            let number = NUMBER.fetch_add(1, Ordering::Relaxed);
            let name = format!("holdfast-tls-{}-{number}.pem", std::process::id());
            let path = std::env::temp_dir().join(name);
            fs::write(&path, content).unwrap();
            File(path)
        }
    }

    impl Drop for File {
        fn drop(&mut self) {
            let _ = fs::remove_file(&self.0);
        }
    }

    fn client(ca: &str, own: Option<&Owner>, name: &str) -> ClientTls {
        let ca = File::new(ca);
        let own = own.map(|own| (File::new(own.pem()), File::new(own.key.serialize_pem())));
        let own = own.as_ref().map(|(file, key)| (file.0.as_path(), key.0.as_path()));
        ClientTls::new(ClientSettings { ca: Some(&ca.0), own, decrypted_key: None, name }).unwrap()
    }

    fn server(
        of: &Owner,
        version: &'static SupportedProtocolVersion,
        asks: Option<&Owner>,
    ) -> Channel {
        let provider = provider();
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[version])
            .unwrap();
        let builder = match asks {
            None => builder.with_no_client_auth(),
            Some(authority) => {
                let mut roots = RootCertStore::empty();
                roots.add(authority.certificate.der().clone()).unwrap();
                let roots = Arc::new(roots);
                let verifier = WebPkiClientVerifier::builder_with_provider(roots, provider);
                builder.with_client_cert_verifier(verifier.build().unwrap())
            }
        };
        let key = PrivateKeyDer::try_from(of.key.serialize_der()).unwrap();
        let chain = vec![of.certificate.der().clone()];
        let config = builder.with_single_cert(chain, key).unwrap();
        Channel::new(ServerConnection::new(Arc::new(config)).unwrap())
    }

    /// What the client received, or why the client or the server gave up.
    fn talk(client: &ClientTls, server: &mut Channel, piece: usize) -> Result<Vec<u8>, String> {
        let mut client = client.channel().unwrap();
        let (mut to_server, mut to_client) = (Vec::new(), Vec::new());
        let (mut asked, mut answered, mut greeted) = (Vec::new(), Vec::new(), false);
        client.send(&[], &mut to_server);
        for _ in 0..20 {
            let mut refused = Ok(());
            for bytes in std::mem::take(&mut to_server).chunks(piece) {
                refused = refused.and(server.receive(bytes, &mut asked, &mut to_client));
            }
            if refused.is_ok() && asked == b"ping" {
                server.send(b"pong", &mut to_client);
                asked.clear();
            }
            for bytes in std::mem::take(&mut to_client).chunks(piece) {
                let done = client.receive(bytes, &mut answered, &mut to_server);
                done.map_err(|error| TlsFailure::from(&error).to_string())?;
            }
            if !client.is_handshaking() && !greeted {
                greeted = true;
                client.send(b"ping", &mut to_server);
            }
            if !answered.is_empty() {
                client.end(&mut to_server);
                let (mut rest, mut out) = (Vec::new(), Vec::new());
                server.receive(&to_server, &mut rest, &mut out).unwrap();
                assert!(server.has_ended() && rest.is_empty());
                return Ok(answered);
            }
        }
        Err("no end".into())
    }

    fn outcome(ca: &str, name: &str, peer: &Owner) -> String {
        let outcome = VERSIONS.map(|version| {
            match talk(&client(ca, None, name), &mut server(peer, version, None), usize::MAX) {
                Ok(_) => "pong".to_owned(),
                Err(why) => why,
            }
        });
        assert_eq!(outcome[0], outcome[1]);
        let [outcome, _] = outcome;
        outcome
    }

    #[test]
    fn data_arrives_in_pieces_of_any_size() {
        let authority = Owner::authority("authority", None);
        let plc = Owner::new("plc", Some(&authority), |_| {});
        for version in VERSIONS {
            for piece in [1, 7, 1000, usize::MAX] {
                let client = client(&authority.pem(), None, "plc");
                let answered = talk(&client, &mut server(&plc, version, None), piece);
                assert_eq!(answered.unwrap(), b"pong");
            }
        }
    }

    #[test]
    fn issuer_and_name_are_checked() {
        let authority = Owner::authority("authority", None);
        let stranger = Owner::authority("stranger", None);
        let plc = Owner::new("plc", Some(&authority), |_| {});
        let address = Owner::new("10.0.0.5", Some(&authority), |_| {});
        let both = authority.pem() + &stranger.pem();

        assert_eq!(outcome(&both, "plc", &plc), "pong");
        assert_eq!(outcome(&both, "10.0.0.5", &address), "pong");
        assert_eq!(
            outcome(&stranger.pem(), "plc", &plc),
            "the issuer of the certificate is unknown: neither the certificate nor an authority \
             above it is trusted"
        );
        assert_eq!(
            outcome(&both, "10.0.0.5", &plc),
            "the certificate is for 'plc', not for '10.0.0.5'"
        );
        assert_eq!(
            outcome(&both, "plc", &address),
            "the certificate is for '10.0.0.5', not for 'plc'"
        );
    }

    #[test]
    fn an_expired_certificate_is_not_trusted() {
        let expired = |params: &mut CertificateParams| {
            params.not_before = date_time_ymd(2020, 1, 1);
            params.not_after = date_time_ymd(2021, 1, 1);
        };
        let authority = Owner::authority("authority", None);
        let late = Owner::new("plc", Some(&authority), expired);
        let own = Owner::new("plc", None, expired);
        for outcome in [outcome(&authority.pem(), "plc", &late), outcome(&own.pem(), "plc", &own)] {
            assert!(outcome.starts_with("the certificate expired "), "{outcome}");
        }

        let early = Owner::new("plc", Some(&authority), |params| {
            params.not_before = date_time_ymd(2099, 1, 1);
        });
        let told_early = outcome(&authority.pem(), "plc", &early);
        assert!(
            told_early.starts_with("the certificate is not valid yet: its validity begins in "),
            "{told_early}"
        );

        let former = Owner::new("former", None, |params| {
            params.is_ca = CA;
            expired(params);
        });
        let plc = Owner::new("plc", Some(&former), |_| {});
        let why = outcome(&former.pem(), "plc", &plc);
        assert!(why.starts_with("an authority above the certificate expired "), "{why}");
        // An expired authority does not affect the others.
        let third = Owner::new("plc", Some(&authority), |_| {});
        assert_eq!(outcome(&(former.pem() + &authority.pem()), "plc", &third), "pong");
    }

    #[test]
    fn a_device_is_trusted_by_its_own_certificate() {
        let unknown = Owner::authority("unknown", None);
        for (is_ca, by) in [
            (CA, None),
            (IsCa::NoCa, None),
            (IsCa::ExplicitNoCa, None),
            (IsCa::NoCa, Some(&unknown)),
        ] {
            let plc = Owner::new("plc", by, |params| params.is_ca = is_ca);
            assert_eq!(outcome(&plc.pem(), "plc", &plc), "pong");
            assert!(outcome(&plc.pem(), "plc8", &plc).contains("for 'plc', not for 'plc8'"));
            let twin = Owner::new("plc", by, |params| params.is_ca = is_ca);
            assert!(outcome(&plc.pem(), "plc", &twin) != "pong");
        }
        let of_client = Owner::new("plc", None, |params| {
            params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        });
        assert_eq!(
            outcome(&of_client.pem(), "plc", &of_client),
            "the certificate is for other purposes: its extendedKeyUsage lacks serverAuth"
        );
    }

    #[test]
    fn the_key_of_a_device_cannot_issue_certificates() {
        for is_ca in [IsCa::NoCa, IsCa::ExplicitNoCa] {
            let device = Owner::new("plc1", None, |params| params.is_ca = is_ca);
            let forged = Owner::new("plc2", Some(&device), |_| {});
            let outcome = outcome(&device.pem(), "plc2", &forged);
            assert!(outcome.starts_with("the issuer of the certificate is unknown"), "{outcome}");
        }
    }

    #[test]
    fn a_peer_that_requires_a_certificate_gets_it_or_refuses() {
        let authority = Owner::authority("authority", None);
        let stranger = Owner::authority("stranger", None);
        let plc = Owner::new("plc", Some(&authority), |_| {});
        let panel = Owner::new("panel", Some(&authority), |_| {});
        let foreign = Owner::new("foreign", Some(&stranger), |_| {});
        for version in VERSIONS {
            let outcome = |own| {
                let client = client(&authority.pem(), own, "plc");
                talk(&client, &mut server(&plc, version, Some(&authority)), usize::MAX)
            };
            assert_eq!(outcome(Some(&panel)).unwrap(), b"pong");
            assert_eq!(outcome(None).unwrap_err(), "the peer requires a certificate");
            assert_eq!(
                outcome(Some(&foreign)).unwrap_err(),
                "the peer refused the certificate: unknown issuer"
            );
        }
    }

    #[test]
    fn a_peer_without_tls_is_reported() {
        let authority = Owner::authority("authority", None);
        let tls = client(&authority.pem(), None, "plc");
        for bytes in [&b"HTTP/1.1 400 Bad Request\r\n\r\n"[..], b"\0\0\0\0\0\x03\x01\x83\x01"] {
            let (mut plain, mut out) = (Vec::new(), Vec::new());
            let error = tls.channel().unwrap().receive(bytes, &mut plain, &mut out).unwrap_err();
            assert_eq!(TlsFailure::from(&error).to_string(), "the peer does not speak TLS");
            assert!(plain.is_empty());
        }
    }

    #[test]
    fn unusable_files_are_reported() {
        let [plc, other] = ["plc", "other"].map(|name| Owner::new(name, None, |_| {}));
        let (certificate, key) = (plc.pem(), plc.key.serialize_pem());
        let outcome = |certificate: &str, key: &[u8]| {
            let (ca, file, key) = (File::new(plc.pem()), File::new(certificate), File::new(key));
            let own = Some((file.0.as_path(), key.0.as_path()));
            let settings =
                ClientSettings { ca: Some(&ca.0), own, decrypted_key: None, name: "plc" };
            let error = ClientTls::new(settings).unwrap_err();
            let (file, key) = (file.0.display().to_string(), key.0.display().to_string());
            error.to_string().replace(&file, "CERT").replace(&key, "KEY")
        };
        assert_eq!(
            outcome(&certificate, other.key.serialize_pem().as_bytes()),
            "KEY: it is not the key of the certificate in CERT"
        );
        assert_eq!(
            outcome(&key, key.as_bytes()),
            "CERT: found no certificate, allowed: a certificate in PEM"
        );
        assert_eq!(
            outcome(&certificate, certificate.as_bytes()),
            "KEY: found no key, allowed: a key in PEM"
        );
        assert_eq!(
            outcome(&certificate, &plc.key.serialize_der()),
            "KEY: found DER, allowed: a key in PEM"
        );
        assert_eq!(outcome(&certificate, b""), "KEY: found no key, allowed: a key in PEM");
        assert_eq!(
            outcome(&certificate, b"-----BEGIN ENCRYPTED PRIVATE KEY-----\n"),
            "KEY: the key is encrypted; use a key without a passphrase"
        );
        assert_eq!(
            outcome(&certificate[..100], key.as_bytes()),
            "CERT: it ends inside a CERTIFICATE"
        );
        assert_eq!(
            outcome(&certificate, &key.as_bytes()[..100]),
            "KEY: it ends inside a PRIVATE KEY"
        );
        assert_eq!(
            outcome(&certificate, key.replace('\n', "").as_bytes()),
            "KEY: it ends inside a block, allowed: PEM, in lines"
        );
        assert_eq!(
            outcome(&certificate, key.replacen('\n', "", 1).as_bytes()),
            "KEY: a line that begins with -----BEGIN does not end with -----"
        );
        assert_eq!(
            outcome(&certificate.replace("MII", "M*I"), key.as_bytes()),
            "CERT: a block is not base64"
        );
        assert_eq!(
            outcome(
                "-----BEGIN CERTIFICATE-----\nMAA=\n-----END CERTIFICATE-----\n",
                key.as_bytes()
            ),
            "CERT: certificate 1 can't be read, allowed: X.509 version 3"
        );
        let ancient = Owner::new("plc", None, |params| {
            params.not_before = rcgen::date_time_ymd(1969, 12, 31);
        });
        assert_eq!(
            outcome(&ancient.pem(), ancient.key.serialize_pem().as_bytes()),
            "CERT: certificate 1 can't be read"
        );
        let missing = Path::new("/nonexistent/ca.pem");
        let settings =
            ClientSettings { ca: Some(missing), own: None, decrypted_key: None, name: "plc" };
        let error = ClientTls::new(settings).unwrap_err().to_string();
        assert!(error.starts_with("/nonexistent/ca.pem: "), "{error}");
        let ca = File::new(vec![b'\n'; 5 << 20]);
        let settings =
            ClientSettings { ca: Some(&ca.0), own: None, decrypted_key: None, name: "plc" };
        assert!(
            ClientTls::new(settings).unwrap_err().to_string().contains("more than 4194304 bytes")
        );
        let ca = File::new(&certificate);
        let settings =
            ClientSettings { ca: Some(&ca.0), own: None, decrypted_key: None, name: "a b" };
        assert_eq!(
            ClientTls::new(settings).unwrap_err().to_string(),
            "found \"a b\" as the name in a certificate, allowed: a host name or an IP address"
        );
    }

    #[test]
    fn values_with_the_same_certificates_and_name_are_equal() {
        let [one, two] = ["one", "two"].map(|name| Owner::new(name, None, |_| {}));
        let made = || client(&one.pem(), Some(&two), "plc");
        assert_eq!(made(), made());
        assert_ne!(made(), client(&two.pem(), Some(&two), "plc"));
        assert_ne!(made(), client(&one.pem(), None, "plc"));
        assert_ne!(made(), client(&one.pem(), Some(&two), "plc2"));
    }
}
