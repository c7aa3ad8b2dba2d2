//! The status block: 30 registers with health and counters of a device.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use holdfast_memory::{Access, Area, Memory, Refusal, Write};

use super::health::Health;

/// Registers of one block.
pub const STATUS_BLOCK_LEN: u16 = 30;

/// The longest interval between writes of the status block.
pub(super) const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// The size of the device name, in bytes.
const NAME_BYTES: usize = 16;

// The registers of a block, as in docs/devices.md. 11 to 19 are not used: they are 0.
const HEALTH_AT: usize = 0;
const LAST_ERROR_AT: usize = 1;
const SECONDS_IN_ERROR_AT: usize = 2;
const NAME_AT: Range<usize> = 3..11;
/// Two registers for each, the low word first.
const COUNTERS_AT: Range<usize> = 20..28;
const FAILURES_AT: usize = 28;
const MOST_FAILURES_AT: usize = 29;

/// Place and content of the block of a device: at `slot` × 30 of an area of registers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlockSettings {
    pub area: Area,
    pub slot: u16,
    /// The name in the block.
    pub name: String,
    /// Whether the last error stays after a recovery.
    pub keep_last_error: bool,
}

impl BlockSettings {
    /// The first register of the block; `None` if an address of the block is beyond 65535.
    pub(super) fn address(&self) -> Option<u16> {
        let address = self.slot.checked_mul(STATUS_BLOCK_LEN)?;
        address.checked_add(STATUS_BLOCK_LEN - 1).map(|_| address)
    }

    /// Whether the area has registers at these addresses.
    pub(super) fn is_possible(&self) -> bool {
        !self.area.is_bits() && self.address().is_some()
    }
}

/// The memory that has the block of a device.
#[derive(Debug, Clone)]
pub struct StatusSettings {
    pub memory: Arc<Memory>,
    pub block: BlockSettings,
}

impl StatusSettings {
    /// Writes the block of a device that is not polled.
    ///
    /// # Errors
    /// As [`Status::write`].
    pub fn write_disabled_status(&self) -> Result<(), Refusal> {
        Status { health: Health::Disabled, ..Status::default() }.write(self)
    }

    /// Whether the memory has the registers of the block.
    pub(super) fn fits(&self) -> bool {
        let span = self.memory.span(self.block.area);
        let inside = |address| span.holds(address, usize::from(STATUS_BLOCK_LEN));
        self.block.is_possible() && self.block.address().is_some_and(inside)
    }
}

/// The content of a status block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status {
    pub health: Health,
    /// The code of a `Fault` of the link, 0 for none.
    pub last_error: u16,
    pub seconds_in_error: u16,
    pub polls: u32,
    pub good_polls: u32,
    pub timeouts: u32,
    pub transport_errors: u32,
    pub failures: u16,
    pub most_failures: u16,
}

impl Status {
    fn registers(&self, settings: &BlockSettings) -> [u16; STATUS_BLOCK_LEN as usize] {
        let mut block = [0; STATUS_BLOCK_LEN as usize];
        block[HEALTH_AT] = self.health.code();
        if self.failures > 0 || settings.keep_last_error {
            block[LAST_ERROR_AT] = self.last_error;
        }
        block[SECONDS_IN_ERROR_AT] = self.seconds_in_error;
        let mut text = [0; NAME_BYTES];
        for (byte, character) in text.iter_mut().zip(settings.name.bytes()) {
            let is_shown = character.is_ascii_graphic() || character == b' ';
            *byte = if is_shown { character } else { b'?' };
        }
        for (register, pair) in block[NAME_AT].iter_mut().zip(text.as_chunks::<2>().0) {
            *register = u16::from_be_bytes(*pair);
        }
        let counters = [self.polls, self.good_polls, self.timeouts, self.transport_errors];
        for (pair, counter) in block[COUNTERS_AT].as_chunks_mut::<2>().0.iter_mut().zip(counters) {
            *pair = [counter as u16, (counter >> 16) as u16];
        }
        block[FAILURES_AT] = self.failures;
        block[MOST_FAILURES_AT] = self.most_failures;
        block
    }

    /// The bytes of the registers of the block.
    pub fn bytes(&self, settings: &BlockSettings) -> Vec<u8> {
        self.registers(settings).iter().flat_map(|register| register.to_be_bytes()).collect()
    }

    /// Writes the block, atomically.
    ///
    /// # Errors
    /// [`Refusal::OutOfRange`] when the block does not fit. Nothing has changed then.
    pub fn write(&self, to: &StatusSettings) -> Result<(), Refusal> {
        self.write_by(to, |write| to.memory.write(Access::Ingest, write))
    }

    /// As [`Status::write`], by something else than the memory.
    pub(super) fn write_by(
        &self,
        to: &StatusSettings,
        write_to: impl FnOnce(Write<'_>) -> Result<(), Refusal>,
    ) -> Result<(), Refusal> {
        let bytes = self.bytes(&to.block);
        let write = Write {
            area: to.block.area,
            address: to.block.address().ok_or(Refusal::OutOfRange)?,
            count: usize::from(STATUS_BLOCK_LEN),
            bytes: &bytes,
        };
        write_to(write)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::Fault;

    #[test]
    fn the_block_has_the_documented_layout() {
        let status = Status {
            health: Health::Error,
            last_error: Fault::Timeout.code(),
            seconds_in_error: 7,
            polls: 0x0001_0002,
            good_polls: 3,
            timeouts: 4,
            transport_errors: 5,
            failures: 6,
            most_failures: 8,
        };
        let mut settings = BlockSettings {
            area: Area::InputRegisters,
            slot: 0,
            name: "meter_1 and more than sixteen".into(),
            keep_last_error: false,
        };
        let block = status.registers(&settings);
        assert_eq!(block[..3], [2, 0x8001, 7]);
        assert_eq!(block[3..11], [0x6D65, 0x7465, 0x725F, 0x3120, 0x616E, 0x6420, 0x6D6F, 0x7265]);
        assert_eq!(block[11..20], [0; 9]);
        assert_eq!(block[20..], [2, 1, 3, 0, 4, 0, 5, 0, 6, 8]);
        let recovered = Status { failures: 0, ..status };
        assert_eq!(recovered.registers(&settings)[1], 0);
        settings.keep_last_error = true;
        assert_eq!(recovered.registers(&settings)[1], 0x8001);
        settings.name = "a\tb\u{e9}".into();
        assert_eq!(recovered.registers(&settings)[3..6], [0x613F, 0x623F, 0x3F00]);
    }
}
