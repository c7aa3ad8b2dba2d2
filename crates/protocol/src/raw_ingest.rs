//! Raw Ingest: one packet is one write, answered with one byte.
//!
//! | format | header | trailer |
//! | --- | --- | --- |
//! | v1 | `52 49`, version `01`, area, unit id (2), address (2), count (2) | none |
//! | crc | `52 49`, version `01`, flags `00`, area, reserved `00`, memory id (2), address (2), count (2) | CRC-32 of all before it, or none |
//!
//! All fields are big-endian. The length of the payload follows from area and count: bits packed
//! least significant bit first, registers two bytes each.
//!
//! ```
//! use core::num::NonZeroU16;
//! use holdfast_protocol::raw_ingest::{Area, Format, Header};
//!
//! let count = NonZeroU16::new(2).unwrap();
//! let header = Header { area: Area::HoldingRegisters, target: 1, address: 100, count };
//! let mut packet = [0; 64];
//! let len = Format::V1.encode_to_slice(&header, &[0, 10, 1, 2], &mut packet)?;
//! assert_eq!(packet[..len], [0x52, 0x49, 1, 3, 0, 1, 0, 100, 0, 2, 0, 10, 1, 2]);
//!
//! // A receiver knows the header before the payload has arrived.
//! assert_eq!(Format::V1.header(&packet[..9]), Ok(None));
//! let received = Format::V1.header(&packet[..10])?.unwrap();
//! assert_eq!(received, header);
//! assert_eq!(Format::V1.payload(&received, &packet[..len])?, [0, 10, 1, 2]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use core::num::NonZeroU16;

use thiserror::Error;

/// The reply to a packet that was written.
pub const DONE: u8 = 0x00;

/// The reply to a packet that was not written.
pub const REFUSED: u8 = 0x01;

/// The first two bytes of a packet. The transaction id of a Modbus frame can be the same.
pub const MAGIC: [u8; 2] = *b"RI";
const VERSION: u8 = 1;

/// The longest header, in bytes.
const MAX_HEADER_LEN: usize = 12;

/// Bytes of a CRC-32.
const CRC_LEN: usize = 4;

/// The layout of packets. Sender and receiver agree on the format; it is never guessed from the
/// bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum Format {
    /// A header of 10 bytes that names a unit id.
    V1,
    /// A header of 12 bytes that names a memory id.
    Crc {
        /// Whether packets end with a CRC-32. Otherwise, what follows the payload is not part of the
        /// packet.
        required: bool,
    },
}

codes! {
    /// The area that a packet writes: one of the four areas of the Modbus data model.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
    Area: u8 {
        Coils = 1, "coils";
        DiscreteInputs = 2, "discrete_inputs";
        HoldingRegisters = 3, "holding_registers";
        InputRegisters = 4, "input_registers";
    }
}

codes! {
    /// Why a receiver refused a packet. It counts and logs the refusal and never sends it. The code
    /// is only an index for counters.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
    #[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
    #[error("packet refused: {}", self.name())]
    Refusal: u8 {
        /// The packet does not start with `52 49`.
        Magic = 0, "magic";
        /// The version is not 1.
        Version = 1, "version";
        /// Flags or the reserved byte are not 0.
        Flags = 2, "flags";
        /// The area is not 1 to 4.
        Area = 3, "area";
        /// The count is 0.
        Count = 4, "count";
        /// The receiver has no memory for the unit id.
        Unit = 5, "unit";
        /// The receiver has no memory with the memory id.
        Memory = 6, "memory";
        /// The sender may not write to the area.
        NotGranted = 7, "not_granted";
        /// The memory lacks some of the addresses.
        Range = 8, "range";
        /// The CRC does not match the bytes before it.
        Crc = 9, "crc";
        /// The packet ended before its last byte.
        Short = 10, "short";
        /// The packet was not complete in time.
        Late = 11, "late";
        /// The receiver must record the write, and can't.
        Unrecorded = 12, "unrecorded";
        /// The receiver must keep the write, and can't.
        NotStored = 13, "not_stored";
        /// The write was passed on, and not confirmed: it may still be carried out.
        NotConfirmed = 14, "not_confirmed";
        /// Too many writes wait for what keeps them.
        Busy = 15, "busy";
        /// The write is larger than what keeps it takes.
        TooLarge = 16, "too_large";
    }
}

