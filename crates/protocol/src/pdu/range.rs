//! The range of items that a request reads: an address and a quantity that its function allows.

use super::{RequestError, limit};

/// `quantity` items from `address`, 1 to `MAX` of them.
///
/// `MAX` is the limit of the function and follows from the [`Request`](super::Request) that the
/// range is for. The end of a range can be beyond the last address, 65535. The memory decides about
/// addresses: a server answers [`IllegalDataAddress`](super::ExceptionCode::IllegalDataAddress)
/// then.
///
/// ```
/// use holdfast_protocol::pdu::{Range, Request, RequestError};
///
/// let request = Request::ReadHoldingRegisters(Range::new(100, 125)?);
/// assert_eq!(
///     Range::new(100, 126).map(Request::ReadHoldingRegisters),
///     Err(RequestError::Quantity { found: 126, max: 125 })
/// );
/// # Ok::<(), RequestError>(())
/// ```
///
/// The fields are private, so a quantity of 0 or one beyond the limit cannot be written:
///
/// ```compile_fail,E0451
/// # use holdfast_protocol::pdu::{Range, Request};
/// let request = Request::ReadHoldingRegisters(Range { address: 100, quantity: 126 });
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Range<const MAX: u16> {
    address: u16,
    quantity: u16,
}

/// The range of functions 1 and 2: 1 to 2000 coils or discrete inputs.
pub type BitRange = Range<{ limit::READ_BITS }>;

/// The range of functions 3, 4 and 23: 1 to 125 registers.
pub type RegisterRange = Range<{ limit::READ_REGISTERS }>;

impl<const MAX: u16> Range<MAX> {
    /// `quantity` items from `address`.
    ///
    /// # Errors
    /// [`RequestError::Quantity`] unless `quantity` is 1 to `MAX`.
    #[inline]
    pub const fn new(address: u16, quantity: u16) -> Result<Range<MAX>, RequestError> {
        if 1 <= quantity && quantity <= MAX {
            Ok(Range { address, quantity })
        } else {
            Err(RequestError::Quantity { found: quantity as usize, max: MAX })
        }
    }

    /// The first address.
    #[inline]
    pub const fn address(self) -> u16 {
        self.address
    }

    /// How many items, 1 to `MAX`.
    #[inline]
    pub const fn quantity(self) -> u16 {
        self.quantity
    }

    /// The address after the last item; beyond 65536 when the range leaves the address space.
    ///
    /// ```
    /// use holdfast_protocol::pdu::BitRange;
    ///
    /// assert_eq!(BitRange::new(65535, 1).unwrap().end(), 65536);
    /// assert_eq!(BitRange::new(65535, 2).unwrap().end(), 65537);
    /// ```
    #[inline]
    pub const fn end(self) -> u32 {
        self.address as u32 + self.quantity as u32
    }

    /// The range as indices of a slice that starts at address 0.
    ///
    /// ```
    /// use holdfast_protocol::pdu::RegisterRange;
    ///
    /// let registers = [7, 8, 9];
    /// let range = RegisterRange::new(1, 2).unwrap();
    /// assert_eq!(registers.get(range.indices()), Some(&[8, 9][..]));
    /// let beyond = RegisterRange::new(2, 2).unwrap();
    /// assert_eq!(registers.get(beyond.indices()), None);
    /// ```
    #[inline]
    pub const fn indices(self) -> core::ops::Range<usize> {
        self.address as usize..self.end() as usize
    }
}

impl BitRange {
    /// Bytes that the bits take in a reply, 1 to 250.
    #[inline]
    pub const fn byte_len(self) -> usize {
        (self.quantity as usize).div_ceil(8)
    }
}

impl RegisterRange {
    /// Bytes that the registers take in a reply, 2 to 250.
    #[inline]
    pub const fn byte_len(self) -> usize {
        self.quantity as usize * 2
    }
}
