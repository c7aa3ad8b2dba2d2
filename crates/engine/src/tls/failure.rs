//! Why TLS failed: one variant per cause, for servers and clients alike. [`TlsFailure::reason`] is
//! for programs and [`Display`](std::fmt::Display) for people; neither depends on the other.

use std::time::Duration;

use rustls::pki_types::UnixTime;
use rustls::{
    AlertDescription, CertificateError, Error, ExtendedKeyPurpose, InvalidMessage, PeerMisbehaved,
};
use thiserror::Error as ThisError;

/// The most names of a certificate in a message.
const MAX_NAMES: usize = 4;

const DAY: u64 = 24 * 60 * 60;

/// Makes `TlsFailure`: its causes with their words, and the list of all words.
macro_rules! failures {
    ($($(#[$about:meta])* $cause:ident $({ $($field:ident: $type:ty),+ })? => $word:literal,)+) => {
        /// Why TLS failed, during the handshake or later.
        ///
        /// Texts from a certificate are escaped in messages, so that they cannot harm a terminal or a log.
        ///
        /// ```
        /// use holdfast_engine::tls::TlsFailure;
        /// use rustls::{AlertDescription, Error};
        ///
        /// let failure = TlsFailure::from(&Error::AlertReceived(AlertDescription::UnknownCA));
        /// assert_eq!(failure.reason(), "peer_refused_certificate");
        /// assert_eq!(
        ///     failure.to_string(),
        ///     "the peer refused the certificate: unknown issuer"
        /// );
        /// ```
        #[derive(Debug, Clone, PartialEq, Eq, ThisError)]
        #[non_exhaustive]
        pub enum TlsFailure {
            $($(#[$about])* $cause $({ $($field: $type),+ })?,)+
        }

        impl TlsFailure {
            /// All words of [`reason`](TlsFailure::reason).
            pub const REASONS: &[&str] = &[$($word),+];

            /// The cause as a word for programs, for errors and log events. It does not change when
            /// messages change.
            pub const fn reason(&self) -> &'static str {
                match self { $(TlsFailure::$cause { .. } => $word,)+ }
            }
        }
    };
}

failures! {
    /// Neither the certificate nor an authority above it is trusted.
    #[error(
        "the issuer of the certificate is unknown: neither the certificate nor an authority above \
         it is trusted"
    )]
    UnknownIssuer => "unknown_issuer",
    #[error("the certificate expired {} ago", span(*.ago))]
    Expired { ago: Duration } => "expired",
    #[error("the certificate is not valid yet: its validity begins in {}", span(*.begins_in))]
    NotYetValid { begins_in: Duration } => "not_yet_valid",
    /// An authority above the certificate, trusted or sent by the peer, has expired.
    #[error("an authority above the certificate expired {} ago", span(*.ago))]
    IssuerExpired { ago: Duration } => "issuer_expired",
    #[error(
        "an authority above the certificate is not valid yet: its validity begins in {}",
        span(*.begins_in)
    )]
    IssuerNotYetValid { begins_in: Duration } => "issuer_not_yet_valid",
    /// The names are not escaped.
    #[error("{}", wrong_name(.expected, .presented))]
    WrongName { expected: String, presented: Vec<String> } => "wrong_name",
    /// `required` is `serverAuth` or `clientAuth`.
    #[error("the certificate is for other purposes: its extendedKeyUsage lacks {required}")]
    WrongPurpose { required: &'static str } => "wrong_purpose",
    #[error("the certificate, or an authority above it, is revoked")]
    Revoked => "revoked",
    #[error("an authority above the certificate has no valid revocation list")]
    UnknownRevocation => "unknown_revocation",
    /// The `nextUpdate` of a revocation list has passed.
    #[error("a revocation list of an authority above the certificate expired {} ago", span(*.ago))]
    ExpiredRevocationList { ago: Duration } => "expired_revocation_list",
    /// The signature of a certificate is invalid; or that of the handshake, when the peer does not
    /// hold the key of its certificate.
    #[error("the signature of the certificate, or of the handshake, is invalid")]
    BadSignature => "bad_signature",
    /// It is not an X.509 certificate.
    #[error("the certificate can't be read")]
    BadCertificate => "bad_certificate",
    #[error("the certificate has more than one role")]
    TwoRoles => "two_roles",
    #[error("the role of the certificate is not a UTF8String of up to 255 bytes")]
    RoleType => "role_type",
    /// It is not among the allowed roles.
    #[error("the role {role:?} of the certificate is not allowed")]
    WrongRole { role: String } => "wrong_role",
    /// The key of the certificate is for other purposes than signing handshakes.
    #[error("the keyUsage of the certificate lacks digitalSignature")]
    WrongKeyUsage => "wrong_key_usage",
    #[error("the certificate has a critical extension that is not supported")]
    UnsupportedExtension => "unsupported_extension",
    /// Its version, key or signature is not supported.
    #[error("the certificate is not supported: {flaw}")]
    UnsupportedCertificate { flaw: String } => "unsupported_certificate",
    /// The certificate has `CA:TRUE` and is not listed itself.
    #[error(
        "the peer presented a CA certificate (CA:TRUE); list that exact certificate in `ca`, or \
         issue one with CA:FALSE"
    )]
    CaAsEndEntity => "ca_as_end_entity",
    /// A certificate above that of the peer cannot sign others.
    #[error("a certificate above that of the peer is not an authority (CA:TRUE, keyCertSign)")]
    IssuerNotAuthority => "issuer_not_authority",
    /// The certificate violates a constraint of an authority, such as `pathLenConstraint`.
    #[error("the certificate violates a constraint of an authority above it: {constraint}")]
    ConstraintViolated { constraint: &'static str } => "constraint_violated",
    #[error("the certificate is not accepted: {flaw}")]
    UntrustedCertificate { flaw: String } => "untrusted_certificate",
    #[error("the peer presented no certificate")]
    NoCertificate => "no_certificate",
    #[error("the peer requires a certificate")]
    PeerRequiresCertificate => "peer_requires_certificate",
    #[error("the peer refused the certificate: {}", refusal(*.alert))]
    PeerRefusedCertificate { alert: AlertDescription } => "peer_refused_certificate",
    /// The alert has several causes.
    #[error(
        "the peer refused the handshake: it may require a certificate, or have no cipher suite in \
         common"
    )]
    PeerRefusedHandshake => "peer_refused_handshake",
    #[error("the peer ended TLS with alert {alert:?}")]
    PeerEnded { alert: AlertDescription } => "peer_ended",
    /// With `by_peer`, the peer reported it by an alert.
    #[error("no TLS version or cipher suite in common; supported: TLS 1.2 and 1.3")]
    NoCommonVersionOrCipher { by_peer: bool } => "no_common_version_or_cipher",
    #[error("the peer does not speak TLS")]
    NotTls => "not_tls",
    #[error("a malformed TLS message: {flaw}")]
    MalformedMessage { flaw: String } => "malformed_message",
    #[error("the peer closed the connection during the TLS handshake")]
    ClosedDuringHandshake => "closed_during_handshake",
    /// When a peer refuses a certificate and resets the connection, its alert is lost.
    #[error("the peer closed the connection before any reply; it may have refused the certificate")]
    ClosedBeforeReply => "closed_before_reply",
    #[error("a TLS record was modified in transit")]
    BadRecord => "bad_record",
    #[error("{text}")]
    Other { text: String } => "other",
}

