//! What an adapter returns of the replies that are sent over it: some two-wire adapters receive what they
//! send. As a request, it would be carried out again and again.

use std::time::Duration;

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
    /// Known from the first reply that is no request.
    has_echo: Option<bool>,
}

impl LineEcho {
    /// A reply is sent now, which takes so long on the line.
    pub(super) fn sent(&mut self, request: &[u8], reply: &[u8], takes: Duration) {
        self.sent.clear();
        self.sent.extend_from_slice(reply);
        self.is_certain = request != reply;
        self.until = Some(Instant::now() + takes + DELAY);
    }

    /// The number of bytes at the start of what has been received that are the echo.
    pub(super) fn at_start_of(&mut self, received: &[u8]) -> usize {
        if self.sent.is_empty() || !received.starts_with(&self.sent) {
            return 0;
        }
        let is_soon = self.until.is_some_and(|until| Instant::now() <= until);
        let is_echo = self.is_certain || self.has_echo.unwrap_or(is_soon);
        if self.is_certain {
            self.has_echo = Some(true);
        }
        let len = self.sent.len();
        self.sent.clear();
        if is_echo { len } else { 0 }
    }

    /// Whether these bytes are the start of an echo whose rest may come with the next packet.
    pub(super) fn begins_with(&self, received: &[u8]) -> bool {
        received.len() < self.sent.len() && self.sent.starts_with(received)
    }

    /// A request has come, which is no echo. A line that had an echo keeps it: one echo may be damaged.
    pub(super) fn request(&mut self) {
        if self.is_certain && !self.sent.is_empty() && self.has_echo.is_none() {
            self.has_echo = Some(false);
        }
        self.sent.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const READ: &[u8] = &[7, 3, 0, 0, 0, 1, 1, 1];
    const VALUE: &[u8] = &[7, 3, 2, 0, 9, 2, 2];
    const WRITE: &[u8] = &[7, 6, 0, 0, 0, 9, 3, 3];

    fn after(echo: &mut LineEcho, request: &[u8], reply: &[u8], received: &[u8]) -> usize {
        echo.sent(request, reply, Duration::from_secs(3600));
        let len = echo.at_start_of(received);
        if len == 0 && !echo.begins_with(received) {
            echo.request();
        }
        len
    }

    #[test]
    fn a_reply_that_comes_back_is_dropped_with_whatever_follows_it_kept() {
        let mut echo = LineEcho::default();
        assert_eq!(echo.at_start_of(READ), 0);
        assert_eq!(after(&mut echo, READ, VALUE, &[VALUE, READ].concat()), VALUE.len());
        assert_eq!(echo.at_start_of(VALUE), 0, "it comes once");
    }

    #[test]
    fn an_echo_may_come_in_parts() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, READ, VALUE, &VALUE[..3]), 0);
        assert!(echo.begins_with(&VALUE[..3]) && !echo.begins_with(VALUE));
        assert_eq!(echo.at_start_of(VALUE), VALUE.len());
    }

    #[test]
    fn a_damaged_echo_does_not_show_that_there_is_none() {
        let mut echo = LineEcho::default();
        echo.sent(READ, VALUE, Duration::ZERO);
        assert_eq!(echo.at_start_of(&[0xFF, 7, 3]), 0);
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
        assert_eq!(echo.at_start_of(WRITE), WRITE.len());
    }

    #[test]
    fn before_that_is_known_it_is_an_echo_if_it_comes_soon() {
        let mut echo = LineEcho::default();
        assert_eq!(after(&mut echo, WRITE, WRITE, WRITE), WRITE.len());
        echo.sent(WRITE, WRITE, Duration::ZERO);
        echo.until = None;
        assert_eq!(echo.at_start_of(WRITE), 0);
    }
}
