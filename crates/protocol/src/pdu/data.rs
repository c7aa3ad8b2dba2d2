//! Bits and registers as a PDU carries them.

use super::{BitRange, Buffer, RegisterRange, RequestError, limit};

/// 1 to `MAX` bits, packed eight to a byte, the least significant bit first (V1.1b3, 6.1).
///
/// `MAX` is the limit of the function and follows from the [`Request`](super::Request) or
/// [`Response`](super::Response) that has the bits. Quantity and bytes always agree.
///
/// ```
/// use holdfast_protocol::pdu::{self, Bits, Request, RequestError};
///
/// let mut room = [0; pdu::MAX_LEN];
/// let bits = Bits::pack(&[true, false, true], &mut room)?;
/// assert_eq!((bits.quantity(), bits.as_bytes()), (3, &[0b101][..]));
/// assert!(bits.iter().eq([true, false, true]));
/// let request = Request::WriteMultipleCoils { address: 19, bits };
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Bits<'a, const MAX: u16> {
    quantity: u16,
    bytes: &'a [u8],
}

impl<'a, const MAX: u16> Bits<'a, MAX> {
    /// Bits that are packed already. Unused bits of the last byte may have any value.
    ///
    /// # Errors
    /// [`RequestError::Quantity`] unless `quantity` is 1 to `MAX`, [`RequestError::Length`] when
    /// `bytes` does not have the length that the bits require.
    #[inline]
    pub const fn new(quantity: u16, bytes: &'a [u8]) -> Result<Bits<'a, MAX>, RequestError> {
        if quantity == 0 || quantity > MAX {
            return Err(RequestError::Quantity { found: quantity as usize, max: MAX });
        }
        let expected = (quantity as usize).div_ceil(8);
        if bytes.len() != expected {
            return Err(RequestError::Length { found: bytes.len(), expected });
        }
        Ok(Bits { quantity, bytes })
    }

    /// Packs bits at the start of `room`.
    ///
    /// # Errors
    /// [`RequestError::Quantity`] unless there are 1 to `MAX` values.
    pub fn pack(values: &[bool], room: &'a mut Buffer) -> Result<Bits<'a, MAX>, RequestError> {
        let quantity = quantity(values.len(), MAX)?;
        let bytes = &mut room[..values.len().div_ceil(8)];
        pack_bits(values, bytes);
        Bits::new(quantity, bytes)
    }

    /// How many bits, 1 to `MAX`.
    #[inline]
    pub const fn quantity(&self) -> u16 {
        self.quantity
    }

    /// The packed bits.
    #[inline]
    pub const fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// One bit, counted from 0; `None` if `index` is [`Bits::quantity`] or more.
    pub fn get(&self, index: u16) -> Option<bool> {
        let byte = self.bytes.get(usize::from(index / 8)).filter(|_| index < self.quantity)?;
        Some(byte >> (index % 8) & 1 == 1)
    }

    /// The bits, in order.
    pub fn iter(&self) -> impl Iterator<Item = bool> + use<'a, MAX> {
        let each = |byte: &'a u8| (0..8).map(move |bit| byte >> bit & 1 == 1);
        self.bytes.iter().flat_map(each).take(usize::from(self.quantity))
    }
}

impl<'a> Bits<'a, { limit::READ_BITS }> {
    /// The bits of a range. `bytes` has the length that the range requires.
    #[inline]
    pub(super) const fn in_range(range: BitRange, bytes: &'a [u8]) -> Self {
        debug_assert!(bytes.len() == range.byte_len());
        Bits { quantity: range.quantity(), bytes }
    }
}

/// 1 to `MAX` registers, each two bytes, the high byte first (V1.1b3, 4.2).
///
/// `MAX` is the limit of the function and follows from the [`Request`](super::Request) or
/// [`Response`](super::Response) that has the registers.
///
/// ```
/// use holdfast_protocol::pdu::{self, Registers, Request, RequestError};
///
/// let mut room = [0; pdu::MAX_LEN];
/// let registers = Registers::pack(&[10, 258], &mut room)?;
/// assert_eq!((registers.quantity(), registers.as_bytes()), (2, &[0, 10, 1, 2][..]));
/// assert!(registers.iter().eq([10, 258]));
/// let request = Request::WriteMultipleRegisters { address: 1, registers };
/// # Ok::<(), RequestError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Registers<'a, const MAX: u16> {
    bytes: &'a [u8],
}