impl TlsFailure {
    /// Whether the peer has not accepted the handshake, even if this side has. Then it has not
    /// carried out any request.
    pub const fn refuses_connection(&self) -> bool {
        matches!(
            self,
            TlsFailure::PeerRequiresCertificate
                | TlsFailure::PeerRefusedCertificate { .. }
                | TlsFailure::PeerRefusedHandshake
                | TlsFailure::NoCommonVersionOrCipher { .. }
                | TlsFailure::ClosedDuringHandshake
        )
    }
}

impl From<&Error> for TlsFailure {
    fn from(error: &Error) -> TlsFailure {
        match error {
            Error::InvalidCertificate(flaw) => from_certificate_error(flaw),
            Error::NoCertificatesPresented => TlsFailure::NoCertificate,
            Error::AlertReceived(alert) => from_alert(*alert),
            Error::InvalidMessage(
                InvalidMessage::InvalidContentType
                | InvalidMessage::UnknownProtocolVersion
                | InvalidMessage::MessageTooLarge,
            ) => TlsFailure::NotTls,
            Error::InvalidMessage(flaw) => {
                TlsFailure::MalformedMessage { flaw: escaped(&format!("{flaw:?}")) }
            }
            Error::PeerIncompatible(_) => TlsFailure::NoCommonVersionOrCipher { by_peer: false },
            Error::PeerMisbehaved(PeerMisbehaved::SignedKxWithWrongAlgorithm) => {
                let flaw = "its key signed TLS 1.2 with an algorithm that is not of its cipher \
                            suite; RSA-PSS keys require TLS 1.3";
                TlsFailure::UnsupportedCertificate { flaw: flaw.into() }
            }
            Error::DecryptError => TlsFailure::BadRecord,
            other => TlsFailure::Other { text: escaped(&other.to_string()) },
        }
    }
}

