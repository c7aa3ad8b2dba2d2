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
use holdfast_runtime::{Retry, lock};
use socket2::SockRef;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::time::{Instant, sleep, timeout_at};

use super::status::{BlockSettings, STATUS_BLOCK_LEN, Status};
use crate::counter::counters;
use crate::link::{Fence, agree, dial};
use crate::name_lookup;
use crate::raw_ingest_areas::in_packet;
use crate::socket_calls::ResendLimit;
use crate::tls::client::ClientTls;
use crate::tls::{Channel, TlsFailure};

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

/// What a packet has: a read, by its area, first address and count, or the status block. After a reload,
/// the index of a read may be that of another one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Content {
    Read(Area, u16, NonZeroU16),
    Status,
}

counters! {
    /// Counters of forwarded packets.
    pub struct ForwardCounters {
        sent,
        /// The receiver did not write the packet.
        refused,
        /// Connecting failed, or no reply arrived.
        failed,
        /// Packets replaced by newer bytes of the same read before they were sent.
        replaced,
        ;
        failure: Mutex<Option<ForwardFailure>>,
    }
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
    /// That of the device.
    fence: Option<Arc<Fence>>,
    waiting: RefCell<Waiting>,
    queued: Notify,
    withdrawn: Notify,
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
    pub(super) fn new(
        settings: ForwardSettings,
        counters: Arc<ForwardCounters>,
        fence: Option<Arc<Fence>>,
    ) -> Rc<Forward> {
        Rc::new(Forward {
            settings,
            counters,
            fence,
            waiting: RefCell::default(),
            queued: Notify::new(),
            withdrawn: Notify::new(),
            failures: Cell::new(0),
            last_status: RefCell::default(),
        })
    }

    /// Queues the bytes of a read, in place of older ones. Never waits.
    pub(super) fn offer(&self, area: Area, address: u16, count: NonZeroU16, bytes: &[u8]) {
        let read = Content::Read(area, address, count);
        let address = self.settings.address(area, address);
        let address = address.expect("offsets are checked when the device is made");
        let area = in_packet(area).expect(NO_FILES);
        let header = Header { area, target: self.settings.target, address, count };
        self.queue(read, &header, bytes);
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

    /// Drops the packets that are queued or not confirmed yet: another node has the lease of the device and
    /// forwards newer bytes, or the values come from elsewhere now. The status block is sent again.
    pub(super) fn withdraw(&self) {
        self.waiting.take();
        self.last_status.take();
        self.withdrawn.notify_waiters();
    }

    /// Whether the receiver may get packets of this node now.
    fn may_send(&self) -> bool {
        self.fence.as_ref().is_none_or(|fence| fence.allows())
    }

    /// Whether its device has this fence.
    pub(super) fn is_behind(&self, fence: Option<&Arc<Fence>>) -> bool {
        self.fence.as_ref().map(Arc::as_ptr) == fence.map(Arc::as_ptr)
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
            let sent = tokio::select! {
                biased;
                () = self.withdrawn.notified() => continue,
                sent = timeout_at(deadline, self.send(&packet, deadline)) => sent,
            };
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
                // The device may not have noticed yet that its lease has ended.
                Err(_) if !self.may_send() => self.withdraw(),
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
        let timeout = deadline.saturating_duration_since(Instant::now());
        ResendLimit::default().cover(SockRef::from(&stream), timeout);
        if let Some(tls) = &self.settings.tls {
            let channel = agree(&mut stream, tls).await?;
            self.check_lease()?;
            return send_over_tls(stream, channel, packet).await;
        }
        self.check_lease()?;
        stream.write_all(packet).await?;
        stream.read_u8().await
    }

    /// Called right before a packet is sent: the process may have been stopped since it was queued.
    fn check_lease(&self) -> io::Result<()> {
        if self.may_send() { Ok(()) } else { Err(io::Error::other("without the lease")) }
    }
}

/// Sends a packet over TLS. Returns the reply.
async fn send_over_tls(
    mut stream: TcpStream,
    mut channel: Channel,
    packet: &[u8],
) -> io::Result<u8> {
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
impl Forward {
    /// Whether a packet waits to be sent.
    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.borrow().order.is_empty()
    }
}

#[cfg(test)]
impl ForwardSettings {
    /// A receiver at this port of this computer.
    pub(super) fn for_tests(port: u16, status: Option<(u16, BlockSettings)>) -> ForwardSettings {
        ForwardSettings {
            host: "127.0.0.1".into(),
            port,
            tls: None,
            format: Format::V1,
            target: 1,
            timeout: Duration::from_secs(60),
            offsets: Vec::new(),
            status,
        }
    }
}

#[cfg(test)]
mod tests {
    use holdfast_memory::Term;
    use tokio::net::TcpListener;
    use tokio::runtime::Builder;
    use tokio::task::{LocalSet, spawn_local};

    use super::*;

    const AREA: Area = Area::HoldingRegisters;

    /// Runs a test with a receiver, and with what forwards to it behind a fence.
    fn with_receiver<F: Future<Output = ()>>(
        test: impl FnOnce(TcpListener, Rc<Forward>, Arc<Fence>) -> F,
    ) {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let receiver = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let block =
                BlockSettings { area: AREA, slot: 0, name: "meter".into(), keep_last_error: false };
            let port = receiver.local_addr().unwrap().port();
            let settings = ForwardSettings::for_tests(port, Some((2, block)));
            let fence = Arc::new(Fence::new(1));
            let forward = Forward::new(settings, Arc::default(), Some(Arc::clone(&fence)));
            spawn_local(Rc::clone(&forward).run());
            let test = test(receiver, forward, fence);
            tokio::time::timeout(Duration::from_secs(60), test).await.unwrap();
        });
    }

    fn open(fence: &Fence) {
        let until = std::time::Instant::now() + Duration::from_secs(3600);
        fence.open(until, Term::default(), Duration::ZERO);
    }

    fn offer(forward: &Forward, value: u8) {
        forward.offer(AREA, 0, NonZeroU16::MIN, &[0, value]);
    }

    /// Reads a packet with one register. Returns the low byte of its value.
    async fn value(stream: &mut TcpStream) -> u8 {
        let header = Header {
            area: in_packet(AREA).unwrap(),
            target: 1,
            address: 0,
            count: NonZeroU16::MIN,
        };
        let mut packet = vec![0; Format::V1.packet_len(&header)];
        stream.read_exact(&mut packet).await.unwrap();
        packet.pop().unwrap()
    }

    #[test]
    fn nothing_is_sent_without_the_lease() {
        with_receiver(async |receiver, forward, fence| {
            offer(&forward, 1);
            let (mut stream, _) = receiver.accept().await.unwrap();
            assert_eq!(stream.read(&mut [0]).await.unwrap(), 0, "it is connected, then closed");
            open(&fence);
            offer(&forward, 2);
            let (mut stream, _) = receiver.accept().await.unwrap();
            assert_eq!(value(&mut stream).await, 2);
        });
    }

    #[test]
    fn what_is_withdrawn_is_not_sent_again() {
        with_receiver(async |receiver, forward, fence| {
            open(&fence);
            offer(&forward, 1);
            let (mut unconfirmed, _) = receiver.accept().await.unwrap();
            assert_eq!(value(&mut unconfirmed).await, 1);
            offer(&forward, 2);
            forward.withdraw();
            offer(&forward, 3);
            let (mut stream, _) = receiver.accept().await.unwrap();
            assert_eq!(value(&mut stream).await, 3);
        });
    }

    #[test]
    fn a_status_block_that_was_withdrawn_is_sent_again() {
        with_receiver(async |_, forward, _| {
            let status = crate::poller::state::DeviceState::default().status();
            forward.offer_status(&status);
            assert!(forward.has_waiting());
            forward.withdraw();
            assert!(!forward.has_waiting());
            forward.offer_status(&status);
            assert!(forward.has_waiting());
        });
    }

    #[test]
    fn a_reload_that_leaves_out_a_read_does_not_put_newer_bytes_before_older_ones() {
        let forward = Forward::new(ForwardSettings::for_tests(1, None), Arc::default(), None);
        let offer = |address, value| forward.offer(AREA, address, NonZeroU16::MIN, &[0, value]);
        offer(0, 1);
        offer(10, 2);
        offer(10, 3);
        let mut waiting = forward.waiting.take();
        let packets = std::iter::from_fn(|| waiting.take());
        assert_eq!(packets.map(|(_, packet)| packet[packet.len() - 1]).collect::<Vec<_>>(), [1, 3]);
    }

    #[test]
    fn reads_take_turns_and_newer_bytes_replace_older_ones() {
        let mut waiting = Waiting::default();
        let (first, second) = (Content::Read(AREA, 0, NonZeroU16::MIN), Content::Status);
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