/// Why a packet cannot be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
#[cfg_attr(not(feature = "exhaustive"), non_exhaustive)]
pub enum EncodeError {
    /// The payload does not have the length that the header requires.
    #[error("payload has {found} bytes, the header requires {expected}")]
    Payload {
        /// The length that was given, in bytes.
        found: usize,
        /// The length that is required, in bytes.
        expected: usize,
    },
    /// The buffer is too short for the packet.
    #[error("packet has {expected} bytes, there is room for {found}")]
    Room {
        /// The room that was given, in bytes.
        found: usize,
        /// The length of the packet, in bytes.
        expected: usize,
    },
}

/// The header of a packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Header {
    /// The area to write.
    pub area: Area,
    /// A unit id (v1) or a memory id (crc).
    pub target: u16,
    /// The first address.
    pub address: u16,
    /// The number of bits or registers.
    pub count: NonZeroU16,
}

impl Area {
    /// Whether an item of this area is one bit; else it is a register.
    pub const fn is_bits(self) -> bool {
        matches!(self, Area::Coils | Area::DiscreteInputs)
    }
}

impl Header {
    /// Bytes of the payload, up to 131,070.
    pub const fn payload_len(&self) -> usize {
        let count = self.count.get() as usize;
        if self.area.is_bits() { count.div_ceil(8) } else { count * 2 }
    }
}

impl Format {
    /// Bytes of the header.
    pub const fn header_len(self) -> usize {
        match self {
            Format::V1 => 10,
            Format::Crc { .. } => MAX_HEADER_LEN,
        }
    }

    /// Bytes of the packet after the payload.
    pub const fn trailer_len(self) -> usize {
        match self {
            Format::Crc { required: true } => CRC_LEN,
            Format::V1 | Format::Crc { required: false } => 0,
        }
    }

    /// Bytes of a whole packet.
    pub const fn packet_len(self, header: &Header) -> usize {
        self.header_len() + header.payload_len() + self.trailer_len()
    }

    /// The header at the start of `bytes`, which may end anywhere. `None` when the header is
    /// incomplete and valid so far.
    ///
    /// # Errors
    /// [`Refusal::Magic`], [`Refusal::Version`], [`Refusal::Flags`], [`Refusal::Area`] or
    /// [`Refusal::Count`], as soon as the wrong byte has arrived.
    pub fn header(self, bytes: &[u8]) -> Result<Option<Header>, Refusal> {
        self.checked_header(bytes, true)
    }

    /// As [`Format::header`], but flags and the reserved byte may have any value.
    ///
    /// # Errors
    /// As [`Format::header`], without [`Refusal::Flags`].
    pub fn header_with_any_flags(self, bytes: &[u8]) -> Result<Option<Header>, Refusal> {
        self.checked_header(bytes, false)
    }

    fn checked_header(self, bytes: &[u8], strict: bool) -> Result<Option<Header>, Refusal> {
        // In the order of the bytes, so that the refusal does not depend on how many have arrived.
        let is = |at: usize, expected: u8| bytes.get(at).is_none_or(|byte| *byte == expected);
        if !is(0, MAGIC[0]) || !is(1, MAGIC[1]) {
            return Err(Refusal::Magic);
        }
        if !is(2, VERSION) {
            return Err(Refusal::Version);
        }
        let (checks_flags, area_at) = match self {
            Format::V1 => (false, 3),
            Format::Crc { .. } => (strict, 4),
        };
        if checks_flags && !is(3, 0) {
            return Err(Refusal::Flags);
        }
        let Some(&[area, ref rest @ ..]) = bytes.get(area_at..) else {
            return Ok(None);
        };
        let area = Area::from_code(area).ok_or(Refusal::Area)?;
        if checks_flags && !is(5, 0) {
            return Err(Refusal::Flags);
        }
        let fields = if self == Format::V1 { Some(rest) } else { rest.get(1..) };
        let Some(&[t0, t1, a0, a1, c0, c1, ..]) = fields else {
            return Ok(None);
        };
        let [target, address, count] = [[t0, t1], [a0, a1], [c0, c1]].map(u16::from_be_bytes);
        let count = NonZeroU16::new(count).ok_or(Refusal::Count)?;
        Ok(Some(Header { area, target, address, count }))
    }

