//! Why a request to a device failed.

use std::io::ErrorKind;
use std::sync::Arc;

use holdfast_protocol::client::InvalidResponse;
use holdfast_protocol::pdu::{ExceptionCode, Function};

use crate::client::ClientError;

/// Errors from this code on are not exceptions.
const NO_EXCEPTION: u16 = 0x8000;

/// The code of exception 00, which some devices send. 0 is no fault.
const EXCEPTION_00: u16 = 0x0100;

/// Makes `Fault`: what is no exception has a number, and a word for people.
macro_rules! faults {
    ($($(#[$about:meta])* $fault:ident = $number:literal, $word:literal;)*) => {
        /// Why a request or a poll failed, as in the status block.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Fault {
            Exception(u8),
            $($(#[$about])* $fault,)*
        }

        impl Fault {
            /// All but exceptions, each with its word.
            pub const NAMED: &[(Fault, &str)] = &[$((Fault::$fault, $word)),*];

            /// Never 0, which means no fault.
            pub const fn code(self) -> u16 {
                match self {
                    Fault::Exception(0) => EXCEPTION_00,
                    Fault::Exception(code) => code as u16,
                    $(Fault::$fault => NO_EXCEPTION + $number,)*
                }
            }
        }
    };
}

faults! {
    Timeout = 1, "timeout";
    Refused = 2, "refused";
    Reset = 3, "reset";
    Invalid = 4, "invalid reply";
    /// The device has no plan, so no request is sent.
    Unplanned = 5, "no plan";
    /// Memory refused the read or the status block.
    Unstored = 6, "not stored";
    /// A task of the device has panicked.
    Internal = 7, "internal error";
    /// The device sends so much without a request that it is left alone for a while.
    Flooded = 8, "flooded";
    /// Another node uses the device. Nothing was sent.
    Standby = 9, "standby";
    /// A write that waited too long, or through a standstill: its caller may no longer expect it. Nothing was sent.
    Expired = 10, "expired";
    /// There is no way to the host, or nothing has its name. Nothing was sent.
    Unreachable = 11, "unreachable";
    /// A write whose device was removed or changed while it waited. Nothing was sent.
    Withdrawn = 12, "withdrawn";
}

/// Exceptions of a gateway that could not reach the unit.
const UNREACHED: [u8; 2] = [0x0A, 0x0B];

impl Fault {
    /// Whether the device has answered, even if only with an exception.
    pub(crate) fn is_answer(self) -> bool {
        matches!(self, Fault::Exception(code) if !UNREACHED.contains(&code))
    }
}

/// The code of the exception that a client of a gateway gets for an error (V1.1b3, 7): that of the device,
/// or that it could not be asked. After that one, clients send a write again: nothing was sent.
/// Any other error counts as a device that did not answer.
pub(crate) fn exception_code(error: &ClientError) -> u8 {
    match (error, fault(error)) {
        (_, Fault::Exception(code)) => code,
        (
            ClientError::NoSilence(_)
            | ClientError::ConnectTimeout { .. }
            | ClientError::LookupTimeout { .. },
            _,
        )
        | (_, Fault::Refused | Fault::Unreachable | Fault::Standby | Fault::Expired) => {
            ExceptionCode::GatewayPathUnavailable.code()
        }
        _ => ExceptionCode::GatewayTargetFailedToRespond.code(),
    }
}

/// The PDU of an exception that answers a request.
pub(crate) fn exception(request: &[u8], code: u8) -> Vec<u8> {
    vec![request.first().copied().unwrap_or_default() | 0x80, code]
}

/// The code of the exception that a reply is; `None` for any other reply.
#[inline]
pub(crate) fn exception_in(reply: &[u8]) -> Option<u8> {
    match reply {
        [code, exception, ..] if code & 0x80 != 0 => Some(*exception),
        _ => None,
    }
}

/// The PDU that confirms a write: it repeats the request, but not its values if it may have several
/// (V1.1b3, 6.11 and 6.12).
pub(crate) fn confirmation(request: &[u8]) -> &[u8] {
    match Function::from_pdu(request) {
        Some(Function::WriteMultipleCoils | Function::WriteMultipleRegisters) => &request[..5],
        _ => request,
    }
}

/// The PDU of a reply, empty after a broadcast; or the error.
pub(crate) type Exchanged = Result<Vec<u8>, Arc<ClientError>>;

/// The error of requests that are not sent because of a flood.
pub(super) const FLOODED: ClientError = ClientError::Invalid(InvalidResponse::Flood);

/// The fault that a failed request counts as.
pub(crate) fn fault(error: &ClientError) -> Fault {
    match error {
        ClientError::Exception(code) => Fault::Exception(*code),
        ClientError::Timeout(_)
        | ClientError::Incomplete(_)
        | ClientError::NoSilence(_)
        | ClientError::ConnectTimeout { .. }
        | ClientError::LookupTimeout { .. } => Fault::Timeout,
        ClientError::Connect { error, .. } if is_unreachable(error.kind()) => Fault::Unreachable,
        ClientError::Connect { .. } | ClientError::Tls { maybe_sent: false, .. } => Fault::Refused,
        ClientError::Invalid(InvalidResponse::Flood) => Fault::Flooded,
        ClientError::Invalid(_) => Fault::Invalid,
        ClientError::Fenced => Fault::Standby,
        ClientError::Expired | ClientError::Elsewhere => Fault::Expired,
        ClientError::Lost(_) | ClientError::Tls { .. } => Fault::Reset,
    }
}

/// Whether the connection failed on the way, so that no peer has refused it.
fn is_unreachable(why: ErrorKind) -> bool {
    matches!(
        why,
        ErrorKind::HostUnreachable
            | ErrorKind::NetworkUnreachable
            | ErrorKind::NetworkDown
            | ErrorKind::TimedOut
            // This machine has no free port.
            | ErrorKind::AddrNotAvailable
            // A name, or a serial device.
            | ErrorKind::NotFound
    )
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::time::Duration;

    use holdfast_protocol::client::Closed;

    use super::*;
    use crate::client::Lost;

    #[test]
    fn what_reaches_nobody_is_not_refused() {
        let failed = |kind: ErrorKind| {
            fault(&ClientError::Connect { to: "tcp://192.0.2.1:502".into(), error: kind.into() })
        };
        for kind in [
            ErrorKind::HostUnreachable,
            ErrorKind::NetworkUnreachable,
            ErrorKind::NetworkDown,
            ErrorKind::TimedOut,
            ErrorKind::AddrNotAvailable,
            ErrorKind::NotFound,
        ] {
            assert_eq!(failed(kind), Fault::Unreachable, "{kind:?}");
        }
        for kind in [ErrorKind::ConnectionRefused, ErrorKind::PermissionDenied] {
            assert_eq!(failed(kind), Fault::Refused, "{kind:?}");
        }
        assert_eq!(Fault::Unreachable.code(), 0x800B);
    }

    #[test]
    fn only_what_was_not_sent_is_a_path_that_is_not_available() {
        let to = String::from("tcp://192.0.2.1:502");
        let refused = ErrorKind::ConnectionRefused.into();
        for (error, code) in [
            (ClientError::Connect { to: to.clone(), error: refused }, 0x0A),
            (ClientError::ConnectTimeout { to, after: Duration::ZERO }, 0x0A),
            (ClientError::Fenced, 0x0A),
            (ClientError::Expired, 0x0A),
            (ClientError::NoSilence(Duration::ZERO), 0x0A),
            (ClientError::Timeout(Duration::ZERO), 0x0B),
            (ClientError::Lost(Lost::Closed(Closed::BySelf)), 0x0B),
            (FLOODED, 0x0B),
            (ClientError::Exception(4), 4),
        ] {
            assert_eq!(exception_code(&error), code, "{error}");
        }
    }

    #[test]
    fn every_exception_has_a_code_of_its_own_which_is_not_0() {
        let codes: BTreeSet<u16> =
            (0..=u8::MAX).map(|code| Fault::Exception(code).code()).collect();
        assert_eq!((codes.len(), codes.contains(&0)), (256, false));
        assert!(codes.iter().all(|code| *code < NO_EXCEPTION));
    }
}
