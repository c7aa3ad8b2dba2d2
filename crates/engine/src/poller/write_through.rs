//! Writes of Modbus clients into ranges that devices are read into: they are passed on to the device.
//!
//! A request must touch one such range and nothing else. It is sent with the area and the address of
//! the device; the client gets the device's answer. When the device has confirmed it, the memory holds
//! the new value before the client has its reply.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use holdfast_memory::{Access, Area, Memory, Outcome, Refusal, Write};
use holdfast_protocol::pdu::{EncodedRequest, ExceptionCode, Function, Range, Request};
use holdfast_runtime::suspend_aware_time;
use tokio::sync::{mpsc, oneshot};

use super::destination::ReadSettings;
use crate::client::ClientError;
use crate::items::{Items, touched};
use crate::link::{
    Caller, Down, Fault, Fence, Link, PendingReply, Permit, Priority, Receiver, Wanted,
    confirmation, exception, exception_code, exception_in, fault, pending_reply, standstill,
    submit_under,
};

/// The most writes into one memory that wait for devices.
const MAX_WAITING: usize = 256;

/// A range of a memory, and where it comes from.
#[derive(Debug, Clone)]
pub struct PassedRange {
    /// Coils or holding registers.
    pub area: Area,
    pub address: u16,
    pub count: u32,
    pub device: Arc<str>,
    /// The first address in the same area of the device.
    pub device_address: u16,
    /// Whether function 22 is carried out as a read and function 6.
    pub emulate: bool,
}

/// The ranges of a memory whose writes are passed on.
#[derive(Debug)]
pub struct Passage {
    pub memory: Arc<Memory>,
    ranges: Vec<PassedRange>,
    writes: mpsc::UnboundedSender<PassedWrite>,
    waiting: Arc<AtomicUsize>,
}

/// A write on its way to a device.
pub(super) struct PassedWrite {
    memory: Arc<Memory>,
    access: Access,
    range: PassedRange,
    /// What it writes in the memory.
    written: Items,
    /// As the client sent it.
    pdu: Vec<u8>,
    /// As the device gets it.
    request: EncodedRequest,
    /// When it came, by [`suspend_aware_time`].
    queued: Duration,
    reply: Receiver,
    _place: Place,
}

/// Values that a device has accepted or returned, in its own addresses.
pub(super) struct Change {
    pub(super) area: Area,
    pub(super) address: u16,
    pub(super) count: u32,
    /// As in a [`Write`].
    pub(super) bytes: Vec<u8>,
}

/// The place of a write that waits. It is free again when this is dropped.
struct Place(Arc<AtomicUsize>);

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl PassedRange {
    fn items(&self) -> Items {
        Items { area: self.area, address: self.address, count: self.count }
    }
}

impl Passage {
    pub(super) fn new(
        memory: Arc<Memory>,
        ranges: Vec<PassedRange>,
        writes: mpsc::UnboundedSender<PassedWrite>,
    ) -> Passage {
        Passage { memory, ranges, writes, waiting: Arc::default() }
    }

    /// Whether a request writes into one of the ranges.
    pub(crate) fn accepts(&self, pdu: &[u8]) -> bool {
        Function::from_pdu(pdu).is_some_and(Function::is_write)
            && Request::parse(pdu).is_ok_and(|request| {
                let (_, written) = touched(&request);
                written.is_some_and(|written| {
                    self.ranges.iter().any(|range| written.overlaps(range.items()))
                })
            })
    }

    /// Sends such a request of a client on its way. Returns the name of the device too.
    ///
    /// # Errors
    /// The exception to refuse it with: the memory is sealed, the request writes the gate bit or touches
    /// more than one range, too many wait, or the poller has stopped.
    pub(crate) fn ask(&self, pdu: &[u8]) -> Result<(Arc<str>, PendingReply), ExceptionCode> {
        let (reply, pending) = pending_reply();
        let device = self.pass(Access::Client, pdu, Receiver::Client(reply))?;
        Ok((device, pending))
    }

