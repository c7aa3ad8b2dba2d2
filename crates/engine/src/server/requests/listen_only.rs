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
        let was_allowed = self.is_allowed.load(Ordering::Relaxed);
        if is_allowed && was_allowed {
            return Vec::new();
        }
        self.is_allowed.store(false, Ordering::Relaxed);
        // Also before it is allowed again: a request may have set a unit to it just after it was forbidden.
        let ends = |unit_id: &u8| self.units[usize::from(*unit_id)].swap(false, Ordering::Relaxed);
        let ended = (0..=u8::MAX).filter(ends).collect();
        self.is_allowed.store(is_allowed, Ordering::Relaxed);
        ended
    }

    /// Whether a request would set a unit to listen only mode, and the listener does not allow that.
    #[inline]
    pub(crate) fn refuses(&self, request: &[u8]) -> bool {
        asks_for(request, SubFunction::ForceListenOnlyMode)
            && !self.is_allowed.load(Ordering::Relaxed)
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
        let Ok(Request::Diagnostics(query)) = request else { return false };
        let ends = query.sub_function() == SubFunction::RestartCommunications;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_unit_that_was_set_to_it_too_late_answers_when_it_is_allowed_again() {
        let listen_only = ListenOnly::new(true);
        listen_only.begin(1);
        assert_eq!(listen_only.set_allowed(true), []);
        assert!(listen_only.is_on(1));
        assert_eq!(listen_only.set_allowed(false), [1]);
        // A request that was let pass before.
        listen_only.begin(2);
        assert_eq!(listen_only.set_allowed(true), [2]);
        assert!(!listen_only.is_on(2));
    }
}
