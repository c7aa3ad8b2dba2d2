//! Listen only mode (V1.1b3, 6.8.1, sub-function 04): the unit ignores requests and never replies, to any
//! peer of the listener, until a request restarts its communications, or a reload forbids the mode.

use std::sync::atomic::{AtomicBool, Ordering};

use holdfast_protocol::pdu::{ExceptionCode, Function, Request, SubFunction};

/// The units of one listener that are in listen only mode.
#[derive(Debug)]
pub(crate) struct ListenOnly {
    /// Whether peers may set units to it.
    is_allowed: AtomicBool,
    units: [AtomicBool; 256],
}

impl ListenOnly {
    pub(crate) fn new(is_allowed: bool) -> ListenOnly {
        let units = [const { AtomicBool::new(false) }; 256];
        ListenOnly { is_allowed: AtomicBool::new(is_allowed), units }
    }

    /// Returns the units whose mode this has ended: after a reload, perhaps no peer has the right to.
    pub(crate) fn set_allowed(&self, is_allowed: bool) -> Vec<u8> {
        self.is_allowed.store(is_allowed, Ordering::Relaxed);
        let ends = |unit_id: &u8| {
            !is_allowed && self.units[usize::from(*unit_id)].swap(false, Ordering::Relaxed)
        };
        (0..=u8::MAX).filter(ends).collect()
    }

    /// Whether a request would set a unit to listen only mode, and the listener does not allow that.
    #[inline]
    pub(crate) fn refuses(&self, request: &[u8]) -> bool {
        !self.is_allowed.load(Ordering::Relaxed)
            && asks_for(request, SubFunction::ForceListenOnlyMode)
    }

    #[inline]
    pub(crate) fn is_on(&self, unit_id: u8) -> bool {
        // A request may set the unit to it just when a reload forbids that.
        self.is_allowed.load(Ordering::Relaxed)
            && self.units[usize::from(unit_id)].load(Ordering::Relaxed)
    }

    pub(crate) fn begin(&self, unit_id: u8) {
        self.units[usize::from(unit_id)].store(true, Ordering::Relaxed);
    }

    /// Ends the mode if that is what a request to the unit asks for. Returns whether it is.
    pub(crate) fn end_by(&self, unit_id: u8, request: &Result<Request<'_>, ExceptionCode>) -> bool {
        let Ok(Request::Diagnostics(asked)) = request else { return false };
        let ends = asked.sub_function() == SubFunction::RestartCommunications;
        if ends {
            self.units[usize::from(unit_id)].store(false, Ordering::Relaxed);
        }
        ends
    }

    /// Whether a request that got no reply has ended the mode.
    pub(crate) fn was_ended_by(&self, unit_id: u8, request: &[u8]) -> bool {
        !self.is_on(unit_id) && asks_for(request, SubFunction::RestartCommunications)
    }
}

#[inline]
fn asks_for(request: &[u8], sub_function: SubFunction) -> bool {
    request.first() == Some(&Function::Diagnostics.code())
        && SubFunction::from_pdu(request) == Some(sub_function)
}
