//! Turns a request PDU into its reply: the behaviour of all units of a listener. On a serial line
//! (`transports/serial.rs`), units that are not there are silent, and nothing answers a broadcast.
//!
//! The checks run in this order: the function is known and allowed (exception 01), the unit is
//! mapped (0B), form, quantity and value are right (03), the ranges of the peer have its addresses (02,
//! or 06 if the memory is sealed), a write can be recorded (04), the memory is not sealed (06), the range
//! is inside its area (02), what it mirrors is not stale (0B). The last three are checked in
//! `holdfast_memory::Memory`, under its lock. A denied function is refused before the unit
//! is looked up, so that a peer without rights cannot discover units. A unit in listen only mode never
//! answers. Of the form of a request for a device, only the length is checked (03, [`pdu::may_be_passed_on`]).

use std::sync::Arc;

use holdfast_memory::{Access, Area, Memory, Read, Write};
use holdfast_protocol::pdu::{
    self, Buffer, Diagnostics, ExceptionCode, Function, Range, Request, SubFunction, reply,
};
use holdfast_runtime::Counter;

use crate::items::Items;
use crate::link::{Asker, PendingReply, exception_in};
use crate::server::connections::reloadable::Reloadable;
use crate::server::reports::comm_events::{CommEvents, Received};
use crate::server::reports::counters::{Bus, Counters, FrameCounters};
use crate::server::requests::exceptions::{NOT_ALLOWED, exception_of, out_of_ranges};
use crate::server::requests::identity::Identity;
use crate::server::requests::listen_only::ListenOnly;
use crate::server::requests::{fifo_queue, file_records, journaled_write};
use crate::server::requests::{reading, writing};
use crate::server::rights::functions::is_write;
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::rule::RequestDestination;

/// What all units of a listener do.
#[derive(Debug, Clone, Copy, Default)]
pub struct UnitSettings {
    /// Whether function 8 may set a unit to listen only mode, for all peers.
    pub listen_only: bool,
    /// Whether events are kept for function 12.
    pub event_log: bool,
}

/// The units of one listener.
#[derive(Debug)]
pub struct UnitServer {
    pub counters: Counters,
    identity: Reloadable<Identity>,
    pub(crate) listen_only: ListenOnly,
    pub(super) comm_events: CommEvents,
}

/// The last character of the ASCII frames of a connection or line, until it is changed.
pub(crate) const ASCII_DELIMITER: u8 = b'\n';

/// The last character of later ASCII frames, if this request has changed it (V1.1b3, 6.8.1,
/// sub-function 03).
pub(crate) fn changed_delimiter(request: &[u8], reply: &[u8]) -> Option<u8> {
    let changes = reply.first() == Some(&Function::Diagnostics.code())
        && SubFunction::from_pdu(request) == Some(SubFunction::ChangeAsciiInputDelimiter);
    if changes { request.get(3).copied() } else { None }
}

impl UnitServer {
    pub fn new(identity: Identity, settings: UnitSettings) -> UnitServer {
        let (counters, identity) = (Counters::default(), Reloadable::new(identity));
        let listen_only = ListenOnly::new(settings.listen_only);
        let comm_events = CommEvents::new(settings.event_log);
        UnitServer { counters, identity, listen_only, comm_events }
    }

    /// Changes what a reload can change. Returns the units whose listen only mode this has ended.
    pub(crate) fn update(&self, identity: Identity, settings: UnitSettings) -> Vec<u8> {
        self.identity.replace(Arc::new(identity));
        self.comm_events.set(settings.event_log);
        self.listen_only.set_allowed(settings.listen_only)
    }

