//! What went wrong with TLS, in words for people.

use std::time::Duration;

use rustls::pki_types::UnixTime;
use rustls::{AlertDescription, CertificateError, Error, InvalidMessage};

/// Names of a certificate that are told.
const NAMES: usize = 4;

const DAY: u64 = 24 * 60 * 60;

/// Why a connection can't be, or go on.
pub fn words(error: &Error) -> String {
    match error {
        Error::InvalidCertificate(flaw) => certificate(flaw),
        Error::AlertReceived(alert) => refusal(*alert),
        Error::InvalidMessage(
            InvalidMessage::InvalidContentType
            | InvalidMessage::UnknownProtocolVersion
            | InvalidMessage::MessageTooLarge,
        ) => "the peer does not speak TLS".into(),
        Error::PeerIncompatible(_) => OTHER_TLS.into(),
        other => other.to_string(),
    }
}

const OTHER_TLS: &str = "the peer has no version or cipher suite of TLS that is ours, 1.2 or 1.3";

/// What is wrong with the certificate of the peer.
fn certificate(flaw: &CertificateError) -> String {
    match flaw {
        CertificateError::UnknownIssuer => {
            "the issuer of the certificate is unknown: it is none of those that are trusted".into()
        }
        CertificateError::ExpiredContext { time, not_after } => {
            format!("the certificate expired {} ago", span(*not_after, *time))
        }
        CertificateError::Expired => "the certificate expired".into(),
        CertificateError::NotValidYetContext { time, not_before } => {
            format!("the certificate is not valid for another {}", span(*time, *not_before))
        }
        CertificateError::NotValidForNameContext { expected, presented } => {
            let expected = expected.to_str();
            if presented.is_empty() {
                return format!("the certificate has no alternative name, allowed: {expected}");
            }
            format!("the certificate is for {}, not for '{expected}'", listing(presented))
        }
        CertificateError::InvalidPurpose | CertificateError::InvalidPurposeContext { .. } => {
            "the certificate is not one for servers".into()
        }
        CertificateError::BadEncoding => "the certificate can't be read".into(),
        CertificateError::BadSignature => "a signature of the certificate is wrong".into(),
        CertificateError::Other(other) => match other.0.downcast_ref() {
            Some(webpki::Error::CaUsedAsEndEntity) => {
                "the certificate is that of an authority: as a device's own it has to be one of \
                 those that are trusted"
                    .into()
            }
            Some(webpki::Error::UnsupportedCertVersion) => {
                "the certificate has an old form, allowed: X.509 version 3".into()
            }
            _ => format!("the certificate: {other}"),
        },
        other => format!("the certificate: {other}"),
    }
}

/// Why the peer ended the connection.
fn refusal(alert: AlertDescription) -> String {
    let of_certificate = match alert {
        AlertDescription::CertificateRequired => return "the peer asks for a certificate".into(),
        AlertDescription::HandshakeFailure => {
            return "the peer refused the handshake: it may ask for a certificate, or has no \
                    cipher suite that is ours"
                .into();
        }
        AlertDescription::ProtocolVersion | AlertDescription::InsufficientSecurity => {
            return OTHER_TLS.into();
        }
        AlertDescription::UnknownCA => "it does not know its issuer",
        AlertDescription::CertificateExpired => "expired",
        AlertDescription::CertificateRevoked => "revoked",
        AlertDescription::AccessDenied => "access denied",
        AlertDescription::UnsupportedCertificate => "of a kind that it does not take",
        AlertDescription::BadCertificate | AlertDescription::CertificateUnknown => "bad",
        other => return format!("the peer ended TLS with alert {other:?}"),
    };
    format!("the peer refused the certificate: {of_certificate}")
}

/// Names as webpki has them, without what they are and without what could be a control character.
fn listing(names: &[String]) -> String {
    let plain = |name: &String| {
        let text = name.strip_prefix("DnsName(\"").and_then(|rest| rest.strip_suffix("\")"));
        let text = text
            .or_else(|| name.strip_prefix("IpAddress(").and_then(|rest| rest.strip_suffix(')')));
        format!("'{}'", text.unwrap_or(name).escape_debug())
    };
    let mut listed: Vec<String> = names.iter().take(NAMES).map(plain).collect();
    if names.len() > NAMES {
        listed.push(format!("{} more", names.len() - NAMES));
    }
    listed.join(", ")
}

fn span(from: UnixTime, to: UnixTime) -> String {
    let seconds = Duration::from_secs(to.as_secs().saturating_sub(from.as_secs())).as_secs();
    if seconds < DAY { format!("{seconds} s") } else { format!("{} days", seconds / DAY) }
}

#[cfg(test)]
mod tests {
    use rustls::pki_types::ServerName;

    use super::*;

    #[test]
    fn names_are_listed_without_what_could_harm_a_terminal() {
        let told = |presented: &[&str]| {
            words(&Error::InvalidCertificate(CertificateError::NotValidForNameContext {
                expected: ServerName::try_from("10.0.0.5").unwrap(),
                presented: presented.iter().map(|name| (*name).to_owned()).collect(),
            }))
        };
        assert_eq!(
            told(&["DnsName(\"plc7\")", "IpAddress(10.0.0.7)"]),
            "the certificate is for 'plc7', '10.0.0.7', not for '10.0.0.5'"
        );
        assert_eq!(
            told(&["DnsName(\"\x1b[2J\n\")"]),
            "the certificate is for '\\u{1b}[2J\\n', not for '10.0.0.5'"
        );
        assert_eq!(
            told(&["DnsName(\"a\")"; 6]),
            "the certificate is for 'a', 'a', 'a', 'a', 2 more, not for '10.0.0.5'"
        );
        assert_eq!(told(&[]), "the certificate has no alternative name, allowed: 10.0.0.5");
    }
}
