//! Verifies the certificates of clients, for a server. [`Trust`] decides whether a listed certificate is trusted,
//! and for which others it vouches.

use std::collections::BTreeSet;
use std::sync::Arc;

use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{CertificateError, DistinguishedName, Error, OtherError};

use super::TlsFailure;
use super::certificate::{Parsed, Purpose};
use super::file_warnings::FileWarnings;
use super::files::FileError;
use super::handshake_notes::{Chain, noted};
use super::provider::handshake_signatures;
use super::revocation::{List, Lists};
use super::server_files::{Protocol, ServerFiles};
use super::trust::{Listed, Trust};

/// Verifies the certificates of clients.
#[derive(Debug)]
pub(super) struct Clients {
    trust: Trust,
    accepted_issuers: Vec<DistinguishedName>,
    /// The allowed roles; `None` is any.
    roles: Option<Vec<String>>,
}

impl Clients {
    /// `None`: clients need no certificate.
    pub(super) fn load(
        files: &ServerFiles,
        warnings: &mut FileWarnings<'_>,
    ) -> Result<Option<Clients>, FileError> {
        let ca_key = files.protocol.ca_key();
        let Some(ca_file) = &files.ca_file else {
            return may_lack_authorities(files).map(|()| None);
        };
        let listed = Listed::of_file(ca_file)?;
        let names: BTreeSet<_> =
            listed.iter().filter_map(|each| each.parsed.accepted_issuer()).collect();
        let accepted_issuers = names.into_iter().map(DistinguishedName::from).collect();
        warnings.of_listed(ca_file, &listed);
        let may_have_list = |each: &Listed| each.is_authority() || !each.parsed.is_self_issued();
        let lists = match &files.crl_file {
            Some(file) if !listed.iter().any(may_have_list) => {
                let flaw = format!(
                    "crl_file requires an authority (CA:TRUE) in {ca_key}, or a certificate that \
                     one has signed"
                );
                return Err(FileError::content(file, flaw));
            }
            Some(file) => List::of_file(file)?,
            None => Vec::new(),
        };
        let trust = Trust::new(listed, Lists { lists });
        if let Some(file) = &files.crl_file {
            warnings.of_lists(file, &trust);
        }
        Ok(Some(Clients { trust, accepted_issuers, roles: files.roles.clone() }))
    }

    /// Verifies the certificate of a client, its own first, and its role.
    pub(super) fn judge(
        &self,
        chain: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<(), TlsFailure> {
        let (own, intermediates) = chain.split_first().ok_or(TlsFailure::NoCertificate)?;
        self.trust.judge(own, intermediates, Purpose::Client, now)?;
        let role = Parsed::new(own).map_err(Error::from)?.role()?;
        match &self.roles {
            Some(allowed) if !allowed.contains(&role) => Err(TlsFailure::WrongRole { role }),
            _ => Ok(()),
        }
    }
}

/// # Errors
/// The protocol, or another setting, requires the authorities of clients.
fn may_lack_authorities(files: &ServerFiles) -> Result<(), FileError> {
    let ca_key = files.protocol.ca_key();
    if files.protocol == Protocol::Modbus {
        let flaw = format!("found without {ca_key}, which Modbus/TCP Security requires");
        return Err(FileError::content(&files.cert_file, flaw));
    }
    if let Some(file) = &files.crl_file {
        let flaw = format!("found without {ca_key}, allowed: only with it");
        return Err(FileError::content(file, flaw));
    }
    if files.roles.is_some() {
        let flaw = format!("found with roles and without {ca_key}, allowed: roles only with it");
        return Err(FileError::content(&files.cert_file, flaw));
    }
    Ok(())
}

impl ClientCertVerifier for Clients {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &self.accepted_issuers
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

    handshake_signatures!();
}

/// The error with which rustls sends the alert for a failure (RFC 8446, 6.2).
fn refused(failure: &TlsFailure) -> Error {
    let error = match failure {
        TlsFailure::Expired { .. }
        | TlsFailure::NotYetValid { .. }
        | TlsFailure::IssuerExpired { .. }
        | TlsFailure::IssuerNotYetValid { .. } => CertificateError::Expired,
        TlsFailure::Revoked => CertificateError::Revoked,
        TlsFailure::UnknownIssuer => CertificateError::UnknownIssuer,
        TlsFailure::WrongPurpose { .. }
        | TlsFailure::WrongKeyUsage
        | TlsFailure::UnsupportedCertificate { .. } => CertificateError::InvalidPurpose,
        TlsFailure::BadCertificate
        | TlsFailure::BadSignature
        | TlsFailure::TwoRoles
        | TlsFailure::RoleType
        | TlsFailure::UnsupportedExtension => CertificateError::BadEncoding,
        TlsFailure::WrongRole { .. } => CertificateError::ApplicationVerificationFailure,
        // The alert certificate_unknown.
        other => return CertificateError::Other(OtherError(Arc::new(other.clone()))).into(),
    };
    error.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tls::test_party::{Owner, Party};

    #[test]
    fn clients_find_the_issuer_of_a_listed_certificate_among_the_accepted_ones() {
        let party = Party::new();
        let (other, alone) = (Owner::authority("other", None), Owner::new("alone", None, |_| {}));
        let issuers = |listed: &[&Owner]| -> Vec<Vec<u8>> {
            let text: String = listed.iter().map(|owner| owner.pem()).collect();
            let files = ServerFiles {
                ca_file: Some(party.folder.write("listed.pem", &text)),
                ..party.files()
            };
            let clients = Clients::load(&files, &mut FileWarnings::new(&files, UnixTime::now()));
            let clients = clients.unwrap().unwrap();
            clients.root_hint_subjects().iter().map(|name| name.as_ref().to_vec()).collect()
        };
        let authority = issuers(&[&party.authority]);
        assert_eq!(authority.len(), 1);
        assert_eq!(issuers(&[&party.client, &party.server]), authority);
        assert_eq!(issuers(&[&party.client, &other]).len(), 2);
        assert_ne!(issuers(&[&alone]), authority);
        assert_eq!(issuers(&[&alone]).len(), 1);
    }
}