    /// The payload of the packet that `bytes` begin with. What follows the packet is ignored.
    ///
    /// # Errors
    /// [`Refusal::Short`] when `bytes` end before the packet, [`Refusal::Crc`] for a wrong CRC.
    pub fn payload<'p>(self, header: &Header, bytes: &'p [u8]) -> Result<&'p [u8], Refusal> {
        let packet = bytes.get(..self.packet_len(header)).ok_or(Refusal::Short)?;
        let (body, trailer) = packet.split_at(packet.len() - self.trailer_len());
        if !trailer.is_empty() && trailer != crc32fast::hash(body).to_be_bytes() {
            return Err(Refusal::Crc);
        }
        Ok(&body[self.header_len()..])
    }

    /// Writes a packet at the start of `packet` and returns its length.
    ///
    /// # Errors
    /// [`EncodeError::Payload`] unless `payload` has [`Header::payload_len`] bytes,
    /// [`EncodeError::Room`] when `packet` is shorter than [`Format::packet_len`].
    pub fn encode_to_slice(
        self,
        header: &Header,
        payload: &[u8],
        packet: &mut [u8],
    ) -> Result<usize, EncodeError> {
        if payload.len() != header.payload_len() {
            let (found, expected) = (payload.len(), header.payload_len());
            return Err(EncodeError::Payload { found, expected });
        }
        let (found, expected) = (packet.len(), self.packet_len(header));
        let packet = packet.get_mut(..expected).ok_or(EncodeError::Room { found, expected })?;
        let (head, rest) = packet.split_at_mut(self.header_len());
        let (body, trailer) = rest.split_at_mut(payload.len());
        let (start, fields) = head.split_at_mut(head.len() - 6);
        let area = header.area.code();
        match self {
            Format::V1 => start.copy_from_slice(&[MAGIC[0], MAGIC[1], VERSION, area]),
            Format::Crc { .. } => {
                start.copy_from_slice(&[MAGIC[0], MAGIC[1], VERSION, 0, area, 0]);
            }
        }
        let words = [header.target, header.address, header.count.get()];
        for (pair, word) in fields.as_chunks_mut().0.iter_mut().zip(words) {
            *pair = word.to_be_bytes();
        }
        body.copy_from_slice(payload);
        if !trailer.is_empty() {
            let mut crc = crc32fast::Hasher::new();
            crc.update(head);
            crc.update(body);
            trailer.copy_from_slice(&crc.finalize().to_be_bytes());
        }
        Ok(expected)
    }

    /// Appends a packet to `packet`. Requires the feature `alloc`.
    ///
    /// # Errors
    /// [`EncodeError::Payload`] unless `payload` has [`Header::payload_len`] bytes. `packet` is
    /// unchanged then.
    #[cfg(feature = "alloc")]
    pub fn encode(
        self,
        header: &Header,
        payload: &[u8],
        packet: &mut alloc::vec::Vec<u8>,
    ) -> Result<(), EncodeError> {
        let start = packet.len();
        packet.resize(start + self.packet_len(header), 0);
        let written = self.encode_to_slice(header, payload, &mut packet[start..]);
        if written.is_err() {
            packet.truncate(start);
        }
        written.map(|_| ())
    }
}