    /// Carries out a request and writes the reply. Returns its length, or `None` when there is no
    /// reply. `can_record` is called before a request is carried out that the peer may send, and makes room for
    /// its record; without room, the request is refused.
    #[inline]
    pub fn answer(
        &self,
        rights: &PeerRights,
        unit_id: u8,
        request: &[u8],
        can_record: impl FnOnce() -> bool,
        reply: &mut Buffer,
    ) -> Option<usize> {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        let logs = self.comm_events.is_on();
        let was_silent = logs && self.receive(unit_id);
        let served = self.serve(rights, unit_id, (function_code, request), can_record, reply);
        if logs {
            self.note_served(unit_id, request, was_silent, &served);
        }
        match served {
            Ok(Some(len)) => {
                if function_code != Function::GetCommEventCounter.code() {
                    self.counters.events.add();
                }
                Some(len)
            }
            Ok(None) => {
                self.counters.unanswered.add();
                None
            }
            Err(code) => {
                self.counters.exception(code);
                Some(reply::exception(function_code, code, reply))
            }
        }
    }

    /// Logs a request. Returns whether its unit is in listen only mode.
    #[cold]
    fn receive(&self, unit_id: u8) -> bool {
        let silent = self.listen_only.is_on(unit_id);
        self.comm_events.receive(Received::Request { silent });
        silent
    }

    /// Logs what became of a request, and what it did to communications. A reply comes before a restart
    /// (V1.1b3, 6.8.1, sub-function 01).
    #[cold]
    fn note_served(
        &self,
        unit_id: u8,
        request: &[u8],
        was_silent: bool,
        served: &Result<Option<usize>, ExceptionCode>,
    ) {
        let silent = self.listen_only.is_on(unit_id);
        if silent && !was_silent {
            self.comm_events.silence();
        }
        self.comm_events.send(served.err(), silent || was_silent);
        let restarts = SubFunction::from_pdu(request) == Some(SubFunction::RestartCommunications)
            && request.first() == Some(&Function::Diagnostics.code());
        if restarts && !silent && served.is_ok() {
            self.comm_events.restart(request.get(3) == Some(&0xFF));
        }
    }

    /// Counts and logs a frame that is not a request.
    pub(crate) fn discard(&self, counter: impl Fn(&FrameCounters) -> &Counter) {
        counter(&self.counters.frames).add();
        self.comm_events.receive(Received::Error);
    }

