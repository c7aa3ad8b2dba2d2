//! Forwards reads as Raw Ingest packets. A receiver that is down does not delay the device. When it is
//! back, it gets the newest bytes of each read.

use std::cell::{Cell, RefCell};
use std::collections::{HashMap, VecDeque};
use std::io::{self, ErrorKind};
use std::num::NonZeroU16;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use holdfast_memory::Area;
use holdfast_protocol::raw_ingest::{DONE, Format, Header};
use holdfast_runtime::{Counter, Retry, lock};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep, timeout_at};

use super::status::{BlockSettings, STATUS_BLOCK_LEN, Status};
use crate::link::{agree, dial};
use crate::name_lookup;
use crate::raw_ingest_areas::in_packet;
use crate::tls::TlsFailure;
use crate::tls::client::ClientTls;

/// The longest pause before a receiver that is down is tried again.
const MAX_PAUSE: Duration = Duration::from_secs(10);

/// Why a block has an area that packets have too.
const NO_FILES: &str = "files of devices are not polled";

/// Bytes per read of a socket.
const CHUNK_BYTES: usize = 1024;

/// A receiver of Raw Ingest packets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ForwardSettings {
    pub host: String,
    pub port: u16,
    /// `None` is plain TCP.
    pub tls: Option<Arc<ClientTls>>,
    pub format: Format,
    /// The unit id (v1) or memory id (crc) in packets.
    pub target: u16,
    pub timeout: Duration,
    /// Added to the addresses of reads, for each area; 0 for other areas.
    pub offsets: Vec<(Area, u16)>,
    /// The status block of the device, with the unit id or memory id in its packets.
    pub status: Option<(u16, BlockSettings)>,
}

impl ForwardSettings {
    /// The address in packets; `None` beyond 65535.
    pub(super) fn address(&self, area: Area, address: u16) -> Option<u16> {
        let offset = self.offsets.iter().find(|(of, _)| *of == area);
        address.checked_add(offset.map_or(0, |(_, offset)| *offset))
    }
}

/// What a packet has: a read, by its index, or the status block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Content {
    Read(usize),
    Status,
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
    failure: Mutex<Option<ForwardFailure>>,
}

/// Why a packet was not confirmed.
#[derive(Debug, Clone)]
pub struct ForwardFailure {
    /// A word for programs, if TLS failed.
    pub reason: Option<&'static str>,
    pub text: String,
}

impl ForwardCounters {
    /// The last failure.
    pub fn failure(&self) -> Option<ForwardFailure> {
        lock(&self.failure).clone()
    }

    fn fail(&self, error: &io::Error) {
        let tls = error.get_ref().and_then(|inner| inner.downcast_ref::<TlsFailure>());
        let failure =
            ForwardFailure { reason: tls.map(TlsFailure::reason), text: error.to_string() };
        self.failed.add();
        *lock(&self.failure) = Some(failure);
    }
}

/// One receiver of one device.
pub(super) struct Forward {
    settings: ForwardSettings,
    pub(super) counters: Arc<ForwardCounters>,
    waiting: RefCell<Waiting>,
    queued: Notify,
    failures: Cell<u32>,
    /// The status block that was offered last.
    last_status: RefCell<Vec<u8>>,
}

/// The newest unsent packet of each content, in the order of arrival.
#[derive(Default)]
struct Waiting {
    order: VecDeque<Content>,
    newest: HashMap<Content, Vec<u8>>,
}

impl Waiting {
    /// Queues a packet. Returns whether it replaced an older one.
    fn put(&mut self, of: Content, packet: Vec<u8>) -> bool {
        let replaced = self.newest.insert(of, packet).is_some();
        if !replaced {
            self.order.push_back(of);
        }
        replaced
    }

    /// Puts back a packet that was not sent. Returns whether there is already a newer one.
    fn put_back(&mut self, of: Content, packet: Vec<u8>) -> bool {
        let outdated = self.newest.contains_key(&of);
        if !outdated {
            self.newest.insert(of, packet);
            self.order.push_front(of);
        }
        outdated
    }

    fn take(&mut self) -> Option<(Content, Vec<u8>)> {
        debug_assert_eq!(self.order.len(), self.newest.len());
        let of = self.order.pop_front()?;
        let packet = self.newest.remove(&of).expect("what is in the order has a packet");
        Some((of, packet))
    }
}

