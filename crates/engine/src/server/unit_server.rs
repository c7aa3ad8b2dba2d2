//! Turns a request PDU into its reply: the behaviour of all units of a listener, on every
//! transport.
//!
//! The checks run in this order: the function is known and allowed (exception 01), the unit is
//! mapped (0B), form, quantity and value are right (03), a write can be recorded (04), the memory is
//! not sealed (06), the range is inside its area (02), what it mirrors is not stale (0B). A denied function is refused before the unit is looked up, so that a
//! peer without rights cannot discover units. A unit in listen only mode never answers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use holdfast_memory::{Access, Area, Memory, Write};
use holdfast_protocol::pdu::{
    self, Buffer, Diagnostics, ExceptionCode, Function, Range, Request, SubFunction, reply,
};

use super::counters::{Bus, Counters};
use super::functions::is_write;
use super::identity::Identity;
use super::journaled_write;
use super::live::Live;
use super::memory_operations::{exception_of, reading, writing};
use super::policy::{Elsewhere, PeerRights};
use crate::link::{Asker, PendingReply};

/// The units of one listener.
#[derive(Debug)]
pub struct UnitServer {
    pub counters: Counters,
    identity: Live<Identity>,
    /// Whether peers may set units to listen only mode. It lasts for all peers of the listener.
    listen_only: AtomicBool,
    /// Units in listen only mode (V1.1b3, 6.8.1, sub-function 04).
    silent: [AtomicBool; 256],
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
    pub fn new(identity: Identity, listen_only: bool) -> UnitServer {
        let silent = [const { AtomicBool::new(false) }; 256];
        let (counters, identity) = (Counters::default(), Live::new(identity));
        let listen_only = AtomicBool::new(listen_only);
        UnitServer { counters, identity, listen_only, silent }
    }

    /// Changes what a reload can change.
    pub(crate) fn update(&self, identity: Identity, listen_only: bool) {
        self.identity.replace(Arc::new(identity));
        self.listen_only.store(listen_only, Ordering::Relaxed);
    }

    /// Carries out a request and writes the reply. Returns its length, or `None` when there is no
    /// reply. A request that is not `permitted` could not be recorded, and is refused.
    #[inline]
    pub fn answer(
        &self,
        rights: &PeerRights,
        unit_id: u8,
        request: &[u8],
        permitted: bool,
        reply: &mut Buffer,
    ) -> Option<usize> {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        match self.serve(rights, unit_id, (function_code, request), permitted, reply) {
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

    /// Whether a request would silence a unit for all peers, and the listener does not allow that.
    #[inline]
    pub(crate) fn refuses_silence(&self, request: &[u8]) -> bool {
        !self.listen_only.load(Ordering::Relaxed)
            && request.first() == Some(&Function::Diagnostics.code())
            && SubFunction::from_pdu(request) == Some(SubFunction::ForceListenOnlyMode)
    }

    /// Where a request goes that is not answered here.
    #[inline]
    pub(crate) fn elsewhere<'r>(
        &self,
        rights: &'r PeerRights,
        unit_id: u8,
        request: &[u8],
    ) -> Option<&'r Elsewhere> {
        let places = rights.elsewhere(unit_id)?;
        self.find_destination(places, unit_id, request)
    }