    /// Where a request goes that is not answered here; `None` if it is.
    #[inline]
    pub(crate) fn destination<'r>(
        &self,
        rights: &'r PeerRights,
        unit_id: u8,
        request: &[u8],
    ) -> Option<&'r RequestDestination> {
        let destinations = rights.destinations(unit_id)?;
        self.find_destination(destinations, unit_id, request)
    }

    /// The first destination that accepts a request. Not inline: most units have none.
    #[inline(never)]
    fn find_destination<'r>(
        &self,
        destinations: &'r [RequestDestination],
        unit_id: u8,
        request: &[u8],
    ) -> Option<&'r RequestDestination> {
        destinations.iter().find(|destination| match destination {
            RequestDestination::Device(_) => !self.listen_only.refuses(request),
            RequestDestination::Mirror(passage) => {
                !self.listen_only.is_on(unit_id) && passage.accepts(request)
            }
            RequestDestination::Journal(_) => !self.listen_only.is_on(unit_id) && is_write(request),
        })
    }

    /// Sends a request on its way to a device or a journal. Returns also the name of the device.
    /// `can_record` is called as by `answer`.
    ///
    /// # Errors
    /// The exception to answer it with.
    pub(crate) fn forward(
        &self,
        rights: &PeerRights,
        destination: &RequestDestination,
        asker: &Asker,
        unit_id: u8,
        request: &[u8],
        can_record: &mut dyn FnMut() -> bool,
    ) -> Result<(Option<Arc<str>>, PendingReply), ExceptionCode> {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        self.comm_events.receive(Received::Request { silent: false });
        let checked = check_forwarded(rights, destination, unit_id, request);
        let sent = checked.and_then(|()| match destination {
            _ if !can_record() => Err(ExceptionCode::ServerDeviceFailure),
            RequestDestination::Device(route) => route
                .ask(asker, unit_id, request)
                .map(|pending| (Some(Arc::clone(&route.name)), pending)),
            RequestDestination::Mirror(passage) => {
                passage.ask(request).map(|(device, pending)| (Some(device), pending))
            }
            RequestDestination::Journal(memory) => {
                journaled_write::submit(memory, request).map(|pending| (None, pending))
            }
        });
        sent.inspect_err(|code| {
            self.counters.exception(*code);
            self.comm_events.send(Some(*code), false);
        })
    }

    /// Drops a write to a device whose peer has ended. Returns whether it did: what is refused goes on, to be
    /// reported.
    pub(crate) fn withdraw(
        &self,
        rights: &PeerRights,
        device: &RequestDestination,
        unit_id: u8,
        request: &[u8],
    ) -> bool {
        if check_forwarded(rights, device, unit_id, request).is_err() {
            return false;
        }
        self.counters.request(request.first().copied().unwrap_or_default());
        if let RequestDestination::Device(route) = device {
            route.link.counters.requests.add();
            route.link.counters.withdrawn.add();
        }
        true
    }

    /// Counts what a device has answered, or what was answered in its place.
    pub(crate) fn forwarded(&self, request: &[u8], reply: &[u8]) {
        let exception = exception_in(reply);
        let refused = exception.and_then(ExceptionCode::from_code);
        self.comm_events.send(refused, false);
        match reply {
            [] => self.counters.unanswered.add(),
            _ if exception.is_some() => {
                if let Some(code) = refused {
                    self.counters.exception(code);
                }
            }
            _ if request.first() != Some(&Function::GetCommEventCounter.code()) => {
                self.counters.events.add();
            }
            _ => {}
        }
    }

    #[inline]
    pub(super) fn serve(
        &self,
        rights: &PeerRights,
        unit_id: u8,
        (function_code, pdu): (u8, &[u8]),
        can_record: impl FnOnce() -> bool,
        reply: &mut Buffer,
    ) -> Result<Option<usize>, ExceptionCode> {
        let request = Request::parse(pdu);
        let refusal = rights.refusal(unit_id, (function_code, pdu), &request);
        let denied = refusal.is_some()
            || self.listen_only.refuses(pdu)
            || function_code == Function::GetCommEventLog.code() && !self.comm_events.is_on();
        let memory = rights.memory(unit_id);
        if memory.is_some() && self.listen_only.is_on(unit_id) {
            if !denied && self.listen_only.end_by(unit_id, &request) {
                self.counters.clear_bus(Bus { no_response: 1, ..Bus::default() });
            }
            return Ok(None);
        }
        if denied {
            return Err(NOT_ALLOWED);
        }
        let memory = memory.ok_or(ExceptionCode::GatewayTargetFailedToRespond)?;
        let request = request.as_ref().map_err(|code| *code)?;
        if rights.ranges(unit_id).is_some_and(|ranges| !ranges.allow(request)) {
            return Err(out_of_ranges(memory));
        }
        if !can_record() {
            return Err(ExceptionCode::ServerDeviceFailure);
        }
        match *request {
            Request::ReadCoils(range) => {
                read(memory, Area::Coils, range, reply::read_coils(range, reply))
            }
            Request::ReadDiscreteInputs(range) => {
                let room = reply::read_discrete_inputs(range, reply);
                read(memory, Area::DiscreteInputs, range, room)
            }
            Request::ReadHoldingRegisters(range) => {
                let room = reply::read_holding_registers(range, reply);
                read(memory, Area::HoldingRegisters, range, room)
            }
            Request::ReadInputRegisters(range) => {
                let room = reply::read_input_registers(range, reply);
                read(memory, Area::InputRegisters, range, room)
            }
            Request::WriteSingleCoil { address, value } => {
                write(memory, writing(Area::Coils, address, 1, &[u8::from(value)]))?;
                Ok(reply::write_single_coil(address, value, reply))
            }
            Request::WriteSingleRegister { address, value } => {
                let bytes = value.to_be_bytes();
                write(memory, writing(Area::HoldingRegisters, address, 1, &bytes))?;
                Ok(reply::write_single_register(address, value, reply))
            }
            Request::WriteMultipleCoils { address, bits } => {
                write(memory, writing(Area::Coils, address, bits.quantity(), bits.as_bytes()))?;
                Ok(reply::write_multiple_coils(address, bits, reply))
            }
            Request::WriteMultipleRegisters { address, registers } => {
                let (count, bytes) = (registers.quantity(), registers.as_bytes());
                write(memory, writing(Area::HoldingRegisters, address, count, bytes))?;
                Ok(reply::write_multiple_registers(address, registers, reply))
            }
            Request::MaskWriteRegister { address, and_mask, or_mask } => {
                let area = Area::HoldingRegisters;
                let done = memory.mask_write(Access::Client, area, address, and_mask, or_mask);
                let answered = |()| reply::mask_write_register(address, and_mask, or_mask, reply);
                done.map_err(exception_of).map(answered)
            }
            Request::ReadWriteMultipleRegisters { read, write_address, registers } => {
                let area = Area::HoldingRegisters;
                let (count, bytes) = (registers.quantity(), registers.as_bytes());
                let (out, len) = reply::read_write_multiple_registers(read, reply);
                let done = memory.write_then_read(
                    Access::Client,
                    writing(area, write_address, count, bytes),
                    reading(area, read, out),
                );
                done.map_err(exception_of).map(|()| len)
            }
            _ if memory.sealed() => Err(ExceptionCode::ServerDeviceBusy),
            Request::Diagnostics(query) => {
                return Ok(self.diagnose(unit_id, query, reply));
            }
            Request::GetCommEventCounter => {
                Ok(reply::event_counter(false, self.counters.bus().events as u16, reply))
            }
            Request::GetCommEventLog => {
                let bus = self.counters.bus();
                let (events, messages) = (bus.events as u16, bus.messages as u16);
                let latest = self.comm_events.latest();
                let len = reply::event_log(false, events, messages, &latest, reply);
                Ok(len.expect("no more events are kept than fit into a reply"))
            }
            Request::ReadExceptionStatus => {
                let bits = exception_status(rights, unit_id, memory)?;
                Ok(reply::exception_status(bits, reply))
            }
            Request::ReportServerId => {
                let identity = self.identity.get();
                let text = &identity.card(unit_id).text;
                let len = reply::server_id(&[unit_id], true, text, reply);
                Ok(len.expect("the text of an identity fits into a reply"))
            }
            Request::ReadFileRecord(ranges) => file_records::read(memory, ranges, reply),
            Request::WriteFileRecord(records) => file_records::write(memory, records, reply),
            Request::ReadFifoQueue { address } => {
                fifo_queue::read(rights, unit_id, memory, address, reply)
            }
            Request::ReadDeviceIdentification { code, object_id } => {
                self.identity.get().card(unit_id).objects.reply(code, object_id, reply)
            }
        }
        .map(Some)
    }

    /// Function 8. The counters are those of the listener; their low 16 bits are sent.
    fn diagnose(&self, unit_id: u8, query: Diagnostics<'_>, reply: &mut Buffer) -> Option<usize> {
        let bus = self.counters.bus();
        let count = match query.sub_function() {
            // Each connection and line has a delimiter of its own, see `changed_delimiter`.
            SubFunction::ReturnQueryData | SubFunction::ChangeAsciiInputDelimiter => {
                return Some(reply::diagnostics_echo(query, reply));
            }
            SubFunction::RestartCommunications | SubFunction::ClearCounters => {
                self.counters.clear_bus(Bus { events: 1, ..Bus::default() });
                return Some(reply::diagnostics_echo(query, reply));
            }
            SubFunction::ForceListenOnlyMode => {
                self.listen_only.begin(unit_id);
                return None;
            }
            // This server has no overruns and sends no negative acknowledge.
            SubFunction::ClearOverrunCounter => return Some(reply::diagnostics_echo(query, reply)),
            SubFunction::ReturnServerNakCount
            | SubFunction::ReturnBusCharacterOverrunCount
            | SubFunction::ReturnDiagnosticRegister => 0,
            SubFunction::ReturnBusMessageCount => bus.messages,
            SubFunction::ReturnBusCommunicationErrorCount => bus.communication_errors,
            SubFunction::ReturnBusExceptionErrorCount => bus.exceptions,
            SubFunction::ReturnServerMessageCount => bus.server_messages,
            SubFunction::ReturnServerNoResponseCount => bus.no_response,
            SubFunction::ReturnServerBusyCount => bus.busy,
        };
        Some(reply::diagnostics(query.sub_function(), count as u16, reply))
    }
}