    /// The device that a range of the memory is read from, if one write can change it.
    pub fn device_of(&self, area: Area, address: u16, count: u32) -> Option<&str> {
        let items = Items { area, address, count };
        let range = self.ranges.iter().find(|range| items.is_in(range.items()));
        range.map(|range| &*range.device)
    }

    /// Sends a write that is not of a Modbus client, and waits for the answer of the device.
    ///
    /// # Errors
    /// The code of the exception: of the device, or as for clients.
    pub fn write(&self, request: &Request<'_>) -> Result<(), u8> {
        let encoded = EncodedRequest::new(request);
        let (reply, pending) = pending_reply();
        self.pass(Access::Ingest, encoded.pdu(), Receiver::Client(reply))
            .map_err(ExceptionCode::code)?;
        match pending.wait() {
            Ok(reply) => exception_in(&reply.pdu).map_or(Ok(()), Err),
            Err(_) => Err(ExceptionCode::GatewayPathUnavailable.code()),
        }
    }

    /// Sends a write of an event loop on its way, which can withdraw it. Returns the ticket.
    pub fn call(&self, caller: &Arc<Caller>, request: &Request<'_>) -> u64 {
        let encoded = EncodedRequest::new(request);
        let (ticket, waiting) = caller.begin(&encoded, Duration::MAX, false);
        // What is refused here ends as lost, and was not sent.
        let _ = self.pass(Access::Ingest, encoded.pdu(), Receiver::EventLoop(waiting));
        ticket
    }

    fn pass(&self, access: Access, pdu: &[u8], reply: Receiver) -> Result<Arc<str>, ExceptionCode> {
        let request = Request::parse(pdu)?;
        let (read, written) = touched(&request);
        let written = written.ok_or(ExceptionCode::IllegalFunction)?;
        admit(&self.memory, access, written)?;
        let is_whole = |range: &&PassedRange| {
            let range = range.items();
            written.is_in(range) && read.is_none_or(|read| read.is_in(range))
        };
        let range = self.ranges.iter().find(is_whole).ok_or(ExceptionCode::IllegalDataAddress)?;
        let place = Place(Arc::clone(&self.waiting));
        if self.waiting.fetch_add(1, Ordering::Relaxed) >= MAX_WAITING {
            return Err(ExceptionCode::GatewayPathUnavailable);
        }
        let passed = PassedWrite {
            memory: Arc::clone(&self.memory),
            access,
            range: range.clone(),
            written,
            request: translated(pdu, range, read.is_some())?,
            pdu: pdu.to_vec(),
            queued: suspend_aware_time(),
            reply,
            _place: place,
        };
        let sent = self.writes.send(passed);
        sent.or(Err(ExceptionCode::GatewayPathUnavailable))?;
        Ok(Arc::clone(&range.device))
    }
}

/// Whether a memory lets these items be changed in the device.
fn admit(memory: &Memory, access: Access, written: Items) -> Result<(), ExceptionCode> {
    let Items { area, address, count } = written;
    let checked = memory.check_passed(access, (area, address, count as usize));
    checked.map_err(|refusal| match refusal {
        Refusal::Sealed => ExceptionCode::ServerDeviceBusy,
        _ => ExceptionCode::IllegalDataAddress,
    })
}

/// The request with the addresses of the device.
fn translated(
    pdu: &[u8],
    range: &PassedRange,
    has_read: bool,
) -> Result<EncodedRequest, ExceptionCode> {
    let mut moved = pdu.to_vec();
    // Function 23 has the address to read, the quantity to read, and the address to write.
    for at in [Some(1), has_read.then_some(5)].into_iter().flatten() {
        let Some(bytes) = moved.get_mut(at..).and_then(<[u8]>::first_chunk_mut::<2>) else {
            return Err(ExceptionCode::IllegalDataValue);
        };
        let offset = u16::from_be_bytes(*bytes) - range.address;
        let device_address = range.device_address.checked_add(offset);
        *bytes = device_address.ok_or(ExceptionCode::IllegalDataAddress)?.to_be_bytes();
    }
    EncodedRequest::parse(&moved)
}

impl PassedWrite {
    pub(super) fn device(&self) -> &str {
        &self.range.device
    }

