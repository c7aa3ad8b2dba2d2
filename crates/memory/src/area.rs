//! The four areas of a memory, and the range of addresses of each.

use crate::error::LayoutError;

/// One of the four areas of the Modbus data model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Area {
    Coils,
    DiscreteInputs,
    HoldingRegisters,
    InputRegisters,
}

impl Area {
    pub const ALL: [Area; 4] =
        [Area::Coils, Area::DiscreteInputs, Area::HoldingRegisters, Area::InputRegisters];

    /// The name used in configurations and messages.
    pub const fn name(self) -> &'static str {
        match self {
            Area::Coils => "coils",
            Area::DiscreteInputs => "discrete_inputs",
            Area::HoldingRegisters => "holding_registers",
            Area::InputRegisters => "input_registers",
        }
    }

    pub fn from_name(name: &str) -> Option<Area> {
        Area::ALL.into_iter().find(|area| area.name() == name)
    }

    /// Whether an item of this area is one bit; otherwise it is a 16-bit register.
    pub const fn is_bits(self) -> bool {
        matches!(self, Area::Coils | Area::DiscreteInputs)
    }

    /// The number of bytes of `count` items. Bits are packed eight to a byte.
    pub const fn byte_len(self, count: usize) -> usize {
        if self.is_bits() { count.div_ceil(8) } else { count * 2 }
    }

    /// Copies `count` items from item `at` of one range to item `to` of another.
    pub fn copy(self, from: &[u8], at: usize, into: &mut [u8], to: usize, count: usize) {
        if self.is_bits() {
            for index in 0..count {
                let (at, to) = (at + index, to + index);
                let (bit, mask) = (from[at / 8] >> (at % 8) & 1, 1 << (to % 8));
                into[to / 8] = into[to / 8] & !mask | bit << (to % 8);
            }
        } else {
            into[to * 2..(to + count) * 2].copy_from_slice(&from[at * 2..(at + count) * 2]);
        }
    }

    pub(crate) const fn index(self) -> usize {
        self as usize
    }
}

/// The addresses of one area: `start` to `start + size - 1`. With size 0 the area does not exist:
/// every access to it is out of range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Span {
    start: u16,
    size: u32,
}

impl Span {
    /// The number of 16-bit addresses.
    pub const MAX_SIZE: u32 = 65_536;

    /// # Errors
    /// [`LayoutError::TooLarge`] when `start + size` is greater than 65,536.
    pub fn new(start: u16, size: u32) -> Result<Span, LayoutError> {
        match u32::from(start).checked_add(size) {
            Some(end) if end <= Span::MAX_SIZE => Ok(Span { start, size }),
            _ => Err(LayoutError::TooLarge { start, size }),
        }
    }

    pub const fn start(self) -> u16 {
        self.start
    }

    pub const fn size(self) -> u32 {
        self.size
    }

    /// The address after the last one, at most 65,536.
    pub const fn end(self) -> u32 {
        self.start as u32 + self.size
    }

    /// Whether all of `address .. address + count` is inside the span.
    pub fn holds(self, address: u16, count: usize) -> bool {
        self.offset(address, count).is_some()
    }

    /// The offset of `address` from the start; `None` unless all of `address .. address + count` is
    /// inside the span.
    pub(crate) fn offset(self, address: u16, count: usize) -> Option<usize> {
        let offset = usize::from(address.checked_sub(self.start)?);
        let end = offset.checked_add(count)?;
        (end <= self.size as usize).then_some(offset)
    }
}

/// The four spans of a memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Layout {
    spans: [Span; 4],
}

impl Layout {
    /// Returns this layout with the span of `area` replaced.
    #[must_use]
    pub fn with(mut self, area: Area, span: Span) -> Layout {
        self.spans[area.index()] = span;
        self
    }

    pub const fn span(&self, area: Area) -> Span {
        self.spans[area.index()]
    }
}