impl From<Error> for TlsFailure {
    fn from(error: Error) -> TlsFailure {
        TlsFailure::from(&error)
    }
}

fn from_certificate_error(flaw: &CertificateError) -> TlsFailure {
    match flaw {
        CertificateError::UnknownIssuer => TlsFailure::UnknownIssuer,
        CertificateError::ExpiredContext { time, not_after } => {
            TlsFailure::Expired { ago: between(*not_after, *time) }
        }
        CertificateError::NotValidYetContext { time, not_before } => {
            TlsFailure::NotYetValid { begins_in: between(*time, *not_before) }
        }
        CertificateError::NotValidForNameContext { expected, presented } => {
            let presented = presented.iter().map(|name| without_kind(name).to_owned()).collect();
            TlsFailure::WrongName { expected: expected.to_str().into_owned(), presented }
        }
        CertificateError::InvalidPurposeContext {
            required: ExtendedKeyPurpose::ServerAuth,
            ..
        } => TlsFailure::WrongPurpose { required: "serverAuth" },
        CertificateError::InvalidPurposeContext {
            required: ExtendedKeyPurpose::ClientAuth,
            ..
        } => TlsFailure::WrongPurpose { required: "clientAuth" },
        CertificateError::Revoked => TlsFailure::Revoked,
        CertificateError::UnknownRevocationStatus => TlsFailure::UnknownRevocation,
        CertificateError::BadSignature => TlsFailure::BadSignature,
        CertificateError::BadEncoding => TlsFailure::BadCertificate,
        CertificateError::UnhandledCriticalExtension => TlsFailure::UnsupportedExtension,
        CertificateError::Other(other) => match other.0.downcast_ref::<TlsFailure>() {
            Some(failure) => failure.clone(),
            None => untrusted(flaw),
        },
        _ => untrusted(flaw),
    }
}

fn untrusted(flaw: &CertificateError) -> TlsFailure {
    TlsFailure::UntrustedCertificate { flaw: escaped(&flaw.to_string()) }
}

fn from_alert(alert: AlertDescription) -> TlsFailure {
    match alert {
        AlertDescription::CertificateRequired => TlsFailure::PeerRequiresCertificate,
        AlertDescription::HandshakeFailure => TlsFailure::PeerRefusedHandshake,
        AlertDescription::ProtocolVersion | AlertDescription::InsufficientSecurity => {
            TlsFailure::NoCommonVersionOrCipher { by_peer: true }
        }
        AlertDescription::UnknownCA
        | AlertDescription::CertificateExpired
        | AlertDescription::CertificateRevoked
        | AlertDescription::AccessDenied
        | AlertDescription::UnsupportedCertificate
        | AlertDescription::BadCertificate
        | AlertDescription::CertificateUnknown => TlsFailure::PeerRefusedCertificate { alert },
        alert => TlsFailure::PeerEnded { alert },
    }
}

