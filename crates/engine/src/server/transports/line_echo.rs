//! What an adapter returns of the replies that are sent over it: some two-wire adapters receive what they
//! send. As a request, it would be carried out again and again.

use std::time::Duration;

use holdfast_protocol::frame::rtu_stream::{Next, Requests};
use tokio::time::Instant;

/// Added to the time that a reply takes on the line: adapters hold bytes back for up to 16 ms, in both directions.
const DELAY: Duration = Duration::from_millis(40);

/// The last reply, until a request has come, and whether the line has an echo.
#[derive(Debug, Default)]
pub(super) struct LineEcho {
    sent: Vec<u8>,
    /// A reply that equals its request may come again as the next request.
    is_certain: bool,
    until: Option<Instant>,
    /// Whether what has come since began before that.
    is_soon: bool,
    known: Known,
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
    /// A reply is sent now, which takes so long on the line.
    pub(super) fn sent(&mut self, request: &[u8], reply: &[u8], takes: Duration) {
        self.sent.clear();
        self.sent.extend_from_slice(reply);
        self.is_certain = request != reply;
        (self.until, self.is_soon) = (Some(Instant::now() + takes + DELAY), false);
    }

    /// The number of bytes at the start of what has been received that are the echo. A request may begin like
    /// it: while more bytes of it may come, that is open.
    pub(super) fn at_start_of(&mut self, received: &[u8], more_may_come: bool) -> usize {
        if self.sent.is_empty() || !received.starts_with(&self.sent) {
            return 0;
        }
        // It stays in time while the rest is waited for.
        self.is_soon |= self.until.is_some_and(|until| Instant::now() <= until);
        match Requests::default().next(received) {
            Next::Frame { len, .. } if len > self.sent.len() => return 0,
            Next::Incomplete if more_may_come => return 0,
            _ => {}
        }
        let is_echo = match self.known {
            Known::Echo => true,
            Known::NoEcho => self.is_certain && self.is_soon,
            Known::Nothing | Known::EchoOnce => self.is_soon,
        };
        if self.is_certain && is_echo {
            self.known = Known::Echo;
        }
        let len = self.sent.len();
        self.sent.clear();
        if is_echo { len } else { 0 }
    }

    /// Whether these bytes are the start of an echo whose rest may come with the next packet.
    pub(super) fn begins_with(&self, received: &[u8]) -> bool {
        received.len() < self.sent.len() && self.sent.starts_with(received)
    }

    /// A request has come, which is no echo. On a line that had an echo, it may have been damaged: such a line
    /// never counts as one without, or the echo of a write would be carried out as the next write.
    pub(super) fn request(&mut self) {
        if self.is_certain && !self.sent.is_empty() {
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

    fn after(echo: &mut LineEcho, request: &[u8], reply: &[u8], received: &[u8]) -> usize {
        echo.sent(request, reply, Duration::from_secs(3600));
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
        echo.sent(READ, VALUE, Duration::ZERO);
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
        echo.sent(WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE, false), WRITE.len());
    }

    #[test]
    fn before_that_is_known_it_is_an_echo_if_it_comes_soon() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len());
        echo.sent(WRITE, WRITE, Duration::ZERO);
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
            echo.sent(&request[..len], REPLY, Duration::from_secs(3600));
            assert!((1..len).all(|part| echo.at_start_of(&request[..part], true) == 0));
            assert_eq!(echo.at_start_of(&request[..len], true), 0);
            assert_eq!(echo.at_start_of(&request[..len], false), 0);
            echo.request();
        }
        echo.sent(READ, REPLY, Duration::from_secs(3600));
        assert_eq!(echo.at_start_of(REPLY, true), 0);
        assert_eq!(echo.at_start_of(REPLY, false), REPLY.len());
    }

    #[test]
    fn what_is_certain_must_come_soon_unless_the_line_has_an_echo() {
        let mut echo = LineEcho::default();
        for is_known in [false, true] {
            echo.sent(READ, VALUE, Duration::ZERO);
            echo.until = None;
            assert_eq!(echo.at_start_of(VALUE, false) > 0, is_known);
            assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        }
    }

    #[test]
    fn after_an_echo_that_did_not_come_back_only_time_tells() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, VALUE), VALUE.len());
        assert_eq!(after(&mut echo, READ, VALUE, WRITE), 0);
        echo.sent(WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE, false), 0);
        assert_eq!(after(&mut echo, READ, VALUE, READ), 0);
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len(), "two may have been damaged");
    }
}
