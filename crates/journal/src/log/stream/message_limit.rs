//! The largest message that the servers accept from this node.

use std::sync::{Arc, Mutex};

use holdfast_runtime::lock;

/// The limit is not lowered below this: it has room for one write of registers.
const MIN_BYTES: usize = 2048;

/// How many bytes a message may have, with its headers. It outlasts connections.
///
/// The limit of an account or a user may be below that of the server. The client does not show it: a larger message
/// is not stored, and ends the connection. The limit is then lowered, for the life of the process.
#[derive(Debug, Clone, Default)]
pub(in crate::log) struct MessageLimit(Arc<Mutex<Known>>);

#[derive(Debug, Default)]
struct Known {
    of_server: usize,
    lowered: Option<usize>,
    /// The largest message of this connection.
    largest_sent: usize,
    /// The size of the last message that was too large, and `lowered` before it.
    too_large: Option<(usize, Option<usize>)>,
}

impl MessageLimit {
    /// A server was connected, which names this limit.
    pub(in crate::log) fn connected(&self, of_server: usize) {
        let mut known = lock(&self.0);
        // The server's own limit was lowered while it ran, and it says so now.
        if let Some((bytes, lowered)) = known.too_large.take()
            && of_server < bytes
        {
            known.lowered = lowered;
        }
        (known.of_server, known.largest_sent) = (of_server, 0);
    }

    pub(in crate::log) fn bytes(&self) -> usize {
        lock(&self.0).bytes()
    }

    /// A message with at most this many bytes is being sent.
    pub(in crate::log) fn sent(&self, bytes: usize) {
        let mut known = lock(&self.0);
        known.largest_sent = known.largest_sent.max(bytes);
    }

    /// A message was too large. Lowers the limit to the largest power of two below what was sent: limits usually
    /// are powers of two. Returns what to do about it, or what this node does.
    pub(in crate::log) fn exceeded(&self) -> String {
        let mut known = lock(&self.0);
        // No part of a snapshot and no steps, but a request to JetStream, which can't be made smaller.
        let Some(below) = known.largest_sent.min(known.bytes()).checked_sub(1) else {
            return "raise the limit of the account or the user".to_owned();
        };
        known.too_large = Some((below + 1, known.lowered));
        let lowered = below.checked_ilog2().map_or(0, |exponent| 1 << exponent);
        if lowered < MIN_BYTES {
            known.lowered = Some(MIN_BYTES);
            return format!("raise the limit of the account or the user to at least {MIN_BYTES}");
        }
        known.lowered = Some(lowered);
        format!("until its restart, this node sends at most {lowered} bytes in a message")
    }
}

impl Known {
    fn bytes(&self) -> usize {
        self.lowered.map_or(self.of_server, |lowered| lowered.min(self.of_server))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sends as much as is allowed to a server that accepts so many bytes, until it is accepted.
    fn found(of_server: usize, accepted: usize) -> usize {
        let limit = MessageLimit::default();
        for _ in 0..20 {
            limit.connected(of_server);
            limit.sent(100);
            limit.sent(limit.bytes().min(128 << 10));
            if limit.bytes().min(128 << 10) <= accepted {
                return limit.bytes();
            }
            limit.exceeded();
        }
        panic!("it is not lowered to {accepted}");
    }

    #[test]
    fn the_limit_is_lowered_to_the_largest_power_of_two_that_is_accepted() {
        assert_eq!(found(1 << 20, 1 << 20), 1 << 20);
        assert_eq!(found(1 << 20, 65_536), 65_536);
        assert_eq!(found(1 << 20, 65_535), 32_768);
        assert_eq!(found(1_000_000, 10_000), 8192);
        assert_eq!(found(1 << 20, 2048), 2048);
    }

    #[test]
    fn what_was_learnt_outlasts_connections_also_to_servers_that_accept_less() {
        let limit = MessageLimit::default();
        limit.connected(1 << 20);
        limit.sent(9000);
        assert!(limit.exceeded().ends_with("at most 8192 bytes in a message"));
        limit.connected(1 << 20);
        limit.connected(4096);
        assert_eq!(limit.bytes(), 4096);
        limit.connected(1 << 20);
        assert_eq!(limit.bytes(), 8192);
    }

    #[test]
    fn a_limit_that_the_server_names_is_not_learnt() {
        let limit = MessageLimit::default();
        limit.connected(1 << 20);
        limit.sent(60_000);
        limit.exceeded();
        limit.connected(50_000);
        assert_eq!(limit.bytes(), 50_000);
        limit.connected(1 << 20);
        assert_eq!(limit.bytes(), 1 << 20);
    }

    #[test]
    fn a_request_that_is_too_large_does_not_lower_the_limit_nor_anything_below_its_minimum() {
        let limit = MessageLimit::default();
        limit.connected(1 << 20);
        assert!(limit.exceeded().starts_with("raise the limit"));
        assert_eq!(limit.bytes(), 1 << 20);
        limit.sent(1);
        assert!(limit.exceeded().ends_with("to at least 2048"));
        assert_eq!(limit.bytes(), MIN_BYTES);
    }
}