impl Forward {
    pub(super) fn new(settings: ForwardSettings, counters: Arc<ForwardCounters>) -> Rc<Forward> {
        Rc::new(Forward {
            settings,
            counters,
            waiting: RefCell::default(),
            queued: Notify::new(),
            failures: Cell::new(0),
            last_status: RefCell::default(),
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
        let address = self.settings.address(area, address);
        let address = address.expect("offsets are checked when the device is made");
        let area = in_packet(area).expect(NO_FILES);
        let header = Header { area, target: self.settings.target, address, count };
        self.queue(Content::Read(read), &header, bytes);
    }

    /// Whether the receiver gets the status block.
    pub(super) fn has_status(&self) -> bool {
        self.settings.status.is_some()
    }

    /// Queues the status block, if the receiver gets it and it has changed. Never waits.
    pub(super) fn offer_status(&self, status: &Status) {
        let Some((target, block)) = &self.settings.status else { return };
        let bytes = status.bytes(block);
        if *self.last_status.borrow() == bytes {
            return;
        }
        let header = Header {
            area: in_packet(block.area).expect(NO_FILES),
            target: *target,
            address: block.address().expect("the block is checked when the device is made"),
            count: const { NonZeroU16::new(STATUS_BLOCK_LEN).unwrap() },
        };
        self.queue(Content::Status, &header, &bytes);
        self.last_status.replace(bytes);
    }

    fn queue(&self, of: Content, header: &Header, bytes: &[u8]) {
        let mut packet = Vec::with_capacity(self.settings.format.packet_len(header));
        let encoded = self.settings.format.encode(header, bytes, &mut packet);
        encoded.expect("the length of the bytes matches their count");
        if self.waiting.borrow_mut().put(of, packet) {
            self.counters.replaced.add();
        }
        self.queued.notify_one();
    }

    /// Sends the queued packets, one after another, forever.
    pub(super) async fn run(self: Rc<Forward>) {
        loop {
            let next = self.waiting.borrow_mut().take();
            let Some((of, packet)) = next else {
                self.queued.notified().await;
                continue;
            };
            let deadline = Instant::now() + self.settings.timeout;
            let sent = timeout_at(deadline, self.send(&packet, deadline)).await;
            let too_late = || {
                let seconds = self.settings.timeout.as_secs_f64();
                io::Error::new(ErrorKind::TimedOut, format!("no reply within {seconds} s"))
            };
            match sent.unwrap_or_else(|_| Err(too_late())) {
                Ok(reply) => {
                    self.failures.set(0);
                    let counters = &self.counters;
                    if reply == DONE { counters.sent.add() } else { counters.refused.add() }
                }
                Err(error) => {
                    self.counters.fail(&error);
                    if self.waiting.borrow_mut().put_back(of, packet) {
                        self.counters.replaced.add();
                    }
                    self.failures.set(self.failures.get().saturating_add(1));
                    sleep(Retry::default().up_to(MAX_PAUSE).pause(self.failures.get())).await;
                }
            }
        }
    }

    async fn send(&self, packet: &[u8], deadline: Instant) -> io::Result<u8> {
        let found = name_lookup::addresses_of(&self.settings.host, self.settings.port).await?;
        let mut stream = dial(found, deadline).await?;
        if let Some(tls) = &self.settings.tls {
            return send_over_tls(stream, tls, packet).await;
        }
        stream.write_all(packet).await?;
        stream.read_u8().await
    }
}

/// Sends a packet over TLS. Returns the reply.
async fn send_over_tls(mut stream: TcpStream, tls: &ClientTls, packet: &[u8]) -> io::Result<u8> {
    let mut channel = agree(&mut stream, tls).await?;
    let (mut plain, mut out, mut chunk) = (Vec::new(), Vec::new(), [0; CHUNK_BYTES]);
    channel.send(packet, &mut out);
    // A receiver that refuses the certificate closes the connection. Its alert says why.
    let sent = stream.write_all(&out).await;
    loop {
        let len = match stream.read(&mut chunk).await {
            Ok(len @ 1..) => len,
            Ok(_) => return Err(sent.err().unwrap_or_else(|| lost(TlsFailure::ClosedBeforeReply))),
            Err(error) => return Err(sent.err().unwrap_or(error)),
        };
        out.clear();
        let received = channel.receive(&chunk[..len], &mut plain, &mut out);
        if let Some(reply) = plain.first() {
            channel.end(&mut out);
            let _ = stream.try_write(&out);
            return Ok(*reply);
        }
        received.map_err(|error| lost(TlsFailure::from(&error)))?;
        if channel.has_ended() {
            return Err(lost(TlsFailure::ClosedBeforeReply));
        }
        stream.write_all(&out).await?;
    }
}

fn lost(failure: TlsFailure) -> io::Error {
    io::Error::other(failure)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_take_turns_and_newer_bytes_replace_older_ones() {
        let mut waiting = Waiting::default();
        let (first, second) = (Content::Read(0), Content::Status);
        assert!(!waiting.put(first, vec![1]) && !waiting.put(second, vec![2]));
        let (of, packet) = waiting.take().unwrap();
        assert_eq!((of, &packet[..]), (first, &[1][..]));
        assert!(!waiting.put(first, vec![3]) && waiting.put(first, vec![4]));
        assert!(waiting.put_back(of, packet));
        let (of, packet) = waiting.take().unwrap();
        assert_eq!((of, &packet[..]), (second, &[2][..]));
        assert!(!waiting.put_back(of, packet));
        assert_eq!(waiting.take(), Some((second, vec![2])));
        assert_eq!(waiting.take(), Some((first, vec![4])));
        assert_eq!(waiting.take(), None);
    }
}
