//! What an adapter returns of the replies that are sent over it: some two-wire adapters receive what they
//! send. As a request, it would be carried out again and again.
//!
//! What equals the last reply and comes next is its echo:
//!
//! | of the line is known | the reply differs from its request | it equals it, as of a write |
//! | --- | --- | --- |
//! | that it has an echo | always | always |
//! | that it has none | if it comes in time | never |
//! | nothing, or that an echo did not come back | if it comes in time | if it comes in time; later, [`Slow`] decides |
//!
//! A reply that has the form of no request is its echo in any case.

use std::time::Duration;

use holdfast_protocol::frame::rtu_stream::{Next, Requests};
use holdfast_protocol::pdu::{ExceptionCode, Request};
use tokio::time::Instant;

/// Added to the time that a reply takes on the line: adapters hold bytes back for up to 16 ms, in both directions.
const DELAY: Duration = Duration::from_millis(40);

/// How much later an echo may come over a network, to a serial server.
const SLOW: Duration = Duration::from_millis(250);

/// After a repeated write was dropped as an echo, so many repetitions are carried out in a row.
const MAX_REPEATS_AFTER_DROP: u8 = 4;

/// The last reply, until a request has come, and whether the line has an echo.
#[derive(Debug, Default)]
pub(super) struct LineEcho {
    sent: Vec<u8>,
    /// Whether the reply differs from its request. One that equals it may come again as the next request.
    reply_differs: bool,
    /// No request has its form: it comes back only as its echo.
    is_no_request: bool,
    until: Option<Instant>,
    /// Whether what has come since began before that.
    is_soon: bool,
    known: Known,
    slow: Slow,
}

/// What came of a write that came again, later than an echo should, on a line of which nothing else is known. If
/// it is an echo, its reply has one again, without end.
#[derive(Debug, Default, Clone, Copy)]
enum Slow {
    #[default]
    Nothing,
    /// It was carried out. So are as many more of them in a row.
    CarriedOut(u8),
    /// It was taken for an echo.
    Dropped,
}

/// What replies that differ from their requests have shown of the line.
#[derive(Debug, Default, Clone, Copy)]
enum Known {
    #[default]
    Nothing,
    NoEcho,
    Echo,
    /// It had an echo, and one did not come back: it may have been damaged.
    EchoOnce,
}

impl LineEcho {
    /// A reply with this PDU is sent now, which takes so long on the line.
    pub(super) fn sent(&mut self, request: &[u8], (reply, pdu): (&[u8], &[u8]), takes: Duration) {
        self.sent.clear();
        self.sent.extend_from_slice(reply);
        self.reply_differs = request != reply;
        let has_no_form = Request::parse(pdu) == Err(ExceptionCode::IllegalDataValue);
        let is_exception = pdu.first().is_some_and(|code| code & 0x80 != 0);
        self.is_no_request = self.reply_differs && (has_no_form || is_exception);
        (self.until, self.is_soon) = (Some(Instant::now() + takes + DELAY), false);
    }

    /// The number of bytes at the start of what has been received that are the echo. A request may begin like
    /// it: while more bytes of it may come, that is open.
    pub(super) fn at_start_of(&mut self, received: &[u8], more_may_come: bool) -> usize {
        self.judged(received, more_may_come, Instant::now())
    }

    fn judged(&mut self, received: &[u8], more_may_come: bool, now: Instant) -> usize {
        if self.sent.is_empty() || !received.starts_with(&self.sent) {
            return 0;
        }
        // It stays in time while the rest is waited for.
        self.is_soon |= self.until.is_some_and(|until| now <= until);
        match Requests::default().next(received) {
            Next::Frame { len, .. } if len > self.sent.len() => return 0,
            Next::Incomplete if more_may_come => return 0,
            _ => {}
        }
        let is_echo = match self.known {
            _ if self.is_no_request => true,
            Known::Echo => true,
            Known::NoEcho => self.reply_differs && self.is_soon,
            Known::Nothing | Known::EchoOnce if self.is_soon => true,
            Known::Nothing | Known::EchoOnce if self.reply_differs => false,
            Known::Nothing | Known::EchoOnce => return self.slow_echo(now),
        };
        if self.reply_differs && is_echo {
            self.known = Known::Echo;
        }
        let len = self.sent.len();
        self.sent.clear();
        if is_echo { len } else { 0 }
    }