/// Why the peer refused the certificate, according to its alert.
fn refusal(alert: AlertDescription) -> &'static str {
    match alert {
        AlertDescription::UnknownCA => "unknown issuer",
        AlertDescription::CertificateExpired => "expired",
        AlertDescription::CertificateRevoked => "revoked",
        AlertDescription::AccessDenied => "access denied",
        AlertDescription::UnsupportedCertificate => "unsupported",
        AlertDescription::CertificateUnknown => "no reason given",
        _ => "bad",
    }
}

fn wrong_name(expected: &str, presented: &[String]) -> String {
    let expected = escaped(expected);
    if presented.is_empty() {
        return format!("the certificate has no alternative name: it is not for '{expected}'");
    }
    let mut listed: Vec<String> =
        presented.iter().take(MAX_NAMES).map(|name| format!("'{}'", escaped(name))).collect();
    if presented.len() > MAX_NAMES {
        listed.push(format!("{} more", presented.len() - MAX_NAMES));
    }
    format!("the certificate is for {}, not for '{expected}'", listed.join(", "))
}

/// Removes the wrapper that webpki adds, as in `DnsName("plc7")`.
fn without_kind(name: &str) -> &str {
    let text = name.strip_prefix("DnsName(\"").and_then(|rest| rest.strip_suffix("\")"));
    let text =
        text.or_else(|| name.strip_prefix("IpAddress(").and_then(|rest| rest.strip_suffix(')')));
    text.unwrap_or(name)
}

/// Escapes control characters.
fn escaped(text: &str) -> String {
    text.escape_debug().to_string()
}

pub(super) fn between(from: UnixTime, to: UnixTime) -> Duration {
    Duration::from_secs(to.as_secs().saturating_sub(from.as_secs()))
}

