//! The counters of a listener. Neither counting nor reading blocks.

use std::sync::Mutex;

use holdfast_protocol::pdu::ExceptionCode;
use holdfast_protocol::raw_ingest::{Header, Refusal};
use holdfast_runtime::{Counter, lock};

use crate::counter::{ReasonCounters, counters};

/// The counters of one listener since its start.
#[derive(Debug)]
pub struct Counters {
    requests: [Counter; 256],
    exceptions: [Counter; 16],
    /// Requests carried out, except Get Comm Event Counter (V1.1b3, 6.9).
    pub events: Counter,
    /// Requests without a reply: broadcasts, and requests to a unit in listen only mode.
    pub unanswered: Counter,
    pub frames: FrameCounters,
    cleared: Mutex<Bus>,
}

counters! {
    /// Frames that are not requests.
    pub struct FrameCounters {
        /// Wrong protocol id: discarded.
        foreign,
        /// Invalid length, or the start of a Raw Ingest packet: the connection is closed, or the datagram
        /// is discarded.
        broken,
        /// Wrong CRC or LRC, incomplete, too long, or invalid characters: discarded.
        damaged,
        /// On a serial line, for a unit that is not served here; there and over UDP, an exception: ignored.
        other_unit,
    }
}

counters! {
    /// Packets of a Raw Ingest listener.
    pub struct PacketCounters {
        accepted,
        /// Bits and registers written.
        values,
        /// Bytes behind packets that were written, where a connection carries one: the sender does not speak
        /// this protocol.
        surplus_bytes,
        /// Bytes of packets that did not arrive completely, behind others that were written, where a
        /// connection carries many.
        dropped_bytes,
        /// Memory of packets that are not complete, in bytes.
        held_bytes,
        ;
        refused: [Counter; Refusal::TooLarge as usize + 1],
    }
}

impl PacketCounters {
    /// Counts a packet that was written.
    pub fn accept(&self, header: &Header) {
        self.accepted.add();
        self.values.add_many(u64::from(header.count.get()));
    }

    pub fn refuse(&self, refusal: Refusal) {
        self.refused[usize::from(refusal.code())].add();
    }

    /// Refused packets by reason. Reasons without a refusal are left out.
    pub fn refused(&self) -> impl Iterator<Item = (Refusal, u64)> {
        let reasons = nonzero(&self.refused);
        reasons.filter_map(|(code, count)| Some((Refusal::from_code(code)?, count)))
    }
}

counters! {
    /// Connections, datagrams from peers that no rule names, and requests for listen only mode.
    pub struct ConnectionCounters {
        accepted,
        /// No rule names the peer.
        refused_source,
        /// No rule names the role in the certificate of the peer.
        refused_role,
        /// `max_connections` or `max_connections_per_source` was reached.
        refused_full,
        /// A request asked for listen only mode, which the listener does not allow.
        refused_listen_only,
        /// Closed in favour of a new connection.
        evicted,
        /// Closed during the handshake in favour of a new connection.
        evicted_handshakes,
        /// Ended by a reload: no rule names the peer any more.
        rights_revoked,
        /// Ended by an operator.
        ended,
        /// Closed after `idle_timeout`.
        idle,
        /// Closed because a request did not arrive within `request_timeout`.
        request_timeout,
        /// Closed because the peer did not read its replies within `request_timeout`.
        slow_reader,
        /// The system could not accept a connection.
        accept_errors,
        ;
        /// TLS failed, usually in the handshake.
        pub tls_failed: ReasonCounters,
        /// What a peer sent is not HTTP.
        pub broken_request: Counter,
    }
}

/// The counters of Diagnostics (V1.1b3, 6.8.1) since they were last cleared.
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

    /// Requests by function code. Codes without a request are left out.
    pub fn requests(&self) -> impl Iterator<Item = (u8, u64)> {
        nonzero(&self.requests)
    }

    /// Exceptions by code. Codes that were not sent are left out.
    pub fn exceptions(&self) -> impl Iterator<Item = (u8, u64)> {
        nonzero(&self.exceptions)
    }

    /// The counters of Diagnostics.
    pub fn bus(&self) -> Bus {
        let (now, cleared) = (self.total(), *lock(&self.cleared));
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

    /// Resets the counters of Diagnostics to 0. All other counters continue. `owed` is how the
    /// current request will be counted after this.
    pub fn clear_bus(&self, owed: Bus) {
        let mut now = self.total();
        now.events += owed.events;
        now.no_response += owed.no_response;
        *lock(&self.cleared) = now;
    }

    fn total(&self) -> Bus {
        let requests: u64 = self.requests.iter().map(Counter::get).sum();
        let frames = &self.frames;
        let errors = frames.foreign.get() + frames.broken.get() + frames.damaged.get();
        Bus {
            // Damaged frames are not messages (Serial Line V1.02, annex A).
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