    /// The first place that accepts a request. Not inline: most units have no such places.
    #[inline(never)]
    fn find_destination<'r>(
        &self,
        places: &'r [Elsewhere],
        unit_id: u8,
        request: &[u8],
    ) -> Option<&'r Elsewhere> {
        places.iter().find(|place| match place {
            Elsewhere::Device(_) => !self.refuses_silence(request),
            Elsewhere::Mirror(passage) => !self.is_silent(unit_id) && passage.accepts(request),
            Elsewhere::Journal(_) => !self.is_silent(unit_id) && is_write(request),
        })
    }

    /// Sends a request on its way to a device or a journal. Returns also the name of the device.
    ///
    /// # Errors
    /// The exception to answer it with.
    pub(crate) fn forward(
        &self,
        rights: &PeerRights,
        place: &Elsewhere,
        asker: &Asker,
        unit_id: u8,
        request: &[u8],
        permitted: bool,
    ) -> Result<(Option<Arc<str>>, PendingReply), ExceptionCode> {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        let sent = match place {
            _ if !rights.allows(unit_id, function_code) => Err(ExceptionCode::IllegalFunction),
            Elsewhere::Device(_) if rights.denies(unit_id, request) => {
                Err(ExceptionCode::IllegalFunction)
            }
            _ if !permitted => Err(ExceptionCode::ServerDeviceFailure),
            Elsewhere::Mirror(passage) if outside(rights, unit_id, request) => {
                Err(out_of_ranges(&passage.memory))
            }
            Elsewhere::Journal(memory) if outside(rights, unit_id, request) => {
                Err(out_of_ranges(memory))
            }
            Elsewhere::Device(route) => route
                .ask(asker, unit_id, request)
                .map(|pending| (Some(Arc::clone(&route.name)), pending)),
            Elsewhere::Mirror(passage) => {
                passage.ask(request).map(|(device, pending)| (Some(device), pending))
            }
            Elsewhere::Journal(memory) => {
                journaled_write::submit(memory, request).map(|pending| (None, pending))
            }
        };
        sent.inspect_err(|code| self.counters.exception(*code))
    }

    /// Counts what a device has answered, or what was answered in its place.
    pub(crate) fn forwarded(&self, request: &[u8], reply: &[u8]) {
        match reply {
            [] => self.counters.unanswered.add(),
            [code, exception, ..] if code & 0x80 != 0 => {
                if let Some(code) = ExceptionCode::from_code(*exception) {
                    self.counters.exception(code);
                }
            }
            _ if request.first() != Some(&Function::GetCommEventCounter.code()) => {
                self.counters.events.add();
            }
            _ => {}
        }
    }

    /// Carries out a broadcast write (Serial Line V1.02, 2.1). It counts as one message without a
    /// reply, even if several memories carry it out. `permit` is asked before each, and `note` receives
    /// the permit, the reply that each would have sent, and where a log has the write. A journal is
    /// waited for, because what follows on the line expects the effects.
    pub async fn broadcast<P>(
        &self,
        rights: &PeerRights,
        request: &[u8],
        mut permit: impl FnMut() -> Option<P>,
        mut note: impl FnMut(&[u8], Option<u64>, Option<P>),
    ) {
        let function_code = request.first().copied().unwrap_or_default();
        self.counters.request(function_code);
        self.counters.unanswered.add();
        let (mut carried_out, mut refused) = (false, None);
        let may =
            |unit_id| rights.allows(unit_id, function_code) && !outside(rights, unit_id, request);
        for unit_id in rights.one_unit_of_each_memory(|unit_id| !self.is_silent(unit_id), may) {
            let permit = permit();
            let journal = rights
                .memory(unit_id)
                .filter(|memory| memory.has_journal() && permit.is_some() && may(unit_id));
            let (reply, log_sequence) = match journal {
                Some(memory) => journaled_write::carry_out(memory, request).await,
                None => {
                    let (mut reply, asked) = ([0; pdu::MAX_LEN], (function_code, request));
                    let done = self.serve(rights, unit_id, asked, permit.is_some(), &mut reply);
                    let len = match done {
                        Ok(len) => len.unwrap_or_default(),
                        Err(code) => reply::exception(function_code, code, &mut reply),
                    };
                    (reply[..len].to_vec(), None)
                }
            };
            match reply[..] {
                [code, exception, ..] if code & 0x80 != 0 => {
                    refused = refused.or(ExceptionCode::from_code(exception));
                }
                _ => carried_out = true,
            }
            note(&reply, log_sequence, permit);
        }
        match refused {
            Some(code) => self.counters.exception(code),
            None if carried_out => self.counters.events.add(),
            None => {}
        }
    }

    #[inline]
    fn is_silent(&self, unit_id: u8) -> bool {
        self.silent[usize::from(unit_id)].load(Ordering::Relaxed)
    }

    #[inline]
    fn serve(
        &self,
        rights: &PeerRights,
        unit_id: u8,
        (function_code, pdu): (u8, &[u8]),
        permitted: bool,
        reply: &mut Buffer,
    ) -> Result<Option<usize>, ExceptionCode> {
        let request = Request::parse(pdu);
        let denied = !rights.allows(unit_id, function_code)
            || self.refuses_silence(pdu)
            || denied(rights, unit_id, pdu, &request);
        let memory = rights.memory(unit_id);
        if memory.is_some() && self.is_silent(unit_id) {
            if !denied {
                self.listen(unit_id, &request);
            }
            return Ok(None);
        }
        if denied {
            return Err(ExceptionCode::IllegalFunction);
        }
        let memory = memory.ok_or(ExceptionCode::GatewayTargetFailedToRespond)?;
        let request = request?;
        if !permitted {
            return Err(ExceptionCode::ServerDeviceFailure);
        }
        if rights.ranges(unit_id).is_some_and(|ranges| !ranges.allow(&request)) {
            return Err(out_of_ranges(memory));
        }
        match request {
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
            Request::Diagnostics(asked) => {
                return Ok(self.diagnose(unit_id, asked, reply));
            }
            Request::GetCommEventCounter => {
                Ok(reply::event_counter(false, self.counters.bus().events as u16, reply))
            }
            Request::ReportServerId => {
                let identity = self.identity.get();
                let text = &identity.card(unit_id).text;
                let len = reply::server_id(&[unit_id], true, text, reply);
                Ok(len.expect("the text of an identity fits into a reply"))
            }
            Request::ReadDeviceIdentification { code, object_id } => {
                self.identity.get().card(unit_id).objects.reply(code, object_id, reply)
            }
        }
        .map(Some)
    }

    /// In listen only mode, a unit carries out only the request that ends the mode, without a
    /// reply.
    fn listen(&self, unit_id: u8, request: &Result<Request<'_>, ExceptionCode>) {
        if let Ok(Request::Diagnostics(asked)) = request
            && asked.sub_function() == SubFunction::RestartCommunications
        {
            self.silent[usize::from(unit_id)].store(false, Ordering::Relaxed);
            self.counters.clear_bus(Bus { no_response: 1, ..Bus::default() });
        }
    }

    /// Function 8. The counters are those of the listener; their low 16 bits are sent.
    fn diagnose(&self, unit_id: u8, asked: Diagnostics<'_>, reply: &mut Buffer) -> Option<usize> {
        let bus = self.counters.bus();
        let count = match asked.sub_function() {
            // Each connection and line has a delimiter of its own, see `changed_delimiter`.
            SubFunction::ReturnQueryData | SubFunction::ChangeAsciiInputDelimiter => {
                return Some(reply::diagnostics_echo(asked, reply));
            }
            SubFunction::RestartCommunications | SubFunction::ClearCounters => {
                self.counters.clear_bus(Bus { events: 1, ..Bus::default() });
                return Some(reply::diagnostics_echo(asked, reply));
            }
            SubFunction::ForceListenOnlyMode => {
                self.silent[usize::from(unit_id)].store(true, Ordering::Relaxed);
                return None;
            }
            // This server has no overruns and sends no negative acknowledge.
            SubFunction::ClearOverrunCounter => return Some(reply::diagnostics_echo(asked, reply)),
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
        Some(reply::diagnostics(asked.sub_function(), count as u16, reply))
    }
}