    /// Judges a write that equals the last one and its reply, on a line of which nothing else is known.
    fn slow_echo(&mut self, now: Instant) -> usize {
        let is_slow = self.until.is_some_and(|until| now <= until + SLOW);
        self.slow = match self.slow {
            // It had no reply that could come back: the master has repeated it. That does not show that the line
            // has no echo.
            Slow::Dropped => Slow::CarriedOut(MAX_REPEATS_AFTER_DROP),
            _ if !is_slow => Slow::Nothing,
            Slow::Nothing => Slow::CarriedOut(0),
            Slow::CarriedOut(0) => Slow::Dropped,
            Slow::CarriedOut(more) => Slow::CarriedOut(more - 1),
        };
        if let Slow::Dropped = self.slow {
            // It is kept, to be known when it comes again.
            return self.sent.len();
        }
        self.sent.clear();
        0
    }

    /// Whether these bytes are the start of an echo whose rest may come with the next packet.
    pub(super) fn begins_with(&self, received: &[u8]) -> bool {
        received.len() < self.sent.len() && self.sent.starts_with(received)
    }

    /// A request has come, which is no echo. On a line that had an echo, it may have been damaged: such a line
    /// never counts as one without, or the echo of a write would be carried out as the next write.
    pub(super) fn request(&mut self) {
        if !self.sent.is_empty() {
            self.slow = Slow::Nothing;
        }
        if self.reply_differs && !self.sent.is_empty() {
            self.known = match self.known {
                Known::Echo | Known::EchoOnce => Known::EchoOnce,
                Known::Nothing | Known::NoEcho => Known::NoEcho,
            };
        }
        self.sent.clear();
    }
}

#[cfg(test)]
mod tests {
    use holdfast_protocol::frame::rtu;

    use super::*;

    const READ: &[u8] = &[7, 3, 0, 0, 0, 1, 1, 1];
    const VALUE: &[u8] = &[7, 3, 2, 0, 9, 2, 2];
    const WRITE: &[u8] = &[7, 6, 0, 0, 0, 9, 3, 3];

    /// The reply to a read of 24 coils, which may be a read itself.
    const COILS: &[u8] = &[7, 1, 3, 0, 0, 1, 4, 4];

    fn sent(echo: &mut LineEcho, request: &[u8], reply: &[u8], takes: Duration) {
        echo.sent(request, (reply, &reply[1..reply.len() - 2]), takes);
    }

    fn after(echo: &mut LineEcho, request: &[u8], reply: &[u8], received: &[u8]) -> usize {
        sent(echo, request, reply, Duration::from_secs(3600));
        let len = echo.at_start_of(received, false);
        if len == 0 && !echo.begins_with(received) {
            echo.request();
        }
        len
    }

    #[test]
    fn a_reply_that_comes_back_is_dropped_with_whatever_follows_it_kept() {
        let mut echo = LineEcho::default();
        assert_eq!(echo.at_start_of(READ, false), 0);
        assert_eq!(after(&mut echo, READ, VALUE, &[VALUE, READ].concat()), VALUE.len());
        assert_eq!(echo.at_start_of(VALUE, false), 0, "it comes once");
    }