pub(super) fn span(time: Duration) -> String {
    let seconds = time.as_secs();
    if seconds < DAY { format!("{seconds} s") } else { format!("{} days", seconds / DAY) }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::sync::Arc;

    use rustls::OtherError;
    use rustls::pki_types::ServerName;

    use super::*;

    fn wrong_names(presented: &[&str]) -> TlsFailure {
        TlsFailure::from(Error::from(CertificateError::NotValidForNameContext {
            expected: ServerName::try_from("10.0.0.5").unwrap(),
            presented: presented.iter().map(|name| (*name).to_owned()).collect(),
        }))
    }

    #[test]
    fn names_are_listed_with_control_characters_escaped() {
        let message = |presented: &[&str]| wrong_names(presented).to_string();
        assert_eq!(
            message(&["DnsName(\"plc7\")", "IpAddress(10.0.0.7)"]),
            "the certificate is for 'plc7', '10.0.0.7', not for '10.0.0.5'"
        );
        assert_eq!(
            message(&["DnsName(\"\x1b[2J\n\")"]),
            "the certificate is for '\\u{1b}[2J\\n', not for '10.0.0.5'"
        );
        assert_eq!(
            message(&["DnsName(\"a\")"; 6]),
            "the certificate is for 'a', 'a', 'a', 'a', 2 more, not for '10.0.0.5'"
        );
        assert_eq!(
            message(&[]),
            "the certificate has no alternative name: it is not for '10.0.0.5'"
        );
        let names = wrong_names(&["DnsName(\"plc7\")"]);
        let TlsFailure::WrongName { expected, presented } = names else { panic!("{names:?}") };
        assert_eq!((expected.as_str(), presented), ("10.0.0.5", vec!["plc7".to_owned()]));
    }

    #[test]
    fn text_from_a_peer_cannot_harm_a_terminal() {
        let harmful = Error::General("\x1b[2J\r\n".into());
        assert_eq!(TlsFailure::from(harmful).to_string(), "unexpected error: \\u{1b}[2J\\r\\n");
    }

    #[test]
    fn a_failure_carried_through_rustls_is_unchanged() {
        let failure = TlsFailure::CaAsEndEntity;
        let carried = CertificateError::Other(OtherError(Arc::new(failure.clone())));
        assert_eq!(TlsFailure::from(Error::from(carried)), failure);
    }

    #[test]
    fn every_cause_has_its_own_reason_and_text() {
        let (ago, begins_in) = (Duration::from_secs(59), Duration::from_secs(3 * DAY));
        let (flaw, alert) = (String::from("flaw"), AlertDescription::UnknownCA);
        let causes = [
            TlsFailure::UnknownIssuer,
            TlsFailure::Expired { ago },
            TlsFailure::NotYetValid { begins_in },
            TlsFailure::IssuerExpired { ago },
            TlsFailure::IssuerNotYetValid { begins_in },
            TlsFailure::WrongName { expected: "a".into(), presented: Vec::new() },
            TlsFailure::WrongPurpose { required: "serverAuth" },
            TlsFailure::Revoked,
            TlsFailure::UnknownRevocation,
            TlsFailure::ExpiredRevocationList { ago },
            TlsFailure::BadSignature,
            TlsFailure::BadCertificate,
            TlsFailure::TwoRoles,
            TlsFailure::RoleType,
            TlsFailure::WrongRole { role: "engineer".into() },
            TlsFailure::WrongKeyUsage,
            TlsFailure::UnsupportedExtension,
            TlsFailure::UnsupportedCertificate { flaw: flaw.clone() },
            TlsFailure::CaAsEndEntity,
            TlsFailure::IssuerNotAuthority,
            TlsFailure::ConstraintViolated { constraint: "pathLenConstraint" },
            TlsFailure::UntrustedCertificate { flaw: flaw.clone() },
            TlsFailure::NoCertificate,
            TlsFailure::PeerRequiresCertificate,
            TlsFailure::PeerRefusedCertificate { alert },
            TlsFailure::PeerRefusedHandshake,
            TlsFailure::PeerEnded { alert },
            TlsFailure::NoCommonVersionOrCipher { by_peer: false },
            TlsFailure::NotTls,
            TlsFailure::MalformedMessage { flaw },
            TlsFailure::ClosedDuringHandshake,
            TlsFailure::ClosedBeforeReply,
            TlsFailure::BadRecord,
            TlsFailure::Other { text: "text".into() },
        ];
        let words: HashSet<&str> = causes.iter().map(TlsFailure::reason).collect();
        let texts: HashSet<String> = causes.iter().map(TlsFailure::to_string).collect();
        assert_eq!((words.len(), texts.len()), (causes.len(), causes.len()));
        assert_eq!(words, TlsFailure::REASONS.iter().copied().collect());
        assert!(texts.contains("the certificate expired 59 s ago"));
        assert!(texts.contains("the certificate is not valid yet: its validity begins in 3 days"));
    }

    #[test]
    fn alerts_of_the_peer_and_failures_found_here_have_reasons() {
        let message = |error: Error| TlsFailure::from(error).reason();
        let required = Error::AlertReceived(AlertDescription::CertificateRequired);
        assert_eq!(message(required), "peer_requires_certificate");
        assert_eq!(message(InvalidMessage::InvalidContentType.into()), "not_tls");
        assert_eq!(message(InvalidMessage::UnexpectedMessage("hello").into()), "malformed_message");
        assert_eq!(message(Error::DecryptError), "bad_record");
        assert_eq!(message(Error::HandshakeNotComplete), "other");
        let [here, there] = [
            TlsFailure::from(Error::from(rustls::PeerIncompatible::NoCipherSuitesInCommon)),
            TlsFailure::from(Error::AlertReceived(AlertDescription::ProtocolVersion)),
        ];
        assert_eq!(here, TlsFailure::NoCommonVersionOrCipher { by_peer: false });
        assert_eq!(there, TlsFailure::NoCommonVersionOrCipher { by_peer: true });
        assert_eq!(here.reason(), there.reason());
    }
}
