//! What devices send without a request, and late: counted for each connection, over all its lives.

use holdfast_protocol::client::Connection;
use holdfast_runtime::Counter;

#[derive(Debug, Default)]
pub struct StrayCounters {
    /// Frames that no request asked for.
    pub replies: Counter,
    /// The bytes of these, and all others that are no part of a reply.
    pub bytes: Counter,
    /// Replies that came after the timeout of their request.
    pub late: Counter,
    /// Requests that had more than their timeout, because late replies repeat.
    pub raised_timeouts: Counter,
    /// Times that a connection was closed, and not opened for a while, because these were too many.
    pub floods: Counter,
}

impl StrayCounters {
    /// Counts what a connection has received. `late` is its count of late replies the last time.
    pub(crate) fn take(&self, connection: &mut Connection, late: &mut u64) {
        let strays = connection.take_strays();
        if strays.bytes > 0 {
            self.replies.add_many(strays.replies);
            self.bytes.add_many(strays.bytes);
        }
        let raised = connection.take_raised();
        if raised > 0 {
            self.raised_timeouts.add_many(raised);
        }
        let before = std::mem::replace(late, connection.late());
        self.late.add_many(*late - before);
    }
}
