//! Modbus on a serial line: one device, RTU or ASCII frames, one request at a time.
//!
//! The listener answers only frames for units that it serves, and ignores all others and damaged
//! ones. Unit id 0 is the broadcast: every memory carries out the write, no unit replies. A lost
//! device is opened again when it returns.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use holdfast_protocol::frame::{ascii, rtu};
use holdfast_protocol::pdu::{self, Function};
use serial2_tokio::SerialPort;
use tokio::sync::watch;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use crate::link::{Asker, source};
use crate::serial_line::{LineMode, SerialLine};
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

/// The unit id that addresses all units (Modbus over Serial Line V1.02, 2.2).
const BROADCAST: u8 = 0;

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
            source: source(),
            delimiter: AtomicU8::new(ASCII_DELIMITER),
            reported: Reported::default(),
        }
    }

    /// Serves the line until `stop`.
    pub(crate) async fn serve(
        self,
        context: Arc<ListenerContext>,
        mut port: SerialPort,
        mut stop: watch::Receiver<bool>,
    ) {
        let serving = Serving { context, running: stop.clone() };
        let mut stopping = std::pin::pin!(stop.wait_for(|stop| *stop));
        loop {
            let lost = async {
                match self.line.mode {
                    LineMode::Rtu { .. } => self.serve_rtu(&serving, &port).await,
                    LineMode::Ascii => self.serve_ascii(&serving, &port).await,
                }
            };
            tokio::select! {
                _ = &mut stopping => return,
                _ = lost => serving.context.report(Kind::LineLost, None),
            }
            port = loop {
                tokio::select! {
                    _ = &mut stopping => return,
                    () = sleep(REOPEN_INTERVAL) => {}
                }
                if let Ok(port) = self.line.open() {
                    break port;
                }
            };
            serving.context.report(Kind::LineBack, None);
        }
    }

    /// Serves RTU frames until the device is lost.
    async fn serve_rtu(&self, serving: &Serving, port: &SerialPort) -> io::Error {
        let silence = self.line.silence();
        // One byte more than the longest frame, so that a longer one is detected.
        let mut frame = [0; rtu::MAX_LEN + 1];
        let mut len = 0;
        let mut quiet = std::pin::pin!(sleep_until(Instant::now()));
        loop {
            let at = len.min(frame.len() - 1);
            // Characters that are already available do not count as silence, even if they are read
            // late.
            let read = tokio::select! {
                biased;
                read = port.read(&mut frame[at..]) => read,
                () = &mut quiet, if len > 0 => {
                    if let Err(error) = self.answer_rtu(serving, port, &frame[..len]).await {
                        return error;
                    }
                    len = 0;
                    continue;
                }
            };
            match read {
                Ok(0) => return io::ErrorKind::UnexpectedEof.into(),
                Ok(more) => len = at + more,
                Err(error) => return error,
            }
            quiet.as_mut().reset(Instant::now() + silence);
        }
    }

    async fn answer_rtu(
        &self,
        serving: &Serving,
        port: &SerialPort,
        frame: &[u8],
    ) -> io::Result<()> {
        let Ok((unit_id, request)) = rtu::decode(frame) else {
            self.damaged();
            return Ok(());
        };
        let mut reply = [0; rtu::MAX_LEN];
        let Some(buffer) = reply[Rtu::HEADER_LEN..].first_chunk_mut::<{ pdu::MAX_LEN }>() else {
            return Ok(());
        };
        match self.answer(serving, unit_id, request, buffer).await {
            None => Ok(()),
            Some(len) => {
                let len = Rtu::complete(&mut reply, 0, unit_id, len);
                send(port, &reply[..len]).await
            }
        }
    }

    /// Serves ASCII frames until the device is lost.
    async fn serve_ascii(&self, serving: &Serving, port: &SerialPort) -> io::Error {
        let mut input = [0; 256];
        let mut frame: Vec<u8> = Vec::with_capacity(ascii::MAX_LEN);
        loop {
            let read = if frame.is_empty() {
                port.read(&mut input).await
            } else {
                match timeout(CHARACTER_TIMEOUT, port.read(&mut input)).await {
                    Ok(read) => read,
                    Err(_) => {
                        self.damaged();
                        frame.clear();
                        continue;
                    }
                }
            };
            let len = match read {
                Ok(0) => return io::ErrorKind::UnexpectedEof.into(),
                Ok(len) => len,
                Err(error) => return error,
            };
            for &character in &input[..len] {
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
                    if let Err(error) = self.answer_ascii(serving, port, &mut frame).await {
                        return error;
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
    ) -> io::Result<()> {
        if let Some(delimiter) = frame.last_mut() {
            *delimiter = b'\n';
        }
        let mut body = [0; pdu::MAX_LEN + 2];
        let Ok((unit_id, request)) = ascii::decode(frame, &mut body) else {
            self.damaged();
            return Ok(());
        };
        let mut buffer = [0; pdu::MAX_LEN];
        let Some(len) = self.answer(serving, unit_id, request, &mut buffer).await else {
            return Ok(());
        };
        let mut reply = [0; ascii::MAX_LEN];
        match ascii::encode(unit_id, &buffer[..len], &mut reply) {
            None => Ok(()),
            Some(len) => send(port, &reply[..len]).await,
        }
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
        if unit_id == BROADCAST {
            self.broadcast(context, request).await;
            return None;
        }
        let rights = self.rights.get();
        if let Some(place) = self.unit_server.elsewhere(&rights, unit_id, request) {
            let asker = Asker { source: self.source, peer: None, waiting: 0 };
            let asked = Asked::send(context, place, (0, unit_id, request), |permitted| {
                self.unit_server.forward(&rights, place, &asker, unit_id, request, permitted)
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
        let (len, refused) = context.answer(ours, None, unit_id, request, reply);
        context.note_refused(refused, &self.reported, None);
        let answered = &reply[..len.unwrap_or_default()];
        if let Some(delimiter) = changed_delimiter(request, answered) {
            self.delimiter.store(delimiter, Ordering::Relaxed);
        }
        len
    }

    /// Carries out a broadcast: every memory carries out the write, no unit replies.
    async fn broadcast(&self, context: &ListenerContext, request: &[u8]) {
        let function = Function::from_pdu(request);
        let wanted = function.is_some_and(|function| {
            function.is_write() && function != Function::ReadWriteMultipleRegisters
        });
        if !wanted {
            self.unit_server.counters.frames.other_unit.add();
            return;
        }
        let permit = || context.permit(request);
        let note = |reply: &[u8], log_sequence, permit| {
            if let Some(auditor) = &context.auditor {
                let forwarded = Forwarded { route: None, request, reply, log_sequence };
                auditor.note_forwarded(&context.name, None, BROADCAST, forwarded, permit);
            }
        };
        self.unit_server.broadcast(&self.rights.get(), request, permit, note).await;
    }
}

/// Sends a reply. An error means that the line is lost.
async fn send(port: &SerialPort, reply: &[u8]) -> io::Result<()> {
    timeout(WRITE_TIMEOUT, port.write_all(reply))
        .await
        .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))?
}
