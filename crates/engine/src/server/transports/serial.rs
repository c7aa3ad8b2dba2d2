//! Modbus on a serial line: one device, RTU or ASCII frames, one request at a time.
//!
//! The listener answers only frames for units that it serves, and ignores all others, damaged ones, and
//! exceptions, which are never requests. Unit id 0 is the broadcast: every memory carries out the write, no unit replies. A lost
//! device is opened again when it returns.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use holdfast_memory::Memory;
use holdfast_protocol::frame::{ascii, rtu};
use holdfast_protocol::pdu::{self, Function};
use serial2_tokio::SerialPort;
use tokio::sync::watch;
use tokio::time::{sleep, sleep_until, timeout};

use crate::link::{Asker, new_source};
use crate::serial_line::{LineMode, OpenLine, SerialLine};
use crate::server::connections::listener::ListenerContext;
use crate::server::connections::reloadable::Reloadable;
use crate::server::connections::reply_order::{Asked, Expected};
use crate::server::reports::audit::Forwarded;
use crate::server::reports::event::Kind;
use crate::server::reports::refused_request::Reported;
use crate::server::requests::unit_server::{
    ASCII_DELIMITER, UnitServer, UnitSettings, changed_delimiter,
};
use crate::server::rights::peer_rights::PeerRights;
use crate::server::rights::rule::Rule;
use crate::server::transports::framing::{Framing, Rtu};
use crate::server::transports::line_echo::LineEcho;
use crate::server::transports::rtu_line::{RtuLine, has_more};

/// The unit id that addresses all units (Modbus over Serial Line V1.02, 2.2).
const BROADCAST: u8 = 0;

/// The most characters of an ASCII line that wait while a request is carried out: two frames.
const MAX_AHEAD: usize = 2 * ascii::MAX_LEN;

/// The longest pause between two characters of an ASCII frame (2.5.2.1).
const CHARACTER_TIMEOUT: Duration = Duration::from_secs(1);

/// The interval between attempts to open a lost device.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// A line that does not send a reply within this time counts as lost.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// A listener on a serial line.
#[derive(Debug, Clone)]
pub struct SerialSettings {
    pub line: SerialLine,
    /// The sources of the rule are ignored: a serial line has none.
    pub rule: Rule,
    pub units: UnitSettings,
}

pub(crate) struct ModbusSerial {
    unit_server: Arc<UnitServer>,
    rights: Arc<Reloadable<PeerRights>>,
    line: SerialLine,
    /// The number of the line as a source of requests to devices.
    source: u64,
    /// The last character of an ASCII frame.
    delimiter: AtomicU8,
    reported: Reported,
}

/// What an answer needs of the listener.
struct Serving {
    context: Arc<ListenerContext>,
    /// The engine waits until all of it is dropped.
    running: watch::Receiver<bool>,
}

/// What is received while a request is carried out.
enum Input<'i> {
    Rtu(&'i mut RtuLine),
    Ascii(&'i mut VecDeque<u8>),
}

impl Input<'_> {
    async fn receive(&mut self, port: &SerialPort) -> io::Result<()> {
        match self {
            Input::Rtu(line) => line.receive_newer(port).await,
            Input::Ascii(characters) => receive(port, characters).await,
        }
    }

    /// Whether a request has come, or begun: noise is none.
    fn has_request(&self) -> bool {
        match self {
            Input::Rtu(line) => line.has_request(),
            Input::Ascii(characters) => characters.contains(&b':'),
        }
    }
}

impl ModbusSerial {
    pub(crate) fn new(
        line: SerialLine,
        rights: Arc<Reloadable<PeerRights>>,
        unit_server: Arc<UnitServer>,
    ) -> ModbusSerial {
        ModbusSerial {
            unit_server,
            rights,
            line,
            source: new_source(),
            delimiter: AtomicU8::new(ASCII_DELIMITER),
            reported: Reported::default(),
        }
    }

    /// Serves the line until `stop`.
    pub(crate) async fn serve(
        self,
        context: Arc<ListenerContext>,
        mut line: OpenLine<SerialPort>,
        mut stop: watch::Receiver<bool>,
    ) {
        let serving = Serving { context, running: stop.clone() };
        let mut stopping = std::pin::pin!(stop.wait_for(|stop| *stop));
        loop {
            let lost = async {
                match self.line.mode {
                    LineMode::Rtu { .. } => self.serve_rtu(&serving, &line.port).await,
                    LineMode::Ascii => self.serve_ascii(&serving, &line.port).await,
                }
            };
            tokio::select! {
                _ = &mut stopping => return,
                _ = lost => serving.context.report(Kind::LineLost, None),
            }
            // The system gives its name to the next device only when nobody has the lost one.
            drop(line);
            line = loop {
                tokio::select! {
                    _ = &mut stopping => return,
                    () = sleep(REOPEN_INTERVAL) => {}
                }
                if let Ok(line) = self.line.open() {
                    break line;
                }
            };
            serving.context.report(Kind::LineBack, None);
        }
    }

