//! Modbus on a serial line: one device, RTU or ASCII frames, one request at a time.
//!
//! Only frames for a unit that is served here are answered; all others, and damaged ones, are passed
//! over in silence. Unit id 0 is the broadcast: every memory takes the write, nobody replies.
//! A device that is lost is opened again until it is back.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use holdfast_protocol::frame::{ascii, rtu};
use holdfast_protocol::pdu::{self, Function};
use serial2_tokio::{CharSize, FlowControl, Parity, SerialPort, Settings, StopBits};
use tokio::sync::watch;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use crate::event::Kind;
use crate::framing::{Framing, Rtu};
use crate::listener::Front;
use crate::policy::{Grant, Rule};
use crate::station::Station;

/// The unit id that addresses all (Modbus over Serial Line V1.02, 2.2).
const BROADCAST: u8 = 0;

/// The longest pause between two characters of an ASCII frame (2.5.2.1).
const CHARACTER_TIMEOUT: Duration = Duration::from_secs(1);

/// Above 19,200 baud the silence between RTU frames does not get shorter (2.5.1.1).
const FAST: (u32, Duration) = (19_200, Duration::from_micros(1_750));

/// How often a lost device is tried.
const REOPEN: Duration = Duration::from_secs(1);

/// How long the line may take for a reply before it is held to be stuck.
const STUCK: Duration = Duration::from_secs(10);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineParity {
    None,
    Even,
    Odd,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineMode {
    /// A silence ends a frame; `None` for that of the standard.
    Rtu {
        silence: Option<Duration>,
    },
    Ascii,
}

/// A serial device and how it is set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    pub device: String,
    pub baud: u32,
    pub parity: LineParity,
    pub stop_bits: u8,
    pub data_bits: u8,
    pub mode: LineMode,
}

/// A listener on a serial line.
#[derive(Debug, Clone)]
pub struct SerialSettings {
    pub line: Line,
    /// A line has no sources: those of the rule are not looked at.
    pub rule: Rule,
}

impl Line {
    /// Opens the device, in the context of a runtime.
    pub(crate) fn open(&self) -> io::Result<SerialPort> {
        SerialPort::open(&self.device, |settings: Settings| self.set(settings))
    }

    /// Opens the device for blocking calls.
    pub(crate) fn open_blocking(&self) -> io::Result<serial2::SerialPort> {
        serial2::SerialPort::open(&self.device, |settings: Settings| self.set(settings))
    }

    fn set(&self, mut settings: Settings) -> io::Result<Settings> {
        settings.set_raw();
        settings.set_baud_rate(self.baud)?;
        settings.set_stop_bits(if self.stop_bits == 2 { StopBits::Two } else { StopBits::One });
        settings.set_flow_control(FlowControl::None);
        if !self.is_pseudo_terminal() {
            let seven = self.data_bits == 7;
            settings.set_char_size(if seven { CharSize::Bits7 } else { CharSize::Bits8 });
            settings.set_parity(match self.parity {
                LineParity::None => Parity::None,
                LineParity::Even => Parity::Even,
                LineParity::Odd => Parity::Odd,
            });
        }
        Ok(settings)
    }

    /// A pseudo terminal carries bytes: Linux refuses to give its characters another form.
    fn is_pseudo_terminal(&self) -> bool {
        let device = std::fs::canonicalize(&self.device);
        device.is_ok_and(|device| device.starts_with("/dev/pts"))
    }

    /// The silence that ends an RTU frame: 3.5 characters.
    pub(crate) fn silence(&self) -> Duration {
        let (fast, shortest) = FAST;
        match self.mode {
            LineMode::Rtu { silence: Some(silence) } => silence,
            _ if self.baud > fast => shortest,
            _ => {
                let parity = u32::from(self.parity != LineParity::None);
                let bits = 1 + u32::from(self.data_bits) + parity + u32::from(self.stop_bits);
                Duration::from_secs_f64(3.5 * f64::from(bits) / f64::from(self.baud))
            }
        }
    }
}

pub(crate) struct ModbusSerial {
    station: Arc<Station>,
    grant: Grant,
    line: Line,
}

impl ModbusSerial {
    pub(crate) fn new(settings: SerialSettings, station: Arc<Station>) -> ModbusSerial {
        ModbusSerial { station, grant: Grant::new(&settings.rule), line: settings.line }
    }

    /// Serves the line until `stop`.
    pub(crate) async fn serve(
        self,
        front: Arc<Front>,
        mut port: SerialPort,
        mut stop: watch::Receiver<bool>,
    ) {
        let mut stopping = std::pin::pin!(stop.wait_for(|stop| *stop));
        loop {
            let lost = async {
                match self.line.mode {
                    LineMode::Rtu { .. } => self.serve_rtu(&front, &port).await,
                    LineMode::Ascii => self.serve_ascii(&front, &port).await,
                }
            };
            tokio::select! {
                _ = &mut stopping => return,
                _ = lost => front.report(Kind::LineLost, None),
            }
            port = loop {
                tokio::select! {
                    _ = &mut stopping => return,
                    () = sleep(REOPEN) => {}
                }
                if let Ok(port) = self.line.open() {
                    break port;
                }
            };
            front.report(Kind::LineBack, None);
        }
    }

