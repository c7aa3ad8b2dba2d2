//! What a device may do that the standard does not allow.

use core::time::Duration;

use super::echo::Echo;
use crate::pdu::EncodedRequest;

/// How to treat a device that deviates from the standard. The default follows the standard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tolerance {
    /// Unit ids that a reply may carry.
    pub accept_unit: AcceptUnit,
    /// Ignores surplus bytes at the end of a reply. Over TCP and UDP, an exception reply ends after its
    /// exception code whatever length its header has.
    pub pad: bool,
    /// Whether the adapter repeats what is sent.
    pub echo: Echo,
    /// Time between the end of a request and the next. Only one request is in flight then.
    pub pause: Duration,
    /// Time between connecting and the first request.
    pub pause_after_connect: Duration,
    /// How often a read is sent again after a timeout, an invalid reply or a lost connection. Each
    /// retry has the whole timeout.
    pub retries: u8,
    /// Counts exceptions 05 and 06 of a read as failures that [`Tolerance::retries`] covers.
    pub retry_busy: bool,
    /// Requests after which the connection ends; 0 for no limit. Only one request is in flight then.
    pub close_after: u32,
    /// Time between the end of a connection and the next attempt to connect. The driver keeps it.
    pub reconnect: Duration,
    /// Writes one coil with function 15 and one register with function 16, for a device without functions 5
    /// and 6. A request that is passed on as it came stays as it is.
    pub write_multiple: bool,
}

impl Tolerance {
    /// Whether a transport that can carry several requests at once carries one.
    pub const fn is_one_at_a_time(&self) -> bool {
        !self.pause.is_zero() || self.close_after > 0
    }

    /// The request to send instead of this one; `None` for this one.
    pub fn adapted(&self, request: &EncodedRequest) -> Option<EncodedRequest> {
        if self.write_multiple { request.as_multiple() } else { None }
    }
}

/// Unit ids that a reply may carry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AcceptUnit {
    /// That of the request.
    #[default]
    Requested,
    /// That of the request, or this one.
    Also(u8),
    /// Any.
    Any,
}

impl AcceptUnit {
    pub(super) fn accepts(self, requested: u8, found: u8) -> bool {
        match self {
            _ if found == requested => true,
            AcceptUnit::Requested => false,
            AcceptUnit::Also(unit_id) => found == unit_id,
            AcceptUnit::Any => true,
        }
    }
}
