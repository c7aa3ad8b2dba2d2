//! Modbus requests that a listener refuses because of rights, or because a memory is sealed: what
//! the log has of them.

use std::sync::atomic::{AtomicU8, Ordering};

use holdfast_memory::Memory;
use holdfast_protocol::pdu::ExceptionCode;

use crate::link::exception_in;
use crate::server::rights::functions::is_write;
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::rule::RequestDestination;

/// A refused request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct RefusedRequest {
    pub unit_id: u8,
    pub function_code: u8,
    pub why: Why,
}

/// Why a request was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Why {
    /// The function is not known, or not allowed for the peer.
    Function,
    /// The peer does not have the unit.
    Unit,
    /// An address does not exist, or the peer may not use it.
    Address,
    /// A write to a memory that is sealed.
    Sealed,
}

impl Why {
    /// The name of the event.
    pub const fn name(self) -> &'static str {
        match self {
            Why::Function => "refused_function",
            Why::Unit => "refused_unit",
            Why::Address => "refused_address",
            Why::Sealed => "refused_sealed",
        }
    }
}

impl RefusedRequest {
    /// The refusal that a memory's reply to a request is; `None` for any other reply.
    #[inline]
    pub(crate) fn from_reply(
        rights: &PeerRights,
        unit_id: u8,
        request: &[u8],
        reply: &[u8],
    ) -> Option<RefusedRequest> {
        let code = ExceptionCode::from_code(exception_in(reply)?)?;
        let why = match code {
            ExceptionCode::ServerDeviceBusy if is_write(request) => Why::Sealed,
            // If the unit has a memory, the mirrored device does not answer: that is no refusal.
            ExceptionCode::GatewayTargetFailedToRespond if rights.memory(unit_id).is_none() => {
                Why::Unit
            }
            _ => return RefusedRequest::from_exception(unit_id, request, code),
        };
        Some(RefusedRequest::new(unit_id, request, why))
    }

    /// The refusal of a request that was rejected before it was sent on. `None` if it was sent, or failed
    /// for another reason, such as a full queue.
    pub(crate) fn before_sending<T>(
        destination: &RequestDestination,
        unit_id: u8,
        request: &[u8],
        sent: &Result<T, ExceptionCode>,
    ) -> Option<RefusedRequest> {
        match *sent.as_ref().err()? {
            // A full queue and a log that can't be used have the same exception.
            ExceptionCode::ServerDeviceBusy if destination.memory().is_some_and(Memory::sealed) => {
                Some(RefusedRequest::new(unit_id, request, Why::Sealed))
            }
            // Devices on a line could find another request in it, with a function that the peer may not use.
            ExceptionCode::IllegalDataValue
                if matches!(destination, RequestDestination::Device(_)) =>
            {
                Some(RefusedRequest::new(unit_id, request, Why::Function))
            }
            code => RefusedRequest::from_exception(unit_id, request, code),
        }
    }

    fn from_exception(unit_id: u8, request: &[u8], code: ExceptionCode) -> Option<RefusedRequest> {
        let why = match code {
            ExceptionCode::IllegalFunction => Why::Function,
            ExceptionCode::IllegalDataAddress => Why::Address,
            _ => return None,
        };
        Some(RefusedRequest::new(unit_id, request, why))
    }

    fn new(unit_id: u8, request: &[u8], why: Why) -> RefusedRequest {
        let function_code = request.first().copied().unwrap_or_default();
        RefusedRequest { unit_id, function_code, why }
    }
}

/// The reasons that were reported for a connection or line: each is reported once.
#[derive(Debug, Default)]
pub(crate) struct Reported(AtomicU8);

impl Reported {
    /// Marks the reason of a refusal as reported. Returns whether it was the first.
    pub(crate) fn mark(&self, refused: &RefusedRequest) -> bool {
        let bit = 1 << refused.why as u8;
        self.0.fetch_or(bit, Ordering::Relaxed) & bit == 0
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use holdfast_memory::{Area, Gate, GateMode, Layout, Memory, Span};

    use super::*;
    use crate::server::rights::functions::{AccessMode, Functions};
    use crate::server::rights::rule::Rule;

    const READ: [u8; 5] = [3, 0, 0, 0, 1];
    const WRITE: [u8; 5] = [6, 0, 0, 0, 1];

    fn why(request: &[u8], reply: &[u8]) -> Option<Why> {
        RefusedRequest::from_reply(&PeerRights::none(), 1, request, reply)
            .map(|refused| refused.why)
    }

    #[test]
    fn a_unit_whose_memory_is_stale_is_not_refused_for_rights() {
        let memory = Memory::new(Layout::default(), None).unwrap();
        let rights = PeerRights::new(&Rule {
            sources: Vec::new(),
            roles: None,
            units: vec![(1, Arc::new(memory))],
            destinations: Vec::new(),
            access: AccessMode::ReadWrite,
            functions: Functions::All,
            narrowed: Vec::new(),
        });
        for (unit_id, expected) in [(1, None), (2, Some(Why::Unit))] {
            let refused = RefusedRequest::from_reply(&rights, unit_id, &READ, &[0x83, 0x0B]);
            assert_eq!(refused.map(|refused| refused.why), expected);
        }
    }

    #[test]
    fn a_refusal_has_the_reason_of_its_exception() {
        assert_eq!(why(&WRITE, &[0x86, 1]), Some(Why::Function));
        assert_eq!(why(&READ, &[0x83, 2]), Some(Why::Address));
        assert_eq!(why(&WRITE, &[0x86, 6]), Some(Why::Sealed));
        assert_eq!(why(&READ, &[0x83, 0x0B]), Some(Why::Unit));
    }

    #[test]
    fn a_busy_journal_is_refused_as_sealed_only_if_its_memory_is() {
        let layout = Layout::default().with(Area::Coils, Span::new(0, 1).unwrap());
        let gate = Gate { area: Area::Coils, address: 0, mode: GateMode::Once };
        let refused = |gate, code| {
            let destination =
                RequestDestination::Journal(Arc::new(Memory::new(layout.clone(), gate).unwrap()));
            let refused = RefusedRequest::before_sending::<()>(&destination, 1, &WRITE, &Err(code));
            refused.map(|refused| refused.why)
        };
        let busy = ExceptionCode::ServerDeviceBusy;
        assert_eq!(refused(Some(gate), busy), Some(Why::Sealed));
        assert_eq!(refused(None, busy), None);
        assert_eq!(refused(Some(gate), ExceptionCode::IllegalFunction), Some(Why::Function));
    }

    #[test]
    fn other_replies_are_no_refusal() {
        // A sealed memory is read again and again until it is opened.
        for (request, reply) in [(READ, [0x83, 6]), (READ, [0x83, 3]), (WRITE, [0x86, 4])] {
            assert_eq!(why(&request, &reply), None);
        }
        assert_eq!(why(&WRITE, &WRITE), None);
        assert_eq!(why(&WRITE, &[]), None);
    }

    #[test]
    fn each_reason_is_reported_once() {
        let reported = Reported::default();
        let refused = |why| RefusedRequest { unit_id: 1, function_code: 6, why };
        for why in [Why::Function, Why::Unit, Why::Address, Why::Sealed] {
            assert!(reported.mark(&refused(why)));
            assert!(!reported.mark(&refused(why)));
        }
    }
}
