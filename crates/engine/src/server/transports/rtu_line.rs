//! The RTU frames that arrive on a serial line: a silence ends them (Modbus over Serial Line V1.02, 2.5.1.1).

use std::io;
use std::time::Duration;

use holdfast_protocol::frame::rtu;
use holdfast_protocol::frame::rtu_stream::{Next, Requests};
use serial2_tokio::SerialPort;
use tokio::time::Instant;

use crate::serial_line::{LineMode, SerialLine};

/// How long the rest of a request is waited for: adapters collect bytes for up to 16 ms, and deliver them
/// together.
const PACKET_PAUSE: Duration = Duration::from_millis(30);

/// One byte more than the longest frame, so that a longer one is detected.
const MAX_BYTES: usize = rtu::MAX_LEN + 1;

/// What has been received since the last frame.
pub(super) struct RtuLine {
    bytes: [u8; MAX_BYTES],
    len: usize,
    silence: Duration,
    /// Whether to wait for the rest of a request: the silence is the default one, and shorter than
    /// [`PACKET_PAUSE`].
    may_wait: bool,
    last: Instant,
    /// How many bytes there were at each silence after which the rest was waited for.
    cuts: Vec<usize>,
    is_waiting: bool,
}

impl RtuLine {
    pub(super) fn new(line: &SerialLine) -> RtuLine {
        let silence = line.silence();
        let is_configured = matches!(line.mode, LineMode::Rtu { silence: Some(_) });
        RtuLine {
            bytes: [0; MAX_BYTES],
            len: 0,
            silence,
            may_wait: !is_configured && silence < PACKET_PAUSE,
            last: Instant::now(),
            cuts: Vec::new(),
            is_waiting: false,
        }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// Receives some bytes. An error means that the line is lost.
    pub(super) async fn receive(&mut self, port: &SerialPort) -> io::Result<()> {
        let (bytes, len) = read(port).await?;
        self.append(&bytes[..len]);
        Ok(())
    }

    /// Does the same while a request is carried out: of several frames, the last one counts.
    pub(super) async fn receive_newer(&mut self, port: &SerialPort) -> io::Result<()> {
        let (bytes, len) = read(port).await?;
        let pause = self.last.elapsed();
        if pause >= PACKET_PAUSE || (pause >= self.silence && !self.is_incomplete()) {
            self.skip(self.len);
        }
        self.append(&bytes[..len]);
        Ok(())
    }

    /// Whether these are the bytes of a request, or of its start: not of noise.
    pub(super) fn has_request(&self) -> bool {
        match Requests::default().next(self.bytes()) {
            Next::Frame { .. } => true,
            Next::Incomplete => self.len > 1 && self.bytes[0] != 0,
            Next::Damaged { .. } | Next::Stray { .. } => false,
        }
    }

    fn is_incomplete(&self) -> bool {
        Requests::default().next(self.bytes()) == Next::Incomplete
    }

    fn append(&mut self, bytes: &[u8]) {
        // When it is full, the last byte is written over: the frame stays too long.
        let at = self.len.min(MAX_BYTES - 1);
        self.len = MAX_BYTES.min(at + bytes.len());
        self.bytes[at..self.len].copy_from_slice(&bytes[..self.len - at]);
        (self.last, self.is_waiting) = (Instant::now(), false);
    }

    /// When the frame ends, if nothing else arrives.
    pub(super) fn end(&self) -> Instant {
        self.last + if self.is_waiting { PACKET_PAUSE } else { self.silence }
    }

    /// After a silence: whether to wait once more, for the rest of an echo or of a request to a served unit.
    /// Never for other units: their next request comes too soon, and their replies look like incomplete requests.
    pub(super) fn waits_for_rest(&mut self, is_echo: bool, is_served: impl Fn(u8) -> bool) -> bool {
        let may_wait = is_echo
            || self.may_wait
                && is_served(self.bytes[0])
                && self.is_incomplete()
                && self.start().is_none();
        if self.is_waiting || !may_wait {
            return false;
        }
        self.is_waiting = true;
        self.cuts.push(self.len);
        true
    }

    /// Where a valid frame starts that ends here: at the first byte, or at one that came after a silence,
    /// where a new request has come instead of the rest.
    fn start(&self) -> Option<usize> {
        let mut starts = [0].into_iter().chain(self.cuts.iter().copied());
        starts.find(|start| rtu::decode(&self.bytes[*start..self.len]).is_ok())
    }

    /// Takes the frame that has ended.
    pub(super) fn take(&mut self) -> ([u8; MAX_BYTES], usize) {
        self.skip(self.start().unwrap_or_default());
        let (frame, len) = (self.bytes, self.len);
        self.skip(len);
        (frame, len)
    }

    /// Drops the first bytes.
    pub(super) fn skip(&mut self, count: usize) {
        if count > 0 {
            self.bytes.copy_within(count..self.len, 0);
            self.len -= count;
            self.cuts.clear();
            self.is_waiting = false;
        }
    }
}

/// Whether more follows a request whose length is known. The CRC fits again behind zeros, which are noise then, and
/// no longer request.
pub(super) fn has_more(frame: &[u8]) -> bool {
    let mut requests = Requests::default();
    let found = requests.next(frame);
    matches!(found, Next::Frame { len, .. } if len < frame.len()) && requests.is_at_start()
}

async fn read(port: &SerialPort) -> io::Result<([u8; MAX_BYTES], usize)> {
    let mut bytes = [0; MAX_BYTES];
    match port.read(&mut bytes).await? {
        0 => Err(io::ErrorKind::UnexpectedEof.into()),
        len => Ok((bytes, len)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serial_line::{LineDirection, LineParity};

    const UNIT: u8 = 7;

    fn line(silence: Option<Duration>) -> RtuLine {
        RtuLine::new(&SerialLine {
            device: String::new(),
            baud: 9_600,
            parity: LineParity::Even,
            stop_bits: 1,
            data_bits: 8,
            mode: LineMode::Rtu { silence },
            direction: LineDirection::Adapter,
        })
    }

    fn frame(pdu: &[u8]) -> Vec<u8> {
        let mut frame = [0; rtu::MAX_LEN];
        let len = rtu::encode(UNIT, pdu, &mut frame).unwrap();
        frame[..len].to_vec()
    }

    fn taken(line: &mut RtuLine) -> Vec<u8> {
        let (frame, len) = line.take();
        frame[..len].to_vec()
    }

    #[test]
    fn the_rest_of_a_request_may_come_with_the_next_packet_of_an_adapter() {
        let write = frame(&[16, 0, 0, 0, 2, 4, 1, 2, 3, 4]);
        let mut line = line(None);
        for piece in write.chunks(4) {
            line.append(piece);
            let ends = line.bytes().len() == write.len();
            assert_eq!(line.waits_for_rest(false, |unit_id| unit_id == UNIT), !ends);
            assert!(ends || !line.waits_for_rest(false, |_| true), "only once without new bytes");
        }
        assert_eq!(taken(&mut line), write);
        assert!(line.bytes().is_empty());
    }

    #[test]
    fn nothing_is_waited_for_of_other_units_and_with_a_silence_that_was_configured() {
        for (mut line, unit_id) in [(line(None), 9), (line(Some(Duration::from_millis(2))), UNIT)] {
            line.append(&[unit_id, 3, 2, 0, 1, 2, 3]);
            assert!(!line.waits_for_rest(false, |unit_id| unit_id == UNIT));
        }
    }

    #[test]
    fn a_request_that_comes_instead_of_the_rest_is_taken() {
        let read = frame(&[3, 0, 0, 0, 1]);
        for before in [&frame(&[6, 0, 0, 0, 9])[..5], &[0], &[0, 0], &[UNIT, 3], &[UNIT]] {
            let mut line = line(None);
            line.append(before);
            assert!(line.waits_for_rest(false, |_| true));
            line.append(&read);
            while line.waits_for_rest(false, |_| true) {
                line.is_waiting = false;
            }
            assert_eq!(taken(&mut line), read, "after {before:?}");
        }
    }

    #[test]
    fn the_rest_of_an_echo_is_waited_for_too() {
        let mut line = line(Some(Duration::from_millis(2)));
        line.append(&[9, 3, 2]);
        assert!(line.waits_for_rest(true, |_| false));
        assert!(!line.waits_for_rest(true, |_| false), "only once without new bytes");
    }

    #[test]
    fn zeros_behind_a_request_are_no_part_of_it() {
        let read = frame(&[3, 0, 0, 0, 1]);
        for (bytes, expected) in [
            (read.clone(), false),
            ([&read[..], &[0]].concat(), true),
            ([&read[..], &[0, 0]].concat(), true),
            // A longer request.
            (frame(&[3, 0, 0, 0, 1, 0]), false),
            // Of an unknown length: the CRC fits before its last byte too.
            ([&frame(&[100])[..], &[0]].concat(), false),
        ] {
            assert!(rtu::decode(&bytes).is_ok());
            assert_eq!(has_more(&bytes), expected, "{bytes:?}");
        }
    }

    #[test]
    fn noise_is_no_request() {
        for (bytes, is_one) in [
            (&[0][..], false),
            (&[0, 0, 0], false),
            (&[UNIT], false),
            (&[UNIT, 3, 0], true),
            (&frame(&[3, 0, 0, 0, 1]), true),
        ] {
            let mut line = line(None);
            line.append(bytes);
            assert_eq!(line.has_request(), is_one, "{bytes:?}");
        }
    }
}
