//! The end of a connection whose peer must still get the last reply: it is read until it closes.
//!
//! Closing a socket with unread bytes resets the connection, and the reply could be lost.

use std::future::poll_fn;
use std::net::Shutdown;
use std::time::Duration;

use socket2::SockRef;
use tokio::sync::watch;
use tokio::task::yield_now;
use tokio::time::{Instant, timeout_at};

use crate::server::transports::stream::Stream;

/// The longest time that a peer is read after its last reply.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);

/// Bytes per read.
const DRAIN_CHUNK_BYTES: usize = 16 * 1024;

/// The most reads after that time.
const MAX_LAST_READS: usize = 4;

/// Shuts down the sending side, then reads until the peer closes, and passes the number of bytes on.
pub(crate) async fn drain<S: Stream>(
    stream: &mut S,
    stop: watch::Receiver<bool>,
    drained: impl FnMut(usize),
) {
    drain_for(DRAIN_TIMEOUT, stream, stop, drained).await;
}

/// As `drain`, for at most this long.
pub(crate) async fn drain_for<S: Stream + ?Sized>(
    limit: Duration,
    stream: &mut S,
    mut stop: watch::Receiver<bool>,
    mut drained: impl FnMut(usize),
) {
    let _ = SockRef::from(stream.socket()).shutdown(Shutdown::Write);
    let mut unsent = Vec::new();
    let deadline = Instant::now() + limit;
    while Instant::now() < deadline {
        // On the stack, because many peers may be read at the same time: outside the closure, it would
        // be a part of every connection.
        let read =
            poll_fn(|context| stream.poll_read(context, &mut [0; DRAIN_CHUNK_BYTES], &mut unsent));
        let read = tokio::select! {
            read = timeout_at(deadline, read) => read,
            _ = stop.wait_for(|stop| *stop) => break,
        };
        let Ok(Ok(len)) = read else { return };
        drained(len);
        // A peer that never pauses leaves time for other connections.
        yield_now().await;
    }
    for _ in 0..MAX_LAST_READS {
        let Some(len) = stream.read_now(&mut [0; DRAIN_CHUNK_BYTES], &mut unsent) else { return };
        drained(len);
    }
}