/// Whether a request reads or writes anything outside the ranges of a peer.
pub(super) fn exceeds_ranges(rights: &PeerRights, unit_id: u8, request: &[u8]) -> bool {
    rights
        .ranges(unit_id)
        .is_some_and(|ranges| Request::parse(request).is_ok_and(|request| !ranges.allow(&request)))
}

/// Checks a request to a device, a mirror or a journal, before it takes room for its record.
fn check_forwarded(
    rights: &PeerRights,
    destination: &RequestDestination,
    unit_id: u8,
    request: &[u8],
) -> Result<(), ExceptionCode> {
    let function_code = request.first().copied().unwrap_or_default();
    match destination {
        _ if !rights.allows(unit_id, function_code) => Err(NOT_ALLOWED),
        // A gateway may put it on a line, whose devices could read it as several requests: with
        // functions, and for units, that the peer may not use.
        RequestDestination::Device(_) if !pdu::may_be_passed_on(request) => {
            Err(ExceptionCode::IllegalDataValue)
        }
        RequestDestination::Device(_) if rights.denies(unit_id, request) => Err(NOT_ALLOWED),
        RequestDestination::Mirror(passage) if exceeds_ranges(rights, unit_id, request) => {
            Err(out_of_ranges(&passage.memory))
        }
        RequestDestination::Journal(memory) if exceeds_ranges(rights, unit_id, request) => {
            Err(out_of_ranges(memory))
        }
        // Also parsed when it is submitted: a malformed one takes no room.
        RequestDestination::Journal(_) => Request::parse(request).map(drop),
        RequestDestination::Device(_) | RequestDestination::Mirror(_) => Ok(()),
    }
}