    /// Serves RTU frames until the device is lost.
    async fn serve_rtu(&self, front: &Front, port: &SerialPort) -> io::Error {
        let silence = self.line.silence();
        // One byte more than the longest frame: a longer one shows.
        let mut frame = [0; rtu::MAX_LEN + 1];
        let mut len = 0;
        let mut quiet = std::pin::pin!(sleep_until(Instant::now()));
        loop {
            let at = len.min(frame.len() - 1);
            // Characters that are there already end no silence, however late they are looked at.
            let read = tokio::select! {
                biased;
                read = port.read(&mut frame[at..]) => read,
                () = &mut quiet, if len > 0 => {
                    if let Err(error) = self.answer_rtu(front, port, &frame[..len]).await {
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

    async fn answer_rtu(&self, front: &Front, port: &SerialPort, frame: &[u8]) -> io::Result<()> {
        let Ok((unit_id, request)) = rtu::decode(frame) else {
            self.station.counters.frames.damaged.add();
            return Ok(());
        };
        let mut reply = [0; rtu::MAX_LEN];
        let Some(buffer) = reply[Rtu::HEADER_LEN..].first_chunk_mut::<{ pdu::MAX_LEN }>() else {
            return Ok(());
        };
        match self.answer(front, unit_id, request, buffer) {
            None => Ok(()),
            Some(len) => {
                let len = Rtu::complete(&mut reply, 0, unit_id, len);
                send(port, &reply[..len]).await
            }
        }
    }

    /// Serves ASCII frames until the device is lost.
    async fn serve_ascii(&self, front: &Front, port: &SerialPort) -> io::Error {
        let damaged = &self.station.counters.frames.damaged;
        let mut input = [0; 256];
        let mut frame: Vec<u8> = Vec::with_capacity(ascii::MAX_LEN);
        loop {
            let read = if frame.is_empty() {
                port.read(&mut input).await
            } else {
                match timeout(CHARACTER_TIMEOUT, port.read(&mut input)).await {
                    Ok(read) => read,
                    Err(_) => {
                        damaged.add();
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
                let ends =
                    character == self.station.ascii_delimiter() && frame.last() == Some(&b'\r');
                if character == b':' && !ends {
                    if !frame.is_empty() {
                        damaged.add();
                    }
                    frame.clear();
                } else if frame.is_empty() {
                    // Between frames: nothing that is for anybody.
                    continue;
                } else if frame.len() == ascii::MAX_LEN {
                    damaged.add();
                    frame.clear();
                    continue;
                }
                frame.push(character);
                if ends {
                    if let Err(error) = self.answer_ascii(front, port, &mut frame).await {
                        return error;
                    }
                    frame.clear();
                }
            }
        }
    }

    async fn answer_ascii(
        &self,
        front: &Front,
        port: &SerialPort,
        frame: &mut [u8],
    ) -> io::Result<()> {
        if let Some(delimiter) = frame.last_mut() {
            *delimiter = b'\n';
        }
        let mut body = [0; pdu::MAX_LEN + 2];
        let Ok((unit_id, request)) = ascii::decode(frame, &mut body) else {
            self.station.counters.frames.damaged.add();
            return Ok(());
        };
        let mut buffer = [0; pdu::MAX_LEN];
        let Some(len) = self.answer(front, unit_id, request, &mut buffer) else {
            return Ok(());
        };
        let mut reply = [0; ascii::MAX_LEN];
        match ascii::encode(unit_id, &buffer[..len], &mut reply) {
            None => Ok(()),
            Some(len) => send(port, &reply[..len]).await,
        }
    }

    /// The length of the reply, if one is due.
    fn answer(
        &self,
        front: &Front,
        unit_id: u8,
        request: &[u8],
        reply: &mut pdu::Buffer,
    ) -> Option<usize> {
        if unit_id == BROADCAST {
            self.broadcast(front, request);
            return None;
        }
        if self.grant.memory(unit_id).is_none() {
            self.station.counters.frames.other_unit.add();
            return None;
        }
        let len = self.station.answer(&self.grant, unit_id, request, reply);
        if let Some(auditor) = &front.auditor {
            let reply = &reply[..len.unwrap_or_default()];
            auditor.note(&front.name, None, unit_id, request, reply);
        }
        len
    }

    /// A write for all: every memory takes it, nobody replies.
    fn broadcast(&self, front: &Front, request: &[u8]) {
        let function = request.first().copied().and_then(Function::from_code);
        let wanted = function
            .is_some_and(|code| code.is_write() && code != Function::ReadWriteMultipleRegisters);
        if !wanted {
            self.station.counters.frames.other_unit.add();
            return;
        }
        self.station.broadcast(&self.grant, request, |reply| {
            if let Some(auditor) = &front.auditor {
                auditor.note(&front.name, None, BROADCAST, request, reply);
            }
        });
    }
}

/// Sends a reply; a line that does not take it is held to be lost.
async fn send(port: &SerialPort, reply: &[u8]) -> io::Result<()> {
    timeout(STUCK, port.write_all(reply))
        .await
        .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))?
}
