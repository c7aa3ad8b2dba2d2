//! The four areas of a memory and its files, and the range of addresses of each.

use std::borrow::Cow;
use std::ops::Range;

use crate::bits;
use crate::error::LayoutError;

/// One of the four areas of the Modbus data model, or a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Area {
    Coils,
    DiscreteInputs,
    HoldingRegisters,
    InputRegisters,
    /// The file of this number. Its addresses are record numbers, its items records of one register.
    File(u16),
}

/// What the name of a file begins with; its number follows.
const FILE: &str = "file:";

impl Area {
    /// The four areas; not files.
    pub const ALL: [Area; 4] =
        [Area::Coils, Area::DiscreteInputs, Area::HoldingRegisters, Area::InputRegisters];

    /// The name used in configurations and messages.
    pub fn name(self) -> Cow<'static, str> {
        Cow::Borrowed(match self {
            Area::Coils => "coils",
            Area::DiscreteInputs => "discrete_inputs",
            Area::HoldingRegisters => "holding_registers",
            Area::InputRegisters => "input_registers",
            Area::File(number) => return Cow::Owned(format!("{FILE}{number}")),
        })
    }

    /// One of the four areas.
    pub fn from_name(name: &str) -> Option<Area> {
        Area::ALL.into_iter().find(|area| area.name() == name)
    }

    pub fn file_from_name(name: &str) -> Option<Area> {
        let number: u16 = name.strip_prefix(FILE)?.parse().ok()?;
        Some(Area::File(number)).filter(|file| number > 0 && file.name() == name)
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

    /// Copies `count` items, from item `at` of a range, to `out`, which has room for just them.
    #[inline]
    pub(crate) fn copy_out(self, from: &[u8], at: usize, count: usize, out: &mut [u8]) {
        if self.is_bits() {
            bits::copy_out(from, at, count, out);
        } else {
            out.copy_from_slice(&from[at * 2..(at + count) * 2]);
        }
    }

    /// Copies `count` items, which are all of `values`, to item `at` of a range.
    #[inline]
    pub(crate) fn copy_in(self, into: &mut [u8], at: usize, count: usize, values: &[u8]) {
        if self.is_bits() {
            bits::copy_in(into, at, count, values);
        } else {
            into[at * 2..(at + count) * 2].copy_from_slice(values);
        }
    }

    /// Which of the bytes of a memory contain the area: see [`Contents::areas`](crate::Contents).
    pub const fn index(self) -> usize {
        match self {
            Area::Coils => 0,
            Area::DiscreteInputs => 1,
            Area::HoldingRegisters => 2,
            Area::InputRegisters => 3,
            Area::File(_) => FILES,
        }
    }
}

/// The index of all files.
pub(crate) const FILES: usize = Area::ALL.len();

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

/// The spans of the areas and files of a memory.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Layout {
    spans: [Span; 4],
    /// Sorted by their numbers.
    files: Vec<File>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct File {
    number: u16,
    span: Span,
    /// How many records the files before it have.
    before: u32,
}

impl File {
    const fn end(self) -> u32 {
        self.before + self.span.size
    }
}

impl Layout {
    /// Returns this layout with the span of `area` replaced.
    #[must_use]
    pub fn with(mut self, area: Area, span: Span) -> Layout {
        let Area::File(number) = area else {
            self.spans[area.index()] = span;
            return self;
        };
        let at = self.files.partition_point(|file| file.number < number);
        if self.files.get(at).is_some_and(|file| file.number == number) {
            self.files.remove(at);
        }
        if span.size > 0 {
            self.files.insert(at, File { number, span, before: 0 });
        }
        for at in at..self.files.len() {
            self.files[at].before = if at == 0 { 0 } else { self.files[at - 1].end() };
        }
        self
    }

    pub fn span(&self, area: Area) -> Span {
        match area {
            Area::File(number) => self.file(number).map_or_else(Span::default, |file| file.span),
            area => self.spans[area.index()],
        }
    }

    /// The four areas, and the files that exist.
    pub fn areas(&self) -> impl Iterator<Item = Area> {
        Area::ALL.into_iter().chain(self.files.iter().map(|file| Area::File(file.number)))
    }

    pub fn has_files(&self) -> bool {
        !self.files.is_empty()
    }

    /// The lengths of the bytes of a memory, see [`Contents::areas`](crate::Contents).
    pub fn byte_lens(&self) -> Vec<usize> {
        let areas = Area::ALL.map(|area| area.byte_len(self.span(area).size as usize));
        let files = self.files.last().map(|last| last.end() as usize * 2);
        areas.into_iter().chain(files).collect()
    }

    /// Where the bytes of a range are: the index of its area, and the bytes there. `None` unless it has
    /// items, and all of `address .. address + count` exists.
    pub fn bytes(&self, area: Area, address: u16, count: usize) -> Option<(usize, Range<usize>)> {
        let offset = self.offset(area, address, count).filter(|_| count > 0)?;
        let range = if area.is_bits() {
            offset / 8..(offset + count).div_ceil(8)
        } else {
            offset * 2..(offset + count) * 2
        };
        Some((area.index(), range))
    }

    /// The offset of `address` in the bytes of its area, in items; `None` unless all of
    /// `address .. address + count` exists.
    #[inline]
    pub(crate) fn offset(&self, area: Area, address: u16, count: usize) -> Option<usize> {
        match area {
            Area::File(number) => {
                let file = self.file(number)?;
                Some(file.before as usize + file.span.offset(address, count)?)
            }
            area => self.spans[area.index()].offset(address, count),
        }
    }

    /// As [`Layout::offset`], of an address that exists.
    #[inline]
    pub(crate) fn offset_inside(&self, area: Area, address: u16) -> usize {
        let (before, span) = match area {
            Area::File(number) => {
                self.file(number).map_or((0, Span::default()), |file| (file.before, file.span))
            }
            area => (0, self.spans[area.index()]),
        };
        before as usize + usize::from(address - span.start)
    }

    #[cold]
    fn file(&self, number: u16) -> Option<&File> {
        let at = self.files.binary_search_by_key(&number, |file| file.number).ok()?;
        self.files.get(at)
    }
}
