//! Forwarding: what was read goes on as Raw Ingest packets. A target that is down costs the device
//! nothing; when it is back, it gets the newest of each read.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::io;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use holdfast_protocol::raw_ingest::{DONE, Format, Header};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::time::{sleep, timeout};

use super::backoff;
use crate::counters::Counter;

/// A receiver of Raw Ingest packets.
#[derive(Debug, Clone)]
pub struct ForwardSettings {
    pub host: String,
    pub port: u16,
    pub format: Format,
    /// The unit id (v1) or memory id (crc) that packets name.
    pub target: u16,
    pub timeout: Duration,
}

/// What became of packets.
#[derive(Debug, Default)]
pub struct ForwardCounters {
    pub sent: Counter,
    /// The receiver answered that it did not write.
    pub refused: Counter,
    /// There was no connection, or no reply.
    pub failed: Counter,
    /// Replaced by newer bytes of the same read before they were sent.
    pub replaced: Counter,
}

/// One target of one device.
pub(super) struct Forward {
    settings: ForwardSettings,
    pub(super) counters: Arc<ForwardCounters>,
    /// The newest packet of each read that has not been sent.
    waiting: RefCell<BTreeMap<usize, Vec<u8>>>,
    news: Notify,
    failures: Cell<u32>,
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

    /// Takes the bytes of a read, in place of older ones. Never waits.
    pub(super) fn offer(&self, read: usize, area: u8, address: u16, count: u16, bytes: &[u8]) {
        let header = Header { area, target: self.settings.target, address, count };
        let mut packet = Vec::with_capacity(self.settings.format.packet_len(&header));
        self.settings.format.encode(&header, bytes, &mut packet);
        if self.waiting.borrow_mut().insert(read, packet).is_some() {
            self.counters.replaced.add();
        }
        self.news.notify_one();
    }

    /// Sends what was offered, one packet after the other, for ever.
    pub(super) async fn run(self: Rc<Forward>) {
        loop {
            let next = self.waiting.borrow_mut().pop_first();
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
                    // It goes first again, unless there are newer bytes by then.
                    self.waiting.borrow_mut().entry(read).or_insert(packet);
                    self.failures.set(self.failures.get().saturating_add(1));
                    sleep(backoff::pause(self.failures.get())).await;
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