/// Whether a sub-function is unknown, or not allowed for a read-only peer. Like the function, it is
/// checked before anything else.
fn denied(
    rights: &PeerRights,
    unit_id: u8,
    pdu: &[u8],
    request: &Result<Request<'_>, ExceptionCode>,
) -> bool {
    if *request == Err(ExceptionCode::IllegalFunction) {
        return true;
    }
    let diagnostics = pdu.first() == Some(&Function::Diagnostics.code());
    diagnostics
        && rights.is_read_only(unit_id)
        && SubFunction::from_pdu(pdu).is_some_and(SubFunction::changes_state)
}

/// Whether a request reads or writes what the rights of a peer leave out.
fn outside(rights: &PeerRights, unit_id: u8, request: &[u8]) -> bool {
    rights
        .ranges(unit_id)
        .is_some_and(|ranges| Request::parse(request).is_ok_and(|request| !ranges.allow(&request)))
}

/// The refusal of such a request: a sealed memory is busy for every request.
fn out_of_ranges(memory: &Memory) -> ExceptionCode {
    if memory.sealed() {
        ExceptionCode::ServerDeviceBusy
    } else {
        ExceptionCode::IllegalDataAddress
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

#[inline]
fn write(memory: &Memory, write: Write<'_>) -> Result<(), ExceptionCode> {
    memory.write(Access::Client, write).map_err(exception_of)
}