// Not inlined, the parts of `out` are loaded before their stores are done: 2 % of a server's rate.
#[inline(always)]
fn read<const MAX: u16>(
    memory: &Memory,
    area: Area,
    range: Range<MAX>,
    (out, len): (&mut [u8], usize),
) -> Result<usize, ExceptionCode> {
    memory.read(Access::Client, reading(area, range, out)).map_err(exception_of).map(|()| len)
}

/// The bits of a memory that function 7 reads, under the checks of any other read.
fn exception_status(
    rights: &PeerRights,
    unit_id: u8,
    memory: &Memory,
) -> Result<u8, ExceptionCode> {
    let (area, address) = rights.exception_status(unit_id).ok_or(NOT_ALLOWED)?;
    let items = Items { area, address, count: 8 };
    if rights.ranges(unit_id).is_some_and(|ranges| !ranges.allow_read(items)) {
        return Err(out_of_ranges(memory));
    }
    let mut bits = [0];
    let read = Read { area, address, count: 8, out: &mut bits };
    memory.read(Access::Client, read).map_err(exception_of).map(|()| bits[0])
}

#[inline]
fn write(memory: &Memory, write: Write<'_>) -> Result<(), ExceptionCode> {
    memory.write(Access::Client, write).map_err(exception_of)
}
