//! What is doubtful about the files of a server. None of it is an error: the clock of a machine may
//! be wrong just after power-on, and dates are checked when a certificate is used.

use std::path::Path;

use rustls::pki_types::{CertificateDer, UnixTime};

use super::certificate::{Parsed, name_text};
use super::failure::{between, span};
use super::revocation::List;
use super::server_files::ServerFiles;
use super::trust::{Listed, Trust};

/// Finds what is doubtful.
pub(super) struct FileWarnings<'f> {
    files: &'f ServerFiles,
    now: UnixTime,
    found: Vec<String>,
}

impl<'f> FileWarnings<'f> {
    pub(super) fn new(files: &'f ServerFiles, now: UnixTime) -> FileWarnings<'f> {
        FileWarnings { files, now, found: Vec::new() }
    }

    pub(super) fn found(self) -> Vec<String> {
        self.found
    }

    pub(super) fn of_own(&mut self, chain: &[CertificateDer<'_>]) {
        for (der, number) in chain.iter().zip(1..) {
            if let Ok(parsed) = Parsed::new(der) {
                let file = &self.files.cert_file;
                self.of_dates(file, &parsed, number, "clients refuse this server");
            }
        }
    }

    pub(super) fn of_listed(&mut self, file: &Path, listed: &[Listed]) {
        for (each, number) in listed.iter().zip(1..) {
            let parsed = &each.parsed;
            self.of_dates(file, parsed, number, outcome(each));
            let mut others = listed.iter().zip(1..).filter(|(other, _)| other.is_authority());
            if !each.is_authority()
                && let Some((_, issuer)) =
                    others.find(|(other, _)| parsed.is_issued_by(&other.parsed))
            {
                let name = parsed.subject_text();
                self.add(file, &format!(
                    "certificate {number} ({name}) is of the authority in certificate {issuer}: all \
                     clients of that authority are trusted, not only this one"
                ));
            }
        }
    }

    fn of_dates(&mut self, file: &Path, parsed: &Parsed, number: usize, outcome: &str) {
        let (begins, ends) = parsed.validity();
        let name = format!("certificate {number} ({})", parsed.subject_text());
        if self.now > ends {
            let ago = span(between(ends, self.now));
            self.add(file, &format!("{name} expired {ago} ago: {outcome}"));
        }
        if self.now < begins {
            let wait = span(between(self.now, begins));
            self.add(
                file,
                &format!(
                    "{name} is not valid yet, its validity begins in {wait}: {outcome} until then"
                ),
            );
        }
    }

    pub(super) fn of_lists(&mut self, file: &Path, trust: &Trust) {
        let (lists, listed) = (&trust.lists.lists, &trust.listed);
        let ca_key = self.files.protocol.ca_key();
        let authorities: Vec<_> =
            listed.iter().zip(1..).filter(|(each, _)| each.is_authority()).collect();
        for list in lists {
            let name = format!("revocation list {} ({})", list.number, name_text(list.issuer()));
            let named = || {
                let issued = |each: &&(&Listed, usize)| each.0.parsed.has_subject(list.issuer());
                authorities.iter().filter(issued)
            };
            // A certificate can be listed without its authority.
            let is_of_listed = |each: &Listed| each.parsed.has_issuer(list.issuer());
            let is_named = named().next().is_some();
            if !is_named && !listed.iter().any(is_of_listed) {
                self.add(file, &format!(
                    "{name} is not of an authority in {ca_key}: it applies only to clients that \
                     send its authority"
                ));
            }
            if is_named && !named().any(|(each, _)| list.is_signed_by(&each.parsed)) {
                let mut keys = named().map(|(each, _)| each.parsed.own_key());
                let flaw = match keys
                    .all(|key| list.is_of_another(key.as_ref(), &trust.authorities()))
                {
                    true => format!(
                        "is not signed by the authority of that name in {ca_key}: it does not count \
                         for the clients of that authority"
                    ),
                    false => format!(
                        "has a signature that can't be verified with the key of the authority of \
                         that name in {ca_key} (allowed: SHA-256, SHA-384 or SHA-512): the clients of \
                         that authority are refused, unless it has signed a newer list"
                    ),
                };
                self.add(file, &format!("{name} {flaw}"));
            }
            self.of_age(file, list, &name);
            let missing = list.missing();
            if !missing.is_empty() {
                let missing = missing.join(" and no ");
                self.add(file, &format!(
                    "{name} has no {missing} (RFC 5280, 5.2): Holdfast uses it, other programs may \
                     refuse it"
                ));
            }
        }
        for (each, number) in listed.iter().zip(1..).filter(|(each, _)| trust.is_revoked(each)) {
            let subject = each.parsed.subject_text();
            let outcome = outcome(each);
            self.add(
                file,
                &format!("certificate {number} of {ca_key} ({subject}) is revoked: {outcome}"),
            );
        }
        for (each, number) in authorities {
            if !lists.iter().any(|list| list.is_signed_by(&each.parsed)) {
                let subject = each.parsed.subject_text();
                self.add(file, &format!(
                    "found no list of certificate {number} of {ca_key} ({subject}): its clients are \
                     refused"
                ));
            }
        }
    }

    fn of_age(&mut self, file: &Path, list: &List, name: &str) {
        if let Some(ends) = list.ends()
            && self.now > ends
        {
            let ago = span(between(ends, self.now));
            self.add(
                file,
                &format!("{name} expired {ago} ago: clients of that authority are refused"),
            );
        }
        if self.now < list.begins() {
            let wait = span(between(self.now, list.begins()));
            self.add(file, &format!("{name} was issued {wait} in the future: check the clock"));
        }
    }

    fn add(&mut self, file: &Path, doubt: &str) {
        self.found.push(format!("{}: {doubt}", file.display()));
    }
}

/// What follows if a listed certificate can't be used.
fn outcome(listed: &Listed) -> &'static str {
    match listed.is_authority() {
        true => "its clients are refused",
        false => "this client is refused",
    }
}