    /// Serves RTU frames until the device is lost.
    async fn serve_rtu(&self, serving: &Serving, port: &SerialPort) -> io::Error {
        let (mut line, mut echo) = (RtuLine::new(&self.line), LineEcho::default());
        loop {
            let (end, has_begun) = (line.end(), !line.bytes().is_empty());
            // Characters that are already available do not count as silence, even if they are read
            // late.
            let done = tokio::select! {
                biased;
                received = line.receive(port) => received,
                () = sleep_until(end), if has_begun => {
                    let is_echo = echo.begins_with(line.bytes());
                    if line.waits_for_rest(is_echo, |unit_id| self.is_served(unit_id)) {
                        continue;
                    }
                    let echoed = echo.at_start_of(line.bytes(), false);
                    if echoed > 0 {
                        line.skip(echoed);
                        continue;
                    }
                    let (frame, len) = line.take();
                    self.answer_rtu(serving, port, &frame[..len], &mut line, &mut echo).await
                }
            };
            if let Err(error) = done {
                return error;
            }
            line.skip(echo.at_start_of(line.bytes(), true));
        }
    }

    async fn answer_rtu(
        &self,
        serving: &Serving,
        port: &SerialPort,
        frame: &[u8],
        line: &mut RtuLine,
        echo: &mut LineEcho,
    ) -> io::Result<()> {
        let (false, Ok((unit_id, request))) = (has_more(frame), rtu::decode(frame)) else {
            self.damaged();
            return Ok(());
        };
        echo.request();
        let mut reply = [0; rtu::MAX_LEN];
        let Some(buffer) = reply[Rtu::HEADER_LEN..].first_chunk_mut::<{ pdu::MAX_LEN }>() else {
            return Ok(());
        };
        let answer = self.answer(serving, unit_id, request, buffer);
        let is_broadcast = unit_id == BROADCAST;
        let Some(pdu_len) = unless_newer(answer, is_broadcast, Input::Rtu(line), port).await?
        else {
            return Ok(());
        };
        let len = Rtu::complete(&mut reply, 0, unit_id, pdu_len);
        let pdu = &reply[Rtu::HEADER_LEN..][..pdu_len];
        echo.sent(frame, (&reply[..len], pdu), self.line.character() * len as u32);
        send(port, &reply[..len]).await
    }

    /// Whether frames for a unit id are requests to this listener.
    fn is_served(&self, unit_id: u8) -> bool {
        let rights = self.rights.get();
        let is_known = rights.memory(unit_id).is_some() || rights.destinations(unit_id).is_some();
        is_known || unit_id == BROADCAST
    }

    /// Serves ASCII frames until the device is lost.
    async fn serve_ascii(&self, serving: &Serving, port: &SerialPort) -> io::Error {
        let mut echo = LineEcho::default();
        let mut input = VecDeque::new();
        let mut frame: Vec<u8> = Vec::with_capacity(ascii::MAX_LEN);
        loop {
            let received = if frame.is_empty() {
                receive(port, &mut input).await
            } else {
                match timeout(CHARACTER_TIMEOUT, receive(port, &mut input)).await {
                    Ok(received) => received,
                    Err(_) => {
                        self.damaged();
                        frame.clear();
                        continue;
                    }
                }
            };
            if let Err(error) = received {
                return error;
            }
            while let Some(character) = input.pop_front() {
                let delimiter = self.delimiter.load(Ordering::Relaxed);
                let ends = character == delimiter && frame.last() == Some(&b'\r');
                if character == b':' && !ends {
                    if !frame.is_empty() {
                        self.damaged();
                    }
                    frame.clear();
                } else if frame.is_empty() {
                    // Characters between frames are ignored.
                    continue;
                } else if frame.len() == ascii::MAX_LEN {
                    self.damaged();
                    frame.clear();
                    continue;
                }
                frame.push(character);
                if ends {
                    if echo.at_start_of(&frame, false) == 0 {
                        let ahead = (&mut input, &mut echo);
                        let answered = self.answer_ascii(serving, port, &mut frame, ahead).await;
                        if let Err(error) = answered {
                            return error;
                        }
                    }
                    frame.clear();
                }
            }
        }
    }

    async fn answer_ascii(
        &self,
        serving: &Serving,
        port: &SerialPort,
        frame: &mut [u8],
        (input, echo): (&mut VecDeque<u8>, &mut LineEcho),
    ) -> io::Result<()> {
        if let Some(delimiter) = frame.last_mut() {
            *delimiter = b'\n';
        }
        let mut body = [0; pdu::MAX_LEN + 2];
        let Ok((unit_id, request)) = ascii::decode(frame, &mut body) else {
            self.damaged();
            return Ok(());
        };
        echo.request();
        let mut buffer = [0; pdu::MAX_LEN];
        let answer = self.answer(serving, unit_id, request, &mut buffer);
        let is_broadcast = unit_id == BROADCAST;
        let Some(len) = unless_newer(answer, is_broadcast, Input::Ascii(input), port).await? else {
            return Ok(());
        };
        let (pdu, mut reply) = (&buffer[..len], [0; ascii::MAX_LEN]);
        let Some(len) = ascii::encode(unit_id, pdu, &mut reply) else { return Ok(()) };
        echo.sent(frame, (&reply[..len], pdu), self.line.character() * len as u32);
        send(port, &reply[..len]).await
    }

