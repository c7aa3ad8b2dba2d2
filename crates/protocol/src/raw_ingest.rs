//! Raw Ingest: one packet is one write, answered with one byte.
//!
//! | format | header | trailer |
//! | --- | --- | --- |
//! | v1 | `52 49`, version `01`, area, unit id (2), address (2), count (2) | none |
//! | crc | `52 49`, version `01`, flags `00`, area, reserved `00`, memory id (2), address (2), count (2) | CRC-32 of all before it, or none |
//!
//! All fields are big-endian. Areas: 1 coils, 2 discrete inputs, 3 holding registers, 4 input
//! registers. The length of the payload follows from area and count: bits packed least significant
//! bit first, registers two bytes each.

/// The reply to a packet that was written.
pub const DONE: u8 = 0x00;

/// The reply to a packet that was not.
pub const REFUSED: u8 = 0x01;

const MAGIC: [u8; 2] = *b"RI";
const VERSION: u8 = 1;

/// How packets are laid out. It is agreed on, never guessed from the bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A header of 10 bytes that names a unit id.
    V1,
    /// A header of 12 bytes that names a memory id; with or without CRC-32 behind the payload.
    Crc { required: bool },
}

codes! {
    /// Why a packet is refused. It is counted and logged, never sent; the code is only its place
    /// among the counters.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
    Refusal: u8 {
        Magic = 0, "magic";
        Version = 1, "version";
        Flags = 2, "flags";
        Area = 3, "area";
        Count = 4, "count";
        Unit = 5, "unit";
        Memory = 6, "memory";
        NotGranted = 7, "not_granted";
        Range = 8, "range";
        Crc = 9, "crc";
        Short = 10, "short";
        Late = 11, "late";
        Extra = 12, "extra";
    }
}

/// What a packet says of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// 1 to 4.
    pub area: u8,
    /// A unit id (v1) or a memory id (crc).
    pub target: u16,
    pub address: u16,
    /// At least 1.
    pub count: u16,
}

impl Header {
    /// Bytes of the payload.
    pub const fn payload_len(&self) -> usize {
        let count = self.count as usize;
        if self.area <= 2 { count.div_ceil(8) } else { count * 2 }
    }
}

impl Format {
    /// Bytes of the header.
    pub const fn header_len(self) -> usize {
        match self {
            Format::V1 => 10,
            Format::Crc { .. } => 12,
        }
    }

    /// Bytes behind the payload.
    pub const fn trailer_len(self) -> usize {
        match self {
            Format::Crc { required: true } => 4,
            Format::V1 | Format::Crc { required: false } => 0,
        }
    }

    /// Bytes of a whole packet.
    pub const fn packet_len(self, header: &Header) -> usize {
        self.header_len() + header.payload_len() + self.trailer_len()
    }

    /// The header at the start of `bytes`, which may end anywhere; `None` when it is not complete
    /// and nothing speaks against it so far.
    ///
    /// # Errors
    /// [`Refusal::Magic`], `Version`, `Flags`, `Area`, `Count`: as soon as the byte is there.
    pub fn header(self, bytes: &[u8]) -> Result<Option<Header>, Refusal> {
        let is = |at: usize, expected: u8| bytes.get(at).is_none_or(|byte| *byte == expected);
        if !is(0, MAGIC[0]) || !is(1, MAGIC[1]) {
            return Err(Refusal::Magic);
        }
        if !is(2, VERSION) {
            return Err(Refusal::Version);
        }
        let rest = match self {
            Format::V1 => bytes.get(3..),
            Format::Crc { .. } if !is(3, 0) || !is(5, 0) => return Err(Refusal::Flags),
            Format::Crc { .. } => bytes.get(4..),
        };
        let Some(&[area, ref rest @ ..]) = rest else {
            return Ok(None);
        };
        if !(1..=4).contains(&area) {
            return Err(Refusal::Area);
        }
        let fields = if self == Format::V1 { Some(rest) } else { rest.get(1..) };
        let Some(&[t0, t1, a0, a1, c0, c1, ..]) = fields else {
            return Ok(None);
        };
        let [target, address, count] = [[t0, t1], [a0, a1], [c0, c1]].map(u16::from_be_bytes);
        if count == 0 {
            return Err(Refusal::Count);
        }
        Ok(Some(Header { area, target, address, count }))
    }

    /// The payload of a whole packet.
    ///
    /// # Errors
    /// [`Refusal::Short`] and [`Refusal::Extra`] when `packet` has not the length that its header
    /// says, [`Refusal::Crc`].
    pub fn payload<'p>(self, header: &Header, packet: &'p [u8]) -> Result<&'p [u8], Refusal> {
        match packet.len().cmp(&self.packet_len(header)) {
            std::cmp::Ordering::Less => return Err(Refusal::Short),
            std::cmp::Ordering::Greater => return Err(Refusal::Extra),
            std::cmp::Ordering::Equal => {}
        }
        let (body, trailer) = packet.split_at(packet.len() - self.trailer_len());
        if !trailer.is_empty() && trailer != crc32fast::hash(body).to_be_bytes() {
            return Err(Refusal::Crc);
        }
        Ok(&body[self.header_len()..])
    }

    /// Appends a packet to `packet`. `payload` has exactly [`Header::payload_len`] bytes.
    pub fn encode(self, header: &Header, payload: &[u8], packet: &mut Vec<u8>) {
        debug_assert_eq!(payload.len(), header.payload_len());
        let start = packet.len();
        packet.extend_from_slice(&MAGIC);
        packet.push(VERSION);
        match self {
            Format::V1 => packet.push(header.area),
            Format::Crc { .. } => packet.extend_from_slice(&[0, header.area, 0]),
        }
        for field in [header.target, header.address, header.count] {
            packet.extend_from_slice(&field.to_be_bytes());
        }
        packet.extend_from_slice(payload);
        if self.trailer_len() > 0 {
            let crc = crc32fast::hash(&packet[start..]);
            packet.extend_from_slice(&crc.to_be_bytes());
        }
    }
}
