//! When a client has given up its earlier requests: without transaction ids, it would take a reply to one of
//! them for the reply to a newer request.

use std::time::Duration;

/// Requests that are sent together arrive within this time of each other, also if TCP sends a segment again.
pub(in crate::server) const BURST_TIME: Duration = Duration::from_millis(250);

/// Whether a client that sends something so long after its last request, or the last reply, has given up. On a
/// stream, `frame` is the silence that ends a frame.
pub(in crate::server) fn has_given_up(pause: Duration, frame: Option<Duration>) -> bool {
    pause > frame.unwrap_or_default().max(BURST_TIME)
}
