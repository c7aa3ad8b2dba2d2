//! Keeps the requests of one connection in order around its writes: none passes an earlier write, nor
//! does a write pass an earlier request. Reads alone go as the link pleases.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use holdfast_runtime::lock;
use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock};

/// The connections that have requests. Their locks are fair: first come, first served.
#[derive(Debug, Default)]
pub(in crate::link) struct Order {
    sources: Mutex<HashMap<u64, Arc<RwLock<()>>>>,
}

/// A request whose turn among those of its connection has come. It lasts until it is answered.
#[derive(Debug)]
pub(in crate::link) struct InOrder {
    order: Arc<Order>,
    source: u64,
    held: Option<Held>,
}

#[derive(Debug)]
#[allow(dead_code, reason = "they are held, not read")]
enum Held {
    Read(OwnedRwLockReadGuard<()>),
    Write(OwnedRwLockWriteGuard<()>),
}

impl Order {
    /// Waits until the requests are answered that this one may not pass.
    pub(in crate::link) async fn wait(self: &Arc<Order>, source: u64, is_read: bool) -> InOrder {
        let of_source = Arc::clone(lock(&self.sources).entry(source).or_default());
        let held = match is_read {
            true => Held::Read(of_source.read_owned().await),
            false => Held::Write(of_source.write_owned().await),
        };
        InOrder { order: Arc::clone(self), source, held: Some(held) }
    }
}

impl Drop for InOrder {
    fn drop(&mut self) {
        self.held = None;
        let mut sources = lock(&self.order.sources);
        if sources.get(&self.source).is_some_and(|lock| Arc::strong_count(lock) == 1) {
            sources.remove(&self.source);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::Future;
    use std::pin::pin;
    use std::task::{Context, Poll, Waker};

    use super::*;

    fn poll<F: Future>(future: std::pin::Pin<&mut F>) -> Poll<F::Output> {
        future.poll(&mut Context::from_waker(Waker::noop()))
    }

    fn now(order: &Arc<Order>, source: u64, is_read: bool) -> Option<InOrder> {
        match poll(pin!(order.wait(source, is_read))) {
            Poll::Ready(in_order) => Some(in_order),
            Poll::Pending => None,
        }
    }

    #[test]
    fn only_a_write_makes_others_of_its_connection_wait() {
        let order = Arc::<Order>::default();
        let reads = [now(&order, 1, true).unwrap(), now(&order, 1, true).unwrap()];
        assert!(now(&order, 1, false).is_none(), "a write waits for the reads before it");
        let other = now(&order, 2, false).unwrap();
        drop(reads);
        let write = now(&order, 1, false).unwrap();
        assert!(now(&order, 1, true).is_none(), "a read waits for the write before it");
        drop(write);
        assert!(now(&order, 1, true).is_some());
        drop(other);
    }

    #[test]
    fn a_read_does_not_pass_a_write_that_waits() {
        let order = Arc::<Order>::default();
        let first = now(&order, 1, true).unwrap();
        let mut write = pin!(order.wait(1, false));
        assert!(poll(write.as_mut()).is_pending());
        let mut read = pin!(order.wait(1, true));
        assert!(poll(read.as_mut()).is_pending());
        drop(first);
        let Poll::Ready(written) = poll(write.as_mut()) else { panic!("it is its turn") };
        assert!(poll(read.as_mut()).is_pending());
        drop(written);
        assert!(poll(read.as_mut()).is_ready());
    }

    #[test]
    fn a_connection_without_requests_leaves_nothing() {
        let order = Arc::<Order>::default();
        let first = now(&order, 1, true).unwrap();
        let second = now(&order, 1, true).unwrap();
        drop(first);
        assert_eq!(lock(&order.sources).len(), 1);
        drop(second);
        assert!(lock(&order.sources).is_empty());
    }
}