    /// Refuses it: it was not sent. If its memory is sealed by now, that is the reason.
    pub(super) fn refuse(self) {
        let refusal = admit(&self.memory, self.access, self.written).err();
        let code = refusal.unwrap_or(ExceptionCode::GatewayPathUnavailable);
        self.reply.send(exception(&self.pdu, code.code()));
    }

    /// Whether its memory still admits it, for a [`Permit`]: the seal may close while it waits.
    fn admitted(&self) -> Wanted {
        let (memory, access, written) = (Arc::clone(&self.memory), self.access, self.written);
        Arc::new(move |_| admit(&memory, access, written).is_ok())
    }

    /// Carries it out. Returns what memory has of it: what has changed in the device, and what
    /// function 23 has read.
    pub(super) async fn carry_out(
        self,
        (link, unit_id, reads): (&Link, u8, &RefCell<Vec<ReadSettings>>),
        timeout: Duration,
        permit: &Permit,
    ) -> Vec<Change> {
        if self.reply.is_unwanted() {
            return Vec::new();
        }
        let function = self.request.pdu()[0];
        // What waits for a silent unit must not reach it in a burst when it is back.
        let is_silent = link.admit(unit_id, function) == Err(Down::Unit);
        let is_down = is_silent || link.retry_at().is_some();
        if is_down || !self.is_mirrored(reads) {
            self.refuse();
            return Vec::new();
        }
        // The last notes that it is sent.
        let of_client = permit
            .and(standstill::none_since(self.queued))
            .and(self.admitted())
            .and(self.reply.wanted());
        let call = async |request: &EncodedRequest, permit| {
            link.call(unit_id, request, timeout, Priority::Urgent, permit).await
        };
        let mask = match self.request.request() {
            Some(Request::MaskWriteRegister { address, and_mask, or_mask }) => {
                Some((address, and_mask, or_mask))
            }
            _ => None,
        };
        let read = |address| {
            let range = Range::new(address, 1).expect("one register is a valid range");
            EncodedRequest::new(&Request::ReadHoldingRegisters(range))
        };
        let mut value = None;
        let answered = match mask {
            Some((address, and_mask, or_mask)) if self.range.emulate => {
                let masked = |pdu: &[u8]| {
                    let now = register(pdu)?;
                    let new = (now & and_mask) | (or_mask & !and_mask);
                    value = Some(new);
                    let write = Request::WriteSingleRegister { address, value: new };
                    Some(EncodedRequest::new(&write))
                };
                link.read_then_write(unit_id, &read(address), masked, timeout, &of_client).await
            }
            Some((address, ..)) => match call(&self.request, &of_client).await {
                Ok(answer) => {
                    // The memory may not know what the device had before. What it can't show is not
                    // confirmed, although the device has carried it out.
                    value = call(&read(address), permit).await.ok().and_then(|pdu| register(&pdu));
                    let unknown =
                        ClientError::Exception(ExceptionCode::GatewayTargetFailedToRespond.code());
                    if value.is_some() { Ok(answer) } else { Err(unknown.into()) }
                }
                refused => refused,
            },
            None => call(&self.request, &of_client).await,
        };
        let outcome = answered.as_ref().map(drop).map_err(|error| fault(error));
        // Its device or its client has gone, or may have gone in a standstill, or its memory was sealed, and
        // it was not sent.
        if outcome == Err(Fault::Expired) {
            if !self.reply.is_unwanted() {
                self.refuse();
            }
            return Vec::new();
        }
        // Without the lease, nothing was sent.
        if outcome != Err(Fault::Standby) {
            link.record((unit_id, function), outcome);
        }
        match answered {
            Ok(answer) => self.confirm(&answer, value, reads, permit).await,
            Err(error) => {
                self.reply.send(exception(&self.pdu, exception_code(&error)));
                Vec::new()
            }
        }
    }

