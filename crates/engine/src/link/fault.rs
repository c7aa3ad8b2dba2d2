//! Why a request to a device failed.

use std::io::ErrorKind;
use std::sync::Arc;

use holdfast_protocol::client::InvalidResponse;
use holdfast_protocol::pdu::ExceptionCode;

use crate::client::ClientError;

/// Errors from this code on are not exceptions.
const NO_EXCEPTION: u16 = 0x8000;

/// Why a request or a poll failed, as in the status block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    Exception(u8),
    Timeout,
    Refused,
    /// There is no way to the host, or nothing has its name. Nothing was sent.
    Unreachable,
    Reset,
    Invalid,
    /// The device has no plan, so no request is sent.
    Unplanned,
    /// Memory refused the read or the status block.
    Unstored,
    /// A task of the device has panicked.
    Internal,
    /// The device sends so much without a request that it is left alone for a while.
    Flooded,
    /// Another node uses the device. Nothing was sent.
    Standby,
    /// A write that waited too long: its caller no longer expects it. Nothing was sent.
    Expired,
}

/// Exceptions of a gateway that could not reach the unit.
const UNREACHED: [u8; 2] = [0x0A, 0x0B];

impl Fault {
    /// Whether the device has answered, even if only with an exception.
    pub(crate) fn is_answer(self) -> bool {
        matches!(self, Fault::Exception(code) if !UNREACHED.contains(&code))
    }

    /// The code of the exception that a client of a gateway gets for it (V1.1b3, 7): that of the device,
    /// or whether its address or only the device could not be reached.
    pub(crate) fn exception(self, is_unreachable: bool) -> u8 {
        match self {
            Fault::Exception(code) => code,
            Fault::Standby => ExceptionCode::GatewayPathUnavailable.code(),
            _ if is_unreachable => ExceptionCode::GatewayPathUnavailable.code(),
            _ => ExceptionCode::GatewayTargetFailedToRespond.code(),
        }
    }

    pub const fn code(self) -> u16 {
        match self {
            Fault::Exception(code) => code as u16,
            Fault::Timeout => NO_EXCEPTION + 1,
            Fault::Refused => NO_EXCEPTION + 2,
            Fault::Reset => NO_EXCEPTION + 3,
            Fault::Invalid => NO_EXCEPTION + 4,
            Fault::Unplanned => NO_EXCEPTION + 5,
            Fault::Unstored => NO_EXCEPTION + 6,
            Fault::Internal => NO_EXCEPTION + 7,
            Fault::Flooded => NO_EXCEPTION + 8,
            Fault::Standby => NO_EXCEPTION + 9,
            Fault::Expired => NO_EXCEPTION + 10,
            Fault::Unreachable => NO_EXCEPTION + 11,
        }
    }
}

/// The PDU of an exception that answers a request.
pub(crate) fn exception(request: &[u8], code: u8) -> Vec<u8> {
    vec![request.first().copied().unwrap_or_default() | 0x80, code]
}

/// The PDU of a reply, empty after a broadcast; or the fault.
pub(crate) type Answer = Result<Vec<u8>, Fault>;

/// As [`Answer`], with the error.
pub(super) type Exchanged = Result<Vec<u8>, Arc<ClientError>>;

/// The error of requests that are not sent because of a flood.
pub(super) const FLOODED: ClientError = ClientError::Invalid(InvalidResponse::Flood);

/// The fault that a failed request counts as.
pub(super) fn fault(error: &ClientError) -> Fault {
    match error {
        ClientError::Exception(code) => Fault::Exception(*code),
        ClientError::Timeout(_)
        | ClientError::ConnectTimeout { .. }
        | ClientError::LookupTimeout { .. } => Fault::Timeout,
        ClientError::Connect { error, .. } if is_unreachable(error.kind()) => Fault::Unreachable,
        ClientError::Connect { .. } | ClientError::Tls { maybe_sent: false, .. } => Fault::Refused,
        ClientError::Invalid(InvalidResponse::Flood) => Fault::Flooded,
        ClientError::Invalid(_) => Fault::Invalid,
        ClientError::Fenced => Fault::Standby,
        ClientError::Expired => Fault::Expired,
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
            // A name, or a serial device.
            | ErrorKind::NotFound
    )
}

#[cfg(test)]
mod tests {
    use super::*;

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
            ErrorKind::NotFound,
        ] {
            assert_eq!(failed(kind), Fault::Unreachable, "{kind:?}");
        }
        for kind in [ErrorKind::ConnectionRefused, ErrorKind::PermissionDenied] {
            assert_eq!(failed(kind), Fault::Refused, "{kind:?}");
        }
        assert_eq!(Fault::Unreachable.code(), 0x800B);
    }
}
