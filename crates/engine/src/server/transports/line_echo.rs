//! What an adapter returns of the replies that are sent over it: some two-wire adapters receive what they
//! send. As a request, it would be carried out again and again.

use std::time::Duration;

use tokio::time::Instant;

/// Added to the time that a reply takes on the line: adapters and systems hold bytes back.
const DELAY: Duration = Duration::from_millis(50);

/// The last reply, until something else has come, and whether the line has an echo.
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

    /// The number of bytes at the start of what has been received since that are the echo.
    pub(super) fn at_start_of(&mut self, received: &[u8]) -> usize {
        let len = self.sent.len();
        if received.len() < len && self.sent.starts_with(received) {
            return 0;
        }
        let is_same = received.starts_with(&self.sent);
        let is_soon = self.until.is_some_and(|until| Instant::now() <= until);
        let is_echo = is_same && (self.is_certain || self.has_echo.unwrap_or(is_soon));
        if self.is_certain && len > 0 {
            self.has_echo = Some(is_same);
        }
        self.sent.clear();
        self.is_certain = false;
        if is_echo { len } else { 0 }
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
        echo.at_start_of(received)
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
        assert_eq!(echo.at_start_of(VALUE), VALUE.len());
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
