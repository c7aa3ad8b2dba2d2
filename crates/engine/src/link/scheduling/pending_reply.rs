//! A reply that comes later, and whether its client still waits for it.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use tokio::sync::oneshot::error::RecvError;
use tokio::sync::{Notify, oneshot};

use crate::link::limits::permit::Wanted;

/// The two ends of a reply: where it is sent, and where it is awaited.
pub(crate) fn pending_reply() -> (ReplyTo, PendingReply) {
    let (to, from) = oneshot::channel();
    let client = Arc::<Client>::default();
    (ReplyTo { to, client: Arc::clone(&client) }, PendingReply { from, client })
}

/// Whether the client that waits for a reply has disconnected.
#[derive(Debug, Default)]
struct Client {
    is_gone: AtomicBool,
    gone: Notify,
}

impl Client {
    fn give_up(&self) {
        self.is_gone.store(true, Ordering::Relaxed);
        self.gone.notify_one();
    }
}

/// The reply to a request.
#[derive(Debug, Default)]
pub(crate) struct Reply {
    /// Empty after a broadcast.
    pub(crate) pdu: Vec<u8>,
    /// The sequence of the write in the log of a memory. `None` without a log.
    pub(crate) log_sequence: Option<u64>,
}

/// Gives a reply up when it is dropped.
pub(crate) struct GivesUp(Arc<Client>);

impl Drop for GivesUp {
    fn drop(&mut self) {
        self.0.give_up();
    }
}

/// Where a reply goes.
pub(crate) struct ReplyTo {
    to: oneshot::Sender<Reply>,
    client: Arc<Client>,
}

/// A reply that comes later. An error means that the request was not sent, or that its link has ended.
#[derive(Debug)]
pub(crate) struct PendingReply {
    from: oneshot::Receiver<Reply>,
    client: Arc<Client>,
}

impl ReplyTo {
    pub(crate) fn send(self, pdu: Vec<u8>) {
        self.send_written(pdu, None);
    }

    /// Sends the reply to a write, with its sequence if a log has it.
    pub(crate) fn send_written(self, pdu: Vec<u8>, log_sequence: Option<u64>) {
        // Fails if the client has disconnected.
        let _ = self.to.send(Reply { pdu, log_sequence });
    }

    /// Whether the request need not be sent any more.
    pub(crate) fn is_unwanted(&self) -> bool {
        self.to.is_closed() || self.client.is_gone.load(Ordering::Relaxed)
    }

    /// Whether the client has not disconnected, for a [`Permit`](crate::link::Permit).
    pub(crate) fn wanted(&self) -> Wanted {
        let client = Arc::clone(&self.client);
        Arc::new(move |_| !client.is_gone.load(Ordering::Relaxed))
    }

    /// Waits until the client has disconnected.
    pub(crate) fn gone(&self) -> impl Future<Output = ()> + use<> {
        let client = Arc::clone(&self.client);
        async move { client.gone.notified().await }
    }
}

impl PendingReply {
    /// The client has disconnected: a request that waits for its turn is not sent. The reply to one that
    /// was sent still comes, because the audit log records it.
    pub(crate) fn give_up(&self) {
        self.client.give_up();
    }

    /// As [`give_up`](PendingReply::give_up), when the result is dropped.
    pub(crate) fn give_up_on_drop(&self) -> GivesUp {
        GivesUp(Arc::clone(&self.client))
    }

    /// Blocks the calling thread until the reply comes.
    pub(crate) fn wait(self) -> Result<Reply, RecvError> {
        self.from.blocking_recv()
    }
}

impl Future for PendingReply {
    type Output = Result<Reply, RecvError>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        Pin::new(&mut self.from).poll(context)
    }
}
