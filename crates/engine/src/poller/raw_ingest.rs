//! Forwards reads as Raw Ingest packets. A target that is down does not delay the device. When the
//! target is back, it receives the newest bytes of each read.

use std::cell::{Cell, RefCell};
use std::collections::{HashMap, VecDeque};
use std::io;
use std::num::NonZeroU16;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use holdfast_memory::Area;
use holdfast_protocol::raw_ingest::{DONE, Format, Header};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::time::{sleep, timeout};

use crate::counter::Counter;
use crate::link::backoff;
use crate::packet_area::in_packet;

/// The longest pause before a target that is down is tried again.
const MAX_PAUSE: Duration = Duration::from_secs(10);

/// A receiver of Raw Ingest packets.
#[derive(Debug, Clone)]
pub struct ForwardSettings {
    pub host: String,
    pub port: u16,
    pub format: Format,
    /// The unit id (v1) or memory id (crc) in packets.
    pub target: u16,
    pub timeout: Duration,
}

/// Counters of forwarded packets.
#[derive(Debug, Default)]
pub struct ForwardCounters {
    pub sent: Counter,
    /// The receiver did not write the packet.
    pub refused: Counter,
    /// Connecting failed, or no reply arrived.
    pub failed: Counter,
    /// Packets replaced by newer bytes of the same read before they were sent.
    pub replaced: Counter,
}

/// One target of one device.
pub(super) struct Forward {
    settings: ForwardSettings,
    pub(super) counters: Arc<ForwardCounters>,
    waiting: RefCell<Waiting>,
    news: Notify,
    failures: Cell<u32>,
}

/// The newest unsent packet of each read, in the order of arrival.
#[derive(Default)]
struct Waiting {
    order: VecDeque<usize>,
    newest: HashMap<usize, Vec<u8>>,
}

impl Waiting {
    /// Queues a packet. Returns whether it replaced an older one.
    fn put(&mut self, read: usize, packet: Vec<u8>) -> bool {
        let replaced = self.newest.insert(read, packet).is_some();
        if !replaced {
            self.order.push_back(read);
        }
        replaced
    }

    /// Puts back a packet that was not sent. Returns whether there is already a newer one.
    fn put_back(&mut self, read: usize, packet: Vec<u8>) -> bool {
        let outdated = self.newest.contains_key(&read);
        if !outdated {
            self.newest.insert(read, packet);
            self.order.push_front(read);
        }
        outdated
    }

    fn take(&mut self) -> Option<(usize, Vec<u8>)> {
        debug_assert_eq!(self.order.len(), self.newest.len());
        let read = self.order.pop_front()?;
        let packet = self.newest.remove(&read).expect("a read in the order has a packet");
        Some((read, packet))
    }
}

impl Forward {
    pub(super) fn new(settings: ForwardSettings, counters: Arc<ForwardCounters>) -> Rc<Forward> {
        Rc::new(Forward {
            settings,
            counters,
            waiting: RefCell::default(),
            news: Notify::new(),
            failures: Cell::new(0),
        })
    }

    /// Queues the bytes of a read, in place of older ones. Never waits.
    pub(super) fn offer(
        &self,
        read: usize,
        area: Area,
        address: u16,
        count: NonZeroU16,
        bytes: &[u8],
    ) {
        let area = in_packet(area);
        let header = Header { area, target: self.settings.target, address, count };
        let mut packet = Vec::with_capacity(self.settings.format.packet_len(&header));
        let encoded = self.settings.format.encode(&header, bytes, &mut packet);
        encoded.expect("the length of a read matches its count");
        if self.waiting.borrow_mut().put(read, packet) {
            self.counters.replaced.add();
        }
        self.news.notify_one();
    }

    /// Sends the queued packets, one after another, forever.
    pub(super) async fn run(self: Rc<Forward>) {
        loop {
            let next = self.waiting.borrow_mut().take();
            let Some((read, packet)) = next else {
                self.news.notified().await;
                continue;
            };
            match timeout(self.settings.timeout, self.send(&packet)).await {
                Ok(Ok(reply)) => {
                    self.failures.set(0);
                    let counters = &self.counters;
                    if reply == DONE { counters.sent.add() } else { counters.refused.add() }
                }
                Ok(Err(_)) | Err(_) => {
                    self.counters.failed.add();
                    if self.waiting.borrow_mut().put_back(read, packet) {
                        self.counters.replaced.add();
                    }
                    self.failures.set(self.failures.get().saturating_add(1));
                    sleep(backoff::pause(self.failures.get(), MAX_PAUSE)).await;
                }
            }
        }
    }

    async fn send(&self, packet: &[u8]) -> io::Result<u8> {
        let address = (self.settings.host.as_str(), self.settings.port);
        let mut stream = TcpStream::connect(address).await?;
        stream.write_all(packet).await?;
        stream.read_u8().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_take_turns_and_newer_bytes_replace_older_ones() {
        let mut waiting = Waiting::default();
        assert!(!waiting.put(0, vec![1]) && !waiting.put(1, vec![2]));
        let (read, packet) = waiting.take().unwrap();
        assert_eq!((read, &packet[..]), (0, &[1][..]));
        assert!(!waiting.put(0, vec![3]) && waiting.put(0, vec![4]));
        assert!(waiting.put_back(read, packet));
        let (read, packet) = waiting.take().unwrap();
        assert_eq!((read, &packet[..]), (1, &[2][..]));
        assert!(!waiting.put_back(read, packet));
        assert_eq!(waiting.take(), Some((1, vec![2])));
        assert_eq!(waiting.take(), Some((0, vec![4])));
        assert_eq!(waiting.take(), None);
    }
}
