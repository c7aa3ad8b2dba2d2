//! An authority, a server and a client, for tests.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use rcgen::{
    BasicConstraints, Certificate, CertificateParams, CertificateRevocationList,
    CertificateRevocationListParams, CrlDistributionPoint, CrlIssuingDistributionPoint, CrlScope,
    CustomExtension, DnType, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose,
    RevokedCertParams, date_time_ymd,
};
use rustls::client::WantsClientCert;
use rustls::pki_types::{PrivateKeyDer, ServerName};
use rustls::{
    ClientConfig, ClientConnection, ConfigBuilder, RootCertStore, SupportedProtocolVersion,
};

use super::provider::provider;
use super::server_files::{Protocol, ServerFiles};

/// A certificate and its key.
pub(crate) struct Owner {
    pub(crate) certificate: Certificate,
    pub(crate) params: CertificateParams,
    pub(crate) key: KeyPair,
}

impl Owner {
    /// Valid from 2000 to 2100, unless `with` says otherwise.
    pub(crate) fn new(
        name: &str,
        by: Option<&Owner>,
        with: impl Fn(&mut CertificateParams),
    ) -> Owner {
        let mut params = CertificateParams::new([name.to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        (params.not_before, params.not_after) =
            (date_time_ymd(2000, 1, 1), date_time_ymd(2100, 1, 1));
        with(&mut params);
        let key = KeyPair::generate().unwrap();
        let certificate = match by {
            None => params.self_signed(&key),
            Some(by) => params.signed_by(&key, &by.issuer()),
        };
        Owner { certificate: certificate.unwrap(), params, key }
    }

    pub(crate) fn authority(name: &str, by: Option<&Owner>) -> Owner {
        Owner::new(name, by, |params| {
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        })
    }

    pub(crate) fn pem(&self) -> String {
        self.certificate.pem()
    }

    pub(crate) fn issuer(&self) -> Issuer<'_, &KeyPair> {
        Issuer::from_params(&self.params, &self.key)
    }
}

/// A list of certificates that an authority has revoked, with its scope and distribution point. Also an
/// authority that may not sign lists signs it.
pub(crate) fn revocations(
    by: &Owner,
    revoked: &[&Owner],
    scope: Option<(CrlScope, &str)>,
) -> CertificateRevocationList {
    let entry = |owner: &&Owner| RevokedCertParams {
        serial_number: owner.params.serial_number.clone().unwrap(),
        revocation_time: date_time_ymd(2026, 1, 1),
        reason_code: None,
        invalidity_date: None,
    };
    let list = CertificateRevocationListParams {
        this_update: date_time_ymd(2026, 1, 1),
        next_update: date_time_ymd(2090, 1, 1),
        crl_number: 1.into(),
        issuing_distribution_point: scope.map(|(scope, uri)| CrlIssuingDistributionPoint {
            distribution_point: CrlDistributionPoint { uris: vec![uri.to_owned()] },
            scope: Some(scope),
        }),
        revoked_certs: revoked.iter().map(entry).collect(),
        key_identifier_method: KeyIdMethod::Sha256,
    };
    let mut issuer = by.params.clone();
    issuer.key_usages = Vec::new();
    list.signed_by(&Issuer::from_params(&issuer, &by.key)).unwrap()
}

/// The extension that holds the role.
pub(crate) const ROLE_ARCS: [u64; 9] = [1, 3, 6, 1, 4, 1, 50316, 802, 1];

/// The extension with a role.
pub(crate) fn role(role: &str) -> CustomExtension {
    let content = [&[12, role.len() as u8], role.as_bytes()].concat();
    CustomExtension::from_oid_content(&ROLE_ARCS, content)
}

/// A folder of files, removed on drop.
pub(crate) struct Folder(PathBuf);

impl Folder {
    pub(crate) fn new() -> Folder {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let name = format!("holdfast-party-{}-{number}", std::process::id());
        let path = std::env::temp_dir().join(name);
        fs::create_dir(&path).unwrap();
        Folder(path)
    }

    pub(crate) fn write(&self, name: &str, content: &str) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, content).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// An authority, and the certificates of a server and of a client with the role `operator`.
pub(crate) struct Party {
    pub(crate) folder: Folder,
    pub(crate) authority: Owner,
    pub(crate) server: Owner,
    pub(crate) client: Owner,
}

impl Party {
    pub(crate) fn new() -> Party {
        Party::with_client(|_| {})
    }

    pub(crate) fn with_client(with: impl Fn(&mut CertificateParams)) -> Party {
        let authority = Owner::authority("authority", None);
        let server = Owner::new("localhost", Some(&authority), |_| {});
        let client = Owner::new("panel 7", Some(&authority), |params| {
            params.subject_alt_names.clear();
            params.serial_number = Some(7.into());
            params.custom_extensions = vec![role("operator")];
            with(params);
        });
        Party { folder: Folder::new(), authority, server, client }
    }

    pub(crate) fn files(&self) -> ServerFiles {
        let write = |name, content: String| self.folder.write(name, &content);
        ServerFiles {
            protocol: Protocol::Modbus,
            cert_file: write("server.pem", self.server.pem()),
            key_file: write("server.key", self.server.key.serialize_pem()),
            ca_file: Some(write("ca.pem", self.authority.pem())),
            crl_file: None,
            roles: None,
        }
    }

    /// The settings of the client. They keep sessions, so that the next connection resumes one.
    pub(crate) fn client(&self, version: &'static SupportedProtocolVersion) -> Arc<ClientConfig> {
        let key = PrivateKeyDer::try_from(self.client.key.serialize_der()).unwrap();
        let chain = vec![self.client.certificate.der().clone()];
        Arc::new(self.trusting(version).with_client_auth_cert(chain, key).unwrap())
    }

    /// The settings of a client without a certificate.
    pub(crate) fn anonymous(
        &self,
        version: &'static SupportedProtocolVersion,
    ) -> Arc<ClientConfig> {
        Arc::new(self.trusting(version).with_no_client_auth())
    }

    fn trusting(
        &self,
        version: &'static SupportedProtocolVersion,
    ) -> ConfigBuilder<ClientConfig, WantsClientCert> {
        let mut roots = RootCertStore::empty();
        roots.add(self.authority.certificate.der().clone()).unwrap();
        ClientConfig::builder_with_provider(provider())
            .with_protocol_versions(&[version])
            .unwrap()
            .with_root_certificates(roots)
    }
}

pub(crate) fn connection(config: &Arc<ClientConfig>) -> ClientConnection {
    let name = ServerName::try_from("localhost").unwrap();
    ClientConnection::new(Arc::clone(config), name).unwrap()
}
