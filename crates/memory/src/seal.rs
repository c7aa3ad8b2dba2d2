//! The seal of a memory: which bit opens it, when it closes again, and whose accesses it refuses.

use crate::area::{Area, Layout};
use crate::bits;
use crate::error::Refusal;
use crate::operation::Access;

/// When the gate bit opens the seal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GateMode {
    /// The first ingest that leaves the gate bit at 1 opens the memory until a restart.
    Once,
    /// The memory is sealed whenever the gate bit is 0.
    Level,
}

/// The bit that opens a sealed memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gate {
    pub area: Area,
    pub address: u16,
    pub mode: GateMode,
}

impl Gate {
    /// Refuses a client's write to the gate bit: clients can't open the memory.
    #[inline]
    pub(crate) fn admit_write(
        self,
        access: Access,
        (area, address, count): (Area, u16, usize),
    ) -> Result<(), Refusal> {
        let start = usize::from(address);
        let is_in =
            self.area == area && (start..start + count).contains(&usize::from(self.address));
        if is_in && access == Access::Client { Err(Refusal::GateBit) } else { Ok(()) }
    }

    /// Whether the memory is sealed after an ingest that has left the gate bit like this.
    #[inline]
    pub(crate) fn seals(self, was_sealed: bool, bit: bool) -> bool {
        match self.mode {
            GateMode::Once => was_sealed && !bit,
            GateMode::Level => !bit,
        }
    }

    /// Sets the bit of a gate that opens once to 0 in contents that were restored after a restart: the next
    /// write would open the memory otherwise. Returns whether the memory is sealed: how old the contents are
    /// is unknown, so a gate that opens once is closed again.
    pub fn restore_seal(self, layout: &Layout, areas: &mut [Box<[u8]>]) -> bool {
        let offset = usize::from(self.address - layout.span(self.area).start());
        let area = &mut areas[self.area.index()];
        if self.mode == GateMode::Once {
            bits::copy_in(area, offset, 1, &[0]);
        }
        self.seals(true, bits::get(area, offset))
    }
}

/// Refuses an access that the seal does not admit.
#[inline]
pub(crate) const fn admit(access: Access, is_sealed: bool) -> Result<(), Refusal> {
    match (access, is_sealed) {
        (Access::Client, true) => Err(Refusal::Sealed),
        (Access::Restore, false) => Err(Refusal::Unsealed),
        _ => Ok(()),
    }
}
