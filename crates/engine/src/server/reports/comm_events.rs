//! The events of a listener that function 12 reads, Get Comm Event Log (V1.1b3, 6.10): one byte for each
//! request that has come, and one when it has been dealt with.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use holdfast_protocol::pdu::{ExceptionCode, limit};
use holdfast_runtime::lock;

/// How many events are kept: as many as a reply has.
const KEPT: usize = limit::LOG_EVENTS as usize;

/// Initiated Communication Restart.
const RESTARTED: u8 = 0x00;
/// Entered Listen Only Mode.
const SILENCED: u8 = 0x04;
/// A request or its end while the unit is in listen only mode.
const LISTENS_ONLY: u8 = 0x20;
const SENT: u8 = 0x40;
const RECEIVED: u8 = 0x80;
/// A frame that came with an error.
const ERROR: u8 = 0x02;
const BROADCAST: u8 = 0x40;

/// What has come in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Received {
    /// A request to a unit, which may be in listen only mode.
    Request {
        silent: bool,
    },
    Broadcast,
    /// A frame that is not a request.
    Error,
}

/// The latest events. Nothing is kept, and nothing locked, while the log is off.
#[derive(Debug)]
pub(crate) struct CommEvents {
    is_on: AtomicBool,
    /// The latest first.
    kept: Mutex<VecDeque<u8>>,
}

impl CommEvents {
    pub(crate) fn new(is_on: bool) -> CommEvents {
        CommEvents { is_on: AtomicBool::new(is_on), kept: Mutex::default() }
    }

    /// Turned off, it forgets its events.
    pub(crate) fn set(&self, is_on: bool) {
        self.is_on.store(is_on, Ordering::Relaxed);
        if !is_on {
            lock(&self.kept).clear();
        }
    }

    #[inline]
    pub(crate) fn is_on(&self) -> bool {
        self.is_on.load(Ordering::Relaxed)
    }

    #[inline]
    pub(crate) fn receive(&self, received: Received) {
        if self.is_on() {
            self.add(match received {
                Received::Request { silent } => RECEIVED | silenced(silent),
                Received::Broadcast => RECEIVED | BROADCAST,
                Received::Error => RECEIVED | ERROR,
            });
        }
    }

    /// A request has been dealt with: a reply was sent, an exception, or nothing.
    #[inline]
    pub(crate) fn send(&self, exception: Option<ExceptionCode>, silent: bool) {
        if self.is_on() {
            self.add(SENT | silenced(silent) | exception.map_or(0, bit_of));
        }
    }

    pub(crate) fn silence(&self) {
        self.add(SILENCED);
    }

    /// Communications were restarted, with or without the events before.
    pub(crate) fn restart(&self, forgets: bool) {
        let mut kept = lock(&self.kept);
        if forgets {
            kept.clear();
        }
        push(&mut kept, RESTARTED);
    }

    /// The events, the latest first.
    pub(crate) fn latest(&self) -> Vec<u8> {
        lock(&self.kept).iter().copied().collect()
    }

    #[cold]
    #[inline(never)]
    fn add(&self, event: u8) {
        push(&mut lock(&self.kept), event);
    }
}

fn push(kept: &mut VecDeque<u8>, event: u8) {
    kept.truncate(KEPT - 1);
    kept.push_front(event);
}

fn silenced(silent: bool) -> u8 {
    if silent { LISTENS_ONLY } else { 0 }
}

/// The bit of an exception. The standard has none for those of gateways.
fn bit_of(exception: ExceptionCode) -> u8 {
    match exception.code() {
        1..=3 => 0x01,
        4 => 0x02,
        5 | 6 => 0x04,
        7 => 0x08,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_event_has_the_byte_of_the_standard() {
        let events = CommEvents::new(true);
        events.receive(Received::Request { silent: false });
        events.receive(Received::Request { silent: true });
        events.receive(Received::Broadcast);
        events.receive(Received::Error);
        events.silence();
        events.send(None, false);
        events.send(None, true);
        assert_eq!(events.latest(), [0x60, 0x40, 0x04, 0x82, 0xC0, 0xA0, 0x80]);
    }

    #[test]
    fn an_exception_has_the_bit_of_its_kind() {
        let cases = [
            (ExceptionCode::IllegalFunction, 0x41),
            (ExceptionCode::IllegalDataAddress, 0x41),
            (ExceptionCode::IllegalDataValue, 0x41),
            (ExceptionCode::ServerDeviceFailure, 0x42),
            (ExceptionCode::Acknowledge, 0x44),
            (ExceptionCode::ServerDeviceBusy, 0x44),
            (ExceptionCode::GatewayTargetFailedToRespond, 0x40),
        ];
        for (exception, expected) in cases {
            let events = CommEvents::new(true);
            events.send(Some(exception), false);
            assert_eq!(events.latest(), [expected], "{exception}");
        }
    }

    #[test]
    fn the_latest_64_events_are_kept() {
        let events = CommEvents::new(true);
        for _ in 0..KEPT {
            events.receive(Received::Error);
        }
        events.silence();
        let found = events.latest();
        assert_eq!((found.len(), found[0]), (KEPT, 0x04));
        assert!(found[1..].iter().all(|event| *event == 0x82));
    }

    #[test]
    fn a_restart_may_forget_what_was_before() {
        for (forgets, expected) in [(false, &[0x00, 0x82][..]), (true, &[0x00])] {
            let events = CommEvents::new(true);
            events.receive(Received::Error);
            events.restart(forgets);
            assert_eq!(events.latest(), expected);
        }
    }

    #[test]
    fn nothing_is_kept_while_the_log_is_off() {
        let events = CommEvents::new(false);
        events.receive(Received::Error);
        events.send(None, false);
        assert_eq!(events.latest(), []);
        events.set(true);
        events.receive(Received::Error);
        assert_eq!(events.latest(), [0x82]);
        events.set(false);
        assert_eq!(events.latest(), []);
    }
}
