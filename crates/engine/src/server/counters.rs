//! What a listener counts. Counting never waits, and reading never stops the counting.

use std::sync::{Mutex, PoisonError};

use holdfast_protocol::pdu::ExceptionCode;
use holdfast_protocol::raw_ingest::Refusal;

use crate::counter::Counter;

/// The counters of one listener, since it was started.
#[derive(Debug)]
pub struct Counters {
    requests: [Counter; 256],
    exceptions: [Counter; 16],
    /// Requests carried out, those for the event counter itself not among them (V1.1b3, 6.9).
    pub events: Counter,
    /// Requests without a reply: to a unit that is in listen only mode, and broadcasts.
    pub unanswered: Counter,
    pub frames: FrameCounters,
    cleared: Mutex<Bus>,
}

/// Frames that are no requests.
#[derive(Debug, Default)]
pub struct FrameCounters {
    /// With a protocol id other than 0: discarded.
    pub foreign: Counter,
    /// With a length that no frame has: a connection is closed, a datagram discarded.
    pub broken: Counter,
    /// With a wrong CRC or LRC, cut short, or with characters that belong in no frame: discarded.
    pub damaged: Counter,
    /// On a serial line, for a unit that is not served here: passed over.
    pub other_unit: Counter,
}

/// What became of the packets of a Raw Ingest listener.
#[derive(Debug, Default)]
pub struct PacketCounters {
    pub accepted: Counter,
    /// Bits and registers that were written.
    pub values: Counter,
    refused: [Counter; 13],
}

impl PacketCounters {
    pub fn refuse(&self, refusal: Refusal) {
        self.refused[usize::from(refusal.code())].add();
    }

    /// Refused packets by reason, reasons that never came up left out.
    pub fn refused(&self) -> impl Iterator<Item = (Refusal, u64)> {
        let reasons = nonzero(&self.refused);
        reasons.filter_map(|(code, count)| Some((Refusal::from_code(code)?, count)))
    }
}

/// What became of connections, and of datagrams from peers that no rule names.
#[derive(Debug, Default)]
pub struct ConnectionCounters {
    pub accepted: Counter,
    /// No rule names the peer.
    pub refused_source: Counter,
    /// No rule names the role that the peer's certificate has.
    pub refused_role: Counter,
    /// `max_connections` or `max_connections_per_source` was reached.
    pub refused_full: Counter,
    /// TLS failed, most often in its handshake.
    pub tls_failed: Counter,
    /// Closed in favour of a new connection.
    pub evicted: Counter,
    /// Closed after `idle_timeout`.
    pub idle: Counter,
    /// Closed because a request did not arrive within `request_timeout`.
    pub request_timeout: Counter,
    /// Closed because the peer did not take its replies within `request_timeout`.
    pub slow_reader: Counter,
    /// The system could not accept a connection.
    pub accept_errors: Counter,
}

/// The counters of Diagnostics (V1.1b3, 6.8.1), since they were cleared.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Bus {
    pub messages: u64,
    pub communication_errors: u64,
    pub exceptions: u64,
    pub server_messages: u64,
    pub no_response: u64,
    pub busy: u64,
    pub events: u64,
}

impl Default for Counters {
    fn default() -> Counters {
        Counters {
            requests: [const { Counter::new() }; 256],
            exceptions: [const { Counter::new() }; 16],
            events: Counter::default(),
            unanswered: Counter::default(),
            frames: FrameCounters::default(),
            cleared: Mutex::default(),
        }
    }
}

impl Counters {
    #[inline]
    pub fn request(&self, function_code: u8) {
        self.requests[usize::from(function_code)].add();
    }

    pub fn exception(&self, code: ExceptionCode) {
        self.exceptions[usize::from(code.code()) & 0x0F].add();
    }

    /// Requests by function code, codes never asked for left out.
    pub fn requests(&self) -> impl Iterator<Item = (u8, u64)> {
        nonzero(&self.requests)
    }

    /// Exceptions by code, codes never sent left out.
    pub fn exceptions(&self) -> impl Iterator<Item = (u8, u64)> {
        nonzero(&self.exceptions)
    }

    /// The counters of Diagnostics.
    pub fn bus(&self) -> Bus {
        let (now, cleared) =
            (self.total(), *self.cleared.lock().unwrap_or_else(PoisonError::into_inner));
        Bus {
            messages: now.messages.saturating_sub(cleared.messages),
            communication_errors: now
                .communication_errors
                .saturating_sub(cleared.communication_errors),
            exceptions: now.exceptions.saturating_sub(cleared.exceptions),
            server_messages: now.server_messages.saturating_sub(cleared.server_messages),
            no_response: now.no_response.saturating_sub(cleared.no_response),
            busy: now.busy.saturating_sub(cleared.busy),
            events: now.events.saturating_sub(cleared.events),
        }
    }

    /// Starts the counters of Diagnostics again at 0; all others go on. `owed` is what the request
    /// that asks for it will still be counted as.
    pub fn clear_bus(&self, owed: Bus) {
        let mut now = self.total();
        now.events += owed.events;
        now.no_response += owed.no_response;
        *self.cleared.lock().unwrap_or_else(PoisonError::into_inner) = now;
    }

    fn total(&self) -> Bus {
        let requests: u64 = self.requests.iter().map(Counter::get).sum();
        let frames = &self.frames;
        let errors = frames.foreign.get() + frames.broken.get() + frames.damaged.get();
        Bus {
            // Without damaged ones (Serial Line V1.02, annex A).
            messages: requests + frames.other_unit.get(),
            communication_errors: errors,
            exceptions: self.exceptions.iter().map(Counter::get).sum(),
            server_messages: requests,
            no_response: self.unanswered.get(),
            busy: self.exceptions[usize::from(ExceptionCode::ServerDeviceBusy.code())].get(),
            events: self.events.get(),
        }
    }
}

fn nonzero(counters: &[Counter]) -> impl Iterator<Item = (u8, u64)> {
    let all = counters.iter().enumerate().map(|(code, counter)| (code as u8, counter.get()));
    all.filter(|(_, count)| *count > 0)
}
