//! When a Modbus connection over a stream ends for want of bytes, and when a silence ends a frame.

use std::time::Duration;

use tokio::time::Instant;

use crate::server::connections::given_up::has_given_up;
use crate::server::reports::event::Kind;

/// A timer without a deadline fires after this time.
pub(crate) const NO_DEADLINE: Duration = Duration::from_secs(30 * 365 * 24 * 3600);

#[derive(Debug, Clone, Copy)]
pub(crate) struct Timeouts {
    /// The longest time without a request. `None`: no limit.
    pub(crate) idle: Option<Duration>,
    /// The longest time from the first byte of a request to its last, and for a peer to read its
    /// replies.
    pub(crate) request: Duration,
    /// The longest time between two reads of a request. After that, the request is discarded, and the
    /// next byte starts a frame; `None` where silence means nothing.
    pub(crate) frame: Option<Duration>,
}

impl Timeouts {
    /// The deadline of the first bytes, or of the rest of a request whose beginning has arrived, and
    /// what ends the connection then.
    pub(crate) fn first_request(&self, begun: Instant, is_partial: bool) -> (Instant, Kind) {
        if is_partial {
            return (begun + self.request, Kind::RequestTimeout);
        }
        (begun + self.idle.unwrap_or(NO_DEADLINE), Kind::Idle)
    }
}

/// What is under way between a peer and the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Exchange {
    /// Nothing: the peer may be idle for so long.
    Idle,
    /// Replies that come later.
    Replies,
    /// A request, or a TLS record, of which a part has arrived.
    Request,
}

/// What has arrived of the next request.
#[derive(Debug, Clone, Copy)]
enum Arrival {
    Nothing,
    /// The beginning of a request or of a TLS record, or bytes that are discarded until a silence.
    Partial {
        begun: Instant,
        last_read: Instant,
    },
}

/// What the end of a wait means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Expired {
    Nothing,
    /// The frame that had begun: what comes next starts another.
    Frame,
    Connection(Kind),
}

#[derive(Debug)]
pub(super) struct Deadlines {
    pub(super) timeouts: Timeouts,
    last_request: Instant,
    arrival: Arrival,
}

impl Deadlines {
    pub(super) fn new(timeouts: Timeouts) -> Deadlines {
        Deadlines { timeouts, last_request: Instant::now(), arrival: Arrival::Nothing }
    }

    /// The beginning of a request was there from the start.
    pub(super) fn begin(&mut self) {
        let begun = self.last_request;
        self.arrival = Arrival::Partial { begun, last_read: begun };
    }

    /// A request was complete, or a reply has come.
    #[inline]
    pub(super) fn note_request(&mut self, now: Instant) {
        self.last_request = now;
    }

    /// Whether what arrives now shows that a client without transaction ids has given up.
    pub(super) fn has_given_up(&self) -> bool {
        has_given_up(self.last_request.elapsed(), self.timeouts.frame)
    }

    /// All that has arrived was complete.
    #[inline]
    pub(super) fn note_complete(&mut self) {
        self.arrival = Arrival::Nothing;
    }

    /// Bytes were read that are not a complete request: the first of them, or more.
    pub(super) fn note_partial(&mut self, now: Instant, is_new: bool) {
        let begun = match self.arrival {
            Arrival::Partial { begun, .. } if !is_new => begun,
            _ => now,
        };
        self.arrival = Arrival::Partial { begun, last_read: now };
    }

    /// What the peer has sent could not be read yet: it is not to blame for silence.
    pub(super) fn restart(&mut self, now: Instant) {
        self.last_request = now;
        if let Arrival::Partial { .. } = self.arrival {
            self.arrival = Arrival::Partial { begun: now, last_read: now };
        }
    }

    pub(super) fn next(&self, exchange: Exchange) -> Instant {
        let (end, _) = self.end(exchange);
        self.frame_end().map_or(end, |frame_end| frame_end.min(end))
    }

    pub(super) fn expired(&self, now: Instant, exchange: Exchange) -> Expired {
        let (end, kind) = self.end(exchange);
        if now < self.next(exchange) {
            Expired::Nothing
        } else if self.frame_end().is_some_and(|frame_end| frame_end < end) {
            Expired::Frame
        } else {
            Expired::Connection(kind)
        }
    }

    /// When and why the connection ends.
    fn end(&self, exchange: Exchange) -> (Instant, Kind) {
        // Bytes that are discarded do not put off the end for want of requests.
        let idle = self.timeouts.idle.filter(|_| exchange == Exchange::Idle);
        let idle = (self.last_request + idle.unwrap_or(NO_DEADLINE), Kind::Idle);
        let Arrival::Partial { begun, .. } = self.arrival else { return idle };
        let request = (begun + self.timeouts.request, Kind::RequestTimeout);
        if exchange == Exchange::Request || request.0 < idle.0 { request } else { idle }
    }

    /// When a silence ends a frame.
    fn frame_end(&self) -> Option<Instant> {
        match self.arrival {
            Arrival::Nothing => None,
            Arrival::Partial { last_read, .. } => {
                self.timeouts.frame.map(|frame| last_read + frame)
            }
        }
    }
}