    /// Takes what the device has confirmed into memory, then replies. `value` is what the device holds
    /// after function 22.
    async fn confirm(
        self,
        answer: &[u8],
        value: Option<u16>,
        reads: &RefCell<Vec<ReadSettings>>,
        permit: &Permit,
    ) -> Vec<Change> {
        let mut changes: Vec<Change> = self.change(value).into_iter().collect();
        if let Ok(Request::ReadWriteMultipleRegisters { read, .. }) = Request::parse(&self.pdu)
            && let Some(bytes) = answer.get(2..)
        {
            let (address, count) = (self.device_address_of(read.address()), read.quantity().into());
            let area = Area::HoldingRegisters;
            changes.push(Change { area, address, count, bytes: bytes.to_vec() });
        }
        let mut is_stored = true;
        for change in &changes {
            // A reload may have given the range to another device meanwhile.
            is_stored &= self.is_mirrored(reads) && self.store(change, permit.fence.as_ref()).await;
        }
        let reply = match Function::from_pdu(&self.pdu) {
            // What memory can't show is not confirmed, although the device has carried it out.
            _ if !is_stored => {
                exception(&self.pdu, ExceptionCode::GatewayTargetFailedToRespond.code())
            }
            Some(Function::ReadWriteMultipleRegisters) => answer.to_vec(),
            _ => confirmation(&self.pdu).to_vec(),
        };
        self.reply.send(reply);
        changes
    }

    /// Whether the range still is read from the device, to the same place.
    fn is_mirrored(&self, reads: &RefCell<Vec<ReadSettings>>) -> bool {
        let PassedRange { area, address, count, device_address, .. } = self.range;
        let (address, device_address) = (u32::from(address), u32::from(device_address));
        reads.borrow().iter().any(|read| {
            let first = u32::from(read.address);
            let has_all = first <= device_address && device_address + count <= first + read.count;
            let into = read.into.as_ref().filter(|_| read.area == area && has_all);
            into.is_some_and(|into| {
                Arc::ptr_eq(&into.memory, &self.memory)
                    && into.area == area
                    && u32::from(into.address) + (device_address - first) == address
            })
        })
    }

    /// What the device has taken over.
    fn change(&self, value: Option<u16>) -> Option<Change> {
        let request = self.request.request()?;
        let Items { area, address, count } = touched(&request).1?;
        let bytes = match request {
            Request::WriteSingleCoil { value, .. } => vec![u8::from(value)],
            Request::WriteSingleRegister { value, .. } => value.to_be_bytes().to_vec(),
            Request::WriteMultipleCoils { bits, .. } => bits.as_bytes().to_vec(),
            Request::WriteMultipleRegisters { registers, .. } => registers.as_bytes().to_vec(),
            Request::ReadWriteMultipleRegisters { registers, .. } => registers.as_bytes().to_vec(),
            _ => value?.to_be_bytes().to_vec(),
        };
        Some(Change { area, address, count, bytes })
    }

    /// The address of the device that belongs to one of the memory.
    fn device_address_of(&self, address: u16) -> u16 {
        address - self.range.address + self.range.device_address
    }

    /// Whether memory has taken a change. Waits for its journal, if it has one, without holding up other
    /// devices.
    async fn store(&self, change: &Change, fence: Option<&Arc<Fence>>) -> bool {
        let address = change.address - self.range.device_address + self.range.address;
        let Change { area, count, ref bytes, .. } = *change;
        let write = Write { area, address, count: count as usize, bytes };
        let stored = if self.memory.has_journal() {
            let (done, outcome) = oneshot::channel();
            let kept = Box::new(|outcome: Outcome| {
                let _ = done.send(outcome);
            });
            let submitted = submit_under(fence, &self.memory, Access::Mirror, write, kept);
            let carried_out = outcome.await.is_ok_and(|outcome| outcome.is_ok());
            submitted.map(|()| carried_out)
        } else {
            self.memory.write(Access::Mirror, write).map(|()| true)
        };
        let fits = !matches!(stored, Err(Refusal::OutOfRange | Refusal::WrongLength));
        debug_assert!(fits, "a mirrored range is inside its memory: {stored:?}");
        stored.unwrap_or(false)
    }
}

/// The register in the reply to a read of one.
fn register(pdu: &[u8]) -> Option<u16> {
    pdu.get(2..)?.first_chunk::<2>().map(|bytes| u16::from_be_bytes(*bytes))
}