    #[test]
    fn an_echo_may_come_in_parts() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, &VALUE[..3]), 0);
        assert!(echo.begins_with(&VALUE[..3]) && !echo.begins_with(VALUE));
        assert_eq!(echo.at_start_of(VALUE, false), VALUE.len());
    }

    #[test]
    fn a_damaged_echo_does_not_show_that_there_is_none() {
        let mut echo = LineEcho::default();
        sent(&mut echo, READ, VALUE, Duration::ZERO);
        assert_eq!(echo.at_start_of(&[0xFF, 7, 3], false), 0);
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len());
        assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        assert_eq!(after(&mut echo, READ, VALUE, WRITE), 0);
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len(), "it still has one");
    }

    #[test]
    fn a_write_that_is_repeated_is_no_echo_on_a_line_that_has_none() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, WRITE), 0);
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), 0);
    }

    #[test]
    fn a_confirmation_that_comes_back_is_an_echo_on_a_line_that_has_one() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        sent(&mut echo, WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE, false), WRITE.len());
    }

    #[test]
    fn before_that_is_known_it_is_an_echo_if_it_comes_soon() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len());
        sent(&mut echo, WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE, false), 0);
    }

    #[test]
    fn a_request_that_begins_like_the_last_reply_is_no_echo() {
        // The CRC of the reply is the byte count of the request and its first byte.
        const REPLY: &[u8] = &[3, 16, 0, 0x99, 0, 8, 0x10, 2];
        let mut pdu = [REPLY[1..].to_vec(), vec![0; 15]].concat();
        let mut echo = LineEcho::default();
        for value in 0..3 {
            pdu[21] = value;
            let mut request = [0; rtu::MAX_LEN];
            let len = rtu::encode(3, &pdu, &mut request).unwrap();
            sent(&mut echo, &request[..len], REPLY, Duration::from_secs(3600));
            assert!((1..len).all(|part| echo.at_start_of(&request[..part], true) == 0));
            assert_eq!(echo.at_start_of(&request[..len], true), 0);
            assert_eq!(echo.at_start_of(&request[..len], false), 0);
            echo.request();
        }
        sent(&mut echo, READ, REPLY, Duration::from_secs(3600));
        assert_eq!(echo.at_start_of(REPLY, true), 0);
        assert_eq!(echo.at_start_of(REPLY, false), REPLY.len());
    }

    #[test]
    fn what_may_be_a_request_must_come_soon_unless_the_line_has_an_echo() {
        let mut echo = LineEcho::default();
        for is_known in [false, true] {
            sent(&mut echo, READ, COILS, Duration::ZERO);
            echo.until = None;
            assert_eq!(echo.at_start_of(COILS, false) > 0, is_known);
            assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        }
    }

    #[test]
    fn what_has_the_form_of_no_request_is_an_echo_however_late_it_comes() {
        for reply in [VALUE, &[7, 0x83, 2, 5, 5]] {
            let mut echo = LineEcho::default();
            for _ in 0..2 {
                sent(&mut echo, READ, reply, Duration::ZERO);
                echo.until = None;
                assert_eq!(echo.at_start_of(reply, false), reply.len());
                assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len(), "that is known now");
                assert_eq!(after(&mut echo, READ, VALUE, READ), 0);
            }
        }
    }

    /// Sends `WRITE` so long after its reply would have come back. Returns whether it was carried out.
    fn write(echo: &mut LineEcho, later: Duration) -> bool {
        let now = echo.until.map_or_else(Instant::now, |until| until + later);
        let is_echo = echo.judged(WRITE, false, now) > 0;
        if !is_echo {
            echo.request();
            sent(echo, WRITE, WRITE, Duration::ZERO);
        }
        !is_echo
    }

    const MUCH_LATER: Duration = Duration::from_secs(3600);

    #[test]
    fn the_slow_echo_of_a_write_is_not_carried_out_without_end() {
        let mut echo = LineEcho::default();
        let echoes = [1, MAX_REPEATS_AFTER_DROP, MAX_REPEATS_AFTER_DROP].map(|most| {
            assert!(write(&mut echo, Duration::from_secs(1)), "it is no echo");
            (0..=most).take_while(|_| write(&mut echo, SLOW)).count()
        });
        assert_eq!(echoes, [1, MAX_REPEATS_AFTER_DROP, MAX_REPEATS_AFTER_DROP].map(usize::from));
    }

    #[test]
    fn a_master_that_repeats_a_write_is_answered_when_it_asks_again() {
        for later in [SLOW, MUCH_LATER] {
            let mut echo = LineEcho::default();
            let unanswered = (0..100).filter(|_| !write(&mut echo, SLOW)).count();
            assert!(unanswered <= 100 / usize::from(MAX_REPEATS_AFTER_DROP));
            assert!((0..=MAX_REPEATS_AFTER_DROP).any(|_| !write(&mut echo, SLOW)));
            assert!(write(&mut echo, later));
        }
    }

    #[test]
    fn writes_between_others_or_after_a_while_are_no_slow_echo() {
        let mut echo = LineEcho::default();
        for later in [MUCH_LATER, SLOW, SLOW + Duration::from_millis(1), SLOW] {
            assert!(write(&mut echo, later));
        }
        // A request to another unit has come.
        echo.request();
        assert!(write(&mut echo, SLOW) && write(&mut echo, SLOW));
    }

    #[test]
    fn after_an_echo_that_did_not_come_back_only_time_tells() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        assert_eq!(after(&mut echo, READ, VALUE, WRITE), 0);
        sent(&mut echo, WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE, false), 0);
        assert_eq!(after(&mut echo, READ, VALUE, READ), 0);
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len(), "two may have been damaged");
    }
}