    fn damaged(&self) {
        self.unit_server.discard(|frames| &frames.damaged);
    }

    /// Returns the length of the reply, if there is one.
    async fn answer(
        &self,
        serving: &Serving,
        unit_id: u8,
        request: &[u8],
        reply: &mut pdu::Buffer,
    ) -> Option<usize> {
        let Serving { context, running } = serving;
        // The exception of another server, or a late echo. To answer it would go on without end.
        if request.first().is_some_and(|code| code & 0x80 != 0) {
            self.unit_server.counters.frames.other_unit.add();
            return None;
        }
        if unit_id == BROADCAST {
            self.broadcast(context, request).await;
            return None;
        }
        let rights = self.rights.get();
        if let Some(destination) = self.unit_server.destination(&rights, unit_id, request) {
            let asker = Asker { source: self.source, peer: None };
            let asked = Asked::send(context, destination, (0, unit_id, request), |can_record| {
                self.unit_server.forward(&rights, destination, &asker, unit_id, request, can_record)
            });
            let (asked, answered, refused) = asked;
            context.note_refused(refused, &self.reported, None);
            let answered = match answered {
                Expected::Pending(pending) => {
                    let ours = (Arc::clone(&self.unit_server), Arc::clone(context));
                    asked.answered(pending, ours, None, running.clone()).await
                }
                Expected::Known(reply) => {
                    asked.record(context, None, &reply);
                    reply
                }
            };
            let answered = answered.pdu;
            reply[..answered.len()].copy_from_slice(&answered);
            return (!answered.is_empty()).then_some(answered.len());
        }
        if rights.memory(unit_id).is_none() {
            self.unit_server.counters.frames.other_unit.add();
            return None;
        }
        let ours = (&*self.unit_server, &*rights);
        let len = context.answer(ours, (None, &self.reported), unit_id, request, reply);
        let answered = &reply[..len.unwrap_or_default()];
        if let Some(delimiter) = changed_delimiter(request, answered) {
            self.delimiter.store(delimiter, Ordering::Relaxed);
        }
        len
    }

    /// Carries out a broadcast: every memory carries out the write, no unit replies.
    async fn broadcast(&self, context: &ListenerContext, request: &[u8]) {
        if !Function::from_pdu(request).is_some_and(Function::can_be_broadcast) {
            self.unit_server.counters.frames.other_unit.add();
            return;
        }
        let permit = || context.permit(request);
        let note = |memory: Option<&Memory>, reply: &[u8], log_sequence, permit| {
            if let Some(auditor) = &context.auditor {
                let memory = memory.and_then(Memory::name);
                let forwarded = Forwarded { memory, route: None, request, reply, log_sequence };
                auditor.note_forwarded(&context.name, None, BROADCAST, forwarded, permit);
            }
        };
        let refused = self.unit_server.broadcast(&self.rights.get(), request, permit, note).await;
        context.note_refused(refused, &self.reported, None);
    }
}

/// Waits for a reply. Returns its length; `None` if there is none, or as soon as another request comes: the
/// master has given up, and would take it for the reply to that one. A broadcast has no reply to give up.
async fn unless_newer(
    answer: impl Future<Output = Option<usize>>,
    is_broadcast: bool,
    mut input: Input<'_>,
    port: &SerialPort,
) -> io::Result<Option<usize>> {
    let mut answer = std::pin::pin!(answer);
    let mut lost = None;
    loop {
        tokio::select! {
            biased;
            len = &mut answer => return lost.map_or(Ok(len), Err),
            received = input.receive(port), if lost.is_none() => match received {
                // Whatever follows the request: another unit may answer it.
                Ok(()) if !is_broadcast && input.has_request() => return Ok(None),
                Ok(()) => {}
                Err(error) => lost = Some(error),
            },
        }
    }
}

/// Receives characters. An error means that the line is lost.
async fn receive(port: &SerialPort, input: &mut VecDeque<u8>) -> io::Result<()> {
    let mut bytes = [0; 256];
    match port.read(&mut bytes).await? {
        0 => Err(io::ErrorKind::UnexpectedEof.into()),
        len => {
            input.extend(&bytes[..len]);
            input.drain(..input.len().saturating_sub(MAX_AHEAD));
            Ok(())
        }
    }
}

/// Sends a reply. An error means that the line is lost.
async fn send(port: &SerialPort, reply: &[u8]) -> io::Result<()> {
    timeout(WRITE_TIMEOUT, port.write_all(reply))
        .await
        .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))?
}