impl<'a, const MAX: u16> Registers<'a, MAX> {
    /// Registers in big-endian bytes, two for each.
    ///
    /// # Errors
    /// [`RequestError::Length`] for an odd number of bytes, [`RequestError::Quantity`] unless there
    /// are 1 to `MAX` registers.
    #[inline]
    pub const fn new(bytes: &'a [u8]) -> Result<Registers<'a, MAX>, RequestError> {
        let found = bytes.len() / 2;
        if bytes.len() % 2 == 1 {
            Err(RequestError::Length { found: bytes.len(), expected: bytes.len() + 1 })
        } else if found == 0 || found > MAX as usize {
            Err(RequestError::Quantity { found, max: MAX })
        } else {
            Ok(Registers { bytes })
        }
    }

    /// Packs registers at the start of `room`.
    ///
    /// # Errors
    /// [`RequestError::Quantity`] unless there are 1 to `MAX` values.
    pub fn pack(values: &[u16], room: &'a mut Buffer) -> Result<Registers<'a, MAX>, RequestError> {
        quantity(values.len(), MAX)?;
        let bytes = &mut room[..values.len() * 2];
        pack_registers(values, bytes);
        Registers::new(bytes)
    }

    /// How many registers, 1 to `MAX`.
    #[inline]
    pub const fn quantity(&self) -> u16 {
        (self.bytes.len() / 2) as u16
    }

    /// The registers as big-endian bytes.
    #[inline]
    pub const fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// One register, counted from 0; `None` if `index` is [`Registers::quantity`] or more.
    pub fn get(&self, index: u16) -> Option<u16> {
        self.pairs().get(usize::from(index)).copied().map(u16::from_be_bytes)
    }

    /// The registers, in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = u16> + use<'a, MAX> {
        self.pairs().iter().copied().map(u16::from_be_bytes)
    }

    fn pairs(&self) -> &'a [[u8; 2]] {
        self.bytes.as_chunks().0
    }
}

impl<'a> Registers<'a, { limit::READ_REGISTERS }> {
    /// The registers of a range. `bytes` has the length that the range requires.
    #[inline]
    pub(super) const fn in_range(range: RegisterRange, bytes: &'a [u8]) -> Self {
        debug_assert!(bytes.len() == range.byte_len());
        Registers { bytes }
    }
}

/// Converts a number of values to a quantity, if it is 1 to `max`.
fn quantity(found: usize, max: u16) -> Result<u16, RequestError> {
    match u16::try_from(found) {
        Ok(quantity) if (1..=max).contains(&quantity) => Ok(quantity),
        _ => Err(RequestError::Quantity { found, max }),
    }
}

/// Packs bits eight to a byte, the least significant bit first. Unused bits of the last byte are 0.
///
/// ```
/// use holdfast_protocol::pdu::pack_bits;
///
/// let mut bytes = [0xFF; 2];
/// pack_bits(&[true, false, true, true, false, false, true, true, true], &mut bytes);
/// assert_eq!(bytes, [0xCD, 0x01]);
/// ```
///
/// # Panics
/// When `bytes` does not have the length that the bits require.
pub fn pack_bits(values: &[bool], bytes: &mut [u8]) {
    assert_eq!(bytes.len(), values.len().div_ceil(8), "bytes for {} bits", values.len());
    for (byte, bits) in bytes.iter_mut().zip(values.chunks(8)) {
        *byte = bits.iter().rev().fold(0, |byte, bit| byte << 1 | u8::from(*bit));
    }
}

/// Packs registers as big-endian bytes.
///
/// ```
/// use holdfast_protocol::pdu::pack_registers;
///
/// let mut bytes = [0; 4];
/// pack_registers(&[555, 100], &mut bytes);
/// assert_eq!(bytes, [0x02, 0x2B, 0x00, 0x64]);
/// ```
///
/// # Panics
/// When `bytes` does not have two bytes for each register.
pub fn pack_registers(values: &[u16], bytes: &mut [u8]) {
    assert_eq!(bytes.len(), values.len() * 2, "bytes for {} registers", values.len());
    for (pair, value) in bytes.as_chunks_mut().0.iter_mut().zip(values) {
        *pair = value.to_be_bytes();
    }
}
